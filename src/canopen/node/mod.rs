//! One node: the machines of its life, its start and its TPDOs, and the state it is believed to be in.
//!
//! This file joins the machines and runs their clocks.
//!
//! - `watch`: how its life is watched. `reception`: what its frames mean. `transfers`: what it is asked by SDO.
//! - `strange`: TPDOs in its name that its mapping does not have. `supply`:
//!   what it is sent in RPDOs.

mod reception;
mod strange;
mod supply;
mod transfers;
mod watch;

use std::time::Duration;

use super::boot::{Boot, BootSettings};
use super::duplicate::Duplicate;
use super::guarding::Failure;
use super::outputs::Outputs;
use super::pdo::Pdos;
use super::polls::Polls;
use super::rpdo::Rpdos;
use super::sdo::{Refused, SdoClient};
use super::start::Start;
use super::{NmtRequest, NmtState, NodeEvent, NodeId, NodeSettings, PdoIndex, Role, cob_id};
use crate::can::{CanFrame, CanId};
use crate::time::Instant;
use strange::Strange;
pub(super) use strange::predefined_tpdo;
use watch::Watch;

/// A boot-up message this long after an ordered reset was ordered too; slow devices take seconds.
const RESET_TAKES: Duration = Duration::from_secs(30);

/// What a node sent before a command of ours reached it comes within this time.
const ON_ITS_WAY: Duration = Duration::from_millis(20);

/// One node.
#[derive(Debug)]
pub(super) struct Node {
    pub(super) id: NodeId,
    pub(super) watch: Watch,
    /// `None` in the passive role.
    pub(super) start: Option<Start>,
    pub(super) sdo: Option<SdoClient>,
    pub(super) boot: Boot,
    pub(super) polls: Polls,
    /// What the node has told to send with other identifiers; `None`: not at all.
    moved: Vec<(Moved, Option<CanId>)>,
    /// The identifier of its emergency messages, unless it tells another.
    emergency: CanId,
    pub(super) pdos: Pdos,
    rpdos: Rpdos,
    /// A frame of it came since the bus can be used.
    heard: bool,
    pub(super) duplicate: Duplicate,
    strange: Strange,
    /// Started by nobody: its TPDOs may follow its boot-up message at once.
    pub(super) self_starting: bool,
    /// The believed state; `None` before the first sign.
    pub(super) state: Option<NmtState>,
    /// Another master ordered it out of operation, and it has told no state since.
    told_to_leave: bool,
    /// Where the last NMT command leads, until the node goes elsewhere.
    pub(super) ordered: Option<NmtState>,
    /// What `ordered` was before the last command of ours, and whether the node was held.
    before: Option<(Option<NmtState>, bool)>,
    /// It was taken out of operation to be configured, and starts by nobody's command: that is given back.
    taken_out: bool,
    /// It was put into pre-operational and has told no state since: until when what it sends was on its way before, and
    /// the state before.
    entered: Option<(Instant, Option<NmtState>)>,
    /// Until then a boot-up message is the effect of an ordered reset.
    pub(super) reset_until: Option<Instant>,
    /// Undefined state code that was told last.
    pub(super) invalid: Option<u8>,
    pub(super) unsolicited_told: bool,
    /// It told of an error since it booted.
    pub(super) told_errors: bool,
    /// An emergency message was the last that it told: it may have been switched off and on without a boot-up message.
    pub(super) unconfirmed_errors: bool,
    /// It told its state since it was lost or the bus could not be used.
    pub(super) supervised: bool,
    /// Somebody else's last guard request was not answered yet.
    pub(super) overheard_request: bool,
    /// Until then somebody else is known to guard this node.
    pub(super) foreign_guard_until: Option<Instant>,
    /// When somebody else read an object the last time.
    foreign_read: Option<Instant>,
    pub(super) seen: bool,
    never_seen_after: Duration,
    never_seen_at: Option<Instant>,
    never_seen_told: bool,
}

/// What a node can send with another identifier than was thought.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Moved {
    /// One of its TPDOs.
    Pdo(PdoIndex),
    /// Its emergency messages.
    Emergency,
}

