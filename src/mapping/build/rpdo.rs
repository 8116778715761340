//! RPDOs: what the gateway sends a node, and the tags that stand in it.

use std::time::Duration;

use super::super::file::{MappingFile, MappingWord, OnStartWord, RpdoSection, TagSection, WrittenValue};
use super::super::table::{Field, FieldKind, RpdoDef, Scale, Source, TagDef, WriteLimits};
use super::super::{At, SourceText, codec};
use super::boot::{check_set_invalid, mapping_mode};
use super::fields;
use super::items::Item;
use super::node::{self, Frame};
use super::problems::Problems;
use super::tags::Context;
use super::{sync, writable};
use crate::canopen::boot::{BootStep, PdoSetup};
use crate::canopen::{NodeId, PdoIndex, Role, RpdoSettings, RpdoTrigger};
use crate::process_image::Value;

/// The place of an RPDO that there is not; never in a finished table.
const NO_RPDO: usize = usize::MAX;

/// One RPDO of a mapping.
#[derive(Clone, Copy, Debug)]
pub struct Rpdo<'a> {
    /// Its number.
    pub number: u64,
    /// The number as it is written.
    pub key: &'a At<String>,
    /// Its entry.
    pub section: &'a RpdoSection,
}

impl<'a> Rpdo<'a> {
    /// All of a mapping, by their numbers.
    pub fn all(file: &'a MappingFile) -> Vec<Self> {
        let number = |key: &At<String>| key.value.parse().unwrap_or(u64::MAX);
        let mut all: Vec<Self> =
            file.rpdo.iter().map(|(key, section)| Self { number: number(key), key, section }).collect();
        all.sort_by_key(|rpdo| rpdo.number);
        all
    }

    fn frame(&self) -> Frame<'a> {
        let section = self.section;
        Frame {
            what: "RPDO",
            key: self.key,
            maps: &section.maps,
            length: section.length.as_ref(),
            is_adopted: false,
        }
    }

    /// What the table says of it.
    pub fn def(&self) -> RpdoDef {
        RpdoDef {
            number: u16::try_from(self.number).unwrap_or_default(),
            keeps_last: self.section.on_start == OnStartWord::Last,
        }
    }
}

/// What the CANopen master needs to know: nothing, unless the configuration allows that the node is sent something.
pub fn settings(problems: &mut Problems, context: &Context<'_>, id: NodeId) -> Vec<RpdoSettings> {
    let settings: Vec<RpdoSettings> =
        context.rpdos.iter().map(|rpdo| one(problems, context, id, rpdo)).collect();
    let passive = context.bus.as_ref().is_some_and(|bus| bus.role == Role::Passive);
    if context.entry.outputs.value && (settings.is_empty() || passive) {
        let why = if passive { "the gateway is passive on its bus" } else { "its mapping has no [rpdo.N]" };
        let at = &context.entry.outputs.span;
        let message = format!("`outputs = true` means nothing here: {why}");
        problems.warning(context.config, at, message, "leave `outputs` out");
    }
    if context.entry.outputs.value { settings } else { Vec::new() }
}

