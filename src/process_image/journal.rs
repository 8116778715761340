//! What happened, in order: the last events, each with a sequence number.

use std::collections::VecDeque;

use super::{AlarmIndex, Priority, Value};
use crate::time::Timestamp;

/// What an event is about.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum EventKind {
    /// An alarm changed its state.
    Alarm,
    /// A node changed, restarted, or did something unexpected.
    Node,
    /// A bus changed its state, or something happened on it that concerns no configured node.
    Bus,
    /// Somebody asked the gateway to act.
    Command,
    /// The gateway itself.
    Gateway,
}

impl EventKind {
    /// The word in payloads.
    #[must_use]
    pub fn word(self) -> &'static str {
        match self {
            Self::Alarm => "alarm",
            Self::Node => "node",
            Self::Bus => "bus",
            Self::Command => "command",
            Self::Gateway => "gateway",
        }
    }

    /// The number in the event ring: 1 alarm .. 5 gateway.
    #[must_use]
    pub fn code(self) -> u16 {
        match self {
            Self::Alarm => 1,
            Self::Node => 2,
            Self::Bus => 3,
            Self::Command => 4,
            Self::Gateway => 5,
        }
    }
}

/// One thing that happened.
#[derive(Clone, Debug, PartialEq)]
pub struct Event {
    /// Counts up by one without a gap, from 1, or from the number after the last that is on disk.
    pub seq: u64,
    /// When it happened, UTC.
    pub ts: Timestamp,
    /// What it is about.
    pub kind: EventKind,
    /// Name of the node, where it concerns one.
    pub node: Option<String>,
    /// Name of the bus, where it concerns one and no node.
    pub bus: Option<String>,
    /// What happened, in snake case: the alarm's name, or `state`, `node_restarted`, `foreign_guard_master`.
    pub name: String,
    /// State before; empty where there is none.
    pub from: String,
    /// State after; empty where there is none.
    pub to: String,
    /// The alarm, for an alarm event.
    pub alarm: Option<AlarmIndex>,
    /// Priority of the alarm.
    pub priority: Option<Priority>,
    /// Value that caused it.
    pub value: Option<Value>,
    /// One sentence for people; may be empty.
    pub text: String,
}

/// The last events. When full, the oldest leaves; a late reader learns how many it missed.
#[derive(Clone, Debug)]
pub struct Journal {
    events: VecDeque<Event>,
    capacity: usize,
    newest: u64,
    /// The number before the first event that was ever in it.
    before: u64,
}

impl Journal {
    /// Events that are kept.
    pub const CAPACITY: usize = 1024;

    /// An empty journal.
    #[must_use]
    pub fn new() -> Self {
        Self::with_capacity(Self::CAPACITY)
    }

    /// An empty journal that keeps `capacity` events, at least one.
    #[must_use]
    pub fn with_capacity(capacity: usize) -> Self {
        Self { events: VecDeque::new(), capacity: capacity.max(1), newest: 0, before: 0 }
    }

    /// An empty journal whose first event will have the number `newest` + 1: it goes on where another one ended.
    #[must_use]
    pub fn after_number(newest: u64) -> Self {
        Self { newest, before: newest, ..Self::new() }
    }

    /// Appends an event. Its `seq` must be one more than the newest's; a gap would tell readers that they missed one.
    pub fn append(&mut self, event: Event) {
        debug_assert_eq!(event.seq, self.newest + 1, "events are numbered without a gap");
        self.newest = event.seq;
        if self.events.len() == self.capacity {
            self.events.pop_front();
        }
        self.events.push_back(event);
    }

    /// Alarms have other places now; `None`: there is no such alarm any more.
    pub fn renumber_alarms(&mut self, new: impl Fn(AlarmIndex) -> Option<AlarmIndex>) {
        for event in &mut self.events {
            event.alarm = event.alarm.and_then(&new);
        }
    }

    /// All events, and those to come, have numbers that are so much higher: another stream, which is longer, is gone on with.
    pub fn number_higher(&mut self, by: u64) {
        self.events.iter_mut().for_each(|event| event.seq += by);
        self.newest += by;
        self.before += by;
    }

    /// Sequence number of the newest event, 0 before the first.
    #[must_use]
    pub fn newest(&self) -> u64 {
        self.newest
    }

    /// Events since the start.
    #[must_use]
    pub fn recorded(&self) -> u64 {
        self.newest - self.before
    }

    /// The events after `cursor` (the last `seq` that the reader has), oldest first, and how many it missed.
    pub fn since(&self, cursor: u64) -> (impl Iterator<Item = &Event>, u64) {
        let oldest = self.events.front().map_or(self.newest + 1, |event| event.seq);
        let next = cursor.saturating_add(1);
        // Numbers have no gap, so the place of the next one is known.
        let seen = usize::try_from(next.saturating_sub(oldest)).unwrap_or(usize::MAX);
        (self.events.iter().skip(seen), oldest.saturating_sub(next))
    }

    /// The same, copied.
    #[must_use]
    pub fn after(&self, cursor: u64) -> (Vec<Event>, u64) {
        let (events, missed) = self.since(cursor);
        (events.cloned().collect(), missed)
    }

    /// The last events, newest first.
    pub fn newest_first(&self) -> impl Iterator<Item = &Event> {
        self.events.iter().rev()
    }
}

impl Default for Journal {
    fn default() -> Self {
        Self::new()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn event(seq: u64) -> Event {
        Event {
            seq,
            ts: Timestamp::default(),
            kind: EventKind::Gateway,
            node: None,
            bus: None,
            name: "test".into(),
            from: String::new(),
            to: String::new(),
            alarm: None,
            priority: None,
            value: None,
            text: String::new(),
        }
    }

    #[test]
    fn a_late_reader_learns_how_many_events_it_missed() {
        let mut journal = Journal::with_capacity(3);
        (1..=5).for_each(|seq| journal.append(event(seq)));
        let seqs = |cursor| {
            let (events, missed) = journal.after(cursor);
            (events.iter().map(|event| event.seq).collect::<Vec<_>>(), missed)
        };
        assert_eq!(seqs(0), (vec![3, 4, 5], 2));
        assert_eq!(seqs(2), (vec![3, 4, 5], 0));
        assert_eq!(seqs(4), (vec![5], 0));
        assert_eq!(seqs(5), (vec![], 0));
    }

    #[test]
    fn a_journal_that_goes_on_after_another_has_no_gap() {
        let mut journal = Journal::after_number(41);
        assert_eq!((journal.newest(), journal.recorded(), journal.after(41).1), (41, 0, 0));
        journal.append(event(42));
        let (events, missed) = journal.after(41);
        assert_eq!((events.len(), missed, journal.recorded()), (1, 0, 1));
        assert_eq!(journal.after(10).1, 31, "those before are gone for it");
    }
}
