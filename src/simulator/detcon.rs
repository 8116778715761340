//! A `DetCon` as it behaves on the bus: NMT states, node guarding, four TPDOs. Pure.

use std::collections::VecDeque;
use std::time::Duration;

use super::cadence::{BASE_PERIOD, EventDriven, KNOCK_PERIOD, Periodic};
use super::faults::{Faults, SHORTEST_BOOT_LOOP};
use super::values::{Tpdo, Values, WireFormat};
use crate::can::CanFrame;
use crate::canopen::{NmtRequest, NmtState, NodeId, cob_id};
use crate::time::{Instant, Now};

/// Frames that wait to be sent, and guard requests that wait for their reply. Nothing fills them as long as the outputs
/// are drained after each input; beyond, the newest is dropped, as a full controller would.
const QUEUE_LIMIT: usize = 64;
/// How often the second master guards.
const FOREIGN_GUARD_PERIOD: Duration = Duration::from_millis(700);
/// How often the second master stops the device.
const FOREIGN_STOP_PERIOD: Duration = Duration::from_secs(10);
/// All four TPDOs are sent within 100 ms of the start (R-DET-077).
const LONGEST_STAGGER: Duration = Duration::from_millis(25);

/// What a device is like. The default is what devices in the field are expected to do.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct DetconSettings {
    /// From the boot-up message to pre-operational (R-DET-027).
    pub initialisation: Duration,
    /// From a guard request to its reply.
    pub reply_delay: Duration,
    /// From the start command to TPDO1, and from each TPDO to the next in the first round; at most 25 ms (R-DET-077).
    pub stagger: Duration,
    /// Guard requests are answered during initialisation too (`sim_guard_in_boot`, R-DET-030).
    pub guard_in_boot: bool,
    /// An event-triggered TPDO3 restarts its period (`sim_event_restarts_period`, R-DET-075).
    pub event_restarts_period: bool,
    /// Enter pre-operational, reset node and reset communication have an effect (R-DET-016).
    pub all_nmt_commands: bool,
    /// How values are written.
    pub format: WireFormat,
}

impl Default for DetconSettings {
    fn default() -> Self {
        Self {
            initialisation: Duration::from_millis(80),
            reply_delay: Duration::from_millis(1),
            stagger: Duration::from_millis(5),
            guard_in_boot: true,
            event_restarts_period: true,
            all_nmt_commands: true,
            format: WireFormat::default(),
        }
    }
}

/// The device. Powered off when made.
#[derive(Clone, Debug)]
pub struct Detcon {
    node: NodeId,
    settings: DetconSettings,
    faults: Faults,
    values: Values,
    /// `None` = powered off.
    state: Option<NmtState>,
    initialised_at: Option<Instant>,
    /// Bit 7 of the next guard reply.
    toggle: bool,
    replies: VecDeque<Instant>,
    /// TPDO1, 2 and 4.
    intensities: [(Tpdo, Periodic); 3],
    /// TPDO3.
    status: EventDriven,
    foreign_guard_at: Option<Instant>,
    foreign_stop_at: Option<Instant>,
    restart_at: Option<Instant>,
    outputs: VecDeque<CanFrame>,
}

/// What can become due.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Work {
    Restart,
    FinishInitialisation,
    ForeignStop,
    ForeignGuard,
    Reply,
    Send(Tpdo),
}

impl Detcon {
    /// A device without power.
    #[must_use]
    pub fn new(node: NodeId, settings: DetconSettings) -> Self {
        Self {
            node,
            settings,
            faults: Faults::default(),
            values: Values::default(),
            state: None,
            initialised_at: None,
            toggle: false,
            replies: VecDeque::new(),
            intensities: [Tpdo::One, Tpdo::Two, Tpdo::Four].map(|tpdo| (tpdo, Periodic::default())),
            status: EventDriven::default(),
            foreign_guard_at: None,
            foreign_stop_at: None,
            restart_at: None,
            outputs: VecDeque::new(),
        }
    }

    /// Its node id.
    #[must_use]
    pub fn node(&self) -> NodeId {
        self.node
    }

    /// Its NMT state; `None` = powered off.
    #[must_use]
    pub fn state(&self) -> Option<NmtState> {
        self.state
    }

    /// What it measures and reports.
    #[must_use]
    pub fn values(&self) -> &Values {
        &self.values
    }

    /// The faults that are on.
    #[must_use]
    pub fn faults(&self) -> &Faults {
        &self.faults
    }

    /// Switches the power on: boot-up message, initialisation, pre-operational (R-DET-026, R-DET-027). No effect when on.
    pub fn power_on(&mut self, now: Now) {
        self.advance(now.instant);
        if self.state.is_none() {
            self.boot(now.instant);
            self.advance(now.instant);
        }
    }

    /// Switches the power off: silence at once.
    pub fn power_off(&mut self, now: Now) {
        self.advance(now.instant);
        self.state = None;
        self.initialised_at = None;
        self.restart_at = None;
        self.outputs.clear();
        self.silence();
    }

