//! The gateway, with the shipped mapping of the Danfoss DST P92C, against the simulated one: it is identified, configured,
//! started, read, watched, and never written to without need.

use std::sync::Arc;

use cangate::can::{BusEvent, BusIndex, Link};
use cangate::canopen::{NmtState, NodeId};
use cangate::gateway::{Gateway, Input};
use cangate::mapping::{Sketch, SourceText, TagTable, check_mapping};
use cangate::process_image::{Quality, Reason};
use cangate::simulator::{DevicePlan, Kind, Scenario};
use cangate::time::Now;

use super::support::world::World;

/// A `DetCon` at node 1 and a transmitter at node 2.
fn plant() -> Arc<TagTable> {
    let sketch = Sketch::new().node("node001", 1, "motortech-detcon", |_| ()).node(
        "node002",
        2,
        "danfoss-dst-p92c",
        |_| (),
    );
    Arc::new(sketch.build().unwrap().0)
}

fn transmitter(scenario: &str) -> DevicePlan {
    DevicePlan::new(NodeId::new(2).unwrap(), Scenario::shipped(Kind::DstP92c, scenario).unwrap())
}

/// Both devices are there; the gateway has run for 5 s.
fn running() -> World {
    let mut world = World::with(plant(), 1);
    world.power_on(1, "quiet");
    world.connect(&transmitter("quiet"));
    world.run_for(1000);
    world.start_gateway();
    world.run_for(5000);
    world
}

/// SDO writes that the gateway sent, each different one once.
fn writes(world: &World) -> Vec<&str> {
    let is_write = |frame: &&str| {
        let command = frame.strip_prefix("602#").and_then(|data| u8::from_str_radix(&data[..2], 16).ok());
        command.is_some_and(|command| command & 0xE0 == 0x20)
    };
    world.sent.iter().map(String::as_str).filter(is_write).collect()
}

#[test]
fn r_dst_001_024_057_061_a_transmitter_as_shipped_is_configured_started_and_read() {
    let world = running();
    let node = world.node(2);
    assert!(node.online && node.supervised && !node.identity_mismatch, "{}", node.reason);
    assert_eq!(node.nmt, Some(NmtState::Operational));
    for tag in ["pressure", "temperature", "pressure_status", "error_register", "pressure_overflow_count"] {
        assert_eq!(world.tag(2, tag).quality, Quality::Good, "{tag}");
    }
    assert!((-40.0..125.0).contains(&world.number(2, "temperature")), "{}", world.number(2, "temperature"));
    assert!((0.0..1000.0).contains(&world.number(2, "pressure")), "{}", world.number(2, "pressure"));
    assert!(world.raised.is_empty(), "{:?}", world.raised);
    assert!(world.is_good(1), "the other node is not concerned");
}

#[test]
fn r_dst_028_the_pressure_is_in_bar_whatever_the_device_was_set_to() {
    let mut world = running();
    world.order("node 2 pressure 123.4");
    world.run_for(3000);
    assert!((world.number(2, "pressure") - 123.4).abs() < 2.0, "{}", world.number(2, "pressure"));
}

#[test]
fn r_dst_090_a_gateway_that_starts_again_twenty_times_writes_nothing() {
    let mut world = running();
    assert!(!writes(&world).is_empty(), "the first time it had to");
    for _ in 0..20 {
        world.sent.clear();
        world.start_gateway();
        world.run_for(4000);
        assert_eq!(writes(&world), Vec::<&str>::new());
        assert!(!world.sent.iter().any(|frame| frame.starts_with("000#")), "{:?}", world.sent);
        assert_eq!(world.tag(2, "pressure").quality, Quality::Good);
    }
}

#[test]
fn r_dst_061_a_transmitter_that_is_unplugged_is_lost_within_its_heartbeat_time_and_comes_back() {
    let mut world = running();
    world.order("node 2 power off");
    let took = world.run_until(3100, |world| world.active_alarms().contains(&"node_lost"));
    assert!(took <= 3001, "{took}");
    assert!(!world.tag(2, "pressure").quality.is_usable());
    assert!(!world.tag(2, "pressure_status").quality.is_usable(), "what was polled is no better");
    world.order("node 2 power on");
    world.run_until(5000, |world| world.tag(2, "pressure").quality == Quality::Good);
    assert!(world.node(2).online);
}

