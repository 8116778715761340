//! What is published when, in numbers instead of time.

use std::collections::{BTreeMap, VecDeque};

use cangate::mqtt::topics::Topics;
use cangate::mqtt::{Identity, MqttSettings, Publisher, payload};
use cangate::process_image::{NodeIndex, ProcessImage, Quality, Reason, Revision, Value};

use crate::support::plant::{at, event, good, happen, image, lose, table};

struct Bench {
    publisher: Publisher,
    image: ProcessImage,
}

impl Bench {
    /// A publisher in a session whose birth is out.
    fn new() -> Self {
        let mut bench = Self::without_session();
        bench.publisher.handle_session_up();
        assert!(!bench.sent(0).is_empty());
        bench
    }

    fn without_session() -> Self {
        let table = table(2);
        let identity = Identity { sid: "s".into(), ..Identity::default() };
        let image = image(&table);
        Self { publisher: Publisher::new(table, &MqttSettings::default(), identity), image }
    }

    /// Topics (below the prefix) and payloads that go out by `millis`, each acknowledged at once.
    fn sent(&mut self, millis: u64) -> Vec<(String, serde_json::Value)> {
        let mut sent = Vec::new();
        loop {
            self.publisher.handle_image(at(millis), &self.image);
            while let Some(out) = self.publisher.poll_output() {
                self.publisher.handle_acknowledged(out.id);
                let topic = out.message.topic.strip_prefix("cangate/hall-1/").unwrap().to_owned();
                sent.push((topic, serde_json::from_str(&out.message.payload).unwrap()));
            }
            if self.publisher.poll_timeout().is_none_or(|due| due > at(millis).instant) {
                return sent;
            }
        }
    }

    fn topics(&mut self, millis: u64) -> Vec<String> {
        self.sent(millis).into_iter().map(|(topic, _)| topic).collect()
    }

    fn change(&mut self, tag: usize, value: Value) {
        self.image.revision = Revision(self.image.revision.0 + 1);
        self.image.tags[tag] = good(value);
    }
}

#[test]
fn a_session_begins_with_all_that_is_retained_and_ends_its_birth_with_online() {
    let mut bench = Bench::without_session();
    assert_eq!(bench.topics(0), [""; 0]);
    assert_eq!(bench.publisher.poll_timeout(), None);
    for _ in 0..2 {
        bench.publisher.handle_session_up();
        let sent = bench.sent(1000);
        let topics: Vec<_> = sent.iter().map(|(topic, _)| topic.as_str()).collect();
        assert_eq!(
            topics,
            [
                "bridge/info",
                "bridge/health",
                "bridge/alarm/mqtt_down",
                "bridge/alarm/can0_bus_off",
                "engine1/alarm/node_lost",
                "engine1/alarm/pdo_timeout_1",
                "engine1/alarm/trip",
                "engine2/alarm/node_lost",
                "engine2/alarm/pdo_timeout_1",
                "engine2/alarm/trip",
                "engine1/availability",
                "engine1/state",
                "engine2/availability",
                "engine2/state",
                "bridge/state",
            ]
        );
        assert_eq!(sent.last().unwrap().1["state"], "online");
        bench.publisher.handle_session_down();
    }
}

#[test]
fn a_birth_of_many_nodes_is_made_in_several_reads_and_is_whole() {
    let table = table(127);
    let image = image(&table);
    let mut publisher = Publisher::new(table, &MqttSettings::default(), Identity::default());
    publisher.handle_session_up();
    let mut topics = std::collections::BTreeMap::new();
    let mut reads = 0;
    let mut last = String::new();
    while publisher.poll_timeout().is_some_and(|due| due <= at(0).instant) {
        publisher.handle_image(at(0), &image);
        reads += 1;
        while let Some(out) = publisher.poll_output() {
            publisher.handle_acknowledged(out.id);
            *topics.entry(out.message.topic.to_string()).or_insert(0) += 1;
            last = out.message.topic.to_string();
        }
    }
    assert!(reads > 10, "{reads}");
    assert_eq!(topics.len(), 3 + 2 + 127 * 5);
    assert!(topics.values().all(|times| *times == 1));
    assert_eq!(last, "cangate/hall-1/bridge/state");
}

