//! What Home Assistant is told: golden file, sizes, what a former run left, a broker.

use std::collections::{BTreeMap, BTreeSet};

use cangate::gateway::command::Desk;
use cangate::mqtt::back_off::Pace;
use cangate::mqtt::client::run;
use cangate::mqtt::settings::BaseTopic;
use cangate::mqtt::{Identity, MqttSettings, MqttStatus, Publisher};
use cangate::process_image::{ProcessImage, process_image};
use cangate::time::Clock;
use serde_json::{Value, json};
use tokio::sync::watch;
use tokio::task::JoinHandle;
use tokio_util::sync::CancellationToken;

use crate::contract_mqtt::assert_golden;
use crate::support::mosquitto::{Mosquitto, Probe, Seen};
use crate::support::plant::{at, image, table};
use crate::support::registers;
use crate::support::until;

const ENGINE1: &str = "homeassistant/device/cangate_hall-1/engine1/config";

fn settings() -> MqttSettings {
    let mut settings = MqttSettings::default();
    settings.home_assistant.enabled = true;
    settings
}

fn identity() -> Identity {
    Identity { sid: "s".into(), version: "0.1.0".into(), ..Identity::default() }
}

struct Bench {
    publisher: Publisher,
    image: ProcessImage,
}

impl Bench {
    fn new() -> Self {
        let table = table(2);
        let image = image(&table);
        Self { publisher: Publisher::new(table, &settings(), identity()), image }
    }

    /// Topics and payloads that go out by `millis`, all retained and acknowledged.
    fn sent(&mut self, millis: u64) -> Vec<(String, String)> {
        let mut sent = Vec::new();
        loop {
            self.publisher.handle_image(at(millis), &self.image);
            while let Some(out) = self.publisher.poll_output() {
                assert!(out.message.retain && out.message.at_least_once, "{}", out.message.topic);
                self.publisher.handle_acknowledged(out.id);
                sent.push((out.message.topic.to_string(), out.message.payload.to_string()));
            }
            if self.publisher.poll_timeout().is_none_or(|due| due > at(millis).instant) {
                return sent;
            }
        }
    }

    fn announced(&mut self, millis: u64) -> Vec<(String, String)> {
        let mut sent = self.sent(millis);
        sent.retain(|(topic, _)| topic.starts_with("homeassistant/"));
        sent
    }
}

#[test]
fn a_node_is_announced_as_the_golden_file_says() {
    let mut bench = Bench::new();
    bench.publisher.handle_session_up();
    bench.publisher.handle_subscribed();
    let sent: BTreeMap<String, String> = bench.announced(0).into_iter().collect();
    let topics: Vec<_> = sent.keys().map(String::as_str).collect();
    let of = |object: &str| format!("homeassistant/device/cangate_hall-1/{object}/config");
    assert_eq!(topics, [&of("bridge"), &of("engine1"), &of("engine2")]);
    assert_golden("home_assistant_node.json", &sent[ENGINE1]);
    assert_golden("home_assistant_gateway.json", &sent[&of("bridge")]);
}

#[test]
fn nothing_is_announced_or_subscribed_unless_it_is_asked_for() {
    let table = table(1);
    let image = image(&table);
    let mut publisher = Publisher::new(table, &MqttSettings::default(), identity());
    assert_eq!(publisher.subscriptions(), [""; 0]);
    publisher.handle_session_up();
    publisher.handle_subscribed();
    publisher.handle_image(at(0), &image);
    while let Some(out) = publisher.poll_output() {
        assert!(!out.message.topic.starts_with("homeassistant/"));
        publisher.handle_acknowledged(out.id);
    }
}

#[test]
fn the_announcements_come_in_each_session_once_the_broker_has_answered_the_subscription() {
    let mut bench = Bench::new();
    for session in 0..3 {
        bench.publisher.handle_session_up();
        assert_eq!(
            bench.announced(session * 100).len(),
            0,
            "they would take the place of what is to be read"
        );
        bench.publisher.handle_subscribed();
        if session > 0 {
            assert_eq!(bench.announced(session * 100 + 50).len(), 3);
        }
        // Of the first session nothing is left over, though it ended before anything was announced.
        bench.publisher.handle_session_down();
    }
}

