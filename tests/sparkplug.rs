//! What the edge node of Sparkplug B says when: the statements of the specification, by their ids, in numbers instead of time.

use std::collections::BTreeSet;
use std::sync::Arc;

use cangate::gateway::command::Desk;
use cangate::mqtt::back_off::Pace;
use cangate::mqtt::sparkplug::command::Asked;
use cangate::mqtt::sparkplug::payload::{Metric, MetricValue, Payload, PropertyContent};
use cangate::mqtt::sparkplug::{EdgeNode, SparkplugSettings, SparkplugStatus, task};
use cangate::mqtt::{Identity, MqttSettings};
use cangate::process_image::{ImageWriter, ProcessImage, Quality, Reason, Revision, Value, process_image};
use cangate::time::Clock;
use prost::Message;
use rumqttc::QoS;
use tokio::sync::watch;
use tokio::task::JoinHandle;
use tokio_util::sync::CancellationToken;

use crate::support::mosquitto::{Mosquitto, Probe, Seen};
use crate::support::plant::{at, good, image, lose, table};

struct Bench {
    node: EdgeNode,
    image: ProcessImage,
    table: Arc<cangate::mapping::TagTable>,
}

/// A message: topic below `spBv1.0/works/`, payload, quality of service.
type Sent = (String, Payload, bool);

impl Bench {
    fn with(change: impl FnOnce(&mut SparkplugSettings)) -> Self {
        let mut settings =
            SparkplugSettings { enabled: true, group_id: "works".into(), ..SparkplugSettings::default() };
        change(&mut settings);
        let table = table(2);
        let image = image(&table);
        let identity = Identity { version: "0.1.0".into(), ..Identity::default() };
        Self { node: EdgeNode::new(Arc::clone(&table), &settings, &identity), image, table }
    }

    /// In a session whose births are out.
    fn live() -> Self {
        let mut bench = Self::with(|_| ());
        bench.connect(0);
        bench.sent(0);
        assert!(bench.node.is_live());
        bench
    }

    fn connect(&mut self, millis: u64) -> Payload {
        let (topic, will) = self.node.begin_session(at(millis));
        assert_eq!(topic, "spBv1.0/works/NDEATH/hall-1");
        self.node.handle_session_up();
        Payload::decode(&*will).unwrap()
    }

    /// What goes out by `millis`; all of it leaves.
    fn sent(&mut self, millis: u64) -> Vec<Sent> {
        let mut sent = Vec::new();
        loop {
            self.node.handle_image(at(millis), &self.image);
            while let Some(packet) = self.node.poll_output() {
                self.node.handle_sent(packet.id);
                let topic = packet.topic.strip_prefix("spBv1.0/works/").unwrap().to_owned();
                sent.push((topic, Payload::decode(&*packet.payload).unwrap(), packet.at_least_once));
            }
            if self.node.poll_timeout().is_none_or(|due| due > at(millis).instant) {
                return sent;
            }
        }
    }

    fn change(&mut self, tag: usize, value: Value, millis: u64) {
        self.image.revision = Revision(self.image.revision.0 + 1);
        self.image.tags[tag] = good(value);
        self.image.tags[tag].received = at(millis).utc;
    }

    fn host(&mut self, online: bool, timestamp: u64) {
        let state = format!(r#"{{"online":{online},"timestamp":{timestamp}}}"#);
        self.node.handle_message(at(timestamp), "spBv1.0/STATE/scada", state.as_bytes(), true);
    }

    fn ask_for_rebirth(&mut self, millis: u64, retained: bool) {
        let metric = Metric {
            name: Some("Node Control/Rebirth".into()),
            value: Some(MetricValue::Boolean(true)),
            ..Metric::default()
        };
        let payload = Payload { metrics: vec![metric], ..Payload::default() }.encode_to_vec();
        self.node.handle_message(at(millis), "spBv1.0/works/NCMD/hall-1", &payload, retained);
    }
}

fn topics(sent: &[Sent]) -> Vec<&str> {
    sent.iter().map(|(topic, ..)| topic.as_str()).collect()
}

fn named<'a>(payload: &'a Payload, name: &str) -> &'a Metric {
    let found = payload.metrics.iter().find(|metric| metric.name.as_deref() == Some(name));
    found.unwrap_or_else(|| panic!("no metric {name}"))
}

