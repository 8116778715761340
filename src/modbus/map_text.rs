//! The register and topic map as text, for people, spreadsheets and programs, and what differs between two maps.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write as _;

use super::gateway_block::MAP_VERSION;
use super::map_st::structured_text;
use super::points::{hash, hash_text};
use super::{MapDocument, Point, RegisterMap, Table, WordOrder};

/// How the map is printed.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, clap::ValueEnum)]
pub enum MapFormat {
    /// Columns for a terminal.
    #[default]
    Table,
    /// For a spreadsheet.
    Csv,
    /// For programs and `map diff`.
    Json,
    /// Markdown, for the project's folder.
    Md,
    /// IEC 61131-3 structured text: the addresses as constants, for a PLC project.
    St,
}

/// The whole map as a text that ends with a line feed.
#[must_use]
pub fn render(map: &RegisterMap, format: MapFormat) -> String {
    let points = map.points();
    match format {
        MapFormat::Table => terminal(points, map),
        MapFormat::Csv => csv(points, map.word_order()),
        MapFormat::Json => json(map),
        MapFormat::Md => markdown(points, map),
        MapFormat::St => structured_text(map),
    }
}

/// A column: its heading and what it says of a point.
type Column = (&'static str, fn(&Point, WordOrder) -> String);

const ADDRESS: Column = ("Address", |point, _| point.address.to_string());
const NUMBER: Column = ("Number", |point, _| (point.address + 1).to_string());
const REFERENCE: Column = ("Reference", |point, _| point.reference.clone());
const TWIN: Column = ("Also as", |point, _| point.table.twin().reference(point.address));
const TYPE: Column = ("Type", |point, _| point.kind.clone());
const COUNT: Column = ("Count", |point, _| point.count.to_string());
const ORDER: Column = ("Order", |point, order| byte_order(point, order).to_owned());
const SCALE: Column = ("Scale", |point, _| point.scale.to_string());
const UNIT: Column = ("Unit", |point, _| point.engineering_unit.clone());
const TAG: Column = ("Tag", |point, _| point.tag.clone());
const NODE: Column = ("Node", |point, _| point.node.clone());
const DESCRIPTION: Column = ("Description", |point, _| point.description.clone());
const SOURCE: Column = ("Source", |point, _| point.source.clone());
const TOPIC: Column = ("Topic", |point, _| point.topic.clone());
const COB_ID: Column = ("COB-ID", |point, _| point.cob_id.clone());
const UNIT_ID: Column = ("Unit id", |point, _| point.unit_id.to_string());
const TABLE: Column = ("Table", |point, _| point.table.word().to_owned());
const WRITABLE: Column = ("Writable", |point, _| point.writable.to_string());

/// Order of the bytes of a value, the highest being A; empty for a bit.
fn byte_order(point: &Point, order: WordOrder) -> &'static str {
    match (point.table, point.count) {
        (Table::DiscreteInput | Table::Coil, _) => "",
        (_, 1) => "AB",
        _ => order.letters(),
    }
}

fn terminal(points: &[Point], map: &RegisterMap) -> String {
    const COLUMNS: [Column; 10] =
        [UNIT_ID, REFERENCE, TWIN, ADDRESS, TYPE, SCALE, UNIT, NODE, TAG, DESCRIPTION];
    let mut rows: Vec<Vec<String>> = vec![COLUMNS.iter().map(|(name, _)| (*name).to_owned()).collect()];
    rows.extend(points.iter().map(|point| cells(&COLUMNS, point, map.word_order())));
    let widths: Vec<usize> = (0..COLUMNS.len())
        .map(|column| rows.iter().filter_map(|row| row.get(column)).map(|cell| cell.chars().count()).max())
        .map(Option::unwrap_or_default)
        .collect();
    let mut text = format!(
        "Map {} version {MAP_VERSION}, 32-bit values {}\n\n",
        map.hash_text(),
        map.word_order().letters()
    );
    for row in rows {
        let line: Vec<String> =
            row.iter().zip(&widths).map(|(cell, width)| format!("{cell:width$}")).collect();
        text.push_str(line.join("  ").trim_end());
        text.push('\n');
    }
    text
}

fn csv(points: &[Point], order: WordOrder) -> String {
    const COLUMNS: [Column; 18] = [
        UNIT_ID,
        TABLE,
        ADDRESS,
        NUMBER,
        REFERENCE,
        TWIN,
        TYPE,
        COUNT,
        ORDER,
        SCALE,
        UNIT,
        WRITABLE,
        NODE,
        TAG,
        DESCRIPTION,
        SOURCE,
        TOPIC,
        COB_ID,
    ];
    let heading = COLUMNS.map(|(name, _)| name.to_lowercase().replace([' ', '-'], "_")).join(",");
    let mut text = heading + "\n";
    for point in points {
        let cells: Vec<String> = cells(&COLUMNS, point, order).iter().map(|cell| quoted(cell)).collect();
        text.push_str(&cells.join(","));
        text.push('\n');
    }
    text
}

