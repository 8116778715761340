//! The tables of a mapping that come from an EDS, other than its tags, as text.

use super::chunk::{Chunk, Part, text};
use super::former::Former;
use super::model::{Eds, ObjectId};
use super::pdo::Tpdo;
use super::report::{Place, Report};
use super::setup;

/// Heartbeat of a device that sends none by default, in ms.
const HEARTBEAT_MS: u64 = 1000;
/// Shortest time-out of a heartbeat, in ms.
const SHORTEST_TIMEOUT_MS: u64 = 500;
/// Longest time-out of a heartbeat, in ms; the heartbeat itself must be shorter.
const LONGEST_TIMEOUT_MS: u64 = 65_535;

/// A text in quotation marks, as TOML has it.
pub fn quoted(text: &str) -> String {
    toml::Value::String(text.to_owned()).to_string()
}

/// `[device]`. A description that was written by hand stays.
pub fn device(eds: &Eds, former: &Former, registers_used: u64, bits_used: u64) -> String {
    let device = &eds.device;
    let or = |text: &str, other: &str| quoted(if text.is_empty() { other } else { text });
    let file = eds.file.rsplit(['/', '\\']).next().unwrap_or_default();
    let before = former.chunk(&Part::Device).and_then(|chunk| text(chunk.entry(), "description"));
    let versions = [("version", &device.file_version), ("of", &device.file_date)];
    let source: Vec<String> = std::iter::once(file.to_owned())
        .chain(
            versions.iter().filter(|(_, text)| !text.is_empty()).map(|(what, text)| format!("{what} {text}")),
        )
        .collect();
    [
        "[device]".to_owned(),
        format!("vendor = {}", or(&device.vendor_name, "unknown")),
        format!("model = {}", or(&device.product_name, file.split('.').next().unwrap_or_default())),
        format!("description = {}", quoted(before.unwrap_or(&device.description))),
        format!("source = {}", quoted(&source.join(", "))),
        format!("registers_used = {registers_used}"),
        format!("bits_used = {bits_used}"),
    ]
    .join("\n")
}

/// `[identity]`; `None` where the file says nothing of it. A number that is 0 is not maintained by the maker.
pub fn identity(eds: &Eds) -> Option<String> {
    let number = |index, sub| {
        let number = eds.objects.get(&ObjectId::new(index, sub))?.number()?.of(None)?;
        u32::try_from(number).ok()
    };
    let or = |number: Option<u32>, other: Option<u32>| {
        number.filter(|number| *number != 0).or(other.filter(|other| *other != 0))
    };
    let device = &eds.device;
    let lines: Vec<String> = [
        ("device_type", number(0x1000, 0)),
        ("vendor_id", or(number(0x1018, 1), device.vendor_number)),
        ("product_code", or(number(0x1018, 2), device.product_number)),
        ("revision_number", or(number(0x1018, 3), device.revision_number)),
    ]
    .into_iter()
    .filter_map(|(key, number)| number.map(|number| format!("{key} = 0x{number:08X}")))
    .collect();
    (!lines.is_empty()).then(|| format!("[identity]\n{}", lines.join("\n")))
}

/// `[error_control]`: heartbeat where the device has it, else guarding, else none. What was there before stays.
pub fn error_control(eds: &Eds, former: &Former) -> String {
    if let Some(chunk) = former.chunk(&Part::ErrorControl) {
        return chunk.text.clone();
    }
    let object = |index| eds.objects.get(&ObjectId::new(index, 0));
    let number = |index| {
        let number = object(index)?.number()?.of(None)?;
        u64::try_from(number).ok().filter(|number| *number > 0)
    };
    let mut lines = vec!["[error_control]".to_owned()];
    let heartbeat = object(0x1017)
        .and_then(|object| number(0x1017).or(object.access.is_writable().then_some(HEARTBEAT_MS)));
    if let Some(heartbeat) = heartbeat {
        // Two lost in a row, and a half more for their delay; a busy host may be late by more than a fast heartbeat.
        let timeout = (heartbeat * 5 / 2).clamp(SHORTEST_TIMEOUT_MS, LONGEST_TIMEOUT_MS);
        lines.push("kind = \"heartbeat\"".to_owned());
        lines.push(format!("heartbeat_ms = {}", heartbeat.min(LONGEST_TIMEOUT_MS - 1)));
        lines.push(format!("heartbeat_timeout_ms = {timeout}"));
    } else if object(0x100C).is_some() && object(0x100D).is_some() {
        lines.push("kind = \"guarding\"".to_owned());
        if let Some(time) = number(0x100C) {
            lines.push(format!("guard_time_ms = {}", time.clamp(20, LONGEST_TIMEOUT_MS)));
        }
        if let Some(factor) = number(0x100D) {
            lines.push(format!("life_time_factor = {}", factor.min(255)));
        }
    } else {
        lines.push("kind = \"none\"".to_owned());
    }
    lines.join("\n")
}