#[test]
fn state_is_published_on_change_but_not_more_often_than_every_half_second() {
    let mut bench = Bench::new();
    bench.change(0, Value::Float(20.0));
    assert_eq!(bench.topics(100), [""; 0]);
    assert_eq!(bench.publisher.poll_timeout(), Some(at(500).instant));
    bench.change(0, Value::Float(30.0));
    let sent = bench.sent(500);
    assert_eq!(sent.len(), 1);
    assert_eq!(sent[0].0, "engine1/state");
    assert_eq!(sent[0].1["tags"]["knock_intensity_1"], 30);
    assert_eq!(bench.topics(1000), [""; 0]);
}

#[test]
fn a_change_after_a_quiet_time_is_published_at_once() {
    let mut bench = Bench::new();
    bench.change(2, Value::Bool(true));
    assert_eq!(bench.topics(3000), ["engine1/state"]);
}

#[test]
fn while_knocking_state_is_published_every_tenth_of_a_second() {
    let mut bench = Bench::new();
    bench.change(3, Value::Bool(true));
    assert_eq!(bench.topics(100), ["engine1/state"]);
    bench.change(0, Value::Float(50.0));
    assert_eq!(bench.topics(199), [""; 0]);
    assert_eq!(bench.topics(200), ["engine1/state"]);
    bench.change(3, Value::Bool(false));
    assert_eq!(bench.topics(300), [""; 0], "quiet again: half a second");
    assert_eq!(bench.topics(700), ["engine1/state"]);
}

#[test]
fn a_change_within_the_deadband_waits_for_the_ten_seconds() {
    let mut bench = Bench::new();
    bench.change(0, Value::Float(12.9));
    assert_eq!(bench.topics(5000), [""; 0]);
    bench.change(0, Value::Float(13.1));
    assert_eq!(bench.topics(5001), ["engine1/state"]);
    assert_eq!(bench.topics(10_000), ["engine2/state"]);
    assert_eq!(bench.topics(15_001), ["engine1/state"]);
    bench.change(0, Value::Float(f64::NAN));
    assert_eq!(bench.topics(16_000), ["engine1/state"]);
    bench.change(0, Value::Float(f64::NAN));
    assert_eq!(bench.topics(17_000), [""; 0]);
}

#[test]
fn a_lost_node_is_told_at_once_its_state_with_the_usual_interval() {
    let mut bench = Bench::new();
    lose(&mut bench.image, &table(2), 1, at(100));
    let sent = bench.sent(100);
    let topics: Vec<_> = sent.iter().map(|(topic, _)| topic.as_str()).collect();
    assert_eq!(topics, ["engine2/alarm/node_lost", "engine2/availability"]);
    assert_eq!(sent[1].1, serde_json::json!({"state": "offline", "reason": "no guarding reply for 1.5 s"}));
    let state = bench.sent(500).remove(0);
    assert_eq!(state.0, "engine2/state");
    assert_eq!(state.1["quality"], "bad");
}

#[test]
fn a_quality_that_changed_is_a_change() {
    let mut bench = Bench::new();
    bench.image.revision = Revision(2);
    bench.image.tags[4].quality = Quality::Stale(Reason::PdoTimeout);
    assert_eq!(bench.topics(600), ["engine2/state"]);
}

#[test]
fn p5_each_message_of_a_topic_has_the_next_number() {
    let mut bench = Bench::new();
    let mut seqs = Vec::new();
    for step in 1..=5 {
        bench.change(0, Value::Float(f64::from(step) * 10.0));
        seqs.push(bench.sent(u64::try_from(step).unwrap() * 1000).remove(0).1["seq"].as_u64().unwrap());
    }
    assert_eq!(seqs, [2, 3, 4, 5, 6]);
}

#[test]
fn health_is_published_every_half_minute() {
    let mut bench = Bench::new();
    assert!(!bench.topics(29_999).contains(&"bridge/health".to_owned()));
    assert!(bench.topics(30_000).contains(&"bridge/health".to_owned()));
    assert!(!bench.topics(59_999).contains(&"bridge/health".to_owned()));
    assert!(bench.topics(60_000).contains(&"bridge/health".to_owned()));
}

#[test]
fn p1_events_of_a_time_without_broker_are_published_later_in_order() {
    let mut bench = Bench::without_session();
    for seq in 1..=3000 {
        happen(&mut bench.image, seq);
        bench.publisher.handle_image(at(seq), &bench.image);
    }
    bench.publisher.handle_session_up();
    let sent = bench.sent(4000);
    let seqs: Vec<_> = sent
        .iter()
        .filter(|(topic, _)| topic == "event")
        .map(|(_, payload)| payload["seq"].as_u64().unwrap())
        .collect();
    assert_eq!(seqs, (1..=3000).collect::<Vec<_>>());
}

