//! Keys of serial lines that do not do what they seem to: those that nobody writes into the module, and packings that
//! cannot carry their line.

use std::ops::Range;

use super::super::installation::ChannelEntry;
use super::super::{At, SourceText};
use super::lines::used;
use super::problems::Problems;
use super::tags::Context;
use crate::canopen::Role;
use crate::esd::{CanTxMode, ChannelSettings, ModuleKind, SerialMode};
use crate::mapping::table::BusDef;

/// A module keeps so many received bytes that did not leave yet.
const RING: u32 = 256;
/// Most bytes of a frame.
const FULL_FRAME: u32 = 8;

/// Who sets up the lines of a module.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum SetUp {
    /// The gateway: it compares, and writes unless `configure` says otherwise.
    Managed,
    /// Somebody else: `manage = false` says so.
    Elsewhere,
    /// Nobody that is known of: the bus has no reply identifier.
    Nobody,
    /// Somebody else: the gateway is passive.
    Passive,
}

/// At most one warning for each line that is used: keys that nobody writes, or a packing that is too slow.
pub fn check(problems: &mut Problems, context: &Context<'_>, kind: ModuleKind, channels: &[ChannelSettings]) {
    // That there is no such bus was told.
    let Some(bus) = &context.bus else { return };
    let set_up = match context.entry.manage.as_ref().map(|at| at.value) {
        _ if bus.role == Role::Passive => SetUp::Passive,
        Some(false) => SetUp::Elsewhere,
        Some(true) => SetUp::Managed,
        None if bus.esd.reply_id.is_some() => SetUp::Managed,
        None => SetUp::Nobody,
    };
    for (number, key, entry) in used(context, kind) {
        let Some(channel) = channels.iter().find(|channel| channel.number == number) else { continue };
        if set_up != SetUp::Managed && warn_of_unwritten(problems, context.config, set_up, bus, entry) {
            continue;
        }
        if matches!(set_up, SetUp::Managed | SetUp::Nobody) {
            warn_of_packing(problems, context.config, set_up, bus, (key, entry), channel);
        }
    }
}

/// Keys that are parts of the module's parameters, and where they stand.
fn keys(entry: &ChannelEntry) -> Vec<(&'static str, Range<usize>)> {
    fn at<T>(at: Option<&At<T>>) -> Option<Range<usize>> {
        at.map(|at| at.span.clone())
    }
    let keys = [
        ("baud", at(entry.baud.as_ref())),
        ("receive_baud", at(entry.receive_baud.as_ref())),
        ("transmit_baud", at(entry.transmit_baud.as_ref())),
        ("data_bits", at(entry.data_bits.as_ref())),
        ("parity", at(entry.parity.as_ref())),
        ("stop_bits", at(entry.stop_bits.as_ref())),
        ("cts", at(entry.cts.as_ref())),
        ("rts", at(entry.rts.as_ref())),
        ("min_char", at(entry.min_char.as_ref())),
        ("end_mark", at(entry.end_mark.as_ref())),
        ("max_char", at(entry.max_char.as_ref())),
        ("inhibit_ms", at(entry.inhibit_ms.as_ref())),
    ];
    keys.into_iter().filter_map(|(key, span)| Some((key, span?))).collect()
}

/// Whether there are keys that nobody writes. Where `manage = false` says that somebody else sets the module up, the bit
/// rate is no order: the pace of what goes out follows from it, and nothing else could tell it.
fn warn_of_unwritten(
    problems: &mut Problems,
    config: &SourceText,
    set_up: SetUp,
    bus: &BusDef,
    entry: &ChannelEntry,
) -> bool {
    let mut keys = keys(entry);
    if set_up == SetUp::Elsewhere {
        keys.retain(|(key, _)| !matches!(*key, "baud" | "transmit_baud"));
    }
    let Some((_, first)) = keys.iter().min_by_key(|(_, span)| span.start) else { return false };
    let names: Vec<String> = keys.iter().map(|(key, _)| format!("`{key}`")).collect();
    let verb = if names.len() == 1 { "is" } else { "are" };
    let written = format!("{} {verb} not written", names.join(", "));
    let (message, hint) = match set_up {
        SetUp::Passive => (
            format!("{written}: the gateway is passive on bus `{}`", bus.name),
            "leave it out: the line is as the module has it".to_owned(),
        ),
        SetUp::Elsewhere => (
            format!("{written}: the module is not managed; only the pace follows it"),
            "leave it out, or take `manage = false` out".to_owned(),
        ),
        SetUp::Nobody | SetUp::Managed => (
            format!("{written}: the module is not managed; only the pace follows it"),
            format!(
                "give [bus.{}.esd] a `reply_id`; or leave it out, and say `manage = false` where another tool sets the \
                 module up",
                bus.name
            ),
        ),
    };
    problems.warning(config, first, message, hint);
    true
}

/// Tells a line that can bring more than its frames carry away (R-ESD-026, R-ESD-028).
fn warn_of_packing(
    problems: &mut Problems,
    config: &SourceText,
    set_up: SetUp,
    bus: &BusDef,
    (key, entry): (&At<String>, &ChannelEntry),
    channel: &ChannelSettings,
) {
    let mode = channel.can_tx_mode.unwrap_or(CanTxMode::DEFAULT);
    let serial = channel.serial_mode.or_else(|| SerialMode::from_value(SerialMode::DEFAULT_VALUE));
    let Some(brings) = serial.map(SerialMode::receives) else { return };
    let (most, inhibit) = (u32::from(mode.max_char), u32::from(mode.inhibit));
    // Without an inhibit time only the bus sets a limit.
    let Some(carries) = (most * 1_000).checked_div(inhibit).filter(|carries| *carries < brings) else {
        return;
    };
    let shipped = if channel.can_tx_mode.is_none() { " as shipped" } else { "" };
    let message = format!(
        "channel {}{shipped} passes on at most {carries} bytes/s ({most} every {inhibit} ms) of the {brings} that its line \
         can bring: what the {RING} bytes of its memory cannot hold is lost there",
        channel.number
    );
    let fits = format!("`max_char = {FULL_FRAME}` and `inhibit_ms = {}`", FULL_FRAME * 1_000 / brings);
    let hint = if set_up == SetUp::Nobody {
        format!(
            "give the channel {fits}, and [bus.{}.esd] a `reply_id`; or say `manage = false` where another tool sets the \
             module up",
            bus.name
        )
    } else {
        format!("give it {fits}")
    };
    let places = [&entry.inhibit_ms, &entry.max_char, &entry.min_char, &entry.baud, &entry.receive_baud];
    let span = places.into_iter().flatten().next().map_or(&key.span, |at| &at.span);
    problems.warning(config, span, message, hint);
}
