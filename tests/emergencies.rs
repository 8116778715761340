//! Errors that devices tell of: each has its alarm, ends when it is over, is seen though it began before the gateway, and a
//! storm of them harms nobody.

use std::sync::Arc;

use cangate::canopen::NodeId;
use cangate::canopen::emcy::{MOST_ACTIVE, MOST_REMEMBERED};
use cangate::mapping::{Sketch, SourceText, check_mapping, shipped};
use cangate::process_image::{AlarmIndex, AlarmState, Priority, Quality, Reason, Value};
use cangate::simulator::{DevicePlan, Kind, Scenario};

use super::support::world::World;

/// The shipped mapping.
const TRANSMITTER: &str = "danfoss-dst-p92c";

fn world(mapping: &str) -> World {
    let source = SourceText::new("dst", mapping);
    let sketch = Sketch::new().mapping(source).node("node001", 1, "dst", |_| ());
    World::with(Arc::new(sketch.build().unwrap().0), 1)
}

fn connect(world: &mut World) {
    let scenario = Scenario::shipped(Kind::DstP92c, "quiet").unwrap();
    world.connect(&DevicePlan::new(NodeId::new(1).unwrap(), scenario));
}

/// A transmitter with its shipped mapping that has run for 5 s.
fn running() -> World {
    let mut world = world(shipped(TRANSMITTER).unwrap());
    connect(&mut world);
    world.run_for(1000);
    world.start_gateway();
    world.run_for(5000);
    assert!(world.raised.is_empty(), "{:?}", world.raised);
    world
}

fn numbers(world: &World) -> [u16; 3] {
    ["emcy_code", "error_register", "active_errors"].map(|tag| {
        assert_eq!(world.tag(1, tag).quality, Quality::Good, "{tag}");
        match world.tag(1, tag).value {
            Value::Unsigned(number) => u16::try_from(number).unwrap(),
            other => panic!("{tag} is {other:?}"),
        }
    })
}

#[test]
fn r_dst_074_077_083_each_error_raises_its_alarm_and_no_other() {
    for (code, register, alarm, priority) in [
        (0x8100, 0x11, "can_error", Priority::Low),
        (0x6161, 0x81, "settings_error", Priority::High),
        (0x6363, 0x21, "mapping_error", Priority::Low),
        (0x6300, 0x81, "start_up_error", Priority::High),
        (0x4000, 0x09, "temperature_error", Priority::Low),
        (0xF011, 0x21, "pressure_error", Priority::High),
    ] {
        let mut world = running();
        world.order(&format!("emcy {code:04X}"));
        world.run_for(3000);
        assert_eq!(world.active_alarms(), [alarm]);
        assert_eq!(numbers(&world), [code, register, 1]);
        let def = world.table.alarms.iter().find(|def| def.name == alarm).unwrap();
        assert_eq!(def.priority, priority, "{alarm}");
        world.order("emcy clear");
        world.run_for(10);
        assert_eq!(world.active_alarms(), [""; 0], "R-DST-076");
        assert_eq!(numbers(&world), [0, 0, 0]);
        assert_eq!(world.raised.len(), 1, "{:?}", world.raised);
        assert_eq!(world.events("emergency"), 2);
    }
}

#[test]
fn v_dst_11_r_dst_074_the_worked_frames_are_events_with_code_class_and_register() {
    let mut world = running();
    for (frame, text) in [
        (
            "11F0210000000000",
            "0xF011 (additional functions, pressure_error), error register 0x21 (generic, device profile)",
        ),
        (
            "0040090000000000",
            "0x4000 (temperature, temperature_error), error register 0x09 (generic, temperature)",
        ),
        (
            "0081110000000000",
            "0x8100 (communication, can_error), error register 0x11 (generic, communication)",
        ),
        ("6361210000000000", "0x6163 (internal software), error register 0x21 (generic, device profile)"),
        (
            "6363210000000000",
            "0x6363 (data set, mapping_error), error register 0x21 (generic, device profile)",
        ),
        (
            "6161810000000000",
            "0x6161 (internal software, settings_error), error register 0x81 (generic, manufacturer)",
        ),
        (
            "0063810000000000",
            "0x6300 (data set, start_up_error), error register 0x81 (generic, manufacturer)",
        ),
        ("0000000000000000", "0x0000 (error reset or no error), error register 0x00"),
    ] {
        world.overhear(&format!("081#{frame}"));
        let event = world
            .image
            .journal
            .newest_first()
            .find(|event| event.name == "emergency" && event.alarm.is_none())
            .unwrap();
        assert_eq!(event.text, format!("error code {text}, manufacturer bytes 0000000000"));
        assert_eq!(event.ts, world.now().utc);
    }
    assert_eq!(world.active_alarms(), [""; 0]);
    let history: Vec<u16> = world.node(1).errors.history().map(|record| record.emergency.code).collect();
    assert_eq!(history, [0, 0x6300, 0x6161, 0x6363, 0x6163, 0x8100, 0x4000, 0xF011], "R-DST-078");
}

