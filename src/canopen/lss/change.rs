//! A new node id or bit rate for one slave, from its preparation to its boot-up (R-DST-092, R-DST-110 to R-DST-115).
//!
//! The steps are those of the DST P92C's manual: heartbeat off, NMT stop, configuration state, configure, store, activate,
//! waiting state, boot-up. What fails in between leads to the way back: waiting state, then the states and the heartbeat
//! that were before.

use std::collections::VecDeque;
use std::time::Duration;

use super::codec::{self, BIT_RATE, NODE_ID};
use super::program::{Exchange, Expect, Next, Reply, accepted, activate, no_answer, store, switch_selective};
use super::{
    LssActivation, LssAnswer, LssChange, LssDuty, LssError, LssSettings, LssState, LssTarget, Performed,
};
use crate::canopen::{NmtRequest, NodeId};

/// A slave boots with a new node id within this time after it was switched to waiting state, or wants a reset for it.
const ACTIVATION: Duration = Duration::from_millis(2000);

/// A change under way.
#[derive(Debug)]
pub(super) struct Change {
    /// The present node id.
    node: Option<NodeId>,
    boot_timeout: Duration,
    /// What is still to be done.
    steps: VecDeque<Step>,
    /// What is being done.
    step: Option<Step>,
    /// What the heartbeat was before, in milliseconds.
    heartbeat: u16,
    /// What the way back consists of.
    stopped: bool,
    switched: bool,
    restored: bool,
    /// It takes effect without anybody switching the device off and on.
    active: bool,
    /// Why it failed.
    failure: Option<LssError>,
}

#[derive(Clone, Debug)]
enum Step {
    ReadHeartbeat(NodeId),
    /// Unless it is off anyway.
    HeartbeatOff(NodeId),
    /// One node, or all.
    Stop(Option<NodeId>),
    /// All slaves to waiting state.
    Leave,
    /// One slave to configuration state, or all.
    Switch(LssTarget),
    /// Sent, and answered without an error code.
    Ask(Exchange),
    /// Sent.
    Activate(Exchange),
    Perform(LssDuty),
    /// The boot-up message at the new bit rate with the old node id, which not every device sends.
    AwaitChange(NodeId, Duration),
    Pause(Duration),
    AwaitBootUp(NodeId),
    AwaitBootUpAfterReset(NodeId),
    RestoreStates,
    /// Unless it was off.
    RestoreHeartbeat(NodeId),
}

impl Change {
    /// A change that has not begun.
    pub(super) fn new(change: &LssChange, settings: &LssSettings) -> Self {
        Self {
            node: change.node,
            boot_timeout: settings.boot_timeout,
            steps: steps(change),
            step: None,
            heartbeat: 0,
            stopped: false,
            switched: false,
            restored: true,
            active: change.activation != LssActivation::PowerCycle,
            failure: None,
        }
    }

    /// The step after this reply.
    pub(super) fn next(&mut self, reply: Reply, settings: &LssSettings) -> Next {
        if let Err(error) = self.judge(reply, settings) {
            self.fail(error);
        }
        while let Some(step) = self.steps.pop_front() {
            let next = self.perform(&step);
            self.step = Some(step);
            if let Some(next) = next {
                return next;
            }
        }
        let (active, restored) = (self.active, self.restored);
        Next::Finish(self.failure.take().map_or(Ok(LssAnswer::Changed { active, restored }), Err))
    }

    /// The first failure counts, and turns to the way back; what fails on that is left out.
    fn fail(&mut self, error: LssError) {
        self.restored = false;
        if matches!(self.step, Some(Step::RestoreStates | Step::RestoreHeartbeat(_))) {
            return;
        }
        if self.failure.is_none() {
            self.failure = Some(error);
            let leave = self.switched.then_some(Step::Leave);
            let states = self.stopped.then_some(Step::RestoreStates);
            let heartbeat = self.node.map(Step::RestoreHeartbeat);
            self.steps = leave.into_iter().chain(states).chain(heartbeat).collect();
        }
    }

    /// Whether the last step succeeded.
    fn judge(&mut self, reply: Reply, settings: &LssSettings) -> Result<(), LssError> {
        let Some(step) = self.step.clone() else {
            return if let Reply::Failed(error) = reply { Err(error) } else { Ok(()) };
        };
        match (step, reply) {
            (_, Reply::Failed(error)) => Err(error),
            (Step::ReadHeartbeat(_), Reply::Performed(Performed::Value(millis))) => {
                self.heartbeat = u16::try_from(millis).unwrap_or(u16::MAX);
                Ok(())
            }
            (Step::Ask(exchange), Reply::Answer(answer)) => accepted(exchange.service, answer),
            (Step::Ask(exchange), Reply::Silence) => Err(no_answer(&exchange, settings)),
            (Step::Switch(target), Reply::Silence) => Err(no_answer(&switch(target), settings)),
            (Step::AwaitBootUp(new), Reply::Performed(performed)) if performed != Performed::Yes => {
                let Some(old) = self.node else { return Err(LssError::NotActive(NO_BOOT_UP)) };
                // A device that waits for a reset instead gets one.
                self.steps.push_front(Step::AwaitBootUpAfterReset(new));
                self.steps.push_front(Step::Perform(LssDuty::Nmt(Some(old), NmtRequest::ResetCommunication)));
                Ok(())
            }
            (Step::AwaitBootUpAfterReset(_), Reply::Performed(performed)) if performed != Performed::Yes => {
                Err(LssError::NotActive(NO_BOOT_UP))
            }
            (Step::Perform(LssDuty::CheckIdentity(..)), Reply::Performed(Performed::No)) => {
                Err(LssError::NotActive("another device answers at its node id"))
            }
            (Step::AwaitChange(..), _) => Ok(()),
            (step, Reply::Performed(Performed::Failed(reason))) => {
                Err(LssError::Duty { what: duty(&step), reason })
            }
            (step, Reply::Performed(Performed::No)) => {
                Err(LssError::Duty { what: duty(&step), reason: "it did not come about".to_owned() })
            }
            (_, Reply::Performed(_) | Reply::Done | Reply::Answer(_) | Reply::Silence) => Ok(()),
        }
    }

