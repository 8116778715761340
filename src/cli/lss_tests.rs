//! Tests of [`super`], and of [`LssTask`] against played devices.

use std::collections::BTreeMap;
use std::time::Duration;

use clap::Parser;

use super::super::CommandLine;
use super::super::Subcommand;
use super::super::session::{Machine, Step};
use super::*;
use crate::can::CanFrame;
use crate::time::{Instant, Now};

fn arguments(words: &str) -> LssArguments {
    let line = ["cangate", "lss", "-i", "can0"].into_iter().chain(words.split(' '));
    let Subcommand::Lss(arguments) = CommandLine::try_parse_from(line).unwrap().command else {
        panic!("{words}");
    };
    arguments
}

/// What a device answers; an answer that is several frames has spaces between them.
type Device = BTreeMap<&'static str, &'static str>;

/// A DST at node 1, heartbeat every 500 ms, that takes node id 5.
fn dst() -> Device {
    BTreeMap::from([
        ("601#4018100100000000", "581#431810013D020000"),
        ("601#4018100200000000", "581#4318100211000000"),
        ("601#4018100300000000", "581#4318100322000000"),
        ("601#4018100400000000", "581#4318100433000000"),
        ("601#4017100000000000", "581#4B171000F4010000"),
        ("601#2B17100000000000", "581#6017100000000000"),
        ("7E5#4333000000000000", "7E4#4400000000000000"),
        ("7E5#1105000000000000", "7E4#1100000000000000"),
        ("7E5#1300030000000000", "7E4#1300000000000000"),
        ("7E5#1700000000000000", "7E4#1700000000000000"),
        ("605#4018100100000000", "585#431810013D020000"),
        ("605#4018100200000000", "585#4318100211000000"),
        ("605#4018100300000000", "585#4318100322000000"),
        ("605#4018100400000000", "585#4318100433000000"),
        ("605#2B171000F4010000", "585#6017100000000000"),
    ])
}

/// Runs what a command line asks for; gives the frames that were sent, and what came of it. `before`: frames overheard
/// before anything is sent. The device boots with its new id when it is told to leave configuration state after a store.
fn run(words: &str, device: &Device, before: &[&str]) -> (Vec<String>, Result<Vec<LssAnswer>, LssError>) {
    let mut task = task(&arguments(words)).unwrap();
    let mut now = 0_u64;
    let mut sent: Vec<String> = Vec::new();
    task.begin(Instant::from_millis(now));
    for frame in before {
        task.handle_frame(Now::from_millis(now), &frame.parse().unwrap());
    }
    loop {
        let mut answers: Vec<CanFrame> = Vec::new();
        while let Some(step) = task.poll_output() {
            match step {
                Step::Transmit(frame) => {
                    let frame = frame.to_string();
                    let stored = sent.iter().any(|earlier| earlier == "7E5#1700000000000000");
                    if stored && frame == "7E5#0400000000000000" {
                        answers.push("705#00".parse().unwrap());
                    }
                    answers
                        .extend(device.get(frame.as_str()).map(|answer| answer.parse::<CanFrame>().unwrap()));
                    sent.push(frame);
                }
                Step::Done(outcome) => return (sent, outcome),
            }
        }
        if answers.is_empty() {
            let due = task.poll_timeout().expect("something to wait for");
            now = due.as_micros().div_ceil(1000).max(now);
            task.handle_timeout(Now::from_millis(now));
        }
        for answer in answers {
            now += 1;
            task.handle_frame(Now::from_millis(now), &answer);
        }
        assert!(now < 600_000, "it does not end: {sent:#?}");
    }
}

