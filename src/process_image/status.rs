//! What readers see of nodes, buses and alarms, beside the tags.

use super::{ErrorLog, FrameCounts, NmtState, Revision, Value};
use crate::time::{Instant, Timestamp};

/// What is known of one node.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct NodeStatus {
    /// Seen, and not lost since.
    pub online: bool,
    /// Why it is not online, or not operational, in words for the operator; empty when all is well.
    pub reason: String,
    /// The NMT state that it reported last; `None` before the first and while it is not online.
    pub nmt: Option<NmtState>,
    /// Guarding or heartbeat is configured and answered in time.
    pub supervised: bool,
    /// Device type or identity is not the configured one.
    pub identity_mismatch: bool,
    /// It need not be there, and has not come since the gateway started.
    pub may_be_absent: bool,
    /// Sends data that a simulator made up.
    pub simulated: bool,
    /// The gateway sends nothing to this node's bus.
    pub passive: bool,
    /// All values that the device sends are good.
    pub data_good: bool,
    /// One entry for each TPDO of the mapping, in its order.
    pub pdos: Vec<PdoStatus>,
    /// What it told of its errors.
    pub errors: ErrorLog,
    /// Counters since the start of the gateway.
    pub counters: NodeCounters,
    /// UTC of the newest process data.
    pub newest_data: Option<Timestamp>,
    /// Counts up with every change of this node's data: a reader of several blocks can see that they belong together.
    pub generation: u64,
    /// When anything of this node changed last, but for the counters and times that move with every frame.
    pub revision: Revision,
}

impl NodeStatus {
    /// Copies a newer status. Where more changed than what moves with every frame, `revision` is noted and the answer
    /// is `true`. Allocates nothing unless the reason is another.
    pub fn update(&mut self, newer: &Self, revision: Revision) -> bool {
        // What moves with every frame is taken over first: what differs after that is news.
        self.counters.frames_received = newer.counters.frames_received;
        self.newest_data = newer.newest_data;
        for (shown, newer) in self.pdos.iter_mut().zip(&newer.pdos) {
            shown.last_received = newer.last_received;
            shown.received = newer.received;
        }
        let before = std::mem::replace(&mut self.revision, newer.revision);
        if *self == *newer {
            self.revision = before;
            return false;
        }
        let (mut reason, mut pdos) = (std::mem::take(&mut self.reason), std::mem::take(&mut self.pdos));
        let mut errors = std::mem::take(&mut self.errors);
        reason.clone_from(&newer.reason);
        pdos.clone_from(&newer.pdos);
        errors.copy_from(&newer.errors);
        *self = Self { reason, pdos, errors, revision, ..*newer };
        true
    }
}

/// What is known of one TPDO.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct PdoStatus {
    /// TPDO number, 1-based.
    pub number: u16,
    /// When it was last received with a usable length.
    pub last_received: Option<Instant>,
    /// Did not come in time while it was expected.
    pub stale: bool,
    /// What it carried last may still be used: neither too old, nor spoilt by what happened to its node or bus since.
    pub usable: bool,
    /// Times received with a usable length.
    pub received: u64,
}

/// Counters of one node. All saturate; Modbus shows the low 16 bits of most.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct NodeCounters {
    /// Boot-up messages after the first contact.
    pub restarts: u64,
    /// Guard requests without a reply in time.
    pub guard_misses: u64,
    /// Guard replies with the wrong toggle bit.
    pub toggle_errors: u64,
    /// TPDOs too short or too long.
    pub pdo_length_errors: u64,
    /// NMT commands that the gateway sent to this node.
    pub nmt_commands_sent: u64,
    /// Emergency messages.
    pub emcys: u64,
    /// SDO transfers that failed.
    pub sdo_errors: u64,
    /// Reported states that were not ordered, or not defined, and TPDOs in a state that has none.
    pub unexpected_states: u64,
    /// Guard replies with a wrong length, or remote and 29-bit frames on this node's identifiers.
    pub malformed: u64,
    /// Frames with a bit set that the mapping calls reserved.
    pub reserved_bits: u64,
    /// Synchronous TPDOs that came after the window of SYNC (R-ESD-115).
    pub late_pdos: u64,
    /// All frames received from this node.
    pub frames_received: u64,
}

