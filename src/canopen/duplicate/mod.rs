//! Signs that two nodes share one id.
//!
//! CAN cannot tell who sent a frame, so there is never proof; things that a single node does not do are taken for evidence.
//! Whoever shares an id mixes up two machines' values, therefore suspicion is told early and kept for a while.
//!
//! - this file: the watch over one node id. `signs`: what is counted. `answers`: SDO answers that are one too many.

mod answers;
mod signs;

use std::time::Duration;

pub(super) use answers::{Answers, Extra, HeartbeatTime};
use signs::{Alternation, BootUps, Rate};

use super::{PdoIndex, PdoSettings};
use crate::can::CanFrame;
use crate::time::Instant;

/// A suspicion ends after this long without new evidence.
const QUIET: Duration = Duration::from_secs(30);
/// TPDOs that surround a boot-up message by no more than this go on, rather than stop and start again.
const GOES_ON: Duration = Duration::from_secs(1);
/// Requests in a row that must have been answered twice: one might be chance.
const ANSWERED_TWICE: u8 = 3;
/// Two lengths that take turns: there and back, and there again.
const LENGTH_CHANGES: u8 = 3;
/// Heartbeats and guard replies that take turns: there and back twice.
const KIND_CHANGES: u8 = 4;
/// SDO answers too many, none much later than the one before; one that says something else counts twice.
const EXTRA_ANSWERS: u8 = 3;
const EXTRA_WITHIN: Duration = Duration::from_secs(10);

/// The watch over one node id.
#[derive(Debug)]
pub(super) struct Duplicate {
    rates: Vec<Option<Rate>>,
    /// By TPDO: the lengths of its frames.
    lengths: Vec<Alternation<u8>>,
    /// By TPDO: two lengths have taken turns since the suspicion began.
    apart: Vec<bool>,
    /// Whether the node tells its state by itself or answers.
    kinds: Alternation<StateKind>,
    /// Heartbeats, where the node has told or was told how often it sends them.
    heartbeats: Option<Rate>,
    answers: Answers,
    /// SDO answers too many, and when the last came.
    extra: (u8, Instant),
    boot_ups: BootUps,
    last_pdo: Option<Instant>,
    /// A boot-up message that came while TPDOs were flowing, before any start command.
    boot_up: Option<Instant>,
    /// A boot-up message after which nobody has started the node, and before which no TPDO came.
    quiet_boot_up: bool,
    /// It sent TPDOs after such a message: it needs no start command.
    starts_itself: bool,
    /// The reply to the last guard request.
    reply: Option<u8>,
    /// Requests in a row that were answered twice.
    twice: u8,
    twice_since_reply: bool,
    /// When the suspicion ends.
    until: Option<Instant>,
    /// What has been told since it began.
    told: Vec<&'static str>,
}

/// How a state frame came about.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum StateKind {
    /// Nobody had asked, and its toggle bit is not set.
    Heartbeat,
    /// Somebody had asked, and its toggle bit is set: no heartbeat is like that (CiA 301).
    Reply,
}

impl Duplicate {
    /// Nothing suspicious yet.
    pub(super) fn new(pdos: &[PdoSettings]) -> Self {
        let rates = pdos.iter().map(|pdo| pdo.shortest_period.and_then(Rate::new)).collect();
        Self {
            rates,
            lengths: pdos.iter().map(|_| Alternation::default()).collect(),
            apart: vec![false; pdos.len()],
            kinds: Alternation::default(),
            heartbeats: None,
            answers: Answers::default(),
            extra: (0, Instant::START),
            boot_ups: BootUps::default(),
            last_pdo: None,
            boot_up: None,
            quiet_boot_up: false,
            starts_itself: false,
            reply: None,
            twice: 0,
            twice_since_reply: false,
            until: None,
            told: Vec::new(),
        }
    }

