//! What comes from outside: other masters, strangers, a bus that fails; and the passive role.

use super::bench::{Bench, detcon, master, mute, passive, running, running_with, usable};
use crate::canopen::{
    ErrorControl, GuardingSettings, Network, NetworkOutput, NmtRequest, NodeEvent, NodeId, NodeSettings,
    StartSettings,
};
use crate::time::Now;

#[test]
fn foreign_nmt_commands_are_told_and_believed_only_after_the_node_says_so() {
    let mut bench = running_with(mute());
    bench.frame(100, "000#0201").run(500).frame(501, "701#84");
    assert_eq!(
        bench.take(),
        [
            "100 NmtCommand { command: 2, node: 1 }",
            "500 701#R1",
            "501 State { from: Some(Operational), to: Stopped, ordered: false }",
            "501 000#0101",
            "501 NmtSent { request: Start }",
        ]
    );
    bench.frames(&[(600, "000#01"), (610, "000#R2"), (620, "000#FF00")]);
    assert_eq!(
        bench.take(),
        [
            "600 UnknownId { id: 000, node: None, first: true }",
            "610 UnknownId { id: 000, node: None, first: false }",
            "620 NmtCommand { command: 255, node: 0 }",
        ]
    );
}

#[test]
fn unknown_identifiers_are_new_once_and_the_memory_for_them_is_bounded() {
    let mut bench = running_with(mute());
    for round in 0..2 {
        for id in 0..400 {
            bench.frame(1, &format!("{:08X}#00", 0x10_0000 + id));
        }
        let first = bench.take_those_with("first: true").len();
        assert_eq!(first, if round == 0 { 256 } else { 0 });
    }
    bench.frames(&[(2, "080#"), (3, "080#"), (4, "17F#"), (5, "682#"), (6, "7E5#00")]);
    assert_eq!(
        bench.take(),
        [
            "2 Sync { produced: false, first: true }",
            "3 Sync { produced: false, first: false }",
            "4 UnknownId { id: 17F, node: None, first: true }",
            "5 UnknownId { id: 682, node: None, first: true }",
            "6 Lss",
        ]
    );
}

#[test]
fn a_tpdo_may_have_a_29_bit_identifier() {
    let mut settings = detcon(1);
    settings.pdos[0].cob_id = "18FF0001#".parse::<crate::can::CanFrame>().unwrap().id();
    let mut bench = running_with(settings);
    bench.frame(100, "18FF0001#0102030405060708").frame(110, "181#0102030405060708");
    assert_eq!(
        bench.take(),
        [
            "100 Pdo { pdo: PdoIndex(0), data: [1, 2, 3, 4, 5, 6, 7, 8], length: 8 }",
            "110 UnknownId { id: 181, node: Some(node 1), first: true }",
        ]
    );
}

#[test]
fn r_det_004_of_two_nodes_with_one_id_the_first_counts() {
    let second = NodeSettings { error_control: ErrorControl::None, ..detcon(1) };
    let mut bench =
        Bench::new(master(vec![mute(), second, NodeSettings { id: NodeId::new(2).unwrap(), ..mute() }]));
    bench.run(20);
    assert_eq!(bench.take(), ["0 701#R1", "10 702#R1"]);
}

#[test]
fn a_request_that_did_not_leave_is_no_miss() {
    let mut bench = running_with(mute());
    for request in 1..=10 {
        bench.not_sent(500 * request, "701#R1");
    }
    bench.run(5499);
    assert!(bench.take().iter().all(|line| line.ends_with("701#R1")));
}

#[test]
fn nothing_is_asked_and_nobody_blamed_before_the_bus_can_be_used() {
    let mut network = Network::new(master(vec![detcon(1), mute()]), Now::from_millis(0));
    assert_eq!(network.poll_timeout(), None);
    network.handle_link(Now::from_millis(60_000), true);
    network.handle_timeout(Now::from_millis(60_000));
    let told: Vec<_> = std::iter::from_fn(|| network.poll_output()).collect();
    assert_eq!(told, [NetworkOutput::Transmit("701#R1".parse().unwrap())]);
}

#[test]
fn a_command_that_did_not_leave_is_as_if_it_had_not_been_given() {
    let mut bench = running();
    assert!(bench.request(100, 1, NmtRequest::Stop));
    bench.not_sent(101, "000#0201").take();
    bench.frame(600, "701#7F");
    assert_eq!(
        bench.take_those_with("Sent"),
        ["600 NmtSent { request: Start }"],
        "it is not held back, and its supervision went on"
    );
    let mut waiting = running_with(mute());
    waiting.frame(600, "701#FF").not_sent(601, "000#0101");
    waiting.run(1500);
    assert!(waiting.take_those_with("PdoTimeout").is_empty(), "a start that did not leave promises no TPDO");
}

#[test]
fn a_frame_that_is_handed_over_after_the_bus_went_down_sets_no_clock_going() {
    let mut bench = running();
    bench.link(400, false).frame(401, "701#FF").frame(402, "181#0000000000000000").run(60_000);
    let lines = bench.take();
    assert!(!lines.iter().any(|line| line.contains("000#") || line.contains("Timeout")), "{lines:?}");
}

