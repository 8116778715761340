//! How long the store lasts, and how much room so many hours need, pure: from the configured nodes, before anything runs.

use std::time::Duration;

use crate::mapping::codec::scale;
use crate::mapping::{Derived, Field, FieldKind, NodeDef, Scale, Source, TagDef, TagTable};
use crate::process_image::{NodeIndex, ProcessImage, Quality, Sample, Value};
use crate::store::record::stored_size;

use super::buffer::body;
use super::payload::{self, Stamp};
use super::settings::MqttSettings;
use super::topics::Topics;

/// Bytes of an event on disk: name of its node, texts and all.
const EVENT: f64 = 420.0;

/// How much happens.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Load {
    /// Every node changes all the time, with the longest values: a state every `history_interval_ms`; an event a second.
    Worst,
    /// Every node changes every three seconds, or as often as is kept where that is less; an event a minute.
    Typical,
    /// Nothing changes: every node publishes as often as it must; an event an hour.
    Quiet,
}

impl Load {
    /// All of them, the heaviest first.
    pub const ALL: [Self; 3] = [Self::Worst, Self::Typical, Self::Quiet];

    /// The word in tables.
    #[must_use]
    pub fn word(self) -> &'static str {
        match self {
            Self::Worst => "worst case",
            Self::Typical => "typical",
            Self::Quiet => "quiet",
        }
    }

    fn events_per_hour(self) -> f64 {
        match self {
            Self::Worst => 3600.0,
            Self::Typical => 60.0,
            Self::Quiet => 1.0,
        }
    }
}

/// What a node takes.
#[derive(Clone, Debug, PartialEq)]
pub struct NodePlan {
    /// Its name.
    pub name: String,
    /// By [`Load::ALL`]: bytes of a state on disk, and states in an hour.
    pub loads: [(usize, f64); 3],
}

/// What all of them take.
#[derive(Clone, Debug, PartialEq)]
pub struct Plan {
    /// The nodes that publish.
    pub nodes: Vec<NodePlan>,
    /// By [`Load::ALL`]: bytes in an hour, events among them.
    pub bytes_per_hour: [f64; 3],
}

impl Plan {
    /// Of these nodes.
    #[must_use]
    pub fn new(table: &TagTable, settings: &MqttSettings) -> Self {
        let topics = Topics::new(settings.base_topic.as_str(), table);
        let kept = Duration::from_millis(settings.history_interval_ms.into());
        let mut nodes = Vec::new();
        for (place, (def, topics)) in table.nodes.iter().zip(&topics.nodes).enumerate() {
            let loads = Load::ALL.map(|load| {
                let image = image(table, load);
                (bytes_of(table, &image, NodeIndex(place), &topics.state), states_per_hour(def, load, kept))
            });
            nodes.push(NodePlan { name: def.name.clone(), loads });
        }
        let of = |place: usize, load: Load| {
            let states = nodes.iter().filter_map(|node| node.loads.get(place));
            states.map(|(bytes, states)| as_f64(*bytes) * states).sum::<f64>()
                + load.events_per_hour() * EVENT
        };
        let [worst, typical, quiet] = Load::ALL;
        let bytes_per_hour = [of(0, worst), of(1, typical), of(2, quiet)];
        Self { nodes, bytes_per_hour }
    }

    /// By [`Load::ALL`]: how many hours so many bytes last. The store lets go of whole segments: one of 32 is always short.
    #[must_use]
    pub fn hours(&self, bytes: u64) -> [f64; 3] {
        #[expect(clippy::as_conversions, clippy::cast_precision_loss, reason = "a plan needs no 53 bits")]
        let usable = bytes as f64 - (bytes as f64 / 32.0).min(4.0 * 1024.0 * 1024.0);
        self.bytes_per_hour.map(|rate| usable / rate)
    }

    /// By [`Load::ALL`]: how many bytes so many hours need.
    #[must_use]
    pub fn bytes(&self, hours: f64) -> [f64; 3] {
        self.bytes_per_hour.map(|rate| {
            let used = rate * hours;
            used + (used / 31.0).min(4.0 * 1024.0 * 1024.0)
        })
    }
}

fn states_per_hour(def: &NodeDef, load: Load, kept: Duration) -> f64 {
    let publish = &def.publish;
    let interval = match load {
        Load::Worst if publish.fast_while.is_some() => publish.fast_interval.min(publish.min_interval),
        Load::Worst => publish.min_interval,
        Load::Typical => publish.min_interval.max(Duration::from_secs(3)),
        Load::Quiet => publish.max_interval,
    };
    3600.0 / interval.min(publish.max_interval).max(kept).as_secs_f64().max(0.001)
}

