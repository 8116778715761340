//! Asks who is there: the active half of a scan. Pure.
//!
//! [`Probe`] reads the device type 0x1000 of each node id by SDO; of those that answer also the identity 0x1018 and the
//! device name 0x1008, and how its first TPDO 0x1800:2 and its heartbeat 0x1017 are set; to those that do not, and of which no state is known, it sends one guard request, whose answer the
//! [`Census`](super::census::Census) takes. It never asks node id 0, and writes nothing.
//!
//! A bus at work must not notice: one frame at most every [`ProbeSettings::gap`], segments of longer answers included.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::time::Duration;

use super::cob_id;
use super::object::{DataType, ObjectId};
use super::sdo::{SdoClient, SdoError, SdoOutput, SdoRequest, SdoSettings, TransferId, answer_id};
use super::{NmtState, NodeId};
use crate::can::{CanFrame, CanId};
use crate::time::Instant;

/// Device type.
const DEVICE_TYPE: ObjectId = ObjectId::new(0x1000, 0);
/// What is read of a node that has answered.
const MORE: [ObjectId; 7] = [
    ObjectId::new(0x1018, 1),
    ObjectId::new(0x1018, 2),
    ObjectId::new(0x1018, 3),
    ObjectId::new(0x1018, 4),
    ObjectId::new(0x1008, 0),
    ObjectId::new(0x1800, 2),
    ObjectId::new(0x1017, 0),
];
/// Frames in a row that did not leave, after which nobody is there who would acknowledge.
const NOBODY: u32 = 10;
/// Answers that wait for their turn; nobody has more than one outstanding, so what is beyond was never asked for.
const HELD: usize = 256;
/// The longest device name that is read, in bytes.
const LONGEST_NAME: usize = 256;

/// How a probe behaves.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ProbeSettings {
    /// At least so much time between two frames.
    pub gap: Duration,
    /// How long an SDO answer may take.
    pub timeout: Duration,
    /// How long the answer to a guard request may take.
    pub guard_timeout: Duration,
}

impl Default for ProbeSettings {
    /// 20 frames a second at most.
    fn default() -> Self {
        Self {
            gap: Duration::from_millis(50),
            timeout: Duration::from_millis(500),
            guard_timeout: Duration::from_millis(200),
        }
    }
}

/// What a node said of itself; `None` where it has no such object.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Identity {
    /// Device type, 0x1000.
    pub device_type: Option<u32>,
    /// Vendor id, product code, revision number and serial number, 0x1018:1 to 4.
    pub identity: [Option<u32>; 4],
    /// Manufacturer device name, 0x1008; control characters as `\x1B`.
    pub name: Option<String>,
    /// Transmission type of TPDO1, 0x1800:2; up to 240 it follows SYNC.
    pub tpdo1_type: Option<u32>,
    /// Producer heartbeat time, 0x1017, in ms; 0 = no heartbeat.
    pub heartbeat: Option<u32>,
}

/// What a probe wants done, or tells.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum ProbeOutput {
    /// Send this frame.
    Transmit(CanFrame),
    /// This node answered by SDO.
    Found(NodeId, Identity),
    /// Everybody was asked.
    Done {
        /// Frames that did not leave. When it was ended early, nobody acknowledges.
        not_sent: u32,
        /// Ended before everybody was asked, as frame after frame did not leave.
        nobody_acknowledges: bool,
    },
}

/// Asks node ids one after another.
#[derive(Debug)]
pub struct Probe {
    settings: ProbeSettings,
    /// Not asked yet.
    nodes: VecDeque<NodeId>,
    /// Asked for the device type, not answered yet.
    asked: BTreeMap<NodeId, SdoClient>,
    /// Have answered; more is to be read.
    answered: VecDeque<(NodeId, SdoClient, Identity)>,
    /// The one of which more is read, and how much of [`MORE`] is done.
    reading: Option<Reading>,
    /// To be guarded once.
    silent: VecDeque<NodeId>,
    /// Nodes whose state is known: no guard request.
    known: BTreeSet<NodeId>,
    /// Answers that wait until another frame may be sent.
    held: VecDeque<CanFrame>,
    /// Frames that wait until another may be sent: aborts of transfers that ended by their time limit.
    late: VecDeque<CanFrame>,
    /// The next frame may be sent then.
    open_at: Instant,
    /// The answer to the last guard request may come until then.
    guarded_until: Instant,
    not_sent: u32,
    not_sent_in_a_row: u32,
    ended: bool,
    outputs: VecDeque<ProbeOutput>,
}

