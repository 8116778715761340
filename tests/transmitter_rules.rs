//! What the gateway does with a DST P92C, requirement by requirement: with the shipped mapping or one of its own, against the
//! simulated device, which refuses what the maker's guide says that it refuses.

use std::sync::Arc;

use cangate::canopen::{NmtState, NodeId, PdoIndex};
use cangate::mapping::installation::{ErrorControlWord, NodeEntry};
use cangate::mapping::{At, Sketch, SourceText, TagTable};
use cangate::process_image::Quality;
use cangate::simulator::{DevicePlan, Kind, Scenario};

use super::support::world::World;

/// The objects that TPDO1 of the device can carry, index and sub-index in one number, with their bits.
const MAPPABLE: [(u32, u32); 6] = [
    (0x0091_3001, 32),
    (0x0061_3001, 32),
    (0x0061_5001, 8),
    (0x0091_3002, 32),
    (0x0061_3002, 32),
    (0x0061_5002, 8),
];

fn table(id: u8, mapping: &str, change: impl FnOnce(&mut NodeEntry)) -> Arc<TagTable> {
    let sketch = Sketch::new().mapping(SourceText::new("own", format!("{HEAD}{mapping}"))).node(
        &format!("node{id:03}"),
        id,
        if mapping.is_empty() { "danfoss-dst-p92c" } else { "own" },
        change,
    );
    Arc::new(sketch.build().unwrap_or_else(|problems| panic!("{problems:#?}")).0)
}

/// The begin of a mapping of our own.
const HEAD: &str = "format = 1\ndevice = { vendor = 'x', model = 'y' }\n\
                    error_control = { kind = 'heartbeat', heartbeat_ms = 500 }\n";

/// A transmitter with these keys under `[device]` of its scenario.
fn transmitter(id: u8, keys: &str) -> DevicePlan {
    let text = format!("description = \"x\"\n[device]\nnoise = false\n{keys}\n");
    DevicePlan::new(NodeId::new(id).unwrap(), Scenario::parse(Kind::DstP92c, "s.toml", &text).unwrap())
}

/// The device has run for a second; then the gateway starts, and what is sent is logged.
fn started(table: Arc<TagTable>, plan: &DevicePlan, orders: &[&str]) -> World {
    let mut world = World::with(table, 1);
    world.connect(plan);
    world.run_for(1000);
    for order in orders {
        world.order(order);
    }
    world.log = Some(Vec::new());
    world.start_gateway();
    world.run_for(5000);
    world
}

/// The gateway with the shipped mapping, and a transmitter from the factory at node 1.
fn shipped() -> World {
    started(table(1, "", |_| ()), &transmitter(1, ""), &[])
}

/// Takes what was sent on the bus since the last call.
fn take(world: &mut World) -> Vec<String> {
    world.log.replace(Vec::new()).unwrap()
}

/// Those of some frames that begin so.
fn of<'a>(frames: &'a [String], beginning: &str) -> Vec<&'a str> {
    frames.iter().map(String::as_str).filter(|frame| frame.starts_with(beginning)).collect()
}

/// Those of some frames that write an object of node 1 by SDO.
fn writes(frames: &[String]) -> Vec<&str> {
    let is_write = |frame: &&str| u8::from_str_radix(&frame[4..6], 16).unwrap() & 0xE0 == 0x20;
    of(frames, "601#").into_iter().filter(is_write).collect()
}

#[test]
fn r_dst_003_004_013_a_transmitter_is_operated_at_each_node_id_from_the_factorys_1_to_127() {
    for id in [1, 5, 127] {
        let mut world = started(table(id, "", |_| ()), &transmitter(id, ""), &[]);
        assert!(world.is_good(id) && world.node(id).online, "{id}");
        let identifiers = [0x180, 0x580, 0x600, 0x700].map(|base: u16| base + u16::from(id));
        for frame in take(&mut world) {
            let identifier = u16::from_str_radix(&frame[..3], 16).unwrap();
            let nmt = [format!("000#80{id:02X}"), format!("000#01{id:02X}")];
            assert!(identifiers.contains(&identifier) || nmt.contains(&frame), "{frame}");
        }
    }
}

#[test]
fn r_dst_013_tpdo1_is_taken_from_the_identifier_that_the_device_says() {
    let mut world = started(table(1, "", |_| ()), &transmitter(1, ""), &["set 1800 1 0x1F3"]);
    assert!(!of(&take(&mut world), "1F3#").is_empty());
    assert!(world.is_good(1));
    world.order("set 1800 1 0x181");
    world.run_for(4000);
    assert!(!world.is_good(1), "181 is not what it said");
}

