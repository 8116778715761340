//! Signs that two nodes share one id.
//!
//! CAN cannot tell who sent a frame, so there is never proof; three things a single node does not do are taken for
//! evidence. Whoever shares an id mixes up two machines' values, therefore suspicion is told early and kept for a while.

use std::time::Duration;

use super::{PdoIndex, PdoSettings};
use crate::time::Instant;

/// A suspicion ends after this long without new evidence.
const QUIET: Duration = Duration::from_secs(30);
/// TPDOs are counted over this long, or five of their periods.
const WINDOW: Duration = Duration::from_secs(2);
/// TPDOs that surround a boot-up message by no more than this go on, rather than stop and start again.
const GOES_ON: Duration = Duration::from_secs(1);
/// Requests in a row that must have been answered twice: one might be chance.
const ANSWERED_TWICE: u8 = 3;

/// The watch over one node id.
#[derive(Debug)]
pub(super) struct Duplicate {
    rates: Vec<Option<Rate>>,
    last_pdo: Option<Instant>,
    /// A boot-up message that came while TPDOs were flowing, before any start command.
    boot_up: Option<Instant>,
    /// Requests in a row that were answered twice.
    twice: u8,
    twice_since_reply: bool,
    /// When the suspicion ends.
    until: Option<Instant>,
}

/// Counts the frames of one TPDO.
#[derive(Debug)]
struct Rate {
    window: Duration,
    /// More than this in a window is too often: 1.5 times what the shortest period allows, and one for jitter.
    most: u64,
    since: Option<Instant>,
    count: u64,
}

impl Duplicate {
    /// Nothing suspicious yet.
    pub(super) fn new(pdos: &[PdoSettings]) -> Self {
        let rates = pdos.iter().map(|pdo| pdo.shortest_period.and_then(Rate::new)).collect();
        Self { rates, last_pdo: None, boot_up: None, twice: 0, twice_since_reply: false, until: None }
    }

    /// A TPDO came. The evidence is given when the suspicion begins.
    pub(super) fn handle_pdo(&mut self, now: Instant, index: PdoIndex) -> Option<&'static str> {
        self.last_pdo = Some(now);
        if self.boot_up.take().is_some_and(|boot_up| now.since(boot_up) <= GOES_ON) {
            return self.suspect(now, "a boot-up message while TPDOs go on");
        }
        let rate = self.rates.get_mut(index.0)?.as_mut()?;
        if rate.is_too_high(now) {
            self.suspect(now, "TPDOs come more often than one node sends them")
        } else {
            None
        }
    }

    /// A boot-up message. `self_starting`: the node needs no start command before its TPDOs, so that these prove nothing.
    pub(super) fn handle_boot_up(&mut self, now: Instant, self_starting: bool) {
        let flowing = self.last_pdo.is_some_and(|last| now.since(last) <= GOES_ON);
        self.boot_up = (flowing && !self_starting).then_some(now);
    }

    /// Somebody started the node: its TPDOs are no surprise.
    pub(super) fn handle_start(&mut self) {
        self.boot_up = None;
    }

    /// The first reply to a guard request.
    pub(super) fn handle_reply(&mut self) {
        if !std::mem::take(&mut self.twice_since_reply) {
            self.twice = 0;
        }
    }

    /// A second reply to the same guard request.
    pub(super) fn handle_second_reply(&mut self, now: Instant) -> Option<&'static str> {
        if !std::mem::replace(&mut self.twice_since_reply, true) {
            self.twice = self.twice.saturating_add(1);
        }
        if self.twice >= ANSWERED_TWICE {
            self.suspect(now, "guard requests are answered twice")
        } else {
            None
        }
    }

    /// `true`: the suspicion has ended.
    pub(super) fn handle_timeout(&mut self, now: Instant) -> bool {
        let over = self.until.is_some_and(|until| until <= now);
        if over {
            self.until = None;
        }
        over
    }

    /// When the suspicion ends.
    pub(super) fn poll_timeout(&self) -> Option<(Instant, &'static str)> {
        self.until.map(|until| (until, "duplicate node id"))
    }

    fn suspect(&mut self, now: Instant, evidence: &'static str) -> Option<&'static str> {
        self.until.replace(now + QUIET).is_none().then_some(evidence)
    }
}

