//! The gateway against our simulators, over a bus with loss, delay and duplicates, in numbers-time.

use std::time::Duration;

use cangate::canopen::{NmtState, NodeId};
use cangate::process_image::{Quality, Value};
use cangate::simulator::{DevicePlan, Kind, Scenario};

use super::support::world::{Weather, World};

/// `running` and `good` again within this time of a boot-up message, in ms.
const BACK_WITHIN: u64 = 2000;
/// `node_lost` comes at the latest so long after the last valid reply (R-DET-033), in ms.
const LOST_WITHIN: u64 = 1600;

fn is_lost(world: &World) -> bool {
    world.active_alarms().contains(&"node_lost")
}

#[test]
fn cold_start_with_the_device_first() {
    let mut world = World::new(1, 1);
    world.power_on(1, "quiet");
    world.run_for(5000);
    world.start_gateway();
    assert!(!world.is_good(1));
    let took = world.run_until(BACK_WITHIN, |world| world.is_good(1));
    assert!(took < 200, "guarded at once (R-DET-046): {took} ms");
    world.run_for(10_000);
    assert_eq!(world.node(1).nmt, Some(NmtState::Operational));
    assert!(world.is_good(1) && world.node(1).online && world.raised.is_empty());
}

#[test]
fn cold_start_with_the_gateway_first() {
    let mut world = World::new(1, 1);
    world.start_gateway();
    world.run_for(5000);
    assert!(!world.is_good(1) && !world.node(1).online);
    world.power_on(1, "quiet");
    world.run_until(BACK_WITHIN, |world| world.is_good(1));
    world.run_for(10_000);
    assert!(world.is_good(1) && world.active_alarms().is_empty(), "{:?}", world.active_alarms());
}

#[test]
fn a_gateway_that_starts_again_takes_over_a_running_device_without_disturbing_it() {
    let mut world = World::running(1);
    // Between two guard requests: a reply to the old gateway's last one would look to the new one like a repeated toggle bit.
    world.run_for(250);
    world.sent.clear();
    world.start_gateway();
    world.run_until(1000, |world| world.is_good(1));
    world.run_for(5000);
    assert_eq!(world.sent.iter().collect::<Vec<_>>(), ["701#R1"], "no start, no reset");
    assert_eq!(world.node(1).counters.toggle_errors, 0);
}

#[test]
fn power_cycle_is_over_within_two_seconds_of_the_boot_up() {
    for off_ms in [50, 300, 700, 1400, 1700, 5000, 60_000] {
        let mut world = World::running(1);
        world.order("power off");
        world.run_for(off_ms);
        // The last reply came up to 500 ms before.
        assert!(is_lost(&world) || off_ms < LOST_WITHIN, "{off_ms} ms");
        assert!(!is_lost(&world) || off_ms > LOST_WITHIN - 500, "{off_ms} ms");
        world.order("power on");
        world.run_for(20);
        assert!(!world.is_good(1), "{off_ms} ms: old data is not good");
        world.run_until(BACK_WITHIN - 20, |world| world.is_good(1));
        world.run_for(1000);
        assert!(world.is_good(1) && world.node(1).online && !is_lost(&world));
        assert_eq!(world.node(1).nmt, Some(NmtState::Operational));
    }
}

#[test]
fn r_det_033_036_037_muted_guarding_loses_the_node_keeps_its_data_uncertain_and_recovers() {
    for late in [0, 123, 250, 499] {
        // An alarm that comes again and again within a minute would stay.
        let mut world = World::running(1);
        world.run_for(late);
        let before = world.node(1).counters.guard_misses;
        world.order("mute guarding on");
        world.run_until(LOST_WITHIN, is_lost);
        assert_eq!(world.node(1).counters.guard_misses - before, 3);
        assert!(!world.node(1).online);
        world.run_for(1000);
        assert!(matches!(world.qualities(1).as_slice(), [Quality::Uncertain(_)]));
        world.order("mute guarding off");
        world.run_until(1000, |world| !is_lost(world));
        world.run_until(1000, |world| world.is_good(1));
        assert!(world.node(1).online);
    }
}

#[test]
fn a_silent_node_among_others_raises_one_alarm() {
    let mut world = World::running(2);
    world.order("node 2 power off");
    world.run_until(LOST_WITHIN, is_lost);
    world.run_for(10_000);
    assert_eq!(world.active_alarms(), ["node_lost"]);
    assert!(world.is_good(1) && !world.is_good(2));
    assert!(matches!(world.qualities(2).as_slice(), [Quality::Bad(_)]));
}

