//! The object dictionary of an EDS: sections to objects.

use std::collections::{BTreeMap, BTreeSet};

use super::ini::{Entry, Ini, Section};
use super::model::{Access, DataType, Object, ObjectId, Value};
use super::number::{self, Oddity};
use super::report::{Place, Report};
use super::sections::{Kind, kind};

/// Most entries of an object dictionary that are read.
pub const MOST_OBJECTS: usize = 65_536;
/// Highest sub-index that is a value; 255 describes the structure.
const HIGHEST_SUB: u8 = 254;

/// Objects, and the names of arrays and records.
pub type Objects = (BTreeMap<ObjectId, Object>, BTreeMap<u16, String>);

/// The sections of one index.
#[derive(Default)]
struct Parts<'a> {
    main: Option<&'a Section>,
    subs: BTreeMap<u8, &'a Section>,
    names: Option<&'a Section>,
    values: Option<&'a Section>,
}

/// All objects of a file. `None` where there are too many.
pub fn objects(report: &mut Report, ini: &Ini) -> Option<Objects> {
    let parts = collect(report, ini);
    check_lists(report, ini, &parts);
    let mut objects = BTreeMap::new();
    let mut groups = BTreeMap::new();
    for (index, parts) in &parts {
        one(report, *index, parts, &mut objects, &mut groups);
        if objects.len() > MOST_OBJECTS {
            let place = parts.main.map_or(Place::START, |section| section.place);
            report.error(
                place,
                format!("more than {MOST_OBJECTS} objects"),
                "is this the EDS of one device?",
            );
            return None;
        }
    }
    Some((objects, groups))
}

fn collect<'a>(report: &mut Report, ini: &'a Ini) -> BTreeMap<u16, Parts<'a>> {
    let mut all: BTreeMap<u16, Parts<'a>> = BTreeMap::new();
    let mut modules = None;
    for section in &ini.sections {
        let before = match kind(&section.name) {
            Kind::Object(index) => all.entry(index).or_default().main.replace(section),
            Kind::Sub(index, sub) => all.entry(index).or_default().subs.insert(sub, section),
            Kind::Names(index) => all.entry(index).or_default().names.replace(section),
            Kind::Values(index) => all.entry(index).or_default().values.replace(section),
            Kind::Module => {
                modules.get_or_insert(section.place);
                None
            }
            Kind::List | Kind::Other => None,
            Kind::Unknown => {
                let message = format!("section [{}] is not of the standard", section.title);
                report.warn(section.place, message, "it is left out");
                None
            }
        };
        if let Some(before) = before {
            let message = format!("[{}] means the same as [{}]", section.title, before.title);
            report.warn(section.place, message, format!("line {} is left out", before.place.line));
        }
    }
    if let Some(place) = modules {
        let hint =
            "describe the device as it is built: its configuration tool can export a DCF without modules";
        report.warn(place, "modules are not supported; their objects are left out", hint);
    }
    all
}

/// `[MandatoryObjects]` and its like against the objects that are there.
fn check_lists(report: &mut Report, ini: &Ini, parts: &BTreeMap<u16, Parts<'_>>) {
    for section in ini.sections.iter().filter(|section| kind(&section.name) == Kind::List) {
        let mut listed = BTreeSet::new();
        for (key, entry) in
            section.entries.iter().filter(|(key, _)| key.bytes().all(|byte| byte.is_ascii_digit()))
        {
            let Some(index) = whole(report, entry).and_then(|index| u16::try_from(index).ok()) else {
                let message = format!("`{}` is not the index of an object", entry.value);
                report.warn(entry.place, message, "write 0x1000 to 0xFFFF");
                continue;
            };
            listed.insert(index);
            if !parts.contains_key(&index) {
                let message = format!("object {index:04X}h is listed, but there is no [{index:04X}]");
                report.warn(entry.place, message, format!("describe it, or take `{key}` out of the list"));
            }
        }
        let said = section.get("supportedobjects");
        let count = said.and_then(|entry| whole(report, entry));
        if let (Some(entry), Some(count)) = (said, count)
            && usize::try_from(count) != Ok(listed.len())
        {
            let message = format!("SupportedObjects says {count}, but {} are listed", listed.len());
            report.warn(entry.place, message, "every object that is described is read, listed or not");
        }
    }
}

