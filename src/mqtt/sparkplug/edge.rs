//! The edge node of Sparkplug B: what is said when. Pure: told of the session, the image and the host; tells what to send.
//!
//! - Every session begins with NBIRTH and one DBIRTH for each node that is online; data follow when all births are out.
//! - A node that is lost dies by DDEATH and is born again when it is back.
//! - While nobody takes it (no session, or no primary host) each change is kept; it is sent as historical after the births, to
//!   what is alive.
//! - Everything has quality of service 0, so that nothing is acknowledged: what left the process counts as sent.

use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;
use std::time::Duration;

use prost::Message as _;

use super::catalogue::Catalogue;
use super::command::{self, Asked};
use super::history::{Batch, History};
use super::host::{PrimaryHost, Turn};
use super::messages;
use super::origin::{Origin, Told, is_online};
use super::payload::{self, Payload};
use super::settings::SparkplugSettings;
use super::topics::EdgeTopics;
use crate::mapping::{NodeDef, TagTable};
use crate::mqtt::outbox::MessageId;
use crate::mqtt::payload::Identity;
use crate::mqtt::publisher::LARGEST_MESSAGE;
use crate::process_image::{NodeIndex, ProcessImage, Revision};
use crate::time::{Instant, Now};

mod exchange;
mod telling;

/// Messages that are made and not taken: more are made when there is room; values that change meanwhile are told once.
const MOST_QUEUED: usize = 32;
/// Historical values in one message.
const HISTORY_BATCH: usize = 250;
/// Time between two messages of historical values: 5,000 values a second.
const HISTORY_PACE: Duration = Duration::from_millis(50);
/// Largest payload in bytes; the session takes twice the size of an ordinary message.
const LARGEST_PAYLOAD: usize = 2 * LARGEST_MESSAGE - 1024;

/// A message for the broker.
#[derive(Clone, Debug, PartialEq)]
pub struct Packet {
    /// For [`EdgeNode::handle_sent`].
    pub id: MessageId,
    /// Where to.
    pub topic: Arc<str>,
    /// A payload of Sparkplug B.
    pub payload: Vec<u8>,
    /// Quality of service 1, else 0. Never retained.
    pub at_least_once: bool,
}

/// Counters since the start.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct SparkplugReport {
    /// NBIRTH messages.
    pub births: u64,
    /// Of those: because a host asked.
    pub rebirths: u64,
    /// Messages of data, NDATA and DDATA.
    pub data: u64,
    /// Values that are kept.
    pub held: u64,
    /// Values that were sent as historical.
    pub historical: u64,
    /// Values that left because there was no room.
    pub dropped: u64,
    /// Commands that were not carried out.
    pub ignored: u64,
    /// Messages that were larger than a session takes: devices that cannot be born.
    pub too_large: u64,
}

/// How far the session is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Phase {
    /// No session.
    Down,
    /// The primary host is not online.
    Waiting,
    /// The birth of this origin is next.
    Births(usize),
    Live,
    /// NDEATH is said: the session is to end.
    Dead,
}

/// The edge node.
#[derive(Debug)]
pub struct EdgeNode {
    table: Arc<TagTable>,
    catalogue: Catalogue,
    topics: EdgeTopics,
    host: Option<PrimaryHost>,
    phase: Phase,
    /// Of the present session, and of the one to come.
    bd_seq: (u8, u8),
    /// Of the next message.
    seq: u8,
    origins: Vec<Origin>,
    told: Vec<Option<Told>>,
    seen: Option<Revision>,
    /// Something found no room in the queue.
    more: bool,
    queue: VecDeque<(Packet, Option<Batch>)>,
    history: History,
    next_history: Instant,
    /// Values that are handed over and have not left.
    under_way: BTreeMap<MessageId, Batch>,
    next_id: u64,
    /// NDEATH, once it is said.
    farewell: Option<MessageId>,
    farewell_sent: bool,
    report: SparkplugReport,
}

impl EdgeNode {
    /// An edge node that has said nothing yet.
    #[must_use]
    pub fn new(table: Arc<TagTable>, settings: &SparkplugSettings, identity: &Identity) -> Self {
        let catalogue = Catalogue::new(&table, identity);
        Self {
            topics: EdgeTopics::new(settings, &table),
            host: settings.primary_host.as_deref().map(PrimaryHost::new),
            phase: Phase::Down,
            bd_seq: (0, 0),
            seq: 0,
            origins: vec![Origin::default(); catalogue.origins()],
            told: vec![None; catalogue.len()],
            seen: None,
            more: false,
            queue: VecDeque::new(),
            history: History::new(settings.history_values, catalogue.origins()),
            next_history: Instant::START,
            under_way: BTreeMap::new(),
            next_id: 0,
            farewell: None,
            farewell_sent: false,
            report: SparkplugReport::default(),
            catalogue,
            table,
        }
    }