impl Rate {
    /// `None` for a period of zero, against which no rate is too high.
    fn new(shortest_period: Duration) -> Option<Self> {
        let window = WINDOW.max(shortest_period.saturating_mul(5));
        let expected = window.as_micros().checked_div(shortest_period.as_micros())?;
        let most = u64::try_from(expected.saturating_mul(3) / 2 + 1).unwrap_or(u64::MAX);
        Some(Self { window, most, since: None, count: 0 })
    }

    fn is_too_high(&mut self, now: Instant) -> bool {
        match self.since {
            Some(since) if now.since(since) < self.window => self.count = self.count.saturating_add(1),
            Some(_) | None => {
                self.since = Some(now);
                self.count = 1;
            }
        }
        self.count > self.most
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::can::CanId;

    fn at(millis: u64) -> Instant {
        Instant::from_millis(millis)
    }

    fn watch() -> Duplicate {
        Duplicate::new(&[PdoSettings {
            number: 1,
            cob_id: CanId::Standard(0x181),
            length: 8,
            strict_length: false,
            timeout: None,
            synchronous: false,
            shortest_period: Some(Duration::from_millis(100)),
        }])
    }

    #[test]
    fn one_node_at_its_shortest_period_is_not_suspected_with_twenty_percent_jitter() {
        let mut watch = watch();
        for frame in 0_u64..10_000 {
            let jitter = if frame % 2 == 0 { 0 } else { 20 };
            assert_eq!(watch.handle_pdo(at(frame * 100 + jitter), PdoIndex(0)), None);
        }
    }

    #[test]
    fn two_nodes_at_the_shortest_period_are_suspected_within_five_seconds() {
        let mut watch = watch();
        for frame in 0_u64..100 {
            assert_eq!(watch.handle_pdo(at(frame * 100), PdoIndex(0)), None);
        }
        let found = (200_u64..300).find(|frame| watch.handle_pdo(at(frame * 50), PdoIndex(0)).is_some());
        assert!(found.is_some_and(|frame| frame * 50 < 15_000), "{found:?}");
    }

    #[test]
    fn a_suspicion_is_told_once_and_ends_after_thirty_quiet_seconds() {
        let mut watch = watch();
        let told =
            (0_u64..2000).filter(|frame| watch.handle_pdo(at(frame * 10), PdoIndex(0)).is_some()).count();
        assert_eq!(told, 1);
        let (end, _) = watch.poll_timeout().unwrap();
        assert!(end > at(49_000) && end < at(50_000), "{end:?}");
        assert!(watch.handle_timeout(end));
        assert_eq!(watch.poll_timeout(), None);
    }

    #[test]
    fn tpdos_that_go_on_over_a_boot_up_message_are_suspicious_unless_the_node_was_started() {
        let mut first = watch();
        first.handle_pdo(at(0), PdoIndex(0));
        first.handle_boot_up(at(200), false);
        assert!(first.handle_pdo(at(500), PdoIndex(0)).is_some());

        let mut started = watch();
        started.handle_pdo(at(0), PdoIndex(0));
        started.handle_boot_up(at(200), false);
        started.handle_start();
        assert_eq!(started.handle_pdo(at(500), PdoIndex(0)), None);

        let mut self_starting = watch();
        self_starting.handle_pdo(at(0), PdoIndex(0));
        self_starting.handle_boot_up(at(200), true);
        assert_eq!(self_starting.handle_pdo(at(500), PdoIndex(0)), None);

        let mut quiet_before = watch();
        quiet_before.handle_boot_up(at(5000), false);
        assert_eq!(quiet_before.handle_pdo(at(5100), PdoIndex(0)), None);
    }

    #[test]
    fn three_requests_in_a_row_answered_twice_are_suspicious() {
        let mut watch = watch();
        watch.handle_reply();
        assert_eq!(watch.handle_second_reply(at(1)), None);
        watch.handle_reply();
        watch.handle_reply();
        for request in 0..3 {
            watch.handle_reply();
            let evidence = watch.handle_second_reply(at(500 * request));
            assert_eq!(evidence.is_some(), request == 2, "request {request}");
        }
    }

    #[test]
    fn a_period_of_zero_is_never_exceeded() {
        assert!(Rate::new(Duration::ZERO).is_none());
    }
}
