//! TPDOs that are taken as the device has them (`mapping = "adopt"`): the gateway against the simulated DST P92C.

use std::sync::Arc;

use cangate::can::{BusEvent, BusIndex, Link};
use cangate::canopen::{NmtRequest, NmtState, NodeId};
use cangate::gateway::{Action, Gateway, Input, Outcome, Output};
use cangate::mapping::installation::RoleWord;
use cangate::mapping::{Sketch, SourceText, TagTable, check_mapping};
use cangate::modbus::{ModbusSettings, RegisterMap};
use cangate::process_image::{NodeIndex, Quality, Reason};
use cangate::simulator::{DevicePlan, Kind, Scenario};
use cangate::time::Now;

use super::support::world::World;

/// A transmitter that somebody else configures. The temperature is read where no TPDO carries it.
const MAPPING: &str = r#"
format = 1
[device]
vendor = "Example"
model = "P"
[error_control]
kind = "heartbeat"
heartbeat_ms = 500
[tpdo.1]
cob_id = "$NODEID+0x180"
mapping = "adopt"
[[tag]]
name = "pressure"
object = "0x9130:1"
type = "i32"
unit = "bar"
unit_object = "0x6131:1"
digits_object = "0x6132:1"
registers = [{ address = 100, type = "f32" }]
[[tag]]
name = "pressure_float"
object = "0x6130:1"
type = "f32"
unit = "bar"
unit_object = "0x6131:1"
[[tag]]
name = "pressure_status"
object = "0x6150:1"
type = "u8"
[[tag]]
name = "temperature"
object = "0x9130:2"
poll_ms = 1000
type = "i32"
unit = "°C"
unit_object = "0x6131:2"
digits_object = "0x6132:2"
[[derived]]
name = "hot"
when = "temperature > 40"
"#;

fn table(text: &str, role: RoleWord) -> Arc<TagTable> {
    let sketch = Sketch::new().mapping(SourceText::new("own", text)).node("node002", 2, "own", |_| ());
    let (table, _) = sketch.bus(|bus| bus.role = role).build().unwrap_or_else(|why| panic!("{why:#?}"));
    Arc::new(table)
}

/// The gateway has run for 3 s beside a transmitter of 100 bar and 50 °C that was set up so.
fn world(settings: &[&str]) -> World {
    world_of(MAPPING, settings)
}

fn world_of(text: &str, settings: &[&str]) -> World {
    let mut world = World::with(table(text, RoleWord::Master), 1);
    let scenario = Scenario::shipped(Kind::DstP92c, "quiet").unwrap();
    world.connect(&DevicePlan::new(NodeId::new(2).unwrap(), scenario));
    for line in ["pressure 100", "temperature 50", "set 1800 2 255", "set 1800 5 200"].iter().chain(settings)
    {
        world.order(&format!("node 2 {line}"));
    }
    world.run_for(1000);
    world.start_gateway();
    world.run_for(3000);
    world
}

/// Float pressure, then the temperature.
const REMAPPED: [&str; 4] =
    ["set 1A00 0 0", "set 1A00 1 0x61300120", "set 1A00 2 0x91300220", "set 1A00 0 2"];

fn text_of(world: &World, event: &str) -> String {
    let mut told = world.image.journal.newest_first().filter(|each| each.name == event);
    told.next().map(|event| event.text.clone()).unwrap_or_default()
}

fn reads_of(world: &World, request: &str) -> bool {
    world.sent.iter().any(|frame| frame.starts_with(request))
}

#[test]
fn r_dst_024_tags_are_decoded_where_the_device_maps_their_objects() {
    let world = world(&[]);
    assert!((world.number(2, "pressure") - 100.0).abs() < 2.0, "{}", world.number(2, "pressure"));
    for tag in ["pressure", "pressure_status", "temperature", "hot"] {
        assert_eq!(world.tag(2, tag).quality, Quality::Good, "{tag}");
    }
    assert!((world.number(2, "temperature") - 50.0).abs() < 2.0, "read, as no TPDO carries it");
    assert!(world.tag(2, "hot").value.is_true(), "what is computed from it is computed");
    assert_eq!(world.tag(2, "pressure_float").quality, Quality::Bad(Reason::NotMapped));
    assert_eq!(text_of(&world, "not_mapped"), "no TPDO of the device carries: pressure_float");
    assert_eq!(
        text_of(&world, "pdo_adopted"),
        "the device sends in TPDO1: 0x9130:1 (32 bit), 0x6150:1 (8 bit)"
    );
    let writes = world.sent.iter().filter(|frame| frame.starts_with("602#2")).collect::<Vec<_>>();
    assert_eq!(writes, ["602#2B171000F4010000"], "nothing but the heartbeat");
    assert!(world.raised.is_empty(), "{:?}", world.raised);
}

