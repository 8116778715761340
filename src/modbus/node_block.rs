//! The node block: registers 0-99 and alarm bits 128-191 of every node, the same for every device type.

use crate::mapping::{Encoding, NodeDef, Source, TagTable};
use crate::process_image::{
    AlarmIndex, AlarmState, NmtState, NodeCounters, NodeIndex, NodeStatus, Priority, ProcessImage, Quality,
    TagIndex,
};
use crate::time::{Now, Timestamp};

use super::encoding::{Cell, low_16};

/// Registers that the block takes.
pub const REGISTERS: u16 = 100;
/// First of the 32 bits that tell active alarms.
pub const ACTIVE_BITS: u16 = 128;
/// First of the 32 bits that tell unacknowledged alarms.
pub const UNACKNOWLEDGED_BITS: u16 = 160;
/// Bits that every node has at least; the device's own stand below [`ACTIVE_BITS`].
pub const BITS: u16 = 192;

/// A register of a fixed block.
#[derive(Clone, Copy, Debug)]
pub struct Row<S> {
    /// 0-based, offset not yet added.
    pub address: u16,
    /// U16 or U32 as a rule.
    pub encoding: Encoding,
    /// Name in the register map.
    pub name: &'static str,
    /// Engineering units per count.
    pub scale: f64,
    /// Engineering unit; empty for none.
    pub unit: &'static str,
    /// One sentence.
    pub description: &'static str,
    /// What it shows.
    pub show: S,
}

/// What a register of the node block shows.
#[derive(Clone, Copy, Debug)]
pub enum NodeRegister {
    /// +1 per second while the node's data is processed and fresh.
    Heartbeat,
    /// Bits 0-12.
    StatusWord,
    /// Code of the NMT state.
    NmtState,
    /// Age of the oldest process data.
    OldestAge,
    /// Age of a TPDO by its number.
    PdoAge(u16),
    /// Active alarms.
    ActiveAlarms,
    /// Unacknowledged alarms.
    UnacknowledgedAlarms,
    /// Highest priority among the active alarms.
    HighestPriority,
    /// Snapshot generation.
    Generation,
    /// A counter, low 16 bits.
    Counter(fn(&NodeCounters) -> u64),
    /// Frames received.
    FramesReceived,
    /// UTC seconds of the newest process data.
    NewestSeconds,
    /// Its milliseconds.
    NewestMillis,
    /// Whether the clock is synchronised.
    Clock,
}

const fn row(
    address: u16,
    name: &'static str,
    unit: &'static str,
    show: NodeRegister,
    description: &'static str,
) -> Row<NodeRegister> {
    Row { address, encoding: Encoding::U16, name, scale: 1.0, unit, description, show }
}

const fn double(
    address: u16,
    name: &'static str,
    unit: &'static str,
    show: NodeRegister,
    description: &'static str,
) -> Row<NodeRegister> {
    Row { encoding: Encoding::U32, ..row(address, name, unit, show, description) }
}

