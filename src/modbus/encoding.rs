//! Values as 16-bit registers: saturation, rounding, the patterns that mean "invalid", word order.

use super::WordOrder;
use crate::mapping::Encoding;
use crate::process_image::Value;

/// What one entry of the register map shows.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Cell {
    /// One register.
    Word(u16),
    /// A 32-bit value in two registers.
    Double(u32),
}

impl Cell {
    /// Its registers in the order of their addresses; the second is `None` for a single one.
    #[must_use]
    pub fn registers(self, order: WordOrder) -> (u16, Option<u16>) {
        match self {
            Self::Word(word) => (word, None),
            Self::Double(double) => {
                let [b3, b2, b1, b0] = double.to_be_bytes();
                let (high, low) = (u16::from_be_bytes([b3, b2]), u16::from_be_bytes([b1, b0]));
                match order {
                    WordOrder::Big => (high, Some(low)),
                    WordOrder::Little => (low, Some(high)),
                }
            }
        }
    }

    /// The low 16 bits of a counter.
    #[must_use]
    pub fn low_word(number: u64) -> Self {
        Self::Word(low_16(number))
    }

    /// The low 32 bits of a counter.
    #[must_use]
    pub fn low_double(number: u64) -> Self {
        Self::Double(low_32(number))
    }

    /// One register without sign, 65,535 for anything greater.
    #[must_use]
    pub fn saturated(number: impl TryInto<u16>) -> Self {
        Self::Word(number.try_into().unwrap_or(u16::MAX))
    }
}

/// The low 16 bits.
#[must_use]
pub fn low_16(number: u64) -> u16 {
    let [.., b1, b0] = number.to_be_bytes();
    u16::from_be_bytes([b1, b0])
}

/// The low 32 bits.
#[must_use]
pub fn low_32(number: u64) -> u32 {
    let [.., b3, b2, b1, b0] = number.to_be_bytes();
    u32::from_be_bytes([b3, b2, b1, b0])
}

/// The pattern that cannot be mistaken for a value of this encoding: all ones without sign, the most negative number
/// with sign, NaN for floats.
#[must_use]
pub fn invalid(encoding: Encoding) -> Cell {
    match encoding {
        Encoding::Bool => Cell::Word(0),
        Encoding::U16 | Encoding::Raw16 => Cell::Word(0xFFFF),
        Encoding::I16 => Cell::Word(0x8000),
        Encoding::U32 | Encoding::Raw32 => Cell::Double(0xFFFF_FFFF),
        Encoding::I32 => Cell::Double(0x8000_0000),
        Encoding::F32 => Cell::Double(f32::NAN.to_bits()),
    }
}

/// A value (for raw encodings: the raw value) as it stands in registers.
///
/// `resolution` is the engineering units per count of a whole-number encoding. Numbers round to the nearest count, half
/// away from zero, and stop at the ends of the encoding; a NaN has no count and shows as invalid.
#[must_use]
pub fn encode(value: Value, encoding: Encoding, resolution: f64) -> Cell {
    match encoding {
        Encoding::Bool => Cell::Word(u16::from(value.is_true())),
        Encoding::F32 => Cell::Double(to_f32(value.as_f64()).to_bits()),
        Encoding::Raw16 => raw_16(value),
        Encoding::Raw32 => raw_32(value),
        Encoding::U16 | Encoding::I16 | Encoding::U32 | Encoding::I32 => {
            let count = value.as_f64() / resolution;
            if count.is_nan() { invalid(encoding) } else { whole(count.round(), encoding) }
        }
    }
}

/// A whole number in its encoding, stopped at its ends.
fn whole(count: f64, encoding: Encoding) -> Cell {
    let count = saturating_i64(count);
    match encoding {
        Encoding::I16 => Cell::Word(i16_bits(count)),
        Encoding::U32 | Encoding::Raw32 => Cell::Double(u32_of(count)),
        Encoding::I32 => Cell::Double(i32_bits(count)),
        Encoding::U16 | Encoding::Raw16 | Encoding::Bool | Encoding::F32 => Cell::Word(u16_of(count)),
    }
}

fn raw_16(value: Value) -> Cell {
    Cell::Word(match value {
        Value::Bool(bit) => u16::from(bit),
        Value::Unsigned(number) => u16::try_from(number).unwrap_or(u16::MAX),
        Value::Signed(number) => i16_bits(number),
        Value::Float(number) if number.is_nan() => 0xFFFF,
        Value::Float(number) => u16_of(saturating_i64(number.round())),
    })
}

fn raw_32(value: Value) -> Cell {
    Cell::Double(match value {
        Value::Bool(bit) => u32::from(bit),
        Value::Unsigned(number) => u32::try_from(number).unwrap_or(u32::MAX),
        Value::Signed(number) => i32_bits(number),
        Value::Float(number) => to_f32(number).to_bits(),
    })
}

