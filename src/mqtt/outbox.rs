//! What the broker has not acknowledged yet: ordered, bounded, in memory.
//!
//! Two lanes take turns, so that what is live never waits behind a backlog of events; a third has what they leave:
//!
//! - *latest*: retained topics. Of one topic only the newest message waits; it takes the place of the one before. There
//!   are only so many topics, so nothing has to leave this lane: what was told to it reaches the broker.
//! - *events*: every one is kept, in order, within the limits in count and bytes. When they are full, the oldest leaves.
//!   Those that stand in the store do not count: few of them are taken out at a time.
//! - *history*: samples from the store. They go when nothing else waits, and never fill more than half of the window.
//!
//! A message is forgotten when it is acknowledged, superseded by a newer one of its retained topic, or dropped because
//! the outbox is full; the last two are counted. When the session is lost, events that were not acknowledged go back in
//! front, in order, and will be sent again; what is retained is let go, because each session begins with all of it.
//! Samples that were let go so are given back: they belong to the history.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use crate::store::Class;
use crate::time::Instant;

mod not_taken;
mod report;

pub use not_taken::{Became, NotTakenMessage};
pub use report::OutboxReport;

/// A message for the broker.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Message {
    /// Where to.
    pub topic: Arc<str>,
    /// JSON.
    pub payload: Arc<str>,
    /// Quality of service 1, else 0.
    pub at_least_once: bool,
    /// The broker keeps it for later subscribers; of those that wait only the newest is kept. What is not retained is an
    /// event.
    pub retain: bool,
    /// From then on nobody is to get it; with MQTT 5 nobody does.
    pub expires: Option<Instant>,
    /// What a request wants to find in its answer, with MQTT 5.
    pub correlation: Option<Arc<[u8]>>,
}

impl Message {
    /// A retained message of quality of service 1 that does not expire.
    #[must_use]
    pub fn retained(topic: Arc<str>, payload: Arc<str>) -> Self {
        Self { retain: true, ..Self::event(topic, payload) }
    }

    /// An event, of quality of service 1, that does not expire.
    #[must_use]
    pub fn event(topic: Arc<str>, payload: Arc<str>) -> Self {
        Self { topic, payload, at_least_once: true, retain: false, expires: None, correlation: None }
    }

    /// What it takes of the outbox's bytes.
    #[must_use]
    pub fn size(&self) -> usize {
        let correlation = self.correlation.as_ref().map_or(0, |data| data.len());
        self.topic.len().saturating_add(self.payload.len()).saturating_add(correlation)
    }
}

/// Names a message between [`Outbox::poll_output`] and [`Outbox::handle_acknowledged`].
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct MessageId(u64);

impl MessageId {
    /// Of a message that is in no outbox.
    #[must_use]
    pub const fn new(number: u64) -> Self {
        Self(number)
    }
}

/// A message to be sent now.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Outgoing {
    /// For the acknowledgement.
    pub id: MessageId,
    /// It.
    pub message: Message,
    /// It was sent in an earlier session that ended before the acknowledgement: the broker may see it twice.
    pub again: bool,
}

/// What fits.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Limits {
    /// Events, sent and waiting.
    pub messages: usize,
    /// Bytes of topics and payloads of events, sent and waiting.
    pub bytes: usize,
    /// Messages that may be sent and not acknowledged at the same time.
    pub window: usize,
    /// Bytes of one message; a larger one is counted and thrown away, because a broker would cut the session.
    pub message: usize,
}

#[derive(Clone, Debug)]
struct Entry {
    message: Message,
    origin: Origin,
    /// Sent in an earlier session.
    sent_before: bool,
}

/// Where a message comes from.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Origin {
    /// It is here and nowhere else.
    Here,
    /// A sample that is told live since then, and whether it went to the store meanwhile.
    Sample(Instant, Copied),
    /// It stands in the store, at this position.
    Stored(Class, u64),
    /// It stands in the store, nobody knows where, and comes again.
    Forgotten,
}

/// Whether a sample that is told live is in the store too.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Copied {
    No,
    /// It is on its way there.
    Soon,
    /// At this position.
    At(u64),
}

/// A sample that is not told live any more, and that the store does not have.
pub type Unsent = Message;

