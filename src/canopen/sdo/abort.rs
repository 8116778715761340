//! Abort codes of SDO transfers (CiA 301, 7.2.4.3.17).

use std::fmt;

/// Why a transfer was aborted, as the one who aborts it says.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct AbortCode(pub u32);

impl AbortCode {
    /// The toggle bit did not alternate.
    pub const TOGGLE: Self = Self(0x0503_0000);
    /// The other side did not go on in time.
    pub const TIMEOUT: Self = Self(0x0504_0000);
    /// The command specifier is unknown, or not valid here.
    pub const COMMAND: Self = Self(0x0504_0001);
    /// The block size is not 1..=127.
    pub const BLOCK_SIZE: Self = Self(0x0504_0002);
    /// The sequence number is not valid.
    pub const SEQUENCE: Self = Self(0x0504_0003);
    /// The check sum of a block transfer differs.
    pub const CRC: Self = Self(0x0504_0004);
    /// The value is too long for this side.
    pub const OUT_OF_MEMORY: Self = Self(0x0504_0005);
    /// The object cannot be accessed in this way.
    pub const UNSUPPORTED_ACCESS: Self = Self(0x0601_0000);
    /// The length of the data does not match.
    pub const LENGTH: Self = Self(0x0607_0010);
    /// The length of the data is too high.
    pub const TOO_LONG: Self = Self(0x0607_0012);
    /// Any other reason.
    pub const GENERAL: Self = Self(0x0800_0000);

    /// What CiA 301 says about the code; `None` for codes that it does not list.
    #[must_use]
    pub const fn name(self) -> Option<&'static str> {
        Some(match self.0 {
            0x0503_0000 => "toggle bit not alternated",
            0x0504_0000 => "SDO protocol timed out",
            0x0504_0001 => "command specifier not valid or unknown",
            0x0504_0002 => "invalid block size",
            0x0504_0003 => "invalid sequence number",
            0x0504_0004 => "CRC error",
            0x0504_0005 => "out of memory",
            0x0601_0000 => "unsupported access to an object",
            0x0601_0001 => "attempt to read a write-only object",
            0x0601_0002 => "attempt to write a read-only object",
            0x0602_0000 => "object does not exist",
            0x0604_0041 => "object cannot be mapped to the PDO",
            0x0604_0042 => "mapped objects would exceed the PDO length",
            0x0604_0043 => "general parameter incompatibility",
            0x0604_0047 => "general internal incompatibility in the device",
            0x0606_0000 => "access failed due to a hardware error",
            0x0607_0010 => "length of the data does not match",
            0x0607_0012 => "length of the data too high",
            0x0607_0013 => "length of the data too low",
            0x0609_0011 => "sub-index does not exist",
            0x0609_0030 => "value range exceeded",
            0x0609_0031 => "value too high",
            0x0609_0032 => "value too low",
            0x0609_0036 => "maximum value is less than minimum value",
            0x060A_0023 => "resource not available: SDO connection",
            0x0800_0000 => "general error",
            0x0800_0020 => "data cannot be transferred or stored",
            0x0800_0021 => "data cannot be transferred or stored because of local control",
            0x0800_0022 => "data cannot be transferred or stored because of the present device state",
            0x0800_0023 => "no object dictionary present",
            0x0800_0024 => "no data available",
            _ => return None,
        })
    }

    /// Whether the value was refused for its range (R-DST-011: devices differ in which of the three they say).
    #[must_use]
    pub const fn is_range(self) -> bool {
        matches!(self.0, 0x0609_0030..=0x0609_0032)
    }

    /// Whether it says that there is no such object or sub-index.
    #[must_use]
    pub const fn is_missing(self) -> bool {
        matches!(self.0, 0x0602_0000 | 0x0609_0011)
    }
}

impl fmt::Display for AbortCode {
    /// `0x06020000, object does not exist`; codes that are not listed in hexadecimal alone (R-DST-069).
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "0x{:08X}", self.0)?;
        self.name().map_or(Ok(()), |name| write!(f, ", {name}"))
    }
}

impl fmt::Debug for AbortCode {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "0x{:08X}", self.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn r_dst_068_the_codes_of_the_manual_have_names() {
        for code in [
            0x0601_0001,
            0x0601_0002,
            0x0602_0000,
            0x0604_0041,
            0x0604_0042,
            0x0604_0043,
            0x0606_0000,
            0x0607_0012,
            0x0607_0013,
            0x0609_0011,
            0x0609_0030,
            0x0609_0031,
            0x0609_0032,
        ] {
            assert!(AbortCode(code).name().is_some(), "{code:08X}");
        }
        assert_eq!(AbortCode(0x0602_0000).to_string(), "0x06020000, object does not exist");
    }

    #[test]
    fn r_dst_069_other_codes_are_shown_in_hex() {
        assert_eq!(AbortCode(0x1234_ABCD).to_string(), "0x1234ABCD");
    }

    #[test]
    fn r_dst_011_the_three_range_codes_are_alike() {
        assert!([0x0609_0030, 0x0609_0031, 0x0609_0032].into_iter().all(|code| AbortCode(code).is_range()));
        assert!(!AbortCode(0x0609_0011).is_range());
    }
}
