//! Who is on a bus, from frames overheard. Pure, and it sends nothing.
//!
//! [`Census`] takes frames and keeps, for each node id of the predefined connection set (CiA 301, 7.3.5), what was seen of
//! it, and beside the nodes what belongs to none. It believes the identifiers: a device whose identifiers were moved, or
//! that is no CANopen device at all, shows up under the node id that they stand for by default.
//!
//! CAN does not tell who sent a frame. That two devices share a node id is therefore a suspicion
//! ([`NodeRecord::suspicions`]), never a proof; and a request may be of any other participant.
//!
//! Bounded: 127 nodes, [`MOST_KINDS`] kinds of anything that can be many; what is more is only counted.

use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;

use super::duplicate::{Answers, Extra};
use super::{NmtRequest, NmtState, NodeId};
use crate::can::{CanFrame, CanId};
use crate::time::Instant;

/// How many different unknown identifiers, NMT commands, EMCY codes of a node are told apart.
pub const MOST_KINDS: usize = 256;
/// TPDOs that surround a boot-up message by no more than this go on, rather than stop and start again.
const GOES_ON: Duration = Duration::from_secs(1);
/// A state frame later than this after a guard request is no answer to it.
const ANSWERS_WITHIN: Duration = Duration::from_millis(500);
/// A state frame so soon after the answer to a guard request is a second answer.
const ANSWERS_AGAIN_WITHIN: Duration = Duration::from_millis(50);
/// SDO answers too many that are no chance; one that says something else counts twice.
const EXTRA_ANSWERS: u8 = 2;
/// LSS slave to master, master to slave (CiA 305).
const LSS: [u16; 2] = [0x7E4, 0x7E5];

/// Frames of one kind.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Traffic {
    /// How many.
    pub count: u64,
    /// Their DLCs.
    pub dlcs: BTreeSet<u8>,
    first: Instant,
    last: Instant,
}

impl Traffic {
    fn add(&mut self, now: Instant, dlc: u8) {
        if self.count == 0 {
            self.first = now;
        }
        self.last = now;
        self.count = self.count.saturating_add(1);
        self.dlcs.insert(dlc);
    }

    /// Mean time between two frames; `None` before the second.
    #[must_use]
    pub fn period(&self) -> Option<Duration> {
        let gaps = u32::try_from(self.count.checked_sub(1)?).ok()?;
        self.last.since(self.first).checked_div(gaps)
    }
}

/// How a node's state becomes known.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Reports {
    /// It tells by itself: a heartbeat producer.
    Heartbeat,
    /// It answers guard requests.
    Guarding,
}

/// Why two devices may share a node id.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Suspicion {
    /// One TPDO identifier carries frames of different lengths.
    DifferentLengths,
    /// A boot-up message while TPDOs go on, which no start command explains.
    BootUpWhileRunning,
    /// A guard request, or SDO requests, were answered twice.
    AnsweredTwice,
}

impl Suspicion {
    /// What was seen, for people.
    #[must_use]
    pub const fn text(self) -> &'static str {
        match self {
            Self::DifferentLengths => "frames of different lengths on one TPDO identifier",
            Self::BootUpWhileRunning => "a boot-up message while TPDOs went on",
            Self::AnsweredTwice => "requests were answered twice",
        }
    }
}

/// What was seen of one node id.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct NodeRecord {
    /// Boot-up messages.
    pub boot_ups: u64,
    /// The state that it told last.
    pub state: Option<NmtState>,
    /// How it tells its state; boot-up messages alone say nothing of that.
    pub reports: Option<Reports>,
    /// Heartbeats, or answers to guard requests.
    pub states: Traffic,
    /// Guard requests of somebody else.
    pub guard_requests: Traffic,
    /// TPDO1 to TPDO4 of the predefined connection set.
    pub tpdos: [Traffic; 4],
    /// RPDO1 to RPDO4: frames that somebody sends to the node.
    pub rpdos: [Traffic; 4],
    /// EMCY error codes, and how often each came.
    pub emergencies: BTreeMap<u16, u64>,
    /// Error register of the last EMCY.
    pub error_register: Option<u8>,
    /// SDO requests to it.
    pub sdo_requests: u64,
    /// SDO answers of it.
    pub sdo_answers: u64,
    /// Why two devices may share the id.
    pub suspicions: BTreeSet<Suspicion>,
    asked: Option<Instant>,
    answered: Option<Instant>,
    answers: Answers,
    extra_answers: u8,
    first_tpdo: Option<Instant>,
    last_tpdo: Option<Instant>,
    booted_while_running: Option<Instant>,
}

