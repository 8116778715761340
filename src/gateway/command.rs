//! What a northbound can ask for. Checked here, whoever asks; written to the journal, whatever comes of it.
//!
//! - [`desk`] \[IO\]: where northbounds hand in their requests.

pub mod desk;

use std::time::Duration;

pub use crate::canopen::NmtRequest;
pub use crate::canopen::object::ObjectId;
pub use crate::canopen::sdo::AbortCode;
use crate::process_image::{AlarmIndex, NodeIndex, TagIndex, Value};
pub use desk::Desk;

/// A request.
#[derive(Clone, Debug, PartialEq)]
pub struct Command {
    /// Chosen by the asker; comes back with the reply.
    pub id: u64,
    /// Who asks, for the journal.
    pub source: CommandSource,
    /// What for.
    pub action: Action,
}

/// Who asks.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum CommandSource {
    /// A Modbus client, by its address.
    Modbus(String),
    /// An MQTT topic.
    Mqtt(String),
    /// A user of the page or the HTTP interface.
    Web(String),
    /// A client of the CiA 309-3 gateway, by its address.
    Cia309(String),
}

/// What is asked for.
#[derive(Clone, Debug, PartialEq)]
pub enum Action {
    /// An NMT command to one node.
    Nmt {
        /// The node.
        node: NodeIndex,
        /// The command.
        request: NmtRequest,
    },
    /// A value for a tag that stands in an RPDO. Done means that it was taken: it is in a frame that the bus took, or is
    /// sent as soon as the inhibit time, SYNC, or the other values of its RPDO allow.
    WriteTag {
        /// The tag.
        tag: TagIndex,
        /// What it is to be, in engineering units.
        value: Value,
    },
    /// One alarm was seen by an operator.
    Acknowledge {
        /// The alarm.
        alarm: AlarmIndex,
    },
    /// All alarms, of one node or of all.
    AcknowledgeAll {
        /// The node; `None` = every alarm of the gateway.
        node: Option<NodeIndex>,
    },
    /// A latched, acknowledged alarm is reset.
    Reset {
        /// The alarm.
        alarm: AlarmIndex,
    },
    /// An object of a node is read by SDO. Answered with [`Outcome::Read`] when the node has answered; not journalled unless
    /// it fails, as it changes nothing.
    SdoRead {
        /// The node.
        node: NodeIndex,
        /// Which object.
        object: ObjectId,
        /// How many bytes it has, where the asker knows: some devices do not say how many of four bytes count.
        len: Option<usize>,
        /// How long the node may take for each answer; `None` = as the gateway's own requests.
        timeout: Option<Duration>,
    },
    /// An object of a node is written by SDO, once. Answered with [`Outcome::Done`] when the node has confirmed it.
    SdoWrite {
        /// The node.
        node: NodeIndex,
        /// Which object.
        object: ObjectId,
        /// Its bytes, little-endian as its type has them.
        data: Vec<u8>,
        /// As for `SdoRead`.
        timeout: Option<Duration>,
    },
}

/// What came of it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Outcome {
    /// Done.
    Done,
    /// There is no such node, tag or alarm.
    Unknown,
    /// Not allowed, or out of range; why.
    Rejected(String),
    /// A queue is full.
    Busy,
    /// The node cannot take it now.
    NodeUnavailable,
    /// The object was read: its bytes, little-endian.
    Read(Vec<u8>),
    /// The node refused the transfer.
    Aborted(AbortCode),
    /// The node did not answer in time. A write may have been done or not.
    Timeout,
    /// The transfer broke off for another reason; which. A write may have been done or not.
    Failed(String),
}