#[test]
fn r_dst_078_079_the_classes_that_are_there_follow_the_error_register() {
    let mut world = running();
    world.overhear("081#11F0210000000000");
    world.overhear("081#0040290000000000");
    let set = |world: &World| {
        let bits = ["generic", "temperature", "communication", "pressure_or_mapping", "memory_or_start_up"];
        let set = bits.into_iter().filter(|bit| world.tag(1, &format!("error_{bit}")).value.is_true());
        set.collect::<Vec<_>>()
    };
    assert_eq!(set(&world), ["generic", "temperature", "pressure_or_mapping"]);
    assert_eq!(world.active_alarms(), ["temperature_error", "pressure_error"]);
    world.overhear("081#0040090000000000");
    assert_eq!(set(&world), ["generic", "temperature"]);
    assert_eq!(world.active_alarms(), ["temperature_error"]);
    assert_eq!(numbers(&world), [0x4000, 0x09, 1]);
}

#[test]
fn r_dst_080_081_an_error_that_was_there_before_the_gateway_is_found() {
    let mut world = world(shipped(TRANSMITTER).unwrap());
    connect(&mut world);
    world.run_for(1000);
    world.order("emcy F011");
    world.run_for(1000);
    world.start_gateway();
    world.run_for(1000);
    assert_eq!(world.active_alarms(), ["pressure_error"]);
    assert_eq!(numbers(&world), [0xF011, 0x21, 1]);
    assert_eq!((world.events("emergency_found"), world.events("emergency")), (1, 0));
    world.order("emcy clear");
    world.run_for(100);
    assert_eq!(world.active_alarms(), [""; 0]);
}

#[test]
fn r_dst_081_an_error_without_a_code_has_the_alarm_of_the_register() {
    let mut world = running();
    world.order("set 1001 0 33");
    world.run_until(11_000, |world| world.active_alarms() == ["device_error"]);
    assert_eq!(numbers(&world), [0, 0x21, 0]);
}

#[test]
fn a_message_that_was_lost_is_made_good_by_reading_the_register() {
    let mut world = running();
    world.overhear("081#11F0210000000000");
    world.run_for(1000);
    assert_eq!(world.active_alarms(), ["pressure_error"]);
    world.run_until(12_000, |world| world.active_alarms().is_empty());
    assert_eq!(numbers(&world), [0, 0, 0]);
}

#[test]
fn r_dst_051_076_after_a_boot_up_no_error_is_left() {
    let mut world = running();
    world.overhear("081#11F0210000000000");
    assert_eq!(world.active_alarms(), ["pressure_error"]);
    world.order("power cycle");
    world.run_until(500, |world| !world.active_alarms().contains(&"pressure_error"));
    world.run_for(5000);
    assert_eq!(numbers(&world), [0, 0, 0]);
}

#[test]
fn r_dst_052_053_a_transmitter_that_starts_with_an_error_and_no_boot_up_message_is_booted() {
    for off_for in [10, 10_000] {
        let mut world = running();
        world.order("boot error on");
        world.order("power off");
        world.run_for(off_for);
        world.order("power on");
        world.run_for(12_000);
        assert!(world.node(1).online, "{off_for}: {}", world.node(1).reason);
        assert_eq!(world.tag(1, "pressure").quality, Quality::Good, "{off_for}");
        assert_eq!(world.active_alarms(), ["start_up_error"], "{off_for}");
        assert_eq!(world.node(1).counters.restarts, 0, "there was no boot-up message");
    }
}

#[test]
fn r_dst_077_a_code_that_the_mapping_does_not_name_is_shown_in_hex_with_its_class() {
    let mut world = running();
    world.overhear("081#6361210000000000");
    world.overhear("081#0050210000000000");
    assert_eq!(world.active_alarms(), ["emergency"]);
    let place = world.table.alarms.iter().position(|alarm| alarm.name == "emergency").unwrap();
    let (def, status) = (&world.table.alarms[place], world.image.alarm(AlarmIndex(place)).unwrap());
    assert_eq!((def.priority, def.bit), (Priority::Low, Some(9)));
    assert!(def.told(status.value).ends_with("does not name. Error code 0x6163 (internal software)."));
    assert_eq!(def.told(None), def.text);
    let call = world.image.journal.newest_first().find(|event| event.alarm.is_some()).unwrap();
    assert!(call.text.ends_with("Error code 0x6163 (internal software)."), "{}", call.text);
    world.overhear("081#0000000000000000");
    assert_eq!(world.active_alarms(), [""; 0]);
}

