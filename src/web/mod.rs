//! HTTP: status page, health and metrics. Reads the process image; writes nothing.
//!
//! - [`settings`]: the `[http]` table.
//! - [`health`]: what is shown of the rest of the program.
//! - [`status`]: the JSON of `/api/v1`. [`metrics`]: the text of `/metrics`. Both pure.
//! - [`host`]: who a request is meant for. [`recent`]: an answer that is used again for a moment. Both pure.
//! - [`server`], [`listener`] \[IO\]: routes, connections. `page/index.html`: the page, `openapi.json`: the description.

pub mod health;
pub mod host;
pub mod listener;
pub mod metrics;
pub mod recent;
pub mod server;
pub mod settings;
pub mod status;

pub use health::{HealthSource, ProgramHealth, Reading, ReadingKind, SessionHealth};
pub use server::{Server, WebState};
pub use settings::WebSettings;
pub use status::About;
