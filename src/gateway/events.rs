//! Events on their way to the journal: numbered without a gap, and a storm of one kind folded into a count.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use super::refusals::{Refusals, Report};
use crate::alarms::Transition;
use crate::mapping::{AlarmOwner, TagTable};
use crate::process_image::{Event, EventKind, TagIndex};
use crate::time::{Instant, Now, Timestamp};

/// Events of one kind about one node or bus that are journalled one by one within [`WINDOW`]; those above are folded.
const BURST: u32 = 10;

/// How long events of one kind are counted together. A kind that storms is journalled once for each window, with
/// its count, until a window had no more than [`BURST`]: one that comes a thousand times a second cannot flush the journal.
const WINDOW: Duration = Duration::from_secs(10);

/// What is counted together: the same name about the same node, bus or gateway.
type Key = (AlarmOwner, Name);

/// What happened.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Name {
    /// A word of the gateway.
    Word(&'static str),
    /// A bool tag of which edges are counted has changed; the event bears the tag's name.
    Edge(TagIndex),
}

/// Events that are not yet in the journal.
#[derive(Debug)]
pub(super) struct EventLog {
    table: Arc<TagTable>,
    newest: u64,
    /// The task publishes after a bounded batch of inputs, and each input causes a few events at most.
    pending: Vec<Event>,
    windows: BTreeMap<Key, Window>,
    next_flush: Option<Instant>,
    refusals: Refusals,
}

#[derive(Debug)]
struct Window {
    ends: Instant,
    passed: u32,
    folded: u64,
    /// How the last folded one was: `from` and `to`.
    last: (String, String),
    storming: bool,
}

impl EventLog {
    /// The first event will have the number `newest` + 1.
    pub(super) fn new(table: Arc<TagTable>, newest: u64) -> Self {
        let (pending, windows, refusals) = (Vec::new(), BTreeMap::new(), Refusals::default());
        Self { table, newest, pending, windows, next_flush: None, refusals }
    }

    /// Goes on counting where another log stopped. What that still counted is to be flushed before.
    pub(super) fn take_over(&mut self, old: &Self) {
        self.newest = old.newest;
    }

    /// The next events have numbers that are so much higher. Those before have been [drained](Self::drain).
    pub(super) fn number_higher(&mut self, by: u64) {
        self.newest += by;
    }

    /// Journals all counts at once, before their time.
    pub(super) fn flush(&mut self, now: Now) {
        for report in self.refusals.take_all() {
            self.record_request(now, report);
        }
        let folded: Vec<Key> =
            self.windows.iter().filter(|(_, window)| window.folded > 0).map(|(key, _)| *key).collect();
        for key in folded {
            self.close_window(now, key);
        }
        self.next_flush = None;
    }

    /// Something happened to a node, a bus or the gateway. `fill` completes the event; of those that are folded into a
    /// count the last one's `from` and `to` are kept.
    pub(super) fn record(&mut self, now: Now, about: AlarmOwner, name: Name, fill: impl FnOnce(&mut Event)) {
        let key = (about, name);
        if self.windows.get(&key).is_some_and(|window| window.ends <= now.instant) {
            self.close_window(now, key);
        }
        let window = self.windows.entry(key).or_insert(Window {
            ends: now.instant + WINDOW,
            passed: 0,
            folded: 0,
            last: Default::default(),
            storming: false,
        });
        if window.storming || window.passed >= BURST {
            window.folded = window.folded.saturating_add(1);
            let mut event = blank();
            fill(&mut event);
            window.last = (event.from, event.to);
            let ends = window.ends;
            self.next_flush = Some(self.next_flush.map_or(ends, |flush| flush.min(ends)));
            return;
        }
        window.passed += 1;
        self.push(now, about, name, fill);
    }

    /// An alarm changed its state. Never folded: delays and latching already hold back what flutters.
    pub(super) fn record_transition(&mut self, transition: &Transition) {
        let Some(alarm) = self.table.alarms.get(transition.alarm.0) else { return };
        let (name, owner, text, priority) = (
            alarm.name.clone(),
            alarm.owner,
            alarm.told(transition.status.value).into_owned(),
            alarm.priority,
        );
        self.push(transition.at, owner, Name::Word(""), |event| {
            event.kind = EventKind::Alarm;
            event.name = name;
            transition.from.word().clone_into(&mut event.from);
            transition.to.word().clone_into(&mut event.to);
            event.alarm = Some(transition.alarm);
            event.priority = Some(priority);
            event.value = transition.status.value;
            event.text = text;
        });
    }

    /// Somebody asked for something, and it was done or may have been. Never folded: each of them can have changed something.
    pub(super) fn record_request(&mut self, now: Now, report: Report) {
        self.push(now, report.about, Name::Word(report.name), |event| {
            if report.is_command {
                event.kind = EventKind::Command;
            }
            report.fill(event);
        });
    }

    /// Somebody asked for something that was refused. Those that repeat are folded.
    pub(super) fn record_refusal(&mut self, now: Now, report: Report) {
        if let Some(report) = self.refusals.admit(now.instant, report) {
            self.record_request(now, report);
        }
    }

    /// Journals the counts of storms whose window has ended, and of refusals.
    pub(super) fn handle_timeout(&mut self, now: Now) {
        for report in self.refusals.take_due(now.instant) {
            self.record_request(now, report);
        }
        if self.next_flush.is_none_or(|flush| flush > now.instant) {
            return;
        }
        let due: Vec<Key> = self
            .windows
            .iter()
            .filter(|(_, window)| window.folded > 0 && window.ends <= now.instant)
            .map(|(key, _)| *key)
            .collect();
        for key in due {
            self.close_window(now, key);
        }
        self.next_flush =
            self.windows.values().filter(|window| window.folded > 0).map(|window| window.ends).min();
    }

