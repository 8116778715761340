//! The core: joins networks, mapping and alarms to what readers see. Pure but for `task`.
//!
//! One struct, [`Gateway`], one input at a time. The task's law: one input, then `poll_output` until `None`, then
//! `publish` into the process image, then wait.
//!
//! - [`command`]: what a northbound can ask for.
//! - `core`: the four verbs. `node`: one node's part. `derived`: computed tags. `conditions`: built-in alarms.
//! - `task` \[IO\]: owns the gateway and the image's writer.

pub mod command;
pub mod core;

pub use command::{Action, Command, CommandSource, Outcome};
pub use core::{Gateway, Health, Input, Output};
