//! Raw bits to values, values to registers' numbers. Called for every tag of every frame: no allocation, no loop.

use super::table::{Encoding, Field, FieldKind, Scale};
use crate::process_image::Value;

/// The raw value of a field; `None` where the data is too short for it, or the field is none (see [`Field`]).
/// Data after the eighth byte is not looked at.
#[must_use]
#[inline]
pub fn decode(field: &Field, data: &[u8]) -> Option<Value> {
    let bits = bits(*field, data)?;
    Some(match field.kind {
        FieldKind::Bool => Value::Bool(bits != 0),
        FieldKind::Unsigned => Value::Unsigned(bits),
        FieldKind::Signed => Value::Signed(sign_extended(bits, field.width)),
        FieldKind::Float if field.width == 32 => {
            Value::Float(f64::from(f32::from_bits(u32::try_from(bits).ok()?)))
        }
        FieldKind::Float => Value::Float(f64::from_bits(bits)),
    })
}

/// The bits of a field, least significant first, byte order and inversion already seen to.
#[inline]
fn bits(field: Field, data: &[u8]) -> Option<u64> {
    let (bit, width) = (u32::from(field.bit), u32::from(field.width));
    let mut padded = [0; 8];
    let length = data.len().min(8);
    padded.get_mut(..length)?.copy_from_slice(data.get(..length)?);
    if width == 0 || u32::try_from(length).ok()? * 8 < bit + width {
        return None;
    }
    let mask = u64::MAX >> (64 - width);
    let mut bits = (u64::from_le_bytes(padded) >> bit) & mask;
    if field.big_endian {
        // The field's bytes are the lowest ones now; swapped they are the highest ones.
        bits = bits.swap_bytes() >> (64 - width);
    }
    Some(if field.invert { bits ^ mask } else { bits })
}

#[expect(
    clippy::as_conversions,
    clippy::cast_possible_wrap,
    reason = "the bits are meant to be taken as two's complement"
)]
#[inline]
fn sign_extended(bits: u64, width: u8) -> i64 {
    let unused = 64 - u32::from(width);
    ((bits << unused) as i64) >> unused
}

/// The value in engineering units. A bool stays a bool and an unscaled number stays as it is.
#[must_use]
#[inline]
pub fn scale(scale: &Scale, raw: Value) -> Value {
    if matches!(raw, Value::Bool(_)) || *scale == Scale::IDENTITY {
        return raw;
    }
    Value::Float(raw.as_f64() * scale.multiply / scale.divide + scale.add)
}

/// Why a value cannot be written into a field.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum EncodeError {
    /// A bit takes true and false, or 1 and 0.
    #[error("it is a bit: write true or false")]
    NotABit,
    /// A number takes no truth.
    #[error("it is a number: write a number")]
    NotANumber,
    /// NaN and infinity are for nobody to act on.
    #[error("NaN and infinity cannot be written")]
    NotFinite,
    /// It does not fit into the bits.
    #[error("it is out of the range of its type")]
    OutOfRange,
    /// The field does not lie in eight bytes.
    #[error("the field does not lie in the PDO")]
    NoField,
}

/// Puts a value, in engineering units, into the bits of a field: [`decode`] and [`scale`] backwards. A number is rounded to
/// the nearest that the field can hold, halves away from zero. On an error `data` is as it was.
pub fn encode(field: &Field, scale: &Scale, value: Value, data: &mut [u8; 8]) -> Result<(), EncodeError> {
    let (bit, width) = (u32::from(field.bit), u32::from(field.width));
    if width == 0 || bit + width > 64 {
        return Err(EncodeError::NoField);
    }
    let mask = u64::MAX >> (64 - width);
    let mut bits = match field.kind {
        FieldKind::Bool => u64::from(truth(value).ok_or(EncodeError::NotABit)?),
        FieldKind::Unsigned => whole_bits(unscaled_whole(scale, value)?, 0, i128::from(mask))?,
        FieldKind::Signed => {
            let highest = i128::from(mask >> 1);
            whole_bits(unscaled_whole(scale, value)?, -highest - 1, highest)?
        }
        FieldKind::Float => float_bits(unscaled(scale, value)?, width)?,
    } & mask;
    if field.invert {
        bits ^= mask;
    }
    if field.big_endian {
        bits = bits.swap_bytes() >> (64 - width);
    }
    *data = ((u64::from_le_bytes(*data) & !(mask << bit)) | (bits << bit)).to_le_bytes();
    Ok(())
}

