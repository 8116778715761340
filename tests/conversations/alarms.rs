//! Alarms: of the mapping, of the gateway; one cause raises one alarm.

use cangate::can::{BusCounters, BusEvent, Link};
use cangate::canopen::NmtRequest;
use cangate::gateway::{Action, Health, Outcome};
use cangate::mapping::At;
use cangate::process_image::{AlarmState, EventKind, NodeIndex, Priority, SessionTrouble, Value};
use cangate::time::Now;

use super::{QUIET, detcon, detcon_with, running, table};
use crate::support::conversation::Conversation;

/// Two running engines.
fn two_engines() -> Conversation {
    let mut conversation = Conversation::new(table(&[("engine1", 1), ("engine2", 2)], |_, _| ()));
    conversation.answer_guarding(2, 5);
    for frame in QUIET {
        let (id, data) = frame.split_once('#').unwrap();
        let id = u16::from_str_radix(id, 16).unwrap() + 1;
        conversation.send_cyclically(&format!("{id:03X}#{data}"), 500);
    }
    running(conversation)
}

#[test]
fn a_healthy_node_raises_no_alarm() {
    let mut conversation = running(detcon());
    conversation.run_to(600_000);
    assert!(conversation.raised().is_empty(), "{:?}", conversation.raised());
    assert!(conversation.image.tags.iter().all(|tag| tag.quality.is_good()));
    assert_eq!(conversation.node().reason, "");
}

#[test]
fn r_det_001_a_node_that_never_shows_a_frame_names_the_likely_causes() {
    let mut conversation = detcon();
    conversation.run_to(60_000);
    assert_eq!(conversation.active(), ["node_never_seen"]);
    assert_eq!(conversation.raised(), ["node_never_seen"], "it was not lost: it never was there");
    let reason = &conversation.node().reason;
    for cause in ["CANopen mode", "node id", "bit rate"] {
        assert!(reason.contains(cause), "{reason}");
    }
    conversation.answer_guarding(1, 5);
    conversation.run_to(61_000);
    assert!(conversation.active().is_empty());
    assert!(conversation.node().online);
}

#[test]
fn r_det_082_the_alarm_names_the_tpdo() {
    let mut conversation = running(detcon());
    conversation.stop_sending("281");
    conversation.run_to(2_500);
    assert_eq!(conversation.active(), ["pdo_timeout_2"]);
    conversation.frame(QUIET[1]);
    assert!(conversation.active().is_empty());
}

#[test]
fn a_node_that_is_switched_off_raises_one_alarm_whenever_that_happens() {
    for off in (1_000..1_500).step_by(20) {
        let mut conversation = running(detcon());
        conversation.run_to(off);
        conversation.stop_answering(1);
        conversation.stop_sending("");
        conversation.run_to(off + 5_000);
        assert_eq!(conversation.raised(), ["node_lost"], "switched off at {off} ms");
    }
}

#[test]
fn a_cable_that_breaks_raises_one_alarm_for_all_nodes_within_two_seconds() {
    for off in (1_000..1_500).step_by(20) {
        let mut conversation = two_engines();
        conversation.run_to(off);
        conversation.stop_answering(1);
        conversation.stop_answering(2);
        conversation.stop_sending("");
        conversation.run_to(off + 2_000);
        assert_eq!(conversation.active(), ["bus_silent"], "cut at {off} ms");
        conversation.run_to(off + 10_000);
        assert_eq!(conversation.raised(), ["bus_silent"], "cut at {off} ms");
        assert_eq!(conversation.tag_text("knock_intensity_1"), "0.00 bad (node_lost)");
        conversation.frame(QUIET[0]);
        assert!(!conversation.active().contains(&"bus_silent"), "one frame ends it");
    }
}

#[test]
fn one_of_two_nodes_switched_off_is_that_nodes_alarm() {
    let mut conversation = two_engines();
    conversation.stop_answering(1);
    for frame in QUIET {
        conversation.stop_sending(&frame[..4]);
    }
    conversation.run_to(5_000);
    assert_eq!(conversation.alarm_of(0, "node_lost").state, AlarmState::Unacknowledged);
    assert_eq!(conversation.raised(), ["node_lost"]);
}

