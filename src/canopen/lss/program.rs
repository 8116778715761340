//! What a job does step by step, without time: the services of CiA 305 one by one; scans and changes in files of their own.

use std::time::Duration;

use super::change::Change;
use super::codec::{self, Payload};
use super::fastscan::Fastscan;
use super::slowscan::Slowscan;
use super::{LssAddress, LssAnswer, LssDuty, LssError, LssJob, LssSettings, Performed};

/// A job under way.
#[derive(Debug)]
pub(super) enum Program {
    Service(Service),
    Fastscan(Fastscan),
    Slowscan(Slowscan),
    Change(Box<Change>),
}

/// What came of the last step.
#[derive(Debug)]
pub(super) enum Reply {
    /// There was none yet, or there is nothing to say about it.
    Done,
    /// The answer that was expected.
    Answer(Payload),
    /// No answer.
    Silence,
    /// The caller did its duty.
    Performed(Performed),
    /// The job is to end, for this reason.
    Failed(LssError),
}

/// The next step.
#[derive(Debug)]
pub(super) enum Next {
    /// Send frames, and wait for an answer.
    Exchange(Exchange),
    /// Wait so long.
    Pause(Duration),
    /// The caller is to do this.
    Perform(LssDuty),
    /// Tell that this slave was found, and go on.
    Found(LssAddress),
    /// The job is over.
    Finish(Result<LssAnswer, LssError>),
}

/// Frames, and what is expected after them.
#[derive(Clone, Debug)]
pub(super) struct Exchange {
    /// How people call it.
    pub(super) service: &'static str,
    pub(super) frames: Vec<Payload>,
    pub(super) expect: Expect,
}

/// What is expected after the frames of an exchange.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Expect {
    /// No answer.
    Nothing,
    /// An answer with this command specifier, within the time-out.
    Answer(u8),
    /// The answer to `store`.
    Stored,
    /// Answers with this command specifier, of as many slaves as there are: all are waited for, so that none of them
    /// passes for an answer to the next question.
    Collect(u8),
}

impl Exchange {
    pub(super) fn new(service: &'static str, frames: &[Payload], expect: Expect) -> Self {
        Self { service, frames: frames.to_vec(), expect }
    }
}

impl Program {
    /// The program of a job that was checked.
    pub(super) fn new(job: LssJob, settings: &LssSettings) -> Self {
        match job {
            LssJob::Fastscan(known) => Self::Fastscan(Fastscan::new(known)),
            LssJob::Slowscan(ranges) => Self::Slowscan(Slowscan::new(ranges)),
            LssJob::Change(change) => Self::Change(Box::new(Change::new(&change, settings))),
            LssJob::SwitchGlobal { .. }
            | LssJob::SwitchSelective(_)
            | LssJob::ConfigureNodeId(_)
            | LssJob::ConfigureBitRate(_)
            | LssJob::ActivateBitRate { .. }
            | LssJob::Store
            | LssJob::InquireAddress
            | LssJob::InquireNodeId
            | LssJob::Identify(_)
            | LssJob::IdentifyNonConfigured => {
                Self::Service(Service { job, numbers: Vec::new(), asked: false })
            }
        }
    }

    /// The step after this reply.
    pub(super) fn next(&mut self, reply: Reply, settings: &LssSettings) -> Next {
        match self {
            Self::Change(change) => change.next(reply, settings),
            Self::Service(service) => service.next(reply, settings),
            Self::Fastscan(scan) => scan.next(reply),
            Self::Slowscan(scan) => scan.next(reply),
        }
    }
}

/// One service.
#[derive(Debug)]
pub(super) struct Service {
    job: LssJob,
    /// The parts of an address so far.
    numbers: Vec<u32>,
    asked: bool,
}

impl Service {
    fn next(&mut self, reply: Reply, settings: &LssSettings) -> Next {
        let exchange = self.exchange();
        let first = !std::mem::replace(&mut self.asked, true);
        match reply {
            Reply::Failed(error) => Next::Finish(Err(error)),
            Reply::Done if first => Next::Exchange(exchange),
            Reply::Done | Reply::Performed(_) => Next::Finish(Ok(LssAnswer::Done)),
            Reply::Silence if self.is_question() => Next::Finish(Ok(LssAnswer::Answered(false))),
            Reply::Silence => Next::Finish(Err(no_answer(&exchange, settings))),
            Reply::Answer(answer) => self.handle_answer(&exchange, answer),
        }
    }

