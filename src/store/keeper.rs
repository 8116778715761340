//! Events and samples under one bound, on a disk that may fail. Pure: told the time, and driven turn by turn.

use std::sync::Arc;
use std::time::Duration;

use uuid::Uuid;

use super::disk::{Disk, DiskError};
use super::log::{Log, Surroundings, length};
use super::reading::Want;
use super::record::{Class, HEAD, Item, LARGEST_BODY, OVERHEAD, StreamId};
use super::report::{State, StoreReport, Sync};
use crate::time::{Instant, Now, Timestamp};

mod faults;

/// With [`Sync::Balanced`]: what is written is made sure of after this time.
pub const SYNC_INTERVAL: Duration = Duration::from_millis(500);
/// Acknowledgements are written down this long after they came, so that a start repeats little. Nobody waits until the disk
/// has made sure of that: it costs no block of its own.
const MARK_INTERVAL: Duration = Duration::from_millis(200);
/// A disk that failed is tried again after this time.
pub const RETRY_INTERVAL: Duration = Duration::from_secs(5);
/// A segment that could not be read this often in a row is given up.
const READ_TRIES: u32 = 3;
/// Fewest bytes of a store.
pub const LEAST_BYTES: u64 = 1024 * 1024;

/// What fits in memory while the disk fails.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Limits {
    /// Records.
    pub records: usize,
    /// Bytes of bodies.
    pub bytes: usize,
}

/// How records are kept.
#[derive(Clone, Copy, Debug)]
pub struct StoreSettings {
    /// Most bytes on disk; at least [`LEAST_BYTES`].
    pub bytes: u64,
    /// Records that are older leave; by the wall clock.
    pub age: Option<Duration>,
    /// When what is written is made sure of.
    pub sync: Sync,
    /// What fits in memory.
    pub memory: Limits,
    /// Names the run of the system: another one after each boot.
    pub boot: Uuid,
    /// Makes a name for a stream, never the same.
    pub fresh: fn() -> StreamId,
}

impl StoreSettings {
    fn segment(&self) -> u64 {
        (self.bytes.max(LEAST_BYTES) / 32).min(4 * 1024 * 1024)
    }
}

/// What is to be kept.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Entry {
    /// What it is.
    pub class: Class,
    /// Its number in its stream; of events one more than the one before.
    pub number: u64,
    /// A text of at most [`LARGEST_BODY`] bytes; of a longer one nothing is kept but the place.
    pub body: Arc<str>,
}

/// What is to be done in one go.
#[derive(Clone, Debug, Default)]
pub struct Turn {
    /// In order.
    pub append: Vec<Entry>,
    /// Positions of records that need not be kept any more.
    pub acknowledged: Vec<(Class, u64)>,
    /// How much is to be handed out, by [`Class::place`].
    pub want: [Want; 2],
}

/// What came of it.
#[derive(Clone, Debug, Default)]
pub struct Done {
    /// The positions of what was appended, in the same order.
    pub placed: Vec<u64>,
    /// What was handed out, by [`Class::place`].
    pub items: [Vec<Item>; 2],
    /// There is more to hand out, by [`Class::place`].
    pub more: [bool; 2],
    /// Counts up when positions became others, because a disk came that was not there at the start: what was handed out
    /// before is forgotten, and comes again.
    pub epoch: u32,
    /// When a turn is to be made at the latest.
    pub due: Option<Instant>,
    /// Figures.
    pub report: StoreReport,
}

/// The store.
#[derive(Debug)]
pub struct Store<D> {
    disk: D,
    settings: StoreSettings,
    logs: [Log; 2],
    state: State,
    reason: Arc<str>,
    /// The disk was read since the start.
    opened: bool,
    epoch: u32,
    faults: u64,
    filling: bool,
    retry_at: Instant,
    /// Since when something is not made sure of, and something acknowledged not written down.
    unsure_since: Option<Instant>,
    unmarked_since: Option<Instant>,
    /// How often in a row reading failed of each class, and until when it is not tried again.
    read_failures: [u32; 2],
    unreadable_until: Instant,
}

