//! Objects of an object dictionary (CiA 301): how they are named, what an entry of a PDO mapping says, and their basic
//! data types as text for the tools.

use std::fmt;
use std::str::FromStr;

mod data_type;
mod time_text;

pub use data_type::{DataType, ValueError};

/// One entry of an object dictionary: index and sub-index, written `0x1018:1`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct ObjectId {
    /// The index, 0..=0xFFFF.
    pub index: u16,
    /// The sub-index, 0..=255; 0 for an object without sub-indices.
    pub sub: u8,
}

impl ObjectId {
    /// Index and sub-index.
    #[must_use]
    pub const fn new(index: u16, sub: u8) -> Self {
        Self { index, sub }
    }
}

impl fmt::Display for ObjectId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "0x{:04X}:{}", self.index, self.sub)
    }
}

/// Why a text does not name an object.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error(
    "`{text}` does not name an object: {reason}; write index and sub-index as `0x1018:1` (index hexadecimal with 0x, \
     sub-index decimal or with 0x; `:0` where there are no sub-indices)"
)]
pub struct ParseObjectError {
    text: String,
    reason: &'static str,
}

impl FromStr for ObjectId {
    type Err = ParseObjectError;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let fail = |reason| ParseObjectError { text: text.to_owned(), reason };
        let (index, sub) = text.split_once(':').ok_or_else(|| fail("there is no `:`"))?;
        let index = hexadecimal(index).ok_or_else(|| fail("the index does not begin with 0x"))?;
        let index = digits(index, 16).ok_or_else(|| fail("the index is not 0x0 to 0xFFFF"))?;
        let sub = hexadecimal(sub).map_or_else(|| digits(sub, 10), |sub| digits(sub, 16));
        let sub = sub.and_then(|sub| u8::try_from(sub).ok());
        Ok(Self::new(index, sub.ok_or_else(|| fail("the sub-index is not 0 to 255"))?))
    }
}

/// What follows `0x`.
fn hexadecimal(text: &str) -> Option<&str> {
    text.strip_prefix("0x").or_else(|| text.strip_prefix("0X"))
}

/// A number without a sign, which `from_str_radix` would take.
fn digits(text: &str, radix: u32) -> Option<u16> {
    let plain = text.bytes().all(|byte| byte.is_ascii_alphanumeric());
    u16::from_str_radix(text, radix).ok().filter(|_| plain)
}

/// One entry of a PDO mapping (0x1600.. and 0x1A00..): an object and how many of its bits the PDO carries.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct MappedObject {
    /// The object; an index of 1..=7 is a dummy of that data type, which only fills space.
    pub object: ObjectId,
    /// Bits, 0..=255; a PDO carries 64 at most.
    pub bits: u8,
}

impl MappedObject {
    /// From the value of the entry: index << 16 | sub << 8 | bits.
    #[must_use]
    pub const fn from_entry(entry: u32) -> Self {
        let [bits, sub, low, high] = entry.to_le_bytes();
        Self { object: ObjectId::new(u16::from_le_bytes([low, high]), sub), bits }
    }

    /// The value of the entry.
    #[must_use]
    pub const fn entry(self) -> u32 {
        let [low, high] = self.object.index.to_le_bytes();
        u32::from_le_bytes([self.bits, self.object.sub, low, high])
    }
}

impl fmt::Display for MappedObject {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} ({} bit)", self.object, self.bits)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_object_survives_a_round_trip() {
        for object in [ObjectId::new(0x1018, 1), ObjectId::new(0, 0), ObjectId::new(0xFFFF, 255)] {
            assert_eq!(object.to_string().parse(), Ok(object));
        }
        assert_eq!(ObjectId::new(0x1A00, 10).to_string(), "0x1A00:10");
        assert_eq!("0x1a00:0x0A".parse(), Ok(ObjectId::new(0x1A00, 10)));
        assert_eq!("0X1:0".parse(), Ok(ObjectId::new(1, 0)));
    }

    #[test]
    fn what_names_no_object_is_refused_with_the_reason() {
        for (text, reason) in [
            ("0x1018", "no `:`"),
            ("1018:1", "begin with 0x"),
            ("1018h:1", "begin with 0x"),
            ("0x:1", "0x0 to 0xFFFF"),
            ("0x10000:1", "0x0 to 0xFFFF"),
            ("0x+1:1", "0x0 to 0xFFFF"),
            ("0x1018:", "0 to 255"),
            ("0x1018:256", "0 to 255"),
            ("0x1018:-1", "0 to 255"),
            ("0x1018:+1", "0 to 255"),
            ("0x1018:0x100", "0 to 255"),
            ("0x1018:1:2", "0 to 255"),
        ] {
            let error = text.parse::<ObjectId>().unwrap_err().to_string();
            assert!(error.contains(reason), "{error}");
            assert!(error.contains("0x1018:1"), "a hint: {error}");
        }
    }

    #[test]
    fn v_dst_15_mapping_entries() {
        for (entry, object, bits) in
            [(0x6130_0120, "0x6130:1", 32), (0x9130_0220, "0x9130:2", 32), (0x6150_0108, "0x6150:1", 8)]
        {
            let mapped = MappedObject::from_entry(entry);
            assert_eq!((mapped.object, mapped.bits), (object.parse().unwrap(), bits));
            assert_eq!(mapped.entry(), entry);
        }
        assert_eq!(MappedObject::from_entry(0x6130_0120).to_string(), "0x6130:1 (32 bit)");
    }
}
