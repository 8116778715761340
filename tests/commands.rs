//! Who may ask for what, and what is told of it: from the desk at which the doors hand in to the journal and the bus.

use std::sync::Arc;

use cangate::access::{Access, Grant, Role};
use cangate::can::Link;
use cangate::canopen::NmtRequest;
use cangate::gateway::command::desk::{Request, Requests};
use cangate::gateway::command::{Authority, ObjectId};
use cangate::gateway::{Action, CommandSource, Desk, Input, Outcome};
use cangate::process_image::{AlarmIndex, Event, EventKind, NodeIndex, TagIndex, Value};

use super::conversations::{detcon, running};
use super::support::conversation::Conversation;

/// One of everything that can be asked for.
fn actions() -> [Action; 8] {
    let (node, object, timeout) = (NodeIndex(0), ObjectId::new(0x1017, 0), None);
    [
        Action::Nmt { node, request: NmtRequest::Stop },
        Action::WriteTags { writes: vec![(TagIndex(0), Value::Unsigned(1))] },
        Action::Acknowledge { alarm: AlarmIndex(0), raise: None },
        Action::AcknowledgeAll { node: None },
        Action::Reset { alarm: AlarmIndex(0) },
        Action::SdoRead { node, object, len: None, timeout },
        Action::SdoWrite { node, object, data: vec![0, 0], timeout },
        Action::SerialSend { line: cangate::process_image::LineIndex(0), bytes: vec![1] },
    ]
}

/// How many requests the journal tells of as refused.
pub fn forbidden(events: &[Event]) -> u64 {
    let refused = events.iter().filter(|event| event.kind == EventKind::Command && event.to == "forbidden");
    let count = |event: &Event| match event.value {
        Some(Value::Unsigned(count)) => count,
        _ => 1,
    };
    refused.map(count).sum()
}

/// Frames that are not part of guarding and starting the node.
pub fn commands_sent(conversation: &Conversation) -> Vec<String> {
    let sent = conversation.all_sent.iter().filter(|frame| !frame.is_remote()).map(ToString::to_string);
    sent.filter(|frame| frame != "000#0101").collect()
}

#[tokio::test(start_paused = true)]
async fn must_hold_100_000_attempts_without_a_right_send_no_frame_and_all_stand_in_the_audit() {
    let mut conversation = running(detcon());
    let (desk, commands) = Desk::new(32);
    let mut requests = Requests::new(&desk, commands);
    assert_eq!(desk.access(), Arc::new(Access::default()), "nobody is known");
    let viewer = Authority::Grant(Arc::new(Grant::new("panel", Role::Viewer, [])));
    let actions = actions();
    for attempt in 0..100_000_usize {
        let (action, port) = (actions[attempt % actions.len()].clone(), 1024 + attempt % 60_000);
        let client = format!("10.0.{}.7:{port}", attempt % 3);
        match attempt % 4 {
            0 => desk.refuse(CommandSource::modbus(client), action.word(), "nobody is known by it".into()),
            1 => desk.refuse(CommandSource::web(client), action.word(), "no login".into()),
            2 => {
                let topic = CommandSource::mqtt("cangate/hall-1/bridge/request/write".into());
                assert!(matches!(desk.ask(topic, &viewer, action).await, Outcome::Forbidden(_)));
            }
            _ => {
                let refused = desk.hand_in(CommandSource::web(client), &viewer, action);
                assert!(matches!(refused, Err(Outcome::Forbidden(_))));
            }
        }
        if attempt % 10_000 == 0 {
            match requests.next().await {
                Some(Request::Refused(refused)) => conversation.input(Input::Refused(refused)),
                other => panic!("{other:?}"),
            }
        }
    }
    match requests.next().await {
        Some(Request::Refused(refused)) => conversation.input(Input::Refused(refused)),
        other => panic!("{other:?}"),
    }
    let counted: u64 = desk.refused().into_iter().map(|(_, count)| count).sum();
    assert_eq!(counted, 100_000);
    drop(desk);
    assert!(requests.next().await.is_none(), "not one got through");
    let asked_until = conversation.now_millis();
    conversation.run_to(asked_until + 61_000);
    assert_eq!(commands_sent(&conversation), [""; 0]);
    let events = conversation.events();
    assert_eq!(forbidden(&events), 100_000);
    assert!(events.len() < 200, "{} events: they do not push others out of the journal", events.len());
    let from: Vec<&str> = events.iter().map(|event| event.from.as_str()).collect();
    assert!(from.contains(&"mqtt cangate/hall-1/bridge/request/write as panel"), "{from:?}");
    assert!(from.iter().any(|from| from.starts_with("modbus 10.0.0.7:")), "{from:?}");
}

