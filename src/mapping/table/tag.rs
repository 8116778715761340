//! Tags, and their places in the register map.

use super::{Derived, DeviceUnit};
use crate::canopen::object::ObjectId;
use crate::process_image::{NodeIndex, TagIndex, Value};

/// The word in the place of a unit that only the device knows.
pub const DEVICE_UNIT: &str = "device";

/// A tag.
#[derive(Clone, Debug, PartialEq)]
pub struct TagDef {
    /// Its node.
    pub node: NodeIndex,
    /// Unique within the node, snake case.
    pub name: String,
    /// One sentence.
    pub description: String,
    /// Engineering unit; empty for none, [`DEVICE_UNIT`] for that of the device.
    pub unit: String,
    /// Unit and decimal digits that the device tells, where it is asked for them.
    pub device_unit: Option<DeviceUnit>,
    /// Digits after the decimal point in payloads and pages.
    pub decimals: u8,
    /// Where its value comes from.
    pub source: Source,
    /// The object of the device that it is, where the mapping says so.
    pub object: Option<ObjectId>,
    /// What can be written to that object, where the mapping lets it be written by SDO.
    pub writable: Option<WriteLimits>,
    /// A bool tag of the same node that tells whether the value means anything (R-DET-086).
    pub valid: Option<TagIndex>,
    /// A bool tag of the same node that is true while the value is to be used with a reservation (R-DST-026).
    pub doubtful: Option<TagIndex>,
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
    /// An object that stands where the node itself maps it, or nowhere.
    Adopted {
        /// Which.
        object: ObjectId,
        /// How it is read where no TPDO carries it, by its place in the polls of the node's settings.
        poll: Option<usize>,
        /// How its bits are read, from the first of them on.
        field: Field,
        /// From raw to engineering units.
        scale: Scale,
    },
    /// What the emergency messages of the node told.
    Emergency {
        /// Which part of it.
        part: EmergencyPart,
        /// How its bytes are read.
        field: Field,
        /// From raw to engineering units.
        scale: Scale,
    },
    /// Bits of an RPDO: what the gateway sends the node.
    Rpdo {
        /// Which, by its place in [`NodeDef::rpdos`](super::NodeDef::rpdos).
        rpdo: usize,
        /// Which bits, and how they are written.
        field: Field,
        /// From raw to engineering units.
        scale: Scale,
        /// What can be written.
        limits: WriteLimits,
    },
    /// A value of an esd module, or of one of its serial lines.
    Module {
        /// Which, by its place: [`ModuleCarrier`](super::ModuleCarrier).
        carrier: usize,
        /// Which bits of it, and how they are read.
        field: Field,
        /// From raw to engineering units.
        scale: Scale,
    },
    /// Computed from other tags of the node.
    Derived(Derived),
}

/// What can be written to a tag, in engineering units.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct WriteLimits {
    /// What holds before anything was written; `None`: nothing is sent before.
    pub default: Option<Value>,
    /// Lowest value.
    pub minimum: f64,
    /// Highest value.
    pub maximum: f64,
}

impl WriteLimits {
    /// Whatever the type can hold, and no default.
    pub const NONE: Self = Self { default: None, minimum: f64::NEG_INFINITY, maximum: f64::INFINITY };
}

/// A part of what emergency messages tell.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum EmergencyPart {
    /// Error code of the last; 0 = none.
    Code,
    /// Error register, of the last or as it was read.
    Register,
    /// Manufacturer bytes of the last.
    Vendor,
    /// How many errors are there.
    ActiveCount,
}

impl EmergencyPart {
    /// Bits that it has.
    #[must_use]
    pub fn width(self) -> u8 {
        match self {
            Self::Code => 16,
            Self::Register | Self::ActiveCount => 8,
            Self::Vendor => 40,
        }
    }

    /// Where it begins: in the bytes of the message, but for the number of errors.
    #[must_use]
    pub fn first_bit(self) -> u8 {
        match self {
            Self::Code | Self::ActiveCount => 0,
            Self::Register => 16,
            Self::Vendor => 24,
        }
    }
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

    /// This one, and another one of what it gives.
    #[must_use]
    pub fn then(self, next: Self) -> Self {
        Self {
            multiply: self.multiply * next.multiply,
            divide: self.divide * next.divide,
            add: self.add * next.multiply / next.divide + next.add,
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
