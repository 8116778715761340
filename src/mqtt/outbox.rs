//! What the broker has not acknowledged yet: ordered, bounded in count and bytes, in memory.
//!
//! Two lanes take turns, so that what is live never waits behind a backlog of events:
//!
//! - *latest*: retained topics. Of one topic only the newest message waits; it takes the place of the one before.
//! - *all*: events. Every one is kept, in order.
//!
//! A message is forgotten when it is acknowledged, superseded by a newer one of its retained topic, or dropped because
//! the outbox is full; the last two are counted. When the session is lost, events that were not acknowledged go back in
//! front, in order, and will be sent again; what is retained is let go, because each session begins with all of it.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

/// What a message is, in the order in which messages leave a full outbox.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Class {
    /// Values: soon replaced by newer ones.
    Sample,
    /// How gateway and nodes are.
    Status,
    /// The present state of an alarm.
    Alarm,
    /// What happened.
    Event,
}

impl Class {
    /// All classes, the first to leave first.
    pub const ALL: [Self; 4] = [Self::Sample, Self::Status, Self::Alarm, Self::Event];

    /// The word in `bridge/health` and metrics.
    #[must_use]
    pub fn word(self) -> &'static str {
        match self {
            Self::Sample => "sample",
            Self::Status => "status",
            Self::Alarm => "alarm",
            Self::Event => "event",
        }
    }
}

/// A message for the broker.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Message {
    /// Where to.
    pub topic: Arc<str>,
    /// JSON.
    pub payload: Arc<str>,
    /// Quality of service 1, else 0.
    pub acknowledged: bool,
    /// The broker keeps it for later subscribers; of those that wait only the newest is kept.
    pub retain: bool,
    /// When it leaves a full outbox.
    pub class: Class,
}

impl Message {
    /// What it takes of the outbox's bytes.
    #[must_use]
    pub fn size(&self) -> usize {
        self.topic.len().saturating_add(self.payload.len())
    }
}

/// Names a message between [`Outbox::poll_output`] and [`Outbox::handle_acknowledged`].
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct MessageId(u64);

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
    /// Messages, sent and waiting.
    pub messages: usize,
    /// Bytes of topics and payloads, sent and waiting.
    pub bytes: usize,
    /// Messages that may be sent and not acknowledged at the same time.
    pub window: usize,
    /// Bytes of one message; a larger one is counted and thrown away, because a broker would cut the session.
    pub message: usize,
}

/// Fill and counters since the start. Counters saturate.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct OutboxReport {
    /// Messages in the outbox.
    pub messages: usize,
    /// Most messages.
    pub messages_limit: usize,
    /// Bytes in the outbox.
    pub bytes: usize,
    /// Most bytes.
    pub bytes_limit: usize,
    /// Times that a message was handed to the session.
    pub sent: u64,
    /// Of those: after an earlier try whose session ended.
    pub sent_again: u64,
    /// Acknowledged by the broker.
    pub acknowledged: u64,
    /// Retained messages that a newer one of the same topic replaced before they were acknowledged.
    pub superseded: u64,
    /// Larger than the limit of one message.
    pub too_large: u64,
    /// Events that left the journal before they could be read.
    pub events_missed: u64,
    /// Events taken in, and their bytes: for the forecast.
    pub events: (u64, u64),
    /// Dropped because the outbox was full, by the place of the class in [`Class::ALL`].
    pub dropped_by_class: [u64; 4],
}

impl OutboxReport {
    /// Messages dropped because the outbox was full, of each class.
    pub fn dropped(&self) -> impl Iterator<Item = (Class, u64)> + '_ {
        Class::ALL.into_iter().zip(self.dropped_by_class)
    }

    /// How long events at their mean rate so far would take to fill what is free; `None` before the first event.
    /// At most 10,000 hours.
    #[must_use]
    #[expect(clippy::as_conversions, clippy::cast_precision_loss, reason = "a forecast needs no 53 bits")]
    pub fn hours_left(&self, uptime_s: u64) -> Option<f64> {
        let (events, bytes) = self.events;
        let hours = uptime_s.max(1) as f64 / 3600.0;
        let left = |free: usize, used: u64| free as f64 / (used as f64 / hours);
        let by_count = left(self.messages_limit.saturating_sub(self.messages), events);
        let by_bytes = left(self.bytes_limit.saturating_sub(self.bytes), bytes);
        (events > 0).then(|| by_count.min(by_bytes).min(10_000.0))
    }
}

#[derive(Clone, Debug)]
struct Entry {
    message: Message,
    /// Sent in an earlier session.
    sent_before: bool,
}

