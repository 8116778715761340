//! Cables that break and are mended: one alarm over the whole of it, and nothing live that is not.

use cangate::can::Link;
use cangate::mapping::At;
use cangate::mapping::installation::{NodeEntry, ToggleWord};

use super::{QUIET, detcon, detcon_with, running, table};
use crate::support::conversation::Conversation;

/// Lets an engine be well from now on: it answers guarding and sends its TPDOs every 500 ms.
fn plug_in(conversation: &mut Conversation, node: u8) {
    conversation.answer_guarding(node, 5);
    for frame in QUIET {
        let (id, data) = frame.split_once('#').unwrap();
        let id = u16::from_str_radix(id, 16).unwrap() + u16::from(node) - 1;
        conversation.send_cyclically(&format!("{id:03X}#{data}"), 500);
    }
}

fn unplug_all(conversation: &mut Conversation) {
    for node in 1..=3 {
        conversation.stop_answering(node);
    }
    conversation.stop_sending("");
}

fn unplug(conversation: &mut Conversation, node: u8) {
    conversation.stop_answering(node);
    for base in [0x180, 0x280, 0x380, 0x480_u16] {
        conversation.stop_sending(&format!("{:03X}#", base + u16::from(node)));
    }
}

/// Three engines, of which the first so many are there. Time: 3000 ms.
fn engines(there: u8, change: impl Fn(&mut NodeEntry)) -> Conversation {
    let nodes = [("engine1", 1), ("engine2", 2), ("engine3", 3)];
    let mut conversation = Conversation::new(table(&nodes, |_, node| change(node)));
    for node in 1..=there {
        plug_in(&mut conversation, node);
    }
    conversation.run_to(3_000);
    conversation
}

#[test]
fn p20_a_cable_cut_and_mended_is_one_alarm_whenever_that_happens() {
    for cut in (3_000..3_500).step_by(50) {
        for away in [2_000, 10_000, 10_250] {
            let mut conversation = engines(3, |_| ());
            conversation.run_to(cut);
            unplug_all(&mut conversation);
            conversation.run_to(cut + away);
            for node in [2, 3, 1] {
                plug_in(&mut conversation, node);
                conversation.run_to(conversation.now_millis() + 300);
            }
            conversation.run_to(cut + away + 30_000);
            assert_eq!(conversation.raised(), ["bus_silent"], "cut at {cut} ms for {away} ms");
            assert_eq!(conversation.active(), [""; 0]);
            assert_eq!(conversation.tag_text("knock_intensity_1"), "0.00 good");
        }
    }
}

#[test]
fn p20_a_node_that_does_not_come_back_with_the_others_is_told_soon_after() {
    let mut conversation = engines(3, |_| ());
    unplug_all(&mut conversation);
    conversation.run_to(20_000);
    plug_in(&mut conversation, 1);
    plug_in(&mut conversation, 3);
    conversation.run_to(21_400);
    assert_eq!(conversation.raised(), ["bus_silent"], "it may come back yet");
    conversation.run_to(22_000);
    assert_eq!(conversation.raised(), ["bus_silent", "node_lost"]);
    assert!(conversation.alarm_of(1, "node_lost").state.is_active());
}

#[test]
fn p20_a_bus_that_is_plugged_in_late_is_one_alarm() {
    let mut conversation = engines(0, |_| ());
    conversation.run_to(20_000);
    assert_eq!(conversation.raised(), ["bus_silent"]);
    for node in [3, 1, 2] {
        plug_in(&mut conversation, node);
        conversation.run_to(conversation.now_millis() + 300);
    }
    conversation.run_to(50_000);
    assert_eq!(conversation.raised(), ["bus_silent"]);
    assert_eq!(conversation.active(), [""; 0]);
}

#[test]
fn p20_after_a_plugged_in_bus_the_node_that_is_still_missing_is_told() {
    let mut conversation = engines(0, |_| ());
    conversation.run_to(20_000);
    plug_in(&mut conversation, 1);
    plug_in(&mut conversation, 2);
    conversation.run_to(30_000);
    assert_eq!(conversation.raised(), ["bus_silent", "node_never_seen"]);
    assert!(conversation.alarm_of(2, "node_never_seen").state.is_active());
}