    /// The commands that are to be subscribed in each session, before anything is sent.
    #[must_use]
    pub fn command_subscriptions(&self) -> Vec<String> {
        vec![self.topics.ncmd.clone(), self.topics.dcmd_filter()]
    }

    /// The STATE of the primary host, where there is one: likewise, and whatever becomes of commands, since nothing is born
    /// without it.
    #[must_use]
    pub fn host_subscription(&self) -> Vec<String> {
        self.host.iter().map(|host| host.topic().to_owned()).collect()
    }

    /// A session is to be opened: topic and payload of its last will. Each call counts the birth-death sequence number up
    /// (tck-id-message-flow-edge-node-birth-publish-will-message-payload-bdSeq).
    pub fn begin_session(&mut self, now: Now) -> (String, Vec<u8>) {
        let (_, next) = self.bd_seq;
        self.bd_seq = (next, next.wrapping_add(1));
        (self.topics.ndeath.to_string(), messages::death(now, self.bd_seq.0).encode_to_vec())
    }

    /// A session with the broker began.
    pub fn handle_session_up(&mut self) {
        self.farewell = None;
        self.farewell_sent = false;
        self.phase = match &mut self.host {
            Some(host) => {
                host.handle_session_up();
                Phase::Waiting
            }
            None => Phase::Births(0),
        };
        self.forget_births();
        self.origins.iter_mut().for_each(|origin| origin.refused = false);
    }

    /// The session ended: what has not left is kept or made anew.
    pub fn handle_session_down(&mut self) {
        self.phase = Phase::Down;
        self.forget_births();
        for batch in std::mem::take(&mut self.under_way).into_values() {
            self.history.put_back(batch);
        }
    }

    /// A message has left.
    pub fn handle_sent(&mut self, id: MessageId) {
        if let Some(batch) = self.under_way.remove(&id) {
            let sent = u64::try_from(batch.values.len()).unwrap_or(u64::MAX);
            if batch.historical {
                self.report.historical = self.report.historical.saturating_add(sent);
            }
        }
        self.farewell_sent |= self.farewell == Some(id);
    }

    /// A message of a subscribed topic came; nothing in it can do harm. What it asks of the gateway is the caller's to do.
    pub fn handle_message(&mut self, now: Now, topic: &str, payload: &[u8], retained: bool) -> Asked {
        if let Some(host) = self.host.as_mut().filter(|host| host.topic() == topic) {
            match host.handle_state(payload) {
                Turn::Came if self.phase == Phase::Waiting => self.phase = Phase::Births(0),
                Turn::Left if matches!(self.phase, Phase::Births(_) | Phase::Live) => self.say_farewell(now),
                Turn::Came | Turn::Left | Turn::None => {}
            }
            return Asked::Nothing;
        }
        let asked = self.handle_command(topic, payload, retained);
        if matches!(asked, Asked::Refused(_)) {
            count(&mut self.report.ignored);
        }
        asked
    }

    fn handle_command(&mut self, topic: &str, payload: &[u8], retained: bool) -> Asked {
        if retained {
            return Asked::Refused("what the broker had kept was meant for another time".to_owned());
        }
        if let Some(device) = self.topics.commanded(topic) {
            let Some(NodeIndex(node)) = self.table.find_node(device) else {
                return Asked::Refused("there is no such device".to_owned());
            };
            let writes = command::writes(&self.catalogue, node + 1, payload);
            return writes.map_or_else(Asked::Refused, Asked::Write);
        }
        if topic != self.topics.ncmd || !payload::asks_for_rebirth(payload) {
            return Asked::Refused("only a rebirth can be asked of the edge node".to_owned());
        }
        // A request before the births are out is answered by them.
        if self.phase == Phase::Live {
            count(&mut self.report.rebirths);
            self.phase = Phase::Births(0);
            self.forget_births();
        }
        Asked::Nothing
    }

