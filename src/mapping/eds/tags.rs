//! The tags of a mapping from the objects of an EDS.

use std::collections::BTreeMap;
use std::fmt;

use super::chunk::{Chunk, Part, text};
use super::former::Former;
use super::model::{DataType, Eds, ObjectId};
use super::naming::title;
use super::pdo::{Mapped, Tpdo};
use super::report::{Place, Report};
use super::writer::quoted;

/// How often an object that no TPDO carries is asked for.
const POLL_MS: u32 = 60_000;
/// Objects that are asked for, at most, without anybody having asked for them.
const MOST_POLLED: usize = 64;
/// Tags that a mapping can have.
const MOST_TAGS: usize = 4096;
/// Lowest index of an object that is a value of the process.
const FIRST_VALUE: u16 = 0x2000;

/// The `type` of a tag.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Type {
    /// `bool`
    Bool,
    /// `u1` to `u64`
    Unsigned(u8),
    /// `i2` to `i64`
    Signed(u8),
    /// `f32` or `f64`
    Float(u8),
}

impl fmt::Display for Type {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Bool => f.write_str("bool"),
            Self::Unsigned(bits) => write!(f, "u{bits}"),
            Self::Signed(bits) => write!(f, "i{bits}"),
            Self::Float(bits) => write!(f, "f{bits}"),
        }
    }
}

impl Type {
    /// Reads what [`fmt::Display`] writes.
    fn from_word(word: &str) -> Option<Self> {
        if word == "bool" {
            return Some(Self::Bool);
        }
        let (kind, bits) = word.split_at_checked(1)?;
        let bits = bits.parse().ok()?;
        match kind {
            "u" => Some(Self::Unsigned(bits)),
            "i" => Some(Self::Signed(bits)),
            "f" => Some(Self::Float(bits)),
            _ => None,
        }
    }

    /// How it stands in the register map, and in how many registers. A bool stands among the bits, and a whole number of
    /// more than 32 bits has no place there without losing digits.
    fn register(self) -> Option<(&'static str, u16)> {
        match self {
            Self::Unsigned(..=16) => Some(("u16", 1)),
            Self::Signed(..=16) => Some(("i16", 1)),
            Self::Unsigned(..=32) => Some(("u32", 2)),
            Self::Signed(..=32) => Some(("i32", 2)),
            Self::Float(_) => Some(("f32", 2)),
            Self::Bool | Self::Unsigned(_) | Self::Signed(_) => None,
        }
    }

    /// Whether a tag can change from one to the other and keep its address.
    fn has_same_place(self, other: Self) -> bool {
        let count = |kind: Self| kind.register().map(|(_, count)| count);
        count(self) == count(other) && (self == Self::Bool) == (other == Self::Bool)
    }
}

/// An object that becomes a tag.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Candidate {
    object: ObjectId,
    kind: Type,
    /// Whether a TPDO carries it.
    is_carried: bool,
}

/// All tags as text, in the order of the file.
#[derive(Debug, Default)]
pub struct Tags {
    /// One text for each.
    pub texts: Vec<String>,
    /// Registers below this one were given away, now or before.
    pub registers_used: u64,
    /// The same for bits.
    pub bits_used: u64,
}

/// The tags: those that were there stay as they are, new ones come after them.
pub fn tags(report: &mut Report, eds: &Eds, tpdos: &[Tpdo], former: &mut Former) -> Tags {
    let mut maker = Maker {
        eds,
        tags: Tags { texts: Vec::new(), registers_used: former.registers_used, bits_used: former.bits_used },
    };
    let candidates = candidates(report, eds, tpdos, former);
    let by_object: BTreeMap<ObjectId, Candidate> =
        candidates.iter().map(|candidate| (candidate.object, *candidate)).collect();
    let carried_before: Vec<Mapped> = former
        .chunks
        .iter()
        .filter(|chunk| matches!(chunk.part, Part::Tpdo(_)))
        .filter_map(Chunk::maps)
        .flatten()
        .collect();
    let mut known = former.own_tags.clone();
    for chunk in std::mem::take(&mut former.chunks) {
        if let Part::Tag(object) = chunk.part {
            known.insert(object);
            let was_carried = carried_before.iter().any(|mapped| mapped.object == object);
            maker.keep(report, &chunk, by_object.get(&object).copied(), object, was_carried, former);
        }
        former.chunks.push(chunk);
    }
    for candidate in candidates.iter().filter(|candidate| !known.contains(&candidate.object)) {
        maker.add(report, *candidate, former);
    }
    maker.tags
}

