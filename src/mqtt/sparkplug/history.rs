//! Values that are kept while nobody takes them: in memory, bounded, the oldest leave. Pure.

use std::collections::VecDeque;

use super::catalogue::Datum;
use crate::time::Timestamp;

/// A value that was not sent when it was new.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Kept {
    /// Place of its metric.
    pub metric: usize,
    /// Its own time.
    pub at: Timestamp,
    /// It; `None` where there was none.
    pub datum: Option<Datum>,
    /// Its quality code.
    pub quality: u32,
}

/// Values of one origin that are being sent.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Batch {
    /// Whose.
    pub origin: usize,
    /// They were kept before.
    pub historical: bool,
    /// In order, each with its number among all values that were ever kept.
    pub values: Vec<(u64, Kept)>,
}

/// The values.
#[derive(Clone, Debug)]
pub struct History {
    limit: usize,
    /// By origin, oldest first.
    origins: Vec<VecDeque<(u64, Kept)>>,
    held: usize,
    next: u64,
    dropped: u64,
}

impl History {
    /// Nothing, of so many origins; at most `limit` values of all of them together.
    #[must_use]
    pub fn new(limit: usize, origins: usize) -> Self {
        Self { limit, origins: vec![VecDeque::new(); origins], held: 0, next: 0, dropped: 0 }
    }

    /// Takes over what another one keeps: `place` tells where each of it belongs here. What belongs nowhere is dropped.
    pub fn go_on_from(&mut self, old: Self, place: impl Fn(usize, Kept) -> Option<(usize, Kept)>) {
        (self.next, self.dropped) = (old.next, old.dropped);
        for (origin, values) in old.origins.into_iter().enumerate() {
            for (number, kept) in values {
                let placed = place(origin, kept);
                let values = placed.and_then(|(origin, kept)| Some((self.origins.get_mut(origin)?, kept)));
                match values {
                    Some((values, kept)) => {
                        values.push_back((number, kept));
                        self.held += 1;
                    }
                    None => self.dropped = self.dropped.saturating_add(1),
                }
            }
        }
        self.trim();
    }

    /// Keeps a value.
    pub fn push(&mut self, origin: usize, kept: Kept) {
        if let Some(values) = self.origins.get_mut(origin) {
            self.next = self.next.saturating_add(1);
            values.push_back((self.next, kept));
            self.held += 1;
        }
        self.trim();
    }

    /// Takes the oldest values of the first origin that has some and is wanted, at most so many.
    pub fn take(&mut self, most: usize, is_wanted: impl Fn(usize) -> bool) -> Option<Batch> {
        let mut origins = self.origins.iter_mut().enumerate();
        let (origin, values) = origins.find(|(origin, values)| !values.is_empty() && is_wanted(*origin))?;
        let values: Vec<_> = values.drain(..most.min(values.len())).collect();
        self.held -= values.len();
        Some(Batch { origin, historical: true, values })
    }

    /// Values that are sent as they come, so that they can be kept should they not leave.
    pub fn live(&mut self, origin: usize, values: impl Iterator<Item = Kept>) -> Batch {
        let next = &mut self.next;
        let number = |kept| {
            *next = next.saturating_add(1);
            (*next, kept)
        };
        Batch { origin, historical: false, values: values.map(number).collect() }
    }

    /// Puts back what was taken and not sent; it stands in front again.
    pub fn put_back(&mut self, batch: Batch) {
        if let Some(values) = self.origins.get_mut(batch.origin) {
            self.held += batch.values.len();
            for value in batch.values.into_iter().rev() {
                values.push_front(value);
            }
            // Batches come back in any order.
            values.make_contiguous().sort_by_key(|(number, _)| *number);
        }
        self.trim();
    }

    /// Whether a wanted origin has values.
    pub fn has(&self, is_wanted: impl Fn(usize) -> bool) -> bool {
        self.origins.iter().enumerate().any(|(origin, values)| !values.is_empty() && is_wanted(origin))
    }

    /// How many values there are.
    #[must_use]
    pub fn held(&self) -> usize {
        self.held
    }

    /// How many left because there was no room.
    #[must_use]
    pub fn dropped(&self) -> u64 {
        self.dropped
    }

    fn trim(&mut self) {
        while self.held > self.limit {
            let fronts = self.origins.iter_mut().filter(|values| !values.is_empty());
            let Some(oldest) = fronts.min_by_key(|values| values.front().map(|(number, _)| *number)) else {
                return;
            };
            oldest.pop_front();
            self.held -= 1;
            self.dropped = self.dropped.saturating_add(1);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn kept(metric: usize) -> Kept {
        Kept { metric, at: Timestamp::default(), datum: None, quality: 0 }
    }

    fn metrics(batch: &Batch) -> Vec<usize> {
        batch.values.iter().map(|(_, kept)| kept.metric).collect()
    }

    #[test]
    fn the_oldest_of_all_origins_leaves_and_is_counted() {
        let mut history = History::new(3, 2);
        for (origin, metric) in [(0, 1), (1, 2), (1, 3), (0, 4), (1, 5)] {
            history.push(origin, kept(metric));
        }
        assert_eq!((history.held(), history.dropped()), (3, 2));
        assert_eq!(metrics(&history.take(9, |_| true).unwrap()), [4]);
        assert_eq!(metrics(&history.take(9, |_| true).unwrap()), [3, 5]);
        assert!(history.take(9, |_| true).is_none());
    }

    #[test]
    fn what_was_not_sent_comes_back_in_its_order_and_what_has_no_room_is_counted() {
        let mut history = History::new(4, 1);
        (0..4).for_each(|metric| history.push(0, kept(metric)));
        let first = history.take(1, |_| true).unwrap();
        let second = history.take(1, |_| true).unwrap();
        history.push(0, kept(4));
        history.put_back(second);
        history.put_back(first);
        assert_eq!(history.dropped(), 1, "there was room for one that came meanwhile");
        assert_eq!(metrics(&history.take(9, |_| true).unwrap()), [1, 2, 3, 4]);
    }

    #[test]
    fn only_what_is_wanted_is_taken_and_no_room_keeps_nothing() {
        let mut history = History::new(9, 2);
        history.push(0, kept(1));
        assert!(history.take(9, |origin| origin == 1).is_none() && !history.has(|origin| origin == 1));
        let mut none = History::new(0, 1);
        none.push(0, kept(1));
        assert_eq!((none.held(), none.dropped()), (0, 1));
    }
}
