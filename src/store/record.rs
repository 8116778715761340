//! How records and the heads of segment files stand on disk, little-endian. Pure.
//!
//! A record bears its mark, its checksum and the id of its stream, so that each is believed or not by itself. The mark
//! holds a byte that UTF-8 never does: no text that is stored as it is can look like the beginning of a record. Long texts
//! are deflated (RFC 1951), each by itself, so that damage to one costs no other; one that looks like a beginning there has no
//! checksum that fits.

use std::borrow::Cow;
use std::sync::Arc;

use miniz_oxide::deflate::compress_to_vec;
use miniz_oxide::inflate::decompress_to_vec_with_limit;
use uuid::Uuid;

use crate::time::Timestamp;

/// Names a stream of numbers for ever.
pub type StreamId = Uuid;

/// What a record is, which decides what has to go first.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Class {
    /// Something that happened. Goes last.
    Event,
    /// A value of some moment. Goes first.
    Sample,
}

impl Class {
    /// Both, in the order in which arrays hold them.
    pub const ALL: [Self; 2] = [Self::Event, Self::Sample];

    /// Its place in such arrays.
    #[must_use]
    pub fn place(self) -> usize {
        match self {
            Self::Event => 0,
            Self::Sample => 1,
        }
    }

    /// The word in names of files and figures.
    #[must_use]
    pub fn word(self) -> &'static str {
        match self {
            Self::Event => "event",
            Self::Sample => "sample",
        }
    }

    fn code(self) -> u8 {
        match self {
            Self::Event => 1,
            Self::Sample => 2,
        }
    }
}

/// A record as it is handed out.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Item {
    /// Its place in its class; for the acknowledgement.
    pub position: u64,
    /// Records before it that are gone and that no item before told of.
    pub lost_before: u64,
    /// The stream that its number belongs to.
    pub stream: StreamId,
    /// Its number there, as it was given in.
    pub number: u64,
    /// When it was given in.
    pub at: Timestamp,
    /// As it was given in.
    pub body: Arc<str>,
}

/// A record inside the store.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Record {
    pub(super) position: u64,
    pub(super) stream: StreamId,
    pub(super) number: u64,
    pub(super) at: Timestamp,
    pub(super) body: Arc<str>,
}

/// What stands in a segment after its head.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum Piece {
    /// A record.
    Record(Record),
    /// All up to `acked` need not be sent any more; what is missing up to `dropped` was dropped, not damaged.
    Marked { acked: u64, dropped: u64 },
    /// The log was closed in good order: nothing came after this.
    Closed,
    /// Another segment was begun after this one.
    Sealed,
}

/// Bytes of a body.
pub const LARGEST_BODY: usize = 512 * 1024;
/// Bytes that a record takes beside its body.
pub const OVERHEAD: usize = 54;
const MARK: [u8; 4] = [0xFF, 0xC6, 0x91, 0x0D];
const RECORD: u8 = 1;
const POSITION: u8 = 2;
const CLOSED: u8 = 3;
const SEALED: u8 = 4;
/// A record whose body is deflated.
const PACKED: u8 = 5;
/// Shorter bodies stand as they are: there is little to be won.
const WORTH_PACKING: usize = 512;
/// How hard is tried, of 1 to 10: more wins hardly anything with bodies of some kilobytes.
const EFFORT: u8 = 6;

/// A body as it stands on disk, and the kind of its record.
fn packed(body: &str) -> (u8, Cow<'_, [u8]>) {
    let worth = body.len() >= WORTH_PACKING;
    let packed = worth.then(|| compress_to_vec(body.as_bytes(), EFFORT));
    match packed.filter(|packed| packed.len() < body.len()) {
        Some(packed) => (PACKED, packed.into()),
        None => (RECORD, body.as_bytes().into()),
    }
}

/// Bytes that a record of this body takes on disk.
#[must_use]
pub fn stored_size(body: &str) -> usize {
    packed(body).1.len() + OVERHEAD
}

/// What was found at the beginning of some bytes.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum Found {
    /// A piece, and its length in bytes.
    Piece(Piece, usize),
    /// What may be a piece that goes on behind these bytes.
    Cut,
    /// None.
    Damaged,
}

