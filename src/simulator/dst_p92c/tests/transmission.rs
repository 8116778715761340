//! When TPDO1 is sent, and its re-mapping.

use super::bench::{Bench, quiet};
use crate::simulator::dst_p92c::DstSettings;

#[test]
fn v_dst_20_r_dst_040_043_046_with_type_1_it_comes_after_each_sync_and_only_then() {
    let mut bench = Bench::ready();
    bench.order("pressure 1");
    assert_eq!(bench.read(0x1800, 2), 1);
    bench.frame("000#0101");
    bench.run_for(5000);
    assert_eq!(bench.of("181"), [""; 0]);
    let start = bench.now();
    bench.frame("080#");
    bench.run_for(100);
    bench.order("pressure 1.00001");
    bench.frame("080#");
    bench.run_for(100);
    let sent = bench.take();
    assert_eq!(sent[0], (start + 1, "181#A086010000".to_owned()));
    assert_eq!(sent[1], (start + 101, "181#A186010000".to_owned()));
    assert_eq!(sent.len(), 2);
    // The extended identifier of the same number is another frame (R-DST-005), and so is a remote frame.
    bench.frame("00000080#");
    bench.frame("080#R0");
    bench.run_for(100);
    assert!(bench.frames().is_empty());
    assert_eq!(bench.write(0x1005, 0, 4, 0x90), 0);
    bench.take();
    bench.frame("080#");
    bench.frame("090#01");
    bench.run_for(100);
    assert_eq!(bench.of("181").len(), 1);
}

#[test]
fn r_dst_041_043_046_123_with_type_255_it_comes_at_the_start_and_with_the_event_timer() {
    let mut bench = Bench::operational();
    let start = bench.now();
    bench.run_for(3500);
    assert_eq!(bench.times("181"), [start, start + 1000, start + 2000, start + 3000]);
    bench.talk(&[("601#2B001805FA000000", "581#6000180500000000")]);
    let written = bench.now() - 2;
    bench.run_to(written + 1100);
    assert_eq!(bench.times("181"), [250, 500, 750, 1000].map(|after| written + after));
    bench.write(0x1800, 5, 2, 0);
    bench.run_for(70_000);
    assert!(bench.of("181").is_empty(), "0 stops the timer");
    bench.write(0x1800, 5, 2, 1);
    bench.take();
    bench.run_for(1000);
    assert!((998..=1000).contains(&bench.of("181").len()));
    bench.frame("000#0201");
    bench.run_for(1000);
    assert!(bench.of("181").is_empty());
}

#[test]
fn r_dst_042_a_change_by_the_delta_is_told_at_once() {
    for (index, delta) in [(0x6133, 2.0_f32.to_bits()), (0x9133, 20)] {
        let mut bench = Bench::operational();
        for (at, sub, length, value) in
            [(0x1800, 5, 2, 0), (0x6131, 1, 4, 0x004E_0000), (0x6132, 1, 1, 1), (index, 1, 4, delta)]
        {
            assert_eq!(bench.write(at, sub, length, value), 0);
        }
        bench.order("pressure 100");
        bench.run_for(100);
        bench.take();
        bench.order("pressure 101.9");
        bench.run_for(100);
        assert!(bench.of("181").is_empty(), "{index:04X}");
        bench.order("pressure 102");
        assert_eq!(bench.of("181#FC03").len(), 1, "{index:04X}");
        bench.order("pressure 100.05");
        bench.run_for(100);
        assert!(bench.of("181").is_empty(), "{index:04X}: counted from the last that was sent");
        bench.order("pressure 99.9");
        assert_eq!(bench.of("181").len(), 1, "{index:04X}");
        bench.write(index, 1, 4, 0);
        bench.take();
        bench.order("pressure 300");
        bench.run_for(100);
        assert!(bench.of("181").is_empty(), "{index:04X}: 0 = disabled");
    }
}

#[test]
fn r_dst_042_a_change_of_temperature_counts_too() {
    let mut bench = Bench::operational();
    bench.write(0x1800, 5, 2, 0);
    bench.write(0x6133, 2, 4, 0.5_f32.to_bits());
    bench.take();
    bench.order("temperature 45.5");
    assert_eq!(bench.of("181").len(), 1);
}

