//! Changes of node id and bit rate, with what the caller does in between and the way back.

use std::time::Duration;

use super::*;
use crate::canopen::NodeId;

fn node(id: u8) -> NodeId {
    NodeId::new(id).unwrap()
}

/// The example of the manual: node 1 becomes node 5 at 250 kbit/s.
fn example() -> LssChange {
    LssChange {
        target: LssTarget::OnlySlave { confirmed: true },
        node: Some(node(1)),
        stop_all: true,
        node_id: Some(node(5)),
        bit_rate: LssBitRate::from_kbit(250),
        activation: LssActivation::Now { delay: Duration::from_millis(100) },
    }
}

/// A change of the node id alone, of the slave with that address.
fn by_address() -> LssChange {
    LssChange { target: LssTarget::Address(DST), stop_all: false, bit_rate: None, ..example() }
}

fn script(change: LssChange) -> (Script, Vec<String>) {
    let mut script = Script::new(LssSettings::default());
    let begun = script.begin(LssJob::Change(change));
    (script, begun)
}

const CHANGED: &str = "Changed { active: true, restored: true }";

#[test]
fn r_dst_092_r_dst_113_the_example_of_the_manual_frame_by_frame() {
    let (mut script, begun) = script(example());
    assert_eq!(begun, ["ReadHeartbeat(node 1)"]);
    assert_eq!(script.performed(Performed::Value(1000)), ["WriteHeartbeat(node 1, 0)"]);
    assert_eq!(script.performed(Performed::Yes), ["Nmt(None, Stop)"], "step 1");
    assert_eq!(
        script.performed(Performed::Yes),
        ["7E5#0401000000000000", "7E5#1105000000000000"],
        "steps 2 and 3"
    );
    assert_eq!(script.answer("7E4#1100000000000000"), ["7E5#1300030000000000"], "step 4");
    assert_eq!(script.answer("7E4#1300000000000000"), ["7E5#1700000000000000"], "step 5");
    assert_eq!(
        script.answer("7E4#1700000000000000"),
        ["7E5#1564000000000000", "ChangeInterface(250 kbit/s)"],
        "step 6"
    );
    // Our interface goes down and up again meanwhile.
    script.master.pause();
    assert!(script.outputs().is_empty());
    script.master.resume();
    assert_eq!(script.performed(Performed::Yes), ["AwaitBootUp(node 1, 2.2s)"]);
    assert_eq!(
        script.performed(Performed::Yes),
        ["7E5#0400000000000000", "AwaitBootUp(node 5, 2s)"],
        "step 7"
    );
    assert_eq!(script.performed(Performed::Yes), ["RestoreStates"]);
    assert_eq!(script.performed(Performed::Yes), ["WriteHeartbeat(node 5, 1000)"]);
    assert_eq!(script.performed(Performed::Yes), [CHANGED]);
    assert!(script.master.is_idle());
}

#[test]
fn r_dst_114_a_power_cycle_replaces_the_activation() {
    let (mut script, _) = script(LssChange { activation: LssActivation::PowerCycle, ..example() });
    script.performed(Performed::Value(0));
    script.performed(Performed::Yes);
    script.answer("7E4#1100000000000000");
    script.answer("7E4#1300000000000000");
    assert_eq!(script.answer("7E4#1700000000000000"), ["RestoreStates"]);
    assert_eq!(script.performed(Performed::Yes), ["Changed { active: false, restored: true }"]);
}

#[test]
fn r_dst_098_r_dst_111_a_slave_is_chosen_by_its_address_and_checked_at_its_new_node_id() {
    let (mut script, begun) = script(by_address());
    assert_eq!(begun, ["ReadHeartbeat(node 1)"]);
    assert_eq!(
        script.performed(Performed::Value(0)),
        ["Nmt(Some(node 1), Stop)"],
        "no heartbeat to turn off"
    );
    assert_eq!(
        script.performed(Performed::Yes),
        [
            "7E5#0400000000000000",
            "7E5#403D020000000000",
            "7E5#4178563412000000",
            "7E5#4203020100000000",
            "7E5#4340E20100000000"
        ]
    );
    assert_eq!(script.answer("7E4#4400000000000000"), ["7E5#1105000000000000"]);
    assert_eq!(script.answer("7E4#1100000000000000"), ["7E5#1700000000000000"]);
    assert_eq!(
        script.answer("7E4#1700000000000000"),
        ["7E5#0400000000000000", "AwaitBootUp(node 5, 2s)"],
        "no bit rate to activate"
    );
    let check = script.performed(Performed::Yes);
    assert_eq!(check, [format!("CheckIdentity(node 5, {DST:?})")]);
    assert_eq!(script.performed(Performed::Yes), ["RestoreStates"]);
    assert_eq!(script.performed(Performed::Yes), [CHANGED]);
}

#[test]
fn r_dst_111_without_address_or_confirmation_nothing_is_sent() {
    let mut master = LssMaster::new(LssSettings::default());
    let target = LssTarget::OnlySlave { confirmed: false };
    let refused = master.request(at(0), LssJob::Change(LssChange { target, ..example() }));
    assert_eq!(refused, Err(LssError::NotConfirmed));
    assert_eq!(master.poll_output(), None);
    let nothing = LssChange { node_id: None, bit_rate: None, ..example() };
    assert!(matches!(master.request(at(0), LssJob::Change(nothing)), Err(LssError::Nonsense(_))));
}