#[test]
fn r_dst_078_an_alarm_tells_of_the_error_that_is_there_when_the_one_that_raised_it_has_gone() {
    let mut world = running();
    world.overhear("081#0020030000000000");
    let place = world.table.alarms.iter().position(|alarm| alarm.name == "emergency").unwrap();
    let shown = |world: &World| *world.image.alarm(AlarmIndex(place)).unwrap();
    assert_eq!(shown(&world).value, Some(Value::Unsigned(0x2000)));
    let before = shown(&world).revision;
    world.run_for(10);
    // Its bit of the error register is not set any more.
    world.overhear("081#0031050000000000");
    let status = shown(&world);
    assert_eq!((status.value, status.count), (Some(Value::Unsigned(0x3100)), 1));
    assert!(status.revision > before, "readers are told");
    assert!(world.table.alarms[place].told(status.value).ends_with("Error code 0x3100 (mains voltage)."));
}

#[test]
fn errors_of_a_lost_transmitter_are_not_good_and_its_alarms_are_told_by_the_loss() {
    let mut world = running();
    world.order("emcy F011");
    world.run_for(100);
    world.order("power off");
    world.run_until(3100, |world| world.active_alarms() == ["node_lost"]);
    assert_eq!(world.tag(1, "emcy_code").quality, Quality::Bad(Reason::NodeLost));
    assert!(!world.node(1).data_good);
    world.order("emcy clear");
    world.order("power on");
    world.run_until(5000, |world| world.node(1).data_good);
    assert_eq!(numbers(&world), [0, 0, 0]);
    assert!(!world.active_alarms().contains(&"pressure_error"));
}

#[test]
fn r_dst_078_ten_thousand_messages_a_second_are_bounded_and_all_end_together() {
    let mut world = running();
    let mut seed = 12_345_u32;
    let mut draw = || {
        seed = seed.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        seed >> 16
    };
    let newest = world.image.journal.newest();
    for _ in 0..1000 {
        for _ in 0..10 {
            let length = draw() % 9;
            let data = (0..length).map(|_| format!("{:02X}", draw() & 0xFF)).collect::<Vec<_>>().concat();
            // An empty one is a boot-up message, of which there is another test.
            if !data.is_empty() {
                world.overhear(&format!("081#{data}"));
            }
        }
        world.run_for(1);
        let errors = &world.node(1).errors;
        assert!(errors.active().len() <= MOST_ACTIVE && errors.history().count() <= MOST_REMEMBERED);
    }
    assert!(world.image.journal.newest() - newest < 100, "{}", world.image.journal.newest() - newest);
    assert!(world.node(1).counters.emcys > 5000);
    assert!(world.active_alarms().contains(&"emergency"), "{:?}", world.active_alarms());
    world.overhear("081#0000000000000000");
    world.run_for(61_000);
    assert_eq!(world.active_alarms(), [""; 0]);
    assert_eq!(numbers(&world), [0, 0, 0]);
    assert_eq!(world.tag(1, "pressure").quality, Quality::Good);
}

#[test]
fn r_det_091_an_emergency_message_of_a_detcon_is_an_event_and_no_alarm() {
    let mut world = World::running(1);
    world.overhear("081#1042010A0B0C0D0E");
    world.run_for(1000);
    assert_eq!((world.events("emergency"), world.node(1).counters.emcys), (1, 1));
    assert!(world.raised.is_empty(), "{:?}", world.raised);
    assert!(!world.table.alarms.iter().any(|alarm| alarm.name == "emergency"));
}

/// Without SDO: what is known of its errors is what it tells.
const SIMPLE: &str = r#"
format = 1
device = { vendor = "test", model = "simple" }
[error_control]
kind = "heartbeat"
[emergency]
cob_id = "$NODEID+0x1ABCD0"
[[emergency.error]]
code = 0x8100
mask = 0xFF00
name = "bus_error"
priority = "medium"
bit = 30
latch = true
text = "The bus."
action = "Look."
[[emergency.error]]
code = 0x8130
name = "silence"
priority = "critical"
bit = 30
text = "Nobody."
action = "Look."
[[emergency.error]]
code = 0x5000
name = "ignored"
priority = "low"
enabled = false
text = "It is always so."
action = "Nothing."
[[tag]]
name = "code"
emergency = "code"
type = "u16"
registers = [{ address = 100, type = "u16" }]
[[tag]]
name = "vendor"
emergency = "vendor"
type = "u40"
byte_order = "big"
"#;

