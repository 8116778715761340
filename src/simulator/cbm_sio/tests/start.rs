//! Resets, the EEPROM, and where identifiers and parameters come from at a start (R-ESD-033, R-ESD-067, R-ESD-068, R-ESD-105 to
//! R-ESD-109).

use super::super::parameters::Model;
use super::super::settings::SioSettings;
use super::bench::{Bench, prompt};
use crate::canopen::NmtState;
use crate::simulator::Device;

const STORE: &str = "700#810000121200";
const RESET: &str = "700#FF000012AAAA";
const TX_ID: &str = "700#020000120567";

/// Module 12 with another identifier to CAN, stored.
fn stored() -> Bench {
    let mut bench = Bench::sio4(0x12);
    bench.talk(&[("700#820000120345", "-"), (STORE, "-")]);
    bench
}

#[test]
fn r_esd_033_after_a_reset_nothing_is_sent_for_ten_seconds_neither_to_can_nor_to_the_line() {
    let settings = SioSettings { first_tx_delay_ms: 10_000, ..prompt(Model::Sio4) };
    let mut bench = Bench::of(&settings, 0x12);
    bench.say(1, b"a");
    bench.frame("0B9#42");
    bench.frame(TX_ID);
    bench.run_to(9999);
    assert!(bench.frames().is_empty() && bench.line(1).is_empty());
    assert_eq!(bench.device.status().state, Some(NmtState::Initialising));
    bench.run_to(10_000);
    assert_eq!(bench.take(), [(10_000, "0B4#61".to_owned())]);
    bench.run_to(10_002);
    assert_eq!(bench.line(1), b"B", "what came meanwhile was kept");
    assert_eq!(bench.device.status().state, Some(NmtState::Operational));
    bench.frame("700#FF000000AAAA");
    bench.say(1, b"c");
    bench.run_for(9990);
    assert!(bench.frames().is_empty());
    bench.run_for(20);
    assert_eq!(bench.frames(), ["0B4#63"]);
}

#[test]
fn r_esd_033_090_the_silence_is_a_parameter_that_acts_at_once_and_replies_may_be_let_through() {
    let settings = SioSettings { first_tx_delay_ms: 10_000, ..prompt(Model::Sio4) };
    let mut bench = Bench::of(&settings, 0x12);
    bench.say(1, b"abc");
    bench.run_to(1000);
    bench.frame("700#860000120000");
    bench.run_to(1100);
    let sent: Vec<_> = bench.take().iter().map(|(at, _)| *at).collect();
    assert_eq!(sent, [1000, 1020, 1040], "no time that has passed is made up for");
    bench.frame("700#860000122710");
    bench.say(1, b"d");
    bench.run_to(1200);
    assert_eq!(bench.frames(), ["0B4#64"], "what has begun does not end before the next reset");
    let mut open = Bench::of(&SioSettings { replies_in_delay: true, ..settings }, 0x12);
    assert_eq!(open.ask(TX_ID), "567#020000B4");
}

#[test]
fn r_esd_067_from_public_copies_only_what_was_stored_survives_and_storing_needs_the_module_number() {
    let mut bench = Bench::sio4(0x12);
    bench.talk(&[("700#820000120345", "-"), (RESET, "-"), (TX_ID, "567#020000B4")]);
    bench.talk(&[
        ("700#820000120345", "-"),
        ("700#810000121300", "-"),
        (RESET, "-"),
        (TX_ID, "567#020000B4"),
    ]);
    let mut bench = stored();
    bench.talk(&[(RESET, "-"), (TX_ID, "567#02000345")]);
    bench.order("power cycle");
    assert_eq!(bench.ask(TX_ID), "567#02000345");
    bench.talk(&[("700#820000120111", "-"), (TX_ID, "567#02000111"), (RESET, "-"), (TX_ID, "567#02000345")]);
}

#[test]
fn r_esd_068_a_module_number_acts_at_once_and_survives_when_it_was_stored() {
    let mut bench = Bench::sio4(0x12);
    bench.talk(&[
        ("700#810100125500", "-"),
        ("700#010100120567", "-"),
        ("700#010100550567", "567#010155"),
        ("700#FF000055AAAA", "-"),
        ("700#010100120567", "567#010112"),
        ("700#810100125500", "-"),
        ("700#810000555500", "-"),
        ("700#FF000000AAAA", "-"),
        ("700#010100550567", "567#010155"),
        ("700#010000550567", "567#010055"),
        ("700#810100550000", "-"),
        ("700#81010055FF00", "-"),
        ("700#010100550567", "567#010155"),
    ]);
    bench.order("switch 34");
    bench.order("reset");
    assert_eq!(bench.ask("700#010100550567"), "567#010155", "the switches no longer count");
}