fn one(problems: &mut Problems, context: &Context<'_>, id: NodeId, rpdo: &Rpdo<'_>) -> RpdoSettings {
    let (source, section) = (context.source, rpdo.section);
    let number = node::pdo_number(problems, source, "rpdo", rpdo.key);
    let length = node::checked_length(problems, source, &rpdo.frame());
    let trigger = match &section.transmission_type {
        None => RpdoTrigger::Event,
        Some(at) => {
            let kind = problems.within(source, at, "transmission_type", 0..=255);
            match u8::try_from(kind) {
                Ok(every) if kind <= sync::LAST_SYNCHRONOUS => {
                    if context.entry.outputs.value {
                        sync::check(problems, context, (source, at), &format!("RPDO {}", rpdo.number));
                    }
                    RpdoTrigger::Sync(every)
                }
                Ok(254 | 255) => RpdoTrigger::Event,
                Ok(_) | Err(_) => {
                    let message = format!("an RPDO cannot be sent with transmission type {kind}");
                    problems.error(source, &at.span, message, "use 0 to 240, 254 or 255");
                    RpdoTrigger::Event
                }
            }
        }
    };
    check_mapping(problems, source, rpdo);
    let refresh = match &section.refresh_ms {
        None => Some(1_000),
        Some(at) if at.value == 0 => None,
        Some(at) => Some(problems.within(source, at, "refresh_ms", 10..=3_600_000)),
    };
    let timers = [(&section.refresh_ms, "refresh_ms"), (&section.inhibit_ms, "inhibit_ms")];
    for (at, what) in timers.into_iter().filter(|_| matches!(trigger, RpdoTrigger::Sync(_))) {
        if let Some(at) = at {
            let message = format!("{what} means nothing for an RPDO that follows SYNC");
            problems.error(source, &at.span, message, "leave it out, or use transmission type 255");
        }
    }
    if let (RpdoTrigger::Sync(_), Some(at)) = (trigger, &section.inhibit_ms) {
        let hint = "leave it out, or use transmission type 255";
        problems.error(source, &at.span, "inhibit_ms means nothing for an RPDO that follows SYNC", hint);
    }
    let inhibit = problems.milliseconds(
        source,
        section.inhibit_ms.as_ref(),
        "inhibit_ms",
        0..=65_535,
        Duration::from_millis(10),
    );
    RpdoSettings {
        number,
        cob_id: section.cob_id.value.of(id),
        length: u8::try_from(length).unwrap_or(8),
        trigger,
        refresh: refresh.filter(|_| trigger == RpdoTrigger::Event).map(Duration::from_millis),
        inhibit,
    }
}

/// What is sent is for the gateway to say, so that it cannot take it from the device.
fn check_mapping(problems: &mut Problems, source: &SourceText, rpdo: &Rpdo<'_>) {
    let section = rpdo.section;
    if section.mapping.value == MappingWord::Adopt {
        let message =
            format!("RPDO {} cannot be adopted: the gateway must know what it sends", rpdo.key.value);
        problems.error(source, &section.mapping.span, message, "use `write`, `verify` or `fixed`");
    }
    let mode = mapping_mode(section.mapping.value).filter(|_| !section.maps.is_empty());
    check_set_invalid(problems, source, &section.set_pdo_invalid, mode);
}

/// How each RPDO is seen to before the node is started; nothing where it is sent none.
pub fn steps(context: &Context<'_>) -> Vec<BootStep> {
    let rpdos = context.rpdos.iter().enumerate().filter(|_| context.entry.outputs.value);
    let step = |(place, rpdo): (usize, &Rpdo<'_>)| {
        let section = rpdo.section;
        let mode = mapping_mode(section.mapping.value).filter(|_| !section.maps.is_empty())?;
        Some(BootStep::Rpdo(PdoSetup {
            pdo: PdoIndex(place),
            number: u16::try_from(rpdo.number).unwrap_or_default(),
            mode,
            maps: section.maps.iter().filter_map(|entry| node::mapped(&entry.value)).collect(),
            transmission_type: section.transmission_type.as_ref().and_then(|at| u8::try_from(at.value).ok()),
            inhibit_time: None,
            event_timer: None,
            set_invalid: section.set_pdo_invalid.value,
        }))
    };
    rpdos.filter_map(step).collect()
}

