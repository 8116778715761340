//! How fast something may be fed that empties at its own speed and tells nothing (R-ESD-037).

use std::time::Duration;

use crate::time::Instant;

/// A model of a buffer, in time: when it will be empty if nothing more is put in.
#[derive(Clone, Copy, Debug)]
pub(super) struct Bucket {
    empty_at: Instant,
}

impl Bucket {
    /// Empty.
    pub(super) fn new() -> Self {
        Self { empty_at: Instant::START }
    }

    /// When there is room for what takes `cost` to drain in a buffer that takes `depth` to drain. May lie in the past.
    pub(super) fn opens(self, cost: Duration, depth: Duration) -> Instant {
        let spare = u64::try_from(depth.saturating_sub(cost).as_micros()).unwrap_or(u64::MAX);
        Instant::from_micros(self.empty_at.as_micros().saturating_sub(spare))
    }

    /// Something is put in that takes `cost` to drain.
    pub(super) fn fill(&mut self, now: Instant, cost: Duration) {
        self.empty_at = self.empty_at.max(now) + cost;
    }

    /// It holds so much at least, for all that is known.
    pub(super) fn holds(&mut self, now: Instant, content: Duration) {
        self.empty_at = self.empty_at.max(now + content);
    }

    /// It was emptied.
    pub(super) fn clear(&mut self) {
        self.empty_at = Instant::START;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MILLI: Duration = Duration::from_millis(1);

    #[test]
    fn a_late_feeder_makes_up_for_what_drained_and_never_fills_it_above_its_depth() {
        let mut bucket = Bucket::new();
        let mut fed = Vec::new();
        // Looked at every 3 ms only, for what drains one piece a millisecond, five of which fit.
        for now in (0..30).step_by(3).map(Instant::from_millis) {
            let mut pieces = 0;
            while bucket.opens(MILLI, 5 * MILLI) <= now {
                bucket.fill(now, MILLI);
                pieces += 1;
            }
            fed.push(pieces);
        }
        assert_eq!(fed, [5, 3, 3, 3, 3, 3, 3, 3, 3, 3]);
    }
}
