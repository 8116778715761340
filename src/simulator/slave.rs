//! What every simulated slave does, whatever it is: power, boot-up message, NMT commands, and the mishaps that can happen
//! to each. Pure.

use std::collections::VecDeque;
use std::time::Duration;

use super::order::{millis, switch, unless_off};
use crate::can::CanFrame;
use crate::canopen::{NmtRequest, NmtState, NodeId, cob_id};
use crate::time::Instant;

/// Frames that wait to be sent. Nothing fills them as long as the outputs are drained after each input; beyond, the newest
/// is dropped, as a full controller would.
pub const QUEUE_LIMIT: usize = 64;
/// A boot loop is not faster than this.
pub const SHORTEST_BOOT_LOOP: Duration = Duration::from_millis(100);
/// How often the second master guards.
const FOREIGN_GUARD_PERIOD: Duration = Duration::from_millis(700);
/// How often the second master stops the device.
const FOREIGN_STOP_PERIOD: Duration = Duration::from_secs(10);

/// What can be wrong with any slave. The default is a healthy one.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct SlaveFaults {
    /// Another master is on the bus: it guards this device and stops it from time to time.
    pub second_master: bool,
    /// Another device with the same node id: everything is sent twice.
    pub duplicate: bool,
    /// The device restarts by itself, again and again, with this time between two restarts (at least
    /// [`SHORTEST_BOOT_LOOP`]).
    pub boot_loop: Option<Duration>,
    /// NMT start has no effect.
    pub refuse_start: bool,
}

/// An order that every slave understands.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SlaveOrder {
    /// Switches the power.
    Power(bool),
    /// Another master interferes.
    SecondMaster(bool),
    /// Another device has the same node id.
    Duplicate(bool),
    /// The device restarts again and again, this long after each start.
    BootLoop(Option<Duration>),
    /// NMT start has no effect.
    RefuseStart(bool),
}

/// The orders of every slave, for people.
pub const HELP: &str = "\
power on|off                  supply of the device
second master on|off          another master guards and stops the device
duplicate on|off              another device with the same node id
refuse start on|off           NMT start has no effect
boot loop MS|off              the device restarts again and again";

impl SlaveOrder {
    /// `None` when these are not words of such an order.
    ///
    /// # Errors
    /// They are, but with a wrong number or switch; the text says which.
    pub fn parse(words: &[&str]) -> Option<Result<Self, String>> {
        Some(match words {
            ["power", to] => switch(to).map(Self::Power),
            ["second", "master", to] => switch(to).map(Self::SecondMaster),
            ["duplicate", to] => switch(to).map(Self::Duplicate),
            ["boot", "loop", interval] => unless_off(interval, millis).map(Self::BootLoop),
            ["refuse", "start", to] => switch(to).map(Self::RefuseStart),
            _ => return None,
        })
    }
}

impl SlaveFaults {
    /// Switches the fault that an order is about; the power is none.
    pub fn switch(&mut self, order: SlaveOrder) {
        match order {
            SlaveOrder::Power(_) => {}
            SlaveOrder::SecondMaster(on) => self.second_master = on,
            SlaveOrder::Duplicate(on) => self.duplicate = on,
            SlaveOrder::BootLoop(interval) => self.boot_loop = interval,
            SlaveOrder::RefuseStart(on) => self.refuse_start = on,
        }
    }
}

/// What can become due.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SlaveWork {
    /// The boot loop: the device is to boot.
    Restart,
    /// The second master is to stop it; see [`Slave::interfere`].
    ForeignStop,
    /// The second master is to guard it.
    ForeignGuard,
}

/// The part of a slave that all have. Powered off when made.
#[derive(Clone, Debug)]
pub struct Slave {
    node: NodeId,
    /// `None` = powered off.
    state: Option<NmtState>,
    faults: SlaveFaults,
    foreign_guard_at: Option<Instant>,
    foreign_stop_at: Option<Instant>,
    restart_at: Option<Instant>,
    outputs: VecDeque<CanFrame>,
}

