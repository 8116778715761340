//! All nodes of one bus.

use super::{NetworkOutput, NetworkSettings, NmtRequest, NodeId};
use crate::can::CanFrame;
use crate::time::{Instant, Now};

/// One bus as its NMT master, or a passive listener, sees it.
#[derive(Debug)]
pub struct Network {
    _settings: NetworkSettings,
}

impl Network {
    /// A network of which nothing is known yet. Guards every node at once, without waiting for a boot-up (R-DET-046).
    #[must_use]
    pub fn new(settings: NetworkSettings, _now: Now) -> Self {
        Self { _settings: settings }
    }

    /// Takes a frame that another node sent; `now` is its receive time.
    pub fn handle_frame(&mut self, _now: Now, _frame: &CanFrame) {}

    /// A frame of ours did not leave: what waits for its answer must not blame the node.
    pub fn handle_not_sent(&mut self, _now: Now, _frame: &CanFrame) {}

    /// The bus can be used, or cannot: while it cannot, nothing is sent and no node is blamed for silence by guarding.
    pub fn handle_link(&mut self, _now: Now, _up: bool) {}

    /// An NMT command that an operator asked for, for one node or all. `false`: the role or the node id forbids it.
    pub fn request_nmt(&mut self, _now: Now, _node: Option<NodeId>, _request: NmtRequest) -> bool {
        false
    }

    /// What became due.
    pub fn handle_timeout(&mut self, _now: Now) {}

    /// What is to be done; call until `None`.
    pub fn poll_output(&mut self) -> Option<NetworkOutput> {
        None
    }

    /// When `handle_timeout` is to be called at the latest, and why.
    #[must_use]
    pub fn poll_timeout(&self) -> Option<(Instant, &'static str)> {
        None
    }
}