impl<D: Disk> Store<D> {
    /// A store in memory alone.
    #[must_use]
    pub fn in_memory(disk: D, settings: StoreSettings) -> Self {
        let stream = (settings.fresh)();
        Self {
            disk,
            settings,
            logs: Class::ALL.map(|class| Log::new(class, stream)),
            state: State::Off,
            reason: "".into(),
            opened: false,
            epoch: 0,
            faults: 0,
            filling: false,
            retry_at: Instant::START,
            unsure_since: None,
            unmarked_since: None,
            read_failures: [0; 2],
            unreadable_until: Instant::START,
        }
    }

    /// Reads what is there. A disk that fails is told of in the report, and tried again later.
    #[must_use]
    pub fn open(disk: D, settings: StoreSettings, now: Now) -> Self {
        let mut store = Self::in_memory(disk, settings);
        store.state = State::Good;
        if let Err(error) = store.attach(now) {
            store.fail(now, &error);
        }
        store
    }

    /// The stream of new events, and the number of the newest.
    #[must_use]
    pub fn stream(&self) -> (StreamId, u64) {
        let [events, _] = &self.logs;
        (events.stream, events.number)
    }

    /// New events belong to a stream of their own: their numbers do not go on where those that were found end.
    pub fn begin_stream(&mut self) {
        let fresh = (self.settings.fresh)();
        let events = self.log(Class::Event);
        (events.stream, events.number) = (fresh, 0);
    }

    /// Does all of a turn: never fails, never blocks for longer than the disk does.
    pub fn turn(&mut self, now: Now, turn: Turn) -> Done {
        for (class, position) in turn.acknowledged {
            let log = self.log(class);
            let before = log.acked();
            log.acknowledge(position);
            if log.acked() > before {
                self.unmarked_since.get_or_insert(now.instant);
            }
        }
        self.retry(now);
        let placed = self.append(now, turn.append);
        self.tend(now);
        let items = self.hand_out(now, turn.want);
        let more = self.logs.each_ref().map(|log| log.has_more() && self.may_read(now, log));
        let readable = Some(self.unreadable_until).filter(|until| *until > now.instant);
        let due = [self.poll_timeout(), readable].into_iter().flatten().min();
        Done { placed, items, more, epoch: self.epoch, due, report: self.report() }
    }

    /// When a turn is to be made though there is nothing to do.
    #[must_use]
    pub fn poll_timeout(&self) -> Option<Instant> {
        match self.state {
            State::Off => None,
            State::Full | State::Faulty => Some(self.retry_at),
            State::Good => {
                let sync = self.unsure_since.map(|since| since + SYNC_INTERVAL);
                let mark = self.unmarked_since.map(|since| since + MARK_INTERVAL);
                [sync, mark].into_iter().flatten().min()
            }
        }
    }

    /// The end in good order: everything is made sure of.
    pub fn close(&mut self, now: Now) {
        self.retry_at = Instant::START;
        self.retry(now);
        self.attempt(now, |store| {
            let Self { disk, logs, .. } = store;
            logs.iter_mut().try_for_each(|log| log.close(disk, now.utc))
        });
    }

    /// Figures.
    #[must_use]
    pub fn report(&self) -> StoreReport {
        let sum = |figure: fn(&Log) -> u64| self.logs.iter().map(figure).sum::<u64>();
        let each = |figure: fn(&Log) -> u64| self.logs.each_ref().map(figure);
        let in_memory = self.state != State::Good;
        let memory = length(self.settings.memory.bytes);
        StoreReport {
            state: self.state,
            reason: Arc::clone(&self.reason),
            records: each(Log::waiting),
            bytes: if in_memory { sum(|log| length(log.ring_bytes)) } else { sum(Log::bytes) },
            bytes_limit: if in_memory { memory } else { self.bytes_limit() },
            filling: self.filling,
            dropped: each(|log| log.counts.dropped),
            damaged: each(|log| log.counts.damaged),
            damaged_places: sum(|log| log.counts.damaged_places),
            faults: self.faults,
            written: sum(|log| log.counts.written),
            payload: sum(|log| log.counts.payload),
            syncs: sum(|log| log.counts.syncs),
        }
    }