/// Why an SDO transfer was not begun.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum SdoRefused {
    /// The bus is passive, or the node is not there or has no SDO.
    #[error("no SDO is configured for this node, or the gateway is passive on its bus")]
    NoSdo,
    /// A stopped node answers no SDO (CiA 301, R-DST-071).
    #[error("the node is stopped; in that state it answers no SDO")]
    Stopped,
    /// The gateway is identifying or configuring the node; that takes some hundred milliseconds.
    #[error("the node is being configured; try again in a moment")]
    Booting,
    /// The client does not take it.
    #[error(transparent)]
    Client(#[from] Refused),
}

impl Node {
    /// A node of which nothing is known; first guarded `phase` after `now`.
    pub(super) fn new(settings: NodeSettings, role: Role, phase: Duration, now: Instant) -> Self {
        let master = role == Role::Master;
        let sdo = settings.sdo.filter(|_| master).map(|sdo| SdoClient::new(settings.id, sdo));
        let boot = Boot::new(if sdo.is_some() { settings.boot } else { BootSettings::default() });
        Self {
            id: settings.id,
            watch: Watch::new(settings.error_control, role, phase, now),
            self_starting: !settings.start.auto_start,
            start: master.then(|| Start::new(settings.start, boot.is_done())),
            sdo,
            boot,
            polls: Polls::new(settings.polls),
            moved: Vec::new(),
            emergency: settings.emergency.unwrap_or_else(|| cob_id::emcy(settings.id)),
            duplicate: Duplicate::new(&settings.pdos),
            strange: Strange::default(),
            pdos: Pdos::new(settings.pdos),
            rpdos: Rpdos::new(settings.rpdos),
            heard: false,
            state: None,
            ordered: None,
            before: None,
            taken_out: false,
            told_to_leave: false,
            entered: None,
            reset_until: None,
            invalid: None,
            unsolicited_told: false,
            told_errors: false,
            unconfirmed_errors: false,
            supervised: false,
            overheard_request: false,
            foreign_guard_until: None,
            foreign_read: None,
            seen: false,
            never_seen_after: settings.never_seen_after,
            never_seen_at: Some(now + settings.never_seen_after),
            never_seen_told: false,
        }
    }

    /// Whether nobody would mind if it were started: it may be included in a broadcast.
    pub(super) fn may_be_started_with_all(&self) -> bool {
        let ready = |start: &Start| !start.is_held() && !start.is_held_back();
        !self.self_starting && self.start.as_ref().is_some_and(ready)
    }

    /// An operator's command, or an automatic one, was sent to this node.
    pub(super) fn command_sent(
        &mut self,
        now: Instant,
        request: NmtRequest,
        manual: bool,
        outputs: &mut Outputs,
    ) {
        self.note_sent(now, request, outputs);
        let Some(start) = &mut self.start else { return };
        match request {
            NmtRequest::Start => {
                if manual {
                    start.release();
                }
                start.sent(now);
            }
            NmtRequest::Stop | NmtRequest::EnterPreOperational => start.hold(),
            NmtRequest::ResetNode | NmtRequest::ResetCommunication => start.cancel(),
        }
    }

    /// A start of all nodes was sent because of another node (R-DET-018).
    pub(super) fn started_with_all(&mut self, now: Instant, outputs: &mut Outputs) {
        let waiting = matches!(self.state, Some(NmtState::Stopped | NmtState::PreOperational));
        self.note_sent(now, NmtRequest::Start, outputs);
        if let Some(start) = self.start.as_mut().filter(|_| waiting && !self.watch.is_lost()) {
            start.sent_to_all(now);
        }
    }

    fn note_sent(&mut self, now: Instant, request: NmtRequest, outputs: &mut Outputs) {
        outputs.node(self.id, NodeEvent::NmtSent { request });
        self.before = Some((self.ordered, self.start.as_ref().is_some_and(Start::is_held)));
        if let Some(guarding) = self.watch.guarding() {
            guarding.settle(now);
        }
        self.expect(now, request);
    }

    /// Resets the node by itself, because the settings say so (R-DET-016).
    pub(super) fn send_reset(&mut self, now: Instant, outputs: &mut Outputs) {
        outputs.transmit(NmtRequest::ResetNode.frame(Some(self.id)));
        self.command_sent(now, NmtRequest::ResetNode, false, outputs);
    }

