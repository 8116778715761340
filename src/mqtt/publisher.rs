//! What has to be published when. Pure: told of the image, the session and the acknowledgements; tells what to send.
//!
//! - The state of a node goes out when a published value, its quality or the node's state changed, at least
//!   `min_interval` after the message before, and at the latest `max_interval` after it.
//! - Alarms, availability, events and messages of serial lines are never held back.
//! - Every session begins with the birth: all that is retained, and `bridge/state` last, so that whoever sees
//!   "online" sees nothing that is older than it.
//! - Without a session events and messages of serial lines are collected, and states where there is a store; all else is made
//!   anew at the next birth.
//! - With a store events go through it, and so do the states that are not told live: those make the history.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::Duration;

use super::buffer::Buffer;
use super::home_assistant::HomeAssistant;
use super::line_reader::LineReaders;
use super::outbox::{Limits, Message, MessageId, Outbox, OutboxReport, Outgoing};
use super::payload::{self, Identity};
use super::requests::{Response, VerbTopics};
use super::serial_command::SerialAnswer;
use super::settings::{MqttSettings, StateQos};
use super::told::{NodeState, watched};
use super::topics::Topics;
use crate::mapping::TagTable;
use crate::process_image::{AlarmStatus, LineIndex, ProcessImage, Quality, Revision, Value};
use crate::time::{Instant, Now};

mod exchange;
mod not_taken;
mod stored;
mod telling;

/// Time between two messages on `bridge/health`.
const HEALTH_INTERVAL: Duration = Duration::from_secs(30);
/// An answer that does not reach who asked within this time is of no use to him.
const ANSWER_EXPIRY: Duration = Duration::from_secs(60);
/// Payloads made under one lock of the image; the rest follows under the next.
const MOST_PER_READ: usize = 32;
/// Events taken from the journal under one lock of the image; the rest follows under the next.
const MOST_EVENTS_PER_READ: usize = 128;
/// Bytes that a state is longer in the history, its topic included.
const HISTORY_IS_LONGER: usize = "/history\n".len() - "/state".len() + "\"historical\":true,".len();
/// Bytes of one message: what brokers take unless told otherwise is far more.
pub const LARGEST_MESSAGE: usize = 256 * 1024;

/// What the broker is to be told.
#[derive(Debug)]
pub struct Publisher {
    table: Arc<TagTable>,
    topics: Topics,
    home_assistant: Option<HomeAssistant>,
    identity: Identity,
    state_acknowledged: bool,
    /// How long the state of a node is worth anything.
    state_expiry: Option<Duration>,
    outbox: Outbox,
    /// What goes through the store, where there is one.
    buffer: Option<Buffer>,
    /// Without a session a node is looked at no more often.
    history_interval: Duration,
    session: bool,
    birth: Birth,
    nodes: Vec<NodeState>,
    /// What was last published of each tag, by its place in the table.
    tags: Vec<Option<(Value, Quality)>>,
    /// Whether a change of the tag changes the payload: it is published, or tells whether one that is means anything.
    watched: Vec<bool>,
    /// What was last published of each alarm.
    alarms: Vec<Option<AlarmStatus>>,
    seen: Option<Revision>,
    /// The last event taken from the journal.
    cursor: u64,
    next_health: Instant,
    /// Work was left for the next call because of [`MOST_PER_READ`].
    more: bool,
    /// Events were left in the journal because of [`MOST_EVENTS_PER_READ`].
    more_events: bool,
    /// Messages of serial lines.
    lines: LineReaders,
    /// Retained topics of tables before this one, to be cleared at each birth until the broker says that it did.
    gone: BTreeSet<Arc<str>>,
    /// Those of them whose clearing is on its way.
    clearing: BTreeMap<MessageId, Arc<str>>,
    /// Of the last state of nodes of tables before this one: should one come back, it goes on from there.
    numbers: BTreeMap<String, u64>,
    /// When events are tried again that the broker does not take for now.
    release_at: Option<Instant>,
    /// `offline`, once the gateway stops.
    farewell: Option<MessageId>,
    /// The broker has it.
    farewell_acknowledged: bool,
    scratch: String,
}

