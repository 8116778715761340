//! Block transfers (CiA 301, 7.2.4.3.9 to 7.2.4.3.16): many segments for one acknowledgement, with a check sum.
//!
//! A block that breaks off in its middle is not mended: the client aborts, and begins again if it may. What was lost
//! within a block that came to its end is sent again from the first lost segment on.

use super::codec::{Answer, BLOCK, Payload, Request, SEGMENT, crc};
use super::transfer::{COPIES, Seen, Step, append};
use super::{AbortCode, ProtocolError, SdoError};
use crate::canopen::object::ObjectId;

/// Blocks in a row of which not even the first segment arrives, after which the transfer ends.
const STALLS: u32 = 3;

/// Reading: the server sends blocks.
#[derive(Debug)]
pub(super) struct BlockRead {
    announced: Option<u32>,
    phase: Reading,
    seen: Seen,
    stalls: u32,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Reading {
    /// This segment comes next.
    Segment(u8),
    /// This one got lost: the rest of the block is of no use.
    Lost(u8),
    /// All came; the check sum is missing.
    End,
}

impl BlockRead {
    /// The server is ready to send; `first` is the answer that says so.
    pub(super) fn new(announced: Option<u32>, first: Payload) -> Self {
        let mut seen = Seen::default();
        seen.take(first, COPIES);
        Self { announced, phase: Reading::Segment(1), seen, stalls: 0 }
    }

    /// Whether the next frame is a segment, which only its place tells.
    pub(super) fn is_receiving(&self) -> bool {
        self.phase != Reading::End
    }

    /// Takes a segment, or an abort of this object.
    pub(super) fn handle_segment(
        &mut self,
        object: ObjectId,
        payload: Payload,
        data: &mut Vec<u8>,
        longest: usize,
    ) -> Step {
        let [head, segment @ ..] = payload;
        let (number, last) = (head & 0x7F, head & 0x80 != 0);
        let (Reading::Segment(expected) | Reading::Lost(expected)) = self.phase else { return Step::Unasked };
        if number == 0 {
            return match Answer::parse(payload).abort_of(object) {
                Some(code) => Step::Failed { error: SdoError::Abort(code), abort: None },
                None => Step::Unasked,
            };
        }
        if self.phase == Reading::Segment(number) {
            self.seen.take(payload, 1);
            append(data, &segment, longest + SEGMENT);
            if let Some(step) = self.too_long(data.len(), longest) {
                return step;
            }
            if last {
                self.phase = Reading::End;
                return Step::Send(Request::BlockReadAcknowledge { segment: number }.payload());
            }
            self.phase = Reading::Segment(number + 1);
            if number < BLOCK {
                return Step::Continue;
            }
        } else if self.seen.is_copy(payload) {
            return Step::Duplicate;
        } else if number <= expected {
            return Step::Unasked;
        } else {
            self.seen.take(payload, 1);
            self.phase = Reading::Lost(expected);
            if number < BLOCK && !last {
                return Step::Continue;
            }
        }
        self.acknowledge()
    }

    /// The block is at its end.
    fn acknowledge(&mut self) -> Step {
        let (Reading::Segment(next) | Reading::Lost(next)) = self.phase else { return Step::Unasked };
        let segment = next - 1;
        self.stalls = if segment == 0 { self.stalls + 1 } else { 0 };
        if self.stalls > STALLS {
            return Step::protocol(ProtocolError::NoProgress, AbortCode::SEQUENCE);
        }
        self.phase = Reading::Segment(1);
        Step::Send(Request::BlockReadAcknowledge { segment }.payload())
    }

    /// The padding of the last segment is counted until its length is known.
    fn too_long(&self, received: usize, longest: usize) -> Option<Step> {
        let least = (received + 1).saturating_sub(SEGMENT);
        if let Some(announced) = self.announced
            && usize::try_from(announced).is_ok_and(|announced| least > announced.max(1))
        {
            let error = ProtocolError::Size { announced, received: least };
            return Some(Step::protocol(error, AbortCode::LENGTH));
        }
        (least > longest.max(1)).then(|| Step::abort(SdoError::TooLong { longest }, AbortCode::OUT_OF_MEMORY))
    }

