//! Emergency messages: which errors have alarms of their own, and tags that show what was told.

use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;

use super::super::builtin::BUS_TROUBLE_OR_LOST;
use super::super::file::{EmergencyWord, ErrorSection, TagSection};
use super::super::installation::ByteOrderWord;
use super::super::table::{
    AlarmCondition, AlarmDef, AlarmOwner, BuiltIn, EmergencyDef, EmergencyPart, ErrorDef, Field, FieldKind,
};
use super::alarms::{self, Draft};
use super::fields;
use super::items::Item;
use super::problems::Problems;
use super::tags::Context;
use crate::canopen::object::ObjectId;
use crate::canopen::polls::Poll;

/// Error register.
const ERROR_REGISTER: ObjectId = ObjectId::new(0x1001, 0);

/// The poll of the error register, where the mapping asks for it.
pub fn poll(problems: &mut Problems, context: &Context<'_>) -> Option<Poll> {
    let at = context.file.emergency.register_poll_ms.as_ref()?;
    let millis = problems.within(context.source, at, "register_poll_ms", 100..=86_400_000);
    let read_by_boot = context.file.emergency.read_at_boot;
    let period = Duration::from_millis(millis);
    Some(Poll { object: ERROR_REGISTER, period, length: 1, read_by_boot, unless_sent: None })
}

/// The errors that the mapping names. The poll of the error register is the last of `polls`.
pub fn definition(problems: &mut Problems, context: &Context<'_>, polls: &[Poll]) -> EmergencyDef {
    let section = &context.file.emergency;
    let errors: Vec<ErrorDef> =
        section.error.iter().map(|section| error(problems, context, section)).collect();
    check_codes(problems, context, &errors);
    let polled = section.register_poll_ms.is_some();
    EmergencyDef { errors, register_poll: polls.len().checked_sub(1).filter(|_| polled) }
}

fn error(problems: &mut Problems, context: &Context<'_>, section: &ErrorSection) -> ErrorDef {
    let source = context.source;
    let number = |number: u64| u16::try_from(number).unwrap_or(u16::MAX);
    let code = problems.within(source, &section.code, "code", 0..=0xFFFF);
    let mask = section.mask.as_ref().map(|at| problems.within(source, at, "mask", 1..=0xFFFF));
    let (code, mask) = (number(code), mask.map_or(u16::MAX, number));
    if code == 0 {
        let hint = "0 says that no error is left; name the codes of errors";
        problems.error(source, &section.code.span, "0 is not the code of an error", hint);
    } else if code & !mask != 0 {
        let message =
            format!("code 0x{code:04X} has bits that mask 0x{mask:04X} leaves out, so it never matches");
        let hint = format!("use code 0x{:04X}, or another mask", code & mask);
        problems.error(source, &section.code.span, message, hint);
    }
    let bit = section.register_bit.as_ref().map(|at| problems.within(source, at, "register_bit", 1..=7));
    ErrorDef {
        code,
        mask,
        name: section.name.value.clone(),
        register_bit: bit.and_then(|bit| u8::try_from(bit).ok()),
    }
}

/// Two entries may match the same code only where one of them is the more exact.
fn check_codes(problems: &mut Problems, context: &Context<'_>, errors: &[ErrorDef]) {
    for (place, (error, section)) in errors.iter().zip(&context.file.emergency.error).enumerate() {
        let before = errors.iter().take(place);
        let clash = before.into_iter().find(|other| {
            let common = error.mask & other.mask;
            let overlap = (error.code ^ other.code) & common == 0;
            let one_is_exacter = error.mask != other.mask && (common == error.mask || common == other.mask);
            overlap && !one_is_exacter
        });
        if let Some(other) = clash {
            let message = format!("errors `{}` and `{}` have codes in common", other.name, error.name);
            let hint = "give each its own code; a class may hold a code that is named by itself";
            problems.error(context.source, &section.code.span, message, hint);
        }
    }
}

/// The alarms of the errors.
pub fn alarms(
    problems: &mut Problems,
    context: &Context<'_>,
    known: &mut BTreeSet<String>,
    names: &mut BTreeMap<String, usize>,
) -> Vec<Draft> {
    let mut drafts = Vec::new();
    for (place, section) in context.file.emergency.error.iter().enumerate() {
        check_bit(problems, context, section);
        alarms::check_name(problems, context, &section.name.span, &section.name.value, known, names);
        known.insert(section.name.value.clone());
        let (draft, enabled) = draft(problems, context, section, place);
        if enabled {
            drafts.push(draft);
        }
    }
    drafts
}

