//! What operators ask for, and the passive role.

use cangate::can::Link;
use cangate::canopen::{NmtRequest, NmtState};
use cangate::gateway::{Action, Outcome};
use cangate::mapping::installation::RoleWord;
use cangate::process_image::{AlarmIndex, EventKind, NodeIndex};

use super::{QUIET, detcon, detcon_with, running};

#[test]
fn v_det_01_r_det_007_009_016_017_nmt_commands_of_an_operator() {
    let mut conversation = running(detcon());
    for (request, frame) in [
        (NmtRequest::Stop, "000#0201"),
        (NmtRequest::Start, "000#0101"),
        (NmtRequest::EnterPreOperational, "000#8001"),
        (NmtRequest::ResetCommunication, "000#8201"),
        (NmtRequest::ResetNode, "000#8101"),
    ] {
        assert_eq!(conversation.nmt(request), Outcome::Done);
        conversation.play(&format!("{} -> {frame}", conversation.now_millis()));
    }
    conversation.end();
    assert_eq!(conversation.node().counters.nmt_commands_sent, 5);
    let event = conversation.events().into_iter().find(|event| event.kind == EventKind::Command).unwrap();
    assert_eq!((event.name.as_str(), event.from.as_str(), event.to.as_str()), ("nmt", "mqtt test", "done"));
    assert_eq!(event.text, "stop");
}

#[test]
fn r_det_017_a_node_that_an_operator_stopped_stays_stopped() {
    let mut conversation = running(detcon());
    conversation.nmt(NmtRequest::Stop);
    conversation.forget_sent();
    for frame in QUIET {
        conversation.stop_sending(frame);
    }
    conversation.answer_guarding(1, 4);
    conversation.run_to(10_000);
    conversation.end();
    assert_eq!(conversation.node().nmt, Some(NmtState::Stopped));
    assert_eq!(conversation.tag_text("trip"), "false stale (node_not_operational)");
    assert_eq!(conversation.node().reason, "stopped by a command");
    assert!(conversation.raised().is_empty(), "{:?}", conversation.raised());
}

#[test]
fn a_command_to_nobody_or_over_a_bus_that_is_down_is_refused() {
    let mut conversation = running(detcon());
    let nobody = Action::Nmt { node: NodeIndex(7), request: NmtRequest::Stop };
    assert_eq!(conversation.command(nobody), Outcome::Unknown);
    assert_eq!(conversation.command(Action::AcknowledgeAll { node: Some(NodeIndex(7)) }), Outcome::Unknown);
    assert_eq!(
        conversation.command(Action::Acknowledge { alarm: AlarmIndex(9_999), raise: None }),
        Outcome::Unknown
    );
    assert_eq!(conversation.command(Action::Reset { alarm: AlarmIndex(9_999) }), Outcome::Unknown);
    conversation.link(Link::Down);
    assert_eq!(conversation.nmt(NmtRequest::Stop), Outcome::NodeUnavailable);
    conversation.end();
}

#[test]
fn who_asks_again_and_again_for_what_is_refused_does_not_fill_the_journal() {
    let mut conversation = running(detcon_with(|bus, _| bus.role = RoleWord::Passive));
    for second in 2..=302 {
        conversation.run_to(second * 1000);
        assert!(matches!(conversation.nmt(NmtRequest::Stop), Outcome::Rejected(_)));
    }
    let commands = conversation.events().into_iter().filter(|event| event.kind == EventKind::Command);
    let texts: Vec<String> = commands.map(|event| event.text).collect();
    assert_eq!(texts.len(), 6, "the first, and a count each minute: {texts:#?}");
    assert!(texts[0].starts_with("stop: ") && !texts[0].contains("more of these"), "{}", texts[0]);
    assert!(texts[5].starts_with("60 more of these within 60 s, the last: stop: "), "{}", texts[5]);
}

#[test]
fn in_the_passive_role_not_one_frame_is_sent_and_values_are_there() {
    let mut conversation = running(detcon_with(|bus, _| bus.role = RoleWord::Passive));
    conversation.frame("701#00");
    conversation.frame("701#R1");
    conversation.frame("701#7F");
    conversation.run_to(2_000);
    conversation.stop_sending("");
    conversation.run_to(60_000);
    conversation.frame("701#00");
    conversation.run_to(70_000);
    assert!(
        matches!(conversation.nmt(NmtRequest::Start), Outcome::Rejected(reason) if reason.contains("passive"))
    );
    assert!(conversation.all_sent.is_empty(), "{:?}", conversation.all_sent);
    assert!(conversation.node().passive);
    assert!(conversation.tag("knock_intensity_1").received_at.is_some());
}

#[test]
fn latched_bits_stay_until_acknowledged_while_the_source_is_false() {
    let mut conversation = running(detcon());
    conversation.stop_sending("381");
    conversation.frame("381#0200FF0F000099CC");
    conversation.command(Action::AcknowledgeAll { node: None });
    assert_eq!(conversation.tag_text("trip_latched"), "true good", "trip still stands");
    conversation.frame("381#0000FF0F000099CC");
    assert_eq!(conversation.tag_text("trip_latched"), "true good");
    assert_eq!(conversation.command(Action::AcknowledgeAll { node: Some(NodeIndex(0)) }), Outcome::Done);
    assert_eq!(conversation.tag_text("trip_latched"), "false good");
}
