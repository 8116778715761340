//! Node guarding of one node (CiA 301, R-DET-021..046): when to ask, and what an answer is worth.
//!
//! Requests stand on a grid of the guard time, a different one for each node, but for those that have a reason to come
//! sooner; of one node there is never more than one open. A reply that is missed or
//! carries the wrong toggle bit is a failure; `life_time_factor` failures in a row lose the node. Only a valid reply or a
//! boot-up message ends the loss; guarding goes on meanwhile.

use std::time::Duration;

use super::{GuardingSettings, TogglePolicy};
use crate::time::Instant;

/// A node is asked this long after its boot-up message at the latest, so that it is started soon (R-DET-019).
const AFTER_BOOT_UP: Duration = Duration::from_millis(100);

/// The guard machine of one node.
#[derive(Debug)]
pub(super) struct Guarding {
    settings: GuardingSettings,
    /// Wait between "start asking" and the first request, different for each node so that requests do not burst.
    phase: Duration,
    /// A point of the grid that the requests stand on.
    grid: Instant,
    /// When the next request is due; `None` while the bus cannot be used.
    due: Option<Instant>,
    /// The next request is the one after a boot-up message; the one after it keeps its distance from that.
    after_boot_up: bool,
    /// End of the pause after an NMT command.
    settled: Option<Instant>,
    open: Option<Request>,
    /// Deadline of the newest request that was missed: a reply received before it was only handed to us late.
    missed: Option<Instant>,
    /// Deadline of the newest request that was answered: a second answer before it comes from a second node.
    answered: Option<Instant>,
    /// Until then a state frame answers somebody else's request.
    foreign: Option<Instant>,
    /// Toggle bit of the reply that the next one is compared with; `None` accepts either (R-DET-034).
    reference: Option<bool>,
    /// Misses and toggle errors in a row.
    failures: u16,
    /// How many of them were toggle errors.
    wrong_toggles: u16,
    lost: bool,
    probed: Option<Instant>,
}

/// A request that waits for its reply.
#[derive(Clone, Copy, Debug)]
struct Request {
    deadline: Instant,
    /// A boot-up message came meanwhile. It may have been the reply (R-DET-034), so that no miss is counted.
    excused: bool,
}

/// One more failure.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Failure {
    /// Failures in a row.
    pub(super) consecutive: u16,
    /// This one lost the node; whether all failures were wrong toggle bits.
    pub(super) lost: Option<bool>,
}

/// What a state frame other than a boot-up message is worth.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Verdict {
    /// The state counts.
    Valid {
        /// It ended the loss of the node.
        recovered: bool,
        /// It had the wrong toggle bit, which the policy only counts; failures in a row until then.
        wrong_toggle: Option<u16>,
    },
    /// Wrong toggle bit: as if it had not come (R-DET-035).
    ToggleError(Failure),
    /// No request of ours was open: the state counts, a loss stays (R-DET-037, R-DET-045).
    Unsolicited {
        /// Somebody else had asked.
        foreign: bool,
        /// Our request had been answered already.
        twice: bool,
        /// That was too long ago for this to be an answer as well, and no other request followed.
        unasked: bool,
    },
}

/// What became due.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Due {
    /// A reply did not come in time.
    pub(super) missed: Option<Failure>,
    /// A request is to be sent.
    pub(super) request: bool,
}

impl Guarding {
    /// Asks `phase` after `now` for the first time (R-DET-046), without waiting for a boot-up message.
    pub(super) fn new(mut settings: GuardingSettings, phase: Duration, now: Instant) -> Self {
        settings.reply_timeout = settings.reply_timeout.min(settings.guard_time);
        settings.life_time_factor = settings.life_time_factor.max(1);
        Self {
            settings,
            phase,
            grid: now + phase,
            due: Some(now + phase),
            after_boot_up: false,
            settled: None,
            open: None,
            missed: None,
            answered: None,
            foreign: None,
            reference: None,
            failures: 0,
            wrong_toggles: 0,
            lost: false,
            probed: None,
        }
    }

