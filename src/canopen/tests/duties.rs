//! What a master does beside guarding: starting, orders, TPDOs, other kinds of error control.

use std::time::Duration;

use super::bench::{Bench, detcon, master, mute, passive, running, running_with, usable};
use crate::can::{CanFrame, CanId};
use crate::canopen::{
    ErrorControl, GuardingSettings, NetworkOutput, NetworkSettings, NmtRequest, NodeId, NodeSettings,
    StartSettings,
};
use crate::time::Now;

fn with_start(change: impl FnOnce(&mut StartSettings)) -> NodeSettings {
    let mut start = StartSettings::default();
    change(&mut start);
    NodeSettings { start, ..mute() }
}

#[test]
fn r_det_017_no_start_for_a_node_that_is_operational() {
    let mut bench = running_with(mute());
    bench.run(500).frame(501, "701#85").run(1000).frame(1001, "701#05");
    assert!(bench.take_those_with("000#").is_empty());
}

#[test]
fn r_det_019_start_without_a_report_at_the_latest_after_the_start_delay() {
    let mut bench = running_with(mute());
    bench.run(1600).take();
    bench.frame(1700, "701#00").run(2199);
    assert!(bench.take_those_with("000#").is_empty());
    bench.run(2200);
    assert_eq!(bench.take_those_with("000#"), ["2200 000#0101"]);
}

#[test]
fn r_det_020_start_is_repeated_without_limit_and_reported_after_three_attempts() {
    let mut bench = Bench::new(master(vec![mute()]));
    for request in 0..12 {
        let byte = if request % 2 == 0 { "701#7F" } else { "701#FF" };
        bench.run(500 * request).frame(500 * request + 1, byte);
    }
    bench.frame(5900, "701#05");
    let told = bench.take().into_iter().filter(|line| !line.contains("701#") && !line.contains("NmtSent"));
    assert_eq!(
        told.skip(2).collect::<Vec<_>>(),
        [
            "1 000#0101",
            "1001 000#0101",
            "2001 000#0101",
            "3001 StartFailed { attempts: 3 }",
            "3001 000#0101",
            "4001 000#0101",
            "5001 000#0101",
            "5900 UnsolicitedState",
            "5900 State { from: Some(PreOperational), to: Operational, ordered: true }",
            "5900 StartSucceeded",
        ]
    );
}

#[test]
fn r_det_020_a_tpdo_confirms_the_start() {
    let mut bench = Bench::new(master(vec![detcon(1)]));
    bench.frame(1, "701#7F").frame(300, "181#0000000000000000").run(499);
    assert_eq!(
        bench.take()[3..],
        [
            "1 000#0101".to_owned(),
            "1 NmtSent { request: Start }".to_owned(),
            "300 State { from: Some(PreOperational), to: Operational, ordered: true }".to_owned(),
            "300 Pdo { pdo: PdoIndex(0), data: [0, 0, 0, 0, 0, 0, 0, 0], length: 8 }".to_owned(),
        ]
    );
    bench.run(1400);
    assert!(bench.take_those_with("000#").is_empty());
}

#[test]
fn r_det_020_a_lost_node_is_not_started() {
    let mut bench = Bench::new(master(vec![mute()]));
    bench.frame(1, "701#7F").run(10_000);
    assert_eq!(bench.take_those_with("000#"), ["1 000#0101", "1001 000#0101"]);
}

#[test]
fn r_det_016_reset_on_recovery_only_where_asked_for_and_then_instead_of_a_start() {
    let mut bench = running_with(with_start(|start| start.reset_on_recovery = true));
    bench.run(2000).frame(2001, "701#7F");
    assert_eq!(bench.take_those_with("000#"), ["2001 000#8101"]);
    bench.frame(2300, "701#00").run(2400).frame(2401, "701#7F");
    assert_eq!(
        bench.take(),
        [
            "2300 State { from: Some(PreOperational), to: Initialising, ordered: true }",
            "2400 701#R1",
            "2401 State { from: Some(Initialising), to: PreOperational, ordered: true }",
            "2401 000#0101",
            "2401 NmtSent { request: Start }",
        ]
    );
}

#[test]
fn r_det_016_all_commands_are_offered_and_a_stop_holds_until_a_start() {
    for (order, byte) in [(NmtRequest::Stop, "84"), (NmtRequest::EnterPreOperational, "FF")] {
        let mut bench = running_with(mute());
        assert!(bench.request(100, 1, order));
        bench.take();
        bench.run(500).frame(501, &format!("701#{byte}")).run(999);
        let told = bench.take();
        assert!(told[1].contains("ordered: true"), "{told:?}");
        assert!(told.iter().all(|line| !line.contains("000#")), "{told:?}");
        bench.frame(1000, "701#00").run(1100).frame(1101, "701#7F").run(3000);
        assert!(bench.take_those_with("000#").is_empty(), "not after a restart either");
        assert!(bench.request(3001, 1, NmtRequest::Start));
        assert_eq!(bench.take_those_with("000#"), ["3001 000#0101"]);
    }
}

