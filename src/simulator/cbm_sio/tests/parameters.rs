//! User parameters and what they mean (R-ESD-012, R-ESD-090 to R-ESD-103).

use std::time::Duration;

use super::super::parameters::{Keep, Model, RATES, SerialMode, Trigger, TxMode};
use super::super::settings::SioSettings;
use super::bench::{Bench, prompt};

fn serial(raw: u16, channel: usize) -> Option<SerialMode> {
    SerialMode::decode(raw, &SioSettings::new(Model::Sio4), channel)
}

#[test]
fn r_esd_090_parameter_00_is_the_silence_after_a_reset() {
    let settings = SioSettings { replies_in_delay: true, ..SioSettings::new(Model::Sio4) };
    let mut bench = Bench::of(&settings, 0x12);
    bench.talk(&[("700#060000120567", "567#06002710"), ("700#860000120BB8", "-")]);
    bench.order("send 1 x");
    bench.run_to(2999);
    assert!(bench.frames().is_empty());
    bench.run_to(3000);
    assert_eq!(bench.frames(), ["0B4#78"]);
}

#[test]
fn r_esd_091_the_tx_mode_is_inhibit_time_longest_and_shortest_frame() {
    let mode = TxMode::decode(0x1411, false).unwrap();
    assert_eq!(mode, TxMode { inhibit: Duration::from_millis(20), most: 1, trigger: Trigger::Count(1) });
    let mode = TxMode::decode(0xFF88, false).unwrap();
    assert_eq!(mode, TxMode { inhibit: Duration::from_millis(255), most: 8, trigger: Trigger::Count(8) });
}

#[test]
fn r_esd_092_from_public_copies_the_longest_comes_first_unless_told_otherwise() {
    let mode = |min_first| TxMode::decode(0x1483, min_first).unwrap();
    assert_eq!((mode(false).most, mode(false).trigger), (8, Trigger::Count(3)));
    assert_eq!((mode(true).most, mode(true).trigger), (3, Trigger::Count(8)));
    let mut bench = Bench::of(&SioSettings { min_first: true, ..prompt(Model::Sio1) }, 0x23);
    bench.frame("700#8601002314B8");
    bench.say(1, b"ab\r");
    bench.run_for(100);
    assert_eq!(bench.frames(), ["15E#6162"]);
}

#[test]
fn r_esd_093_094_codes_9_to_e_are_taken_and_f_and_0_are_not() {
    let marks =
        [(0x9, 13, Keep::All), (0xA, 10, Keep::All), (0xB, 13, Keep::NoMark), (0xC, 10, Keep::NoMark)];
    let marks = marks.into_iter().chain([(0xD, 13, Keep::NoLineEnds), (0xE, 10, Keep::NoLineEnds)]);
    for (code, mark, keep) in marks {
        assert_eq!(TxMode::decode(0x1480 | code, false).unwrap().trigger, Trigger::Mark(mark, keep));
    }
    let mut bench = Bench::sio4(0x12);
    for wrong in ["148F", "1480", "1401", "1491", "0000"] {
        bench.frame(&format!("700#86010012{wrong}"));
        assert_eq!(bench.ask("700#060100120567"), "567#06011411", "{wrong}");
    }
    bench.talk(&[("700#86010012148E", "-"), ("700#060100120567", "567#0601148E")]);
}

#[test]
fn r_esd_095_096_each_direction_has_a_code_for_its_rate() {
    let mode = serial(0x1273, 0).unwrap();
    assert_eq!((mode.receive, mode.send), (19_200, 9_600));
    let named = [
        38400, 19200, 9600, 4800, 2400, 1200, 600, 300, 150, 7200, 14400, 28800, 57600, 115_200, 230_400,
        76800,
    ];
    assert_eq!(RATES, named);
    for code in 0..16_u16 {
        let mode = serial(code << 12 | code << 8 | 0x73, 0).unwrap();
        assert_eq!((mode.receive, mode.send), (named[usize::from(code)], named[usize::from(code)]));
    }
}