/// The outbox.
#[derive(Clone, Debug)]
pub struct Outbox {
    limits: Limits,
    /// Retained messages that wait, oldest first.
    latest: BTreeMap<MessageId, Entry>,
    /// Where the waiting message of a retained topic stands.
    latest_of: BTreeMap<Arc<str>, MessageId>,
    /// Events that wait, oldest first.
    events: BTreeMap<MessageId, Entry>,
    /// How many of them are of the store.
    stored_events: usize,
    /// Samples of the store that wait, oldest first.
    history: BTreeMap<MessageId, Entry>,
    /// Samples that were acknowledged before the store said where it has them.
    acknowledged_soon: BTreeSet<MessageId>,
    /// Sent, not acknowledged.
    in_flight: BTreeMap<MessageId, Entry>,
    next: u64,
    /// The lane whose turn it is.
    latest_turn: bool,
    /// The broker does not take events for now: only what is retained is sent.
    held: bool,
    report: OutboxReport,
}

impl Outbox {
    /// An empty outbox.
    #[must_use]
    pub fn new(limits: Limits) -> Self {
        let report = OutboxReport {
            messages_limit: limits.messages,
            bytes_limit: limits.bytes,
            ..OutboxReport::default()
        };
        Self {
            limits,
            latest: BTreeMap::new(),
            latest_of: BTreeMap::new(),
            events: BTreeMap::new(),
            stored_events: 0,
            history: BTreeMap::new(),
            acknowledged_soon: BTreeSet::new(),
            in_flight: BTreeMap::new(),
            next: 0,
            latest_turn: true,
            held: false,
            report,
        }
    }

    /// Takes a message in. Where that is one event too many, the oldest that wait leave. What was sent already does not
    /// leave. `None` for a message that no broker would take.
    pub fn push(&mut self, message: Message) -> Option<MessageId> {
        if message.size() > self.limits.message {
            count(&mut self.report.too_large);
            return None;
        }
        if !message.retain {
            let (events, bytes) = self.report.events;
            let size = u64::try_from(message.size()).unwrap_or(u64::MAX);
            self.report.events = (events.saturating_add(1), bytes.saturating_add(size));
        }
        let (id, _) = self.take_in(message, Origin::Here);
        while self.report.held.0 > self.limits.messages || self.report.held.1 > self.limits.bytes {
            let oldest = self.events.iter().find(|(_, entry)| entry.origin == Origin::Here);
            let Some(oldest) = oldest.map(|(id, _)| *id) else { break };
            self.remove_waiting(oldest);
            count(&mut self.report.events_dropped);
        }
        Some(id)
    }

    /// Takes a sample in that is to be told live, on a retained topic; gives the one that waited there and that the store
    /// does not have.
    pub fn push_sample(&mut self, message: Message, now: Instant) -> Option<Unsent> {
        if message.size() > self.limits.message {
            count(&mut self.report.too_large);
            return None;
        }
        let (_, superseded) = self.take_in(message, Origin::Sample(now, Copied::No));
        superseded.and_then(Entry::unsent)
    }

    /// Whether a message of a retained topic waits to be sent.
    #[must_use]
    pub fn is_waiting(&self, topic: &str) -> bool {
        self.latest_of.contains_key(topic)
    }

    /// Takes a message out of the store in, which keeps it until it is acknowledged. `false` for one that no broker would
    /// take: it is acknowledged with that.
    pub fn push_stored(&mut self, message: Message, class: Class, position: u64) -> bool {
        let fits = message.size() <= self.limits.message;
        if fits {
            self.take_in(message, Origin::Stored(class, position));
        } else {
            count(&mut self.report.too_large);
        }
        fits
    }

    fn take_in(&mut self, message: Message, origin: Origin) -> (MessageId, Option<Entry>) {
        let before = if message.retain { self.latest_of.get(&message.topic).copied() } else { None };
        let superseded = before.and_then(|id| self.remove_waiting(id));
        if superseded.is_some() {
            count(&mut self.report.superseded);
        }
        // What waits takes the place of the one before; a sample that is on its way to the store keeps its own name.
        let is_on_its_way = superseded.as_ref().is_some_and(|entry| entry.is_copied(Copied::Soon));
        let id = before.filter(|_| !is_on_its_way).unwrap_or_else(|| self.next_id());
        self.insert_waiting(id, Entry { message, origin, sent_before: false });
        (id, superseded)
    }

    /// Takes the place of another one: all that is in it, and its counters. The limits are its own, in the report too.
    pub fn go_on_from(&mut self, old: Self) {
        let Limits { messages: messages_limit, bytes: bytes_limit, .. } = self.limits;
        let report = OutboxReport { messages_limit, bytes_limit, ..old.report };
        *self = Self { limits: self.limits, report, ..old };
    }