/// The outbox.
#[derive(Clone, Debug)]
pub struct Outbox {
    limits: Limits,
    /// Retained messages that wait, oldest first.
    latest: BTreeMap<MessageId, Entry>,
    /// Where the waiting message of a retained topic stands.
    latest_of: BTreeMap<Arc<str>, MessageId>,
    /// Other messages that wait, oldest first.
    all: BTreeMap<MessageId, Entry>,
    /// Waiting messages by class, for dropping.
    waiting: [BTreeSet<MessageId>; 4],
    /// Sent, not acknowledged.
    in_flight: BTreeMap<MessageId, Entry>,
    next: u64,
    /// The lane whose turn it is.
    latest_turn: bool,
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
            all: BTreeMap::new(),
            waiting: Default::default(),
            in_flight: BTreeMap::new(),
            next: 0,
            latest_turn: true,
            report,
        }
    }

    /// Takes a message in. When that is too much, others leave: the lowest class first, and of a class the oldest.
    /// What was sent already does not leave.
    pub fn push(&mut self, message: Message) {
        if message.size() > self.limits.message {
            self.report.too_large = self.report.too_large.saturating_add(1);
            return;
        }
        if message.class == Class::Event {
            let (events, bytes) = self.report.events;
            let size = u64::try_from(message.size()).unwrap_or(u64::MAX);
            self.report.events = (events.saturating_add(1), bytes.saturating_add(size));
        }
        let superseded = if message.retain { self.latest_of.get(&message.topic).copied() } else { None };
        let id = superseded.unwrap_or_else(|| self.next_id());
        if superseded.is_some() {
            self.remove_waiting(id);
            self.report.superseded = self.report.superseded.saturating_add(1);
        }
        self.insert_waiting(id, Entry { message, sent_before: false });
        while self.report.messages > self.limits.messages || self.report.bytes > self.limits.bytes {
            if !self.drop_one() {
                break;
            }
        }
    }

    /// The next message to send, while the window is open.
    pub fn poll_output(&mut self) -> Option<Outgoing> {
        if self.in_flight.len() >= self.limits.window {
            return None;
        }
        let from_latest = (self.latest_turn || self.all.is_empty()) && !self.latest.is_empty();
        let lane = if from_latest { &self.latest } else { &self.all };
        let id = *lane.keys().next()?;
        self.latest_turn = !from_latest;
        let entry = self.remove_waiting(id)?;
        self.count_in(&entry);
        self.report.sent = self.report.sent.saturating_add(1);
        self.report.sent_again = self.report.sent_again.saturating_add(u64::from(entry.sent_before));
        let outgoing = Outgoing { id, message: entry.message.clone(), again: entry.sent_before };
        self.in_flight.insert(id, entry);
        Some(outgoing)
    }

    /// The broker has it: forgotten. An id that is not in flight is ignored.
    pub fn handle_acknowledged(&mut self, id: MessageId) {
        if let Some(entry) = self.in_flight.remove(&id) {
            self.count_out(&entry);
            self.report.acknowledged = self.report.acknowledged.saturating_add(1);
        }
    }

    /// The session ended: events in flight go back in front, in order; what is retained is let go.
    pub fn handle_session_down(&mut self) {
        for (id, entry) in std::mem::take(&mut self.in_flight) {
            self.count_out(&entry);
            if entry.message.retain {
                self.report.superseded = self.report.superseded.saturating_add(1);
            } else {
                self.insert_waiting(id, Entry { sent_before: true, ..entry });
            }
        }
        let retained: Vec<_> = self.latest.keys().copied().collect();
        for id in retained {
            self.remove_waiting(id);
            self.report.superseded = self.report.superseded.saturating_add(1);
        }
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

    /// Drops the oldest waiting message of the lowest class that has one; `false` when nothing waits.
    fn drop_one(&mut self) -> bool {
        let Some((class, id)) =
            Class::ALL.into_iter().find_map(|class| Some((class, *self.class_set(class).first()?)))
        else {
            return false;
        };
        self.remove_waiting(id);
        if let Some(dropped) = self.report.dropped_by_class.get_mut(place(class)) {
            *dropped = dropped.saturating_add(1);
        }
        true
    }

    fn insert_waiting(&mut self, id: MessageId, entry: Entry) {
        self.count_in(&entry);
        self.class_set(entry.message.class).insert(id);
        if entry.message.retain {
            self.latest_of.insert(Arc::clone(&entry.message.topic), id);
            self.latest.insert(id, entry);
        } else {
            self.all.insert(id, entry);
        }
    }

    fn remove_waiting(&mut self, id: MessageId) -> Option<Entry> {
        let entry = self.latest.remove(&id).or_else(|| self.all.remove(&id))?;
        self.class_set(entry.message.class).remove(&id);
        if entry.message.retain {
            self.latest_of.remove(&entry.message.topic);
        }
        self.count_out(&entry);
        Some(entry)
    }

    fn class_set(&mut self, class: Class) -> &mut BTreeSet<MessageId> {
        let [sample, status, alarm, event] = &mut self.waiting;
        match class {
            Class::Sample => sample,
            Class::Status => status,
            Class::Alarm => alarm,
            Class::Event => event,
        }
    }

    fn count_in(&mut self, entry: &Entry) {
        self.report.messages += 1;
        self.report.bytes += entry.message.size();
    }

    fn count_out(&mut self, entry: &Entry) {
        self.report.messages -= 1;
        self.report.bytes -= entry.message.size();
    }
}

