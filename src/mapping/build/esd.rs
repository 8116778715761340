//! Nodes that are esd modules: their settings, the tags that show their values, and what does not belong to them.

use std::ops::Range;
use std::time::Duration;

use super::super::file::{
    EmergencySection, ErrorControlSection, MappingFile, ModuleWord, StartSection, TagSection,
};
use super::super::installation::{BusEntry, HighHalfWord, NodeEntry, WatchdogWord};
use super::super::table::{EsdBusDef, Field, FieldKind, LineValue, ModuleCarrier, ModuleValue};
use super::super::{At, SourceText, locate};
use super::fields;
use super::items::Item;
use super::lines;
use super::problems::Problems;
use super::tags::Context;
use crate::can::CanId;
use crate::canopen::Role;
use crate::esd::parameters::DEFAULT_FIRST_TX_DELAY;
use crate::esd::{ManagementSettings, ModuleKind, ModuleNumber, ModuleSettings, WatchdogSettings};

/// A module may be silent for its first Tx activate delay, and so long until it is asked for the first time (R-ESD-033).
const NEVER_SEEN_MARGIN: Duration = Duration::from_secs(5);
/// Highest identifier of 11 bits.
const HIGHEST_ID: u64 = 0x7FF;

/// What `[bus.NAME.esd]` says.
pub fn bus(problems: &mut Problems, config: &SourceText, entry: &BusEntry) -> EsdBusDef {
    let default = EsdBusDef::default();
    let Some(section) = &entry.esd else { return default };
    let section = &section.value;
    let timeout = section.reply_timeout_ms.as_ref();
    let repetitions = section.repetitions.as_ref();
    let repetitions = repetitions.map(|at| problems.within(config, at, "repetitions", 0..=10));
    let stop_bit_set = section.stop_bit_set.as_ref();
    let stop_bit_set = stop_bit_set.map(|at| problems.within(config, at, "stop_bit_set", 1..=2));
    EsdBusDef {
        reply_id: section.reply_id.as_ref().map(|at| identifier(problems, config, at, "reply_id")),
        reply_timeout: problems.milliseconds(
            config,
            timeout,
            "reply_timeout_ms",
            1..=10_000,
            default.reply_timeout,
        ),
        repetitions: repetitions.and_then(|it| u8::try_from(it).ok()).unwrap_or(default.repetitions),
        min_char_high: section.high_half == Some(HighHalfWord::MinChar),
        stop_bit_set: stop_bit_set.and_then(|it| u8::try_from(it).ok()).unwrap_or(default.stop_bit_set),
    }
}

/// An identifier of 11 bits; 0 is that of NMT commands.
pub fn identifier(problems: &mut Problems, config: &SourceText, at: &At<u64>, what: &str) -> CanId {
    if !(1..=HIGHEST_ID).contains(&at.value) {
        let message = format!("{what} 0x{:X} is no identifier of the esd protocol", at.value);
        problems.error(
            config,
            &at.span,
            message,
            "use 0x001 to 0x7FF: 11 bits, and not that of NMT commands",
        );
    }
    let id = u16::try_from(at.value.clamp(1, HIGHEST_ID)).unwrap_or(1);
    CanId::Standard(id)
}

/// The settings of a module.
pub fn settings(
    problems: &mut Problems,
    context: &Context<'_>,
    name: &str,
    kind: ModuleKind,
    number: ModuleNumber,
) -> ModuleSettings {
    let switch = switch(problems, context, kind);
    ModuleSettings {
        number,
        kind,
        management: management(problems, context, name, switch),
        channels: lines::channels(problems, context, name, kind, switch),
    }
}

/// What the coding switch says; the highest that there is where it is none, which is told.
fn switch(problems: &mut Problems, context: &Context<'_>, kind: ModuleKind) -> u8 {
    let highest = kind.highest_switch();
    let at = context.entry.coding_switch.as_ref().unwrap_or(&context.entry.id);
    if !(1..=u64::from(highest)).contains(&at.value) {
        let message = match &context.entry.coding_switch {
            Some(_) => format!("coding_switch 0x{:02X} gives no usable identifiers", at.value),
            None => format!("id {} cannot be the value of the coding switch as well", at.value),
        };
        let hint = format!(
            "give it the `coding_switch` that its {} has, 0x01 to 0x{highest:02X}: 0 would be the identifier of NMT \
             commands, and above it they have more than 11 bits",
            kind.model()
        );
        problems.error(context.config, &at.span, message, hint);
    }
    u8::try_from(at.value.clamp(1, u64::from(highest))).unwrap_or(highest)
}

