//! What was told of an origin, the edge node or a device, and what is news. Pure.

use std::collections::BTreeMap;
use std::time::Duration;

use super::catalogue::{Datum, MetricDef, Reading};
use super::history::Kept;
use crate::mapping::NodeDef;
use crate::process_image::{ProcessImage, TagIndex};
use crate::time::{Instant, Timestamp};

/// Least time between two messages of the edge node's own data, alarms apart.
const NODE_INTERVAL: Duration = Duration::from_secs(1);

/// How an origin stands.
#[derive(Clone, Debug, Default)]
pub(super) struct Origin {
    pub(super) born: bool,
    /// Its birth is too large to be sent.
    pub(super) refused: bool,
    /// When its data were last told.
    pub(super) last: Option<Instant>,
    /// Something changed since.
    pub(super) dirty: bool,
    /// Of that: something that is told at once.
    pub(super) urgent: bool,
    /// Its device asks for the faster interval.
    pub(super) fast: bool,
    /// Units that its device told when it was born.
    pub(super) units: BTreeMap<TagIndex, String>,
}

impl Origin {
    /// When its data may be told; `node` is that of a device.
    pub(super) fn due(&self, node: Option<&NodeDef>) -> Instant {
        let interval = match node {
            _ if self.urgent => Duration::ZERO,
            Some(node) if self.fast => node.publish.fast_interval,
            Some(node) => node.publish.min_interval,
            None => NODE_INTERVAL,
        };
        self.last.map_or(Instant::START, |last| last + interval)
    }
}

/// What was last told, or kept, of a metric.
#[derive(Clone, Copy, Debug)]
pub(super) struct Told {
    pub(super) datum: Option<Datum>,
    pub(super) quality: u32,
    pub(super) at: Timestamp,
}

/// A change of a metric.
pub(super) struct Change {
    pub(super) kept: Kept,
    /// Its quality is another one than before.
    pub(super) requalified: bool,
}

/// Whether an origin is there: the edge node always is, a device while its node is.
pub(super) fn is_online(origin: usize, image: &ProcessImage) -> bool {
    origin.checked_sub(1).is_none_or(|node| image.nodes.get(node).is_some_and(|node| node.online))
}

/// Whether its device asks for the faster interval.
pub(super) fn is_fast(node: Option<&NodeDef>, image: &ProcessImage) -> bool {
    node.and_then(|node| node.publish.fast_while).is_some_and(|tag| {
        let sample = image.tag(tag);
        sample.quality.is_usable() && sample.value.is_true()
    })
}

/// Whether a reading is another one than what was told. What never had a value has none to tell.
pub(super) fn is_news(def: &MetricDef, told: Option<Told>, reading: &Reading) -> bool {
    match told {
        None => reading.datum.is_some_and(|datum| datum != Datum::Fixed),
        Some(told) => told.quality != reading.quality || def.is_news(told.datum, reading.datum),
    }
}
