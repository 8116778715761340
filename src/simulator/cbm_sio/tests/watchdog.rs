//! The watchdog (R-ESD-081 to R-ESD-086).

use super::super::parameters::Model;
use super::super::settings::SioSettings;
use super::bench::{Bench, prompt};

/// Module 12 with its watchdog at 512, 1000 ms, three times.
fn guarded() -> Bench {
    let mut bench = Bench::sio4(0x12);
    bench.talk(&[("700#810400120512", "-"), ("700#8105031203E8", "-"), ("700#810200120000", "-")]);
    bench
}

#[test]
fn r_esd_081_from_public_copies_time_and_factor_enable_it_and_a_reset_disables_it() {
    for (set, enabled) in
        [("700#8105031203E8", true), ("700#810500121000", false), ("700#810503120000", false)]
    {
        let mut bench = Bench::sio4(0x12);
        bench.frame("700#810400120512");
        bench.frame("700#810200120000");
        bench.frame(set);
        bench.talk(&[("512#R1", "512#7D")]);
        bench.run_for(20_000);
        assert_eq!(bench.says("new on bus"), enabled, "{set}");
        bench.frame("700#810200120000");
        bench.run_for(20_000);
        assert!(!bench.says("new on bus"), "it is inactive after a reset");
        assert_eq!(bench.ask("700#010500120567"), if enabled { "567#0105000000".into() } else { told(set) });
    }
}

fn told(set: &str) -> String {
    format!("567#0105{}{}", &set[12..16], &set[8..10])
}

#[test]
fn r_esd_082_the_time_begins_with_the_first_request() {
    let mut bench = guarded();
    bench.run_for(60_000);
    assert!(!bench.says("new on bus"));
    for first in ["512#R1", "700#FF0200120000", "700#FF0200001234"] {
        let mut bench = guarded();
        bench.frame(first);
        assert!(bench.says("guarded"));
        bench.run_for(2999);
        assert!(!bench.says("new on bus"));
        bench.run_for(2);
        assert!(bench.says("new on bus"), "{first}");
    }
}

#[test]
fn r_esd_083_each_request_in_time_keeps_it_alive_and_a_late_one_does_not() {
    let mut bench = guarded();
    for round in 0..10 {
        bench.frame(if round % 2 == 0 { "512#R1" } else { "700#FF0200120000" });
        bench.run_for(2900);
    }
    assert!(!bench.says("new on bus"));
    bench.run_for(200);
    assert!(bench.says("new on bus"));
}

#[test]
fn r_esd_084_from_public_copies_a_remote_frame_of_any_length_is_answered_by_one_byte() {
    let mut bench = guarded();
    for (length, answer) in (0..=8).zip(["512#7D", "512#FD"].iter().cycle()) {
        assert_eq!(bench.ask(&format!("512#R{length}")), *answer);
    }
    assert_eq!(bench.ask("512#00"), "-", "a data frame is no request");
    assert_eq!(bench.ask("513#R1"), "-");
}

#[test]
fn r_esd_085_the_toggle_changes_with_each_reply_and_begins_anew_with_a_reset() {
    let mut bench = guarded();
    bench.talk(&[("512#R1", "512#7D"), ("700#FF0200120000", "512#FD"), ("512#R1", "512#7D")]);
    bench.order("reset");
    bench.talk(&[("700#810400120512", "-"), ("512#R1", "512#7D")]);
    bench.order("stuck toggle on");
    bench.talk(&[("512#R1", "512#FD"), ("512#R1", "512#FD")]);
}

#[test]
fn r_esd_086_from_public_copies_the_bits_between_are_set_unless_told_otherwise() {
    let settings = SioSettings { watchdog_fill: false, watchdog_state: 4, ..prompt(Model::Sio4) };
    let mut bench = Bench::of(&settings, 0x12);
    bench.talk(&[("700#810400120512", "-"), ("512#R1", "512#04"), ("512#R1", "512#84")]);
}

#[test]
fn a_muted_watchdog_counts_requests_all_the_same() {
    let mut bench = guarded();
    bench.order("mute watchdog on");
    assert_eq!(bench.ask("512#R1"), "-");
    bench.run_for(3000);
    assert!(bench.says("new on bus"));
}