/// Whether and how the module is managed.
fn management(
    problems: &mut Problems,
    context: &Context<'_>,
    name: &str,
    switch: u8,
) -> Option<ManagementSettings> {
    let (config, entry) = (context.config, context.entry);
    let first_tx_delay = entry.first_tx_delay_ms.as_ref().map(|at| {
        Duration::from_millis(problems.within(config, at, "first_tx_delay_ms", 0..=u64::from(u16::MAX)))
    });
    let status_period = problems.milliseconds(
        config,
        entry.status_period_ms.as_ref(),
        "status_period_ms",
        100..=60_000,
        Duration::from_secs(2),
    );
    let watchdog = watchdog(problems, context);
    if !is_managed(problems, context, name) {
        return None;
    }
    if let (Some(at), Some(watchdog)) = (&entry.watchdog_id, watchdog) {
        warn_of_watchdog(problems, config, at, watchdog);
    }
    Some(ManagementSettings {
        switch: Some(switch),
        check_kind: entry.check_identity.unwrap_or(true),
        configure: entry.configure.unwrap_or(true),
        store: entry.save_after_config.unwrap_or(false),
        first_tx_delay,
        min_char_high: context.bus.as_ref().is_some_and(|bus| bus.esd.min_char_high),
        status_period,
        watchdog,
        never_seen_after: first_tx_delay.unwrap_or(DEFAULT_FIRST_TX_DELAY) + NEVER_SEEN_MARGIN,
    })
}

/// Whether the module is managed, and if not, which keys mean nothing.
fn is_managed(problems: &mut Problems, context: &Context<'_>, name: &str) -> bool {
    let (config, entry) = (context.config, context.entry);
    // That there is no such bus was told.
    let Some(bus) = &context.bus else { return false };
    let passive = bus.role == Role::Passive;
    if let Some(at) = entry.manage.as_ref().filter(|at| at.value) {
        if passive {
            let message = "a module cannot be managed on a bus where the gateway is passive";
            problems.error(config, &at.span, message, "leave `manage` out, or make the gateway master there");
        } else if bus.esd.reply_id.is_none() {
            let message = format!("bus `{}` has no identifier on which modules could answer", bus.name);
            let hint = format!(
                "add [bus.{}.esd] with a `reply_id` that nobody else on the bus uses, or set `manage = false`",
                bus.name
            );
            problems.error(config, &at.span, message, hint);
        }
    }
    let managed = entry.manage.as_ref().map_or(bus.esd.reply_id.is_some(), |at| at.value) && !passive;
    if !managed && !passive {
        let here = |key: &str| locate(config, &["node", name, key]);
        let keys = [
            ("first_tx_delay_ms", entry.first_tx_delay_ms.as_ref().map(|at| at.span.clone())),
            ("status_period_ms", entry.status_period_ms.as_ref().map(|at| at.span.clone())),
            ("watchdog_id", entry.watchdog_id.as_ref().map(|at| at.span.clone())),
            ("configure", entry.configure.filter(|it| *it).map(|_| here("configure"))),
            (
                "save_after_config",
                entry.save_after_config.filter(|it| *it).map(|_| here("save_after_config")),
            ),
        ];
        for (key, span) in keys.into_iter().filter_map(|(key, span)| Some((key, span?))) {
            let message = format!("`{key}` means nothing: the module is not managed");
            let hint = format!(
                "give [bus.{}.esd] a `reply_id`, and do not set `manage = false`; or leave it out",
                bus.name
            );
            problems.warning(config, &span, message, hint);
        }
    }
    managed
}