/// How far the birth of this session has come.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Birth {
    /// Nothing sent yet.
    Due,
    /// `bridge/info` is out; nodes and alarms follow.
    Nodes,
    /// All is out.
    Done,
}

impl Publisher {
    /// A publisher that has told nothing yet.
    #[must_use]
    pub fn new(table: Arc<TagTable>, settings: &MqttSettings, identity: Identity) -> Self {
        let limits = Limits {
            messages: settings.outbox_messages,
            bytes: settings.outbox_bytes,
            window: usize::from(settings.inflight),
            message: LARGEST_MESSAGE,
        };
        let topics = Topics::new(settings.base_topic.as_str(), &table);
        let announced = &settings.home_assistant;
        Self {
            home_assistant: HomeAssistant::new(announced, &table, &topics, &identity.version),
            topics,
            identity,
            state_acknowledged: settings.qos_state == StateQos::AtLeastOnce,
            state_expiry: settings.state_expiry_s.map(|seconds| Duration::from_secs(seconds.into())),
            outbox: Outbox::new(limits),
            buffer: None,
            history_interval: Duration::from_millis(settings.history_interval_ms.into()),
            session: false,
            birth: Birth::Due,
            nodes: vec![NodeState::default(); table.nodes.len()],
            tags: vec![None; table.tags.len()],
            watched: watched(&table),
            alarms: vec![None; table.alarms.len()],
            seen: None,
            cursor: 0,
            next_health: Instant::START,
            more: false,
            more_events: false,
            lines: LineReaders::new(&table),
            gone: BTreeSet::new(),
            clearing: BTreeMap::new(),
            numbers: BTreeMap::new(),
            release_at: None,
            farewell: None,
            farewell_acknowledged: false,
            scratch: String::new(),
            table,
        }
    }

    /// Topic and payload of the last will.
    #[must_use]
    pub fn last_will(&self) -> (&str, &'static str) {
        (&self.topics.bridge_state, payload::OFFLINE)
    }

    /// A session with the broker began: the birth follows with the next image.
    pub fn handle_session_up(&mut self) {
        self.session = true;
        self.birth = Birth::Due;
        for node in &mut self.nodes {
            node.published = None;
            node.availability = None;
        }
        self.alarms.fill(None);
        self.seen = None;
    }

    /// What the broker had kept on [`subscriptions`](Self::subscriptions) is on its way, or cannot be had: what would take its
    /// place may be sent.
    pub fn handle_subscribed(&mut self) {
        self.home_assistant.iter_mut().for_each(HomeAssistant::handle_subscribed);
    }

    /// The session ended: what was not acknowledged is kept or made anew.
    pub fn handle_session_down(&mut self) {
        self.session = false;
        self.more = false;
        self.release_at = None;
        self.home_assistant.iter_mut().for_each(HomeAssistant::handle_session_down);
        let unsent = self.outbox.handle_session_down();
        self.keep_samples(unsent);
    }

    /// The broker has a message.
    pub fn handle_acknowledged(&mut self, id: MessageId) {
        self.farewell_acknowledged |= self.farewell == Some(id);
        if let Some(topic) = self.clearing.remove(&id) {
            self.gone.remove(&topic);
        }
        let stored = self.outbox.handle_acknowledged(id);
        if let (Some(buffer), Some(stored)) = (&mut self.buffer, stored) {
            buffer.acknowledge(stored);
        }
    }

