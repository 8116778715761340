//! What is measured: worked frames, overloads, counters, zero and offset, errors.

use super::bench::{Bench, quiet};
use crate::simulator::dst_p92c::DstSettings;

/// A device in Operational that sends one TPDO1 now and then none by itself.
fn sender(node: u8, mapping: &[u32], units: [u32; 4]) -> Bench {
    let mut bench = Bench::of_node(node, &DstSettings { default_transmission_type: 255, ..quiet() });
    bench.run_for(200);
    assert_eq!(bench.write(0x1800, 5, 2, 0), 0);
    map(&mut bench, mapping);
    let [pressure, digits, temperature, temperature_digits] = units;
    for (index, sub, length, value) in [
        (0x6131, 1, 4, pressure),
        (0x6132, 1, 1, digits),
        (0x6131, 2, 4, temperature),
        (0x6132, 2, 1, temperature_digits),
    ] {
        assert_eq!(bench.write(index, sub, length, value), 0);
    }
    bench
}

fn map(bench: &mut Bench, mapping: &[u32]) {
    assert_eq!(bench.write(0x1A00, 0, 1, 0), 0);
    for (sub, entry) in (1..).zip(mapping) {
        assert_eq!(bench.write(0x1A00, sub, 4, *entry), 0);
    }
    assert_eq!(bench.write(0x1A00, 0, 1, u32::try_from(mapping.len()).unwrap()), 0);
}

/// The TPDO1 that comes when the device is started.
fn first_tpdo(bench: &mut Bench) -> String {
    bench.frame("000#8000");
    bench.take();
    bench.frame("000#0100");
    let mut sent = bench.frames();
    sent.retain(|frame| frame.starts_with("18"));
    assert_eq!(sent.len(), 1, "{sent:?}");
    sent.remove(0)
}

const PA: [u32; 4] = [0x0022_0000, 0, 0x002D_0000, 0];
const DEFAULT: [u32; 2] = [0x9130_0120, 0x6150_0108];

#[test]
fn v_dst_01_to_05_r_dst_012_014_015_016_025_031_032_the_default_mapping_in_each_unit() {
    for (units, orders, frame) in [
        (PA, &["pressure 1"][..], "181#A086010000"),
        (PA, &["pressure -0.01"], "181#18FCFFFF04"),
        ([0x004E_0000, 3, 0x002D_0000, 0], &["pressure 12.345"], "181#3930000000"),
        ([0xFD4E_0000, 1, 0x002D_0000, 0], &["pressure 5"], "181#50C3000000"),
        (PA, &["set 9130 1 2147483647", "set 6150 1 0xF9"], "181#FFFFFF7FF9"),
        (PA, &["sensor 1 bad"], "181#FFFFFF7F01"),
    ] {
        let mut bench = sender(1, &DEFAULT, units);
        for order in orders {
            bench.order(order);
        }
        assert_eq!(first_tpdo(&mut bench), frame);
    }
    // V-DST-04 has a span that ends below 5 bar.
    let settings =
        DstSettings { span_bar: 4.0, pressure_bar: 5.0, default_transmission_type: 255, ..quiet() };
    let mut bench = Bench::ready_as(&settings);
    bench.write(0x6131, 1, 4, 0xFD4E_0000);
    bench.write(0x6132, 1, 1, 1);
    assert_eq!(first_tpdo(&mut bench), "181#50C3000002");
}

#[test]
fn v_dst_06_to_09_r_dst_016_018_025_029_032_other_mappings() {
    let mut bench = sender(1, &[0x6130_0120, 0x9130_0220], [0x004E_0000, 0, 0x002D_0000, 0]);
    bench.order("pressure 1.5");
    bench.order("temperature 25");
    assert_eq!(first_tpdo(&mut bench), "181#0000C03F19000000");

    let units = [0x00AB_0000, 2, 0x00AC_0000, 1];
    let mut bench = sender(5, &[0x9130_0120, 0x6150_0108, 0x6150_0208], units);
    bench.order("pressure 85.11991564");
    assert_eq!(first_tpdo(&mut bench), "185#40E201000000");

    let mut bench = sender(1, &[0x6130_0120, 0x6130_0220], [0x004E_0000, 0, 0x00AC_0000, 0]);
    bench.order("temperature 10");
    bench.order("sensor 1 bad");
    assert_eq!(first_tpdo(&mut bench), "181#0000C07F00004842");

    let mut bench = sender(1, &[0x9130_0220, 0x6150_0208], [0x0022_0000, 0, 0x002D_0000, 2]);
    bench.order("temperature -40");
    assert_eq!(first_tpdo(&mut bench), "181#60F0FFFF00");
}