#[test]
fn r_det_016_an_ordered_reset_is_no_restart() {
    for (order, frame) in [(NmtRequest::ResetNode, "000#8101"), (NmtRequest::ResetCommunication, "000#8201")]
    {
        let mut bench = running();
        assert!(bench.request(100, 1, order));
        bench.frame(200, "701#00").run(300).frame(301, "701#7F");
        let told = bench.take();
        assert_eq!(told[0], format!("100 {frame}"));
        assert!(told.iter().all(|line| !line.contains("Restarted")), "{told:?}");
        assert_eq!(told.last().unwrap(), "301 NmtSent { request: Start }");
    }
}

#[test]
fn a_boot_up_long_after_an_ordered_reset_is_a_restart() {
    let mut bench = running_with(with_start(|start| start.auto_start = false));
    assert!(bench.request(100, 1, NmtRequest::ResetNode));
    bench.frame(31_000, "701#00");
    assert_eq!(bench.take_those_with("Restarted"), ["31000 Restarted"]);
}

#[test]
fn commands_for_unknown_nodes_or_in_the_passive_role_are_refused() {
    let mut bench = running();
    assert!(!bench.request(1, 2, NmtRequest::Start));
    assert!(bench.take().is_empty());
    let mut listener = Bench::new(passive(vec![detcon(1)]));
    assert!(!listener.request(1, 1, NmtRequest::Start));
    assert!(listener.take().is_empty());
}

#[test]
fn v_det_01_r_det_010_an_operators_command_to_all_is_one_frame() {
    let mut network = usable(master(vec![mute(), NodeSettings { id: NodeId::new(2).unwrap(), ..mute() }]));
    assert!(network.request_nmt(Now::from_millis(0), None, NmtRequest::Stop));
    let told: Vec<_> = std::iter::from_fn(|| network.poll_output()).collect();
    assert_eq!(told[0], NetworkOutput::Transmit("000#0200".parse().unwrap()));
    assert_eq!(told.len(), 3);
}

#[test]
fn settle_a_request_that_falls_into_the_pause_after_a_command_is_sent_at_its_end() {
    let mut bench = running_with(mute());
    bench.request(495, 1, NmtRequest::Start);
    bench.run(515).frame(516, "701#85").run(1000);
    assert_eq!(bench.take(), ["495 000#0101", "495 NmtSent { request: Start }", "515 701#R1", "1000 701#R1"]);
}

#[test]
fn settle_a_stream_of_commands_cannot_hold_guarding_up() {
    let mut bench = running_with(mute());
    for millis in 1..600 {
        bench.request(millis, 1, NmtRequest::Start);
    }
    assert_eq!(bench.take_those_with("701#"), ["520 701#R1"]);
}

#[test]
fn r_det_018_start_is_addressed_unless_broadcast_is_asked_for() {
    let two = || vec![mute(), NodeSettings { id: NodeId::new(2).unwrap(), ..mute() }];
    let mut addressed = Bench::new(master(two()));
    addressed.run(20).frames(&[(20, "701#7F"), (21, "702#7F")]);
    assert_eq!(addressed.take_those_with("000#"), ["20 000#0101", "21 000#0102"]);

    let mut all = Bench::new(NetworkSettings { start_broadcast: true, ..master(two()) });
    all.run(20).frames(&[(20, "701#7F"), (21, "702#7F")]).run(1500);
    assert_eq!(
        all.take_those_with("000#"),
        ["20 000#0100", "21 000#0100", "1020 000#0100"],
        "one repetition for both"
    );

    let mut held = Bench::new(NetworkSettings { start_broadcast: true, ..master(two()) });
    held.run(20).frame(20, "702#05");
    held.request(21, 2, NmtRequest::Stop);
    held.frame(30, "701#7F");
    assert_eq!(
        held.take_those_with("000#"),
        ["21 000#0202", "30 000#0101"],
        "node 2 was stopped by an operator"
    );
}

#[test]
fn r_det_082_each_tpdo_is_supervised_from_the_start_command_on() {
    let mut bench = Bench::new(master(vec![detcon(1)]));
    bench.frame(1, "701#7F").frame(300, "281#0000000000000000");
    for (request, byte) in (1..).zip(["85", "05", "85", "05"]) {
        bench.run(500 * request).frame(500 * request + 1, &format!("701#{byte}"));
    }
    assert_eq!(
        bench.take_those_with("PdoTimeout"),
        [
            "1501 PdoTimeout { pdo: PdoIndex(0) }",
            "1501 PdoTimeout { pdo: PdoIndex(2) }",
            "1501 PdoTimeout { pdo: PdoIndex(3) }",
            "1800 PdoTimeout { pdo: PdoIndex(1) }",
        ]
    );
}