    /// When the next count is due.
    pub(super) fn poll_timeout(&self) -> Option<Instant> {
        [self.next_flush, self.refusals.poll_timeout()].into_iter().flatten().min()
    }

    /// Takes the events, oldest first.
    pub(super) fn drain(&mut self) -> impl Iterator<Item = Event> + '_ {
        self.pending.drain(..)
    }

    fn close_window(&mut self, now: Now, key: Key) {
        let Some(window) = self.windows.get_mut(&key) else { return };
        let folded = std::mem::take(&mut window.folded);
        let (from, to) = std::mem::take(&mut window.last);
        window.storming = folded > u64::from(BURST);
        window.passed = 0;
        window.ends = now.instant + WINDOW;
        if folded > 0 {
            self.push(now, key.0, key.1, |event| {
                event.from = from;
                event.to = to;
                event.text = format!("{folded} more of these within {} s", WINDOW.as_secs());
            });
        }
    }

    fn push(&mut self, now: Now, about: AlarmOwner, name: Name, fill: impl FnOnce(&mut Event)) {
        let (kind, node, bus) = match about {
            AlarmOwner::Gateway => (EventKind::Gateway, None, None),
            AlarmOwner::Bus(bus) => {
                (EventKind::Bus, None, self.table.buses.get(bus.0).map(|bus| bus.name.clone()))
            }
            AlarmOwner::Node(node) => {
                (EventKind::Node, self.table.node(node).map(|node| node.name.clone()), None)
            }
        };
        let name = match name {
            Name::Word(word) => word.to_owned(),
            Name::Edge(tag) => self.table.tag(tag).map(|tag| tag.name.clone()).unwrap_or_default(),
        };
        self.newest += 1;
        let mut event = Event { seq: self.newest, ts: now.utc, kind, node, bus, name, ..blank() };
        fill(&mut event);
        let told = |text: &str| (!text.is_empty()).then(|| text.to_owned());
        tracing::info!(
            seq = event.seq,
            kind = event.kind.word(),
            node = event.node,
            bus = event.bus,
            from = told(&event.from),
            to = told(&event.to),
            "{}{}{}",
            event.name,
            if event.text.is_empty() { "" } else { ": " },
            event.text
        );
        self.pending.push(event);
    }
}

/// An event of which nothing is said yet.
fn blank() -> Event {
    Event {
        seq: 0,
        ts: Timestamp::default(),
        kind: EventKind::Gateway,
        node: None,
        bus: None,
        name: String::new(),
        from: String::new(),
        to: String::new(),
        alarm: None,
        priority: None,
        value: None,
        text: String::new(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn record(log: &mut EventLog, millis: u64, name: &'static str) {
        log.handle_timeout(Now::from_millis(millis));
        log.record(Now::from_millis(millis), AlarmOwner::Gateway, Name::Word(name), |_| ());
    }

    #[test]
    fn a_storm_of_one_kind_is_folded_into_its_count_and_others_still_pass() {
        let mut log = EventLog::new(Arc::default(), 0);
        for millis in 0..30_000 {
            record(&mut log, millis, "storm");
        }
        record(&mut log, 30_000, "other");
        log.handle_timeout(Now::from_millis(40_000));
        let events: Vec<Event> = log.drain().collect();
        let seqs: Vec<u64> = events.iter().map(|event| event.seq).collect();
        assert_eq!(seqs, (1..=u64::try_from(events.len()).unwrap()).collect::<Vec<_>>(), "no gap");
        let told: u64 = events
            .iter()
            .filter(|event| event.name == "storm")
            .map(|event| event.text.split(' ').next().and_then(|count| count.parse().ok()).unwrap_or(1))
            .sum();
        assert_eq!(told, 30_000, "every one is told of, singly or in a count");
        assert_eq!(events.iter().filter(|event| event.name == "storm").count(), 13);
        assert_eq!(events.iter().filter(|event| event.name == "other").count(), 1);
    }

    #[test]
    fn after_a_quiet_window_events_are_journalled_one_by_one_again() {
        let mut log = EventLog::new(Arc::default(), 0);
        for millis in 0..30 {
            record(&mut log, millis, "storm");
        }
        record(&mut log, 10_000, "storm");
        assert_eq!(log.drain().count(), 11, "ten, and the count; the window after a storm folds still");
        record(&mut log, 20_000, "storm");
        let texts: Vec<String> = log.drain().map(|event| event.text).collect();
        assert_eq!(texts, ["1 more of these within 10 s", ""]);
        assert_eq!(log.poll_timeout(), None);
    }
    #[test]
    fn a_count_tells_how_the_last_of_them_was() {
        let mut log = EventLog::new(Arc::default(), 0);
        for step in 0..30_u64 {
            log.record(Now::from_millis(step), AlarmOwner::Gateway, Name::Word("storm"), |event| {
                event.from = step.to_string();
                event.to = (step + 1).to_string();
            });
        }
        log.handle_timeout(Now::from_millis(10_000));
        let last = log.drain().last().unwrap();
        assert_eq!((last.from.as_str(), last.to.as_str()), ("29", "30"));
        assert_eq!(last.text, "20 more of these within 10 s");
    }
}