fn bd_seq(payload: &Payload) -> Option<MetricValue> {
    assert_eq!(named(payload, "bdSeq").datatype, Some(4), "Int64");
    named(payload, "bdSeq").value.clone()
}

fn property(metric: &Metric, key: &str) -> Option<PropertyContent> {
    let properties = metric.properties.as_ref()?;
    let place = properties.keys.iter().position(|name| name == key)?;
    properties.values[place].value.clone()
}

fn millis(at: cangate::time::Now) -> u64 {
    u64::try_from(at.utc.as_millis()).unwrap()
}

const BIRTHS: [&str; 3] = ["NBIRTH/hall-1", "DBIRTH/hall-1/engine1", "DBIRTH/hall-1/engine2"];

#[test]
fn tck_id_principles_birth_certificates_order_a_session_begins_with_all_births() {
    let mut bench = Bench::with(|_| ());
    for session in 0..2 {
        bench.connect(session);
        let sent = bench.sent(session);
        assert_eq!(topics(&sent), BIRTHS);
        // tck-id-topics-nbirth-seq-num, tck-id-topics-dbirth-seq, tck-id-topics-nbirth-mqtt.
        let seq: Vec<_> = sent.iter().map(|(_, payload, _)| payload.seq.unwrap()).collect();
        assert_eq!(seq, [0, 1, 2]);
        assert!(sent.iter().all(|(_, payload, acknowledged)| payload.timestamp.is_some() && !acknowledged));
        bench.node.handle_session_down();
    }
}

#[test]
fn tck_id_topics_nbirth_bdseq_matching_each_connect_counts_up_and_wraps_after_255() {
    let mut bench = Bench::with(|_| ());
    for connect in 0..600_u64 {
        let expected = Some(MetricValue::Long(connect % 256));
        if connect % 7 == 3 {
            // An attempt that never became a session counts, too.
            let (_, will) = bench.node.begin_session(at(0));
            assert_eq!(bd_seq(&Payload::decode(&*will).unwrap()), expected);
            continue;
        }
        let will = bench.connect(0);
        assert_eq!(bd_seq(&will), expected);
        // tck-id-topics-ndeath-payload, tck-id-topics-ndeath-seq.
        assert_eq!((will.metrics.len(), will.seq), (1, None));
        assert_eq!(bd_seq(&bench.sent(0)[0].1), expected);
        bench.node.handle_session_down();
    }
}

#[test]
fn tck_id_operational_behavior_data_publish_nbirth_values_births_tell_everything() {
    let mut bench = Bench::with(|_| ());
    bench.image.tags[1].received_at = None;
    bench.image.tags[1].quality = Quality::NEVER;
    bench.image.tags[2].quality = Quality::Stale(Reason::PdoTimeout);
    bench.connect(50);
    let sent = bench.sent(50);
    let rebirth = named(&sent[0].1, "Node Control/Rebirth");
    assert_eq!((rebirth.datatype, rebirth.alias), (Some(11), None));
    assert_eq!(rebirth.value, Some(MetricValue::Boolean(false)));
    assert_eq!(named(&sent[0].1, "Bus/can0/State").value, Some(MetricValue::String("error_active".into())));
    assert_eq!(named(&sent[0].1, "Properties/Version").value, Some(MetricValue::String("0.1.0".into())));
    let engine = &sent[1].1;
    let knock = named(engine, "knock_intensity_1");
    // Its validity was never received: the value is there, and bad.
    assert_eq!((knock.datatype, &knock.value), (Some(5), &Some(MetricValue::Int(13))));
    assert_eq!(property(knock, "Quality"), Some(PropertyContent::Int(0)));
    assert_eq!(property(knock, "engUnit"), Some(PropertyContent::String("%".into())));
    assert_eq!(knock.timestamp, Some(millis(at(0))), "when it was received");
    let never = named(engine, "sensor_used_1");
    assert_eq!((never.is_null, &never.value, never.timestamp), (Some(true), &None, Some(millis(at(50)))));
    assert_eq!(property(never, "Quality"), Some(PropertyContent::Int(0)));
    let stale = named(engine, "trip");
    assert_eq!((stale.is_null, &stale.value), (None, &Some(MetricValue::Boolean(false))));
    assert_eq!(property(stale, "Quality"), Some(PropertyContent::Int(500)));
    let good = named(engine, "engine_knocking");
    assert_eq!(property(good, "Quality"), Some(PropertyContent::Int(192)));
    assert_eq!(named(engine, "NMT State").value, Some(MetricValue::String("operational".into())));
    assert_eq!(named(engine, "Alarm/trip").value, Some(MetricValue::Boolean(false)));
    for (_, payload, _) in &sent {
        for metric in &payload.metrics {
            assert!(metric.name.is_some() && metric.datatype.is_some() && metric.timestamp.is_some());
            assert_eq!(metric.is_null == Some(true), metric.value.is_none(), "{metric:?}");
        }
        // tck-id-operational-behavior-data-publish-dbirth-order.
        assert!(payload.metrics.is_sorted_by_key(|metric| metric.timestamp));
    }
}

