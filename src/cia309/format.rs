//! How values are written: the data types of CiA 309-3, and two notations that other gateways have beside them.
//!
//! | type | example |
//! |---|---|
//! | `b` | `1` |
//! | `i8` .. `i64`, `u8` .. `u64`, in steps of 8 | `-5`, `1000`; also taken: `0x3E8` |
//! | `x8` .. `x64` | `0x03E8`: as `u8` .. `u64`, shown in hexadecimal; not in the standard |
//! | `r32`, `r64` | `1.5`, `1e-3`, `NaN`, `inf` |
//! | `vs` | `"a text"`, a quote in it doubled; what is no printable ASCII or Latin-1 as `\x1B`, a backslash as `\\` |
//! | `os`, `us`, `d` | base64; `""` for nothing |
//! | `t`, `td` | days and milliseconds: `365 43200000` |
//! | `hex` | `9A C5 00 00`, `""` for nothing: the bytes as they come; not in the standard. A read without a type is shown so |

use super::words::Word;
use crate::base64;
use crate::canopen::object::DataType;

/// How the bytes of an object are written.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Format {
    /// As the type says.
    Typed(DataType),
    /// A number without sign, in hexadecimal.
    Hexadecimal(DataType),
    /// Byte by byte.
    Bytes,
}

/// The bytes are not as many as the type has.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct WrongLength;

impl Format {
    /// From the word of a type, in lower case.
    #[must_use]
    pub fn from_word(word: &str) -> Option<Self> {
        if word == "hex" {
            return Some(Self::Bytes);
        }
        let is_number = |text: &&str| text.bytes().all(|byte| byte.is_ascii_digit());
        if let Some(bits) = word.strip_prefix('x').filter(is_number) {
            return DataType::from_cia309(&format!("u{bits}")).map(Self::Hexadecimal);
        }
        DataType::from_cia309(word).map(Self::Typed)
    }

    /// How many bytes it has; `None`: any number.
    #[must_use]
    pub fn size(self) -> Option<usize> {
        match self {
            Self::Typed(data_type) | Self::Hexadecimal(data_type) => data_type.size(),
            Self::Bytes => None,
        }
    }

    /// Bytes as text.
    ///
    /// # Errors
    /// They are not as many as the type has.
    pub fn show(self, bytes: &[u8]) -> Result<String, WrongLength> {
        if self.size().is_some_and(|size| size != bytes.len()) {
            return Err(WrongLength);
        }
        Ok(match self {
            Self::Bytes => spaced(bytes),
            Self::Hexadecimal(_) => {
                let digits: Vec<String> = bytes.iter().rev().map(|byte| format!("{byte:02X}")).collect();
                format!("0x{}", digits.concat())
            }
            Self::Typed(DataType::Bool) => u8::from(bytes != [0]).to_string(),
            Self::Typed(DataType::OctetString | DataType::UnicodeString | DataType::Domain) => {
                base64::encode(bytes)
            }
            Self::Typed(DataType::TimeOfDay | DataType::TimeDifference) => time(bytes).ok_or(WrongLength)?,
            Self::Typed(DataType::VisibleString) => {
                let text = DataType::VisibleString.decode(bytes).map_err(|_| WrongLength)?;
                format!("\"{}\"", text.replace('"', "\"\""))
            }
            Self::Typed(data_type) => data_type.decode(bytes).map_err(|_| WrongLength)?,
        })
    }

    /// Words as bytes; `None` where they are no value of the type.
    #[must_use]
    pub fn read(self, words: &[Word]) -> Option<Vec<u8>> {
        match self {
            // No bytes are `""`, as for `os`; a value that was forgotten is not taken for that.
            Self::Bytes if words.is_empty() => None,
            Self::Bytes => {
                let texts = words.iter().map(Word::text);
                DataType::OctetString.encode(&texts.collect::<Vec<_>>().join(" ")).ok()
            }
            Self::Typed(data_type @ (DataType::TimeOfDay | DataType::TimeDifference)) => {
                let [days, milliseconds] = words else { return None };
                let days = number(days, DataType::U16)?;
                let milliseconds = number(milliseconds, DataType::U32)?;
                let bytes = [milliseconds, days].concat();
                (data_type.size() == Some(bytes.len())).then_some(bytes)
            }
            Self::Typed(data_type) | Self::Hexadecimal(data_type) => {
                let [word] = words else { return None };
                single(data_type, word)
            }
        }
    }
}

fn single(data_type: DataType, word: &Word) -> Option<Vec<u8>> {
    match (data_type, word) {
        (DataType::VisibleString, _) => data_type.encode(word.text()).ok(),
        (DataType::OctetString | DataType::UnicodeString | DataType::Domain, _) => {
            base64::decode(word.text())
        }
        // A quoted number is a text.
        (_, Word::Quoted(_)) => None,
        (DataType::Bool, Word::Plain(text)) => match text.as_str() {
            "0" => Some(vec![0]),
            "1" => Some(vec![1]),
            _ => None,
        },
        (DataType::F32 | DataType::F64, Word::Plain(text)) => data_type.encode(text).ok(),
        (_, Word::Plain(_)) => number(word, data_type),
    }
}

/// A whole number. One that begins with a zero is refused: it is octal to some gateways, and decimal to people.
fn number(word: &Word, data_type: DataType) -> Option<Vec<u8>> {
    let Word::Plain(text) = word else { return None };
    let digits = text.strip_prefix('-').unwrap_or(text);
    let ambiguous =
        digits.len() > 1 && digits.starts_with('0') && !digits.starts_with("0x") && !digits.starts_with("0X");
    if ambiguous { None } else { data_type.encode(text).ok() }
}

fn spaced(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02X}")).collect::<Vec<_>>().join(" ")
}