    /// DLC of the request.
    pub(super) fn rtr_dlc(&self) -> u8 {
        self.settings.rtr_dlc.min(8)
    }

    /// Whether the node is lost.
    pub(super) fn is_lost(&self) -> bool {
        self.lost
    }

    /// A state frame other than a boot-up message. [`expire`](Self::expire) is to be called before.
    pub(super) fn handle_reply(&mut self, now: Instant, toggle: bool) -> Verdict {
        if let Some(request) = self.open.take() {
            self.answered = Some(request.deadline);
            return self.judge(toggle);
        }
        if self.missed.is_some_and(|deadline| now <= deadline) {
            self.missed = None;
            return self.judge(toggle);
        }
        let foreign = self.foreign.take().is_some_and(|until| now <= until);
        let answered = self.answered.filter(|_| !foreign);
        let twice = answered.is_some_and(|deadline| now <= deadline);
        let unasked = answered.is_some() && !twice;
        self.alive();
        if self.settings.toggle_resync {
            self.reference = Some(toggle);
        }
        Verdict::Unsolicited { foreign, twice, unasked }
    }

    /// The answer to a request of ours.
    fn judge(&mut self, toggle: bool) -> Verdict {
        let wrong = self.reference == Some(toggle) && self.settings.toggle != TogglePolicy::Off;
        if wrong && self.settings.toggle == TogglePolicy::Strict {
            self.wrong_toggles = self.wrong_toggles.saturating_add(1);
            return Verdict::ToggleError(self.fail());
        }
        let wrong_toggle = wrong.then_some(self.failures);
        self.reference = Some(toggle);
        self.alive();
        Verdict::Valid { recovered: std::mem::take(&mut self.lost), wrong_toggle }
    }

    /// A state frame `00`: a boot-up message, or a reply of a node that is still initialising. Either way the node is alive
    /// and the next reply sets the toggle reference (R-DET-034). Gives whether the node was lost, and whether a request
    /// was open that this may have answered.
    pub(super) fn handle_zero(&mut self) -> (bool, bool) {
        self.alive();
        self.forget_reference();
        self.missed = None;
        self.answered = None;
        if let Some(request) = &mut self.open {
            request.excused = true;
        }
        (std::mem::take(&mut self.lost), self.open.is_some())
    }

    /// It was a boot-up message: asks soon, again after the guard time, and then on the grid, so that the nodes of a bus
    /// that were switched on together are not asked together for good.
    pub(super) fn ask_after_boot_up(&mut self, now: Instant) {
        if self.due.is_some() {
            self.due = Some(now + AFTER_BOOT_UP.min(self.settings.guard_time));
            self.after_boot_up = true;
        }
    }

    /// A guard request that somebody else sent (R-DET-043).
    pub(super) fn handle_foreign_request(&mut self, now: Instant) {
        self.foreign = Some(now + self.settings.reply_timeout);
    }

    /// Our request did not leave: nobody can be blamed for the missing reply.
    pub(super) fn handle_not_sent(&mut self) {
        self.open = None;
    }

    /// An NMT command was sent: the node is left in peace for a moment; a request that falls into it waits.
    pub(super) fn settle(&mut self, now: Instant) {
        self.settled = Some(now + self.settings.settle);
    }

    /// The next reply is accepted with either toggle bit.
    pub(super) fn forget_reference(&mut self) {
        self.reference = None;
    }

    /// Asks at once, where no request is open; at most once in a guard time, whatever the reasons (R-DET-083).
    pub(super) fn probe(&mut self, now: Instant) {
        let recently = self.probed.is_some_and(|last| now.since(last) < self.settings.guard_time);
        if self.open.is_none() && self.due.is_some() && !recently {
            self.due = Some(now);
            self.probed = Some(now);
        }
    }