#[test]
fn tck_id_payloads_alias_uniqueness_no_two_metrics_of_node_and_devices_have_one_alias_or_name() {
    let mut bench = Bench::with(|_| ());
    bench.connect(0);
    let sent = bench.sent(0);
    let mut aliases = BTreeSet::new();
    for (_, payload, _) in &sent {
        let mut names = BTreeSet::new();
        for metric in &payload.metrics {
            let name = metric.name.as_deref().unwrap();
            // tck-id-case-sensitivity-metric-names.
            assert!(names.insert(name.to_lowercase()), "{name}");
            match metric.alias {
                Some(alias) => assert!(aliases.insert(alias), "{name}"),
                None => assert!(["bdSeq", "Node Control/Rebirth"].contains(&name), "{name}"),
            }
        }
    }
    assert!(aliases.len() > 20);
}

#[test]
fn tck_id_topics_ddata_payload_a_change_is_told_by_alias_and_nothing_else_is() {
    let mut bench = Bench::with(|_| ());
    bench.connect(0);
    let births = bench.sent(0);
    assert_eq!(bench.sent(60_000).len(), 0, "nothing periodic");
    bench.change(2, Value::Bool(true), 60_001);
    let sent = bench.sent(60_002);
    assert_eq!(topics(&sent), ["DDATA/hall-1/engine1"]);
    let payload = &sent[0].1;
    assert_eq!(
        (payload.metrics.len(), payload.seq, payload.timestamp),
        (1, Some(3), Some(millis(at(60_002))))
    );
    let metric = &payload.metrics[0];
    // tck-id-payloads-alias-data-cmd-requirement.
    assert_eq!((&metric.name, metric.datatype), (&None, None));
    assert_eq!(metric.alias, named(&births[1].1, "trip").alias);
    assert_eq!(metric.value, Some(MetricValue::Boolean(true)));
    assert_eq!(metric.timestamp, Some(millis(at(60_001))));
    assert_eq!((metric.is_historical, property(metric, "Quality")), (None, None));
    assert_eq!(bench.sent(120_000).len(), 0);
}

#[test]
fn a_deadband_and_the_least_interval_hold_back_what_moves_little_and_often() {
    let mut bench = Bench::live();
    bench.change(0, Value::Float(12.9), 1000);
    assert_eq!(bench.sent(2000).len(), 0, "less than the deadband of 0.5");
    bench.change(0, Value::Float(20.0), 2001);
    assert_eq!(bench.sent(2001).len(), 1);
    bench.change(0, Value::Float(30.0), 2100);
    assert_eq!(bench.sent(2100).len(), 0);
    bench.change(0, Value::Float(40.0), 2200);
    assert_eq!(bench.node.poll_timeout(), Some(at(2501).instant));
    let sent = bench.sent(2501);
    assert_eq!(sent[0].1.metrics.len(), 1, "the newest only");
}

