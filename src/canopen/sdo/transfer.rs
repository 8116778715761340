//! One SDO transfer, from its first frame to its result: expedited and in segments here, in blocks in `block`.
//!
//! It knows no time: the client says when an answer is overdue.

use super::block::{BlockRead, BlockWrite};
use super::codec::{Answer, Payload, Request, SEGMENT};
use super::{AbortCode, ProtocolError, SdoAction, SdoError, SdoRequest};
use crate::canopen::object::ObjectId;

/// Objects of at most so many bytes are not worth blocks: four segments.
pub(super) const BLOCK_THRESHOLD: u8 = 28;

/// Copies of a first answer that may come: its request arrives twice, and each of the two answers does.
pub(super) const COPIES: u32 = 3;

/// One transfer.
#[derive(Debug)]
pub(super) struct Transfer {
    pub(super) object: ObjectId,
    direction: Direction,
    /// What was read so far, or is to be written.
    data: Vec<u8>,
    /// The most bytes to read.
    longest: usize,
    /// How long the object is, where an expedited answer does not say it.
    len: Option<usize>,
    state: State,
    seen: Seen,
    /// First requests that were sent, and answers to them that came: what is missing may come later.
    begun: u32,
    answered: u32,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Direction {
    Read,
    Write,
}

#[derive(Debug)]
enum State {
    /// The first request was sent.
    Begun,
    Reading {
        toggle: bool,
        announced: Option<u32>,
    },
    /// `sent`: bytes in segments, with the one that is not acknowledged yet.
    Writing {
        toggle: bool,
        sent: usize,
    },
    BlockReadBegun,
    BlockReading(BlockRead),
    BlockWriteBegun,
    BlockWriting(BlockWrite),
}

/// Appends without ever asking for more memory than the longest object needs, whatever a server announces.
pub(super) fn append(data: &mut Vec<u8>, bytes: &[u8], longest: usize) {
    if data.capacity() - data.len() < bytes.len() {
        let most = longest.saturating_sub(data.len()).max(bytes.len());
        data.reserve_exact(data.len().max(64).clamp(bytes.len(), most));
    }
    data.extend_from_slice(bytes);
}

/// What an answer leads to.
#[derive(Debug)]
pub(super) enum Step {
    /// Send this and wait for an answer.
    Send(Payload),
    /// Wait for the next answer, or go on sending segments of a block.
    Continue,
    /// It is over; `farewell` is still to be sent.
    Done { data: Vec<u8>, farewell: Option<Payload> },
    /// It is over. `abort`: the server is to be told.
    Failed { error: SdoError, abort: Option<AbortCode> },
    /// The server does not do blocks, or not well enough: begin again without. `abort`: it is to be told.
    NoBlocks { abort: Option<AbortCode> },
    /// The answer was no answer to this transfer: another client's, or one that comes late.
    Unasked,
    /// The answer came a second time.
    Duplicate,
}

impl Step {
    /// A failure of which the server is to be told.
    pub(super) fn abort(error: SdoError, code: AbortCode) -> Self {
        Self::Failed { error, abort: Some(code) }
    }

    /// A breach of the protocol.
    pub(super) fn protocol(error: ProtocolError, code: AbortCode) -> Self {
        Self::abort(SdoError::Protocol(error), code)
    }
}

/// The last answer that was taken, to know it when it comes again.
///
/// A CAN controller repeats a frame whose last bit was disturbed for itself alone: all others have it twice. The copy
/// follows its original at once, before any other frame of the same node.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Seen {
    last: Option<Payload>,
    /// How many copies may come.
    copies: u32,
}

impl Seen {
    /// An answer was taken, of which so many copies may follow.
    pub(super) fn take(&mut self, payload: Payload, copies: u32) {
        *self = Self { last: Some(payload), copies };
    }

    /// Whether this is a copy of the last answer; each is one less.
    pub(super) fn is_copy(&mut self, payload: Payload) -> bool {
        let copy = self.last == Some(payload) && self.copies > 0;
        self.copies = self.copies.saturating_sub(u32::from(copy));
        copy
    }
}

impl Transfer {
    /// A transfer that has not begun; reads at most `longest` bytes.
    pub(super) fn new(request: SdoRequest, longest: usize) -> Self {
        let (direction, data) = match request.action {
            SdoAction::Read => (Direction::Read, Vec::new()),
            SdoAction::Write(data) => (Direction::Write, data),
        };
        Self {
            object: request.object,
            direction,
            data,
            longest,
            len: request.len,
            state: State::Begun,
            seen: Seen::default(),
            begun: 0,
            answered: 0,
        }
    }

