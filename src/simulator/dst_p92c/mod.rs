//! A pretend Danfoss DST P92C: a CANopen pressure transmitter, and the hydraulic line that it measures at. Pure.
//!
//! - [`protocol`]: the device on the bus: NMT, boot-up, heartbeat; `services`: SDO, LSS, EMCY; [`tpdo`]: its TPDO1.
//! - [`object_table`]: its object dictionary as a table; [`dictionary`]: the values in it. [`store`]: what it remembers
//!   without power.
//! - [`hydraulics`]: what it measures at. [`measurement`], [`units`]: how that becomes objects.
//! - [`faults`]: what can be wrong with it. [`action`]: what can be ordered of it.
//! - [`settings`]: what it is like, and what its scenarios can say of that.
//! - [`device`]: all of that together.

pub mod action;
pub mod device;
pub mod dictionary;
pub mod faults;
pub mod hydraulics;
pub mod measurement;
pub mod object_table;
pub mod protocol;
mod services;
pub mod settings;
pub mod store;
#[cfg(test)]
mod tests;
pub mod tpdo;
pub mod units;

pub use action::Action;
pub use device::SimulatedDst;
pub use protocol::DstP92c;
pub(super) use settings::DeviceTable;
pub use settings::DstSettings;

use super::scenario::Shipped;

/// Scenarios that come with the program.
pub const SCENARIOS: [Shipped; 9] = [
    ("quiet", include_str!("scenarios/quiet.toml")),
    ("overpressure", include_str!("scenarios/overpressure.toml")),
    ("overtemperature", include_str!("scenarios/overtemperature.toml")),
    ("bad_sensor", include_str!("scenarios/bad_sensor.toml")),
    ("power_cycle", include_str!("scenarios/power_cycle.toml")),
    ("boot_error", include_str!("scenarios/boot_error.toml")),
    ("mute", include_str!("scenarios/mute.toml")),
    ("emergencies", include_str!("scenarios/emergencies.toml")),
    ("demo", include_str!("scenarios/demo.toml")),
];