fn truth(value: Value) -> Option<bool> {
    match value {
        Value::Bool(bit) => Some(bit),
        Value::Unsigned(_) | Value::Signed(_) | Value::Float(_) if value.as_f64() == 0.0 => Some(false),
        Value::Unsigned(1) | Value::Signed(1) | Value::Float(1.0) => Some(true),
        Value::Unsigned(_) | Value::Signed(_) | Value::Float(_) => None,
    }
}

/// The raw number of a value.
fn unscaled(scale: &Scale, value: Value) -> Result<f64, EncodeError> {
    let number = match value {
        Value::Bool(_) => return Err(EncodeError::NotANumber),
        Value::Unsigned(_) | Value::Signed(_) | Value::Float(_) => value.as_f64(),
    };
    let raw =
        if *scale == Scale::IDENTITY { number } else { (number - scale.add) * scale.divide / scale.multiply };
    match (number.is_finite(), raw.is_finite()) {
        (false, _) => Err(EncodeError::NotFinite),
        (true, false) => Err(EncodeError::OutOfRange),
        (true, true) => Ok(raw),
    }
}

/// The same, rounded; without a scale all digits are kept.
fn unscaled_whole(scale: &Scale, value: Value) -> Result<i128, EncodeError> {
    match value {
        Value::Unsigned(number) if *scale == Scale::IDENTITY => Ok(number.into()),
        Value::Signed(number) if *scale == Scale::IDENTITY => Ok(number.into()),
        Value::Bool(_) | Value::Unsigned(_) | Value::Signed(_) | Value::Float(_) => {
            #[expect(
                clippy::as_conversions,
                clippy::cast_possible_truncation,
                reason = "saturates, and whatever is so large is out of every range"
            )]
            let whole = unscaled(scale, value)?.round() as i128;
            Ok(whole)
        }
    }
}

/// The two's complement of a whole number, within limits.
fn whole_bits(number: i128, lowest: i128, highest: i128) -> Result<u64, EncodeError> {
    if !(lowest..=highest).contains(&number) {
        return Err(EncodeError::OutOfRange);
    }
    u64::try_from(number & i128::from(u64::MAX)).map_err(|_| EncodeError::OutOfRange)
}

fn float_bits(number: f64, width: u32) -> Result<u64, EncodeError> {
    if width != 32 {
        return Ok(number.to_bits());
    }
    #[expect(
        clippy::as_conversions,
        clippy::cast_possible_truncation,
        reason = "the nearest single-precision number"
    )]
    let single = number as f32;
    if single.is_finite() { Ok(single.to_bits().into()) } else { Err(EncodeError::OutOfRange) }
}

/// A value as registers, high word first; of an encoding that takes one register the first counts, the second is 0.
///
/// `value` is in engineering units, `resolution` is that of the [`RegisterDef`](super::RegisterDef), `raw` is shown by the raw
/// encodings. Whole numbers are rounded to the nearest (halves away from zero) and saturate; signed ones stop one short of
/// their lowest number, which means "invalid". A value that is not `usable`, or not a number, gives the invalid pattern of
/// [`Encoding`].
#[must_use]
pub fn registers(encoding: Encoding, resolution: f64, value: Value, raw: Value, usable: bool) -> [u16; 2] {
    if !usable {
        return invalid(encoding);
    }
    let counts = value.as_f64() / resolution;
    match encoding {
        Encoding::Bool => [u16::from(value.is_true()), 0],
        Encoding::Raw16 => [low_word(raw_bits(raw)), 0],
        Encoding::Raw32 => words(low_double_word(raw_bits(raw))),
        Encoding::F32 => float_words(value.as_f64()),
        Encoding::U16 | Encoding::I16 | Encoding::U32 | Encoding::I32 if counts.is_nan() => invalid(encoding),
        Encoding::U16 => [low_word(saturated(counts, 0.0, f64::from(u16::MAX))), 0],
        Encoding::I16 => [low_word(saturated(counts, f64::from(-i16::MAX), f64::from(i16::MAX))), 0],
        Encoding::U32 => words(low_double_word(saturated(counts, 0.0, f64::from(u32::MAX)))),
        Encoding::I32 => words(low_double_word(saturated(counts, f64::from(-i32::MAX), f64::from(i32::MAX)))),
    }
}

/// What an encoding shows of a value that must not be used.
#[must_use]
pub fn invalid(encoding: Encoding) -> [u16; 2] {
    match encoding {
        Encoding::Bool => [0, 0],
        Encoding::U16 | Encoding::Raw16 => [0xFFFF, 0],
        Encoding::I16 | Encoding::I32 => [0x8000, 0],
        Encoding::U32 | Encoding::Raw32 => [0xFFFF, 0xFFFF],
        Encoding::F32 => [0x7FC0, 0],
    }
}