    /// The bus cannot be used: nothing is asked and nobody is blamed. A loss stays.
    pub(super) fn pause(&mut self) {
        self.due = None;
        self.open = None;
        self.missed = None;
        self.answered = None;
        self.settled = None;
        self.forget_reference();
        self.alive();
    }

    /// The bus can be used again: as at the start.
    pub(super) fn resume(&mut self, now: Instant) {
        self.grid = now + self.phase;
        self.due = Some(self.grid);
        self.after_boot_up = false;
    }

    /// Closes a request whose deadline lies before `now`, for a frame that was received at `now`.
    pub(super) fn expire(&mut self, now: Instant) -> Option<Failure> {
        let late = self.open.is_some_and(|request| request.deadline < now);
        if late { self.close() } else { None }
    }

    /// What became due.
    pub(super) fn handle_timeout(&mut self, now: Instant) -> Due {
        let overdue = self.open.is_some_and(|request| request.deadline <= now);
        let missed = if overdue { self.close() } else { None };
        let request = self.open.is_none() && self.send_at().is_some_and(|at| at <= now);
        if request {
            let period = self.settings.guard_time;
            let booted = std::mem::take(&mut self.after_boot_up);
            self.due = Some(if booted { now + period } else { next_on_grid(self.grid, period, now) });
            self.settled = None;
            self.answered = None;
            self.open = Some(Request { deadline: now + self.settings.reply_timeout, excused: false });
        }
        Due { missed, request }
    }

    /// When [`handle_timeout`](Self::handle_timeout) has something to do.
    pub(super) fn poll_timeout(&self) -> Option<(Instant, &'static str)> {
        match self.open {
            Some(request) => Some((request.deadline, "guard reply")),
            None => self.send_at().map(|at| (at, "guard request")),
        }
    }

    /// When the next request leaves: on the grid, or at the end of the pause after an NMT command. That pause moves a
    /// request by its own length at most, so that a stream of commands cannot hold guarding up.
    fn send_at(&self) -> Option<Instant> {
        let due = self.due?;
        let settled = self.settled.map_or(due, |until| until.min(due + self.settings.settle));
        Some(due.max(settled))
    }

    fn close(&mut self) -> Option<Failure> {
        let request = self.open.take()?;
        if request.excused {
            return None;
        }
        self.missed = Some(request.deadline);
        self.forget_reference();
        Some(self.fail())
    }

    fn fail(&mut self) -> Failure {
        self.failures = self.failures.saturating_add(1);
        let expired = self.failures >= u16::from(self.settings.life_time_factor);
        let lost = (expired && !self.lost).then_some(self.wrong_toggles == self.failures);
        self.lost |= expired;
        Failure { consecutive: self.failures, lost }
    }

    fn alive(&mut self) {
        self.failures = 0;
        self.wrong_toggles = 0;
    }
}

