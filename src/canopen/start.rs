//! Starting one node and seeing to it that it did start (R-DET-016..020).

use std::time::Duration;

use super::StartSettings;
use crate::time::Instant;

/// Unanswered start commands after which the start has failed (R-DET-020).
const ATTEMPTS: u32 = 3;
/// A node that boots so often within [`STORM_WINDOW`] restarts because it is started: its start waits (F14).
const STORM_BOOTS: usize = 3;
const STORM_WINDOW: Duration = Duration::from_secs(10);
/// How long the start of such a node waits.
pub(super) const STORM_WAIT: Duration = Duration::from_secs(30);

/// The start machine of one node.
#[derive(Debug)]
pub(super) struct Start {
    settings: StartSettings,
    phase: Phase,
    /// Start commands of this attempt to start.
    attempts: u32,
    /// `StartFailed` was told and the node has not been operational since.
    failed: bool,
    /// An operator took the node out of operation: it stays so until an operator starts it.
    held: bool,
    /// Its boot is done, or it needs none.
    configured: bool,
    /// The last boot-up messages, oldest first.
    boots: [Option<Instant>; STORM_BOOTS],
    /// The node restarts again and again: it is not started before.
    quiet_until: Option<Instant>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Phase {
    /// Nothing to do.
    Idle,
    /// After a boot-up message: start then, if the node has not reported pre-operational by then (R-DET-019).
    Booting(Instant),
    /// A command was sent; repeat it then.
    Sent(Instant),
    /// The bus went down while a start was under way.
    Paused,
}

/// A start command is due.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct StartDue {
    /// The start has failed, after so many commands; told once.
    pub(super) failed: Option<u32>,
}

impl Start {
    /// Nothing under way. A node that is not `configured` yet is not started.
    pub(super) fn new(settings: StartSettings, configured: bool) -> Self {
        Self {
            settings,
            phase: Phase::Idle,
            attempts: 0,
            failed: false,
            held: false,
            configured,
            boots: [None; STORM_BOOTS],
            quiet_until: None,
        }
    }

    /// Whether an operator took the node out of operation.
    pub(super) fn is_held(&self) -> bool {
        self.held
    }

    /// Whether its start waits: it is not configured yet, or restarts again and again.
    pub(super) fn is_held_back(&self) -> bool {
        !self.configured || self.quiet_until.is_some()
    }

    /// The boot of the node begins anew: it is not started before that is done.
    pub(super) fn handle_boot_begun(&mut self) {
        self.configured = false;
        self.cancel();
    }

    /// The boot of the node is done: a start command is due after `wait`, unless the node is operational already.
    pub(super) fn handle_boot_done(&mut self, now: Instant, operational: bool, wait: Duration) {
        self.configured = true;
        if self.settings.auto_start && !self.held && !operational {
            let at = now + wait;
            self.phase = Phase::Booting(self.quiet_until.map_or(at, |until| until.max(at)));
        }
    }

    /// Whether a lost node is to be reset when it comes back.
    pub(super) fn resets_on_recovery(&self) -> bool {
        self.settings.reset_on_recovery
    }

    /// A boot-up message: what was under way is void. `true`: it was one too many, from now on the start waits.
    pub(super) fn handle_boot_up(&mut self, now: Instant) -> bool {
        self.cancel();
        if !self.settings.auto_start || self.held {
            return false;
        }
        self.quiet_until = self.quiet_until.filter(|until| now < *until);
        let storm = self.quiet_until.is_none() && self.boots_too_often(now);
        if storm {
            self.quiet_until = Some(now + STORM_WAIT);
        }
        if self.configured {
            self.phase = Phase::Booting(self.quiet_until.unwrap_or(now + self.settings.delay));
        }
        storm
    }

    fn boots_too_often(&mut self, now: Instant) -> bool {
        self.boots.rotate_left(1);
        if let Some(newest) = self.boots.last_mut() {
            *newest = Some(now);
        }
        let often = self.boots.iter().all(|boot| boot.is_some_and(|at| now.since(at) <= STORM_WINDOW));
        if often {
            self.boots = [None; STORM_BOOTS];
        }
        often
    }

