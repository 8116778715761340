//! The worked examples of the requirements, byte for byte.

use super::super::parameters::{Model, bits_per_second};
use super::bench::{Bench, prompt};

#[test]
fn v_esd_01_identifiers() {
    let sent = |mut bench: Bench| {
        for channel in 1..=5 {
            bench.say(channel, b"x");
        }
        bench.run_for(10);
        // The terminal interface has one stop bit less, so its byte comes first.
        let mut frames = bench.frames();
        frames.sort();
        frames.join(" ")
    };
    assert_eq!(sent(Bench::sio4(0x11)), "0AA#78 0AB#78 0AC#78 0AD#78 0AE#78");
    assert_eq!(sent(Bench::sio1(0x11)), "0AA#78");
    assert_eq!(sent(Bench::sio1(0x23)), "15E#78");
    let mut four = Bench::sio4(0x11);
    for (channel, frame) in (1..).zip(["0AF#31", "0B0#32", "0B1#33", "0B2#34", "0B3#35"]) {
        four.frame(frame);
        four.run_for(5);
        assert_eq!(four.line(channel), [b'0' + channel]);
    }
    let mut one = Bench::sio1(0x23);
    one.frame("15F#31");
    one.run_for(5);
    assert_eq!(one.line(1), b"1");
}

#[test]
fn v_esd_02_serial_to_can_with_default_parameters() {
    let mut bench = Bench::sio1(0x23);
    bench.say(1, &[0xEE, 0xDD, 0x88]);
    bench.run_for(100);
    let sent = bench.take();
    let first = sent[0].0;
    let sent: Vec<_> = sent.iter().map(|(at, frame)| (at - first, frame.as_str())).collect();
    assert_eq!(sent, [(0, "15E#EE"), (20, "15E#DD"), (40, "15E#88")]);
}

#[test]
fn v_esd_03_can_to_serial() {
    let mut bench = Bench::sio1(0x23);
    bench.frame("15F#48656C6C6F");
    bench.frame("15F#");
    bench.run_for(10);
    assert_eq!(bench.line(1), b"Hello");
}

#[test]
fn v_esd_04_packing_with_other_settings() {
    let mut bench = Bench::sio1(0x23);
    bench.frame("700#860100231484");
    bench.say(1, &[1, 2, 3]);
    bench.run_for(1000);
    assert!(bench.frames().is_empty());
    bench.say(1, &[4]);
    bench.run_for(1000);
    assert_eq!(bench.frames(), ["15E#01020304"]);
    bench.order("unplug on");
    bench.say(1, &[1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11]);
    bench.run_for(1000);
    bench.order("unplug off");
    bench.run_for(1000);
    assert_eq!(bench.frames(), ["15E#0102030405060708"]);
    bench.say(1, &[12]);
    bench.run_for(1000);
    assert_eq!(bench.frames(), ["15E#090A0B0C"]);
}

#[test]
fn v_esd_05_end_marks() {
    for (code, input, frames) in [
        ("9", "61626364 0D", &["15E#616263640D"][..]),
        ("B", "61626364 0D", &["15E#61626364"]),
        ("E", "61626364 0D0A", &["15E#61626364"]),
        ("D", "61626364 0D", &["15E#61626364"]),
        ("B", "30313233 34353637 38 0D", &["15E#3031323334353637", "15E#38"]),
    ] {
        let mut bench = Bench::sio1(0x23);
        bench.frame(&format!("700#86010023148{code}"));
        bench.order(&format!("send 1 hex:{input}"));
        bench.run_for(1000);
        assert_eq!(bench.frames(), frames, "{code}: {input}");
    }
}

#[test]
fn v_esd_06_requests_and_replies() {
    let mut bench = Bench::sio1(0x12);
    bench.talk(&[
        ("700#020000120567", "567#020000B4"),
        ("700#8200001201AA", "-"),
        ("700#020000120567", "567#020001AA"),
        ("700#830000120155", "-"),
        ("700#030000120567", "567#030001550155"),
        ("700#000300120567", "567#0056312E30614530"),
        ("700#000500120567", "567#0005414130303132"),
        ("700#000100120567", "567#000112"),
        ("700#010100120567", "567#010112"),
        ("700#010000120567", "567#010000"),
        ("700#090000120567", "567#FF"),
        ("700#7F0112000567", "567#"),
    ]);
    bench.say(1, b"x");
    bench.run_for(10);
    assert_eq!(bench.frames(), ["1AA#78"], "the new identifier is in use");
}