fn one(
    report: &mut Report,
    index: u16,
    parts: &Parts<'_>,
    objects: &mut BTreeMap<ObjectId, Object>,
    groups: &mut BTreeMap<u16, String>,
) {
    let object_type = parts.main.and_then(|section| {
        let entry = section.get("objecttype")?;
        let number = whole(report, entry).unwrap_or(-1);
        if !matches!(number, 0 | 2 | 5..=9) {
            let hint = "write 0x7 (variable), 0x8 (array) or 0x9 (record); it is taken for a variable";
            report.warn(entry.place, format!("there is no object type `{}`", entry.value), hint);
        }
        Some((number, entry.place))
    });
    let compact = parts.main.and_then(|section| section.get("compactsubobj"));
    let compact = compact.and_then(|entry| whole(report, entry)).unwrap_or(0);
    let compact = u8::try_from(compact.clamp(0, i128::from(HIGHEST_SUB))).unwrap_or(HIGHEST_SUB);
    let is_group = !parts.subs.is_empty() || compact > 0 || matches!(object_type, Some((8 | 9, _)));
    if let (false, Some((2 | 7, place))) = (parts.subs.is_empty(), object_type) {
        report.warn(
            place,
            format!("{index:04X}h is called a variable, but has sub-indices"),
            "write ObjectType=0x8 (array) or 0x9 (record); the sub-indices count",
        );
    }
    if let (None, Some(first)) = (parts.main, parts.subs.values().next()) {
        let message = format!("[{}] has no [{index:04X}] that it belongs to", first.title);
        report.warn(first.place, message, format!("add [{index:04X}] with its ParameterName"));
    }
    if let Some(section) = parts.main {
        if is_group {
            groups.insert(index, section.text("parametername").to_owned());
        } else if !matches!(object_type, Some((0 | 5 | 6, _))) {
            objects.insert(ObjectId::new(index, 0), object(report, section));
        }
        if compact > 0 {
            compact_object(report, index, section, compact, objects);
        }
    }
    for (sub, section) in &parts.subs {
        objects.insert(ObjectId::new(index, *sub), object(report, section));
    }
    name_subs(report, index, parts, objects);
    fill_values(report, index, parts, objects);
}

/// The sub-indices of `CompactSubObj`: 0 says how many there are, the others are like their main section.
fn compact_object(
    report: &mut Report,
    index: u16,
    section: &Section,
    count: u8,
    objects: &mut BTreeMap<ObjectId, Object>,
) {
    let template = object(report, section);
    let number = Value { text: count.to_string(), place: section.place };
    let first = Object {
        name: "Highest sub-index".to_owned(),
        data_type: DataType::Unsigned(8),
        access: Access::ReadOnly,
        default: Some(number),
        parameter_value: None,
        low_limit: None,
        high_limit: None,
        pdo_mapping: false,
        unit: String::new(),
        place: section.place,
    };
    objects.insert(ObjectId::new(index, 0), first);
    for sub in 1..=count {
        let name = format!("{} {sub}", template.name);
        objects.insert(ObjectId::new(index, sub), Object { name, ..template.clone() });
    }
}

/// `[nnnnName]`.
fn name_subs(report: &mut Report, index: u16, parts: &Parts<'_>, objects: &mut BTreeMap<ObjectId, Object>) {
    let names = parts.names.map(|section| numbered(report, section)).unwrap_or_default();
    for (sub, entry) in names {
        if let Some(object) = objects.get_mut(&ObjectId::new(index, sub)) {
            object.name.clone_from(&entry.value);
        }
    }
}

/// `[nnnnValue]`.
fn fill_values(report: &mut Report, index: u16, parts: &Parts<'_>, objects: &mut BTreeMap<ObjectId, Object>) {
    let values = parts.values.map(|section| numbered(report, section)).unwrap_or_default();
    for (sub, entry) in values {
        match objects.get_mut(&ObjectId::new(index, sub)) {
            Some(object) => {
                object.parameter_value = value(report, Some(entry), object.data_type);
            }
            None => report.warn(
                entry.place,
                format!("{index:04X}h has no sub-index {sub}"),
                "check CompactSubObj and the keys of this section, which are decimal",
            ),
        }
    }
}

