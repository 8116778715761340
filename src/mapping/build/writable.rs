//! Tags that are objects and may be written by SDO.

use super::super::At;
use super::super::file::TagSection;
use super::super::table::{DeviceUnit, Field, FieldKind, Scale, Source, WriteLimits};
use super::items::{Entry, Item};
use super::problems::Problems;
use super::tags::Context;
use super::{boot, rpdo};
use crate::canopen::object::ObjectId;

/// Below it are the objects by which the gateway itself knows and configures the device (CiA 301).
const FIRST_OBJECT: u16 = 0x2000;

/// Where the mapping says that the tag may be written by SDO.
pub fn asked(section: &TagSection) -> Option<&At<bool>> {
    section.writable.as_ref().filter(|at| at.value)
}

/// Whether a tag of the mapping may be written by SDO, so that there must be SDO with the node.
pub fn any(context: &Context<'_>) -> bool {
    context
        .items
        .list
        .iter()
        .any(|item| matches!(item.entry, Entry::Tag(section) if asked(section).is_some()))
}

/// What can be written to the object of a tag that a TPDO carries or that is polled; `None` where nothing can. `object` is
/// `None` where the tag names none, or none that can be read, which was told.
pub fn limits(
    problems: &mut Problems,
    context: &Context<'_>,
    item: &Item<'_>,
    section: &TagSection,
    (source, object, device_unit): (&Source, Option<ObjectId>, Option<&DeviceUnit>),
) -> Option<WriteLimits> {
    let Some(at) = asked(section) else {
        rpdo::refuse_limits(problems, context, section);
        return None;
    };
    let mut refuse = |message: String, hint: &str| problems.error(context.source, &at.span, message, hint);
    let name = &item.name;
    if section.object.is_none() {
        let message = format!("`{name}` names no object, so it cannot be written by SDO");
        refuse(message, "name its `object` instead of `tpdo` and `bit`, or leave `writable` out");
    }
    if let Some(object) = object.filter(|object| object.index < FIRST_OBJECT) {
        let message =
            format!("{object} belongs to the communication of the device, which the gateway looks after");
        refuse(
            message,
            "objects from 0x2000 on can be tags that are written; `cangate sdo write` writes every object",
        );
    }
    if device_unit.is_some() {
        let message = format!("`{name}` is shown otherwise than the device has it, so it cannot be written");
        refuse(message, "leave `unit_object` and `digits_object` out, or `writable`");
    }
    let (field, scale) = parts(source)?;
    if field.kind != FieldKind::Bool && !field.width.is_multiple_of(8) {
        let message =
            format!("no object is of the type `{}`, so `{name}` cannot be written", section.kind.value);
        refuse(message, "use bool or a type of whole bytes, or leave `writable` out");
    }
    if let Some(at) = &section.default {
        let message = format!("`{name}` is an object, so `default` means nothing");
        problems.error(
            context.source,
            &at.span,
            message,
            "leave it out; [[setup]] gives objects their values",
        );
    }
    if object.is_some_and(|object| boot::set_to(context, object).is_some()) {
        let message = format!(
            "`{name}` can be written, and [[setup]] writes the same object at each start of the node"
        );
        problems.warning(context.source, &at.span, message, "leave one of them out");
    }
    let limits = rpdo::limits(problems, context, item, section, (field, scale));
    Some(WriteLimits { default: None, ..limits })
}

fn parts(source: &Source) -> Option<(Field, Scale)> {
    match source {
        Source::Pdo { field, scale, .. }
        | Source::Polled { field, scale, .. }
        | Source::Adopted { field, scale, .. } => Some((*field, *scale)),
        Source::Emergency { .. } | Source::Rpdo { .. } | Source::Module { .. } | Source::Derived(_) => None,
    }
}