    /// Takes the check sum.
    pub(super) fn handle_end(&mut self, answer: Answer, payload: Payload, data: &mut Vec<u8>) -> Step {
        let Answer::BlockReadEnd { unused, crc: theirs } = answer else {
            let [command, ..] = payload;
            return if self.seen.is_copy(payload) {
                Step::Duplicate
            } else {
                Step::protocol(ProtocolError::Command(command), AbortCode::COMMAND)
            };
        };
        data.truncate(data.len().saturating_sub(usize::from(unused)));
        let received = data.len();
        if let Some(announced) = self.announced
            && usize::try_from(announced) != Ok(received)
        {
            return Step::protocol(ProtocolError::Size { announced, received }, AbortCode::LENGTH);
        }
        if crc(data) != theirs {
            return Step::protocol(ProtocolError::Crc, AbortCode::CRC);
        }
        Step::Done { data: std::mem::take(data), farewell: Some(Request::BlockReadEnd.payload()) }
    }
}

/// Writing: we send blocks.
#[derive(Debug)]
pub(super) struct BlockWrite {
    /// Segments of a block, as the server wants it.
    block: u8,
    /// Bytes that arrived.
    done: usize,
    /// Segments of this block that were sent.
    sent: u8,
    /// The block is complete: everything was sent, or as much as goes into one.
    complete: bool,
    /// All bytes arrived, and the check sum was sent.
    ending: bool,
    seen: Seen,
    stalls: u32,
}

impl BlockWrite {
    /// The server is ready for blocks of so many segments; `first` is the answer that says so.
    pub(super) fn new(block: u8, first: Payload) -> Result<Self, Step> {
        let mut seen = Seen::default();
        seen.take(first, COPIES);
        let write = Self { block, done: 0, sent: 0, complete: false, ending: false, seen, stalls: 0 };
        if (1..=BLOCK).contains(&block) { Ok(write) } else { Err(wrong_size(block)) }
    }

    /// Whether segments are to be sent.
    pub(super) fn has_segments(&self) -> bool {
        !self.complete && !self.ending
    }

    /// The next segment.
    pub(super) fn poll_segment(&mut self, data: &[u8]) -> Option<Payload> {
        if !self.has_segments() {
            return None;
        }
        let from = self.done + usize::from(self.sent) * SEGMENT;
        let rest = data.get(from..).unwrap_or_default();
        let segment = rest.get(..SEGMENT).unwrap_or(rest);
        let last = rest.len() <= SEGMENT;
        self.sent += 1;
        self.complete = last || self.sent >= self.block;
        Some(Request::BlockWriteSegment { segment: self.sent, data: segment, last }.payload())
    }

    /// Takes an acknowledgement.
    pub(super) fn handle_answer(&mut self, answer: Answer, payload: Payload, data: &[u8]) -> Step {
        if answer == Answer::BlockWritten && self.ending {
            return Step::Done { data: Vec::new(), farewell: None };
        }
        if let Answer::BlockAcknowledged { segment, block } = answer
            && !self.ending
        {
            // While the block is being sent the same acknowledgement again can only be a copy.
            let early = !self.complete || segment > self.sent;
            if early && self.seen.is_copy(payload) {
                return Step::Duplicate;
            }
            if segment > self.sent {
                let error = ProtocolError::Sequence { acknowledged: segment, sent: self.sent };
                return Step::protocol(error, AbortCode::SEQUENCE);
            }
            self.seen.take(payload, 1);
            return self.acknowledged(segment, block, data);
        }
        let [command, ..] = payload;
        if self.seen.is_copy(payload) {
            Step::Duplicate
        } else {
            Step::protocol(ProtocolError::Command(command), AbortCode::COMMAND)
        }
    }

    fn acknowledged(&mut self, segment: u8, block: u8, data: &[u8]) -> Step {
        self.done = data.len().min(self.done + usize::from(segment) * SEGMENT);
        self.stalls = if segment == 0 { self.stalls + 1 } else { 0 };
        if self.stalls > STALLS {
            return Step::protocol(ProtocolError::NoProgress, AbortCode::SEQUENCE);
        }
        if self.done == data.len() {
            self.ending = true;
            let unused = u8::try_from((SEGMENT - data.len() % SEGMENT) % SEGMENT).unwrap_or_default();
            return Step::Send(Request::BlockWriteEnd { unused, crc: crc(data) }.payload());
        }
        if !(1..=BLOCK).contains(&block) {
            return wrong_size(block);
        }
        (self.block, self.sent, self.complete) = (block, 0, false);
        Step::Continue
    }
}

fn wrong_size(block: u8) -> Step {
    Step::protocol(ProtocolError::BlockSize(block), AbortCode::BLOCK_SIZE)
}
