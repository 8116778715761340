//! What has to be published when. Pure: told of the image, the session and the acknowledgements; tells what to send.
//!
//! - The state of a node goes out when a published value, its quality or the node's state changed, at least
//!   `min_interval` after the message before, and at the latest `max_interval` after it.
//! - Alarms, availability and events are never held back.
//! - Every session begins with the birth: all that is retained, and `bridge/state` last, so that whoever sees
//!   "online" sees nothing that is older than it.
//! - Without a session only events are collected; all else is made anew at the next birth.

use std::sync::Arc;
use std::time::Duration;

use super::outbox::{Limits, Message, MessageId, Outbox, OutboxReport, Outgoing};
use super::payload::{self, Identity, Stamp};
use super::settings::{MqttSettings, StateQos};
use super::told::{NodeState, differs, is_same_alarm, watched};
use super::topics::Topics;
use crate::mapping::{NodeDef, TagTable};
use crate::process_image::{AlarmStatus, NodeIndex, ProcessImage, Quality, Revision, TagIndex, Value};
use crate::time::{Instant, Now};

/// Time between two messages on `bridge/health`.
const HEALTH_INTERVAL: Duration = Duration::from_secs(30);
/// Payloads made under one lock of the image; the rest follows under the next.
const MOST_PER_READ: usize = 32;
/// Events taken from the journal under one lock of the image; the rest follows under the next.
const MOST_EVENTS_PER_READ: usize = 128;
/// Bytes of one message: what brokers take unless told otherwise is far more.
pub const LARGEST_MESSAGE: usize = 256 * 1024;

