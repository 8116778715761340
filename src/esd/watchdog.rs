//! The watchdog of one module (R-ESD-081..087): when to trigger it, and what an answer is worth.
//!
//! Requests stand on a grid of the watchdog time; there is never more than one open. An answer that is missed or carries the
//! toggle bit of the one before is a failure; as many failures in a row as the factor says lose the module. Triggering goes
//! on meanwhile: the module resets itself without.

use std::time::Duration;

use super::identifiers::ModuleNumber;
use super::init_frame::{InitCommand, Order};
use super::settings::{WatchdogMode, WatchdogSettings};
use crate::can::{CanFrame, CanId};
use crate::time::Instant;

/// DLC of the remote frame. The manual is silent on it (V-ESD-11 assumes 1, the length of the answer).
const REMOTE_DLC: u8 = 1;

/// A request that did not leave is sent again after this part of the watchdog time: the module counts on it.
const AGAIN: u32 = 4;

/// The watchdog machine of one module.
#[derive(Debug)]
pub(super) struct Watchdog {
    id: CanId,
    period: Duration,
    factor: u32,
    reply_timeout: Duration,
    frame: CanFrame,
    /// The module counts on being triggered, also while the bus cannot be used.
    running: bool,
    /// When the next request is due; `None` while none can be sent.
    due: Option<Instant>,
    /// Until when the answer to the open request may come.
    open: Option<Instant>,
    /// Toggle bit of the answer that the next one is compared with; `None` accepts either (R-ESD-085).
    reference: Option<bool>,
    /// Misses and toggle errors in a row.
    failures: u32,
}

/// What came of a request.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Verdict {
    /// Nothing that counts.
    Nothing,
    /// The module is alive.
    Alive,
    /// It did not answer in time, for so many times in a row.
    Missed(u32),
    /// It answered with the toggle bit of the answer before.
    ToggleError,
}

impl Watchdog {
    /// Not running.
    pub(super) fn new(settings: WatchdogSettings, module: ModuleNumber, reply_timeout: Duration) -> Self {
        let period = settings.time.max(Duration::from_millis(1));
        let command = InitCommand::Supervisor { module: Some(module), order: Order::Watchdog };
        let frame = match settings.mode {
            WatchdogMode::Remote => CanFrame::remote_frame(settings.id, REMOTE_DLC),
            WatchdogMode::Command => None,
        };
        Self {
            id: settings.id,
            period,
            factor: u32::from(settings.factor.max(1)),
            reply_timeout: reply_timeout.min(period),
            frame: frame.unwrap_or_else(|| command.frame()),
            running: false,
            due: None,
            open: None,
            reference: None,
            failures: 0,
        }
    }

    /// Identifier of the answers.
    pub(super) fn id(&self) -> CanId {
        self.id
    }

    /// Triggers from now on, if it does not yet. The module is to be configured for it before.
    pub(super) fn start(&mut self, now: Instant) {
        self.running = true;
        if self.due.is_none() {
            self.due = Some(now);
        }
    }

    /// Triggers no more, and forgets. `true`: it was triggered until now.
    pub(super) fn stop(&mut self) -> bool {
        self.pause();
        std::mem::take(&mut self.running)
    }

    /// The bus cannot be used.
    pub(super) fn pause(&mut self) {
        self.due = None;
        self.open = None;
        self.reference = None;
        self.failures = 0;
    }

    /// The bus can be used: a module that was triggered before it went down counts on going on at once (R-ESD-083).
    pub(super) fn resume(&mut self, now: Instant) {
        if self.running {
            self.start(now);
        }
    }

    /// Failures until now do not count.
    pub(super) fn forgive(&mut self) {
        self.failures = 0;
    }

    /// As many failures in a row as lose the module.
    pub(super) fn has_failed(&self) -> bool {
        self.failures >= self.factor
    }

    /// A frame on its identifier. [`handle_timeout`](Self::handle_timeout) is to be called before for a deadline that lies
    /// before it.
    pub(super) fn handle_frame(&mut self, frame: &CanFrame) -> Verdict {
        let [answer] = *frame.data() else { return Verdict::Nothing };
        let toggle = answer & 0x80 != 0;
        if self.open.take().is_none() {
            // Too late, or somebody else asked: the module is alive, and its toggle bit moved on.
            self.reference = Some(toggle);
            self.failures = 0;
            return Verdict::Alive;
        }
        if self.reference == Some(toggle) {
            self.failures = self.failures.saturating_add(1);
            return Verdict::ToggleError;
        }
        self.reference = Some(toggle);
        self.failures = 0;
        Verdict::Alive
    }

    /// A frame of ours did not leave: nobody can be blamed for the missing answer. `true`: it was the request.
    pub(super) fn handle_not_sent(&mut self, now: Instant, frame: &CanFrame) -> bool {
        let mine = *frame == self.frame && self.open.is_some();
        if mine {
            self.open = None;
            let again = now + self.period / AGAIN;
            self.due = self.due.map(|due| due.min(again));
        }
        mine
    }

    /// What became due, and the request that is to be sent now.
    pub(super) fn handle_timeout(&mut self, now: Instant) -> (Verdict, Option<CanFrame>) {
        let mut verdict = Verdict::Nothing;
        if self.open.take_if(|deadline| *deadline <= now).is_some() {
            self.reference = None;
            self.failures = self.failures.saturating_add(1);
            verdict = Verdict::Missed(self.failures);
        }
        let Some(due) = self.due.filter(|due| *due <= now && self.open.is_none()) else {
            return (verdict, None);
        };
        // What was slept through is not made up for.
        let next = due + self.period;
        self.due = Some(if next <= now { now + self.period } else { next });
        self.open = Some(now + self.reply_timeout);
        (verdict, Some(self.frame))
    }

