//! Layer setting services: node id and bit rate without SDO.

use super::bench::{Bench, quiet};
use crate::canopen::NmtState;
use crate::simulator::dst_p92c::DstSettings;

/// In Stopped, as the guide asks for it.
fn stopped() -> Bench {
    let mut bench = Bench::ready();
    bench.frame("000#0200");
    bench
}

/// The device of V-DST-19 after switch state selective.
fn selected() -> Bench {
    let mut bench = stopped();
    bench.talk(&[
        ("7E5#403D020000000000", "-"),
        ("7E5#4178563412000000", "-"),
        ("7E5#4200000000000000", "-"),
        ("7E5#4340E20100000000", "7E4#4400000000000000"),
    ]);
    bench
}

#[test]
fn v_dst_19_r_dst_091_094_095_099_100_101_103_104_105_120_the_frames_of_each_service() {
    let mut bench = selected();
    bench.talk(&[
        ("7E5#5A00000000000000", "7E4#5A3D020000000000"),
        ("7E5#5B00000000000000", "7E4#5B78563412000000"),
        ("7E5#5C00000000000000", "7E4#5C03020100000000"),
        ("7E5#5D00000000000000", "7E4#5D40E20100000000"),
        ("7E5#5E00000000000000", "7E4#5E01000000000000"),
        ("7E5#1100000000000000", "7E4#1101000000000000"),
        ("7E5#1180000000000000", "7E4#1101000000000000"),
        ("7E5#1300050000000000", "7E4#1301000000000000"),
        ("7E5#1300080000000000", "7E4#1301000000000000"),
        ("7E5#1301030000000000", "7E4#1301000000000000"),
        ("7E5#1700000000000000", "7E4#17FF010000000000"),
        ("7E5#1105", "-"),
    ]);
}

#[test]
fn v_dst_19_r_dst_094_106_109_both_identify_services_in_both_states() {
    let identify = [
        ("7E5#463D020000000000", "-"),
        ("7E5#4778563412000000", "-"),
        ("7E5#4800000000000000", "-"),
        ("7E5#4900000000000000", "-"),
        ("7E5#4A00000000000000", "-"),
        ("7E5#4BFFFFFFFF000000", "7E4#4F00000000000000"),
    ];
    stopped().talk(&identify);
    selected().talk(&identify);
    let ask = |unconfigured| {
        let mut bench = Bench::ready_as(&DstSettings { unconfigured, ..quiet() });
        bench.frame("000#0200");
        bench.ask("7E5#4C00000000000000")
    };
    assert_eq!((ask(false).as_str(), ask(true).as_str()), ("-", "7E4#5000000000000000"));
}

#[test]
fn r_dst_097_098_102_113_the_sequence_of_the_guide() {
    let mut bench = stopped();
    bench.talk(&[
        ("7E5#0401000000000000", "-"),
        ("7E5#1105000000000000", "7E4#1100000000000000"),
        ("7E5#1300030000000000", "7E4#1300000000000000"),
        ("7E5#1700000000000000", "7E4#1700000000000000"),
    ]);
    let activated = bench.now();
    bench.frame("7E5#1564000000000000");
    bench.run_for(100);
    bench.order("bus 250");
    bench.run_for(200);
    assert_eq!(bench.take(), [(activated + 200, "701#00".to_owned())], "the old node id");
    assert_eq!(bench.state(), Some(NmtState::Stopped));
    bench.frame("7E5#0400000000000000");
    assert_eq!(bench.frames(), ["705#00"]);
    assert_eq!(bench.state(), Some(NmtState::PreOperational));
    bench.talk(&[
        ("605#40014F0000000000", "585#4F014F0005000000"),
        ("605#40004F0000000000", "585#4F004F0003000000"),
        ("605#4000180100000000", "585#4300180185010000"),
    ]);
}

#[test]
fn r_dst_114_a_power_cycle_does_instead_of_the_last_steps() {
    let mut bench = stopped();
    bench.talk(&[
        ("7E5#0401000000000000", "-"),
        ("7E5#1105000000000000", "7E4#1100000000000000"),
        ("7E5#1700000000000000", "7E4#1700000000000000"),
    ]);
    bench.order("power cycle");
    bench.run_for(200);
    assert_eq!(bench.frames(), ["705#00"]);
    assert_eq!(bench.state(), Some(NmtState::PreOperational));
}