/// A cell of a CSV file (RFC 4180).
fn quoted(cell: &str) -> String {
    if cell.contains([',', '"', '\n', '\r']) {
        return format!("\"{}\"", cell.replace('"', "\"\""));
    }
    cell.to_owned()
}

/// One point to a line, so that two maps can be compared as texts too.
fn json(map: &RegisterMap) -> String {
    // Plain structs of texts and numbers: there is nothing that could not be written.
    let lines: Vec<String> =
        map.points().iter().map(|point| serde_json::to_string(point).unwrap_or_default()).collect();
    let (hash, points) = (map.hash_text(), lines.join(",\n"));
    format!("{{\"version\":{MAP_VERSION},\"hash\":\"{hash}\",\"points\":[\n{points}\n]}}\n")
}

fn markdown(points: &[Point], map: &RegisterMap) -> String {
    const COLUMNS: [Column; 14] = [
        ADDRESS,
        NUMBER,
        REFERENCE,
        TWIN,
        TYPE,
        COUNT,
        ORDER,
        SCALE,
        UNIT,
        TAG,
        NODE,
        DESCRIPTION,
        SOURCE,
        TOPIC,
    ];
    let mut text = format!(
        "# Register map\n\nVersion {MAP_VERSION}, hash `{}`, 32-bit values {}.\n\nAddress: as on the wire, from 0. Number: from 1. \
         Every input register (3xxxxx) can be read as the holding register (4xxxxx) of the same address too, every \
         discrete input (1xxxxx) as a coil (0xxxxx).\nWhat a block leaves out is reserved and reads 0.\n",
        map.hash_text(),
        map.word_order().letters(),
    );
    let mut under = None;
    for point in points {
        if under != Some(point.unit_id) {
            under = Some(point.unit_id);
            let own = if point.node.is_empty() { " (the gateway; also 0 and 255)" } else { "" };
            let _infallible = write!(text, "\n## Unit id {}{own}\n\n", point.unit_id);
            let names = COLUMNS.map(|(name, _)| name);
            let _infallible = write!(text, "| {} |\n|{}\n", names.join(" | "), "---|".repeat(names.len()));
        }
        let cells = cells(&COLUMNS, point, map.word_order());
        let cells: Vec<String> = cells.iter().map(|cell| cell.replace('|', "\\|")).collect();
        let _infallible = writeln!(text, "| {} |", cells.join(" | "));
    }
    text
}

fn cells(columns: &[Column], point: &Point, order: WordOrder) -> Vec<String> {
    columns.iter().map(|(_, cell)| cell(point, order)).collect()
}

/// What changed between two maps.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct MapDiff {
    /// One line for each change.
    pub lines: Vec<String>,
    /// A published address or topic is gone or means something else: exit code 1.
    pub breaking: bool,
}

/// A map that cannot be compared.
#[derive(Debug, thiserror::Error)]
#[error("{which} is no map as `cangate map --format json` writes it: {source}")]
pub struct DiffError {
    /// The old one or the new one.
    pub which: &'static str,
    /// What is wrong with it.
    pub source: serde_json::Error,
}

/// Compares two maps as `map --format json` wrote them.
///
/// # Errors
/// One of them is no such text.
pub fn diff(old: &str, new: &str) -> Result<MapDiff, DiffError> {
    let parse = |which, text| serde_json::from_str(text).map_err(|source| DiffError { which, source });
    let (old, new): (MapDocument, MapDocument) = (parse("the old map", old)?, parse("the new map", new)?);
    let mut changes = MapDiff::default();
    let (old_places, new_places) = (by_place(&old), by_place(&new));
    // New places by what stands there; a place that was there before is no target of a move.
    let fresh = || new_places.iter().filter(|(place, _)| !old_places.contains_key(place));
    let mut targets: BTreeMap<String, Place> =
        fresh().map(|(place, after)| (meaning(after), *place)).collect();
    let mut moved_to = BTreeSet::new();
    for (place, before) in &old_places {
        match new_places.get(place) {
            Some(after) if meaning(before) != meaning(after) => changes.broke(format!(
                "changed meaning: {} was {}, is {}",
                place_text(*place),
                meaning(before),
                meaning(after)
            )),
            Some(after) if before.topic != after.topic => changes.broke(format!(
                "changed topic: {} was `{}`, is `{}`",
                meaning(before),
                before.topic,
                after.topic
            )),
            Some(_) => {}
            None => changes.broke(match targets.remove(&meaning(before)) {
                Some(target) => {
                    moved_to.insert(target);
                    format!(
                        "moved: {} from {} to {}",
                        meaning(before),
                        place_text(*place),
                        place_text(target)
                    )
                }
                None => format!("removed: {} at {}", meaning(before), place_text(*place)),
            }),
        }
    }
    let added = fresh().filter(|(place, _)| !moved_to.contains(place));
    changes
        .lines
        .extend(added.map(|(place, point)| format!("added: {} at {}", meaning(point), place_text(*place))));
    for line in differences_of_the_whole(&old, &new) {
        changes.broke(line);
    }
    Ok(changes)
}