impl Piece {
    /// Adds it to `out`.
    pub(super) fn write(&self, class: Class, out: &mut Vec<u8>) {
        let ((kind, body), position, number, at, stream) = match self {
            Self::Record(record) => {
                let Record { position, stream, number, at, body } = record;
                (packed(body), *position, *number, at.as_micros(), *stream)
            }
            Self::Marked { acked, dropped } => ((POSITION, Cow::default()), *acked, *dropped, 0, Uuid::nil()),
            Self::Closed => ((CLOSED, Cow::default()), 0, 0, 0, Uuid::nil()),
            Self::Sealed => ((SEALED, Cow::default()), 0, 0, 0, Uuid::nil()),
        };
        let start = out.len();
        out.extend_from_slice(&MARK);
        out.extend_from_slice(&[kind, class.code()]);
        out.extend_from_slice(&u32::try_from(body.len()).unwrap_or(u32::MAX).to_le_bytes());
        out.extend_from_slice(&position.to_le_bytes());
        out.extend_from_slice(&number.to_le_bytes());
        out.extend_from_slice(&at.to_le_bytes());
        out.extend_from_slice(stream.as_bytes());
        let head = crc32c::crc32c(out.get(start..).unwrap_or_default());
        out.extend_from_slice(&crc32c::crc32c_append(head, &body).to_le_bytes());
        out.extend_from_slice(&body);
    }

    /// Reads the piece at the beginning of `bytes`.
    pub(super) fn read(class: Class, bytes: &[u8]) -> Found {
        let Some((head, rest)) = bytes.split_at_checked(OVERHEAD) else {
            let begins = MARK.iter().zip(bytes).all(|(mark, byte)| mark == byte);
            return if begins && !bytes.is_empty() { Found::Cut } else { Found::Damaged };
        };
        Self::read_whole(class, head, rest).unwrap_or(Found::Damaged)
    }

    fn read_whole(class: Class, head: &[u8], rest: &[u8]) -> Option<Found> {
        let (summed, mut sum) = head.split_at_checked(OVERHEAD - 4)?;
        let mut bytes = summed;
        let mark: [u8; 4] = take(&mut bytes)?;
        let [kind, of_class] = take(&mut bytes)?;
        let length = usize::try_from(u32::from_le_bytes(take(&mut bytes)?)).ok()?;
        if mark != MARK || of_class != class.code() || length > LARGEST_BODY {
            return None;
        }
        let Some(body) = rest.get(..length) else { return Some(Found::Cut) };
        if crc32c::crc32c_append(crc32c::crc32c(summed), body) != u32::from_le_bytes(take(&mut sum)?) {
            return None;
        }
        let (position, number) =
            (u64::from_le_bytes(take(&mut bytes)?), u64::from_le_bytes(take(&mut bytes)?));
        let at = Timestamp::from_micros(i64::from_le_bytes(take(&mut bytes)?));
        let stream = Uuid::from_bytes(take(&mut bytes)?);
        let piece = match kind {
            RECORD | PACKED => {
                let body = if kind == PACKED {
                    String::from_utf8(decompress_to_vec_with_limit(body, LARGEST_BODY).ok()?).ok()?.into()
                } else {
                    std::str::from_utf8(body).ok()?.into()
                };
                Self::Record(Record { position, stream, number, at, body })
            }
            POSITION => Self::Marked { acked: position, dropped: number },
            CLOSED => Self::Closed,
            SEALED => Self::Sealed,
            _ => return None,
        };
        Some(Found::Piece(piece, OVERHEAD + length))
    }
}

/// Where the next mark stands in `bytes`, or where one that is cut may begin; their length where there is none.
pub(super) fn next_mark(bytes: &[u8]) -> usize {
    let begins = |tail: &[u8]| MARK.iter().zip(tail).all(|(mark, byte)| mark == byte);
    let mut from = 0;
    while let Some(tail) = bytes.get(from..).filter(|tail| !tail.is_empty()) {
        let Some(found) = tail.iter().position(|byte| Some(byte) == MARK.first()) else { break };
        if tail.get(found..).is_some_and(begins) {
            return from + found;
        }
        from += found + 1;
    }
    bytes.len()
}