#[test]
fn what_is_read_before_the_answer_to_the_subscription_is_told_of_all_the_same() {
    let mut bench = Bench::new();
    bench.publisher.handle_session_up();
    let old = br#"{"components":{"old":{"platform":"sensor","unique_id":"cangate.hall-1.engine1.old"}}}"#;
    bench.publisher.handle_message(ENGINE1, old, true);
    bench.publisher.handle_message("homeassistant/device/cangate_hall-1/engine9/config", b"{}", true);
    bench.publisher.handle_subscribed();
    let sent: BTreeMap<String, String> = bench.announced(0).into_iter().collect();
    assert_eq!(sent["homeassistant/device/cangate_hall-1/engine9/config"], "");
    let engine: Value = serde_json::from_str(&sent[ENGINE1]).unwrap();
    assert_eq!(engine["components"]["old"], json!({"platform": "sensor"}));
}

#[test]
fn home_assistant_is_told_again_when_it_starts() {
    let mut bench = Bench::new();
    assert_eq!(
        bench.publisher.subscriptions(),
        ["homeassistant/status", "homeassistant/device/cangate_hall-1/+/config"]
    );
    bench.publisher.handle_session_up();
    bench.publisher.handle_subscribed();
    assert_eq!(bench.announced(0).len(), 3);
    bench.publisher.handle_message("homeassistant/status", b"offline", false);
    assert_eq!(bench.announced(100).len(), 0);
    bench.publisher.handle_message("homeassistant/status", b"online", false);
    assert_eq!(bench.announced(200).len(), 3);
}

