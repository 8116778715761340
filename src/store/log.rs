//! The records of one class: segment files, oldest first, and behind them a ring in memory while the disk fails. Pure.
//!
//! Only the newest segment grows. It stays until there is a newer one, since its head says where positions and numbers go on.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::ops::RangeInclusive;

use uuid::Uuid;

use super::disk::{Disk, DiskError};
use super::record::{Class, HEAD, Head, Piece, Record, StreamId};
use crate::time::Timestamp;

/// Records that were acknowledged before they were read, of which more are forgotten: those come twice.
const MOST_EARLY: usize = 65_536;

/// A segment file.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Segment {
    pub(super) file: u32,
    /// Position of its first record.
    pub(super) first: u64,
    pub(super) bytes: u64,
    /// Time of its newest record, as far as it is known.
    pub(super) newest: Timestamp,
}

/// Where reading goes on.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Cursor {
    /// The next position to be handed out.
    pub(super) position: u64,
    /// File and offset, where they are known.
    pub(super) place: Option<(u32, u64)>,
    /// Records that are missing before the next one and that nobody was told of.
    pub(super) lost: u64,
}

/// What was counted since the start.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Counts {
    pub(super) dropped: u64,
    pub(super) damaged: u64,
    pub(super) damaged_places: u64,
    pub(super) written: u64,
    pub(super) payload: u64,
    pub(super) syncs: u64,
}

/// What a log needs to know of its surroundings.
#[derive(Clone, Copy, Debug)]
pub(super) struct Surroundings {
    pub(super) at: Timestamp,
    pub(super) boot: Uuid,
    pub(super) strict: bool,
    /// Bytes of a segment, above which a new one is begun.
    pub(super) segment: u64,
}

#[derive(Debug)]
pub(super) struct Log {
    pub(super) class: Class,
    pub(super) segments: VecDeque<Segment>,
    /// The newest segment takes more.
    pub(super) open: bool,
    /// Number that the next file gets.
    pub(super) next_file: u32,
    /// Position of the next record.
    pub(super) next: u64,
    /// Number of the newest record, and its stream.
    pub(super) number: u64,
    pub(super) stream: StreamId,
    pub(super) cursor: Cursor,
    /// Handed out and not acknowledged; with the first position that is missing before it, or its own.
    pub(super) outstanding: BTreeMap<u64, u64>,
    /// Acknowledged and not yet come to by the reader.
    pub(super) early: BTreeSet<u64>,
    /// What is missing up to here was dropped, not damaged.
    pub(super) dropped_to: u64,
    /// Positions behind it that were dropped from memory.
    pub(super) dropped: VecDeque<RangeInclusive<u64>>,
    /// Acknowledged up to here, as it stands on disk.
    pub(super) marked: u64,
    /// What the disk did not take; always the newest.
    pub(super) ring: VecDeque<Record>,
    pub(super) ring_bytes: usize,
    /// What the disk took and has not made sure.
    pub(super) unsynced: Vec<Record>,
    pub(super) dirty: bool,
    pub(super) counts: Counts,
}

/// The name of a segment file.
pub(super) fn name(class: Class, file: u32) -> String {
    format!("{}-{file:08}.log", class.word())
}

/// The number in the name of a segment file of this class.
pub(super) fn file_of(class: Class, name: &str) -> Option<u32> {
    let digits = name.strip_prefix(class.word())?.strip_prefix('-')?.strip_suffix(".log")?;
    (digits.len() >= 8 && digits.bytes().all(|byte| byte.is_ascii_digit())).then(|| digits.parse().ok())?
}

impl Log {
    /// A log without a record.
    pub(super) fn new(class: Class, stream: StreamId) -> Self {
        Self {
            class,
            segments: VecDeque::new(),
            open: false,
            next_file: 1,
            next: 1,
            number: 0,
            stream,
            cursor: Cursor { position: 1, ..Cursor::default() },
            outstanding: BTreeMap::new(),
            early: BTreeSet::new(),
            dropped_to: 0,
            dropped: VecDeque::new(),
            marked: 0,
            ring: VecDeque::new(),
            ring_bytes: 0,
            unsynced: Vec::new(),
            dirty: false,
            counts: Counts::default(),
        }
    }