/// The head of a segment file: where the log stood when the file was begun.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Head {
    /// Position of its first record.
    pub(super) first: u64,
    /// All up to here need not be sent any more.
    pub(super) acked: u64,
    /// What is missing up to here was dropped, not damaged.
    pub(super) dropped: u64,
    /// Number of the newest record before it.
    pub(super) number: u64,
    /// When it was begun.
    pub(super) at: Timestamp,
    /// The stream of its numbers.
    pub(super) stream: StreamId,
    /// The run of the system in which it was written.
    pub(super) boot: Uuid,
    /// Every record was synced before it was handed out.
    pub(super) strict: bool,
}

/// Bytes of a head.
pub(super) const HEAD: usize = 88;
const HEAD_MARK: [u8; 8] = *b"CANGATE\n";
/// Version of the format. Another one is not touched.
const VERSION: u16 = 1;

/// What the beginning of a file says.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum FoundHead {
    /// This.
    Head(Head),
    /// It was written by a program that knows this version of the format.
    Version(u16),
    /// Nothing that can be believed.
    Damaged,
}

impl Head {
    pub(super) fn write(&self, class: Class, out: &mut Vec<u8>) {
        let start = out.len();
        out.extend_from_slice(&HEAD_MARK);
        out.extend_from_slice(&VERSION.to_le_bytes());
        out.extend_from_slice(&[class.code(), u8::from(self.strict)]);
        for number in [self.first, self.acked, self.dropped, self.number] {
            out.extend_from_slice(&number.to_le_bytes());
        }
        out.extend_from_slice(&self.at.as_micros().to_le_bytes());
        out.extend_from_slice(self.stream.as_bytes());
        out.extend_from_slice(self.boot.as_bytes());
        let sum = crc32c::crc32c(out.get(start..).unwrap_or_default());
        out.extend_from_slice(&sum.to_le_bytes());
    }

    pub(super) fn read(class: Class, bytes: &[u8]) -> FoundHead {
        Self::read_whole(class, bytes).unwrap_or(FoundHead::Damaged)
    }

    fn read_whole(class: Class, bytes: &[u8]) -> Option<FoundHead> {
        let (mut rest, mut sum) = bytes.get(..HEAD)?.split_at_checked(HEAD - 4)?;
        let summed = crc32c::crc32c(rest);
        let mark: [u8; 8] = take(&mut rest)?;
        let version = u16::from_le_bytes(take(&mut rest)?);
        if mark != HEAD_MARK || summed != u32::from_le_bytes(take(&mut sum)?) {
            return None;
        }
        if version != VERSION {
            return Some(FoundHead::Version(version));
        }
        let [of_class, strict] = take(&mut rest)?;
        let mut number = || Some(u64::from_le_bytes(take(&mut rest)?));
        let (first, acked, dropped, newest) = (number()?, number()?, number()?, number()?);
        let at = Timestamp::from_micros(i64::from_le_bytes(take(&mut rest)?));
        let (stream, boot) = (Uuid::from_bytes(take(&mut rest)?), Uuid::from_bytes(take(&mut rest)?));
        let head = Self { first, acked, dropped, number: newest, at, stream, boot, strict: strict == 1 };
        (of_class == class.code()).then_some(FoundHead::Head(head))
    }
}

