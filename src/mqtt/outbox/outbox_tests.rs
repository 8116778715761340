//! The outbox by itself.

use proptest::prelude::*;

use super::*;

fn message(topic: &str, payload: &str, retain: bool) -> Message {
    Message { retain, ..Message::event(topic.into(), payload.into()) }
}

fn outbox(messages: usize, window: usize) -> Outbox {
    Outbox::new(Limits { messages, bytes: 1_000_000, window, message: 1000 })
}

fn drain(outbox: &mut Outbox) -> Vec<String> {
    std::iter::from_fn(|| outbox.poll_output()).map(|out| out.message.payload.to_string()).collect()
}

#[test]
fn of_a_retained_topic_only_the_newest_waits_at_its_place() {
    let mut outbox = outbox(10, 10);
    outbox.push(message("a", "a1", true));
    outbox.push(message("b", "b1", true));
    outbox.push(message("a", "a2", true));
    assert_eq!(drain(&mut outbox), ["a2", "b1"]);
    assert_eq!(outbox.report().superseded, 1);
    outbox.push(message("a", "a3", true));
    assert_eq!(drain(&mut outbox), ["a3"], "what is sent already is not superseded");
}

#[test]
fn a_full_outbox_lets_the_oldest_events_go_and_nothing_that_is_retained() {
    let mut outbox = outbox(4, 0);
    outbox.push(message("state", "s", true));
    outbox.push(message("alarm", "a", true));
    for number in 1..=6 {
        outbox.push(message("event", &format!("e{number}"), false));
    }
    outbox.push(message("health", "h", true));
    assert_eq!(outbox.report().events_dropped, 2);
    outbox.limits.window = 10;
    assert_eq!(drain(&mut outbox), ["s", "e3", "a", "e4", "h", "e5", "e6"]);
}

#[test]
fn what_waits_at_a_stop_is_let_go_and_counted_what_is_sent_may_still_be_acknowledged() {
    let mut outbox = outbox(10, 1);
    for (topic, retain) in [("event", false), ("event", false), ("state", true)] {
        outbox.push(message(topic, "x", retain));
    }
    let sent = outbox.poll_output().unwrap();
    outbox.clear_waiting();
    assert_eq!((outbox.report().messages, outbox.report().held.0), (1, 0));
    assert_eq!(outbox.report().events_dropped, 2);
    outbox.handle_acknowledged(sent.id);
    assert!(outbox.is_empty());
}

#[test]
fn p5_after_a_lost_session_events_come_again_in_order_and_are_marked() {
    let mut outbox = outbox(10, 3);
    for number in 1..=4 {
        outbox.push(message("event", &format!("e{number}"), false));
    }
    let sent: Vec<_> = std::iter::from_fn(|| outbox.poll_output()).collect();
    assert!(sent.iter().all(|out| !out.again));
    outbox.handle_acknowledged(sent[1].id);
    outbox.handle_session_down();
    outbox.limits.window = 10;
    let again: Vec<_> = std::iter::from_fn(|| outbox.poll_output())
        .map(|out| (out.message.payload.to_string(), out.again))
        .collect();
    let expected = [("e1", true), ("e3", true), ("e4", false)].map(|(name, again)| (name.to_owned(), again));
    assert_eq!(again, expected);
}

#[test]
fn p6_what_is_live_takes_turns_with_the_backlog() {
    let mut outbox = outbox(100, 100);
    for number in 1..=3 {
        outbox.push(message("event", &format!("e{number}"), false));
    }
    outbox.push(message("a", "live1", true));
    outbox.push(message("b", "live2", true));
    assert_eq!(drain(&mut outbox), ["live1", "e1", "live2", "e2", "e3"]);
}

#[test]
fn a_message_that_no_broker_takes_is_counted_and_thrown_away() {
    let mut outbox = outbox(10, 10);
    outbox.push(message("event", &"x".repeat(2000), false));
    assert!(outbox.is_empty());
    assert_eq!(outbox.report().too_large, 1);
}

#[test]
fn the_forecast_is_what_is_free_over_the_mean_rate() {
    let mut outbox = outbox(110, 0);
    assert_eq!(outbox.report().hours_left(3600), None);
    for _ in 0..10 {
        outbox.push(message("event", "x", false));
    }
    assert_eq!(outbox.report().hours_left(3600), Some(10.0));
}

#[test]
fn an_event_that_is_not_taken_for_now_goes_back_in_front_and_waits_with_all_that_follow() {
    let mut outbox = outbox(10, 3);
    for number in 1..=5 {
        outbox.push(message("event", &format!("e{number}"), false));
    }
    let sent: Vec<_> = std::iter::from_fn(|| outbox.poll_output()).map(|out| out.id).collect();
    outbox.handle_acknowledged(sent[1]);
    for id in [sent[2], sent[0]] {
        assert_eq!(outbox.handle_not_taken(id, false).unwrap().became, Became::Held);
    }
    outbox.push(message("state", "s", true));
    assert_eq!(drain(&mut outbox), ["s"], "only what is retained");
    assert_eq!((outbox.report().refused, outbox.report().held.0), (0, 4));
    outbox.release();
    assert_eq!(drain(&mut outbox), ["e1", "e3"]);
    assert_eq!(outbox.report().sent_again, 2);
    outbox.handle_not_taken(sent[0], false);
    outbox.handle_session_down();
    assert_eq!(drain(&mut outbox), ["e1", "e3", "e4"], "a new session tries again");
}