fn watchdog(problems: &mut Problems, context: &Context<'_>) -> Option<WatchdogSettings> {
    let (config, entry) = (context.config, context.entry);
    let time = problems.milliseconds(
        config,
        entry.watchdog_ms.as_ref(),
        "watchdog_ms",
        20..=u64::from(u16::MAX),
        Duration::from_secs(1),
    );
    let factor = entry.watchdog_factor.as_ref();
    let factor = factor.map_or(3, |at| problems.within(config, at, "watchdog_factor", 1..=255));
    let Some(id) = &entry.watchdog_id else {
        let without = [
            ("watchdog_ms", entry.watchdog_ms.as_ref().map(|at| &at.span)),
            ("watchdog_factor", entry.watchdog_factor.as_ref().map(|at| &at.span)),
            ("watchdog_by", entry.watchdog_by.as_ref().map(|at| &at.span)),
        ];
        for (key, span) in without.into_iter().filter_map(|(key, span)| Some((key, span?))) {
            let message = format!("`{key}` means nothing without `watchdog_id`");
            let hint = "give the watchdog an identifier of its own, or leave this out: then it is off";
            problems.error(config, span, message, hint);
        }
        return None;
    };
    Some(WatchdogSettings {
        id: identifier(problems, config, id, "watchdog_id"),
        time,
        factor: u8::try_from(factor).unwrap_or(3),
        mode: entry.watchdog_by.as_ref().map_or(WatchdogWord::Remote, |at| at.value).into(),
    })
}

/// Whoever uses the watchdog has to know what it does.
fn warn_of_watchdog(problems: &mut Problems, config: &SourceText, at: &At<u64>, watchdog: WatchdogSettings) {
    let after = watchdog.time * u32::from(watchdog.factor);
    let late = if watchdog.factor < 3 { ", or asks it late" } else { "" };
    let message = format!(
        "with its watchdog on, the module resets itself when the gateway stops without a word{late}, after {} ms",
        after.as_millis()
    );
    let hint = "bytes on their way to its lines are lost then; leave `watchdog_id` out unless the module has to fall \
                silent without its master";
    problems.warning(config, &at.span, message, hint);
}

/// Where the value of a tag stands that shows something of a module; `None` for any other tag.
pub fn source(
    problems: &mut Problems,
    context: &Context<'_>,
    item: &Item<'_>,
    section: &TagSection,
) -> Option<(usize, Field)> {
    let source = context.source;
    let Some(esd) = &context.file.esd else {
        for span in [section.module.as_ref().map(|at| &at.span), section.channel.as_ref().map(|at| &at.span)]
            .into_iter()
            .flatten()
        {
            let message = format!("`{}` is of no esd module", item.name);
            problems.error(source, span, message, "leave it out, or say with [esd] that the device is one");
        }
        return None;
    };
    let channels = ModuleKind::from(esd.module.value).channels();
    refuse_places(problems, context, item, section);
    let Some(word) = &section.module else {
        let message = format!("nothing says what of the module `{}` shows", item.name);
        problems.error(source, &item.span, message, "give it `module`, for example \"bytes_received\"");
        return Some((0, fields::whole(section).unwrap_or(NO_FIELD)));
    };
    let carrier = match value(word.value) {
        Value::Module(value) => {
            if let Some(at) = &section.channel {
                let message = format!("`{}` is of the module, not of one of its lines", item.name);
                problems.error(source, &at.span, message, "leave `channel` out");
            }
            ModuleCarrier::Module(value)
        }
        Value::Line(value) => ModuleCarrier::Line(channel(problems, context, item, section, channels), value),
    };
    let first = section.bit.as_ref().map_or(0, |at| at.value);
    let field = fields::of_type(problems, context, section, first);
    let last = first.saturating_add(u64::from(field.width) - 1);
    if last >= u64::from(carrier.width()) || field.kind == FieldKind::Float {
        let span = section.bit.as_ref().map_or(&section.kind.span, |at| &at.span);
        let message =
            format!("`{}` takes bits {first} to {last} of a number of {} bits", item.name, carrier.width());
        problems.error(source, span, message, "give it an unsigned type that is no wider, and no float");
    }
    Some((carrier.place(usize::from(channels)), field))
}

/// A field in the place of one that is wrong, which was told.
const NO_FIELD: Field =
    Field { bit: 0, width: 1, kind: FieldKind::Unsigned, big_endian: false, invert: false };