#[test]
fn r_dst_024_another_mapping_moves_them_and_what_comes_by_itself_is_not_read() {
    let mut world = world(&REMAPPED);
    assert!((world.number(2, "pressure_float") - 100.0).abs() < 2.0);
    assert!((world.number(2, "temperature") - 50.0).abs() < 2.0);
    assert!(world.tag(2, "hot").value.is_true() && world.tag(2, "hot").quality.is_good());
    assert_eq!(world.tag(2, "pressure").quality, Quality::Bad(Reason::NotMapped));
    assert_eq!(world.tag(2, "pressure_status").quality, Quality::Bad(Reason::NotMapped));
    assert!(!reads_of(&world, "602#40309102"), "the temperature comes in the TPDO");
    // It forgets its settings with its supply, and sends what it sends from the factory.
    world.order("node 2 power cycle");
    world.run_for(3000);
    world.order("node 2 set 1800 2 255");
    world.run_for(3000);
    assert_eq!(world.tag(2, "pressure").quality, Quality::Good);
    assert!((world.number(2, "pressure") - 100.0).abs() < 2.0);
    assert_eq!(world.tag(2, "pressure_float").quality, Quality::Bad(Reason::NotMapped));
    assert_eq!(world.tag(2, "temperature").quality, Quality::Good);
    assert!(reads_of(&world, "602#40309102"), "now it has to be read");
}

#[test]
fn r_dst_024_what_the_device_maps_with_fewer_bits_than_the_tag_has_is_read_all_the_same() {
    let text = MAPPING.replace(
        "[[derived]]",
        "[[tag]]\nname = \"wide_status\"\nobject = \"0x6150:1\"\npoll_ms = 1000\ntype = \"u16\"\n[[derived]]",
    );
    let world = world_of(&text, &[]);
    assert_eq!(world.tag(2, "pressure_status").quality, Quality::Good, "8 bits of it come");
    assert!(reads_of(&world, "602#40506101"));
    assert!(world.node(2).counters.sdo_errors > 0, "it has no 16 bits, which is told");
}

#[test]
fn r_dst_034_what_is_read_is_not_good_after_a_reset_that_was_ordered_until_it_is_read_again() {
    let mut world = world(&[]);
    assert_eq!(world.tag(2, "temperature").quality, Quality::Good);
    world.order("node 2 mute sdo on");
    let reset = Action::Nmt { node: NodeIndex(0), request: NmtRequest::ResetNode };
    assert_eq!(world.ask(reset), Outcome::Done);
    world.run_until(1000, |world| world.node(2).nmt == Some(NmtState::Initialising));
    for tag in ["temperature", "hot", "pressure"] {
        assert_eq!(world.tag(2, tag).quality, Quality::Stale(Reason::NodeRestarted), "{tag}");
    }
    world.order("node 2 mute sdo off");
    world.run_until(40_000, |world| world.tag(2, "temperature").quality.is_good());
    assert_eq!(world.node(2).counters.restarts, 0, "it was no surprise");
}

#[test]
fn r_dst_050_the_time_out_follows_from_the_event_timer_of_the_device() {
    let mut world = world(&["set 1800 5 700"]);
    world.order("node 2 mute pdo on");
    let took =
        world.run_until(2200, |world| world.tag(2, "pressure").quality == Quality::Stale(Reason::PdoTimeout));
    assert!(took > 1300, "three times 700 ms after the last one: {took}");
    assert!(world.node(2).pdos[0].stale);
    assert!(world.active_alarms().contains(&"pdo_timeout_1"), "{:?}", world.active_alarms());
}

#[test]
fn r_dst_050_without_an_event_timer_nothing_times_out_and_that_is_told() {
    let mut world = world(&["set 1800 5 0"]);
    world.run_for(60_000);
    assert!(text_of(&world, "pdo_adopted").ends_with("it is not supervised"));
    assert!(!world.node(2).pdos[0].stale && world.raised.is_empty());
}

#[test]
fn r_dst_119_a_tpdo_with_another_identifier_is_heard_and_told_of() {
    let world = world(&["set 1800 1 0x1A5"]);
    assert_eq!(world.tag(2, "pressure").quality, Quality::Good);
    assert_eq!(world.events("pdo_id_differs"), 1);
    assert!(text_of(&world, "pdo_id_differs").contains("1A5"), "{}", text_of(&world, "pdo_id_differs"));
    assert_eq!(world.events("emergency_id_differs"), 0);
}

/// Whether an emergency message on this identifier raises an alarm, and one without an error ends it.
fn hears_errors(world: &mut World, id: &str) -> bool {
    world.overhear(&format!("{id}#0010010000000000"));
    let heard = world.active_alarms() == ["emergency"];
    world.overhear(&format!("{id}#0000000000000000"));
    assert!(world.active_alarms().is_empty(), "{:?}", world.active_alarms());
    heard
}

