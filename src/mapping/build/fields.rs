//! Bits of TPDOs: types, places, overlaps.

use std::ops::Range;

use super::super::file::TagSection;
use super::super::installation::ByteOrderWord;
use super::super::table::{Field, FieldKind};
use super::super::{At, SourceText};
use super::items::{Entry, Item};
use super::node::{self, Tpdo};
use super::problems::Problems;
use super::tags::{Context, Kind};
use crate::canopen::object::ObjectId;

/// The place of a TPDO that there is not; never in a finished table.
const NO_TPDO: usize = usize::MAX;

/// The kind and width that a type's word stands for.
pub fn parse(word: &str) -> Option<(FieldKind, u8)> {
    let number = |text: &str, lowest: u8| {
        let plain =
            text.len() <= 2 && !text.starts_with('0') && text.bytes().all(|byte| byte.is_ascii_digit());
        text.parse::<u8>().ok().filter(|width| plain && (lowest..=64).contains(width))
    };
    match word {
        "bool" => return Some((FieldKind::Bool, 1)),
        "f32" => return Some((FieldKind::Float, 32)),
        "f64" => return Some((FieldKind::Float, 64)),
        _ => {}
    }
    if let Some(width) = word.strip_prefix('u').and_then(|text| number(text, 1)) {
        return Some((FieldKind::Unsigned, width));
    }
    word.strip_prefix('i').and_then(|text| number(text, 2)).map(|width| (FieldKind::Signed, width))
}

/// The kind of a tag's value.
pub fn kind(section: &TagSection) -> Kind {
    match parse(&section.kind.value) {
        Some((FieldKind::Bool, _)) => Kind::Bool,
        Some((FieldKind::Unsigned, width)) if is_plain(section) => Kind::Bits(width),
        Some((FieldKind::Unsigned | FieldKind::Signed, width)) => Kind::Whole(width),
        Some((FieldKind::Float, _)) | None => Kind::Number,
    }
}

/// Whether the raw number is the value.
fn is_plain(section: &TagSection) -> bool {
    section.scale.is_none() && section.unit_object.is_none() && section.digits_object.is_none()
}

/// The TPDO and the bits of a tag.
pub fn field(
    problems: &mut Problems,
    context: &Context<'_>,
    item: &Item<'_>,
    section: &TagSection,
) -> (usize, Field) {
    let source = context.source;
    let stride = stride(problems, source, section);
    let Some((number, first)) = place(problems, context, item, section) else {
        let field = of_type(problems, context, section, 0);
        let span = section.object.as_ref().map_or(&item.span, |object| &object.span);
        check_byte_order(problems, source, span, &item.name, field);
        return (NO_TPDO, field);
    };
    let bit = first.value.saturating_add(item.element.index.saturating_mul(stride));
    let field = of_type(problems, context, section, bit);
    let (number_span, bit_span) = (&number.span, &first.span);
    let number = number.value;
    let pdo = context.tpdos.iter().position(|tpdo| tpdo.number == number);
    match pdo.and_then(|place| context.tpdos.get(place)) {
        // A TPDO whose entry is wrong has been told already.
        None if context.items.is_lost(&number.to_string()) || context.tpdos.iter().any(Tpdo::is_misnamed) => {
        }
        None => {
            let known: Vec<&str> = context.tpdos.iter().map(|tpdo| tpdo.key.value.as_str()).collect();
            let hint = if known.is_empty() {
                "declare it: [tpdo.1]".to_owned()
            } else {
                format!("declared are: {}", known.join(", "))
            };
            problems.error(source, number_span, format!("there is no [tpdo.{number}]"), hint);
        }
        Some(tpdo) => {
            let bits = tpdo.frame().length().unwrap_or(8).min(8) * 8;
            let last = bit.saturating_add(u64::from(field.width) - 1);
            if last >= bits {
                let message = format!(
                    "`{}` takes bits {bit} to {last}, but TPDO {number} has only {bits} bits",
                    item.name
                );
                let hint = "byte b bit i is bit 8 b + i; check `bit`, `type` and the `length` of the TPDO";
                problems.error(source, bit_span, message, hint);
            }
        }
    }
    check_byte_order(problems, source, bit_span, &item.name, field);
    (pdo.unwrap_or(NO_TPDO), field)
}

