//! What is told when another configuration comes while a session with the broker lasts, in numbers instead of time.

use std::sync::Arc;

use cangate::mqtt::sparkplug::payload::{MetricValue, Payload};
use cangate::mqtt::sparkplug::{EdgeNode, SparkplugSettings};
use cangate::mqtt::{Identity, MqttSettings, Publisher};
use cangate::process_image::{NodeIndex, ProcessImage, Revision, Value};
use prost::Message;

use crate::support::plant::{at, good, happen, image, lose, table};

fn identity() -> Identity {
    Identity { sid: "s".into(), ..Identity::default() }
}

/// Topics and payloads that go out by `millis`, all acknowledged.
fn sent(publisher: &mut Publisher, image: &ProcessImage, millis: u64) -> Vec<(String, String)> {
    let mut sent = Vec::new();
    loop {
        publisher.handle_image(at(millis), image);
        while let Some(out) = publisher.poll_output() {
            publisher.handle_acknowledged(out.id);
            sent.push((out.message.topic.to_string(), out.message.payload.to_string()));
        }
        if publisher.poll_timeout().is_none_or(|due| due > at(millis).instant) {
            return sent;
        }
    }
}

fn cleared(sent: &[(String, String)]) -> Vec<&str> {
    sent.iter().filter(|(_, payload)| payload.is_empty()).map(|(topic, _)| topic.as_str()).collect()
}

fn payload_of<'a>(sent: &'a [(String, String)], topic: &str) -> &'a str {
    let found = sent.iter().find(|(each, _)| each.ends_with(topic));
    found.map_or_else(|| panic!("{topic}: {sent:?}"), |(_, payload)| payload.as_str())
}

