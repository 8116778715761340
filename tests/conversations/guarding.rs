//! Guarding: V-DET-03 and 14, loss and recovery, foreign masters.

use cangate::canopen::NmtState;
use cangate::mapping::At;
use cangate::mapping::installation::ErrorControlWord;
use cangate::process_image::Value;

use super::{QUIET, detcon, detcon_with, running};

#[test]
fn v_det_03_r_det_023_040_041_all_guarding_bytes() {
    for (byte, state) in [
        ("80", NmtState::Initialising),
        ("04", NmtState::Stopped),
        ("84", NmtState::Stopped),
        ("05", NmtState::Operational),
        ("85", NmtState::Operational),
        ("7F", NmtState::PreOperational),
        ("FF", NmtState::PreOperational),
    ] {
        let mut conversation = detcon();
        conversation.play(&format!("10 reply 701#{byte}"));
        assert_eq!(conversation.node().nmt, Some(state), "{byte}");
        assert_eq!(conversation.node().counters.restarts, 0);
    }
    for (byte, raw) in [("06", 6), ("FE", 126)] {
        let mut conversation = detcon();
        conversation.play(&format!("10 reply 701#{byte}"));
        let events = conversation.events_named("node_state_invalid");
        assert_eq!(events.len(), 1);
        assert_eq!(events[0].value, Some(Value::Unsigned(raw)));
        assert!(conversation.node().online, "a sign of life all the same");
    }
}

#[test]
fn v_det_14_r_det_035_one_repeated_toggle_bit_is_counted_and_forgiven() {
    let mut conversation = detcon();
    conversation.play(
        "0    reply 701#05
         500  reply 701#05
         1000 reply 701#85",
    );
    assert_eq!(conversation.node().counters.toggle_errors, 1);
    assert!(conversation.node().online);
    assert!(conversation.active().is_empty());
}

#[test]
fn v_det_14_r_det_036_a_stuck_toggle_bit_loses_the_node() {
    let mut conversation = detcon();
    conversation.play(
        "0    reply 701#05
         500  reply 701#05
         1000 reply 701#05
         1100 alarm node_lost normal
         1450 reply 701#05
         1502 alarm node_lost unacknowledged
         1502 event node_lost",
    );
    assert_eq!(conversation.node().counters.toggle_errors, 3);
    assert!(conversation.node().reason.contains("toggle bit"), "{}", conversation.node().reason);
}

#[test]
fn v_det_14_r_det_034_after_a_missed_reply_either_toggle_bit_is_taken() {
    let mut conversation = detcon();
    conversation.play(
        "0    reply 701#05
         600  reply 701#05",
    );
    assert_eq!(conversation.node().counters.guard_misses, 1);
    assert_eq!(conversation.node().counters.toggle_errors, 0);
}

#[test]
fn v_det_14_r_det_033_036_037_silence_loses_the_node_and_a_reply_brings_it_back() {
    let mut conversation = detcon();
    conversation.play(
        "0    reply 701#05
         400  <- 181#3300000000000000
         1599 alarm node_lost normal
         1599 tag knock_intensity_1 = 20.00 good
         1600 alarm node_lost unacknowledged
         1600 tag knock_intensity_1 = 20.00 bad (node_lost)
         1600 event node_lost
         1900 reply 701#FF",
    );
    assert_eq!(conversation.node().counters.guard_misses, 3);
    let back = conversation.now_millis();
    conversation.play(&format!(
        "{back} -> 000#0101
         {back} event node_recovered
         {back} tag knock_intensity_1 = 20.00 bad (node_lost)"
    ));
    assert!(!conversation.active().contains(&"node_lost"));
    assert_eq!(conversation.node().nmt, Some(NmtState::PreOperational));
    conversation.frame("181#3300000000000000");
    assert_eq!(conversation.tag_text("knock_intensity_1"), "20.00 good");
}

