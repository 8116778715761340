//! SDO client (CiA 301, 7.2.4): reads and writes the objects of one node, expedited, in segments or in blocks.
//!
//! [`SdoClient`] is for one node and does one transfer at a time, as an SDO server can do no more; what else is asked
//! waits in a short queue. It has the four verbs of this crate. Every request that it takes ends with one
//! [`SdoOutput::Done`], in bounded time.
//!
//! Not here: whether a node is in a state in which it answers (not in Stopped, R-DST-071), and what the bytes mean.
//!
//! - `codec`: frames, and their identifiers ([`request_id`], [`answer_id`]). [`AbortCode`]: why a transfer was aborted.
//! - `transfer`, `block`: one transfer from frame to frame, without time.
//! - `client`: the queue, time limits and repetitions.
//!
//! # Never the wrong answer
//!
//! An SDO answer does not say which request it answers: the first one names the object, segments have one toggle bit,
//! blocks a number. What the client relies on is that a CAN bus delivers the frames of one identifier from one node in
//! the order in which they were sent; and that a server answers its requests in order.
//!
//! - *An answer that comes late* must not pass for that to the next request. After a time-out the client aborts, and for
//!   as long again as it had waited it begins nothing and takes nothing. An answer is therefore mistaken only if it
//!   takes more than twice the time-out. A read whose first request is not answered is repeated at once without that
//!   pause: whichever answer comes first was given after the read began. If then answers are still missing at its end,
//!   the pause comes there.
//! - *A frame that arrives twice* (a CAN controller repeats a frame whose very last bit was disturbed; a tunnel may do so
//!   as well) follows its original before any other frame of the node. One copy is recognised and ignored in each
//!   place; a second is a toggle error. As the copy of a last answer would fit the next transfer of the same object,
//!   that begins 20 ms later.
//! - *Another client of the same server* may get answers while we wait for ours: those for other objects are counted and
//!   ignored. Between our segments its request ends our transfer in the server; the client sees that from the answer,
//!   and begins again or says so. A copy of our request from elsewhere cannot be told from ours.
//! - *Blocks* are read and written only with a check sum, as without any frame with the right first byte would pass for a
//!   segment.
//! - *Writes are not repeated* unless the request allows it, or the request did not leave our own interface.
//!
//! # Bounds
//!
//! Eight requests wait for each priority; no more memory than [`SdoSettings::longest`] for one transfer, whatever the
//! server announces; no transfer longer than [`SdoSettings::within`].

mod abort;
mod block;
mod client;
mod codec;
mod error;
mod request;
mod transfer;

pub use abort::AbortCode;
pub use client::SdoClient;
pub use codec::{answer_id, request_id};
pub use error::{ProtocolError, SdoError};
pub use request::{
    Refused, SdoAction, SdoCounters, SdoOutput, SdoPriority, SdoRequest, SdoSettings, TransferId,
};

#[cfg(test)]
mod tests;
