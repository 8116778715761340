//! Turns the kernel's receive times, which are wall-clock times, into moments on both clocks. Pure.
//!
//! The wall clock may be set while a frame waits in the socket. What is known for sure is monotonic: a frame is
//! not younger than the present moment, and not older than the last time the socket was seen empty.

use std::time::Duration;

use crate::time::{Instant, Now, Timestamp};

/// How far kernel time and ours may differ without the wall clock having been set: they are not read at once.
const SLACK: Duration = Duration::from_millis(10);

/// The receive times of one socket.
#[derive(Clone, Copy, Debug)]
pub struct Stamper {
    /// When the socket was last seen empty.
    empty_at: Instant,
    /// The last time given out: times do not go backwards.
    last: Instant,
}

impl Stamper {
    /// For a socket that is being opened now, and so is empty.
    #[must_use]
    pub fn new(now: Now) -> Self {
        Self { empty_at: now.instant, last: now.instant }
    }

    /// The socket is empty now.
    pub fn handle_empty(&mut self, now: Now) {
        self.empty_at = now.instant;
    }

    /// When a frame was received that is read now and of which the kernel says `received`.
    pub fn stamp(&mut self, now: Now, received: Option<Timestamp>) -> Now {
        let at = received.and_then(|received| self.believed(now, received)).unwrap_or(now);
        self.last = self.last.max(at.instant);
        Now { instant: self.last, utc: at.utc }
    }

    /// `None` when the wall clock was set while the frame waited.
    fn believed(&self, now: Now, received: Timestamp) -> Option<Now> {
        let oldest = now.instant.since(self.empty_at);
        let age = now.utc.as_micros().checked_sub(received.as_micros())?;
        let Ok(age) = u64::try_from(age) else {
            // From the future, a little: our reading of the clock came first.
            return (Duration::from_micros(age.unsigned_abs()) <= SLACK)
                .then_some(Now { instant: now.instant, utc: received });
        };
        let age = Duration::from_micros(age);
        if age > oldest + SLACK {
            return None;
        }
        let back = u64::try_from(age.min(oldest).as_micros()).ok()?;
        let instant = Instant::from_micros(now.instant.as_micros().saturating_sub(back));
        Some(Now { instant, utc: received })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn now(instant_ms: u64, utc_ms: i64) -> Now {
        Now { instant: Instant::from_millis(instant_ms), utc: Timestamp::from_millis(utc_ms) }
    }

    #[test]
    fn a_frame_that_waited_is_stamped_with_its_receive_time_on_both_clocks() {
        let mut stamper = Stamper::new(now(1_000, 50_000));
        let at = stamper.stamp(now(1_400, 50_400), Some(Timestamp::from_millis(50_100)));
        assert_eq!(at, now(1_100, 50_100));
    }

    #[test]
    fn a_wall_clock_set_forward_makes_no_frame_older_than_the_socket_was_empty() {
        let mut stamper = Stamper::new(now(1_000, 50_000));
        stamper.handle_empty(now(1_300, 50_300));
        let at = stamper.stamp(now(1_400, 3_600_000), Some(Timestamp::from_millis(50_350)));
        assert_eq!(at, now(1_400, 3_600_000));
    }

    #[test]
    fn a_wall_clock_set_back_makes_no_frame_younger_than_now() {
        let mut stamper = Stamper::new(now(1_000, 50_000));
        let at = stamper.stamp(now(1_400, 10), Some(Timestamp::from_millis(50_350)));
        assert_eq!(at, now(1_400, 10));
    }

    #[test]
    fn a_frame_that_came_between_our_clock_and_our_read_is_as_young_as_now() {
        let mut stamper = Stamper::new(now(1_000, 50_000));
        let at = stamper.stamp(now(1_400, 50_400), Some(Timestamp::from_millis(50_401)));
        assert_eq!(at, now(1_400, 50_401));
    }

    #[test]
    fn a_long_stall_is_not_taken_for_a_set_clock() {
        let mut stamper = Stamper::new(now(1_000, 50_000));
        let at = stamper.stamp(now(61_000, 110_000), Some(Timestamp::from_millis(50_020)));
        assert_eq!(at, now(1_020, 50_020));
    }

    #[test]
    fn times_never_go_backwards() {
        let mut stamper = Stamper::new(now(1_000, 50_000));
        let first = stamper.stamp(now(1_400, 50_400), Some(Timestamp::from_millis(50_300)));
        let second = stamper.stamp(now(1_400, 50_400), Some(Timestamp::from_millis(50_200)));
        assert!(second.instant >= first.instant);
    }

    #[test]
    fn without_a_kernel_time_now_is_the_best_guess() {
        let mut stamper = Stamper::new(now(0, 0));
        assert_eq!(stamper.stamp(now(5, 7), None), now(5, 7));
        assert_eq!(stamper.stamp(now(6, 8), Some(Timestamp::from_micros(i64::MIN))), now(6, 8));
    }
}