#[test]
fn an_alarm_is_told_at_once() {
    let mut bench = Bench::live();
    bench.change(0, Value::Float(20.0), 1000);
    assert_eq!(bench.sent(1000).len(), 1);
    bench.image.revision = Revision(99);
    let alarm = bench.table.nodes[0].alarms.start + 2;
    bench.image.alarms[alarm].state = cangate::process_image::AlarmState::Unacknowledged;
    let sent = bench.sent(1001);
    assert_eq!(sent[0].1.metrics[0].value, Some(MetricValue::Boolean(true)));
}

#[test]
fn a_change_of_quality_alone_is_told_with_the_time_of_the_change() {
    let mut bench = Bench::live();
    bench.image.revision = Revision(99);
    bench.image.tags[2].quality = Quality::Stale(Reason::PdoTimeout);
    let sent = bench.sent(5000);
    let metric = &sent[0].1.metrics[0];
    assert_eq!(property(metric, "Quality"), Some(PropertyContent::Int(500)));
    assert_eq!(metric.value, Some(MetricValue::Boolean(false)), "the last value");
    assert_eq!(metric.timestamp, Some(millis(at(5000))));
    bench.change(2, Value::Bool(false), 6000);
    let sent = bench.sent(6000);
    assert_eq!(property(&sent[0].1.metrics[0], "Quality"), Some(PropertyContent::Int(192)), "good again");
}

#[test]
fn tck_id_payloads_sequence_num_incrementing_after_255_comes_0() {
    let mut bench = Bench::live();
    for message in 0..600_u64 {
        let now = (message + 1) * 1000;
        bench.change(2, Value::Bool(message % 2 == 0), now);
        let sent = bench.sent(now);
        assert_eq!((sent.len(), sent[0].1.seq), (1, Some((message + 3) % 256)));
    }
}

#[test]
fn tck_id_operational_behavior_device_ddeath_a_lost_node_dies_and_is_born_again() {
    let mut bench = Bench::live();
    lose(&mut bench.image, &bench.table.clone(), 0, at(1000));
    let sent = bench.sent(1000);
    assert_eq!(topics(&sent), ["DDEATH/hall-1/engine1"]);
    assert_eq!((sent[0].1.seq, sent[0].1.metrics.len()), (Some(3), 0));
    bench.change(2, Value::Bool(true), 2000);
    assert_eq!(bench.sent(2000).len(), 0, "a dead device says nothing");
    bench.image.revision = Revision(99);
    bench.image.nodes[0].online = true;
    let sent = bench.sent(3000);
    assert_eq!(topics(&sent), ["DBIRTH/hall-1/engine1"]);
    assert_eq!(sent[0].1.seq, Some(4));
    assert_eq!(named(&sent[0].1, "trip").value, Some(MetricValue::Boolean(true)));
    // In a new session a node that is not there is not born.
    lose(&mut bench.image, &bench.table.clone(), 1, at(4000));
    bench.node.handle_session_down();
    bench.connect(5000);
    assert_eq!(topics(&bench.sent(5000))[..2], BIRTHS[..2]);
}

#[test]
fn tck_id_operational_behavior_data_commands_rebirth_action_2_a_rebirth_is_a_complete_birth_with_the_same_bdseq()
 {
    let mut bench = Bench::with(|_| ());
    bench.connect(0);
    bench.node.handle_session_down();
    let will = bench.connect(0);
    bench.sent(0);
    bench.change(2, Value::Bool(true), 1000);
    assert_eq!(bench.sent(1000)[0].1.seq, Some(3));
    bench.ask_for_rebirth(2000, true);
    assert_eq!(bench.sent(2000).len(), 0, "what the broker had kept is no request");
    bench.ask_for_rebirth(3000, false);
    bench.ask_for_rebirth(3000, false);
    let sent = bench.sent(3000);
    assert_eq!(topics(&sent), BIRTHS, "once, however often it was asked for meanwhile");
    assert_eq!(sent[0].1.seq, Some(0));
    assert_eq!(bd_seq(&sent[0].1), bd_seq(&will));
    let report = bench.node.report();
    assert_eq!((report.births, report.rebirths, report.ignored), (2, 1, 1));
}

