//! Two devices with one node id: what gives them away, and what does not.

use std::time::Duration;

use super::bench::{Bench, detcon, master, mute, passive, running, running_with};
use crate::canopen::boot::BootSettings;
use crate::canopen::object::ObjectId;
use crate::canopen::sdo::{SdoRequest, SdoSettings, TransferId};
use crate::canopen::{ErrorControl, NmtRequest, NodeId, NodeSettings};
use crate::time::Now;

const TOLD: &str = "Duplicate";

/// A transmitter: one TPDO of 5 bytes, heartbeat every 500 ms, SDO.
fn transmitter() -> NodeSettings {
    let mut settings = detcon(1);
    settings.pdos.truncate(1);
    settings.pdos[0].length = 5;
    settings.pdos[0].shortest_period = None;
    NodeSettings {
        error_control: ErrorControl::Heartbeat { timeout: Duration::from_secs(600) },
        sdo: Some(SdoSettings::default()),
        ..settings
    }
}

/// A transmitter that was found operational at time 0.
fn sending() -> Bench {
    let mut bench = Bench::new(master(vec![transmitter()]));
    bench.frame(0, "701#05").take();
    bench
}

#[test]
fn lengths_that_take_turns_tell_two_devices_apart_and_only_the_right_length_counts() {
    let mut bench = sending();
    for turn in 0..4 {
        bench.frame(500 * turn + 100, "181#1000000000").frame(500 * turn + 300, "181#2020202020202020");
    }
    assert_eq!(
        bench.take(),
        [
            "100 Pdo { pdo: PdoIndex(0), data: [16, 0, 0, 0, 0, 0, 0, 0], length: 5 }",
            // A longer frame alone is one with padding (R-DET-081).
            "300 PdoLength { pdo: PdoIndex(0), received: 8, discarded: false }",
            "300 Pdo { pdo: PdoIndex(0), data: [32, 32, 32, 32, 32, 32, 32, 32], length: 8 }",
            "600 Pdo { pdo: PdoIndex(0), data: [16, 0, 0, 0, 0, 0, 0, 0], length: 5 }",
            "800 DuplicateSuspected { evidence: \"one TPDO comes with two lengths by turns\" }",
            "800 DuplicateToldApart { pdo: PdoIndex(0) }",
            "800 PdoLength { pdo: PdoIndex(0), received: 8, discarded: true }",
            "1100 Pdo { pdo: PdoIndex(0), data: [16, 0, 0, 0, 0, 0, 0, 0], length: 5 }",
            "1300 PdoLength { pdo: PdoIndex(0), received: 8, discarded: true }",
            "1600 Pdo { pdo: PdoIndex(0), data: [16, 0, 0, 0, 0, 0, 0, 0], length: 5 }",
            "1800 PdoLength { pdo: PdoIndex(0), received: 8, discarded: true }",
        ]
    );
    bench.run(60_000);
    assert_eq!(bench.take_those_with(TOLD), ["31800 DuplicateCleared"], "30 s after the last");
}

#[test]
fn a_length_that_changes_once_or_with_a_boot_is_a_device_that_was_set_anew() {
    let mut bench = sending();
    bench.frame(100, "181#0000000000").frame(200, "181#0000000000000000");
    for boot in 1..10 {
        bench.frame(3000 * boot, "701#00");
        bench.frame(3000 * boot + 1500, "181#0000000000").frame(3000 * boot + 1600, "181#0000000000000000");
    }
    assert_eq!(bench.take_those_with(TOLD), Vec::<String>::new());
}

#[test]
fn heartbeats_beside_the_replies_of_a_guarded_node_are_another_device() {
    let mut bench = running_with(mute());
    for request in 1..=5 {
        let byte = if request % 2 == 1 { "85" } else { "05" };
        bench.run(500 * request).frame(500 * request + 1, &format!("701#{byte}"));
        bench.frame(500 * request + 300, "701#05");
    }
    assert_eq!(
        bench.take_those_with(TOLD),
        ["2501 DuplicateSuspected { evidence: \"heartbeats and answers to guard requests come by turns\" }"]
    );
}

#[test]
fn replies_to_another_master_beside_the_heartbeats_of_a_node_are_another_device() {
    for settings in [master(vec![transmitter()]), passive(vec![transmitter()])] {
        let mut bench = Bench::new(settings);
        for turn in 0..6 {
            let byte = if turn % 2 == 0 { "05" } else { "85" };
            bench.frame(700 * turn, "701#R1").frame(700 * turn + 1, &format!("701#{byte}"));
            bench.frame(700 * turn + 400, "701#05");
        }
        let told = bench.take_those_with(TOLD);
        assert!(told.len() == 1 && told[0].contains("heartbeats and answers"), "{told:?}");
    }
}

#[test]
fn a_heartbeat_node_that_somebody_guards_in_vain_is_one_device() {
    let mut bench = sending();
    for turn in 0..600 {
        bench.frame(700 * turn + 50, "701#R1");
        if turn % 5 < 3 {
            bench.frame(700 * turn + 51 + turn % 600, "701#05");
        }
    }
    assert_eq!(bench.take_those_with(TOLD), Vec::<String>::new());
}

#[test]
fn a_guarded_node_that_answers_late_or_by_turns_in_time_is_one_device() {
    let mut bench = running_with(mute());
    for request in 1..200 {
        let byte = if request % 2 == 1 { "85" } else { "05" };
        let delay = if request % 3 == 0 { 150 } else { 20 };
        bench.run(500 * request).frame(500 * request + delay, &format!("701#{byte}"));
    }
    assert_eq!(bench.take_those_with(TOLD), Vec::<String>::new());
}

