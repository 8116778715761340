//! Modbus/TCP Security (MB-TCP-Security v36): Modbus over mutual TLS, with the client's role in its certificate.
//!
//! - [`settings`]: the `[modbus.security]` table.
//! - [`role`]: the role in a certificate, pure. [`rights`]: what a role may do, pure.
//! - [`door`] \[IO\]: from a TCP connection to one whose client is known.

pub mod door;
pub mod rights;
pub mod role;
pub mod settings;

pub use door::Door;
pub use rights::{Right, Rights};
pub use role::PeerRole;
pub use settings::SecuritySettings;
