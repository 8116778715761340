//! The worked examples of the DetCon requirements (V-DET), and the requirements on its life, step by step.

use super::bench::{Bench, detcon, master, mute, running, running_with};
use crate::canopen::{ErrorControl, GuardingSettings, NmtRequest, NodeSettings, StartSettings, TogglePolicy};

fn with_guarding(change: impl FnOnce(&mut GuardingSettings)) -> NodeSettings {
    let mut guarding = GuardingSettings::default();
    change(&mut guarding);
    NodeSettings { error_control: ErrorControl::Guarding(guarding), ..mute() }
}

/// The gateway has been asking for 400 ms when the device boots: 400 ms are to be taken off to get the example's times.
#[test]
fn v_det_02_r_det_021_to_028_power_up_guarding_start_stop() {
    let mut bench = Bench::new(master(vec![mute()]));
    bench.run(399).take();
    bench.frame(400, "701#00").run(500).frame(501, "701#7F").run(1000).frame(1001, "701#85");
    bench.run(1500).frame(1501, "701#05");
    assert!(bench.request(1600, 1, NmtRequest::Stop));
    bench.run(2000).frame(2001, "701#84").run(2500).frame(2501, "701#04").run(2600);
    assert_eq!(
        bench.take(),
        [
            "400 Seen",
            "400 State { from: None, to: Initialising, ordered: true }",
            "500 701#R1",
            "501 State { from: Some(Initialising), to: PreOperational, ordered: true }",
            "501 000#0101",
            "501 NmtSent { request: Start }",
            "1000 701#R1",
            "1001 State { from: Some(PreOperational), to: Operational, ordered: true }",
            "1500 701#R1",
            "1600 000#0201",
            "1600 NmtSent { request: Stop }",
            "2000 701#R1",
            "2001 State { from: Some(Operational), to: Stopped, ordered: true }",
            "2500 701#R1",
        ]
    );
}

#[test]
fn v_det_03_r_det_023_all_guarding_data_bytes() {
    for byte in 0..=255_u8 {
        let mut bench = Bench::new(master(vec![mute()]));
        bench.frame(0, &format!("701#{byte:02X}"));
        let expected = match byte & 0x7F {
            0 => "State { from: None, to: Initialising, ordered: true }".to_owned(),
            4 => "State { from: None, to: Stopped, ordered: true }".to_owned(),
            5 => "State { from: None, to: Operational, ordered: true }".to_owned(),
            127 => "State { from: None, to: PreOperational, ordered: true }".to_owned(),
            raw => format!("InvalidState {{ raw: {raw} }}"),
        };
        assert_eq!(bench.take()[2], format!("0 {expected}"), "{byte:02X}");
    }
}

#[test]
fn v_det_13_wrong_dlc() {
    let mut bench = running();
    for (frame, pdo, received) in
        [("181#00FF80", 0, 3), ("381#01", 2, 1), ("481#0019FF8003", 3, 5), ("181#", 0, 0)]
    {
        bench.frame(10, frame);
        let expected =
            format!("10 PdoLength {{ pdo: PdoIndex({pdo}), received: {received}, discarded: true }}");
        assert_eq!(bench.take(), [expected]);
    }
    bench.frame(10, "481#0019FF8003010000");
    assert_eq!(
        bench.take(),
        [
            "10 PdoLength { pdo: PdoIndex(3), received: 8, discarded: false }",
            "10 Pdo { pdo: PdoIndex(3), data: [0, 25, 255, 128, 3, 1, 0, 0], length: 8 }",
        ]
    );

    let mut settings = detcon(1);
    settings.pdos.iter_mut().for_each(|pdo| pdo.strict_length = true);
    let mut strict = running_with(settings);
    strict.frame(10, "481#0019FF8003010000");
    assert_eq!(strict.take(), ["10 PdoLength { pdo: PdoIndex(3), received: 8, discarded: true }"]);
}

#[test]
fn v_det_13_r_det_080_a_short_tpdo_does_not_refresh_the_timeout() {
    let mut bench = running();
    bench.frames(&[(500, "701#85"), (1000, "701#05"), (1400, "181#00FF80"), (1500, "701#85")]);
    assert_eq!(bench.take_those_with("PdoTimeout").len(), 4);
}

/// Both ways to treat the toggle reference agree where nobody else guards the node.
fn strict_and_resync() -> [NodeSettings; 2] {
    [mute(), with_guarding(|guarding| guarding.toggle_resync = true)]
}

#[test]
fn v_det_14_r_det_035_a_toggle_bit_repeated_once_is_an_error_and_no_loss() {
    for settings in strict_and_resync() {
        let mut bench = running_with(settings);
        bench.run(500).frame(501, "701#05").run(1000).frame(1001, "701#85");
        bench.run(1500).frame(1501, "701#85");
        assert_eq!(
            bench.take(),
            [
                "500 701#R1",
                "501 ToggleError { consecutive: 1 }",
                "1000 701#R1",
                "1500 701#R1",
                "1501 ToggleError { consecutive: 1 }",
            ]
        );
    }
}

