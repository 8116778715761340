//! The object dictionary by SDO: what is there, what can be written, save and load.

use super::super::object_table::{Access, TABLE, Type};
use super::bench::{Bench, quiet};
use crate::canopen::NodeId;
use crate::simulator::Device;
use crate::simulator::dst_p92c::DstSettings;

#[test]
fn r_dst_002_003_004_008_everything_has_its_default_at_its_place() {
    let mut bench = Bench::of_node(5, &quiet());
    bench.run_for(200);
    for entry in TABLE.iter().filter(|entry| entry.kind != Type::Text && entry.access != Access::Wo) {
        let (index, sub) = entry.key;
        let expected = match (index, sub) {
            (0x1014, 0) => 0x85,
            (0x1800, 1) => 0x185,
            (0x1018, 2) => 0x1234_5678,
            (0x1018, 3) => 0x0001_0203,
            (0x1018, 4) => 123_460,
            (0x4F01, 0) => 5,
            (0x6130 | 0x6148 | 0x6149 | 0x7100 | 0x9130 | 0x9148 | 0x9149, 1..) => continue,
            _ => entry.default,
        };
        assert_eq!(bench.read(index, sub), expected, "{index:04X}/{sub}");
    }
    let mut factory = Bench::ready();
    assert_eq!((factory.read(0x4F00, 0), factory.read(0x4F01, 0)), (4, 1));
}

#[test]
fn v_dst_16_r_dst_008_009_010_011_039_068_accesses_that_are_refused() {
    let mut bench = Bench::ready();
    bench.talk(&[
        ("601#2300100000000000", "581#8000100002000106"),
        ("601#4025610100000000", "581#8025610101000106"),
        ("601#4000200000000000", "581#8000200000000206"),
        ("601#4018100500000000", "581#8018100511000906"),
        ("601#2F00180202000000", "581#8000180230000906"),
        ("601#2F001A0000000000", "581#60001A0000000000"),
        ("601#23001A0108000110", "581#80001A0141000406"),
        ("601#23001A0120013061", "581#60001A0100000000"),
        ("601#23001A0220023061", "581#60001A0200000000"),
        ("601#23001A0308015061", "581#60001A0300000000"),
        ("601#2F001A0003000000", "581#80001A0042000406"),
        ("601#2F00180505000000", "581#8000180513000706"),
        ("601#2300180505000000", "581#8000180512000706"),
    ]);
}

#[test]
fn r_dst_009_every_entry_has_its_access() {
    let mut bench = Bench::ready();
    for entry in &TABLE {
        let (index, sub) = entry.key;
        let length = entry.kind.length().map_or(4, |length| u8::try_from(length).unwrap());
        let code = bench.write(index, sub, length, 0);
        assert_eq!(code == 0x0601_0002, entry.access == Access::Ro, "{index:04X}/{sub}: {code:08X}");
    }
}

#[test]
fn v_dst_13_14_r_dst_012_065_066_067_070_measured_values_and_parameters() {
    let mut bench = Bench::ready();
    bench.order("temperature 25");
    bench.order("pressure 1");
    bench.talk(&[
        ("601#4030910100000000", "581#43309101A0860100"),
        ("601#4030610200000000", "581#433061020000C841"),
        ("601#4030910200000000", "581#4330910219000000"),
        ("601#4000180500000000", "581#4B001805E8030000"),
        ("601#2331610100004E00", "581#6031610100000000"),
    ]);
    bench.order("pressure 1.5");
    bench.talk(&[
        ("601#4030610100000000", "581#433061010000C03F"),
        ("601#2F001802FF000000", "581#6000180200000000"),
        ("601#2B001805FA000000", "581#6000180500000000"),
        ("601#2F00180201000000", "581#6000180200000000"),
        // Not eight bytes: not an SDO request.
        ("601#40001805", "-"),
        ("601#", "-"),
        ("601#R8", "-"),
    ]);
}

#[test]
fn v_dst_21_r_dst_072_texts_come_in_segments() {
    let mut bench = Bench::ready();
    bench.talk(&[
        ("601#4008100000000000", "581#4108100010000000"),
        ("601#6000000000000000", "581#0044535420503932"),
        ("601#7000000000000000", "581#10432043414E6F70"),
        ("601#6000000000000000", "581#0B656E0000000000"),
        ("601#4009100000000000", "581#4109100006000000"),
        ("601#6000000000000000", "581#03312E3030723100"),
        ("601#40004E0400000000", "581#41004E040E000000"),
        ("601#6000000000000000", "581#0031312E32323333"),
        ("601#7000000000000000", "581#1134342E35353636"),
    ]);
    bench.talk(&[("601#A40810007F000000", "581#C608100010000000")]);
    bench.frame("601#A300000000000000");
    bench.run_for(2);
    assert_eq!(bench.frames(), ["581#0144535420503932", "581#02432043414E6F70", "581#83656E0000000000"]);
}

