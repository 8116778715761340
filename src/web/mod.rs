//! HTTP: status page, health and metrics. Reads the process image; writes nothing.
//!
//! - [`settings`]: the `[http]` table.
//! - [`health`]: what is shown of the rest of the program.
//! - [`status`]: the JSON of `/api/v1`. [`metrics`]: the text of `/metrics`. Both pure.
//! - [`server`], [`listener`] \[IO\]: routes, connections. `page/index.html`: the page, `openapi.json`: the description.

pub mod health;
pub mod listener;
pub mod metrics;
pub mod server;
pub mod settings;
pub mod status;

pub use health::{HealthSource, ProgramHealth, Reading, ReadingKind, SessionHealth};
pub use server::{Server, WebState};
pub use settings::WebSettings;
pub use status::About;
