//! Suspend and continue (R-ESD-041 to R-ESD-043).

use super::bench::Bench;
use crate::canopen::NmtState;
use crate::simulator::Device;

const SUSPEND: &str = "700#FF0400125A5A";
const CONTINUE: &str = "700#FF040012A5A5";

#[test]
fn r_esd_041_042_all_channels_stop_and_go_on_together_and_keep_what_came() {
    let mut bench = Bench::sio4(0x12);
    bench.frame(SUSPEND);
    for channel in 1..=5 {
        bench.say(channel, b"ab");
        bench.frame(&format!("{:03X}#4142", 0xB8 + u16::from(channel)));
    }
    bench.run_for(5000);
    assert!(bench.frames().is_empty());
    assert!((1..=5).all(|channel| bench.line(channel).is_empty()));
    assert_eq!(bench.device.status().state, Some(NmtState::Stopped));
    bench.frame(CONTINUE);
    let resumed = bench.now();
    bench.run_for(100);
    let mut sent = bench.take();
    sent.sort();
    let at = |offset: u64, frames: [&str; 5]| frames.map(|frame| (resumed + offset, frame.to_owned()));
    let first = at(0, ["0B4#61", "0B5#61", "0B6#61", "0B7#61", "0B8#61"]);
    let second = at(20, ["0B4#62", "0B5#62", "0B6#62", "0B7#62", "0B8#62"]);
    assert_eq!(sent, [first, second].concat());
    assert_eq!(bench.line(1), b"AB");
}

#[test]
fn r_esd_041_a_line_goes_on_at_its_pace_and_not_faster() {
    let mut bench = Bench::sio4(0x12);
    bench.frame("0B9#4142434445464748");
    bench.run_for(3);
    bench.frame(SUSPEND);
    bench.run_for(1000);
    let before = bench.timed_line(1);
    assert!((2..=3).contains(&before.len()), "the character that had begun is sent");
    bench.frame(CONTINUE);
    bench.run_for(100);
    let after = bench.timed_line(1);
    assert_eq!(before.len() + after.len(), 8);
    assert!(after.windows(2).all(|pair| (1145..=1147).contains(&(pair[1].0 - pair[0].0))), "{after:?}");
}

#[test]
fn r_esd_043_from_public_copies_requests_are_answered_and_parameters_wait() {
    let mut bench = Bench::sio4(0x12);
    bench.talk(&[
        (SUSPEND, "-"),
        ("700#820000120345", "-"),
        ("700#020000120567", "567#02000345"),
        ("700#860100121488", "-"),
        ("700#060100120567", "567#06011488"),
    ]);
    bench.frame("700#830000120346");
    bench.frame("0B9#41");
    bench.frame("346#42");
    bench.say(1, b"12345678");
    bench.run_for(100);
    bench.frame(CONTINUE);
    bench.run_for(100);
    assert_eq!(bench.frames(), ["345#3132333435363738"]);
    assert_eq!(bench.line(1), b"A", "the old identifier held until then");
    bench.frame("346#43");
    bench.run_for(100);
    assert_eq!(bench.line(1), b"C");
}

#[test]
fn r_esd_041_a_reset_ends_it() {
    let mut bench = Bench::sio4(0x12);
    bench.talk(&[(SUSPEND, "-"), ("700#FF000012AAAA", "-"), ("700#010200120567", "567#0102C1")]);
}
