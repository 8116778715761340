//! Questions to the modules of a bus, one at a time, and whose an answer is (R-ESD-053, 055).
//!
//! Answers carry no module number, and all modules answer on one identifier. So an answer belongs to the one question that is
//! open, if it answers that; and where another answer may still be on its way, nothing is asked before it had its time:
//!
//! - Before the next question the longest time that a module takes for an answer passes in quiet: a frame that the bus
//!   doubled has a second answer.
//! - After a question that nobody answered in time, or that was answered after it had been repeated, a whole reply time-out
//!   passes in quiet, and two since it was sent last. Then the module is asked for its number first. That answer tells whose
//!   it is, and a module answers in the order in which it was asked: whatever it still owed has come by then.

use std::time::Duration;

use super::answer::Answer;
use super::identifiers::ModuleNumber;
use super::init_frame::{InitCommand, Request};
use crate::can::CanFrame;
use crate::time::Instant;

/// The longest time that a module takes to answer on a free bus (R-ESD-053).
const LONGEST_ANSWER: Duration = Duration::from_millis(10);

/// Quiet is not waited for longer than so many reply time-outs: somebody else's traffic on the reply identifier must not
/// put an end to all questions.
const PATIENCE: u32 = 10;

/// Who asks whom, and what was answered.
#[derive(Debug)]
pub(super) struct Dialogue {
    reply_id: u16,
    timeout: Duration,
    repetitions: u8,
    open: Option<Open>,
    /// When the newest question was sent last.
    sent: Instant,
    /// When the last question was closed.
    closed: Instant,
    /// When the last frame came on the reply identifier, or the last question was closed.
    busy: Instant,
    /// An answer to an earlier question may still come.
    doubt: bool,
}

/// A question that waits for its answer.
#[derive(Debug)]
struct Open {
    module: usize,
    number: ModuleNumber,
    request: Request,
    /// What is asked after it.
    then: Option<Request>,
    frame: CanFrame,
    /// How often it was sent.
    sent: u8,
    /// How often it may be sent again.
    left: u8,
    deadline: Instant,
}

/// What a frame on the reply identifier meant.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Heard {
    /// It answers nothing that is open.
    Nothing,
    /// The module is the one that is meant; this is the question itself.
    Next(CanFrame),
    /// The answer of a module.
    Answer(usize, Answer),
}

/// What became of a question in time.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Overdue {
    /// Nothing yet.
    Nothing,
    /// It is asked again.
    Again(CanFrame),
    /// This module did not answer.
    Unanswered(usize),
}

impl Dialogue {
    pub(super) fn new(reply_id: u16, timeout: Duration, repetitions: u8) -> Self {
        Self {
            reply_id,
            timeout: timeout.max(Duration::from_millis(1)),
            repetitions,
            open: None,
            sent: Instant::START,
            closed: Instant::START,
            busy: Instant::START,
            doubt: false,
        }
    }

    /// No question is open.
    pub(super) fn is_free(&self) -> bool {
        self.open.is_none()
    }

    /// When a question may be asked, if nothing comes on the reply identifier until then.
    pub(super) fn ready_at(&self) -> Instant {
        let ready = if self.doubt {
            (self.busy + self.timeout).max(self.sent + self.timeout * 2)
        } else {
            self.busy + LONGEST_ANSWER.min(self.timeout)
        };
        ready.min(self.closed + self.timeout * PATIENCE)
    }

    /// Asks; gives the frame to send. To be called when no question is open.
    pub(super) fn ask(
        &mut self,
        now: Instant,
        module: usize,
        number: ModuleNumber,
        request: Request,
    ) -> CanFrame {
        let fence = self.doubt && request != Request::ActiveNumber;
        let (first, then) = if fence { (Request::ActiveNumber, Some(request)) } else { (request, None) };
        // Who is asked for its number for its own sake is asked again and again anyway.
        let left = if request == Request::ActiveNumber { 0 } else { self.repetitions };
        self.begin(
            now,
            Open {
                module,
                number,
                request: first,
                then,
                frame: InitCommand::Request { module: number, request: first, reply_id: self.reply_id }
                    .frame(),
                sent: 1,
                left,
                deadline: now + self.timeout,
            },
        )
    }

    fn begin(&mut self, now: Instant, open: Open) -> CanFrame {
        let frame = open.frame;
        self.sent = now;
        self.closed = now;
        self.open = Some(open);
        frame
    }

    /// A data frame on the reply identifier. [`handle_timeout`](Self::handle_timeout) is to be called before for a deadline that
    /// lies before it.
    pub(super) fn handle_frame(&mut self, now: Instant, data: &[u8]) -> Heard {
        self.busy = self.busy.max(now);
        let answers = |open: &Open| match Answer::parse(open.request, data) {
            answer if open.request == Request::ActiveNumber => {
                answer.filter(|answer| *answer == Answer::Number(open.number.get()))
            }
            answer => answer,
        };
        let Some(answer) = self.open.as_ref().and_then(answers) else { return Heard::Nothing };
        let Some(open) = self.open.take() else { return Heard::Nothing };
        self.closed = now;
        if open.request == Request::ActiveNumber {
            self.doubt = false;
        } else if open.sent > 1 {
            self.doubt = true;
        }
        let Some(request) = open.then else { return Heard::Answer(open.module, answer) };
        Heard::Next(self.begin(
            now,
            Open {
                request,
                then: None,
                frame: InitCommand::Request { module: open.number, request, reply_id: self.reply_id }.frame(),
                sent: 1,
                left: self.repetitions,
                deadline: now + self.timeout,
                ..open
            },
        ))
    }

    /// What became due.
    pub(super) fn handle_timeout(&mut self, now: Instant) -> Overdue {
        let Some(open) = self.open.as_mut().filter(|open| open.deadline <= now) else {
            return Overdue::Nothing;
        };
        if open.left > 0 {
            open.left -= 1;
            open.sent = open.sent.saturating_add(1);
            open.deadline = now + self.timeout;
            self.sent = now;
            return Overdue::Again(open.frame);
        }
        let module = open.module;
        self.drop_open(now);
        Overdue::Unanswered(module)
    }

    /// A frame of ours did not leave: if it is the question, nobody owes an answer to it, and it is asked once more.
    pub(super) fn handle_not_sent(&mut self, frame: &CanFrame) {
        if let Some(open) = self.open.as_mut().filter(|open| open.frame == *frame) {
            open.left = open.left.saturating_add(1);
            open.sent = open.sent.saturating_sub(1);
        }
    }

    /// What was asked of a module does not matter any more.
    pub(super) fn drop_module(&mut self, now: Instant, module: usize) {
        if self.open.as_ref().is_some_and(|open| open.module == module) {
            self.drop_open(now);
        }
    }

    /// Nothing matters any more that was asked until now.
    pub(super) fn clear(&mut self, now: Instant) {
        self.drop_open(now);
    }

    fn drop_open(&mut self, now: Instant) {
        // An answer to the question for the number tells whose it is, whenever it comes.
        if self.open.take().is_some_and(|open| open.request != Request::ActiveNumber) {
            self.doubt = true;
        }
        self.closed = now;
        self.busy = self.busy.max(now);
    }

    /// When [`handle_timeout`](Self::handle_timeout) has something to do.
    pub(super) fn poll_timeout(&self) -> Option<Instant> {
        self.open.as_ref().map(|open| open.deadline)
    }
}
