//! What the configuration file holds.

use std::collections::BTreeMap;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

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
}

/// The `[gateway]` table.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct GatewaySettings {
    /// Its name, part of topics and of the MQTT client id: 1 to 64 of a-z, 0-9, _ and -. Unique at the broker.
    #[schemars(regex(pattern = r"^[a-z0-9_-]{1,64}$"))]
    pub name: String,
}

impl Default for GatewaySettings {
    fn default() -> Self {
        Self { name: "cangate".to_owned() }
    }
}
