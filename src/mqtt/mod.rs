//! MQTT: the process image as JSON topics, and the journal as events.
//!
//! - [`settings`]: the `[mqtt]` table.
//! - [`topics`], [`payload`], [`json`]: names and contents, pure.
//! - [`publisher`]: what has to be published when, pure. [`outbox`]: what the broker has not acknowledged yet.
//! - `client` \[IO\]: the session with the broker.

pub mod json;
pub mod outbox;
pub mod payload;
pub mod publisher;
pub mod settings;
pub mod topics;

pub use outbox::{Class, OutboxReport};
pub use payload::Identity;
pub use publisher::Publisher;
pub use settings::MqttSettings;