#[test]
fn p29_a_session_goes_on_with_another_table_and_numbers_have_no_gap() {
    let (two, one) = (table(2), table(1));
    let mut shown = image(&two);
    let settings = MqttSettings::default();
    let mut publisher = Publisher::new(two, &settings, identity());
    publisher.handle_session_up();
    happen(&mut shown, 1);
    let first = sent(&mut publisher, &shown, 0);
    assert!(payload_of(&first, "hall-1/event").contains(r#""seq":1,"#));
    assert!(payload_of(&first, "engine1/state").contains(r#""seq":1,"#));

    let journal = shown.journal.clone();
    let mut shown = image(&one);
    shown.journal = journal;
    happen(&mut shown, 2);
    publisher.exchange(&settings, Arc::clone(&one), identity(), &[]);
    let second = sent(&mut publisher, &shown, 100);
    let prefix = "cangate/hall-1/engine2";
    assert_eq!(
        cleared(&second),
        [
            format!("{prefix}/alarm/node_lost"),
            format!("{prefix}/alarm/pdo_timeout_1"),
            format!("{prefix}/alarm/trip"),
            format!("{prefix}/availability"),
            format!("{prefix}/state"),
        ]
    );
    let events: Vec<_> = second.iter().filter(|(topic, _)| topic.ends_with("/event")).collect();
    assert_eq!(events.len(), 1);
    assert!(events[0].1.contains(r#""seq":2,"#), "{events:?}");
    assert!(payload_of(&second, "engine1/state").contains(r#""seq":2,"#));
    assert_eq!(second.last().unwrap().0, "cangate/hall-1/bridge/state", "the birth is whole");

    // The broker has done it, and somebody else may have these topics now.
    publisher.handle_session_down();
    publisher.handle_session_up();
    assert_eq!(cleared(&sent(&mut publisher, &shown, 200)), [""; 0]);
    // And when the node is back, its topics are its own again.
    let two = table(2);
    let mut again = image(&two);
    again.journal = shown.journal.clone();
    let shown = again;
    publisher.exchange(&settings, two, identity(), &[]);
    let third = sent(&mut publisher, &shown, 300);
    assert_eq!(cleared(&third), [""; 0]);
    assert!(payload_of(&third, "engine2/state").contains(r#""seq":2,"#));
}

#[test]
fn topics_that_are_no_more_are_cleared_at_each_birth_until_the_broker_says_that_it_did() {
    let (two, one) = (table(2), table(1));
    let settings = MqttSettings::default();
    let shown = image(&one);
    let mut publisher = Publisher::new(two, &settings, identity());
    publisher.exchange(&settings, Arc::clone(&one), identity(), &[]);
    publisher.handle_session_up();
    publisher.handle_image(at(0), &shown);
    let mut left = 0;
    while let Some(out) = publisher.poll_output() {
        left += usize::from(out.message.payload.is_empty());
    }
    assert_eq!(left, 5, "none of it acknowledged");
    publisher.handle_session_down();
    publisher.handle_session_up();
    assert_eq!(cleared(&sent(&mut publisher, &shown, 100)).len(), 5);
    publisher.handle_session_down();
    publisher.handle_session_up();
    assert_eq!(cleared(&sent(&mut publisher, &shown, 200)), [""; 0]);
}

#[test]
fn without_a_session_nothing_is_lost_by_another_table() {
    let table = table(1);
    let mut shown = image(&table);
    let settings = MqttSettings::default();
    let mut publisher = Publisher::new(Arc::clone(&table), &settings, identity());
    happen(&mut shown, 1);
    publisher.handle_image(at(0), &shown);
    publisher.exchange(&MqttSettings { outbox_messages: 100, ..settings }, table, identity(), &[]);
    assert_eq!((publisher.report().messages_limit, publisher.report().held.0), (100, 1));
    happen(&mut shown, 2);
    publisher.handle_session_up();
    let told = sent(&mut publisher, &shown, 100);
    let events = told.iter().filter(|(topic, _)| topic.ends_with("/event"));
    let numbers: Vec<bool> =
        events.zip(1..).map(|((_, text), seq)| text.contains(&format!("\"seq\":{seq},"))).collect();
    assert_eq!(numbers, [true, true]);
}

#[test]
fn home_assistant_forgets_what_is_no_more_and_is_told_of_the_rest() {
    let mut settings = MqttSettings::default();
    settings.home_assistant.enabled = true;
    let two = table(2);
    let shown = image(&two);
    let mut publisher = Publisher::new(two, &settings, identity());
    publisher.handle_session_up();
    publisher.handle_subscribed();
    sent(&mut publisher, &shown, 0);
    let one = table(1);
    let shown = image(&one);
    publisher.exchange(&settings, Arc::clone(&one), identity(), &[]);
    let told = sent(&mut publisher, &shown, 100);
    let gone = "homeassistant/device/cangate_hall-1/engine2/config";
    assert!(cleared(&told).contains(&gone), "{:?}", cleared(&told));
    assert!(!payload_of(&told, "engine1/config").is_empty());
    settings.home_assistant.enabled = false;
    publisher.exchange(&settings, one, identity(), &[]);
    let told = sent(&mut publisher, &shown, 200);
    let announced = cleared(&told).iter().filter(|topic| topic.starts_with("homeassistant/")).count();
    assert_eq!(announced, 2, "{told:?}");
}

fn edge(engines: u8) -> (EdgeNode, ProcessImage) {
    let settings =
        SparkplugSettings { enabled: true, group_id: "works".into(), ..SparkplugSettings::default() };
    let table = table(engines);
    let image = image(&table);
    (EdgeNode::new(table, &settings, &Identity::default()), image)
}

fn said(node: &mut EdgeNode, image: &ProcessImage, millis: u64) -> Vec<(String, Payload)> {
    let mut said = Vec::new();
    loop {
        node.handle_image(at(millis), image);
        while let Some(packet) = node.poll_output() {
            node.handle_sent(packet.id);
            let topic = packet.topic.strip_prefix("spBv1.0/works/").unwrap().to_owned();
            said.push((topic, Payload::decode(&*packet.payload).unwrap()));
        }
        if node.poll_timeout().is_none_or(|due| due > at(millis).instant) {
            return said;
        }
    }
}

fn bd_seq(payload: &Payload) -> Option<MetricValue> {
    payload.metrics.iter().find(|metric| metric.name.as_deref() == Some("bdSeq"))?.value.clone()
}

#[test]
fn tck_id_topics_ddeath_a_device_that_is_no_more_dies_and_the_rest_is_born_again_in_the_same_session() {
    let (mut node, shown) = edge(2);
    node.begin_session(at(0));
    node.handle_session_up();
    let births = said(&mut node, &shown, 0);
    let last = births.last().unwrap().1.seq.unwrap();
    let (next, shown) = edge(1);
    node.exchange(at(100), next, &[Some(NodeIndex(0))]);
    let again = said(&mut node, &shown, 100);
    let topics: Vec<&str> = again.iter().map(|(topic, _)| topic.as_str()).collect();
    assert_eq!(topics, ["DDEATH/hall-1/engine2", "NBIRTH/hall-1", "DBIRTH/hall-1/engine1"]);
    assert_eq!(again[0].1.seq, Some(last + 1), "without a gap");
    assert_eq!(again[1].1.seq, Some(0));
    assert_eq!(bd_seq(&again[1].1), bd_seq(&births[0].1));
    assert_eq!(node.report().rebirths, 0, "nobody asked");
    // One that begins anew is told as dead before it is born again.
    let (next, mut shown) = edge(1);
    lose(&mut shown, &table(1), 0, at(200));
    node.exchange(at(200), next, &[None]);
    let topics: Vec<String> = said(&mut node, &shown, 200).into_iter().map(|(topic, _)| topic).collect();
    assert_eq!(topics, ["DDEATH/hall-1/engine1", "NBIRTH/hall-1"]);
}

#[test]
fn values_that_were_kept_for_sparkplug_stay_with_their_metrics() {
    let (mut node, mut shown) = edge(2);
    said(&mut node, &shown, 0);
    let of_engine2 = shown.tags.len() / 2;
    for (round, value) in [30.0, 40.0].into_iter().enumerate() {
        shown.revision = Revision(shown.revision.0 + 1);
        shown.tags[of_engine2] = good(Value::Float(value));
        said(&mut node, &shown, 1000 * (u64::try_from(round).unwrap() + 1));
    }
    let held = node.report().held;
    assert!(held >= 2, "{held}");
    // A node more in front of it: every place is another one.
    let (next, shown) = edge(3);
    node.exchange(at(3000), next, &[Some(NodeIndex(0)), Some(NodeIndex(1)), None]);
    assert_eq!(node.report().held, held);
    node.begin_session(at(4000));
    node.handle_session_up();
    // Historical values follow at their pace.
    let told: Vec<_> = (0..10).flat_map(|step| said(&mut node, &shown, 9000 + 50 * step)).collect();
    let values = told.iter().filter(|(topic, _)| topic == "DDATA/hall-1/engine2");
    let values = values.flat_map(|(_, payload)| &payload.metrics);
    let historical: Vec<_> = values
        .filter(|metric| metric.is_historical == Some(true))
        .filter_map(|metric| match metric.value {
            Some(MetricValue::Int(value)) => Some(value),
            _ => None,
        })
        .collect();
    assert!(historical.contains(&30) && historical.contains(&40), "{historical:?}");
    assert_eq!(node.report().held, 0);
}
