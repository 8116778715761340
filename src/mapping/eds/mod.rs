//! EDS and DCF files (CiA 306): reading those of any maker, and making a device mapping of one.
//!
//! - [`read()`]: bytes to an [`Eds`], with a warning for everything that is not as the standard has it. Its parts: `charset`,
//!   `ini`, `number`, `sections`, `objects`.
//! - [`import()`]: an [`Eds`] to the text of a mapping; with the former text of the same mapping, addresses and what was
//!   written by hand stay. Its parts: `pdo` (what the TPDOs carry), `naming`, `addresses`, `former` (the former text) and
//!   `chunk` (one table of it), `tags`, `setup`, `writer`.
//! - [`dcf()`]: an [`Eds`] and what a node is set to, to the DCF of that node.
//! - [`model`]: what an EDS says. [`report`]: where messages are collected.

mod addresses;
mod charset;
mod chunk;
mod dcf;
mod former;
pub mod import;
mod ini;
pub mod model;
mod naming;
pub mod number;
mod objects;
pub mod pdo;
mod read;
pub mod report;
mod sections;
mod setup;
mod tags;
mod writer;

pub use dcf::{Commissioning, configured, dcf};
pub use import::{Imported, import};
pub use model::{Access, DataType, DeviceInfo, Eds, Object, ObjectId, Value};
pub use read::read;