#[test]
fn r_dst_092_111_113_a_node_id_is_changed_by_the_address_that_the_device_tells() {
    let (sent, outcome) = run("set-node-id --node 1 --to 5", &dst(), &["701#05", "181#1027000000"]);
    assert_eq!(outcome, Ok(vec![LssAnswer::Changed { active: true, restored: true }]));
    let expected = [
        "601#4018100100000000",
        "601#4018100200000000",
        "601#4018100300000000",
        "601#4018100400000000",
        "601#4017100000000000",
        "601#2B17100000000000",
        "000#0201",
        "7E5#0400000000000000",
        "7E5#403D020000000000",
        "7E5#4111000000000000",
        "7E5#4222000000000000",
        "7E5#4333000000000000",
        "7E5#1105000000000000",
        "7E5#1700000000000000",
        "7E5#0400000000000000",
        "605#4018100100000000",
        "605#4018100200000000",
        "605#4018100300000000",
        "605#4018100400000000",
        "000#0101",
        "000#0105",
        "605#2B171000F4010000",
    ];
    assert_eq!(sent, expected, "the heartbeat of 500 ms is back and the node runs as before");
}

#[test]
fn a_detcon_that_shares_the_node_id_runs_on_and_the_moved_device_waits() {
    let (sent, outcome) =
        run("set-node-id --node 1 --to 5", &dst(), &["181#00FF80017FFE3340", "181#1027000000"]);
    assert!(outcome.is_ok(), "{outcome:?}");
    assert!(sent.contains(&"000#0101".to_owned()), "whoever is left at node 1 is started again");
    assert!(!sent.contains(&"000#0105".to_owned()), "nobody knows what the moved device did: {sent:?}");
}

#[test]
fn r_dst_112_114_a_new_bit_rate_waits_for_the_device_to_be_switched_off_and_on() {
    let words = "set-node-id --to 5 --bit-rate 250 --only-one-device";
    let (sent, outcome) = run(words, &dst(), &[]);
    assert_eq!(outcome, Ok(vec![LssAnswer::Changed { active: false, restored: true }]));
    let configuration: Vec<&str> =
        sent.iter().map(String::as_str).filter(|frame| frame.starts_with("7E5#")).collect();
    assert_eq!(
        configuration,
        ["7E5#0401000000000000", "7E5#1105000000000000", "7E5#1300030000000000", "7E5#1700000000000000"],
        "nothing is activated"
    );
    assert_eq!(sent[0], "000#0200", "the manual's example stops all nodes");
    let lines = told(&arguments(words).command, &outcome.unwrap());
    assert!(lines[0].contains("all other devices and this host's interface must follow"), "{lines:?}");
}

#[test]
fn r_dst_111_nothing_is_changed_without_an_address_or_a_confirmation() {
    for words in ["set-node-id --to 5", "set-bit-rate --bit-rate 250", "inquire"] {
        let error = task(&arguments(words)).unwrap_err();
        assert!(error.contains("--only-one-device") && error.contains("--serial"), "{error}");
    }
    let error = task(&arguments("set-node-id --to 5 --vendor 1 --serial 7")).unwrap_err();
    assert!(error.contains("--revision"), "{error}");
}

#[test]
fn a_device_that_does_not_tell_its_identity_is_not_touched() {
    let (sent, outcome) = run("set-node-id --node 1 --to 5", &Device::new(), &[]);
    let error = outcome.unwrap_err().to_string();
    assert!(error.contains("0x1018") && error.contains("--vendor"), "{error}");
    assert!(sent.iter().all(|frame| frame.starts_with("601#")), "{sent:?}");
}

#[test]
fn a_device_that_refuses_is_brought_back_to_its_heartbeat_and_state() {
    let mut device = dst();
    device.insert("7E5#1105000000000000", "7E4#1101000000000000");
    device.insert("601#2B171000F4010000", "581#6017100000000000");
    let (sent, outcome) = run("set-node-id --node 1 --to 5", &device, &["701#7F"]);
    assert!(matches!(outcome, Err(LssError::Refused { code: 1, .. })), "{outcome:?}");
    let end: Vec<&str> = sent.iter().rev().take(3).rev().map(String::as_str).collect();
    assert_eq!(end, ["7E5#0400000000000000", "000#8001", "601#2B171000F4010000"]);
}

