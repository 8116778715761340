//! What a simulated device is to whoever puts it on a bus: the task, and the tests. Pure.

use std::fmt;
use std::str::FromStr;
use std::time::Duration;

use super::scenario::Scenario;
use crate::can::{CanFrame, CanId};
use crate::canopen::{NmtState, NodeId};
use crate::time::{Instant, Now};

/// The number by which a device is called: the node id of a CANopen device, the coding switches of an esd module. 1..=254.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct DeviceNumber(u8);

impl DeviceNumber {
    /// `None` outside 1..=254.
    #[must_use]
    pub const fn new(number: u8) -> Option<Self> {
        if number >= 1 && number <= 254 { Some(Self(number)) } else { None }
    }

    /// The number.
    #[must_use]
    pub const fn get(self) -> u8 {
        self.0
    }

    /// The node id of a CANopen device; the highest for numbers above all node ids, which `cangate sim` refuses.
    #[must_use]
    pub fn node_id(self) -> NodeId {
        NodeId::new(self.0).unwrap_or(NodeId::HIGHEST)
    }
}

impl From<NodeId> for DeviceNumber {
    fn from(node: NodeId) -> Self {
        Self(node.get())
    }
}

impl fmt::Display for DeviceNumber {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}", self.0)
    }
}

impl FromStr for DeviceNumber {
    type Err = String;

    /// Decimal, or hexadecimal behind `0x`.
    fn from_str(text: &str) -> Result<Self, String> {
        let number = match text.strip_prefix("0x") {
            Some(digits) => u8::from_str_radix(digits, 16).ok().filter(|_| !digits.starts_with('+')),
            None => text.parse().ok(),
        };
        let wrong = || format!("`{text}` is not the number of a device; give 1 to 254, or 0x01 to 0xFE");
        number.and_then(Self::new).ok_or_else(wrong)
    }
}

/// A device on a bus, with its plant behind it and its story. It has the four verbs of everything that lives in time.
pub trait Device: Send {
    /// Its number; a node id can change while the device runs.
    fn node(&self) -> DeviceNumber;

    /// How reports call it.
    fn name(&self) -> String {
        format!("node {}", self.node())
    }

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

    /// How many bytes the serial line of a channel, from 1, takes now from an end outside this program. 0 where there is no
    /// such end.
    fn serial_room(&self, _channel: u8) -> usize {
        0
    }

    /// Takes bytes that came from the outside end of a channel; no more than `serial_room` said.
    fn handle_serial(&mut self, _now: Now, _channel: u8, _bytes: &[u8]) {}

    /// Bytes that went out to the outside end of a channel; call until `None`.
    fn poll_serial(&mut self) -> Option<(u8, Vec<u8>)> {
        None
    }
}

/// A device that is to be simulated.
#[derive(Clone, Debug, PartialEq)]
pub struct DevicePlan {
    /// Its number.
    pub node: DeviceNumber,
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
    pub fn new(node: impl Into<DeviceNumber>, scenario: Scenario) -> Self {
        let node = node.into();
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