#[test]
fn a_bus_that_goes_down_tells_of_the_bus_and_not_of_its_nodes() {
    for (link, alarm) in
        [(Link::BusOff, "bus_off"), (Link::Down, "interface_down"), (Link::Absent, "interface_down")]
    {
        let mut conversation = two_engines();
        conversation.link(link);
        conversation.stop_answering(1);
        conversation.stop_answering(2);
        conversation.stop_sending("");
        conversation.run_to(20_000);
        assert_eq!(conversation.raised(), [alarm]);
        assert!(conversation.node().reason.contains("can0"), "{}", conversation.node().reason);
        conversation.link(Link::ErrorActive);
        assert!(!conversation.active().contains(&alarm));
    }
}

#[test]
fn r_det_089_bus_off_without_any_frame_names_the_bit_rate() {
    let mut conversation = detcon();
    conversation.link(Link::BusOff);
    let events = conversation.events_named("bus_state");
    assert!(events.last().unwrap().text.contains("bit rate"));
    let errors = |seconds: u64| BusEvent::Counters {
        counters: BusCounters { error_frames: 500 * seconds, ..BusCounters::default() },
        at: Now::from_millis(1_000 * seconds),
    };
    conversation.bus_event(errors(1));
    assert!(conversation.events_named("bus_errors")[0].text.contains("bit rate"));
}

#[test]
fn a_high_load_is_told_after_ten_seconds() {
    let mut conversation = running(detcon());
    let report = |seconds: u64| BusEvent::Counters {
        counters: BusCounters {
            frames_received: 1_000 * seconds,
            wire_bits: 112_500 * seconds,
            ..BusCounters::default()
        },
        at: Now::from_millis(1_000 * seconds),
    };
    for seconds in 1..=20 {
        conversation.run_to(1_000 * seconds);
        conversation.bus_event(report(seconds));
        assert_eq!(conversation.active().contains(&"bus_load_high"), seconds >= 12, "{seconds} s");
    }
}

#[test]
fn frames_that_the_kernel_dropped_are_an_alarm_for_a_minute() {
    let mut conversation = running(detcon());
    let counters = BusCounters { overruns: 3, ..BusCounters::default() };
    conversation.bus_event(BusEvent::Counters { counters, at: Now::from_millis(1_000) });
    assert_eq!(conversation.active(), ["frames_lost"]);
    conversation.run_to(60_900);
    assert_eq!(conversation.active(), ["frames_lost"]);
    conversation.run_to(61_000);
    assert_eq!(conversation.active(), [""; 0]);
    assert_eq!(conversation.alarm("frames_lost").state, AlarmState::ReturnedUnacknowledged);
}

#[test]
fn somebody_elses_nmt_command_is_an_alarm() {
    let mut conversation = running(detcon());
    conversation.frame("000#0201");
    assert_eq!(conversation.active(), ["foreign_master"]);
    assert_eq!(conversation.events_named("foreign_nmt_command").len(), 1);
}

#[test]
fn a_tool_that_reads_objects_is_told_and_whoever_writes_them_or_uses_lss_is_another_master() {
    for (frame, event, text) in [
        ("601#2B171000F4010000", "foreign_sdo_write", "writes 0x1017:0"),
        ("7E5#0401000000000000", "foreign_lss", "node id or bit rate"),
    ] {
        let mut conversation = running(detcon());
        conversation.frame("601#4000100000000000");
        assert_eq!(conversation.events_named("foreign_sdo_read").len(), 1);
        assert_eq!(conversation.active(), [""; 0]);
        conversation.frame(frame);
        assert_eq!(conversation.active(), ["foreign_master"], "{frame}");
        assert!(conversation.events_named(event)[0].text.contains(text), "{frame}");
    }
}

#[test]
fn frames_of_nobodys_are_told_with_what_they_may_mean_and_no_alarm() {
    let mut conversation = running(detcon());
    for (frame, text) in [
        (
            "77F#05",
            "heartbeat, boot-up message or guard request of node 127, which is not configured: another master",
        ),
        ("185#00", "185 comes from node 5, which is not configured"),
        ("201#00", "somebody else sends node 1 process data, 201"),
        ("7F0#00", "7F0 belongs to no configured node"),
        ("581#6017100000000000", "581 stands for node 1, but the mapping of that node does not know it"),
    ] {
        conversation.frame(frame);
        let events = conversation.events_named("unknown_id");
        assert!(events.last().is_some_and(|event| event.text.contains(text)), "{frame}: {events:?}");
    }
    assert_eq!(conversation.active(), [""; 0]);
}

