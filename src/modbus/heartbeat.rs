//! Counters that go up by one per second while all is well: the cheapest watchdog that a PLC can have.

use std::sync::atomic::{AtomicU16, Ordering};
use std::time::Duration;

use super::node_block::NodeView;
use crate::mapping::TagTable;
use crate::process_image::{NodeIndex, ProcessImage};
use crate::time::Now;

/// The core writes the image every second; when it has not for this long, it has stopped or cannot keep up.
const CORE_SILENT: Duration = Duration::from_secs(3);

/// One counter for each node and one for the gateway, modulo 65,536.
#[derive(Debug)]
pub struct Heartbeats {
    gateway: AtomicU16,
    nodes: Vec<AtomicU16>,
}

impl Heartbeats {
    /// All at 0.
    #[must_use]
    pub fn new(nodes: usize) -> Self {
        Self { gateway: AtomicU16::new(0), nodes: (0..nodes).map(|_| AtomicU16::new(0)).collect() }
    }

    /// Goes on where another's counters stood: `from` tells for each node its place there, where it has one.
    pub fn go_on_from(&self, old: &Self, from: &[Option<NodeIndex>]) {
        self.gateway.store(old.gateway(), Ordering::Relaxed);
        for (counter, from) in self.nodes.iter().zip(from) {
            counter.store(from.map_or(0, |from| old.node(from)), Ordering::Relaxed);
        }
    }

    /// To be called once a second: counts the gateway while its core runs, and each node whose data is processed and
    /// fresh.
    pub fn tick(&self, table: &TagTable, image: &ProcessImage, now: Now) {
        if now.instant.since(image.written_at) <= CORE_SILENT {
            self.gateway.fetch_add(1, Ordering::Relaxed);
        }
        for (index, counter) in self.nodes.iter().enumerate() {
            let node = NodeView::new(table, image, NodeIndex(index), now);
            if node.is_some_and(|node| node.is_fresh()) {
                counter.fetch_add(1, Ordering::Relaxed);
            }
        }
    }

    /// The gateway's.
    #[must_use]
    pub fn gateway(&self) -> u16 {
        self.gateway.load(Ordering::Relaxed)
    }

    /// A node's.
    #[must_use]
    pub fn node(&self, node: NodeIndex) -> u16 {
        self.nodes.get(node.0).map_or(0, |counter| counter.load(Ordering::Relaxed))
    }
}
