//! When a TPDO is due.

use std::time::Duration;

use crate::time::Instant;

/// Period of every TPDO (R-DET-068, R-DET-070).
pub const BASE_PERIOD: Duration = Duration::from_millis(500);
/// Period of TPDO1, 2 and 4 while any channel knocks (R-DET-069).
pub const KNOCK_PERIOD: Duration = Duration::from_millis(100);
/// Least time between two TPDO3 (R-DET-072).
pub const INHIBIT_TIME: Duration = Duration::from_millis(100);
/// Allowed deviation of an interval (R-DET-078). What is later than that starts a new count instead of catching up.
const TOLERANCE: Duration = Duration::from_millis(10);

/// A TPDO that is sent periodically. Stopped when made.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Periodic {
    next: Option<Instant>,
    /// Since the last start.
    last: Option<Instant>,
}

impl Periodic {
    /// The first is due at `first`.
    pub fn start(&mut self, first: Instant) {
        *self = Self { next: Some(first), last: None };
    }

    /// No more.
    pub fn stop(&mut self) {
        *self = Self::default();
    }

    /// When the next is due; `None` while stopped.
    #[must_use]
    pub fn due(&self) -> Option<Instant> {
        self.next
    }

    /// It was sent.
    pub fn sent(&mut self, now: Instant, period: Duration) {
        self.next = self.next.map(|due| counted_from(due, now) + period);
        self.last = Some(now);
    }

    /// From now on another period counts, from the last frame on.
    pub fn change_period(&mut self, now: Instant, period: Duration) {
        if let (Some(next), Some(last)) = (&mut self.next, self.last) {
            *next = now.max(last + period);
        }
    }
}

/// A TPDO that is sent periodically and at events, with an inhibit time between two. Stopped when made.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct EventDriven {
    next: Option<Instant>,
    /// Kept over stop and start, so that the inhibit time holds between them too.
    last: Option<Instant>,
    /// An event that no frame has told of yet.
    event: Option<Instant>,
}

impl EventDriven {
    /// The first is due at `first`, or at the end of the inhibit time.
    pub fn start(&mut self, first: Instant) {
        self.next = Some(first);
        self.event = None;
    }

    /// No more.
    pub fn stop(&mut self) {
        self.next = None;
        self.event = None;
    }

    /// Something changed that is to be told. What changes back meanwhile is told all the same (R-DET-073).
    pub fn event(&mut self, now: Instant) {
        if self.next.is_some() && self.event.is_none() {
            self.event = Some(now);
        }
    }

    /// Whether a frame is due that is to tell of an event.
    #[must_use]
    pub fn event_is_due(&self, now: Instant) -> bool {
        self.event.is_some() && self.due().is_some_and(|due| due <= now)
    }

    /// When the next is due; `None` while stopped.
    #[must_use]
    pub fn due(&self) -> Option<Instant> {
        let wanted = self.event.map_or(self.next?, |event| event.min(self.next.unwrap_or(event)));
        Some(self.last.map_or(wanted, |last| wanted.max(last + INHIBIT_TIME)))
    }

    /// It was sent. `restart`: an event starts the period anew (R-DET-075); otherwise the periodic ones keep their grid.
    pub fn sent(&mut self, now: Instant, restart: bool) {
        let (Some(next), Some(due)) = (self.next, self.due()) else { return };
        self.next = Some(if restart {
            counted_from(due, now) + BASE_PERIOD
        } else if next <= now {
            let missed = now.since(next).as_micros() / BASE_PERIOD.as_micros();
            next + BASE_PERIOD * u32::try_from(missed + 1).unwrap_or(u32::MAX)
        } else {
            next
        });
        self.last = Some(now);
        self.event = None;
    }
}

/// A small delay is made up for, so that periods do not drift; a large one is not, so that frames do not bunch.
fn counted_from(due: Instant, now: Instant) -> Instant {
    if now.since(due) <= TOLERANCE { due } else { now }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ms(millis: u64) -> Instant {
        Instant::from_millis(millis)
    }

    #[test]
    fn r_det_078_a_small_delay_is_made_up_for_and_a_large_one_is_not() {
        let mut timer = Periodic::default();
        timer.start(ms(0));
        timer.sent(ms(7), BASE_PERIOD);
        assert_eq!(timer.due(), Some(ms(500)));
        timer.sent(ms(800), BASE_PERIOD);
        assert_eq!(timer.due(), Some(ms(1300)));
    }

    #[test]
    fn a_faster_period_counts_from_the_last_frame_and_is_never_due_in_the_past() {
        let mut timer = Periodic::default();
        timer.start(ms(0));
        timer.change_period(ms(0), KNOCK_PERIOD);
        assert_eq!(timer.due(), Some(ms(0)));
        timer.sent(ms(0), BASE_PERIOD);
        timer.change_period(ms(30), KNOCK_PERIOD);
        assert_eq!(timer.due(), Some(ms(100)));
        timer.change_period(ms(250), KNOCK_PERIOD);
        assert_eq!(timer.due(), Some(ms(250)));
    }

    #[test]
    fn r_det_072_a_periodic_frame_too_waits_for_the_inhibit_time() {
        let mut timer = EventDriven::default();
        timer.start(ms(0));
        timer.sent(ms(0), false);
        timer.event(ms(450));
        assert_eq!(timer.due(), Some(ms(450)));
        timer.sent(ms(450), false);
        assert_eq!(timer.due(), Some(ms(550)));
        timer.sent(ms(550), false);
        assert_eq!(timer.due(), Some(ms(1000)));
    }

    #[test]
    fn r_det_072_the_inhibit_time_holds_over_stop_and_start() {
        let mut timer = EventDriven::default();
        timer.start(ms(0));
        timer.sent(ms(0), true);
        timer.stop();
        assert_eq!(timer.due(), None);
        timer.start(ms(20));
        assert_eq!(timer.due(), Some(ms(100)));
    }
}
