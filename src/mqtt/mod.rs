//! MQTT: the process image as JSON topics, and the journal as events.
//!
//! - [`settings`]: the `[mqtt]` table.
//! - [`topics`], [`payload`], [`json`]: names and contents, pure.
//! - [`publisher`]: what has to be published when, pure. [`outbox`]: what the broker has not acknowledged yet.
//! - `told`: what the broker was told last, pure.
//! - [`back_off`]: how long to wait for the next attempt, pure.
//! - [`uplink`] \[IO\]: one session with a broker. [`client`] \[IO\]: the task that keeps one.
//! - `broker` \[IO\]: a broker inside the process, for the demo.

pub mod back_off;
#[cfg(feature = "embedded-broker")]
pub mod broker;
pub mod client;
pub mod json;
pub mod outbox;
pub mod payload;
pub mod publisher;
pub mod settings;
mod told;
pub mod topics;
pub mod uplink;

pub use client::MqttStatus;
pub use outbox::OutboxReport;
pub use payload::Identity;
pub use publisher::Publisher;
pub use settings::MqttSettings;
