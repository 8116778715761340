//! What is done with a node before it is started, and which of its objects are read again and again.

use std::time::Duration;

use super::super::file::{MappingWord, SetupSection, SetupValue};
use super::super::{At, SourceText};
use super::items::Entry;
use super::node::Tpdo;
use super::problems::Problems;
use super::rpdo;
use super::tags::Context;
use super::{node, units};
use crate::canopen::PdoIndex;
use crate::canopen::boot::{BootStep, MappingMode, PdoSetup};
use crate::canopen::object::{DataType, ObjectId};
use crate::canopen::polls::Poll;

/// Consumer heartbeat time of the first node that is supervised.
const SUPERVISED: ObjectId = ObjectId::new(0x1016, 1);
/// Producer heartbeat time.
const HEARTBEAT: ObjectId = ObjectId::new(0x1017, 0);

/// Identifier of emergency messages.
const EMERGENCY_ID: ObjectId = ObjectId::new(0x1014, 0);
/// A unit that somebody changes in a running device is noticed within this time.
const UNIT_PERIOD: Duration = Duration::from_secs(10);

/// The steps of the boot: identity, errors, heartbeat, settings, units, and the PDOs last, so that what they carry is
/// read when all else is as it should be.
pub fn steps(problems: &mut Problems, context: &Context<'_>) -> Vec<BootStep> {
    let mut steps = identity(problems, context);
    if context.file.emergency.read_at_boot {
        steps.push(BootStep::Errors);
    }
    if let Some((source, at)) = node::heartbeat(context) {
        let millis = problems.within(source, at, "heartbeat_ms", 10..=65_535);
        let data = u16::try_from(millis).unwrap_or(u16::MAX).to_le_bytes().to_vec();
        steps.push(BootStep::Write { object: HEARTBEAT, data, optional: false });
    }
    steps.extend(supervision_of_the_gateway(problems, context));
    let setups = context.file.setup.iter().filter_map(|section| setup(problems, context, section));
    steps.extend(setups);
    steps.extend(units::objects(context).into_iter().map(|(object, _)| BootStep::Read { object }));
    let before_pdos = steps.len();
    let pdos = context.tpdos.iter().enumerate();
    steps.extend(pdos.filter_map(|(place, tpdo)| pdo(problems, context, place, tpdo)));
    steps.extend(rpdo::steps(context));
    // A device that is asked anything is asked which identifier its emergency messages have (R-DST-119).
    let is_read = context.items.list.iter().any(|item| {
        let Entry::Tag(section) = item.entry else { return false };
        node::polled(context, section).is_some()
    });
    if !steps.is_empty() || is_read || context.file.emergency.register_poll_ms.is_some() {
        steps.insert(before_pdos, BootStep::Read { object: EMERGENCY_ID });
    }
    let start = &context.file.start;
    if context.entry.save_after_config.or(start.save_after_config).unwrap_or(false) && !steps.is_empty() {
        steps.push(BootStep::Save);
    }
    steps
}

/// How a TPDO is seen to; `None` where the device is not asked. Its numbers are looked at all the same, as its time-out
/// follows from them.
fn pdo(problems: &mut Problems, context: &Context<'_>, place: usize, tpdo: &Tpdo<'_>) -> Option<BootStep> {
    let section = tpdo.section;
    let mut number = |at: Option<(&SourceText, &At<u64>)>, what: &str, highest: u64| {
        at.map(|(source, at)| problems.within(source, at, what, 0..=highest))
    };
    let transmission_type = number(tpdo.transmission_type(context), "transmission_type", 255);
    let event_timer = number(tpdo.event_timer(context), "event_timer_ms", 65_535);
    let inhibit_time = number(tpdo.inhibit_time(context), "inhibit_time_us", 6_553_500);
    if let Some((source, at)) = tpdo.inhibit_time(context).filter(|(_, at)| !at.value.is_multiple_of(100)) {
        let message = format!("inhibit_time_us {} cannot be set", at.value);
        problems.error(source, &at.span, message, "devices count in steps of 100 us");
    }
    let written = mapping_mode(section.mapping).filter(|_| !section.maps.is_empty());
    check_set_invalid(problems, context.source, &section.set_pdo_invalid, written);
    let mode = if tpdo.is_adopted() {
        refuse_changes(problems, context, tpdo);
        MappingMode::Adopt { timed: node::is_untimed(context, section) }
    } else {
        written?
    };
    Some(BootStep::Pdo(PdoSetup {
        pdo: PdoIndex(place),
        number: u16::try_from(tpdo.number).unwrap_or_default(),
        mode,
        maps: section.maps.iter().filter_map(|entry| node::mapped(&entry.value)).collect(),
        transmission_type: transmission_type.and_then(|number| u8::try_from(number).ok()),
        inhibit_time: inhibit_time.and_then(|micros| u16::try_from(micros / 100).ok()),
        event_timer: event_timer.and_then(|millis| u16::try_from(millis).ok()),
        set_invalid: section.set_pdo_invalid.value,
    }))
}

/// A PDO is marked as not valid only while its mapping is written.
pub fn check_set_invalid(
    problems: &mut Problems,
    source: &SourceText,
    at: &At<bool>,
    mode: Option<MappingMode>,
) {
    if at.value && mode != Some(MappingMode::Write) {
        let message = "the mapping of this PDO is not written, so `set_pdo_invalid` means nothing";
        problems.error(source, &at.span, message, "leave it out, or write `maps` and mapping = \"write\"");
    }
}