#[test]
fn one_cause_raises_one_alarm_when_127_nodes_die_at_once() {
    let mut world = World::running(127);
    assert!((1..=127).all(|id| world.is_good(id)));
    assert!(world.raised.is_empty(), "{:?}", world.raised);
    world.order("power off");
    world.run_for(5000);
    assert_eq!(world.active_alarms(), ["bus_silent"]);
    assert_eq!(world.raised.iter().collect::<Vec<_>>(), ["bus_silent"]);
    world.order("power on");
    world.run_for(BACK_WITHIN);
    assert!((1..=127).all(|id| world.is_good(id)));
    world.run_for(1000);
    assert_eq!(world.active_alarms(), [""; 0]);
    assert_eq!(world.raised.iter().collect::<Vec<_>>(), ["bus_silent"], "nor is any raised by their return");
}

#[test]
fn the_story_of_the_demo_is_told_by_values_and_alarms() {
    let mut world = World::new(1, 1);
    world.start_gateway();
    world.power_on(1, "demo");
    world.run_for(7900);
    assert_eq!(world.tag(1, "engine_knocking").value, Value::Bool(false));
    world.run_for(1000);
    assert_eq!(world.tag(1, "engine_knocking").value, Value::Bool(true));
    assert_eq!(world.tag(1, "knock_intensity_max_channel").value, Value::Unsigned(7));
    assert!(world.number(1, "reduction_margin_min") < 0.0);
    world.run_until(3000, |world| world.active_alarms().contains(&"engine_knocking"));
    world.run_until(3000, |world| world.active_alarms().contains(&"load_reduction"));
    world.run_for(10_000);
    assert!(world.active_alarms().is_empty(), "{:?}", world.active_alarms());
    world.run_until(5000, |world| world.active_alarms().contains(&"sensor_fault_3"));
    assert!(!world.tag(1, "channel_valid_3").value.is_true());
    world.run_for(60_000 - world.millis());
    assert_eq!(world.tag(1, "trip_count").value, Value::Unsigned(0));
    world.run_for(110_000 - world.millis());
    assert_eq!(world.tag(1, "trip_count").value, Value::Unsigned(1));
    assert!(world.tag(1, "trip_latched").value.is_true() && !world.tag(1, "trip").value.is_true());
    assert!(world.raised.contains("trip") && world.raised.contains("stop_limit_7"));
    assert_eq!((world.events("node_restarted"), world.node(1).counters.guard_misses), (0, 0));
}

#[test]
fn a_trip_pulse_of_100_ms_is_never_missed_whatever_its_phase() {
    let mut world = World::running(1);
    for pulse in 1..=50 {
        world.order("trip 100");
        world.run_for(20_037 + 7 * pulse);
        assert_eq!(world.tag(1, "trip_count").value, Value::Unsigned(pulse));
    }
}

/// Runs a shipped scenario at node 1 beside a healthy node 2.
fn world_with(scenario: &str, seconds: u64) -> World {
    let mut world = World::new(2, 1);
    world.start_gateway();
    world.power_on(1, scenario);
    world.power_on(2, "quiet");
    world.run_for(1000 * seconds);
    assert!(world.is_good(2), "the other node is not concerned");
    world
}

#[test]
fn each_fault_raises_its_alarm_and_no_other() {
    for (scenario, seconds, expected) in [
        ("quiet", 30, &[][..]),
        ("knock_cylinder_7", 15, &["engine_knocking", "load_reduction"]),
        ("trip", 8, &["trip"]),
        ("bad_sensor", 16, &["sensor_fault_3"]),
        ("power_cycle", 9, &["node_lost"]),
        ("mute_guarding", 9, &["node_lost"]),
        ("mute_pdos", 12, &["pdo_timeout_1", "pdo_timeout_2", "pdo_timeout_3", "pdo_timeout_4"]),
        ("stuck_toggle", 9, &["node_lost"]),
        ("wrong_length", 18, &["pdo_length", "pdo_timeout_3"]),
        // Two masters that guard in turns both see wrong toggle bits: the cause is told, not the consequence.
        ("second_master", 9, &["foreign_guard_master", "foreign_master"]),
    ] {
        let world = world_with(scenario, seconds);
        assert_eq!(world.raised.iter().collect::<Vec<_>>(), expected, "{scenario}");
    }
}

#[test]
fn each_fault_is_over_when_its_cause_is() {
    // What is active still is held on purpose: by its off-delay, or by its latch.
    for (scenario, held) in [
        ("power_cycle", &[][..]),
        ("mute_guarding", &[]),
        ("mute_pdos", &[]),
        ("stuck_toggle", &[]),
        ("wrong_length", &["pdo_length"]),
        ("second_master", &["foreign_master", "foreign_guard_master"]),
    ] {
        let world = world_with(scenario, 19);
        assert!(world.is_good(1), "{scenario}: {:?}", world.qualities(1));
        assert!(world.node(1).online, "{scenario}");
        assert_eq!(world.active_alarms(), held, "{scenario}");
    }
}

