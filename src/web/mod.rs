//! HTTP: status page, health and metrics, which read the process image; commands of clients that have a token or log in.
//!
//! - [`settings`]: the `[http]` table.
//! - [`health`]: what is shown of the rest of the program.
//! - [`status`]: the JSON of `/api/v1`. [`metrics`]: the text of `/metrics`. Both pure.
//! - [`host`]: who a request is meant for. [`recent`]: an answer that is used again for a moment. Both pure.
//! - [`login`]: tokens, and who guesses them; [`sessions`]: who is logged in; [`pace`]: how often an address may ask. Pure.
//! - [`guard`] \[IO\]: who asks. [`secret_files`] \[IO\]: what it knows them by. `login_routes` \[IO\]: logging in and out, and who may read. [`commands`] \[IO\]: what may be
//!   asked for.
//! - [`server`], [`listener`] \[IO\]: routes, connections. [`line`](mod@line) \[IO\]: TLS around them. `page/index.html`: the page, `openapi.json`: the description.

pub mod commands;
pub mod guard;
pub mod health;
pub mod host;
pub mod line;
pub mod listener;
pub mod login;
mod login_routes;
pub mod metrics;
pub mod pace;
pub mod recent;
pub mod secret_files;
pub mod server;
pub mod sessions;
pub mod settings;
pub mod status;

pub use health::{
    CertificateHealth, ClientHealth, ConfigurationHealth, HealthSource, ProgramHealth, Reading, ReadingKind,
    SessionHealth,
};
pub use server::{Server, WebState};
pub use settings::{Readers, WebSettings, WebTls};
pub use status::About;
