//! The LSS master of one bus: one job at a time, its frames, time limits and what the caller has to do for it.

use std::collections::VecDeque;
use std::time::Duration;

use super::codec::{ANSWER_ID, Payload, REQUEST_ID};
use super::program::{Exchange, Expect, Next, Program, Reply};
use super::{
    LssActivation, LssAnswer, LssDuty, LssError, LssJob, LssOutput, LssRange, LssSettings, LssState,
    LssTarget, Performed,
};
use crate::can::CanFrame;
use crate::time::Instant;

/// More outputs than a caller who fetches them ever leaves; what comes after that is dropped.
const UNFETCHED: usize = 1024;

/// The LSS master of one bus.
#[derive(Debug)]
pub struct LssMaster {
    settings: LssSettings,
    job: Option<Running>,
    configuring: Configuring,
    paused: bool,
    outputs: VecDeque<LssOutput>,
    unasked: u64,
}

/// The job under way.
#[derive(Debug)]
struct Running {
    program: Program,
    /// What the slaves do if it succeeds.
    outcome: Configuring,
    phase: Phase,
    sent: Option<CanFrame>,
}

#[derive(Debug)]
enum Phase {
    /// The next frame then.
    Sending { at: Instant, frames: VecDeque<Payload>, expect: Expect },
    /// For an answer, until then. `answer`: one of several that may come.
    Waiting { until: Instant, expect: Expect, answer: Option<Payload> },
    /// Until then.
    Pausing(Instant),
    /// For the caller. `interface`: to change our own bit rate, which takes the bus away for a moment.
    Performing { interface: bool },
}

/// Who is in configuration state, as far as we brought somebody there.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Configuring {
    Nobody,
    /// One slave that was selected, or that an operator says is the only one.
    One,
    /// All, however many they are.
    All,
}

impl LssMaster {
    /// A master that has nothing to do, on a bus that can be used.
    #[must_use]
    pub fn new(settings: LssSettings) -> Self {
        let outputs = VecDeque::new();
        Self { settings, job: None, configuring: Configuring::Nobody, paused: false, outputs, unasked: 0 }
    }

    /// Whether no job is under way.
    #[must_use]
    pub fn is_idle(&self) -> bool {
        self.job.is_none()
    }

    /// Answers that nobody waited for: late ones, or another master's.
    #[must_use]
    pub fn unasked(&self) -> u64 {
        self.unasked
    }

    /// Begins a job. If it is taken, [`LssOutput::Done`] will follow.
    ///
    /// Nothing is configured while all slaves would obey and nobody has confirmed that there is only one (R-DST-111).
    pub fn request(&mut self, now: Instant, job: LssJob) -> Result<(), LssError> {
        if self.paused {
            return Err(LssError::BusUnavailable);
        }
        if self.job.is_some() {
            return Err(LssError::Busy);
        }
        check(&job)?;
        self.check_target(&job)?;
        let outcome = self.outcome(&job);
        let program = Program::new(job, &self.settings);
        self.job = Some(Running { program, outcome, phase: Phase::Pausing(now), sent: None });
        self.advance(now, Reply::Done);
        Ok(())
    }

    /// Takes a frame with the identifier of the slaves' answers; others are ignored.
    pub fn handle_frame(&mut self, now: Instant, frame: &CanFrame) {
        let Ok(payload) = Payload::try_from(frame.data()) else { return };
        if frame.id() != ANSWER_ID {
            return;
        }
        let [command, ..] = payload;
        let phase = self.job.as_mut().map(|job| &mut job.phase);
        let Some(Phase::Waiting { expect, answer, .. }) =
            phase.filter(|phase| phase.takes(command, &self.settings))
        else {
            self.unasked = self.unasked.saturating_add(1);
            return;
        };
        if matches!(expect, Expect::Collect(_)) {
            *answer = Some(payload);
        } else {
            self.advance(now, Reply::Answer(payload));
        }
    }

    /// The caller did its duty, or could not. Ignored when none is pending.
    pub fn handle_performed(&mut self, now: Instant, performed: Performed) {
        if matches!(self.job, Some(Running { phase: Phase::Performing { .. }, .. })) {
            self.advance(now, Reply::Performed(performed));
        }
    }

