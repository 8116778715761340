//! What the page and the metrics show of the rest of the program, in plain numbers: this room knows neither Modbus nor
//! MQTT; the supervisor fills this in.

use std::sync::Arc;

use crate::time::Timestamp;

/// Asked at every request.
pub type HealthSource = Arc<dyn Fn() -> ProgramHealth + Send + Sync>;

/// How the rest of the program is.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ProgramHealth {
    /// What is not ready yet, one sentence each; empty when the gateway can serve.
    pub not_ready: Vec<String>,
    /// The MQTT session; `None` where MQTT is not configured.
    pub mqtt: Option<SessionHealth>,
    /// Clients of the Modbus server.
    pub modbus_clients: Vec<ClientHealth>,
    /// Certificates in use, and until when they are valid.
    pub certificates: Vec<CertificateHealth>,
    /// The configuration that runs.
    pub configuration: ConfigurationHealth,
    /// Counters and gauges of other parts, for `/metrics`.
    pub readings: Vec<Reading>,
}

/// Which configuration runs, and whether a newer one was refused.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct ConfigurationHealth {
    /// When it was taken in.
    pub loaded: Timestamp,
    /// How often another one was taken in since the start.
    pub reloads: u64,
    /// How often one was refused since the start.
    pub rejections: u64,
    /// Why the newest was refused, with file, line and column; `None`: it runs.
    pub rejected: Option<String>,
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

/// A client of the Modbus server, by its address.
#[derive(Clone, Debug, Default, PartialEq, Eq, serde::Serialize)]
pub struct ClientHealth {
    /// Its address; `null` for those that could not be remembered, together.
    pub address: Option<String>,
    /// It has a reserved place.
    pub reserved: bool,
    /// Connections open now.
    pub open: u64,
    /// Connections since the start.
    pub connections: u64,
    /// Requests answered, exceptions included.
    pub requests: u64,
    /// Exceptions answered.
    pub exceptions: u64,
    /// Requests that waited, as it asks faster than it may.
    pub delayed: u64,
    /// Connections that were not let in.
    pub refused: u64,
}

/// A file with certificates.
#[derive(Clone, Debug, Default, PartialEq, Eq, serde::Serialize)]
pub struct CertificateHealth {
    /// The file.
    pub file: String,
    /// Subject of the one that expires first.
    pub subject: String,
    /// Until when it is valid, RFC 3339.
    pub expires: String,
    /// Whole days until then; negative once it has expired.
    pub days_left: i64,
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