#[test]
fn r_dst_026_a_broken_sensor_makes_its_value_meaningless_and_raises_an_alarm() {
    let mut world = running();
    world.order("node 2 sensor 1 bad");
    world.run_until(5000, |world| world.active_alarms().contains(&"pressure_invalid"));
    assert_eq!(world.tag(2, "pressure").quality, Quality::Bad(Reason::NotANumber), "R-DST-037");
    world.order("node 2 sensor 1 good");
    world.run_until(5000, |world| world.tag(2, "pressure").quality == Quality::Good);
}

#[test]
fn r_dst_001_another_device_at_its_place_is_not_started_and_said_to_be_another() {
    let mut world = World::with(
        Arc::new(Sketch::new().node("node001", 1, "danfoss-dst-p92c", |_| ()).build().unwrap().0),
        1,
    );
    world.power_on(1, "quiet");
    world.start_gateway();
    world.run_for(10_000);
    assert!(!world.sent.iter().any(|frame| frame.starts_with("000#")), "{:?}", world.sent);
    assert_eq!(world.events("node_boot_failed"), 1, "told once: it answers no SDO");
}

#[test]
fn r_dst_034_nothing_is_shown_before_it_is_known_what_the_tpdo_carries() {
    let table = plant();
    let mut gateway = Gateway::new(Arc::clone(&table), Now::from_millis(0));
    let mut image = gateway.empty_image();
    let at = Now::from_millis(1);
    let frame = "182#0000C03F19000000".parse().unwrap();
    for event in [BusEvent::Link { link: Link::ErrorActive, at }, BusEvent::Frame { frame, at }] {
        gateway.handle_input(at, Input::Bus { bus: BusIndex(0), event });
    }
    while gateway.poll_output().is_some() {}
    gateway.publish(&mut image);
    let pressure = table.find_tag(table.find_node("node002").unwrap(), "pressure").unwrap();
    assert_eq!(image.tag(pressure).quality, Quality::NEVER);
    assert_eq!(image.nodes[1].counters.frames_received, 1, "it was seen all the same");
}

#[test]
fn mistakes_about_objects_are_told_with_the_way_out() {
    let shipped = cangate::mapping::shipped("danfoss-dst-p92c").unwrap();
    for (right, wrong, message) in [
        ("\"0x6130:1/32\"", "\"0x6130:1/16\"", "0x6130:1 is mapped with 16 bits, but `f32` has 32"),
        ("\"0x6130:1/32\"", "\"0x6130-1\"", "`0x6130-1` is no mapped object"),
        ("maps = [\"0x6130:1/32\", \"0x9130:2/32\"]\n", "", "the length of TPDO 1 is not known"),
        ("poll_ms = 60000", "poll_ms = 50", "poll_ms 50 is out of range"),
        (
            "object = \"0x3000:0\"\n",
            "object = \"0x3000:0\"\ntpdo = 1\n",
            "needs either `tpdo` and `bit`, or `object`",
        ),
        (
            "poll_ms = 60000\n",
            "",
            "no TPDO maps 0x3000:0, so `pressure_overflow_count` would never have a value",
        ),
        ("value = 0x004E0000", "value = -1", "-1 does not fit into u32"),
        (
            "event_timer_ms = 1000",
            "event_timer_ms = 1000\ninhibit_time_us = 50",
            "inhibit_time_us 50 cannot be set",
        ),
    ] {
        let text = shipped.replacen(right, wrong, 1);
        assert_ne!(text, shipped, "{right}");
        let problems = check_mapping(&SourceText::new("dst.toml", text.as_str())).unwrap_err();
        let told: Vec<String> = problems.iter().map(ToString::to_string).collect();
        assert!(
            told.iter().any(|line| line.contains(message) && line.contains("hint: ")),
            "{wrong}: {told:#?}"
        );
    }
}