#[test]
fn commands_that_ask_for_nothing_that_there_is_are_counted_and_nothing_of_them_is_done() {
    let mut bench = Bench::live();
    for (topic, payload) in [
        ("spBv1.0/works/DCMD/hall-1/engine1", &b""[..]),
        ("spBv1.0/works/DCMD/hall-1/engine1", b"\xFF\xFF"),
        ("spBv1.0/works/NCMD/hall-1", b"\x0A\xFF"),
        ("spBv1.0/works/NCMD/hall-1", b""),
    ] {
        bench.node.handle_message(at(0), topic, payload, false);
    }
    assert_eq!(bench.node.report().ignored, 4);
    assert_eq!(bench.sent(1000).len(), 0);
}

#[test]
fn a_dcmd_is_for_the_device_of_its_topic_and_none_that_the_broker_had_kept_is_carried_out() {
    let mut bench = Bench::live();
    let trip =
        Metric { name: Some("trip".into()), value: Some(MetricValue::Boolean(true)), ..Metric::default() };
    let payload = Payload { metrics: vec![trip], ..Payload::default() }.encode_to_vec();
    let table = table(2);
    for device in ["engine1", "engine2"] {
        let topic = format!("spBv1.0/works/DCMD/hall-1/{device}");
        let tag = table.find_tag(table.find_node(device).unwrap(), "trip").unwrap();
        let asked = bench.node.handle_message(at(0), &topic, &payload, false);
        assert_eq!(
            asked,
            Asked::Write(vec![(tag, Value::Bool(true))]),
            "whether it may be written is the desk's to say"
        );
        let kept = bench.node.handle_message(at(0), &topic, &payload, true);
        assert!(matches!(kept, Asked::Refused(_)), "{kept:?}");
    }
    for topic in ["spBv1.0/works/DCMD/hall-1/engine3", "spBv1.0/works/DCMD/hall-10/engine1"] {
        let asked = bench.node.handle_message(at(0), topic, &payload, false);
        assert!(matches!(asked, Asked::Refused(_)), "{asked:?}");
    }
    assert_eq!(bench.node.report().ignored, 4);
}

#[test]
fn tck_id_operational_behavior_edge_node_intentional_disconnect_ndeath_is_the_last_message() {
    let mut bench = Bench::live();
    bench.change(2, Value::Bool(true), 1000);
    bench.node.handle_stop(at(1000));
    let sent = bench.sent(1000);
    assert_eq!(topics(&sent), ["NDEATH/hall-1"]);
    assert_eq!((sent[0].1.seq, sent[0].1.metrics.len(), sent[0].2), (None, 1, true));
    assert_eq!(bd_seq(&sent[0].1), Some(MetricValue::Long(0)));
    assert!(bench.node.has_said_farewell());
}

#[test]
fn what_changed_while_the_broker_was_away_follows_the_births_as_historical_with_its_own_times() {
    let mut bench = Bench::live();
    bench.node.handle_session_down();
    let mut kept = Vec::new();
    for step in 1..=400_u64 {
        let now = step * 1000;
        bench.change(2, Value::Bool(step % 2 == 1), now);
        assert_eq!(bench.sent(now).len(), 0);
        kept.push((Some(millis(at(now))), Some(MetricValue::Boolean(step % 2 == 1))));
    }
    bench.connect(500_000);
    let mut sent = bench.sent(500_000);
    assert_eq!(topics(&sent[..3]), BIRTHS);
    assert_eq!(topics(&sent[3..]), ["DDATA/hall-1/engine1"]);
    // The rest comes at its pace; what is live goes first.
    bench.image.revision = Revision(9999);
    let alarm = bench.table.nodes[1].alarms.start;
    bench.image.alarms[alarm].state = cangate::process_image::AlarmState::Unacknowledged;
    assert_eq!(bench.node.poll_timeout(), Some(at(500_050).instant));
    let more = bench.sent(500_050);
    assert_eq!(topics(&more), ["DDATA/hall-1/engine2", "DDATA/hall-1/engine1"]);
    sent.extend(more);
    assert_eq!(bench.node.poll_timeout(), None);
    let seq: Vec<_> = sent.iter().map(|(_, payload, _)| payload.seq.unwrap()).collect();
    assert!(seq.iter().copied().eq(0..seq.len() as u64), "{seq:?}");
    let historical = sent[3..].iter().filter(|(topic, ..)| topic == "DDATA/hall-1/engine1");
    let metrics: Vec<_> = historical.flat_map(|(_, payload, _)| payload.metrics.iter()).collect();
    assert!(metrics.iter().all(|metric| metric.is_historical == Some(true)));
    let told: Vec<_> = metrics.iter().map(|metric| (metric.timestamp, metric.value.clone())).collect();
    assert_eq!(told, kept);
    let report = bench.node.report();
    assert_eq!((report.held, report.historical, report.dropped), (0, 400, 0));
}