#[test]
fn r_det_080_a_short_tpdo_changes_nothing_and_is_counted() {
    let mut world = World::running(1);
    world.order("wrong length 3 1");
    world.order("knock 7 on");
    world.run_for(1000);
    assert_eq!(world.tag(1, "engine_knocking").value, Value::Bool(false));
    assert!(world.node(1).counters.pdo_length_errors >= 3);
}

#[test]
fn r_det_052_reserved_bits_are_counted_and_change_nothing() {
    let mut world = World::running(1);
    world.order("reserved bits on");
    world.run_for(2000);
    assert!(world.is_good(1) && world.node(1).counters.reserved_bits > 0);
    assert_eq!(world.tag(1, "status_bits").value, Value::Unsigned(0));
    assert!(world.raised.is_empty());
}

#[test]
fn r_det_020_a_node_that_refuses_to_start_is_reported_and_started_as_soon_as_it_can_be() {
    let mut world = World::new(1, 1);
    world.start_gateway();
    world.power_on(1, "quiet");
    world.order("refuse start on");
    world.run_until(10_000, |world| world.active_alarms().contains(&"node_start_failed"));
    world.order("refuse start off");
    world.run_until(3000, |world| world.is_good(1));
    world.run_until(10_000, |world| world.active_alarms().is_empty());
}

#[test]
fn r_det_033_late_replies_are_missed_and_replies_in_time_are_not() {
    let mut world = World::running(1);
    world.order("late replies 90");
    world.run_for(10_000);
    assert_eq!(world.node(1).counters.guard_misses, 0);
    world.order("late replies 150");
    world.run_for(10_000);
    assert!(world.node(1).counters.guard_misses > 0);
    world.order("late replies off");
    world.run_for(3000);
    assert!(world.is_good(1) && !is_lost(&world));
}

#[test]
fn a_second_device_with_the_same_node_id_is_suspected() {
    let mut world = World::running(1);
    world.power_on(1, "quiet");
    world.run_until(15_000, |world| world.active_alarms().contains(&"duplicate_node"));
}

#[test]
fn f14_a_device_that_restarts_again_and_again_is_left_in_peace_and_started_when_it_is_calm() {
    let mut world = World::running(1);
    world.order("boot loop 1000");
    world.run_for(20_500);
    assert!((19..=21).contains(&world.node(1).counters.restarts), "{}", world.node(1).counters.restarts);
    world.order("boot loop off");
    assert!(world.active_alarms().contains(&"node_start_failed"), "{:?}", world.active_alarms());
    world.run_until(30_000 + BACK_WITHIN, |world| world.is_good(1));
    assert!(!world.active_alarms().contains(&"node_start_failed"));
    world.run_for(40_000);
    assert!(world.is_good(1));
}

#[test]
fn bad_weather_costs_no_more_than_what_it_breaks() {
    for seed in 0..10 {
        let mut world = World::new(3, seed);
        world.weather = Weather { lost: 100, doubled: 50, longest_delay: Duration::from_millis(30) };
        world.start_gateway();
        for id in 1..=3 {
            world.power_on(id, "demo");
        }
        world.run_for(30_000);
        world.order("power off");
        world.run_for(1000);
        world.order("power on");
        world.run_for(20_000);
        world.weather = Weather::default();
        // Frames that come twice look like a second device, until that has not been seen for 30 s.
        world.run_for(33_000);
        for id in 1..=3 {
            let node = world.node(id);
            assert!(node.online && world.is_good(id), "seed {seed}: {node:?} {:?}", world.qualities(id));
            assert_eq!(node.nmt, Some(NmtState::Operational), "seed {seed}: {node:?}");
        }
    }
}

#[test]
fn whatever_happens_the_gateway_sends_nothing_but_guard_requests_and_starts() {
    let mut world = World::new(2, 7);
    world.weather = Weather { lost: 50, doubled: 20, longest_delay: Duration::from_millis(5) };
    world.start_gateway();
    world.power_on(1, "demo");
    world.power_on(2, "second_master");
    for order in
        ["power off", "power on", "stuck toggle on", "wrong length 4 3", "boot loop 700", "clear all"]
    {
        world.order(order);
        world.run_for(7000);
    }
    assert_eq!(world.sent.iter().collect::<Vec<_>>(), ["000#0101", "000#0102", "701#R1", "702#R1"]);
}

#[test]
fn a_device_of_another_kind_on_the_same_bus_disturbs_nobody() {
    let mut world = World::running(1);
    let scenario = Scenario::shipped(Kind::DstP92c, "demo").unwrap();
    world.connect(&DevicePlan::new(NodeId::new(5).unwrap(), scenario));
    world.order("node 5 set 1017 0 500");
    world.run_for(60_000);
    assert!(world.is_good(1) && world.raised.is_empty(), "{:?}", world.raised);
    assert_eq!(world.sent.iter().collect::<Vec<_>>(), ["000#0101", "701#R1"]);
}
