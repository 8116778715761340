//! Topics and payloads are a promise: the files in `fixtures/contract` are never edited to make this pass.

use std::fs;
use std::path::Path;

use cangate::modbus::{ModbusSettings, RegisterMap};
use cangate::mqtt::BufferReport;
use cangate::mqtt::json::JsonWriter;
use cangate::mqtt::outbox::OutboxReport;
use cangate::mqtt::payload::{self, Identity, Stamp};
use cangate::mqtt::topics::Topics;
use cangate::process_image::{
    AlarmIndex, AlarmState, AlarmStatus, EventKind, NodeIndex, NodeStatus, Priority, Quality, Reason,
    Revision, Sample, Value,
};

use cangate::store::{State, StoreReport};

use crate::support::plant::{at, event, image, lose, table};
use crate::support::registers;

/// Holds a payload, byte for byte, against its file.
pub(crate) fn assert_golden(name: &str, payload: &str) {
    let _: serde_json::Value = serde_json::from_str(payload).expect("a payload is JSON");
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/contract").join(name);
    let golden = fs::read_to_string(&path).unwrap_or_default();
    assert_eq!(payload, golden.trim_end(), "{name} is a promise to users");
}

fn identity() -> Identity {
    Identity {
        sid: "3f0c".into(),
        version: "0.1.0".into(),
        map_version: 1,
        map_hash: "00c0ffee".into(),
        started: at(0),
    }
}

#[test]
fn topics_stand_under_base_and_gateway() {
    let topics = Topics::new("plant/north", &table(2));
    assert_eq!(&*topics.bridge_state, "plant/north/hall-1/bridge/state");
    assert_eq!(&*topics.bridge_info, "plant/north/hall-1/bridge/info");
    assert_eq!(&*topics.bridge_health, "plant/north/hall-1/bridge/health");
    assert_eq!(&*topics.event, "plant/north/hall-1/event");
    assert_eq!(&*topics.nodes[1].state, "plant/north/hall-1/engine2/state");
    assert_eq!(&*topics.nodes[1].availability, "plant/north/hall-1/engine2/availability");
    let alarms: Vec<_> = topics.alarms.iter().map(|topic| &**topic).collect();
    assert_eq!(alarms[0], "plant/north/hall-1/bridge/alarm/mqtt_down");
    assert_eq!(alarms[1], "plant/north/hall-1/bridge/alarm/can0_bus_off");
    assert_eq!(alarms[7], "plant/north/hall-1/engine2/alarm/trip");
}

#[test]
fn the_register_map_names_the_topics_that_are_published() {
    let table = registers::table();
    let topics = Topics::new("plant/north", &table);
    let map = RegisterMap::build(&table, &ModbusSettings::default(), "plant/north").unwrap();
    for (node, topics) in table.nodes.iter().zip(&topics.nodes) {
        let point = map.points().iter().find(|point| point.node == node.name && point.tag == "trip").unwrap();
        assert_eq!(point.topic, *topics.state);
    }
    let alarm = |name| map.points().iter().find(|point| point.tag == name).unwrap().topic.clone();
    assert_eq!(alarm("alarm.trip.active"), *topics.alarms[4]);
}