/// The block. What it leaves out is reserved and reads 0.
pub const NODE_BLOCK: &[Row<NodeRegister>] = &[
    row(
        0,
        "node.heartbeat",
        "",
        NodeRegister::Heartbeat,
        "Counts up by one per second while this node's data is processed and fresh",
    ),
    row(
        1,
        "node.status",
        "",
        NodeRegister::StatusWord,
        "Bit 0 online, 1 operational, 2 supervision ok, 3 all process data good, 4 an alarm active, 5 an alarm \
         unacknowledged, 6 simulated, 7 identity mismatch, 8-11 TPDO1-4 stale, 12 passive",
    ),
    row(
        2,
        "node.nmt_state",
        "",
        NodeRegister::NmtState,
        "0 boot-up, 4 stopped, 5 operational, 127 pre-operational, 65535 unknown",
    ),
    row(
        3,
        "node.oldest_age",
        "ms",
        NodeRegister::OldestAge,
        "Age of the oldest process data; 65535 = more or never",
    ),
    row(4, "node.tpdo1_age", "ms", NodeRegister::PdoAge(1), "Age of TPDO1; 65535 = more or never"),
    row(5, "node.tpdo2_age", "ms", NodeRegister::PdoAge(2), "Age of TPDO2; 65535 = more or never"),
    row(6, "node.tpdo3_age", "ms", NodeRegister::PdoAge(3), "Age of TPDO3; 65535 = more or never"),
    row(7, "node.tpdo4_age", "ms", NodeRegister::PdoAge(4), "Age of TPDO4; 65535 = more or never"),
    row(8, "node.active_alarms", "", NodeRegister::ActiveAlarms, "Active alarms of this node"),
    row(
        9,
        "node.unacknowledged_alarms",
        "",
        NodeRegister::UnacknowledgedAlarms,
        "Alarms of this node that nobody has acknowledged",
    ),
    row(
        10,
        "node.highest_priority",
        "",
        NodeRegister::HighestPriority,
        "Highest priority among the active alarms: 0 none, 1 low, 2 medium, 3 high, 4 critical",
    ),
    row(
        11,
        "node.generation",
        "",
        NodeRegister::Generation,
        "Counts up with every change of this node's data; equal before and after = nothing changed between",
    ),
    row(12, "node.restarts", "", NodeRegister::Counter(|c| c.restarts), "Restarts of the device"),
    row(
        13,
        "node.guard_misses",
        "",
        NodeRegister::Counter(|c| c.guard_misses),
        "Guard requests without a reply",
    ),
    row(
        14,
        "node.toggle_errors",
        "",
        NodeRegister::Counter(|c| c.toggle_errors),
        "Guard replies with the wrong toggle bit",
    ),
    row(
        15,
        "node.pdo_length_errors",
        "",
        NodeRegister::Counter(|c| c.pdo_length_errors),
        "TPDOs with a wrong length",
    ),
    row(
        16,
        "node.nmt_commands_sent",
        "",
        NodeRegister::Counter(|c| c.nmt_commands_sent),
        "NMT commands that the gateway sent to this node",
    ),
    row(17, "node.emcys", "", NodeRegister::Counter(|c| c.emcys), "Emergency messages"),
    row(18, "node.sdo_errors", "", NodeRegister::Counter(|c| c.sdo_errors), "SDO transfers that failed"),
    row(
        19,
        "node.unexpected_states",
        "",
        NodeRegister::Counter(|c| c.unexpected_states),
        "NMT states that were not ordered or are not defined",
    ),
    double(20, "node.frames_received", "", NodeRegister::FramesReceived, "Frames received from this node"),
    double(
        30,
        "node.data_utc_seconds",
        "s",
        NodeRegister::NewestSeconds,
        "UTC seconds since 1970 of the newest process data; 0 = never",
    ),
    row(
        32,
        "node.data_utc_milliseconds",
        "ms",
        NodeRegister::NewestMillis,
        "Milliseconds within that second",
    ),
    row(33, "node.clock", "", NodeRegister::Clock, "Bit 0: the gateway's clock is synchronised"),
];

/// One node with all that its block is computed from.
#[derive(Clone, Copy, Debug)]
pub struct NodeView<'a> {
    def: &'a NodeDef,
    status: &'a NodeStatus,
    table: &'a TagTable,
    image: &'a ProcessImage,
    now: Now,
}

impl<'a> NodeView<'a> {
    /// `None` where table and image do not have the node.
    #[must_use]
    pub fn new(table: &'a TagTable, image: &'a ProcessImage, index: NodeIndex, now: Now) -> Option<Self> {
        Some(Self { def: table.node(index)?, status: image.node(index)?, table, image, now })
    }

    /// A register of the block; `heartbeat` is the node's counter.
    #[must_use]
    pub fn register(&self, show: NodeRegister, heartbeat: u16) -> Cell {
        match show {
            NodeRegister::Heartbeat => Cell::Word(heartbeat),
            NodeRegister::StatusWord => Cell::Word(self.status_word()),
            NodeRegister::NmtState => {
                Cell::Word(self.status.nmt.map_or(u16::MAX, |state| u16::from(state.code())))
            }
            NodeRegister::OldestAge => Cell::saturated(self.oldest_age()),
            NodeRegister::PdoAge(number) => Cell::saturated(self.pdo_age(number)),
            NodeRegister::ActiveAlarms => Cell::saturated(self.alarms(AlarmState::is_active).count()),
            NodeRegister::UnacknowledgedAlarms => {
                Cell::saturated(self.alarms(AlarmState::is_unacknowledged).count())
            }
            NodeRegister::HighestPriority => Cell::Word(self.highest_priority()),
            NodeRegister::Generation => Cell::low_word(self.status.generation),
            NodeRegister::Counter(counter) => Cell::low_word(counter(&self.status.counters)),
            NodeRegister::FramesReceived => Cell::low_double(self.status.counters.frames_received),
            NodeRegister::NewestSeconds => {
                let seconds = self.status.newest_data.map_or(0, |at| at.as_secs().max(0));
                Cell::low_double(seconds.unsigned_abs())
            }
            NodeRegister::NewestMillis => {
                let millis = self.status.newest_data.map_or(0, Timestamp::subsec_millis);
                Cell::Word(low_16(millis.unsigned_abs()))
            }
            NodeRegister::Clock => Cell::Word(u16::from(self.image.clock_synchronised)),
        }
    }