    /// The image as it stands. To be called when it changed and when [`poll_timeout`](Self::poll_timeout) is due: all
    /// that becomes due is made from the image, so one verb serves both.
    pub fn handle_image(&mut self, now: Now, image: &ProcessImage) {
        self.collect_events(image);
        self.collect_messages(image);
        let mut left = MOST_PER_READ;
        if !self.session && self.buffer.is_none() {
            return;
        }
        self.more = false;
        if !self.session {
            self.publish_nodes(now, image, &mut left);
            self.seen = if self.more { None } else { Some(image.revision) };
            return;
        }
        self.keep_overdue(now);
        self.release_held(now);
        if self.birth == Birth::Due {
            self.clear_gone(now);
            payload::info(&mut self.scratch, &self.table, &self.identity);
            self.push(Arc::clone(&self.topics.bridge_info), true);
            self.next_health = now.instant;
            self.birth = Birth::Nodes;
        }
        self.publish_health(now, image);
        self.publish_announcements(&mut left);
        if self.seen != Some(image.revision) {
            self.publish_alarms(image, &mut left);
        }
        self.publish_nodes(now, image, &mut left);
        self.seen = if self.more { None } else { Some(image.revision) };
        if self.birth == Birth::Nodes && !self.more {
            self.publish_bridge_state(payload::ONLINE);
            self.birth = Birth::Done;
        }
    }

    /// The gateway stops in good order: what waits is given up, and `offline` is the last message of the session.
    pub fn handle_stop(&mut self) {
        self.more = false;
        self.more_events = false;
        self.lines.stop();
        let unsent = self.outbox.clear_waiting();
        self.keep_samples(unsent);
        self.farewell = self.publish_bridge_state(payload::OFFLINE);
    }

    /// The next message to send; call until `None`.
    pub fn poll_output(&mut self) -> Option<Outgoing> {
        if self.session { self.outbox.poll_output() } else { None }
    }

    /// When [`handle_image`](Self::handle_image) is to be called at the latest.
    #[must_use]
    pub fn poll_timeout(&self) -> Option<Instant> {
        if self.more_events || self.lines.has_more() {
            return Some(Instant::START);
        }
        let stored = self.buffer.as_ref().and_then(|buffer| buffer.poll_timeout(&self.outbox, self.session));
        if !self.session && self.buffer.is_none() {
            return None;
        }
        let announces = self.home_assistant.as_ref().is_some_and(HomeAssistant::has_more);
        if self.more || (self.session && (announces || self.birth != Birth::Done)) {
            return Some(Instant::START);
        }
        let nodes = self.table.nodes.iter().zip(&self.nodes).map(|(def, node)| self.due(def, node));
        let health = self.session.then_some(self.next_health);
        nodes.chain(health).chain(self.release_at).chain(self.overdue_at()).chain(stored).min()
    }

    /// Fill and counters of the outbox.
    #[must_use]
    pub fn report(&self) -> &OutboxReport {
        self.outbox.report()
    }

