//! Something that is done again and again, at fixed distances.

use std::time::Duration;

use crate::time::Instant;

/// The beat of a producer. A beat that is noticed late is done once, late; those that were missed altogether are left
/// out. The next one is counted from when this one was due, so that lateness never adds up.
#[derive(Clone, Copy, Debug)]
pub(super) struct Beat {
    period: Duration,
    next: Option<Instant>,
    last: Option<Instant>,
}

impl Beat {
    /// Not running. A period of zero never beats.
    pub(super) fn new(period: Duration) -> Self {
        Self { period, next: None, last: None }
    }

    /// From now on; at once, unless the last beat is less than a period ago.
    pub(super) fn start(&mut self, now: Instant) {
        if self.next.is_none() && !self.period.is_zero() {
            self.next = Some(self.last.map_or(now, |last| now.max(last + self.period)));
        }
    }

    /// No more.
    pub(super) fn stop(&mut self) {
        self.next = None;
    }

    /// Whether it is time; then the next one is set.
    pub(super) fn take(&mut self, now: Instant) -> bool {
        let Some(due) = self.next.filter(|due| *due <= now) else { return false };
        let period = u64::try_from(self.period.as_micros()).unwrap_or(u64::MAX).max(1);
        let missed = now.as_micros().saturating_sub(due.as_micros()) / period;
        let ahead = period.saturating_mul(missed.saturating_add(1));
        self.next = Some(Instant::from_micros(due.as_micros().saturating_add(ahead)));
        self.last = Some(now);
        true
    }

    /// When it beats next.
    pub(super) fn due(&self) -> Option<Instant> {
        self.next
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Beats that are noticed at these times.
    fn noticed(beat: &mut Beat, at: &[u64]) -> Vec<u64> {
        at.iter().copied().filter(|millis| beat.take(Instant::from_millis(*millis))).collect()
    }

    fn running() -> Beat {
        let mut beat = Beat::new(Duration::from_millis(100));
        beat.start(Instant::START);
        beat
    }

    #[test]
    fn lateness_does_not_add_up() {
        let mut beat = running();
        assert_eq!(noticed(&mut beat, &[0, 103, 207, 303, 399, 400]), [0, 103, 207, 303, 400]);
        assert_eq!(beat.due(), Some(Instant::from_millis(500)));
    }

    #[test]
    fn what_was_missed_is_left_out_and_not_made_up_for() {
        let mut beat = running();
        assert_eq!(noticed(&mut beat, &[0, 1234, 1235, 1299, 1300, 1301]), [0, 1234, 1300]);
        assert_eq!(beat.due(), Some(Instant::from_millis(1400)));
    }

    #[test]
    fn a_beat_that_is_stopped_and_started_again_and_again_is_no_faster() {
        let mut beat = running();
        let mut beats = Vec::new();
        for millis in 0..1000 {
            beat.stop();
            beat.start(Instant::from_millis(millis));
            beats.extend(noticed(&mut beat, &[millis]));
        }
        assert_eq!(beats, [0, 100, 200, 300, 400, 500, 600, 700, 800, 900]);
    }

    #[test]
    fn a_period_of_zero_never_beats() {
        let mut beat = Beat::new(Duration::ZERO);
        beat.start(Instant::START);
        assert_eq!(beat.due(), None);
    }
}