#[test]
fn a_class_of_codes_has_an_alarm_and_a_code_that_is_named_by_itself_goes_before() {
    let mut world = world(SIMPLE);
    world.start_gateway();
    world.overhear("701#05");
    assert_eq!((world.tag(1, "code").quality, world.number(1, "code")), (Quality::Good, 0.0));
    world.overhear("001ABCD1#4081110102030405");
    assert_eq!(world.active_alarms(), ["bus_error"]);
    assert_eq!(world.number(1, "vendor"), f64::from(0x0102_0304) * 256.0 + 5.0);
    world.overhear("001ABCD1#3081110000000000");
    assert_eq!(world.active_alarms(), ["bus_error", "silence"]);
    world.overhear("001ABCD1#0050110000000000");
    assert_eq!(world.active_alarms(), ["bus_error", "silence"], "one that is switched off raises none");
    world.overhear("001ABCD1#0000000000000000");
    assert_eq!(world.active_alarms(), ["bus_error"], "it latches");
    let place = world.table.alarms.iter().position(|alarm| alarm.name == "bus_error").unwrap();
    assert_eq!(world.image.alarm(AlarmIndex(place)).unwrap().state, AlarmState::LatchedUnacknowledged);
    world.overhear("081#3081110000000000");
    assert_eq!(world.node(1).counters.emcys, 4, "not its identifier");
}

#[test]
fn r_dst_001_another_device_has_one_alarm_that_says_so() {
    let text = shipped(TRANSMITTER).unwrap().replace("vendor_id = 0x23D", "vendor_id = 0x23E");
    let mut world = world(&text);
    connect(&mut world);
    world.start_gateway();
    // It is given no heartbeat: that it sends none is no second cause.
    world.run_for(10_000);
    assert_eq!(world.active_alarms(), ["identity_mismatch"]);
    assert!(world.node(1).identity_mismatch && world.node(1).reason.contains("another device"));
    assert_eq!(world.raised.len(), 1, "{:?}", world.raised);
    world.order("power off");
    world.run_until(60_000, |world| world.active_alarms() == ["node_lost"]);
}

#[test]
fn mistakes_about_errors_are_told_with_the_way_out() {
    for (right, wrong, message) in [
        ("code = 0x8130", "code = 0", "0 is not the code of an error"),
        ("code = 0x8130", "code = 70000", "code 70000 is out of range"),
        ("mask = 0xFF00", "mask = 0", "mask 0 is out of range"),
        ("mask = 0xFF00", "mask = 0x00FF", "code 0x8100 has bits that mask 0x00FF leaves out"),
        ("mask = 0xFF00\n", "", ""),
        ("code = 0x8130", "code = 0x8100\nmask = 0xFF00", "`bus_error` and `silence` have codes in common"),
        ("code = 0x8130", "code = 0x0030\nmask = 0x00FF", "`bus_error` and `silence` have codes in common"),
        ("code = 0x5000", "code = 0x8130", "`silence` and `ignored` have codes in common"),
        ("bit = 30", "bit = 15", "bit 15 is out of range"),
        ("code = 0x5000", "code = 0x5000\nregister_bit = 0", "register_bit 0 is out of range"),
        ("\"silence\"", "\"node_lost\"", "`node_lost` is the name of a built-in alarm"),
        ("\"silence\"", "\"bus_error\"", "there are two alarms `bus_error`"),
        ("latch = true", "suppressed_by = [\"silense\"]", "there is no alarm `silense`"),
        ("\"$NODEID+0x1ABCD0\"", "0x601", "emergency of node `check` has identifier"),
        ("\"$NODEID+0x1ABCD0\"", "0x20000000", "an identifier"),
        (
            "[[tag]]",
            "[[alarm]]\nname = 'a'\nwhen = 'code > 1'\npriority = 'low'\ntext = ''\naction = ''\nbit = 30\n[[tag]]",
            "error `bus_error` and alarm `a` have the same bit 30",
        ),
        (
            "type = \"u16\"\nreg",
            "type = \"i16\"\nreg",
            "`i16` is no type for this part of emergency messages",
        ),
        ("type = \"u40\"", "type = \"u48\"", "`u48` is no type for this part of emergency messages"),
        ("type = \"u40\"", "type = \"u40\"\ntpdo = 1", "`tpdo` means nothing here"),
        ("emergency = \"vendor\"", "emergency = \"vendour\"", "vendour"),
        ("read", "read", ""),
    ] {
        let text = SIMPLE.replacen(right, wrong, 1);
        let told: Vec<String> = match check_mapping(&SourceText::new("simple.toml", text.as_str())) {
            Ok(warnings) => warnings.iter().map(ToString::to_string).collect(),
            Err(problems) => problems.iter().map(ToString::to_string).collect(),
        };
        let found = told.iter().any(|line| line.contains(message) && line.contains("hint: "));
        assert_eq!(found, !message.is_empty(), "{wrong}: {told:#?}");
    }
}
