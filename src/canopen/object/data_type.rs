//! The basic data types of CiA 301, between the bytes of an object and the text that a tool shows or takes.

use std::fmt;
use std::str::FromStr;

use super::hexadecimal;
use super::time_text;

/// A basic data type of CiA 301.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum DataType {
    /// One byte, 0 or 1.
    Bool,
    /// Signed, 1 byte.
    I8,
    /// Signed, 2 bytes.
    I16,
    /// Signed, 3 bytes.
    I24,
    /// Signed, 4 bytes.
    I32,
    /// Signed, 5 bytes.
    I40,
    /// Signed, 6 bytes.
    I48,
    /// Signed, 7 bytes.
    I56,
    /// Signed, 8 bytes.
    I64,
    /// Unsigned, 1 byte.
    U8,
    /// Unsigned, 2 bytes.
    U16,
    /// Unsigned, 3 bytes.
    U24,
    /// Unsigned, 4 bytes.
    U32,
    /// Unsigned, 5 bytes.
    U40,
    /// Unsigned, 6 bytes.
    U48,
    /// Unsigned, 7 bytes.
    U56,
    /// Unsigned, 8 bytes.
    U64,
    /// IEEE 754 single.
    F32,
    /// IEEE 754 double.
    F64,
    /// Text: ASCII by the standard, Latin-1 in many devices.
    VisibleString,
    /// Any bytes.
    OctetString,
    /// UTF-16, little-endian.
    UnicodeString,
    /// Milliseconds since midnight and days since 1984-01-01; 6 bytes.
    TimeOfDay,
    /// Milliseconds and days; 6 bytes.
    TimeDifference,
    /// Any bytes, mostly a file.
    Domain,
}

/// Each type, its code in an object dictionary, our word, and the word of CiA 309-3.
const TYPES: [(DataType, u16, &str, &str); 25] = [
    (DataType::Bool, 0x01, "bool", "b"),
    (DataType::I8, 0x02, "i8", "i8"),
    (DataType::I16, 0x03, "i16", "i16"),
    (DataType::I32, 0x04, "i32", "i32"),
    (DataType::U8, 0x05, "u8", "u8"),
    (DataType::U16, 0x06, "u16", "u16"),
    (DataType::U32, 0x07, "u32", "u32"),
    (DataType::F32, 0x08, "f32", "r32"),
    (DataType::VisibleString, 0x09, "string", "vs"),
    (DataType::OctetString, 0x0A, "octets", "os"),
    (DataType::UnicodeString, 0x0B, "unicode", "us"),
    (DataType::TimeOfDay, 0x0C, "time_of_day", "t"),
    (DataType::TimeDifference, 0x0D, "time_difference", "td"),
    (DataType::Domain, 0x0F, "domain", "d"),
    (DataType::I24, 0x10, "i24", "i24"),
    (DataType::F64, 0x11, "f64", "r64"),
    (DataType::I40, 0x12, "i40", "i40"),
    (DataType::I48, 0x13, "i48", "i48"),
    (DataType::I56, 0x14, "i56", "i56"),
    (DataType::I64, 0x15, "i64", "i64"),
    (DataType::U24, 0x16, "u24", "u24"),
    (DataType::U40, 0x18, "u40", "u40"),
    (DataType::U48, 0x19, "u48", "u48"),
    (DataType::U56, 0x1A, "u56", "u56"),
    (DataType::U64, 0x1B, "u64", "u64"),
];

/// Why bytes or a text are not a value of a data type.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum ValueError {
    /// The number of bytes is not that of the type.
    #[error("{len} bytes are no {data_type}, which has {size}; is the object of another type?")]
    Length {
        /// The type.
        data_type: DataType,
        /// Its size in bytes.
        size: usize,
        /// What there was, in bytes.
        len: usize,
    },
    /// The text cannot be read.
    #[error("`{text}` is no {data_type}: write {hint}")]
    Text {
        /// The type.
        data_type: DataType,
        /// What was given.
        text: String,
        /// What is expected.
        hint: &'static str,
    },
    /// The number does not fit.
    #[error("{text} does not fit into {data_type}: it takes {low} to {high}")]
    Range {
        /// The type.
        data_type: DataType,
        /// What was given.
        text: String,
        /// The least value.
        low: i128,
        /// The greatest value.
        high: i128,
    },
}

