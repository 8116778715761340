//! MQTT: the process image as JSON topics, and the journal as events.
//!
//! - [`settings`]: the `[mqtt]` table. [`version`]: which MQTT is spoken, `labels`: what it tells of payloads, pure.
//! - [`topics`], [`payload`], [`json`]: names and contents, pure.
//! - [`publisher`]: what has to be published when, pure. [`outbox`]: what the broker has not acknowledged yet.
//! - `told`: what the broker was told last, pure. `line_reader`: which messages of serial lines it was not, pure.
//! - [`serial_command`]: what is to be sent on a serial line, pure. `commands` \[IO\]: asks the gateway to.
//! - [`home_assistant`]: what announces nodes, tags and alarms to Home Assistant, pure. [`kind`]: what a tag's values are, pure.
//! - [`sparkplug`]: a second publisher, with a session of its own.
//! - [`buffer`]: what goes through the store, pure. [`store_link`] \[IO\]: the store on a thread of its own.
//! - [`plan`]: how long the store lasts, pure.
//! - [`requests`] \[IO\]: what comes on `bridge/request/...`. `transactions`: none of it is done twice, pure.
//! - [`back_off`]: how long to wait for the next attempt, pure. `attempts`: the same for a connection, with what is told of it, pure.
//!   `image_watch`: when the image is read, pure. `subscription`: when commands are taken, pure. `thrown_away`: how
//!   many of them were not, pure.
//! - [`uplink`] \[IO\]: one session with a broker. [`client`] \[IO\]: the task that keeps one.
//! - `broker` \[IO\]: a broker inside the process, for the demo.

mod attempts;
pub mod back_off;
#[cfg(feature = "embedded-broker")]
pub mod broker;
pub mod buffer;
pub mod client;
mod commands;
pub mod home_assistant;
mod image_watch;
pub mod json;
pub mod kind;
mod labels;
mod line_reader;
pub mod outbox;
pub mod payload;
pub mod plan;
pub mod publisher;
pub mod requests;
pub mod serial_command;
pub mod settings;
pub mod sparkplug;
pub mod store_link;
mod subscription;
mod thrown_away;
mod told;
pub mod topics;
mod transactions;
pub mod uplink;
pub mod version;

pub use buffer::BufferReport;
pub use client::MqttStatus;
pub use outbox::OutboxReport;
pub use payload::Identity;
pub use publisher::Publisher;
pub use settings::MqttSettings;
pub use store_link::StoreLink;
pub use version::MqttVersion;
