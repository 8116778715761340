//! Starts, watches and stops the tasks; joins the rooms. The only room that knows all others.
//!
//! Start: everything is checked and every listener bound before the first task is spawned. CAN interfaces, the broker
//! and name servers may be missing then, in any order; their tasks wait for them.
//!
//! - `wiring` \[IO\]: builds the parts, binds, spawns.
//! - `tasks` \[IO\]: the named tasks; a task that ends by itself is a bug and stops the process in order.
//! - `shutdown` \[IO\]: signals.
//! - [`readings`]: counters of the views for page and metrics.
//! - `descriptors` \[IO\]: the limit of open files.
//! - `health` \[IO\]: what the gateway is told about the rest of the program.

pub mod descriptors;
pub mod health;
pub mod readings;
pub mod shutdown;
pub mod tasks;
pub mod wiring;

pub use tasks::{Ended, Tasks};
pub use wiring::{Bound, Installation, StartError, bind};
