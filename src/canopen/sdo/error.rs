//! Why an SDO transfer failed.

use std::time::Duration;

use super::AbortCode;

/// Why a transfer failed. After a failed write the object may have been written or not, unless the text says otherwise.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum SdoError {
    /// The node did not answer (R-DST-073).
    #[error(
        "no answer within {} ms, {requests} request(s) sent: is the node there, and in a state in which it takes SDO?",
        after.as_millis()
    )]
    Timeout {
        /// How long each request waited.
        after: Duration,
        /// How often the transfer was begun.
        requests: u32,
    },
    /// The node refused, with this code.
    #[error("the node aborted: {0}")]
    Abort(AbortCode),
    /// The node answered what CiA 301 does not allow.
    #[error("the node does not keep to the SDO protocol: {0}")]
    Protocol(ProtocolError),
    /// Another client began a transfer on the same channel, which ends ours.
    #[error("another SDO client of the same node came between; only one can transfer at a time")]
    Interrupted,
    /// The bus is down, or did not take the request.
    #[error("the bus cannot be used")]
    BusUnavailable,
    /// The object is longer than the client takes ([`SdoSettings::longest`](super::SdoSettings::longest)).
    #[error("the object is longer than {longest} bytes, the most that is read")]
    TooLong {
        /// The bound in bytes.
        longest: usize,
    },
    /// The transfer as a whole took too long, though the node kept answering.
    #[error("the transfer was not finished within {} s", within.as_secs())]
    TooSlow {
        /// The bound.
        within: Duration,
    },
}

/// What was wrong with an answer.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum ProtocolError {
    /// The toggle bit of a segment did not alternate.
    #[error("the toggle bit did not alternate")]
    Toggle,
    /// The first byte is none that may come here.
    #[error("unexpected command byte 0x{0:02X}")]
    Command(u8),
    /// The received bytes are not as many as were announced.
    #[error("{received} bytes came where {announced} were announced")]
    Size {
        /// From the first answer.
        announced: u32,
        /// What came, at least.
        received: usize,
    },
    /// A segment that is not the last was empty.
    #[error("an empty segment that is not the last")]
    EmptySegment,
    /// A block size outside 1..=127.
    #[error("block size {0}, where 1 to 127 is allowed")]
    BlockSize(u8),
    /// An acknowledged sequence number that was never sent.
    #[error("segment {acknowledged} acknowledged where {sent} were sent")]
    Sequence {
        /// By the node.
        acknowledged: u8,
        /// By us.
        sent: u8,
    },
    /// The check sum of a block transfer differs.
    #[error("the check sum differs")]
    Crc,
    /// Block segments got lost over and over at the same place.
    #[error("the same segments were lost again and again")]
    NoProgress,
}
