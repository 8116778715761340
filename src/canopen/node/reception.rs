//! What a frame of a node means for it: boot-up messages, states, TPDOs, emergencies.
//!
//! Functions that may find that the node waits to be started return whether it does.

use std::time::Duration;

use super::super::duplicate::StateKind;
use super::super::emcy::Emergency;
use super::super::guarding::Verdict;
use super::super::outputs::Outputs;
use super::super::pdo::Length;
use super::super::start::{STORM_WAIT, Start};
use super::super::{NmtRequest, NmtState, NodeEvent, PdoIndex};
use super::Node;
use super::strange::Strange;
use super::watch::Watch;
use crate::can::{CanFrame, CanId};
use crate::time::Instant;

/// Another guarding master has gone after this long without a request of it.
const FOREIGN_GUARD_QUIET: Duration = Duration::from_secs(60);
/// EMCY: transmit COB-ID collision (CiA 301).
const COLLISION: u16 = 0x8150;

impl Node {
    /// A frame on `0x700 + id`.
    pub(in crate::canopen) fn handle_error_control(
        &mut self,
        now: Instant,
        frame: &CanFrame,
        outputs: &mut Outputs,
    ) -> bool {
        if frame.is_remote() {
            self.guard_request(now, outputs);
            return false;
        }
        self.frame_seen(now, outputs);
        if frame.dlc() != 1 {
            outputs.node(self.id, NodeEvent::Malformed { frame: *frame });
        }
        match frame.data().first() {
            None => false,
            Some(0) => {
                let asked = std::mem::take(&mut self.overheard_request);
                self.boot_up(now, !asked, outputs)
            }
            Some(&byte) => self.state_frame(now, byte, outputs),
        }
    }

    /// A guard request that we did not send (R-DET-043). In the passive role that is another's business.
    fn guard_request(&mut self, now: Instant, outputs: &mut Outputs) {
        self.overheard_request = true;
        if self.start.is_none() {
            return;
        }
        if let Some(guarding) = self.watch.guarding() {
            guarding.handle_foreign_request(now);
        }
        if self.foreign_guard_until.replace(now + FOREIGN_GUARD_QUIET).is_none() {
            outputs.node(self.id, NodeEvent::ForeignGuardMaster);
        }
    }

    /// A state frame `00`: a boot-up message, or a reply of a node that is still initialising with toggle bit 0; the two
    /// look the same (R-DET-029, R-DET-034, R-DET-039). `single`: it can be no reply to somebody else, nor one of two that
    /// a device sends for one boot.
    fn boot_up(&mut self, now: Instant, single: bool, outputs: &mut Outputs) -> bool {
        let initialising = self.state == Some(NmtState::Initialising);
        let (recovered, reply) = match &mut self.watch {
            Watch::Guarding(guarding) => guarding.handle_zero(),
            Watch::Heartbeat(heartbeat) => (heartbeat.handle_boot_up(now), false),
            Watch::Nothing => (false, false),
        };
        if recovered {
            outputs.node(self.id, NodeEvent::Recovered);
        }
        if initialising && reply {
            return false;
        }
        if let Some(guarding) = self.watch.guarding() {
            guarding.ask_after_boot_up(now);
        }
        self.duplicate.handle_boot_up(now, self.self_starting || self.boot.is_self_starting());
        self.strange = Strange::default();
        let expected = self.reset_until.take().is_some_and(|until| now <= until);
        if single && !reply {
            self.duplicate.count_boot_up(now, expected);
        }
        let was_running = self.state.is_some() && !initialising;
        if was_running && !expected {
            outputs.node(self.id, NodeEvent::Restarted);
        }
        if !self.boot.is_empty() {
            self.boot.handle_boot_up(now);
            self.polls.stop();
            // What was to be given back after a change was reset since.
            self.taken_out = false;
            self.transfer(now, outputs);
        }
        self.unconfirmed_errors = false;
        if std::mem::take(&mut self.told_errors) {
            outputs.node(self.id, NodeEvent::ErrorsForgotten);
        }
        self.invalid = None;
        self.set_state(NmtState::Initialising, true, outputs);
        self.ordered = None;
        self.pdos.stop();
        if self.start.as_mut().is_some_and(|start| start.handle_boot_up(now)) {
            outputs.node(self.id, NodeEvent::StartHeldBack { wait: STORM_WAIT });
        }
        false
    }