    /// The bits of register 1.
    #[must_use]
    pub fn status_word(&self) -> u16 {
        let status = self.status;
        let facts = [
            status.online,
            self.is_operational(),
            status.supervised,
            self.all_data_good(),
            self.alarms(AlarmState::is_active).next().is_some(),
            self.alarms(AlarmState::is_unacknowledged).next().is_some(),
            status.simulated,
            status.identity_mismatch,
            self.pdo_is_stale(1),
            self.pdo_is_stale(2),
            self.pdo_is_stale(3),
            self.pdo_is_stale(4),
            status.passive,
        ];
        facts.into_iter().rev().fold(0, |word, fact| (word << 1) | u16::from(fact))
    }

    /// Online, operational, the right device, and all its process data good.
    #[must_use]
    pub fn is_healthy(&self) -> bool {
        self.status.online && self.is_operational() && !self.status.identity_mismatch && self.all_data_good()
    }

    /// Whether the node is there and the data of its supervised TPDOs is younger than their time-outs. Looks at ages and
    /// not at what the gateway has marked, so that it tells the truth also when the gateway itself has stopped.
    #[must_use]
    pub fn is_fresh(&self) -> bool {
        let timeouts =
            self.def.pdos().iter().enumerate().filter_map(|(place, pdo)| Some((place, pdo.timeout?)));
        self.status.online
            && timeouts.into_iter().all(|(place, timeout)| self.age(place) <= timeout.as_millis())
    }

    fn is_operational(&self) -> bool {
        self.status.nmt == Some(NmtState::Operational)
    }

    /// All that comes from the device itself, in TPDOs or by reading.
    fn all_data_good(&self) -> bool {
        let tags = self.table.tags.get(self.def.tags.clone()).unwrap_or_default();
        tags.iter().zip(self.def.tags.clone()).all(|(tag, index)| {
            matches!(tag.source, Source::Derived(_) | Source::Rpdo { .. })
                || !self.def.is_asked_for(&tag.source)
                || self.image.tag(TagIndex(index)).quality.is_good()
        })
    }

    /// The TPDO place and quality of each tag that comes from a TPDO.
    fn pdo_tags(&self) -> impl Iterator<Item = (usize, Quality)> {
        let tags = self.table.tags.get(self.def.tags.clone()).unwrap_or_default();
        tags.iter().zip(self.def.tags.clone()).filter_map(|(tag, index)| match tag.source {
            Source::Pdo { pdo, .. } => Some((pdo, self.image.tag(TagIndex(index)).quality)),
            Source::Derived(_)
            | Source::Polled { .. }
            | Source::Adopted { .. }
            | Source::Rpdo { .. }
            | Source::Emergency { .. }
            | Source::Module { .. } => None,
        })
    }

    /// A TPDO that the mapping has, and whose data is not to be used. It is enough to look at one of its tags, as all
    /// of them stand or fall together.
    fn pdo_is_stale(&self, number: u16) -> bool {
        let Some(place) = self.def.pdos().iter().position(|pdo| pdo.number == number) else {
            return false;
        };
        let status = self.status.pdos.get(place);
        let silent = status.is_none_or(|pdo| pdo.stale || pdo.last_received.is_none());
        silent
            || self.pdo_tags().find(|(pdo, _)| *pdo == place).is_some_and(|(_, quality)| !quality.is_usable())
    }

    fn oldest_age(&self) -> u128 {
        let places = 0..self.def.pdos().len();
        places.map(|place| self.age(place)).max().unwrap_or(u128::MAX)
    }

    fn pdo_age(&self, number: u16) -> u128 {
        let place = self.def.pdos().iter().position(|pdo| pdo.number == number);
        place.map_or(u128::MAX, |place| self.age(place))
    }

    fn age(&self, place: usize) -> u128 {
        let last = self.status.pdos.get(place).and_then(|pdo| pdo.last_received);
        last.map_or(u128::MAX, |last| self.now.instant.since(last).as_millis())
    }

    /// Priorities of the node's alarms whose state is such.
    fn alarms(&self, such: impl Fn(AlarmState) -> bool) -> impl Iterator<Item = Priority> {
        let defs = self.table.alarms.get(self.def.alarms.clone()).unwrap_or_default();
        defs.iter().zip(self.def.alarms.clone()).filter_map(move |(def, index)| {
            let state = self.image.alarm(AlarmIndex(index))?.state;
            such(state).then_some(def.priority)
        })
    }

    fn highest_priority(&self) -> u16 {
        self.alarms(AlarmState::is_active).map(Priority::code).max().unwrap_or(0)
    }
}
