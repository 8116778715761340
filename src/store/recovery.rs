//! What is found of a log after a start. Pure.
//!
//! Of each segment the head is read, and of the last few everything: what they end with tells where positions and numbers
//! go on. Numbers of events go on in a new stream where some may have been given out and forgotten: when in the newest segment
//! something unreadable or older stands behind the newest record, when it was not the newest, and after a power cut, unless
//! everything had been made sure of before.

use uuid::Uuid;

use super::disk::{Disk, DiskError};
use super::log::{Cursor, Log, Segment, Surroundings, file_of, length, name};
use super::record::{Class, Found, FoundHead, HEAD, Head, Piece, Record, StreamId, next_mark};
use crate::time::Timestamp;

/// Bytes that are read at once.
const CHUNK: usize = 1024 * 1024;
/// Segments before the newest that are read wholly.
const OVERLAPPING: usize = 3;

/// What a segment ends with.
#[derive(Debug, Default)]
struct Tail {
    newest: Option<Record>,
    marked: Option<(u64, u64)>,
    closed: bool,
    sealed: bool,
    /// Behind the newest record that is known there may have been newer ones.
    damaged: bool,
    places: u64,
}

/// Reads what there is. `fresh` is the stream that numbers go on in where those so far cannot be told.
pub(super) fn recover<D: Disk>(
    disk: &mut D,
    class: Class,
    files: &[(String, u64)],
    around: Surroundings,
    fresh: StreamId,
) -> Result<Log, DiskError> {
    let mut log = Log::new(class, fresh);
    let mut whole = true;
    let mut found: Vec<(Segment, Option<Head>)> = Vec::new();
    for (name, bytes) in files {
        let Some(file) = file_of(class, name) else { continue };
        log.next_file = log.next_file.max(file.checked_add(1).unwrap_or(1));
        if let Some((first, at, head)) = look_at(disk, class, name)? {
            found.push((Segment { file, first, bytes: *bytes, newest: at }, head));
        } else {
            // Nothing in it can be believed; what it held may have been the newest.
            whole = false;
            log.counts.damaged_places += 1;
            disk.remove(name)?;
        }
    }
    while files.iter().any(|(other, _)| *other == name(class, log.next_file)) {
        log.next_file = log.next_file.checked_add(1).unwrap_or(1);
    }
    found.sort_by_key(|(segment, _)| (segment.first, segment.file));
    let ends = found.iter().skip(1).map(|(segment, _)| segment.newest).collect::<Vec<_>>();
    for ((segment, _), end) in found.iter_mut().zip(ends) {
        segment.newest = end;
    }
    let Some((newest, head)) = found.last().cloned() else { return Ok(log) };
    let tail = read_tail(disk, class, &newest, head.is_some())?;
    let heads = found.iter().filter_map(|(_, head)| *head);
    let marks = heads.map(|head| (head.acked, head.dropped)).chain(tail.marked);
    log.segments = found.iter().map(|(segment, _)| segment.clone()).collect();
    go_on(&mut log, &newest, head, &tail);
    // What was written again after a fault may stand in a segment before, too, and go on further there.
    for (segment, head) in found.iter().rev().skip(1).take(OVERLAPPING) {
        let tail = read_tail(disk, class, segment, head.is_some())?;
        log.next = log.next.max(tail.newest.map_or(1, |record| record.position.saturating_add(1)));
    }
    let (acked, dropped) =
        marks.fold((0, 0), |(acked, dropped), mark| (mark.0.max(acked), mark.1.max(dropped)));
    log.marked = acked.min(log.next - 1);
    log.dropped_to = dropped.min(log.next - 1);
    // Positions begin at 1, unless what came before the first segment was acknowledged and removed.
    let position = log.marked.saturating_add(1);
    log.cursor = Cursor { position, ..Cursor::default() };
    log.counts.damaged_places += tail.places;
    if let Some(newest) = log.segments.back_mut() {
        newest.newest = tail.newest.as_ref().map_or(newest.newest, |record| record.at);
    }
    if !whole || !is_known_whole(head, &tail, around.boot) {
        log.stream = fresh;
    }
    // A file goes on being written only where the system can have lost nothing of it.
    let same = head.is_some_and(|head| head.boot == around.boot && head.strict == around.strict);
    log.open = same && !tail.damaged && !tail.sealed;
    // Its checksums were read from what the system still holds in memory: only a sync makes sure.
    log.dirty = log.open;
    Ok(log)
}

