//! What each shipped scenario does on the bus, and what the manual says of it.

use super::super::SCENARIOS;
use crate::canopen::{NmtState, NodeId};
use crate::simulator::{DevicePlan, Kind, Scenario, Settings};
use crate::time::Now;

fn parse(text: &str) -> Result<Scenario, String> {
    Scenario::parse(Kind::DstP92c, "s.toml", text).map_err(|error| error.to_string())
}

/// Runs a shipped scenario with a master that sets the event timer and heartbeats after each boot, starts the device and
/// asks it for its type once a second. Gives everything the device sent, with its time.
fn play(name: &str, until: u64) -> Vec<(u64, String)> {
    let plan = DevicePlan::new(NodeId::new(1).unwrap(), Scenario::shipped(Kind::DstP92c, name).unwrap());
    let mut device = plan.power_on(Now::from_millis(0));
    let mut log = Vec::new();
    for millis in 0..=until {
        let now = Now::from_millis(millis);
        device.handle_timeout(now);
        let mut say = |frame: &str| device.handle_frame(now, &frame.parse().unwrap());
        if millis % 1000 == 500 {
            say("601#4000100000000000");
        }
        if millis % 1000 == 250 && device.status().state == Some(NmtState::PreOperational) {
            let mut say = |frame: &str| device.handle_frame(now, &frame.parse().unwrap());
            for frame in ["601#2F001802FF000000", "601#2B001805F4010000", "601#2B171000F4010000", "000#0101"]
            {
                say(frame);
            }
        }
        while let Some(frame) = device.poll_output() {
            log.push((millis, frame.to_string()));
        }
    }
    log
}

fn of<'a>(log: &'a [(u64, String)], id: &str, from: u64, to: u64) -> Vec<&'a str> {
    let chosen = log.iter().filter(|(at, frame)| frame.starts_with(id) && (from..to).contains(at));
    chosen.map(|(_, frame)| frame.as_str()).collect()
}

#[test]
fn every_shipped_scenario_can_be_read_and_is_in_the_manual() {
    const MANUAL: &str = include_str!("../../../../docs/simulator.md");
    for (name, text) in SCENARIOS {
        let scenario = parse(text).unwrap_or_else(|error| panic!("{error}"));
        assert!(!scenario.description.is_empty());
        assert!(MANUAL.contains(&format!("| `{name}` |")), "{name}");
    }
    for line in Kind::DstP92c.help().lines() {
        let order = line.split_once("  ").map_or(line, |(order, _)| order);
        let word = order.split(' ').next().unwrap();
        assert!(MANUAL.contains(&format!("`{word}")), "{word}");
    }
}

#[test]
fn quiet_has_values_near_its_set_point_and_no_error() {
    let log = play("quiet", 20_000);
    assert!(of(&log, "081", 0, 20_000).is_empty());
    let values = of(&log, "181", 1000, 20_000);
    assert_eq!(values.len(), 38);
    assert!(values.iter().all(|frame| frame.ends_with("00")), "status 0");
    assert!(values.windows(2).any(|pair| pair[0] != pair[1]), "noise");
}

#[test]
fn overpressure_and_overtemperature_raise_and_clear_their_error() {
    for (name, code) in [("overpressure", "081#11F021"), ("overtemperature", "081#004009")] {
        let log = play(name, 12_000);
        assert_eq!(of(&log, "081", 0, 12_000).len(), 2, "{name}");
        assert_eq!(of(&log, code, 5000, 10_000).len(), 1, "{name}");
        assert_eq!(of(&log, "081#000000", 10_000, 10_100).len(), 1, "{name}");
    }
    let log = play("overpressure", 12_000);
    assert!(of(&log, "181", 8000, 10_000).iter().all(|frame| frame.ends_with("02")));
}

#[test]
fn bad_sensor_invalidates_pressure_then_temperature() {
    let log = play("bad_sensor", 26_000);
    assert!(of(&log, "181", 5000, 10_000).iter().all(|frame| frame.ends_with("FFFFFF7F01")));
    assert_eq!(of(&log, "081#004009", 20_000, 20_100).len(), 1);
}

