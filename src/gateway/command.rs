//! What a northbound can ask for. Checked here, whoever asks; written to the journal, whatever comes of it.

use crate::canopen::NmtRequest;
use crate::process_image::{AlarmIndex, NodeIndex, TagIndex, Value};

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
}