#[test]
fn r_esd_105_power_command_and_watchdog_reset_the_module_and_leave_what_is_stored() {
    for reset in ["power", "command", "watchdog"] {
        let mut bench = stored();
        bench.talk(&[("700#82000012000A", "-"), ("700#810200120000", "-"), ("700#810400120512", "-")]);
        bench.frame("0B9#41");
        match reset {
            "power" => bench.order("power cycle"),
            "command" => bench.frame(RESET),
            _ => {
                bench.talk(&[("700#81050112000A", "-"), ("512#R0", "512#7D")]);
                bench.run_for(10);
            }
        }
        bench.line(1);
        bench.talk(&[(TX_ID, "567#02000345"), ("700#010200120567", "567#010281")]);
        assert!(reset != "command" || bench.line(1).is_empty(), "the rings are empty");
    }
}

#[test]
fn r_esd_106_a_stored_module_number_makes_everything_come_from_the_eeprom() {
    let mut bench = stored();
    bench.talk(&[("700#010000120567", "567#010012"), (RESET, "-")]);
    bench.order("switch 34");
    bench.frame(RESET);
    bench.talk(&[
        (TX_ID, "567#02000345"),
        ("700#010000120567", "567#010012"),
        ("700#010200120567", "567#010281"),
    ]);
}

#[test]
fn r_esd_106_without_a_stored_module_number_everything_comes_from_the_switches() {
    let mut bench = Bench::sio4(0x12);
    bench.order("switch 34");
    bench.frame(RESET);
    bench.talk(&[
        ("700#010100340567", "567#010134"),
        ("700#010000340567", "567#010000"),
        ("700#020000340567", "567#02000208"),
        ("700#010200340567", "567#0102C1"),
    ]);
}

#[test]
fn r_esd_106_with_a_spoilt_eeprom_too_and_storing_repairs_it() {
    let mut bench = stored();
    bench.order("eeprom error");
    bench.talk(&[
        (TX_ID, "567#02000345"),
        (RESET, "-"),
        (TX_ID, "567#020000B4"),
        ("700#010000120567", "567#010000"),
        ("700#010200120567", "567#0102C1"),
        (STORE, "-"),
        (RESET, "-"),
        ("700#010000120567", "567#010012"),
    ]);
}

#[test]
fn r_esd_107_switches_that_leave_00_overwrite_the_eeprom_and_the_module_resets_itself() {
    let mut bench = stored();
    bench.order("switch 00");
    assert_eq!(bench.ask(TX_ID), "567#02000345", "nothing happens before the reset");
    bench.frame(RESET);
    bench.say(1, b"z");
    bench.frame("0B9#41");
    bench.run_for(1000);
    assert!(bench.frames().is_empty() && bench.line(1).is_empty(), "it has no identifiers");
    assert!(bench.says("coding switches at 00"));
    bench.order("switch 34");
    assert!(bench.says("overwriting its eeprom"));
    bench.run_for(9999);
    assert!(bench.says("coding switches at 00"));
    bench.run_for(1);
    assert!(!bench.says("coding switches at 00") && bench.says("new on bus"));
    bench.talk(&[("700#020000340567", "567#02000208"), ("700#010000340567", "567#010000")]);
}

#[test]
fn r_esd_109_from_public_copies_a_default_reset_overwrites_what_was_stored() {
    let mut bench = stored();
    bench.talk(&[
        ("700#FF030012AAAB", "-"),
        (TX_ID, "567#02000345"),
        ("700#FF030012AAAA", "-"),
        (TX_ID, "567#020000B4"),
        ("700#010200120567", "567#0102C1"),
        (RESET, "-"),
        (TX_ID, "567#020000B4"),
    ]);
}

#[test]
fn r_esd_105_what_waited_in_the_rings_is_lost_without_power() {
    let mut bench = Bench::sio4(0x12);
    bench.order("cts 1 off");
    bench.frame("0B9#4142");
    bench.order("power off");
    assert_eq!(bench.device.status().state, None);
    bench.say(1, b"nobody hears that");
    bench.run_for(1000);
    assert_eq!(bench.ask(TX_ID), "-");
    bench.order("power on");
    bench.order("cts 1 on");
    bench.run_for(1000);
    assert!(bench.frames().is_empty() && bench.line(1).is_empty());
}