/// Why a word is not a data type.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error(
    "`{0}` is not a data type; there are bool, i8 to i64, u8 to u64, f32, f64, string, unicode, octets, domain, \
     time_of_day and time_difference"
)]
pub struct ParseDataTypeError(String);

impl DataType {
    /// From the code that an object dictionary or an EDS gives it, 0x0001..=0x001B; `None` for structures, reserved and
    /// manufacturers' types.
    #[must_use]
    pub fn from_code(code: u16) -> Option<Self> {
        TYPES.iter().find(|entry| entry.1 == code).map(|entry| entry.0)
    }

    /// From a type word of CiA 309-3: `b`, `u16`, `r32`, `vs`. Its `x8` to `x64` are a notation of the unsigned types, and
    /// not known here.
    #[must_use]
    pub fn from_cia309(word: &str) -> Option<Self> {
        TYPES.iter().find(|entry| entry.3 == word).map(|entry| entry.0)
    }

    /// The code in an object dictionary.
    #[must_use]
    pub fn code(self) -> u16 {
        TYPES.iter().find(|entry| entry.0 == self).map_or(0x0F, |entry| entry.1)
    }

    /// The word in files and on the command line: `u16`, `f32`, `string`.
    #[must_use]
    pub fn word(self) -> &'static str {
        TYPES.iter().find(|entry| entry.0 == self).map_or("domain", |entry| entry.2)
    }

    /// How many bytes it has; `None`: any number.
    #[must_use]
    pub const fn size(self) -> Option<usize> {
        match self {
            Self::Bool | Self::I8 | Self::U8 => Some(1),
            Self::I16 | Self::U16 => Some(2),
            Self::I24 | Self::U24 => Some(3),
            Self::I32 | Self::U32 | Self::F32 => Some(4),
            Self::I40 | Self::U40 => Some(5),
            Self::I48 | Self::U48 | Self::TimeOfDay | Self::TimeDifference => Some(6),
            Self::I56 | Self::U56 => Some(7),
            Self::I64 | Self::U64 | Self::F64 => Some(8),
            Self::VisibleString | Self::OctetString | Self::UnicodeString | Self::Domain => None,
        }
    }

    const fn is_signed(self) -> bool {
        matches!(
            self,
            Self::I8 | Self::I16 | Self::I24 | Self::I32 | Self::I40 | Self::I48 | Self::I56 | Self::I64
        )
    }

    /// The bytes of an object as text: numbers decimal, bytes as pairs of hexadecimal digits, times as
    /// `2026-01-31 12:00:00.000` and `3 12:00:00.000` (days first). Control characters of a string appear as `\x1B` and a
    /// backslash as `\\`, so that no device can steer a terminal; NULs at its end are left away.
    pub fn decode(self, bytes: &[u8]) -> Result<String, ValueError> {
        if let Some(size) = self.size().filter(|size| *size != bytes.len()) {
            return Err(ValueError::Length { data_type: self, size, len: bytes.len() });
        }
        Ok(match self {
            Self::Bool => (bytes != [0]).to_string(),
            Self::F32 => f32::from_bits(u32::try_from(unsigned(bytes)).unwrap_or_default()).to_string(),
            Self::F64 => f64::from_bits(unsigned(bytes)).to_string(),
            Self::VisibleString => escape(bytes.iter().map(|byte| char::from(*byte))),
            Self::UnicodeString => {
                let units = bytes.chunks(2).map(|pair| u16::try_from(unsigned(pair)).unwrap_or_default());
                escape(char::decode_utf16(units).map(|unit| unit.unwrap_or(char::REPLACEMENT_CHARACTER)))
            }
            Self::OctetString | Self::Domain => {
                bytes.iter().map(|byte| format!("{byte:02X}")).collect::<Vec<_>>().concat()
            }
            Self::TimeOfDay => time_text::time_of_day(unsigned(bytes)),
            Self::TimeDifference => time_text::time_difference(unsigned(bytes)),
            Self::I8
            | Self::I16
            | Self::I24
            | Self::I32
            | Self::I40
            | Self::I48
            | Self::I56
            | Self::I64
            | Self::U8
            | Self::U16
            | Self::U24
            | Self::U32
            | Self::U40
            | Self::U48
            | Self::U56
            | Self::U64 => self.integer(bytes).to_string(),
        })
    }

    /// The bytes of an object from a text such as [`decode`](Self::decode) gives; integers also as `0x1F`, bytes also with
    /// spaces between them.
    pub fn encode(self, text: &str) -> Result<Vec<u8>, ValueError> {
        let fail = |hint| ValueError::Text { data_type: self, text: text.to_owned(), hint };
        match self {
            Self::Bool => match text {
                "true" | "1" => Ok(vec![1]),
                "false" | "0" => Ok(vec![0]),
                _ => Err(fail("`true` or `false`")),
            },
            Self::F32 => {
                let value: f32 = text.parse().map_err(|_| fail("a number such as `1.5`"))?;
                Ok(value.to_le_bytes().to_vec())
            }
            Self::F64 => {
                let value: f64 = text.parse().map_err(|_| fail("a number such as `1.5`"))?;
                Ok(value.to_le_bytes().to_vec())
            }
            Self::VisibleString => {
                let characters = unescape(text).ok_or_else(|| fail("a backslash as `\\\\` or `\\x5C`"))?;
                let latin_1 = characters.into_iter().map(|character| u8::try_from(u32::from(character)).ok());
                latin_1.collect::<Option<_>>().ok_or_else(|| fail("characters of Latin-1 only"))
            }
            Self::UnicodeString => {
                let characters = unescape(text).ok_or_else(|| fail("a backslash as `\\\\` or `\\x5C`"))?;
                let text: String = characters.into_iter().collect();
                Ok(text.encode_utf16().flat_map(u16::to_le_bytes).collect())
            }
            Self::OctetString | Self::Domain => {
                octets(text).ok_or_else(|| fail("pairs of hexadecimal digits, as `0A1B`"))
            }
            Self::TimeOfDay => time_text::parse_time_of_day(text)
                .map(|bytes| bytes.to_vec())
                .ok_or_else(|| fail("`2026-01-31 12:00:00.000`, from 1984-01-01 to 2163-06-06")),
            Self::TimeDifference => time_text::parse_time_difference(text)
                .map(|bytes| bytes.to_vec())
                .ok_or_else(|| fail("days and time, as `3 12:00:00.000`")),
            Self::I8
            | Self::I16
            | Self::I24
            | Self::I32
            | Self::I40
            | Self::I48
            | Self::I56
            | Self::I64
            | Self::U8
            | Self::U16
            | Self::U24
            | Self::U32
            | Self::U40
            | Self::U48
            | Self::U56
            | Self::U64 => self.encode_integer(text),
        }
    }

    fn encode_integer(self, text: &str) -> Result<Vec<u8>, ValueError> {
        let (negative, digits) = text.strip_prefix('-').map_or((false, text), |digits| (true, digits));
        let (digits, radix) = hexadecimal(digits).map_or((digits, 10), |digits| (digits, 16));
        let number = Some(digits)
            .filter(|digits| digits.bytes().all(|byte| byte.is_ascii_alphanumeric()))
            .and_then(|digits| i128::from_str_radix(digits, radix).ok());
        let hint = "a whole number, as `100` or `0x64`";
        let fail = || ValueError::Text { data_type: self, text: text.to_owned(), hint };
        let number = number.ok_or_else(fail)?;
        let number = if negative { -number } else { number };
        let size = self.size().unwrap_or_default();
        let span = 1_i128 << (8 * size);
        let (low, high) = if self.is_signed() { (-span / 2, span / 2 - 1) } else { (0, span - 1) };
        if number < low || number > high {
            return Err(ValueError::Range { data_type: self, text: text.to_owned(), low, high });
        }
        Ok(number.to_le_bytes().get(..size).unwrap_or_default().to_vec())
    }

    fn integer(self, bytes: &[u8]) -> i128 {
        let value = i128::from(unsigned(bytes));
        let span = 1_i128 << (8 * bytes.len().min(8));
        if self.is_signed() && value >= span / 2 { value - span } else { value }
    }
}

