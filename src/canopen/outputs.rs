//! What a network wants done, in order, until its caller fetches it.

use std::collections::VecDeque;

use super::{ForeignEvent, NetworkOutput, NodeEvent, NodeId};
use crate::can::CanFrame;

/// More than one call can produce on a full bus of 127 nodes. Reached only if the caller does not drain; what comes
/// after that is dropped.
const LIMIT: usize = 16_384;

/// The queue behind `poll_output`.
#[derive(Debug)]
pub(super) struct Outputs {
    queue: VecDeque<NetworkOutput>,
}

impl Outputs {
    /// Empty, with room for what one frame causes.
    pub(super) fn new() -> Self {
        Self { queue: VecDeque::with_capacity(64) }
    }

    /// Something happened to a node.
    pub(super) fn node(&mut self, node: NodeId, event: NodeEvent) {
        self.push(NetworkOutput::Node(node, event));
    }

    /// Something happened beside the nodes.
    pub(super) fn foreign(&mut self, event: ForeignEvent) {
        self.push(NetworkOutput::Foreign(event));
    }

    /// A frame is to be sent.
    pub(super) fn transmit(&mut self, frame: CanFrame) {
        self.push(NetworkOutput::Transmit(frame));
    }

    /// The oldest.
    pub(super) fn pop(&mut self) -> Option<NetworkOutput> {
        self.queue.pop_front()
    }

    fn push(&mut self, output: NetworkOutput) {
        if self.queue.len() < LIMIT {
            self.queue.push_back(output);
        }
    }
}