    /// The node reports pre-operational or stopped. `true`: a start command is due now (R-DET-017).
    pub(super) fn handle_idle_node(&self, now: Instant) -> bool {
        let held_back = self.quiet_until.is_some_and(|until| now < until);
        self.settings.auto_start
            && self.configured
            && !self.held
            && !held_back
            && !matches!(self.phase, Phase::Sent(_))
    }

    /// The node is operational, or sends TPDOs. `true`: after a failed start.
    pub(super) fn handle_operational(&mut self) -> bool {
        self.cancel();
        std::mem::take(&mut self.failed)
    }

    /// A start command was sent.
    pub(super) fn sent(&mut self, now: Instant) {
        self.quiet_until = None;
        self.attempts = self.attempts.saturating_add(1);
        let wait = if self.attempts == 1 { self.settings.confirm } else { self.settings.retry };
        self.phase = Phase::Sent(now + wait);
    }

    /// A start command to all nodes was sent because of another node. It counts as this one's too, unless one was sent
    /// so lately that its effect is still to be awaited.
    pub(super) fn sent_to_all(&mut self, now: Instant) {
        let lately = matches!(self.phase, Phase::Sent(at) if at.since(now) > self.settings.retry / 2);
        if !lately {
            self.sent(now);
        }
    }

    /// A start command did not leave: it does not count.
    pub(super) fn handle_not_sent(&mut self) {
        self.attempts = self.attempts.saturating_sub(1);
    }

    /// Nothing is under way any more: the node is lost, reset or ordered elsewhere.
    pub(super) fn cancel(&mut self) {
        self.phase = Phase::Idle;
        self.attempts = 0;
    }

    /// An operator takes the node out of operation.
    pub(super) fn hold(&mut self) {
        self.cancel();
        self.held = true;
        self.failed = false;
        self.quiet_until = None;
    }

    /// An operator starts the node.
    pub(super) fn release(&mut self) {
        self.cancel();
        self.held = false;
        self.failed = false;
        self.quiet_until = None;
    }

    /// The bus cannot be used.
    pub(super) fn pause(&mut self) {
        if self.phase != Phase::Idle {
            self.phase = Phase::Paused;
            self.attempts = 0;
        }
    }

    /// The bus can be used again: a start that was under way goes on as after a boot-up message.
    pub(super) fn resume(&mut self, now: Instant) {
        if self.phase == Phase::Paused {
            self.phase = Phase::Booting(now + self.settings.delay);
        }
    }

    /// Whether a start command is due; [`sent`](Self::sent) is to follow.
    pub(super) fn handle_timeout(&mut self, now: Instant) -> Option<StartDue> {
        match self.phase {
            Phase::Booting(at) if at <= now => Some(StartDue { failed: None }),
            Phase::Sent(at) if at <= now => {
                let failed = self.attempts >= ATTEMPTS && !self.failed;
                self.failed |= failed;
                Some(StartDue { failed: failed.then_some(self.attempts) })
            }
            Phase::Idle | Phase::Booting(_) | Phase::Sent(_) | Phase::Paused => None,
        }
    }