impl fmt::Display for DataType {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.word())
    }
}

impl FromStr for DataType {
    type Err = ParseDataTypeError;

    fn from_str(word: &str) -> Result<Self, Self::Err> {
        let entry = TYPES.iter().find(|entry| entry.2 == word);
        entry.map(|entry| entry.0).ok_or_else(|| ParseDataTypeError(word.to_owned()))
    }
}

/// Up to eight bytes, little-endian.
fn unsigned(bytes: &[u8]) -> u64 {
    bytes.iter().take(8).rev().fold(0, |value, byte| value << 8 | u64::from(*byte))
}

fn escape(characters: impl Iterator<Item = char>) -> String {
    let text: String = characters.collect();
    let shown = text.trim_end_matches('\0').chars().map(|character| match character {
        '\\' => "\\\\".to_owned(),
        _ if character.is_control() => format!("\\x{:02X}", u32::from(character)),
        _ => character.to_string(),
    });
    shown.collect()
}

/// The reverse of [`escape`]; `None` after a backslash that escapes nothing.
fn unescape(text: &str) -> Option<Vec<char>> {
    let mut characters = Vec::with_capacity(text.len());
    let mut rest = text.chars();
    while let Some(character) = rest.next() {
        characters.push(match character {
            '\\' => match rest.next()? {
                '\\' => '\\',
                'x' => char::from_u32(rest.next()?.to_digit(16)? << 4 | rest.next()?.to_digit(16)?)?,
                _ => return None,
            },
            _ => character,
        });
    }
    Some(characters)
}