/// The source of a tag that stands in an RPDO.
pub fn source(
    problems: &mut Problems,
    context: &Context<'_>,
    item: &Item<'_>,
    section: &TagSection,
    number: &At<u64>,
    scale: Scale,
) -> Source {
    let source = context.source;
    let wrong = [
        (section.tpdo.as_ref().map(|at| &at.span), "tpdo"),
        (section.poll_ms.as_ref().map(|at| &at.span), "poll_ms"),
        (section.unit_object.as_ref().map(|at| &at.span), "unit_object"),
        (section.digits_object.as_ref().map(|at| &at.span), "digits_object"),
        (writable::asked(section).map(|at| &at.span), "writable"),
    ];
    for (span, what) in wrong {
        if let Some(span) = span {
            let message = format!("`{}` is sent in an RPDO, so `{what}` means nothing", item.name);
            problems.error(source, span, message, "leave one of them out");
        }
    }
    let place = context.rpdos.iter().position(|rpdo| rpdo.number == number.value);
    let rpdo = place.and_then(|place| context.rpdos.get(place));
    if rpdo.is_none() && !context.items.is_lost(&number.value.to_string()) {
        let known = context.rpdos.iter().map(|rpdo| rpdo.key.value.as_str());
        problems.unknown(source, &number.span, "RPDO", &number.value.to_string(), known);
    }
    let first = first_bit(problems, context, item, section, rpdo);
    let stride = fields::stride(problems, source, section);
    let bit = first.value.saturating_add(item.element.index.saturating_mul(stride));
    let field = fields::of_type(problems, context, section, bit);
    fields::check_byte_order(problems, source, &first.span, &item.name, field);
    let bits = rpdo.and_then(|rpdo| rpdo.frame().length()).unwrap_or(8).min(8) * 8;
    let last = bit.saturating_add(u64::from(field.width) - 1);
    if last >= bits {
        let message =
            format!("`{}` takes bits {bit} to {last}, but RPDO {} has only {bits}", item.name, number.value);
        let hint = "byte b bit i is bit 8 b + i; check `bit`, `type` and the `length` of the RPDO";
        problems.error(source, &first.span, message, hint);
    }
    let limits = limits(problems, context, item, section, (field, scale));
    Source::Rpdo { rpdo: place.unwrap_or(NO_RPDO), field, scale, limits }
}

/// Where it stands: as it is written, or where `maps` has its object.
fn first_bit(
    problems: &mut Problems,
    context: &Context<'_>,
    item: &Item<'_>,
    section: &TagSection,
    rpdo: Option<&Rpdo<'_>>,
) -> At<u64> {
    let source = context.source;
    match (&section.bit, &section.object) {
        (Some(bit), None) => bit.clone(),
        (None, Some(object)) => {
            fields::refuse_array(problems, source, section);
            let id = node::object(problems, source, object);
            let mapped = rpdo.map(|rpdo| &rpdo.section.maps).zip(id);
            if let Some((maps, id)) = mapped {
                fields::check_width(problems, source, section, (object, id), maps);
            }
            let found = mapped.and_then(|(maps, id)| node::bit_of(maps, id));
            if found.is_none() && mapped.is_some() {
                let message = format!("the RPDO does not map {}", object.value);
                problems.error(source, &object.span, message, "add it to `maps`, or write `bit`");
            }
            At { value: found.unwrap_or_default(), span: object.span.clone() }
        }
        _ => {
            let message = format!("`{}` needs either `rpdo` and `bit`, or `rpdo` and `object`", item.name);
            problems.error(source, &item.span, message, "write where it stands, or which object it is");
            At { value: 0, span: item.span.clone() }
        }
    }
}