#[test]
fn no_more_is_kept_than_the_settings_say_and_what_leaves_is_counted() {
    let mut bench = Bench::with(|settings| settings.history_values = 10);
    bench.connect(0);
    bench.sent(0);
    bench.node.handle_session_down();
    for step in 1..=25_u64 {
        bench.change(2, Value::Bool(step % 2 == 1), step * 1000);
        bench.sent(step * 1000);
    }
    assert_eq!((bench.node.report().held, bench.node.report().dropped), (10, 15));
    bench.connect(30_000);
    let sent = bench.sent(30_000);
    assert_eq!(sent[3].1.metrics[0].timestamp, Some(millis(at(16_000))), "the newest ten");
}

#[test]
fn values_of_a_node_that_is_away_wait_until_it_is_born() {
    let mut bench = Bench::live();
    bench.node.handle_session_down();
    bench.change(2, Value::Bool(true), 1000);
    bench.sent(1000);
    lose(&mut bench.image, &bench.table.clone(), 0, at(2000));
    bench.sent(2000);
    bench.connect(3000);
    assert_eq!(topics(&bench.sent(3000)), [BIRTHS[0], BIRTHS[2]]);
    assert!(bench.node.report().held > 1);
    bench.image.revision = Revision(99);
    bench.image.nodes[0].online = true;
    let sent = bench.sent(4000);
    assert_eq!(topics(&sent), ["DBIRTH/hall-1/engine1", "DDATA/hall-1/engine1"]);
    assert_eq!(sent[1].1.metrics[0].is_historical, Some(true));
}

#[test]
fn what_was_handed_over_and_did_not_leave_is_sent_again_as_historical() {
    let mut bench = Bench::live();
    bench.change(2, Value::Bool(true), 1000);
    bench.node.handle_image(at(1000), &bench.image);
    let packet = bench.node.poll_output().unwrap();
    assert!(packet.topic.contains("DDATA"));
    // It is queued in the library when the session ends.
    bench.change(6, Value::Bool(true), 1001);
    bench.node.handle_image(at(1001), &bench.image);
    bench.node.handle_session_down();
    assert_eq!(bench.node.poll_output(), None);
    bench.connect(2000);
    let mut sent = bench.sent(2000);
    sent.extend(bench.sent(2100));
    let again: Vec<_> =
        sent[3..].iter().map(|(topic, payload, _)| (topic.as_str(), payload.metrics[0].timestamp)).collect();
    assert_eq!(
        again,
        [("DDATA/hall-1/engine1", Some(millis(at(1000)))), ("DDATA/hall-1/engine2", Some(millis(at(1001))))]
    );
}