impl NodeRecord {
    /// Whether the node itself was heard: otherwise frames were only sent to it.
    #[must_use]
    pub fn is_heard(&self) -> bool {
        self.boot_ups > 0
            || self.states.count > 0
            || self.sdo_answers > 0
            || !self.emergencies.is_empty()
            || self.tpdos.iter().any(|tpdo| tpdo.count > 0)
    }

    /// Whether there was any frame of it, or to it, but for ours.
    #[must_use]
    pub fn is_seen(&self) -> bool {
        self.is_heard()
            || self.guard_requests.count > 0
            || self.sdo_requests > 0
            || self.rpdos.iter().any(|rpdo| rpdo.count > 0)
    }

    /// The TPDOs that were seen: number 1..=4, traffic.
    pub fn seen_tpdos(&self) -> impl Iterator<Item = (u16, &Traffic)> {
        (1..).zip(&self.tpdos).filter(|(_, tpdo)| tpdo.count > 0)
    }

    /// From its first TPDO to its last.
    #[must_use]
    pub fn listened(&self) -> Duration {
        let span = self.first_tpdo.zip(self.last_tpdo);
        span.map_or(Duration::ZERO, |(first, last)| last.since(first))
    }

    fn handle_sdo_answer(&mut self, now: Instant, frame: &CanFrame) {
        self.sdo_answers = self.sdo_answers.saturating_add(1);
        let weight = match self.answers.handle_answer(now, frame).0 {
            None => return,
            Some(Extra::Same) => 1,
            Some(Extra::Different) => 2,
        };
        self.extra_answers = self.extra_answers.saturating_add(weight);
        if self.extra_answers >= EXTRA_ANSWERS {
            self.suspicions.insert(Suspicion::AnsweredTwice);
        }
    }

    fn handle_tpdo(&mut self, now: Instant, tpdo: usize, dlc: u8) {
        self.first_tpdo.get_or_insert(now);
        self.last_tpdo = Some(now);
        if self.booted_while_running.take().is_some_and(|boot_up| now.since(boot_up) <= GOES_ON) {
            self.suspicions.insert(Suspicion::BootUpWhileRunning);
        }
        let Some(traffic) = self.tpdos.get_mut(tpdo) else { return };
        traffic.add(now, dlc);
        if traffic.dlcs.len() > 1 {
            self.suspicions.insert(Suspicion::DifferentLengths);
        }
    }

    /// A data frame on `0x700 + id`.
    fn handle_state(&mut self, now: Instant, byte: u8, dlc: u8) {
        let asked = self.asked.take().is_some_and(|asked| now.since(asked) <= ANSWERS_WITHIN);
        let Some(state) = NmtState::from_code(byte & 0x7F) else { return };
        self.state = Some(state);
        if byte == 0 && !asked {
            self.boot_ups = self.boot_ups.saturating_add(1);
            let running = self.last_tpdo.is_some_and(|last| now.since(last) <= GOES_ON);
            self.booted_while_running = running.then_some(now);
            return;
        }
        self.states.add(now, dlc);
        let again = self.answered.is_some_and(|answered| now.since(answered) <= ANSWERS_AGAIN_WITHIN);
        self.answered = asked.then_some(now);
        if again && !asked {
            self.suspicions.insert(Suspicion::AnsweredTwice);
            return;
        }
        // A guarded node never tells by itself, so one unasked state settles it.
        if !asked {
            self.reports = Some(Reports::Heartbeat);
        } else if self.reports.is_none() {
            self.reports = Some(Reports::Guarding);
        }
    }

    fn handle_emergency(&mut self, data: &[u8]) {
        match *data {
            // What devices before version 4 of the standard send as boot-up message.
            [] => self.boot_ups = self.boot_ups.saturating_add(1),
            [low, high, register, ..] => {
                let code = u16::from_le_bytes([low, high]);
                self.error_register = Some(register);
                count(&mut self.emergencies, code);
            }
            _ => {}
        }
    }
}