#[test]
fn power_cycle_is_silent_and_boots() {
    let log = play("power_cycle", 12_000);
    assert!(of(&log, "", 5000, 10_000).is_empty());
    assert_eq!(of(&log, "701#00", 10_000, 10_200).len(), 1);
    assert!(!of(&log, "181", 10_200, 12_000).is_empty());
}

#[test]
fn boot_error_restarts_without_a_boot_up_message_and_later_with() {
    let log = play("boot_error", 17_000);
    assert!(of(&log, "701#00", 200, 14_000).is_empty());
    assert_eq!(of(&log, "081#006381", 6000, 6200).len(), 1);
    assert_eq!(of(&log, "701#00", 15_000, 15_200).len(), 1);
}

#[test]
fn mute_leaves_out_one_kind_of_frame_after_the_other() {
    let log = play("mute", 45_000);
    for (id, from) in [("701", 5000), ("181", 20_000), ("581", 35_000)] {
        assert!(of(&log, id, from + 2, from + 5000).is_empty(), "{id}");
        for other in ["701", "181", "581"].into_iter().filter(|other| *other != id) {
            assert!(!of(&log, other, from, from + 5000).is_empty(), "{other} while {id} is muted");
        }
    }
}

#[test]
fn emergencies_tells_each_code_of_the_guide_and_its_end() {
    let log = play("emergencies", 25_000);
    let codes: Vec<_> = of(&log, "081", 0, 25_000).into_iter().map(|frame| &frame[4..10]).collect();
    let expected = ["008111", "616181", "636321", "006381", "004009", "11F021"];
    assert_eq!(codes, expected.map(|code| [code, "000000"]).concat());
}

#[test]
fn demo_works_strokes_and_overshoots_once_in_two_minutes() {
    let log = play("demo", 180_000);
    assert_eq!(of(&log, "081#11F021", 46_000, 48_000).len(), 1);
    assert_eq!(of(&log, "081#000000", 48_000, 55_000).len(), 1);
    assert_eq!(of(&log, "081#11F021", 0, 180_000).len(), 3, "overshoot, sensor, overshoot");
}

#[test]
fn all_keys_of_the_device_can_be_given() {
    let text = r#"
description = "all"
[device]
boot_ms = 300
reply_delay_ms = 5
default_transmission_type = 255
boot_on_error = true
sdo_in_stopped = true
unconfigured = true
lss_in_any_state = true
address_needs_save = false
product_code = 0x11223344
revision = 3
serial_number = 4294967295
bus_kbit = 500
kbit = 125
span_bar = 600
pressure_bar = 12.5
temperature_c = -3
noise = false
[[step]]
at_ms = 100
for_ms = 200
do = ["pressure 700 100", "emcy 8100"]
"#;
    let scenario = parse(text).unwrap();
    let Settings::DstP92c(settings) = scenario.settings else { panic!("another kind") };
    assert_eq!((settings.bus_kbit, settings.bit_rate, settings.serial_number), (500, 4, u32::MAX));
    assert_eq!((settings.span_bar, settings.temperature_c), (600.0, -3.0));
    let told: Vec<_> = scenario.events.iter().map(|event| event.order.as_str()).collect();
    assert_eq!(told, ["pressure 700 100", "emcy 8100", "pressure off", "emcy clear"]);
}

#[test]
fn wrong_keys_are_told_where_they_stand() {
    for (line, message) in [
        ("default_transmission_type = 2", "give 1 (after each SYNC) or 255"),
        ("kbit = 100", "give 20, 50, 125"),
        ("span_bar = 0", "give 1 to 2000"),
        ("serial_number = -1", "-1 is not a serial number"),
        ("cylinders = 12", "unknown field `cylinders`"),
    ] {
        let error = parse(&format!("description = \"x\"\n[device]\n{line}\n")).unwrap_err();
        assert!(error.starts_with("s.toml:3:") && error.contains(message), "{error}");
    }
    let error = parse("description = \"x\"\n[[step]]\nat_ms = 1\ndo = \"knock 7 on\"\n").unwrap_err();
    assert!(error.contains("s.toml:4:6: error: `knock 7 on` cannot be ordered"), "{error}");
}
