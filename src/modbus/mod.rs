//! Modbus TCP: the process image as registers and bits (MODBUS Application Protocol V1.1b3).
//!
//! What stands where, pure:
//! - [`settings`]: the `[modbus]` table of the configuration.
//! - [`node_block`], [`gateway_block`], [`event_ring`]: the fixed blocks, each with what its registers mean. [`line_text`]: serial lines.
//! - [`register_map`]: which unit and address shows what; built once from the tag table, immutable.
//!   [`map_text`] writes it for people and programs, [`map_st`] for PLC projects; `map diff`.
//!   [`address_space`] is the part that is the same for registers and bits, [`points`] the list for people.
//! - [`register_bank`]: reads registers out of the process image. [`encoding`]: values as registers.
//!
//! How it is asked for, pure:
//! - [`frame`]: the MBAP header. [`pdu`]: requests; every length is checked before it is used.
//! - [`caller`]: who asks, and what it may ask.
//! - [`writing`]: what a write asks for. [`command_block`]: registers that give commands.
//! - [`general_reference`]: FC 43/13, objects of nodes. [`identification`]: FC 43/14. [`service`]: from a request to its answer.
//!
//! On the network:
//! - [`server`] \[IO\]: listens. [`connection`] \[IO\]: one client. [`writers`] \[IO\]: those who may write.
//! - [`rtu`]: the same on serial lines. [`security`]: the same with certificates.
//! - [`counters`]: what happened. [`accounts`]: what each client asked.

pub mod accounts;
pub mod address_space;
pub mod caller;
pub mod command_block;
pub mod connection;
pub mod counters;
pub mod encoding;
pub mod event_ring;
#[cfg(test)]
mod fixture;
pub mod frame;
pub mod gateway_block;
pub mod general_reference;
pub mod heartbeat;
pub mod identification;
pub mod line_text;
pub mod map_st;
pub mod map_text;
pub mod node_block;
pub mod pdu;
pub mod points;
pub mod register_bank;
pub mod register_map;
pub mod rtu;
pub mod security;
pub mod server;
pub mod service;
pub mod settings;
mod source;
pub mod writers;
pub mod writing;

pub use accounts::{Accounts, ClientValues};
pub use counters::{CounterValues, Counters, End};
pub use map_text::{MapDiff, MapFormat};
pub use points::{MapDocument, Point, Table};
pub use register_bank::RegisterBank;
pub use register_map::{MapError, RegisterMap};
pub use security::SecuritySettings;
pub use server::{Lines, Plain, SecureServer, SecurityError, Server};
pub use settings::{ModbusSettings, ObjectAccess, SettingsError, WordOrder};
