//! What `cangate esd` does on a bus, and the dialogues that it needs. Pure.

use std::collections::{BTreeMap, VecDeque};
use std::time::Duration;

use super::session::{Machine, Step};
use crate::can::{CanFrame, CanId};
use crate::esd::{
    Answer, InitCommand, ModuleNumber, Order, Request, Scan, ScanOutput, ScanSettings, Setting,
};
use crate::time::{Instant, Now};

/// How long to listen whether somebody else uses the reply identifier.
const LISTEN: Duration = Duration::from_millis(200);
/// So often a request is sent (R-ESD-053).
const ATTEMPTS: u32 = 3;

/// Where modules answer, and how long they may take.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Reply {
    /// The identifier.
    pub id: u16,
    /// The time.
    pub timeout: Duration,
}

/// What is to be done.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Job {
    /// Find modules.
    Scan {
        /// Where they answer.
        reply: Reply,
        /// Those without news too.
        ask_each: bool,
    },
    /// Ask one for all that it tells.
    Show {
        /// Which one.
        module: ModuleNumber,
        /// Where it answers.
        reply: Reply,
    },
    /// Give an order.
    Order {
        /// To whom; `None`: to all.
        module: Option<ModuleNumber>,
        /// Which.
        order: Order,
        /// Where it is asked what came of it; `None`: it is not asked.
        reply: Option<Reply>,
    },
    /// Set something.
    Set {
        /// In which one.
        module: ModuleNumber,
        /// What.
        setting: Setting,
        /// Where it is asked what came of it.
        reply: Reply,
    },
}

impl Job {
    /// The identifier on which an answer is expected.
    pub(super) fn reply(self) -> Option<Reply> {
        match self {
            Self::Scan { reply, .. } | Self::Show { reply, .. } | Self::Set { reply, .. } => Some(reply),
            Self::Order { reply, .. } => reply,
        }
    }
}

/// Listens whether somebody else uses an identifier for answers: sends on it, or has modules answer on it. Ends with the
/// first such frame, or with `None`.
#[derive(Debug)]
pub(super) struct Listen {
    id: u16,
    until: Instant,
    output: Option<Step<Option<CanFrame>>>,
}

impl Listen {
    pub(super) fn new(now: Instant, id: u16) -> Self {
        Self { id, until: now + LISTEN, output: None }
    }

    fn is_foreign(&self, frame: &CanFrame) -> bool {
        let asked = match InitCommand::parse(frame) {
            Some(InitCommand::Request { reply_id, .. } | InitCommand::Service { reply_id, .. }) => {
                reply_id == self.id
            }
            Some(InitCommand::Set { .. } | InitCommand::Supervisor { .. }) | None => false,
        };
        asked || Some(frame.id()) == CanId::standard(self.id)
    }
}

impl Machine for Listen {
    type Output = Option<CanFrame>;

    fn handle_frame(&mut self, _: Now, frame: &CanFrame) {
        if self.is_foreign(frame) {
            self.output = Some(Step::Done(Some(*frame)));
        }
    }

    fn handle_not_sent(&mut self, _: Now, _: &CanFrame) {}

    fn handle_timeout(&mut self, now: Now) {
        if now.instant >= self.until {
            self.output.get_or_insert(Step::Done(None));
        }
    }

    fn poll_output(&mut self) -> Option<Step<Self::Output>> {
        self.output.take()
    }

    fn poll_timeout(&self) -> Option<Instant> {
        Some(self.until)
    }
}

/// What a module answered; `None` where it did not.
pub(super) type Answers = BTreeMap<Request, Option<Answer>>;

/// Asks a module one thing after another, and adds what it says to what is known of it. Ends early when nothing is known and
/// the first is not answered, for then it is not there; with the frame that did not leave where one did not.
#[derive(Debug)]
pub(super) struct Dialogue {
    module: ModuleNumber,
    reply: Reply,
    waiting: VecDeque<Request>,
    open: Option<Open>,
    answers: Answers,
    output: Option<Step<Result<Answers, CanFrame>>>,
}

