//! A `DetCon` as it behaves on the bus: NMT states, node guarding, four TPDOs. Pure.

use std::collections::VecDeque;
use std::time::Duration;

use super::super::slave::{QUEUE_LIMIT, Slave, SlaveFaults, SlaveWork};
use super::cadence::{BASE_PERIOD, EventDriven, KNOCK_PERIOD, Periodic};
use super::faults::Faults;
use super::values::{Tpdo, Values, WireFormat};
use crate::can::CanFrame;
use crate::canopen::{NmtRequest, NmtState, NodeId, cob_id};
use crate::time::{Instant, Now};

/// All four TPDOs are sent within 100 ms of the start (R-DET-077).
const LONGEST_STAGGER: Duration = Duration::from_millis(25);

/// What a device is like. The default is what devices in the field are expected to do.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct DetconSettings {
    /// Cylinders of the engine that have a sensor, from channel 1 on, 0..=20.
    pub cylinders: u8,
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
            cylinders: 16,
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
    slave: Slave,
    settings: DetconSettings,
    faults: Faults,
    values: Values,
    initialised_at: Option<Instant>,
    /// Bit 7 of the next guard reply.
    toggle: bool,
    replies: VecDeque<Instant>,
    /// TPDO1, 2 and 4.
    intensities: [(Tpdo, Periodic); 3],
    /// TPDO3.
    status: EventDriven,
}

/// What can become due.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Work {
    Slave(SlaveWork),
    FinishInitialisation,
    Reply,
    Send(Tpdo),
}

impl Detcon {
    /// A device without power.
    #[must_use]
    pub fn new(node: NodeId, settings: DetconSettings) -> Self {
        Self {
            slave: Slave::new(node),
            settings,
            faults: Faults::default(),
            values: Values::default(),
            initialised_at: None,
            toggle: false,
            replies: VecDeque::new(),
            intensities: [Tpdo::One, Tpdo::Two, Tpdo::Four].map(|tpdo| (tpdo, Periodic::default())),
            status: EventDriven::default(),
        }
    }

    /// Its node id.
    #[must_use]
    pub fn node(&self) -> NodeId {
        self.slave.node()
    }

    /// Its NMT state; `None` = powered off.
    #[must_use]
    pub fn state(&self) -> Option<NmtState> {
        self.slave.state()
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
        if self.state().is_none() {
            self.boot(now.instant);
            self.advance(now.instant);
        }
    }

    /// Switches the power off: silence at once.
    pub fn power_off(&mut self, now: Now) {
        self.advance(now.instant);
        self.slave.power_off();
        self.initialised_at = None;
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

    /// Switches the faults of a `DetCon` on and off.
    pub fn update_faults(&mut self, now: Now, change: impl FnOnce(&mut Faults)) {
        self.advance_before(now.instant);
        let event_bytes = self.event_bytes();
        change(&mut self.faults);
        self.tell_event(now.instant, event_bytes);
        self.advance(now.instant);
    }

    /// Switches the faults of any slave on and off.
    pub fn update_slave_faults(&mut self, now: Now, change: impl FnOnce(&mut SlaveFaults)) {
        self.advance_before(now.instant);
        let mut faults = *self.slave.faults();
        change(&mut faults);
        self.slave.set_faults(now.instant, faults);
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
        self.slave.poll_output()
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
        let slave = self.slave.next_work().map(|(due, work)| (due, Work::Slave(work)));
        let timers =
            [(self.initialised_at, Work::FinishInitialisation), (self.replies.front().copied(), Work::Reply)];
        let [one, two, four] = self.intensities.map(|(tpdo, timer)| (timer.due(), Work::Send(tpdo)));
        let pdos = [one, two, (self.status.due(), Work::Send(Tpdo::Three)), four];
        let own = timers.into_iter().chain(pdos).filter_map(|(due, work)| Some((due?, work)));
        slave.into_iter().chain(own).min_by_key(|(due, _)| *due)
    }

    fn perform(&mut self, now: Instant, work: Work) {
        match work {
            Work::Slave(SlaveWork::Restart) => self.boot(now),
            Work::Slave(work @ (SlaveWork::ForeignStop | SlaveWork::ForeignGuard)) => {
                if let Some(frame) = self.slave.interfere(now, work) {
                    self.receive(now, &frame);
                }
            }
            Work::FinishInitialisation => {
                self.initialised_at = None;
                self.slave.enter(NmtState::PreOperational);
            }
            Work::Reply => {
                self.replies.pop_front();
                self.reply();
            }
            Work::Send(tpdo) => self.send_tpdo(now, tpdo),
        }
    }

    /// Only NMT commands and guard requests concern the device (R-DET-006, R-DET-015).
    fn receive(&mut self, now: Instant, frame: &CanFrame) {
        if let Some(request) = self.slave.command(frame) {
            self.obey(now, request);
        } else if frame.is_remote() && frame.id() == cob_id::error_control(self.node()) {
            self.guard(now);
        }
    }

    /// An NMT command to this device. During initialisation nobody listens (R-DET-019).
    fn obey(&mut self, now: Instant, request: NmtRequest) {
        match request {
            NmtRequest::Start => {
                if self.state() != Some(NmtState::Operational) {
                    self.slave.enter(NmtState::Operational);
                    self.start_tpdos(now);
                }
            }
            NmtRequest::Stop => {
                self.slave.enter(NmtState::Stopped);
                self.stop_tpdos();
            }
            NmtRequest::EnterPreOperational if self.settings.all_nmt_commands => {
                self.slave.enter(NmtState::PreOperational);
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
        self.slave.boot(now);
        self.initialised_at = Some(now + self.settings.initialisation);
        self.slave.send_boot_up();
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
        let Some(state) = self.state() else { return };
        let booting = state == NmtState::Initialising;
        let silent = self.faults.mute_guarding || (booting && !self.settings.guard_in_boot);
        if !silent && self.replies.len() < QUEUE_LIMIT {
            self.replies.push_back(now + self.faults.late_replies.unwrap_or(self.settings.reply_delay));
        }
    }

    fn reply(&mut self) {
        let Some(state) = self.state() else { return };
        let toggle = if self.toggle { 0x80 } else { 0 };
        if !self.faults.stuck_toggle {
            self.toggle = !self.toggle;
        }
        self.slave.send(cob_id::error_control(self.node()), &[state.code() | toggle]);
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
        if let Some(payload) = data.get(..length) {
            self.slave.send(tpdo.can_id(self.node()), payload);
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
#[path = "protocol_fault_tests.rs"]
mod fault_tests;
#[cfg(test)]
#[path = "protocol_tests.rs"]
mod tests;