/// Counts one more of a kind, of at most [`MOST_KINDS`]. Whether it was counted.
fn count<K: Ord>(kinds: &mut BTreeMap<K, u64>, kind: K) -> bool {
    if kinds.len() >= MOST_KINDS && !kinds.contains_key(&kind) {
        return false;
    }
    let counter = kinds.entry(kind).or_default();
    *counter = counter.saturating_add(1);
    true
}

/// What is on a bus.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Census {
    /// By node id: everybody whose identifiers were seen, those included to whom somebody only talked.
    pub nodes: BTreeMap<NodeId, NodeRecord>,
    /// NMT commands of somebody else, by command byte and node id byte (0 = all), and how often each came.
    pub nmt: BTreeMap<(u8, u8), u64>,
    /// SYNC; its producer cannot be told.
    pub sync: Traffic,
    /// TIME.
    pub time: Traffic,
    /// Frames of an LSS master or slave.
    pub lss: u64,
    /// Identifiers that stand for nothing in the predefined connection set, and those of 29 bit.
    pub unknown: BTreeMap<CanId, Traffic>,
    /// Frames of identifiers that found no place in [`unknown`](Self::unknown).
    pub unknown_more: u64,
    /// All frames.
    pub frames: u64,
}

impl Census {
    /// Takes a frame of another participant.
    pub fn handle_frame(&mut self, now: Instant, frame: &CanFrame) {
        self.frames = self.frames.saturating_add(1);
        let dlc = frame.dlc();
        let CanId::Standard(id) = frame.id() else {
            self.handle_unknown(now, frame);
            return;
        };
        match (id, frame.is_remote()) {
            (0x000, false) => self.handle_nmt(frame),
            (0x080, false) => self.sync.add(now, dlc),
            (0x100, false) => self.time.add(now, dlc),
            (id, false) if LSS.contains(&id) => self.lss = self.lss.saturating_add(1),
            (id, remote) => {
                let node = u8::try_from(id & 0x7F).ok().and_then(NodeId::new);
                // 0x100 + 1.. is nobody's, and 0x780.. holds the identifiers of LSS.
                let service = id >> 7;
                match node.filter(|_| is_of_a_node(service, remote)) {
                    Some(node) => self.nodes.entry(node).or_default().handle(now, service, frame),
                    None => self.handle_unknown(now, frame),
                }
            }
        }
    }

    /// Takes a frame that we sent ourselves, so that the answer to a guard or SDO request is known as one.
    pub fn handle_sent(&mut self, now: Instant, frame: &CanFrame) {
        let CanId::Standard(id) = frame.id() else { return };
        let Some(node) = u8::try_from(id & 0x7F).ok().and_then(NodeId::new) else { return };
        match (id >> 7, frame.is_remote()) {
            (0xE, true) => self.nodes.entry(node).or_default().asked = Some(now),
            (0xC, false) => {
                self.nodes.entry(node).or_default().answers.handle_request(now, frame);
            }
            _ => {}
        }
    }

    /// Whether somebody else behaves as an NMT master: commands nodes or guards them.
    #[must_use]
    pub fn has_master(&self) -> bool {
        !self.nmt.is_empty() || self.nodes.values().any(|node| node.guard_requests.count > 0)
    }

    fn handle_nmt(&mut self, frame: &CanFrame) {
        let &[command, node] = frame.data() else { return };
        count(&mut self.nmt, (command, node));
        if NmtRequest::from_code(command) == Some(NmtRequest::Start) {
            for (id, record) in &mut self.nodes {
                if node == 0 || node == id.get() {
                    record.booted_while_running = None;
                }
            }
        }
    }

    fn handle_unknown(&mut self, now: Instant, frame: &CanFrame) {
        let full = self.unknown.len() >= MOST_KINDS;
        match self.unknown.get_mut(&frame.id()) {
            Some(traffic) => traffic.add(now, frame.dlc()),
            None if full => self.unknown_more = self.unknown_more.saturating_add(1),
            None => self.unknown.entry(frame.id()).or_default().add(now, frame.dlc()),
        }
    }
}

/// Whether bits 10..7 of an identifier stand for a service of a node; of remote frames only guarding does here.
fn is_of_a_node(service: u16, remote: bool) -> bool {
    if remote { service == 0xE } else { matches!(service, 0x1 | 0x3..=0xA | 0xB | 0xC | 0xE) }
}