impl NodeCounters {
    /// Each counter with its name in payloads and pages, and a sentence.
    #[must_use]
    pub fn named(&self) -> [(&'static str, &'static str, u64); 12] {
        [
            ("frames_received", "Frames received from the node", self.frames_received),
            ("restarts", "Boot-up messages after the first contact", self.restarts),
            ("guard_misses", "Guard requests without a reply in time", self.guard_misses),
            ("toggle_errors", "Guard replies with the wrong toggle bit", self.toggle_errors),
            ("pdo_length_errors", "TPDOs too short or too long", self.pdo_length_errors),
            ("nmt_commands_sent", "NMT commands sent to the node", self.nmt_commands_sent),
            ("emcys", "Emergency messages", self.emcys),
            ("sdo_errors", "SDO transfers that failed", self.sdo_errors),
            ("unexpected_states", "States that were not ordered", self.unexpected_states),
            ("malformed", "Frames that cannot be right", self.malformed),
            ("reserved_bits", "Frames with a reserved bit set", self.reserved_bits),
            ("late_pdos", "Synchronous TPDOs after the window of SYNC", self.late_pdos),
        ]
    }
}

/// What is known of one bus.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct BusStatus {
    /// State of the interface and its controller.
    pub state: BusState,
    /// Bus load in 0.1 % over the last second; `None` where the bit rate is unknown.
    pub load_permille: Option<u16>,
    /// Frames per second, received and sent.
    pub frames_per_second: u32,
    /// Frames received since the start.
    pub frames_received: u64,
    /// Frames sent since the start.
    pub frames_sent: u64,
    /// Frames that could not be sent.
    pub frames_not_sent: u64,
    /// Error frames since the start.
    pub errors: u64,
    /// Times bus-off.
    pub bus_off_count: u64,
    /// Frames that the kernel dropped.
    pub overruns: u64,
    /// Frames of identifiers that belong to no configured node, FD and 29-bit frames (R-DET-006).
    pub foreign_frames: u64,
    /// Frames handed to the bus, by kind. Not all of them left: see [`frames_not_sent`](Self::frames_not_sent).
    pub sent: FrameCounts,
    /// Frames that the gateway made and the configuration does not allow: they were dropped. A bug of ours.
    pub frames_blocked: u64,
}

impl BusStatus {
    /// Each counter with its name in payloads and pages, and a sentence.
    #[must_use]
    pub fn named(&self) -> [(&'static str, &'static str, u64); 7] {
        [
            ("frames_received", "Frames received", self.frames_received),
            ("frames_sent", "Frames sent", self.frames_sent),
            ("frames_not_sent", "Frames that could not be sent", self.frames_not_sent),
            ("errors", "Error frames", self.errors),
            ("bus_off_count", "Times that the controller went bus-off", self.bus_off_count),
            ("overruns", "Frames that the kernel dropped", self.overruns),
            ("foreign_frames", "Frames that belong to no configured node", self.foreign_frames),
        ]
    }
}

/// State of a bus as readers see it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord)]
pub enum BusState {
    /// No such interface.
    #[default]
    Absent,
    /// Interface down.
    Down,
    /// Controller off the bus.
    BusOff,
    /// Working with many errors.
    ErrorPassive,
    /// Working.
    ErrorActive,
}

impl BusState {
    /// The number in the gateway's register block: 0 absent, 1 down, 2 bus-off, 3 error passive, 4 error active.
    #[must_use]
    pub fn code(self) -> u16 {
        match self {
            Self::Absent => 0,
            Self::Down => 1,
            Self::BusOff => 2,
            Self::ErrorPassive => 3,
            Self::ErrorActive => 4,
        }
    }

    /// The word in payloads, events and pages.
    #[must_use]
    pub fn word(self) -> &'static str {
        match self {
            Self::Absent => "absent",
            Self::Down => "down",
            Self::BusOff => "bus_off",
            Self::ErrorPassive => "error_passive",
            Self::ErrorActive => "error_active",
        }
    }
}

/// Priority of an alarm (ISA-18.2); the number is that of the node block's register.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Priority {
    /// 1
    Low,
    /// 2
    Medium,
    /// 3
    High,
    /// 4
    Critical,
}

impl Priority {
    /// 1 low .. 4 critical.
    #[must_use]
    pub fn code(self) -> u16 {
        match self {
            Self::Low => 1,
            Self::Medium => 2,
            Self::High => 3,
            Self::Critical => 4,
        }
    }