#[test]
fn tck_id_message_flow_edge_node_birth_publish_phid_wait_nothing_is_said_before_the_host_is_online() {
    let mut bench = Bench::with(|settings| settings.primary_host = Some("scada".into()));
    assert_eq!(
        bench.node.command_subscriptions(),
        ["spBv1.0/works/NCMD/hall-1", "spBv1.0/works/DCMD/hall-1/+"]
    );
    assert_eq!(bench.node.host_subscription(), ["spBv1.0/STATE/scada"]);
    bench.connect(0);
    bench.host(false, 5);
    bench.sent(0);
    bench.change(2, Value::Bool(true), 1000);
    assert_eq!(bench.sent(1000).len(), 0);
    bench.host(true, 4);
    assert_eq!(bench.sent(1500).len(), 0, "older than what was said before");
    bench.host(true, 2000);
    let sent = bench.sent(2000);
    assert_eq!(topics(&sent)[..3], BIRTHS);
    assert!(
        sent[3..]
            .iter()
            .flat_map(|(_, payload, _)| &payload.metrics)
            .all(|metric| metric.is_historical == Some(true))
    );
    // tck-id-operational-behavior-edge-node-termination-host-offline.
    bench.host(false, 1999);
    assert!(bench.node.is_live(), "an older one");
    bench.host(false, 2000);
    assert_eq!(topics(&bench.sent(3000)), ["NDEATH/hall-1"]);
    assert!(bench.node.has_said_farewell(), "the session is to end");
    bench.change(2, Value::Bool(false), 4000);
    assert_eq!(bench.sent(4000).len(), 0);
    bench.node.handle_session_down();
    bench.connect(5000);
    assert!(!bench.node.has_said_farewell());
    bench.host(true, 5001);
    let sent = bench.sent(5001);
    assert_eq!(topics(&sent)[..3], BIRTHS);
    assert_eq!(bd_seq(&sent[0].1), Some(MetricValue::Long(1)));
    let rest: Vec<Sent> = (1..5).flat_map(|step| bench.sent(5001 + step * 50)).collect();
    let mut kept = sent[3..].iter().chain(&rest).flat_map(|(_, payload, _)| &payload.metrics);
    assert!(
        kept.any(|metric| (metric.is_historical, metric.timestamp) == (Some(true), Some(millis(at(4000)))))
    );
    assert_eq!(bench.node.report().held, 0);
}

#[test]
fn births_of_many_nodes_are_made_as_they_are_taken_and_data_wait_for_all_of_them() {
    let table = table(127);
    let mut image = image(&table);
    let settings = SparkplugSettings::default();
    let mut node = EdgeNode::new(Arc::clone(&table), &settings, &Identity::default());
    node.begin_session(at(0));
    node.handle_session_up();
    let mut topics = Vec::new();
    let mut reads = 0;
    while node.poll_timeout().is_some_and(|due| due <= at(0).instant) {
        node.handle_image(at(0), &image);
        reads += 1;
        image.revision = Revision(image.revision.0 + 1);
        image.tags[2] = good(Value::Bool(reads % 2 == 1));
        while let Some(packet) = node.poll_output() {
            node.handle_sent(packet.id);
            topics.push(packet.topic.to_string());
        }
    }
    assert!(reads > 3, "{reads}");
    assert_eq!(topics.len(), 128);
    assert!(topics.iter().all(|topic| topic.contains("BIRTH/")));
}

#[test]
fn a_unit_that_the_device_tells_later_makes_a_new_birth() {
    let mut bench = Bench::live();
    bench.image.revision = Revision(99);
    bench.image.units.insert(cangate::process_image::TagIndex(0), "mbar".into());
    let sent = bench.sent(1000);
    assert_eq!(topics(&sent), ["DBIRTH/hall-1/engine1"]);
    let unit = property(named(&sent[0].1, "knock_intensity_1"), "engUnit");
    assert_eq!(unit, Some(PropertyContent::String("mbar".into())));
    assert_eq!(bench.sent(2000).len(), 0, "once");
}

#[test]
fn nothing_that_a_broker_sends_can_stop_it() {
    let mut random = fastrand::Rng::with_seed(5);
    let mut bench = Bench::with(|settings| settings.primary_host = Some("scada".into()));
    bench.connect(0);
    bench.host(true, 1);
    let topics =
        ["spBv1.0/works/NCMD/hall-1", "spBv1.0/works/DCMD/hall-1/engine1", "spBv1.0/STATE/scada", "x"];
    for round in 0..20_000_u64 {
        let length = random.usize(0..40);
        let payload: Vec<u8> = std::iter::repeat_with(|| random.u8(..)).take(length).collect();
        bench.node.handle_message(at(round), topics[random.usize(0..4)], &payload, random.bool());
    }
    assert_eq!(bench.sent(30_000).len(), 3);
}