    /// The image as it stands. To be called when it changed and when [`poll_timeout`](Self::poll_timeout) is due.
    pub fn handle_image(&mut self, now: Now, image: &ProcessImage) {
        while let Phase::Births(origin) = self.phase {
            if self.queue.len() >= MOST_QUEUED {
                return;
            }
            if origin == 0 || is_online(origin, image) {
                self.give_birth(origin, now, image);
            }
            let next = origin + 1;
            self.phase = if next < self.origins.len() { Phase::Births(next) } else { Phase::Live };
        }
        if self.seen != Some(image.revision) {
            (0..self.origins.len()).for_each(|origin| self.note_changes(origin, image));
            self.seen = Some(image.revision);
        }
        self.more = false;
        for origin in 0..self.origins.len() {
            self.more |= !self.tell(origin, now, image);
        }
        self.send_history(now);
    }

    /// The gateway stops in good order: NDEATH is the last message of the session
    /// (tck-id-operational-behavior-edge-node-intentional-disconnect-ndeath).
    pub fn handle_stop(&mut self, now: Now) {
        if !matches!(self.phase, Phase::Down | Phase::Dead) {
            self.say_farewell(now);
        }
    }

    /// The next message to send; call until `None`.
    pub fn poll_output(&mut self) -> Option<Packet> {
        let (packet, batch) = self.queue.pop_front()?;
        if let Some(batch) = batch {
            self.under_way.insert(packet.id, batch);
        }
        Some(packet)
    }

    /// When [`handle_image`](Self::handle_image) is to be called at the latest.
    #[must_use]
    pub fn poll_timeout(&self) -> Option<Instant> {
        if self.queue.len() >= MOST_QUEUED {
            // When something of it is taken, the caller comes back.
            return None;
        }
        if self.more || matches!(self.phase, Phase::Births(_)) {
            return Some(Instant::START);
        }
        let origins =
            self.origins.iter().enumerate().filter(|(_, origin)| origin.dirty && self.listens(origin));
        let due = origins.map(|(place, origin)| origin.due(self.node(place))).min();
        let history = self.has_history().then_some(self.next_history);
        [due, history].into_iter().flatten().min()
    }

    /// Whether the session is to be ended in good order, as NDEATH has left.
    #[must_use]
    pub fn has_said_farewell(&self) -> bool {
        self.farewell_sent
    }

    /// Whether the births of this session are out.
    #[must_use]
    pub fn is_live(&self) -> bool {
        self.phase == Phase::Live
    }

    /// Counters.
    #[must_use]
    pub fn report(&self) -> SparkplugReport {
        SparkplugReport {
            held: u64::try_from(self.history.held()).unwrap_or(u64::MAX),
            dropped: self.history.dropped(),
            ..self.report
        }
    }

    /// Nothing that waits is sent; the values in it are kept.
    fn forget_births(&mut self) {
        for (_, batch) in std::mem::take(&mut self.queue) {
            if let Some(batch) = batch {
                self.history.put_back(batch);
            }
        }
        self.origins.iter_mut().for_each(|origin| origin.born = false);
        self.seen = None;
    }

    fn say_farewell(&mut self, now: Now) {
        self.forget_births();
        self.phase = Phase::Dead;
        let payload = messages::death(now, self.bd_seq.0);
        let topic = Arc::clone(&self.topics.ndeath);
        self.farewell = self.push(topic, &payload, None);
        if let Some((packet, _)) = self.queue.back_mut() {
            packet.at_least_once = true;
        }
    }

    /// Whether somebody takes, or something keeps, what is new of an origin: a device that is dead says nothing.
    fn listens(&self, origin: &Origin) -> bool {
        origin.born || self.phase != Phase::Live
    }

    /// The node of a device; the edge node has none.
    fn node(&self, place: usize) -> Option<&NodeDef> {
        place.checked_sub(1).and_then(|node| self.table.nodes.get(node))
    }

    /// Puts a message behind those that wait; `None` for one that no session would take.
    fn push(&mut self, topic: Arc<str>, payload: &Payload, batch: Option<Batch>) -> Option<MessageId> {
        let payload = payload.encode_to_vec();
        if payload.len() > LARGEST_PAYLOAD {
            count(&mut self.report.too_large);
            return None;
        }
        self.next_id += 1;
        let id = MessageId::new(self.next_id);
        self.queue.push_back((Packet { id, topic, payload, at_least_once: false }, batch));
        Some(id)
    }
}

fn count(counter: &mut u64) {
    *counter = counter.saturating_add(1);
}