/// Bits from one element of an array to the next.
pub fn stride(problems: &mut Problems, source: &SourceText, section: &TagSection) -> u64 {
    let width = parse(&section.kind.value).map_or(1, |(_, width)| width);
    let stride = section.array.as_ref().and_then(|array| array.value.bit_stride.as_ref());
    stride.map_or(u64::from(width), |stride| problems.within(source, stride, "bit_stride", 1..=64))
}

/// The field of a tag that begins at this bit.
pub fn of_type(problems: &mut Problems, context: &Context<'_>, section: &TagSection, bit: u64) -> Field {
    let (kind, width) = parse(&section.kind.value).unwrap_or_else(|| {
        let message = format!("there is no type `{}`", section.kind.value);
        let hint = "use bool, u1 to u64, i2 to i64, f32 or f64";
        problems.error(context.source, &section.kind.span, message, hint);
        (FieldKind::Unsigned, 1)
    });
    Field {
        bit: u8::try_from(bit).unwrap_or(u8::MAX),
        width,
        kind,
        big_endian: section.byte_order == ByteOrderWord::Big,
        invert: section.invert,
    }
}

/// Where a tag stands: as it is written, or where the TPDO that maps its object has it.
fn place(
    problems: &mut Problems,
    context: &Context<'_>,
    item: &Item<'_>,
    section: &TagSection,
) -> Option<(At<u64>, At<u64>)> {
    let source = context.source;
    match (&section.tpdo, &section.bit, &section.object) {
        (Some(tpdo), Some(bit), None) => {
            if let Some(at) = &section.poll_ms {
                let message = format!("`{}` stands in a TPDO, so `poll_ms` means nothing", item.name);
                problems.error(source, &at.span, message, "leave it out; it is for tags with `object`");
            }
            if context.tpdos.iter().any(|known| known.number == tpdo.value && known.is_adopted()) {
                let message =
                    format!("where `{}` stands in TPDO {} is for the device to say", item.name, tpdo.value);
                problems.error(source, &tpdo.span, message, "name its `object` instead of `tpdo` and `bit`");
            }
            Some((tpdo.clone(), bit.clone()))
        }
        (None, None, Some(object)) => {
            let id = node::object(problems, source, object)?;
            refuse_array(problems, source, section);
            let maps = context.tpdos.iter().flat_map(|tpdo| &tpdo.section.maps);
            check_width(problems, source, section, (object, id), maps);
            let found = node::in_pdo(context, id);
            if found.is_none() && section.poll_ms.is_none() && node::adopted(context, section).is_none() {
                let message = format!("no TPDO maps {id}, so `{}` would never have a value", item.name);
                problems.error(
                    source,
                    &object.span,
                    message,
                    "add it to `maps` of a TPDO, or give it a `poll_ms`",
                );
            }
            let at = |value| At { value, span: object.span.clone() };
            found.map(|(number, bit)| (at(number), at(bit)))
        }
        _ => {
            let message =
                format!("`{}` needs either `tpdo` and `bit`, or `object`, or `emergency`", item.name);
            problems.error(source, &item.span, message, "write where it stands, or which object it is");
            None
        }
    }
}

/// All elements of an array would be the same object.
pub fn refuse_array(problems: &mut Problems, source: &SourceText, section: &TagSection) {
    if let Some(array) = &section.array {
        let message = "an array cannot be one object";
        problems.error(source, &array.span, message, "write an entry for each object");
    }
}

/// A PDO that carries fewer bits of an object than its type has would leave the rest to its neighbour.
pub fn check_width<'a>(
    problems: &mut Problems,
    source: &SourceText,
    section: &TagSection,
    (object, id): (&At<String>, ObjectId),
    maps: impl IntoIterator<Item = &'a At<String>>,
) {
    let bits =
        maps.into_iter().filter_map(|entry| node::mapped(&entry.value)).find(|entry| entry.object == id);
    if let Some((bits, (_, width))) = bits.map(|entry| entry.bits).zip(parse(&section.kind.value))
        && width > bits
    {
        let message = format!("{id} is mapped with {bits} bits, but `{}` has {width}", section.kind.value);
        problems.error(source, &object.span, message, "let `type` and `maps` agree");
    }
}