    /// Changes the values. What follows from it on the bus follows at once (R-DET-069, R-DET-071). A periodic frame that is
    /// due at this very moment carries the new values.
    pub fn update(&mut self, now: Now, change: impl FnOnce(&mut Values)) {
        self.advance_before(now.instant);
        let (knocking, event_bytes) = (self.values.is_knocking(), self.event_bytes());
        change(&mut self.values);
        if self.values.is_knocking() != knocking {
            let period = self.intensity_period();
            for (_, timer) in &mut self.intensities {
                timer.change_period(now.instant, period);
            }
        }
        self.tell_event(now.instant, event_bytes);
        self.advance(now.instant);
    }

    /// Switches faults on and off.
    pub fn update_faults(&mut self, now: Now, change: impl FnOnce(&mut Faults)) {
        self.advance_before(now.instant);
        let (before, event_bytes) = (self.faults, self.event_bytes());
        change(&mut self.faults);
        if self.faults.second_master != before.second_master {
            let first = self.faults.second_master.then_some(now.instant);
            (self.foreign_stop_at, self.foreign_guard_at) = (first, first);
        }
        if self.faults.boot_loop != before.boot_loop {
            self.schedule_restart(now.instant);
        }
        self.tell_event(now.instant, event_bytes);
        self.advance(now.instant);
    }

    /// Takes a frame that another participant sent.
    pub fn handle_frame(&mut self, now: Now, frame: &CanFrame) {
        self.advance(now.instant);
        self.receive(now.instant, frame);
        self.advance(now.instant);
    }

    /// What became due.
    pub fn handle_timeout(&mut self, now: Now) {
        self.advance(now.instant);
    }

    /// The next frame to send; call until `None`.
    pub fn poll_output(&mut self) -> Option<CanFrame> {
        self.outputs.pop_front()
    }

    /// When `handle_timeout` is to be called at the latest.
    #[must_use]
    pub fn poll_timeout(&self) -> Option<Instant> {
        self.next_work().map(|(due, _)| due)
    }

    /// Does what is due, in the order of time. Ends, because all work moves its own deadline beyond `now`.
    fn advance(&mut self, now: Instant) {
        while let Some((_, work)) = self.next_work().filter(|(due, _)| *due <= now) {
            self.perform(now, work);
        }
    }

    /// Does what was due before `now`, and leaves what is due just now: but for a frame that tells of an earlier event,
    /// so that a pulse as long as the inhibit time is always seen.
    fn advance_before(&mut self, now: Instant) {
        while let Some((_, work)) = self.next_work().filter(|(due, _)| *due < now) {
            self.perform(now, work);
        }
        if self.status.event_is_due(now) {
            self.send_tpdo(now, Tpdo::Three);
        }
    }

    /// The earliest work; of what is due at the same time, the first listed here.
    fn next_work(&self) -> Option<(Instant, Work)> {
        let timers = [
            (self.restart_at, Work::Restart),
            (self.initialised_at, Work::FinishInitialisation),
            (self.foreign_stop_at, Work::ForeignStop),
            (self.foreign_guard_at, Work::ForeignGuard),
            (self.replies.front().copied(), Work::Reply),
        ];
        let [one, two, four] = self.intensities.map(|(tpdo, timer)| (timer.due(), Work::Send(tpdo)));
        let pdos = [one, two, (self.status.due(), Work::Send(Tpdo::Three)), four];
        let all = timers.into_iter().chain(pdos);
        all.filter_map(|(due, work)| Some((due?, work))).min_by_key(|(due, _)| *due)
    }

    fn perform(&mut self, now: Instant, work: Work) {
        match work {
            Work::Restart => self.boot(now),
            Work::FinishInitialisation => {
                self.initialised_at = None;
                self.state = Some(NmtState::PreOperational);
            }
            Work::ForeignStop => {
                self.foreign_stop_at = Some(now + FOREIGN_STOP_PERIOD);
                self.interfere(now, NmtRequest::Stop.frame(Some(self.node)));
            }
            Work::ForeignGuard => {
                self.foreign_guard_at = Some(now + FOREIGN_GUARD_PERIOD);
                if let Some(request) = CanFrame::remote_frame(cob_id::error_control(self.node), 1) {
                    self.interfere(now, request);
                }
            }
            Work::Reply => {
                self.replies.pop_front();
                self.reply();
            }
            Work::Send(tpdo) => self.send_tpdo(now, tpdo),
        }
    }

    /// A frame of the second master: everybody on the bus sees it, this device too.
    fn interfere(&mut self, now: Instant, frame: CanFrame) {
        self.transmit(frame);
        self.receive(now, &frame);
    }

    /// Only NMT commands and guard requests concern the device (R-DET-006, R-DET-015).
    fn receive(&mut self, now: Instant, frame: &CanFrame) {
        if self.state.is_none() {
            return;
        }
        if frame.id() == cob_id::NMT {
            if let [command, node] = *frame.data()
                && (node == 0 || node == self.node.get())
                && let Some(request) = NmtRequest::from_code(command)
            {
                self.obey(now, request);
            }
        } else if frame.is_remote() && frame.id() == cob_id::error_control(self.node) {
            self.guard(now);
        }
    }

