//! What a tag can hold.

use std::fmt::{self, Write as _};

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

/// Appends a finite number with at most `decimals` digits after the point and no trailing zeros: the same in every view.
pub fn write_rounded(out: &mut String, number: f64, decimals: u8) {
    // Above this a double has no digits after the point, and fixed notation would only be long.
    const LARGE: f64 = 1e15;
    // Writing into a string cannot fail.
    if number.abs() >= LARGE {
        let _infallible = write!(out, "{number:e}");
        return;
    }
    let start = out.len();
    let _infallible = write!(out, "{number:.*}", usize::from(decimals));
    if out.get(start..).is_some_and(|text| text.contains('.')) {
        out.truncate(out.trim_end_matches('0').trim_end_matches('.').len());
    }
    if out.get(start..) == Some("-0") {
        out.truncate(start);
        out.push('0');
    }
}

/// A number as [`write_rounded`] shows it; what is not finite stays as it is.
#[must_use]
pub fn rounded(number: f64, decimals: u8) -> f64 {
    let mut text = String::new();
    if number.is_finite() {
        write_rounded(&mut text, number, decimals);
    }
    text.parse().unwrap_or(number)
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

#[cfg(test)]
mod tests {
    use super::*;

    fn shown(number: f64, decimals: u8) -> String {
        let mut out = "x".to_owned();
        write_rounded(&mut out, number, decimals);
        out.split_off(1)
    }

    #[test]
    fn numbers_are_rounded_and_have_no_trailing_zeros() {
        for (number, decimals, expected) in [
            (12.549_019_607, 2, "12.55"),
            (100.0, 2, "100"),
            (100.0, 0, "100"),
            (-0.001, 2, "0"),
            // Neither is half of a hundredth: 1.005 is a little less as a double, 0.125 is exactly half.
            (1.005, 2, "1"),
            (0.125, 2, "0.12"),
            (1e300, 2, "1e300"),
        ] {
            assert_eq!(shown(number, decimals), expected);
            assert_eq!(rounded(number, decimals).to_bits(), expected.parse::<f64>().unwrap().to_bits());
        }
        assert!(rounded(f64::NAN, 2).is_nan());
        assert!(rounded(f64::INFINITY, 2).is_infinite());
    }
}