#[test]
fn the_first_tpdo_of_a_node_that_starts_by_itself_is_no_surprise() {
    let start = StartSettings { auto_start: false, ..StartSettings::default() };
    let mut bench = running_with(NodeSettings { start, ..mute() });
    bench.frame(200, "701#00").frame(300, "181#0000000000000000");
    assert!(bench.take_those_with("Unexpected").is_empty());
}

#[test]
fn a_node_is_supervised_from_its_first_state_on_and_not_after_a_boot_up_a_tpdo_or_a_loss() {
    let mut network = usable(master(vec![mute()]));
    let mut told = Vec::new();
    let mut take = |network: &mut Network, millis: u64, frame: Option<&str>| {
        let now = Now::from_millis(millis);
        network.handle_timeout(now);
        if let Some(frame) = frame {
            network.handle_frame(now, &frame.parse().unwrap());
        }
        let is_told = |output| output == NetworkOutput::Node(NodeId::new(1).unwrap(), NodeEvent::Supervised);
        told.extend(
            std::iter::from_fn(|| network.poll_output())
                .filter_map(|output| is_told(output).then_some(millis)),
        );
    };
    take(&mut network, 0, Some("701#00"));
    take(&mut network, 1, Some("181#0000000000000000"));
    take(&mut network, 501, Some("701#05"));
    take(&mut network, 1001, Some("701#85"));
    for millis in (1500..10_000).step_by(100) {
        take(&mut network, millis, None);
    }
    take(&mut network, 10_000, Some("181#0000000000000000"));
    take(&mut network, 10_050, Some("701#05"));
    assert_eq!(told, [501, 10_050]);
}

#[test]
fn a_bus_that_is_down_blames_no_node_and_is_asked_anew_when_it_comes_back() {
    let mut bench = running();
    bench.link(400, false).run(60_000);
    assert!(!bench.request(60_000, 1, NmtRequest::Start), "nothing can be sent");
    assert!(bench.take().is_empty());
    bench.link(60_000, true).frame(60_001, "701#05").link(60_002, true).run(60_499);
    assert_eq!(bench.take(), ["60000 701#R1"], "either toggle bit");
}

#[test]
fn a_loss_outlives_a_bus_failure_until_the_node_answers() {
    let mut bench = running_with(mute());
    bench.run(1600).link(1700, false).link(1800, true).run(10_000);
    assert_eq!(bench.take_those_with("Lost").len(), 1);
    bench.frame(10_301, "701#05");
    assert_eq!(bench.take_those_with("Recovered"), ["10301 Recovered"]);
}

#[test]
fn a_node_is_not_called_never_seen_while_the_bus_is_down() {
    let mut bench = Bench::new(master(vec![mute()]));
    bench.link(1000, false).link(60_000, true).run(69_999);
    assert!(bench.take_those_with("NeverSeen").is_empty());
    bench.run(70_000);
    assert_eq!(bench.take_those_with("NeverSeen"), ["70000 NeverSeen"]);
}

#[test]
fn passive_states_are_taken_from_what_another_master_asks() {
    let mut bench = Bench::new(passive(vec![detcon(1)]));
    bench.frames(&[
        (100, "701#00"),
        (200, "701#R1"),
        (201, "701#7F"),
        (202, "000#0101"),
        (203, "181#0000000000000000"),
        (700, "701#R1"),
        (701, "701#05"),
        (1200, "701#R1"),
        (1201, "701#05"),
        (1300, "000#0200"),
        (1301, "701#84"),
    ]);
    bench.run(60_000);
    assert_eq!(
        bench.take(),
        [
            "100 Seen",
            "100 State { from: None, to: Initialising, ordered: true }",
            "201 State { from: Some(Initialising), to: PreOperational, ordered: true }",
            "202 NmtCommand { command: 1, node: 1 }",
            "203 State { from: Some(PreOperational), to: Operational, ordered: true }",
            "203 Pdo { pdo: PdoIndex(0), data: [0, 0, 0, 0, 0, 0, 0, 0], length: 8 }",
            "1300 NmtCommand { command: 2, node: 0 }",
            "1300 State { from: Some(Operational), to: Stopped, ordered: true }",
            "2901 Lost { stuck_toggle: false }",
        ]
    );
}

#[test]
fn passive_without_foreign_guarding_only_tpdos_can_time_out() {
    let mut bench = Bench::new(passive(vec![detcon(1)]));
    bench.frame(100, "701#00").frame(300, "181#0000000000000000").run(60_000);
    let told = bench.take();
    assert!(told.iter().all(|line| !line.contains("Lost")), "{told:?}");
    assert_eq!(told.iter().filter(|line| line.contains("PdoTimeout")).count(), 4);
}