#[derive(Debug)]
struct Reading {
    node: NodeId,
    client: SdoClient,
    identity: Identity,
    done: usize,
    /// The read under way.
    pending: bool,
}

impl Probe {
    /// Will ask these nodes; those in `known` get no guard request.
    #[must_use]
    pub fn new(
        now: Instant,
        nodes: impl IntoIterator<Item = NodeId>,
        known: BTreeSet<NodeId>,
        settings: ProbeSettings,
    ) -> Self {
        Self {
            settings,
            nodes: nodes.into_iter().collect(),
            asked: BTreeMap::new(),
            answered: VecDeque::new(),
            reading: None,
            silent: VecDeque::new(),
            known,
            held: VecDeque::new(),
            late: VecDeque::new(),
            open_at: now,
            guarded_until: now,
            not_sent: 0,
            not_sent_in_a_row: 0,
            ended: false,
            outputs: VecDeque::new(),
        }
    }

    /// Takes a frame of another participant.
    pub fn handle_frame(&mut self, now: Instant, frame: &CanFrame) {
        self.not_sent_in_a_row = 0;
        let CanId::Standard(id) = frame.id() else { return };
        let Some(node) = u8::try_from(id & 0x7F).ok().and_then(NodeId::new) else { return };
        if frame.id() == cob_id::error_control(node) && !frame.is_remote() {
            let state = frame.data().first().and_then(|byte| NmtState::from_code(byte & 0x7F));
            // A boot-up message tells that a node is there, and that it is about to change its state.
            if state.is_some_and(|state| state != NmtState::Initialising) {
                self.known.insert(node);
            }
        } else if frame.id() == answer_id(node) && self.held.len() < HELD {
            self.held.push_back(*frame);
        }
        self.advance(now);
    }

    /// A frame of ours did not leave.
    pub fn handle_not_sent(&mut self, now: Instant, frame: &CanFrame) {
        self.not_sent = self.not_sent.saturating_add(1);
        self.not_sent_in_a_row = self.not_sent_in_a_row.saturating_add(1);
        if let Some(reading) = &mut self.reading {
            reading.client.handle_not_sent(frame);
        }
        if self.not_sent_in_a_row >= NOBODY && !self.ended {
            self.end(true);
        }
        self.advance(now);
    }

    /// What became due.
    pub fn handle_timeout(&mut self, now: Instant) {
        self.advance(now);
    }

    /// What is to be done; call until `None` after each of the calls above, and at the beginning.
    pub fn poll_output(&mut self) -> Option<ProbeOutput> {
        self.outputs.pop_front()
    }

    /// When [`handle_timeout`](Self::handle_timeout) is to be called.
    #[must_use]
    pub fn poll_timeout(&self) -> Option<Instant> {
        if self.ended {
            return None;
        }
        let clients = self.asked.values().chain(self.reading.as_ref().map(|reading| &reading.client));
        let due = clients.filter_map(|client| client.poll_timeout().map(|(at, _)| at)).min();
        let turn = self.waits_for_turn().then_some(self.open_at);
        let end = self.is_over().then_some(self.guarded_until);
        [due, turn, end].into_iter().flatten().min()
    }

    fn waits_for_turn(&self) -> bool {
        let idle = self.reading.as_ref().is_none_or(|reading| !reading.pending);
        let to_read = idle && (!self.answered.is_empty() || self.reading.is_some());
        let frames = !self.held.is_empty() || !self.late.is_empty();
        frames || to_read || !self.nodes.is_empty() || !self.silent.is_empty()
    }

    /// Whether nothing is left but to wait for the last answers to guard requests.
    fn is_over(&self) -> bool {
        self.asked.is_empty() && self.reading.is_none() && !self.waits_for_turn()
    }

    fn advance(&mut self, now: Instant) {
        if self.ended {
            return;
        }
        self.expire(now);
        while self.open_at <= now && self.take_turn(now) {}
        if self.is_over() && self.guarded_until <= now {
            self.end(false);
        }
    }

    /// Nodes that did not answer in time.
    fn expire(&mut self, now: Instant) {
        for client in self.asked.values_mut() {
            client.handle_timeout(now);
        }
        if let Some(reading) = &mut self.reading {
            reading.client.handle_timeout(now);
        }
        self.take_results(now);
    }

