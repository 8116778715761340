//! `/metrics` in the Prometheus text format, pure: a snapshot of the process image as families of numbers.

use std::collections::BTreeMap;
use std::fmt;

use prometheus_client::collector::Collector;
use prometheus_client::encoding::{DescriptorEncoder, EncodeMetric, MetricEncoder};
use prometheus_client::metrics::MetricType;
use prometheus_client::metrics::counter::ConstCounter;
use prometheus_client::metrics::gauge::ConstGauge;
use prometheus_client::registry::Registry;

use super::health::{ProgramHealth, Reading, ReadingKind};
use super::status::{About, quality_code};
use crate::mapping::{AlarmOwner, TagTable};
use crate::process_image::{NmtState, NodeStatus, ProcessImage, TagIndex};
use crate::time::Now;

/// Content type of the text.
pub const CONTENT_TYPE: &str = "application/openmetrics-text; version=1.0.0; charset=utf-8";

/// All numbers of one moment.
#[derive(Debug, Default)]
pub struct Metrics {
    families: BTreeMap<&'static str, Family>,
}

#[derive(Debug)]
struct Family {
    help: &'static str,
    kind: ReadingKind,
    numbers: Vec<(Vec<(&'static str, String)>, f64)>,
}

impl Metrics {
    /// Of this moment.
    #[must_use]
    pub fn new(
        table: &TagTable,
        about: &About,
        image: &ProcessImage,
        health: ProgramHealth,
        now: Now,
    ) -> Self {
        let mut metrics = Self::default();
        metrics.program(table, about, image, &health, now);
        metrics.buses(table, image);
        metrics.nodes(table, image, now);
        metrics.alarms(table, image);
        for reading in health.readings {
            metrics.add(reading);
        }
        metrics
    }

    /// As text.
    #[must_use]
    pub fn encode(self) -> String {
        let mut registry = Registry::with_prefix("cangate");
        registry.register_collector(Box::new(self));
        let mut text = String::new();
        // Writing into a string cannot fail; were it to, half a page would be worse than none.
        match prometheus_client::encoding::text::encode(&mut text, &registry) {
            Ok(()) => text,
            Err(fmt::Error) => String::new(),
        }
    }

    fn add(&mut self, reading: Reading) {
        let family = self.families.entry(reading.name).or_insert_with(|| Family {
            help: reading.help,
            kind: reading.kind,
            numbers: Vec::new(),
        });
        family.numbers.push((reading.labels, reading.value));
    }

    fn gauge(
        &mut self,
        name: &'static str,
        help: &'static str,
        labels: &[(&'static str, &str)],
        value: impl Into<f64>,
    ) {
        self.number(ReadingKind::Gauge, name, help, labels, value.into());
    }

    #[expect(clippy::as_conversions, clippy::cast_precision_loss, reason = "Prometheus counts in doubles")]
    fn counter(
        &mut self,
        name: &'static str,
        help: &'static str,
        labels: &[(&'static str, &str)],
        value: u64,
    ) {
        self.number(ReadingKind::Counter, name, help, labels, value as f64);
    }

    fn number(
        &mut self,
        kind: ReadingKind,
        name: &'static str,
        help: &'static str,
        labels: &[(&'static str, &str)],
        value: f64,
    ) {
        let labels = labels.iter().map(|(name, text)| (*name, (*text).to_owned())).collect();
        self.add(Reading { name, help, kind, labels, value });
    }

    fn program(
        &mut self,
        table: &TagTable,
        about: &About,
        image: &ProcessImage,
        health: &ProgramHealth,
        now: Now,
    ) {
        let build: &[_] = &[
            ("version", about.version.as_str()),
            ("gateway", &table.gateway),
            ("map_hash", &about.map_hash),
        ];
        self.gauge("build_info", "What this gateway is", build, 1);
        let uptime = now.instant.since(about.started.instant).as_secs_f64();
        self.gauge("uptime_seconds", "Time since the start of the program", &[], uptime);
        self.gauge("ready", "The gateway can serve", &[], u8::from(health.not_ready.is_empty()));
        let synchronised = u8::from(image.clock_synchronised);
        self.gauge("clock_synchronised", "The wall clock is synchronised", &[], synchronised);
        if let Some(mqtt) = &health.mqtt {
            self.gauge("mqtt_connected", "The MQTT session is up", &[], u8::from(mqtt.connected));
        }
        self.counter("events", "Events since the start", &[], image.journal.newest());
    }

    fn buses(&mut self, table: &TagTable, image: &ProcessImage) {
        for (def, bus) in table.buses.iter().zip(&image.buses) {
            let labels: &[_] = &[("bus", def.name.as_str())];
            let states = "State of the bus: 0 absent, 1 down, 2 bus-off, 3 error passive, 4 error active";
            self.gauge("bus_state", states, labels, bus.state.code());
            if let Some(permille) = bus.load_permille {
                let ratio = f64::from(permille) / 1000.0;
                self.gauge("bus_load_ratio", "Load of the bus over the last second", labels, ratio);
            }
            for (name, help, count) in [
                ("bus_frames_received", "Frames received", bus.frames_received),
                ("bus_frames_sent", "Frames sent", bus.frames_sent),
                ("bus_frames_not_sent", "Frames that could not be sent", bus.frames_not_sent),
                ("bus_errors", "Error frames", bus.errors),
                ("bus_off", "Times that the controller went bus-off", bus.bus_off_count),
                ("bus_overruns", "Frames that the kernel dropped", bus.overruns),
                ("bus_foreign_frames", "Frames that belong to no configured node", bus.foreign_frames),
            ] {
                self.counter(name, help, labels, count);
            }
        }
    }

    fn nodes(&mut self, table: &TagTable, image: &ProcessImage, now: Now) {
        for (def, status) in table.nodes.iter().zip(&image.nodes) {
            let labels: &[_] = &[("node", def.name.as_str())];
            self.gauge("node_online", "The node is there", labels, u8::from(status.online));
            let nmt = status.nmt.map_or(-1, |nmt| i16::from(NmtState::code(nmt)));
            let states = "NMT state: 0 boot-up, 4 stopped, 5 operational, 127 pre-operational, -1 unknown";
            self.gauge("node_nmt_state", states, labels, nmt);
            let quality = quality_code(image.worst_quality(def.tags.clone().map(TagIndex)));
            let qualities = "Worst quality of its tags: 0 good, 1 uncertain, 2 stale, 3 bad";
            self.gauge("node_quality", qualities, labels, quality);
            for pdo in &status.pdos {
                let number = pdo.number.to_string();
                let labels: &[_] = &[("node", def.name.as_str()), ("pdo", &number)];
                if let Some(received) = pdo.last_received {
                    let age = now.instant.since(received).as_secs_f64();
                    self.gauge("node_pdo_age_seconds", "Age of the newest TPDO", labels, age);
                }
                let stale = u8::from(pdo.stale);
                self.gauge("node_pdo_stale", "The TPDO did not come in time", labels, stale);
                self.counter("node_pdos_received", "TPDOs received", labels, pdo.received);
            }
            self.node_counters(labels, status);
        }
    }

    fn node_counters(&mut self, labels: &[(&'static str, &str)], status: &NodeStatus) {
        let counters = &status.counters;
        for (name, help, count) in [
            ("node_frames_received", "Frames received from the node", counters.frames_received),
            ("node_restarts", "Boot-up messages after the first contact", counters.restarts),
            ("node_guard_misses", "Guard requests without a reply in time", counters.guard_misses),
            ("node_toggle_errors", "Guard replies with the wrong toggle bit", counters.toggle_errors),
            ("node_pdo_length_errors", "TPDOs too short or too long", counters.pdo_length_errors),
            ("node_nmt_commands_sent", "NMT commands sent to the node", counters.nmt_commands_sent),
            ("node_emcys", "Emergency messages", counters.emcys),
            ("node_sdo_errors", "SDO transfers that failed", counters.sdo_errors),
            ("node_unexpected_states", "States that were not ordered", counters.unexpected_states),
            ("node_malformed_frames", "Frames that cannot be right", counters.malformed),
            ("node_reserved_bits", "Frames with a reserved bit set", counters.reserved_bits),
        ] {
            self.counter(name, help, labels, count);
        }
    }

    fn alarms(&mut self, table: &TagTable, image: &ProcessImage) {
        for (def, status) in table.alarms.iter().zip(&image.alarms) {
            let owner = match def.owner {
                AlarmOwner::Gateway => "gateway",
                AlarmOwner::Bus(bus) => table.buses.get(bus.0).map_or("bus", |bus| bus.name.as_str()),
                AlarmOwner::Node(node) => table.node(node).map_or("node", |node| node.name.as_str()),
            };
            let labels: &[_] = &[("owner", owner), ("alarm", &def.name), ("priority", def.priority.word())];
            self.gauge("alarm_active", "The alarm is active", labels, u8::from(status.state.is_active()));
            let waits = u8::from(status.state.is_unacknowledged());
            self.gauge("alarm_unacknowledged", "The alarm waits for an operator", labels, waits);
            self.counter("alarm_raised", "Times that the alarm was raised", labels, status.count);
        }
    }
}

impl Collector for Metrics {
    fn encode(&self, mut encoder: DescriptorEncoder<'_>) -> Result<(), fmt::Error> {
        for (name, family) in &self.families {
            let kind = match family.kind {
                ReadingKind::Counter => MetricType::Counter,
                ReadingKind::Gauge => MetricType::Gauge,
            };
            let mut encoder = encoder.encode_descriptor(name, family.help, None, kind)?;
            if let [(labels, number)] = family.numbers.as_slice()
                && labels.is_empty()
            {
                encode_number(family.kind, *number, encoder)?;
                continue;
            }
            for (labels, number) in &family.numbers {
                encode_number(family.kind, *number, encoder.encode_family(labels)?)?;
            }
        }
        Ok(())
    }
}

fn encode_number(kind: ReadingKind, number: f64, encoder: MetricEncoder<'_>) -> Result<(), fmt::Error> {
    match kind {
        ReadingKind::Counter => ConstCounter::new(number).encode(encoder),
        ReadingKind::Gauge => ConstGauge::new(number).encode(encoder),
    }
}
