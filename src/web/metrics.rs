//! `/metrics` in the Prometheus text format, pure: a snapshot of the process image as families of numbers.

use std::borrow::Cow;
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
use crate::process_image::{FrameKind, NmtState, NodeStatus, ProcessImage, TagIndex};
use crate::time::Now;

/// Content type of the text.
pub const CONTENT_TYPE: &str = "application/openmetrics-text; version=1.0.0; charset=utf-8";

/// All numbers of one moment.
#[derive(Debug, Default)]
pub struct Metrics {
    families: BTreeMap<Cow<'static, str>, Family>,
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
            let Reading { name, help, kind, labels, value } = reading;
            metrics.add(name.into(), (help, kind), labels, value);
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

    fn add(
        &mut self,
        name: Cow<'static, str>,
        (help, kind): (&'static str, ReadingKind),
        labels: Vec<(&'static str, String)>,
        value: f64,
    ) {
        let new = || Family { help, kind, numbers: Vec::new() };
        self.families.entry(name).or_insert_with(new).numbers.push((labels, value));
    }

    fn gauge(
        &mut self,
        name: impl Into<Cow<'static, str>>,
        help: &'static str,
        labels: &[(&'static str, &str)],
        value: impl Into<f64>,
    ) {
        self.add(name.into(), (help, ReadingKind::Gauge), owned(labels), value.into());
    }

    #[expect(clippy::as_conversions, clippy::cast_precision_loss, reason = "Prometheus counts in doubles")]
    fn counter(
        &mut self,
        name: impl Into<Cow<'static, str>>,
        help: &'static str,
        labels: &[(&'static str, &str)],
        value: u64,
    ) {
        self.add(name.into(), (help, ReadingKind::Counter), owned(labels), value as f64);
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
        for certificate in &health.certificates {
            let help = "Whole days until the first certificate of a file expires";
            let labels = vec![("file", certificate.file.clone())];
            self.add(
                "certificate_days_left".into(),
                (help, ReadingKind::Gauge),
                labels,
                days(certificate.days_left),
            );
        }
        self.counter("events", "Events since the start", &[], image.journal.recorded());
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
            for (name, help, count) in bus.named() {
                let name = if name == "bus_off_count" { "bus_off".into() } else { format!("bus_{name}") };
                self.counter(name, help, labels, count);
            }
            for kind in FrameKind::ALL {
                let labels: &[_] = &[("bus", def.name.as_str()), ("kind", kind.word())];
                let help = "Frames that the gateway handed to the bus, by kind";
                self.counter("can_frames_sent", help, labels, bus.sent.of(kind));
            }
            let blocked = "Frames that the configuration does not allow, dropped: a bug in cangate";
            self.counter("can_frames_blocked", blocked, labels, bus.frames_blocked);
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
        for (name, help, count) in status.counters.named() {
            let name =
                if name == "malformed" { "node_malformed_frames".into() } else { format!("node_{name}") };
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

#[expect(clippy::as_conversions, clippy::cast_precision_loss, reason = "Prometheus counts in doubles")]
fn days(days: i64) -> f64 {
    days as f64
}

fn owned(labels: &[(&'static str, &str)]) -> Vec<(&'static str, String)> {
    labels.iter().map(|(name, text)| (*name, (*text).to_owned())).collect()
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
