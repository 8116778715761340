//! Which alarm tells the cause of which, in an order in which causes come first.

use std::collections::BTreeSet;

use super::AlarmSpec;
use crate::process_image::AlarmIndex;

/// The chains of cause and consequence.
#[derive(Debug)]
pub(super) struct Suppression {
    /// By alarm: its consequences.
    consequences: Vec<Vec<usize>>,
    /// By alarm: its place when causes come first.
    ranks: Vec<usize>,
}

impl Suppression {
    /// Chains are to be free of circles and of unknown alarms; what is not is left out, so that no two alarms silence
    /// each other.
    pub(super) fn new(specs: &[AlarmSpec]) -> Self {
        let ranks = ranks(specs);
        let rank = |alarm: usize| ranks.get(alarm).copied();
        let mut consequences = vec![Vec::new(); specs.len()];
        for (alarm, spec) in specs.iter().enumerate() {
            let causes: BTreeSet<AlarmIndex> = spec.suppressed_by.iter().copied().collect();
            for cause in causes.into_iter().filter(|cause| rank(cause.0) < rank(alarm)) {
                if let Some(list) = consequences.get_mut(cause.0) {
                    list.push(alarm);
                }
            }
        }
        Self { consequences, ranks }
    }

    /// What an alarm is the cause of.
    pub(super) fn consequences(&self, alarm: usize) -> &[usize] {
        self.consequences.get(alarm).map(Vec::as_slice).unwrap_or_default()
    }

    /// The place of an alarm when causes come first.
    pub(super) fn rank(&self, alarm: usize) -> usize {
        self.ranks.get(alarm).copied().unwrap_or(alarm)
    }
}

/// Takes away, again and again, the alarms whose causes are all taken. What is left stands in circles, or behind them.
fn ranks(specs: &[AlarmSpec]) -> Vec<usize> {
    let known = |cause: &AlarmIndex| cause.0 < specs.len();
    let mut waiting: BTreeSet<usize> = (0..specs.len()).collect();
    let mut ranks = vec![0; specs.len()];
    let mut next = 0;
    while !waiting.is_empty() {
        let free = |alarm: &usize| {
            let causes = specs.get(*alarm).map(|spec| spec.suppressed_by.as_slice()).unwrap_or_default();
            causes.iter().filter(|cause| known(cause)).all(|cause| !waiting.contains(&cause.0))
        };
        let mut taken: Vec<usize> = waiting.iter().copied().filter(free).collect();
        if taken.is_empty() {
            taken.extend(waiting.first());
        }
        for alarm in taken {
            waiting.remove(&alarm);
            if let Some(rank) = ranks.get_mut(alarm) {
                *rank = next;
            }
            next += 1;
        }
    }
    ranks
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::alarms::fixture::spec;

    fn suppression(causes: &[&[usize]]) -> Suppression {
        let specs: Vec<_> = causes.iter().map(|causes| spec().suppressed_by(causes).build()).collect();
        Suppression::new(&specs)
    }

    #[test]
    fn causes_come_first_in_whatever_order_they_are_listed() {
        let suppression = suppression(&[&[2], &[0, 2], &[]]);
        let mut order = [0, 1, 2];
        order.sort_by_key(|alarm| suppression.rank(*alarm));
        assert_eq!(order, [2, 0, 1]);
        assert_eq!(suppression.consequences(2), [0, 1]);
    }

    #[test]
    fn alarms_in_a_circle_do_not_silence_each_other() {
        let suppression = suppression(&[&[1], &[0], &[2], &[7, 3]]);
        assert_eq!(suppression.consequences(0), [1]);
        assert!(suppression.consequences(1).is_empty());
        assert!(suppression.consequences(2).is_empty(), "itself");
        assert!(suppression.consequences(7).is_empty(), "unknown");
    }

    #[test]
    fn a_cause_listed_twice_counts_once() {
        assert_eq!(suppression(&[&[], &[0, 0]]).consequences(0), [1]);
    }
}