#[test]
fn v_det_10_r_det_085_sensor_fault_only_for_used_and_bad() {
    let mut conversation = running(detcon());
    conversation.stop_sending("381");
    conversation.send_cyclically("381#0000FF0F01800000", 500);
    conversation.run_to(2_900);
    assert_eq!(conversation.active(), [""; 0], "two seconds of delay");
    conversation.run_to(3_100);
    assert_eq!(conversation.active(), ["sensor_fault_1"]);
    assert!(conversation.is_normal("sensor_fault_16"), "bad, but not in use");
}

#[test]
fn r_det_088_status_bits_are_alarms_with_their_own_priority() {
    let conversation = detcon();
    for (name, priority) in [
        ("trip", Priority::Critical),
        ("load_reduction", Priority::High),
        ("engine_knocking", Priority::High),
        ("no_isu_pulses", Priority::High),
        ("eeprom_fault", Priority::High),
        ("low_rpm", Priority::Low),
        ("spurious_pulse", Priority::Low),
    ] {
        assert_eq!(conversation.table.alarms[conversation.alarm_index(name).0].priority, priority, "{name}");
    }
}

#[test]
fn r_det_088_a_trip_of_100_ms_is_an_alarm_that_waits_for_a_reset() {
    let mut conversation = running(detcon());
    conversation.stop_sending("381");
    conversation.play(
        "1200 <- 381#0200FF0F000099CC
         1200 alarm trip unacknowledged
         1300 <- 381#0000FF0F000099CC",
    );
    conversation.send_cyclically("381#0000FF0F000099CC", 500);
    conversation.play("6400 alarm trip latched_unacknowledged");
    assert!(conversation.alarm("trip").first_out);
    let alarm = conversation.alarm_index("trip");
    assert!(matches!(conversation.command(Action::Reset { alarm }), Outcome::Rejected(_)));
    assert_eq!(conversation.command(Action::Acknowledge { alarm, raise: None }), Outcome::Done);
    assert!(matches!(conversation.command(Action::Acknowledge { alarm, raise: None }), Outcome::Rejected(_)));
    assert_eq!(conversation.command(Action::Reset { alarm }), Outcome::Done);
    assert!(conversation.is_normal("trip"));
    let steps: Vec<(String, String)> = conversation
        .events_named("trip")
        .into_iter()
        .filter(|event| event.kind == EventKind::Alarm)
        .map(|event| (event.from, event.to))
        .collect();
    let words = ["normal", "unacknowledged", "latched_unacknowledged", "latched_acknowledged", "normal"];
    let wanted: Vec<(String, String)> =
        words.windows(2).map(|pair| (pair[0].to_owned(), pair[1].to_owned())).collect();
    assert_eq!(steps, wanted);
}

#[test]
fn an_alarm_keeps_its_state_while_its_tags_cannot_be_used() {
    let mut conversation = running(detcon());
    conversation.stop_sending("381");
    conversation.send_cyclically("381#0400FF0F000099CC", 500);
    conversation.run_to(3_000);
    assert_eq!(conversation.active(), ["load_reduction"]);
    conversation.stop_sending("381");
    conversation.run_to(20_000);
    assert_eq!(conversation.tag_text("load_reduction"), "true stale (pdo_timeout)");
    assert_eq!(conversation.active(), ["pdo_timeout_3", "load_reduction"]);
}

#[test]
fn the_cylinder_that_knocked_first_is_told() {
    let mut conversation = running(detcon());
    conversation.frame("181#000000000000FF00");
    conversation.run_to(1_100);
    conversation.frame("381#0300FF0F000099CC");
    assert!(conversation.alarm("stop_limit_7").first_out);
    assert!(!conversation.alarm("trip").first_out);
    let events = conversation.events_named("stop_limit_7");
    assert_eq!(events[0].value.map(cangate::process_image::Value::as_f64), Some(100.0));
    assert_eq!(events[0].text, "Cylinder 7 knocked above the immediate stop limit.");
}

#[test]
fn mqtt_that_is_down_for_a_minute_is_an_alarm_and_one_that_is_not_configured_is_none() {
    let mut conversation = running(detcon());
    conversation.run_to(100_000);
    conversation.health(Health { mqtt_connected: Some(false), ..Health::default() });
    conversation.run_to(159_000);
    assert_eq!(conversation.active(), [""; 0]);
    conversation.run_to(160_000);
    assert_eq!(conversation.active(), ["mqtt_down"]);
    conversation.health(Health { mqtt_connected: Some(true), clock_synchronised: true, ..Health::default() });
    assert!(conversation.image.mqtt_connected && conversation.image.clock_synchronised);
    conversation.run_to(166_000);
    assert_eq!(conversation.active(), [""; 0]);
}

