//! The tag table: every node, tag and alarm of an installation, checked and resolved. Immutable.
//!
//! Made once from the mapping files and the installation's nodes; the gateway, the register map and the topics are
//! all built from it, so that they cannot disagree.
//!
//! - `tag`: tags and their places in the register map; `writing`: which of them can be written. `device_unit`: units that the device tells.
//! - `protocol`: what a node speaks. `module`, `line`: esd modules and their serial lines.
//! - `derived`: computed tags. `alarm`: alarms. `emergency`: errors that emergency messages tell of.

mod alarm;
mod derived;
mod device_unit;
mod emergency;
mod line;
mod module;
mod protocol;
mod tag;
mod writing;

use std::collections::BTreeMap;
use std::ops::Range;
use std::time::Duration;

use crate::can::BusIndex;
use crate::canopen::{NodeSettings, OwnHeartbeatSettings, PdoSettings, Role, SyncSettings, TimeSettings};
use crate::process_image::{LineIndex, NodeIndex, TagIndex};

pub use alarm::*;
pub use derived::*;
pub use device_unit::*;
pub use emergency::*;
pub use line::*;
pub use module::*;
pub use protocol::*;
pub use tag::*;
pub use writing::*;

/// Everything that an installation has.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct TagTable {
    /// Name of the gateway, part of topics.
    pub gateway: String,
    /// By [`BusIndex`].
    pub buses: Vec<BusDef>,
    /// By [`NodeIndex`], in the order of their names.
    pub nodes: Vec<NodeDef>,
    /// By [`TagIndex`]; the tags of a node stand together, inputs of a derived tag before it.
    pub tags: Vec<TagDef>,
    /// By [`AlarmIndex`](crate::process_image::AlarmIndex): the gateway's, then the buses', then each node's; a cause before what it suppresses.
    pub alarms: Vec<AlarmDef>,
    /// By [`LineIndex`]: the serial lines of the modules that are used, those of a module together.
    pub lines: Vec<LineDef>,
}

impl TagTable {
    /// The definition of a node.
    #[must_use]
    pub fn node(&self, node: NodeIndex) -> Option<&NodeDef> {
        self.nodes.get(node.0)
    }

    /// The definition of a tag.
    #[must_use]
    pub fn tag(&self, tag: TagIndex) -> Option<&TagDef> {
        self.tags.get(tag.0)
    }

    /// Digits after the decimal point of a value that belongs to a tag; 3 where it belongs to none.
    #[must_use]
    pub fn decimals(&self, tag: Option<TagIndex>) -> u8 {
        tag.and_then(|tag| self.tag(tag)).map_or(3, |tag| tag.decimals)
    }

    /// The tag of a node by its name.
    #[must_use]
    pub fn find_tag(&self, node: NodeIndex, name: &str) -> Option<TagIndex> {
        let range = self.node(node)?.tags.clone();
        let offset = self.tags.get(range.clone())?.iter().position(|tag| tag.name == name)?;
        Some(TagIndex(range.start + offset))
    }

    /// The definition of a serial line.
    #[must_use]
    pub fn line(&self, line: LineIndex) -> Option<&LineDef> {
        self.lines.get(line.0)
    }

    /// The node of a name.
    #[must_use]
    pub fn find_node(&self, name: &str) -> Option<NodeIndex> {
        self.nodes.iter().position(|node| node.name == name).map(NodeIndex)
    }
}

/// A bus.
#[derive(Clone, Debug, PartialEq)]
pub struct BusDef {
    /// Its name in the configuration.
    pub name: String,
    /// Master or passive.
    pub role: Role,
    /// Bit rate in bit/s that the load is computed with when the interface does not tell its own (R-DET-089).
    pub bit_rate: u32,
    /// Start nodes by one broadcast (R-DET-018).
    pub start_broadcast: bool,
    /// SYNC, where the configuration tells of it.
    pub sync: Option<SyncSettings>,
    /// TIME, where the gateway sends it.
    pub time: Option<TimeSettings>,
    /// The gateway's own heartbeat, where it sends one.
    pub own_heartbeat: Option<OwnHeartbeatSettings>,
    /// What its esd modules have in common.
    pub esd: EsdBusDef,
}