impl Slave {
    /// A slave without power.
    #[must_use]
    pub fn new(node: NodeId) -> Self {
        Self {
            node,
            state: None,
            faults: SlaveFaults::default(),
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

    /// Gives it another node id.
    pub fn set_node(&mut self, node: NodeId) {
        self.node = node;
    }

    /// Its NMT state; `None` = powered off.
    #[must_use]
    pub fn state(&self) -> Option<NmtState> {
        self.state
    }

    /// Moves it to another state; no effect without power.
    pub fn enter(&mut self, state: NmtState) {
        if self.state.is_some() {
            self.state = Some(state);
        }
    }

    /// The faults that are on.
    #[must_use]
    pub fn faults(&self) -> &SlaveFaults {
        &self.faults
    }

    /// Switches faults on and off.
    pub fn set_faults(&mut self, now: Instant, faults: SlaveFaults) {
        let before = std::mem::replace(&mut self.faults, faults);
        if self.faults.second_master != before.second_master {
            let first = self.faults.second_master.then_some(now);
            (self.foreign_stop_at, self.foreign_guard_at) = (first, first);
        }
        if self.faults.boot_loop != before.boot_loop && self.state.is_some() {
            self.schedule_restart(now);
        }
    }

    /// The device boots: initialising, with power. The boot-up message is for the device to send.
    pub fn boot(&mut self, now: Instant) {
        self.state = Some(NmtState::Initialising);
        self.schedule_restart(now);
    }

    /// Sends the boot-up message.
    pub fn send_boot_up(&mut self) {
        self.send(cob_id::error_control(self.node), &[0]);
    }

    /// Silence at once.
    pub fn power_off(&mut self) {
        self.state = None;
        self.restart_at = None;
        self.outputs.clear();
    }

    fn schedule_restart(&mut self, now: Instant) {
        self.restart_at = self.faults.boot_loop.map(|interval| now + interval.max(SHORTEST_BOOT_LOOP));
    }

    /// The NMT command in a frame, if it is one for this device and the device listens: not without power, and not during
    /// initialisation.
    #[must_use]
    pub fn command(&self, frame: &CanFrame) -> Option<NmtRequest> {
        if frame.id() != cob_id::NMT || self.state.is_none_or(|state| state == NmtState::Initialising) {
            return None;
        }
        let [command, node] = *frame.data() else { return None };
        let request = NmtRequest::from_code(command).filter(|_| node == 0 || node == self.node.get())?;
        let refused = request == NmtRequest::Start && self.faults.refuse_start;
        (!refused).then_some(request)
    }

    /// Sends a data frame of at most 8 bytes.
    pub fn send(&mut self, id: crate::can::CanId, data: &[u8]) {
        if let Some(frame) = CanFrame::data_frame(id, data) {
            self.transmit(frame);
        }
    }

    /// Sends a frame, and its double.
    pub fn transmit(&mut self, frame: CanFrame) {
        let copies = if self.faults.duplicate { 2 } else { 1 };
        for _ in 0..copies {
            self.push(frame);
        }
    }

    fn push(&mut self, frame: CanFrame) {
        if self.outputs.len() < QUEUE_LIMIT {
            self.outputs.push_back(frame);
        }
    }

    /// The next frame to send; call until `None`.
    pub fn poll_output(&mut self) -> Option<CanFrame> {
        self.outputs.pop_front()
    }

    /// The earliest work; of what is due at the same time, the first of [`SlaveWork`].
    #[must_use]
    pub fn next_work(&self) -> Option<(Instant, SlaveWork)> {
        let timers = [
            (self.restart_at, SlaveWork::Restart),
            (self.foreign_stop_at, SlaveWork::ForeignStop),
            (self.foreign_guard_at, SlaveWork::ForeignGuard),
        ];
        timers.into_iter().filter_map(|(due, work)| Some((due?, work))).min_by_key(|(due, _)| *due)
    }

    /// Sends the frame of the second master that is due, once: it is nobody's double. Gives it back, because everybody on
    /// the bus sees it, this device too.
    pub fn interfere(&mut self, now: Instant, work: SlaveWork) -> Option<CanFrame> {
        let frame = match work {
            SlaveWork::Restart => None,
            SlaveWork::ForeignStop => {
                self.foreign_stop_at = Some(now + FOREIGN_STOP_PERIOD);
                Some(NmtRequest::Stop.frame(Some(self.node)))
            }
            SlaveWork::ForeignGuard => {
                self.foreign_guard_at = Some(now + FOREIGN_GUARD_PERIOD);
                CanFrame::remote_frame(cob_id::error_control(self.node), 1)
            }
        }?;
        self.push(frame);
        Some(frame)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn slave() -> Slave {
        let mut slave = Slave::new(NodeId::new(1).unwrap());
        slave.boot(Instant::START);
        slave.enter(NmtState::PreOperational);
        slave
    }

    #[test]
    fn frames_of_the_second_master_are_nobodys_double() {
        let mut slave = slave();
        let faults = SlaveFaults { second_master: true, duplicate: true, ..SlaveFaults::default() };
        slave.set_faults(Instant::START, faults);
        slave.send_boot_up();
        while let Some((_, work)) = slave.next_work().filter(|(due, _)| *due <= Instant::START) {
            slave.interfere(Instant::START, work);
        }
        let sent: Vec<_> =
            std::iter::from_fn(|| slave.poll_output()).map(|frame| frame.to_string()).collect();
        assert_eq!(sent, ["701#00", "701#00", "000#0201", "701#R1"]);
    }

    #[test]
    fn a_slave_hears_commands_to_it_and_to_all_but_not_without_power_or_while_it_starts() {
        let command = |slave: &Slave, frame: &str| slave.command(&frame.parse().unwrap());
        let mut slave = slave();
        assert_eq!(command(&slave, "000#0101"), Some(NmtRequest::Start));
        assert_eq!(command(&slave, "000#8100"), Some(NmtRequest::ResetNode));
        for frame in ["000#0102", "000#0301", "000#01", "000#010100", "001#0101", "00000000#0101"] {
            assert_eq!(command(&slave, frame), None, "{frame}");
        }
        slave.boot(Instant::START);
        assert_eq!(command(&slave, "000#0101"), None);
        slave.power_off();
        assert_eq!(command(&slave, "000#0101"), None);
    }

    #[test]
    fn a_boot_loop_is_never_faster_than_a_tenth_of_a_second_and_needs_power() {
        let mut slave = slave();
        let looping = SlaveFaults { boot_loop: Some(Duration::ZERO), ..SlaveFaults::default() };
        slave.set_faults(Instant::START, looping);
        assert_eq!(slave.next_work(), Some((Instant::from_millis(100), SlaveWork::Restart)));
        slave.power_off();
        assert_eq!(slave.next_work(), None);
    }
}
