//! Modbus RTU: the same registers on a serial line (MODBUS over Serial Line V1.02, 2.5.1).
//!
//! - [`settings`]: the `[[modbus.rtu]]` tables.
//! - [`receiver`]: frames in a stream of bytes, pure.
//! - `line` \[IO\]: answers what comes on one line.

pub mod line;
pub mod receiver;
pub mod settings;

pub use receiver::{Receiver, Request};
pub use settings::{Parity, RtuSettings};
