//! From the line to CAN: what makes a frame, and when (R-ESD-001, R-ESD-024 to R-ESD-032, R-ESD-093).

use std::time::Duration;

use super::super::channel::RING;
use super::super::parameters::Model;
use super::super::settings::SioSettings;
use super::bench::{Bench, hex, prompt};

/// An SIO1 with `TxId` 15E and this CAN Tx mode.
fn with(mode: u16) -> Bench {
    let mut bench = Bench::sio1(0x23);
    let [high, low] = mode.to_be_bytes();
    bench.frame(&format!("700#86010023{high:02X}{low:02X}"));
    bench
}

/// What frames a text becomes, all within a second.
fn frames(mode: u16, text: &[u8]) -> Vec<String> {
    let mut bench = with(mode);
    bench.say(1, text);
    bench.run_for(1000);
    bench.frames()
}

#[test]
fn r_esd_001_every_byte_goes_through_as_it_is() {
    let mut bench = with(0x0088);
    let bytes: Vec<u8> = (0..=255).collect();
    bench.say(1, &bytes);
    bench.run_for(1000);
    let sent: String = bench.frames().iter().map(|frame| frame[4..].to_owned()).collect();
    let all: String = hex(&bytes);
    assert_eq!(sent, all);
}

#[test]
fn r_esd_024_026_eight_characters_or_fewer_make_a_frame() {
    assert_eq!(frames(0x1488, b"12345678"), ["15E#3132333435363738"]);
    assert!(frames(0x1488, b"1234567").is_empty());
    assert_eq!(frames(0x1483, b"123"), ["15E#313233"]);
    assert_eq!(frames(0x1431, b"1"), ["15E#31"]);
}

#[test]
fn r_esd_025_an_idle_line_sends_what_waits_when_that_is_switched_on() {
    let settings = SioSettings { idle_timeout: Some(Duration::from_millis(50)), ..prompt(Model::Sio1) };
    for mode in ["1488", "1489"] {
        let mut bench = Bench::of(&settings, 0x23);
        bench.frame(&format!("700#86010023{mode}"));
        bench.say(1, b"12");
        bench.run_to(51);
        assert!(bench.frames().is_empty(), "the second character came after 2 ms");
        bench.run_to(53);
        assert_eq!(bench.frames(), ["15E#3132"]);
        bench.run_to(1000);
        assert!(bench.frames().is_empty());
    }
}

#[test]
fn r_esd_026_a_frame_has_no_more_than_max_char() {
    let mut bench = with(0x1431);
    bench.order("unplug on");
    bench.say(1, b"1234567");
    bench.run_for(100);
    bench.order("unplug off");
    bench.run_for(100);
    assert_eq!(bench.frames(), ["15E#313233", "15E#343536", "15E#37"]);
}

#[test]
fn r_esd_027_from_the_factory_each_byte_has_its_frame() {
    let mut bench = Bench::sio1(0x23);
    bench.say(1, b"abc");
    bench.run_for(1000);
    assert_eq!(bench.frames(), ["15E#61", "15E#62", "15E#63"]);
}

#[test]
fn r_esd_028_frames_keep_the_inhibit_time_and_take_what_came_meanwhile() {
    let mut bench = with(0x6481);
    bench.say(1, b"abcdef");
    bench.run_for(1000);
    let sent = bench.take();
    assert_eq!(
        sent.iter().map(|(_, frame)| frame.as_str()).collect::<Vec<_>>(),
        ["15E#61", "15E#6263646566"]
    );
    assert_eq!(sent[1].0 - sent[0].0, 100);
    let mut four = Bench::sio4(0x12);
    four.say(1, b"ab");
    four.say(2, b"c");
    four.run_for(10);
    assert_eq!(four.frames(), ["0B4#61", "0B5#63"], "each channel has its own");
}

#[test]
fn r_esd_029_fewer_than_min_char_bytes_wait_and_more_go_out_together() {
    let mut bench = with(0x1485);
    bench.order("unplug on");
    bench.say(1, b"0123456789AB");
    bench.run_for(100);
    bench.order("unplug off");
    bench.run_for(1000);
    assert_eq!(bench.frames(), ["15E#3031323334353637"], "four are too few");
    bench.say(1, b"C");
    bench.run_for(1000);
    assert_eq!(bench.frames(), ["15E#3839414243"]);
}