/// Takes the first bytes off.
fn take<const N: usize>(bytes: &mut &[u8]) -> Option<[u8; N]> {
    let (first, rest) = bytes.split_first_chunk()?;
    *bytes = rest;
    Some(*first)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn record(body: &str) -> Piece {
        let at = Timestamp::from_millis(1_763_760_000_123);
        Piece::Record(Record { position: 7, stream: Uuid::from_u128(9), number: 3, at, body: body.into() })
    }

    #[test]
    fn what_is_written_is_read() {
        for piece in [
            record("{\"a\":1}"),
            record(""),
            Piece::Marked { acked: 3, dropped: 2 },
            Piece::Closed,
            Piece::Sealed,
        ] {
            let mut bytes = Vec::new();
            piece.write(Class::Event, &mut bytes);
            let length = bytes.len();
            bytes.extend_from_slice(b"more");
            assert_eq!(Piece::read(Class::Event, &bytes), Found::Piece(piece, length));
            assert_eq!(Piece::read(Class::Sample, &bytes), Found::Damaged, "each class has its own files");
        }
        let head = Head {
            first: 1,
            acked: 2,
            dropped: 3,
            number: 5,
            at: Timestamp::from_millis(6),
            stream: Uuid::from_u128(7),
            boot: Uuid::from_u128(8),
            strict: true,
        };
        let mut bytes = Vec::new();
        head.write(Class::Sample, &mut bytes);
        assert_eq!(bytes.len(), HEAD);
        assert_eq!(Head::read(Class::Sample, &bytes), FoundHead::Head(head));
        assert_eq!(Head::read(Class::Event, &bytes), FoundHead::Damaged);
    }

    /// A state with so many values, no two alike.
    fn long_body(values: u32) -> String {
        let value = |place: u32| {
            format!(
                "\"intensity_{place}\":{},",
                f64::from(place.wrapping_mul(2_654_435_761) % 10_007) / 100.0
            )
        };
        format!("plant/engine/history\n{{{}\"é\":0}}", (1..=values).map(value).collect::<String>())
    }

    #[test]
    fn a_long_body_takes_less_than_half_and_comes_out_byte_for_byte() {
        for values in [30, 100, 1000, 10_000] {
            let body = long_body(values);
            let piece = record(&body);
            let mut bytes = Vec::new();
            piece.write(Class::Sample, &mut bytes);
            assert_eq!(bytes.len(), stored_size(&body));
            assert!(bytes.len() < body.len() / 2 + OVERHEAD, "{} of {}", bytes.len(), body.len());
            assert_eq!(Piece::read(Class::Sample, &bytes), Found::Piece(piece, bytes.len()));
        }
        // Short or without a pattern: nothing is added.
        let noise: String = (0..600_u32)
            .filter_map(|place| char::from_u32(place.wrapping_mul(2_654_435_761) % 0xD000))
            .collect();
        for body in ["x".repeat(WORTH_PACKING - 1), noise] {
            assert!(stored_size(&body) <= body.len() + OVERHEAD);
            let mut bytes = Vec::new();
            record(&body).write(Class::Sample, &mut bytes);
            assert_eq!(Piece::read(Class::Sample, &bytes), Found::Piece(record(&body), bytes.len()));
        }
    }

    #[test]
    fn a_body_that_would_come_out_longer_than_any_is_damage() {
        let body: std::sync::Arc<str> = "x".repeat(LARGEST_BODY + 1).into();
        let mut bytes = Vec::new();
        record(&body).write(Class::Sample, &mut bytes);
        assert!(bytes.len() < LARGEST_BODY / 100);
        assert_eq!(Piece::read(Class::Sample, &bytes), Found::Damaged);
    }

    #[test]
    fn no_bit_of_a_record_or_head_can_flip_unseen() {
        for body in ["{\"state\":\"online\"}".to_owned(), long_body(30)] {
            no_bit_flips_unseen(&body);
        }
    }

    fn no_bit_flips_unseen(body: &str) {
        let mut bytes = Vec::new();
        record(body).write(Class::Event, &mut bytes);
        for bit in 0..bytes.len() * 8 {
            bytes[bit / 8] ^= 1 << (bit % 8);
            let found = Piece::read(Class::Event, &bytes);
            assert!(matches!(found, Found::Damaged | Found::Cut), "bit {bit}: {found:?}");
            bytes[bit / 8] ^= 1 << (bit % 8);
        }
        for length in 0..bytes.len() {
            let found = Piece::read(Class::Event, &bytes[..length]);
            assert!(matches!(found, Found::Damaged | Found::Cut), "{length}");
        }
    }

    #[test]
    fn the_next_mark_is_found_behind_anything() {
        let mut bytes = vec![0xFF; 100];
        record("x").write(Class::Event, &mut bytes);
        assert_eq!(next_mark(&bytes), 100);
        assert_eq!(next_mark(&bytes[101..]), bytes.len() - 101);
        assert_eq!(next_mark(&bytes[..102]), 100, "a mark that is cut");
        assert_eq!(next_mark(&[]), 0);
    }
}