#[test]
fn v_det_14_r_det_036_a_stuck_toggle_bit_loses_the_node() {
    for settings in strict_and_resync() {
        let mut bench = running_with(settings);
        bench.run(500).frame(501, "701#05").run(1000).frame(1001, "701#05").run(1500).frame(1501, "701#05");
        bench.run(2000).frame(2001, "701#05");
        assert_eq!(
            bench.take(),
            [
                "500 701#R1",
                "501 ToggleError { consecutive: 1 }",
                "1000 701#R1",
                "1001 ToggleError { consecutive: 2 }",
                "1500 701#R1",
                "1501 ToggleError { consecutive: 3 }",
                "1501 Lost { stuck_toggle: true }",
                "2000 701#R1",
                "2001 ToggleError { consecutive: 4 }",
            ]
        );
    }
}

#[test]
fn v_det_14_r_det_034_after_a_lost_reply_either_toggle_bit_is_valid() {
    let mut bench = running_with(mute());
    bench.run(1000).frame(1001, "701#05").run(1500).frame(1501, "701#85");
    assert_eq!(
        bench.take(),
        ["500 701#R1", "600 GuardMissed { consecutive: 1 }", "1000 701#R1", "1500 701#R1"]
    );
}

#[test]
fn v_det_14_r_det_036_and_037_silence_loses_the_node_and_a_reply_recovers_it() {
    let mut bench = running_with(mute());
    bench.run(2000).frame(2001, "701#FF").run(2100);
    assert_eq!(
        bench.take(),
        [
            "500 701#R1",
            "600 GuardMissed { consecutive: 1 }",
            "1000 701#R1",
            "1100 GuardMissed { consecutive: 2 }",
            "1500 701#R1",
            "1600 GuardMissed { consecutive: 3 }",
            "1600 Lost { stuck_toggle: false }",
            "2000 701#R1",
            "2001 Recovered",
            "2001 State { from: Some(Operational), to: PreOperational, ordered: false }",
            "2001 000#0101",
            "2001 NmtSent { request: Start }",
        ]
    );
}

#[test]
fn v_det_15_boot_up_in_the_middle_of_operation() {
    let mut bench = Bench::new(master(vec![detcon(1)]));
    bench.frames(&[(0, "701#85"), (100, "181#1020304050607080"), (200, "701#00")]);
    bench.run(300).frame(300, "701#7F").frame(350, "181#0000000000000000").run(800).frame(800, "701#85");
    assert_eq!(
        bench.take(),
        [
            "0 701#R1",
            "0 Seen",
            "0 State { from: None, to: Operational, ordered: true }",
            "100 Pdo { pdo: PdoIndex(0), data: [16, 32, 48, 64, 80, 96, 112, 128], length: 8 }",
            "200 Restarted",
            "200 State { from: Some(Operational), to: Initialising, ordered: true }",
            "300 701#R1",
            "300 State { from: Some(Initialising), to: PreOperational, ordered: true }",
            "300 000#0101",
            "300 NmtSent { request: Start }",
            "350 State { from: Some(PreOperational), to: Operational, ordered: true }",
            "350 Pdo { pdo: PdoIndex(0), data: [0, 0, 0, 0, 0, 0, 0, 0], length: 8 }",
            "800 701#R1",
        ]
    );
}

#[test]
fn v_det_16_highest_node_id() {
    let mut bench = Bench::new(master(vec![detcon(127)]));
    bench.frames(&[(0, "77F#00"), (101, "77F#7F"), (200, "4FF#FF0000010F00")]);
    assert_eq!(
        bench.take(),
        [
            "0 77F#R1",
            "0 Seen",
            "0 State { from: None, to: Initialising, ordered: true }",
            "100 77F#R1",
            "101 State { from: Some(Initialising), to: PreOperational, ordered: true }",
            "101 000#017F",
            "101 NmtSent { request: Start }",
            "200 State { from: Some(PreOperational), to: Operational, ordered: true }",
            "200 Pdo { pdo: PdoIndex(3), data: [255, 0, 0, 1, 15, 0, 0, 0], length: 6 }",
        ]
    );
}