/// The poll of a tag whose object no TPDO maps, by its place among the polls of the node.
pub fn poll(context: &Context<'_>, item: &Item<'_>) -> Option<usize> {
    let mut place = 0;
    for other in &context.items.list {
        let Entry::Tag(section) = other.entry else { continue };
        if node::polled(context, section).is_some() {
            if other.name == item.name {
                return Some(place);
            }
            place += 1;
        }
    }
    None
}

/// The field of a polled object: all of its bytes.
pub fn whole(section: &TagSection) -> Option<Field> {
    let (kind, width) = parse(&section.kind.value)?;
    let big_endian = section.byte_order == ByteOrderWord::Big;
    Some(Field { bit: 0, width, kind, big_endian, invert: section.invert })
}

/// Only whole bytes can be turned round.
pub fn check_byte_order(
    problems: &mut Problems,
    source: &SourceText,
    span: &Range<usize>,
    name: &str,
    field: Field,
) {
    if field.big_endian && (!field.bit.is_multiple_of(8) || !field.width.is_multiple_of(8)) {
        let message =
            format!("`{name}` does not consist of whole bytes, so byte_order = \"big\" means nothing");
        problems.error(source, span, message, "give it whole bytes, or leave the byte order out");
    }
}

/// Bits of one TPDO that two tags use, or that the maker calls reserved.
pub fn check_overlaps(problems: &mut Problems, context: &Context<'_>, fields: &[(usize, usize, Field)]) {
    let mut used: Vec<(usize, Range<u16>, usize)> = fields
        .iter()
        .filter(|(_, pdo, _)| *pdo != NO_TPDO)
        .map(|(item, pdo, field)| {
            let first = u16::from(field.bit);
            (*pdo, first..first + u16::from(field.width), *item)
        })
        .collect();
    used.sort_by_key(|(pdo, bits, item)| (*pdo, bits.start, *item));
    let mut furthest: Option<&(usize, Range<u16>, usize)> = None;
    for next in &used {
        let before = furthest.filter(|(pdo, _, _)| *pdo == next.0);
        if let Some((_, bits, item)) = before
            && next.1.start < bits.end
            && let (Some(one), Some(other)) = (context.items.get(*item), context.items.get(next.2))
        {
            let message = format!("`{}` and `{}` share bit {}", one.name, other.name, next.1.start);
            problems.warning(context.source, &other.span, message, "check `bit` and `type` of both");
        }
        if before.is_none_or(|(_, bits, _)| bits.end < next.1.end) {
            furthest = Some(next);
        }
    }
    for (pdo, bits, item) in &used {
        let reserved = context.tpdos.get(*pdo).map_or(0, Tpdo::reserved_bits);
        let mask = bits.clone().filter(|bit| *bit < 64).fold(0u64, |mask, bit| mask | 1 << bit);
        if reserved & mask != 0
            && let Some(item) = context.items.get(*item)
        {
            let message = format!("`{}` uses a bit that reserved_bits names", item.name);
            problems.warning(context.source, &item.span, message, "take the bit out of one of them");
        }
    }
}

/// The fields of all tags: item, TPDO, bits.
pub fn all(
    context: &Context<'_>,
    tags: &[super::super::table::TagDef],
    places: &[usize],
) -> Vec<(usize, usize, Field)> {
    use super::super::table::Source;
    let mut fields = Vec::new();
    for (item, place) in places.iter().enumerate() {
        if let (Some(Source::Pdo { pdo, field, .. }), Some(Entry::Tag(_))) =
            (tags.get(*place).map(|tag| &tag.source), context.items.get(item).map(|item| item.entry))
        {
            fields.push((item, *pdo, *field));
        }
    }
    fields
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn types_are_bool_whole_numbers_and_floats() {
        assert_eq!(parse("bool"), Some((FieldKind::Bool, 1)));
        assert_eq!(parse("u64"), Some((FieldKind::Unsigned, 64)));
        assert_eq!(parse("i2"), Some((FieldKind::Signed, 2)));
        assert_eq!(parse("f32"), Some((FieldKind::Float, 32)));
        for word in ["u0", "u65", "i1", "u08", "f16", "u", "int", "u+8", "u256"] {
            assert_eq!(parse(word), None, "{word}");
        }
    }
}