    /// An NMT command to this device. During initialisation nobody listens (R-DET-019).
    fn obey(&mut self, now: Instant, request: NmtRequest) {
        if self.state == Some(NmtState::Initialising) {
            return;
        }
        match request {
            NmtRequest::Start => {
                if self.state != Some(NmtState::Operational) && !self.faults.refuse_start {
                    self.state = Some(NmtState::Operational);
                    self.start_tpdos(now);
                }
            }
            NmtRequest::Stop => {
                self.state = Some(NmtState::Stopped);
                self.stop_tpdos();
            }
            NmtRequest::EnterPreOperational if self.settings.all_nmt_commands => {
                self.state = Some(NmtState::PreOperational);
                self.stop_tpdos();
            }
            NmtRequest::ResetNode | NmtRequest::ResetCommunication if self.settings.all_nmt_commands => {
                self.boot(now);
            }
            NmtRequest::EnterPreOperational | NmtRequest::ResetNode | NmtRequest::ResetCommunication => {}
        }
    }

    fn boot(&mut self, now: Instant) {
        self.silence();
        self.toggle = false;
        self.state = Some(NmtState::Initialising);
        self.initialised_at = Some(now + self.settings.initialisation);
        self.schedule_restart(now);
        if let Some(message) = CanFrame::data_frame(cob_id::error_control(self.node), &[0]) {
            self.transmit(message);
        }
    }

    fn schedule_restart(&mut self, now: Instant) {
        let interval = self.faults.boot_loop.filter(|_| self.state.is_some());
        self.restart_at = interval.map(|interval| now + interval.max(SHORTEST_BOOT_LOOP));
    }

    fn silence(&mut self) {
        self.replies.clear();
        self.stop_tpdos();
    }

    fn start_tpdos(&mut self, now: Instant) {
        let stagger = self.settings.stagger.min(LONGEST_STAGGER);
        let first = |tpdo: Tpdo| now + stagger * u32::from(tpdo.number());
        for (tpdo, timer) in &mut self.intensities {
            timer.start(first(*tpdo));
        }
        self.status.start(first(Tpdo::Three));
    }

    fn stop_tpdos(&mut self) {
        for (_, timer) in &mut self.intensities {
            timer.stop();
        }
        self.status.stop();
    }

    fn guard(&mut self, now: Instant) {
        let booting = self.state == Some(NmtState::Initialising);
        let silent = self.faults.mute_guarding || (booting && !self.settings.guard_in_boot);
        if !silent && self.replies.len() < QUEUE_LIMIT {
            self.replies.push_back(now + self.faults.late_replies.unwrap_or(self.settings.reply_delay));
        }
    }

    fn reply(&mut self) {
        let Some(state) = self.state else { return };
        let toggle = if self.toggle { 0x80 } else { 0 };
        if !self.faults.stuck_toggle {
            self.toggle = !self.toggle;
        }
        if let Some(reply) = CanFrame::data_frame(cob_id::error_control(self.node), &[state.code() | toggle])
        {
            self.transmit(reply);
        }
    }

    fn send_tpdo(&mut self, now: Instant, tpdo: Tpdo) {
        let period = self.intensity_period();
        if let Some((_, timer)) = self.intensities.iter_mut().find(|(own, _)| *own == tpdo) {
            timer.sent(now, period);
        } else {
            self.status.sent(now, self.settings.event_restarts_period);
        }
        if self.faults.mutes(tpdo) {
            return;
        }
        let data = self.values.encode(tpdo, self.format());
        let length = usize::from(self.faults.length_of(tpdo));
        let frame =
            data.get(..length).and_then(|payload| CanFrame::data_frame(tpdo.can_id(self.node), payload));
        if let Some(frame) = frame {
            self.transmit(frame);
        }
    }

    fn transmit(&mut self, frame: CanFrame) {
        let copies = if self.faults.duplicate { 2 } else { 1 };
        for _ in 0..copies {
            if self.outputs.len() < QUEUE_LIMIT {
                self.outputs.push_back(frame);
            }
        }
    }

    fn intensity_period(&self) -> Duration {
        if self.values.is_knocking() { KNOCK_PERIOD } else { BASE_PERIOD }
    }

    fn format(&self) -> WireFormat {
        WireFormat {
            reserved_bits: self.settings.format.reserved_bits || self.faults.reserved_bits,
            ..self.settings.format
        }
    }

    /// Status and analogue output as on the bus: TPDO3 is sent when they change (R-DET-071).
    fn event_bytes(&self) -> [u8; 2] {
        let [status, analog_output, ..] = self.values.encode(Tpdo::Three, self.format());
        [status, analog_output]
    }

    fn tell_event(&mut self, now: Instant, before: [u8; 2]) {
        if self.event_bytes() != before {
            self.status.event(now);
        }
    }
}

#[cfg(test)]
#[path = "detcon_tests.rs"]
mod tests;