#[test]
fn v_esd_07_status_byte() {
    let mut bench = Bench::sio1(0x12);
    bench.talk(&[
        ("700#010200120567", "567#0102C1"),
        ("700#810200120000", "-"),
        ("700#010200120567", "567#010241"),
        ("700#810000121200", "-"),
        ("700#FF000012AAAA", "-"),
        ("700#810200120000", "-"),
        ("700#FF0400125A5A", "-"),
    ]);
    bench.order("error");
    bench.talk(&[("700#010200120567", "567#010207")]);
}

#[test]
fn v_esd_08_supervisor_commands() {
    let restarts = |frame: &str| {
        let mut bench = Bench::sio1(0x12);
        bench.frame("700#810200120000");
        bench.frame(frame);
        bench.says("new on bus")
    };
    for frame in ["700#FF000000AAAA", "700#FF030012AAAA", "700#FF000012AAAA"] {
        assert!(restarts(frame), "{frame}");
    }
    for frame in ["700#FF000012AAAB", "700#FF000012AA", "700#FF000013AAAA"] {
        assert!(!restarts(frame), "{frame}");
    }
    let mut bench = Bench::sio1(0x12);
    let status = "700#010200120567";
    bench.talk(&[
        ("700#FF0400125A5A", "-"),
        (status, "567#0102C3"),
        ("700#FF040012A5A5", "-"),
        (status, "567#0102C1"),
        ("700#FF0400005A5A", "-"),
        (status, "567#0102C3"),
    ]);
}

#[test]
fn v_esd_09_user_parameters() {
    let mut bench = Bench::of(&prompt(Model::Sio4), 0x12);
    bench.talk(&[
        ("700#860200121173", "-"),
        ("700#060200120567", "567#06021173"),
        ("700#860100121411", "-"),
        ("700#060100120567", "567#06011411"),
        ("700#86010012148B", "-"),
        ("700#060100120567", "567#0601148B"),
        ("700#860000120000", "-"),
        ("700#060000120567", "567#06000000"),
        ("700#062200120567", "567#06222273"),
    ]);
    bench.say(1, b"abc\r");
    bench.run_for(100);
    assert_eq!(bench.frames(), ["0B4#616263"]);
}

#[test]
fn v_esd_10_bit_rate() {
    assert_eq!(bits_per_second([0x03, 0x1C]), 125_000);
    let mut bench = Bench::sio1(0x12);
    bench.talk(&[
        ("700#81030012011C", "-"),
        ("700#81030012031C", "-"),
        ("700#810000121200", "-"),
        ("700#FF000012AAAA", "-"),
        ("700#010300120567", "567#0103031C"),
    ]);
}

#[test]
fn v_esd_11_watchdog() {
    let mut bench = Bench::sio1(0x12);
    bench.talk(&[
        ("700#810400120512", "-"),
        ("700#8105031203E8", "-"),
        ("700#010500120567", "567#010503E803"),
        ("512#R1", "512#7D"),
        ("512#R1", "512#FD"),
        ("700#FF0200120000", "512#7D"),
        ("700#810500120000", "-"),
        ("700#810200120000", "-"),
    ]);
    bench.run_for(60_000);
    assert!(!bench.says("new on bus"), "it is switched off");
    bench.talk(&[("700#8105031203E8", "-"), ("512#R1", "512#FD")]);
    let guarded = bench.now() - 10;
    bench.run_to(guarded + 2999);
    assert!(!bench.says("new on bus"));
    bench.run_to(guarded + 3001);
    assert!(bench.says("new on bus"));
    assert_eq!(bench.ask("700#010200120567"), "567#0102C1");
}
