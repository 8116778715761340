//! The core: joins networks, mapping and alarms to what readers see. Pure but for `task`.
//!
//! One struct, [`Gateway`], one input at a time. The task's law: one input, then `poll_output` until `None`, then
//! `publish` into the process image, then wait.
//!
//! - [`command`]: what a northbound can ask for. `operate`: what comes of it.
//! - `objects`: objects of nodes that northbounds read and write.
//! - `core`: the four verbs.
//! - `bus`: one bus; `node` and `node_event`: one node; `emergency`: its errors.
//! - `supply`: what nodes are sent in RPDOs.
//! - `tags`: the value of every tag; `derived`: computed tags; `units`: units that devices tell.
//! - `conditions`: what raises alarms. `events`: on the way to the journal.
//! - `marks`: which places changed.
//! - [`replay`]: a recording through the same core.
//! - [`task`] \[IO\]: owns the gateway and the image's writer.

mod boot_event;
mod bus;
pub mod command;
mod conditions;
pub mod core;
mod derived;
mod emergency;
mod events;
#[cfg(test)]
mod fixture;
mod marks;
mod node;
mod node_event;
mod objects;
mod operate;
pub mod replay;
mod supply;
mod tags;
pub mod task;
mod units;

pub use command::{Action, Command, CommandSource, Desk, Outcome};
pub use core::{Gateway, Health, Input, Output};