/// Errors may share a bit with each other, and with no other alarm.
fn check_bit(problems: &mut Problems, context: &Context<'_>, section: &ErrorSection) {
    let Some(bit) = &section.bit else { return };
    problems.within(context.source, bit, "bit", 16..=31);
    let same = |other: &u64| *other == bit.value;
    let other =
        context.file.alarm.iter().find(|alarm| alarm.bit.as_ref().is_some_and(|bit| same(&bit.value)));
    if let Some(other) = other {
        let message = format!(
            "error `{}` and alarm `{}` have the same bit {}",
            section.name.value, other.name.value, bit.value
        );
        problems.error(context.source, &bit.span, message, "give the error another bit of 16 to 31");
    }
}

fn draft(
    problems: &mut Problems,
    context: &Context<'_>,
    section: &ErrorSection,
    place: usize,
) -> (Draft, bool) {
    let source = context.source;
    let mut delay = |at, what| alarms::delay(problems, source, at, what, Duration::ZERO);
    let mut alarm = AlarmDef {
        name: section.name.value.clone(),
        owner: AlarmOwner::Node(context.node),
        condition: AlarmCondition::BuiltIn(BuiltIn::NamedError(place)),
        priority: section.priority.into(),
        on_delay: delay(section.on_delay_ms.as_ref(), "on_delay_ms"),
        off_delay: delay(section.off_delay_ms.as_ref(), "off_delay_ms"),
        latch: section.latch,
        suppressed_by: Vec::new(),
        first_out: section.first_out,
        bit: section.bit.as_ref().and_then(|bit| u8::try_from(bit.value).ok()),
        value: None,
        text: section.text.clone(),
        action: section.action.clone(),
    };
    let enabled =
        alarms::change_by_installation(problems, context, &mut alarm, section.enabled.unwrap_or(true));
    let usual = BUS_TROUBLE_OR_LOST.iter().map(|cause| ((*cause).to_owned(), None));
    let own = section.suppressed_by.iter().map(|cause| (cause.value.clone(), Some(cause.span.clone())));
    (Draft { alarm, causes: usual.chain(own).collect(), span: section.name.span.clone() }, enabled)
}

/// Where the value of a tag stands that shows what emergency messages told; `None` for any other tag.
pub fn source(
    problems: &mut Problems,
    context: &Context<'_>,
    item: &Item<'_>,
    section: &TagSection,
) -> Option<(EmergencyPart, Field)> {
    let word = section.emergency.as_ref()?;
    let source = context.source;
    let part = match word.value {
        EmergencyWord::Code => EmergencyPart::Code,
        EmergencyWord::Register => EmergencyPart::Register,
        EmergencyWord::Vendor => EmergencyPart::Vendor,
        EmergencyWord::ActiveCount => EmergencyPart::ActiveCount,
    };
    let elsewhere = [
        ("tpdo", section.tpdo.as_ref().map(|at| &at.span)),
        ("bit", section.bit.as_ref().map(|at| &at.span)),
        ("rpdo", section.rpdo.as_ref().map(|at| &at.span)),
        ("object", section.object.as_ref().map(|at| &at.span)),
        ("poll_ms", section.poll_ms.as_ref().map(|at| &at.span)),
        ("array", section.array.as_ref().map(|at| &at.span)),
        ("unit_object", section.unit_object.as_ref().map(|at| &at.span)),
        ("digits_object", section.digits_object.as_ref().map(|at| &at.span)),
    ];
    for (key, span) in elsewhere.into_iter().filter_map(|(key, span)| Some((key, span?))) {
        let message = format!("`{}` comes from emergency messages: `{key}` means nothing here", item.name);
        problems.error(source, span, message, "leave it out, or `emergency`");
    }
    // Of a code, a register or a number some bits alone would be another one; the maker's bytes may hold several things.
    let fits = |width| width == part.width() || part == EmergencyPart::Vendor && width < part.width();
    let field = fields::whole(section).filter(|field| field.kind == FieldKind::Unsigned && fits(field.width));
    if field.is_none() {
        let message = format!("`{}` is no type for this part of emergency messages", section.kind.value);
        problems.error(source, &section.kind.span, message, format!("use u{}", part.width()));
    }
    let big_endian = section.byte_order == ByteOrderWord::Big;
    let whole = Field { bit: 0, width: part.width(), kind: FieldKind::Unsigned, big_endian, invert: false };
    let field = Field { bit: part.first_bit(), ..field.unwrap_or(whole) };
    fields::check_byte_order(problems, source, &section.kind.span, &item.name, field);
    Some((part, field))
}