/// The task over mosquitto, with the image that it reads.
struct Running {
    writer: ImageWriter,
    status: watch::Receiver<SparkplugStatus>,
    stop: CancellationToken,
    task: JoinHandle<()>,
}

impl Running {
    fn start(broker: &Mosquitto) -> Self {
        let mut settings = MqttSettings {
            url: format!("mqtt://{}", broker.address).parse().unwrap(),
            ..MqttSettings::default()
        };
        settings.sparkplug =
            SparkplugSettings { enabled: true, group_id: "works".into(), ..SparkplugSettings::default() };
        let table = table(2);
        let (writer, reader) = process_image(image(&table));
        let node = EdgeNode::new(table, &settings.sparkplug, &Identity::default());
        let (sender, status) = watch::channel(SparkplugStatus::default());
        let stop = CancellationToken::new();
        let stopping = stop.clone();
        let task = tokio::spawn(async move {
            let (exchanges, pace) = (tokio::sync::mpsc::channel(1).1, Pace::of(&settings));
            let (desk, _requests) = Desk::new(1);
            task::run(
                settings,
                "hall-1",
                node,
                reader,
                desk,
                Clock::start(),
                stopping,
                sender,
                exchanges,
                pace,
            )
            .await;
        });
        Self { writer, status, stop, task }
    }
}

fn decoded(seen: &Seen) -> Payload {
    Payload::decode(&*seen.payload).unwrap()
}

#[tokio::test]
async fn over_mosquitto_a_session_has_births_data_a_rebirth_and_a_death_of_either_kind() {
    let Some(broker) = Mosquitto::start().await else { return };
    let probe = Probe::start(broker.address, "probe").await;
    for is_killed in [true, false] {
        let from = probe.seen().len();
        let mut running = Running::start(&broker);
        let topic = |topic: &str| format!("spBv1.0/works/{topic}");
        let last_birth = topic("DBIRTH/hall-1/engine2");
        let birth = probe.wait_for("NBIRTH", from, |seen| seen.topic == topic("NBIRTH/hall-1")).await;
        assert_eq!((birth.qos, birth.retain), (QoS::AtMostOnce, false));
        probe.wait_for("the last birth", from, |seen| seen.topic == last_birth).await;
        running.writer.apply(|image| {
            image.revision = Revision(2);
            image.tags[2] = good(Value::Bool(true));
        });
        probe.wait_for("DDATA", from, |seen| seen.topic == topic("DDATA/hall-1/engine1")).await;
        running.status.wait_for(|status| status.live).await.unwrap();

        let rebirth = Metric {
            name: Some("Node Control/Rebirth".into()),
            value: Some(MetricValue::Boolean(true)),
            ..Metric::default()
        };
        let request = Payload { metrics: vec![rebirth], ..Payload::default() }.encode_to_vec();
        let before = probe.seen().len();
        probe.publish(&topic("NCMD/hall-1"), &request, false).await;
        let again = probe.wait_for("NBIRTH again", before, |seen| seen.topic == topic("NBIRTH/hall-1")).await;
        assert_eq!(bd_seq(&decoded(&again)), bd_seq(&decoded(&birth)));
        probe.wait_for("the last birth", before, |seen| seen.topic == last_birth).await;
        // tck-id-message-flow-device-dcmd-subscribe.
        probe.publish(&topic("DCMD/hall-1/engine1"), &request, false).await;
        running.status.wait_for(|status| status.report.ignored == 1).await.unwrap();

        let before = probe.seen().len();
        if is_killed {
            running.task.abort();
        } else {
            running.stop.cancel();
        }
        let death = probe.wait_for("NDEATH", before, |seen| seen.topic == topic("NDEATH/hall-1")).await;
        assert_eq!((death.qos, death.retain), (QoS::AtLeastOnce, false));
        assert_eq!((decoded(&death).seq, bd_seq(&decoded(&death))), (None, bd_seq(&decoded(&birth))));
        if !is_killed {
            running.task.await.unwrap();
        }
    }
    let deaths = probe.seen().iter().filter(|seen| seen.topic.contains("NDEATH")).count();
    assert_eq!(deaths, 2, "who said it himself leaves no last will");
}