#[test]
fn v_dst_17_r_dst_028_030_033_units_and_digits() {
    let mut bench = Bench::ready();
    bench.talk(&[
        ("601#2331610100004E00", "581#6031610100000000"),
        ("601#233161010000AB00", "581#6031610100000000"),
        ("601#2331610100004EFD", "581#6031610100000000"),
        ("601#2331610100004E00", "581#6031610100000000"),
        ("601#2F32610103000000", "581#6032610100000000"),
        ("601#4031610100000000", "581#4331610100004E00"),
        ("601#23801F0008000000", "581#60801F0000000000"),
        ("601#232561017A65726F", "581#6025610100000000"),
        ("601#2310100173617665", "581#6010100100000000"),
        ("601#231110016C6F6164", "581#6011100100000000"),
    ]);
}

#[test]
fn r_dst_029_033_units_and_digits_outside_their_range_are_refused() {
    let mut bench = Bench::ready();
    for (unit, most) in [(0x004E_0000, 5), (0x00AB_0000, 3), (0x0022_0000, 0), (0xFD4E_0000, 2)] {
        assert_eq!(bench.write(0x6131, 1, 4, unit), 0);
        assert_eq!(bench.write(0x6132, 1, 1, most), 0, "{unit:08X}");
        assert_eq!(bench.write(0x6132, 1, 1, most + 1), 0x0609_0030, "{unit:08X}");
    }
    for unit in [0x002D_0000, 0x00AC_0000, 0x0005_0000] {
        assert_eq!(bench.write(0x6131, 2, 4, unit), 0);
    }
    for (sub, unit) in [(1, 0x002D_0000), (1, 0xFD22_0000), (2, 0x004E_0000), (2, 0xFD05_0000)] {
        assert_eq!(bench.write(0x6131, sub, 4, unit), 0x0609_0030, "{unit:08X}");
    }
    assert_eq!((bench.write(0x6132, 2, 1, 5), bench.write(0x6132, 2, 1, 6)), (0, 0x0609_0030));
    // Digits that the next unit does not allow are gone.
    bench.write(0x6131, 1, 4, 0x004E_0000);
    bench.write(0x6132, 1, 1, 5);
    bench.write(0x6131, 1, 4, 0x00AB_0000);
    assert_eq!(bench.read(0x6132, 1), 0);
}

#[test]
fn r_dst_005_011_058_089_120_other_values_outside_their_range() {
    let mut bench = Bench::ready();
    for (index, sub, length, good, bad) in [
        (0x1005, 0, 4, 0x81, 0x2000_0080_u32),
        (0x1800, 1, 4, 0x8000_0181, 0x2000_0181),
        (0x1F80, 0, 4, 8, 5),
        (0x4F01, 0, 1, 127, 128),
        (0x4F01, 0, 1, 1, 0),
        (0x61A0, 1, 1, 2, 3),
        (0x61A1, 1, 1, 255, 256),
        (0x1003, 0, 1, 0, 1),
    ] {
        assert_eq!(bench.write(index, sub, length, good), 0, "{index:04X}/{sub}");
        if bad <= 0xFF || length == 4 {
            assert_eq!(bench.write(index, sub, length, bad), 0x0609_0030, "{index:04X}/{sub}");
        }
    }
    assert_eq!(bench.read(0x61A0, 1), 2);
    assert_eq!(bench.write(0x6124, 1, 4, f32::NAN.to_bits()), 0x0609_0030);
    assert_eq!(bench.write(0x6124, 1, 4, 1.5_f32.to_bits()), 0);
}

#[test]
fn v_dst_18_r_dst_007_056_116_117_node_id_and_bit_rate_by_sdo() {
    let mut bench = Bench::ready();
    bench.talk(&[
        ("601#2F004F0003000000", "581#60004F0000000000"),
        ("601#2F014F0005000000", "581#60014F0000000000"),
        ("601#2F004F0005000000", "581#80004F0030000906"),
        ("601#2F014F0080000000", "581#80014F0030000906"),
        // Nothing has changed yet.
        ("601#4014100000000000", "581#4314100081000000"),
        ("601#2310100173617665", "581#6010100100000000"),
    ]);
    bench.frame("000#8101");
    bench.run_for(1000);
    assert_eq!(bench.frames(), [""; 0], "the bus still runs at 125 kbit/s");
    assert!(bench.device.status().says("not at the bit rate of the bus"));
    bench.order("bus 250");
    bench.order("power cycle");
    bench.run_for(200);
    assert_eq!(bench.frames(), ["705#00"]);
    bench.talk(&[
        ("605#40004F0000000000", "585#4F004F0003000000"),
        ("605#4014100000000000", "585#4314100085000000"),
        ("605#4000180100000000", "585#4300180185010000"),
    ]);
    for (index, good) in (0..=8).map(|index| (index, index <= 7 && index != 5)) {
        assert_eq!(bench.write(0x4F00, 0, 1, index) == 0, good, "{index}");
    }
}