    /// A master, ourselves or in the passive role another, sent a command: what the node will do is no surprise.
    pub(super) fn expect(&mut self, now: Instant, request: NmtRequest) {
        self.ordered = Some(match request {
            NmtRequest::Start => NmtState::Operational,
            NmtRequest::Stop => NmtState::Stopped,
            NmtRequest::EnterPreOperational | NmtRequest::ResetNode | NmtRequest::ResetCommunication => {
                NmtState::PreOperational
            }
        });
        match request {
            NmtRequest::Start => {
                self.told_to_leave = false;
                self.duplicate.handle_start();
                if !self.watch.is_lost() {
                    self.pdos.supervise(now);
                }
            }
            NmtRequest::Stop | NmtRequest::EnterPreOperational => self.pdos.stop(),
            NmtRequest::ResetNode | NmtRequest::ResetCommunication => {
                self.pdos.stop();
                self.reset_until = Some(now + RESET_TAKES);
                if let Some(guarding) = self.watch.guarding() {
                    guarding.forget_reference();
                }
            }
        }
    }

    /// A guard request of ours did not leave.
    pub(super) fn guard_request_not_sent(&mut self) {
        if let Some(guarding) = self.watch.guarding() {
            guarding.handle_not_sent();
        }
    }

    /// A command of ours to this node did not leave: as if it had not been given.
    pub(super) fn command_not_sent(&mut self, now: Instant, request: NmtRequest, outputs: &mut Outputs) {
        if request == NmtRequest::EnterPreOperational
            && let Some((_, state)) = self.entered.take()
        {
            match state {
                Some(state) => self.set_state(state, true, outputs),
                None => self.state = None,
            }
            self.boot.handle_state(true);
            self.boot.postpone(now);
        }
        if let Some((ordered, held)) = self.before.take() {
            self.ordered = ordered;
            if let Some(start) = self.start.as_mut().filter(|start| start.is_held() && !held) {
                start.release();
            }
        }
        if self.state == Some(NmtState::Operational) && !self.watch.is_lost() {
            self.pdos.supervise(now);
        } else {
            self.pdos.stop();
        }
        match request {
            NmtRequest::Start => {
                if let Some(start) = &mut self.start {
                    start.handle_not_sent();
                }
            }
            NmtRequest::ResetNode | NmtRequest::ResetCommunication => self.reset_until = None,
            NmtRequest::Stop | NmtRequest::EnterPreOperational => {}
        }
    }

    /// The bus cannot be used: silence proves nothing.
    pub(super) fn pause(&mut self) {
        match &mut self.watch {
            Watch::Guarding(guarding) => guarding.pause(),
            Watch::Heartbeat(heartbeat) => heartbeat.pause(),
            Watch::Nothing => {}
        }
        if let Some(start) = &mut self.start {
            start.pause();
        }
        self.boot.pause();
        self.polls.stop();
        if let Some(sdo) = &mut self.sdo {
            sdo.pause();
        }
        self.pdos.stop();
        self.never_seen_at = None;
        self.supervised = false;
        self.heard = false;
    }

    /// The bus can be used again: as at the start, but what was known stays known.
    pub(super) fn resume(&mut self, now: Instant) {
        match &mut self.watch {
            Watch::Guarding(guarding) => guarding.resume(now),
            Watch::Heartbeat(heartbeat) => heartbeat.resume(now),
            Watch::Nothing => {}
        }
        if let Some(start) = &mut self.start {
            start.resume(now);
        }
        if let Some(sdo) = &mut self.sdo {
            sdo.resume(now);
        }
        self.boot.resume(now);
        if self.state == Some(NmtState::Operational) && !self.watch.is_lost() {
            self.pdos.supervise(now);
        }
        if !self.seen && !self.never_seen_told {
            self.never_seen_at = Some(now + self.never_seen_after);
        }
    }