#[test]
fn g01_the_alarm_of_mqtt_says_why_there_is_no_session_and_follows_the_reason() {
    let mut conversation = running(detcon());
    let down = |mqtt_trouble| Health { mqtt_connected: Some(false), mqtt_trouble, ..Health::default() };
    conversation.health(down(Some(SessionTrouble::Expired)));
    conversation.run_to(200_000);
    let told = |conversation: &Conversation| {
        let table = &conversation.table;
        let place = table.alarms.iter().position(|alarm| alarm.name == "mqtt_down").unwrap();
        let value = conversation.image.alarms[place].value;
        (value, table.alarms[place].told(value).into_owned())
    };
    let (value, text) = told(&conversation);
    assert_eq!(value, Some(Value::Unsigned(21)));
    assert_eq!(text, "There is no session with the MQTT broker. Its certificate has expired.");
    assert_eq!(conversation.events_named("mqtt_down")[0].text, text);
    conversation.health(down(Some(SessionTrouble::WrongHost)));
    conversation.run_to(201_000);
    assert_eq!(
        told(&conversation).1,
        "There is no session with the MQTT broker. Its certificate is for another host."
    );
}

#[test]
fn g06_certificates_are_told_of_a_month_and_a_week_before_they_expire_and_when_they_have() {
    let mut conversation = running(detcon());
    conversation.run_to(10_000);
    let mut at = 10_000;
    for (days, expected) in [
        (None, ""),
        (Some(400), ""),
        (Some(30), ""),
        (Some(29), "certificate_expires"),
        (Some(7), "certificate_expires"),
        (Some(6), "certificate_expires_soon"),
        (Some(0), "certificate_expires_soon"),
        (Some(-1), "certificate_expired"),
        (Some(90), ""),
    ] {
        at += 1_000;
        conversation.health(Health { certificate_days: days, ..Health::default() });
        conversation.run_to(at);
        let active = conversation.active();
        assert_eq!(active.first().copied().unwrap_or_default(), expected, "{days:?}");
        assert!(active.len() <= 1);
    }
}

#[test]
fn p26_data_of_a_node_that_was_told_to_stop_grows_old_too() {
    let mut conversation = running(detcon_with(|_, node| node.guard_time_ms = Some(At::nowhere(0))));
    conversation.command(Action::Nmt { node: NodeIndex(0), request: NmtRequest::Stop });
    conversation.stop_sending("");
    conversation.run_to(2_500);
    assert_eq!(conversation.tag_text("knock_intensity_1"), "0.00 stale (pdo_timeout)");
    assert!(conversation.raised().is_empty(), "it was told to: {:?}", conversation.raised());
}

#[test]
fn acknowledge_all_acknowledges_what_waits_and_is_journalled() {
    let mut conversation = running(detcon());
    conversation.stop_sending("181");
    conversation.run_to(3_000);
    assert_eq!(conversation.command(Action::AcknowledgeAll { node: None }), Outcome::Done);
    assert_eq!(conversation.alarm("pdo_timeout_1").state, AlarmState::Acknowledged);
    assert_eq!(conversation.events().last().unwrap().seq, conversation.image.journal.newest());
    assert_eq!(conversation.events_named("acknowledge_all").len(), 1);
}

#[test]
fn a_storm_cannot_flush_the_journal() {
    let mut conversation = running(detcon());
    conversation.frame("081#1042010A0B0C0D0E");
    for millis in 1_000..21_000 {
        conversation.run_to(millis);
        conversation.frame("701#");
    }
    assert_eq!(conversation.node().counters.malformed, 20_000);
    assert_eq!(conversation.events_named("emergency").len(), 1, "still there");
    assert!(conversation.image.journal.newest() < 100);
}

#[test]
fn a_count_is_at_least_what_is_known_of_it() {
    let mut conversation = detcon();
    conversation.answer_guarding(1, 5);
    for frame in [QUIET[0], QUIET[1], "381#0000FF0F03000000"] {
        conversation.send_cyclically(frame, 500);
    }
    conversation.run_to(3_000);
    assert_eq!(conversation.tag_text("sensor_faults"), "2 bad (never_received)");
    assert!(conversation.active().contains(&"protection_degraded"), "{:?}", conversation.active());
}
