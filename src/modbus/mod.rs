//! Modbus TCP: the process image as registers and bits (MODBUS Application Protocol V1.1b3).
//!
//! - [`settings`]: the `[modbus]` table of the configuration.
//! - `register_map`: which address shows what; built once from the tag table, immutable.
//! - `register_bank`: reads registers out of the process image.
//! - `pdu`: requests and replies, pure; every length is checked before it is used.
//! - `server` \[IO\]: connections.

pub mod settings;

pub use settings::{ModbusSettings, SettingsError, WordOrder};
