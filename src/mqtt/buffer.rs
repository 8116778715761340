//! Between publisher and store, pure: what goes there in turns, what comes back when, and its figures.
//!
//! One turn is under way at a time; what comes meanwhile goes with the next, so that a slow disk makes larger turns and not
//! more of them. Samples come back no faster than `history_rate`, and events as the broker takes them.

use std::sync::Arc;

use uuid::Uuid;

use super::outbox::{MessageId, Outbox};
use crate::store::record::{OVERHEAD, stored_size};
use crate::store::{Class, Done, Entry, Item, StoreReport, Turn, Want};
use crate::time::Instant;

/// Events that wait for a turn; more stay in the gateway's journal.
const EVENTS_WAITING: usize = 1024;
/// Bytes of samples that wait for a turn; of more the newest are dropped, and counted.
const SAMPLE_BYTES_WAITING: usize = 4 * 1024 * 1024;
/// Messages of the store that are taken out ahead of the broker, of each class.
const AHEAD: usize = 64;
/// Their bytes.
const AHEAD_BYTES: usize = 256 * 1024;
/// Of so many states one is deflated to see what they take on disk; a number that no count of nodes shares.
const MEASURED: u64 = 17;

/// What waits for the store and what is known of it.
#[derive(Debug)]
pub(super) struct Buffer {
    append: Vec<Entry>,
    /// Beside each of them: its name in the outbox, where it is told live as well.
    names: Vec<Option<MessageId>>,
    sample_bytes: usize,
    acknowledged: Vec<(Class, u64)>,
    /// The names of the turn that is under way.
    under_way: Option<Vec<Option<MessageId>>>,
    more: [bool; 2],
    /// Samples were asked for up to there.
    asked_below: Option<u64>,
    /// None came, because that one is still told live: asking again is of no use as long as it is.
    held_at: Option<u64>,
    due: Option<Instant>,
    epoch: u32,
    report: StoreReport,
    allowance: Allowance,
    /// Samples that were dropped because the disk was too slow for them.
    refused: u64,
    /// Bytes that went to the disk, or would have gone without a session: for the forecast.
    produced: u64,
    /// States that are counted there, and thousandths of their bytes that they take on disk.
    states: u64,
    per_mille: u64,
}

/// How many samples may be taken out now.
#[derive(Clone, Copy, Debug)]
struct Allowance {
    /// In a second.
    rate: u32,
    left: u32,
    since: Instant,
}

impl Allowance {
    fn refill(&mut self, now: Instant) {
        let micros = now.since(self.since).as_micros().saturating_mul(self.rate.into());
        let new = u32::try_from(micros / 1_000_000).unwrap_or(u32::MAX);
        if new > 0 {
            self.left = self.left.saturating_add(new).min((self.rate / 10).max(1));
            self.since = now;
        }
    }

    /// When there is a hundredth of a second's worth, or one.
    fn due(&self) -> Instant {
        let count = (self.rate / 100).max(1);
        self.since
            + std::time::Duration::from_micros(u64::from(count) * 1_000_000 / u64::from(self.rate.max(1)) + 1)
    }
}

/// An item of the store as a message.
pub(super) struct Told {
    pub(super) class: Class,
    pub(super) item: Item,
}

impl Buffer {
    /// Of a store that was just opened. `rate`: samples that are taken out of it in a second.
    pub(super) fn new(opened: &Done, rate: u32, now: Instant) -> Self {
        Self {
            append: Vec::new(),
            names: Vec::new(),
            sample_bytes: 0,
            acknowledged: Vec::new(),
            under_way: None,
            more: opened.more,
            asked_below: None,
            held_at: None,
            due: opened.due,
            epoch: opened.epoch,
            report: opened.report.clone(),
            allowance: Allowance { rate, left: 0, since: now },
            refused: 0,
            produced: 0,
            states: 0,
            per_mille: 1000,
        }
    }

    /// Events that wait for a turn.
    pub(super) fn events(&self) -> u64 {
        length(self.append.iter().filter(|entry| entry.class == Class::Event).count())
    }

    /// Samples that are taken out of it in a second, from now on.
    pub(super) fn set_rate(&mut self, rate: u32) {
        self.allowance.rate = rate;
    }

    /// Whether more events can be taken in.
    pub(super) fn takes_events(&self) -> bool {
        self.append.len() < EVENTS_WAITING
    }

    pub(super) fn keep_event(&mut self, number: u64, body: String) {
        self.produced = self.produced.saturating_add(length(body.len() + OVERHEAD));
        self.push(Entry { class: Class::Event, number, body: body.into() }, None);
    }

    /// Keeps a sample for the history. `name` is that in the outbox, where it is told live as well.
    pub(super) fn keep_sample(&mut self, body: String, name: Option<MessageId>) {
        if self.sample_bytes >= SAMPLE_BYTES_WAITING {
            self.refused = self.refused.saturating_add(1);
            return;
        }
        self.sample_bytes += body.len();
        self.push(Entry { class: Class::Sample, number: 0, body: body.into() }, name);
    }

    /// A state was made; whether it ever goes to the store shows later. `longer`: by so many bytes its body is longer.
    pub(super) fn count_state(&mut self, state: &str, longer: usize) {
        if self.states.is_multiple_of(MEASURED) {
            self.per_mille = length(stored_size(state)).saturating_mul(1000) / length(state.len()).max(1);
        }
        self.states = self.states.saturating_add(1);
        let bytes = length(state.len() + longer).saturating_mul(self.per_mille) / 1000;
        self.produced = self.produced.saturating_add(bytes);
    }

    fn push(&mut self, entry: Entry, name: Option<MessageId>) {
        self.append.push(entry);
        self.names.push(name);
    }

