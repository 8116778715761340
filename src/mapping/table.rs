//! The tag table: every node, tag and alarm of an installation, checked and resolved. Immutable.
//!
//! Made once from the mapping files and the installation's nodes; the gateway, the register map and the topics are
//! all built from it, so that they cannot disagree.

use std::ops::Range;
use std::time::Duration;

use super::expression::Expression;
use crate::can::BusIndex;
use crate::canopen::{NodeSettings, Role};
use crate::process_image::{NodeIndex, Priority, TagIndex};

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
}

/// A node.
#[derive(Clone, Debug, PartialEq)]
pub struct NodeDef {
    /// Its name in the configuration, part of topics.
    pub name: String,
    /// Its bus.
    pub bus: BusIndex,
    /// What the CANopen master needs to know, PDOs included.
    pub canopen: NodeSettings,
    /// The device type.
    pub device: DeviceDef,
    /// Modbus unit id, 1..=247.
    pub unit_id: u8,
    /// Added to every Modbus address.
    pub offset: u16,
    /// What Modbus shows of invalid data.
    pub on_loss: OnLoss,
    /// Publish 0 instead of the last value when a value is not usable (R-DET-084). Off unless asked for.
    pub zero_on_bad: bool,
    /// Its tags.
    pub tags: Range<usize>,
    /// Its alarms; their order is that of the bits at discrete inputs 128 and 160 ([`AlarmDef::bit`]).
    pub alarms: Range<usize>,
    /// Reserved bits of each PDO, by [`PdoIndex`](crate::canopen::PdoIndex): a set one is counted (R-DET-052).
    pub reserved_bits: Vec<u64>,
    /// How often the MQTT state topic is published.
    pub publish: PublishDef,
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

/// A tag.
#[derive(Clone, Debug, PartialEq)]
pub struct TagDef {
    /// Its node.
    pub node: NodeIndex,
    /// Unique within the node, snake case.
    pub name: String,
    /// One sentence.
    pub description: String,
    /// Engineering unit; empty for none.
    pub unit: String,
    /// Digits after the decimal point in payloads and pages.
    pub decimals: u8,
    /// Where its value comes from.
    pub source: Source,
    /// A bool tag of the same node that tells whether the value means anything (R-DET-086).
    pub valid: Option<TagIndex>,
    /// Where it stands in the register map of its unit, offset not yet added.
    pub registers: Vec<RegisterDef>,
    /// Whether it is part of the MQTT state payload.
    pub published: bool,
    /// A smaller change is not published by itself; in engineering units.
    pub deadband: f64,
}

/// Where the value of a tag comes from.
#[derive(Clone, Debug, PartialEq)]
pub enum Source {
    /// Bits of a TPDO.
    Pdo {
        /// Which, by its place in the node's settings.
        pdo: usize,
        /// Which bits, and how to read them.
        field: Field,
        /// From raw to engineering units.
        scale: Scale,
    },
    /// An object of the node that is read again and again, because no TPDO carries it.
    Polled {
        /// Which, by its place in the polls of the node's settings.
        poll: usize,
        /// How its bytes are read.
        field: Field,
        /// From raw to engineering units.
        scale: Scale,
    },
    /// Computed from other tags of the node.
    Derived(Derived),
}

/// Bits of a frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Field {
    /// Position of its lowest bit: byte b bit i = 8 b + i.
    pub bit: u8,
    /// Width in bits, 1..=64.
    pub width: u8,
    /// How the bits are read.
    pub kind: FieldKind,
    /// Most significant byte first; only for whole bytes (R-DET-050).
    pub big_endian: bool,
    /// All bits inverted before anything else (R-DET-051).
    pub invert: bool,
}

/// How bits are read.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum FieldKind {
    /// One bit.
    Bool,
    /// Without sign.
    Unsigned,
    /// Two's complement.
    Signed,
    /// IEEE 754, 32 or 64 bits.
    Float,
}

/// `value = raw * multiply / divide + add`. Kept as three numbers, so that 100/255 is exact.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Scale {
    /// Multiplied first.
    pub multiply: f64,
    /// Divided then; not zero.
    pub divide: f64,
    /// Added last.
    pub add: f64,
}

impl Scale {
    /// Raw is the value.
    pub const IDENTITY: Self = Self { multiply: 1.0, divide: 1.0, add: 0.0 };
}

