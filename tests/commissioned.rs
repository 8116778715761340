//! What an installation decides of the boot of a node: whether it has to be there, what is asked of it, what it keeps.

use std::sync::Arc;

use cangate::canopen::{NmtState, NodeId};
use cangate::mapping::installation::NodeEntry;
use cangate::mapping::{At, Sketch, SourceText, TagTable};
use cangate::modbus::ModbusSettings;
use cangate::process_image::{Quality, Reason};
use cangate::simulator::{DevicePlan, Kind, Scenario};

use super::support::registers;
use super::support::world::World;

/// Float pressure and the temperature of a DST P92C, in bar and tenths of a degree.
const MAPPING: &str = r#"
format = 1
[device]
vendor = "Example"
model = "P"
[identity]
vendor_id = 0x23D
[error_control]
kind = "heartbeat"
heartbeat_ms = 500
[tpdo.1]
cob_id = "$NODEID+0x180"
maps = ["0x6130:1/32", "0x9130:2/32"]
transmission_type = 255
event_timer_ms = 100
[[setup]]
object = "0x6131:1"
type = "u32"
value = 0x004E0000
[[setup]]
object = "0x6132:2"
type = "u8"
value = 1
[[tag]]
name = "pressure"
object = "0x6130:1"
type = "f32"
unit = "bar"
unit_object = "0x6131:1"
[[tag]]
name = "temperature"
object = "0x9130:2"
type = "i32"
unit = "°C"
digits_object = "0x6132:2"
"#;

const SAVE: &str = "602#2310100173617665";
const START: &str = "000#0102";
const PRE_OPERATIONAL: &str = "000#8002";

fn table(text: &str, change: impl FnOnce(&mut NodeEntry)) -> Arc<TagTable> {
    let sketch = Sketch::new().mapping(SourceText::new("own", text)).node("node002", 2, "own", change);
    Arc::new(sketch.build().unwrap_or_else(|why| panic!("{why:#?}")).0)
}

/// A bus with a transmitter on it, and a gateway that has run for 3 s.
fn world(text: &str, change: impl FnOnce(&mut NodeEntry)) -> World {
    let mut world = World::with(table(text, change), 1);
    connect(&mut world);
    world.run_for(1000);
    world.start_gateway();
    world.run_for(3000);
    world
}

fn connect(world: &mut World) {
    let scenario = Scenario::shipped(Kind::DstP92c, "quiet").unwrap();
    world.connect(&DevicePlan::new(NodeId::new(2).unwrap(), scenario));
}

/// Commands and SDO writes that the gateway sent, each different one once.
fn orders(world: &World) -> Vec<&str> {
    let is_order = |frame: &&str| frame.starts_with("000#") || frame.starts_with("602#2");
    world.sent.iter().map(String::as_str).filter(is_order).collect()
}

#[test]
fn r_dst_084_090_what_was_written_is_stored_only_where_that_is_asked_for_and_only_then() {
    let plain = world(MAPPING, |_| ());
    assert!(orders(&plain).len() > 3 && !plain.sent.contains(SAVE));
    let mut saving = world(MAPPING, |node| node.save_after_config = Some(true));
    assert!(saving.sent.contains(SAVE));
    assert_eq!(saving.tag(2, "pressure").quality, Quality::Good);
    saving.sent.clear();
    saving.order("node 2 power cycle");
    saving.run_for(5000);
    assert_eq!(saving.tag(2, "pressure").quality, Quality::Good);
    assert_eq!(orders(&saving), [START], "it has kept everything, so nothing is written or stored again");
}

#[test]
fn an_optional_node_that_never_came_is_no_alarm_and_one_that_was_there_is() {
    let mut world = World::with(table(MAPPING, |node| node.required = Some(false)), 1);
    world.start_gateway();
    world.run_for(60_000);
    assert!(world.raised.is_empty(), "{:?}", world.raised);
    assert_eq!(world.events("node_boot_failed"), 0);
    assert!(!world.node(2).online && world.node(2).may_be_absent);
    let healthy = |world: &World| {
        let bank = registers::bank((*world.table).clone(), &ModbusSettings::default());
        let status = registers::registers(&bank, &world.image, world.now(), 247, 1, 1).unwrap();
        status[0] & 1 == 1
    };
    assert!(healthy(&world));
    connect(&mut world);
    world.run_for(60_000);
    assert!(world.node(2).online && !world.node(2).may_be_absent);
    assert_eq!(world.tag(2, "pressure").quality, Quality::Good);
    world.order("node 2 power off");
    world.run_until(5000, |world| world.active_alarms().contains(&"node_lost"));
    assert!(!healthy(&world));
}

