//! What the entries of the register map show, as 16-bit registers in either word order.

use super::WordOrder;
use crate::mapping::{Encoding, codec};
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

    /// A tag's value, [`codec::registers`].
    #[must_use]
    pub fn of_value(encoding: Encoding, resolution: f64, value: Value, raw: Value, usable: bool) -> Self {
        let [high, low] = codec::registers(encoding, resolution, value, raw, usable);
        if encoding.count() == 1 {
            return Self::Word(high);
        }
        let ([b3, b2], [b1, b0]) = (high.to_be_bytes(), low.to_be_bytes());
        Self::Double(u32::from_be_bytes([b3, b2, b1, b0]))
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_high_word_comes_first_unless_switched() {
        let cell = Cell::Double(0x1234_5678);
        assert_eq!(cell.registers(WordOrder::Big), (0x1234, Some(0x5678)));
        assert_eq!(cell.registers(WordOrder::Little), (0x5678, Some(0x1234)));
        assert_eq!(Cell::Word(0x1234).registers(WordOrder::Little), (0x1234, None));
    }

    #[test]
    fn counters_show_their_low_bits() {
        assert_eq!(Cell::low_word(0x1_2345), Cell::Word(0x2345));
        assert_eq!(Cell::low_double(0x1_2345_6789), Cell::Double(0x2345_6789));
        assert_eq!(Cell::saturated(70_000_u32), Cell::Word(0xFFFF));
    }

    #[test]
    fn a_value_takes_as_many_registers_as_its_encoding_says() {
        let shown = |encoding| Cell::of_value(encoding, 0.01, Value::Float(12.34), Value::Unsigned(7), true);
        assert_eq!(shown(Encoding::U16), Cell::Word(1234));
        assert_eq!(shown(Encoding::Raw16), Cell::Word(7));
        assert_eq!(shown(Encoding::I32), Cell::Double(1234));
        assert_eq!(shown(Encoding::F32), Cell::Double(12.34_f32.to_bits()));
    }
}