#[test]
fn r_dst_093_in_configuration_state_no_nmt_command_is_executed() {
    let mut bench = selected();
    for command in ["000#0101", "000#8001", "000#8101", "000#8200"] {
        bench.frame(command);
        assert_eq!(bench.state(), Some(NmtState::Stopped), "{command}");
    }
    bench.frame("7E5#0400000000000000");
    bench.frame("000#0101");
    assert_eq!(bench.state(), Some(NmtState::Operational));
}

#[test]
fn r_dst_096_105_only_what_is_stored_is_shown_and_what_is_not_is_lost() {
    let mut bench = selected();
    bench.talk(&[
        ("7E5#1105000000000000", "7E4#1100000000000000"),
        ("7E5#5E00000000000000", "7E4#5E01000000000000"),
    ]);
    bench.frame("7E5#0400000000000000");
    bench.frame("000#8001");
    bench.run_for(100);
    assert!(bench.frames().is_empty(), "no boot-up: the node id is the old one");
    assert_eq!(bench.read(0x4F01, 0), 1);
    bench.frame("000#0200");
    bench.talk(&[
        ("7E5#0401000000000000", "-"),
        ("7E5#1105000000000000", "7E4#1100000000000000"),
        ("7E5#1700000000000000", "7E4#1700000000000000"),
        ("7E5#5E00000000000000", "7E4#5E05000000000000"),
    ]);
}

#[test]
fn r_dst_102_only_the_stored_bit_timing_is_activated() {
    let mut bench = selected();
    bench.talk(&[("7E5#1300030000000000", "7E4#1300000000000000")]);
    bench.frame("7E5#1532000000000000");
    bench.run_for(99);
    assert_eq!(bench.ask("7E5#5E00000000000000"), "-", "deaf while it switches");
    bench.run_for(100);
    // It was not stored: the device is where it was.
    assert_eq!(bench.ask("7E5#5E00000000000000"), "7E4#5E01000000000000");
}

#[test]
fn r_dst_007_101_116_at_another_bit_rate_than_the_bus_it_is_deaf_and_mute() {
    let mut bench = Bench::ready();
    for (index, kbit) in [(0, 1000), (1, 800), (2, 500), (3, 250), (6, 50), (7, 20), (4, 125)] {
        bench.frame("000#0200");
        bench.frame("7E5#0401000000000000");
        bench.talk(&[
            (format!("7E5#1300{index:02X}0000000000").as_str(), "7E4#1300000000000000"),
            ("7E5#1700000000000000", "7E4#1700000000000000"),
        ]);
        bench.frame("7E5#150A000000000000");
        bench.run_for(100);
        assert!(bench.frames().is_empty());
        assert_eq!(bench.ask("7E5#5E00000000000000"), "-");
        bench.order(&format!("bus {kbit}"));
        assert_eq!(bench.ask("7E5#5E00000000000000"), "7E4#5E01000000000000");
        bench.frame("7E5#0400000000000000");
        bench.frame("000#8001");
        assert_eq!(bench.read(0x4F00, 0), index);
    }
    // A bus that takes every bit rate, as vcan does.
    bench.order("bus 0");
    bench.frame("000#0200");
    bench.talk(&[
        ("7E5#0401000000000000", "-"),
        ("7E5#1300030000000000", "7E4#1300000000000000"),
        ("7E5#1700000000000000", "7E4#1700000000000000"),
    ]);
    bench.frame("7E5#150A000000000000");
    bench.run_for(100);
    assert_eq!(bench.frames(), ["701#00"]);
}

#[test]
fn r_dst_094_outside_stopped_and_with_heartbeats_lss_is_not_served_unless_the_device_does() {
    let ask = |bench: &mut Bench| {
        bench.frame("7E5#0401000000000000");
        bench.ask("7E5#5E00000000000000") != "-"
    };
    assert!(!ask(&mut Bench::ready()));
    let mut bench = Bench::ready();
    bench.write(0x1017, 0, 2, 5000);
    bench.frame("000#0200");
    assert!(!ask(&mut bench));
    assert!(ask(&mut stopped()));
    assert!(ask(&mut Bench::ready_as(&DstSettings { lss_in_any_state: true, ..quiet() })));
}

#[test]
fn r_dst_095_devices_of_one_simulation_have_serial_numbers_of_their_own() {
    let serial = |node| {
        let mut bench = Bench::of_node(node, &quiet());
        bench.run_for(200);
        bench.read(0x1018, 4)
    };
    assert_eq!((serial(1), serial(2), serial(127)), (123_456, 123_457, 123_582));
}
