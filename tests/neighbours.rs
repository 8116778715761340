//! The gateway beside others: two devices with one node id, seen while it runs, and healthy devices that never look so.

use std::sync::Arc;

use cangate::canopen::NodeId;
use cangate::mapping::{Sketch, TagTable};
use cangate::process_image::{Quality, Reason};
use cangate::simulator::{DevicePlan, Kind, Scenario};

use super::support::world::World;

/// A `DetCon` at node 1 and a transmitter at node 2.
fn plant() -> Arc<TagTable> {
    let sketch = Sketch::new().node("node001", 1, "motortech-detcon", |_| ());
    Arc::new(sketch.node("node002", 2, "danfoss-dst-p92c", |_| ()).build().unwrap().0)
}

fn transmitter(node: u8, scenario: &str) -> DevicePlan {
    DevicePlan::new(NodeId::new(node).unwrap(), Scenario::shipped(Kind::DstP92c, scenario).unwrap())
}

/// Both devices are there; the gateway has run for 5 s.
fn running() -> World {
    let mut world = World::with(plant(), 1);
    world.start_gateway();
    world.power_on(1, "quiet");
    world.connect(&transmitter(2, "quiet"));
    world.run_for(5000);
    assert!(world.is_good(1) && world.is_good(2));
    world
}

fn is_suspected(world: &World) -> bool {
    world.active_alarms().contains(&"duplicate_node")
}

#[test]
fn p22_a_transmitter_with_the_node_id_of_a_detcon_is_told_and_the_values_stay_those_of_the_detcon() {
    let mut world = running();
    // As delivered, but one that sends by itself.
    let mut plan = transmitter(1, "demo");
    plan.story_after = std::time::Duration::from_secs(3600);
    world.connect(&plan);
    world.run_until(5000, is_suspected);
    world.say("000#0100");
    world.run_for(60_000);
    assert!(world.node(1).reason.contains("two devices seem to share node id 1"), "{}", world.node(1).reason);
    assert_eq!(world.tag(1, "knock_intensity_1").quality, Quality::Good, "TPDO1 is told apart by its length");
    assert!(world.number(1, "knock_intensity_1") < 50.0);
    let other = world.tag(1, "knock_intensity_9").quality;
    assert_eq!(
        other,
        Quality::Uncertain(Reason::DuplicateNode),
        "whether the other sends TPDO2 is not known"
    );
    assert_eq!(world.tag(2, "pressure").quality, Quality::Good, "the other node is not concerned");
}

#[test]
fn p22_a_detcon_with_the_node_id_of_a_transmitter_is_told_and_nothing_is_silently_mixed() {
    let mut world = running();
    world.power_on(2, "quiet");
    // The gateway does not start it, as the transmitter runs.
    world.run_for(5000);
    world.say("000#0100");
    world.run_until(5000, is_suspected);
    // Both send 8 bytes: in the long run only its other TPDOs give it away, of which the transmitter says that it has none.
    world.run_for(60_000);
    assert!(world.node(2).reason.contains("this device does not have"), "{}", world.node(2).reason);
    assert_eq!(world.tag(2, "pressure").quality, Quality::Uncertain(Reason::DuplicateNode));
    assert!(world.is_good(1), "the other node is not concerned");
}

#[test]
fn p22_a_detcon_and_a_transmitter_that_share_a_node_id_before_the_gateway_starts_are_told_whichever_is_meant()
{
    for node in [1, 2] {
        for detcon_first in [true, false] {
            let mut world = World::with(plant(), 1);
            // Beside a DetCon a transmitter is seen only if it sends by itself: as delivered it waits for SYNC, without a
            // heartbeat.
            let mut plan = transmitter(node, if node == 1 { "demo" } else { "quiet" });
            plan.story_after = std::time::Duration::from_secs(3600);
            if detcon_first {
                world.power_on(node, "quiet");
                world.connect(&plan);
            } else {
                world.connect(&plan);
                world.power_on(node, "quiet");
            }
            // Nobody listens to their boot-up messages.
            world.run_for(5000);
            world.start_gateway();
            world.run_until(10_000, is_suspected);
            world.run_for(60_000);
            let reason = &world.node(node).reason;
            let shared = format!("two devices seem to share node id {node}");
            assert!(reason.contains(&shared), "node {node}, DetCon first: {detcon_first}: {reason}");
            let tag = if node == 1 { "knock_intensity_9" } else { "pressure" };
            assert_eq!(
                world.tag(node, tag).quality,
                Quality::Uncertain(Reason::DuplicateNode),
                "node {node}, DetCon first: {detcon_first}"
            );
        }
    }
}

#[test]
fn p22_two_transmitters_with_one_node_id_are_told_within_five_seconds_and_their_values_are_uncertain() {
    let mut world = running();
    let mut plan = transmitter(2, "quiet");
    plan.seed = 99;
    world.connect(&plan);
    world.run_until(5000, is_suspected);
    world.run_for(2000);
    for tag in ["pressure", "temperature", "pressure_status"] {
        assert_eq!(world.tag(2, tag).quality, Quality::Uncertain(Reason::DuplicateNode), "{tag}");
    }
    assert!(world.is_good(1), "the other node is not concerned");
}

#[test]
fn p22_two_detcons_with_one_node_id_are_told_within_five_seconds_and_their_values_are_uncertain() {
    let mut world = running();
    world.power_on(1, "knock_cylinder_7");
    world.run_until(5000, is_suspected);
    // Only one of them was started, and they answer guard requests by turns.
    let mut seen = Vec::new();
    for _ in 0..100 {
        world.run_for(300);
        let now = world.qualities(1);
        assert!(!now.contains(&Quality::Good), "at {} ms", world.millis());
        seen.extend(now);
    }
    assert!(seen.contains(&Quality::Uncertain(Reason::DuplicateNode)), "{seen:?}");
}

#[test]
fn a_healthy_detcon_never_looks_like_two() {
    for (scenario, _) in Kind::Detcon.shipped() {
        let mut world = World::with(plant(), 7);
        world.start_gateway();
        world.power_on(1, scenario);
        world.run_for(150_000);
        world.start_gateway();
        world.run_for(30_000);
        assert_eq!(world.events("duplicate_node"), 0, "{scenario}");
    }
}

#[test]
fn a_healthy_transmitter_never_looks_like_two() {
    for (scenario, _) in Kind::DstP92c.shipped() {
        let mut world = World::with(plant(), 7);
        world.start_gateway();
        world.connect(&transmitter(2, scenario));
        world.run_for(150_000);
        world.start_gateway();
        world.run_for(30_000);
        assert_eq!(world.events("duplicate_node"), 0, "{scenario}");
    }
}

#[test]
fn a_transmitter_that_reboots_in_any_rhythm_never_looks_like_two_also_where_it_starts_by_itself() {
    for self_starting in [false, true] {
        let mut world = running();
        if self_starting {
            world.order("node 2 set 1F80 0 8");
        }
        for pause in (50..5000).step_by(317) {
            world.order("node 2 power cycle");
            world.run_for(pause);
        }
        world.run_for(30_000);
        assert_eq!(world.events("duplicate_node"), 0, "starts by itself: {self_starting}");
    }
}