#[test]
fn r_esd_030_093_codes_9_to_e_send_at_an_end_mark_from_public_copies() {
    let text = b"ab\rcd\nef\r\ngh";
    for (code, expected) in [
        (0x9, &["61620D", "63640A65660D"][..]),
        (0xA, &["61620D63640A", "65660D0A"]),
        (0xB, &["6162", "63640A6566"]),
        (0xC, &["61620D6364", "65660D"]),
        (0xD, &["6162", "63646566"]),
        (0xE, &["61626364", "6566"]),
    ] {
        let expected: Vec<_> = expected.iter().map(|data| format!("15E#{data}")).collect();
        assert_eq!(frames(0x1480 | code, text), expected, "{code:X}");
    }
}

#[test]
fn r_esd_030_a_mark_alone_sends_nothing_where_it_is_not_sent_itself() {
    assert!(frames(0x148D, b"\r\n\r\n").is_empty());
    assert!(frames(0x148B, b"\r\r").is_empty());
    assert_eq!(frames(0x1489, b"\r\r"), ["15E#0D", "15E#0D"]);
}

#[test]
fn r_esd_031_eight_bytes_do_not_wait_for_their_mark_from_public_copies() {
    assert_eq!(frames(0x1489, b"12345678"), ["15E#3132333435363738"]);
    assert_eq!(frames(0x1489, b"1234567\r"), ["15E#313233343536370D"]);
    assert_eq!(frames(0x1489, b"12345678\r"), ["15E#3132333435363738", "15E#0D"]);
    assert_eq!(frames(0x148D, b"12345678\r\n9\r\n"), ["15E#3132333435363738", "15E#39"]);
}

#[test]
fn r_esd_030_lines_that_wait_are_not_joined() {
    let mut bench = with(0xC889);
    bench.say(1, b"a\rb\rc\r");
    bench.run_for(1000);
    let sent = bench.take();
    let gaps: Vec<_> = sent.windows(2).map(|pair| pair[1].0 - pair[0].0).collect();
    assert_eq!(
        sent.into_iter().map(|(_, frame)| frame).collect::<Vec<_>>(),
        ["15E#610D", "15E#620D", "15E#630D"]
    );
    assert_eq!(gaps, [200, 200]);
}

#[test]
fn r_esd_032_bytes_keep_their_order() {
    let text: Vec<u8> = (0..200).collect();
    for mode in [0x0088, 0x0181, 0x0511, 0x0548] {
        let sent: String = frames(mode, &text).iter().map(|frame| frame[4..].to_owned()).collect();
        let all: String = hex(&text);
        assert!(all.starts_with(&sent) && sent.len() > 300, "{mode:04X}: {sent}");
    }
}

#[test]
fn r_esd_036_what_does_not_fit_into_the_ring_is_lost_and_counted_from_public_copies() {
    let mut bench = Bench::sio1(0x23);
    bench.order("unplug on");
    bench.say(1, &[b'x'; RING]);
    bench.run_for(1000);
    assert!(!bench.device_remarks().contains("overflow"));
    bench.say(1, b"yz");
    bench.run_for(2000);
    assert!(bench.says("channel 1 to can overflow 2"), "{}", bench.device_remarks());
    bench.order("unplug off");
    bench.run_for(256 * 20);
    let sent = bench.frames();
    assert_eq!(sent.len(), RING);
    assert!(sent.iter().all(|frame| frame == "15E#78"), "the oldest are kept");
    assert!(bench.says("channel 1 to can overflow 2"), "the count stays");
}

#[test]
fn lost_bytes_are_told_once_a_second_and_counted_all_the_same() {
    let mut bench = Bench::sio1(0x23);
    bench.say(1, &[b'x'; 1000]);
    let mut told = std::collections::BTreeSet::new();
    for _ in 0..1000 {
        bench.run_for(3);
        told.insert(bench.device_remarks());
    }
    assert!((2..=5).contains(&told.len()), "{told:?}");
    let counted = bench.device.module().channels()[0].overflow_to_can;
    assert!(bench.says(&format!("channel 1 to can overflow {counted}")), "{}", bench.device_remarks());
}

#[test]
fn a_module_whose_task_sleeps_too_long_sends_the_same_frames() {
    let text: Vec<u8> = (0..100).collect();
    let sent = |late: bool| {
        let mut bench = with(0x0A83);
        bench.say(1, &text);
        if late {
            bench.oversleep_to(500);
        } else {
            bench.run_to(500);
        }
        bench.frames()
    };
    assert_eq!(sent(true), sent(false));
}

#[test]
fn another_mode_sends_what_waits_in_the_old_one() {
    let mut bench = with(0x1488);
    bench.say(1, b"123");
    bench.run_for(100);
    bench.frame("700#860100231489");
    bench.run_for(100);
    assert_eq!(bench.frames(), ["15E#313233"]);
}
