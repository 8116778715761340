//! Booting one node: from its first sign of life to the moment in which it may be started (CiA 302-2).
//!
//! What is done is data: a list of [`BootStep`]s, empty for a device that knows no SDO, as a DetCon. Each is a read, or a
//! write that *compares first*: what the device already has is not written again, so that a restart of the gateway writes
//! nothing and wears no memory (R-DST-090). [`BootStep::Save`] stores only if something was written.
//!
//! A node that does not answer is asked again and again, ever more seldom, and at once when it gives a sign of life
//! (R-DST-052, R-DST-053). Nothing here resets a node. To change the mapping of a PDO the node has to be pre-operational
//! (R-DST-023): one that is not known to be is put there first, and only if there is something to change.
//!
//! - this file: the way through the steps, repetition, what is told.
//! - `task`: one step each, from answer to answer. `pdo`: the step that reads or changes a PDO.
//! - `settings`, `event`: plain data.

mod event;
mod pdo;
mod settings;
mod task;

use std::collections::VecDeque;
use std::time::Duration;

pub use event::{BootEvent, BootFailure, MappedPdo};
pub use settings::{BootSettings, BootStep, MappingMode, PdoSetup};

use self::task::{Advance, Task};
use super::object::MappedObject;
use super::sdo::{SdoAction, SdoError, SdoRequest, TransferId};
use super::{PdoIndex, RpdoIndex};
use crate::time::Instant;

/// After a boot-up message the node is left in peace for a moment: some take requests before they can answer them.
const SETTLE: Duration = Duration::from_millis(20);
/// Ids of boot transfers have this bit; those of everybody else do not.
const BOOT_ID: u64 = 1 << 63;

/// The boot machine of one node.
#[derive(Debug)]
pub(super) struct Boot {
    settings: BootSettings,
    phase: Phase,
    /// Counts begun boots, so that answers to an older one are recognised.
    run: u64,
    /// The step under way.
    step: usize,
    task: Option<Task>,
    /// Objects written in this boot.
    written: u32,
    /// Failures in a row.
    failures: u32,
    /// The failure that was told last, until the boot succeeds.
    told: Option<BootFailure>,
    /// The node is not known to be pre-operational.
    may_run: bool,
    /// A write that waits for the node to be pre-operational.
    held: Option<SdoRequest>,
    outputs: VecDeque<BootOutput>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Phase {
    /// The bus cannot be used.
    Paused,
    /// It begins then.
    Waiting(Instant),
    /// An answer is awaited.
    Running,
    /// The node has been put into pre-operational; the step goes on then.
    Settling(Instant),
    /// All steps are done.
    Done,
}

/// What the machine wants done, or tells.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum BootOutput {
    /// Ask the SDO client of the node.
    Sdo(TransferId, SdoRequest),
    /// Put the node into pre-operational.
    EnterPreOperational,
    /// Tell.
    Tell(BootEvent),
}

impl Boot {
    /// Nothing is done before [`resume`](Self::resume).
    pub(super) fn new(settings: BootSettings) -> Self {
        let phase = if settings.steps.is_empty() { Phase::Done } else { Phase::Paused };
        Self {
            settings,
            phase,
            run: 0,
            step: 0,
            task: None,
            written: 0,
            failures: 0,
            told: None,
            may_run: true,
            held: None,
            outputs: VecDeque::new(),
        }
    }

    /// Whether a transfer was asked for by a boot.
    pub(super) fn is_mine(id: TransferId) -> bool {
        id.0 & BOOT_ID != 0
    }

    /// Whether the node may be started.
    pub(super) fn is_done(&self) -> bool {
        self.phase == Phase::Done
    }

    /// Whether it is asking or changing the node just now: nobody else should come between.
    pub(super) fn is_under_way(&self) -> bool {
        matches!(self.phase, Phase::Running | Phase::Settling(_))
    }

    /// The node booted: everything anew.
    pub(super) fn handle_boot_up(&mut self, now: Instant) {
        self.failures = 0;
        self.restart(now + SETTLE);
    }

    /// A node that was lost is back, without a boot-up message.
    pub(super) fn handle_recovered(&mut self, now: Instant) {
        self.failures = 0;
        self.restart(now + SETTLE);
    }

    /// What an RPDO is to carry, where the node is asked.
    pub(super) fn wants_rpdo(&self, rpdo: RpdoIndex) -> Option<&[MappedObject]> {
        self.settings.setup_of_rpdo(rpdo).map(|setup| setup.maps.as_slice())
    }

    /// Whether a TPDO is taken as the node has it; then whether its time-out follows from the node's event timer.
    pub(super) fn adopts(&self, pdo: PdoIndex) -> Option<bool> {
        self.settings.adopts(pdo)
    }

    /// Whether the node is asked what a TPDO carries.
    pub(super) fn asks_about(&self, pdo: PdoIndex) -> bool {
        self.settings.asks_about(pdo)
    }

    /// Whether there is nothing to do at all.
    pub(super) fn is_empty(&self) -> bool {
        self.settings.steps.is_empty()
    }

    /// Any other frame of the node. One that did not answer before may do so now.
    pub(super) fn handle_alive(&mut self, now: Instant) {
        if let Phase::Waiting(at) = self.phase
            && self.told == Some(BootFailure::NoAnswer)
            && at > now + SETTLE
        {
            self.phase = Phase::Waiting(now + SETTLE);
            self.told = None;
        }
    }

    /// The node reports a state, or is believed to be in it. `may_run`: another one than pre-operational.
    pub(super) fn handle_state(&mut self, may_run: bool) {
        self.may_run = may_run;
    }