/// Where positions and numbers go on.
fn go_on(log: &mut Log, newest: &Segment, head: Option<Head>, tail: &Tail) {
    let behind = tail.newest.as_ref().map(|record| record.position.saturating_add(1));
    log.next = behind.unwrap_or(newest.first).max(newest.first).max(1);
    if let Some(head) = head {
        (log.stream, log.number) = (head.stream, head.number);
    }
    if let Some(record) = &tail.newest {
        (log.stream, log.number) = (record.stream, record.number);
    }
}

/// Whether every number that was given out is known.
fn is_known_whole(head: Option<Head>, tail: &Tail, boot: Uuid) -> bool {
    let Some(head) = head else { return false };
    !tail.damaged && !tail.sealed && (head.boot == boot || head.strict || tail.closed)
}

/// Position of the first record of a file and when it was begun; `None` where nothing in it can be believed.
fn look_at<D: Disk>(
    disk: &mut D,
    class: Class,
    name: &str,
) -> Result<Option<(u64, Timestamp, Option<Head>)>, DiskError> {
    match Head::read(class, &disk.read(name, 0, HEAD)?) {
        FoundHead::Head(head) => return Ok(Some((head.first, head.at, Some(head)))),
        FoundHead::Version(version) => {
            return Err(DiskError::Failed(format!(
                "`{name}` was written by another version of cangate (format {version}); take another folder, or remove it"
            )));
        }
        FoundHead::Damaged => {}
    }
    let mut first = None;
    walk(disk, class, name, 0, |piece, _, _| {
        if let Piece::Record(record) = piece {
            first = Some((record.position, record.at, None));
        }
        first.is_none()
    })?;
    Ok(first)
}

fn read_tail<D: Disk>(
    disk: &mut D,
    class: Class,
    segment: &Segment,
    has_head: bool,
) -> Result<Tail, DiskError> {
    let mut tail = Tail::default();
    let start = if has_head { length(HEAD) } else { 0 };
    let mut end = start;
    let mut doubtful = false;
    let places = walk(disk, class, &name(class, segment.file), start, |piece, from, behind| {
        tail.closed = matches!(piece, Piece::Closed);
        doubtful |= from > end;
        end = behind;
        match piece {
            Piece::Record(record) => {
                // Only what stands behind the newest record can have been a newer one.
                doubtful = tail.newest.as_ref().is_some_and(|newest| newest.position >= record.position);
                if !doubtful {
                    tail.newest = Some(record);
                }
            }
            Piece::Marked { acked, dropped } => tail.marked = Some((acked, dropped)),
            Piece::Closed => {}
            Piece::Sealed => tail.sealed = true,
        }
        true
    })?;
    let is_cut = end < segment.bytes;
    tail.damaged = is_cut || doubtful;
    // What is damaged further in front is counted when it is come to.
    tail.places = places.min(u64::from(is_cut));
    Ok(tail)
}

/// Goes through the pieces of a file while `each` says so, which is told the offsets of the piece and of what is behind it;
/// gives the number of places that were skipped.
fn walk<D: Disk>(
    disk: &mut D,
    class: Class,
    name: &str,
    start: u64,
    mut each: impl FnMut(Piece, u64, u64) -> bool,
) -> Result<u64, DiskError> {
    let (mut at, mut places) = (start, 0);
    loop {
        let chunk = disk.read(name, at, CHUNK)?;
        let at_end = chunk.len() < CHUNK;
        let mut offset = 0;
        while let Some(rest) = chunk.get(offset..).filter(|rest| !rest.is_empty()) {
            match Piece::read(class, rest) {
                Found::Piece(piece, taken) => {
                    let from = at.saturating_add(length(offset));
                    offset += taken;
                    if !each(piece, from, at.saturating_add(length(offset))) {
                        return Ok(places);
                    }
                }
                Found::Cut if !at_end && offset > 0 => break,
                Found::Cut | Found::Damaged => {
                    places += 1;
                    offset += 1 + next_mark(rest.get(1..).unwrap_or_default());
                }
            }
        }
        at = at.saturating_add(length(offset));
        if at_end {
            return Ok(places);
        }
    }
}
