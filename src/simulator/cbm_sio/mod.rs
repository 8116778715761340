//! Pretend esd modules CAN-CBM-SIO1 and CAN-CBM-SIO4: serial lines behind CAN, with esd's own protocol. Pure.
//!
//! - [`module`]: the module on the bus, with its channels; [`start`]: power, resets, what it remembers; `protocol`: its commands.
//! - [`parameters`]: what can be set of it, and what the numbers mean.
//! - [`channel`]: one serial channel, from the line to CAN and back; [`mod@line`]: what is at the end of its line.
//! - [`faults`]: what can be wrong with it. [`action`]: what can be ordered of it.
//! - [`settings`]: what it is like, and what its scenarios can say of that.
//! - [`device`]: all of that together.

pub mod action;
pub mod channel;
pub mod device;
pub mod faults;
pub mod line;
pub mod module;
pub mod parameters;
mod protocol;
pub mod settings;
pub mod start;
#[cfg(test)]
mod tests;

pub use action::Action;
pub use device::SimulatedSio;
pub use module::Module;
pub use parameters::Model;
pub use settings::SioSettings;
pub(super) use settings::{Sio1Table, Sio4Table};

use super::scenario::Shipped;

/// Scenarios of the SIO1 that come with the program.
pub const SIO1_SCENARIOS: [Shipped; 7] = [
    ("quiet", include_str!("scenarios/quiet.toml")),
    ("scanner", include_str!("scenarios/scanner.toml")),
    ("reset", include_str!("scenarios/reset.toml")),
    ("power_cycle", include_str!("scenarios/power_cycle.toml")),
    ("unplug", include_str!("scenarios/unplug.toml")),
    ("can_error", include_str!("scenarios/can_error.toml")),
    ("mute", include_str!("scenarios/mute.toml")),
];

/// Scenarios of the SIO4 that come with the program.
pub const SIO4_SCENARIOS: [Shipped; 9] = [
    ("quiet", include_str!("scenarios/quiet.toml")),
    ("scanner", include_str!("scenarios/scanner.toml")),
    ("reset", include_str!("scenarios/reset.toml")),
    ("power_cycle", include_str!("scenarios/power_cycle.toml")),
    ("unplug", include_str!("scenarios/unplug.toml")),
    ("can_error", include_str!("scenarios/can_error.toml")),
    ("mute", include_str!("scenarios/mute.toml")),
    ("cts", include_str!("scenarios/cts.toml")),
    ("demo", include_str!("scenarios/demo.toml")),
];