    pub(super) fn acknowledge(&mut self, (class, position): (Class, u64)) {
        self.acknowledged.push((class, position));
    }

    /// The next turn, where there is something to do and none is under way. `reading`: there is a session to read for.
    pub(super) fn poll_turn(&mut self, now: Instant, outbox: &Outbox, reading: bool) -> Option<Turn> {
        if self.under_way.is_some() {
            return None;
        }
        let want = if reading { self.want(now, outbox) } else { [Want::default(); 2] };
        let [events, samples] = want;
        let is_due = self.due.is_some_and(|due| due <= now);
        let reads = (self.more[0] && events.records > 0) || (self.more[1] && samples.records > 0);
        if self.append.is_empty() && self.acknowledged.is_empty() && !reads && !is_due {
            return None;
        }
        self.sample_bytes = 0;
        self.under_way = Some(std::mem::take(&mut self.names));
        let append = std::mem::take(&mut self.append);
        let acknowledged = std::mem::take(&mut self.acknowledged);
        Some(Turn { append, acknowledged, want })
    }

    fn want(&mut self, now: Instant, outbox: &Outbox) -> [Want; 2] {
        self.allowance.refill(now);
        let room = |class| AHEAD.saturating_sub(outbox.stored_waiting(class));
        let allowed = usize::try_from(self.allowance.left).unwrap_or(usize::MAX);
        // Where a sample that is still told live will stand is known only after the turn.
        let live = outbox.first_told_live();
        let is_held = self.names.iter().any(Option::is_some) || (live.is_some() && live == self.held_at);
        let samples = if is_held { 0 } else { room(Class::Sample).min(allowed) };
        self.asked_below = live.filter(|_| samples > 0);
        let below = live.unwrap_or(u64::MAX);
        [
            Want { records: room(Class::Event), bytes: AHEAD_BYTES, below: u64::MAX },
            Want { records: samples, bytes: AHEAD_BYTES, below },
        ]
    }

    /// A turn is done: gives what came out of the store.
    pub(super) fn handle_done(&mut self, done: Done, outbox: &mut Outbox) -> Vec<Told> {
        let names = self.under_way.take().unwrap_or_default();
        if done.epoch != self.epoch {
            self.epoch = done.epoch;
            outbox.forget_stored();
            self.acknowledged.clear();
        }
        for (name, position) in names.into_iter().zip(&done.placed) {
            if let Some(name) = name
                && !outbox.handle_stored(name, *position)
            {
                self.acknowledged.push((Class::Sample, *position));
            }
        }
        self.more = done.more;
        self.due = done.due;
        self.report = done.report;
        let [events, samples] = done.items;
        if let Some(below) = self.asked_below.take() {
            self.held_at = Some(below).filter(|_| samples.is_empty());
        }
        let taken = u32::try_from(samples.len()).unwrap_or(u32::MAX);
        self.allowance.left = self.allowance.left.saturating_sub(taken);
        let told = |class: Class| move |item: Item| Told { class, item };
        events
            .into_iter()
            .map(told(Class::Event))
            .chain(samples.into_iter().map(told(Class::Sample)))
            .collect()
    }

    /// When the next turn is due though nothing happens.
    pub(super) fn poll_timeout(&self, outbox: &Outbox, reading: bool) -> Option<Instant> {
        if self.under_way.is_some() {
            return None;
        }
        let has_room = outbox.stored_waiting(Class::Sample) < AHEAD;
        let is_held = self.allowance.left == 0 && outbox.first_told_live().is_none();
        let history = (reading && self.more[1] && has_room && is_held).then(|| self.allowance.due());
        [self.due, history].into_iter().flatten().min()
    }

    /// Whether nothing is on its way to the store.
    pub(super) fn is_idle(&self) -> bool {
        self.under_way.is_none() && self.append.is_empty() && self.acknowledged.is_empty()
    }

    /// Whether the store has events that were not taken out.
    pub(super) fn has_events(&self) -> bool {
        self.more[0]
    }

    /// Fill, counters and forecast.
    pub(super) fn report(&self, uptime_s: u64) -> BufferReport {
        let mut store = self.report.clone();
        store.dropped[1] = store.dropped[1].saturating_add(self.refused);
        BufferReport { hours_left: self.hours_left(uptime_s), store }
    }

    #[expect(clippy::as_conversions, clippy::cast_precision_loss, reason = "a forecast needs no 53 bits")]
    fn hours_left(&self, uptime_s: u64) -> Option<f64> {
        let free = self.report.bytes_limit.saturating_sub(self.report.bytes) as f64;
        let hours = uptime_s.max(1) as f64 / 3600.0;
        (self.produced > 0).then(|| (free / (self.produced as f64 / hours)).min(100_000.0))
    }
}

/// Fill and counters of the store, and how long it would last.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct BufferReport {
    /// Figures of the store.
    pub store: StoreReport,
    /// Hours until it is full if the broker went away now, at the mean rate of events and samples so far; `None` before the
    /// first; at most 100,000.
    pub hours_left: Option<f64>,
}

fn length(bytes: usize) -> u64 {
    u64::try_from(bytes).unwrap_or(u64::MAX)
}

/// The body of a record: topic and payload.
pub(super) fn body(topic: &str, payload: &str) -> String {
    format!("{topic}\n{payload}")
}

/// Topic and payload of a body; nothing of one that has none.
pub(super) fn parts(body: &str) -> Option<(Arc<str>, &str)> {
    let (topic, payload) = body.split_once('\n')?;
    Some((topic.into(), payload))
}

/// A stream's id as events show it.
pub(super) fn stream_text(stream: Uuid) -> String {
    stream.to_string()
}
