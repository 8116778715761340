//! Alarms: their conditions on tags, the conditions that the gateway itself watches, and their list.
//!
//! A condition of a mapping is decided from values that can be used only. Where one of them cannot, the rest may
//! still decide (`a or b` holds when `a` does, and two faults that are known are at least two); if not, the condition
//! stays as it was: an alarm is neither raised nor cleared by data that nobody should act on.

use std::collections::BTreeMap;

use crate::alarms::{AlarmList, AlarmSpec, Transition};
use crate::mapping::expression::{Comparison, Operand};
use crate::mapping::{AlarmCondition, AlarmDef, AlarmOwner, BuiltIn, Derived, Expression, Source, TagTable};
use crate::process_image::{AlarmIndex, AlarmStatus, Revision, Sample, TagIndex, Value};
use crate::time::{Instant, Now};

use super::kept::Kept;
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
                    let mut look_at = |tag: TagIndex| {
                        if let Some(alarms) = by_tag.get_mut(tag.0) {
                            alarms.push(AlarmIndex(place));
                        }
                    };
                    expression.for_each_tag(&mut |tag| {
                        look_at(tag);
                        counted(table, tag).iter().copied().for_each(&mut look_at);
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

    /// Takes over the alarms that stay.
    pub(super) fn take_over(&mut self, old: Self, kept: &Kept, now: Now) {
        for (holds, from) in self.holds.iter_mut().zip(&kept.alarms) {
            if let Some(held) = from.and_then(|from| old.holds.get(from.0)) {
                *holds = *held;
            }
        }
        self.list.take_over(old.list, &kept.alarms, now);
        self.unpublished = true;
    }

    /// A condition that the gateway watches begins or ends. Nothing where the table has no such alarm.
    pub(super) fn set(&mut self, now: Now, owner: AlarmOwner, condition: BuiltIn, holds: bool) {
        self.decided(now, owner, condition, holds, None);
    }

    /// The same for a condition that holds while there is a value, which is shown with its alarm; so is another value that
    /// takes its place.
    pub(super) fn set_with(&mut self, now: Now, owner: AlarmOwner, condition: BuiltIn, value: Option<Value>) {
        self.decided(now, owner, condition, value.is_some(), value);
    }

    fn decided(
        &mut self,
        now: Now,
        owner: AlarmOwner,
        condition: BuiltIn,
        holds: bool,
        value: Option<Value>,
    ) {
        let Some(alarm) = self.built_in.get(&(owner, condition)).copied() else { return };
        if let Some(held) = self.holds.get_mut(alarm.0)
            && *held != holds
        {
            *held = holds;
            self.list.set_condition(now, alarm, holds, value);
        }
        if let Some(value) = value {
            self.unpublished |= self.list.set_value(alarm, value);
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
        let inputs = Inputs { table, tags };
        for place in self.outdated.drain() {
            let Some(alarm) = table.alarms.get(place) else { continue };
            let AlarmCondition::Tags(expression) = &alarm.condition else { continue };
            let (Some(holds), Some(held)) = (decide(expression, &inputs), self.holds.get_mut(place)) else {
                continue;
            };
            if *held != holds {
                *held = holds;
                let value =
                    alarm.value.map(|tag| inputs.sample(tag)).filter(|sample| sample.quality.is_usable());
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
        let counted = self.list.take_counted();
        if !std::mem::take(&mut self.unpublished) && !counted {
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

/// The tags that a count looks at; none of another tag.
fn counted(table: &TagTable, tag: TagIndex) -> &[TagIndex] {
    match table.tag(tag).map(|tag| &tag.source) {
        Some(Source::Derived(Derived::Count { of })) => of,
        Some(
            Source::Derived(_)
            | Source::Pdo { .. }
            | Source::Polled { .. }
            | Source::Adopted { .. }
            | Source::Rpdo { .. }
            | Source::Emergency { .. }
            | Source::Module { .. },
        )
        | None => &[],
    }
}

/// What conditions look at.
#[derive(Clone, Copy)]
struct Inputs<'a> {
    table: &'a TagTable,
    tags: &'a [Sample],
}

impl Inputs<'_> {
    fn sample(&self, tag: TagIndex) -> &Sample {
        self.tags.get(tag.0).unwrap_or(&Sample::NEVER)
    }

    /// The lowest and the highest that a value can be. For a count of which some inputs cannot be used that is known all
    /// the same: each of them is in or is not. `None` for other values that cannot be used.
    fn bounds(&self, operand: Operand) -> Option<[f64; 2]> {
        let tag = match operand {
            Operand::Number(number) => return Some([number, number]),
            Operand::Tag(tag) => tag,
        };
        let sample = self.sample(tag);
        if sample.quality.is_usable() {
            let value = sample.value.as_f64();
            return Some([value, value]);
        }
        let of = counted(self.table, tag);
        if of.is_empty() {
            return None;
        }
        let bounds = of.iter().map(|tag| self.sample(*tag)).fold([0_u32, 0], |[low, high], input| {
            let usable = input.quality.is_usable();
            let set = input.value.is_true();
            [low + u32::from(usable && set), high + u32::from(!usable || set)]
        });
        Some(bounds.map(f64::from))
    }
}

/// Whether a condition holds; `None` where that depends on a value that cannot be used.
fn decide(expression: &Expression, inputs: &Inputs<'_>) -> Option<bool> {
    let join = |parts: &[Expression], decisive: bool| {
        let mut outcome = Some(!decisive);
        for part in parts {
            match decide(part, inputs) {
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
        Expression::Not(part) => decide(part, inputs).map(|holds| !holds),
        Expression::Tag(tag) => {
            let sample = inputs.sample(*tag);
            sample.quality.is_usable().then_some(sample.value.is_true())
        }
        Expression::Compare { left, comparison, right } => {
            compare(inputs.bounds(*left)?, *comparison, inputs.bounds(*right)?)
        }
    }
}

/// Compares two values of which only bounds may be known; `None` where these do not decide.
fn compare(left: [f64; 2], comparison: Comparison, right: [f64; 2]) -> Option<bool> {
    let [[left_low, left_high], [right_low, right_high]] = [left, right];
    // The ends at which the comparison holds most and least readily.
    let (most, least) = match comparison {
        Comparison::Less | Comparison::LessOrEqual => ((left_low, right_high), (left_high, right_low)),
        Comparison::Greater | Comparison::GreaterOrEqual => ((left_high, right_low), (left_low, right_high)),
        Comparison::Equal | Comparison::NotEqual => {
            let apart = left_high < right_low || right_high < left_low;
            let known = left_low.total_cmp(&left_high).is_eq() && right_low.total_cmp(&right_high).is_eq();
            if apart {
                return Some(comparison == Comparison::NotEqual);
            }
            return known.then(|| comparison.holds(left_low, right_low));
        }
    };
    let holds = comparison.holds(least.0, least.1);
    (holds == comparison.holds(most.0, most.1)).then_some(holds)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::process_image::{Quality, Reason, Value};

    #[test]
    fn a_condition_is_decided_from_values_that_can_be_used() {
        let table = TagTable::default();
        let bit = |value, quality| Sample { value: Value::Bool(value), quality, ..Sample::NEVER };
        let tags = [
            bit(true, Quality::Good),
            bit(false, Quality::Uncertain(Reason::NodeLost)),
            bit(true, Quality::Stale(Reason::PdoTimeout)),
        ];
        let look = Inputs { table: &table, tags: &tags };
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
    #[test]
    fn what_is_known_of_a_count_decides_where_it_can() {
        use Comparison::{Equal, Greater, GreaterOrEqual, Less, LessOrEqual, NotEqual};
        for (comparison, number, expected) in [
            (GreaterOrEqual, 2.0, Some(true)),
            (GreaterOrEqual, 3.0, None),
            (GreaterOrEqual, 5.0, Some(false)),
            (Greater, 1.0, Some(true)),
            (Greater, 4.0, Some(false)),
            (Less, 5.0, Some(true)),
            (Less, 3.0, None),
            (Less, 2.0, Some(false)),
            (LessOrEqual, 4.0, Some(true)),
            (LessOrEqual, 1.0, Some(false)),
            (Equal, 3.0, None),
            (Equal, 5.0, Some(false)),
            (NotEqual, 1.0, Some(true)),
            (NotEqual, 2.0, None),
        ] {
            let between = [2.0, 4.0];
            assert_eq!(compare(between, comparison, [number, number]), expected, "{comparison:?} {number}");
        }
        assert_eq!(compare([1.0, 1.0], Less, [2.0, 4.0]), Some(true));
        assert_eq!(compare([3.0, 3.0], Less, [2.0, 4.0]), None);
        assert_eq!(compare([3.0, 3.0], Equal, [3.0, 3.0]), Some(true));
    }
}
