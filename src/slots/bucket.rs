//! How often a client may ask, pure: a bucket that fills steadily.

use std::time::Duration;

use crate::time::Instant;

/// How fast buckets fill, and how much they hold.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Rate {
    /// Time that one request is worth.
    pub each: Duration,
    /// Requests that may come at once.
    pub burst: u32,
}

/// A bucket; full at first.
#[derive(Clone, Copy, Debug, Default)]
pub struct Bucket {
    full: Instant,
}

impl Bucket {
    /// Takes a request out of it.
    ///
    /// # Errors
    /// It is empty: in how long there is something in it.
    pub fn take(&mut self, now: Instant, rate: Rate) -> Result<(), Duration> {
        let next = self.full.max(now) + rate.each;
        let empty = now + rate.each.saturating_mul(rate.burst);
        if next > empty {
            return Err(next.since(empty));
        }
        self.full = next;
        Ok(())
    }

    /// Nothing is missing from it.
    #[must_use]
    pub fn is_full(&self, now: Instant) -> bool {
        self.full <= now
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_bucket_gives_what_it_holds_at_once_then_as_fast_as_it_fills_and_saves_up_no_more() {
        let rate = Rate { each: Duration::from_millis(10), burst: 400 };
        let mut bucket = Bucket::default();
        let mut taken = |millis| {
            let now = Instant::from_millis(millis);
            (0..1000).filter(|_| bucket.take(now, rate).is_ok()).count()
        };
        assert_eq!([taken(5_000), taken(6_000), taken(60_000)], [400, 100, 400]);
        let now = Instant::from_millis(60_003);
        assert_eq!(bucket.take(now, rate), Err(Duration::from_millis(7)));
        assert!(bucket.take(now + Duration::from_millis(7), rate).is_ok());
        assert!(!bucket.is_full(now) && bucket.is_full(now + Duration::from_secs(5)));
    }
}
