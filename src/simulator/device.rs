//! What a simulated device is to whoever puts it on a bus: the task, and the tests. Pure.

use std::fmt;
use std::time::Duration;

use super::scenario::Scenario;
use crate::can::{CanFrame, CanId};
use crate::canopen::{NmtState, NodeId};
use crate::time::{Instant, Now};

/// A device on a bus, with its plant behind it and its story. It has the four verbs of everything that lives in time.
pub trait Device: Send {
    /// Its node id; it can change while the device runs.
    fn node(&self) -> NodeId;

    /// What an operator would see.
    fn status(&self) -> Status;

    /// Whether frames of this identifier concern it. What does not need not be handed to it.
    fn hears(&self, id: CanId) -> bool;

    /// Takes a frame that another participant sent.
    fn handle_frame(&mut self, now: Now, frame: &CanFrame);

    /// Takes an order.
    ///
    /// # Errors
    /// It is not understood, or would do nothing here; the text says why. Nothing was done then.
    fn handle_line(&mut self, now: Now, words: &[&str]) -> Result<(), String>;

    /// What became due.
    fn handle_timeout(&mut self, now: Now);

    /// The next frame to send; call until `None`.
    fn poll_output(&mut self) -> Option<CanFrame>;

    /// When `handle_timeout` is to be called at the latest.
    fn poll_timeout(&self) -> Option<Instant>;
}

/// A device that is to be simulated.
#[derive(Clone, Debug, PartialEq)]
pub struct DevicePlan {
    /// Its node id.
    pub node: NodeId,
    /// What it is like and what happens to it.
    pub scenario: Scenario,
    /// Equal seeds behave alike.
    pub seed: u64,
    /// The story begins so long after power-on.
    pub story_after: Duration,
}

impl DevicePlan {
    /// A device whose story begins at once.
    #[must_use]
    pub fn new(node: NodeId, scenario: Scenario) -> Self {
        Self { node, scenario, seed: u64::from(node.get()), story_after: Duration::ZERO }
    }
}

/// What an operator would see of a device.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Status {
    /// `None` = powered off.
    pub state: Option<NmtState>,
    /// What is remarkable about it, in words.
    pub remarks: Vec<String>,
}

impl Status {
    /// Whether this is among the remarks.
    #[must_use]
    pub fn says(&self, remark: &str) -> bool {
        self.remarks.iter().any(|said| said == remark)
    }
}

impl fmt::Display for Status {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.state.map_or("off", NmtState::word))?;
        self.remarks.iter().try_for_each(|remark| write!(f, ", {remark}"))
    }
}
