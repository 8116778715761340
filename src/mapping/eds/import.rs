//! From an EDS or DCF to the text of a device mapping.

use super::chunk::{Chunk, Part};
use super::former::{BEGIN, END, Former};
use super::model::Eds;
use super::pdo::{Tpdo, tpdos};
use super::report::{Place, Report};
use super::{setup, tags, writer};
use crate::mapping::{Diagnostic, SourceText};

/// A mapping made of an EDS.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Imported {
    /// Its text.
    pub text: String,
    /// What was left out, or is not as it was.
    pub warnings: Vec<Diagnostic>,
    /// TPDOs that it has.
    pub tpdos: usize,
    /// Tags that import wrote, now or before.
    pub tags: usize,
    /// Objects that are set at every start.
    pub settings: usize,
    /// Registers below this one are given away.
    pub registers_used: u64,
    /// Bits below this one are given away.
    pub bits_used: u64,
}

/// Makes a mapping of an EDS (R-ESD-110, R-ESD-118 to 122). With the former text of the same mapping, addresses and names
/// never move, and what was written by hand stays; an error tells why that text cannot be taken up.
///
/// The same input gives the same text.
pub fn import(eds: &Eds, previous: Option<&SourceText>) -> Result<Imported, Vec<Diagnostic>> {
    let mut former = previous.map(Former::read).transpose()?.unwrap_or_default();
    let mut report = Report::new(eds.file.clone());
    let sent = sent(&mut report, eds, &former);
    let tags = tags::tags(&mut report, eds, &sent, &mut former);
    let entries = setup::entries(&mut report, eds, &former);
    writer::tell_changed_setup(&mut report, &former, &entries);
    if tags.texts.is_empty() {
        let hint =
            "its TPDOs carry nothing by default: add tags by hand, or import a DCF that configures them";
        report.warn(Place::START, "this device has no value that a tag could be made of", hint);
    }
    let mut parts = vec![
        "# Made from an EDS or DCF. Names, units, descriptions and scales may be changed here; they and the addresses stay.\n\
         format = 1"
            .to_owned(),
        writer::device(eds, &former, tags.registers_used, tags.bits_used),
    ];
    let is_own = |table: &str| former.own_tables.contains(table);
    parts.extend(writer::identity(eds).filter(|_| !is_own("identity")));
    parts.extend((!is_own("error_control")).then(|| writer::error_control(eds, &former)));
    parts.extend(sent.iter().map(|tpdo| writer::tpdo(tpdo, &former)));
    parts.extend(tags.texts.iter().cloned());
    parts
        .extend(former.chunks.iter().filter(|chunk| chunk.part == Part::Own).map(|chunk| chunk.text.clone()));
    parts.extend(entries.iter().map(writer::setup));
    let text = format!("{}{BEGIN}\n{}\n\n{END}\n{}", former.above, parts.join("\n\n"), former.below);
    if let (Some(previous), Err(error)) = (previous, text.parse::<toml::Table>()) {
        let hint =
            "a table stands both inside and outside the lines that import writes: take one of them out";
        return Err(vec![previous.error(
            &(0..0),
            format!("this mapping cannot be updated: {}", error.message()),
            hint,
        )]);
    }
    Ok(Imported {
        text,
        warnings: report.finish(),
        tpdos: sent.len(),
        tags: tags.texts.len(),
        settings: entries.len(),
        registers_used: tags.registers_used,
        bits_used: tags.bits_used,
    })
}

/// The TPDOs of the file; where a former text has `mapping = "write"` and no DCF says otherwise, its content counts.
fn sent(report: &mut Report, eds: &Eds, former: &Former) -> Vec<Tpdo> {
    let found = tpdos(report, eds);
    let mut sent = found.sent;
    sent.retain(|tpdo| !former.own_tpdos.contains_key(&tpdo.number));
    for chunk in &former.chunks {
        let Part::Tpdo(number) = chunk.part else { continue };
        let place = sent.iter().position(|tpdo| tpdo.number == number);
        let by_file = place.and_then(|place| sent.get(place)).is_some_and(|tpdo| tpdo.is_configured);
        let is_written = chunk.entry().get("mapping").and_then(|mode| mode.as_str()) == Some("write");
        match (written(chunk, number).filter(|_| is_written && !by_file), place) {
            (Some(own), Some(place)) => sent.splice(place..=place, [own]).for_each(drop),
            (Some(own), None) => sent.push(own),
            (None, Some(_)) => {}
            (None, None) => {
                let message = format!("the device no longer sends TPDO {number}");
                report.warn(Place::START, message, "its entry is gone; mapping = \"write\" would keep it");
            }
        }
    }
    sent.sort_by_key(|tpdo| tpdo.number);
    let is_off = |number: &u16| {
        sent.iter().all(|tpdo| tpdo.number != *number) && !former.own_tpdos.contains_key(number)
    };
    tell_tpdos(
        report,
        found.off.iter().copied().filter(is_off),
        "of the device is off or empty by default",
        "to use it add a [tpdo.N] with mapping = \"write\" below what import writes",
    );
    let on_sync = sent.iter().filter(|tpdo| matches!(tpdo.transmission_type, Some(0..=240)));
    tell_tpdos(
        report,
        on_sync.map(|tpdo| tpdo.number),
        "is sent after a SYNC only",
        "something on the bus must produce SYNC; or write transmission_type = 255, an event_timer_ms and mapping = \"write\"",
    );
    sent
}

/// One warning for several TPDOs, the first 16 of them by number.
fn tell_tpdos(report: &mut Report, numbers: impl Iterator<Item = u16>, what: &str, hint: &str) {
    let numbers: Vec<String> = numbers.take(16).map(|number| number.to_string()).collect();
    if !numbers.is_empty() {
        report.warn(Place::START, format!("TPDO {} {what}", numbers.join(", ")), hint);
    }
}

/// A TPDO as a former text has it; its chunk is kept as it is, so only what tags need is read.
fn written(chunk: &Chunk, number: u16) -> Option<Tpdo> {
    let text = chunk.entry().get("cob_id").and_then(|cob_id| cob_id.as_str().map(str::to_owned));
    let text = text.or_else(|| chunk.entry().get("cob_id").map(ToString::to_string))?;
    let (whole, _) = super::number::whole(&text)?;
    Some(Tpdo {
        number,
        cob_id: super::pdo::CobId { base: u32::try_from(whole.base).ok()?, plus_node_id: whole.plus_node_id },
        maps: chunk.maps()?,
        transmission_type: chunk
            .entry()
            .get("transmission_type")
            .and_then(|number| u8::try_from(number.as_integer()?).ok()),
        event_timer_ms: None,
        inhibit_time_us: None,
        is_configured: true,
    })
}
