//! What the broker has not acknowledged yet: ordered, bounded, in memory.
//!
//! Two lanes take turns, so that what is live never waits behind a backlog of events:
//!
//! - *latest*: retained topics. Of one topic only the newest message waits; it takes the place of the one before. There
//!   are only so many topics, so nothing has to leave this lane: what was told to it reaches the broker.
//! - *events*: every one is kept, in order, within the limits in count and bytes. When they are full, the oldest leaves.
//!
//! A message is forgotten when it is acknowledged, superseded by a newer one of its retained topic, or dropped because
//! the outbox is full; the last two are counted. When the session is lost, events that were not acknowledged go back in
//! front, in order, and will be sent again; what is retained is let go, because each session begins with all of it.

use std::collections::BTreeMap;
use std::sync::Arc;

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
    /// Events, sent and waiting.
    pub messages: usize,
    /// Bytes of topics and payloads of events, sent and waiting.
    pub bytes: usize,
    /// Messages that may be sent and not acknowledged at the same time.
    pub window: usize,
    /// Bytes of one message; a larger one is counted and thrown away, because a broker would cut the session.
    pub message: usize,
}

/// Fill and counters since the start. Counters saturate.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct OutboxReport {
    /// Messages in the outbox: events, and at most one waiting for each retained topic.
    pub messages: usize,
    /// Most events.
    pub messages_limit: usize,
    /// Bytes in the outbox.
    pub bytes: usize,
    /// Most bytes of events.
    pub bytes_limit: usize,
    /// Events in the outbox, and their bytes: what the limits hold for.
    pub held: (usize, usize),
    /// Times that a message was handed to the session.
    pub sent: u64,
    /// Of those: after an earlier try whose session ended.
    pub sent_again: u64,
    /// Acknowledged by the broker.
    pub acknowledged: u64,
    /// Retained messages that were let go without an acknowledgement: a newer one of the same topic replaced them, or the
    /// session was lost.
    pub superseded: u64,
    /// Larger than the limit of one message.
    pub too_large: u64,
    /// Events that left the journal before they could be read.
    pub events_missed: u64,
    /// Events taken in, and their bytes: for the forecast.
    pub events: (u64, u64),
    /// Events dropped because the outbox was full.
    pub events_dropped: u64,
}