#[test]
fn v_det_17_r_det_006_042_r_dst_005_frames_that_must_not_be_decoded() {
    let mut bench = running();
    bench.frames(&[
        (1, "00000181#0102030405060708"),
        (2, "181#R8"),
        (3, "581#0102030405060708"),
        (4, "182#0102030405060708"),
        (5, "701#"),
        (6, "00000701#00"),
        (7, "081#R8"),
    ]);
    assert_eq!(
        bench.take(),
        [
            "1 Malformed { frame: 00000181#0102030405060708 }",
            "2 Malformed { frame: 181#R8 }",
            "3 UnknownId { id: 581, node: Some(node 1), first: true }",
            "4 UnknownId { id: 182, node: Some(node 2), first: true }",
            "5 Malformed { frame: 701# }",
            "6 Malformed { frame: 00000701#00 }",
            "7 Malformed { frame: 081#R8 }",
        ]
    );
}

#[test]
fn r_det_042_only_the_first_byte_of_a_long_guard_reply_counts() {
    let mut bench = Bench::new(master(vec![mute()]));
    bench.frame(0, "701#7F05");
    assert_eq!(
        bench.take()[2..4],
        ["0 Malformed { frame: 701#7F05 }", "0 State { from: None, to: PreOperational, ordered: true }"]
    );
}

#[test]
fn r_det_033_the_loss_comes_at_most_1600_ms_after_the_last_valid_reply() {
    for reply in [0, 1, 50, 99, 100] {
        let mut bench = Bench::new(master(vec![mute()]));
        bench.frame(reply, "701#05").run(5000);
        let lost = bench.take_those_with("Lost");
        assert_eq!(lost, ["1600 Lost { stuck_toggle: false }"]);
    }
}

#[test]
fn r_det_032_and_036_the_node_is_lost_after_exactly_the_life_time_factor() {
    for factor in [1, 2, 5, 255] {
        let mut bench = running_with(with_guarding(|guarding| guarding.life_time_factor = factor));
        bench.run(500 * 300);
        let lines = bench.take();
        let lost = lines.iter().position(|line| line.contains("Lost")).unwrap();
        assert_eq!(
            lines[lost - 1],
            format!("{} GuardMissed {{ consecutive: {factor} }}", 500 * u64::from(factor) + 100)
        );
    }
}

#[test]
fn r_det_035_warn_counts_a_wrong_toggle_bit_and_off_does_not_look() {
    let mut warn = running_with(with_guarding(|guarding| guarding.toggle = TogglePolicy::Warn));
    let mut off = running_with(with_guarding(|guarding| guarding.toggle = TogglePolicy::Off));
    for bench in [&mut warn, &mut off] {
        for request in 1..=10 {
            bench.run(500 * request).frame(500 * request + 1, "701#05");
        }
    }
    let told = warn.take();
    assert_eq!(told.iter().filter(|line| line.contains("ToggleError { consecutive: 0 }")).count(), 10);
    assert!(told.iter().all(|line| !line.contains("Lost")), "{told:?}");
    assert_eq!(off.take().iter().filter(|line| !line.contains("701#R1")).count(), 0);
}

#[test]
fn r_det_035_a_toggle_error_does_not_update_the_state() {
    let mut bench = running_with(mute());
    bench.run(500).frame(501, "701#7F");
    assert_eq!(bench.take(), ["500 701#R1", "501 ToggleError { consecutive: 1 }"]);
}

#[test]
fn r_det_029_and_040_replies_with_state_0_are_no_protocol_error() {
    let mut bench = Bench::new(master(vec![mute()]));
    bench.frame(0, "701#00").run(100).frame(101, "701#00").run(600).frame(601, "701#80");
    bench.run(1000).frame(1001, "701#7F");
    let told = bench.take();
    assert!(told.iter().all(|line| !line.contains("Error") && !line.contains("Restarted")), "{told:?}");
    assert!(told.iter().all(|line| !line.contains("Missed")), "{told:?}");
    assert_eq!(told.iter().filter(|line| line.contains("State {")).count(), 2, "{told:?}");
}

#[test]
fn r_det_039_a_reply_00_while_initialising_does_not_put_the_start_off() {
    let mut bench = Bench::new(master(vec![mute()]));
    bench.frame(0, "701#00").run(100).frame(101, "701#00").run(1000);
    assert_eq!(bench.take_those_with("000#"), ["500 000#0101"]);
}

#[test]
fn r_det_040_state_0_with_toggle_1_is_no_boot_up() {
    let mut bench = running_with(mute());
    bench.run(500).frame(501, "701#80").run(1000).frame(1001, "701#80");
    assert_eq!(
        bench.take(),
        [
            "500 701#R1",
            "501 State { from: Some(Operational), to: Initialising, ordered: false }",
            "1000 701#R1",
            "1001 ToggleError { consecutive: 1 }",
        ]
    );
}

#[test]
fn r_det_038_states_that_nobody_ordered_are_unexpected_and_the_node_is_started() {
    for (byte, state) in [("84", "Stopped"), ("FF", "PreOperational")] {
        let mut bench = running_with(mute());
        bench.run(500).frame(501, &format!("701#{byte}"));
        assert_eq!(
            bench.take()[1..],
            [
                format!("501 State {{ from: Some(Operational), to: {state}, ordered: false }}"),
                "501 000#0101".to_owned(),
                "501 NmtSent { request: Start }".to_owned(),
            ]
        );
    }
}