#[test]
fn r_dst_001_another_device_is_started_only_where_its_identity_is_not_checked() {
    let other = MAPPING.replace("0x23D", "0x23E");
    let strict = world(&other, |_| ());
    assert!(!strict.sent.contains(START) && strict.node(2).identity_mismatch);
    let tolerant = world(&other, |node| node.check_identity = Some(false));
    assert!(tolerant.sent.contains(START));
    assert!(tolerant.node(2).identity_mismatch, "it is told all the same");
    assert_eq!(tolerant.events("identity_mismatch"), 1);
    assert_eq!(tolerant.tag(2, "pressure").quality, Quality::Good);
}

#[test]
fn r_dst_122_without_sdo_a_device_is_started_and_listened_to_and_nothing_more() {
    let mut world = World::with(table(MAPPING, |node| node.configure = Some(false)), 1);
    connect(&mut world);
    let set_up = [
        "set 1A00 0 0",
        "set 1A00 1 0x61300120",
        "set 1A00 2 0x91300220",
        "set 1A00 0 2",
        "set 1800 2 255",
        "set 1800 5 100",
        "set 1017 0 500",
        "set 6131 1 0x004E0000",
        "set 6132 2 1",
        "pressure 100",
        "temperature 50",
    ];
    for line in set_up {
        world.order(&format!("node 2 {line}"));
    }
    world.run_for(1000);
    world.start_gateway();
    world.run_for(5000);
    assert_eq!(world.sent.iter().collect::<Vec<_>>(), [START]);
    assert!((world.number(2, "pressure") - 100.0).abs() < 2.0, "bar, as its setup says");
    assert!((world.number(2, "temperature") - 50.0).abs() < 2.0, "one digit, as its setup says");
    assert_eq!(world.tag(2, "pressure").quality, Quality::Good);
}

#[test]
fn r_dst_036_without_sdo_a_unit_that_nothing_says_is_not_guessed() {
    let text = MAPPING.replace("0x6131:1\"\ntype", "0x6131:2\"\ntype").replace("0x004E0000", "0x002D0000");
    let mut world = World::with(table(&text, |node| node.configure = Some(false)), 1);
    connect(&mut world);
    for line in [
        "set 1017 0 500",
        "set 1800 2 255",
        "set 1800 5 100",
        "set 1A00 0 0",
        "set 1A00 1 0x61300120",
        "set 1A00 2 0x91300220",
        "set 1A00 0 2",
    ] {
        world.order(&format!("node 2 {line}"));
    }
    world.run_for(1000);
    world.start_gateway();
    world.run_for(2000);
    assert_eq!(world.tag(2, "pressure").quality, Quality::Bad(Reason::UnknownUnit));
}

#[test]
fn r_dst_059_a_device_that_starts_by_itself_is_taken_out_of_operation_only_to_be_configured() {
    let mut world = world(MAPPING, |_| ());
    assert_eq!(world.node(2).nmt, Some(NmtState::Operational));
    // The same device, found running by a gateway that is told that it starts by itself.
    world.table = table(MAPPING, |node| node.self_starting = Some(true));
    world.sent.clear();
    world.start_gateway();
    world.run_for(5000);
    assert_eq!(orders(&world), Vec::<&str>::new(), "nothing is to be changed, so nothing is sent");
    assert_eq!(world.tag(2, "pressure").quality, Quality::Good);
    // One setting has to be changed: only in pre-operational, and then it runs again.
    world.table =
        table(&MAPPING.replace("value = 1\n", "value = 2\n"), |node| node.self_starting = Some(true));
    world.log = Some(Vec::new());
    world.start_gateway();
    world.run_for(5000);
    let log = world.log.take().unwrap();
    let is_order = |frame: &&String| frame.starts_with("000#") || frame.starts_with("602#2");
    let told: Vec<_> = log.iter().filter(is_order).collect();
    assert_eq!(told, [PRE_OPERATIONAL, "602#2F32610202000000", START], "in this order");
    assert_eq!(world.node(2).nmt, Some(NmtState::Operational));
    assert_eq!(world.tag(2, "temperature").quality, Quality::Good);
}

