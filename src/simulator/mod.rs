//! Pretend devices: pure state machines on the device's side of the bus, and one task that puts them on a bus.
//!
//! For tests, for `cangate sim` and for `cangate demo`; `docs/simulator.md` is its manual. A device has the four verbs
//! of everything in this crate that lives in time. Not here: anything that the gateway knows of a device; the two sides
//! meet on the bus only, and share nothing but frames, identifiers and the words of NMT.
//!
//! - [`kind`]: the list of devices; each has a folder: [`detcon`], [`dst_p92c`], [`cbm_sio`].
//! - [`device`]: what a device is to whoever puts it on a bus.
//! - [`slave`]: what every slave does; [`sdo_server`], [`lss_slave`] and [`emcy`] what some do.
//! - [`order`]: what can be ordered of one; [`scenario`]: orders at given times, which `scenario_file` reads.
//! - [`random`]: where noise comes from.
//! - [`task`] \[IO\]: puts devices on a bus. [`serial_end`] \[IO\]: puts serial channels of a device to where programs find
//!   them; [`serial_place`]: how that is typed.

pub mod cbm_sio;
pub mod detcon;
pub mod device;
pub mod dst_p92c;
pub mod emcy;
pub mod error;
pub mod kind;
pub mod lss_slave;
pub mod order;
pub mod random;
pub mod scenario;
mod scenario_file;
pub mod sdo_server;
pub mod serial_end;
pub mod serial_place;
pub mod slave;
pub mod task;

pub use device::{Device, DeviceNumber, DevicePlan, Status};
pub use error::{Problem, SimulatorError};
pub use kind::{Kind, Settings};
pub use order::Order;
pub use scenario::Scenario;

use std::time::Duration;

use crate::canopen::NodeId;
use detcon::DetconSettings;

/// The devices of `cangate demo`: node 1 at an engine of 16 cylinders, node 2 at one of 12, node 5 at a press, and module
/// 0x1A with a barcode scanner, a balance and echoes at its lines. Both engines tell the same story, the second half a minute
/// later, so that something goes on most of the time.
#[must_use]
pub fn demo() -> Vec<DevicePlan> {
    let story = |kind| Scenario::shipped(kind, "demo");
    let stories = (story(Kind::Detcon), story(Kind::DstP92c), story(Kind::CbmSio4));
    let (Some(engine), Some(press), Some(lines)) = stories else { return Vec::new() };
    let engines = [(1, 16, Duration::ZERO), (2, 12, Duration::from_secs(30))];
    let engines = engines.into_iter().filter_map(|(node, cylinders, story_after)| {
        let settings = Settings::Detcon(DetconSettings { cylinders, ..DetconSettings::default() });
        let scenario = Scenario { settings, ..engine.clone() };
        Some(DevicePlan { story_after, ..DevicePlan::new(NodeId::new(node)?, scenario) })
    });
    let press = NodeId::new(5).map(|node| DevicePlan::new(node, press.clone()));
    let module = DeviceNumber::new(0x1A).map(|module| DevicePlan::new(module, lines));
    engines.chain(press).chain(module).collect()
}