/// The first instant of the grid `grid + k * period` after `now`, k at least 1: what was slept through is not made up for.
fn next_on_grid(grid: Instant, period: Duration, now: Instant) -> Instant {
    let period = u64::try_from(period.as_micros()).unwrap_or(u64::MAX).max(1);
    let passed = now.as_micros().saturating_sub(grid.as_micros()) / period;
    let ahead = passed.saturating_add(1).saturating_mul(period);
    Instant::from_micros(grid.as_micros().saturating_add(ahead))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(millis: u64) -> Instant {
        Instant::from_millis(millis)
    }

    /// A machine whose first request was answered with toggle bit 0.
    fn answered() -> Guarding {
        let mut guarding = Guarding::new(GuardingSettings::default(), Duration::ZERO, at(0));
        assert!(guarding.handle_timeout(at(0)).request);
        assert_eq!(guarding.handle_reply(at(1), false), VALID);
        guarding
    }

    const VALID: Verdict = Verdict::Valid { recovered: false, wrong_toggle: None };

    fn error(consecutive: u16, lost: Option<bool>) -> Verdict {
        Verdict::ToggleError(Failure { consecutive, lost })
    }

    #[test]
    fn r_det_034_the_first_reply_may_have_either_toggle_bit() {
        for toggle in [false, true] {
            let mut guarding = Guarding::new(GuardingSettings::default(), Duration::ZERO, at(0));
            guarding.handle_timeout(at(0));
            assert_eq!(guarding.handle_reply(at(1), toggle), VALID);
            guarding.handle_timeout(at(500));
            assert_eq!(guarding.handle_reply(at(501), toggle), error(1, None));
        }
    }

    #[test]
    fn r_det_035_a_wrong_toggle_bit_does_not_change_the_expected_one() {
        let mut guarding = answered();
        for (request, verdict) in
            (1..).zip([error(1, None), error(2, None), error(3, Some(true)), error(4, None)])
        {
            guarding.handle_timeout(at(500 * request));
            assert_eq!(guarding.handle_reply(at(500 * request + 1), false), verdict);
        }
        guarding.handle_timeout(at(2500));
        let recovered = Verdict::Valid { recovered: true, wrong_toggle: None };
        assert_eq!(guarding.handle_reply(at(2501), true), recovered);
    }

    #[test]
    fn misses_after_wrong_toggle_bits_are_silence_and_no_stuck_toggle() {
        let mut guarding = answered();
        for request in 1..=2 {
            guarding.handle_timeout(at(500 * request));
            guarding.handle_reply(at(500 * request + 1), false);
        }
        guarding.handle_timeout(at(1500));
        let due = guarding.handle_timeout(at(1600));
        assert_eq!(due.missed, Some(Failure { consecutive: 3, lost: Some(false) }));
    }

    #[test]
    fn r_det_033_a_reply_at_its_deadline_is_in_time_and_requests_never_overlap() {
        let mut guarding = answered();
        guarding.handle_timeout(at(500));
        assert_eq!(guarding.poll_timeout(), Some((at(600), "guard reply")));
        assert_eq!(guarding.expire(at(600)), None);
        assert_eq!(guarding.handle_reply(at(600), true), VALID);
        assert_eq!(guarding.poll_timeout(), Some((at(1000), "guard request")));

        let settings =
            GuardingSettings { reply_timeout: Duration::from_secs(9), ..GuardingSettings::default() };
        let mut slow = Guarding::new(settings, Duration::ZERO, at(0));
        slow.handle_timeout(at(0));
        assert_eq!(slow.poll_timeout(), Some((at(500), "guard reply")), "at most the guard time");
        let due = slow.handle_timeout(at(500));
        assert!(due.request && due.missed.is_some());
    }

    #[test]
    fn requests_stay_on_their_grid_when_a_timeout_is_handled_late() {
        let mut guarding = answered();
        assert!(guarding.handle_timeout(at(503)).request);
        guarding.handle_reply(at(504), true);
        assert_eq!(guarding.poll_timeout(), Some((at(1000), "guard request")));
        assert!(guarding.handle_timeout(at(7777)).request);
        guarding.handle_reply(at(7778), false);
        assert_eq!(
            guarding.poll_timeout(),
            Some((at(8000), "guard request")),
            "what was slept through is let go"
        );
    }

    #[test]
    fn after_a_boot_up_the_node_is_asked_soon_then_after_the_guard_time_and_then_on_its_grid() {
        let mut guarding = answered();
        guarding.handle_zero();
        guarding.ask_after_boot_up(at(200));
        for (request, toggle) in [(300, false), (800, true), (1000, false), (1500, true)] {
            assert_eq!(guarding.poll_timeout(), Some((at(request), "guard request")));
            guarding.handle_timeout(at(request));
            assert_eq!(guarding.handle_reply(at(request + 1), toggle), VALID);
        }
    }

    #[test]
    fn a_grid_at_the_end_of_time_does_not_overflow() {
        let end = Instant::from_micros(u64::MAX);
        assert_eq!(next_on_grid(end, Duration::MAX, end), end);
        assert_eq!(next_on_grid(at(0), Duration::ZERO, at(5)), Instant::from_micros(5001));
    }
}
