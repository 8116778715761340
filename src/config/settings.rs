//! What the configuration file holds.

use std::collections::BTreeMap;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::access::AccessEntry;
use crate::cia309::settings::Cia309Settings;
use crate::mapping::At;
use crate::mapping::installation::{BusEntry, NodeEntry};
use crate::modbus::settings::ModbusSettings;
use crate::mqtt::settings::MqttSettings;
use crate::web::settings::WebSettings;

/// The configuration file.
#[derive(Clone, Debug, PartialEq, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
#[schemars(title = "cangate configuration")]
pub struct Settings {
    /// Version of this format: 1.
    pub version: At<u64>,
    /// The gateway itself.
    #[serde(default)]
    pub gateway: GatewaySettings,
    /// The CAN buses, by name.
    #[serde(default)]
    pub bus: BTreeMap<At<String>, BusEntry>,
    /// The nodes, by name.
    #[serde(default)]
    pub node: BTreeMap<At<String>, NodeEntry>,
    /// The Modbus TCP server.
    #[serde(default)]
    pub modbus: ModbusSettings,
    /// The MQTT client; without this table there is none.
    pub mqtt: Option<MqttSettings>,
    /// The page, health and metrics.
    #[serde(default)]
    pub http: WebSettings,
    /// The CiA 309-3 gateway; off unless it has a `listen`.
    #[serde(default)]
    pub cia309: Cia309Settings,
    /// Who may ask the gateway for more than values, by name: 1 to 64 of A-Z, a-z, 0-9, _ and -. Without a table: nobody.
    #[serde(default)]
    pub access: BTreeMap<At<String>, AccessEntry>,
}

/// The `[gateway]` table.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct GatewaySettings {
    /// Its name, part of topics and of the MQTT client id: 1 to 64 of a-z, 0-9, _ and -. Unique at the broker.
    #[schemars(regex(pattern = r"^[a-z0-9_-]{1,64}$"))]
    pub name: String,
    /// What makes the files be read again while the gateway runs: `signal` (SIGHUP), `watch` (SIGHUP, or a file that changed),
    /// `off`.
    pub reload: ReloadMode,
    /// Whether a reload may change what stands at published Modbus addresses and topics. Off unless asked for: who reads them
    /// would take one value for another. Meant for one reload, and to be taken out again.
    pub allow_map_change: bool,
}

/// What makes the files be read again.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum ReloadMode {
    /// SIGHUP.
    #[default]
    Signal,
    /// SIGHUP, and a file that changed.
    Watch,
    /// Nothing: only a restart does.
    Off,
}

impl Default for GatewaySettings {
    fn default() -> Self {
        Self { name: "cangate".to_owned(), reload: ReloadMode::default(), allow_map_change: false }
    }
}