    /// What became due.
    pub fn handle_timeout(&mut self, now: Instant) {
        let Some(job) = &mut self.job else { return };
        match &mut job.phase {
            Phase::Sending { at, .. } if *at <= now => self.send_next(now),
            Phase::Waiting { until, answer, .. } if *until <= now => {
                let reply = answer.take().map_or(Reply::Silence, Reply::Answer);
                self.advance(now, reply);
            }
            Phase::Pausing(until) if *until <= now => self.advance(now, Reply::Done),
            Phase::Sending { .. } | Phase::Waiting { .. } | Phase::Pausing(_) | Phase::Performing { .. } => {}
        }
    }

    /// A frame of ours did not leave: the job fails.
    pub fn handle_not_sent(&mut self, now: Instant, frame: &CanFrame) {
        let ours = self.job.as_ref().is_some_and(|job| job.sent.as_ref() == Some(frame));
        if ours {
            self.advance(now, Reply::Failed(LssError::BusUnavailable));
        }
    }

    /// The caller gives up. A change goes back as far as it can before it ends.
    pub fn cancel(&mut self, now: Instant) {
        if self.job.is_some() {
            self.advance(now, Reply::Failed(LssError::Cancelled));
        }
    }

    /// The bus cannot be used: the job fails at once, and nothing is taken until [`resume`](Self::resume). A job that has just
    /// asked for another bit rate of our interface goes on.
    pub fn pause(&mut self) {
        self.paused = true;
        if !matches!(self.job, None | Some(Running { phase: Phase::Performing { interface: true }, .. })) {
            self.finish(Err(LssError::BusUnavailable));
        }
    }

    /// The bus can be used again.
    pub fn resume(&mut self) {
        self.paused = false;
    }

    /// What is to be done; call until `None` after each of the calls above.
    pub fn poll_output(&mut self) -> Option<LssOutput> {
        self.outputs.pop_front()
    }

    /// When [`handle_timeout`](Self::handle_timeout) is to be called, and why.
    #[must_use]
    pub fn poll_timeout(&self) -> Option<(Instant, &'static str)> {
        match &self.job.as_ref()?.phase {
            Phase::Sending { at, .. } => Some((*at, "LSS frame")),
            Phase::Waiting { until, .. } => Some((*until, "LSS answer")),
            Phase::Pausing(until) => Some((*until, "LSS pause")),
            Phase::Performing { .. } => None,
        }
    }

    /// Whether whoever would obey is the one that is meant.
    fn check_target(&self, job: &LssJob) -> Result<(), LssError> {
        match job {
            LssJob::ConfigureNodeId(_)
            | LssJob::ConfigureBitRate(_)
            | LssJob::ActivateBitRate { .. }
            | LssJob::Store => match self.configuring {
                Configuring::One => Ok(()),
                Configuring::All => Err(LssError::NotConfirmed),
                Configuring::Nobody => {
                    Err(LssError::Nonsense("no LSS slave was switched to configuration state before"))
                }
            },
            LssJob::SwitchGlobal { .. }
            | LssJob::SwitchSelective(_)
            | LssJob::InquireAddress
            | LssJob::InquireNodeId
            | LssJob::Identify(_)
            | LssJob::IdentifyNonConfigured
            | LssJob::Fastscan(_)
            | LssJob::Slowscan(_)
            | LssJob::Change(_) => Ok(()),
        }
    }

    /// Who is in configuration state after a job that succeeds.
    fn outcome(&self, job: &LssJob) -> Configuring {
        match job {
            LssJob::SwitchGlobal { state: LssState::Waiting, .. } | LssJob::Change(_) => Configuring::Nobody,
            LssJob::SwitchGlobal { only_slave: true, .. } => Configuring::One,
            LssJob::SwitchGlobal { only_slave: false, .. } => Configuring::All,
            // Whoever was there before stays.
            LssJob::SwitchSelective(_) | LssJob::Fastscan(_) => match self.configuring {
                Configuring::Nobody => Configuring::One,
                Configuring::One | Configuring::All => Configuring::All,
            },
            LssJob::ConfigureNodeId(_)
            | LssJob::ConfigureBitRate(_)
            | LssJob::ActivateBitRate { .. }
            | LssJob::Store
            | LssJob::InquireAddress
            | LssJob::InquireNodeId
            | LssJob::Identify(_)
            | LssJob::IdentifyNonConfigured
            | LssJob::Slowscan(_) => self.configuring,
        }
    }

