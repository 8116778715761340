//! What an EDS or DCF says of a device.

use std::collections::BTreeMap;

use super::number::{self, Whole};
use super::report::Place;
pub use crate::canopen::object::ObjectId;

/// A device as its EDS or DCF describes it.
#[derive(Clone, Debug, Default)]
pub struct Eds {
    /// The file's name, as the user gave it.
    pub file: String,
    /// The device.
    pub device: DeviceInfo,
    /// Its object dictionary, arrays and records taken apart.
    pub objects: BTreeMap<ObjectId, Object>,
    /// Names of arrays and records, by index.
    pub groups: BTreeMap<u16, String>,
    /// Node id of a DCF, 1..=127.
    pub node_id: Option<u8>,
    /// Bit rate of a DCF, in bit/s.
    pub bit_rate: Option<u32>,
}

/// `[DeviceInfo]` and `[FileInfo]`.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct DeviceInfo {
    /// Maker.
    pub vendor_name: String,
    /// Maker's number, as in 0x1018:1.
    pub vendor_number: Option<u32>,
    /// Product.
    pub product_name: String,
    /// Product's number, as in 0x1018:2.
    pub product_number: Option<u32>,
    /// Product's revision, as in 0x1018:3.
    pub revision_number: Option<u32>,
    /// What the file says of itself.
    pub description: String,
    /// Version of the file, `version.revision`; empty where it says none.
    pub file_version: String,
    /// Day of the last change of the file, as written there.
    pub file_date: String,
}

/// One entry of the object dictionary.
#[derive(Clone, Debug, PartialEq)]
pub struct Object {
    /// Its `ParameterName`.
    pub name: String,
    /// Its type.
    pub data_type: DataType,
    /// How it can be accessed.
    pub access: Access,
    /// Value after a start with factory settings.
    pub default: Option<Value>,
    /// Value that a DCF gives it.
    pub parameter_value: Option<Value>,
    /// Lowest value.
    pub low_limit: Option<Value>,
    /// Highest value.
    pub high_limit: Option<Value>,
    /// Whether a PDO can carry it.
    pub pdo_mapping: bool,
    /// Engineering unit, where the maker added a key for it.
    pub unit: String,
    /// Where it is described.
    pub place: Place,
}

impl Object {
    /// What it holds when the device was configured as the file says: of a DCF its value, else the default.
    #[must_use]
    pub fn value(&self) -> Option<&Value> {
        self.parameter_value.as_ref().or(self.default.as_ref())
    }

    /// The same as a whole number.
    #[must_use]
    pub fn number(&self) -> Option<Whole> {
        self.value().and_then(Value::whole)
    }
}

/// A value as it is written.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Value {
    /// The text, never empty.
    pub text: String,
    /// Where it stands.
    pub place: Place,
}

impl Value {
    /// As a whole number.
    #[must_use]
    pub fn whole(&self) -> Option<Whole> {
        number::whole(&self.text).map(|(whole, _)| whole)
    }
}

/// `AccessType`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Access {
    /// `ro`
    ReadOnly,
    /// `wo`
    WriteOnly,
    /// `rw`
    ReadWrite,
    /// `rwr`: read and write, sent in a TPDO.
    ReadWriteSent,
    /// `rww`: read and write, received in an RPDO.
    ReadWriteReceived,
    /// `const`
    Constant,
    /// Missing or unknown.
    #[default]
    Unknown,
}

impl Access {
    /// Reads the word of an EDS, in any case.
    #[must_use]
    pub fn from_word(word: &str) -> Option<Self> {
        Some(match word.to_ascii_lowercase().as_str() {
            "ro" => Self::ReadOnly,
            "wo" => Self::WriteOnly,
            "rw" => Self::ReadWrite,
            "rwr" => Self::ReadWriteSent,
            "rww" => Self::ReadWriteReceived,
            "const" => Self::Constant,
            _ => return None,
        })
    }

    /// Whether it may be written by SDO.
    #[must_use]
    pub fn is_writable(self) -> bool {
        matches!(self, Self::WriteOnly | Self::ReadWrite | Self::ReadWriteSent | Self::ReadWriteReceived)
    }

    /// Whether a TPDO may carry it: a value that the device makes, not one that is only handed to it.
    #[must_use]
    pub fn is_sent(self) -> bool {
        matches!(self, Self::ReadOnly | Self::ReadWrite | Self::ReadWriteSent)
    }
}

/// `DataType` (CiA 301, table 44).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum DataType {
    /// One bit.
    Boolean,
    /// Two's complement of so many bits.
    Integer(u8),
    /// Without sign, of so many bits.
    Unsigned(u8),
    /// IEEE 754 of 32 or 64 bits.
    Real(u8),
    /// `TIME_OF_DAY` or `TIME_DIFFERENCE`, 48 bits.
    Time,
    /// `VISIBLE_STRING`, `OCTET_STRING` or `UNICODE_STRING`.
    Text,
    /// Any amount of data.
    Domain,
    /// Another number, such as that of a record type.
    Other(u16),
    /// Missing.
    #[default]
    Unknown,
}

impl DataType {
    /// The type of a number.
    #[must_use]
    pub fn from_number(number: u16) -> Self {
        match number {
            0x01 => Self::Boolean,
            0x02 => Self::Integer(8),
            0x03 => Self::Integer(16),
            0x04 => Self::Integer(32),
            0x05 => Self::Unsigned(8),
            0x06 => Self::Unsigned(16),
            0x07 => Self::Unsigned(32),
            0x08 => Self::Real(32),
            0x09..=0x0B => Self::Text,
            0x0C | 0x0D => Self::Time,
            0x0F => Self::Domain,
            0x10 => Self::Integer(24),
            0x11 => Self::Real(64),
            0x12 => Self::Integer(40),
            0x13 => Self::Integer(48),
            0x14 => Self::Integer(56),
            0x15 => Self::Integer(64),
            0x16 => Self::Unsigned(24),
            0x18 => Self::Unsigned(40),
            0x19 => Self::Unsigned(48),
            0x1A => Self::Unsigned(56),
            0x1B => Self::Unsigned(64),
            other => Self::Other(other),
        }
    }

    /// Whether its values are numbers.
    #[must_use]
    pub fn is_number(self) -> bool {
        matches!(self, Self::Boolean | Self::Integer(_) | Self::Unsigned(_) | Self::Real(_))
    }
}