#[test]
fn r_dst_061_a_heartbeat_of_the_installation_brings_its_own_time_out() {
    let change = |node: &mut NodeEntry| node.heartbeat_ms = Some(At::nowhere(2000));
    let mut world = world(MAPPING, change);
    assert!(world.sent.contains("602#2B171000D0070000"), "2000 ms");
    world.run_for(10_000);
    assert!(world.raised.is_empty(), "{:?}", world.raised);
    world.order("node 2 power off");
    let took = world.run_until(6100, |world| world.active_alarms().contains(&"node_lost"));
    assert!(took > 3900, "three times 2000 ms after the last one: {took}");
}

#[test]
fn r_dst_062_a_node_supervises_the_gateway_only_where_that_is_asked_for() {
    let quiet = world(MAPPING, |_| ());
    assert!(!quiet.sent.iter().any(|frame| frame.starts_with("602#231610") || frame.starts_with("77E#")));
    let sketch = Sketch::new().mapping(SourceText::new("own", MAPPING)).bus(|bus| {
        bus.own_node_id = Some(At::nowhere(126));
        bus.own_heartbeat_ms = Some(At::nowhere(1000));
    });
    let supervise = |node: &mut NodeEntry| node.supervise_gateway_ms = Some(At::nowhere(3000));
    let (table, _) = sketch.clone().node("node002", 2, "own", supervise).build().unwrap();
    let mut world = World::with(Arc::new(table), 1);
    connect(&mut world);
    world.run_for(1000);
    world.start_gateway();
    world.run_for(5000);
    assert!(world.sent.contains("602#23161001B80B7E00"), "node 126, 3000 ms");
    assert!(world.sent.contains("77E#05"));
    assert_eq!(world.node(2).nmt, Some(NmtState::Operational));
}

#[test]
fn r_dst_062_a_supervision_that_would_miss_the_gateway_at_once_is_refused() {
    let supervise = |node: &mut NodeEntry| node.supervise_gateway_ms = Some(At::nowhere(1000));
    for (own, heartbeat, message) in [
        (None, None, "the gateway sends no heartbeat on this bus"),
        (Some(126), Some(1000), "not longer than the time between two heartbeats"),
        (None, Some(1000), "a heartbeat needs a node id"),
    ] {
        let sketch = Sketch::new().mapping(SourceText::new("own", MAPPING)).bus(|bus| {
            bus.own_node_id = own.map(At::nowhere);
            bus.own_heartbeat_ms = heartbeat.map(At::nowhere);
        });
        let problems = sketch.node("node002", 2, "own", supervise).build().unwrap_err();
        let told: Vec<String> = problems.iter().map(ToString::to_string).collect();
        assert!(told.iter().any(|line| line.contains(message)), "{message}: {told:#?}");
    }
}

#[test]
fn r_dst_024_verify_withholds_another_content_and_only_tells_of_another_timer() {
    let verify = MAPPING.replace("transmission_type = 255", "mapping = \"verify\"\ntransmission_type = 255");
    let same = ["set 1A00 0 0", "set 1A00 1 0x61300120", "set 1A00 2 0x91300220", "set 1A00 0 2"];
    for content in [&same[..], &[]] {
        let mut world = World::with(table(&verify, |_| ()), 1);
        let scenario = Scenario::shipped(Kind::DstP92c, "quiet").unwrap();
        world.connect(&DevicePlan::new(NodeId::new(2).unwrap(), scenario));
        for line in ["set 1800 2 255", "set 1800 5 200"].iter().chain(content) {
            world.order(&format!("node 2 {line}"));
        }
        world.run_for(1000);
        world.start_gateway();
        world.run_for(5000);
        assert_eq!(world.events("pdo_differs"), 1);
        assert_eq!(world.tag(2, "temperature").quality.is_good(), !content.is_empty());
        assert_eq!(world.events("pdo_mapping_differs"), usize::from(content.is_empty()));
    }
}