#[test]
fn resync_bears_with_a_second_guarding_master_and_strict_does_not() {
    for (toggle_resync, errors) in [(false, 20), (true, 0)] {
        let guarding = GuardingSettings { toggle_resync, ..GuardingSettings::default() };
        let mut bench =
            running_with(NodeSettings { error_control: ErrorControl::Guarding(guarding), ..mute() });
        for request in 1..=20 {
            bench.frame(500 * request - 250, "701#R1").frame(500 * request - 249, "701#85");
            bench.run(500 * request).frame(500 * request + 1, "701#05");
        }
        let told = bench.take();
        let wrong = told.iter().filter(|line| line.contains("ToggleError")).count();
        assert_eq!(wrong, errors, "resync {toggle_resync}: {told:?}");
        assert!(
            told.iter().all(|line| !line.contains("Unsolicited") && !line.contains("Duplicate")),
            "{told:?}"
        );
    }
}

#[test]
fn a_gateway_that_was_asleep_counts_one_miss_and_sends_one_request() {
    let mut bench = running_with(mute());
    bench.run(500).take();
    bench.network.handle_timeout(Now::from_millis(60_250));
    let told: Vec<_> = std::iter::from_fn(|| bench.network.poll_output()).collect();
    assert_eq!(told.len(), 2, "{told:?}");
    assert_eq!(bench.network.poll_timeout().unwrap().0.as_millis(), 60_350, "then the reply");
}

#[test]
fn a_reply_received_in_time_but_handed_over_late_is_valid() {
    let mut bench = running_with(mute());
    bench.run(600).take();
    bench.network.handle_frame(Now::from_millis(501), &"701#85".parse().unwrap());
    assert_eq!(
        bench.network.poll_output().map(|output| format!("{output:?}")).unwrap(),
        "Node(node 1, FrameSeen)"
    );
    assert_eq!(bench.network.poll_output(), None, "not unsolicited");
}

#[test]
fn lss_requests_of_somebody_else_are_told_until_60_s_without() {
    let mut bench = running_with(mute());
    for millis in [100, 110, 120, 60_000, 120_000] {
        bench.frame(millis, "7E5#0400000000000000");
    }
    assert_eq!(bench.take_those_with("Lss"), ["100 Lss"]);
    bench.frame(180_001, "7E5#5100000000800000");
    assert_eq!(bench.take_those_with("Lss"), ["180001 Lss"]);
}

#[test]
fn somebody_elses_sdo_requests_are_told_reads_once_and_writes_with_their_object() {
    let mut bench = running_with(mute());
    bench.frames(&[
        (100, "601#4000100000000000"),
        (101, "601#4018100100000000"),
        (110, "601#A018100104000000"),
        (120, "601#2B171000F4010000"),
        (130, "601#2100300020000000"),
        (131, "601#0041424344454647"),
        (140, "601#C618100120000000"),
        (141, "601#0141424344454647"),
        (150, "601#8018100100000405"),
        (160, "601#4000"),
    ]);
    assert_eq!(
        bench.take(),
        [
            "100 ForeignSdo { object: ObjectId { index: 4096, sub: 0 }, write: false }",
            "120 ForeignSdo { object: ObjectId { index: 4119, sub: 0 }, write: true }",
            "130 ForeignSdo { object: ObjectId { index: 12288, sub: 0 }, write: true }",
            "140 ForeignSdo { object: ObjectId { index: 4120, sub: 1 }, write: true }",
        ]
    );
}

/// A node that sends heartbeats.
fn heartbeat_node() -> NodeSettings {
    let timeout = std::time::Duration::from_millis(1500);
    NodeSettings { error_control: ErrorControl::Heartbeat { timeout }, ..mute() }
}

#[test]
fn passive_states_are_taken_from_heartbeats_commands_and_boot_up_messages() {
    let mut bench = Bench::new(passive(vec![heartbeat_node()]));
    bench.frames(&[
        (100, "000#0201"),
        (200, "701#7F"),
        (1200, "701#05"),
        (1300, "000#8001"),
        (2200, "701#7F"),
        (2300, "000#0100"),
        (3200, "701#05"),
        (3300, "000#8201"),
        (3400, "701#00"),
        (3500, "701#7F"),
        (3600, "081#"),
    ]);
    bench.run(60_000);
    assert_eq!(
        bench.take_those_with("State"),
        [
            "200 State { from: None, to: PreOperational, ordered: true }",
            "1200 State { from: Some(PreOperational), to: Operational, ordered: false }",
            "1300 State { from: Some(Operational), to: PreOperational, ordered: true }",
            "3200 State { from: Some(PreOperational), to: Operational, ordered: true }",
            "3400 State { from: Some(Operational), to: Initialising, ordered: true }",
            "3500 State { from: Some(Initialising), to: PreOperational, ordered: true }",
            "3600 State { from: Some(PreOperational), to: Initialising, ordered: true }",
        ]
    );
}

#[test]
fn passive_a_heartbeat_that_stays_away_loses_the_node_and_nothing_is_ever_sent() {
    let mut bench = Bench::new(passive(vec![heartbeat_node()]));
    bench.run(30_000).frame(31_000, "701#05").run(40_000).frame(40_000, "701#7F").run(41_000);
    let told = bench.take();
    assert!(told.contains(&"32500 Lost { stuck_toggle: false }".to_owned()), "{told:?}");
    assert!(told.contains(&"40000 Recovered".to_owned()), "{told:?}");
    assert!(told.iter().all(|line| !line.contains('#')), "{told:?}");
}
