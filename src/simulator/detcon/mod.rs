//! A pretend MOTORTECH `DetCon`: a knock controller, and the engine that it listens to. Pure.
//!
//! - [`protocol`]: the device on the bus: states, guarding, TPDOs.
//! - [`values`]: what it measures, and how that is written into its TPDOs. [`cadence`]: when they are due.
//! - [`faults`]: what can be wrong with it.
//! - [`engine`]: what it measures at: a plausible engine.
//! - [`control`]: what can be ordered of it. `device_table`: what its scenarios can say of it.
//! - [`device`]: all of that together.

#[cfg(test)]
mod bench;
pub mod cadence;
pub mod control;
pub mod device;
mod device_table;
pub mod engine;
pub mod faults;
pub mod protocol;
#[cfg(test)]
mod scenario_tests;
pub mod values;

pub use control::{Control, Point};
pub use device::SimulatedDetcon;
pub(super) use device_table::DeviceTable;
pub use faults::Faults;
pub use protocol::{Detcon, DetconSettings};
pub use values::{Channel, StatusBit, Tpdo, Values, WireFormat};

use super::scenario::Shipped;

/// Scenarios that come with the program.
pub const SCENARIOS: [Shipped; 11] = [
    ("quiet", include_str!("scenarios/quiet.toml")),
    ("knock_cylinder_7", include_str!("scenarios/knock_cylinder_7.toml")),
    ("trip", include_str!("scenarios/trip.toml")),
    ("bad_sensor", include_str!("scenarios/bad_sensor.toml")),
    ("power_cycle", include_str!("scenarios/power_cycle.toml")),
    ("mute_guarding", include_str!("scenarios/mute_guarding.toml")),
    ("mute_pdos", include_str!("scenarios/mute_pdos.toml")),
    ("stuck_toggle", include_str!("scenarios/stuck_toggle.toml")),
    ("wrong_length", include_str!("scenarios/wrong_length.toml")),
    ("second_master", include_str!("scenarios/second_master.toml")),
    ("demo", include_str!("scenarios/demo.toml")),
];