/// What holds for all points and stands in none of them: the version of the layout, and the order of words, which only the
/// hash tells.
fn differences_of_the_whole(old: &MapDocument, new: &MapDocument) -> Vec<String> {
    let mut lines = Vec::new();
    if old.version != new.version {
        lines.push(format!("changed meaning: version {} of the layout is now {}", old.version, new.version));
    }
    match (word_order(old), word_order(new)) {
        (Some(before), Some(after)) if before == after => {}
        (Some(before), Some(after)) => lines.push(format!(
            "changed meaning: 32-bit values were {}, are {} (`word_order` in [modbus])",
            before.letters(),
            after.letters()
        )),
        (before, _) if old != new => lines.push(format!(
            "perhaps changed meaning: the hash of the {} map does not belong to its points, so that the order of the words \
             of 32-bit values cannot be told; was the file edited?",
            if before.is_none() { "old" } else { "new" }
        )),
        _ => {}
    }
    lines
}

/// The order of words that a map was made with; `None` where its hash is not that of its points.
fn word_order(map: &MapDocument) -> Option<WordOrder> {
    let orders = [WordOrder::Big, WordOrder::Little];
    orders.into_iter().find(|order| hash_text(hash(map.version, &map.points, *order)) == map.hash)
}

impl MapDiff {
    fn broke(&mut self, line: String) {
        self.lines.push(line);
        self.breaking = true;
    }
}

/// Where a point stands.
type Place = (u8, Table, u32);

fn by_place(map: &MapDocument) -> BTreeMap<Place, &Point> {
    map.points.iter().map(|point| ((point.unit_id, point.table, point.address), point)).collect()
}

/// What a client relies on at a place, in words.
fn meaning(point: &Point) -> String {
    let owner = if point.node.is_empty() { "gateway" } else { &point.node };
    let mut text = format!("{owner}/{} ({}", point.tag, point.kind);
    if point.count > 2 {
        let _infallible = write!(text, " x {}", point.count);
    }
    if point.scale.to_string() != "1" || !point.engineering_unit.is_empty() {
        let _infallible = write!(text, ", {} {}", point.scale, point.engineering_unit);
    }
    text.trim_end().to_owned() + if point.writable { ", writable)" } else { ")" }
}

