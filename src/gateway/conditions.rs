//! Alarms: their conditions on tags, the conditions that the gateway itself watches, and their list.
//!
//! A condition of a mapping is decided from values that can be used only. Where one of them cannot, the rest may
//! still decide (`a or b` holds when `a` does); if not, the condition stays as it was: an alarm is neither raised
//! nor cleared by data that nobody should act on.

use std::collections::BTreeMap;

use crate::alarms::{AlarmList, AlarmSpec, Transition};
use crate::mapping::{AlarmCondition, AlarmDef, AlarmOwner, BuiltIn, Expression, TagTable};
use crate::process_image::{AlarmIndex, AlarmStatus, Quality, Revision, Sample, TagIndex, Value};
use crate::time::{Instant, Now};

use super::marks::Marks;

/// All alarms and what raises them.
#[derive(Debug)]
pub(super) struct Conditions {
    list: AlarmList,
    built_in: BTreeMap<(AlarmOwner, BuiltIn), AlarmIndex>,
    /// By alarm: whether its condition held when it was last looked at.
    holds: Vec<bool>,
    /// By tag: the alarms whose condition looks at it.
    by_tag: Vec<Vec<AlarmIndex>>,
    /// Alarms of which an input changed.
    outdated: Marks,
    unpublished: bool,
}

impl Conditions {
    pub(super) fn new(table: &TagTable) -> Self {
        let mut built_in = BTreeMap::new();
        let mut by_tag = vec![Vec::new(); table.tags.len()];
        let mut outdated = Marks::new(table.alarms.len());
        for (place, alarm) in table.alarms.iter().enumerate() {
            match &alarm.condition {
                AlarmCondition::BuiltIn(condition) => {
                    built_in.insert((alarm.owner, *condition), AlarmIndex(place));
                }
                AlarmCondition::Tags(expression) => {
                    outdated.mark(place);
                    expression.for_each_tag(&mut |tag| {
                        if let Some(alarms) = by_tag.get_mut(tag.0) {
                            alarms.push(AlarmIndex(place));
                        }
                    });
                }
            }
        }
        Self {
            list: AlarmList::new(table.alarms.iter().map(|alarm| spec(table, alarm)).collect()),
            built_in,
            holds: vec![false; table.alarms.len()],
            by_tag,
            outdated,
            unpublished: false,
        }
    }

    /// A condition that the gateway watches begins or ends. Nothing where the table has no such alarm.
    pub(super) fn set(&mut self, now: Now, owner: AlarmOwner, condition: BuiltIn, holds: bool) {
        let Some(alarm) = self.built_in.get(&(owner, condition)).copied() else { return };
        if let Some(held) = self.holds.get_mut(alarm.0)
            && *held != holds
        {
            *held = holds;
            self.list.set_condition(now, alarm, holds, None);
        }
    }

    /// Something that is over in the moment in which it happens; the off-delay of its alarm starts at once.
    pub(super) fn pulse(&mut self, now: Now, owner: AlarmOwner, condition: BuiltIn) {
        self.set(now, owner, condition, true);
        self.set(now, owner, condition, false);
    }

    /// Whether a condition that the gateway watches holds.
    pub(super) fn is_set(&self, owner: AlarmOwner, condition: BuiltIn) -> bool {
        let alarm = self.built_in.get(&(owner, condition));
        alarm.and_then(|alarm| self.holds.get(alarm.0)).is_some_and(|holds| *holds)
    }

    /// Value or quality of a tag changed.
    pub(super) fn tag_changed(&mut self, tag: TagIndex) {
        for alarm in self.by_tag.get(tag.0).into_iter().flatten() {
            self.outdated.mark(alarm.0);
        }
    }

    /// Looks at the conditions of which an input changed.
    pub(super) fn evaluate(&mut self, now: Now, table: &TagTable, tags: &[Sample]) {
        let sample = |tag: TagIndex| tags.get(tag.0).unwrap_or(&Sample::NEVER);
        for place in self.outdated.drain() {
            let Some(alarm) = table.alarms.get(place) else { continue };
            let AlarmCondition::Tags(expression) = &alarm.condition else { continue };
            let look = |tag| (sample(tag).value, sample(tag).quality);
            let (Some(holds), Some(held)) = (decide(expression, &look), self.holds.get_mut(place)) else {
                continue;
            };
            if *held != holds {
                *held = holds;
                let value = alarm.value.map(sample).filter(|sample| sample.quality.is_usable());
                self.list.set_condition(now, AlarmIndex(place), holds, value.map(|sample| sample.value));
            }
        }
    }