impl OutboxReport {
    /// Messages dropped because the outbox was full, by class. Only events can be; the other classes are a promise of
    /// version 1 of the payloads.
    #[must_use]
    pub fn dropped(&self) -> [(&'static str, u64); 4] {
        [("sample", 0), ("status", 0), ("alarm", 0), ("event", self.events_dropped)]
    }

    /// How long events at their mean rate so far would take to fill what is free; `None` before the first event.
    /// At most 10,000 hours.
    #[must_use]
    #[expect(clippy::as_conversions, clippy::cast_precision_loss, reason = "a forecast needs no 53 bits")]
    pub fn hours_left(&self, uptime_s: u64) -> Option<f64> {
        let (events, bytes) = self.events;
        let hours = uptime_s.max(1) as f64 / 3600.0;
        let left = |free: usize, used: u64| free as f64 / (used as f64 / hours);
        let by_count = left(self.messages_limit.saturating_sub(self.held.0), events);
        let by_bytes = left(self.bytes_limit.saturating_sub(self.held.1), bytes);
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
    /// Events that wait, oldest first.
    events: BTreeMap<MessageId, Entry>,
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
            events: BTreeMap::new(),
            in_flight: BTreeMap::new(),
            next: 0,
            latest_turn: true,
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
        let superseded = if message.retain { self.latest_of.get(&message.topic).copied() } else { None };
        let id = superseded.unwrap_or_else(|| self.next_id());
        if superseded.is_some() {
            self.remove_waiting(id);
            count(&mut self.report.superseded);
        }
        self.insert_waiting(id, Entry { message, sent_before: false });
        while self.report.held.0 > self.limits.messages || self.report.held.1 > self.limits.bytes {
            let Some(oldest) = self.events.keys().next().copied() else { break };
            self.remove_waiting(oldest);
            count(&mut self.report.events_dropped);
        }
        Some(id)
    }

    /// The next message to send, while the window is open.
    pub fn poll_output(&mut self) -> Option<Outgoing> {
        if self.in_flight.len() >= self.limits.window {
            return None;
        }
        let from_latest = (self.latest_turn || self.events.is_empty()) && !self.latest.is_empty();
        let lane = if from_latest { &self.latest } else { &self.events };
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

    /// The broker has it: forgotten. An id that is not in flight is ignored.
    pub fn handle_acknowledged(&mut self, id: MessageId) {
        if let Some(entry) = self.in_flight.remove(&id) {
            self.count_out(&entry);
            count(&mut self.report.acknowledged);
        }
    }

    /// The session ended: events in flight go back in front, in order; what is retained is let go.
    pub fn handle_session_down(&mut self) {
        for (id, entry) in std::mem::take(&mut self.in_flight) {
            self.count_out(&entry);
            if entry.message.retain {
                count(&mut self.report.superseded);
            } else {
                self.insert_waiting(id, Entry { sent_before: true, ..entry });
            }
        }
        self.let_go_of_latest();
    }

    /// Nothing that waits will be sent any more; what is in flight may still be acknowledged.
    pub fn clear_waiting(&mut self) {
        self.let_go_of_latest();
        while let Some(id) = self.events.keys().next().copied() {
            self.remove_waiting(id);
            count(&mut self.report.events_dropped);
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

    fn let_go_of_latest(&mut self) {
        while let Some(id) = self.latest.keys().next().copied() {
            self.remove_waiting(id);
            count(&mut self.report.superseded);
        }
    }

    fn insert_waiting(&mut self, id: MessageId, entry: Entry) {
        self.count_in(&entry);
        if entry.message.retain {
            self.latest_of.insert(Arc::clone(&entry.message.topic), id);
            self.latest.insert(id, entry);
        } else {
            self.events.insert(id, entry);
        }
    }

    fn remove_waiting(&mut self, id: MessageId) -> Option<Entry> {
        let entry = self.latest.remove(&id).or_else(|| self.events.remove(&id))?;
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
        if !entry.message.retain {
            self.report.held = (self.report.held.0 + 1, self.report.held.1 + size);
        }
    }

    fn count_out(&mut self, entry: &Entry) {
        let size = entry.message.size();
        self.report.messages -= 1;
        self.report.bytes -= size;
        if !entry.message.retain {
            self.report.held = (self.report.held.0 - 1, self.report.held.1 - size);
        }
    }
}

fn count(counter: &mut u64) {
    *counter = counter.saturating_add(1);
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn message(topic: &str, payload: &str, retain: bool) -> Message {
        Message { topic: topic.into(), payload: payload.into(), at_least_once: true, retain }
    }

    fn outbox(messages: usize, window: usize) -> Outbox {
        Outbox::new(Limits { messages, bytes: 1_000_000, window, message: 1000 })
    }

    fn drain(outbox: &mut Outbox) -> Vec<String> {
        std::iter::from_fn(|| outbox.poll_output()).map(|out| out.message.payload.to_string()).collect()
    }

    #[test]
    fn of_a_retained_topic_only_the_newest_waits_at_its_place() {
        let mut outbox = outbox(10, 10);
        outbox.push(message("a", "a1", true));
        outbox.push(message("b", "b1", true));
        outbox.push(message("a", "a2", true));
        assert_eq!(drain(&mut outbox), ["a2", "b1"]);
        assert_eq!(outbox.report().superseded, 1);
        outbox.push(message("a", "a3", true));
        assert_eq!(drain(&mut outbox), ["a3"], "what is sent already is not superseded");
    }

    #[test]
    fn a_full_outbox_lets_the_oldest_events_go_and_nothing_that_is_retained() {
        let mut outbox = outbox(4, 0);
        outbox.push(message("state", "s", true));
        outbox.push(message("alarm", "a", true));
        for number in 1..=6 {
            outbox.push(message("event", &format!("e{number}"), false));
        }
        outbox.push(message("health", "h", true));
        assert_eq!(outbox.report().events_dropped, 2);
        outbox.limits.window = 10;
        assert_eq!(drain(&mut outbox), ["s", "e3", "a", "e4", "h", "e5", "e6"]);
    }

    #[test]
    fn what_waits_at_a_stop_is_let_go_and_counted_what_is_sent_may_still_be_acknowledged() {
        let mut outbox = outbox(10, 1);
        for (topic, retain) in [("event", false), ("event", false), ("state", true)] {
            outbox.push(message(topic, "x", retain));
        }
        let sent = outbox.poll_output().unwrap();
        outbox.clear_waiting();
        assert_eq!((outbox.report().messages, outbox.report().held.0), (1, 0));
        assert_eq!(outbox.report().events_dropped, 2);
        outbox.handle_acknowledged(sent.id);
        assert!(outbox.is_empty());
    }

    #[test]
    fn p5_after_a_lost_session_events_come_again_in_order_and_are_marked() {
        let mut outbox = outbox(10, 3);
        for number in 1..=4 {
            outbox.push(message("event", &format!("e{number}"), false));
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
            outbox.push(message("event", &format!("e{number}"), false));
        }
        outbox.push(message("a", "live1", true));
        outbox.push(message("b", "live2", true));
        assert_eq!(drain(&mut outbox), ["live1", "e1", "live2", "e2", "e3"]);
    }

    #[test]
    fn a_message_that_no_broker_takes_is_counted_and_thrown_away() {
        let mut outbox = outbox(10, 10);
        outbox.push(message("event", &"x".repeat(2000), false));
        assert!(outbox.is_empty());
        assert_eq!(outbox.report().too_large, 1);
    }

    #[test]
    fn the_forecast_is_what_is_free_over_the_mean_rate() {
        let mut outbox = outbox(110, 0);
        assert_eq!(outbox.report().hours_left(3600), None);
        for _ in 0..10 {
            outbox.push(message("event", "x", false));
        }
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

    /// Topics 0 and 1 are events, the others retained.
    fn is_retained(topic: usize) -> bool {
        topic >= 2
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
                        let payload = format!("{pushed:0size$}");
                        outbox.push(message(&topic.to_string(), &payload, is_retained(topic)));
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
                let waiting = outbox.events.len() + outbox.latest.len();
                prop_assert_eq!(report.messages, waiting + outbox.in_flight.len());
                prop_assert_eq!(outbox.latest_of.len(), outbox.latest.len());
                let all = || outbox.events.values().chain(outbox.latest.values()).chain(outbox.in_flight.values());
                prop_assert_eq!(report.bytes, all().map(|entry| entry.message.size()).sum::<usize>());
                let events = || all().filter(|entry| !entry.message.retain);
                prop_assert_eq!(report.held.0, events().count());
                prop_assert_eq!(report.held.1, events().map(|entry| entry.message.size()).sum::<usize>());
                prop_assert!(report.held.0 <= messages.max(window) && report.held.1 <= 250);
                prop_assert!(outbox.latest.len() <= 4, "one for each retained topic");
                let left = u64::try_from(report.messages).unwrap();
                prop_assert_eq!(
                    pushed,
                    report.acknowledged + report.superseded + report.too_large + report.events_dropped + left
                );
            }
        }
    }
}
