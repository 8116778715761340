//! Units and decimal digits of a DST P92C (section 5 of the requirements), and numbers as its objects hold them. Pure.

use super::object_table::{FAHRENHEIT, KELVIN};

/// A pressure unit.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PressureUnit {
    /// Pa in one of it.
    pub pascal: f64,
    /// Decimal digits that are allowed with it (R-DST-033).
    pub most_digits: u32,
}

const PSI: u32 = 0xAB_0000;
const BAR: u32 = 0x4E_0000;
const PASCAL: u32 = 0x22_0000;

/// The pressure unit of a code in 0x6131/01; `None` for a code that the device does not take (R-DST-028, R-DST-030).
#[must_use]
pub fn pressure(code: u32) -> Option<PressureUnit> {
    let (prefix, magnitude) = match code >> 24 {
        0x00 => (1.0, 0),
        0xFF => (0.1, 1),
        0xFE => (0.01, 2),
        0xFD => (0.001, 3),
        _ => return None,
    };
    match code & 0x00FF_FFFF {
        PSI => Some(PressureUnit { pascal: 6_894.757_293 * prefix, most_digits: 3 - magnitude }),
        BAR => Some(PressureUnit { pascal: 100_000.0 * prefix, most_digits: 5 - magnitude }),
        PASCAL if magnitude == 0 => Some(PressureUnit { pascal: 1.0, most_digits: 0 }),
        _ => None,
    }
}

/// A temperature in the unit of a code in 0x6131/02 (R-DST-029).
#[must_use]
pub fn temperature(code: u32, celsius: f64) -> f64 {
    match code {
        FAHRENHEIT => celsius * 9.0 / 5.0 + 32.0,
        KELVIN => celsius + 273.15,
        _ => celsius,
    }
}

/// A value as an integer object holds it: physical x 10^digits, rounded (R-DST-032). What is too large for it is at its end.
#[must_use]
pub fn integer(value: f64, digits: u32) -> u32 {
    let scaled = value * power(digits);
    #[expect(
        clippy::as_conversions,
        clippy::cast_possible_truncation,
        reason = "rounded; saturates, and not-a-number becomes 0"
    )]
    let integer = scaled.round() as i32;
    integer.cast_unsigned()
}

/// The value of an integer object.
#[must_use]
pub fn from_integer(raw: i32, digits: u32) -> f64 {
    f64::from(raw) / power(digits)
}

/// A value as a float object holds it.
#[must_use]
pub fn float(value: f64) -> u32 {
    #[expect(
        clippy::as_conversions,
        clippy::cast_possible_truncation,
        reason = "the nearest single-precision number is what the object holds"
    )]
    let float = value as f32;
    float.to_bits()
}

fn power(digits: u32) -> f64 {
    (0..digits.min(9)).fold(1.0, |power, _| power * 10.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn r_dst_028_030_033_units_prefixes_and_their_digits() {
        let of = |code| pressure(code).map(|unit| (unit.pascal, unit.most_digits));
        assert_eq!(of(0x0022_0000), Some((1.0, 0)));
        assert_eq!(of(0x004E_0000), Some((100_000.0, 5)));
        assert_eq!(of(0xFD4E_0000), Some((100.0, 2)));
        assert_eq!(of(0xFF4E_0000), Some((10_000.0, 4)));
        assert_eq!(of(0x00AB_0000), Some((6_894.757_293, 3)));
        assert_eq!(of(0xFEAB_0000).unwrap().1, 1);
        for code in [0xFD22_0000, 0xFC4E_0000, 0x014E_0000, 0x004E_0001, 0x002D_0000, 0] {
            assert_eq!(of(code), None, "{code:08X}");
        }
    }

    #[test]
    fn r_dst_029_temperatures_in_each_unit() {
        let of = |code| (temperature(code, 10.0) * 100.0).round().to_string();
        assert_eq!(
            (of(0x002D_0000), of(0x00AC_0000), of(0x0005_0000)),
            ("1000".into(), "5000".into(), "28315".into())
        );
    }

    #[test]
    fn r_dst_032_an_integer_is_the_value_with_its_digits_and_stays_in_its_range() {
        assert_eq!(integer(12.345, 3), 12345);
        assert_eq!(integer(-40.0, 2), (-4000_i32).cast_unsigned());
        assert_eq!(integer(1e12, 5), 0x7FFF_FFFF);
        assert_eq!(integer(f64::NAN, 5), 0);
        assert_eq!(integer(from_integer(12345, 3), 3), 12345);
    }
}