    /// The word in payloads, events and pages.
    #[must_use]
    pub fn word(self) -> &'static str {
        match self {
            Self::Low => "low",
            Self::Medium => "medium",
            Self::High => "high",
            Self::Critical => "critical",
        }
    }
}

/// State of an alarm (ISA-18.2, IEC 62682).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum AlarmState {
    /// A: nothing to tell.
    #[default]
    Normal,
    /// B: active, nobody has acknowledged it.
    Unacknowledged,
    /// C: active, acknowledged.
    Acknowledged,
    /// D: came and went, nobody has acknowledged it.
    ReturnedUnacknowledged,
    /// E: a latching alarm whose cause has gone, not acknowledged.
    LatchedUnacknowledged,
    /// F: a latching alarm whose cause has gone, acknowledged, waits for a reset.
    LatchedAcknowledged,
    /// G: put aside by an operator until a set time.
    Shelved,
    /// H: suppressed by design, because another alarm tells the cause.
    Suppressed,
    /// I: out of service.
    OutOfService,
}

impl AlarmState {
    /// The word in payloads, events and pages.
    #[must_use]
    pub fn word(self) -> &'static str {
        match self {
            Self::Normal => "normal",
            Self::Unacknowledged => "unacknowledged",
            Self::Acknowledged => "acknowledged",
            Self::ReturnedUnacknowledged => "returned_unacknowledged",
            Self::LatchedUnacknowledged => "latched_unacknowledged",
            Self::LatchedAcknowledged => "latched_acknowledged",
            Self::Shelved => "shelved",
            Self::Suppressed => "suppressed",
            Self::OutOfService => "out_of_service",
        }
    }

    /// The number in the event ring: 0 normal .. 8 out of service, in the order of this enum.
    #[must_use]
    pub fn code(self) -> u16 {
        match self {
            Self::Normal => 0,
            Self::Unacknowledged => 1,
            Self::Acknowledged => 2,
            Self::ReturnedUnacknowledged => 3,
            Self::LatchedUnacknowledged => 4,
            Self::LatchedAcknowledged => 5,
            Self::Shelved => 6,
            Self::Suppressed => 7,
            Self::OutOfService => 8,
        }
    }

    /// Counts as active for readers: its condition holds, or it is latched.
    #[must_use]
    pub fn is_active(self) -> bool {
        matches!(
            self,
            Self::Unacknowledged
                | Self::Acknowledged
                | Self::LatchedUnacknowledged
                | Self::LatchedAcknowledged
        )
    }

    /// Waits for an acknowledgement.
    #[must_use]
    pub fn is_unacknowledged(self) -> bool {
        matches!(self, Self::Unacknowledged | Self::ReturnedUnacknowledged | Self::LatchedUnacknowledged)
    }
}

/// What is known of one alarm.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct AlarmStatus {
    /// Its state.
    pub state: AlarmState,
    /// When the state was entered; `None` while it never left normal.
    pub since: Option<Timestamp>,
    /// Times raised since the start.
    pub count: u64,
    /// It was the first of its group to be raised since the group was last quiet.
    pub first_out: bool,
    /// The value that raised it, where the condition has one; of an alarm for errors of a device the code of one that is
    /// there now, or was there last.
    pub value: Option<Value>,
    /// When it changed last.
    pub revision: Revision,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_moves_with_every_frame_is_copied_and_is_no_news() {
        let mut shown = NodeStatus { pdos: vec![PdoStatus::default(); 2], ..NodeStatus::default() };
        let mut newer = shown.clone();
        newer.counters.frames_received = 7;
        newer.newest_data = Some(Timestamp::from_millis(5));
        newer.pdos[1] = PdoStatus { last_received: Some(Instant::START), received: 3, ..newer.pdos[1] };
        assert!(!shown.update(&newer, Revision(1)));
        assert_eq!(shown, newer);
        newer.data_good = true;
        assert!(shown.update(&newer, Revision(2)));
        assert_eq!(shown, NodeStatus { revision: Revision(2), ..newer });
    }

    #[test]
    fn of_any_number_of_tpdos_each_is_looked_at() {
        let mut shown = NodeStatus { pdos: vec![PdoStatus::default(); 512], ..NodeStatus::default() };
        for place in [0, 63, 64, 511] {
            let mut newer = shown.clone();
            newer.pdos[place].stale = true;
            assert!(shown.update(&newer, Revision(1)), "TPDO{}", place + 1);
        }
    }
}
