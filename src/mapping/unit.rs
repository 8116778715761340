//! Physical units that devices tell by their code (CiA 303-2, as CiA 404 uses it), and what leads from one to another. Pure.
//!
//! A code holds the signed decimal exponent of a prefix in bits 31..24 and the unit in bits 23..16; the others are zero.
//! What is not known here is not guessed (R-DST-036).

use std::fmt;

use super::table::Scale;

/// What a unit is without its prefix.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Base {
    Pascal,
    Bar,
    Psi,
    Celsius,
    Fahrenheit,
    Kelvin,
}

/// Code and text of each.
const BASES: [(Base, u8, &str); 6] = [
    (Base::Pascal, 0x22, "Pa"),
    (Base::Bar, 0x4E, "bar"),
    (Base::Psi, 0xAB, "psi"),
    (Base::Celsius, 0x2D, "°C"),
    (Base::Fahrenheit, 0xAC, "°F"),
    (Base::Kelvin, 0x05, "K"),
];

/// Decimal exponents that have a name.
const PREFIXES: [(i8, &str); 17] = [
    (0, ""),
    (1, "da"),
    (2, "h"),
    (3, "k"),
    (6, "M"),
    (9, "G"),
    (12, "T"),
    (15, "P"),
    (18, "E"),
    (-1, "d"),
    (-2, "c"),
    (-3, "m"),
    (-6, "µ"),
    (-9, "n"),
    (-12, "p"),
    (-15, "f"),
    (-18, "a"),
];

/// A unit with its prefix: `bar`, `mbar`, `°C`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Unit {
    base: Base,
    /// Decimal exponent of the prefix, one of those that have a name; 0 for temperatures.
    exponent: i8,
}

impl Unit {
    /// The unit of a code (R-DST-028, R-DST-029, R-DST-030); `None` for one that is not known here.
    #[must_use]
    pub fn from_code(code: u32) -> Option<Self> {
        let [prefix, unit, denominator, reserved] = code.to_be_bytes();
        let (base, _, _) = BASES.iter().find(|(_, known, _)| *known == unit)?;
        let known = denominator == 0 && reserved == 0;
        Self::new(*base, prefix.cast_signed()).filter(|_| known)
    }

    /// The unit that a text means; `None` where there is none of that name.
    #[must_use]
    pub fn from_text(text: &str) -> Option<Self> {
        let split = |(base, _, name): &(Base, u8, &str)| {
            let prefix = text.strip_suffix(name)?;
            let (exponent, _) = PREFIXES.iter().find(|(_, known)| *known == prefix)?;
            Self::new(*base, *exponent)
        };
        BASES.iter().find_map(split)
    }

    fn new(base: Base, exponent: i8) -> Option<Self> {
        let named = PREFIXES.iter().any(|(known, _)| *known == exponent);
        (named && (exponent == 0 || base.pascal().is_some())).then_some(Self { base, exponent })
    }

    /// What makes a number in this unit one in another (R-DST-035); `None` where both measure different things.
    #[must_use]
    pub fn scale_to(self, other: Self) -> Option<Scale> {
        if self == other {
            return Some(Scale::IDENTITY);
        }
        match (self.base.pascal(), other.base.pascal()) {
            (Some(own), Some(others)) => {
                // Of the same unit only the prefixes differ, and powers of ten are exact.
                let (own, others) = if self.base == other.base { (1.0, 1.0) } else { (own, others) };
                let shift = i32::from(self.exponent) - i32::from(other.exponent);
                let (up, down) = (power_of_ten(shift), power_of_ten(-shift));
                Some(Scale { multiply: own * up, divide: others * down, add: 0.0 })
            }
            (None, None) => Some(self.base.into_celsius().then(other.base.out_of_celsius())),
            (Some(_), None) | (None, Some(_)) => None,
        }
    }

    /// Units of which there are texts, for messages: without prefixes.
    #[must_use]
    pub fn known() -> String {
        BASES.map(|(_, _, name)| name).join(", ")
    }
}

impl Base {
    /// Pascals in one of it, for a pressure.
    fn pascal(self) -> Option<f64> {
        match self {
            Self::Pascal => Some(1.0),
            Self::Bar => Some(100_000.0),
            Self::Psi => Some(6_894.757_293),
            Self::Celsius | Self::Fahrenheit | Self::Kelvin => None,
        }
    }

    fn into_celsius(self) -> Scale {
        match self {
            Self::Fahrenheit => Scale { multiply: 5.0, divide: 9.0, add: -160.0 / 9.0 },
            Self::Kelvin => Scale { add: -273.15, ..Scale::IDENTITY },
            Self::Celsius | Self::Pascal | Self::Bar | Self::Psi => Scale::IDENTITY,
        }
    }