#[test]
fn one_node_unplugged_and_plugged_in_again_is_one_alarm_whenever_that_happens() {
    for off in (1_000..1_500).step_by(20) {
        let mut conversation = running(detcon());
        conversation.run_to(off);
        unplug(&mut conversation, 1);
        conversation.run_to(off + 5_000);
        conversation.answer_guarding(1, 5);
        conversation.run_to(off + 5_600);
        plug_in(&mut conversation, 1);
        conversation.run_to(off + 20_000);
        assert_eq!(conversation.raised(), ["node_lost"], "unplugged at {off} ms");
        assert_eq!(conversation.active(), [""; 0]);
    }
}

#[test]
fn an_interface_that_comes_back_does_not_raise_again_what_its_nodes_had_before() {
    let mut conversation = engines(2, |_| ());
    conversation.run_to(10_000);
    assert_eq!(conversation.raised(), ["node_never_seen"]);
    unplug(&mut conversation, 2);
    conversation.run_to(15_000);
    assert_eq!(conversation.raised(), ["node_never_seen", "node_lost"]);
    conversation.link(Link::Down);
    unplug_all(&mut conversation);
    conversation.run_to(20_000);
    conversation.link(Link::ErrorActive);
    for node in 1..=3 {
        plug_in(&mut conversation, node);
    }
    conversation.run_to(40_000);
    assert_eq!(conversation.raised(), ["node_never_seen", "node_lost", "interface_down"]);
}

#[test]
fn r_det_082_a_node_that_misses_every_other_guard_request_cannot_hide_a_missing_tpdo() {
    let mut conversation = running(detcon_with(|_, node| node.toggle_check = Some(ToggleWord::Off)));
    conversation.stop_sending("281");
    for step in 2..20 {
        if step % 2 == 0 {
            conversation.stop_answering(1);
        } else {
            conversation.answer_guarding(1, 5);
        }
        conversation.run_to(500 * step + 250);
    }
    assert_eq!(conversation.raised(), ["pdo_timeout_2"]);
}

#[test]
fn a_node_that_nobody_guards_is_online_only_while_something_comes() {
    let mut conversation = running(detcon_with(|_, node| node.guard_time_ms = Some(At::nowhere(0))));
    assert!(conversation.node().online);
    conversation.stop_sending("381");
    conversation.run_to(5_000);
    assert!(conversation.node().online, "three TPDOs come still");
    unplug(&mut conversation, 1);
    conversation.run_to(6_400);
    assert!(conversation.node().online);
    conversation.run_to(6_600);
    assert!(!conversation.node().online);
    assert_eq!(conversation.node().nmt, None);
    assert!(conversation.node().reason.contains("nothing comes"), "{}", conversation.node().reason);
    conversation.frame(QUIET[0]);
    assert!(conversation.node().online);
}

#[test]
fn a_frame_that_is_handed_over_after_the_bus_went_down_is_no_sign_of_life() {
    for link in [Link::Down, Link::BusOff] {
        let mut conversation = running(detcon());
        conversation.link(link);
        conversation.frame("181#FF00000000000000");
        assert_eq!(conversation.tag_text("knock_intensity_1"), "100.00 uncertain (bus_unavailable)");
        assert!(!conversation.node().online);
        conversation.link(Link::ErrorActive);
        assert!(!conversation.node().online, "nothing came since");
        assert!(conversation.node().reason.contains("its next frame"), "{}", conversation.node().reason);
        conversation.frame("181#FF00000000000000");
        assert_eq!(conversation.tag_text("knock_intensity_1"), "100.00 good");
        assert!(conversation.node().online);
    }
}

#[test]
fn one_node_lost_beside_one_that_speaks_seldom_is_no_silent_bus() {
    let nodes = [("engine1", 1), ("engine2", 2)];
    let slow = |node: &mut NodeEntry| {
        if node.id.value == 2 {
            node.guard_time_ms = Some(At::nowhere(20_000));
            node.pdo_timeout_ms = Some(At::nowhere(0));
        }
    };
    let mut conversation = Conversation::new(table(&nodes, |_, node| slow(node)));
    plug_in(&mut conversation, 1);
    conversation.answer_guarding(2, 5);
    conversation.run_to(3_000);
    unplug(&mut conversation, 1);
    conversation.run_to(15_000);
    assert_eq!(conversation.raised(), ["node_lost"]);
}

#[test]
fn the_last_node_that_falls_silent_is_that_nodes_alarm() {
    let mut conversation = engines(2, |_| ());
    conversation.run_to(10_000);
    assert_eq!(conversation.raised(), ["node_never_seen"]);
    unplug(&mut conversation, 1);
    conversation.run_to(20_000);
    unplug(&mut conversation, 2);
    conversation.run_to(30_000);
    assert_eq!(conversation.raised(), ["node_never_seen", "node_lost", "node_lost"]);
}