#[test]
fn r_dst_020_022_023_an_operational_device_is_re_mapped_in_the_order_of_the_guide() {
    let plan = transmitter(1, "default_transmission_type = 255");
    let mut world = World::with(table(1, "", |_| ()), 1);
    world.connect(&plan);
    world.run_for(1000);
    world.say("000#0101");
    world.log = Some(Vec::new());
    world.start_gateway();
    world.run_for(5000);
    let frames = take(&mut world);
    let is_step = |frame: &&str| {
        let writes_mapping = frame.starts_with("601#2") && frame[6..10] == *"001A";
        frame.starts_with("000#") || writes_mapping
    };
    let steps: Vec<&str> = frames.iter().map(String::as_str).filter(is_step).collect();
    assert_eq!(
        steps,
        [
            "000#8001",
            "601#2F001A0000000000",
            "601#23001A0120013061",
            "601#23001A0220023091",
            "601#2F001A0002000000",
            "000#0101",
        ]
    );
    assert!(of(&frames, "581#80").is_empty(), "the device refused nothing");
}

#[test]
fn v_dst_15_r_dst_017_entries_that_are_left_over_are_set_to_zero() {
    let orders =
        ["set 1A00 1 0x61500108", "set 1A00 2 0x61500208", "set 1A00 3 0x61500108", "set 1A00 4 0x61500208"];
    let orders = [&orders[..], &["set 1A00 0 4"]].concat();
    let mut world = started(table(1, "", |_| ()), &transmitter(1, ""), &orders);
    let frames = take(&mut world);
    let mapping: Vec<&str> = writes(&frames).into_iter().filter(|frame| frame[6..10] == *"001A").collect();
    assert_eq!(
        mapping,
        [
            "601#2F001A0000000000",
            "601#23001A0120013061",
            "601#23001A0220023091",
            "601#23001A0300000000",
            "601#23001A0400000000",
            "601#2F001A0002000000",
        ]
    );
    assert!(world.is_good(1));
}

#[test]
fn r_dst_018_019_what_the_shipped_mapping_asks_for_the_device_can_map() {
    let table = table(1, "", |_| ());
    let setup = table.nodes[0].protocol.boot().unwrap().setup_of(PdoIndex(0)).unwrap();
    let maps: Vec<(u32, u32)> =
        setup.maps.iter().map(|object| (object.entry() >> 8, object.entry() & 0xFF)).collect();
    assert!(
        (1..=4).contains(&maps.len()) && maps.iter().all(|object| MAPPABLE.contains(object)),
        "{maps:X?}"
    );
    assert!(maps.iter().map(|(_, bits)| bits).sum::<u32>() <= 64);
}

#[test]
fn r_dst_018_an_object_that_cannot_be_mapped_is_told_and_the_device_is_not_started() {
    let mapping =
        "[tpdo.1]\ncob_id = '$NODEID+0x180'\nmaps = ['0x6130:1/32', '0x1001:0/8']\ntimeout_ms = 3000\n";
    let mut world = started(table(1, mapping, |_| ()), &transmitter(1, ""), &[]);
    assert_eq!(of(&take(&mut world), "000#01"), [""; 0]);
    let told = world.image.journal.newest_first().find(|event| event.name == "node_boot_failed").unwrap();
    assert!(told.text.contains("0x1A00:2") && told.text.contains("0x06040041"), "{}", told.text);
}

#[test]
fn r_dst_043_044_123_whatever_the_device_is_set_to_it_sends_by_itself_once_a_second() {
    for (keys, order, expected) in [
        ("", "set 1800 5 1000", &["601#2F001802FF000000"][..]),
        ("default_transmission_type = 255", "set 1800 5 1000", &[]),
        ("default_transmission_type = 255", "set 1800 5 0", &["601#2B001805E8030000"]),
        ("", "set 1800 5 250", &["601#2F001802FF000000", "601#2B001805E8030000"]),
    ] {
        let mut world = started(table(1, "", |_| ()), &transmitter(1, keys), &[order]);
        let frames = take(&mut world);
        let written: Vec<&str> =
            writes(&frames).into_iter().filter(|frame| frame[6..10] == *"0018").collect();
        assert_eq!(written, expected, "{keys} {order}");
        world.run_for(10_000);
        assert_eq!(of(&take(&mut world), "181#").len(), 10, "{keys} {order}");
        assert_eq!(world.events("node_boot_failed"), 0);
    }
}

#[test]
fn r_dst_049_058_086_nothing_is_written_but_what_the_mapping_says() {
    let mut world = shipped();
    for order in ["node 1 power cycle", "node 1 pressure 500", "node 1 sensor 1 bad", "node 1 clear all"] {
        world.order(order);
        world.run_for(10_000);
    }
    let frames = take(&mut world);
    assert!(writes(&frames).len() > 10);
    for frame in writes(&frames) {
        let index = format!("{}{}", &frame[8..10], &frame[6..8]);
        let allowed = ["1017", "1800", "1A00", "6131", "6132"];
        assert!(allowed.contains(&index.as_str()), "{frame}");
    }
}