    /// What became due. `true`: a start command is due.
    pub(super) fn handle_timeout(&mut self, now: Instant, outputs: &mut Outputs) -> bool {
        match &mut self.watch {
            Watch::Guarding(guarding) => {
                let due = guarding.handle_timeout(now);
                let dlc = guarding.rtr_dlc();
                if let Some(failure) = due.missed {
                    self.missed(now, failure, outputs);
                }
                let request = CanFrame::remote_frame(cob_id::error_control(self.id), dlc);
                if let Some(request) = request.filter(|_| due.request) {
                    outputs.transmit(request);
                }
            }
            Watch::Heartbeat(heartbeat) => {
                if heartbeat.handle_timeout(now) {
                    self.lost(now, false, outputs);
                }
            }
            Watch::Nothing => {}
        }
        if let Some(sdo) = &mut self.sdo {
            sdo.handle_timeout(now);
        }
        self.boot.handle_timeout(now);
        self.transfer(now, outputs);
        self.poll(now, outputs);
        while let Some(pdo) = self.pdos.next_late(now) {
            outputs.node(self.id, NodeEvent::PdoTimeout { pdo });
        }
        if self.foreign_guard_until.is_some_and(|until| until <= now) {
            self.foreign_guard_until = None;
            outputs.node(self.id, NodeEvent::ForeignGuardMasterGone);
        }
        let (evidence, cleared) = self.duplicate.handle_timeout(now);
        self.suspect(evidence, outputs);
        if cleared {
            outputs.node(self.id, NodeEvent::DuplicateCleared);
        }
        if self.never_seen_at.is_some_and(|at| at <= now) {
            self.never_seen_at = None;
            self.never_seen_told = true;
            outputs.node(self.id, NodeEvent::NeverSeen);
        }
        let start = self.start.as_mut().and_then(|start| start.handle_timeout(now));
        if let Some(attempts) = start.and_then(|due| due.failed) {
            outputs.node(self.id, NodeEvent::StartFailed { attempts });
        }
        start.is_some()
    }

    /// When [`handle_timeout`](Self::handle_timeout) has something to do, and why.
    pub(super) fn poll_timeout(&self) -> Option<(Instant, &'static str)> {
        let watch = match &self.watch {
            Watch::Guarding(guarding) => guarding.poll_timeout(),
            Watch::Heartbeat(heartbeat) => heartbeat.poll_timeout(),
            Watch::Nothing => None,
        };
        let start = self.start.as_ref().and_then(Start::poll_timeout);
        let never_seen = self.never_seen_at.map(|at| (at, "node never seen"));
        let foreign_guard = self.foreign_guard_until.map(|at| (at, "another guarding master"));
        let sdo = self.sdo.as_ref().and_then(SdoClient::poll_timeout);
        [
            watch,
            start,
            sdo,
            self.boot.poll_timeout(),
            self.polls.poll_timeout(),
            self.pdos.poll_timeout(),
            self.rpdos.poll_timeout(),
            self.duplicate.poll_timeout(),
            never_seen,
            foreign_guard,
        ]
        .into_iter()
        .flatten()
        .min_by_key(|(at, _)| *at)
    }

    /// A guard request was not answered.
    pub(super) fn missed(&mut self, now: Instant, failure: Failure, outputs: &mut Outputs) {
        outputs.node(self.id, NodeEvent::GuardMissed { consecutive: failure.consecutive });
        if let Some(stuck_toggle) = failure.lost {
            self.lost(now, stuck_toggle, outputs);
        }
    }

    /// The node is lost (R-DET-036).
    pub(super) fn lost(&mut self, now: Instant, stuck_toggle: bool, outputs: &mut Outputs) {
        self.supervised = false;
        outputs.node(self.id, NodeEvent::Lost { stuck_toggle });
        self.polls.stop();
        self.pdos.stop();
        if let Some(start) = &mut self.start {
            start.cancel();
        }
        if std::mem::take(&mut self.unconfirmed_errors) {
            self.boot_again(now, outputs);
        }
    }

    /// A lost node shows that it is there, though not that it goes on as before: it is booted, unless that is under way.
    pub(super) fn boot_again(&mut self, now: Instant, outputs: &mut Outputs) {
        if self.boot.is_done() {
            self.boot.handle_recovered(now);
            self.transfer(now, outputs);
        }
    }

    /// A frame of this node came: the first ends the wait for it.
    pub(super) fn frame_seen(&mut self, now: Instant, outputs: &mut Outputs) {
        outputs.node(self.id, NodeEvent::FrameSeen);
        self.boot.handle_alive(now);
        self.heard = true;
        if !self.seen {
            self.seen = true;
            self.never_seen_at = None;
            outputs.node(self.id, NodeEvent::Seen);
        }
    }
}
