//! What the page and the metrics show of the rest of the program, in plain numbers: this room knows neither Modbus nor
//! MQTT; the supervisor fills this in.

use std::sync::Arc;

/// Asked at every request.
pub type HealthSource = Arc<dyn Fn() -> ProgramHealth + Send + Sync>;

/// How the rest of the program is.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ProgramHealth {
    /// What is not ready yet, one sentence each; empty when the gateway can serve.
    pub not_ready: Vec<String>,
    /// The MQTT session; `None` where MQTT is not configured.
    pub mqtt: Option<SessionHealth>,
    /// Counters and gauges of other parts, for `/metrics`.
    pub readings: Vec<Reading>,
}

/// The session with the broker.
#[derive(Clone, Debug, Default, PartialEq, Eq, serde::Serialize)]
pub struct SessionHealth {
    /// It is up.
    pub connected: bool,
    /// Address of the broker.
    pub broker: String,
    /// Why there was no session last time; empty where there always was one.
    pub last_error: String,
}

/// One number of another part of the program.
#[derive(Clone, Debug, PartialEq)]
pub struct Reading {
    /// Name without `cangate_` and without `_total`, snake case with the unit last: `modbus_requests`.
    pub name: &'static str,
    /// One sentence, without a full stop.
    pub help: &'static str,
    /// Counter or gauge.
    pub kind: ReadingKind,
    /// Labels, for example `("class", "event")`.
    pub labels: Vec<(&'static str, String)>,
    /// The number.
    pub value: f64,
}

/// How a number behaves.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ReadingKind {
    /// Only goes up.
    Counter,
    /// Goes up and down.
    Gauge,
}
