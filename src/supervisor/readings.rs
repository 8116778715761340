//! What the page and the metrics show of Modbus and MQTT: their counters, in plain numbers.

use crate::gateway::command::Door;
use crate::modbus::ClientValues;
use crate::modbus::counters::{CounterValues, End};
use crate::mqtt::MqttStatus;
use crate::mqtt::sparkplug::SparkplugStatus;
use crate::store::{Class, StoreReport};
use crate::tls::Life;
use crate::web::{
    CertificateHealth, ClientHealth, ConfigurationHealth, ProgramHealth, Reading, ReadingKind, SessionHealth,
};

/// All of it. `mqtt` is `None` where MQTT is not configured.
#[must_use]
pub fn program_health(
    not_ready: Vec<String>,
    modbus: &CounterValues,
    clients: &[ClientValues],
    mqtt: Option<&MqttStatus>,
    certificates: &[Life],
    refused: &[(Door, u64)],
) -> ProgramHealth {
    let mut readings = modbus_readings(modbus);
    readings.extend(refused.iter().map(|(door, count)| refused_reading(*door, *count)));
    readings.extend(clients.iter().flat_map(client_readings));
    readings.extend(mqtt.into_iter().flat_map(mqtt_readings));
    let session = |status: &MqttStatus| SessionHealth {
        connected: status.connected,
        broker: status.broker.clone(),
        last_error: status.last_error.clone(),
    };
    let certificates = certificates.iter().map(|life| CertificateHealth {
        file: life.file.clone(),
        subject: life.subject.clone(),
        expires: life.expires(),
        days_left: life.days_left,
    });
    ProgramHealth {
        not_ready,
        mqtt: mqtt.map(session),
        modbus_clients: clients.iter().map(client_health).collect(),
        certificates: certificates.collect(),
        configuration: ConfigurationHealth::default(),
        readings,
    }
}

/// Those of the configuration that runs.
#[must_use]
pub fn configuration(health: &ConfigurationHealth) -> [Reading; 3] {
    [
        counter("configuration_reloads", "Times that another configuration was taken in", health.reloads),
        counter("configuration_rejections", "Times that one was refused", health.rejections),
        gauge(
            "configuration_rejected",
            "The newest configuration was refused",
            u64::from(health.rejected.is_some()),
        ),
    ]
}

fn modbus_readings(counters: &CounterValues) -> Vec<Reading> {
    let mut readings = vec![
        counter("modbus_connections", "Connections accepted", counters.accepted),
        gauge("modbus_connections_open", "Connections open now", counters.open),
        counter("modbus_accept_errors", "Times that accepting a connection failed", counters.accept_errors),
        counter("modbus_requests", "Requests answered, exceptions included", counters.requests),
        counter("modbus_connections_refused", "Connections that were not let in", counters.turned_away),
        counter("modbus_forbidden", "Requests that their client had no right to", counters.forbidden),
        counter("modbus_delayed", "Requests that waited, as their client asks too fast", counters.delayed),
        counter("modbus_foreign_frames", "Frames of other protocols, passed over", counters.foreign_frames),
        counter("modbus_rtu_discarded", "Frames on serial lines with a wrong check", counters.rtu_discarded),
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

fn refused_reading(door: Door, count: u64) -> Reading {
    let labels = vec![("door", door.word().to_owned())];
    let help = "Requests refused for want of a right, by the door that they came to";
    Reading { labels, ..counter("commands_refused", help, count) }
}

fn client_health(client: &ClientValues) -> ClientHealth {
    ClientHealth {
        address: client.address.map(|address| address.to_string()),
        reserved: client.reserved,
        open: client.open,
        connections: client.connections,
        requests: client.requests,
        exceptions: client.exceptions,
        delayed: client.delayed,
        refused: client.refused,
    }
}

fn client_readings(client: &ClientValues) -> Vec<Reading> {
    let name = client.address.map_or_else(|| "others".to_owned(), |address| address.to_string());
    let readings = [
        gauge("modbus_client_open", "Connections open now, by client", client.open),
        counter("modbus_client_connections", "Connections, by client", client.connections),
        counter("modbus_client_requests", "Requests answered, by client", client.requests),
        counter("modbus_client_exceptions", "Exceptions answered, by client", client.exceptions),
        counter("modbus_client_delayed", "Requests that waited, by client", client.delayed),
        counter("modbus_client_refused", "Connections that were not let in, by client", client.refused),
    ];
    let labelled = |reading| Reading { labels: vec![("client", name.clone())], ..reading };
    readings.map(labelled).to_vec()
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
            "mqtt_refused",
            "Messages that the broker did not take, and that are not sent again",
            outbox.refused,
        ),
        counter(
            "mqtt_events_missed",
            "Events that left the journal before they could be read",
            outbox.events_missed,
        ),
    ];
    readings.extend(status.buffer.iter().flat_map(|buffer| buffer_readings(&buffer.store)));
    for (class, count) in outbox.dropped() {
        let labels = vec![("class", class.to_owned())];
        let help = "Messages dropped because the outbox was full, by class";
        readings.push(Reading { labels, ..counter("mqtt_dropped", help, count) });
    }
    readings
}

