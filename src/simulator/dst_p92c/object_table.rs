//! The object dictionary of the DST P92C as a table: every entry, its type, access, default and range. Pure.
//!
//! R-DST-008. What the guide leaves to the maker (texts, product code, span) the device fills in.

use Access::{Ro, Rw, Wo};
use Range::{Any, Between, CobId, Mapping, Only, PdoCobId, PressureDigits, PressureUnit, Special};
use Type::{F32, I16, I32, Text, U8, U16, U32};

/// Index and sub-index.
pub type Key = (u16, u8);

/// "save", as written to 0x1010/01.
pub const SAVE: u32 = 0x6576_6173;
/// "load", as written to 0x1011/01.
pub const LOAD: u32 = 0x6461_6F6C;
/// "zero", as written to 0x6125/01.
pub const ZERO: u32 = 0x6F72_657A;
/// °C, °F and K in 0x6131/02 (R-DST-029).
pub const CELSIUS: u32 = 0x002D_0000;
/// °F.
pub const FAHRENHEIT: u32 = 0x00AC_0000;
/// K.
pub const KELVIN: u32 = 0x0005_0000;

/// Type of an entry.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Type {
    /// Unsigned, 8 bit.
    U8,
    /// Unsigned, 16 bit.
    U16,
    /// Unsigned, 32 bit.
    U32,
    /// Signed, 16 bit.
    I16,
    /// Signed, 32 bit.
    I32,
    /// IEEE 754, single precision.
    F32,
    /// Visible string.
    Text,
}

impl Type {
    /// Bytes of a number; `None` for a text.
    #[must_use]
    pub const fn length(self) -> Option<usize> {
        match self {
            U8 => Some(1),
            U16 | I16 => Some(2),
            U32 | I32 | F32 => Some(4),
            Text => None,
        }
    }
}

/// What may be done with an entry (R-DST-009).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Access {
    /// Read.
    Ro,
    /// Write.
    Wo,
    /// Read and write.
    Rw,
}

/// Which numbers may be written (R-DST-011).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Range {
    /// All of the type.
    Any,
    /// These.
    Only(&'static [u32]),
    /// From the first to the second, both included.
    Between(u32, u32),
    /// An 11-bit identifier (R-DST-005).
    CobId,
    /// The same, with bit 31 (not valid) and bit 30 (no remote frames).
    PdoCobId,
    /// psi, bar or Pa, the first two with a prefix (R-DST-028, R-DST-030).
    PressureUnit,
    /// Digits that the pressure unit allows (R-DST-033).
    PressureDigits,
    /// One of the mappable objects, or none, while the PDO is off (R-DST-018, R-DST-022).
    Mapping,
    /// The number of mapped objects, and whether they fit (R-DST-019).
    Special,
}

/// An entry of the dictionary. Numbers are kept as their bits, little-endian; texts are the device's.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Entry {
    /// Where it is.
    pub key: Key,
    /// Its type.
    pub kind: Type,
    /// What may be done with it.
    pub access: Access,
    /// Its bits as it comes from the factory.
    pub default: u32,
    /// Which numbers may be written.
    pub range: Range,
}

const fn entry(index: u16, sub: u8, kind: Type, access: Access, default: u32, range: Range) -> Entry {
    Entry { key: (index, sub), kind, access, default, range }
}