    fn handle_answer(&mut self, exchange: &Exchange, answer: Payload) -> Next {
        if self.is_question() {
            return Next::Finish(Ok(LssAnswer::Answered(true)));
        }
        Next::Finish(match self.job {
            LssJob::InquireNodeId => codec::node_id(answer)
                .map(LssAnswer::NodeId)
                .map_err(|_| LssError::Nonsense("the LSS slave told a node id that is none")),
            LssJob::InquireAddress => {
                self.numbers.push(codec::number(answer));
                let [vendor, product, revision, serial] = *self.numbers.as_slice() else {
                    return Next::Exchange(self.exchange());
                };
                Ok(LssAnswer::Address(LssAddress { vendor, product, revision, serial }))
            }
            LssJob::ConfigureNodeId(_) | LssJob::ConfigureBitRate(_) | LssJob::Store => {
                accepted(exchange.service, answer).map(|()| LssAnswer::Done)
            }
            LssJob::SwitchGlobal { .. }
            | LssJob::SwitchSelective(_)
            | LssJob::ActivateBitRate { .. }
            | LssJob::Identify(_)
            | LssJob::IdentifyNonConfigured
            | LssJob::Fastscan(_)
            | LssJob::Slowscan(_)
            | LssJob::Change(_) => Ok(LssAnswer::Done),
        })
    }

    /// Whether silence is an answer.
    fn is_question(&self) -> bool {
        matches!(self.job, LssJob::Identify(_) | LssJob::IdentifyNonConfigured)
    }

    fn exchange(&self) -> Exchange {
        match &self.job {
            LssJob::SwitchGlobal { state, .. } => {
                Exchange::new("switch global", &[codec::switch_global(*state)], Expect::Nothing)
            }
            LssJob::SwitchSelective(address) => switch_selective(address),
            LssJob::ConfigureNodeId(node) => Exchange::new(
                "configure node id",
                &[codec::configure_node_id(*node)],
                Expect::Answer(codec::NODE_ID),
            ),
            LssJob::ConfigureBitRate(bit_rate) => Exchange::new(
                "configure bit rate",
                &[codec::configure_bit_rate(*bit_rate)],
                Expect::Answer(codec::BIT_RATE),
            ),
            LssJob::ActivateBitRate { delay } => activate(*delay),
            LssJob::InquireAddress => {
                let command = codec::INQUIRE_VENDOR + u8::try_from(self.numbers.len()).unwrap_or_default();
                Exchange::new("inquire address", &[codec::plain(command)], Expect::Answer(command))
            }
            LssJob::InquireNodeId => {
                let command = codec::INQUIRE_NODE_ID;
                Exchange::new("inquire node id", &[codec::plain(command)], Expect::Answer(command))
            }
            LssJob::Identify(range) => Exchange::new(
                "identify remote slave",
                &codec::identify(range),
                Expect::Answer(codec::IDENTIFIED),
            ),
            LssJob::IdentifyNonConfigured => Exchange::new(
                "identify non-configured",
                &[codec::identify_non_configured()],
                Expect::Answer(codec::NON_CONFIGURED),
            ),
            LssJob::Store | LssJob::Fastscan(_) | LssJob::Slowscan(_) | LssJob::Change(_) => store(),
        }
    }
}

/// One slave into configuration state.
pub(super) fn switch_selective(address: &LssAddress) -> Exchange {
    Exchange::new("switch selective", &codec::switch_selective(address), Expect::Answer(codec::SELECTED))
}

/// Store what was configured.
pub(super) fn store() -> Exchange {
    Exchange::new("store", &[codec::plain(codec::STORE)], Expect::Stored)
}

/// Change to the stored bit rate.
pub(super) fn activate(delay: Duration) -> Exchange {
    let delay = u16::try_from(delay.as_millis()).unwrap_or(u16::MAX);
    Exchange::new("activate bit rate", &[codec::activate_bit_rate(delay)], Expect::Nothing)
}

/// Nobody answered.
pub(super) fn no_answer(exchange: &Exchange, settings: &LssSettings) -> LssError {
    LssError::NoAnswer { service: exchange.service, after: exchange.expect.timeout(settings) }
}

/// Whether an answer with error code and specific error says that all is well.
pub(super) fn accepted(service: &'static str, answer: Payload) -> Result<(), LssError> {
    let [_, code, specific, ..] = answer;
    if code == 0 { Ok(()) } else { Err(LssError::Refused { service, code, specific }) }
}

impl Expect {
    /// How long to wait.
    pub(super) fn timeout(self, settings: &LssSettings) -> Duration {
        match self {
            Self::Nothing => settings.gap,
            Self::Answer(_) => settings.timeout,
            Self::Stored => settings.store_timeout,
            Self::Collect(_) => settings.scan_timeout,
        }
    }

    /// Whether an answer with this command specifier is it.
    pub(super) fn takes(self, command: u8, settings: &LssSettings) -> bool {
        match self {
            Self::Nothing => false,
            Self::Answer(expected) | Self::Collect(expected) => command == expected,
            Self::Stored => command == codec::STORE || settings.accept_zero_cs && command == 0,
        }
    }
}