    fn out_of_celsius(self) -> Scale {
        match self {
            Self::Fahrenheit => Scale { multiply: 9.0, divide: 5.0, add: 32.0 },
            Self::Kelvin => Scale { add: 273.15, ..Scale::IDENTITY },
            Self::Celsius | Self::Pascal | Self::Bar | Self::Psi => Scale::IDENTITY,
        }
    }
}

/// 10^`exponent`, 1 for negative ones. Exact up to 10^22.
fn power_of_ten(exponent: i32) -> f64 {
    10_f64.powi(exponent.max(0))
}

impl fmt::Display for Unit {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let prefix = PREFIXES.iter().find(|(exponent, _)| *exponent == self.exponent);
        let base = BASES.iter().find(|(base, _, _)| *base == self.base);
        write!(f, "{}{}", prefix.map_or("", |(_, text)| text), base.map_or("", |(_, _, text)| text))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mapping::codec;
    use crate::process_image::Value;

    fn text(code: u32) -> Option<String> {
        Unit::from_code(code).map(|unit| unit.to_string())
    }

    fn converted(number: f64, from: &str, to: &str) -> Option<f64> {
        let scale = Unit::from_text(from).unwrap().scale_to(Unit::from_text(to).unwrap())?;
        Some(codec::scale(&scale, Value::Float(number)).as_f64())
    }

    #[test]
    fn r_dst_028_029_codes_of_pressures_and_temperatures() {
        for (code, unit) in [
            (0x00AB_0000, "psi"),
            (0x004E_0000, "bar"),
            (0x0022_0000, "Pa"),
            (0x002D_0000, "°C"),
            (0x00AC_0000, "°F"),
            (0x0005_0000, "K"),
        ] {
            assert_eq!(text(code).as_deref(), Some(unit), "0x{code:08X}");
        }
    }

    #[test]
    fn r_dst_030_the_prefix_is_a_signed_decimal_exponent() {
        for (code, unit) in [
            (0xFF4E_0000, "dbar"),
            (0xFE4E_0000, "cbar"),
            (0xFD4E_0000, "mbar"),
            (0xFDAB_0000, "mpsi"),
            (0x0322_0000, "kPa"),
            (0x0622_0000, "MPa"),
        ] {
            assert_eq!(text(code).as_deref(), Some(unit), "0x{code:08X}");
            assert_eq!(Unit::from_text(unit), Unit::from_code(code), "{unit}");
        }
    }

    #[test]
    fn r_dst_036_an_unknown_code_is_no_unit() {
        // No unit, another unit, exponents without a name, a temperature with a prefix, a denominator, reserved bits.
        for code in
            [0, 0x0001_0000, 0x044E_0000, 0x804E_0000, 0xFD2D_0000, 0x004E_0300, 0x004E_0001, u32::MAX]
        {
            assert_eq!(text(code), None, "0x{code:08X}");
        }
        for name in ["", "m", "Bar", "m°C", "xbar", "device"] {
            assert_eq!(Unit::from_text(name), None, "{name}");
        }
    }

    #[test]
    fn r_dst_035_factors_between_units() {
        for (number, from, to, expected) in [
            (1.0, "bar", "Pa", 100_000.0),
            (1.0, "psi", "Pa", 6_894.757_293),
            (1234.56, "psi", "Pa", 8_511_991.563_846_08),
            (5000.0, "mbar", "bar", 5.0),
            (1.5, "bar", "mbar", 1500.0),
            (25.0, "MPa", "bar", 250.0),
            (14.503_773_8, "psi", "bar", 1.0),
            (50.0, "°F", "°C", 10.0),
            (-40.0, "°C", "°F", -40.0),
            (283.15, "K", "°C", 10.0),
            (50.0, "°F", "K", 283.15),
            (10.0, "°C", "K", 283.15),
        ] {
            let got = converted(number, from, to).unwrap();
            assert!((got - expected).abs() <= expected.abs() * 1e-8, "{number} {from} = {got} {to}");
        }
    }

    #[test]
    fn r_dst_035_there_is_no_way_from_a_temperature_to_a_pressure() {
        assert_eq!(converted(1.0, "°C", "bar"), None);
        assert_eq!(converted(1.0, "bar", "K"), None);
    }

    #[test]
    fn every_unit_of_a_code_has_a_text_that_means_it() {
        for prefix in 0..=u8::MAX {
            for unit in 0..=u8::MAX {
                if let Some(known) = Unit::from_code(u32::from_be_bytes([prefix, unit, 0, 0])) {
                    assert_eq!(Unit::from_text(&known.to_string()), Some(known));
                    assert_eq!(known.scale_to(known), Some(Scale::IDENTITY));
                }
            }
        }
    }
}