/// All entries, in order.
pub const TABLE: [Entry; 102] = [
    entry(0x1000, 0, U32, Ro, 0x0002_0194, Any),
    entry(0x1001, 0, U8, Ro, 0x00, Any),
    entry(0x1003, 0, U8, Rw, 0x01, Only(&[0])),
    entry(0x1003, 1, U32, Ro, 0, Any),
    entry(0x1005, 0, U32, Rw, 0x80, CobId),
    entry(0x1008, 0, Text, Ro, 0, Any),
    entry(0x1009, 0, Text, Ro, 0, Any),
    entry(0x100A, 0, Text, Ro, 0, Any),
    entry(0x1010, 0, U8, Ro, 1, Any),
    entry(0x1010, 1, U32, Rw, 0x01, Only(&[SAVE])),
    entry(0x1011, 0, U8, Ro, 1, Any),
    entry(0x1011, 1, U32, Rw, 0x01, Only(&[LOAD])),
    entry(0x1014, 0, U32, Ro, 0x81, Any),
    entry(0x1016, 0, U8, Ro, 1, Any),
    entry(0x1016, 1, U32, Rw, 0, Any),
    entry(0x1017, 0, U16, Rw, 0, Any),
    entry(0x1018, 0, U8, Ro, 4, Any),
    entry(0x1018, 1, U32, Ro, 0x23D, Any),
    entry(0x1018, 2, U32, Ro, 0, Any),
    entry(0x1018, 3, U32, Ro, 0, Any),
    entry(0x1018, 4, U32, Ro, 0, Any),
    entry(0x1800, 0, U8, Ro, 5, Any),
    entry(0x1800, 1, U32, Rw, 0x181, PdoCobId),
    entry(0x1800, 2, U8, Rw, 0x01, Only(&[0x01, 0xFF])),
    entry(0x1800, 3, U16, Rw, 0, Any),
    entry(0x1800, 4, U8, Rw, 0, Any),
    entry(0x1800, 5, U16, Rw, 0x3E8, Any),
    entry(0x1A00, 0, U8, Rw, 2, Special),
    entry(0x1A00, 1, U32, Rw, 0x9130_0120, Mapping),
    entry(0x1A00, 2, U32, Rw, 0x6150_0108, Mapping),
    entry(0x1A00, 3, U32, Rw, 0, Mapping),
    entry(0x1A00, 4, U32, Rw, 0, Mapping),
    entry(0x1F80, 0, U32, Rw, 4, Only(&[4, 8])),
    entry(0x3000, 0, U16, Rw, 0, Any),
    entry(0x3001, 0, U16, Rw, 0, Any),
    entry(0x3002, 0, U16, Rw, 0, Any),
    entry(0x3003, 0, U16, Rw, 0, Any),
    entry(0x4E00, 0, U8, Ro, 4, Any),
    entry(0x4E00, 1, U8, Ro, 11, Any),
    entry(0x4E00, 2, U32, Ro, 223_344, Any),
    entry(0x4E00, 3, U16, Ro, 5566, Any),
    entry(0x4E00, 4, Text, Ro, 0, Any),
    entry(0x4F00, 0, U8, Rw, 4, Only(&[0, 1, 2, 3, 4, 6, 7])),
    entry(0x4F01, 0, U8, Rw, 1, Between(1, 127)),
    entry(0x6110, 0, U8, Ro, 2, Any),
    entry(0x6110, 1, U16, Ro, 0x5A, Any),
    entry(0x6110, 2, U16, Ro, 0x64, Any),
    entry(0x6124, 0, U8, Ro, 1, Any),
    entry(0x6124, 1, F32, Rw, 0, Any),
    entry(0x6125, 0, U8, Ro, 1, Any),
    entry(0x6125, 1, U32, Wo, 0, Only(&[ZERO])),
    entry(0x6130, 0, U8, Ro, 2, Any),
    entry(0x6130, 1, F32, Ro, 0, Any),
    entry(0x6130, 2, F32, Ro, 0, Any),
    entry(0x6131, 0, U8, Ro, 2, Any),
    entry(0x6131, 1, U32, Rw, 0x0022_0000, PressureUnit),
    entry(0x6131, 2, U32, Rw, 0x002D_0000, Only(&[CELSIUS, FAHRENHEIT, KELVIN])),
    entry(0x6132, 0, U8, Ro, 2, Any),
    entry(0x6132, 1, U8, Rw, 0, PressureDigits),
    entry(0x6132, 2, U8, Rw, 0, Between(0, 5)),
    entry(0x6133, 0, U8, Ro, 2, Any),
    entry(0x6133, 1, F32, Rw, 0, Any),
    entry(0x6133, 2, F32, Rw, 0, Any),
    entry(0x6135, 0, U8, Ro, 2, Any),
    entry(0x6135, 1, F32, Rw, 0x4EFF_FFFF, Any),
    entry(0x6135, 2, F32, Rw, 0x4EFF_FFFF, Any),
    entry(0x6148, 0, U8, Ro, 2, Any),
    entry(0x6148, 1, F32, Ro, 0, Any),
    entry(0x6148, 2, F32, Ro, 0, Any),
    entry(0x6149, 0, U8, Ro, 2, Any),
    entry(0x6149, 1, F32, Ro, 0, Any),
    entry(0x6149, 2, F32, Ro, 0, Any),
    entry(0x6150, 0, U8, Ro, 2, Any),
    entry(0x6150, 1, U8, Ro, 0, Any),
    entry(0x6150, 2, U8, Ro, 0, Any),
    entry(0x61A0, 0, U8, Ro, 1, Any),
    entry(0x61A0, 1, U8, Rw, 1, Between(0, 2)),
    entry(0x61A1, 0, U8, Ro, 1, Any),
    entry(0x61A1, 1, U8, Rw, 30, Any),
    entry(0x7100, 0, U8, Ro, 2, Any),
    entry(0x7100, 1, I16, Ro, 0, Any),
    entry(0x7100, 2, I16, Ro, 0, Any),
    entry(0x9124, 0, U8, Ro, 1, Any),
    entry(0x9124, 1, I32, Rw, 0, Any),
    entry(0x9130, 0, U8, Ro, 2, Any),
    entry(0x9130, 1, I32, Ro, 0, Any),
    entry(0x9130, 2, I32, Ro, 0, Any),
    entry(0x9133, 0, U8, Ro, 2, Any),
    entry(0x9133, 1, I32, Rw, 0, Any),
    entry(0x9133, 2, I32, Rw, 0, Any),
    entry(0x9134, 0, U8, Ro, 2, Any),
    entry(0x9134, 1, I32, Rw, 0x8000_0000, Any),
    entry(0x9134, 2, I32, Rw, 0x8000_0000, Any),
    entry(0x9135, 0, U8, Ro, 2, Any),
    entry(0x9135, 1, I32, Rw, 0x7FFF_FF80, Any),
    entry(0x9135, 2, I32, Rw, 0x7FFF_FF80, Any),
    entry(0x9148, 0, U8, Ro, 2, Any),
    entry(0x9148, 1, I32, Ro, 0, Any),
    entry(0x9148, 2, I32, Ro, 0, Any),
    entry(0x9149, 0, U8, Ro, 2, Any),
    entry(0x9149, 1, I32, Ro, 0, Any),
    entry(0x9149, 2, I32, Ro, 0, Any),
];