fn refused(conversation: &mut Conversation, count: u64) {
    let source = CommandSource::modbus("10.0.0.7:1".into());
    let text = "nobody".to_owned();
    let refused = cangate::gateway::Refused { source, verb: "write", action: None, text, count };
    conversation.input(Input::Refused(vec![refused]));
}

#[test]
fn g07_five_refusals_within_a_minute_raise_an_alarm_that_ends_when_they_do() {
    let mut conversation = running(detcon());
    let begin = conversation.now_millis();
    for second in 0..4 {
        conversation.run_to(begin + second * 1000);
        refused(&mut conversation, 1);
    }
    conversation.run_to(begin + 59_000);
    assert!(conversation.is_normal("access_refused"));
    refused(&mut conversation, 1);
    assert!(!conversation.is_normal("access_refused"));
    // The first of the five is a minute ago at 60 s; 300 s later nothing of it is active.
    conversation.run_to(begin + 359_000);
    assert!(conversation.active().contains(&"access_refused"));
    conversation.run_to(begin + 361_000);
    assert!(!conversation.active().contains(&"access_refused"));
}

#[test]
fn g07_four_a_minute_are_no_alarm_however_long_they_come() {
    let mut conversation = running(detcon());
    let begin = conversation.now_millis();
    for quarter in 0..40 {
        conversation.run_to(begin + quarter * 15_001);
        refused(&mut conversation, 1);
        assert!(conversation.is_normal("access_refused"), "{quarter}");
    }
    refused(&mut conversation, 5);
    assert!(!conversation.is_normal("access_refused"));
}

#[test]
fn an_old_screen_cannot_acknowledge_an_alarm_that_was_raised_since() {
    let mut conversation = running(detcon());
    for link in [Link::Down, Link::ErrorActive, Link::Down] {
        let now = conversation.now_millis();
        conversation.run_to(now + 1000);
        conversation.link(link);
    }
    let (alarm, count) =
        (conversation.alarm_index("interface_down"), conversation.alarm("interface_down").count);
    let acknowledge = |raise| Action::Acknowledge { alarm, raise };
    assert_eq!(count, 2);
    let Outcome::Rejected(why) = conversation.command(acknowledge(Some(1))) else { panic!("it was taken") };
    assert!(why.contains("raised 2 times by now, not 1"), "{why}");
    assert!(!conversation.is_normal("interface_down"));
    assert_eq!(conversation.command(acknowledge(Some(2))), Outcome::Done);
}

#[test]
fn what_a_grant_allowed_stands_in_the_journal_with_its_name() {
    let mut conversation = running(detcon());
    let mut source = CommandSource::web("10.0.0.9:40000".into());
    source.access = Some("shift-lead".into());
    let action = Action::AcknowledgeAll { node: None };
    conversation.input(Input::Command(cangate::gateway::Command { id: 1, source, action }));
    let event = conversation.events_named("acknowledge_all").pop().unwrap();
    assert_eq!((event.from.as_str(), event.to.as_str()), ("web 10.0.0.9:40000 as shift-lead", "done"));
}