/// Those of Sparkplug, where it is used.
#[must_use]
pub fn sparkplug(status: &SparkplugStatus) -> Vec<Reading> {
    let report = &status.report;
    vec![
        gauge("sparkplug_connected", "The Sparkplug session is up", status.connected.into()),
        gauge("sparkplug_live", "The births are out, and values are sent as they come", status.live.into()),
        counter("sparkplug_sessions", "Sessions begun", status.sessions),
        counter("sparkplug_failures", "Attempts that failed and sessions that ended", status.failures),
        counter("sparkplug_births", "NBIRTH messages", report.births),
        counter("sparkplug_rebirths", "Of those: because a host asked", report.rebirths),
        counter("sparkplug_data", "Messages of data", report.data),
        gauge("sparkplug_history_values", "Values that are kept for later", report.held),
        counter("sparkplug_historical", "Kept values that were sent", report.historical),
        counter("sparkplug_dropped", "Kept values that left because there was no room", report.dropped),
        counter("sparkplug_commands_ignored", "Commands that were not carried out", report.ignored),
        counter("sparkplug_too_large", "Messages that were larger than a session takes", report.too_large),
    ]
}

fn buffer_readings(store: &StoreReport) -> Vec<Reading> {
    let mut readings = vec![
        gauge("mqtt_buffer_state", "0 no disk, 1 good, 2 full, 3 faulty", store.state.code()),
        gauge("mqtt_buffer_bytes", "Bytes that are kept for the broker", store.bytes),
        gauge("mqtt_buffer_bytes_limit", "Most of those bytes", store.bytes_limit),
        counter("mqtt_buffer_faults", "Times that the disk failed", store.faults),
        counter("mqtt_buffer_written_bytes", "Bytes handed to the disk", store.written),
        counter("mqtt_buffer_payload_bytes", "Bytes of messages among them", store.payload),
        counter("mqtt_buffer_syncs", "Times that the disk was told to make sure", store.syncs),
    ];
    for class in Class::ALL {
        let labels = || vec![("class", class.word().to_owned())];
        let of = |counts: [u64; 2]| counts.get(class.place()).copied().unwrap_or_default();
        let waiting =
            gauge("mqtt_buffer_waiting", "Messages that are kept for the broker", of(store.records));
        let dropped = counter(
            "mqtt_buffer_dropped",
            "Messages dropped for want of room, or too old",
            of(store.dropped),
        );
        let damaged = counter("mqtt_buffer_damaged", "Messages that the disk damaged", of(store.damaged));
        readings.extend([waiting, dropped, damaged].map(|reading| Reading { labels: labels(), ..reading }));
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
        let without = program_health(Vec::new(), &modbus, &[], None, &[], &[(Door::Web, 3)]);
        assert_eq!(value(&without, "commands_refused"), Some(3.0));
        assert_eq!(
            (value(&without, "modbus_requests"), value(&without, "mqtt_connected")),
            (Some(7.0), None)
        );
        let status = MqttStatus { connected: true, ..MqttStatus::default() };
        let with = program_health(Vec::new(), &modbus, &[], Some(&status), &[], &[]);
        assert_eq!(value(&with, "mqtt_sessions"), Some(0.0));
        assert!(with.mqtt.unwrap().connected);
    }
}
