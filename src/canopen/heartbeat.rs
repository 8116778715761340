//! Watching for frames that a node sends by itself: heartbeat (R-DET-044), and in the passive role the replies that
//! another master gets.

use std::time::Duration;

use crate::time::Instant;

/// Loses the node after a silence.
#[derive(Debug)]
pub(super) struct Heartbeat {
    timeout: Duration,
    /// Runs out when no frame comes; `None` before the first frame (where that is waited for), while lost or paused.
    deadline: Option<Instant>,
    /// Silence counts: always, or since the first frame.
    watching: bool,
    lost: bool,
}

impl Heartbeat {
    /// Silence counts from `now` on.
    pub(super) fn new(timeout: Duration, now: Instant) -> Self {
        Self { timeout, deadline: Some(now + timeout), watching: true, lost: false }
    }

    /// Silence counts from the first frame on: whether there will ever be one is not for us to say.
    pub(super) fn after_first_frame(timeout: Duration) -> Self {
        Self { timeout, deadline: None, watching: false, lost: false }
    }

    /// How long the node may be silent.
    pub(super) fn timeout(&self) -> Duration {
        self.timeout
    }

    /// Whether the node is lost.
    pub(super) fn is_lost(&self) -> bool {
        self.lost
    }

    /// A frame came. `true`: it ended the loss.
    pub(super) fn alive(&mut self, now: Instant) -> bool {
        self.watching = true;
        self.deadline = Some(now + self.timeout);
        std::mem::take(&mut self.lost)
    }

    /// A boot-up message came. It ends a loss, but does not promise that other frames will follow. `true`: it was lost.
    pub(super) fn handle_boot_up(&mut self, now: Instant) -> bool {
        self.watching && self.alive(now)
    }

    /// The bus cannot be used: silence proves nothing. A loss stays.
    pub(super) fn pause(&mut self) {
        self.deadline = None;
    }

    /// The bus can be used again.
    pub(super) fn resume(&mut self, now: Instant) {
        if self.watching && !self.lost {
            self.deadline = Some(now + self.timeout);
        }
    }

    /// `true`: the node is lost as from now.
    pub(super) fn handle_timeout(&mut self, now: Instant) -> bool {
        let over = self.deadline.is_some_and(|deadline| deadline <= now);
        if over {
            self.deadline = None;
            self.lost = true;
        }
        over
    }

    /// When the silence becomes too long.
    pub(super) fn poll_timeout(&self) -> Option<(Instant, &'static str)> {
        self.deadline.map(|deadline| (deadline, "heartbeat"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const TIMEOUT: Duration = Duration::from_millis(1500);

    fn at(millis: u64) -> Instant {
        Instant::from_millis(millis)
    }

    #[test]
    fn r_det_044_silence_loses_the_node_and_the_next_frame_recovers_it() {
        let mut heartbeat = Heartbeat::new(TIMEOUT, at(0));
        assert!(!heartbeat.alive(at(1000)));
        assert!(!heartbeat.handle_timeout(at(2499)));
        assert!(heartbeat.handle_timeout(at(2500)));
        assert!(heartbeat.is_lost());
        assert!(!heartbeat.handle_timeout(at(9000)), "told once");
        assert_eq!(heartbeat.poll_timeout(), None);
        assert!(heartbeat.alive(at(9001)));
        assert!(!heartbeat.is_lost());
    }

    #[test]
    fn who_waits_for_the_first_frame_never_loses_a_node_that_sends_none() {
        let mut heartbeat = Heartbeat::after_first_frame(TIMEOUT);
        assert_eq!(heartbeat.poll_timeout(), None);
        heartbeat.pause();
        heartbeat.resume(at(5000));
        assert_eq!(heartbeat.poll_timeout(), None);
        heartbeat.alive(at(6000));
        assert!(heartbeat.handle_timeout(at(7500)));
    }

    #[test]
    fn a_bus_that_is_down_loses_no_node() {
        let mut heartbeat = Heartbeat::new(TIMEOUT, at(0));
        heartbeat.pause();
        assert!(!heartbeat.handle_timeout(at(60_000)));
        heartbeat.resume(at(60_000));
        assert!(!heartbeat.handle_timeout(at(61_499)));
        assert!(heartbeat.handle_timeout(at(61_500)));
    }
}