impl NodeRecord {
    fn handle(&mut self, now: Instant, service: u16, frame: &CanFrame) {
        let dlc = frame.dlc();
        match service {
            0x1 => self.handle_emergency(frame.data()),
            // TPDO1 0x180, RPDO1 0x200, TPDO2 0x280 and so on.
            0x3..=0xA => {
                let place = usize::from((service - 3) / 2);
                if service % 2 == 1 {
                    self.handle_tpdo(now, place, dlc);
                } else if let Some(traffic) = self.rpdos.get_mut(place) {
                    traffic.add(now, dlc);
                }
            }
            0xB => self.handle_sdo_answer(now, frame),
            0xC => {
                self.sdo_requests = self.sdo_requests.saturating_add(1);
                self.answers.handle_request(now, frame);
            }
            _ if frame.is_remote() => {
                self.guard_requests.add(now, dlc);
                self.asked = Some(now);
            }
            _ => {
                if let Some(byte) = frame.data().first() {
                    self.handle_state(now, *byte, dlc);
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Frames with their times in ms.
    fn census(frames: &[(u64, &str)]) -> Census {
        let mut census = Census::default();
        for (at, frame) in frames {
            census.handle_frame(Instant::from_millis(*at), &frame.parse().unwrap());
        }
        census
    }

    fn node(census: &Census, id: u8) -> &NodeRecord {
        &census.nodes[&NodeId::new(id).unwrap()]
    }

    #[test]
    fn v_det_02_a_node_that_another_master_guards_and_starts() {
        let census = census(&[
            (0, "701#00"),
            (100, "701#R1"),
            (101, "701#7F"),
            (102, "000#0101"),
            (600, "701#R1"),
            (601, "701#85"),
            (1100, "701#R1"),
            (1101, "701#05"),
        ]);
        let one = node(&census, 1);
        assert_eq!((one.boot_ups, one.state), (1, Some(NmtState::Operational)));
        assert_eq!(one.reports, Some(Reports::Guarding));
        assert_eq!(one.guard_requests.period(), Some(Duration::from_millis(500)));
        assert_eq!(census.nmt, BTreeMap::from([((1, 1), 1)]));
        assert!(census.has_master());
        assert!(one.suspicions.is_empty());
    }

    #[test]
    fn r_dst_060_a_heartbeat_is_told_from_guarding_and_has_a_period() {
        let census = census(&[(0, "705#00"), (500, "705#7F"), (1000, "705#7F"), (1500, "705#05")]);
        let five = node(&census, 5);
        assert_eq!((five.boot_ups, five.reports), (1, Some(Reports::Heartbeat)));
        assert_eq!(five.states.period(), Some(Duration::from_millis(500)));
        assert!(!census.has_master());
    }

    #[test]
    fn the_answer_to_a_guard_request_of_ours_is_no_heartbeat_and_makes_nobody_a_master() {
        let mut census = Census::default();
        census.handle_sent(Instant::from_millis(0), &"701#R1".parse().unwrap());
        census.handle_frame(Instant::from_millis(2), &"701#7F".parse().unwrap());
        assert_eq!(node(&census, 1).reports, Some(Reports::Guarding));
        assert!(!census.has_master());
    }

    #[test]
    fn tpdos_have_a_number_a_length_and_a_period() {
        let frames: Vec<(u64, &str)> = (0..5)
            .flat_map(|n| {
                [
                    (n * 500, "181#00FF80017FFE3340"),
                    (n * 500 + 3, "481#0019FF800301"),
                    (n * 500 + 5, "382#0000000000"),
                ]
            })
            .collect();
        let census = census(&frames);
        let seen: Vec<(u16, u64, Vec<u8>)> = node(&census, 1)
            .seen_tpdos()
            .map(|(number, tpdo)| (number, tpdo.count, tpdo.dlcs.iter().copied().collect()))
            .collect();
        assert_eq!(seen, [(1, 5, vec![8]), (4, 5, vec![6])]);
        assert_eq!(node(&census, 2).tpdos[2].period(), Some(Duration::from_millis(500)));
    }

    #[test]
    fn a_dst_and_a_detcon_of_the_same_node_id_are_suspected() {
        let census = census(&[(0, "181#00FF80017FFE3340"), (7, "181#1027000000")]);
        assert_eq!(node(&census, 1).suspicions, BTreeSet::from([Suspicion::DifferentLengths]));
    }

    #[test]
    fn a_boot_up_message_while_tpdos_go_on_is_suspicious_unless_a_start_explains_it() {
        let tpdo = "181#0000000000000000";
        let shared = census(&[(0, tpdo), (400, "701#00"), (500, tpdo)]);
        assert_eq!(node(&shared, 1).suspicions, BTreeSet::from([Suspicion::BootUpWhileRunning]));
        for start in ["000#0101", "000#0100"] {
            let restarted = census(&[(0, tpdo), (400, "701#00"), (410, start), (500, tpdo)]);
            assert!(node(&restarted, 1).suspicions.is_empty(), "{start}");
        }
        let slow = census(&[(0, tpdo), (400, "701#00"), (5000, tpdo)]);
        assert!(node(&slow, 1).suspicions.is_empty());
    }

    #[test]
    fn r_dst_074_emergencies_are_kept_by_code() {
        let census =
            census(&[(0, "081#11F0210000000000"), (5, "081#11F0210000000000"), (9, "081#0000000000000000")]);
        assert_eq!(node(&census, 1).emergencies, BTreeMap::from([(0xF011, 2), (0, 1)]));
        assert_eq!(node(&census, 1).error_register, Some(0));
    }

    #[test]
    fn what_belongs_to_no_node_is_kept_apart() {
        let census = census(&[
            (0, "080#"),
            (10, "080#"),
            (11, "100#000000000000"),
            (12, "7E5#0401000000000000"),
            (13, "00000181#0102"),
            (14, "101#00"),
            (15, "77F#00"),
            (16, "780#00"),
            (17, "700#00"),
            (18, "181#R8"),
        ]);
        assert_eq!(census.sync.period(), Some(Duration::from_millis(10)));
        assert_eq!((census.time.count, census.lss, census.frames), (1, 1, 10));
        let unknown: Vec<String> = census.unknown.keys().map(ToString::to_string).collect();
        assert_eq!(unknown, ["101", "181", "700", "780", "00000181"]);
        assert_eq!(census.nodes.keys().map(|id| id.get()).collect::<Vec<_>>(), [127]);
    }

    #[test]
    fn a_node_to_which_somebody_only_talks_was_not_heard() {
        let census =
            census(&[(0, "601#4000100000000000"), (5, "702#R1"), (6, "203#00"), (7, "584#4300100094010200")]);
        let heard: Vec<u8> =
            census.nodes.iter().filter(|(_, node)| node.is_heard()).map(|(id, _)| id.get()).collect();
        assert_eq!(heard, [4]);
    }

    #[test]
    fn answers_too_many_are_suspicious_and_a_second_guard_reply_is_no_heartbeat() {
        let two = census(&[(0, "701#R1"), (1, "701#05"), (2, "701#85")]);
        let node_1 = node(&two, 1);
        assert_eq!(node_1.reports, Some(Reports::Guarding));
        assert!(node_1.suspicions.contains(&Suspicion::AnsweredTwice));
        let one = census(&[(0, "701#R1"), (1, "701#05"), (700, "701#R1"), (701, "701#85")]);
        assert!(node(&one, 1).suspicions.is_empty());

        let mut asked = Census::default();
        asked.handle_sent(Instant::START, &"602#4018100400000000".parse().unwrap());
        asked.handle_frame(Instant::from_millis(1), &"582#4318100440E20100".parse().unwrap());
        assert!(node(&asked, 2).suspicions.is_empty());
        asked.handle_frame(Instant::from_millis(2), &"582#4318100441E20100".parse().unwrap());
        assert!(node(&asked, 2).suspicions.contains(&Suspicion::AnsweredTwice));
    }

    #[test]
    fn no_flood_of_kinds_takes_memory_without_bound() {
        let mut census = Census::default();
        for id in 0..2000_u32 {
            let frame = CanFrame::data_frame(CanId::Extended(id), &[]).unwrap();
            census.handle_frame(Instant::START, &frame);
            let [low, high, ..] = id.to_le_bytes();
            let emergency = CanFrame::data_frame(CanId::Standard(0x81), &[low, high, 0]).unwrap();
            census.handle_frame(Instant::START, &emergency);
            let nmt = CanFrame::data_frame(CanId::Standard(0), &[low, high]).unwrap();
            census.handle_frame(Instant::START, &nmt);
        }
        assert_eq!((census.unknown.len(), census.unknown_more), (MOST_KINDS, 2000 - 256));
        assert_eq!((census.nmt.len(), node(&census, 1).emergencies.len()), (MOST_KINDS, MOST_KINDS));
    }
}
