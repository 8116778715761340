//! Tests of scenarios: reading, and what each shipped one does on the bus.

use std::time::Duration;

use super::SCENARIOS as SHIPPED;
use crate::canopen::{NmtState, NodeId};
use crate::simulator::{DevicePlan, Kind, Scenario, Settings};
use crate::time::Now;

fn shipped(name: &str) -> Option<Scenario> {
    Scenario::shipped(Kind::Detcon, name)
}

fn parse(file: &str, text: &str) -> Result<Scenario, crate::simulator::SimulatorError> {
    Scenario::parse(Kind::Detcon, file, text)
}

/// Runs a shipped scenario with a master that starts the device whenever it is not operational, asked every 500 ms.
/// Gives everything the device sent, with its time.
fn play(name: &str, until: u64) -> Vec<(u64, String)> {
    let scenario = shipped(name).unwrap();
    let node = NodeId::new(1).unwrap();
    let mut device = DevicePlan::new(node, scenario).power_on(Now::from_millis(0));
    let mut log = Vec::new();
    for millis in 0..=until {
        let now = Now::from_millis(millis);
        if device.poll_timeout().is_some_and(|due| due <= now.instant) {
            device.handle_timeout(now);
        }
        if millis % 500 == 250 {
            device.handle_frame(now, &"701#R1".parse().unwrap());
            if device.status().state.is_some_and(|state| state != NmtState::Operational) {
                device.handle_frame(now, &"000#0101".parse().unwrap());
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
    chosen.map(|(_, frame)| &frame[4..]).collect()
}

/// A byte of each TPDO3 in a time.
fn status_bytes(log: &[(u64, String)], byte: usize, from: u64, to: u64) -> Vec<u8> {
    let frames = of(log, "381", from, to).into_iter();
    frames.map(|data| u8::from_str_radix(&data[2 * byte..2 * byte + 2], 16).unwrap()).collect()
}

#[test]
fn every_shipped_scenario_can_be_read_and_says_what_it_is() {
    for (name, text) in SHIPPED {
        let scenario = parse(name, text).unwrap_or_else(|error| panic!("{error}"));
        assert_eq!(shipped(name), Some(scenario.clone()));
        assert!(!scenario.description.is_empty(), "{name}");
    }
    assert!(shipped("unheard_of").is_none());
}

#[test]
fn quiet_shows_a_healthy_engine() {
    let log = play("quiet", 30_000);
    assert!(status_bytes(&log, 0, 0, 30_000).iter().all(|status| *status == 0));
    assert_eq!(of(&log, "181", 1000, 30_000).len(), 58);
    assert_eq!(of(&log, "701", 0, 30_000).len(), 61);
}

#[test]
fn knock_cylinder_7_knocks_with_fast_tpdos_and_a_reduced_load() {
    let log = play("knock_cylinder_7", 30_000);
    for start in [5000, 25_000] {
        assert_eq!(of(&log, "181", start, start + 4000).len(), 40, "{start}");
        let mut status = status_bytes(&log, 0, start, start + 4000);
        status.dedup();
        assert_eq!(status, [0x01, 0x05], "knocking, then also load reduction");
        let seventh = |data: &&str| u8::from_str_radix(&data[12..14], 16).unwrap() > 128;
        assert!(of(&log, "181", start, start + 4000).iter().all(seventh));
        assert!(status_bytes(&log, 1, start, start + 4000).contains(&255));
    }
    assert!(status_bytes(&log, 0, 20_000, 25_000).iter().all(|status| *status == 0));
    assert!(of(&log, "181", 20_000, 24_900).len() <= 10);
}

#[test]
fn trip_pulses_once_and_the_engine_stands_and_starts() {
    let log = play("trip", 34_000);
    let trips: Vec<_> = log
        .iter()
        .filter(|(_, frame)| frame.starts_with("381"))
        .map(|(at, frame)| (*at, u8::from_str_radix(&frame[4..6], 16).unwrap() & 0x02 != 0))
        .collect();
    let begin = trips.iter().find(|(_, trip)| *trip).unwrap().0;
    let end = trips.iter().find(|(at, trip)| *at > begin && !trip).unwrap().0;
    assert!((5000..5100).contains(&begin) && (100..=200).contains(&(end - begin)), "{begin} {end}");
    assert_eq!(trips.iter().filter(|(_, trip)| *trip).count(), 1);
    assert_eq!(status_bytes(&log, 0, 10_000, 14_000).iter().max(), Some(&0x18));
    assert_eq!(of(&log, "181", 10_000, 10_600)[0], "0000000000000000");
    assert!(status_bytes(&log, 0, 22_000, 34_000).iter().all(|status| *status == 0));
}

#[test]
fn bad_sensor_reports_channel_3_without_an_event() {
    let log = play("bad_sensor", 20_000);
    assert!(status_bytes(&log, 4, 0, 5000).iter().all(|bad| *bad == 0));
    assert!(status_bytes(&log, 4, 5600, 15_000).iter().all(|bad| *bad == 0b100));
    assert!(status_bytes(&log, 4, 15_600, 20_000).iter().all(|bad| *bad == 0));
    assert!(of(&log, "181", 5600, 15_000).iter().all(|data| &data[4..6] == "00"));
}

#[test]
fn power_cycle_is_silent_and_boots() {
    let log = play("power_cycle", 12_000);
    assert_eq!(log.iter().filter(|(at, _)| (5000..10_000).contains(at)).count(), 0);
    assert_eq!(of(&log, "701", 10_000, 10_001), ["00"]);
    assert_eq!(of(&log, "701", 10_001, 10_300), ["05"]);
    assert!(!of(&log, "181", 10_250, 10_400).is_empty());
}

#[test]
fn mute_guarding_answers_no_request_while_tpdos_go_on() {
    let log = play("mute_guarding", 12_000);
    assert!(of(&log, "701", 5000, 10_000).is_empty());
    assert_eq!(of(&log, "181", 5000, 10_000).len(), 10);
    assert!(!of(&log, "701", 10_000, 11_000).is_empty());
}

#[test]
fn mute_pdos_sends_none_then_all_but_tpdo3() {
    let log = play("mute_pdos", 26_000);
    for id in ["181", "281", "381", "481"] {
        assert!(of(&log, id, 5000, 10_000).is_empty());
        assert!(!of(&log, id, 10_000, 20_000).is_empty());
        assert_eq!(of(&log, id, 20_000, 25_000).is_empty(), id == "381");
    }
    assert_eq!(of(&log, "701", 5000, 10_000).len(), 10);
}

#[test]
fn stuck_toggle_repeats_one_bit() {
    let log = play("stuck_toggle", 12_000);
    let stuck = of(&log, "701", 5000, 10_000);
    assert_eq!(stuck.len(), 10);
    assert!(stuck.windows(2).all(|pair| pair[0] == pair[1]));
    let free = of(&log, "701", 10_300, 12_000);
    assert!(free.windows(2).all(|pair| pair[0] != pair[1]));
}

#[test]
fn wrong_length_shortens_tpdo3_then_lengthens_tpdo4() {
    let log = play("wrong_length", 16_000);
    assert!(of(&log, "381", 5000, 8000).iter().all(|data| data.len() == 2));
    assert!(of(&log, "381", 8000, 16_000).iter().all(|data| data.len() == 16));
    assert!(of(&log, "481", 0, 12_000).iter().all(|data| data.len() == 12));
    assert!(of(&log, "481", 12_000, 15_000).iter().all(|data| data.len() == 16));
}

#[test]
fn second_master_stops_and_guards() {
    let log = play("second_master", 12_000);
    assert_eq!(of(&log, "000", 0, 12_000), ["0201"]);
    assert_eq!(of(&log, "701#R", 0, 12_000).len(), 8);
}

#[test]
fn demo_knocks_on_cylinder_7_by_second_8_then_loses_a_sensor_and_trips_within_minutes() {
    let log = play("demo", 150_000);
    assert!(status_bytes(&log, 0, 0, 8000).iter().all(|status| *status == 0));
    assert!(status_bytes(&log, 0, 8000, 12_000).iter().all(|status| *status & 1 != 0));
    assert!(status_bytes(&log, 4, 22_600, 30_000).iter().all(|bad| *bad == 0b100));
    assert!(status_bytes(&log, 0, 68_200, 72_000).iter().all(|status| *status & 1 != 0));
    assert!(status_bytes(&log, 0, 105_000, 105_300).iter().any(|status| *status & 2 != 0));
    let above_the_stop_limit = |data: &&str| u8::from_str_radix(&data[12..14], 16).unwrap() > 204;
    assert!(of(&log, "181", 104_600, 105_000).iter().all(above_the_stop_limit));
}

#[test]
fn the_two_engines_of_the_demo_take_turns() {
    let plans = crate::simulator::demo();
    let mut devices: Vec<_> = plans.iter().map(|plan| plan.power_on(Now::from_millis(0))).collect();
    devices.retain(|device| device.node().get() < 5);
    assert_eq!(devices.iter().map(|device| device.node().get()).collect::<Vec<_>>(), [1, 2]);
    let mut first_knock = [None; 2];
    for millis in (0..60_000).step_by(50) {
        for (device, first) in devices.iter_mut().zip(&mut first_knock) {
            device.handle_timeout(Now::from_millis(millis));
            if device.status().says("knocking") && first.is_none() {
                *first = Some(millis);
            }
        }
    }
    assert_eq!(first_knock, [Some(8000), Some(38_000)]);
}

#[test]
fn a_story_with_all_keys_can_be_read() {
    let text = r#"
description = "all"
[device]
cylinders = 12
initialisation_ms = 200
reply_delay_ms = 5
guard_in_boot = false
event_restarts_period = false
all_nmt_commands = false
big_endian_sensor_fields = true
status_invert_mask = 2
[[step]]
at_ms = 1
do = "knock 12 3"
[[step]]
at_ms = 2
do = "late replies 150"
[[step]]
at_ms = 7
for_ms = 10
every_ms = 100
do = ["set trip 1", "set  analog_output 40"]
[[step]]
at_ms = 8
do = ["clear trip", "clear all"]
"#;
    let scenario = parse("all.toml", text).unwrap();
    let Settings::Detcon(settings) = &scenario.settings else { panic!("{:?}", scenario.settings) };
    assert_eq!(settings.cylinders, 12);
    assert_eq!(settings.initialisation, Duration::from_millis(200));
    assert!(!settings.event_restarts_period && settings.format.big_endian_sensor_fields);
    assert_eq!(settings.format.status_invert_mask, 2);
    let told: Vec<_> =
        scenario.events.iter().map(|event| (event.at.as_millis(), event.order.as_str())).collect();
    assert_eq!(
        told,
        [
            (1, "knock 12 3"),
            (2, "late replies 150"),
            (7, "set trip 1"),
            (7, "set analog_output 40"),
            (17, "clear trip"),
            (17, "clear analog_output"),
            (8, "clear trip"),
            (8, "clear all"),
        ]
    );
}

#[test]
fn every_problem_is_told_at_once_with_line_column_and_hint() {
    let text = "description = \"x\"\nrepeat_ms = 50\n\n[[step]]\nat_ms = 0\ndo = [\"knock 21 on\", \"knock 7 256\"]\n\n\
                [[step]]\nat_ms = 0\nevery_ms = 1000\nfor_ms = 1000\ndo = \"mute guarding on\"\n\n\
                [[step]]\nat_ms = 0\nfor_ms = 5\ndo = \"clear tripp\"\n\n\
                [[step]]\nat_ms = 0\nfor_ms = 5\ndo = \"trip\"\n\n\
                [[step]]\nat_ms = 0\nfor_ms = 0\ndo = \"sensor 17 bad\"\n";
    let error = parse("s.toml", text).unwrap_err().to_string();
    for expected in [
        "s.toml:2:13: error: 50 ms is too short a time to repeat\n  hint: give at least 100",
        "s.toml:6:7: error: `knock 21 on` cannot be ordered\n  hint: `21` is not a channel; give a number from 1 to 20",
        "s.toml:6:22: error: `knock 7 256` cannot be ordered\n  hint: `256` is not a raw intensity",
        "s.toml:11:10: error: the step lasts 1000 ms and comes again after 1000 ms",
        "s.toml:17:6: error: `clear tripp` cannot be ordered\n  hint: there is no value `tripp`",
        "s.toml:21:10: error: `trip` does not last",
        "s.toml:26:10: error: the step is over at the moment when it begins",
        "s.toml:27:6: error: `sensor 17 bad` cannot be ordered\n  hint: the engine has 16 cylinders",
    ] {
        assert!(error.contains(expected), "{expected}\n---\n{error}");
    }
}

#[test]
fn unknown_keys_and_orders_are_refused_where_they_stand() {
    for (text, at) in [
        ("description = \"x\"\nrepet_ms = 1000\n", "s.toml:2:1: error: unknown field `repet_ms`"),
        ("description = \"x\"\n[device]\ncylinder = 3\n", "s.toml:3:1: error: unknown field `cylinder`"),
        (
            "description = \"x\"\n[[step]]\nat_ms = 0\ndo = \"explode\"\n",
            "s.toml:4:6: error: `explode` cannot be ordered",
        ),
        ("description = \"x\"\n[[step]]\ndo = \"trip\"\n", "missing field `at_ms`"),
        ("description = \n", "s.toml:1:"),
        ("", "missing field `description`"),
    ] {
        let error = parse("s.toml", text).unwrap_err().to_string();
        assert!(error.contains(at), "{error}");
    }
}

const MANUAL: &str = include_str!("../../../docs/simulator.md");

#[test]
fn the_example_of_the_manual_can_be_read() {
    let (_, rest) = MANUAL.split_once("```toml\n").unwrap();
    let (example, _) = rest.split_once("```").unwrap();
    let scenario = parse("docs/simulator.md", example).unwrap_or_else(|error| panic!("{error}"));
    assert_eq!(scenario.events.len(), 5);
    assert!(matches!(scenario.settings, Settings::Detcon(settings) if settings.cylinders == 12));
}

#[test]
fn the_manual_names_every_scenario_and_every_order() {
    for (name, _) in SHIPPED {
        assert!(MANUAL.contains(&format!("| `{name}` |")), "{name}");
    }
    for line in Kind::Detcon.help().lines() {
        let words = line.split(' ').take_while(|word| word.chars().all(|c| c.is_ascii_lowercase()));
        let order = words.take(2).filter(|word| !word.is_empty()).collect::<Vec<_>>().join(" ");
        assert!(MANUAL.contains(&format!("`{order}")), "{order}");
    }
}