/// A value computed from other tags of the same node. `among` lists name the candidates in order; `valid`, where given,
/// is a bool tag for each of them: a candidate whose tag is not true is left out.
#[derive(Clone, Debug, PartialEq)]
pub enum Derived {
    /// One bit of an unsigned tag.
    Bit {
        /// The tag.
        of: TagIndex,
        /// 0 = lowest.
        bit: u8,
    },
    /// Bool tags as the bits of a number, the first lowest.
    Pack {
        /// The tags.
        of: Vec<TagIndex>,
    },
    /// A condition.
    Logic {
        /// It.
        when: Expression,
    },
    /// The highest value.
    Maximum {
        /// Candidates.
        among: Vec<TagIndex>,
        /// Their validity.
        valid: Option<Vec<TagIndex>>,
    },
    /// Which candidate is highest: its number; that of the first among equals.
    ArgMaximum {
        /// Candidates.
        among: Vec<TagIndex>,
        /// Their validity.
        valid: Option<Vec<TagIndex>>,
        /// Their numbers, one for each.
        numbers: Vec<u16>,
    },
    /// The smallest distance up to a limit, `limit - value`; negative above it.
    Margin {
        /// Candidates.
        among: Vec<TagIndex>,
        /// Their validity.
        valid: Option<Vec<TagIndex>>,
        /// The limit.
        limit: TagIndex,
    },
    /// How many bool tags are true.
    Count {
        /// Candidates.
        of: Vec<TagIndex>,
    },
    /// Rising edges of a bool tag since the start, modulo 65,536.
    RisingEdges {
        /// The bool tag.
        of: TagIndex,
    },
    /// Seconds since the last rising edge of a bool tag; 65,535 = never, or longer ago than 65,534 s.
    SecondsSinceRise {
        /// The bool tag.
        of: TagIndex,
    },
    /// A bool tag that stays true until the node's alarms are acknowledged while the source is false.
    Latch {
        /// The bool tag.
        of: TagIndex,
    },
    /// Rising edges of a bool tag within the last `window`.
    EdgesWithin {
        /// The bool tag.
        of: TagIndex,
        /// How far back.
        window: Duration,
    },
    /// A number that the installation sets for the node, good from the start.
    Constant {
        /// It.
        value: f64,
    },
}

impl Derived {
    /// The tags that it is computed from.
    pub fn for_each_input(&self, visit: &mut impl FnMut(TagIndex)) {
        match self {
            Self::Bit { of, .. }
            | Self::RisingEdges { of }
            | Self::SecondsSinceRise { of }
            | Self::Latch { of }
            | Self::EdgesWithin { of, .. } => visit(*of),
            Self::Pack { of } | Self::Count { of } => of.iter().for_each(|tag| visit(*tag)),
            Self::Logic { when } => when.for_each_tag(visit),
            Self::Maximum { among, valid } | Self::ArgMaximum { among, valid, .. } => {
                among.iter().chain(valid.iter().flatten()).for_each(|tag| visit(*tag));
            }
            Self::Margin { among, valid, limit } => {
                among.iter().chain(valid.iter().flatten()).chain([limit]).for_each(|tag| visit(*tag));
            }
            Self::Constant { .. } => {}
        }
    }

    /// The same, to change which tags they are.
    pub fn for_each_input_mut(&mut self, visit: &mut impl FnMut(&mut TagIndex)) {
        match self {
            Self::Bit { of, .. }
            | Self::RisingEdges { of }
            | Self::SecondsSinceRise { of }
            | Self::Latch { of }
            | Self::EdgesWithin { of, .. } => visit(of),
            Self::Pack { of } | Self::Count { of } => of.iter_mut().for_each(visit),
            Self::Logic { when } => when.for_each_tag_mut(visit),
            Self::Maximum { among, valid } | Self::ArgMaximum { among, valid, .. } => {
                among.iter_mut().chain(valid.iter_mut().flatten()).for_each(visit);
            }
            Self::Margin { among, valid, limit } => {
                among.iter_mut().chain(valid.iter_mut().flatten()).chain([limit]).for_each(visit);
            }
            Self::Constant { .. } => {}
        }
    }
}

/// A place in the register map.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RegisterDef {
    /// Which space: registers (read by FC 3 and FC 4) or bits (FC 1 and FC 2).
    pub space: Space,
    /// 0-based address as on the wire, offset not yet added.
    pub address: u16,
    /// How the value is written there; [`Encoding::Bool`] in the bit space and nowhere else.
    pub encoding: Encoding,
    /// Engineering units per count, for whole-number encodings: 0.01 shows 12.34 % as 1234. 1 for the others.
    pub resolution: f64,
}