fn octets(text: &str) -> Option<Vec<u8>> {
    let digits: Vec<u32> = text
        .chars()
        .filter(|character| *character != ' ')
        .map(|character| character.to_digit(16))
        .collect::<Option<_>>()?;
    let pairs = digits.chunks(2).map(|pair| match *pair {
        [high, low] => u8::try_from(high << 4 | low).ok(),
        _ => None,
    });
    pairs.collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_of_every_type_survive_a_round_trip() {
        for (word, text, bytes) in [
            ("bool", "true", vec![1]),
            ("i8", "-1", vec![0xFF]),
            ("i16", "-32768", vec![0x00, 0x80]),
            ("i24", "-2", vec![0xFE, 0xFF, 0xFF]),
            ("i32", "2147483647", vec![0xFF, 0xFF, 0xFF, 0x7F]),
            ("i40", "-549755813888", vec![0, 0, 0, 0, 0x80]),
            ("i48", "1", vec![1, 0, 0, 0, 0, 0]),
            ("i56", "-1", vec![0xFF; 7]),
            ("i64", "-9223372036854775808", vec![0, 0, 0, 0, 0, 0, 0, 0x80]),
            ("u8", "255", vec![0xFF]),
            ("u16", "1000", vec![0xE8, 0x03]),
            ("u24", "16777215", vec![0xFF; 3]),
            ("u32", "1702257011", b"save".to_vec()),
            ("u40", "1099511627775", vec![0xFF; 5]),
            ("u48", "256", vec![0, 1, 0, 0, 0, 0]),
            ("u56", "72057594037927935", vec![0xFF; 7]),
            ("u64", "18446744073709551615", vec![0xFF; 8]),
            ("f32", "1.5", vec![0x00, 0x00, 0xC0, 0x3F]),
            ("f32", "NaN", vec![0x00, 0x00, 0xC0, 0x7F]),
            ("f64", "-0.1", (-0.1_f64).to_le_bytes().to_vec()),
            ("string", "DST P92C", b"DST P92C".to_vec()),
            ("string", "20 \u{B0}C \\\\ \\x1B[2J", b"20 \xB0C \\ \x1B[2J".to_vec()),
            ("unicode", "\u{3A9}\u{1F600}", vec![0xA9, 0x03, 0x3D, 0xD8, 0x00, 0xDE]),
            ("octets", "00FFA5", vec![0x00, 0xFF, 0xA5]),
            ("domain", "", vec![]),
            ("time_of_day", "1984-01-02 00:00:00.001", vec![1, 0, 0, 0, 1, 0]),
            ("time_difference", "3 12:00:00.000", vec![0x00, 0x2E, 0x93, 0x02, 3, 0]),
        ] {
            let data_type: DataType = word.parse().unwrap();
            assert_eq!(data_type.encode(text).as_ref(), Ok(&bytes), "{word}");
            assert_eq!(data_type.decode(&bytes).as_deref(), Ok(text), "{word}");
        }
    }

    #[test]
    fn other_spellings_are_understood() {
        assert_eq!(DataType::U16.encode("0x03e8"), Ok(vec![0xE8, 0x03]));
        assert_eq!(DataType::I8.encode("-0x80"), Ok(vec![0x80]));
        assert_eq!(DataType::Bool.encode("0"), Ok(vec![0]));
        assert_eq!(DataType::Domain.encode("0a 1B"), Ok(vec![0x0A, 0x1B]));
        assert_eq!(DataType::VisibleString.decode(b"DST\0\0").as_deref(), Ok("DST"));
    }

    #[test]
    fn what_is_no_value_of_the_type_is_refused_with_a_hint() {
        for (data_type, text, hint) in [
            (DataType::Bool, "yes", "`true` or `false`"),
            (DataType::U8, "256", "0 to 255"),
            (DataType::U8, "-1", "0 to 255"),
            (DataType::I24, "8388608", "-8388608 to 8388607"),
            (DataType::U64, "18446744073709551616", "0 to 18446744073709551615"),
            (DataType::U64, "340282366920938463463374607431768211456", "a whole number"),
            (DataType::I32, "1.5", "a whole number"),
            (DataType::I32, "", "a whole number"),
            (DataType::I32, "--1", "a whole number"),
            (DataType::I32, "0x", "a whole number"),
            (DataType::F32, "one", "a number such as"),
            (DataType::VisibleString, "\u{3A9}", "Latin-1"),
            (DataType::VisibleString, "C:\\temp", "a backslash as"),
            (DataType::VisibleString, "\\x4", "a backslash as"),
            (DataType::OctetString, "ABC", "pairs"),
            (DataType::Domain, "0x12", "pairs"),
            (DataType::TimeOfDay, "yesterday", "2026-01-31"),
        ] {
            let error = data_type.encode(text).unwrap_err().to_string();
            assert!(error.contains(hint), "{error}");
        }
    }

    #[test]
    fn r_dst_010_bytes_of_another_length_are_refused() {
        assert_eq!(
            DataType::U16.decode(&[1, 2, 3, 4]),
            Err(ValueError::Length { data_type: DataType::U16, size: 2, len: 4 })
        );
        for (data_type, ..) in TYPES {
            for len in 0..10 {
                let fits = data_type.size().is_none_or(|size| size == len);
                assert_eq!(data_type.decode(&vec![0xFF; len]).is_ok(), fits, "{data_type} of {len} bytes");
            }
        }
    }

    #[test]
    fn codes_and_words_name_one_type_each() {
        for (data_type, code, word, cia309) in TYPES {
            assert_eq!(DataType::from_code(code), Some(data_type));
            assert_eq!(data_type.code(), code);
            assert_eq!(word.parse(), Ok(data_type));
            assert_eq!(data_type.to_string(), word);
            assert_eq!(DataType::from_cia309(cia309), Some(data_type));
        }
        assert_eq!(DataType::from_code(0x20), None);
        assert!("float".parse::<DataType>().unwrap_err().to_string().contains("f32"));
    }
}