    /// A state frame other than `00`.
    fn state_frame(&mut self, now: Instant, byte: u8, outputs: &mut Outputs) -> bool {
        let (toggle, code) = (byte & 0x80 != 0, byte & 0x7F);
        let asked = std::mem::take(&mut self.overheard_request);
        if !matches!(self.watch, Watch::Guarding(_)) {
            let kind = if asked { StateKind::Reply } else { StateKind::Heartbeat };
            self.compare(now, (asked == toggle).then_some(kind), outputs);
        }
        let recovered = match &mut self.watch {
            Watch::Guarding(guarding) => {
                let missed = guarding.expire(now);
                let verdict = guarding.handle_reply(now, toggle);
                if let Some(failure) = missed {
                    self.missed(now, failure, outputs);
                }
                self.compare(now, kind_of(verdict, toggle), outputs);
                match self.weigh(now, verdict, byte, outputs) {
                    Some(recovered) => recovered,
                    None => return false,
                }
            }
            Watch::Heartbeat(heartbeat) => heartbeat.alive(now),
            Watch::Nothing => false,
        };
        self.unconfirmed_errors = false;
        if recovered {
            outputs.node(self.id, NodeEvent::Recovered);
            // It may be another device, or one that lost its settings: everything is read again.
            self.boot.handle_recovered(now);
            self.transfer(now, outputs);
        }
        if !matches!(self.watch, Watch::Nothing) && !std::mem::replace(&mut self.supervised, true) {
            outputs.node(self.id, NodeEvent::Supervised);
        }
        let start = self.report(now, code, outputs);
        let reset = recovered && self.start.as_ref().is_some_and(Start::resets_on_recovery);
        if reset {
            self.send_reset(now, outputs);
        }
        start && !reset
    }

    /// Tells what a guard reply was; `None` where its state does not count, else whether it ended the loss.
    fn weigh(&mut self, now: Instant, verdict: Verdict, byte: u8, outputs: &mut Outputs) -> Option<bool> {
        match verdict {
            Verdict::Valid { recovered, wrong_toggle } => {
                self.duplicate.handle_reply(byte);
                if let Some(consecutive) = wrong_toggle {
                    outputs.node(self.id, NodeEvent::ToggleError { consecutive });
                }
                Some(recovered)
            }
            Verdict::ToggleError(failure) => {
                self.duplicate.handle_reply(byte);
                outputs.node(self.id, NodeEvent::ToggleError { consecutive: failure.consecutive });
                if let Some(stuck_toggle) = failure.lost {
                    self.lost(now, stuck_toggle, outputs);
                }
                None
            }
            Verdict::Unsolicited { foreign, twice, .. } => {
                if twice {
                    let evidence = self.duplicate.handle_second_reply(now, byte);
                    self.suspect(evidence, outputs);
                }
                if !foreign && !std::mem::replace(&mut self.unsolicited_told, true) {
                    outputs.node(self.id, NodeEvent::UnsolicitedState);
                }
                Some(false)
            }
        }
    }

    /// A heartbeat, or the answer to a guard request, where it can be told which.
    fn compare(&mut self, now: Instant, kind: Option<StateKind>, outputs: &mut Outputs) {
        let evidence = kind.and_then(|kind| self.duplicate.handle_state(now, kind));
        self.suspect(evidence, outputs);
    }

    /// Tells new evidence that another node has the same id.
    pub(super) fn suspect(&self, evidence: Option<&'static str>, outputs: &mut Outputs) {
        if let Some(evidence) = evidence {
            outputs.node(self.id, NodeEvent::DuplicateSuspected { evidence });
        }
    }