#[test]
fn what_will_never_be_taken_and_what_is_retained_is_given_up_and_counted() {
    let mut outbox = outbox(10, 10);
    outbox.push(message("event", "e1", false));
    outbox.push(message("state", "s", true));
    outbox.push_stored(message("event", "e2", false), Class::Event, 7);
    let sent: BTreeMap<String, MessageId> = std::iter::from_fn(|| outbox.poll_output())
        .map(|out| (out.message.payload.to_string(), out.id))
        .collect();
    let mut became =
        |payload: &str, for_ever| outbox.handle_not_taken(sent[payload], for_ever).unwrap().became;
    assert_eq!(became("e1", true), Became::GivenUp(None));
    assert_eq!(became("e2", true), Became::GivenUp(Some((Class::Event, 7))));
    assert_eq!(became("s", false), Became::Untold(None));
    assert!(outbox.is_empty());
    assert_eq!((outbox.report().refused, outbox.report().acknowledged), (3, 0));
    assert_eq!(outbox.handle_not_taken(sent["s"], false), None);
}

#[test]
fn a_state_that_is_not_taken_belongs_to_the_history() {
    let mut outbox = outbox(10, 10);
    outbox.push_sample(message("state", "s1", true), Instant::START);
    let id = outbox.poll_output().unwrap().id;
    let unsent = outbox.handle_not_taken(id, false).unwrap().became;
    assert_eq!(unsent, Became::Untold(Some(message("state", "s1", true))));
}

#[derive(Clone, Debug)]
enum Step {
    Push { topic: usize, size: usize },
    Send,
    Acknowledge { which: usize },
    SessionDown,
}

fn step() -> impl Strategy<Value = Step> {
    prop_oneof![
        6 => (0usize..6, 1usize..40).prop_map(|(topic, size)| Step::Push { topic, size }),
        6 => Just(Step::Send),
        4 => (0usize..4).prop_map(|which| Step::Acknowledge { which }),
        1 => Just(Step::SessionDown),
    ]
}

/// Topics 0 and 1 are events, the others retained.
fn is_retained(topic: usize) -> bool {
    topic >= 2
}

proptest! {
    #[test]
    fn p1_p5_p6_nothing_is_lost_uncounted_reordered_or_doubled_within_a_session(
        steps in proptest::collection::vec(step(), 1..300),
        messages in 1usize..12,
        window in 1usize..5,
    ) {
        let mut outbox = Outbox::new(Limits { messages, bytes: 250, window, message: 35 });
        let mut pushed = 0u64;
        // Sequence number -> session in which it was sent last.
        let mut sent: BTreeMap<u64, u64> = BTreeMap::new();
        // Highest sequence number sent first, of each topic.
        let mut newest: BTreeMap<String, u64> = BTreeMap::new();
        let mut in_flight: Vec<MessageId> = Vec::new();
        let mut session = 0u64;
        for step in steps {
            match step {
                Step::Push { topic, size } => {
                    pushed += 1;
                    let payload = format!("{pushed:0size$}");
                    outbox.push(message(&topic.to_string(), &payload, is_retained(topic)));
                }
                Step::Send => {
                    if let Some(out) = outbox.poll_output() {
                        let seq: u64 = out.message.payload.parse().unwrap();
                        let before = sent.insert(seq, session);
                        prop_assert_eq!(before.is_some(), out.again);
                        prop_assert!(before.is_none_or(|before| before < session), "twice in a session");
                        let newest = newest.entry(out.message.topic.to_string()).or_default();
                        prop_assert!(out.again || seq > *newest, "first deliveries in order");
                        *newest = seq.max(*newest);
                        in_flight.push(out.id);
                        prop_assert!(in_flight.len() <= window);
                    }
                }
                Step::Acknowledge { which } => {
                    if which < in_flight.len() {
                        outbox.handle_acknowledged(in_flight.remove(which));
                    }
                }
                Step::SessionDown => {
                    session += 1;
                    in_flight.clear();
                    outbox.handle_session_down();
                }
            }
            let report = *outbox.report();
            let waiting = outbox.events.len() + outbox.latest.len();
            prop_assert_eq!(report.messages, waiting + outbox.in_flight.len());
            prop_assert_eq!(outbox.latest_of.len(), outbox.latest.len());
            let all = || outbox.events.values().chain(outbox.latest.values()).chain(outbox.in_flight.values());
            prop_assert_eq!(report.bytes, all().map(|entry| entry.message.size()).sum::<usize>());
            let events = || all().filter(|entry| !entry.message.retain);
            prop_assert_eq!(report.held.0, events().count());
            prop_assert_eq!(report.held.1, events().map(|entry| entry.message.size()).sum::<usize>());
            prop_assert!(report.held.0 <= messages.max(window) && report.held.1 <= 250);
            prop_assert!(outbox.latest.len() <= 4, "one for each retained topic");
            let left = u64::try_from(report.messages).unwrap();
            prop_assert_eq!(
                pushed,
                report.acknowledged + report.superseded + report.too_large + report.events_dropped + left
            );
        }
    }
}