#[test]
fn two_different_answers_to_a_guard_request_are_two_devices_sooner_than_two_equal_ones() {
    let mut bench = running_with(mute());
    for request in 1..=2 {
        let byte = if request % 2 == 1 { "85" } else { "05" };
        bench.run(500 * request).frame(500 * request + 1, &format!("701#{byte}"));
        bench.frame(500 * request + 2, "701#7F");
    }
    assert_eq!(
        bench.take_those_with(TOLD),
        ["1002 DuplicateSuspected { evidence: \"guard requests are answered twice\" }"]
    );
}

#[test]
fn one_reset_with_two_boot_up_messages_is_two_devices_and_a_bouncing_plug_is_not() {
    let mut bench = running_with(mute());
    assert!(bench.request(1000, 1, NmtRequest::ResetNode));
    bench.frame(1200, "701#00").frame(1450, "701#00").run(10_000);
    assert_eq!(
        bench.take_those_with(TOLD),
        ["3450 DuplicateSuspected { evidence: \"one start brings two boot-up messages\" }"]
    );
    let mut bounced = running_with(mute());
    bounced.frame(1200, "701#00").frame(1450, "701#00").run(10_000);
    assert_eq!(bounced.take_those_with(TOLD), Vec::<String>::new());
    let mut old = running_with(mute());
    assert!(old.request(1000, 1, NmtRequest::ResetNode));
    old.frame(1200, "081#").frame(1201, "701#00").run(10_000);
    assert_eq!(
        old.take_those_with(TOLD),
        Vec::<String>::new(),
        "some devices tell their boot-up in both ways"
    );
}

#[test]
fn objects_that_are_answered_twice_are_two_devices() {
    let mut bench = sending();
    for read in 0..3 {
        let now = Now::from_millis(100 + 100 * read);
        bench.run(100 + 100 * read);
        let request = SdoRequest::read(ObjectId::new(0x1001, u8::try_from(read).unwrap()));
        bench.network.request_sdo(now, NodeId::new(1).unwrap(), TransferId(read), request).unwrap();
        let answer = format!("581#4F0110{read:02X}00000000");
        bench.frame(101 + 100 * read, &answer).frame(102 + 100 * read, &answer);
    }
    assert_eq!(
        bench.take_those_with(TOLD),
        ["302 DuplicateSuspected { evidence: \"SDO requests are answered twice\" }"]
    );
}

#[test]
fn answers_to_another_client_are_no_second_device() {
    let mut bench = sending();
    for read in 0..20_u64 {
        let at = 100 + 100 * read;
        bench.run(at);
        let request = SdoRequest::read(ObjectId::new(0x1001, 0));
        let id = NodeId::new(1).unwrap();
        bench.network.request_sdo(Now::from_millis(at), id, TransferId(read), request).unwrap();
        bench.frame(at + 1, "601#4001100000000000");
        bench.frame(at + 2, "581#4F01100000000000").frame(at + 3, "581#4F01100000000000");
    }
    assert_eq!(bench.take_those_with(TOLD), Vec::<String>::new());
}

#[test]
fn a_device_that_reports_a_collision_itself_is_believed() {
    let mut bench = running();
    bench.frame(400, "081#5081110000000000");
    assert_eq!(
        bench.take_those_with(TOLD),
        [
            "400 DuplicateSuspected { evidence: \"the device reports that its identifiers collide, EMCY 0x8150\" }"
        ]
    );
}

#[test]
fn a_node_id_that_answers_each_request_twice_is_suspected_and_cleared() {
    let mut bench = running_with(mute());
    for request in 1..=4 {
        let byte = if request % 2 == 1 { "85" } else { "05" };
        bench.run(500 * request).frame(500 * request + 1, &format!("701#{byte}"));
        bench.frame(500 * request + 2, &format!("701#{byte}"));
    }
    assert_eq!(
        bench.take_those_with("Duplicate"),
        ["1502 DuplicateSuspected { evidence: \"guard requests are answered twice\" }"]
    );
    for request in 5..=70 {
        let byte = if request % 2 == 1 { "85" } else { "05" };
        bench.run(500 * request).frame(500 * request + 1, &format!("701#{byte}"));
    }
    assert_eq!(bench.take_those_with("Duplicate"), ["32002 DuplicateCleared"]);
}

#[test]
fn a_boot_up_while_tpdos_go_on_is_a_second_node() {
    let mut bench = running();
    bench.frames(&[(400, "181#0000000000000000"), (450, "701#00"), (460, "281#0000000000000000")]);
    assert_eq!(
        bench.take_those_with("Duplicate"),
        ["460 DuplicateSuspected { evidence: \"a boot-up message while TPDOs go on\" }"]
    );
}

#[test]
fn r_dst_059_a_device_that_starts_by_itself_is_alone_though_its_tpdos_follow_its_boot_up_message() {
    for self_starting in [true, false] {
        let boot = BootSettings { self_starting, ..BootSettings::default() };
        let mut bench = running_with(NodeSettings { boot, sdo: Some(SdoSettings::default()), ..detcon(1) });
        bench.frames(&[(400, "181#0000000000000000"), (450, "701#00"), (460, "281#0000000000000000")]);
        assert_eq!(bench.take_those_with(TOLD).is_empty(), self_starting);
    }
}