    /// Begins, or begins again; gives the first request. `blocks`: in blocks if that is worth it.
    pub(super) fn begin(&mut self, blocks: bool) -> Payload {
        self.begun = self.begun.saturating_add(1);
        self.seen = Seen::default();
        let object = self.object;
        match self.direction {
            Direction::Read => {
                self.data = Vec::new();
                if blocks {
                    self.state = State::BlockReadBegun;
                    Request::BlockRead { object, threshold: BLOCK_THRESHOLD }.payload()
                } else {
                    self.state = State::Begun;
                    Request::Read(object).payload()
                }
            }
            Direction::Write if blocks && self.data.len() > usize::from(BLOCK_THRESHOLD) => {
                self.state = State::BlockWriteBegun;
                Request::BlockWrite(object, self.data.len()).payload()
            }
            Direction::Write => {
                self.state = State::Begun;
                if (1..=4).contains(&self.data.len()) {
                    Request::WriteExpedited(object, &self.data).payload()
                } else {
                    Request::WriteSegmented(object, self.data.len()).payload()
                }
            }
        }
    }

    /// Whether no answer has come yet to what [`begin`](Self::begin) gave.
    pub(super) fn is_beginning(&self) -> bool {
        matches!(self.state, State::Begun | State::BlockReadBegun | State::BlockWriteBegun)
    }

    /// The first request did not leave: no answer to it will come.
    pub(super) fn not_begun(&mut self) {
        self.begun = self.begun.saturating_sub(1);
    }

    /// Whether answers to first requests are still missing.
    pub(super) fn is_unsettled(&self) -> bool {
        self.begun > self.answered
    }

    /// The next segment of a block that is to be sent now.
    pub(super) fn poll_segment(&mut self) -> Option<Payload> {
        match &mut self.state {
            State::BlockWriting(block) => block.poll_segment(&self.data),
            State::Begun
            | State::Reading { .. }
            | State::Writing { .. }
            | State::BlockReadBegun
            | State::BlockReading(_)
            | State::BlockWriteBegun => None,
        }
    }

    /// Whether [`poll_segment`](Self::poll_segment) has more.
    pub(super) fn has_segments(&self) -> bool {
        matches!(&self.state, State::BlockWriting(block) if block.has_segments())
    }

    /// Takes an answer.
    pub(super) fn handle_answer(&mut self, payload: Payload) -> Step {
        if let State::BlockReading(block) = &mut self.state
            && block.is_receiving()
        {
            return block.handle_segment(self.object, payload, &mut self.data, self.longest);
        }
        let answer = Answer::parse(payload);
        let named = answer.object();
        if named.is_some_and(|named| named != self.object) {
            let another_began = !self.is_beginning() && !matches!(answer, Answer::Abort { .. });
            let error = SdoError::Interrupted;
            return if another_began { Step::Failed { error, abort: None } } else { Step::Unasked };
        }
        if named.is_some() && self.seen.is_copy(payload) {
            return Step::Duplicate;
        }
        if let Answer::Abort { code, .. } = answer {
            return self.handle_abort(code);
        }
        match &mut self.state {
            State::Begun | State::BlockReadBegun | State::BlockWriteBegun => {
                self.handle_first(answer, payload)
            }
            State::Reading { .. } => self.handle_read_segment(answer, payload),
            State::Writing { .. } => self.handle_written_segment(answer, payload),
            State::BlockReading(block) => block.handle_end(answer, payload, &mut self.data),
            State::BlockWriting(block) => block.handle_answer(answer, payload, &self.data),
        }
    }

    fn handle_abort(&mut self, code: AbortCode) -> Step {
        // What servers say that do not know blocks. Begun again without, the object itself gets its say.
        let refused =
            [AbortCode::COMMAND, AbortCode::BLOCK_SIZE, AbortCode::UNSUPPORTED_ACCESS, AbortCode::GENERAL];
        let asked = matches!(self.state, State::BlockReadBegun | State::BlockWriteBegun);
        self.answered = self.answered.saturating_add(u32::from(self.is_beginning()));
        if asked && refused.contains(&code) {
            return Step::NoBlocks { abort: None };
        }
        Step::Failed { error: SdoError::Abort(code), abort: None }
    }