    /// When [`handle_timeout`](Self::handle_timeout) has something to do.
    pub(super) fn poll_timeout(&self) -> Option<(Instant, &'static str)> {
        match self.phase {
            Phase::Booting(at) => Some((at, "start after boot-up")),
            Phase::Sent(at) => Some((at, "start confirmation")),
            Phase::Idle | Phase::Paused => None,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(millis: u64) -> Instant {
        Instant::from_millis(millis)
    }

    fn due(start: &mut Start, millis: u64) -> Option<StartDue> {
        start.handle_timeout(at(millis))
    }

    const DUE: Option<StartDue> = Some(StartDue { failed: None });

    #[test]
    fn r_det_020_start_is_repeated_and_fails_after_three_unanswered_commands() {
        let mut start = Start::new(StartSettings::default(), true);
        assert!(start.handle_idle_node(at(0)));
        start.sent(at(0));
        assert!(!start.handle_idle_node(at(0)), "one command at a time");
        assert_eq!(due(&mut start, 999), None);
        for (millis, failed) in [(1000, None), (2000, None), (3000, Some(3)), (4000, None), (5000, None)] {
            assert_eq!(due(&mut start, millis), Some(StartDue { failed }), "at {millis}");
            start.sent(at(millis));
        }
        assert!(start.handle_operational());
        assert!(!start.handle_operational(), "told once");
        assert_eq!(start.poll_timeout(), None);
    }

    #[test]
    fn r_det_019_start_after_boot_up_waits_for_the_delay_at_most() {
        let mut start = Start::new(StartSettings::default(), true);
        start.handle_boot_up(at(100));
        assert_eq!(start.poll_timeout(), Some((at(600), "start after boot-up")));
        assert!(start.handle_idle_node(at(0)), "a report of pre-operational starts at once");
        assert_eq!(due(&mut start, 599), None);
        assert_eq!(due(&mut start, 600), DUE);
    }

    #[test]
    fn f14_a_node_that_boots_three_times_within_ten_seconds_is_started_after_thirty_seconds() {
        let mut start = Start::new(StartSettings::default(), true);
        assert!(!start.handle_boot_up(at(0)));
        assert!(!start.handle_boot_up(at(1000)));
        assert!(start.handle_boot_up(at(2000)), "the third");
        assert!(!start.handle_boot_up(at(3000)), "told once");
        assert!(!start.handle_idle_node(at(3100)));
        assert_eq!(start.poll_timeout(), Some((at(32_000), "start after boot-up")));
        assert_eq!(due(&mut start, 32_000), DUE);
        start.sent(at(32_000));
        assert!(!start.is_held_back());
        assert!(!start.handle_boot_up(at(33_000)), "counted anew");
        assert!(!start.handle_boot_up(at(60_000)), "seldom enough");
        assert!(!start.handle_boot_up(at(90_000)));
        assert!(start.handle_idle_node(at(90_100)));
    }

    #[test]
    fn r_det_020_a_failed_start_is_told_again_after_an_operator_ordered_another() {
        let mut start = Start::new(StartSettings::default(), true);
        for ordered_at in [0, 60_000] {
            start.release();
            for attempt in 0..3 {
                start.sent(at(ordered_at + 1000 * attempt));
            }
            assert_eq!(due(&mut start, ordered_at + 3000), Some(StartDue { failed: Some(3) }));
        }
    }

    #[test]
    fn r_det_017_a_node_that_an_operator_stopped_stays_stopped() {
        let mut start = Start::new(StartSettings::default(), true);
        start.hold();
        assert!(!start.handle_idle_node(at(0)));
        start.handle_boot_up(at(0));
        assert_eq!(start.poll_timeout(), None);
        start.release();
        assert!(start.handle_idle_node(at(0)));
    }

    #[test]
    fn r_det_017_without_auto_start_nothing_is_started() {
        let mut start = Start::new(StartSettings { auto_start: false, ..StartSettings::default() }, true);
        start.handle_boot_up(at(0));
        assert!(!start.handle_idle_node(at(0)));
        assert_eq!(start.poll_timeout(), None);
    }

    #[test]
    fn a_command_that_did_not_leave_is_no_attempt() {
        let mut start = Start::new(StartSettings::default(), true);
        for millis in [0, 1000, 2000, 3000, 4000] {
            start.sent(at(millis));
            start.handle_not_sent();
            assert_eq!(due(&mut start, millis + 1000), DUE);
        }
    }

    #[test]
    fn a_start_that_the_bus_interrupted_goes_on() {
        let mut start = Start::new(StartSettings::default(), true);
        start.sent(at(0));
        start.pause();
        assert_eq!(due(&mut start, 9000), None);
        start.resume(at(9000));
        assert_eq!(due(&mut start, 9500), DUE);
    }
}
