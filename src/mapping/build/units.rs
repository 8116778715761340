//! Units and decimal digits that the device tells: which objects it is asked for, and what values are converted to.

use super::super::file::TagSection;
use super::super::table::{DEVICE_UNIT, DeviceUnit, FieldKind, Told};
use super::super::unit::Unit;
use super::super::{At, SourceText};
use super::items::{Entry, Item};
use super::problems::Problems;
use super::tags::Context;
use super::{boot, fields, node};
use crate::canopen::object::ObjectId;

/// Bytes of a unit's code, and of a number of digits.
const UNIT_BYTES: usize = 4;
const DIGITS_BYTES: usize = 1;

/// What the device tells of a tag beside its value; `None` where it is not asked.
pub fn device_unit(
    problems: &mut Problems,
    context: &Context<'_>,
    item: &Item<'_>,
    section: &TagSection,
) -> Option<DeviceUnit> {
    let source = context.source;
    let unit = item.element.fill(&section.unit);
    let kind = fields::parse(&section.kind.value).map(|(kind, _)| kind);
    if let Some(at) = &section.digits_object {
        if matches!(kind, Some(FieldKind::Float | FieldKind::Bool)) {
            let message =
                format!("`{}` is no whole number, so it has no decimal digits to be told", item.name);
            problems.error(
                source,
                &at.span,
                message,
                "leave `digits_object` out: a float is the value itself",
            );
        }
        if let Some(scale) = &section.scale {
            let message = format!("`{}` has both `scale` and `digits_object`", item.name);
            problems.error(source, &scale.span, message, "the digits are its scale: leave `scale` out");
        }
    }
    if section.unit_object.is_none() && unit == DEVICE_UNIT {
        let message = format!("`{}` is in the device's unit, but nothing says where that is told", item.name);
        problems.error(source, &item.span, message, "give it `unit_object`, for example \"0x6131:1\"");
    }
    let target = section.unit_object.as_ref().and_then(|at| {
        if kind == Some(FieldKind::Bool) {
            let message = format!("`{}` is a bit, which has no unit", item.name);
            problems.error(source, &at.span, message, "leave `unit_object` out");
        }
        target(problems, source, item, at, &unit)
    });
    let mut told = |at: &Option<At<String>>| {
        let at = at.as_ref().map(|at| At { value: item.element.fill(&at.value), span: at.span.clone() })?;
        let object = node::object(problems, source, &at)?;
        Some(Told { object, assumed: boot::set_to(context, object) })
    };
    let (unit, digits) = (told(&section.unit_object), told(&section.digits_object));
    (unit.is_some() || digits.is_some()).then_some(DeviceUnit { unit, digits, target })
}

/// Only what is read of the device has a unit that the device chooses.
pub fn refuse_device_unit(
    problems: &mut Problems,
    context: &Context<'_>,
    item: &Item<'_>,
    section: &TagSection,
    why: &str,
) {
    if section.unit == DEVICE_UNIT {
        let message = format!("`{}` {why}, so it is not in the device's unit", item.name);
        problems.error(
            context.source,
            &item.span,
            message,
            "write the unit that it has, or leave `unit` out",
        );
    }
}

/// What values are converted to; `None`: they stay as they are.
fn target(
    problems: &mut Problems,
    source: &SourceText,
    item: &Item<'_>,
    at: &At<String>,
    unit: &str,
) -> Option<Unit> {
    if unit == DEVICE_UNIT {
        return None;
    }
    let target = Unit::from_text(unit);
    if target.is_none() {
        let message = match unit {
            "" => format!("nothing says in which unit `{}` is to be shown", item.name),
            unit => format!("`{}` cannot be converted to `{unit}`, which is not known here", item.name),
        };
        let hint = format!(
            "write `unit = \"device\"`, or one of {}, pressures with any prefix: \"mbar\"",
            Unit::known()
        );
        problems.error(source, &at.span, message, hint);
    }
    target
}

/// The objects in which the device tells units and digits, each once, with their lengths in bytes.
pub fn objects(context: &Context<'_>) -> Vec<(ObjectId, usize)> {
    let mut objects: Vec<(ObjectId, usize)> = Vec::new();
    for item in &context.items.list {
        let Entry::Tag(section) = item.entry else { continue };
        for (at, length) in [(&section.unit_object, UNIT_BYTES), (&section.digits_object, DIGITS_BYTES)] {
            let object = at.as_ref().and_then(|at| item.element.fill(&at.value).parse::<ObjectId>().ok());
            if let Some(object) = object.filter(|object| objects.iter().all(|(known, _)| known != object)) {
                objects.push((object, length));
            }
        }
    }
    objects
}
