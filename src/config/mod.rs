//! Settings of this installation: one TOML file, environment variables over it, all checked before anything starts.
//!
//! Pure: it is handed the text and the variables, and asks its caller for the mapping files that it needs.
//!
//! - [`settings`]: what the file holds.
//! - [`environment`]: `CANGATE__SECTION__KEY` over the settings of the process.
//! - [`loading`]: from text to checked settings and tag table, or to everything that is wrong.

pub mod environment;
pub mod loading;
pub mod settings;

pub use loading::{Loaded, load};
pub use settings::{GatewaySettings, Settings};

/// The file that `run` reads when it is told none.
pub const DEFAULT_FILE: &str = "/etc/cangate/cangate.toml";

/// JSON Schema of the configuration file, for editors.
#[must_use]
pub fn schema() -> serde_json::Value {
    schemars::schema_for!(Settings).to_value()
}
