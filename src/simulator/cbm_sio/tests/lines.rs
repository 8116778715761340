//! Pace and handshake of the lines (R-ESD-007 to R-ESD-011, R-ESD-098), and what can be at their ends.

use super::super::channel::AHEAD;
use super::super::line::LineKind;
use super::super::parameters::{Model, RATES};
use super::super::settings::SioSettings;
use super::bench::{Bench, prompt};
use crate::simulator::Device;

/// How long a hundred characters take to the line of a channel and from it, in microseconds.
fn times(bench: &mut Bench, channel: u8) -> (u64, u64) {
    let rx = 0xB8 + u16::from(channel);
    let begin = bench.now() * 1000;
    for _ in 0..25 {
        bench.frame(&format!("{rx:03X}#55555555"));
    }
    bench.run_for(10_000);
    let to = bench.timed_line(channel).last().unwrap().0 - begin;
    bench.frame(&format!("700#86{:02X}00120088", 1 + 8 * (channel - 1)));
    bench.say(channel, &[0x55; 100]);
    let begin = bench.now() * 1000;
    while bench.device.serial_room(channel) < AHEAD {
        let due = bench.device.poll_timeout().unwrap().as_micros();
        bench.run_to(due.div_ceil(1000));
    }
    (to, bench.now() * 1000 - begin)
}

#[test]
fn r_esd_007_four_channels_at_38400_work_at_the_same_time_and_one_faster() {
    let settings = SioSettings { can_tx_mode: [0x0088; 5], serial_mode: [0x0053; 5], ..prompt(Model::Sio4) };
    let mut bench = Bench::of(&settings, 0x12);
    for round in 0..100_u8 {
        for channel in 1..=4_u8 {
            bench.frame(&format!("{:03X}#{}", 0xB8 + u16::from(channel), format!("{round:02X}").repeat(8)));
            bench.say(channel, &[round; 8]);
        }
        bench.run_for(3);
    }
    bench.run_for(100);
    assert_eq!(bench.frames().len(), 400);
    assert!(!bench.device_remarks().contains("overflow"));
    bench.frame("700#86020012EE53");
    let (to, from) = times(&mut bench, 1);
    assert!((4300..=4345).contains(&to) && (4000..=5000).contains(&from), "{to} {from}");
}

#[test]
fn r_esd_008_the_port_of_the_processor_takes_the_highest_rate_that_has_a_code() {
    let mut bench = Bench::sio4(0x12);
    bench.frame("700#86220012EE73");
    let (to, _) = times(&mut bench, 5);
    assert!((4300..=4345).contains(&to), "{to}");
}

#[test]
fn r_esd_009_a_rate_that_rs_232_cannot_is_told() {
    let mut bench = Bench::sio4(0x12);
    bench.frame("700#860A00120073");
    assert!(!bench.device_remarks().contains("RS-232"));
    bench.frame("700#860A0012CC73");
    assert!(bench.says("channel 2 too fast for RS-232"));
}

#[test]
fn r_esd_010_the_port_of_the_processor_has_rates_of_its_own() {
    for (code, tenths) in [(0, 384_620), (1, 192_310), (2, 96_150), (5, 11_990), (6, 6_002), (7, 2_999)] {
        let mut bench = Bench::sio4(0x12);
        bench.frame(&format!("700#86220012{code}{code}73"));
        bench.frame(&format!("700#86020012{code}{code}53"));
        let nominal = u64::from(RATES[code]) * 10;
        let time = |tenths: u64| 1000 * 10_000_000 / tenths;
        assert!(times(&mut bench, 5).0.abs_diff(time(tenths)) <= 1, "{code}");
        assert!(times(&mut bench, 1).0.abs_diff(time(nominal)) <= 1, "{code}");
    }
}

#[test]
fn each_direction_has_its_rate() {
    let mut bench = Bench::sio4(0x12);
    bench.frame("700#860200121253");
    let (to, from) = times(&mut bench, 1);
    assert!((104_160..=104_170).contains(&to), "9600 to the line: {to}");
    assert!((52_000..=54_000).contains(&from), "19200 from the line: {from}");
}

