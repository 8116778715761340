//! A CANopen master (CiA 301, CiA 302-2), pure: no clock, no socket, no thread.
//!
//! [`Network`] is one bus seen by its NMT master (or by a passive listener). It has four verbs, as everything in this
//! crate that lives in time: `handle_*` takes what came in, `handle_timeout` what became due, `poll_output` gives what
//! is to be done, `poll_timeout` when to come back.
//!
//! Not here: what the bytes of a PDO mean (`mapping`), alarms, values. This room knows
//! `can::frame` and `time` only and could be lifted out as a crate of its own.
//!
//! - [`cob_id`]: node ids and identifiers.
//! - [`nmt`]: states and commands.
//! - [`settings`]: what a network and its nodes are to do.
//! - [`object`]: objects of an object dictionary, and their values as text.
//! - [`sdo`]: reads and writes them; [`lss`]: gives devices node ids and bit rates.
//! - [`census`], [`probe`]: who is on a bus, by listening and by asking; for tools.
//! - [`well_known`]: names and types of the objects that CiA 301 defines.
//! - [`event`]: what a network tells.
//! - [`emcy`]: emergency messages, and the errors that they tell of.
//! - [`boot`]: what is done with a node before it is started.
//! - [`polls`]: objects that are read again and again.
//! - `guarding`, `heartbeat`, `start`, `pdo`, `rpdo`, `duplicate`: one machine each, for one node.
//! - `broadcasts`: SYNC and TIME, what is sent to everybody by the clock; `beat`: that clock.
//! - `node`: one node, made of those machines.
//! - `network`: all nodes of a bus; dispatches frames.

mod beat;
pub mod boot;
mod broadcasts;
pub mod census;
pub mod cob_id;
mod duplicate;
pub mod emcy;
pub mod event;
mod guarding;
mod heartbeat;
pub mod lss;
pub mod network;
pub mod nmt;
mod node;
pub mod object;
mod outputs;
mod pdo;
pub mod polls;
pub mod probe;
mod rpdo;
pub mod sdo;
pub mod settings;
mod start;
pub mod well_known;

pub use cob_id::NodeId;
pub use event::{ForeignEvent, NetworkOutput, NodeEvent};
pub use network::Network;
pub use nmt::{NmtRequest, NmtState};
pub use node::SdoRefused;
pub use settings::{
    ErrorControl, GuardingSettings, NetworkSettings, NodeSettings, OwnHeartbeatSettings, PdoIndex,
    PdoSettings, Role, RpdoIndex, RpdoSettings, RpdoTrigger, StartSettings, SyncSettings, TimeSettings,
    TogglePolicy,
};

#[cfg(test)]
mod tests;
