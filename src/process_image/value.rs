//! What a tag can hold.

use std::fmt;

/// A value, raw as on the bus or in engineering units.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Value {
    /// A single bit.
    Bool(bool),
    /// A whole number without sign.
    Unsigned(u64),
    /// A whole number with sign.
    Signed(i64),
    /// A number with a fraction. May be NaN or infinite when a device sends that.
    Float(f64),
}

impl Value {
    /// The value as a number; a bit is 0 or 1. Whole numbers above 2^53 lose their last digits.
    #[must_use]
    #[expect(
        clippy::as_conversions,
        clippy::cast_precision_loss,
        reason = "documented: above 2^53 the last digits go"
    )]
    pub fn as_f64(self) -> f64 {
        match self {
            Self::Bool(bit) => f64::from(u8::from(bit)),
            Self::Unsigned(number) => number as f64,
            Self::Signed(number) => number as f64,
            Self::Float(number) => number,
        }
    }

    /// Whether the value is true: a set bit, or a number other than zero.
    #[must_use]
    pub fn is_true(self) -> bool {
        match self {
            Self::Bool(bit) => bit,
            Self::Unsigned(number) => number != 0,
            Self::Signed(number) => number != 0,
            Self::Float(number) => number != 0.0,
        }
    }
}

impl fmt::Display for Value {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Bool(bit) => write!(f, "{bit}"),
            Self::Unsigned(number) => write!(f, "{number}"),
            Self::Signed(number) => write!(f, "{number}"),
            Self::Float(number) => write!(f, "{number}"),
        }
    }
}