/// The entries of a section whose keys are sub-indices, in decimal.
fn numbered<'a>(report: &mut Report, section: &'a Section) -> Vec<(u8, &'a Entry)> {
    let mut list = Vec::new();
    for (key, entry) in &section.entries {
        if key == "nrofentries" || entry.value.is_empty() {
            continue;
        }
        match key.parse::<u8>() {
            Ok(sub) => list.push((sub, entry)),
            Err(_) => report.warn(
                entry.place,
                format!("`{key}` of [{}] is not a sub-index", section.title),
                "write the sub-index in decimal; it is left out",
            ),
        }
    }
    list
}

/// An object from its section.
fn object(report: &mut Report, section: &Section) -> Object {
    let data_type = section.get("datatype").map_or(DataType::Unknown, |entry| {
        let number = whole(report, entry).and_then(|number| u16::try_from(number).ok());
        number.map_or_else(
            || {
                let hint = "write 0x0001 to 0x001B; a PDO that carries it tells its width";
                report.warn(entry.place, format!("there is no data type `{}`", entry.value), hint);
                DataType::Unknown
            },
            DataType::from_number,
        )
    });
    let access = section.get("accesstype").map_or(Access::Unknown, |entry| {
        let word = entry.value.split(';').next().unwrap_or_default().trim_end();
        Access::from_word(word).unwrap_or_else(|| {
            let hint = "write ro, wo, rw, rwr, rww or const; it is not written";
            report.warn(entry.place, format!("there is no access type `{}`", entry.value), hint);
            Access::Unknown
        })
    });
    let mapping = section.get("pdomapping").and_then(|entry| {
        let mapping = whole(report, entry);
        if mapping.is_none() {
            report.warn(entry.place, format!("`{}` is not 0 or 1", entry.value), "it is taken for 0");
        }
        mapping
    });
    for key in ["uploadfile", "downloadfile"] {
        if let Some(entry) = section.get(key) {
            report.warn(entry.place, format!("`{key}` of [{}] is left out", section.title), "");
        }
    }
    Object {
        name: section.text("parametername").to_owned(),
        data_type,
        access,
        default: value(report, section.get("defaultvalue"), data_type),
        parameter_value: value(report, section.get("parametervalue"), data_type),
        low_limit: value(report, section.get("lowlimit"), data_type),
        high_limit: value(report, section.get("highlimit"), data_type),
        pdo_mapping: mapping.is_some_and(|mapping| mapping != 0),
        unit: section.text("unit").to_owned(),
        place: section.place,
    }
}

/// A value, told where it ought to be a number and is none; such a one is left out.
fn value(report: &mut Report, entry: Option<&Entry>, data_type: DataType) -> Option<Value> {
    let entry = entry.filter(|entry| !entry.value.is_empty())?;
    let is_real = matches!(data_type, DataType::Real(_)) && number::real(&entry.value).is_some();
    if data_type.is_number() && !is_real && whole(report, entry).is_none() {
        report.warn(entry.place, format!("`{}` is not a number", entry.value), "it is left out");
        return None;
    }
    Some(Value { text: entry.value.clone(), place: entry.place })
}

/// A whole number, its oddities told; without the node id where it has one.
pub fn whole(report: &mut Report, entry: &Entry) -> Option<i128> {
    let (whole, oddity) = number::whole(&entry.value)?;
    match oddity {
        Some(Oddity::Octal) => report.warn(
            entry.place,
            format!("`{}` is octal, that is {}", entry.value, whole.base),
            "a leading 0 means octal in an EDS; take it away if a decimal number is meant",
        ),
        Some(Oddity::NotOctal) => report.warn(
            entry.place,
            format!("`{}` has a leading 0, but is not octal; it is read as {}", entry.value, whole.base),
            "take the leading 0 away",
        ),
        Some(Oddity::Comment) => report.warn(
            entry.place,
            format!("a comment stands behind a number: `{}`", entry.value),
            "give comments lines of their own",
        ),
        Some(Oddity::Suffix) => report.warn(
            entry.place,
            format!("`{}` is a number of the C language", entry.value),
            "take the letters at its end away",
        ),
        None => {}
    }
    Some(whole.base)
}