    /// All up to here need not be sent any more.
    pub(super) fn acked(&self) -> u64 {
        let open = self.outstanding.values().next().copied().unwrap_or(self.cursor.position);
        open.saturating_sub(1)
    }

    /// Records that are not acknowledged; damage that nobody came to yet counts among them.
    pub(super) fn waiting(&self) -> u64 {
        let (from, to) = (self.cursor.position, self.next);
        let missing = self.dropped_in(from, to) + length(self.early.len());
        to.saturating_sub(from).saturating_sub(missing) + length(self.outstanding.len())
    }

    /// How many of the positions `from..to` were dropped.
    pub(super) fn dropped_in(&self, from: u64, to: u64) -> u64 {
        let in_memory: u64 = self.dropped.iter().map(|range| overlap(range, from, to)).sum();
        in_memory + overlap(&(0..=self.dropped_to), from, to)
    }

    pub(super) fn newest_file(&self) -> Option<u32> {
        self.segments.back().map(|segment| segment.file)
    }

    pub(super) fn bytes(&self) -> u64 {
        self.segments.iter().map(|segment| segment.bytes).sum()
    }

    /// Gives the next record its position.
    pub(super) fn place(&mut self, number: u64, at: Timestamp, body: std::sync::Arc<str>) -> Record {
        let record = Record { position: self.next, stream: self.stream, number, at, body };
        self.next = self.next.saturating_add(1);
        self.number = number;
        record
    }

    /// Writes records; those that did not get there are in the ring afterwards.
    pub(super) fn append<D: Disk>(
        &mut self,
        disk: &mut D,
        around: Surroundings,
        records: Vec<Record>,
    ) -> Result<(), DiskError> {
        let mut left = records.into_iter().peekable();
        while left.peek().is_some() {
            let mut batch = Vec::new();
            let mut bytes = Vec::new();
            let mut payload = 0;
            while let Some(record) = left.next_if(|_| length(bytes.len()) < around.segment) {
                payload += length(record.body.len());
                Piece::Record(record.clone()).write(self.class, &mut bytes);
                batch.push(record);
            }
            let roomy = self.segments.back().is_some_and(|segment| segment.bytes < around.segment);
            let first = batch.first().map_or(self.next, |record| record.position);
            let rolled = if self.open && roomy { Ok(()) } else { self.roll(disk, around, first) };
            if let Err(error) = rolled.and_then(|()| self.write(disk, around.at, &bytes)) {
                self.put_all_aside(batch.into_iter().chain(left));
                return Err(error);
            }
            self.counts.payload = self.counts.payload.saturating_add(payload);
            self.unsynced.extend(batch);
        }
        Ok(())
    }

    /// Begins a new segment, whose first record has the position `first`.
    pub(super) fn roll<D: Disk>(
        &mut self,
        disk: &mut D,
        around: Surroundings,
        first: u64,
    ) -> Result<(), DiskError> {
        if self.open {
            let mut sealed = Vec::new();
            Piece::Sealed.write(self.class, &mut sealed);
            self.write(disk, around.at, &sealed)?;
        }
        self.sync(disk)?;
        self.open = false;
        let file = self.next_file;
        // Whatever becomes of it: no name is used twice.
        self.next_file = file.checked_add(1).unwrap_or(1);
        disk.create(&name(self.class, file))?;
        let head = Head {
            first,
            acked: self.acked(),
            dropped: self.dropped_to,
            number: self.number,
            at: around.at,
            stream: self.stream,
            boot: around.boot,
            strict: around.strict,
        };
        self.segments.push_back(Segment { file, first, bytes: 0, newest: around.at });
        let mut bytes = Vec::with_capacity(HEAD);
        head.write(self.class, &mut bytes);
        if let Err(error) = self.write(disk, around.at, &bytes) {
            self.segments.pop_back();
            // A disk without room must not fill with heads; where that fails too, a start will find nothing in it.
            let _ = disk.remove(&name(self.class, file));
            return Err(error);
        }
        self.marked = head.acked;
        self.open = true;
        Ok(())
    }