#[test]
fn r_esd_011_098_cts_stops_channels_1_to_4_and_not_the_terminal_interface() {
    let mut bench = Bench::sio4(0x12);
    for channel in 1..=5_u8 {
        bench.order(&format!("cts {channel} off"));
        bench.frame(&format!("{:03X}#41", 0xB8 + u16::from(channel)));
        bench.run_for(1000);
        assert_eq!(bench.line(channel), if channel == 5 { b"A".to_vec() } else { Vec::new() }, "{channel}");
        bench.order(&format!("cts {channel} on"));
        bench.run_for(1000);
        assert_eq!(bench.line(channel).len(), usize::from(channel != 5), "{channel}");
    }
    let mut one = Bench::sio1(0x12);
    one.order("cts 1 off");
    one.frame("0B5#41");
    one.run_for(10);
    assert_eq!(one.line(1), b"A");
}

#[test]
fn r_esd_098_cts_is_ignored_where_it_is_switched_off() {
    let mut bench = Bench::sio4(0x12);
    bench.order("cts 1 off");
    bench.frame("0B9#4142");
    bench.run_for(1000);
    assert!(bench.line(1).is_empty());
    bench.frame("700#860200122233");
    bench.run_for(10);
    assert_eq!(bench.line(1), b"AB");
}

#[test]
fn r_esd_011_a_line_end_that_heeds_rts_loses_nothing() {
    let settings = SioSettings { heeds_rts: true, ..prompt(Model::Sio4) };
    let mut bench = Bench::of(&settings, 0x12);
    let text: Vec<u8> = (0..1000_u32).map(|number| number.to_le_bytes()[0]).collect();
    bench.say(1, &text);
    bench.run_for(30_000);
    let sent = bench.frames();
    assert_eq!(sent.len(), 1000);
    assert!(sent.iter().zip(&text).all(|(frame, byte)| *frame == format!("0B4#{byte:02X}")));
    assert!(!bench.device_remarks().contains("overflow"));
}

#[test]
fn an_outside_end_is_taken_from_no_faster_than_the_line_is() {
    let mut bench = Bench::sio4(0x12);
    assert_eq!(bench.device.serial_room(1), AHEAD);
    bench.say(1, &[0; AHEAD]);
    assert_eq!(bench.device.serial_room(1), 0);
    bench.run_for(115);
    assert_eq!(bench.device.serial_room(1), 100, "11 bits each at 9600 bit/s");
    assert_eq!((bench.device.serial_room(0), bench.device.serial_room(6)), (0, 0));
}

fn with_lines(lines: [LineKind; 5]) -> Bench {
    Bench::of(&SioSettings { lines, can_tx_mode: [0x0089; 5], ..prompt(Model::Sio4) }, 0x12)
}

#[test]
fn a_scanner_reads_again_and_again() {
    let mut bench =
        with_lines([LineKind::Scanner, LineKind::None, LineKind::None, LineKind::None, LineKind::None]);
    bench.run_to(4999);
    assert!(bench.frames().is_empty());
    bench.run_to(5100);
    assert_eq!(bench.frames(), ["0B4#3430303633383133", "0B4#33333933310D"]);
    bench.run_to(10_100);
    assert_eq!(bench.frames().len(), 2);
    assert_eq!(bench.device.serial_room(1), 0, "it is no outside end");
}

#[test]
fn a_balance_answers_with_its_weight() {
    let mut bench = with_lines([LineKind::Balance; 5]);
    let answer = |bench: &mut Bench, request: &str| {
        bench.frame(&format!("0B9#{request}"));
        bench.run_for(1000);
        let data: String = bench.frames().iter().map(|frame| frame[4..].to_owned()).collect();
        let bytes = (0..data.len() / 2).map(|at| u8::from_str_radix(&data[2 * at..2 * at + 2], 16).unwrap());
        String::from_utf8(bytes.collect()).unwrap()
    };
    assert_eq!(answer(&mut bench, "530D0A"), "S S      12.45 kg\r");
    bench.order("weight 1 3.2");
    assert_eq!(answer(&mut bench, "53490A"), "\nS S       3.20 kg\r");
    assert_eq!(answer(&mut bench, "580D0A"), "\nES\r");
    assert_eq!(answer(&mut bench, "0D0A"), "");
}

#[test]
fn an_echo_sends_back_what_it_gets_and_an_empty_line_nothing() {
    let mut bench =
        with_lines([LineKind::Echo, LineKind::None, LineKind::Echo, LineKind::Echo, LineKind::Echo]);
    bench.frame("0B9#61620D");
    bench.frame("0BA#61620D");
    bench.run_for(1000);
    assert_eq!(bench.frames(), ["0B4#61620D"]);
}