#[test]
fn r_det_082_a_node_that_is_stopped_or_lost_owes_no_tpdo() {
    let mut stopped = running();
    stopped.request(100, 1, NmtRequest::Stop);
    stopped.frame(110, "181#0000000000000000");
    for (request, byte) in (1..).zip(["84", "04", "84", "04", "84", "04"]) {
        stopped.run(500 * request).frame(500 * request + 1, &format!("701#{byte}"));
    }
    assert!(stopped.take_those_with("PdoTimeout").is_empty());

    let mut lost = running();
    lost.frame(1400, "181#0000000000000000").frame(1650, "181#0000000000000000").run(20_000);
    assert_eq!(lost.take_those_with("PdoIndex(0) }"), Vec::<String>::new());
}

#[test]
fn r_det_083_a_tpdo_of_a_stopped_node_is_decoded_and_the_node_is_asked_at_once() {
    let settings =
        NodeSettings { start: StartSettings { auto_start: false, ..StartSettings::default() }, ..detcon(1) };
    let mut bench = Bench::new(master(vec![settings]));
    bench.frame(0, "701#04").take();
    bench.frame(200, "181#0000000000000000").frame(210, "701#85").run(599);
    assert_eq!(
        bench.take(),
        [
            "200 PdoInUnexpectedState { pdo: PdoIndex(0), state: Some(Stopped) }",
            "200 State { from: Some(Stopped), to: Operational, ordered: false }",
            "200 Pdo { pdo: PdoIndex(0), data: [0, 0, 0, 0, 0, 0, 0, 0], length: 8 }",
            "200 701#R1",
            "500 701#R1",
        ]
    );
}

#[test]
fn r_det_083_asking_at_once_happens_once_in_a_guard_time() {
    let settings =
        NodeSettings { start: StartSettings { auto_start: false, ..StartSettings::default() }, ..detcon(1) };
    let mut bench = Bench::new(master(vec![settings]));
    bench.frame(0, "701#04").take();
    for millis in 100..600 {
        bench.frame(millis, "181#0000000000000000");
        if millis % 2 == 1 {
            let byte = if millis < 500 { "84" } else { "04" };
            bench.frame(millis, &format!("701#{byte}"));
        }
    }
    assert!(bench.take_those_with("701#R").len() <= 2);
}

#[test]
fn r_det_083_the_first_tpdo_of_a_node_that_ran_before_the_gateway_is_no_surprise() {
    let mut bench = Bench::new(master(vec![detcon(1)]));
    bench.frame(0, "181#0000000000000000");
    assert_eq!(
        bench.take()[1..3],
        ["0 Seen".to_owned(), "0 State { from: None, to: Operational, ordered: true }".to_owned()]
    );
}

#[test]
fn r_det_037_and_083_tpdos_of_a_lost_node_change_no_state_and_recover_nothing() {
    let mut bench = Bench::new(master(vec![detcon(1)]));
    bench.run(1600).take();
    bench.frame(1700, "181#0000000000000000");
    assert_eq!(
        bench.take(),
        ["1700 Seen", "1700 Pdo { pdo: PdoIndex(0), data: [0, 0, 0, 0, 0, 0, 0, 0], length: 8 }"]
    );
}

#[test]
fn r_det_046_every_node_is_asked_at_once_and_requests_do_not_burst() {
    let nodes = (1..=127).map(|id| NodeSettings { id: NodeId::new(id).unwrap(), ..mute() }).collect();
    let mut network = usable(master(nodes));
    let mut sent = Vec::new();
    for millis in 0..500 {
        network.handle_timeout(Now::from_millis(millis));
        let frames = std::iter::from_fn(|| network.poll_output()).filter_map(|output| match output {
            NetworkOutput::Transmit(frame) => Some((millis, frame.to_string())),
            NetworkOutput::Node(..) | NetworkOutput::Foreign(_) => None,
        });
        sent.extend(frames);
    }
    assert_eq!(sent.len(), 127);
    assert_eq!(sent[0], (0, "701#R1".to_owned()));
    assert_eq!(sent[126].1, "77F#R1");
    assert!(sent.windows(2).all(|pair| pair[1].0 - pair[0].0 >= 3), "{sent:?}");
}

#[test]
fn r_det_021_the_dlc_of_the_request_can_be_set() {
    let guarding = GuardingSettings { rtr_dlc: 0, ..GuardingSettings::default() };
    let mut bench =
        Bench::new(master(vec![NodeSettings { error_control: ErrorControl::Guarding(guarding), ..mute() }]));
    bench.run(0);
    assert_eq!(bench.take(), ["0 701#R0"]);
}