fn float_words(value: f64) -> [u16; 2] {
    #[expect(
        clippy::as_conversions,
        clippy::cast_possible_truncation,
        reason = "the nearest single-precision number"
    )]
    let single = value as f32;
    if single.is_nan() { invalid(Encoding::F32) } else { words(single.to_bits()) }
}

/// Rounded and kept within two limits, as the bits of a two's complement number.
#[expect(
    clippy::as_conversions,
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "within the limits of 33 bits, and the bits are meant to be taken as two's complement"
)]
fn saturated(counts: f64, lowest: f64, highest: f64) -> u64 {
    counts.round().clamp(lowest, highest) as i64 as u64
}

/// The bits of a raw value; a negative number has all its upper ones set.
#[must_use]
pub fn raw_bits(raw: Value) -> u64 {
    match raw {
        Value::Bool(bit) => u64::from(bit),
        Value::Unsigned(number) => number,
        Value::Signed(number) => number.cast_unsigned(),
        Value::Float(number) => number.to_bits(),
    }
}

fn low_word(bits: u64) -> u16 {
    let [first, second, ..] = bits.to_le_bytes();
    u16::from_le_bytes([first, second])
}

fn low_double_word(bits: u64) -> u32 {
    let [first, second, third, fourth, ..] = bits.to_le_bytes();
    u32::from_le_bytes([first, second, third, fourth])
}