/// Days, then milliseconds, of which only 28 bits count.
fn time(bytes: &[u8]) -> Option<String> {
    let [a, b, c, d, low, high] = *<&[u8; 6]>::try_from(bytes).ok()?;
    let milliseconds = u32::from_le_bytes([a, b, c, d]) & 0x0FFF_FFFF;
    Some(format!("{} {milliseconds}", u16::from_le_bytes([low, high])))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cia309::words::words;

    fn format(word: &str) -> Format {
        Format::from_word(word).unwrap_or_else(|| panic!("{word}"))
    }

    fn read(word: &str, text: &str) -> Option<Vec<u8>> {
        format(word).read(&words(text)?)
    }

    #[test]
    fn values_of_every_type_are_shown_and_read_back() {
        for (word, text, bytes) in [
            ("b", "1", vec![1]),
            ("i8", "-128", vec![0x80]),
            ("i16", "-2", vec![0xFE, 0xFF]),
            ("i24", "-8388608", vec![0, 0, 0x80]),
            ("i32", "-2147483648", vec![0, 0, 0, 0x80]),
            ("i40", "-1", vec![0xFF; 5]),
            ("i48", "-1", vec![0xFF; 6]),
            ("i56", "-1", vec![0xFF; 7]),
            ("i64", "-9223372036854775808", vec![0, 0, 0, 0, 0, 0, 0, 0x80]),
            ("u8", "255", vec![0xFF]),
            ("u16", "1000", vec![0xE8, 0x03]),
            ("u24", "16777215", vec![0xFF; 3]),
            ("u32", "50586", vec![0x9A, 0xC5, 0, 0]),
            ("u40", "1099511627775", vec![0xFF; 5]),
            ("u48", "256", vec![0, 1, 0, 0, 0, 0]),
            ("u56", "1", vec![1, 0, 0, 0, 0, 0, 0]),
            ("u64", "18446744073709551615", vec![0xFF; 8]),
            ("x8", "0x0F", vec![0x0F]),
            ("x16", "0x03E8", vec![0xE8, 0x03]),
            ("x32", "0x65766173", b"save".to_vec()),
            ("x64", "0x0000000000000001", vec![1, 0, 0, 0, 0, 0, 0, 0]),
            ("r32", "1.5", vec![0, 0, 0xC0, 0x3F]),
            ("r64", "-0.1", (-0.1_f64).to_le_bytes().to_vec()),
            ("vs", "\"DST P92C\"", b"DST P92C".to_vec()),
            ("vs", "\"Hello, \"\"World\"\"!\"", b"Hello, \"World\"!".to_vec()),
            ("vs", "\"a\\x0D\\x0Ab\\\\\"", b"a\r\nb\\".to_vec()),
            ("os", "ASNFZ4mrze8=", vec![0x01, 0x23, 0x45, 0x67, 0x89, 0xAB, 0xCD, 0xEF]),
            ("d", "", vec![]),
            ("us", "SABp", vec![0x48, 0x00, 0x69]),
            ("t", "365 43200000", vec![0x00, 0x2E, 0x93, 0x02, 0x6D, 0x01]),
            ("td", "0 1", vec![1, 0, 0, 0, 0, 0]),
            ("hex", "9A C5 00 00", vec![0x9A, 0xC5, 0, 0]),
        ] {
            assert_eq!(format(word).show(&bytes).as_deref(), Ok(text), "{word}");
            let typed = if text.is_empty() { "\"\"" } else { text };
            assert_eq!(read(word, typed), Some(bytes), "{word} {typed}");
        }
    }

    #[test]
    fn other_spellings_are_taken() {
        assert_eq!(read("u16", "0x3e8"), Some(vec![0xE8, 0x03]));
        assert_eq!(read("x16", "1000"), Some(vec![0xE8, 0x03]));
        assert_eq!(read("vs", "word"), Some(b"word".to_vec()));
        assert_eq!(read("hex", "9ac5 00"), Some(vec![0x9A, 0xC5, 0]));
        assert_eq!(read("hex", "\"\""), Some(vec![]));
        assert_eq!(read("r32", "inf"), Some(f32::INFINITY.to_le_bytes().to_vec()));
    }

    #[test]
    fn what_is_no_value_of_the_type_is_refused() {
        for (word, text) in [
            ("b", "2"),
            ("u8", "256"),
            ("u8", "-1"),
            ("u8", "1.0"),
            ("u8", "010"),
            ("i16", "-010"),
            ("u8", "\"1\""),
            ("u8", "1 2"),
            ("u8", ""),
            ("r32", "one"),
            ("vs", "two words"),
            ("os", "A"),
            ("t", "1"),
            ("t", "1 2 3"),
            ("t", "65536 0"),
            ("hex", "ABC"),
            ("hex", ""),
            ("x8", "0x100"),
        ] {
            assert_eq!(read(word, text), None, "{word} {text}");
        }
        for word in ["", "u", "u9", "x9", "x", "i128", "xr32", "string", "xs"] {
            assert_eq!(Format::from_word(word), None, "{word}");
        }
    }

    #[test]
    fn bytes_of_another_number_than_the_type_has_are_no_value() {
        for word in ["b", "u16", "i24", "r32", "t", "x64"] {
            assert_eq!(format(word).show(&[1; 5]), Err(WrongLength), "{word}");
        }
    }

    #[test]
    fn no_device_can_begin_a_line_of_its_own() {
        let all: Vec<u8> = (0..=255).collect();
        for word in ["vs", "os", "us", "d", "hex"] {
            let shown = format(word).show(&all).unwrap();
            assert!(!shown.chars().any(char::is_control), "{word}: {shown:?}");
        }
    }
}