    /// What a step asks for; `None`: nothing.
    fn perform(&mut self, step: &Step) -> Option<Next> {
        let duty = match step {
            Step::HeartbeatOff(_) | Step::RestoreHeartbeat(_) if self.heartbeat == 0 => return None,
            Step::ReadHeartbeat(node) => LssDuty::ReadHeartbeat(*node),
            Step::HeartbeatOff(node) => LssDuty::WriteHeartbeat(*node, 0),
            Step::RestoreHeartbeat(node) => LssDuty::WriteHeartbeat(*node, self.heartbeat),
            Step::Stop(node) => {
                self.stopped = true;
                LssDuty::Nmt(*node, NmtRequest::Stop)
            }
            Step::Leave => {
                self.switched = false;
                return Some(Next::Exchange(leave()));
            }
            Step::Switch(target) => {
                self.switched = true;
                return Some(Next::Exchange(switch(*target)));
            }
            Step::Ask(exchange) | Step::Activate(exchange) => return Some(Next::Exchange(exchange.clone())),
            Step::Pause(time) => return Some(Next::Pause(*time)),
            Step::Perform(duty) => duty.clone(),
            Step::AwaitChange(node, within) => LssDuty::AwaitBootUp(*node, *within),
            Step::AwaitBootUp(node) => LssDuty::AwaitBootUp(*node, ACTIVATION),
            Step::AwaitBootUpAfterReset(node) => LssDuty::AwaitBootUp(*node, self.boot_timeout),
            Step::RestoreStates => LssDuty::RestoreStates,
        };
        Some(Next::Perform(duty))
    }
}

const NO_BOOT_UP: &str = "no boot-up message came from the new node id";

/// The steps of a change that succeeds.
fn steps(change: &LssChange) -> VecDeque<Step> {
    let mut steps = VecDeque::new();
    if let Some(node) = change.node {
        steps.extend([Step::ReadHeartbeat(node), Step::HeartbeatOff(node)]);
    }
    steps.push_back(Step::Stop(change.node.filter(|_| !change.stop_all)));
    if matches!(change.target, LssTarget::Address(_)) {
        // Whoever is in configuration state from before must not obey as well.
        steps.push_back(Step::Leave);
    }
    steps.push_back(Step::Switch(change.target));
    if change.node_id.is_some() {
        let frame = codec::configure_node_id(change.node_id);
        steps.push_back(Step::Ask(Exchange::new("configure node id", &[frame], Expect::Answer(NODE_ID))));
    }
    if let Some(bit_rate) = change.bit_rate {
        let frame = codec::configure_bit_rate(bit_rate);
        steps.push_back(Step::Ask(Exchange::new("configure bit rate", &[frame], Expect::Answer(BIT_RATE))));
    }
    steps.push_back(Step::Ask(store()));
    if let LssActivation::Now { delay } = change.activation {
        steps.extend(activation(change, delay));
        steps.push_back(Step::RestoreStates);
        steps.extend(change.node_id.or(change.node).map(Step::RestoreHeartbeat));
    } else {
        steps.push_back(Step::RestoreStates);
    }
    steps
}

/// The steps that bring a stored change into effect.
fn activation(change: &LssChange, delay: Duration) -> Vec<Step> {
    let mut steps = Vec::new();
    if let Some(bit_rate) = change.bit_rate {
        let within = delay + delay + ACTIVATION;
        steps.push(Step::Activate(activate(delay)));
        steps.push(Step::Perform(LssDuty::ChangeInterface(bit_rate)));
        steps.push(change.node.map_or(Step::Pause(within), |node| Step::AwaitChange(node, within)));
    }
    steps.push(Step::Leave);
    steps.extend(change.node_id.map(Step::AwaitBootUp));
    if let (LssTarget::Address(address), Some(node)) = (change.target, change.node_id.or(change.node)) {
        steps.push(Step::Perform(LssDuty::CheckIdentity(node, address)));
    }
    steps
}

fn switch(target: LssTarget) -> Exchange {
    match target {
        LssTarget::Address(address) => switch_selective(&address),
        LssTarget::OnlySlave { .. } => {
            let frame = codec::switch_global(LssState::Configuration);
            Exchange::new("switch global", &[frame], Expect::Nothing)
        }
    }
}

/// All slaves to waiting state.
fn leave() -> Exchange {
    Exchange::new("switch global", &[codec::switch_global(LssState::Waiting)], Expect::Nothing)
}

/// How people call what the caller did.
fn duty(step: &Step) -> &'static str {
    match step {
        Step::ReadHeartbeat(_) => "reading the heartbeat time 0x1017",
        Step::HeartbeatOff(_) | Step::RestoreHeartbeat(_) => "writing the heartbeat time 0x1017",
        Step::Perform(LssDuty::ChangeInterface(_)) => "changing the bit rate of our own interface",
        Step::Perform(LssDuty::CheckIdentity(..)) => "reading the identity 0x1018",
        Step::Stop(_)
        | Step::Leave
        | Step::Switch(_)
        | Step::Ask(_)
        | Step::Activate(_)
        | Step::Perform(_)
        | Step::AwaitChange(..)
        | Step::Pause(_)
        | Step::AwaitBootUp(_)
        | Step::AwaitBootUpAfterReset(_)
        | Step::RestoreStates => "an NMT request",
    }
}