fn place(class: Class) -> usize {
    match class {
        Class::Sample => 0,
        Class::Status => 1,
        Class::Alarm => 2,
        Class::Event => 3,
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn message(topic: &str, payload: &str, retain: bool, class: Class) -> Message {
        Message { topic: topic.into(), payload: payload.into(), acknowledged: true, retain, class }
    }

    fn outbox(messages: usize, window: usize) -> Outbox {
        Outbox::new(Limits { messages, bytes: 1_000_000, window, message: 1000 })
    }

    fn drain(outbox: &mut Outbox) -> Vec<String> {
        std::iter::from_fn(|| outbox.poll_output()).map(|out| out.message.payload.to_string()).collect()
    }

    fn dropped(outbox: &Outbox, class: Class) -> u64 {
        outbox.report().dropped().find(|(of, _)| *of == class).unwrap().1
    }

    #[test]
    fn of_a_retained_topic_only_the_newest_waits_at_its_place() {
        let mut outbox = outbox(10, 10);
        outbox.push(message("a", "a1", true, Class::Sample));
        outbox.push(message("b", "b1", true, Class::Sample));
        outbox.push(message("a", "a2", true, Class::Sample));
        assert_eq!(drain(&mut outbox), ["a2", "b1"]);
        assert_eq!(outbox.report().superseded, 1);
        outbox.push(message("a", "a3", true, Class::Sample));
        assert_eq!(drain(&mut outbox), ["a3"], "what is sent already is not superseded");
    }

    #[test]
    fn a_full_outbox_lets_samples_go_first_then_the_oldest_events() {
        let mut outbox = outbox(4, 0);
        outbox.push(message("state", "s", true, Class::Sample));
        outbox.push(message("health", "h", true, Class::Status));
        outbox.push(message("alarm", "a", true, Class::Alarm));
        for number in 1..=6 {
            outbox.push(message("event", &format!("e{number}"), false, Class::Event));
        }
        outbox.push(message("state", "late", true, Class::Sample));
        let counts = Class::ALL.map(|class| dropped(&outbox, class));
        assert_eq!(counts, [2, 1, 1, 2]);
        outbox.limits.window = 10;
        assert_eq!(drain(&mut outbox), ["e3", "e4", "e5", "e6"]);
    }

    #[test]
    fn p5_after_a_lost_session_events_come_again_in_order_and_are_marked() {
        let mut outbox = outbox(10, 3);
        for number in 1..=4 {
            outbox.push(message("event", &format!("e{number}"), false, Class::Event));
        }
        let sent: Vec<_> = std::iter::from_fn(|| outbox.poll_output()).collect();
        assert!(sent.iter().all(|out| !out.again));
        outbox.handle_acknowledged(sent[1].id);
        outbox.handle_session_down();
        outbox.limits.window = 10;
        let again: Vec<_> = std::iter::from_fn(|| outbox.poll_output())
            .map(|out| (out.message.payload.to_string(), out.again))
            .collect();
        let expected =
            [("e1", true), ("e3", true), ("e4", false)].map(|(name, again)| (name.to_owned(), again));
        assert_eq!(again, expected);
    }

    #[test]
    fn p6_what_is_live_takes_turns_with_the_backlog() {
        let mut outbox = outbox(100, 100);
        for number in 1..=3 {
            outbox.push(message("event", &format!("e{number}"), false, Class::Event));
        }
        outbox.push(message("a", "live1", true, Class::Sample));
        outbox.push(message("b", "live2", true, Class::Sample));
        assert_eq!(drain(&mut outbox), ["live1", "e1", "live2", "e2", "e3"]);
    }

    #[test]
    fn a_message_that_no_broker_takes_is_counted_and_thrown_away() {
        let mut outbox = outbox(10, 10);
        outbox.push(message("event", &"x".repeat(2000), false, Class::Event));
        assert!(outbox.is_empty());
        assert_eq!(outbox.report().too_large, 1);
    }

    #[test]
    fn the_forecast_is_what_is_free_over_the_mean_rate() {
        let mut outbox = outbox(110, 0);
        assert_eq!(outbox.report().hours_left(3600), None);
        (0..10).for_each(|_| outbox.push(message("event", "x", false, Class::Event)));
        assert_eq!(outbox.report().hours_left(3600), Some(10.0));
    }

    #[derive(Clone, Debug)]
    enum Step {
        Push { topic: usize, size: usize },
        Send,
        Acknowledge { which: usize },
        SessionDown,
    }

    fn step() -> impl Strategy<Value = Step> {
        prop_oneof![
            6 => (0usize..6, 1usize..40).prop_map(|(topic, size)| Step::Push { topic, size }),
            6 => Just(Step::Send),
            4 => (0usize..4).prop_map(|which| Step::Acknowledge { which }),
            1 => Just(Step::SessionDown),
        ]
    }

    /// Topics 0 and 1 are events, the others retained, one of each class.
    fn topic_class(topic: usize) -> (bool, Class) {
        [
            (false, Class::Event),
            (false, Class::Event),
            (true, Class::Event),
            (true, Class::Alarm),
            (true, Class::Status),
            (true, Class::Sample),
        ][topic]
    }

    proptest! {
        #[test]
        fn p1_p5_p6_nothing_is_lost_uncounted_reordered_or_doubled_within_a_session(
            steps in proptest::collection::vec(step(), 1..300),
            messages in 1usize..12,
            window in 1usize..5,
        ) {
            let mut outbox = Outbox::new(Limits { messages, bytes: 250, window, message: 35 });
            let mut pushed = 0u64;
            // Sequence number -> session in which it was sent last.
            let mut sent: BTreeMap<u64, u64> = BTreeMap::new();
            // Highest sequence number sent first, of each topic.
            let mut newest: BTreeMap<String, u64> = BTreeMap::new();
            let mut in_flight: Vec<MessageId> = Vec::new();
            let mut session = 0u64;
            for step in steps {
                match step {
                    Step::Push { topic, size } => {
                        pushed += 1;
                        let (retain, class) = topic_class(topic);
                        let payload = format!("{pushed:0size$}");
                        outbox.push(message(&topic.to_string(), &payload, retain, class));
                    }
                    Step::Send => {
                        if let Some(out) = outbox.poll_output() {
                            let seq: u64 = out.message.payload.parse().unwrap();
                            let before = sent.insert(seq, session);
                            prop_assert_eq!(before.is_some(), out.again);
                            prop_assert!(before.is_none_or(|before| before < session), "twice in a session");
                            let newest = newest.entry(out.message.topic.to_string()).or_default();
                            prop_assert!(out.again || seq > *newest, "first deliveries in order");
                            *newest = seq.max(*newest);
                            in_flight.push(out.id);
                            prop_assert!(in_flight.len() <= window);
                        }
                    }
                    Step::Acknowledge { which } => {
                        if which < in_flight.len() {
                            outbox.handle_acknowledged(in_flight.remove(which));
                        }
                    }
                    Step::SessionDown => {
                        session += 1;
                        in_flight.clear();
                        outbox.handle_session_down();
                    }
                }
                let report = *outbox.report();
                let waiting = outbox.all.len() + outbox.latest.len();
                prop_assert_eq!(report.messages, waiting + outbox.in_flight.len());
                prop_assert_eq!(outbox.waiting.iter().map(BTreeSet::len).sum::<usize>(), waiting);
                prop_assert_eq!(outbox.latest_of.len(), outbox.latest.len());
                let bytes = outbox.all.values().chain(outbox.latest.values()).chain(outbox.in_flight.values());
                prop_assert_eq!(report.bytes, bytes.map(|entry| entry.message.size()).sum::<usize>());
                prop_assert!(report.messages <= messages.max(window) && report.bytes <= 250);
                let gone: u64 = report.dropped().map(|(_, dropped)| dropped).sum();
                let left = u64::try_from(report.messages).unwrap();
                prop_assert_eq!(
                    pushed,
                    report.acknowledged + report.superseded + report.too_large + gone + left
                );
            }
        }
    }
}