/// A script that waits for the answer to `store`, with a heartbeat of 500 ms to restore.
fn storing(change: LssChange) -> Script {
    let (mut script, _) = script(change);
    script.performed(Performed::Value(500));
    script.performed(Performed::Yes);
    script.performed(Performed::Yes);
    script.answer("7E4#4400000000000000");
    assert_eq!(script.answer("7E4#1100000000000000"), ["7E5#1700000000000000"]);
    script
}

#[test]
fn r_dst_110_a_store_that_is_not_answered_or_refused_leads_back() {
    for refused in [true, false] {
        let mut script = storing(by_address());
        let back = if refused { script.answer("7E4#17FF010000000000") } else { script.silence() };
        assert_eq!(back, ["7E5#0400000000000000", "RestoreStates"], "store is not repeated");
        assert_eq!(script.performed(Performed::Yes), ["WriteHeartbeat(node 1, 500)"]);
        let done = script.performed(Performed::Failed("no answer".to_owned()));
        assert_eq!(done.len(), 1);
        let expected = if refused { "Refused { service: \"store\"" } else { "NoAnswer { service: \"store\"" };
        assert!(done[0].starts_with(expected), "the first failure is told: {done:?}");
    }
}

#[test]
fn a_slave_that_is_not_there_leads_back() {
    let (mut script, _) = script(by_address());
    script.performed(Performed::Value(0));
    script.performed(Performed::Yes);
    assert_eq!(script.silence(), ["7E5#0400000000000000", "RestoreStates"]);
    assert_eq!(
        script.performed(Performed::Yes),
        ["NoAnswer { service: \"switch selective\", after: 200ms }"]
    );
}

#[test]
fn a_device_that_does_not_boot_by_itself_is_reset_and_else_told_of() {
    let mut script = storing(by_address());
    script.answer("7E4#1700000000000000");
    assert_eq!(script.performed(Performed::No), ["Nmt(Some(node 1), ResetCommunication)"]);
    assert_eq!(script.performed(Performed::Yes), ["AwaitBootUp(node 5, 5s)"]);
    assert_eq!(script.performed(Performed::No), ["RestoreStates"]);
    assert_eq!(script.performed(Performed::Yes), ["WriteHeartbeat(node 1, 500)"]);
    assert!(script.performed(Performed::Yes)[0].starts_with("NotActive"));
}

#[test]
fn another_device_at_the_new_node_id_is_told_of() {
    let mut script = storing(by_address());
    script.answer("7E4#1700000000000000");
    assert!(script.performed(Performed::Yes)[0].starts_with("CheckIdentity"));
    assert_eq!(script.performed(Performed::No), ["RestoreStates"]);
    script.performed(Performed::Yes);
    let done = script.performed(Performed::Yes);
    assert_eq!(done, ["NotActive(\"another device answers at its node id\")"]);
}

#[test]
fn without_a_present_node_id_all_nodes_are_stopped_and_the_change_is_waited_out() {
    let change = LssChange { node: None, stop_all: false, ..example() };
    let (mut script, begun) = script(change);
    assert_eq!(begun, ["Nmt(None, Stop)"]);
    script.performed(Performed::Yes);
    script.answer("7E4#1100000000000000");
    script.answer("7E4#1300000000000000");
    script.answer("7E4#1700000000000000");
    let before = script.now;
    assert_eq!(
        script.performed(Performed::Yes),
        ["7E5#0400000000000000", "AwaitBootUp(node 5, 2s)"],
        "the interface was changed"
    );
    assert!(script.now.since(before) >= Duration::from_millis(200), "two delays have passed");
}

#[test]
fn what_the_caller_cannot_do_ends_the_change_before_anything_is_sent() {
    let (mut script, _) = script(by_address());
    let done = script.performed(Performed::Failed("SDO time-out".to_owned()));
    assert_eq!(done, ["Duty { what: \"reading the heartbeat time 0x1017\", reason: \"SDO time-out\" }"]);
    let error = LssError::Duty { what: "an NMT request", reason: "the role forbids it".to_owned() };
    assert_eq!(error.to_string(), "an NMT request failed: the role forbids it");
}

#[test]
fn a_change_that_is_cancelled_goes_back_first() {
    let mut script = storing(by_address());
    script.master.cancel(script.now);
    assert_eq!(script.outputs(), ["7E5#0400000000000000", "RestoreStates"]);
    script.performed(Performed::Yes);
    assert_eq!(script.performed(Performed::Yes), ["Cancelled"]);
}

#[test]
fn a_heartbeat_that_cannot_be_restored_does_not_hide_that_the_change_succeeded() {
    let mut script = storing(LssChange { target: LssTarget::OnlySlave { confirmed: true }, ..by_address() });
    script.answer("7E4#1700000000000000");
    assert_eq!(script.performed(Performed::Yes), ["RestoreStates"]);
    script.performed(Performed::Yes);
    let done = script.performed(Performed::Failed("aborted".to_owned()));
    assert_eq!(done, ["Changed { active: true, restored: false }"]);
}