#[test]
fn v_dst_10_r_dst_017_tpdo1_is_as_long_as_its_mapping() {
    for (mapping, length) in [
        (&DEFAULT[..], 5),
        (&[0x6150_0208], 1),
        (&[0x9130_0120, 0x9130_0220], 8),
        (&[0x6150_0108, 0x6150_0208, 0x9130_0120], 6),
        (&[0x6150_0108, 0x6150_0108, 0x6150_0108, 0x6150_0108], 4),
    ] {
        let mut bench = sender(1, mapping, PA);
        assert_eq!(first_tpdo(&mut bench).len(), 4 + 2 * length);
        let unused = u8::try_from(mapping.len()).unwrap() + 1..=4;
        for sub in unused {
            assert_eq!(bench.read(0x1A00, sub), 0);
        }
    }
}

#[test]
fn r_dst_031_a_unit_holds_for_float_and_integer_and_the_span() {
    let mut bench = Bench::ready();
    bench.order("pressure 100");
    let float = |raw: u32| f32::from_bits(raw).to_string();
    assert_eq!((float(bench.read(0x6130, 1)), bench.read(0x9130, 1)), ("10000000".to_owned(), 10_000_000));
    assert_eq!(float(bench.read(0x6149, 1)), "40000000");
    bench.write(0x6131, 1, 4, 0x004E_0000);
    bench.write(0x6132, 1, 1, 2);
    assert_eq!((float(bench.read(0x6130, 1)), bench.read(0x9130, 1)), ("100".to_owned(), 10_000));
    assert_eq!((float(bench.read(0x6149, 1)), bench.read(0x9149, 1)), ("400".to_owned(), 40_000));
    bench.write(0x6131, 2, 4, 0x00AC_0000);
    assert_eq!(
        (float(bench.read(0x6148, 2)), float(bench.read(0x6149, 2))),
        ("-40".to_owned(), "257".to_owned())
    );
    bench.write(0x6131, 2, 4, 0x0005_0000);
    bench.write(0x6132, 2, 1, 2);
    assert_eq!((bench.read(0x9148, 2), bench.read(0x9149, 2)), (23_315, 39_815));
}

#[test]
fn v_dst_11_r_dst_074_075_076_077_079_080_082_each_error_has_its_code_and_its_bits() {
    let mut bench = Bench::ready();
    for (code, frame) in [
        ("F011", "081#11F0210000000000"),
        ("4000", "081#0040090000000000"),
        ("8100", "081#0081110000000000"),
        ("6363", "081#6363210000000000"),
        ("6161", "081#6161810000000000"),
        ("6300", "081#0063810000000000"),
        ("6163", "081#6361010000000000"),
    ] {
        bench.order(&format!("emcy {code}"));
        assert_eq!(bench.frames(), [frame]);
        let register = u32::from_str_radix(&frame[8..10], 16).unwrap();
        assert_eq!(bench.read(0x1001, 0), register, "{code}");
        let code = u32::from_str_radix(code, 16).unwrap();
        assert_eq!(bench.read(0x1003, 1), register << 16 | code);
        bench.take();
        bench.order("emcy clear");
        assert_eq!(bench.frames(), ["081#0000000000000000"]);
        assert_eq!((bench.read(0x1001, 0), bench.read(0x1003, 1)), (0, 0));
        bench.take();
    }
    bench.order("emcy F011");
    bench.talk(&[
        ("601#4003100100000000", "581#4303100111F02100"),
        ("601#2F03100000000000", "581#6003100000000000"),
        ("601#4003100100000000", "581#4303100100000000"),
        ("601#4003100000000000", "581#4F03100000000000"),
    ]);
}