#[test]
fn r_det_039_boot_up_while_running_in_each_state() {
    for byte in ["04", "05", "7F"] {
        let settings =
            NodeSettings { start: StartSettings { auto_start: false, ..StartSettings::default() }, ..mute() };
        let mut bench = Bench::new(master(vec![settings]));
        bench.frame(0, &format!("701#{byte}")).frame(200, "701#00").run(300).frame(301, "701#7F");
        let told = bench.take();
        assert!(told.contains(&"200 Restarted".to_owned()), "{told:?}");
        assert!(told.contains(&"300 701#R1".to_owned()), "{told:?}");
        assert!(told.iter().all(|line| !line.contains("Error")), "either toggle bit: {told:?}");
    }
}

#[test]
fn r_det_037_a_boot_up_recovers_a_lost_node() {
    let mut bench = running_with(mute());
    bench.run(1600).take();
    bench.frame(1700, "701#00").run(1800).frame(1801, "701#7F");
    assert_eq!(
        bench.take(),
        [
            "1700 Recovered",
            "1700 Restarted",
            "1700 State { from: Some(Operational), to: Initialising, ordered: true }",
            "1800 701#R1",
            "1801 State { from: Some(Initialising), to: PreOperational, ordered: true }",
            "1801 000#0101",
            "1801 NmtSent { request: Start }",
        ]
    );
}

#[test]
fn r_det_037_nothing_but_a_valid_reply_or_a_boot_up_recovers() {
    let mut bench = running();
    bench.run(1650).take();
    bench.frames(&[(1700, "181#1020304050607080"), (1710, "701#85"), (1720, "081#0010010000000000")]);
    let told = bench.take();
    assert!(told.contains(
        &"1700 Pdo { pdo: PdoIndex(0), data: [16, 32, 48, 64, 80, 96, 112, 128], length: 8 }".to_owned()
    ));
    assert!(told.iter().all(|line| !line.contains("Recovered") && !line.contains("000#")), "{told:?}");
    bench.run(2000).frame(2001, "701#85");
    assert_eq!(bench.take()[1], "2001 Recovered");
}

#[test]
fn r_det_041_an_undefined_state_is_a_sign_of_life_told_once_per_change() {
    let mut bench = running_with(mute());
    for (request, byte) in (1..).zip(["86", "06", "FE", "05", "86"]) {
        bench.run(500 * request).frame(500 * request + 1, &format!("701#{byte}"));
    }
    assert_eq!(
        bench.take().into_iter().filter(|line| !line.contains("701#R1")).collect::<Vec<_>>(),
        ["501 InvalidState { raw: 6 }", "1501 InvalidState { raw: 126 }", "2501 InvalidState { raw: 6 }",]
    );
}

#[test]
fn r_det_043_a_foreign_guard_request_is_told_until_60_s_of_silence() {
    let mut bench = running_with(mute());
    for second in [1, 2, 50, 100] {
        bench.frame(1000 * second + 250, "701#R1");
    }
    assert_eq!(bench.take_those_with("Foreign"), ["1250 ForeignGuardMaster"]);
    bench.frame(160_251, "701#R1");
    assert_eq!(
        bench.take_those_with("Foreign"),
        ["160250 ForeignGuardMasterGone", "160251 ForeignGuardMaster"]
    );
}

#[test]
fn r_det_045_a_state_frame_nobody_asked_for_counts_but_not_its_toggle_bit() {
    let mut bench = running_with(mute());
    bench.run(1100).take();
    bench.frame(1200, "701#85").frame(1300, "701#85").run(1599);
    assert_eq!(bench.take(), ["1200 UnsolicitedState", "1500 701#R1"], "told once, no toggle error");
    bench.run(2100);
    assert_eq!(
        bench.take_those_with("Missed"),
        ["1600 GuardMissed { consecutive: 1 }", "2100 GuardMissed { consecutive: 2 }"]
    );
    bench.frame(2200, "701#04");
    assert_eq!(
        bench.take(),
        [
            "2200 State { from: Some(Operational), to: Stopped, ordered: false }",
            "2200 000#0101",
            "2200 NmtSent { request: Start }",
        ]
    );
}

#[test]
fn r_det_045_a_reply_that_always_comes_late_loses_no_node() {
    let mut bench = running_with(mute());
    for request in 1..=20 {
        bench.run(500 * request).frame(500 * request + 150, "701#05");
    }
    let told = bench.take();
    assert_eq!(told.iter().filter(|line| line.contains("GuardMissed { consecutive: 1 }")).count(), 20);
    assert!(told.iter().all(|line| !line.contains("Lost")), "{told:?}");
}