    /// How many states were made of each node: the number of its newest.
    pub fn states_made(&self) -> impl Iterator<Item = u64> + '_ {
        self.nodes.iter().map(|node| node.seq)
    }

    /// Messages that are sent and not acknowledged.
    #[must_use]
    pub fn in_flight(&self) -> usize {
        self.outbox.in_flight()
    }

    /// Whether the image holds more than one read takes: [`handle_image`](Self::handle_image) is to be called again.
    #[must_use]
    pub fn has_more(&self) -> bool {
        self.more || self.more_events || self.lines.has_more()
    }

    /// Whether everything that was to be told has been acknowledged.
    #[must_use]
    pub fn is_idle(&self) -> bool {
        let stored = self.buffer.as_ref().is_none_or(|buffer| buffer.is_idle() && !buffer.has_events());
        self.outbox.is_empty() && !self.has_more() && stored
    }

    /// Whether the broker has the `offline` of [`handle_stop`](Self::handle_stop).
    #[must_use]
    pub fn has_said_farewell(&self) -> bool {
        self.farewell_acknowledged
    }

    fn collect_events(&mut self, image: &ProcessImage) {
        if self.waits_for_store() {
            self.more_events = self.cursor < image.journal.newest();
            return;
        }
        let (events, missed) = image.journal.since(self.cursor);
        let mut events = events.take(MOST_EVENTS_PER_READ).peekable();
        if let (Some(oldest), true) = (events.peek(), missed > 0) {
            self.outbox.count_missed(missed);
            let last = oldest.seq.saturating_sub(1);
            payload::events_missed(&mut self.scratch, &self.identity.sid, last, missed, oldest.ts);
            self.keep_event(last);
        }
        for event in events {
            payload::event(&mut self.scratch, &self.table, event, &self.identity.sid);
            self.keep_event(event.seq);
            self.cursor = event.seq;
        }
        self.more_events = self.cursor < image.journal.newest();
    }

    /// Messages of serial lines are kept like events: none is left out without a word.
    fn collect_messages(&mut self, image: &ProcessImage) {
        self.lines.begin();
        while let Some(new) = self.lines.next(image) {
            payload::serial_message(
                &mut self.scratch,
                new.message,
                new.encoding,
                &self.identity.sid,
                new.missed,
            );
            if let Some(topics) = self.topics.lines.get(new.line.0) {
                let topic = Arc::clone(&topics.rx);
                self.push(topic, false);
            }
        }
    }

    /// The answer to a request to send on a line.
    pub fn handle_serial_answer(&mut self, now: Now, answer: &SerialAnswer) {
        let line = (&*answer.node, answer.number);
        let said = (answer.result, answer.message.as_str());
        payload::serial_response(&mut self.scratch, line, answer.transaction.as_deref(), said);
        let topic = Arc::clone(&self.topics.serial_response);
        self.push_answer(now, topic, None);
    }

    /// What became of a request is published.
    pub fn handle_response(&mut self, now: Now, response: &Response) {
        self.scratch.clear();
        self.scratch.push_str(&response.payload);
        self.push_answer(now, Arc::clone(&response.topic), response.correlation.clone());
    }

    /// Who asked does not wait for ever.
    fn push_answer(&mut self, now: Now, topic: Arc<str>, correlation: Option<Arc<[u8]>>) {
        let message = Message::event(topic, self.scratch.as_str().into());
        self.outbox.push(Message { expires: Some(now.instant + ANSWER_EXPIRY), correlation, ..message });
    }

    /// The request topics.
    #[must_use]
    pub fn request_topics(&self) -> Vec<VerbTopics> {
        self.topics.requests.clone()
    }

    /// What there is.
    #[must_use]
    pub fn table(&self) -> &Arc<TagTable> {
        &self.table
    }

    /// The command topics that are read, and their lines; none unless the installation allows it.
    #[must_use]
    pub fn command_topics(&self) -> Vec<(Arc<str>, LineIndex)> {
        let lines = self.table.lines.iter().zip(&self.topics.lines).enumerate();
        let written = lines.filter(|(_, (def, _))| def.mqtt.write);
        written.map(|(place, (_, topics))| (Arc::clone(&topics.tx), LineIndex(place))).collect()
    }

    /// What is to be subscribed beside the command topics.
    #[must_use]
    pub fn subscriptions(&self) -> Vec<String> {
        self.home_assistant.as_ref().map(HomeAssistant::subscriptions).unwrap_or_default()
    }

    /// A message of a topic of [`subscriptions`](Self::subscriptions) came; others are left alone.
    pub fn handle_message(&mut self, topic: &str, payload: &[u8], retained: bool) {
        if let Some(home_assistant) = &mut self.home_assistant {
            home_assistant.handle_message(topic, payload, retained);
        }
    }

    /// Puts what stands in the buffer into the outbox.
    fn push(&mut self, topic: Arc<str>, retain: bool) -> Option<MessageId> {
        let payload = Arc::from(self.scratch.as_str());
        self.outbox.push(Message { retain, ..Message::event(topic, payload) })
    }
}