#[test]
fn r_dst_025_075_082_088_an_overload_raises_status_counter_register_and_emergency_together() {
    let mut bench = Bench::ready();
    for (order, end, status_sub, status, counter, code) in [
        ("pressure 401", "pressure off", 1, 0x02, 0x3000, "11F021"),
        ("pressure -1", "pressure off", 1, 0x04, 0x3001, "11F021"),
        ("temperature 126", "temperature off", 2, 0x02, 0x3002, "004009"),
        ("temperature -41", "temperature off", 2, 0x04, 0x3003, "004009"),
    ] {
        for times in 1..=2 {
            bench.take();
            bench.order(order);
            bench.run_for(200);
            assert_eq!(bench.of("081#"), [format!("081#{code}0000000000")], "{order}");
            assert_eq!(bench.read(0x6150, status_sub), status, "{order}");
            assert_eq!(bench.read(counter, 0), times, "{order}");
            bench.order(end);
            assert_eq!((bench.read(0x6150, status_sub), bench.read(0x1001, 0)), (0, 0));
        }
        assert_eq!(bench.write(counter, 0, 2, 0), 0);
        assert_eq!(bench.read(counter, 0), 0);
    }
}

#[test]
fn r_dst_025_075_a_broken_sensor_is_invalid_and_an_error_but_no_overload() {
    let mut bench = Bench::ready();
    bench.order("sensor 2 bad");
    assert_eq!(bench.frames(), ["081#0040090000000000"]);
    assert_eq!((bench.read(0x6150, 2), bench.read(0x3002, 0)), (1, 0));
    bench.order("sensor 1 bad");
    assert_eq!(bench.of("081#"), ["081#11F0290000000000"]);
    bench.order("sensor 2 good");
    bench.order("sensor 1 good");
    assert_eq!(bench.of("081#"), ["081#11F0210000000000", "081#0000000000000000"]);
}

#[test]
fn r_dst_086_zero_makes_the_present_pressure_the_zero_and_keeps_it_when_saved() {
    let mut bench = Bench::ready();
    bench.order("pressure 2");
    assert_eq!(bench.write(0x6125, 1, 4, 0x6F72_657B), 0x0609_0030);
    assert_eq!(bench.write(0x6125, 1, 4, 0x6F72_657A), 0);
    assert_eq!(bench.read(0x9130, 1), 0);
    bench.write(0x1010, 1, 4, 0x6576_6173);
    bench.order("pressure 3");
    assert_eq!(bench.read(0x9130, 1), 100_000);
    bench.order("power cycle");
    bench.run_for(200);
    assert_eq!(bench.read(0x9130, 1), 100_000);
}

#[test]
fn r_dst_087_both_offsets_are_added_in_the_unit_of_the_device() {
    let mut bench = Bench::ready();
    bench.write(0x6131, 1, 4, 0x004E_0000);
    bench.write(0x6132, 1, 1, 2);
    bench.order("pressure 10");
    bench.write(0x6124, 1, 4, 0.5_f32.to_bits());
    assert_eq!((f32::from_bits(bench.read(0x6130, 1)), bench.read(0x9130, 1)), (10.5, 1050));
    bench.write(0x9124, 1, 4, (-25_i32).cast_unsigned());
    assert_eq!((f32::from_bits(bench.read(0x6130, 1)), bench.read(0x9130, 1)), (10.25, 1025));
}

#[test]
fn r_dst_049_interrupt_limits_are_kept_and_have_no_effect() {
    let mut bench = Bench::operational();
    bench.write(0x9135, 1, 4, 1);
    bench.write(0x9134, 1, 4, 1);
    bench.write(0x6135, 1, 4, 1.0_f32.to_bits());
    bench.take();
    bench.order("pressure 300");
    bench.run_for(100);
    assert!(bench.frames().is_empty());
    assert_eq!((bench.read(0x9135, 1), bench.read(0x9134, 1)), (1, 1));
}

#[test]
fn what_is_set_stays_until_it_is_given_back() {
    let mut bench = Bench::ready();
    bench.order("set 6150 1 0x06");
    bench.order("set 1800 5 0");
    bench.run_for(500);
    assert_eq!((bench.read(0x6150, 1), bench.read(0x1800, 5)), (6, 0));
    bench.order("set 6150 1 off");
    bench.order("set 1800 5 off");
    assert_eq!((bench.read(0x6150, 1), bench.read(0x1800, 5)), (0, 1000));
}