/// What a TPDO carries, in its order, and then what else could be of interest and fits a PDO.
fn candidates(report: &mut Report, eds: &Eds, tpdos: &[Tpdo], former: &Former) -> Vec<Candidate> {
    let mut list: Vec<Candidate> = Vec::new();
    let mut seen = former.own_tags.clone();
    let carried = tpdos.iter().map(|tpdo| &tpdo.maps).chain(former.own_tpdos.values()).flatten();
    for mapped in carried.filter(|mapped| !mapped.is_gap()) {
        if seen.insert(mapped.object) {
            let kind = carried_type(report, eds, *mapped);
            list.push(Candidate { object: mapped.object, kind, is_carried: true });
        }
    }
    if list.len() > MOST_TAGS {
        let message = format!("the TPDOs carry {} objects, the first {MOST_TAGS} become tags", list.len());
        report.warn(Place::START, message, "");
        list.truncate(MOST_TAGS);
    }
    let others: Vec<(ObjectId, Type)> = eds
        .objects
        .iter()
        .filter(|(id, object)| {
            let is_count = id.sub == 0 && eds.groups.contains_key(&id.index);
            id.index >= FIRST_VALUE && !is_count && object.pdo_mapping && object.access.is_sent()
        })
        .filter(|(id, _)| !seen.contains(id))
        .filter_map(|(id, object)| polled_type(object.data_type).map(|kind| (*id, kind)))
        .collect();
    let most = MOST_POLLED.min(MOST_TAGS - list.len());
    if let Some((first, _)) = others.get(most) {
        let message = format!(
            "{} more objects could be in a TPDO but are in none; the first {most} are asked for once a minute",
            others.len()
        );
        let place = eds.objects.get(first).map_or(Place::START, |object| object.place);
        report.warn(place, message, format!("from {first} on: add a [[tag]] by hand for each that you want"));
    }
    list.extend(others.into_iter().take(most).map(|(object, kind)| Candidate {
        object,
        kind,
        is_carried: false,
    }));
    list
}

fn polled_type(data_type: DataType) -> Option<Type> {
    match data_type {
        DataType::Boolean => Some(Type::Bool),
        DataType::Integer(bits) => Some(Type::Signed(bits)),
        DataType::Unsigned(bits) => Some(Type::Unsigned(bits)),
        DataType::Real(bits) => Some(Type::Float(bits)),
        DataType::Time | DataType::Text | DataType::Domain | DataType::Other(_) | DataType::Unknown => None,
    }
}

/// The type of an object in a TPDO: its bits there count.
fn carried_type(report: &mut Report, eds: &Eds, mapped: Mapped) -> Type {
    let bits = mapped.bits;
    let Some(object) = eds.objects.get(&mapped.object) else { return Type::Unsigned(bits) };
    let raw = Type::Unsigned(bits);
    let (kind, width) = match object.data_type {
        DataType::Boolean => return Type::Bool,
        DataType::Integer(width) => (if bits > 1 { Type::Signed(bits) } else { raw }, Some(width)),
        DataType::Unsigned(width) => (raw, Some(width)),
        DataType::Real(width) => (if width == bits { Type::Float(bits) } else { raw }, Some(width)),
        DataType::Time => (raw, Some(48)),
        DataType::Text | DataType::Domain | DataType::Other(_) | DataType::Unknown => (raw, None),
    };
    if width != Some(bits) {
        let has =
            width.map_or_else(|| "no type of a known width".to_owned(), |width| format!("{width} bits"));
        let message = format!("{} has {has}, but a TPDO carries it with {bits} bits", mapped.object);
        report.warn(object.place, message, format!("it is read as {kind}; check DataType and the mapping"));
    }
    kind
}

struct Maker<'a> {
    eds: &'a Eds,
    tags: Tags,
}