    /// Uses the turn; `false` when there was nothing to do.
    fn take_turn(&mut self, now: Instant) -> bool {
        if let Some(frame) = self.late.pop_front() {
            self.transmit(now, frame);
        } else if let Some(frame) = self.held.pop_front() {
            let client = self.reading.as_mut().map(|reading| &mut reading.client);
            for client in self.asked.values_mut().chain(client) {
                client.handle_answer(now, &frame);
            }
        } else if let Some(node) = self.nodes.pop_front() {
            let mut client = SdoClient::new(node, self.sdo_settings());
            // A new client takes every request.
            let _ = client.request(now, TransferId(0), SdoRequest::read(DEVICE_TYPE).of_len(4));
            self.asked.insert(node, client);
        } else if !self.read_more(now) {
            let Some(node) = self.silent.pop_front() else { return false };
            if !self.known.contains(&node)
                && let Some(request) = CanFrame::remote_frame(cob_id::error_control(node), 1)
            {
                self.transmit(now, request);
                self.guarded_until = now + self.settings.guard_timeout;
            }
        }
        self.take_results(now);
        true
    }

    /// Begins the next read of a node that has answered.
    fn read_more(&mut self, now: Instant) -> bool {
        if self.reading.is_none()
            && let Some((node, client, identity)) = self.answered.pop_front()
        {
            self.reading = Some(Reading { node, client, identity, done: 0, pending: false });
        }
        let Some(reading) = self.reading.as_mut().filter(|reading| !reading.pending) else { return false };
        let Some(object) = MORE.get(reading.done) else { return false };
        let taken = reading.client.request(now, TransferId(0), SdoRequest::read(*object));
        reading.pending = taken.is_ok();
        taken.is_ok()
    }

    /// What the clients have to say.
    fn take_results(&mut self, now: Instant) {
        let mut frames = Vec::new();
        let mut over = Vec::new();
        for (node, client) in &mut self.asked {
            while let Some(output) = client.poll_output() {
                match output {
                    SdoOutput::Transmit(frame) => frames.push(frame),
                    SdoOutput::Done(_, result) => over.push((*node, result)),
                }
            }
        }
        for (node, result) in over {
            let Some(client) = self.asked.remove(&node) else { continue };
            if matches!(result, Err(SdoError::Timeout { .. } | SdoError::BusUnavailable)) {
                // There is nobody to abort with.
                frames.retain(|frame| frame.id() != super::sdo::request_id(node));
                self.silent.push_back(node);
            } else {
                let identity =
                    Identity { device_type: result.ok().as_deref().and_then(number), ..Identity::default() };
                self.answered.push_back((node, client, identity));
            }
        }
        while let Some(output) = self.reading.as_mut().and_then(|reading| reading.client.poll_output()) {
            match output {
                SdoOutput::Transmit(frame) => frames.push(frame),
                SdoOutput::Done(_, result) => self.handle_read(result),
            }
        }
        for frame in frames {
            self.transmit(now, frame);
        }
    }

    fn handle_read(&mut self, result: Result<Vec<u8>, SdoError>) {
        let Some(mut reading) = self.reading.take() else { return };
        reading.pending = false;
        let gone = matches!(result, Err(SdoError::Timeout { .. } | SdoError::BusUnavailable));
        if let Ok(bytes) = result {
            let identity = &mut reading.identity;
            match (reading.done, identity.identity.get_mut(reading.done)) {
                (_, Some(place)) => *place = number(&bytes),
                (4, None) => identity.name = DataType::VisibleString.decode(&bytes).ok(),
                (5, None) => identity.tpdo1_type = number(&bytes),
                (_, None) => identity.heartbeat = number(&bytes),
            }
        }
        reading.done += 1;
        if gone || reading.done >= MORE.len() {
            self.outputs.push_back(ProbeOutput::Found(reading.node, reading.identity));
        } else {
            self.reading = Some(reading);
        }
    }

    fn transmit(&mut self, now: Instant, frame: CanFrame) {
        if now < self.open_at {
            self.late.push_back(frame);
            return;
        }
        self.open_at = now + self.settings.gap;
        self.outputs.push_back(ProbeOutput::Transmit(frame));
    }

    fn end(&mut self, nobody_acknowledges: bool) {
        self.ended = true;
        self.outputs.push_back(ProbeOutput::Done { not_sent: self.not_sent, nobody_acknowledges });
    }

    fn sdo_settings(&self) -> SdoSettings {
        SdoSettings {
            timeout: self.settings.timeout,
            repeat: 0,
            longest: LONGEST_NAME,
            block: false,
            within: Duration::from_secs(10),
            ..SdoSettings::default()
        }
    }
}

/// A number of up to four bytes.
fn number(bytes: &[u8]) -> Option<u32> {
    (bytes.len() <= 4).then(|| bytes.iter().rev().fold(0, |value, byte| value << 8 | u32::from(*byte)))
}

#[cfg(test)]
#[path = "probe_tests.rs"]
mod tests;
