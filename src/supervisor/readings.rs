//! What the page and the metrics show of Modbus and MQTT: their counters, in plain numbers.

use crate::modbus::counters::{CounterValues, End};
use crate::mqtt::MqttStatus;
use crate::web::{ProgramHealth, Reading, ReadingKind, SessionHealth};

/// All of it. `mqtt` is `None` where MQTT is not configured.
#[must_use]
pub fn program_health(
    not_ready: Vec<String>,
    modbus: &CounterValues,
    mqtt: Option<&MqttStatus>,
) -> ProgramHealth {
    let mut readings = modbus_readings(modbus);
    readings.extend(mqtt.into_iter().flat_map(mqtt_readings));
    let session = |status: &MqttStatus| SessionHealth {
        connected: status.connected,
        broker: status.broker.clone(),
        last_error: status.last_error.clone(),
    };
    ProgramHealth { not_ready, mqtt: mqtt.map(session), readings }
}

fn modbus_readings(counters: &CounterValues) -> Vec<Reading> {
    let mut readings = vec![
        counter("modbus_connections", "Connections accepted", counters.accepted),
        gauge("modbus_connections_open", "Connections open now", counters.open),
        counter("modbus_accept_errors", "Times that accepting a connection failed", counters.accept_errors),
        counter("modbus_requests", "Requests answered, exceptions included", counters.requests),
        counter("modbus_foreign_frames", "Frames of other protocols, passed over", counters.foreign_frames),
    ];
    for (code, count) in counters.exceptions.iter().enumerate() {
        let labels = vec![("code", code.to_string())];
        readings
            .push(Reading { labels, ..counter("modbus_exceptions", "Exceptions answered, by code", *count) });
    }
    for end in End::ALL {
        let labels = vec![("reason", end.word().to_owned())];
        let ended = counter("modbus_connections_ended", "Connections ended, by reason", counters.ended(end));
        readings.push(Reading { labels, ..ended });
    }
    readings
}

fn mqtt_readings(status: &MqttStatus) -> Vec<Reading> {
    let outbox = &status.outbox;
    let size = |number: usize| u64::try_from(number).unwrap_or(u64::MAX);
    let mut readings = vec![
        counter("mqtt_sessions", "Sessions begun", status.sessions),
        counter("mqtt_failures", "Attempts that failed and sessions that ended", status.failures),
        gauge(
            "mqtt_outbox_messages",
            "Messages that wait for the broker's acknowledgement",
            size(outbox.messages),
        ),
        gauge("mqtt_outbox_bytes", "Bytes that wait for the broker's acknowledgement", size(outbox.bytes)),
        counter("mqtt_sent", "Messages handed to the session", outbox.sent),
        counter("mqtt_sent_again", "Of those: again, after a session that ended", outbox.sent_again),
        counter("mqtt_acknowledged", "Messages acknowledged by the broker", outbox.acknowledged),
        counter(
            "mqtt_events_missed",
            "Events that left the journal before they could be read",
            outbox.events_missed,
        ),
    ];
    for (class, count) in outbox.dropped() {
        let labels = vec![("class", class.to_owned())];
        let help = "Messages dropped because the outbox was full, by class";
        readings.push(Reading { labels, ..counter("mqtt_dropped", help, count) });
    }
    readings
}

fn counter(name: &'static str, help: &'static str, value: u64) -> Reading {
    reading(name, help, ReadingKind::Counter, value)
}

fn gauge(name: &'static str, help: &'static str, value: u64) -> Reading {
    reading(name, help, ReadingKind::Gauge, value)
}

#[expect(
    clippy::as_conversions,
    clippy::cast_precision_loss,
    reason = "metrics are 64-bit floats by their standard"
)]
fn reading(name: &'static str, help: &'static str, kind: ReadingKind, value: u64) -> Reading {
    Reading { name, help, kind, labels: Vec::new(), value: value as f64 }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_of_both_views_are_shown_and_mqtt_only_where_it_is_configured() {
        let modbus = CounterValues { requests: 7, ..CounterValues::default() };
        let value = |health: &ProgramHealth, name| {
            health.readings.iter().find(|reading| reading.name == name).map(|reading| reading.value)
        };
        let without = program_health(Vec::new(), &modbus, None);
        assert_eq!(
            (value(&without, "modbus_requests"), value(&without, "mqtt_connected")),
            (Some(7.0), None)
        );
        let status = MqttStatus { connected: true, ..MqttStatus::default() };
        let with = program_health(Vec::new(), &modbus, Some(&status));
        assert_eq!(value(&with, "mqtt_sessions"), Some(0.0));
        assert!(with.mqtt.unwrap().connected);
    }
}