#[test]
fn payload_of_the_bridge_state() {
    assert_eq!(payload::ONLINE, r#"{"state":"online"}"#);
    assert_eq!(payload::OFFLINE, r#"{"state":"offline"}"#);
}

#[test]
fn payload_of_a_state_that_is_good() {
    let (table, mut out) = (table(2), String::new());
    let stamp = Stamp { sid: "3f0c", seq: 17 };
    payload::state(&mut out, &table, &image(&table), NodeIndex(0), stamp);
    assert_golden("mqtt_state_good.json", &out);
}

#[test]
fn r_det_084_r_det_086_payload_of_a_state_that_is_not_all_good() {
    let (table, mut out) = (table(2), String::new());
    let mut image = image(&table);
    image.tags[1].value = Value::Bool(false);
    image.tags[2] = Sample::NEVER;
    image.tags[3].quality = Quality::Stale(Reason::PdoTimeout);
    payload::state(&mut out, &table, &image, NodeIndex(0), Stamp { sid: "3f0c", seq: 18 });
    assert_golden("mqtt_state_mixed.json", &out);
}

#[test]
fn r_det_084_a_lost_node_keeps_its_last_values_unless_zero_is_asked_for() {
    let (plant, mut out) = (table(2), String::new());
    let mut image = image(&plant);
    image.tags[2].value = Value::Bool(true);
    lose(&mut image, &plant, 0, at(0));
    payload::state(&mut out, &plant, &image, NodeIndex(0), Stamp { sid: "3f0c", seq: 19 });
    assert_golden("mqtt_state_lost.json", &out);
    let mut zero = (*plant).clone();
    zero.nodes[0].zero_on_bad = true;
    payload::state(&mut out, &zero, &image, NodeIndex(0), Stamp { sid: "3f0c", seq: 19 });
    assert_golden("mqtt_state_zero_on_bad.json", &out);
}

#[test]
fn payload_of_a_value_that_is_no_number() {
    let (table, mut out) = (table(1), String::new());
    let mut image = image(&table);
    for number in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY] {
        image.tags[0].value = Value::Float(number);
        payload::state(&mut out, &table, &image, NodeIndex(0), Stamp { sid: "3f0c", seq: 1 });
        let read: serde_json::Value = serde_json::from_str(&out).unwrap();
        assert!(read["tags"]["knock_intensity_1"].is_null());
        assert_eq!(read["bad"]["knock_intensity_1"], "not_a_number");
    }
}

#[test]
fn payload_of_an_availability() {
    let mut out = String::new();
    payload::availability(&mut out, &NodeStatus { online: true, ..NodeStatus::default() });
    assert_eq!(out, r#"{"state":"online"}"#);
    let reason = "no guarding reply for 1.5 s".to_owned();
    payload::availability(&mut out, &NodeStatus { reason, ..NodeStatus::default() });
    assert_golden("mqtt_availability_offline.json", &out);
}

#[test]
fn payload_of_an_alarm() {
    let (table, mut out) = (table(1), String::new());
    let status = AlarmStatus {
        state: AlarmState::Unacknowledged,
        since: Some(at(0).utc),
        count: 3,
        first_out: true,
        value: Some(Value::Float(87.843_137)),
        revision: Revision(1),
    };
    payload::alarm(&mut out, &table, &table.alarms[4], &status);
    assert_golden("mqtt_alarm.json", &out);
    payload::alarm(&mut out, &table, &table.alarms[0], &AlarmStatus::default());
    assert_golden("mqtt_alarm_normal.json", &out);
}

#[test]
fn payload_of_an_event() {
    let (table, mut out) = (table(1), String::new());
    payload::event(&mut out, &table, &event(7), "3f0c");
    assert_golden("mqtt_event_node.json", &out);
    let mut alarm = event(8);
    alarm.kind = EventKind::Alarm;
    alarm.name = "trip".into();
    alarm.from = "normal".into();
    alarm.to = "unacknowledged".into();
    alarm.alarm = Some(AlarmIndex(4));
    alarm.priority = Some(Priority::Critical);
    alarm.value = Some(Value::Float(87.843_137));
    alarm.text = "Two lines\nand a \"quote\".".into();
    payload::event(&mut out, &table, &alarm, "3f0c");
    assert_golden("mqtt_event_alarm.json", &out);
    payload::events_missed(&mut out, "3f0c", 976, 976, at(0).utc);
    assert_golden("mqtt_event_missed.json", &out);
}

#[test]
fn payload_of_the_bridge_info_and_health() {
    let (table, mut out) = (table(2), String::new());
    payload::info(&mut out, &table, &identity());
    assert_golden("mqtt_info.json", &out);
    let mut image = image(&table);
    lose(&mut image, &table, 0, at(0));
    let report = OutboxReport {
        messages: 5,
        messages_limit: 20_000,
        bytes: 2_000,
        bytes_limit: 16_777_216,
        sent: 100,
        acknowledged: 95,
        ..OutboxReport::default()
    };
    payload::health(&mut out, &table, &image, &identity(), at(61_500), (&report, None));
    assert_golden("mqtt_health.json", &out);
    let store = StoreReport {
        state: State::Full,
        reason: "cannot write into `/b`: No space left".into(),
        records: [7, 311],
        bytes: 52_311,
        bytes_limit: 1 << 30,
        dropped: [0, 3],
        damaged: [1, 0],
        faults: 2,
        written: 131,
        payload: 100,
        ..StoreReport::default()
    };
    let buffer = BufferReport { store, hours_left: Some(1431.2) };
    payload::health(&mut out, &table, &image, &identity(), at(61_500), (&report, Some(&buffer)));
    assert_golden("mqtt_health_buffer.json", &out);
}

#[test]
fn payload_of_the_history_is_that_of_a_state_that_says_so() {
    let (table, mut out) = (table(2), String::new());
    payload::state(&mut out, &table, &image(&table), NodeIndex(0), Stamp { sid: "3f0c", seq: 17 });
    assert_golden("mqtt_history.json", &payload::historical(&out));
}

#[test]
fn an_event_that_comes_out_of_the_store_is_the_one_that_went_in() {
    let (table, mut out) = (table(1), String::new());
    payload::event(&mut out, &table, &event(7), "3f0c");
    let rest = payload::without_stream(&out, "3f0c", 7);
    assert!(rest.len() < out.len());
    assert_eq!(payload::with_stream("3f0c", 7, rest), out);
}

#[test]
fn a_reused_buffer_holds_one_payload() {
    let mut out = "left over".to_owned();
    JsonWriter::object(&mut out).finish();
    assert_eq!(out, "{}");
}