#[test]
fn r_dst_117_an_address_that_was_not_saved_is_lost_unless_the_device_keeps_it() {
    for (address_needs_save, node) in [(true, 1), (false, 5)] {
        let mut bench = Bench::ready_as(&DstSettings { address_needs_save, ..quiet() });
        assert_eq!(bench.write(0x4F01, 0, 1, 5), 0);
        assert_eq!((bench.read(0x4F01, 0), bench.device.dst().node().get()), (5, 1));
        bench.frame("000#8101");
        bench.run_for(200);
        assert_eq!(bench.device.dst().node(), NodeId::new(node).unwrap());
    }
}

#[test]
fn r_dst_084_what_is_saved_survives_and_what_is_not_does_not() {
    let mut bench = Bench::ready();
    assert_eq!(bench.write(0x1800, 5, 2, 250), 0);
    bench.order("power cycle");
    bench.run_for(200);
    assert_eq!(bench.read(0x1800, 5), 1000);
    for (index, sub, length, value) in
        [(0x1800, 5, 2, 250), (0x1017, 0, 2, 700), (0x6131, 1, 4, 0x004E_0000), (0x61A1, 1, 1, 7)]
    {
        assert_eq!(bench.write(index, sub, length, value), 0);
    }
    assert_eq!(bench.write(0x1010, 1, 4, 0x6576_6174), 0x0609_0030);
    assert_eq!(bench.write(0x1010, 1, 4, 0x6576_6173), 0);
    assert_eq!(bench.read(0x1010, 1), 1);
    bench.order("power cycle");
    bench.run_for(200);
    assert_eq!((bench.read(0x1800, 5), bench.read(0x61A1, 1)), (250, 7));
    bench.take();
    bench.run_for(1400);
    assert_eq!(bench.of("701#7F").len(), 2, "heartbeats without being asked for again");
}

#[test]
fn r_dst_085_restored_defaults_become_active_after_a_reset() {
    let mut bench = Bench::ready();
    bench.write(0x1800, 5, 2, 250);
    bench.write(0x1010, 1, 4, 0x6576_6173);
    assert_eq!(bench.write(0x1011, 1, 4, 0), 0x0609_0030);
    assert_eq!(bench.write(0x1011, 1, 4, 0x6461_6F6C), 0);
    assert_eq!(bench.read(0x1800, 5), 250);
    bench.frame("000#8101");
    bench.run_for(200);
    assert_eq!(bench.read(0x1800, 5), 1000);
}

#[test]
fn r_dst_004_013_identifiers_follow_the_node_id_unless_they_were_written() {
    let mut bench = Bench::ready();
    bench.write(0x4F01, 0, 1, 9);
    bench.write(0x1010, 1, 4, 0x6576_6173);
    bench.frame("000#8101");
    bench.run_for(200);
    assert_eq!((bench.read(0x1014, 0), bench.read(0x1800, 1)), (0x89, 0x189));
    bench.write(0x1800, 1, 4, 0x1F0);
    bench.write(0x4F01, 0, 1, 10);
    bench.write(0x1010, 1, 4, 0x6576_6173);
    bench.frame("000#8109");
    bench.run_for(200);
    assert_eq!((bench.read(0x1014, 0), bench.read(0x1800, 1)), (0x8A, 0x1F0));
}

#[test]
fn accesses_fail_and_answers_are_late_or_missing_when_they_are_ordered_to() {
    let mut bench = Bench::ready();
    bench.order("abort 1017 0 06060000");
    assert_eq!(bench.write(0x1017, 0, 2, 100), 0x0606_0000);
    bench.talk(&[("601#4017100000000000", "581#8017100000000606")]);
    bench.order("abort 1017 0 off");
    assert_eq!(bench.read(0x1017, 0), 0);
    bench.order("mute sdo on");
    assert_eq!(bench.ask("601#4017100000000000"), "-");
    bench.order("mute sdo off");
    bench.order("late sdo 700");
    let asked = bench.now();
    bench.frame("601#4017100000000000");
    bench.run_for(1000);
    assert_eq!(bench.times("581#4B171000"), [asked + 700]);
}