    /// The node reports a state code.
    fn report(&mut self, now: Instant, code: u8, outputs: &mut Outputs) -> bool {
        let Some(state) = NmtState::from_code(code) else {
            if self.invalid.replace(code) != Some(code) {
                outputs.node(self.id, NodeEvent::InvalidState { raw: code });
            }
            return false;
        };
        self.invalid = None;
        if state == NmtState::Operational && self.was_on_its_way(now) {
            return false;
        }
        self.set_state(state, self.is_ordered(state), outputs);
        match state {
            NmtState::Operational => {
                self.operational(now, outputs);
                false
            }
            NmtState::Initialising => {
                self.pdos.stop();
                false
            }
            NmtState::Stopped | NmtState::PreOperational => {
                self.pdos.stop();
                let lost = self.watch.is_lost();
                self.start.as_ref().is_some_and(|start| !lost && start.handle_idle_node(now))
            }
        }
    }

    /// Whether a change to this state is what a command or the end of initialisation leads to (R-DET-038).
    fn is_ordered(&self, to: NmtState) -> bool {
        match self.state {
            None => true,
            Some(NmtState::Initialising) if to == NmtState::PreOperational || self.self_starting => true,
            Some(_) => self.ordered == Some(to),
        }
    }

    pub(super) fn set_state(&mut self, to: NmtState, ordered: bool, outputs: &mut Outputs) {
        self.entered = None;
        self.told_to_leave = false;
        let from = self.state.replace(to);
        self.boot.handle_state(match to {
            NmtState::Initialising => self.self_starting || self.boot.is_self_starting(),
            NmtState::PreOperational => false,
            NmtState::Operational | NmtState::Stopped => true,
        });
        if from != Some(to) {
            if !ordered {
                self.ordered = None;
            }
            outputs.node(self.id, NodeEvent::State { from, to, ordered });
        }
    }

    fn operational(&mut self, now: Instant, outputs: &mut Outputs) {
        if self.start.as_mut().is_some_and(Start::handle_operational) {
            outputs.node(self.id, NodeEvent::StartSucceeded);
        }
        if !self.watch.is_lost() {
            self.pdos.supervise(now);
        }
    }

    /// A frame on the identifier of a TPDO. Whether it counts as one.
    pub(in crate::canopen) fn handle_pdo(
        &mut self,
        now: Instant,
        pdo: PdoIndex,
        frame: &CanFrame,
        outputs: &mut Outputs,
    ) -> bool {
        if frame.is_remote() {
            outputs.node(self.id, NodeEvent::Malformed { frame: *frame });
            return false;
        }
        self.frame_seen(now, outputs);
        let received = frame.dlc();
        let apart = self.duplicate.tells_apart(pdo);
        let evidence = self.duplicate.handle_length(now, pdo, received);
        self.suspect(evidence, outputs);
        if !apart && self.duplicate.tells_apart(pdo) {
            outputs.node(self.id, NodeEvent::DuplicateToldApart { pdo });
        }
        let length = if self.duplicate.tells_apart(pdo) && self.pdos.length(pdo) != Some(received) {
            // It is the other node's.
            Some(Length::Discarded)
        } else {
            self.pdos.receive(now, pdo, received)
        };
        let discarded = matches!(length, None | Some(Length::Discarded));
        if length != Some(Length::Right) {
            outputs.node(self.id, NodeEvent::PdoLength { pdo, received, discarded });
        }
        if discarded || self.was_on_its_way(now) {
            return false;
        }
        let evidence = self.duplicate.handle_pdo(now, pdo);
        self.suspect(evidence, outputs);
        self.believe_operational(now, pdo, outputs);
        let mut data = [0; 8];
        for (to, from) in data.iter_mut().zip(frame.data()) {
            *to = *from;
        }
        outputs.node(self.id, NodeEvent::Pdo { pdo, data, length: received });
        true
    }

    /// Whether the node may have sent what comes now before it was put into pre-operational, a moment ago.
    fn was_on_its_way(&self, now: Instant) -> bool {
        self.entered.is_some_and(|(until, _)| now < until)
    }

    /// Only an operational node sends TPDOs, so it is believed to be one until it reports its state (R-DET-083).
    fn believe_operational(&mut self, now: Instant, pdo: PdoIndex, outputs: &mut Outputs) {
        let state = self.state;
        let ordered = self.is_ordered(NmtState::Operational);
        let surprising = state != Some(NmtState::Operational) && !ordered;
        if surprising {
            outputs.node(self.id, NodeEvent::PdoInUnexpectedState { pdo, state });
        }
        if self.watch.is_lost() {
            return;
        }
        if state != Some(NmtState::Operational) {
            self.set_state(NmtState::Operational, ordered, outputs);
            self.operational(now, outputs);
        } else if let Some(start) = &mut self.start
            && start.handle_operational()
        {
            outputs.node(self.id, NodeEvent::StartSucceeded);
        }
        if surprising && let Some(guarding) = self.watch.guarding() {
            guarding.probe(now);
        }
    }

