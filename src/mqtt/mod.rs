//! MQTT: the process image as JSON topics, and the journal as events.
//!
//! - `topics`, `payload`: names and contents, pure.
//! - `publisher`: what has to be published when, pure. `outbox`: what the broker has not acknowledged yet.
//! - `client` \[IO\]: the session with the broker.