    fn write<D: Disk>(&mut self, disk: &mut D, at: Timestamp, bytes: &[u8]) -> Result<(), DiskError> {
        let Some(segment) = self.segments.back_mut() else { return Ok(()) };
        self.dirty = true;
        self.counts.written = self.counts.written.saturating_add(length(bytes.len()));
        // Some of it may be there even when it fails.
        segment.bytes = segment.bytes.saturating_add(length(bytes.len()));
        segment.newest = at;
        disk.append(&name(self.class, segment.file), bytes)
    }

    /// Makes sure of what was written.
    pub(super) fn sync<D: Disk>(&mut self, disk: &mut D) -> Result<(), DiskError> {
        let Some(file) = self.newest_file().filter(|_| self.dirty) else { return Ok(()) };
        self.counts.syncs = self.counts.syncs.saturating_add(1);
        disk.sync(&name(self.class, file))?;
        self.dirty = false;
        self.unsynced.clear();
        Ok(())
    }

    /// Writes down how far the acknowledgements are.
    pub(super) fn mark<D: Disk>(&mut self, disk: &mut D, at: Timestamp) -> Result<(), DiskError> {
        if !self.open {
            return Ok(());
        }
        let acked = self.acked();
        let mut bytes = Vec::new();
        Piece::Marked { acked, dropped: self.dropped_to }.write(self.class, &mut bytes);
        self.write(disk, at, &bytes)?;
        self.marked = acked;
        Ok(())
    }

    /// Writes down that nothing comes any more.
    pub(super) fn close<D: Disk>(&mut self, disk: &mut D, at: Timestamp) -> Result<(), DiskError> {
        if !self.open {
            return Ok(());
        }
        self.mark(disk, at)?;
        let mut bytes = Vec::new();
        Piece::Closed.write(self.class, &mut bytes);
        self.write(disk, at, &bytes)?;
        self.sync(disk)
    }

    /// The broker has a record.
    pub(super) fn acknowledge(&mut self, position: u64) {
        if position < self.cursor.position {
            self.outstanding.remove(&position);
        } else if position < self.next && self.early.len() < MOST_EARLY {
            self.early.insert(position);
        }
        let acked = self.acked();
        while self.ring.front().is_some_and(|record| record.position <= acked) {
            self.pop_ring();
        }
    }

    /// Removes segments of which everything is acknowledged.
    pub(super) fn clean<D: Disk>(&mut self, disk: &mut D, at: Timestamp) -> Result<(), DiskError> {
        let acked = self.acked();
        let is_done = |segments: &VecDeque<Segment>| {
            segments.get(1).is_some_and(|next| next.first.saturating_sub(1) <= acked)
        };
        if is_done(&self.segments) && self.marked < acked {
            // Else a start after a crash would take what is gone for lost.
            self.mark(disk, at)?;
            self.sync(disk)?;
        }
        while is_done(&self.segments) {
            self.remove_oldest(disk)?;
        }
        Ok(())
    }

    fn remove_oldest<D: Disk>(&mut self, disk: &mut D) -> Result<(), DiskError> {
        let Some(oldest) = self.segments.front() else { return Ok(()) };
        disk.remove(&name(self.class, oldest.file))?;
        self.segments.pop_front();
        Ok(())
    }

    /// Drops the oldest segment; what was not yet handed out is counted.
    pub(super) fn drop_oldest<D: Disk>(
        &mut self,
        disk: &mut D,
        around: Surroundings,
    ) -> Result<(), DiskError> {
        let Some(oldest) = self.segments.front() else { return Ok(()) };
        let from = oldest.first.max(self.cursor.position);
        let behind = self.ring.front().map_or(self.next, |record| record.position);
        if self.segments.len() == 1 && self.open {
            self.roll(disk, around, behind)?;
        }
        let behind = self.segments.get(1).map_or(behind, |next| next.first);
        if from < behind {
            let early = length(self.early.range(from..behind).count());
            let lost = (behind - from).saturating_sub(self.dropped_in(from, behind) + early);
            self.counts.dropped = self.counts.dropped.saturating_add(lost);
        }
        let dropped_to = self.dropped_to.max(behind.saturating_sub(1));
        self.dropped_to = dropped_to;
        self.dropped.retain(|range| *range.end() > dropped_to);
        self.mark(disk, around.at)?;
        self.remove_oldest(disk)
    }