    /// Position of the newest record, for tests.
    #[cfg(test)]
    pub(crate) fn newest_position(&mut self, class: Class) -> u64 {
        self.log(class).next - 1
    }

    /// The disk, for tests.
    #[cfg(test)]
    pub(crate) fn disk_mut(&mut self) -> &mut D {
        &mut self.disk
    }

    fn log(&mut self, class: Class) -> &mut Log {
        let [events, samples] = &mut self.logs;
        match class {
            Class::Event => events,
            Class::Sample => samples,
        }
    }

    fn bytes_limit(&self) -> u64 {
        self.settings.bytes.max(LEAST_BYTES)
    }

    fn around(&self, at: Timestamp) -> Surroundings {
        let StoreSettings { boot, sync, .. } = self.settings;
        Surroundings { at, boot, strict: sync == Sync::Strict, segment: self.settings.segment() }
    }

    /// Takes new records in, and gives their positions.
    fn append(&mut self, now: Now, entries: Vec<Entry>) -> Vec<u64> {
        let mut placed = Vec::with_capacity(entries.len());
        let mut records = [Vec::new(), Vec::new()];
        for Entry { class, number, body } in entries {
            let body = if body.len() > LARGEST_BODY { Arc::from("") } else { body };
            let record = self.log(class).place(number, now.utc, body);
            placed.push(record.position);
            let [events, samples] = &mut records;
            if class == Class::Event { events.push(record) } else { samples.push(record) }
        }
        let around = self.around(now.utc);
        if self.state == State::Good && !placed.is_empty() {
            let bytes = records.iter().flatten().map(|record| length(record.body.len() + OVERHEAD)).sum();
            self.attempt(now, |store| store.make_room(now, bytes));
        }
        let mut first_error = None;
        let in_memory = self.state != State::Good;
        let Self { disk, logs, .. } = self;
        for (log, records) in logs.iter_mut().zip(records) {
            if in_memory || first_error.is_some() {
                log.put_all_aside(records);
            } else if !records.is_empty() {
                first_error = log.append(disk, around, records).err();
            }
        }
        if let Some(error) = first_error {
            self.fail(now, &error);
        }
        self.trim();
        placed
    }

    /// Syncs, marks and cleans, as far as that is due.
    fn tend(&mut self, now: Now) {
        let strict = self.settings.sync == Sync::Strict;
        if self.logs.iter().any(|log| log.dirty) {
            self.unsure_since.get_or_insert(now.instant);
        }
        let is_over = |since: Option<Instant>, interval| {
            since.is_some_and(|since| now.instant.since(since) >= interval)
        };
        let mark = is_over(self.unmarked_since, MARK_INTERVAL);
        let sync = strict || is_over(self.unsure_since, SYNC_INTERVAL);
        self.attempt(now, |store| {
            let Self { disk, logs, .. } = store;
            for log in logs {
                if mark && log.marked < log.acked() {
                    let dirty = log.dirty;
                    log.mark(disk, now.utc)?;
                    log.dirty = dirty;
                }
                if sync {
                    log.sync(disk)?;
                }
                log.clean(disk, now.utc)?;
            }
            store.expire(now)
        });
        if mark {
            self.unmarked_since = None;
        }
        if self.logs.iter().all(|log| !log.dirty) {
            self.unsure_since = None;
        }
    }