    /// The next message to send, while the window is open.
    pub fn poll_output(&mut self) -> Option<Outgoing> {
        if self.in_flight.len() >= self.limits.window {
            return None;
        }
        if self.held && self.latest.is_empty() {
            return None;
        }
        let no_events = self.held || self.events.is_empty();
        let from_latest = (self.latest_turn || no_events) && !self.latest.is_empty();
        let lane = match (from_latest, no_events, self.may_send_history()) {
            (true, _, _) => &self.latest,
            (false, true, true) => &self.history,
            (false, _, _) => &self.events,
        };
        let id = *lane.keys().next()?;
        self.latest_turn = !from_latest;
        let entry = self.remove_waiting(id)?;
        self.count_in(&entry);
        count(&mut self.report.sent);
        if entry.sent_before {
            count(&mut self.report.sent_again);
        }
        let outgoing = Outgoing { id, message: entry.message.clone(), again: entry.sent_before };
        self.in_flight.insert(id, entry);
        Some(outgoing)
    }

    /// The broker has it: forgotten. An id that is not in flight is ignored. Gives where the store has it.
    pub fn handle_acknowledged(&mut self, id: MessageId) -> Option<(Class, u64)> {
        let entry = self.in_flight.remove(&id)?;
        self.count_out(&entry);
        count(&mut self.report.acknowledged);
        if entry.is_copied(Copied::Soon) {
            self.acknowledged_soon.insert(id);
        }
        entry.stored()
    }

    /// The session ended: events and history in flight go back in front, in order; what is retained is let go. Gives the
    /// samples among that, in order.
    pub fn handle_session_down(&mut self) -> Vec<Unsent> {
        self.held = false;
        let mut samples = BTreeMap::new();
        for (id, entry) in std::mem::take(&mut self.in_flight) {
            self.count_out(&entry);
            if entry.message.retain {
                count(&mut self.report.superseded);
                samples.insert(id, entry);
            } else if entry.origin != Origin::Forgotten {
                self.insert_waiting(id, Entry { sent_before: true, ..entry });
            }
        }
        samples.extend(self.let_go_of_latest());
        samples.into_values().filter_map(Entry::unsent).collect()
    }

    /// The samples that are told live since `since` or longer and that the store does not have: they are on their way there
    /// now. Their names are for [`handle_stored`](Self::handle_stored).
    pub fn take_overdue(&mut self, since: Instant) -> Vec<(MessageId, Message)> {
        let mut overdue = Vec::new();
        for (id, entry) in self.in_flight.iter_mut().chain(&mut self.latest) {
            if let Origin::Sample(told, copied @ Copied::No) = &mut entry.origin
                && *told <= since
            {
                *copied = Copied::Soon;
                overdue.push((*id, entry.message.clone()));
            }
        }
        overdue
    }

    /// Since when the oldest sample is told live that the store does not have.
    #[must_use]
    pub fn oldest_sample(&self) -> Option<Instant> {
        let told = |entry: &Entry| match entry.origin {
            Origin::Sample(told, Copied::No) => Some(told),
            Origin::Sample(..) | Origin::Here | Origin::Stored(..) | Origin::Forgotten => None,
        };
        self.in_flight.values().chain(self.latest.values()).filter_map(told).min()
    }

    /// The store has a sample there. `false` when it need not keep it: the broker has it.
    pub fn handle_stored(&mut self, id: MessageId, position: u64) -> bool {
        if self.acknowledged_soon.remove(&id) {
            return false;
        }
        let entry = self.in_flight.get_mut(&id).or_else(|| self.latest.get_mut(&id));
        if let Some(Entry { origin: Origin::Sample(_, copied @ Copied::Soon), .. }) = entry {
            *copied = Copied::At(position);
        }
        true
    }

    /// The first position among the samples of the store that are still told live: the history must not go further.
    #[must_use]
    pub fn first_told_live(&self) -> Option<u64> {
        let position = |entry: &Entry| match entry.origin {
            Origin::Sample(_, Copied::At(position)) => Some(position),
            Origin::Sample(..) | Origin::Here | Origin::Stored(..) | Origin::Forgotten => None,
        };
        self.in_flight.values().chain(self.latest.values()).filter_map(position).min()
    }

    /// Messages of the store that wait, of a class.
    #[must_use]
    pub fn stored_waiting(&self, class: Class) -> usize {
        match class {
            Class::Sample => self.history.len(),
            Class::Event => self.stored_events,
        }
    }

    /// Positions in the store are others now: all that came out of it is forgotten, and will come again.
    pub fn forget_stored(&mut self) {
        let is_stored = |(id, entry): (&MessageId, &Entry)| entry.stored().is_some().then_some(*id);
        let waiting: Vec<_> = self.events.iter().chain(&self.history).filter_map(is_stored).collect();
        for id in waiting {
            self.remove_waiting(id);
        }
        for entry in self.in_flight.values_mut().chain(self.latest.values_mut()) {
            if entry.stored().is_some() {
                entry.origin = Origin::Forgotten;
            }
        }
    }