/// `[tpdo.N]`. Of one that was there before, what the file does not say stays; with the same content and identifier all of it.
pub fn tpdo(tpdo: &Tpdo, former: &Former) -> String {
    let maps: Vec<String> = tpdo.maps.iter().map(|mapped| format!("\"{mapped}\"")).collect();
    let cob_id = format!("\"{}\"", tpdo.cob_id);
    let maps = format!("[{}]", maps.join(", "));
    if let Some(chunk) = former.chunk(&Part::Tpdo(tpdo.number)) {
        return adapted(chunk, &[("cob_id", cob_id), ("maps", maps)]);
    }
    let mode = if tpdo.is_configured { "write" } else { "verify" };
    let mut lines = vec![
        format!("[tpdo.{}]", tpdo.number),
        format!("cob_id = {cob_id}"),
        format!("maps = {maps}"),
        format!("mapping = \"{mode}\""),
    ];
    if let Some(number) = tpdo.transmission_type {
        lines.push(format!("transmission_type = {number}"));
    }
    // What is off by default need not be checked; what a DCF wants to be off must be written.
    let wanted = |number: u32| number > 0 || tpdo.is_configured;
    if let Some(number) = tpdo.event_timer_ms.filter(|number| wanted(u32::from(*number))) {
        lines.push(format!("event_timer_ms = {number}"));
    }
    if let Some(number) = tpdo.inhibit_time_us.filter(|number| wanted(*number)) {
        lines.push(format!("inhibit_time_us = {number}"));
    }
    lines.join("\n")
}

/// A chunk with some keys as they are now; the same text where they already are.
fn adapted(chunk: &Chunk, keys: &[(&str, String)]) -> String {
    let mut chunk = chunk.clone();
    for (key, value) in keys {
        let wanted = format!("v = {value}").parse::<toml::Table>().ok();
        if chunk.entry().get(*key) != wanted.as_ref().and_then(|table| table.get("v"))
            && let Some(changed) = Chunk::from_text(&chunk.with(key, Some(value)))
        {
            chunk = changed;
        }
    }
    chunk.text
}

/// `[[setup]]` of one object.
pub fn setup(entry: &setup::Entry) -> String {
    format!("[[setup]]\nobject = \"{}\"\ntype = \"{}\"\nvalue = {}", entry.object, entry.kind, entry.value)
}

/// Tells which settings of the former text are not those of the file.
pub fn tell_changed_setup(report: &mut Report, former: &Former, entries: &[setup::Entry]) {
    for chunk in &former.chunks {
        let Part::Setup(object) = chunk.part else { continue };
        let before = chunk.entry().get("value").cloned();
        let now = entries.iter().find(|entry| entry.object == object);
        let now = now.and_then(|entry| format!("v = {}", entry.value).parse::<toml::Table>().ok());
        let now = now.as_ref().and_then(|table| table.get("v"));
        if now != before.as_ref() {
            let shown = |value: Option<&toml::Value>| value.map_or("nothing".to_owned(), ToString::to_string);
            let message = format!("{object} was set to {}, now to {}", shown(before.as_ref()), shown(now));
            let hint = "a setting of your own belongs below the last line of what import writes";
            report.warn(Place::START, message, hint);
        }
    }
}