#[test]
fn r_dst_050_a_tpdo_that_no_longer_comes_makes_its_values_stale_after_three_event_timers() {
    let mut world = shipped();
    world.order("node 1 mute pdo on");
    let took = world.run_until(4000, |world| world.active_alarms().contains(&"pdo_timeout_1"));
    assert!((2000..=3001).contains(&took), "{took}");
    assert!(matches!(world.tag(1, "pressure").quality, Quality::Stale(_)));
    world.order("node 1 mute pdo off");
    world.run_until(2000, |world| world.tag(1, "pressure").quality == Quality::Good);

    let timeout = |timer: u32| {
        let mapping = format!(
            "[tpdo.1]\ncob_id = '$NODEID+0x180'\nmaps = ['0x6130:1/32']\nevent_timer_ms = {timer}\ntransmission_type = 255\n"
        );
        table(1, &mapping, |_| ()).nodes[0].pdos()[0].timeout.map(|timeout| timeout.as_millis())
    };
    assert_eq!((timeout(100), timeout(0)), (Some(300), None));
}

#[test]
fn v_dst_12_r_dst_051_056_057_064_a_device_that_booted_is_configured_and_started_again() {
    let mut world = shipped();
    for order in ["node 1 power cycle", "node 1 boot loop 3000"] {
        take(&mut world);
        let restarts = world.node(1).counters.restarts;
        world.order(order);
        world.run_for(4000);
        world.order("node 1 boot loop off");
        world.run_for(3000);
        let frames = take(&mut world);
        let place = |beginning: &str| frames.iter().position(|frame| frame.starts_with(beginning)).unwrap();
        let order_of_events = [
            place("701#00"),
            place("601#40001000"),
            place("601#2B171000"),
            place("601#2F001A00"),
            place("000#0101"),
        ];
        assert!(order_of_events.is_sorted(), "{order}: {frames:#?}");
        assert_eq!(world.node(1).counters.restarts, restarts + 1, "{order}");
        assert_eq!(world.node(1).nmt, Some(NmtState::Operational), "{order}");
        assert!(world.is_good(1), "{order}");
    }
}

#[test]
fn r_dst_058_a_device_that_starts_by_itself_is_left_alone_where_the_installation_says_so() {
    let entry = |node: &mut NodeEntry| node.auto_start = Some(false);
    let mut world = started(table(1, "", entry), &transmitter(1, ""), &[]);
    world.say("601#23801F0008000000");
    world.say("601#2310100173617665");
    world.run_for(100);
    take(&mut world);
    world.order("node 1 power cycle");
    world.run_for(5000);
    let frames = take(&mut world);
    assert!(of(&frames, "701#00").len() == 1 && of(&frames, "181#").len() >= 4, "{frames:#?}");
    assert_eq!(of(&frames, "000#"), [""; 0]);
    assert_eq!(writes(&frames), [""; 0]);
    assert!(world.is_good(1), "{:?} {:?}", world.qualities(1), world.node(1).nmt);
    assert!(!world.raised.contains("duplicate_node") && !world.raised.contains("pdo_timeout_1"));
}

#[test]
fn r_dst_060_each_state_in_a_heartbeat_is_shown() {
    let mut world = shipped();
    for (frame, state) in [
        ("701#7F", NmtState::PreOperational),
        ("701#05", NmtState::Operational),
        ("701#04", NmtState::Stopped),
    ] {
        world.say(frame);
        assert_eq!(world.node(1).nmt, Some(state), "{frame}");
    }
}

#[test]
fn r_dst_063_guarding_is_refused_for_a_device_that_sends_heartbeats() {
    let entry = |node: &mut NodeEntry| node.error_control = Some(At::nowhere(ErrorControlWord::Guarding));
    let problems = Sketch::new().node("press", 1, "danfoss-dst-p92c", entry).build().unwrap_err();
    let told: Vec<String> = problems.iter().map(ToString::to_string).collect();
    assert!(told.iter().any(|line| line.contains("cannot be guarded as well")), "{told:#?}");
    let kind = table(1, "", |_| ()).nodes[0].canopen().unwrap().error_control.clone();
    assert_eq!(format!("{kind:?}"), "Heartbeat { timeout: 3s }");
}

#[test]
fn r_dst_042_047_089_delta_inhibit_time_and_filter_are_set_where_the_mapping_says_so() {
    let mapping = "[tpdo.1]\ncob_id = '$NODEID+0x180'\nmaps = ['0x6130:1/32']\ninhibit_time_us = 50000\n\
                   event_timer_ms = 1000\ntransmission_type = 255\n\
                   [[setup]]\nobject = '0x61A0:1'\ntype = 'u8'\nvalue = 2\n\
                   [[setup]]\nobject = '0x61A1:1'\ntype = 'u8'\nvalue = 10\n\
                   [[setup]]\nobject = '0x6133:1'\ntype = 'f32'\nvalue = 0.5\n";
    let mut world = started(table(1, mapping, |_| ()), &transmitter(1, ""), &[]);
    let frames = take(&mut world);
    for frame in
        ["601#2FA0610102000000", "601#2FA161010A000000", "601#233361010000003F", "601#2B001803F4010000"]
    {
        assert!(writes(&frames).contains(&frame), "{frame}: {frames:#?}");
    }
    assert_eq!(world.node(1).nmt, Some(NmtState::Operational));
}
