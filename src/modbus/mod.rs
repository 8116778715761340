//! Modbus TCP: the process image as registers and bits (MODBUS Application Protocol V1.1b3).
//!
//! What stands where, pure:
//! - [`settings`]: the `[modbus]` table of the configuration.
//! - [`node_block`], [`gateway_block`], [`event_ring`]: the fixed blocks, each with what its registers mean.
//! - [`register_map`]: which unit and address shows what; built once from the tag table, immutable.
//!   [`map_text`] writes it for people and programs, [`map_st`] for PLC projects; `map diff`.
//!   [`address_space`] is the part that is the same for registers and bits, [`points`] the list for people.
//! - [`register_bank`]: reads registers out of the process image. [`encoding`]: values as registers.
//!
//! How it is asked for, pure:
//! - [`frame`]: the MBAP header. [`pdu`]: requests; every length is checked before it is used.
//! - [`general_reference`]: FC 43/13, objects of nodes. [`identification`]: FC 43/14. [`service`]: from a request to its answer.
//!
//! On the network:
//! - [`server`] \[IO\]: listens, accepts, limits. [`connection`] \[IO\]: one client.
//! - [`counters`]: what happened.

pub mod address_space;
pub mod connection;
pub mod counters;
pub mod encoding;
pub mod event_ring;
pub mod frame;
pub mod gateway_block;
pub mod general_reference;
pub mod heartbeat;
pub mod identification;
pub mod map_st;
pub mod map_text;
pub mod node_block;
pub mod pdu;
pub mod points;
pub mod register_bank;
pub mod register_map;
pub mod server;
pub mod service;
pub mod settings;
mod source;

pub use counters::{CounterValues, Counters, End};
pub use map_text::{MapDiff, MapFormat};
pub use points::{MapDocument, Point, Table};
pub use register_bank::RegisterBank;
pub use register_map::{MapError, RegisterMap};
pub use server::{BindError, Server};
pub use settings::{ModbusSettings, ObjectAccess, SettingsError, WordOrder};