#[test]
fn what_a_former_run_announced_is_cleared_and_what_is_of_others_is_left_alone() {
    let mut bench = Bench::new();
    bench.publisher.handle_session_up();
    bench.publisher.handle_subscribed();
    bench.announced(0);
    let gone = "homeassistant/device/cangate_hall-1/engine9/config";
    for (topic, retained) in [
        (gone, true),
        // What is not kept by the broker is what we say ourselves.
        ("homeassistant/device/cangate_hall-1/engine8/config", false),
        ("homeassistant/device/cangate_hall-12/engine9/config", true),
        ("homeassistant/device/other/engine9/config", true),
    ] {
        bench.publisher.handle_message(topic, br#"{"components":{}}"#, retained);
    }
    assert_eq!(bench.announced(100), [(gone.to_owned(), String::new())]);
    // The clearing itself is no reason for another.
    bench.publisher.handle_message(gone, b"", true);
    assert_eq!(bench.announced(200).len(), 0);
}

#[test]
fn an_entity_of_a_former_run_is_told_as_removed_once() {
    let mut bench = Bench::new();
    bench.publisher.handle_session_up();
    bench.publisher.handle_subscribed();
    let now: BTreeMap<String, String> = bench.announced(0).into_iter().collect();
    let mut former: Value = serde_json::from_str(&now[ENGINE1]).unwrap();
    former["components"]["old"] =
        json!({"platform": "binary_sensor", "unique_id": "cangate.hall-1.engine1.old"});
    let mut hear = |payload: &[u8], millis: u64| {
        bench.publisher.handle_message(ENGINE1, payload, true);
        bench.announced(millis)
    };
    assert_eq!(hear(now[ENGINE1].as_bytes(), 100).len(), 0, "nothing is gone");
    let told = hear(former.to_string().as_bytes(), 200);
    let told: Value = serde_json::from_str(&told[0].1).unwrap();
    assert_eq!(told["components"]["old"], json!({"platform": "binary_sensor"}));
    former["components"].as_object_mut().unwrap().remove("old");
    let mut rest = told.clone();
    rest["components"].as_object_mut().unwrap().remove("old");
    assert_eq!(rest, former, "everything else is as ever");
    assert_eq!(hear(told.to_string().as_bytes(), 300).len(), 0, "told as removed already");
    for odd in [&b"no JSON"[..], b"{}", b"[1]", br#"{"components":{"x":1}}"#, b"\xFF"] {
        assert_eq!(hear(odd, 400).len(), 0);
    }
    // Home Assistant starts: it is told without the removed ones.
    bench.publisher.handle_message("homeassistant/status", b"online", false);
    let again: BTreeMap<String, String> = bench.announced(500).into_iter().collect();
    assert_eq!(again[ENGINE1], now[ENGINE1]);
}

#[test]
fn announcements_stay_below_what_is_read_back_and_ids_are_unique() {
    let table = registers::table();
    let mut many = table;
    // A hundred times the tags at one node.
    let tags = many.tags.clone();
    for copy in 0..100 {
        many.tags.extend(tags[many.nodes[0].tags.clone()].iter().cloned().map(|mut tag| {
            tag.name = format!("{}_{copy}", tag.name);
            tag
        }));
    }
    let all = many.tags.len();
    many.nodes.truncate(1);
    many.nodes[0].tags = tags.len()..all;
    let table = std::sync::Arc::new(many);
    let image = ProcessImage::new(all, 1, table.buses.len(), table.alarms.len());
    let mut publisher = Publisher::new(std::sync::Arc::clone(&table), &settings(), identity());
    publisher.handle_session_up();
    publisher.handle_subscribed();
    let mut ids = BTreeSet::new();
    let mut parts = 0;
    while publisher.poll_timeout().is_some_and(|due| due <= at(0).instant) {
        publisher.handle_image(at(0), &image);
        while let Some(out) = publisher.poll_output() {
            publisher.handle_acknowledged(out.id);
            if !out.message.topic.starts_with("homeassistant/") {
                continue;
            }
            parts += 1;
            assert!(out.message.size() < 60 * 1024, "{} bytes", out.message.size());
            let payload: Value = serde_json::from_str(&out.message.payload).unwrap();
            for component in payload["components"].as_object().unwrap().values() {
                assert!(ids.insert(component["unique_id"].as_str().unwrap().to_owned()), "{component}");
            }
        }
    }
    assert!(parts > 3, "{parts}");
    let tags = table.tags[table.nodes[0].tags.clone()].iter().filter(|tag| tag.published).count();
    assert!(tags > 200 && ids.len() > tags, "{} of {tags}", ids.len());
}

#[test]
fn every_option_is_one_that_home_assistant_knows() {
    // home-assistant.io: MQTT discovery, MQTT sensor, MQTT binary sensor.
    let shared =
        ["device", "origin", "qos", "state_topic", "availability", "availability_mode", "components"];
    let device = ["identifiers", "name", "manufacturer", "model", "via_device", "sw_version"];
    let component = [
        "platform",
        "unique_id",
        "name",
        "device_class",
        "entity_category",
        "state_topic",
        "value_template",
        "payload_on",
        "payload_off",
        "availability",
        "availability_mode",
        "json_attributes_topic",
        "unit_of_measurement",
        "state_class",
        "suggested_display_precision",
    ];
    let known = |value: &Value, keys: &[&str]| {
        for key in value.as_object().unwrap().keys() {
            assert!(keys.contains(&key.as_str()), "{key}");
        }
    };
    let mut bench = Bench::new();
    bench.publisher.handle_session_up();
    bench.publisher.handle_subscribed();
    for (_, payload) in bench.announced(0) {
        let payload: Value = serde_json::from_str(&payload).unwrap();
        known(&payload, &shared);
        known(&payload["device"], &device);
        assert!(payload["origin"]["name"].is_string());
        for entity in payload["components"].as_object().unwrap().values() {
            known(entity, &component);
            let platform = entity["platform"].as_str().unwrap();
            assert!(["sensor", "binary_sensor"].contains(&platform));
            // A class of state is for numbers, truths are for bits.
            assert!(platform == "sensor" || entity["state_class"].is_null());
            assert_eq!(platform == "binary_sensor", entity["payload_on"].is_string());
        }
    }
}

#[test]
fn another_prefix_is_used_for_all_topics() {
    let mut settings = settings();
    settings.home_assistant.prefix = BaseTopic::try_from("ha/north".to_owned()).unwrap();
    let publisher = Publisher::new(table(1), &settings, identity());
    assert_eq!(publisher.subscriptions(), ["ha/north/status", "ha/north/device/cangate_hall-1/+/config"]);
}

/// A client over mosquitto, until it is dropped.
fn run_client(broker: &Mosquitto, stop: CancellationToken) -> JoinHandle<()> {
    let settings = MqttSettings { url: format!("mqtt://{}", broker.address).parse().unwrap(), ..settings() };
    let table = table(2);
    let (writer, reader) = process_image(image(&table));
    let publisher = Publisher::new(table, &settings, identity());
    tokio::spawn(async move {
        let _writer = writer;
        let (status, desk, clock) = (watch::channel(MqttStatus::default()).0, Desk::new(1).0, Clock::start());
        let (exchanges, pace) = (tokio::sync::mpsc::channel(1).1, Pace::of(&settings));
        let session =
            run(settings, "hall-1", publisher, reader, desk, clock, stop, status, None, exchanges, pace);
        Box::pin(session).await;
    })
}

#[tokio::test]
async fn mosquitto_keeps_what_is_announced_and_forgets_what_is_no_more() {
    let Some(broker) = Mosquitto::start().await else { return };
    let probe = Probe::start(broker.address, "probe").await;
    let gone = "homeassistant/device/cangate_hall-1/engine9/config";
    let others = "homeassistant/device/somebody/engine9/config";
    probe.publish(gone, br#"{"components":{}}"#, true).await;
    probe.publish(others, br#"{"components":{}}"#, true).await;
    let old = br#"{"components":{"old":{"platform":"sensor","unique_id":"cangate.hall-1.engine1.old"}}}"#;
    probe.publish(ENGINE1, old, true).await;
    probe.wait_for("the former announcement", 0, |seen| seen.topic == ENGINE1).await;

    let stop = CancellationToken::new();
    let client = run_client(&broker, stop.clone());
    probe.wait_for("clearing", 0, |seen| seen.topic == gone && seen.payload.is_empty()).await;
    let stub = |seen: &Seen| {
        let payload: Value = serde_json::from_slice(&seen.payload).unwrap_or_default();
        seen.topic == ENGINE1 && payload["components"]["old"] == json!({"platform": "sensor"})
    };
    probe.wait_for("the removal", 0, stub).await;
    let from = probe.seen().len();
    probe.publish("homeassistant/status", b"online", false).await;
    let told = probe.wait_for("it all again", from, |seen| seen.topic == ENGINE1).await;
    assert_eq!(told.qos, rumqttc::QoS::AtLeastOnce);
    stop.cancel();
    client.await.unwrap();

    // What is announced names topics that are there.
    let late = Probe::start(broker.address, "late").await;
    late.wait_for("the state of the gateway", 0, |seen| seen.topic.ends_with("bridge/state")).await;
    let kept: BTreeMap<String, Vec<u8>> = until("all that is kept", async || {
        let kept: BTreeMap<_, _> = late.seen().into_iter().map(|seen| (seen.topic, seen.payload)).collect();
        (kept.contains_key(ENGINE1) && kept.contains_key("cangate/hall-1/engine2/state")).then_some(kept)
    })
    .await;
    assert!(kept.contains_key(others) && !kept.contains_key(gone));
    let config: Value = serde_json::from_slice(&kept[ENGINE1]).unwrap();
    assert!(config["components"]["old"].is_null());
    let mut topics = BTreeSet::new();
    named_topics(&config, &mut topics);
    assert!(topics.len() >= 6, "{topics:?}");
    for topic in topics {
        assert!(kept.contains_key(&topic), "{topic} is announced and not there");
    }
}

/// Every topic that an announcement names.
fn named_topics(value: &Value, into: &mut BTreeSet<String>) {
    match value {
        Value::Object(members) => {
            for (name, value) in members {
                match value.as_str() {
                    Some(topic) if name.ends_with("topic") => drop(into.insert(topic.to_owned())),
                    _ => named_topics(value, into),
                }
            }
        }
        Value::Array(elements) => elements.iter().for_each(|element| named_topics(element, into)),
        _ => {}
    }
}