#[test]
fn r_esd_097_098_each_mode_bit_has_its_meaning() {
    let plain = serial(0x2213, 0).unwrap();
    assert!(!plain.cts && !plain.two_stop_bits && plain.odd_parity.is_none() && plain.data_bits == 8);
    assert_eq!(serial(0x2293, 0), Some(plain), "bit 7: what RTS does is not known");
    assert_eq!(serial(0x2253, 0), Some(SerialMode { cts: true, ..plain }));
    assert_eq!(serial(0x2233, 0), Some(SerialMode { two_stop_bits: true, ..plain }));
    assert_eq!(serial(0x2203, 0), Some(SerialMode { odd_parity: Some(false), ..plain }));
    assert_eq!(serial(0x2207, 0), Some(SerialMode { odd_parity: Some(true), ..plain }));
    assert_eq!(serial(0x2217, 0), Some(plain), "the type counts only with parity");
    assert_eq!(serial(0x2212, 0), Some(SerialMode { data_bits: 7, ..plain }));
}

#[test]
fn r_esd_099_bit_5_is_a_second_stop_bit_unless_told_otherwise_and_never_at_the_terminal_interface() {
    let settings = SioSettings { two_stop_bits: false, ..SioSettings::new(Model::Sio4) };
    let bits =
        |settings: &SioSettings, channel| SerialMode::decode(0x2273, settings, channel).unwrap().bits();
    assert_eq!(bits(&SioSettings::new(Model::Sio4), 0), 11);
    assert_eq!(bits(&settings, 0), 10);
    assert_eq!(bits(&SioSettings::new(Model::Sio4), 4), 10);
    assert_eq!(bits(&SioSettings::new(Model::Sio1), 0), 10);
}

#[test]
fn r_esd_100_parity_is_a_bit_more_and_only_with_code_00() {
    assert_eq!(serial(0x2213, 0).unwrap().bits(), 10);
    assert_eq!(serial(0x2203, 0).unwrap().bits(), 11);
    for none in [0x220B, 0x2213, 0x221B] {
        assert_eq!(serial(none, 0).unwrap().odd_parity, None, "{none:04X}");
    }
}

#[test]
fn r_esd_101_from_public_copies_bit_2_is_odd() {
    assert_eq!(serial(0x2203, 0).unwrap().odd_parity, Some(false));
    assert_eq!(serial(0x2207, 0).unwrap().odd_parity, Some(true));
}

#[test]
fn r_esd_102_characters_have_5_to_8_bits() {
    for (code, bits, byte) in [(0, 5, "1F"), (1, 6, "3F"), (2, 7, "7F"), (3, 8, "FF")] {
        let mode = serial(0x2210 | code, 0).unwrap();
        assert_eq!(mode.data_bits, bits);
        let mut bench = Bench::sio4(0x12);
        bench.frame(&format!("700#8602001222{:02X}", 0x10 | code));
        bench.say(1, &[0xFF]);
        bench.frame("0B9#FF");
        bench.run_for(10);
        assert_eq!(bench.frames(), [format!("0B4#{byte}")]);
        assert_eq!(bench.line(1), [u8::from_str_radix(byte, 16).unwrap()]);
    }
}

#[test]
fn r_esd_012_the_terminal_interface_takes_three_kinds_of_characters() {
    let mut bench = Bench::sio4(0x12);
    for (mode, taken) in
        [("2203", true), ("2213", true), ("2202", true), ("2212", false), ("2201", false), ("2210", false)]
    {
        bench.frame("700#862200122273");
        bench.frame(&format!("700#86220012{mode}"));
        let answer = if taken { mode } else { "2273" };
        assert_eq!(bench.ask("700#062200120567"), format!("567#0622{answer}"));
    }
    bench.talk(&[("700#860200122210", "-"), ("700#060200120567", "567#06022210")]);
    let mut one = Bench::sio1(0x12);
    one.talk(&[("700#860200122210", "-"), ("700#060200120567", "567#06022273")]);
}

#[test]
fn r_esd_103_from_the_factory_a_line_has_9600_bit_s_8_bits_no_parity_and_cts() {
    let mode = serial(0x2273, 0).unwrap();
    assert_eq!((mode.receive, mode.send, mode.cts), (9600, 9600, true));
    assert_eq!((mode.odd_parity, mode.data_bits), (None, 8));
    let mut bench = Bench::sio4(0x12);
    for number in [0x02, 0x0A, 0x12, 0x1A, 0x22] {
        let answer = bench.ask(&format!("700#06{number:02X}00120567"));
        assert_eq!(answer, format!("567#06{number:02X}2273"));
    }
}