/// The entry at a place.
#[must_use]
pub fn find(key: Key) -> Option<&'static Entry> {
    TABLE.binary_search_by_key(&key, |entry| entry.key).ok().and_then(|place| TABLE.get(place))
}

/// Whether there is any entry of this index.
#[must_use]
pub fn has_object(index: u16) -> bool {
    TABLE.iter().any(|entry| entry.key.0 == index)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_table_is_in_order_so_that_entries_are_found() {
        assert!(TABLE.windows(2).all(|pair| pair[0].key < pair[1].key));
        assert!(TABLE.iter().all(|entry| find(entry.key) == Some(entry)));
        assert_eq!(find((0x1018, 5)), None);
        assert!(has_object(0x1018) && !has_object(0x6134) && !has_object(0x100C));
    }

    #[test]
    fn r_dst_008_sub_index_0_counts_the_entries_of_its_object() {
        for entry in TABLE.iter().filter(|entry| entry.key.1 == 0 && entry.kind == U8 && entry.access == Ro) {
            let highest = TABLE.iter().filter(|other| other.key.0 == entry.key.0).map(|other| other.key.1);
            let highest = u32::from(highest.max().unwrap());
            assert!(highest == entry.default || highest == 0, "{:04X}", entry.key.0);
        }
    }
}