#[test]
fn events_that_left_the_journal_unread_are_told_as_missed_and_counted() {
    let mut bench = Bench::new();
    happen(&mut bench.image, 2000);
    let sent = bench.sent(1);
    assert_eq!(sent.len(), 1 + 1024);
    let missed = &sent[0].1;
    assert_eq!(
        (&missed["name"], &missed["value"], &missed["seq"]),
        (&"events_missed".into(), &976.into(), &976.into())
    );
    assert_eq!(sent[1].1["seq"], 977);
    assert_eq!(bench.publisher.report().events_missed, 976);
}

#[test]
fn an_unacknowledged_event_comes_again_byte_for_byte() {
    let mut bench = Bench::new();
    bench.image.journal.append(event(1));
    bench.publisher.handle_image(at(1), &bench.image);
    let first = bench.publisher.poll_output().unwrap();
    assert!(!first.again);
    bench.publisher.handle_session_down();
    assert!(bench.publisher.poll_output().is_none(), "nothing is sent without a session");
    bench.publisher.handle_session_up();
    bench.publisher.handle_image(at(2), &bench.image);
    let again = std::iter::from_fn(|| bench.publisher.poll_output()).find(|out| out.again).unwrap();
    assert_eq!(again.message, first.message);
}

#[test]
fn a_broker_that_acknowledges_nothing_is_sent_no_more_than_the_window() {
    let mut bench = Bench::without_session();
    bench.publisher.handle_session_up();
    bench.publisher.handle_image(at(0), &bench.image);
    assert_eq!(std::iter::from_fn(|| bench.publisher.poll_output()).count(), 15);
    happen(&mut bench.image, 10);
    bench.publisher.handle_image(at(1), &bench.image);
    assert_eq!(std::iter::from_fn(|| bench.publisher.poll_output()).count(), 1);
}

/// What a broker keeps of a session in which only one message is acknowledged between two looks at the image.
fn kept_by_a_slow_broker(publisher: &mut Publisher, image: &mut ProcessImage) -> BTreeMap<String, String> {
    let mut kept = BTreeMap::new();
    let mut unacknowledged = VecDeque::new();
    for millis in 0..20_000 {
        if millis % 100 == 0 && millis < 10_000 {
            image.revision = Revision(image.revision.0 + 1);
            let tag = usize::try_from(millis / 100 % 8).unwrap() * 4;
            image.tags[tag] = good(Value::Float(f64::from(u32::try_from(millis).unwrap())));
            happen(image, image.journal.newest() + 1);
        }
        publisher.handle_image(at(millis), image);
        while let Some(out) = publisher.poll_output() {
            assert!(unacknowledged.len() < 16);
            unacknowledged.push_back(out.id);
            if out.message.retain {
                kept.insert(out.message.topic.to_string(), out.message.payload.to_string());
            }
        }
        if let Some(id) = unacknowledged.pop_front() {
            publisher.handle_acknowledged(id);
        }
    }
    kept
}

#[test]
fn p1_after_a_long_outage_the_broker_keeps_what_the_image_shows_and_not_what_it_showed() {
    let table = table(127);
    let mut image = image(&table);
    let settings = MqttSettings { outbox_messages: 1000, ..MqttSettings::default() };
    let mut publisher = Publisher::new(table.clone(), &settings, Identity::default());
    for seq in 1..=3000 {
        happen(&mut image, seq);
        publisher.handle_image(at(0), &image);
    }
    assert_eq!((publisher.report().held.0, publisher.report().events_dropped), (1000, 2000));
    lose(&mut image, &table, 1, at(0));
    publisher.handle_session_up();
    let kept = kept_by_a_slow_broker(&mut publisher, &mut image);
    let topics = Topics::new("cangate", &table);
    let mut out = String::new();
    for ((def, status), topic) in table.alarms.iter().zip(&image.alarms).zip(&topics.alarms) {
        payload::alarm(&mut out, &table, def, status);
        assert_eq!(kept.get(&**topic), Some(&out), "{topic}");
    }
    for (place, topics) in topics.nodes.iter().enumerate() {
        payload::availability(&mut out, &image.nodes[place]);
        assert_eq!(kept.get(&*topics.availability), Some(&out), "{}", topics.availability);
        let state: serde_json::Value = serde_json::from_str(&kept[&*topics.state]).unwrap();
        let stamp = payload::Stamp { sid: "", seq: state["seq"].as_u64().unwrap() };
        payload::state(&mut out, &table, &image, NodeIndex(place), stamp);
        assert_eq!(kept[&*topics.state], out, "{}", topics.state);
    }
    assert_eq!(kept[&*topics.bridge_state], payload::ONLINE);
    assert_eq!(kept.len(), 3 + 2 + 127 * 5);
}

