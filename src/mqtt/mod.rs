//! MQTT: the process image as JSON topics, and the journal as events.
//!
//! - [`settings`]: the `[mqtt]` table.
//! - `topics`, `payload`: names and contents, pure.
//! - `publisher`: what has to be published when, pure. `outbox`: what the broker has not acknowledged yet.
//! - `client` \[IO\]: the session with the broker.

pub mod settings;

pub use settings::MqttSettings;