fn place_text((unit_id, table, address): Place) -> String {
    format!("unit {unit_id} {} {address} ({})", table.word(), table.reference(address))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn point(tag: &str, address: u32) -> Point {
        Point {
            node: "engine1".into(),
            tag: tag.into(),
            unit_id: 1,
            table: Table::InputRegister,
            address,
            count: 1,
            kind: "u16".into(),
            scale: 0.01,
            engineering_unit: "%".into(),
            reference: Table::InputRegister.reference(address),
            writable: false,
            topic: "cangate/hall-1/engine1/state".into(),
            source: "TPDO1 byte 0".into(),
            description: "Knock, \"intensity\" | 1".into(),
            cob_id: "0x181".into(),
        }
    }

    fn document(points: &[Point], order: WordOrder) -> MapDocument {
        MapDocument { version: 1, hash: hash_text(hash(1, points, order)), points: points.to_vec() }
    }

    fn compare_documents(old: &MapDocument, new: &MapDocument) -> (Vec<String>, bool) {
        let text = |document: &MapDocument| serde_json::to_string(document).unwrap();
        let diff = diff(&text(old), &text(new)).unwrap();
        (diff.lines, diff.breaking)
    }

    fn compare(old: &[Point], new: &[Point]) -> (Vec<String>, bool) {
        compare_documents(&document(old, WordOrder::Big), &document(new, WordOrder::Big))
    }

    #[test]
    fn equal_maps_and_other_words_are_no_change() {
        assert_eq!(compare(&[point("a", 100)], &[point("a", 100)]), (vec![], false));
        let reworded = Point { description: "x".into(), source: "y".into(), ..point("b", 101) };
        let (lines, breaking) = compare(&[point("b", 101)], &[reworded, point("c", 102)]);
        assert_eq!(lines, ["added: engine1/c (u16, 0.01 %) at unit 1 input_register 102 (300103)"]);
        assert!(!breaking);
    }

    #[test]
    fn what_is_added_breaks_nothing() {
        let (lines, breaking) = compare(&[point("a", 100)], &[point("a", 100), point("b", 101)]);
        assert_eq!(lines, ["added: engine1/b (u16, 0.01 %) at unit 1 input_register 101 (300102)"]);
        assert!(!breaking);
    }

    #[test]
    fn what_moved_is_told_once_and_breaks() {
        let (lines, breaking) = compare(&[point("a", 100)], &[point("a", 105)]);
        assert_eq!(
            lines,
            [
                "moved: engine1/a (u16, 0.01 %) from unit 1 input_register 100 (300101) to unit 1 input_register 105 (300106)"
            ]
        );
        assert!(breaking);
    }

    #[test]
    fn a_second_place_of_a_tag_is_added_and_no_move() {
        let (lines, breaking) = compare(&[point("a", 100)], &[point("a", 100), point("a", 105)]);
        assert_eq!(lines, ["added: engine1/a (u16, 0.01 %) at unit 1 input_register 105 (300106)"]);
        assert!(!breaking);
    }

    #[test]
    fn what_is_gone_or_means_something_else_breaks() {
        let (lines, breaking) = compare(&[point("a", 100), point("b", 101)], &[point("b", 101)]);
        assert_eq!(lines, ["removed: engine1/a (u16, 0.01 %) at unit 1 input_register 100 (300101)"]);
        assert!(breaking);
        for changed in [
            point("b", 100),
            Point { scale: 0.1, ..point("a", 100) },
            Point { kind: "i16".into(), ..point("a", 100) },
            Point { engineering_unit: "V".into(), ..point("a", 100) },
            Point { writable: true, ..point("a", 100) },
        ] {
            let (lines, breaking) = compare(&[point("a", 100)], &[changed]);
            assert!(
                breaking && lines[0].starts_with("changed meaning: unit 1 input_register 100"),
                "{lines:?}"
            );
        }
        let (lines, breaking) =
            compare(&[point("a", 100)], &[Point { topic: "t".into(), ..point("a", 100) }]);
        assert!(breaking && lines[0].starts_with("changed topic: "), "{lines:?}");
    }

    #[test]
    fn another_word_order_breaks_also_when_something_is_added() {
        let (one, two) = ([point("a", 1)], [point("a", 1), point("b", 2)]);
        for (old, new, lines) in [(&one[..], &one[..], 1), (&one[..], &two[..], 2)] {
            let (old, new) = (document(old, WordOrder::Big), document(new, WordOrder::Little));
            let (told, breaking) = compare_documents(&old, &new);
            assert!(breaking && told.len() == lines, "{told:?}");
            assert_eq!(
                told[lines - 1],
                "changed meaning: 32-bit values were ABCD, are CDAB (`word_order` in [modbus])"
            );
        }
    }

    #[test]
    fn another_version_of_the_layout_breaks() {
        let old = document(&[point("a", 1)], WordOrder::Big);
        let hash = hash_text(hash(2, &old.points, WordOrder::Big));
        let (lines, breaking) = compare_documents(&old, &MapDocument { version: 2, hash, ..old.clone() });
        assert!(breaking && lines == ["changed meaning: version 1 of the layout is now 2"], "{lines:?}");
    }

    #[test]
    fn a_map_whose_hash_does_not_belong_to_its_points_cannot_be_called_harmless() {
        let good = document(&[point("a", 1)], WordOrder::Big);
        let edited = MapDocument { hash: "0123456789abcdef".into(), ..good.clone() };
        for (old, new, which) in [(&edited, &good, "the old map"), (&good, &edited, "the new map")] {
            let (lines, breaking) = compare_documents(old, new);
            assert!(breaking && lines[0].contains(which), "{lines:?}");
        }
        assert_eq!(compare_documents(&edited, &edited), (vec![], false), "the same file is the same map");
    }

    #[test]
    fn a_text_that_is_no_map_is_named() {
        let error = diff("{}", "").unwrap_err().to_string();
        assert!(error.starts_with("the old map is no map"), "{error}");
    }

    #[test]
    fn csv_quotes_what_needs_it() {
        let text = csv(&[point("a", 100)], WordOrder::Big);
        let lines: Vec<&str> = text.lines().collect();
        assert_eq!(
            lines[0],
            "unit_id,table,address,number,reference,also_as,type,count,order,scale,unit,writable,node,tag,description,source,topic,cob_id"
        );
        assert_eq!(
            lines[1],
            "1,input_register,100,101,300101,400101,u16,1,AB,0.01,%,false,engine1,a,\"Knock, \"\"intensity\"\" | 1\",\
             TPDO1 byte 0,cangate/hall-1/engine1/state,0x181"
        );
    }
}