    /// The list itself, for what operators do.
    pub(super) fn list_mut(&mut self) -> &mut AlarmList {
        &mut self.list
    }

    /// Takes the next transition.
    pub(super) fn poll_transition(&mut self) -> Option<Transition> {
        let transition = self.list.poll_output()?;
        self.unpublished = true;
        Some(transition)
    }

    pub(super) fn handle_timeout(&mut self, now: Now) {
        if self.poll_timeout().is_some_and(|due| due <= now.instant) {
            self.list.handle_timeout(now);
        }
    }

    pub(super) fn poll_timeout(&self) -> Option<Instant> {
        self.list.poll_timeout()
    }

    /// Copies what changed since the last call; `true` where something did. A transition can change other alarms too
    /// (first-out of a group), so all of them are looked at; transitions are rare.
    pub(super) fn publish(&mut self, alarms: &mut [AlarmStatus], revision: Revision) -> bool {
        if !std::mem::take(&mut self.unpublished) {
            return false;
        }
        let mut moved = false;
        for (place, shown) in alarms.iter_mut().enumerate() {
            let Some(status) = self.list.status(AlarmIndex(place)) else { continue };
            let status = AlarmStatus { revision: shown.revision, ..*status };
            if status != *shown {
                *shown = AlarmStatus { revision, ..status };
                moved = true;
            }
        }
        moved
    }
}

fn spec(table: &TagTable, alarm: &AlarmDef) -> AlarmSpec {
    let group = match alarm.owner {
        AlarmOwner::Gateway => 0,
        AlarmOwner::Bus(bus) => 1 + bus.0,
        AlarmOwner::Node(node) => 1 + table.buses.len() + node.0,
    };
    AlarmSpec {
        priority: alarm.priority,
        on_delay: alarm.on_delay,
        off_delay: alarm.off_delay,
        latch: alarm.latch,
        suppressed_by: alarm.suppressed_by.iter().map(|alarm| AlarmIndex(*alarm)).collect(),
        first_out_group: if alarm.first_out { u32::try_from(group).ok() } else { None },
    }
}

/// Whether a condition holds; `None` where that depends on a value that cannot be used.
fn decide(expression: &Expression, tag: &impl Fn(TagIndex) -> (Value, Quality)) -> Option<bool> {
    let join = |parts: &[Expression], decisive: bool| {
        let mut outcome = Some(!decisive);
        for part in parts {
            match decide(part, tag) {
                Some(holds) if holds == decisive => return Some(decisive),
                Some(_) => {}
                None => outcome = None,
            }
        }
        outcome
    };
    match expression {
        Expression::And(parts) => join(parts, false),
        Expression::Or(parts) => join(parts, true),
        Expression::Not(part) => decide(part, tag).map(|holds| !holds),
        Expression::Tag(_) | Expression::Compare { .. } => {
            let (holds, quality) = expression.evaluate(tag);
            quality.is_usable().then_some(holds)
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::process_image::Reason;

    #[test]
    fn a_condition_is_decided_from_values_that_can_be_used() {
        let tags = [
            (Value::Bool(true), Quality::Good),
            (Value::Bool(false), Quality::Uncertain(Reason::NodeLost)),
            (Value::Bool(true), Quality::Stale(Reason::PdoTimeout)),
        ];
        let look = |tag: TagIndex| tags[tag.0];
        let [yes, no, unknown] = [0, 1, 2].map(|tag| Expression::Tag(TagIndex(tag)));
        let and = |left: &Expression, right: &Expression| {
            decide(&Expression::And(vec![left.clone(), right.clone()]), &look)
        };
        let or = |left: &Expression, right: &Expression| {
            decide(&Expression::Or(vec![left.clone(), right.clone()]), &look)
        };
        assert_eq!(decide(&unknown, &look), None);
        assert_eq!(decide(&Expression::Not(Box::new(unknown.clone())), &look), None);
        assert_eq!((and(&yes, &unknown), and(&unknown, &no)), (None, Some(false)));
        assert_eq!((or(&yes, &unknown), or(&unknown, &no)), (Some(true), None));
        assert_eq!((and(&yes, &no), or(&no, &yes)), (Some(false), Some(true)));
    }
}