    /// When [`handle_timeout`](Self::handle_timeout) has something to do, and why.
    pub(super) fn poll_timeout(&self) -> Option<(Instant, &'static str)> {
        match self.open {
            Some(deadline) => Some((deadline, "watchdog answer")),
            None => self.due.map(|due| (due, "watchdog request")),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(millis: u64) -> Instant {
        Instant::from_millis(millis)
    }

    fn watchdog(mode: WatchdogMode) -> Watchdog {
        let settings =
            WatchdogSettings { id: CanId::Standard(0x512), time: Duration::from_secs(1), factor: 3, mode };
        let mut watchdog =
            Watchdog::new(settings, ModuleNumber::new(0x12).unwrap(), Duration::from_millis(100));
        assert_eq!(watchdog.poll_timeout(), None, "not before it is started");
        watchdog.start(at(0));
        watchdog
    }

    fn answer(watchdog: &mut Watchdog, text: &str) -> Verdict {
        watchdog.handle_frame(&text.parse().unwrap())
    }

    fn request(watchdog: &mut Watchdog, millis: u64) -> Option<String> {
        watchdog.handle_timeout(at(millis)).1.map(|frame| frame.to_string())
    }

    #[test]
    fn r_esd_084_085_086_087_v_esd_11_remote_requests_and_toggling_answers() {
        for (first, second) in [("512#7D", "512#FD"), ("512#FD", "512#7D"), ("512#05", "512#85")] {
            let mut watchdog = watchdog(WatchdogMode::Remote);
            assert_eq!(request(&mut watchdog, 0).as_deref(), Some("512#R1"));
            assert_eq!(answer(&mut watchdog, first), Verdict::Alive, "either toggle bit");
            assert_eq!(request(&mut watchdog, 999), None);
            assert_eq!(request(&mut watchdog, 1000).as_deref(), Some("512#R1"));
            assert_eq!(answer(&mut watchdog, second), Verdict::Alive);
            request(&mut watchdog, 2000);
            assert_eq!(answer(&mut watchdog, second), Verdict::ToggleError);
        }
    }

    #[test]
    fn r_esd_083_087_v_esd_11_the_command_in_place_of_the_remote_frame() {
        let mut watchdog = watchdog(WatchdogMode::Command);
        assert_eq!(request(&mut watchdog, 0).as_deref(), Some("700#FF0200120000"));
        assert_eq!(answer(&mut watchdog, "512#7D"), Verdict::Alive);
    }

    #[test]
    fn r_esd_087_three_failures_in_a_row_lose_the_module_and_requests_go_on() {
        let mut watchdog = watchdog(WatchdogMode::Remote);
        for request in 0..3_u64 {
            assert!(!watchdog.has_failed());
            assert!(watchdog.handle_timeout(at(1000 * request)).1.is_some());
            let miss = u32::try_from(request).unwrap() + 1;
            assert_eq!(watchdog.handle_timeout(at(1000 * request + 100)).0, Verdict::Missed(miss));
        }
        assert!(watchdog.has_failed());
        assert!(watchdog.handle_timeout(at(3000)).1.is_some());
        assert_eq!(answer(&mut watchdog, "512#7D"), Verdict::Alive);
        assert!(!watchdog.has_failed());
    }

    #[test]
    fn r_esd_087_a_wrong_toggle_bit_does_not_change_the_expected_one() {
        let mut watchdog = watchdog(WatchdogMode::Remote);
        request(&mut watchdog, 0);
        answer(&mut watchdog, "512#7D");
        for millis in [1000, 2000, 3000] {
            request(&mut watchdog, millis);
            assert_eq!(answer(&mut watchdog, "512#7D"), Verdict::ToggleError);
        }
        assert!(watchdog.has_failed());
        request(&mut watchdog, 4000);
        assert_eq!(answer(&mut watchdog, "512#FD"), Verdict::Alive);
    }

    #[test]
    fn a_request_that_did_not_leave_is_no_miss_and_is_sent_again_soon() {
        let mut watchdog = watchdog(WatchdogMode::Remote);
        request(&mut watchdog, 0);
        assert!(watchdog.handle_not_sent(at(1), &"512#R1".parse().unwrap()));
        assert!(!watchdog.handle_not_sent(at(1), &"512#R1".parse().unwrap()));
        assert_eq!(watchdog.poll_timeout(), Some((at(251), "watchdog request")));
        assert_eq!(watchdog.handle_timeout(at(251)).0, Verdict::Nothing);
    }

    #[test]
    fn answers_to_somebody_else_move_the_toggle_bit_on_and_are_no_error() {
        let mut watchdog = watchdog(WatchdogMode::Remote);
        request(&mut watchdog, 0);
        answer(&mut watchdog, "512#7D");
        assert_eq!(answer(&mut watchdog, "512#FD"), Verdict::Alive);
        request(&mut watchdog, 1000);
        assert_eq!(answer(&mut watchdog, "512#7D"), Verdict::Alive);
        assert_eq!(answer(&mut watchdog, "512#7D00"), Verdict::Nothing, "a wrong length");
        assert_eq!(answer(&mut watchdog, "512#R1"), Verdict::Nothing, "another master's request");
    }

    #[test]
    fn a_request_that_was_slept_through_is_not_made_up_for() {
        let mut watchdog = watchdog(WatchdogMode::Remote);
        request(&mut watchdog, 0);
        answer(&mut watchdog, "512#7D");
        request(&mut watchdog, 7500);
        answer(&mut watchdog, "512#FD");
        assert_eq!(watchdog.poll_timeout(), Some((at(8500), "watchdog request")));
    }
}
