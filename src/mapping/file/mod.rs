//! The TOML form of a device mapping, as `mappings/README.md` teaches it.
//!
//! Numbers are read wide and names as text; [`build`](super::build()) checks them, so that all problems are told at once.
//!
//! - `canopen`: what the gateway does as master of the device. `tags`: entries that make tags. `alarms`: entries about
//!   alarms. `emergency`: what emergency messages mean. `esd`: what is said of esd modules. [`values`]: values that can be written in more than one way.

mod alarms;
mod canopen;
mod emergency;
mod esd;
mod tags;
pub mod values;

use std::collections::BTreeMap;

use schemars::JsonSchema;
use serde::Deserialize;

use super::At;

pub use alarms::{AlarmSection, BuiltinAlarmSection};
pub use canopen::{
    ErrorControlSection, IdentitySection, MappingWord, OnStartWord, RpdoSection, SetupSection, SetupValue,
    StartSection, TpdoSection,
};
pub use emergency::{EmergencySection, EmergencyWord, ErrorSection};
pub use esd::{EsdSection, ModuleKindWord, ModuleWord};
pub use tags::*;

/// A device mapping.
#[derive(Clone, Debug, PartialEq, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
#[schemars(title = "cangate device mapping")]
pub struct MappingFile {
    /// Version of this format: 1.
    pub format: At<u64>,
    /// What device it is.
    pub device: DeviceSection,
    /// Says that it is an esd module for serial lines, which speaks no CANopen.
    pub esd: Option<EsdSection>,
    /// What it says of itself; a node that says otherwise is not started.
    pub identity: Option<IdentitySection>,
    /// How its life is watched.
    #[serde(default)]
    pub error_control: ErrorControlSection,
    /// How it is started.
    #[serde(default)]
    pub start: StartSection,
    /// How often its state is published by MQTT.
    #[serde(default)]
    pub publish: PublishSection,
    /// The TPDOs that it sends, by their number: `[tpdo.1]`.
    #[serde(default)]
    pub tpdo: BTreeMap<At<String>, TpdoSection>,
    /// The RPDOs that it is sent, by their number: `[rpdo.1]`.
    #[serde(default)]
    pub rpdo: BTreeMap<At<String>, RpdoSection>,
    /// Its emergency messages.
    #[serde(default)]
    pub emergency: EmergencySection,
    /// Objects that are written before it is started, where it has them otherwise.
    #[serde(default)]
    pub setup: Vec<SetupSection>,
    /// Constants that an installation can set for each node.
    #[serde(default)]
    pub parameter: Vec<ParameterSection>,
    /// Values that stand in its TPDOs, or RPDOs.
    #[serde(default)]
    pub tag: Vec<TagSection>,
    /// Values computed from others.
    #[serde(default)]
    pub derived: Vec<DerivedSection>,
    /// Its alarms.
    #[serde(default)]
    pub alarm: Vec<AlarmSection>,
    /// Changes to the alarms that every node has, by their name.
    #[serde(default)]
    pub builtin_alarm: BTreeMap<At<String>, BuiltinAlarmSection>,
}

/// `[device]`.
#[derive(Clone, Debug, PartialEq, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct DeviceSection {
    /// Maker.
    pub vendor: String,
    /// Model.
    pub model: String,
    /// One sentence.
    #[serde(default)]
    pub description: String,
    /// The document that the mapping was made from.
    #[serde(default)]
    pub source: String,
    /// Memory of `cangate import`: addresses below are not given to new objects, whoever had them.
    pub registers_used: Option<u64>,
    /// The same for the addresses of bits.
    pub bits_used: Option<u64>,
}

/// `[publish]`.
#[derive(Clone, Debug, Default, PartialEq, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct PublishSection {
    /// At least this long between two state messages, 10..=3600000. Default: 500.
    pub min_interval_ms: Option<At<u64>>,
    /// The same while `fast_while` is true, 10..=3600000. Default: 100.
    pub fast_interval_ms: Option<At<u64>>,
    /// A bool tag that asks for the faster interval.
    pub fast_while: Option<At<String>>,
    /// At most this long between two state messages, 100..=3600000. Default: 10000.
    pub max_interval_ms: Option<At<u64>>,
}

/// `[[parameter]]`.
#[derive(Clone, Debug, PartialEq, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct ParameterSection {
    /// Its name, unique among tags.
    pub name: At<String>,
    /// One sentence.
    #[serde(default)]
    pub description: String,
    /// Its value where the installation sets none.
    pub default: At<f64>,
    /// Engineering unit.
    #[serde(default)]
    pub unit: String,
}