#[test]
fn r_det_037_tpdos_of_a_lost_node_are_uncertain_and_the_alarm_does_not_flicker() {
    let mut conversation = running(detcon());
    conversation.stop_answering(1);
    conversation.run_to(4_000);
    assert_eq!(conversation.alarm("node_lost").count, 1);
    assert_eq!(conversation.tag_text("knock_intensity_1"), "0.00 uncertain (node_lost)");
    assert!(!conversation.node().online);
    assert_eq!(conversation.raised(), ["node_lost"]);
    for frame in QUIET {
        conversation.stop_sending(frame);
    }
    conversation.run_to(6_000);
    assert_eq!(
        conversation.tag_text("knock_intensity_1"),
        "0.00 bad (node_lost)",
        "it does not come any more"
    );
}

#[test]
fn r_det_038_an_unexpected_state_makes_the_data_stale_and_is_told() {
    let mut conversation = running(detcon());
    conversation.stop_sending("");
    conversation.stop_answering(1);
    conversation.answer_guarding(1, 4);
    conversation.run_to(1_600);
    let event = &conversation.events_named("node_state_unexpected")[0];
    assert_eq!((event.from.as_str(), event.to.as_str()), ("operational", "stopped"));
    assert_eq!(conversation.tag_text("knock_intensity_1"), "0.00 stale (node_not_operational)");
    assert_eq!(conversation.all_sent.iter().filter(|frame| frame.to_string() == "000#0101").count(), 1);
}

#[test]
fn r_det_042_a_guard_reply_of_another_length_is_counted() {
    let mut conversation = detcon();
    conversation.play("10 reply 701#0500");
    assert_eq!(conversation.node().nmt, Some(NmtState::Operational));
    assert_eq!(conversation.node().counters.malformed, 1);
}

#[test]
fn r_det_043_somebody_elses_guard_request_is_told() {
    let mut conversation = running(detcon());
    for millis in [1_200, 1_700, 2_200] {
        conversation.run_to(millis);
        conversation.frame("701#R1");
    }
    assert_eq!(conversation.events_named("foreign_guard_master").len(), 2, "the event and the alarm");
}

#[test]
fn r_det_044_heartbeat_sends_no_request_and_loses_the_node_by_silence() {
    let mut conversation =
        detcon_with(|_, node| node.error_control = Some(At::nowhere(ErrorControlWord::Heartbeat)));
    conversation.send_cyclically("701#05", 1_000);
    conversation.run_to(5_000);
    assert!(conversation.node().online && conversation.node().supervised);
    conversation.stop_sending("701");
    conversation.play(
        "6499 alarm node_lost normal
         6500 alarm node_lost unacknowledged",
    );
    assert!(conversation.all_sent.iter().all(|frame| !frame.is_remote()));
}

#[test]
fn r_det_045_a_state_that_nobody_asked_for_counts_and_is_told_once() {
    let mut conversation = running(detcon());
    for millis in [1_200, 1_300, 1_400] {
        conversation.run_to(millis);
        conversation.frame("701#05");
    }
    assert_eq!(conversation.events_named("unsolicited_state").len(), 1);
    assert_eq!(conversation.node().counters.toggle_errors, 0);
}

#[test]
fn r_det_031_guarding_off_is_no_supervision() {
    let mut conversation = detcon_with(|_, node| node.guard_time_ms = Some(At::nowhere(0)));
    conversation.frame(QUIET[0]);
    conversation.run_to(1_400);
    assert!(conversation.node().online && !conversation.node().supervised);
    assert!(conversation.all_sent.iter().all(|frame| !frame.is_remote()));
}

#[test]
fn r_det_091_emergency_frames_are_events() {
    let mut conversation = running(detcon());
    conversation.frame("081#1042010A0B0C0D0E");
    let event = &conversation.events_named("emergency")[0];
    assert_eq!((event.to.as_str(), event.value), ("0x4210", Some(Value::Unsigned(0x4210))));
    assert!(event.text.contains("register 0x01") && event.text.contains("0A0B0C0D0E"), "{}", event.text);
    assert_eq!(conversation.node().counters.emcys, 1);
}