fn words(double: u32) -> [u16; 2] {
    let [first, second, third, fourth] = double.to_be_bytes();
    [u16::from_be_bytes([first, second]), u16::from_be_bytes([third, fourth])]
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const PERCENT: Scale = Scale { multiply: 100.0, divide: 255.0, add: 0.0 };

    fn field(bit: u8, width: u8, kind: FieldKind) -> Field {
        Field { bit, width, kind, big_endian: false, invert: false }
    }

    /// One bit after the other, as the documentation of `Field` says.
    fn naive(field: Field, data: &[u8]) -> Option<u64> {
        let places: Vec<usize> =
            (usize::from(field.bit)..usize::from(field.bit) + usize::from(field.width)).collect();
        let mut bits: Vec<bool> = Vec::new();
        for place in places {
            let bit = data.get(place / 8)? >> (place % 8) & 1 == 1;
            bits.push(bit != field.invert);
        }
        if field.big_endian {
            bits = bits.chunks(8).rev().flatten().copied().collect();
        }
        Some(bits.iter().rev().fold(0, |number, bit| number << 1 | u64::from(*bit)))
    }

    fn any_field() -> impl Strategy<Value = Field> {
        (0u8..64, any::<bool>(), any::<bool>())
            .prop_flat_map(|(bit, big_endian, invert)| {
                (Just(bit), 1..=64 - bit, Just(big_endian), Just(invert))
            })
            .prop_map(|(bit, width, big_endian, invert)| {
                let big_endian = big_endian && width % 8 == 0;
                Field { bit, width, kind: FieldKind::Unsigned, big_endian, invert }
            })
    }

    proptest! {
        #[test]
        fn decoding_agrees_with_a_bit_by_bit_model(field in any_field(), data in proptest::collection::vec(any::<u8>(), 0..=8)) {
            let expected = naive(field, &data);
            prop_assert_eq!(decode(&field, &data), expected.map(Value::Unsigned));
            let signed = Field { kind: FieldKind::Signed, ..field };
            let model = expected.map(|bits| {
                let sign = bits >> (field.width - 1) & 1 == 1;
                let value = i128::from(bits) - if sign { 1i128 << field.width } else { 0 };
                Value::Signed(i64::try_from(value).unwrap())
            });
            prop_assert_eq!(decode(&signed, &data), model);
        }

        #[test]
        fn floats_come_back_as_sent(single in any::<f32>(), double in any::<f64>()) {
            let read = decode(&field(0, 32, FieldKind::Float), &single.to_le_bytes()).unwrap();
            prop_assert_eq!(read.as_f64().to_bits(), f64::from(single).to_bits());
            let big = Field { big_endian: true, ..field(0, 64, FieldKind::Float) };
            prop_assert_eq!(decode(&big, &double.to_be_bytes()).unwrap().as_f64().to_bits(), double.to_bits());
        }

        #[test]
        fn whole_numbers_survive_their_registers(number in any::<u32>(), signed in -i32::MAX..=i32::MAX) {
            let [high, low] = registers(Encoding::U32, 1.0, Value::Unsigned(number.into()), Value::Bool(false), true);
            prop_assert_eq!(u32::from(high) << 16 | u32::from(low), number);
            let [high, low] = registers(Encoding::I32, 1.0, Value::Signed(signed.into()), Value::Bool(false), true);
            prop_assert_eq!((u32::from(high) << 16 | u32::from(low)).cast_signed(), signed);
        }
    }

    /// Fields of every kind, width and place, with what decodes to a value that can be written.
    fn any_typed_field() -> impl Strategy<Value = Field> {
        (any_field(), 0..4).prop_map(|(field, kind)| match kind {
            0 => Field { kind: FieldKind::Signed, ..field },
            1 => Field { kind: FieldKind::Bool, width: 1, big_endian: false, ..field },
            2 => {
                let width = if field.bit == 0 { 64 } else { 32 };
                Field {
                    kind: FieldKind::Float,
                    bit: field.bit.min(64 - width),
                    width,
                    big_endian: false,
                    ..field
                }
            }
            _ => field,
        })
    }

    proptest! {
        #[test]
        fn what_was_decoded_is_encoded_to_the_same_bits(
            field in any_typed_field(), data in any::<[u8; 8]>(), around in any::<[u8; 8]>()
        ) {
            let value = decode(&field, &data).unwrap();
            let mut written = around;
            match encode(&field, &Scale::IDENTITY, value, &mut written) {
                Ok(()) => {
                    prop_assert_eq!(decode(&field, &written).unwrap(), value);
                    let place = (u64::MAX >> (64 - field.width)) << field.bit;
                    let apart = u64::from_le_bytes(written) ^ u64::from_le_bytes(around);
                    prop_assert_eq!(apart & !place, 0, "its neighbours are as they were");
                    let theirs = u64::from_le_bytes(written) ^ u64::from_le_bytes(data);
                    prop_assert_eq!(theirs & place, 0);
                }
                Err(error) => {
                    prop_assert_eq!(error, EncodeError::NotFinite);
                    prop_assert!(!value.as_f64().is_finite());
                    prop_assert_eq!(written, around);
                }
            }
        }

        #[test]
        fn a_scaled_number_comes_back_from_its_value(
            field in any_field(), signed in any::<bool>(), data in any::<[u8; 8]>(),
            multiply in prop_oneof![Just(100.0), Just(0.1), Just(-0.001), Just(1.0)],
            divide in prop_oneof![Just(255.0), Just(1.0), Just(10.0)],
            add in prop_oneof![Just(0.0), Just(-273.15), Just(40.0)],
        ) {
            let kind = if signed { FieldKind::Signed } else { FieldKind::Unsigned };
            // Beyond that a double cannot tell a number from the next one.
            let field = Field { kind, ..field };
            prop_assume!(field.width <= 40);
            let factors = Scale { multiply, divide, add };
            let raw = decode(&field, &data).unwrap();
            let mut written = [0; 8];
            encode(&field, &factors, scale(&factors, raw), &mut written).unwrap();
            prop_assert_eq!(decode(&field, &written), Some(raw));
        }
    }

    #[test]
    fn what_does_not_fit_is_refused_and_not_cut() {
        let into = |width, kind, value| {
            let mut data = [0; 8];
            encode(&field(0, width, kind), &Scale::IDENTITY, value, &mut data).map(|()| data[0])
        };
        assert_eq!(into(8, FieldKind::Unsigned, Value::Float(255.4)), Ok(255), "rounded");
        assert_eq!(into(8, FieldKind::Unsigned, Value::Float(255.5)), Err(EncodeError::OutOfRange));
        assert_eq!(into(8, FieldKind::Unsigned, Value::Signed(-1)), Err(EncodeError::OutOfRange));
        assert_eq!(into(8, FieldKind::Signed, Value::Signed(-128)), Ok(0x80));
        assert_eq!(into(8, FieldKind::Signed, Value::Signed(128)), Err(EncodeError::OutOfRange));
        assert_eq!(into(8, FieldKind::Unsigned, Value::Float(f64::NAN)), Err(EncodeError::NotFinite));
        assert_eq!(into(8, FieldKind::Unsigned, Value::Bool(true)), Err(EncodeError::NotANumber));
        assert_eq!(into(32, FieldKind::Float, Value::Float(1e39)), Err(EncodeError::OutOfRange));
        assert_eq!(into(1, FieldKind::Bool, Value::Unsigned(1)), Ok(1));
        assert_eq!(into(1, FieldKind::Bool, Value::Unsigned(2)), Err(EncodeError::NotABit));
        assert_eq!(into(0, FieldKind::Unsigned, Value::Unsigned(0)), Err(EncodeError::NoField));
        assert_eq!(into(64, FieldKind::Unsigned, Value::Float(1e300)), Err(EncodeError::OutOfRange));
    }

    #[test]
    fn r_det_048_all_256_raw_values_give_the_documented_hundredths_of_a_percent() {
        for raw in 0u16..=255 {
            let value = scale(&PERCENT, Value::Unsigned(raw.into()));
            let expected = u16::try_from((u32::from(raw) * 10_000 + 127) / 255).unwrap();
            let shown = registers(Encoding::U16, 0.01, value, Value::Unsigned(raw.into()), true);
            assert_eq!(shown, [expected, 0], "raw {raw}");
            let shown = registers(Encoding::Raw16, 1.0, value, Value::Unsigned(raw.into()), true);
            assert_eq!(shown, [raw, 0]);
        }
    }

    #[test]
    fn r_det_047_0_is_0_and_255_is_100_percent() {
        assert_eq!(scale(&PERCENT, Value::Unsigned(0)), Value::Float(0.0));
        assert_eq!(scale(&PERCENT, Value::Unsigned(255)), Value::Float(100.0));
    }

    #[test]
    fn r_det_050_byte_order_of_the_sensor_fields() {
        let frame = [0x00, 0x00, 0x01, 0x80, 0x00, 0x01, 0x00, 0x00];
        let used = field(16, 16, FieldKind::Unsigned);
        assert_eq!(decode(&used, &frame), Some(Value::Unsigned(0x8001)));
        assert_eq!(decode(&Field { big_endian: true, ..used }, &frame), Some(Value::Unsigned(0x0180)));
    }

    #[test]
    fn r_det_051_an_inverted_bit_is_true_when_clear() {
        let inverted = Field { invert: true, ..field(1, 1, FieldKind::Bool) };
        assert_eq!(decode(&inverted, &[0b0000_0000]), Some(Value::Bool(true)));
        assert_eq!(decode(&inverted, &[0b0000_0010]), Some(Value::Bool(false)));
    }

    #[test]
    fn a_field_beyond_the_data_is_no_value() {
        assert_eq!(decode(&field(8, 8, FieldKind::Unsigned), &[1]), None);
        assert_eq!(decode(&field(0, 0, FieldKind::Unsigned), &[1]), None);
        assert_eq!(decode(&field(255, 64, FieldKind::Unsigned), &[0; 8]), None);
    }

    #[test]
    fn registers_saturate_and_never_show_the_signed_invalid_pattern() {
        let shown = |encoding, value| registers(encoding, 1.0, Value::Float(value), Value::Bool(false), true);
        assert_eq!(shown(Encoding::U16, -1.0), [0, 0]);
        assert_eq!(shown(Encoding::U16, 1e9), [0xFFFF, 0]);
        assert_eq!(shown(Encoding::I16, -1e9), [0x8001, 0]);
        assert_eq!(shown(Encoding::I16, f64::INFINITY), [0x7FFF, 0]);
        assert_eq!(shown(Encoding::I32, f64::NEG_INFINITY), [0x8000, 1]);
        assert_eq!(shown(Encoding::U32, 1e99), [0xFFFF, 0xFFFF]);
        assert_eq!(shown(Encoding::I16, -2.5), [0xFFFD, 0]);
        assert_eq!(shown(Encoding::F32, 1234.5), [0x449A, 0x5000]);
        assert_eq!(shown(Encoding::F32, f64::NAN), [0x7FC0, 0]);
        assert_eq!(shown(Encoding::U16, f64::NAN), [0xFFFF, 0]);
    }

    #[test]
    fn an_unusable_value_shows_its_invalid_pattern() {
        for (encoding, pattern) in [
            (Encoding::U16, [0xFFFF, 0]),
            (Encoding::I16, [0x8000, 0]),
            (Encoding::U32, [0xFFFF, 0xFFFF]),
            (Encoding::I32, [0x8000, 0]),
            (Encoding::Raw16, [0xFFFF, 0]),
            (Encoding::F32, [0x7FC0, 0]),
        ] {
            let shown = registers(encoding, 1.0, Value::Unsigned(5), Value::Unsigned(5), false);
            assert_eq!(shown, pattern, "{encoding:?}");
        }
    }

    #[test]
    fn an_unscaled_number_keeps_all_its_digits() {
        assert_eq!(scale(&Scale::IDENTITY, Value::Unsigned(u64::MAX)), Value::Unsigned(u64::MAX));
        assert_eq!(scale(&PERCENT, Value::Bool(true)), Value::Bool(true));
    }
}