    /// A frame on the identifier of a TPDO came, of whatever length. The evidence is given when it is new.
    pub(super) fn handle_length(&mut self, now: Instant, index: PdoIndex, dlc: u8) -> Option<&'static str> {
        let changes = self.lengths.get_mut(index.0)?.add(now, dlc);
        if changes? < LENGTH_CHANGES {
            return None;
        }
        if let Some(apart) = self.apart.get_mut(index.0) {
            *apart = true;
        }
        self.suspect(now, "one TPDO comes with two lengths by turns")
    }

    /// Whether frames of this TPDO that have another length than they should are known to be another node's.
    pub(super) fn tells_apart(&self, index: PdoIndex) -> bool {
        self.apart.get(index.0).is_some_and(|apart| *apart)
    }

    /// A TPDO came. The evidence is given when it is new.
    pub(super) fn handle_pdo(&mut self, now: Instant, index: PdoIndex) -> Option<&'static str> {
        self.last_pdo = Some(now);
        self.starts_itself |= std::mem::take(&mut self.quiet_boot_up);
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
    /// After it the node is as it was stored: what was learned of its heartbeat and lengths is forgotten.
    pub(super) fn handle_boot_up(&mut self, now: Instant, self_starting: bool) {
        let flowing = self.last_pdo.is_some_and(|last| now.since(last) <= GOES_ON);
        self.boot_up = (flowing && !self_starting && !self.starts_itself).then_some(now);
        self.quiet_boot_up = !flowing;
        self.heartbeats = None;
        self.lengths.iter_mut().for_each(Alternation::interrupt);
        self.kinds.interrupt();
    }

    /// That boot-up message is one that nobody had asked for by guarding. `ordered`: by NMT reset.
    pub(super) fn count_boot_up(&mut self, now: Instant, ordered: bool) {
        self.boot_ups.add(now, ordered);
    }

    /// Somebody started the node: its TPDOs are no surprise.
    pub(super) fn handle_start(&mut self) {
        self.boot_up = None;
        self.quiet_boot_up = false;
    }

    /// The first reply to a guard request.
    pub(super) fn handle_reply(&mut self, byte: u8) {
        self.reply = Some(byte);
        if !std::mem::take(&mut self.twice_since_reply) {
            self.twice = 0;
        }
    }

    /// A second reply to the same guard request. One that differs from the first counts twice.
    pub(super) fn handle_second_reply(&mut self, now: Instant, byte: u8) -> Option<&'static str> {
        if !std::mem::replace(&mut self.twice_since_reply, true) {
            let weight = if self.reply.is_some_and(|first| first != byte) { 2 } else { 1 };
            self.twice = self.twice.saturating_add(weight);
        }
        if self.twice >= ANSWERED_TWICE {
            self.suspect(now, "guard requests are answered twice")
        } else {
            None
        }
    }

    /// A heartbeat, or the answer to a guard request. A node does not send both (CiA 301).
    pub(super) fn handle_state(&mut self, now: Instant, kind: StateKind) -> Option<&'static str> {
        let too_often = kind == StateKind::Heartbeat
            && self.heartbeats.as_mut().is_some_and(|heartbeats| heartbeats.is_too_high(now));
        let changes = self.kinds.add(now, kind);
        if changes.is_some_and(|changes| changes >= KIND_CHANGES) {
            self.suspect(now, "heartbeats and answers to guard requests come by turns")
        } else if too_often {
            self.suspect(now, "heartbeats come more often than one node sends them")
        } else {
            None
        }
    }

    /// An SDO request to the node, ours or anybody's.
    pub(super) fn handle_sdo_request(&mut self, now: Instant, frame: &CanFrame) {
        if let Some(millis) = self.answers.handle_request(now, frame) {
            self.heartbeats = Rate::new(millis);
        }
    }

    /// An SDO answer of the node.
    pub(super) fn handle_sdo_answer(&mut self, now: Instant, frame: &CanFrame) -> Option<&'static str> {
        let (extra, heartbeat) = self.answers.handle_answer(now, frame);
        match heartbeat {
            Some(HeartbeatTime::Told(time)) => self.heartbeats = Rate::new(time),
            Some(HeartbeatTime::Unknown) => self.heartbeats = None,
            None => {}
        }
        let weight = match extra? {
            Extra::Same => 1,
            Extra::Different => 2,
        };
        let (count, last) = self.extra;
        let before = if now.since(last) <= EXTRA_WITHIN { count } else { 0 };
        self.extra = (before.saturating_add(weight), now);
        if self.extra.0 >= EXTRA_ANSWERS {
            self.suspect(now, "SDO requests are answered twice")
        } else {
            None
        }
    }

    /// An emergency message by which the device itself says that somebody uses its identifiers.
    pub(super) fn handle_collision(&mut self, now: Instant) -> Option<&'static str> {
        self.suspect(now, "the device reports that its identifiers collide, EMCY 0x8150")
    }

    /// A TPDO in the node's name that the node does not have.
    pub(super) fn handle_strange_tpdo(&mut self, now: Instant) -> Option<&'static str> {
        self.suspect(now, "a TPDO comes that this device does not have")
    }

    /// What became due: new evidence, and whether the suspicion has ended.
    pub(super) fn handle_timeout(&mut self, now: Instant) -> (Option<&'static str>, bool) {
        let evidence = if self.boot_ups.handle_timeout(now) {
            self.suspect(now, "one start brings two boot-up messages")
        } else {
            None
        };
        let over = self.until.is_some_and(|until| until <= now);
        if over {
            self.until = None;
            self.told.clear();
            self.apart.fill(false);
        }
        (evidence, over)
    }

    /// When something becomes due.
    pub(super) fn poll_timeout(&self) -> Option<(Instant, &'static str)> {
        let end = self.until.into_iter().chain(self.boot_ups.poll_timeout()).min();
        end.map(|at| (at, "duplicate node id"))
    }

    fn suspect(&mut self, now: Instant, evidence: &'static str) -> Option<&'static str> {
        self.until = Some(now + QUIET);
        let new = !self.told.contains(&evidence);
        new.then(|| {
            self.told.push(evidence);
            evidence
        })
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
        assert_eq!(watch.handle_timeout(end), (None, true));
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
        watch.handle_reply(5);
        assert_eq!(watch.handle_second_reply(at(1), 5), None);
        watch.handle_reply(0x85);
        watch.handle_reply(5);
        for request in 0..3 {
            watch.handle_reply(5);
            let evidence = watch.handle_second_reply(at(500 * request), 5);
            assert_eq!(evidence.is_some(), request == 2, "request {request}");
        }
    }

    #[test]
    fn two_different_answers_to_each_of_two_requests_are_suspicious() {
        let mut watch = watch();
        watch.handle_reply(5);
        assert_eq!(watch.handle_second_reply(at(1), 0x7F), None, "one might be chance");
        watch.handle_reply(0x85);
        assert!(watch.handle_second_reply(at(501), 0x7F).is_some());
    }

    #[test]
    fn lengths_that_take_turns_tell_two_nodes_apart_until_the_suspicion_ends() {
        let mut watch = watch();
        let told: Vec<bool> = [8, 5, 8, 5]
            .into_iter()
            .zip(0..)
            .map(|(dlc, turn)| watch.handle_length(at(500 * turn), PdoIndex(0), dlc).is_some())
            .collect();
        assert_eq!(told, [false, false, false, true]);
        assert!(watch.tells_apart(PdoIndex(0)));
        assert!(watch.handle_pdo(at(1600), PdoIndex(0)).is_none());
        let (end, _) = watch.poll_timeout().unwrap();
        watch.handle_timeout(end);
        assert!(!watch.tells_apart(PdoIndex(0)));
    }

    #[test]
    fn a_node_that_starts_by_itself_is_known_from_its_first_boot_on() {
        let mut watch = watch();
        watch.handle_boot_up(at(0), false);
        watch.handle_pdo(at(1000), PdoIndex(0));
        watch.handle_boot_up(at(1500), false);
        assert_eq!(watch.handle_pdo(at(1700), PdoIndex(0)), None);
    }

    #[test]
    fn heartbeats_far_too_often_for_what_the_node_told_are_suspicious_and_so_are_both_kinds_of_error_control()
    {
        let mut watch = watch();
        watch.handle_sdo_answer(at(0), &"581#4B171000F4010000".parse().unwrap());
        let alone = (0..1000).filter_map(|beat| watch.handle_state(at(500 * beat), StateKind::Heartbeat));
        assert_eq!(alone.count(), 0);
        let both =
            (0..1000).find_map(|beat| watch.handle_state(at(500_000 + 250 * beat), StateKind::Heartbeat));
        assert!(both.is_some());

        let mut mixed = self::watch();
        for turn in 0..2 {
            assert_eq!(mixed.handle_state(at(500 * turn), StateKind::Heartbeat), None);
            assert_eq!(mixed.handle_state(at(500 * turn + 250), StateKind::Reply), None);
        }
        assert!(mixed.handle_state(at(1000), StateKind::Heartbeat).is_some());
    }

    #[test]
    fn sdo_requests_answered_twice_are_suspicious_sooner_where_the_answers_differ() {
        for (second, needed) in [("581#4300100094010200", 3), ("581#8000100000000206", 2)] {
            let mut watch = watch();
            let found = (1..10).find(|round| {
                let at = at(100 * round);
                watch.handle_sdo_request(at, &"601#4018100100000000".parse().unwrap());
                watch.handle_sdo_request(at, &"601#4000100000000000".parse().unwrap());
                watch.handle_sdo_answer(at, &"581#4300100094010200".parse().unwrap());
                watch.handle_sdo_answer(at, &second.parse().unwrap()).is_some()
            });
            assert_eq!(found, Some(needed), "{second}");
        }
    }
}
