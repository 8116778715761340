//! Starts, watches and stops the tasks; joins the rooms. The only room that knows all others.
//!
//! Start: everything is checked and every listener bound before the first task is spawned. CAN interfaces, the broker
//! and name servers may be missing then, in any order; their tasks wait for them.
//!
//! - `wiring` \[IO\]: builds the parts, binds, spawns. `running` \[IO\]: what runs then.
//! - `mqtt_tasks` \[IO\]: the sessions with the broker.
//! - [`reload`] \[IO\]: takes in another configuration; [`plan`]: what that changes; [`listeners`]: which addresses it needs;
//!   [`last_good`] \[IO\]: texts, and a copy of them.
//! - `tasks` \[IO\]: the named tasks; a task that ends by itself is a bug and stops the process in order.
//! - `shutdown` \[IO\]: signals.
//! - [`readings`]: counters of the views for page and metrics. `program` \[IO\]: gathers them.
//! - `descriptors` \[IO\]: the limit of open files.
//! - `certificates` \[IO\]: for how long certificates are valid yet.
//! - `health` \[IO\]: what the gateway is told about the rest of the program.

pub mod certificates;
pub mod descriptors;
pub mod health;
pub mod last_good;
pub mod listeners;
mod mqtt_tasks;
pub mod plan;
mod program;
pub mod readings;
pub mod reload;
mod running;
pub mod shutdown;
pub mod tasks;
pub mod wiring;

pub use last_good::{LastGood, Sources};
pub use plan::Plan;
pub use reload::{Fresh, Refusal, Reloads};
pub use tasks::{Ended, Tasks};
pub use wiring::{Bound, Installation, StartError, bind};
