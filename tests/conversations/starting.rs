//! Boot-up, start, restart: V-DET-01, 02, 15 and R-DET-016..020.

use cangate::canopen::NmtState;

use super::{QUIET, detcon, detcon_with, running};
use crate::support::conversation::Conversation;

#[test]
fn v_det_02_r_det_017_021_to_029_power_up_guarding_start() {
    let mut conversation = detcon();
    conversation.play(
        "50 <- 701#00
         50 event node_seen
         60 reply 701#7F",
    );
    assert_eq!(conversation.all_sent.last().unwrap().to_string(), "000#0101");
    conversation.forget_sent();
    for byte in ["85", "05"] {
        conversation.play(&format!("{} reply 701#{byte}", conversation.now_millis() + 1));
    }
    assert_eq!(conversation.node().nmt, Some(NmtState::Operational));
    assert!(conversation.node().online && conversation.node().supervised);
    assert_eq!(conversation.node().counters.toggle_errors, 0);
    assert_eq!(conversation.node().counters.restarts, 0, "the first contact is no restart");
    conversation.end();
}

#[test]
fn r_det_017_an_operational_node_is_not_started() {
    let mut conversation = detcon();
    conversation.answer_guarding(1, 5);
    conversation.run_to(5_000);
    conversation.end();
    assert_eq!(conversation.node().nmt, Some(NmtState::Operational));
}

#[test]
fn r_det_017_a_stopped_node_is_started_unless_auto_start_is_off() {
    let started = |auto_start: bool| {
        let mut conversation = detcon_with(|_, node| node.auto_start = Some(auto_start));
        conversation.answer_guarding(1, 4);
        conversation.run_to(100);
        conversation.all_sent.iter().any(|frame| frame.to_string() == "000#0101")
    };
    assert!(started(true) && !started(false));
}

#[test]
fn r_det_020_a_start_without_effect_is_repeated_and_raises_the_alarm_after_three() {
    let mut conversation = detcon();
    conversation.answer_guarding(1, 127);
    conversation.play(
        "1    -> 000#0101
         1001 -> 000#0101
         2001 -> 000#0101
         3001 -> 000#0101
         3001 event node_start_failed
         3001 alarm node_start_failed unacknowledged
         4001 -> 000#0101",
    );
    assert!(conversation.node().reason.contains("start commands had no effect"));
    conversation.answer_guarding(1, 5);
    conversation.play("4600 event node_start_succeeded");
    assert!(!conversation.active().contains(&"node_start_failed"));
    assert_eq!(conversation.node().counters.nmt_commands_sent, 5);
}

#[test]
fn v_det_15_r_det_019_039_boot_up_in_the_middle_of_operation() {
    let mut conversation = running(detcon());
    for frame in QUIET {
        conversation.stop_sending(frame);
    }
    conversation.stop_answering(1);
    conversation.play(
        "1100 <- 181#1020304050607080
         1100 tag knock_intensity_1 = 6.27 good
         1200 <- 701#00
         1200 event node_restarted
         1200 tag knock_intensity_1 = 6.27 stale (node_restarted)
         1200 tag knock_intensity_max = 50.20 stale (node_restarted)",
    );
    assert_eq!(conversation.node().counters.restarts, 1);
    assert_eq!(conversation.node().nmt, Some(NmtState::Initialising));
    conversation.play("1201 reply 701#7F");
    let asked = conversation.now_millis();
    conversation.play(&format!(
        "{asked} -> 000#0101
         {asked} tag knock_intensity_1 = 6.27 stale (node_restarted)
         1900 <- 181#0000000000000000
         1900 tag knock_intensity_1 = 0.00 good"
    ));
    assert_eq!(conversation.node().counters.toggle_errors, 0);
    conversation.end();
}

#[test]
fn r_det_019_a_node_that_answers_no_guarding_is_started_after_the_delay() {
    let mut conversation = detcon();
    conversation.play(
        "50  <- 701#00
         550 -> 000#0101",
    );
}

#[test]
fn r_det_046_each_node_is_asked_at_once() {
    let mut conversation = Conversation::new(super::table(&[("engine1", 1), ("engine2", 2)], |_, _| ()));
    conversation.play(
        "0  -> 701#R1
         50 <- 701#05",
    );
    let asked: Vec<String> = conversation.all_sent.iter().map(ToString::to_string).collect();
    assert_eq!(asked, ["701#R1", "702#R1"]);
}

#[test]
fn a_power_cycle_ends_in_good_data_within_two_seconds_of_the_boot_up() {
    let mut conversation = running(detcon());
    for frame in QUIET {
        conversation.stop_sending(frame);
    }
    conversation.stop_answering(1);
    conversation.run_to(10_000);
    assert!(!conversation.node().online);
    conversation.frame("701#00");
    conversation.answer_guarding(1, 127);
    conversation.run_to(10_300);
    let started = conversation.all_sent.last().unwrap().to_string();
    assert_eq!(started, "000#0101");
    conversation.forget_sent();
    conversation.answer_guarding(1, 5);
    for frame in QUIET {
        conversation.send_cyclically(frame, 500);
    }
    conversation.run_to(12_000);
    assert!(conversation.node().online);
    assert!(conversation.image.tags.iter().all(|tag| tag.quality.is_good()));
}

#[test]
fn r_det_002_016_018_090_nothing_but_addressed_start_and_guard_requests_is_ever_sent() {
    let mut conversation = detcon();
    conversation.answer_guarding(1, 127);
    conversation.run_to(5_000);
    conversation.stop_answering(1);
    conversation.run_to(20_000);
    conversation.frame("701#00");
    conversation.answer_guarding(1, 5);
    conversation.run_to(60_000);
    let kinds: std::collections::BTreeSet<String> =
        conversation.all_sent.iter().map(ToString::to_string).collect();
    assert_eq!(kinds.into_iter().collect::<Vec<_>>(), ["000#0101", "701#R1"]);
}