/// What the broker is to be told.
#[derive(Debug)]
pub struct Publisher {
    table: Arc<TagTable>,
    topics: Topics,
    identity: Identity,
    state_acknowledged: bool,
    outbox: Outbox,
    session: bool,
    birth: Birth,
    nodes: Vec<NodeState>,
    /// What was last published of each tag, by [`TagIndex`].
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
    /// `offline`, once the gateway stops.
    farewell: Option<MessageId>,
    /// The broker has it.
    farewell_acknowledged: bool,
    buffer: String,
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
        Self {
            topics: Topics::new(settings.base_topic.as_str(), &table),
            identity,
            state_acknowledged: settings.qos_state == StateQos::AtLeastOnce,
            outbox: Outbox::new(limits),
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
            farewell: None,
            farewell_acknowledged: false,
            buffer: String::new(),
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

    /// The session ended: what was not acknowledged is kept or made anew.
    pub fn handle_session_down(&mut self) {
        self.session = false;
        self.more = false;
        self.outbox.handle_session_down();
    }

    /// The broker has a message.
    pub fn handle_acknowledged(&mut self, id: MessageId) {
        self.farewell_acknowledged |= self.farewell == Some(id);
        self.outbox.handle_acknowledged(id);
    }

    /// The image as it stands. To be called when it changed and when [`poll_timeout`](Self::poll_timeout) is due: all
    /// that becomes due is made from the image, so one verb serves both.
    pub fn handle_image(&mut self, now: Now, image: &ProcessImage) {
        self.collect_events(image);
        if !self.session {
            return;
        }
        self.more = false;
        let mut left = MOST_PER_READ;
        if self.birth == Birth::Due {
            payload::info(&mut self.buffer, &self.table, &self.identity);
            self.push(Arc::clone(&self.topics.bridge_info), true, true);
            self.next_health = now.instant;
            self.birth = Birth::Nodes;
        }
        self.publish_health(now, image);
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
        self.outbox.clear_waiting();
        self.farewell = self.publish_bridge_state(payload::OFFLINE);
    }

    /// The next message to send; call until `None`.
    pub fn poll_output(&mut self) -> Option<Outgoing> {
        if self.session { self.outbox.poll_output() } else { None }
    }

    /// When [`handle_image`](Self::handle_image) is to be called at the latest.
    #[must_use]
    pub fn poll_timeout(&self) -> Option<Instant> {
        if self.more_events {
            return Some(Instant::START);
        }
        if !self.session {
            return None;
        }
        if self.more || self.birth != Birth::Done {
            return Some(Instant::START);
        }
        let nodes = self.table.nodes.iter().zip(&self.nodes).map(|(def, node)| node.due(def));
        nodes.chain([self.next_health]).min()
    }

    /// Fill and counters of the outbox.
    #[must_use]
    pub fn report(&self) -> &OutboxReport {
        self.outbox.report()
    }

    /// Messages that are sent and not acknowledged.
    #[must_use]
    pub fn in_flight(&self) -> usize {
        self.outbox.in_flight()
    }

    /// Whether the image holds more than one read takes: [`handle_image`](Self::handle_image) is to be called again.
    #[must_use]
    pub fn has_more(&self) -> bool {
        self.more || self.more_events
    }

    /// Whether everything that was to be told has been acknowledged.
    #[must_use]
    pub fn is_idle(&self) -> bool {
        self.outbox.is_empty() && !self.has_more()
    }

    /// Whether the broker has the `offline` of [`handle_stop`](Self::handle_stop).
    #[must_use]
    pub fn has_said_farewell(&self) -> bool {
        self.farewell_acknowledged
    }

    fn collect_events(&mut self, image: &ProcessImage) {
        let (events, missed) = image.journal.since(self.cursor);
        let mut events = events.take(MOST_EVENTS_PER_READ).peekable();
        if let (Some(oldest), true) = (events.peek(), missed > 0) {
            self.outbox.count_missed(missed);
            let last = oldest.seq.saturating_sub(1);
            payload::events_missed(&mut self.buffer, &self.identity.sid, last, missed, oldest.ts);
            self.push(Arc::clone(&self.topics.event), true, false);
        }
        for event in events {
            payload::event(&mut self.buffer, &self.table, event, &self.identity.sid);
            self.push(Arc::clone(&self.topics.event), true, false);
            self.cursor = event.seq;
        }
        self.more_events = self.cursor < image.journal.newest();
    }

    fn publish_health(&mut self, now: Now, image: &ProcessImage) {
        if now.instant < self.next_health {
            return;
        }
        self.next_health = now.instant + HEALTH_INTERVAL;
        let report = *self.outbox.report();
        payload::health(&mut self.buffer, &self.table, image, &self.identity, now, &report);
        self.push(Arc::clone(&self.topics.bridge_health), true, true);
        if self.birth == Birth::Done {
            // The last will of a session before this one may have come late.
            self.publish_bridge_state(payload::ONLINE);
        }
    }

    fn publish_bridge_state(&mut self, state: &str) -> Option<MessageId> {
        self.buffer.clear();
        self.buffer.push_str(state);
        self.push(Arc::clone(&self.topics.bridge_state), true, true)
    }

    fn publish_alarms(&mut self, image: &ProcessImage, left: &mut usize) {
        let table = Arc::clone(&self.table);
        for (place, (def, status)) in table.alarms.iter().zip(&image.alarms).enumerate() {
            let told = self.alarms.get(place).copied().flatten();
            if told.is_some_and(|told| is_same_alarm(&told, status)) {
                continue;
            }
            if !self.take_one(left) {
                return;
            }
            payload::alarm(&mut self.buffer, &table, def, status);
            if let Some(topic) = self.topics.alarms.get(place).cloned() {
                self.push(topic, true, true);
            }
            if let Some(told) = self.alarms.get_mut(place) {
                *told = Some(*status);
            }
        }
    }

    fn publish_nodes(&mut self, now: Now, image: &ProcessImage, left: &mut usize) {
        let table = Arc::clone(&self.table);
        let changed = self.seen != Some(image.revision);
        for (place, def) in table.nodes.iter().enumerate() {
            if changed && !self.publish_availability(place, image, left) {
                return;
            }
            if changed {
                self.note_changes(place, def, image);
            }
            let due = self.nodes.get(place).is_some_and(|node| node.due(def) <= now.instant);
            if due && !self.take_one(left) {
                return;
            }
            if due {
                self.publish_state(now, place, def, image);
            }
        }
    }

    /// Tells whether a node is there, when that changed. `false` when that has to wait for the next read.
    fn publish_availability(&mut self, place: usize, image: &ProcessImage, left: &mut usize) -> bool {
        let (Some(status), Some(node)) = (image.nodes.get(place), self.nodes.get(place)) else { return true };
        let told = node.availability.as_ref();
        if told.is_some_and(|(online, reason)| {
            *online == status.online && (status.online || *reason == status.reason)
        }) {
            return true;
        }
        if !self.take_one(left) {
            return false;
        }
        payload::availability(&mut self.buffer, status);
        if let Some(topics) = self.topics.nodes.get(place) {
            let topic = Arc::clone(&topics.availability);
            self.push(topic, true, true);
        }
        if let Some(node) = self.nodes.get_mut(place) {
            node.availability = Some((status.online, status.reason.clone()));
        }
        true
    }

    /// Marks a node whose published values, what is to be said against them, or NMT state are not those that were told.
    fn note_changes(&mut self, place: usize, def: &NodeDef, image: &ProcessImage) {
        let table = &self.table;
        let Some(node) = self.nodes.get_mut(place) else { return };
        node.fast = def.publish.fast_while.is_some_and(|tag| {
            let sample = image.tag(tag);
            sample.quality.is_usable() && sample.value.is_true()
        });
        if node.dirty {
            return;
        }
        let told = self.tags.get(def.tags.clone()).unwrap_or_default();
        let watched = self.watched.get(def.tags.clone()).unwrap_or_default();
        let tags = table.tags.get(def.tags.clone()).unwrap_or_default().iter().zip(told).zip(watched);
        let moved = def.tags.clone().zip(tags).any(|(index, ((tag, told), watched))| {
            if !watched {
                return false;
            }
            let sample = image.tag(TagIndex(index));
            told.is_none_or(|(value, quality)| {
                quality != sample.quality || differs(value, sample.value, tag.deadband)
            })
        });
        node.dirty = moved || image.nodes.get(place).is_some_and(|status| status.nmt != node.nmt);
    }

    fn publish_state(&mut self, now: Now, place: usize, def: &NodeDef, image: &ProcessImage) {
        let Some(node) = self.nodes.get_mut(place) else { return };
        node.seq += 1;
        node.published = Some(now.instant);
        node.dirty = false;
        node.nmt = image.nodes.get(place).and_then(|status| status.nmt);
        let stamp = Stamp { sid: &self.identity.sid, seq: node.seq };
        payload::state(&mut self.buffer, &self.table, image, NodeIndex(place), stamp);
        for (index, told) in def.tags.clone().zip(self.tags.get_mut(def.tags.clone()).unwrap_or_default()) {
            let sample = image.tag(TagIndex(index));
            *told = Some((sample.value, sample.quality));
        }
        if let Some(topics) = self.topics.nodes.get(place) {
            let topic = Arc::clone(&topics.state);
            self.push(topic, self.state_acknowledged, true);
        }
    }

    /// Uses up one of the payloads that may still be made under this lock.
    fn take_one(&mut self, left: &mut usize) -> bool {
        self.more = *left == 0;
        *left = left.saturating_sub(1);
        !self.more
    }

    /// Puts what stands in the buffer into the outbox.
    fn push(&mut self, topic: Arc<str>, at_least_once: bool, retain: bool) -> Option<MessageId> {
        let payload = Arc::from(self.buffer.as_str());
        self.outbox.push(Message { topic, payload, at_least_once, retain })
    }
}