impl Maker<'_> {
    fn place(&self, object: ObjectId) -> Place {
        self.eds.objects.get(&object).map_or(Place::START, |object| object.place)
    }

    /// A tag that was there before.
    fn keep(
        &mut self,
        report: &mut Report,
        chunk: &Chunk,
        candidate: Option<Candidate>,
        object: ObjectId,
        was_carried: bool,
        former: &mut Former,
    ) {
        let name = text(chunk.entry(), "name").unwrap_or_default().to_owned();
        let is_carried = candidate.is_some_and(|candidate| candidate.is_carried);
        if candidate.is_none() && !self.eds.objects.contains_key(&object) {
            let message = format!("the device no longer has {object}: tag `{name}` is gone");
            report.warn(
                Place::START,
                message,
                "its addresses stay free, so that no other value appears there",
            );
            return;
        }
        let mut chunk = chunk.clone();
        let mut set = |key: &str, value: Option<&str>| {
            chunk.text = {
                let changed = chunk.with(key, value);
                if let Some(again) = Chunk::from_text(&changed) {
                    chunk.table = again.table;
                }
                changed
            }
        };
        if is_carried {
            set("poll_ms", None);
        } else if was_carried {
            set("poll_ms", Some(&POLL_MS.to_string()));
            let message =
                format!("no TPDO carries {object} any more: tag `{name}` is asked for once a minute");
            report.warn(self.place(object), message, "change its poll_ms as you need it");
        }
        if let Some(candidate) = candidate {
            self.retype(report, &mut chunk, &name, candidate, former);
        }
        self.tags.texts.push(chunk.text);
    }

    /// Gives a tag another type, where its object has one that cannot stay at the same address.
    fn retype(
        &mut self,
        report: &mut Report,
        chunk: &mut Chunk,
        name: &str,
        candidate: Candidate,
        former: &mut Former,
    ) {
        let before = text(chunk.entry(), "type").and_then(Type::from_word);
        let Some(before) = before.filter(|before| *before != candidate.kind) else { return };
        let place = self.place(candidate.object);
        if before.has_same_place(candidate.kind) {
            let message = format!(
                "tag `{name}` keeps its type {before}, though the file says {} for {}",
                candidate.kind, candidate.object
            );
            report.warn(place, message, "change `type` in the mapping if it was not changed by hand");
            return;
        }
        let message = format!(
            "{} is now {} instead of {before}: tag `{name}` gets a new address",
            candidate.object, candidate.kind
        );
        report.warn(place, message, "change what reads the old one");
        let (key, value) = self.address(report, candidate, name, former).unzip();
        let kind = format!("\"{}\"", candidate.kind);
        for (changed, value) in [
            ("type", Some(kind.as_str())),
            ("registers", value.as_deref().filter(|_| key == Some("registers"))),
            ("bit_address", value.as_deref().filter(|_| key == Some("bit_address"))),
        ] {
            if let Some(again) = Chunk::from_text(&chunk.with(changed, value)) {
                *chunk = again;
            }
        }
    }

    /// A new tag.
    fn add(&mut self, report: &mut Report, candidate: Candidate, former: &mut Former) {
        let Candidate { object, kind, is_carried } = candidate;
        let name = former.names.name(self.eds, object);
        let mut lines = vec!["[[tag]]".to_owned(), format!("name = \"{name}\"")];
        let title = title(self.eds, object);
        if !title.is_empty() {
            lines.push(format!("description = {}", quoted(&title)));
        }
        lines.push(format!("object = \"{object}\""));
        lines.push(format!("type = \"{kind}\""));
        if !is_carried {
            lines.push(format!("poll_ms = {POLL_MS}"));
        }
        if kind != Type::Bool {
            let unit = self.eds.objects.get(&object).map(|object| object.unit.as_str());
            lines.push(format!("unit = {}", quoted(unit.unwrap_or_default())));
        }
        if let Some((key, value)) = self.address(report, candidate, &name, former) {
            lines.push(format!("{key} = {value}"));
        }
        self.tags.texts.push(lines.join("\n"));
    }

    /// A new address: key and value.
    fn address(
        &mut self,
        report: &mut Report,
        candidate: Candidate,
        name: &str,
        former: &mut Former,
    ) -> Option<(&'static str, String)> {
        let place = self.place(candidate.object);
        let is_bool = candidate.kind == Type::Bool;
        let Some((encoding, count)) = candidate.kind.register().or(is_bool.then_some(("", 0))) else {
            let message = format!("`{name}` has {} and stands in no register", candidate.kind);
            let hint = "registers hold whole numbers of 32 bits; MQTT has it with all its digits";
            report.warn(place, message, hint);
            return None;
        };
        let address = if is_bool { former.addresses.bit() } else { former.addresses.registers(count) };
        let Some(address) = address else {
            report.warn(place, format!("there is no address left for `{name}`"), "MQTT has it");
            return None;
        };
        let end = u64::from(address) + u64::from(count.max(1));
        if is_bool {
            self.tags.bits_used = self.tags.bits_used.max(end);
            return Some(("bit_address", address.to_string()));
        }
        self.tags.registers_used = self.tags.registers_used.max(end);
        if candidate.kind == Type::Float(64) {
            let message = format!("`{name}` has 64 bits, in the registers it is rounded to 32");
            report.warn(place, message, "MQTT has it with all its digits");
        }
        Some(("registers", format!("[{{ address = {address}, type = \"{encoding}\" }}]")))
    }
}
