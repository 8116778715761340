//! The core: joins networks, mapping and alarms to what readers see. Pure but for `task`.
//!
//! One struct, [`Gateway`], one input at a time. The task's law: one input, then `poll_output` until `None`, then
//! `publish` into the process image, then wait.
//!
//! - [`command`]: what a northbound can ask for. `operate`: what comes of it. `intruders`: who asks for what is not theirs.
//! - `objects`: objects of nodes that northbounds read and write.
//! - `core`: the four verbs.
//! - [`allowed_frames`]: what may be sent at all.
//! - `bus`: one bus; `silence`: when nobody is heard on it; `foreign`: what is nobody's. `node` and `node_event`: one node;
//!   `emergency`: its errors.
//! - `supply`: what nodes are sent in RPDOs.
//! - `tags`: the value of every tag; `derived`: computed tags; `units`: units that devices tell.
//! - `conditions`: what raises alarms. `events`: on the way to the journal; `refusals`: those that repeat.
//! - `exchange`: a running gateway goes on with another table; [`kept`]: what stays the same.
//! - [`order`]: what a reload has the task do.
//! - `modules`: esd modules. `lines`: their serial lines.
//! - `marks`: which places changed.
//! - [`replay`]: a recording through the same core.
//! - [`task`] \[IO\]: owns the gateway and the image's writer.

pub mod allowed_frames;
mod boot_event;
mod bus;
pub mod command;
mod conditions;
pub mod core;
mod derived;
mod emergency;
mod events;
mod exchange;
#[cfg(test)]
mod fixture;
mod foreign;
mod intruders;
pub mod kept;
mod lines;
mod marks;
mod modules;
mod node;
mod node_event;
mod objects;
mod operate;
pub mod order;
mod refusals;
pub mod replay;
mod silence;
mod supply;
mod tags;
pub mod task;
mod units;

pub use command::{Action, Command, CommandSource, Desk, Outcome, Refused};
pub use core::{Gateway, Health, Input, Output};