/// What is done with a PDO mapping; `None`: nothing, or it is taken as it is.
pub fn mapping_mode(word: MappingWord) -> Option<MappingMode> {
    match word {
        MappingWord::Fixed | MappingWord::Adopt => None,
        MappingWord::Write => Some(MappingMode::Write),
        MappingWord::Verify => Some(MappingMode::Verify),
    }
}

/// The node is told to watch over the gateway (R-DST-062): its node id and the time after which it is missed.
fn supervision_of_the_gateway(problems: &mut Problems, context: &Context<'_>) -> Option<BootStep> {
    let at = context.entry.supervise_gateway_ms.as_ref()?;
    let millis = problems.within(context.config, at, "supervise_gateway_ms", 10..=65_535);
    let heartbeat = context.bus.as_ref()?.own_heartbeat;
    let wrong = match heartbeat {
        None => "the gateway sends no heartbeat on this bus, so this node would miss it at once",
        Some(heartbeat) if Duration::from_millis(millis) <= heartbeat.period => {
            "this is not longer than the time between two heartbeats of the gateway"
        }
        Some(_) => "",
    };
    if !wrong.is_empty() {
        let hint = "give the bus `own_node_id` and `own_heartbeat_ms`, and the node about three times that";
        problems.error(context.config, &at.span, wrong, hint);
    }
    let value = u32::from(heartbeat?.node.get()) << 16 | u32::try_from(millis).ok()?;
    Some(BootStep::Write { object: SUPERVISED, data: value.to_le_bytes().to_vec(), optional: false })
}

/// What is adopted is not changed.
fn refuse_changes(problems: &mut Problems, context: &Context<'_>, tpdo: &Tpdo<'_>) {
    let numbers = [
        (tpdo.transmission_type(context), "transmission_type"),
        (tpdo.event_timer(context), "event_timer_ms"),
        (tpdo.inhibit_time(context), "inhibit_time_us"),
    ];
    for (at, key) in numbers {
        if let Some((source, at)) = at {
            let message = format!("a TPDO that is adopted is not changed, so `{key}` would never be written");
            problems.error(source, &at.span, message, "leave it out, or write mapping = \"write\"");
        }
    }
    if let Some(bits) = tpdo.section.reserved_bits.first() {
        let message = "what stands where in a TPDO that is adopted is for the device to say, so `reserved_bits` means \
                       nothing";
        problems.error(context.source, &bits.span, message, "leave it out, or write mapping = \"write\"");
    }
}

fn identity(problems: &mut Problems, context: &Context<'_>) -> Vec<BootStep> {
    let Some(identity) = &context.file.identity else { return Vec::new() };
    let tolerated = context.entry.check_identity == Some(false);
    let keys = [
        (&identity.device_type, ObjectId::new(0x1000, 0), "device_type"),
        (&identity.vendor_id, ObjectId::new(0x1018, 1), "vendor_id"),
        (&identity.product_code, ObjectId::new(0x1018, 2), "product_code"),
        (&identity.revision_number, ObjectId::new(0x1018, 3), "revision_number"),
    ];
    let steps = keys.into_iter().filter_map(|(at, object, what)| {
        let expected = problems.within(context.source, at.as_ref()?, what, 0..=u64::from(u32::MAX));
        Some(BootStep::Identity { object, expected: u32::try_from(expected).ok()?, tolerated })
    });
    steps.collect()
}

fn setup(problems: &mut Problems, context: &Context<'_>, section: &SetupSection) -> Option<BootStep> {
    let source = context.source;
    let object = node::object(problems, source, &section.object)?;
    let Ok(kind) = section.kind.value.parse::<DataType>() else {
        let message = format!("there is no type `{}`", section.kind.value);
        problems.error(source, &section.kind.span, message, "use u8 to u64, i8 to i64, f32 or f64");
        return None;
    };
    match kind.encode(&value_text(section)) {
        Ok(data) => Some(BootStep::Write { object, data, optional: section.optional }),
        Err(error) => {
            problems.error(source, &section.value.span, error.to_string(), "check `type` and `value`");
            None
        }
    }
}

fn value_text(section: &SetupSection) -> String {
    match section.value.value {
        SetupValue::Whole(number) => number.to_string(),
        SetupValue::Real(number) => number.to_string(),
    }
}

/// What an object is set to, where that is a number of 32 bits at most.
pub fn set_to(context: &Context<'_>, object: ObjectId) -> Option<u32> {
    let section = context.file.setup.iter().find(|section| section.object.value.parse() == Ok(object))?;
    let data = section.kind.value.parse::<DataType>().ok()?.encode(&value_text(section)).ok()?;
    let mut bytes = [0; 4];
    bytes.get_mut(..data.len())?.copy_from_slice(&data);
    Some(u32::from_le_bytes(bytes))
}

/// The objects that tags name and that no TPDO maps, in the order of the file; then those in which the device tells units.
pub fn polls(problems: &mut Problems, context: &Context<'_>) -> Vec<Poll> {
    let mut polls = Vec::new();
    for item in &context.items.list {
        let Entry::Tag(section) = item.entry else { continue };
        let Some((object, at)) = node::polled(context, section) else { continue };
        let millis = problems.within(context.source, at, "poll_ms", 100..=86_400_000);
        let bits = super::fields::whole(section).map_or(8, |field| field.width);
        let length = usize::from(bits.div_ceil(8));
        let period = Duration::from_millis(millis);
        polls.push(Poll { object, period, length, read_by_boot: false, unless_sent: Some(bits) });
    }
    polls.extend(units::objects(context).into_iter().map(|(object, length)| Poll {
        object,
        period: UNIT_PERIOD,
        length,
        read_by_boot: true,
        unless_sent: None,
    }));
    polls
}