/// What can be written to a tag.
pub fn limits(
    problems: &mut Problems,
    context: &Context<'_>,
    item: &Item<'_>,
    section: &TagSection,
    (field, scale): (Field, Scale),
) -> WriteLimits {
    let number = |at: &Option<At<f64>>, without: f64| at.as_ref().map_or(without, |at| at.value);
    let minimum = number(&section.minimum, f64::NEG_INFINITY);
    let maximum = number(&section.maximum, f64::INFINITY);
    let mut limits = WriteLimits { default: None, minimum, maximum };
    let bounds = [(&section.minimum, "minimum"), (&section.maximum, "maximum")];
    for (at, what) in bounds.into_iter().filter(|_| field.kind == FieldKind::Bool) {
        if let Some(at) = at {
            let message = format!("`{}` is a bit, so `{what}` means nothing", item.name);
            problems.error(context.source, &at.span, message, "leave it out");
        }
    }
    let wrong = minimum.partial_cmp(&maximum).is_none_or(std::cmp::Ordering::is_gt);
    if let Some(at) = section.minimum.as_ref().or(section.maximum.as_ref()).filter(|_| wrong) {
        let message = format!("no value of `{}` lies between {minimum} and {maximum}", item.name);
        problems.error(context.source, &at.span, message, "minimum must not be above maximum");
    }
    if let Some(at) = &section.default {
        let value = match at.value {
            WrittenValue::Bit(bit) => Value::Bool(bit),
            WrittenValue::Whole(number) => Value::Signed(number),
            WrittenValue::Real(number) => Value::Float(number),
        };
        let outside = !matches!(value, Value::Bool(_)) && !(minimum..=maximum).contains(&value.as_f64());
        let result = codec::encode(&field, &scale, value, &mut [0; 8]);
        // That the field lies outside was told already.
        let problem = match result {
            _ if outside => Some(format!("it is not between {minimum} and {maximum}")),
            Ok(()) | Err(codec::EncodeError::NoField) => None,
            Err(error) => Some(error.to_string()),
        };
        if let Some(problem) = problem {
            let message = format!("the default {value} cannot be written to `{}`: {problem}", item.name);
            problems.error(context.source, &at.span, message, "check `type`, `scale` and `default`");
        }
        limits.default = Some(value);
    }
    limits
}

/// Keys that are for tags that can be written.
pub fn refuse_limits(problems: &mut Problems, context: &Context<'_>, section: &TagSection) {
    let default = section.default.as_ref().map(|at| (&at.span, "default"));
    let minimum = section.minimum.as_ref().map(|at| (&at.span, "minimum"));
    let maximum = section.maximum.as_ref().map(|at| (&at.span, "maximum"));
    let writable = writable::asked(section).map(|at| (&at.span, "writable"));
    for (span, what) in [default, minimum, maximum, writable].into_iter().flatten() {
        let message = format!("`{what}` means nothing for a tag that the device sends");
        let hint = match what {
            "writable" => "it is for tags with `object`; leave it out",
            "default" => "it is for tags with `rpdo`; leave it out",
            _ => "it is for tags with `rpdo`, and for objects with `writable = true`; leave it out",
        };
        problems.error(context.source, span, message, hint);
    }
}

/// Two tags that share bits would overwrite each other; an RPDO without tags would send what nobody chose.
pub fn check_contents(problems: &mut Problems, context: &Context<'_>, tags: &[TagDef], places: &[usize]) {
    let mut used: Vec<(usize, u64, usize)> = Vec::new();
    for (index, place) in places.iter().enumerate() {
        let Some(TagDef { source: Source::Rpdo { rpdo, field, .. }, .. }) = tags.get(*place) else {
            continue;
        };
        let end = u32::from(field.bit) + u32::from(field.width);
        if *rpdo == NO_RPDO || field.width == 0 || end > 64 {
            continue;
        }
        let mask = (u64::MAX >> (64 - u32::from(field.width))) << field.bit;
        let other = used.iter().find(|(other, bits, _)| other == rpdo && bits & mask != 0);
        if let Some((_, _, other)) = other
            && let (Some(one), Some(item)) = (context.items.get(*other), context.items.get(index))
        {
            let message = format!("`{}` and `{}` are written to the same bits", one.name, item.name);
            problems.error(context.source, &item.span, message, "check `bit` and `type` of both");
        }
        used.push((*rpdo, mask, index));
    }
    for (place, rpdo) in context.rpdos.iter().enumerate() {
        if !used.iter().any(|(other, _, _)| *other == place) {
            let message = format!("no tag stands in RPDO {}, so it is never sent", rpdo.key.value);
            problems.warning(context.source, &rpdo.key.span, message, "add a [[tag]] with `rpdo` and `bit`");
        }
    }
}
