//! What is asked of an SDO client, and what it gives back. Plain data.

use std::time::Duration;

use super::SdoError;
use crate::can::CanFrame;
use crate::canopen::object::ObjectId;

/// Names a transfer between its request and its result. The caller chooses it; the client does not look at it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct TransferId(pub u64);

/// How a client behaves.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SdoSettings {
    /// How long an answer may take (`sdo_timeout_ms`, R-DST-073).
    pub timeout: Duration,
    /// How often an unanswered request is repeated: reads, and writes that are declared idempotent. Other writes never.
    pub repeat: u32,
    /// How long the answer to a write of 0x1010 (store) or 0x1011 (restore) may take (`store_timeout_ms`).
    pub store_timeout: Duration,
    /// The most bytes that are read or written in one transfer.
    pub longest: usize,
    /// Block transfer where it is worth it and the node can do it with a check sum; else segments.
    pub block: bool,
    /// How long one transfer may take as a whole, with its repetitions.
    pub within: Duration,
}

impl Default for SdoSettings {
    fn default() -> Self {
        Self {
            timeout: Duration::from_millis(500),
            repeat: 2,
            store_timeout: Duration::from_millis(3000),
            longest: 65_536,
            block: false,
            within: Duration::from_secs(120),
        }
    }
}

/// One transfer.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct SdoRequest {
    /// Which object.
    pub object: ObjectId,
    /// Read or write.
    pub action: SdoAction,
    /// Writing it twice does no more than writing it once: the client may repeat it.
    pub idempotent: bool,
    /// Who goes first when several wait.
    pub priority: SdoPriority,
    /// How long the object is, in bytes, where the caller knows: some devices answer with four bytes without saying how
    /// many of them count.
    pub len: Option<usize>,
    /// How long each answer may take, where it is not as long as the [`SdoSettings`] say.
    pub timeout: Option<Duration>,
}

/// Read or write.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum SdoAction {
    /// Read the object (upload in the words of CiA 301).
    Read,
    /// Write these bytes into it (download), little-endian as the data type has them; may be empty.
    Write(Vec<u8>),
}

/// Who goes first. Within a priority it is first come, first served.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum SdoPriority {
    /// The boot of the node: until it is done, commands are of no use.
    Boot,
    /// Everything else: operators, tools, polling.
    #[default]
    Command,
}

impl SdoRequest {
    /// Reads an object, with the priority of a command.
    #[must_use]
    pub const fn read(object: ObjectId) -> Self {
        let (idempotent, priority) = (true, SdoPriority::Command);
        Self { object, action: SdoAction::Read, idempotent, priority, len: None, timeout: None }
    }

    /// Writes an object, once, with the priority of a command.
    #[must_use]
    pub const fn write(object: ObjectId, data: Vec<u8>) -> Self {
        let (idempotent, priority) = (false, SdoPriority::Command);
        Self { object, action: SdoAction::Write(data), idempotent, priority, len: None, timeout: None }
    }

    /// The same, before all commands that wait.
    #[must_use]
    pub fn for_boot(self) -> Self {
        Self { priority: SdoPriority::Boot, ..self }
    }

    /// The same, to be repeated when it is not answered.
    #[must_use]
    pub fn repeatable(self) -> Self {
        Self { idempotent: true, ..self }
    }

    /// The same, of an object that is known to have so many bytes.
    #[must_use]
    pub fn of_len(self, len: usize) -> Self {
        Self { len: Some(len), ..self }
    }
}

/// Why a request was not taken. Nothing was sent, and no [`SdoOutput::Done`] will follow.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum Refused {
    /// As many requests of this priority wait already as may.
    #[error("{limit} SDO requests wait for this node already; try again when one is done")]
    QueueFull {
        /// How many may wait.
        limit: usize,
    },
    /// More bytes to write than the client takes.
    #[error("{len} bytes are too long to write: at most {longest}")]
    TooLong {
        /// What was to be written, in bytes.
        len: usize,
        /// The bound in bytes.
        longest: usize,
    },
    /// The bus is down.
    #[error("the bus cannot be used")]
    BusUnavailable,
}

/// What a client wants done, or tells.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum SdoOutput {
    /// Send this frame.
    Transmit(CanFrame),
    /// A transfer is over: the bytes that were read (none after a write), or why it failed.
    Done(TransferId, Result<Vec<u8>, SdoError>),
}

/// What a client counted since it began.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct SdoCounters {
    /// Transfers that ended well.
    pub succeeded: u64,
    /// Transfers that failed, for whatever reason.
    pub failed: u64,
    /// Requests that were not answered in time, repeated or not.
    pub timeouts: u64,
    /// Answers to nothing that was asked, or too late: another client, or a slow node.
    pub unasked: u64,
    /// The same answer once more.
    pub duplicates: u64,
    /// Answers that are no SDO frames: not 8 bytes.
    pub malformed: u64,
}
