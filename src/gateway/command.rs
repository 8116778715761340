//! What a northbound can ask for. Checked here, whoever asks; written to the journal, whatever comes of it.
//!
//! - [`authority`]: on what ground a request is made, and what that allows.
//! - `refused`: requests that were refused for want of it, on their way to the journal.
//! - [`request`](mod@request): requests as JSON.
//! - [`desk`] \[IO\]: where northbounds hand in their requests.

pub mod authority;
pub mod desk;
mod refused;
pub mod request;

use std::fmt;
use std::sync::Arc;
use std::time::Duration;

pub use crate::access::{Access, Deed, Grant, PasswordHash, PasswordPlace};
pub use crate::canopen::NmtRequest;
pub use crate::canopen::object::ObjectId;
pub use crate::canopen::sdo::AbortCode;
use crate::process_image::{AlarmIndex, LineIndex, NodeIndex, TagIndex, Value};
pub use authority::Authority;
pub use desk::Desk;
pub use refused::Refused;

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

/// The way by which a request came.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Door {
    /// Modbus.
    Modbus,
    /// MQTT.
    Mqtt,
    /// The page or the HTTP interface.
    Web,
    /// The CiA 309-3 gateway.
    Cia309,
    /// The TCP port of a serial line.
    Serial,
}

impl Door {
    /// All of them.
    pub const ALL: [Self; 5] = [Self::Modbus, Self::Mqtt, Self::Web, Self::Cia309, Self::Serial];

    /// The word in journals and metrics.
    #[must_use]
    pub fn word(self) -> &'static str {
        match self {
            Self::Modbus => "modbus",
            Self::Mqtt => "mqtt",
            Self::Web => "web",
            Self::Cia309 => "cia309",
            Self::Serial => "serial",
        }
    }
}

/// Who asks. Shown as `modbus 10.0.0.5:40112 as hmi`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct CommandSource {
    /// By which way.
    pub door: Door,
    /// An address; of MQTT the topic.
    pub client: String,
    /// The `[access.NAME]` that the client is known by, where it is.
    pub access: Option<Arc<str>>,
}

impl CommandSource {
    fn new(door: Door, client: String) -> Self {
        Self { door, client, access: None }
    }

    /// A Modbus client, by its address.
    #[must_use]
    pub fn modbus(client: String) -> Self {
        Self::new(Door::Modbus, client)
    }

    /// An MQTT topic.
    #[must_use]
    pub fn mqtt(topic: String) -> Self {
        Self::new(Door::Mqtt, topic)
    }

    /// A client of the page or the HTTP interface, by its address.
    #[must_use]
    pub fn web(client: String) -> Self {
        Self::new(Door::Web, client)
    }

    /// A client of the CiA 309-3 gateway, by its address.
    #[must_use]
    pub fn cia309(client: String) -> Self {
        Self::new(Door::Cia309, client)
    }

    /// A client of the TCP port of a serial line, by its address.
    #[must_use]
    pub fn serial(client: String) -> Self {
        Self::new(Door::Serial, client)
    }

    /// Wherever on its host it asks from: each further connection has another port.
    #[must_use]
    pub fn without_port(&self) -> Self {
        let host = self.client.parse::<core::net::SocketAddr>();
        let client = host.map_or_else(|_| self.client.clone(), |address| address.ip().to_string());
        Self { client, ..self.clone() }
    }
}

impl fmt::Display for CommandSource {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} {}", self.door.word(), self.client)?;
        self.access.as_ref().map_or(Ok(()), |access| write!(f, " as {access}"))
    }
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
    /// Values for tags: all of them or none. Done means for a tag of an RPDO that it was taken: it is in a frame that the bus
    /// took, or is sent as soon as the inhibit time, SYNC, or the other values of its RPDO allow; for an object that the node
    /// has confirmed it. An object is written by itself.
    WriteTags {
        /// Each tag, and what it is to be, in engineering units.
        writes: Vec<(TagIndex, Value)>,
    },
    /// One alarm was seen by an operator.
    Acknowledge {
        /// The alarm.
        alarm: AlarmIndex,
        /// Which time it was raised, as its status counts, where the asker says so: an old screen must not acknowledge what
        /// was raised since.
        raise: Option<u64>,
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
    /// Bytes for a serial line. Answered with [`Outcome::Done`] when the last of them was handed to the bus, at the pace of
    /// the line; what several asked for is never mixed. Journalled only where it fails, or where a grant is what allows it.
    SerialSend {
        /// The line.
        line: LineIndex,
        /// At most 4096 bytes.
        bytes: Vec<u8>,
    },
    /// An object of a node is read by SDO. Answered with [`Outcome::Read`] when the node has answered; journalled where it
    /// fails, or where a grant is what allows it.
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

impl Action {
    /// Its word in the journal.
    #[must_use]
    pub fn word(&self) -> &'static str {
        match self {
            Self::Nmt { .. } => "nmt",
            Self::WriteTags { .. } => "write",
            Self::Acknowledge { .. } => "acknowledge",
            Self::AcknowledgeAll { .. } => "acknowledge_all",
            Self::Reset { .. } => "reset",
            Self::SerialSend { .. } => "serial_send",
            Self::SdoRead { .. } => "sdo_read",
            Self::SdoWrite { .. } => "sdo_write",
        }
    }
}

/// What came of it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Outcome {
    /// Done.
    Done,
    /// There is no such node, tag or alarm.
    Unknown,
    /// Out of range, or against a setting; why.
    Rejected(String),
    /// Who asks may not; why. Nothing of it reached the gateway.
    Forbidden(String),
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