enum Value {
    Module(ModuleValue),
    Line(LineValue),
}

fn value(word: ModuleWord) -> Value {
    match word {
        ModuleWord::Status => Value::Module(ModuleValue::Status),
        ModuleWord::ActiveSwitch => Value::Module(ModuleValue::ActiveSwitch),
        ModuleWord::ModuleType => Value::Module(ModuleValue::ModuleType),
        ModuleWord::BytesReceived => Value::Line(LineValue::BytesReceived),
        ModuleWord::FramesReceived => Value::Line(LineValue::FramesReceived),
        ModuleWord::BytesSent => Value::Line(LineValue::BytesSent),
        ModuleWord::FramesSent => Value::Line(LineValue::FramesSent),
        ModuleWord::BytesNotSent => Value::Line(LineValue::BytesNotSent),
        ModuleWord::BytesWaiting => Value::Line(LineValue::BytesWaiting),
        ModuleWord::MessagesReceived => Value::Line(LineValue::MessagesReceived),
        ModuleWord::SecondsSinceReceived => Value::Line(LineValue::SecondsSinceReceived),
        ModuleWord::SecondsSinceSent => Value::Line(LineValue::SecondsSinceSent),
    }
}

/// The place of the line that a tag shows something of; 0 where there is no such line, which is told.
fn channel(
    problems: &mut Problems,
    context: &Context<'_>,
    item: &Item<'_>,
    section: &TagSection,
    channels: u8,
) -> usize {
    let Some(at) = &section.channel else {
        let message = format!("nothing says of which serial line `{}` is", item.name);
        problems.error(context.source, &item.span, message, "give it the number of the line: channel = 1");
        return 0;
    };
    let number = At { value: at.value.saturating_add(item.element.index), span: at.span.clone() };
    let number = problems.within(context.source, &number, "channel", 1..=u64::from(channels));
    usize::try_from(number - 1).unwrap_or(0)
}

/// A tag of a module stands in no PDO and is no object.
fn refuse_places(problems: &mut Problems, context: &Context<'_>, item: &Item<'_>, section: &TagSection) {
    let stride = section.array.as_ref().and_then(|array| array.value.bit_stride.as_ref());
    let elsewhere = [
        ("tpdo", section.tpdo.as_ref().map(|at| &at.span)),
        ("rpdo", section.rpdo.as_ref().map(|at| &at.span)),
        ("object", section.object.as_ref().map(|at| &at.span)),
        ("poll_ms", section.poll_ms.as_ref().map(|at| &at.span)),
        ("emergency", section.emergency.as_ref().map(|at| &at.span)),
        ("unit_object", section.unit_object.as_ref().map(|at| &at.span)),
        ("digits_object", section.digits_object.as_ref().map(|at| &at.span)),
        ("bit_stride", stride.map(|at| &at.span)),
    ];
    for (key, span) in elsewhere.into_iter().filter_map(|(key, span)| Some((key, span?))) {
        let message = format!("`{}` is of an esd module: `{key}` means nothing here", item.name);
        problems.error(context.source, span, message, "leave it out: the module speaks no CANopen");
    }
}

/// Sections of the mapping that are about CANopen.
pub fn refuse_sections(problems: &mut Problems, source: &SourceText, file: &MappingFile) {
    let Some(esd) = &file.esd else { return };
    let here = &esd.module.span;
    let whole = |differs: bool| differs.then(|| here.clone());
    let sections: [(&str, Option<Range<usize>>); 7] = [
        ("identity", whole(file.identity.is_some())),
        ("error_control", whole(file.error_control != ErrorControlSection::default())),
        ("start", whole(file.start != StartSection::default())),
        ("emergency", whole(file.emergency != EmergencySection::default())),
        ("tpdo", file.tpdo.keys().next().map(|key| key.span.clone())),
        ("rpdo", file.rpdo.keys().next().map(|key| key.span.clone())),
        ("setup", file.setup.first().map(|setup| setup.object.span.clone())),
    ];
    for (name, span) in sections.into_iter().filter_map(|(name, span)| Some((name, span?))) {
        let message = format!("an esd module speaks no CANopen, so [{name}] means nothing for it");
        problems.error(
            source,
            &span,
            message,
            format!("take [{name}] out, or [esd] if it is a CANopen device"),
        );
    }
}