    /// The answer to the first request, which names our object if it names one.
    fn handle_first(&mut self, answer: Answer, payload: Payload) -> Step {
        let step = match (&self.state, self.direction, answer) {
            (
                State::Begun | State::BlockReadBegun,
                Direction::Read,
                Answer::ReadExpedited { data, len, .. },
            ) => {
                let len = len.or(self.len).unwrap_or(data.len());
                let data = data.iter().take(len).copied().collect();
                Step::Done { data, farewell: None }
            }
            (State::Begun | State::BlockReadBegun, Direction::Read, Answer::ReadSegmented { size, .. }) => {
                self.state = State::Reading { toggle: false, announced: size };
                self.unless_too_long(size, Request::ReadSegment { toggle: false })
            }
            (State::BlockReadBegun, _, Answer::BlockRead { crc: true, size, .. }) => {
                self.state = State::BlockReading(BlockRead::new(size, payload));
                self.unless_too_long(size, Request::BlockReadStart)
            }
            // Without a check sum a frame of another client could pass for a segment.
            (State::BlockReadBegun, _, Answer::BlockRead { crc: false, .. })
            | (State::BlockWriteBegun, _, Answer::BlockWrite { crc: false, .. }) => {
                Step::NoBlocks { abort: Some(AbortCode::GENERAL) }
            }
            (State::BlockWriteBegun, _, Answer::BlockWrite { crc: true, block, .. }) => {
                match BlockWrite::new(block, payload) {
                    Ok(block) => {
                        self.state = State::BlockWriting(block);
                        Step::Continue
                    }
                    Err(step) => step,
                }
            }
            (State::Begun, Direction::Write, Answer::Written { .. }) => {
                if (1..=4).contains(&self.data.len()) {
                    Step::Done { data: Vec::new(), farewell: None }
                } else {
                    Step::Send(self.write_segment(false, 0))
                }
            }
            _ => return Step::Unasked,
        };
        self.answered = self.answered.saturating_add(1);
        let repetitions = self.begun.saturating_sub(1);
        self.seen.take(payload, COPIES.saturating_add(repetitions.saturating_mul(COPIES + 1)));
        step
    }

    fn unless_too_long(&self, announced: Option<u32>, request: Request<'_>) -> Step {
        let longest = self.longest;
        let fits = announced.is_none_or(|size| usize::try_from(size).is_ok_and(|size| size <= longest));
        if fits {
            return Step::Send(request.payload());
        }
        Step::abort(SdoError::TooLong { longest }, AbortCode::OUT_OF_MEMORY)
    }

    fn handle_read_segment(&mut self, answer: Answer, payload: Payload) -> Step {
        let State::Reading { toggle: expected, announced } = self.state else { return Step::Unasked };
        let Answer::Segment { toggle, data, len, last } = answer else {
            return unexpected(payload);
        };
        if toggle != expected {
            return self.wrong_toggle(payload);
        }
        self.segment_taken(payload);
        if len == 0 && !last {
            return Step::protocol(ProtocolError::EmptySegment, AbortCode::GENERAL);
        }
        let received = self.data.len() + len;
        if received <= self.longest {
            append(&mut self.data, data.get(..len).unwrap_or_default(), self.longest);
        } else {
            let error = SdoError::TooLong { longest: self.longest };
            return Step::Failed { error, abort: (!last).then_some(AbortCode::OUT_OF_MEMORY) };
        }
        if let Some(announced) = announced {
            let differs = usize::try_from(announced)
                .map_or(true, |announced| if last { received != announced } else { received > announced });
            if differs {
                let error = SdoError::Protocol(ProtocolError::Size { announced, received });
                return Step::Failed { error, abort: (!last).then_some(AbortCode::LENGTH) };
            }
        }
        if last {
            return Step::Done { data: std::mem::take(&mut self.data), farewell: None };
        }
        self.state = State::Reading { toggle: !expected, announced };
        Step::Send(Request::ReadSegment { toggle: !expected }.payload())
    }

    fn handle_written_segment(&mut self, answer: Answer, payload: Payload) -> Step {
        let State::Writing { toggle: expected, sent } = self.state else { return Step::Unasked };
        let Answer::SegmentWritten { toggle } = answer else {
            return unexpected(payload);
        };
        if toggle != expected {
            return self.wrong_toggle(payload);
        }
        self.segment_taken(payload);
        if sent >= self.data.len() {
            return Step::Done { data: Vec::new(), farewell: None };
        }
        Step::Send(self.write_segment(!expected, sent))
    }

    /// An answer to a segment was taken: by the order on the bus, all answers to first requests have come before it.
    fn segment_taken(&mut self, payload: Payload) {
        self.seen.take(payload, 1);
        self.answered = self.begun;
    }

    fn write_segment(&mut self, toggle: bool, from: usize) -> Payload {
        let rest = self.data.get(from..).unwrap_or_default();
        let data = rest.get(..SEGMENT).unwrap_or(rest);
        let sent = from + data.len();
        let last = sent >= self.data.len();
        let payload = Request::WriteSegment { toggle, data, last }.payload();
        self.state = State::Writing { toggle, sent };
        payload
    }

    fn wrong_toggle(&mut self, payload: Payload) -> Step {
        if self.seen.is_copy(payload) {
            return Step::Duplicate;
        }
        Step::protocol(ProtocolError::Toggle, AbortCode::TOGGLE)
    }
}

/// An answer that is none to a segment, and names no other object.
fn unexpected(payload: Payload) -> Step {
    if Answer::parse(payload).object().is_some() {
        // Our object, begun anew, but not by us.
        return Step::Failed { error: SdoError::Interrupted, abort: None };
    }
    let [command, ..] = payload;
    Step::protocol(ProtocolError::Command(command), AbortCode::COMMAND)
}
