//! What a network wants done, in order, until its caller fetches it.

use std::collections::VecDeque;

use super::event::{ModuleEvent, ModuleIndex, NetworkOutput};
use crate::can::CanFrame;

/// More than one call can produce: all jobs of all channels of a bus that goes down. Reached only if the caller does not
/// drain; what comes after that is dropped.
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

    /// The outputs of one module.
    pub(super) fn of(&mut self, module: usize) -> Teller<'_> {
        Teller { module: ModuleIndex(module), outputs: self }
    }

    /// A frame is to be sent.
    pub(super) fn transmit(&mut self, frame: CanFrame) {
        self.push(NetworkOutput::Transmit(frame));
    }

    /// The oldest.
    pub(super) fn pop(&mut self) -> Option<NetworkOutput> {
        self.queue.pop_front()
    }

    /// One more.
    pub(super) fn push(&mut self, output: NetworkOutput) {
        if self.queue.len() < LIMIT {
            self.queue.push_back(output);
        }
    }
}

/// Tells of one module.
#[derive(Debug)]
pub(super) struct Teller<'a> {
    module: ModuleIndex,
    outputs: &'a mut Outputs,
}

impl Teller<'_> {
    /// Something happened to it.
    pub(super) fn tell(&mut self, event: ModuleEvent) {
        self.outputs.push(NetworkOutput::Module(self.module, event));
    }

    /// A frame for it.
    pub(super) fn transmit(&mut self, frame: CanFrame) {
        self.outputs.transmit(frame);
    }
}
