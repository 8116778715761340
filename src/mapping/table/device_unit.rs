//! Units and decimal digits that a device tells of its values (R-DST-034), and what they make of a raw number.

use super::Scale;
use crate::canopen::object::ObjectId;
use crate::mapping::unit::Unit;
use crate::process_image::{Quality, Reason};

/// Digits above this are no digits: an integer of 32 bits has ten.
const MOST_DIGITS: u32 = 9;

/// What a device tells of a tag beside its value.
#[derive(Clone, Debug, PartialEq)]
pub struct DeviceUnit {
    /// The code of its unit; `None`: the unit is that of the mapping.
    pub unit: Option<Told>,
    /// How many of its digits are decimal digits (R-DST-032); `None`: the scale is that of the mapping.
    pub digits: Option<Told>,
    /// What values are converted to; `None`: nothing, they are shown in the device's unit.
    pub target: Option<Unit>,
}

/// A number that the device tells.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Told {
    /// In which object.
    pub object: ObjectId,
    /// What the mapping sees to that it is: believed where the device may not be asked (R-DST-122).
    pub assumed: Option<u32>,
}

/// How the raw numbers of a tag are to be read.
#[derive(Clone, Debug, PartialEq)]
pub struct Reading {
    /// From raw to the unit in which it is shown.
    pub scale: Scale,
    /// No value is better than this.
    pub quality: Quality,
    /// The device's unit, for people; empty where the device is not asked for it.
    pub unit: String,
}

impl DeviceUnit {
    /// How raw numbers are to be read, from what the device told; `None` where it would not tell. `scale`: that of the mapping.
    ///
    /// Where the unit is not known, the number is shown as it is, as uncertain, with its code; but not in the place of a value
    /// of a certain unit: there it is bad (R-DST-036).
    #[must_use]
    pub fn reading(&self, scale: Scale, unit: Option<u32>, digits: Option<u32>) -> Reading {
        let digits = match (&self.digits, digits) {
            (None, _) => Some(Scale::IDENTITY),
            (Some(_), Some(digits)) if digits <= MOST_DIGITS => {
                let power = i32::try_from(digits).unwrap_or_default();
                Some(Scale { divide: 10_f64.powi(power), ..Scale::IDENTITY })
            }
            (Some(_), _) => None,
        };
        let scale = digits.unwrap_or(Scale::IDENTITY).then(scale);
        let reading = self.in_unit(scale, unit);
        match digits {
            Some(_) => reading,
            None => {
                Reading { quality: reading.quality.worst(Quality::Bad(Reason::UnknownDigits)), ..reading }
            }
        }
    }

    fn in_unit(&self, scale: Scale, code: Option<u32>) -> Reading {
        if self.unit.is_none() {
            return Reading { scale, quality: Quality::Good, unit: String::new() };
        }
        let Some(found) = code.and_then(Unit::from_code) else {
            let unit = code.map_or_else(|| "unknown".to_owned(), |code| format!("unknown(0x{code:08X})"));
            let quality = match self.target {
                None => Quality::Uncertain(Reason::UnknownUnit),
                Some(_) => Quality::Bad(Reason::UnknownUnit),
            };
            return Reading { scale: Scale::IDENTITY, quality, unit };
        };
        let unit = found.to_string();
        match self.target.map(|target| found.scale_to(target)) {
            None => Reading { scale, quality: Quality::Good, unit },
            Some(Some(conversion)) => Reading { scale: scale.then(conversion), quality: Quality::Good, unit },
            Some(None) => Reading { scale, quality: Quality::Bad(Reason::OtherUnit), unit },
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mapping::codec;
    use crate::process_image::Value;

    const BAR: u32 = 0x004E_0000;

    fn told(object: &str) -> Told {
        Told { object: object.parse().unwrap(), assumed: None }
    }

    fn integer(target: Option<&str>) -> DeviceUnit {
        let target = target.map(|text| Unit::from_text(text).unwrap());
        DeviceUnit { unit: Some(told("0x6131:1")), digits: Some(told("0x6132:1")), target }
    }

    fn value(reading: &Reading, raw: Value) -> f64 {
        codec::scale(&reading.scale, raw).as_f64()
    }

    #[test]
    fn r_dst_032_an_integer_has_decimal_digits() {
        for (raw, digits, expected) in [(12345, 3, 12.345), (-1000, 0, -1000.0), (123_456, 2, 1234.56)] {
            let reading = integer(None).reading(Scale::IDENTITY, Some(BAR), Some(digits));
            assert_eq!(value(&reading, Value::Signed(raw)).to_bits(), f64::to_bits(expected), "{raw}");
            assert_eq!((reading.quality, reading.unit.as_str()), (Quality::Good, "bar"));
        }
    }

    #[test]
    fn r_dst_035_a_fixed_unit_is_kept_whatever_the_device_counts_in() {
        let in_bar = integer(Some("bar"));
        for (raw, code, digits, expected) in [
            (100_000, 0x0022_0000, 0, 1.0),
            (12345, BAR, 3, 12.345),
            (50_000, 0xFD4E_0000, 1, 5.0),
            (123_456, 0x00AB_0000, 2, 85.119_915_636_460_8),
        ] {
            let reading = in_bar.reading(Scale::IDENTITY, Some(code), Some(digits));
            assert!((value(&reading, Value::Signed(raw)) - expected).abs() < 1e-9, "{raw} 0x{code:08X}");
            assert_eq!(reading.quality, Quality::Good);
        }
    }

    #[test]
    fn r_dst_036_an_unknown_unit_is_shown_raw_and_never_in_the_place_of_another() {
        let own = integer(None).reading(Scale::IDENTITY, Some(0x0101_0000), Some(3));
        assert_eq!(value(&own, Value::Signed(12345)).to_bits(), 12345_f64.to_bits(), "the raw number");
        assert_eq!(own.quality, Quality::Uncertain(Reason::UnknownUnit));
        assert_eq!(own.unit, "unknown(0x01010000)");
        let fixed = integer(Some("bar")).reading(Scale::IDENTITY, Some(0x0101_0000), Some(3));
        assert_eq!(fixed.quality, Quality::Bad(Reason::UnknownUnit));
        let refused = integer(Some("bar")).reading(Scale::IDENTITY, None, Some(3));
        assert_eq!((refused.quality, refused.unit.as_str()), (Quality::Bad(Reason::UnknownUnit), "unknown"));
    }

    #[test]
    fn r_dst_035_degrees_are_no_bar() {
        let reading = integer(Some("bar")).reading(Scale::IDENTITY, Some(0x002D_0000), Some(0));
        assert_eq!((reading.quality, reading.unit.as_str()), (Quality::Bad(Reason::OtherUnit), "°C"));
    }

    #[test]
    fn r_dst_032_digits_that_are_none_make_no_value() {
        for digits in [None, Some(10), Some(u32::MAX)] {
            let reading = integer(None).reading(Scale::IDENTITY, Some(BAR), digits);
            assert_eq!(reading.quality, Quality::Bad(Reason::UnknownDigits), "{digits:?}");
        }
    }

    #[test]
    fn the_scale_of_the_mapping_comes_before_the_conversion() {
        let tenths = Scale { divide: 10.0, ..Scale::IDENTITY };
        let device = DeviceUnit { digits: None, ..integer(Some("°C")) };
        let reading = device.reading(tenths, Some(0x00AC_0000), None);
        assert!((value(&reading, Value::Signed(500)) - 10.0).abs() < 1e-9);
    }
}
