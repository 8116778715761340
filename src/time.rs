//! Time, brought in from outside.
//!
//! This is the only file that reads a clock. Everything else is handed a [`Now`]: the pure core because it
//! must give the same answer for the same input (replay, tests), the IO tasks because then a frame, the
//! timeout that it cancels and the value that it stamps all agree.
//!
//! Timers use [`Instant`] only, so that a step of the wall clock never fires a timeout.

use std::time::{Duration, SystemTime, UNIX_EPOCH};

/// A moment on the monotonic clock: microseconds since the process (or the recording) started.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Instant(u64);

impl Instant {
    /// The start of the process or of the recording.
    pub const START: Self = Self(0);

    /// From microseconds since the start.
    #[must_use]
    pub const fn from_micros(micros: u64) -> Self {
        Self(micros)
    }

    /// From milliseconds since the start.
    #[must_use]
    pub const fn from_millis(millis: u64) -> Self {
        Self(millis.saturating_mul(1_000))
    }

    /// Microseconds since the start.
    #[must_use]
    pub const fn as_micros(self) -> u64 {
        self.0
    }

    /// Milliseconds since the start, rounded down.
    #[must_use]
    pub const fn as_millis(self) -> u64 {
        self.0 / 1_000
    }

    /// How long ago `earlier` was; zero when it lies in the future.
    #[must_use]
    pub const fn since(self, earlier: Self) -> Duration {
        Duration::from_micros(self.0.saturating_sub(earlier.0))
    }
}

impl std::ops::Add<Duration> for Instant {
    type Output = Self;

    /// Saturates at the end of time (584,000 years) instead of overflowing.
    fn add(self, duration: Duration) -> Self {
        Self(self.0.saturating_add(u64::try_from(duration.as_micros()).unwrap_or(u64::MAX)))
    }
}

/// A moment of the wall clock, UTC: microseconds since 1970-01-01, for stamping values. Never for timers.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Timestamp(i64);

impl Timestamp {
    /// From microseconds since the epoch.
    #[must_use]
    pub const fn from_micros(micros: i64) -> Self {
        Self(micros)
    }

    /// From milliseconds since the epoch.
    #[must_use]
    pub const fn from_millis(millis: i64) -> Self {
        Self(millis.saturating_mul(1_000))
    }

    /// Microseconds since the epoch.
    #[must_use]
    pub const fn as_micros(self) -> i64 {
        self.0
    }

    /// Milliseconds since the epoch, rounded down: the `ts` of every MQTT payload.
    #[must_use]
    pub const fn as_millis(self) -> i64 {
        self.0.div_euclid(1_000)
    }

    /// Whole seconds since the epoch, rounded down.
    #[must_use]
    pub const fn as_secs(self) -> i64 {
        self.0.div_euclid(1_000_000)
    }

    /// The milliseconds within the second, 0..=999.
    #[must_use]
    pub const fn subsec_millis(self) -> i64 {
        self.0.div_euclid(1_000).rem_euclid(1_000)
    }
}

/// One moment on both clocks.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Now {
    /// For timers and ages.
    pub instant: Instant,
    /// For stamping values.
    pub utc: Timestamp,
}

impl Now {
    /// A made-up moment for tests and replay: `millis` after the start, with UTC at the same offset from the epoch.
    #[must_use]
    pub fn from_millis(millis: u64) -> Self {
        Self {
            instant: Instant::from_millis(millis),
            utc: Timestamp::from_millis(i64::try_from(millis).unwrap_or(i64::MAX)),
        }
    }

    /// The same moment moved on by `duration` on both clocks.
    #[must_use]
    pub fn later(self, duration: Duration) -> Self {
        let micros = i64::try_from(duration.as_micros()).unwrap_or(i64::MAX);
        Self {
            instant: self.instant + duration,
            utc: Timestamp::from_micros(self.utc.as_micros().saturating_add(micros)),
        }
    }
}

/// The clock of an IO task. Copies tell the same time.
///
/// [`Now::instant`] is tokio's clock, so that a test with `start_paused` governs it; [`Now::utc`] is always that of the host.
#[derive(Clone, Copy, Debug)]
pub struct Clock {
    origin: tokio::time::Instant,
}

#[expect(clippy::disallowed_methods, reason = "the one place that reads the clocks")]
impl Clock {
    /// A clock whose [`Instant::START`] is this call.
    #[must_use]
    pub fn start() -> Self {
        Self { origin: tokio::time::Instant::now() }
    }

    /// The present moment. The two clocks are read at the same time, but for a millisecond: a thread that was kept waiting
    /// between them reads them again, a few times at most.
    #[must_use]
    pub fn now(&self) -> Now {
        const TRIES: usize = 4;
        const APART: Duration = Duration::from_millis(1);
        let mut begin = tokio::time::Instant::now();
        let mut utc = SystemTime::now();
        for _ in 1..TRIES {
            let end = tokio::time::Instant::now();
            if end.saturating_duration_since(begin) <= APART {
                break;
            }
            (begin, utc) = (end, SystemTime::now());
        }
        let elapsed = begin.saturating_duration_since(self.origin);
        let utc = match utc.duration_since(UNIX_EPOCH) {
            Ok(after) => i64::try_from(after.as_micros()).unwrap_or(i64::MAX),
            Err(before) => i64::try_from(before.duration().as_micros()).map_or(i64::MIN, |micros| -micros),
        };
        Now { instant: Instant(u64::try_from(elapsed.as_micros()).unwrap_or(u64::MAX)), utc: Timestamp(utc) }
    }

    /// The tokio instant to sleep until, for a deadline of the core.
    #[must_use]
    pub fn deadline(&self, instant: Instant) -> tokio::time::Instant {
        self.origin + Duration::from_micros(instant.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_instant_in_the_future_is_no_time_ago() {
        assert_eq!(Instant::from_millis(1).since(Instant::from_millis(5)), Duration::ZERO);
        assert_eq!(Instant::from_millis(5).since(Instant::from_millis(1)), Duration::from_millis(4));
    }

    #[test]
    fn a_time_stamp_before_the_epoch_keeps_its_milliseconds_positive() {
        let before = Timestamp::from_millis(-1);
        assert_eq!((before.as_secs(), before.subsec_millis()), (-1, 999));
    }

    #[tokio::test(start_paused = true)]
    async fn the_clock_follows_paused_time() {
        let clock = Clock::start();
        tokio::time::sleep(Duration::from_millis(250)).await;
        assert_eq!(clock.now().instant, Instant::from_millis(250));
        assert_eq!(
            clock.deadline(Instant::from_millis(250)),
            clock.deadline(Instant::START) + Duration::from_millis(250)
        );
    }
}