#[test]
fn r_det_044_heartbeat_sends_no_request_and_does_not_look_at_bit_7() {
    let error_control = ErrorControl::Heartbeat { timeout: Duration::from_millis(1500) };
    let mut bench = Bench::new(master(vec![NodeSettings { error_control, ..mute() }]));
    bench.frames(&[(100, "701#00"), (200, "701#7F"), (300, "701#05"), (400, "701#05"), (500, "701#85")]);
    bench.run(5000).frame(5001, "701#05").frame(5100, "701#00");
    assert_eq!(
        bench.take(),
        [
            "100 Seen",
            "100 State { from: None, to: Initialising, ordered: true }",
            "200 State { from: Some(Initialising), to: PreOperational, ordered: true }",
            "200 000#0101",
            "200 NmtSent { request: Start }",
            "300 State { from: Some(PreOperational), to: Operational, ordered: true }",
            "2000 Lost { stuck_toggle: false }",
            "5001 Recovered",
            "5100 Restarted",
            "5100 State { from: Some(Operational), to: Initialising, ordered: true }",
        ]
    );
}

#[test]
fn r_det_031_and_044_without_error_control_nothing_is_asked_and_nobody_is_lost() {
    let zero = GuardingSettings { guard_time: Duration::ZERO, ..GuardingSettings::default() };
    for error_control in [ErrorControl::None, ErrorControl::Guarding(zero)] {
        let mut bench = Bench::new(master(vec![NodeSettings { error_control, ..detcon(1) }]));
        bench.frame(100, "701#00").run(600).frame(700, "181#0000000000000000").run(60_000);
        assert_eq!(
            bench.take().into_iter().filter(|line| !line.contains("PdoTimeout")).collect::<Vec<_>>(),
            [
                "100 Seen",
                "100 State { from: None, to: Initialising, ordered: true }",
                "600 000#0101",
                "600 NmtSent { request: Start }",
                "700 State { from: Some(Initialising), to: Operational, ordered: true }",
                "700 Pdo { pdo: PdoIndex(0), data: [0, 0, 0, 0, 0, 0, 0, 0], length: 8 }",
            ]
        );
    }
}

#[test]
fn r_det_001_a_node_that_never_shows_a_frame_is_told_in_every_role() {
    for settings in [master(vec![mute()]), passive(vec![mute()])] {
        let mut bench = Bench::new(settings);
        bench.frame(5000, "701#R1").frame(6000, "00000701#00").run(60_000);
        assert_eq!(bench.take_those_with("Seen"), ["10000 NeverSeen"]);
        bench.frame(61_000, "701#05");
        assert_eq!(bench.take_those_with("Seen"), ["61000 Seen"]);
    }
}

#[test]
fn r_det_091_emergency_messages() {
    let mut bench = running();
    bench.frames(&[
        (1, "081#3081110102030405"),
        (2, "081#0000000000000000"),
        (3, "081#308111"),
        (4, "081#3081"),
    ]);
    assert_eq!(
        bench.take(),
        [
            "1 Emergency { code: 33072, register: 17, vendor: [1, 2, 3, 4, 5] }",
            "2 Emergency { code: 0, register: 0, vendor: [0, 0, 0, 0, 0] }",
            "3 Emergency { code: 33072, register: 17, vendor: [0, 0, 0, 0, 0] }",
            "4 Malformed { frame: 081#3081 }",
        ]
    );
}

#[test]
fn emergency_messages_may_have_any_identifier() {
    for id in [CanId::Standard(0x0F1), CanId::Extended(0x001A_BCDE)] {
        let mut bench = running_with(NodeSettings { emergency: Some(id), ..mute() });
        let frame = CanFrame::data_frame(id, &[0, 0x50, 1]).unwrap();
        bench.frame(1, &frame.to_string()).frame(2, "081#005001");
        let lines = bench.take();
        assert_eq!(lines[0], "1 Emergency { code: 20480, register: 1, vendor: [0, 0, 0, 0, 0] }");
        assert!(lines[1].contains("UnknownId"), "{lines:?}");
    }
}

#[test]
fn a_boot_up_ends_errors_only_where_one_was_told() {
    let mut bench = running();
    bench.frame(1, "701#00").frame(2, "081#0000000000000000").frame(3, "701#00");
    assert_eq!(bench.take_those_with("ErrorsForgotten"), Vec::<String>::new());
    bench.frame(4, "081#0050010000000000").frame(5, "701#00").frame(6, "701#00");
    assert_eq!(bench.take_those_with("ErrorsForgotten"), ["5 ErrorsForgotten"]);
}

#[test]
fn an_empty_emergency_message_is_a_boot_up_as_before_cia_301_version_4() {
    let mut bench = running();
    bench.frame(100, "081#");
    assert_eq!(bench.take()[0], "100 Restarted");
}