    /// The disk took nothing of what is written from here on, and is not believed about what it did not make sure.
    pub(super) fn fall_back(&mut self) {
        self.open = false;
        self.dirty = false;
        let behind = std::mem::take(&mut self.ring);
        self.ring_bytes = 0;
        let acked = self.acked();
        let unsure = std::mem::take(&mut self.unsynced);
        let first = behind.front().map_or(self.next, |record| record.position);
        let unsure = unsure.into_iter().filter(|record| record.position > acked && record.position < first);
        self.put_all_aside(unsure.chain(behind));
    }

    /// Writes what is in memory to a new segment.
    pub(super) fn resume<D: Disk>(&mut self, disk: &mut D, around: Surroundings) -> Result<(), DiskError> {
        let begun = self.next_file;
        let first = self.ring.front().map_or(self.next, |record| record.position);
        let ring: Vec<Record> = std::mem::take(&mut self.ring).into();
        self.ring_bytes = 0;
        let mut tried = self.roll(disk, around, first);
        match tried {
            Ok(()) => tried = self.append(disk, around, ring).and_then(|()| self.sync(disk)),
            Err(_) => self.put_all_aside(ring),
        }
        if let Err(error) = tried {
            self.fall_back();
            self.take_back(disk, begun);
            return Err(error);
        }
        // What was read from memory is on disk now: the place is to be found again.
        self.cursor.place = None;
        Ok(())
    }

    /// Removes the newest segment, if it was begun in vain: all that it holds is in memory.
    fn take_back<D: Disk>(&mut self, disk: &mut D, begun: u32) {
        let front = self.ring.front().map_or(self.next, |record| record.position);
        let newest = self.segments.back().filter(|newest| newest.file >= begun && newest.first >= front);
        if let Some(newest) = newest
            && disk.remove(&name(self.class, newest.file)).is_ok()
        {
            self.segments.pop_back();
        }
    }

    /// Keeps a record in memory.
    pub(super) fn put_aside(&mut self, record: Record) {
        self.ring_bytes = self.ring_bytes.saturating_add(record.body.len());
        self.ring.push_back(record);
    }

    /// Keeps records in memory.
    pub(super) fn put_all_aside(&mut self, records: impl IntoIterator<Item = Record>) {
        for record in records {
            self.put_aside(record);
        }
    }

    fn pop_ring(&mut self) -> Option<Record> {
        let record = self.ring.pop_front()?;
        self.ring_bytes = self.ring_bytes.saturating_sub(record.body.len());
        Some(record)
    }

    /// Drops the oldest record in memory; counted, unless it was handed out already.
    pub(super) fn drop_from_ring(&mut self) {
        let Some(record) = self.pop_ring() else { return };
        let position = record.position;
        if position < self.cursor.position || self.early.contains(&position) {
            return;
        }
        self.counts.dropped = self.counts.dropped.saturating_add(1);
        match self.dropped.back_mut() {
            Some(range) if range.end().saturating_add(1) == position => *range = *range.start()..=position,
            Some(_) | None => self.dropped.push_back(position..=position),
        }
    }
}

/// How many positions of `from..to` are in a range.
pub(super) fn overlap(range: &RangeInclusive<u64>, from: u64, to: u64) -> u64 {
    let end = to.min(range.end().saturating_add(1));
    end.saturating_sub(from.max(*range.start()))
}

/// A length as a number of bytes on disk.
pub(super) fn length(bytes: usize) -> u64 {
    u64::try_from(bytes).unwrap_or(u64::MAX)
}