/// Keys of a node that are for the other kind of devices.
pub fn refuse_keys(problems: &mut Problems, config: &SourceText, entry: &NodeEntry, is_module: bool) {
    let (keys, message, hint) = if is_module {
        (
            canopen_keys(entry),
            "is for CANopen devices, and the mapping is that of an esd module",
            "leave it out; see \"esd modules\" in the manual of the configuration for what these have instead",
        )
    } else {
        (
            module_keys(entry),
            "is for esd modules, and the mapping is that of a CANopen device",
            "leave it out, or name a mapping such as `esd-can-cbm-sio4`",
        )
    };
    for (key, span) in keys {
        problems.error(config, &span, format!("`{key}` {message}"), hint);
    }
}

/// Keys that are set and are for CANopen devices only, each with its place; of those that have none, that of the mapping.
fn canopen_keys(entry: &NodeEntry) -> Vec<(&'static str, Range<usize>)> {
    fn at<T>(at: Option<&At<T>>) -> Option<Range<usize>> {
        at.map(|at| at.span.clone())
    }
    let here = |is_set: bool| is_set.then(|| entry.mapping.span.clone());
    let keys = [
        ("error_control", at(entry.error_control.as_ref())),
        ("guard_time_ms", at(entry.guard_time_ms.as_ref())),
        ("life_time_factor", at(entry.life_time_factor.as_ref())),
        ("guard_reply_ms", at(entry.guard_reply_ms.as_ref())),
        ("toggle_check", here(entry.toggle_check.is_some())),
        ("heartbeat_timeout_ms", at(entry.heartbeat_timeout_ms.as_ref())),
        ("auto_start", here(entry.auto_start.is_some())),
        ("start_delay_ms", at(entry.start_delay_ms.as_ref())),
        ("start_confirm_ms", at(entry.start_confirm_ms.as_ref())),
        ("start_retry_ms", at(entry.start_retry_ms.as_ref())),
        ("reset_on_recovery", here(entry.reset_on_recovery.is_some())),
        ("heartbeat_ms", at(entry.heartbeat_ms.as_ref())),
        ("supervise_gateway_ms", at(entry.supervise_gateway_ms.as_ref())),
        ("self_starting", here(entry.self_starting.is_some())),
        ("store_timeout_ms", at(entry.store_timeout_ms.as_ref())),
        ("sdo_timeout_ms", at(entry.sdo_timeout_ms.as_ref())),
        ("pdo_timeout_ms", at(entry.pdo_timeout_ms.as_ref())),
        ("strict_dlc", here(entry.strict_dlc.is_some())),
        ("outputs", entry.outputs.value.then(|| entry.outputs.span.clone())),
        ("tpdo", entry.tpdo.keys().next().map(|key| key.span.clone())),
    ];
    keys.into_iter().filter_map(|(key, span)| Some((key, span?))).collect()
}

/// Keys that are set and are for esd modules only.
fn module_keys(entry: &NodeEntry) -> Vec<(&'static str, Range<usize>)> {
    let keys = [
        ("coding_switch", entry.coding_switch.as_ref().map(|at| at.span.clone())),
        ("manage", entry.manage.as_ref().map(|at| at.span.clone())),
        ("first_tx_delay_ms", entry.first_tx_delay_ms.as_ref().map(|at| at.span.clone())),
        ("status_period_ms", entry.status_period_ms.as_ref().map(|at| at.span.clone())),
        ("watchdog_id", entry.watchdog_id.as_ref().map(|at| at.span.clone())),
        ("watchdog_ms", entry.watchdog_ms.as_ref().map(|at| at.span.clone())),
        ("watchdog_factor", entry.watchdog_factor.as_ref().map(|at| at.span.clone())),
        ("watchdog_by", entry.watchdog_by.as_ref().map(|at| at.span.clone())),
        ("channel", entry.channel.keys().next().map(|key| key.span.clone())),
    ];
    keys.into_iter().filter_map(|(key, span)| Some((key, span?))).collect()
}