    /// Nothing that waits will be sent any more; what is in flight may still be acknowledged. What the store has is not
    /// lost with that. Gives the samples that it does not have.
    pub fn clear_waiting(&mut self) -> Vec<Unsent> {
        let samples = self.let_go_of_latest();
        while let Some(id) = self.events.keys().chain(self.history.keys()).next().copied() {
            if self.remove_waiting(id).is_some_and(|entry| entry.stored().is_none()) {
                count(&mut self.report.events_dropped);
            }
        }
        samples.into_values().filter_map(Entry::unsent).collect()
    }

    /// Counts events that never came in.
    pub fn count_missed(&mut self, missed: u64) {
        self.report.events_missed = self.report.events_missed.saturating_add(missed);
    }

    /// Whether nothing waits and nothing is in flight.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.report.messages == 0
    }

    /// Messages that are sent and not acknowledged.
    #[must_use]
    pub fn in_flight(&self) -> usize {
        self.in_flight.len()
    }

    /// Fill and counters.
    #[must_use]
    pub fn report(&self) -> &OutboxReport {
        &self.report
    }

    fn next_id(&mut self) -> MessageId {
        self.next += 1;
        MessageId(self.next)
    }

    fn may_send_history(&self) -> bool {
        let is_history = |entry: &&Entry| matches!(entry.origin, Origin::Stored(Class::Sample, _));
        let in_flight = self.in_flight.values().filter(is_history).count();
        !self.history.is_empty() && in_flight < (self.limits.window / 2).max(1)
    }

    fn let_go_of_latest(&mut self) -> BTreeMap<MessageId, Entry> {
        let mut gone = BTreeMap::new();
        while let Some(id) = self.latest.keys().next().copied() {
            gone.extend(self.remove_waiting(id).map(|entry| (id, entry)));
            count(&mut self.report.superseded);
        }
        gone
    }

    fn insert_waiting(&mut self, id: MessageId, entry: Entry) {
        self.count_in(&entry);
        if entry.message.retain {
            self.latest_of.insert(Arc::clone(&entry.message.topic), id);
            self.latest.insert(id, entry);
        } else if matches!(entry.origin, Origin::Stored(Class::Sample, _)) {
            self.history.insert(id, entry);
        } else {
            self.stored_events += usize::from(entry.stored().is_some());
            self.events.insert(id, entry);
        }
    }

    fn remove_waiting(&mut self, id: MessageId) -> Option<Entry> {
        let found = self.latest.remove(&id).or_else(|| {
            let event = self.events.remove(&id)?;
            self.stored_events -= usize::from(event.stored().is_some());
            Some(event)
        });
        let entry = found.or_else(|| self.history.remove(&id))?;
        if entry.message.retain {
            self.latest_of.remove(&entry.message.topic);
        }
        self.count_out(&entry);
        Some(entry)
    }

    fn count_in(&mut self, entry: &Entry) {
        let size = entry.message.size();
        self.report.messages += 1;
        self.report.bytes += size;
        if entry.counts() {
            self.report.held = (self.report.held.0 + 1, self.report.held.1 + size);
        }
    }

    fn count_out(&mut self, entry: &Entry) {
        let size = entry.message.size();
        self.report.messages -= 1;
        self.report.bytes -= size;
        if entry.counts() {
            self.report.held = (self.report.held.0 - 1, self.report.held.1 - size);
        }
    }
}

impl Entry {
    /// Whether the limits hold for it.
    fn counts(&self) -> bool {
        !self.message.retain && self.origin == Origin::Here
    }

    fn is_copied(&self, copied: Copied) -> bool {
        matches!(self.origin, Origin::Sample(_, is) if is == copied)
    }

    /// Where the store has it.
    fn stored(&self) -> Option<(Class, u64)> {
        match self.origin {
            Origin::Stored(class, position) => Some((class, position)),
            Origin::Sample(_, Copied::At(position)) => Some((Class::Sample, position)),
            Origin::Sample(..) | Origin::Here | Origin::Forgotten => None,
        }
    }

    /// The message, where it is a sample that the store does not have.
    fn unsent(self) -> Option<Unsent> {
        self.is_copied(Copied::No).then_some(self.message)
    }
}

fn count(counter: &mut u64) {
    *counter = counter.saturating_add(1);
}

#[cfg(test)]
#[path = "outbox/outbox_tests.rs"]
mod tests;