#[derive(Debug)]
struct Open {
    request: Request,
    frame: CanFrame,
    deadline: Instant,
    left: u32,
}

impl Dialogue {
    pub(super) fn new(
        now: Instant,
        module: ModuleNumber,
        reply: Reply,
        answers: Answers,
        requests: impl IntoIterator<Item = Request>,
    ) -> Self {
        let waiting = requests.into_iter().collect();
        let mut dialogue = Self { module, reply, waiting, open: None, answers, output: None };
        dialogue.next(now);
        dialogue
    }

    fn next(&mut self, now: Instant) {
        match self.waiting.pop_front() {
            Some(request) => self.ask(now, request, ATTEMPTS),
            None => self.end(),
        }
    }

    fn ask(&mut self, now: Instant, request: Request, left: u32) {
        let (module, reply_id) = (self.module, self.reply.id);
        let frame = InitCommand::Request { module, request, reply_id }.frame();
        let deadline = now + self.reply.timeout;
        self.open = Some(Open { request, frame, deadline, left: left - 1 });
        self.output = Some(Step::Transmit(frame));
    }

    fn end(&mut self) {
        self.output = Some(Step::Done(Ok(std::mem::take(&mut self.answers))));
    }
}

impl Machine for Dialogue {
    type Output = Result<Answers, CanFrame>;

    fn handle_frame(&mut self, now: Now, frame: &CanFrame) {
        if frame.is_remote() || CanId::standard(self.reply.id) != Some(frame.id()) {
            return;
        }
        let Some(request) = self.open.as_ref().map(|open| open.request) else { return };
        if let Some(answer) = Answer::parse(request, frame.data()) {
            self.open = None;
            self.answers.insert(request, Some(answer));
            self.next(now.instant);
        }
    }

    fn handle_not_sent(&mut self, _: Now, frame: &CanFrame) {
        if self.open.take_if(|open| open.frame == *frame).is_some() {
            self.output = Some(Step::Done(Err(*frame)));
        }
    }

    fn handle_timeout(&mut self, now: Now) {
        let Some(open) = self.open.take_if(|open| open.deadline <= now.instant) else { return };
        if open.left > 0 {
            return self.ask(now.instant, open.request, open.left);
        }
        let is_first = self.answers.is_empty();
        self.answers.insert(open.request, None);
        if is_first {
            return self.end();
        }
        self.next(now.instant);
    }

    fn poll_output(&mut self) -> Option<Step<Self::Output>> {
        self.output.take()
    }

    fn poll_timeout(&self) -> Option<Instant> {
        self.open.as_ref().map(|open| open.deadline)
    }
}

/// What a scan ends with: the modules, each with whether it had news, and whether all could be asked.
pub(super) type Found = (Vec<(ModuleNumber, bool)>, bool);

/// A scan of all numbers.
#[derive(Debug)]
pub(super) struct Search(Scan);

impl Search {
    pub(super) fn new(now: Now, reply: Reply, ask_each: bool) -> Option<Self> {
        let (low, high) = (ModuleNumber::new(1)?, ModuleNumber::new(254)?);
        let settings = ScanSettings { reply_id: reply.id, low, high, timeout: reply.timeout, ask_each };
        Some(Self(Scan::new(settings, now)))
    }
}

impl Machine for Search {
    type Output = Found;

    fn handle_frame(&mut self, now: Now, frame: &CanFrame) {
        self.0.handle_frame(now, frame);
    }

    fn handle_not_sent(&mut self, now: Now, frame: &CanFrame) {
        self.0.handle_not_sent(now, frame);
    }

    fn handle_timeout(&mut self, now: Now) {
        self.0.handle_timeout(now);
    }

    fn poll_output(&mut self) -> Option<Step<Self::Output>> {
        loop {
            return Some(match self.0.poll_output()? {
                ScanOutput::Transmit(frame) => Step::Transmit(frame),
                ScanOutput::Found { .. } => continue,
                ScanOutput::Done { complete } => Step::Done((self.0.found().collect(), complete)),
            });
        }
    }

    fn poll_timeout(&self) -> Option<Instant> {
        self.0.poll_timeout().map(|(at, _)| at)
    }
}