#[test]
fn r_dst_104_105_the_only_device_is_asked_for_its_address_and_node_id() {
    let device = BTreeMap::from([
        ("7E5#5A00000000000000", "7E4#5A3D020000000000"),
        ("7E5#5B00000000000000", "7E4#5B11000000000000"),
        ("7E5#5C00000000000000", "7E4#5C22000000000000"),
        ("7E5#5D00000000000000", "7E4#5D33000000000000"),
        ("7E5#5E00000000000000", "7E4#5E01000000000000"),
    ]);
    let (sent, outcome) = run("inquire --only-one-device", &device, &[]);
    let lines = told(&arguments("inquire --only-one-device").command, &outcome.unwrap());
    assert_eq!(lines, ["--vendor 0x23D --product 0x11 --revision 0x22 --serial 51", "node id 1"]);
    assert_eq!(sent.first().map(String::as_str), Some("7E5#0401000000000000"));
    assert_eq!(
        sent.last().map(String::as_str),
        Some("7E5#0400000000000000"),
        "no device stays in configuration state"
    );
}

#[test]
fn a_device_that_does_not_answer_an_inquiry_is_told_to_leave_configuration_state_all_the_same() {
    let (sent, outcome) = run("inquire --only-one-device", &Device::new(), &[]);
    assert!(matches!(outcome, Err(LssError::NoAnswer { .. })), "{outcome:?}");
    assert_eq!(sent, ["7E5#0401000000000000", "7E5#5A00000000000000", "7E5#0400000000000000"]);
}

#[test]
fn a_change_that_is_cancelled_goes_back_as_far_as_it_can() {
    let mut task = task(&arguments("set-node-id --node 1 --to 5")).unwrap();
    task.begin(Instant::START);
    task.handle_frame(Now::from_millis(1), &"701#05".parse().unwrap());
    let device = dst();
    let mut sent: Vec<String> = Vec::new();
    let mut now = 1;
    let outcome = loop {
        match task.poll_output() {
            Some(Step::Transmit(frame)) => {
                sent.push(frame.to_string());
                now += 1;
                if sent.last().is_some_and(|last| last == "7E5#1105000000000000") {
                    task.cancel(Instant::from_millis(now));
                } else if let Some(answer) = device.get(frame.to_string().as_str()) {
                    task.handle_frame(Now::from_millis(now), &answer.parse().unwrap());
                } else if frame.to_string() == "601#2B171000F4010000" {
                    task.handle_frame(Now::from_millis(now), &"581#6017100000000000".parse().unwrap());
                }
            }
            Some(Step::Done(outcome)) => break outcome,
            None => {
                now = task.poll_timeout().expect("something to wait for").as_micros().div_ceil(1000).max(now);
                task.handle_timeout(Now::from_millis(now));
            }
        }
    };
    assert_eq!(outcome, Err(LssError::Cancelled));
    let end: Vec<&str> = sent.iter().rev().take(3).rev().map(String::as_str).collect();
    assert_eq!(end, ["7E5#0400000000000000", "000#0101", "601#2B171000F4010000"], "{sent:#?}");
}

#[test]
fn a_scan_without_an_address_looks_for_unconfigured_devices_and_says_when_there_is_none() {
    let (sent, outcome) = run("scan", &Device::new(), &[]);
    let lines = told(&arguments("scan").command, &outcome.unwrap());
    assert!(lines[0].contains("no unconfigured device answered"), "{lines:?}");
    assert_eq!(sent.last().map(String::as_str), Some("7E5#0400000000000000"));
    assert!(task(&arguments("scan --vendor 0x23D")).is_err());
}

#[test]
fn an_address_is_printed_as_it_can_be_typed() {
    let address = LssAddress { vendor: 0x23D, product: 0x0603_3000, revision: 0x0102, serial: 4_294_967_295 };
    let words = format!("inquire {}", options(&address));
    let LssCommand::Inquire { address: read, .. } = arguments(&words).command else { panic!("{words}") };
    assert_eq!(read.address(), Ok(Some(address)));
}

#[test]
fn a_change_listens_before_it_sends_so_that_states_can_be_brought_back() {
    let mut task = task(&arguments("set-node-id --node 1 --to 5")).unwrap();
    task.begin(Instant::START);
    assert_eq!(task.poll_output(), None);
    assert_eq!(task.poll_timeout(), Some(Instant::START + Duration::from_secs(2)));
}
