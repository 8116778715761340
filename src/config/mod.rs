//! Settings of this installation: one TOML file, environment variables over it, all checked before anything starts.
//!
//! Pure: it is handed the text and the variables, and asks its caller for the mapping files that it needs.
//!
//! - [`settings`]: what the file holds.
//! - [`environment`]: `CANGATE__SECTION__KEY` over the settings of the process.
//! - [`listeners`]: addresses and serial ports that two want to have.
//! - [`loading`]: from text to checked settings and tag table, or to everything that is wrong.

pub mod environment;
pub mod listeners;
pub mod loading;
pub mod settings;

pub use loading::{Loaded, load};
pub use settings::{GatewaySettings, ReloadMode, Settings};

/// The file that `run` reads when it is told none.
pub const DEFAULT_FILE: &str = "/etc/cangate/cangate.toml";

/// Where the last good configuration is kept, where this folder is there and can be written to.
pub const DEFAULT_STATE_DIR: &str = "/var/lib/cangate";

/// JSON Schema of the configuration file, for editors.
#[must_use]
pub fn schema() -> serde_json::Value {
    schemars::schema_for!(Settings).to_value()
}