fn u16_of(number: i64) -> u16 {
    u16::try_from(number.max(0)).unwrap_or(u16::MAX)
}

fn u32_of(number: i64) -> u32 {
    u32::try_from(number.max(0)).unwrap_or(u32::MAX)
}

fn i16_bits(number: i64) -> u16 {
    let limited = i16::try_from(number).unwrap_or(if number < 0 { i16::MIN } else { i16::MAX });
    limited.cast_unsigned()
}

fn i32_bits(number: i64) -> u32 {
    let limited = i32::try_from(number).unwrap_or(if number < 0 { i32::MIN } else { i32::MAX });
    limited.cast_unsigned()
}

#[expect(
    clippy::as_conversions,
    clippy::cast_possible_truncation,
    reason = "float to integer `as` saturates, which is what is wanted"
)]
fn saturating_i64(number: f64) -> i64 {
    number as i64
}

#[expect(
    clippy::as_conversions,
    clippy::cast_possible_truncation,
    reason = "rounding to the nearest f32 is what is wanted"
)]
fn to_f32(number: f64) -> f32 {
    number as f32
}

#[cfg(test)]
mod tests {
    use super::*;

    fn word(value: Value, encoding: Encoding, resolution: f64) -> u16 {
        match encode(value, encoding, resolution) {
            Cell::Word(word) => word,
            Cell::Double(_) => panic!("one register expected"),
        }
    }

    fn double(value: Value, encoding: Encoding, resolution: f64) -> u32 {
        match encode(value, encoding, resolution) {
            Cell::Double(double) => double,
            Cell::Word(_) => panic!("two registers expected"),
        }
    }

    #[test]
    fn r_det_048_every_raw_byte_shows_the_rounded_hundredths_of_a_percent() {
        for raw in 0..=255_u32 {
            let percent = f64::from(raw) * 100.0 / 255.0;
            let exact = (u64::from(raw) * 10_000 * 2 + 255) / (2 * 255);
            assert_eq!(
                u64::from(word(Value::Float(percent), Encoding::U16, 0.01)),
                exact,
                "raw {raw} is {percent} %"
            );
        }
    }

    #[test]
    fn whole_numbers_round_half_away_from_zero() {
        assert_eq!(word(Value::Float(2.5), Encoding::U16, 1.0), 3);
        assert_eq!(word(Value::Float(-2.5), Encoding::I16, 1.0), (-3_i16).cast_unsigned());
        assert_eq!(word(Value::Float(2.49), Encoding::U16, 1.0), 2);
    }

    #[test]
    fn whole_numbers_stop_at_the_ends_of_their_encoding() {
        for (value, encoding, expected) in [
            (-1.0, Encoding::U16, 0),
            (65_536.0, Encoding::U16, 0xFFFF),
            (40_000.0, Encoding::I16, 0x7FFF),
            (-40_000.0, Encoding::I16, 0x8000),
            (f64::INFINITY, Encoding::I16, 0x7FFF),
        ] {
            assert_eq!(word(Value::Float(value), encoding, 1.0), expected);
        }
        for (value, encoding, expected) in [
            (-1.0, Encoding::U32, 0),
            (5e9, Encoding::U32, 0xFFFF_FFFF),
            (3e9, Encoding::I32, 0x7FFF_FFFF),
            (-3e9, Encoding::I32, 0x8000_0000),
            (1e300, Encoding::U32, 0xFFFF_FFFF),
        ] {
            assert_eq!(double(Value::Float(value), encoding, 1.0), expected);
        }
    }

    #[test]
    fn a_number_that_is_none_shows_as_invalid() {
        for encoding in [Encoding::U16, Encoding::I16, Encoding::U32, Encoding::I32] {
            assert_eq!(encode(Value::Float(f64::NAN), encoding, 0.1), invalid(encoding));
        }
        assert!(f32::from_bits(double(Value::Float(f64::NAN), Encoding::F32, 1.0)).is_nan());
    }

    #[test]
    fn raw_encodings_keep_the_bits_of_the_bus() {
        assert_eq!(word(Value::Unsigned(0xAB), Encoding::Raw16, 1.0), 0xAB);
        assert_eq!(word(Value::Signed(-1), Encoding::Raw16, 1.0), 0xFFFF);
        assert_eq!(double(Value::Signed(-2), Encoding::Raw32, 1.0), 0xFFFF_FFFE);
        assert_eq!(double(Value::Float(1234.5), Encoding::Raw32, 1.0), 0x449A_5000);
    }

    #[test]
    fn the_high_word_comes_first_unless_switched() {
        let cell = Cell::Double(0x1234_5678);
        assert_eq!(cell.registers(WordOrder::Big), (0x1234, Some(0x5678)));
        assert_eq!(cell.registers(WordOrder::Little), (0x5678, Some(0x1234)));
        assert_eq!(Cell::Word(0x1234).registers(WordOrder::Little), (0x1234, None));
    }
}
