//! Pretend devices: pure state machines on the device's side of the bus, and one task that puts them on a bus.
//!
//! For tests, for `cangate sim` and for `cangate demo`; `docs/simulator.md` is its manual. A device has the four verbs
//! of everything in this crate that lives in time. Not here: anything that the gateway knows of a device; the two sides
//! meet on the bus only.
//!
//! - [`detcon`]: the device on the bus: states, guarding, TPDOs.
//! - [`values`]: what it measures, and how that is written into its TPDOs. [`cadence`]: when they are due.
//! - [`faults`]: what can be wrong with it.
//! - [`engine`]: what it measures at: a plausible engine. [`random`]: its noise.
//! - [`control`]: what can be ordered of it. [`scenario`]: orders at given times; `scenario_file` reads them.
//! - [`device`]: all of that together.
//! - [`task`] \[IO\]: puts devices on a bus.

#[cfg(test)]
mod bench;
pub mod cadence;
pub mod control;
pub mod detcon;
pub mod device;
pub mod engine;
pub mod error;
pub mod faults;
pub mod random;
pub mod scenario;
mod scenario_file;
pub mod task;
pub mod values;

pub use control::{Control, Order, Point};
pub use detcon::{Detcon, DetconSettings};
pub use device::{DevicePlan, SimulatedDevice, Status};
pub use error::{Problem, SimulatorError};
pub use faults::Faults;
pub use scenario::Scenario;
pub use values::{Channel, StatusBit, Tpdo, Values, WireFormat};

use std::time::Duration;

use crate::canopen::NodeId;

/// The devices of `cangate demo`: node 1 at an engine of 16 cylinders, node 2 at one of 12. Both tell the same story, the
/// second half a minute later, so that something goes on most of the time.
#[must_use]
pub fn demo() -> Vec<DevicePlan> {
    let Some(scenario) = Scenario::shipped("demo") else { return Vec::new() };
    [(1, 16, Duration::ZERO), (2, 12, Duration::from_secs(30))]
        .into_iter()
        .filter_map(|(node, cylinders, story_after)| {
            let scenario = Scenario { cylinders, ..scenario.clone() };
            Some(DevicePlan { story_after, ..DevicePlan::new(NodeId::new(node)?, scenario) })
        })
        .collect()
}