#[test]
fn a_validity_tag_that_is_not_published_itself_is_a_change_and_a_reason() {
    let mut table = (*table(2)).clone();
    table.tags[1].published = false;
    let mut bench = Bench::new();
    bench.publisher = Publisher::new(table.into(), &MqttSettings::default(), Identity::default());
    bench.publisher.handle_session_up();
    bench.sent(0);
    bench.image.revision = Revision(2);
    bench.image.tags[1].quality = Quality::Stale(Reason::PdoTimeout);
    let sent = bench.sent(1000);
    assert_eq!(sent[0].0, "engine1/state");
    assert_eq!(sent[0].1["bad"], serde_json::json!({"knock_intensity_1": "pdo_timeout"}));
    bench.change(1, Value::Bool(false));
    assert_eq!(bench.sent(2000)[0].1["bad"], serde_json::json!({"knock_intensity_1": "not_valid"}));
    bench.change(1, Value::Bool(true));
    assert_eq!(bench.sent(3000)[0].1["bad"], serde_json::json!({}));
}

#[test]
fn online_is_said_again_with_each_health_in_case_a_last_will_came_late() {
    let mut bench = Bench::new();
    let sent = bench.sent(30_000);
    let states: Vec<_> = sent.iter().filter(|(topic, _)| topic == "bridge/state").collect();
    assert_eq!(states.len(), 1);
    assert_eq!(states[0].1["state"], "online");
}

#[test]
fn at_a_stop_offline_goes_before_everything_that_still_waits() {
    let mut bench = Bench::without_session();
    bench.publisher.handle_session_up();
    happen(&mut bench.image, 500);
    bench.publisher.handle_image(at(0), &bench.image);
    let sent: Vec<_> = std::iter::from_fn(|| bench.publisher.poll_output()).collect();
    bench.publisher.handle_stop();
    assert!(bench.publisher.poll_output().is_none(), "the window is closed");
    bench.publisher.handle_acknowledged(sent[3].id);
    let farewell = bench.publisher.poll_output().unwrap();
    assert_eq!(&*farewell.message.payload, payload::OFFLINE);
    for out in &sent {
        bench.publisher.handle_acknowledged(out.id);
    }
    assert!(!bench.publisher.has_said_farewell());
    bench.publisher.handle_acknowledged(farewell.id);
    assert!(bench.publisher.has_said_farewell() && bench.publisher.is_idle());
}

#[test]
fn events_that_are_not_taken_for_now_come_again_after_a_minute_in_order_and_live_values_go_on() {
    let mut bench = Bench::new();
    happen(&mut bench.image, 3);
    let mut refused = Vec::new();
    bench.publisher.handle_image(at(1000), &bench.image);
    while let Some(out) = bench.publisher.poll_output() {
        refused.push(out.message.payload.to_string());
        assert!(bench.publisher.handle_not_taken(at(1000), out.id, false).is_some());
    }
    assert_eq!(refused.len(), 1, "the others wait behind it");
    bench.change(0, Value::Float(17.0));
    assert_eq!(bench.topics(2000), ["engine1/state"]);
    assert!(!bench.topics(60_999).contains(&"event".to_owned()));
    let again = bench.sent(61_000);
    let events: Vec<_> = again.iter().filter(|(topic, _)| topic == "event").collect();
    assert_eq!(events.iter().map(|(_, event)| event["seq"].as_u64().unwrap()).collect::<Vec<_>>(), [1, 2, 3]);
    let first: serde_json::Value = serde_json::from_str(&refused[0]).unwrap();
    assert_eq!(events[0].1, first, "with the same bytes");
    assert_eq!(bench.publisher.report().refused, 0);
}