    /// Goes on until something is to be waited for.
    fn advance(&mut self, now: Instant, mut reply: Reply) {
        while let Some(job) = &mut self.job {
            match job.program.next(reply, &self.settings) {
                Next::Found(address) => {
                    self.push(LssOutput::Found(address));
                    reply = Reply::Done;
                    continue;
                }
                Next::Exchange(Exchange { frames, expect, .. }) => {
                    job.phase = Phase::Sending { at: now, frames: frames.into(), expect };
                    self.send_next(now);
                }
                Next::Pause(time) => job.phase = Phase::Pausing(now + time),
                Next::Perform(duty) => {
                    let interface = matches!(duty, LssDuty::ChangeInterface(_));
                    job.phase = Phase::Performing { interface };
                    self.push(LssOutput::Perform(duty));
                }
                Next::Finish(result) => self.finish(result),
            }
            return;
        }
    }

    /// Sends the next frame of an exchange; after the last, waits.
    fn send_next(&mut self, now: Instant) {
        let settings = self.settings;
        let Some(Running { phase, sent, .. }) = &mut self.job else { return };
        let Phase::Sending { at, frames, expect } = phase else { return };
        let frame = frames.pop_front().and_then(|payload| CanFrame::data_frame(REQUEST_ID, &payload));
        *sent = frame;
        *at = now + settings.gap;
        if frames.is_empty() {
            let (until, expect) = (now + expect.timeout(&settings), *expect);
            let waiting = Phase::Waiting { until, expect, answer: None };
            *phase = if expect == Expect::Nothing { Phase::Pausing(until) } else { waiting };
        }
        if let Some(frame) = frame {
            self.push(LssOutput::Transmit(frame));
        }
    }

    fn finish(&mut self, result: Result<LssAnswer, LssError>) {
        if let Some(job) = self.job.take() {
            match &result {
                Ok(LssAnswer::Found(found)) if found.is_empty() => {}
                Ok(_) => self.configuring = job.outcome,
                // It is not known how far the slaves came.
                Err(_) if self.configuring != job.outcome => self.configuring = Configuring::All,
                Err(_) => {}
            }
            self.push(LssOutput::Done(result));
        }
    }

    fn push(&mut self, output: LssOutput) {
        if self.outputs.len() < UNFETCHED {
            self.outputs.push_back(output);
        }
    }
}

impl Phase {
    fn takes(&self, command: u8, settings: &LssSettings) -> bool {
        matches!(self, Self::Waiting { expect, .. } if expect.takes(command, settings))
    }
}

/// Whether a job can be done at all.
fn check(job: &LssJob) -> Result<(), LssError> {
    const LONGEST: Duration = Duration::from_millis(65_535);
    let ordered = |range: &LssRange| range.revision.0 <= range.revision.1 && range.serial.0 <= range.serial.1;
    let backwards = Err(LssError::Nonsense("the least number of a range is greater than the greatest"));
    let too_long = Err(LssError::Nonsense("the delay before a bit rate is activated is 65535 ms at most"));
    match job {
        LssJob::Identify(range) if !ordered(range) => backwards,
        LssJob::Slowscan(ranges) if !ranges.iter().all(ordered) => backwards,
        LssJob::ActivateBitRate { delay } if *delay > LONGEST => too_long,
        LssJob::Change(change) => {
            if change.target == (LssTarget::OnlySlave { confirmed: false }) {
                return Err(LssError::NotConfirmed);
            }
            if change.node_id.is_none() && change.bit_rate.is_none() {
                return Err(LssError::Nonsense("neither a node id nor a bit rate is to be changed"));
            }
            match change.activation {
                LssActivation::Now { delay } if delay > LONGEST => too_long,
                LssActivation::Now { .. } | LssActivation::PowerCycle => Ok(()),
            }
        }
        LssJob::SwitchGlobal { .. }
        | LssJob::SwitchSelective(_)
        | LssJob::ConfigureNodeId(_)
        | LssJob::ConfigureBitRate(_)
        | LssJob::ActivateBitRate { .. }
        | LssJob::Store
        | LssJob::InquireAddress
        | LssJob::InquireNodeId
        | LssJob::Identify(_)
        | LssJob::IdentifyNonConfigured
        | LssJob::Fastscan(_)
        | LssJob::Slowscan(_) => Ok(()),
    }
}
