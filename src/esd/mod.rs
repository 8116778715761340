//! The esd protocol for CAN modules (revision 3.2), as a manager of modules sees it; pure: no clock, no socket, no thread.
//!
//! The CAN-CBM-SIO1 and SIO4 carry serial lines over CAN: what comes in on a line is sent in data frames on the channel's
//! `TxId`, what is sent on its `RxId` goes out on the line. They are managed by commands on the INIT-Id 0x700. That is not
//! CANopen, and this room knows nothing of that; it knows `can::frame` and `time` only.
//!
//! `Network` is all modules of one bus. It has the four verbs of everything in this crate that lives in time.
//!
//! - [`identifiers`]: module numbers and what follows from the coding switch.
//! - [`init_frame`]: commands on the INIT-Id as bytes. [`answer`]: what modules answer.
//! - [`parameters`]: user parameters: how a channel packs bytes into frames, and its serial line.
//! - [`status`]: the CAN status byte. [`bit_rate`]: bit rates as register values.
//! - [`settings`]: what a network and its modules are to do. [`event`]: what a network tells.
//! - `serial_channel`: one serial line: what is to be sent, at which `pace`, and what came in, as messages (`framing`).
//! - `procedure`: one module is found, compared with its `plan`, written and looked after, `step` by step. `watchdog`: its guarding.
//!   `module`: these and its lines together.
//! - [`network`]: all modules of a bus. `dialogue`: one request at a time, and whose an answer is.
//! - [`scan`]: which modules are there, without a network.

pub mod answer;
pub mod bit_rate;
mod dialogue;
pub mod event;
mod framing;
pub mod identifiers;
pub mod init_frame;
mod module;
pub mod network;
mod outputs;
mod pace;
pub mod parameters;
mod plan;
mod procedure;
pub mod scan;
mod serial_channel;
pub mod settings;
pub mod status;
mod step;
#[cfg(test)]
mod tests;
mod watchdog;

pub use answer::{Answer, SoftwareRevision};
pub use bit_rate::CanBitRate;
pub use event::{Cause, MessageEnd, ModuleEvent, ModuleIndex, NetworkOutput, SendOutcome, SerialChunk};
pub use identifiers::{INIT_ID, ModuleKind, ModuleNumber};
pub use init_frame::{InitCommand, Order, Request, Setting};
pub use network::{BUS_PERCENT, Network, SendRefused};
pub use parameters::{CanTxMode, LineFormat, MinChar, Parity, Rate, SerialBits, SerialMode};
pub use plan::allowed_settings;
pub use scan::{Scan, ScanOutput, ScanSettings};
pub use settings::{
    ChannelSettings, FlowControl, Framing, ManagementSettings, ModuleSettings, NetworkSettings, WatchdogMode,
    WatchdogSettings,
};
pub use status::CanStatus;
