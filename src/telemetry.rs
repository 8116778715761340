//! Logs: to standard error, as text or JSON lines. \[IO\]
//!
//! TRACE one frame, DEBUG a decision, INFO a state change that an operator sees, WARN needs attention though all works,
//! ERROR cannot go on.

use std::io::IsTerminal;

use clap::ValueEnum;
use tracing_subscriber::EnvFilter;

/// How log lines look.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
pub enum LogFormat {
    /// For people.
    #[default]
    Text,
    /// One JSON object a line, for log collectors.
    Json,
}

/// What the libraries inside have to say stays out of the log unless it is asked for: the demo's broker tells every client.
pub const DEFAULT_FILTER: &str = "warn,cangate=info";

/// Starts logging. `filter` as in `info,cangate::canopen=debug`.
///
/// # Errors
/// The filter is not one; the text says what is wrong with it.
pub fn start(filter: &str, format: LogFormat) -> Result<(), String> {
    let filter = EnvFilter::try_new(filter).map_err(|error| {
        format!("`{filter}` is not a log filter: {error}; write for example `info,cangate::canopen=debug`")
    })?;
    let builder = tracing_subscriber::fmt().with_env_filter(filter).with_writer(std::io::stderr);
    let started = match format {
        LogFormat::Text => builder.with_ansi(std::io::stderr().is_terminal()).with_target(false).try_init(),
        LogFormat::Json => builder.json().flatten_event(true).try_init(),
    };
    started.map_err(|error| format!("logging could not be started: {error}"))
}