impl BusDef {
    /// The gateway sends nothing there.
    #[must_use]
    pub fn is_passive(&self) -> bool {
        self.role == Role::Passive
    }
}

/// A node.
#[derive(Clone, Debug, PartialEq)]
pub struct NodeDef {
    /// Its name in the configuration, part of topics.
    pub name: String,
    /// Its bus.
    pub bus: BusIndex,
    /// What it speaks, and what its manager needs to know, PDOs included.
    pub protocol: Protocol,
    /// The device type.
    pub device: DeviceDef,
    /// Modbus unit id, 1..=247.
    pub unit_id: u8,
    /// Added to every Modbus address.
    pub offset: u16,
    /// It has to be there: that it never came is an alarm (CiA 302-2: a mandatory slave).
    pub required: bool,
    /// What Modbus shows of invalid data.
    pub on_loss: OnLoss,
    /// Publish 0 instead of the last value when a value is not usable (R-DET-084). Off unless asked for.
    pub zero_on_bad: bool,
    /// Its tags.
    pub tags: Range<usize>,
    /// Its alarms; their order is that of the bits at discrete inputs 128 and 160 ([`AlarmDef::bit`]).
    pub alarms: Range<usize>,
    /// RPDOs of its mapping, by their numbers.
    pub rpdos: Vec<RpdoDef>,
    /// The configuration allows that it is sent RPDOs: only then [`protocol`](Self::protocol) has them, at the same places.
    pub outputs: bool,
    /// Reserved bits of each PDO, by [`PdoIndex`](crate::canopen::PdoIndex): a set one is counted (R-DET-052).
    pub reserved_bits: Vec<u64>,
    /// Its errors.
    pub emergency: EmergencyDef,
    /// How often the MQTT state topic is published.
    pub publish: PublishDef,
}

impl NodeDef {
    /// Settings of a CANopen node.
    #[must_use]
    pub fn canopen(&self) -> Option<&NodeSettings> {
        self.protocol.canopen()
    }

    /// TPDOs; a module has none.
    #[must_use]
    pub fn pdos(&self) -> &[PdoSettings] {
        self.protocol.pdos()
    }

    /// Node id, or module number.
    #[must_use]
    pub fn number(&self) -> u8 {
        self.protocol.number()
    }

    /// Whether a value is asked for, or comes by itself: what a module tells of itself does not where it is not managed.
    #[must_use]
    pub fn is_asked_for(&self, source: &Source) -> bool {
        match (source, self.protocol.module()) {
            (Source::Module { carrier, .. }, Some(module)) => *carrier < ModuleCarrier::told(module),
            _ => true,
        }
    }
}

/// An RPDO of a mapping.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct RpdoDef {
    /// Its number.
    pub number: u16,
    /// When the node takes part again, what was written last is sent, not the defaults.
    pub keeps_last: bool,
}

/// A device type.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct DeviceDef {
    /// Name of the mapping, for example `motortech-detcon`.
    pub mapping: String,
    /// Maker.
    pub vendor: String,
    /// Model.
    pub model: String,
    /// One sentence.
    pub description: String,
    /// By TPDO number: bytes that it has in a device as it is shipped, where the gateway gives it another content.
    pub shipped_lengths: BTreeMap<u16, u8>,
}

/// How often the state topic of a node is published.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PublishDef {
    /// At least this long between two messages.
    pub min_interval: Duration,
    /// The same while [`fast_while`](Self::fast_while) is true.
    pub fast_interval: Duration,
    /// A bool tag that asks for the faster interval, for example "engine is knocking".
    pub fast_while: Option<TagIndex>,
    /// At most this long between two messages, change or not.
    pub max_interval: Duration,
}

/// What Modbus shows of invalid data.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum OnLoss {
    /// A value that cannot be mistaken: 0xFFFF, 0x8000, NaN.
    #[default]
    Invalid,
    /// The last value; the status word tells.
    Hold,
    /// Exception 0x0B for a range that touches invalid data.
    Exception,
}
