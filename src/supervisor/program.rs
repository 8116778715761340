//! What the page and the metrics are told of the program, gathered from where each part tells of itself. \[IO\]

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use tokio::sync::watch;

use super::readings;
use crate::gateway::Desk;
use crate::modbus::{Accounts, Counters};
use crate::mqtt::MqttStatus;
use crate::mqtt::sparkplug::SparkplugStatus;
use crate::tls::Life;
use crate::web::{ConfigurationHealth, ProgramHealth};

/// Where the parts tell of themselves.
#[derive(Debug)]
pub(super) struct Program {
    /// Set once every task is spawned.
    pub(super) ready: Arc<AtomicBool>,
    /// The session with the broker, where there is one.
    pub(super) mqtt: Option<watch::Receiver<MqttStatus>>,
    /// That of Sparkplug.
    pub(super) sparkplug: Option<watch::Receiver<SparkplugStatus>>,
    /// The Modbus server.
    pub(super) modbus: Arc<Counters>,
    /// Its clients.
    pub(super) clients: Arc<Accounts>,
    /// Certificates of TLS.
    pub(super) certificates: watch::Receiver<Vec<Life>>,
    /// What was refused.
    pub(super) desk: Desk,
    /// Which configuration runs.
    pub(super) configuration: watch::Receiver<ConfigurationHealth>,
}

impl Program {
    /// All of it, now.
    pub(super) fn health(&self) -> ProgramHealth {
        let is_ready = self.ready.load(Ordering::Acquire);
        let not_ready = (!is_ready).then(|| "the tasks are being started".to_owned());
        let mqtt = self.mqtt.as_ref().map(|seen| seen.borrow().clone());
        let mut health = readings::program_health(
            not_ready.into_iter().collect(),
            &self.modbus.values(),
            &self.clients.values(),
            mqtt.as_ref(),
            &self.certificates.borrow(),
            &self.desk.refused(),
        );
        let sparkplug = self.sparkplug.as_ref().map(|seen| seen.borrow().clone());
        health.readings.extend(sparkplug.iter().flat_map(readings::sparkplug));
        health.configuration = self.configuration.borrow().clone();
        health.readings.extend(readings::configuration(&health.configuration));
        health
    }
}