/// The TPDO is believed to be as the file says.
fn fixed() -> String {
    let maps = "mapping = \"fixed\"\nmaps = [\"0x9130:1/32\", \"0x6150:1/8\"]";
    let float = MAPPING.find("[[tag]]\nname = \"pressure_float\"").unwrap();
    let status = MAPPING.find("[[tag]]\nname = \"pressure_status\"").unwrap();
    let text = [&MAPPING[..float], &MAPPING[status..]].concat();
    text.replace("mapping = \"adopt\"", maps)
}

#[test]
fn r_dst_119_emergency_messages_with_another_identifier_are_heard_and_told_of() {
    for text in [MAPPING.to_owned(), fixed()] {
        let mut world = world_of(&text, &["set 1014 0 0x99"]);
        assert_eq!(world.events("emergency_id_differs"), 1);
        assert_eq!(
            text_of(&world, "emergency_id_differs"),
            "the device sends its emergency messages as 099, not as 082; that is used"
        );
        assert!(hears_errors(&mut world, "099"));
        assert!(!hears_errors(&mut world, "082"), "it is not its any more");
        world.order("node 2 set 1014 0 off");
        let reset = Action::Nmt { node: NodeIndex(0), request: NmtRequest::ResetCommunication };
        assert_eq!(world.ask(reset), Outcome::Done);
        world.run_for(3000);
        assert!(hears_errors(&mut world, "082"));
        assert!(!hears_errors(&mut world, "099"));
    }
}

#[test]
fn r_dst_119_emergency_messages_that_the_device_has_switched_off_are_told_of() {
    let mut world = world_of(&fixed(), &["set 1014 0 0x80000082"]);
    assert!(text_of(&world, "emergency_id_differs").contains("switched off"));
    assert!(!hears_errors(&mut world, "082"));
}

#[test]
fn r_dst_088_what_is_read_is_read_though_nothing_else_is_asked() {
    let text = fixed().replace("kind = \"heartbeat\"\nheartbeat_ms = 500", "kind = \"none\"");
    let without_units = ["unit_object", "digits_object"];
    let lines = text.lines().filter(|line| !without_units.iter().any(|key| line.starts_with(key)));
    let text = lines.collect::<Vec<_>>().join("\n");
    let world = world_of(&text, &[]);
    assert_eq!(world.tag(2, "temperature").quality, Quality::Good);
}

#[test]
fn r_dst_124_on_a_passive_bus_the_file_is_believed() {
    let text = MAPPING.replace(
        "mapping = \"adopt\"",
        "mapping = \"adopt\"\nmaps = [\"0x6130:1/32\", \"0x6150:1/8\"]\n[[setup]]\nobject = \"0x6131:1\"\ntype = \"u32\"\nvalue = 0x004E0000",
    );
    let table = table(&text, RoleWord::Passive);
    let mut gateway = Gateway::new(Arc::clone(&table), Now::from_millis(0));
    let mut image = gateway.empty_image();
    let at = Now::from_millis(1);
    let frame = "182#0000C03F00".parse().unwrap();
    for event in [BusEvent::Link { link: Link::ErrorActive, at }, BusEvent::Frame { frame, at }] {
        gateway.handle_input(at, Input::Bus { bus: BusIndex(0), event });
        while let Some(output) = gateway.poll_output() {
            assert!(!matches!(output, Output::Transmit { .. }), "{output:?}");
        }
    }
    gateway.publish(&mut image);
    let tag = |name: &str| *image.tag(table.find_tag(NodeIndex(0), name).unwrap());
    assert_eq!(tag("pressure_float").value.as_f64().to_bits(), 1.5_f64.to_bits());
    assert_eq!(tag("pressure_float").quality, Quality::Good);
    assert_eq!(tag("pressure").quality, Quality::Bad(Reason::NotMapped));
}

#[test]
fn the_register_map_says_that_the_place_is_the_devices_affair() {
    let table = table(MAPPING, RoleWord::Master);
    let map = RegisterMap::build(&table, &ModbusSettings::default(), "cangate").unwrap();
    let point = map.points().iter().find(|point| point.tag == "pressure").unwrap();
    assert_eq!(point.source, "0x9130:1, where the device maps it");
}

#[test]
fn mistakes_about_adopted_tpdos_are_told_with_the_way_out() {
    assert_eq!(check_mapping(&SourceText::new("own", MAPPING)), Ok(Vec::new()));
    for (right, wrong, message) in [
        ("\"adopt\"", "\"adopt\"\nevent_timer_ms = 100", "`event_timer_ms` would never be written"),
        ("object = \"0x6150:1\"", "tpdo = 1\nbit = 32", "is for the device to say"),
    ] {
        let broken = MAPPING.replacen(right, wrong, 1);
        let problems = check_mapping(&SourceText::new("own", broken.as_str())).unwrap_err();
        let told: Vec<String> = problems.iter().map(ToString::to_string).collect();
        assert!(
            told.iter().any(|line| line.contains(message) && line.contains("hint: ")),
            "{wrong}: {told:#?}"
        );
    }
}