#[test]
fn r_dst_047_two_are_never_closer_than_the_inhibit_time() {
    let mut bench = Bench::operational();
    bench.write(0x1800, 5, 2, 10);
    bench.write(0x1800, 3, 2, 500);
    bench.write(0x9133, 1, 4, 1);
    bench.take();
    let start = bench.now();
    for step in 0..100 {
        bench.order(&format!("pressure {}", 100 + step));
        bench.run_for(7);
    }
    let times = bench.times("181");
    assert!(times.windows(2).all(|pair| pair[1] - pair[0] >= 50), "{times:?}");
    assert!(times.len() >= 13 && times[0] >= start, "{times:?}");
}

#[test]
fn v_dst_15_r_dst_019_020_021_re_mapping_in_three_steps() {
    let mut bench = Bench::operational();
    bench.write(0x6131, 1, 4, 0x004E_0000);
    bench.order("pressure 1.5");
    bench.order("temperature 25");
    bench.talk(&[("601#2F001A0000000000", "581#60001A0000000000")]);
    bench.run_for(3000);
    assert!(bench.of("181").is_empty(), "off while nothing is mapped");
    bench.talk(&[
        ("601#23001A0120013061", "581#60001A0100000000"),
        ("601#23001A0220023091", "581#60001A0200000000"),
        ("601#23001A0300000000", "581#60001A0300000000"),
        ("601#23001A0400000000", "581#60001A0400000000"),
        ("601#2F001A0002000000", "581#60001A0000000000"),
    ]);
    bench.run_for(1000);
    assert_eq!(bench.of("181"), ["181#0000C03F19000000"]);
}

#[test]
fn r_dst_018_019_022_mappings_that_are_refused() {
    let mut bench = Bench::ready();
    assert_eq!(bench.write(0x1A00, 1, 4, 0x6130_0120), 0x0604_0043, "while it is active");
    assert_eq!(bench.write(0x1A00, 0, 1, 0), 0);
    for entry in [0x6130_0110, 0x6130_0020, 0x6131_0120, 0x1001_0008, 0x0005_0008, 0x7100_0110] {
        assert_eq!(bench.write(0x1A00, 1, 4, entry), 0x0604_0041, "{entry:08X}");
    }
    for (sub, entry) in [(1, 0x9130_0120), (2, 0x9130_0220), (3, 0x6150_0108), (4, 0x6150_0208)] {
        assert_eq!(bench.write(0x1A00, sub, 4, entry), 0);
    }
    for (count, code) in [(4, 0x0604_0042), (3, 0x0604_0042), (5, 0x0604_0042), (255, 0x0604_0042), (2, 0)] {
        assert_eq!(bench.write(0x1A00, 0, 1, count), code, "{count}");
    }
    assert_eq!(bench.write(0x1A00, 0, 1, 0), 0);
    assert_eq!(bench.write(0x1A00, 0, 1, 3), 0x0604_0041, "the third is none");
}

#[test]
fn r_dst_013_tpdo1_has_the_identifier_of_its_object_and_none_while_that_is_not_valid() {
    let mut bench = Bench::operational();
    bench.run_for(1);
    bench.write(0x1800, 1, 4, 0x4000_01F3);
    bench.take();
    bench.run_for(1000);
    assert_eq!(bench.of("1F3").len(), 1);
    bench.write(0x1800, 1, 4, 0x8000_01F3);
    bench.take();
    bench.run_for(3000);
    assert!(bench.frames().is_empty());
}

#[test]
fn r_dst_043_the_factory_default_of_the_transmission_type_can_be_chosen() {
    for kind in [1, 255] {
        let mut bench = Bench::ready_as(&DstSettings { default_transmission_type: kind, ..quiet() });
        assert_eq!(bench.read(0x1800, 2), u32::from(kind));
        bench.frame("000#0101");
        bench.run_for(2500);
        assert_eq!(bench.of("181").len(), if kind == 1 { 0 } else { 3 });
    }
}

#[test]
fn a_muted_pdo_is_silent_and_comes_back() {
    let mut bench = Bench::operational();
    bench.take();
    bench.order("mute pdo on");
    bench.run_for(3000);
    assert!(bench.of("181").is_empty());
    bench.order("mute pdo off");
    bench.run_for(1000);
    assert_eq!(bench.of("181").len(), 1);
}
