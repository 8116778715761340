//! Pretend devices: pure state machines on the device's side of the bus, and one task that puts them on a bus.
//!
//! For tests, for `cangate sim` and for `cangate demo`. A device has the four verbs of everything in this crate that
//! lives in time. Not here: anything that the gateway knows of a device; the two sides meet on the bus only.
//!
//! - [`detcon`]: the device on the bus: states, guarding, TPDOs.
//! - [`values`]: what it measures, and how that is written into its TPDOs. [`cadence`]: when they are due.
//! - [`faults`]: what can be wrong with it.

#[cfg(test)]
mod bench;
pub mod cadence;
pub mod detcon;
pub mod faults;
pub mod values;

pub use detcon::{Detcon, DetconSettings};
pub use faults::Faults;
pub use values::{Channel, StatusBit, Tpdo, Values, WireFormat};