    /// An emergency message (R-DET-091, R-DST-074). Devices from before version 4 of CiA 301 boot up with an empty one.
    pub(in crate::canopen) fn handle_emergency(
        &mut self,
        now: Instant,
        frame: &CanFrame,
        outputs: &mut Outputs,
    ) -> bool {
        if frame.is_remote() {
            outputs.node(self.id, NodeEvent::Malformed { frame: *frame });
            return false;
        }
        self.frame_seen(now, outputs);
        if frame.data().is_empty() {
            return self.boot_up(now, false, outputs);
        }
        let Some(Emergency { code, register, vendor }) = Emergency::decode(frame.data()) else {
            outputs.node(self.id, NodeEvent::Malformed { frame: *frame });
            return false;
        };
        self.told_errors |= code != 0;
        outputs.node(self.id, NodeEvent::Emergency { code, register, vendor });
        if code == COLLISION {
            let evidence = self.duplicate.handle_collision(now);
            self.suspect(evidence, outputs);
        }
        // A device that finds an error when it is switched on may send this in place of its boot-up message (R-DST-052).
        // Such a one that was not missed yet is found out when it is.
        if self.watch.is_lost() {
            self.boot_again(now, outputs);
        } else {
            self.unconfirmed_errors = code != 0;
        }
        false
    }

    /// A frame on `0x580 + id`.
    pub(in crate::canopen) fn handle_sdo_answer(
        &mut self,
        now: Instant,
        frame: &CanFrame,
        outputs: &mut Outputs,
    ) {
        self.frame_seen(now, outputs);
        let evidence = self.duplicate.handle_sdo_answer(now, frame);
        self.suspect(evidence, outputs);
        if let Some(sdo) = &mut self.sdo {
            sdo.handle_answer(now, frame);
        }
        self.transfer(now, outputs);
    }

    /// A 29-bit frame with the number of one of the node's identifiers (R-DET-006).
    pub(in crate::canopen) fn handle_foreign_format(&mut self, frame: &CanFrame, outputs: &mut Outputs) {
        debug_assert!(matches!(frame.id(), CanId::Extended(_)), "11-bit frames are dispatched by kind");
        outputs.node(self.id, NodeEvent::Malformed { frame: *frame });
    }

    /// Another master's command to this node was overheard. Its effect is believed in the passive role, which has no
    /// other way to learn of it; a master asks the node instead, and sends it no RPDOs before it has answered.
    pub(in crate::canopen) fn handle_foreign_command(
        &mut self,
        now: Instant,
        request: NmtRequest,
        outputs: &mut Outputs,
    ) {
        if self.start.is_some() {
            self.told_to_leave = request != NmtRequest::Start;
            if request == NmtRequest::Start {
                self.duplicate.handle_start();
            }
            return;
        }
        self.expect(now, request);
        let reached = match request {
            NmtRequest::Stop => Some(NmtState::Stopped),
            NmtRequest::EnterPreOperational => Some(NmtState::PreOperational),
            NmtRequest::Start | NmtRequest::ResetNode | NmtRequest::ResetCommunication => None,
        };
        if let Some(state) = reached.filter(|_| self.seen) {
            self.set_state(state, true, outputs);
        }
    }
}

/// What a state frame is for certain, by the verdict on it. A reply that comes late is neither.
fn kind_of(verdict: Verdict, toggle: bool) -> Option<StateKind> {
    match verdict {
        Verdict::Valid { .. } | Verdict::ToggleError(_) if toggle => Some(StateKind::Reply),
        Verdict::Unsolicited { unasked: true, .. } if !toggle => Some(StateKind::Heartbeat),
        Verdict::Valid { .. } | Verdict::ToggleError(_) | Verdict::Unsolicited { .. } => None,
    }
}
