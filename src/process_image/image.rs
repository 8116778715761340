//! The process image: the last value of every tag and the state of every node, bus and alarm.

use std::collections::BTreeMap;

use super::{
    AlarmIndex, AlarmStatus, BusStatus, Journal, NodeIndex, NodeStatus, Quality, Sample, SerialLine, TagIndex,
};
use crate::time::Instant;

/// Counts up with every change of the image. A reader remembers the last one it has seen.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Revision(pub u64);

/// Everything that a northbound can read, at one moment.
///
/// Written by one task only, under one lock for all that belongs together: one TPDO is one `apply`, so that a
/// reader never sees half of it.
#[derive(Clone, Debug, Default)]
pub struct ProcessImage {
    /// Revision of the newest change.
    pub revision: Revision,
    /// By [`TagIndex`].
    pub tags: Vec<Sample>,
    /// Units that devices told, of the tags that are shown in the device's own unit.
    pub units: BTreeMap<TagIndex, String>,
    /// By [`NodeIndex`].
    pub nodes: Vec<NodeStatus>,
    /// By place in the configuration.
    pub buses: Vec<BusStatus>,
    /// By [`AlarmIndex`].
    pub alarms: Vec<AlarmStatus>,
    /// By [`LineIndex`](super::LineIndex).
    pub lines: Vec<SerialLine>,
    /// The last events.
    pub journal: Journal,
    /// Whether the MQTT session is up; written by the supervisor's health reports.
    pub mqtt_connected: bool,
    /// Whether the wall clock is synchronised.
    pub clock_synchronised: bool,
    /// When the gateway task wrote last, change or not: a sign of life, at least once a second.
    pub written_at: Instant,
}

impl ProcessImage {
    /// An image in which nothing was ever received.
    #[must_use]
    pub fn new(tags: usize, nodes: usize, buses: usize, alarms: usize) -> Self {
        Self {
            revision: Revision::default(),
            tags: vec![Sample::NEVER; tags],
            units: BTreeMap::new(),
            nodes: vec![NodeStatus::default(); nodes],
            buses: vec![BusStatus::default(); buses],
            alarms: vec![AlarmStatus::default(); alarms],
            lines: Vec::new(),
            journal: Journal::new(),
            mqtt_connected: false,
            clock_synchronised: false,
            written_at: Instant::START,
        }
    }

    /// A tag's sample; one that was never received where there is no such tag.
    #[must_use]
    pub fn tag(&self, tag: TagIndex) -> &Sample {
        self.tags.get(tag.0).unwrap_or(&Sample::NEVER)
    }

    /// A node's status.
    #[must_use]
    pub fn node(&self, node: NodeIndex) -> Option<&NodeStatus> {
        self.nodes.get(node.0)
    }

    /// An alarm's status.
    #[must_use]
    pub fn alarm(&self, alarm: AlarmIndex) -> Option<&AlarmStatus> {
        self.alarms.get(alarm.0)
    }

    /// The worst quality of some tags; good where there are none.
    pub fn worst_quality(&self, tags: impl IntoIterator<Item = TagIndex>) -> Quality {
        tags.into_iter().map(|tag| self.tag(tag).quality).max().unwrap_or(Quality::Good)
    }
}
