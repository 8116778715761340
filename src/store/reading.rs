//! Handing out the records of a log in order: from its segments, then from memory. What is damaged is skipped and told. Pure.

use super::disk::{Disk, DiskError};
use super::log::{Log, Segment, length, name};
use super::record::{Found, FoundHead, HEAD, Head, Item, LARGEST_BODY, OVERHEAD, Piece, Record, next_mark};

/// Bytes that are read at once.
const CHUNK: usize = LARGEST_BODY + OVERHEAD;
/// Chunks that are looked at in one go, however much of them is damaged.
const MOST_CHUNKS: usize = 16;

/// How much is to be handed out at most.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Want {
    /// Records.
    pub records: usize,
    /// Bytes of bodies, by at most one record more.
    pub bytes: usize,
    /// Positions from here on are left.
    pub below: u64,
}

impl Default for Want {
    /// Nothing.
    fn default() -> Self {
        Self { records: 0, bytes: 0, below: u64::MAX }
    }
}

impl Log {
    /// The next records; none where there are none, or where more damage was met than is looked at in one go: then
    /// [`Log::has_more`] holds.
    pub(super) fn read<D: Disk>(&mut self, disk: &mut D, want: Want) -> Result<Vec<Item>, DiskError> {
        let mut items = Vec::new();
        let mut bytes = 0;
        for _ in 0..MOST_CHUNKS {
            let is_full = items.len() >= want.records || bytes >= want.bytes;
            if is_full || self.cursor.position >= want.below || !self.has_more() || !self.is_on_disk() {
                break;
            }
            self.read_chunk(disk, want, &mut items, &mut bytes)?;
        }
        if !self.is_on_disk() {
            self.read_ring(want, &mut items, &mut bytes);
        }
        Ok(items)
    }

    /// Whether there is something to be handed out.
    pub(super) fn has_more(&self) -> bool {
        self.cursor.position < self.next
    }

    /// Whether the next record would have to be on disk.
    pub(super) fn is_on_disk(&self) -> bool {
        let behind = self.ring.front().map_or(self.next, |record| record.position);
        self.cursor.position < behind && !self.segments.is_empty()
    }

    fn read_chunk<D: Disk>(
        &mut self,
        disk: &mut D,
        want: Want,
        items: &mut Vec<Item>,
        bytes: &mut usize,
    ) -> Result<(), DiskError> {
        let Some((file, start)) =
            self.cursor.place.filter(|(file, _)| self.has_file(*file)).or_else(|| self.find())
        else {
            return Ok(());
        };
        let chunk = disk.read(&name(self.class, file), start, CHUNK)?;
        if chunk.is_empty() {
            self.leave(file);
            return Ok(());
        }
        let at_end = chunk.len() < CHUNK;
        let mut offset = if start == 0 { self.behind_head(&chunk) } else { 0 };
        while let Some(rest) = chunk.get(offset..).filter(|rest| !rest.is_empty()) {
            if items.len() >= want.records || *bytes >= want.bytes {
                break;
            }
            match Piece::read(self.class, rest) {
                Found::Piece(Piece::Record(record), _) if record.position >= want.below => break,
                Found::Piece(Piece::Record(record), taken) => {
                    offset += taken;
                    if let Some(item) = self.hand_out(&record) {
                        *bytes += item.body.len();
                        items.push(item);
                    }
                }
                Found::Piece(Piece::Marked { .. } | Piece::Closed | Piece::Sealed, taken) => offset += taken,
                Found::Cut if !at_end && offset > 0 => break,
                Found::Cut | Found::Damaged => {
                    let skipped = 1 + next_mark(rest.get(1..).unwrap_or_default());
                    // Damage that goes on over the end of a chunk is one place.
                    let goes_on = offset == 0 && start > 0 && skipped == rest.len();
                    self.counts.damaged_places += u64::from(!goes_on);
                    offset += skipped;
                }
            }
        }
        self.cursor.place = Some((file, start.saturating_add(length(offset))));
        Ok(())
    }

    /// A record that is next: handed out, with what is missing before it.
    fn hand_out(&mut self, record: &Record) -> Option<Item> {
        let position = record.position;
        let next = self.cursor.position;
        if position < next || position >= self.next {
            return None;
        }
        self.miss(next, position);
        self.cursor.position = position.saturating_add(1);
        if self.early.remove(&position) {
            return None;
        }
        let lost_before = std::mem::take(&mut self.cursor.lost);
        self.outstanding.insert(position, if lost_before > 0 { next } else { position });
        Some(Item {
            position,
            lost_before,
            stream: record.stream,
            number: record.number,
            at: record.at,
            body: std::sync::Arc::clone(&record.body),
        })
    }

    /// The positions `from..to` are not there.
    fn miss(&mut self, from: u64, to: u64) {
        if from >= to {
            return;
        }
        let early = length(self.early.range(from..to).count());
        self.early = self.early.split_off(&to);
        let lost = (to - from).saturating_sub(early);
        let damaged = lost.saturating_sub(self.dropped_in(from, to));
        self.counts.damaged = self.counts.damaged.saturating_add(damaged);
        self.cursor.lost = self.cursor.lost.saturating_add(lost);
    }

    fn read_ring(&mut self, want: Want, items: &mut Vec<Item>, bytes: &mut usize) {
        while items.len() < want.records && *bytes < want.bytes {
            let seen = self.ring.partition_point(|record| record.position < self.cursor.position);
            let Some(record) = self.ring.get(seen).filter(|record| record.position < want.below) else {
                break;
            };
            let record = record.clone();
            if let Some(item) = self.hand_out(&record) {
                *bytes += item.body.len();
                items.push(item);
            }
        }
    }

    fn has_file(&self, file: u32) -> bool {
        self.segments.iter().any(|segment| segment.file == file)
    }

    /// The segment in which the next position is to be looked for.
    fn find(&self) -> Option<(u32, u64)> {
        let begins = |segment: &&Segment| segment.first <= self.cursor.position;
        let found = self.segments.iter().rev().find(begins).or_else(|| self.segments.front());
        found.map(|segment| (segment.file, 0))
    }

    /// A segment was read to its end.
    fn leave(&mut self, file: u32) {
        let place = self.segments.iter().position(|segment| segment.file == file);
        let next = place.and_then(|place| self.segments.get(place + 1));
        if let Some(next) = next {
            self.cursor.place = Some((next.file, 0));
            return;
        }
        // What should be here, and is in no segment, is gone.
        let behind = self.ring.front().map_or(self.next, |record| record.position);
        self.miss(self.cursor.position, behind);
        self.cursor.position = behind;
    }

    /// A segment cannot be read: it counts as damaged as a whole.
    pub(super) fn skip_segment(&mut self) {
        if let Some((file, _)) = self.cursor.place.or_else(|| self.find()) {
            self.counts.damaged_places += 1;
            self.leave(file);
            let next = self.cursor.place.and_then(|(next, _)| {
                self.segments.iter().find(|segment| segment.file == next && next != file)
            });
            if let Some(first) = next.map(|next| next.first.max(self.cursor.position)) {
                self.miss(self.cursor.position, first);
                self.cursor.position = first;
            }
        }
    }

    fn behind_head(&mut self, chunk: &[u8]) -> usize {
        match Head::read(self.class, chunk) {
            FoundHead::Head(_) | FoundHead::Version(_) => HEAD,
            FoundHead::Damaged => {
                self.counts.damaged_places += 1;
                next_mark(chunk)
            }
        }
    }
}