fn bytes_of(table: &TagTable, image: &ProcessImage, node: NodeIndex, topic: &str) -> usize {
    let mut state = String::new();
    let stamp = Stamp { sid: "01234567-89ab-cdef-0123-456789abcdef", seq: 1_000_000 };
    payload::state(&mut state, table, image, node, stamp);
    // "/history" is longer than "/state" by two.
    stored_size(&body(topic, &payload::historical(&state))) + 2
}

/// An image in which every value is there; no two numbers are alike, or deflating would seem to win more than it does.
fn image(table: &TagTable, load: Load) -> ProcessImage {
    let mut image = ProcessImage::new(table.tags.len(), table.nodes.len(), table.buses.len(), 0);
    for node in &mut image.nodes {
        node.nmt = Some(crate::process_image::NmtState::PreOperational);
        node.newest_data = Some(crate::time::Timestamp::from_millis(1_763_760_000_123));
    }
    let mut random = fastrand::Rng::with_seed(1);
    for (shown, tag) in image.tags.iter_mut().zip(&table.tags) {
        let value = value(tag, load, &mut random);
        let received_at = Some(crate::time::Instant::START);
        *shown = Sample { raw: value, value, quality: Quality::Good, received_at, ..Sample::NEVER };
    }
    image
}

/// A value as wide as values of that load are.
fn value(tag: &TagDef, load: Load, random: &mut fastrand::Rng) -> Value {
    let wide = Value::Float(-10_000.0 - 80_000.0 * random.f64());
    let usual = Value::Float(1000.0 * random.f64());
    let raised = Value::Bool(load == Load::Worst && random.bool());
    let mut number = |field: &Field, by: &Scale| {
        let bits = u64::MAX >> (64 - u32::from(field.width.clamp(1, 64)));
        let raw = match (field.kind, load) {
            (FieldKind::Bool, _) => raised,
            (FieldKind::Float, Load::Worst) => wide,
            (FieldKind::Float, _) => usual,
            (FieldKind::Unsigned | FieldKind::Signed, Load::Worst) => {
                Value::Unsigned(random.u64(bits - bits / 2..=bits))
            }
            (FieldKind::Unsigned | FieldKind::Signed, _) => Value::Unsigned(random.u64(0..=bits / 3)),
        };
        scale(by, raw)
    };
    match &tag.source {
        Source::Pdo { field, scale, .. }
        | Source::Polled { field, scale, .. }
        | Source::Adopted { field, scale, .. }
        | Source::Emergency { field, scale, .. }
        | Source::Rpdo { field, scale, .. }
        | Source::Module { field, scale, .. } => number(field, scale),
        Source::Derived(Derived::Bit { .. } | Derived::Logic { .. }) => raised,
        Source::Derived(_) => match load {
            Load::Worst => wide,
            Load::Typical | Load::Quiet => usual,
        },
    }
}

#[expect(clippy::as_conversions, clippy::cast_precision_loss, reason = "a plan needs no 53 bits")]
fn as_f64(bytes: usize) -> f64 {
    bytes as f64
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mapping::Sketch;

    #[test]
    fn what_hours_need_lasts_those_hours_and_a_longer_interval_lasts_longer() {
        let table = Sketch::new().node("engine", 1, "motortech-detcon", |_| ()).build().unwrap().0;
        let plan = Plan::new(&table, &MqttSettings::default());
        let [worst, typical, quiet] = plan.hours(1 << 30);
        assert!(worst < typical && typical < quiet, "{worst} {typical} {quiet}");
        for (place, bytes) in plan.bytes(1000.0).into_iter().enumerate() {
            let bytes = format!("{bytes:.0}").parse().unwrap();
            let hours = plan.hours(bytes)[place];
            assert!((hours / 1000.0 - 1.0).abs() < 0.01, "{hours}");
        }
        let slow = MqttSettings { history_interval_ms: 10_000, ..MqttSettings::default() };
        let [slow, slow_typical, _] = Plan::new(&table, &slow).hours(1 << 30);
        // Events, one a second in the worst case, take as much as they did.
        assert!(
            slow / worst > 2.0 && slow_typical / typical > 3.0,
            "{slow} {worst} {slow_typical} {typical}"
        );
    }
}
