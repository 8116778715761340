//! HTTP: status page, health and metrics. Reads the process image; writes nothing.
//!
//! - [`settings`]: the `[http]` table.

pub mod settings;

pub use settings::WebSettings;
