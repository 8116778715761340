//! Promises to users, as files: what a PLC program or a dashboard is built on. A change here is a new major version.
//!
//! The files are written by hand. No switch renews them: whoever breaks a promise has to edit it knowingly.

use std::fs;
use std::path::Path;

use cangate::mapping::{Sketch, TagTable};
use cangate::modbus::map_text::{MapFormat, diff, render};
use cangate::modbus::{MapDocument, ModbusSettings, RegisterMap};

fn fixture(name: &str) -> String {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/contract").join(name);
    fs::read_to_string(&path).unwrap_or_else(|error| panic!("{}: {error}", path.display()))
}

/// The example of the documentation: one DetCon.
fn detcon() -> TagTable {
    Sketch::new().node("engine1", 1, "motortech-detcon", |_| ()).build().unwrap().0
}

fn register_map() -> RegisterMap {
    RegisterMap::build(&detcon(), &ModbusSettings::default(), "cangate").unwrap()
}

/// A map without its texts for people: another wording breaks no promise.
fn without_texts(json: &str) -> MapDocument {
    let mut document: MapDocument = serde_json::from_str(json).unwrap();
    for point in &mut document.points {
        point.description.clear();
        point.source.clear();
    }
    document
}

#[test]
fn the_register_map_of_the_detcon_is_the_published_one() {
    let (promised, now) = (fixture("register_map_detcon.json"), render(&register_map(), MapFormat::Json));
    let changes = diff(&promised, &now).unwrap();
    assert!(!changes.breaking, "a promise is broken:\n{}", changes.lines.join("\n"));
    let (promised, now) = (without_texts(&promised), without_texts(&now));
    for (promised, now) in promised.points.iter().zip(&now.points) {
        assert_eq!(promised, now);
    }
    assert_eq!(promised, now);
}

#[test]
fn the_json_map_has_the_published_fields_in_their_order() {
    let json = render(&register_map(), MapFormat::Json);
    let first = json.lines().find(|line| line.contains("knock_intensity_1\"")).unwrap().trim_end_matches(',');
    assert_eq!(
        first,
        r#"{"node":"engine1","tag":"knock_intensity_1","unit_id":1,"table":"input_register","address":100,"count":1,"type":"u16","scale":0.01,"engineering_unit":"%","reference":"300101","writable":false,"topic":"cangate/hall-1/engine1/state","source":"TPDO1 byte 0","description":"Knock intensity of channel 1"}"#
    );
    assert!(json.starts_with("{\"version\":1,\"hash\":\""));
}

/// A line of the Markdown map without the columns of texts for people.
fn promised_cells(line: &str) -> Vec<&str> {
    let cells = line.split(" | ").enumerate();
    cells.filter(|(column, _)| ![11, 12].contains(column)).map(|(_, cell)| cell).collect()
}

#[test]
fn the_markdown_map_of_the_detcon_is_the_published_one() {
    let (promised, now) = (fixture("register_map_detcon.md"), render(&register_map(), MapFormat::Md));
    for (number, (promised, now)) in promised.lines().zip(now.lines()).enumerate() {
        assert_eq!(promised_cells(promised), promised_cells(now), "line {}", number + 1);
    }
    assert_eq!(promised.lines().count(), now.lines().count());
}

/// Tag, table, address, type, scale, unit.
type Row = (String, &'static str, u32, &'static str, f64, &'static str);

/// The layout of the DetCon as it was promised, written down apart from its mapping.
fn promised_rows() -> Vec<Row> {
    let mut rows: Vec<Row> = Vec::new();
    let mut percent = |name: String, place: u32, raw: u32, float: u32| {
        rows.push((name.clone(), "input_register", place, "u16", 0.01, "%"));
        rows.push((name.clone(), "input_register", raw, "raw16", 1.0, ""));
        rows.push((name, "input_register", float, "f32", 1.0, "%"));
    };
    for channel in 0..20 {
        let name = format!("knock_intensity_{}", channel + 1);
        percent(name, 100 + channel, 140 + channel, 200 + 2 * channel);
    }
    for (place, name) in (0..).zip(["analog_output", "ignition_reduction_limit", "immediate_stop_limit"]) {
        percent(name.into(), 120 + place, 160 + place, 240 + 2 * place);
    }
    let fields = [
        (123, "status_bits"),
        (124, "used_sensors_1_16"),
        (125, "used_sensors_17_20"),
        (126, "bad_inputs_1_16"),
        (127, "bad_inputs_17_20"),
        (129, "knock_intensity_max_channel"),
    ];
    rows.extend(fields.map(|(address, name)| (name.into(), "input_register", address, "u16", 1.0, "")));
    rows.push(("knock_intensity_max".into(), "input_register", 128, "u16", 0.01, "%"));
    rows.push(("reduction_margin_min".into(), "input_register", 130, "i16", 0.01, "%"));
    let status = [
        "engine_knocking",
        "trip",
        "load_reduction",
        "low_rpm",
        "no_isu_pulses",
        "spurious_pulse",
        "eeprom_fault",
    ];
    for (place, name) in (0..).zip(status) {
        rows.push((format!("{name}_count"), "input_register", 170 + place, "u16", 1.0, ""));
        rows.push((format!("{name}_age"), "input_register", 180 + place, "u16", 1.0, "s"));
        rows.push((name.into(), "discrete_input", place, "bool", 1.0, ""));
        rows.push((format!("{name}_latched"), "discrete_input", 16 + place, "bool", 1.0, ""));
    }
    for channel in 0..20 {
        for (first, name) in [(32, "sensor_used"), (64, "input_bad"), (96, "channel_valid")] {
            let name = format!("{name}_{}", channel + 1);
            rows.push((name, "discrete_input", first + channel, "bool", 1.0, ""));
        }
    }
    rows
}

#[test]
fn r_det_084_every_signal_of_the_detcon_stands_where_it_was_promised() {
    let map = register_map();
    let mut device: Vec<Row> = Vec::new();
    for point in map.points().iter().filter(|point| !point.node.is_empty() && !point.tag.contains('.')) {
        assert_eq!((point.unit_id, point.node.as_str()), (1, "engine1"));
        let published = point.topic == "cangate/hall-1/engine1/state";
        assert!(published || point.tag.ends_with("_age") || point.tag == "status_bits", "{point:?}");
        let kind =
            ["bool", "u16", "i16", "f32", "raw16"].into_iter().find(|kind| *kind == point.kind).unwrap();
        let unit = ["", "%", "s"].into_iter().find(|unit| *unit == point.engineering_unit).unwrap();
        device.push((point.tag.clone(), point.table.word(), point.address, kind, point.scale, unit));
    }
    let mut promised = promised_rows();
    let order = |row: &Row| (row.1, row.2, row.0.clone());
    promised.sort_by_key(order);
    device.sort_by_key(order);
    for (promised, now) in promised.iter().zip(&device) {
        assert_eq!(promised, now);
    }
    assert_eq!(promised.len(), device.len());
}