    /// Drops the oldest segments until so many bytes more fit.
    fn make_room(&mut self, now: Now, bytes: u64) -> Result<(), DiskError> {
        let limit = self.bytes_limit();
        while self.logs.iter().map(Log::bytes).sum::<u64>().saturating_add(bytes) > limit {
            let around = self.around(now.utc);
            let Self { disk, logs, .. } = self;
            let Some(log) = logs.iter_mut().rev().find(|log| can_drop(log)) else { break };
            log.drop_oldest(disk, around)?;
        }
        Ok(())
    }

    fn expire(&mut self, now: Now) -> Result<(), DiskError> {
        let Some(age) = self.settings.age else { return Ok(()) };
        let age = i64::try_from(age.as_micros()).unwrap_or(i64::MAX);
        let oldest = now.utc.as_micros().saturating_sub(age);
        let around = self.around(now.utc);
        let Self { disk, logs, .. } = self;
        for log in logs {
            let is_old =
                |log: &Log| log.segments.front().is_some_and(|front| front.newest.as_micros() < oldest);
            while is_old(log) && can_drop(log) {
                log.drop_oldest(disk, around)?;
            }
        }
        Ok(())
    }

    /// Drops what does not fit in memory: the oldest samples, then the oldest events.
    fn trim(&mut self) {
        let Limits { records, bytes } = self.settings.memory;
        let [events, samples] = &mut self.logs;
        while events.ring.len() + samples.ring.len() > records
            || events.ring_bytes + samples.ring_bytes > bytes
        {
            if samples.ring.is_empty() { events.drop_from_ring() } else { samples.drop_from_ring() }
        }
        let taken = length(events.ring.len() + samples.ring.len());
        let in_bytes = length(events.ring_bytes + samples.ring_bytes);
        let memory = fiftieths(taken, length(records)).max(fiftieths(in_bytes, length(bytes)));
        let on_disk = if self.state == State::Good { self.logs.iter().map(Log::bytes).sum() } else { 0 };
        let fill = memory.max(fiftieths(on_disk, self.bytes_limit()));
        self.filling = if self.filling { fill >= 35 } else { fill >= 40 };
    }

    fn hand_out(&mut self, now: Now, want: [Want; 2]) -> [Vec<Item>; 2] {
        let mut error = None;
        let may_read = self.logs.each_ref().map(|log| self.may_read(now, log));
        let Self { disk, logs, read_failures, .. } = self;
        let mut given = [Vec::new(), Vec::new()];
        let each = logs.iter_mut().zip(read_failures).zip(want).zip(may_read).zip(&mut given);
        let readable = each.filter(|(((_, want), may_read), _)| *may_read && want.records > 0);
        for ((((log, failures), want), _), items) in readable {
            let from_disk = log.is_on_disk();
            match log.read(disk, want) {
                Ok(read) => {
                    *items = read;
                    *failures = if from_disk { 0 } else { *failures };
                }
                Err(failed) => {
                    *failures += 1;
                    if *failures >= READ_TRIES {
                        *failures = 0;
                        log.skip_segment();
                    }
                    error = Some(failed);
                }
            }
        }
        if let Some(error) = error {
            self.unreadable_until = now.instant + RETRY_INTERVAL;
            if self.state == State::Good {
                self.fail(now, &error);
            }
        }
        given
    }

    /// Whether what is next can be read now: not from a disk that failed just before.
    fn may_read(&self, now: Now, log: &Log) -> bool {
        now.instant >= self.unreadable_until || !log.is_on_disk()
    }
}

/// Whether dropping the oldest segment makes room.
fn can_drop(log: &Log) -> bool {
    log.segments.len() > 1
        || log.open && log.segments.front().is_some_and(|only| only.bytes > length(2 * HEAD))
}

/// How full something is, in fiftieths.
fn fiftieths(taken: u64, of: u64) -> u64 {
    taken.saturating_mul(50) / of.max(1)
}