/// A Modbus address space.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Space {
    /// Input registers, and holding registers at the same address.
    Register,
    /// Discrete inputs, and coils at the same address.
    Bit,
}

/// How a value is written into registers.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Encoding {
    /// One bit.
    Bool,
    /// One register without sign, saturating; invalid 0xFFFF.
    U16,
    /// One register, two's complement, saturating; invalid 0x8000.
    I16,
    /// Two registers without sign; invalid `0xFFFF_FFFF`.
    U32,
    /// Two registers, two's complement; invalid `0x8000_0000`.
    I32,
    /// Two registers, IEEE 754; invalid NaN.
    F32,
    /// The raw value, in one register; invalid 0xFFFF.
    Raw16,
    /// The raw value, in two registers; invalid `0xFFFF_FFFF`.
    Raw32,
}

impl Encoding {
    /// Registers (or bits) that it takes.
    #[must_use]
    pub fn count(self) -> u16 {
        match self {
            Self::Bool | Self::U16 | Self::I16 | Self::Raw16 => 1,
            Self::U32 | Self::I32 | Self::F32 | Self::Raw32 => 2,
        }
    }

    /// The word in `map` and in mapping files.
    #[must_use]
    pub fn word(self) -> &'static str {
        match self {
            Self::Bool => "bool",
            Self::U16 => "u16",
            Self::I16 => "i16",
            Self::U32 => "u32",
            Self::I32 => "i32",
            Self::F32 => "f32",
            Self::Raw16 => "raw16",
            Self::Raw32 => "raw32",
        }
    }
}

/// An alarm.
#[derive(Clone, Debug, PartialEq)]
pub struct AlarmDef {
    /// Unique among the alarms of its owner, snake case, part of the topic.
    pub name: String,
    /// Whose it is.
    pub owner: AlarmOwner,
    /// When it holds.
    pub condition: AlarmCondition,
    /// How urgent.
    pub priority: Priority,
    /// The condition must hold this long.
    pub on_delay: Duration,
    /// The condition must be gone this long.
    pub off_delay: Duration,
    /// Stays until acknowledged and reset.
    pub latch: bool,
    /// Alarms that tell the cause, by their place in [`TagTable::alarms`].
    pub suppressed_by: Vec<usize>,
    /// Takes part in its owner's first-out.
    pub first_out: bool,
    /// Bit at discrete inputs 128 (active) and 160 (unacknowledged), 0..=31; alarms of one array share one bit.
    pub bit: Option<u8>,
    /// The tag whose value is shown with the alarm.
    pub value: Option<TagIndex>,
    /// What it means, one sentence.
    pub text: String,
    /// What the operator should do.
    pub action: String,
}

/// Whose an alarm is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum AlarmOwner {
    /// The gateway's own.
    Gateway,
    /// A bus's.
    Bus(BusIndex),
    /// A node's.
    Node(NodeIndex),
}

/// When an alarm holds.
#[derive(Clone, Debug, PartialEq)]
pub enum AlarmCondition {
    /// A condition on tags, from the mapping file.
    Tags(Expression),
    /// A condition that the gateway itself watches.
    BuiltIn(BuiltIn),
}

/// Conditions that the gateway watches for every bus and node, whatever the device.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum BuiltIn {
    /// G01: no MQTT session.
    MqttDown,
    /// B01: the controller is off the bus.
    BusOff,
    /// B02: the interface is missing or down.
    InterfaceDown,
    /// B03: no frame from anyone while nodes are expected.
    BusSilent,
    /// B04: error passive.
    ErrorPassive,
    /// B05: the kernel dropped frames.
    FramesLost,
    /// B06: load over 80 %.
    HighLoad,
    /// B07: an NMT command from somebody else.
    ForeignMaster,
    /// N01: guarding or heartbeat lost the node.
    NodeLost,
    /// N01, first time: no frame at all since the start (R-DET-001).
    NodeNeverSeen,
    /// N02: wrong toggle bits.
    GuardToggle,
    /// N03: this TPDO (by its place in the node's settings) is stale.
    PdoTimeout(usize),
    /// N04: started without effect, or not operational (R-DET-020).
    NotOperational,
    /// N05: restarted unasked.
    Restarted,
    /// N06: TPDO with a wrong length.
    PdoLength,
    /// N07: two nodes seem to share this id.
    DuplicateNode,
    /// R-DET-043: somebody else guards this node.
    ForeignGuardMaster,
}