    /// Whether the node starts by itself.
    pub(super) fn is_self_starting(&self) -> bool {
        self.settings.self_starting
    }

    /// The bus cannot be used.
    pub(super) fn pause(&mut self) {
        if !self.is_empty() {
            self.phase = Phase::Paused;
            self.task = None;
            self.may_run = true;
            self.held = None;
        }
    }

    /// The bus can be used: the node is asked, without waiting for a boot-up message (R-DST-053).
    pub(super) fn resume(&mut self, now: Instant) {
        if self.phase == Phase::Paused {
            self.restart(now);
        }
    }

    /// A transfer is over.
    pub(super) fn handle_sdo(&mut self, now: Instant, id: TransferId, result: Result<Vec<u8>, SdoError>) {
        if id == self.transfer() && self.phase == Phase::Running {
            self.advance(now, Some(result));
        }
    }

    /// A transfer could not even be asked for: as if nobody had answered.
    pub(super) fn handle_refused(&mut self, now: Instant) {
        if self.phase == Phase::Running {
            self.fail(now, BootFailure::NoAnswer);
        }
    }

    /// Nothing can be asked now, and that is nobody's fault.
    pub(super) fn postpone(&mut self, now: Instant) {
        if self.is_under_way() {
            self.task = None;
            self.held = None;
            self.phase = Phase::Waiting(now + self.settings.retry);
        }
    }

    /// What became due.
    pub(super) fn handle_timeout(&mut self, now: Instant) {
        match self.phase {
            Phase::Waiting(at) if at <= now => {
                self.run = self.run.wrapping_add(1);
                self.step = 0;
                self.written = 0;
                self.phase = Phase::Running;
                self.next_step(now);
            }
            Phase::Settling(at) if at <= now => {
                self.may_run = false;
                self.phase = Phase::Running;
                match self.held.take() {
                    Some(request) => self.outputs.push_back(BootOutput::Sdo(self.transfer(), request)),
                    None => self.advance(now, None),
                }
            }
            Phase::Paused | Phase::Waiting(_) | Phase::Running | Phase::Settling(_) | Phase::Done => {}
        }
    }

    /// When [`handle_timeout`](Self::handle_timeout) has something to do, and why.
    pub(super) fn poll_timeout(&self) -> Option<(Instant, &'static str)> {
        match self.phase {
            Phase::Waiting(at) => Some((at, "boot of a node")),
            Phase::Settling(at) => Some((at, "pre-operational before a change")),
            Phase::Paused | Phase::Running | Phase::Done => None,
        }
    }

    /// What is to be done; call until `None`.
    pub(super) fn poll_output(&mut self) -> Option<BootOutput> {
        self.outputs.pop_front()
    }

    fn transfer(&self) -> TransferId {
        TransferId(BOOT_ID | self.run)
    }

    fn restart(&mut self, at: Instant) {
        if !self.is_empty() {
            self.phase = Phase::Waiting(at);
            self.task = None;
            self.held = None;
            self.outputs.push_back(BootOutput::Tell(BootEvent::Begun));
        }
    }

    fn next_step(&mut self, now: Instant) {
        let Some(step) = self.settings.steps.get(self.step) else {
            self.phase = Phase::Done;
            self.failures = 0;
            self.told = None;
            self.outputs.push_back(BootOutput::Tell(BootEvent::Done { written: self.written }));
            return;
        };
        self.task = Some(Task::new(step, self.written));
        self.advance(now, None);
    }

    /// Takes the task as far as it goes without another answer.
    fn advance(&mut self, now: Instant, answer: Option<Result<Vec<u8>, SdoError>>) {
        let mut answer = answer;
        loop {
            let Some(task) = &mut self.task else { return };
            match task.advance(answer.take(), self.may_run) {
                Advance::Ask(request) => {
                    let writes = matches!(request.action, SdoAction::Write(_));
                    let request = request.for_boot();
                    if writes && self.may_run && self.settings.self_starting {
                        self.held = Some(request);
                        return self.enter_pre_operational(now);
                    }
                    self.outputs.push_back(BootOutput::Sdo(self.transfer(), request));
                    return;
                }
                Advance::Tell(event) => self.outputs.push_back(BootOutput::Tell(event)),
                Advance::Wrote(object) => {
                    self.written = self.written.saturating_add(1);
                    self.outputs.push_back(BootOutput::Tell(BootEvent::Wrote { object }));
                }
                Advance::EnterPreOperational => return self.enter_pre_operational(now),
                Advance::Done => {
                    self.task = None;
                    self.step += 1;
                    return self.next_step(now);
                }
                Advance::Failed(failure) => return self.fail(now, failure),
            }
        }
    }

    fn enter_pre_operational(&mut self, now: Instant) {
        self.outputs.push_back(BootOutput::EnterPreOperational);
        self.phase = Phase::Settling(now + SETTLE);
    }

    /// Told once for each cause; tried again, ever more seldom.
    fn fail(&mut self, now: Instant, failure: BootFailure) {
        self.task = None;
        let doubled = 1_u32.checked_shl(self.failures).unwrap_or(u32::MAX);
        let wait = self.settings.retry.saturating_mul(doubled).min(self.settings.longest_retry);
        self.failures = self.failures.saturating_add(1);
        self.phase = Phase::Waiting(now + wait);
        if self.told.as_ref() != Some(&failure) {
            self.told = Some(failure.clone());
            self.outputs.push_back(BootOutput::Tell(BootEvent::Failed(failure)));
        }
    }
}
