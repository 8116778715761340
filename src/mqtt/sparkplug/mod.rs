//! Sparkplug B, version 3.0 of its specification: a second publisher with a session of its own. The gateway is the edge node, each
//! node is a device.
//!
//! - `settings`: the `[mqtt.sparkplug]` table. `topics`: their names. Both pure.
//! - [`payload`]: the protobuf messages. [`catalogue`]: which metrics there are, and how they read. Both pure.
//! - [`command`]: what a host asks for. Pure.
//! - [`edge`]: what is said when; `origin`: what was told; `messages`: what messages consist of. All pure.
//! - [`history`]: what is kept meanwhile. [`host`]: the primary host. Both pure.
//! - `commands` \[IO\]: hands to the gateway what hosts ask for. [`task`] \[IO\]: the task that keeps the session.

pub mod catalogue;
pub mod command;
mod commands;
pub mod edge;
pub mod history;
pub mod host;
mod messages;
mod origin;
pub mod payload;
mod settings;
pub mod task;
mod topics;

pub use edge::EdgeNode;
pub use settings::SparkplugSettings;
pub use task::SparkplugStatus;
pub use topics::EdgeTopics;
