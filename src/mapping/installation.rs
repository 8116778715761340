//! The `[bus.*]` and `[node.*]` tables of the configuration; `esd`: what they say of esd modules.
//!
//! Numbers are read wide and checked by [`build`](super::build()), so that a value out of its range is told together with all
//! other problems. `None` means "what the mapping says, else the default".

mod esd;

use std::collections::BTreeMap;

use schemars::JsonSchema;
use serde::Deserialize;

use super::At;
pub use super::offset::Offset;
use super::table::OnLoss;
use crate::canopen::{Role, TogglePolicy};
use crate::process_image::Priority;

pub use esd::{
    ChannelEntry, EncodingOfLineWord, EndMarkWord, EsdEntry, FlowControlWord, HighHalfWord, ParityWord,
    WatchdogWord,
};

/// `[bus.NAME]`.
#[derive(Clone, Debug, PartialEq, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct BusEntry {
    /// How the bus is reached: `can0`, `virtual:demo`, `slcan:/dev/ttyACM0?bitrate=125000`, `slcan+tcp://host:port`.
    pub interface: At<String>,
    /// Whether the gateway is the NMT master of this bus or sends nothing at all. Default: master.
    #[serde(default)]
    pub role: RoleWord,
    /// Bit rate in bit/s, for the bus load: 10000, 20000, 50000, 100000, 125000, 250000, 500000, 800000 or 1000000.
    /// Default: 125000 (R-DET-089).
    pub bit_rate: Option<At<u64>>,
    /// Start all nodes of the bus with one broadcast command instead of one by one (R-DET-018). Default: false.
    #[serde(default)]
    pub start_broadcast: bool,
    /// The gateway's own node id, 1..=127, where it has one: no node of this bus may use it (R-DET-004).
    pub own_node_id: Option<At<u64>>,
    /// The gateway sends a heartbeat of its own, with `own_node_id`, every 10..=65535 ms. Default: none (R-DST-062).
    pub own_heartbeat_ms: Option<At<u64>>,
    /// SYNC: the message after which synchronous PDOs are sent. Default: none.
    pub sync: Option<At<SyncEntry>>,
    /// TIME: tells the devices the time. Default: none.
    pub time: Option<At<TimeEntry>>,
    /// Modules of esd: how they are managed. Default: not at all.
    pub esd: Option<At<EsdEntry>>,
}

impl BusEntry {
    /// A bus inside the process, everything else as it is by default.
    #[must_use]
    pub fn virtual_bus(name: &str) -> Self {
        Self {
            interface: At::nowhere(format!("virtual:{name}")),
            role: RoleWord::Master,
            bit_rate: None,
            start_broadcast: false,
            own_node_id: None,
            own_heartbeat_ms: None,
            sync: None,
            time: None,
            esd: None,
        }
    }
}

/// `[bus.NAME.sync]`.
#[derive(Clone, Debug, Default, PartialEq, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct SyncEntry {
    /// Who sends it. Default: gateway; in the passive role it never does.
    #[serde(default)]
    pub producer: ProducerWord,
    /// Time between two, 1..=60000 ms; or `period_us`. Where another sends it: what is to be expected, if it is known. 0 = no
    /// SYNC; where another sends it, not known.
    pub period_ms: Option<At<u64>>,
    /// The same in microseconds, 1000..=60000000, or 0.
    pub period_us: Option<At<u64>>,
    /// Its identifier; one above 0x7FF has 29 bits. Default: 0x80.
    pub cob_id: Option<At<u64>>,
    /// Highest number of its counter, 2..=240; 0 = no counter, so no data. Only where the gateway sends it. Default: 0.
    pub counter: Option<At<u64>>,
    /// A synchronous TPDO that comes later after SYNC is told of, 1..=60000000 us; 0 = not looked at. Default: 0.
    pub window_us: Option<At<u64>>,
}

/// `[bus.NAME.time]`.
#[derive(Clone, Debug, Default, PartialEq, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct TimeEntry {
    /// Time between two, 1..=86400 s.
    pub period_s: At<u64>,
    /// Its identifier; one above 0x7FF has 29 bits. Default: 0x100.
    pub cob_id: Option<At<u64>>,
    /// Send it also while the clock of the host is not known to be synchronised. Default: false.
    #[serde(default)]
    pub unsynchronised: bool,
}

/// Who sends SYNC.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum ProducerWord {
    /// This gateway.
    #[default]
    Gateway,
    /// Somebody else.
    Other,
}

/// `role`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum RoleWord {
    /// NMT master: starts and guards its nodes.
    #[default]
    Master,
    /// Sends nothing at all.
    Passive,
}

impl From<RoleWord> for Role {
    fn from(word: RoleWord) -> Self {
        match word {
            RoleWord::Master => Self::Master,
            RoleWord::Passive => Self::Passive,
        }
    }
}

/// `[node.NAME]`.
#[derive(Clone, Debug, Default, PartialEq, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct NodeEntry {
    /// Name of its bus.
    pub bus: At<String>,
    /// CANopen node id, 1..=127, or number of an esd module, 1..=254. It has no default (R-DET-005, R-ESD-049).
    pub id: At<u64>,
    /// Device mapping: the name of a file in `mappings/`, or a path.
    pub mapping: At<String>,
    /// Modbus unit id, 1..=247 without that of the gateway itself. Default: the `id`.
    pub unit_id: Option<At<u64>>,
    /// Added to every Modbus address, so that several nodes can share one unit id; or `"auto"`: behind the one before it
    /// (R-ESD-118). Default: 0.
    pub offset: Option<At<Offset>>,
    /// What Modbus shows of invalid data. Default: invalid.
    #[serde(default)]
    pub on_loss: OnLossWord,
    /// Show 0 instead of the last value when a value is not usable (R-DET-084). Default: false.
    #[serde(default)]
    pub zero_on_bad: bool,
    /// Values for the parameters that the mapping declares.
    #[serde(default)]
    pub parameters: BTreeMap<At<String>, At<f64>>,
    /// How the life of the node is watched (R-DET-044).
    pub error_control: Option<At<ErrorControlWord>>,
    /// Time between two guard requests, 20..=65535 ms; 0 = guarding off (R-DET-031).
    pub guard_time_ms: Option<At<u64>>,
    /// Missed replies in a row until the node is lost, 1..=255 (R-DET-032).
    pub life_time_factor: Option<At<u64>>,
    /// A guard reply later than this is missed; at most the guard time (R-DET-033).
    pub guard_reply_ms: Option<At<u64>>,
    /// What a wrong toggle bit means (R-DET-035).
    pub toggle_check: Option<ToggleWord>,
    /// A heartbeat node is lost after this long without a sign of life, 10..=65535 ms (R-DET-044).
    pub heartbeat_timeout_ms: Option<At<u64>>,
    /// Start the node whenever it waits for it (R-DET-017).
    pub auto_start: Option<bool>,
    /// Start at the latest this long after a boot-up message, 0..=65535 ms (R-DET-019).
    pub start_delay_ms: Option<At<u64>>,
    /// A start without effect for this long is repeated, 10..=65535 ms (R-DET-020).
    pub start_confirm_ms: Option<At<u64>>,
    /// Time between repeated starts, 10..=65535 ms (R-DET-020).
    pub start_retry_ms: Option<At<u64>>,
    /// Send reset node when a lost node comes back (R-DET-016).
    pub reset_on_recovery: Option<bool>,
    /// The node has to be there: one that never came is an alarm. Default: true.
    pub required: Option<bool>,
    /// Read and write its objects by SDO. Default: true; off: it is started and listened to, and nothing more (R-DST-122).
    pub configure: Option<bool>,
    /// Do not start a node that is another device than the mapping is for (R-DST-001). Default: true.
    pub check_identity: Option<bool>,
    /// Heartbeat that the node is to send, 10..=65535 ms (R-DST-061).
    pub heartbeat_ms: Option<At<u64>>,
    /// The node is told to supervise the gateway: it misses a heartbeat after 10..=65535 ms (0x1016, R-DST-062). Default: it
    /// is not told anything.
    pub supervise_gateway_ms: Option<At<u64>>,
    /// The node starts by itself (R-DST-059).
    pub self_starting: Option<bool>,
    /// Store the parameters in the node after something was written (R-DST-090).
    pub save_after_config: Option<bool>,
    /// How long the answer to a store may take, 100..=60000 ms (R-DST-073).
    pub store_timeout_ms: Option<At<u64>>,
    /// How long any other SDO answer may take, 10..=60000 ms (R-DST-073).
    pub sdo_timeout_ms: Option<At<u64>>,
    /// For every TPDO of the node: stale after this long, 10..=3600000 ms; 0 = not supervised (R-DET-082).
    pub pdo_timeout_ms: Option<At<u64>>,
    /// For every TPDO of the node: discard frames that are too long (R-DET-081).
    pub strict_dlc: Option<bool>,
    /// Send the node the RPDOs of its mapping. Default: false.
    #[serde(default)]
    pub outputs: At<bool>,
    /// Changes to TPDOs of the mapping, by their number.
    #[serde(default)]
    pub tpdo: BTreeMap<At<String>, TpdoEntry>,
    /// What the coding switch of an esd module says, 1..=0xCB, of a SIO1 1..=0xCC (R-ESD-021). Default: the `id`.
    pub coding_switch: Option<At<u64>>,
    /// Supervise and configure an esd module by commands. Default: true where its bus has a `reply_id` and the gateway is
    /// master.
    pub manage: Option<At<bool>>,
    /// First Tx activate delay that an esd module is to have, 0..=65535 ms (R-ESD-090). Default: as it has it.
    pub first_tx_delay_ms: Option<At<u64>>,
    /// How often an esd module is asked for its status, 100..=60000 ms. Default: 2000.
    pub status_period_ms: Option<At<u64>>,
    /// Identifier of the watchdog of an esd module, 0x001..=0x7FF (R-ESD-082). Default: no watchdog.
    pub watchdog_id: Option<At<u64>>,
    /// Time between two requests of the watchdog, 20..=65535 ms (R-ESD-087). Default: 1000.
    pub watchdog_ms: Option<At<u64>>,
    /// After so many times this without a request the module resets itself, 1..=255 (R-ESD-087). Default: 3.
    pub watchdog_factor: Option<At<u64>>,
    /// How the watchdog is asked. Default: remote.
    pub watchdog_by: Option<At<WatchdogWord>>,
    /// Serial lines of an esd module that are used, by their number.
    #[serde(default)]
    pub channel: BTreeMap<At<String>, ChannelEntry>,
    /// Changes to tags of the mapping.
    #[serde(default)]
    pub tag: BTreeMap<At<String>, TagEntry>,
    /// Changes to alarms, of the mapping or built in.
    #[serde(default)]
    pub alarm: BTreeMap<At<String>, AlarmEntry>,
}

impl NodeEntry {
    /// A node with nothing but what has no default.
    #[must_use]
    pub fn new(bus: &str, id: u8, mapping: &str) -> Self {
        Self {
            bus: At::nowhere(bus.to_owned()),
            id: At::nowhere(id.into()),
            mapping: At::nowhere(mapping.to_owned()),
            ..Self::default()
        }
    }
}

/// `[node.NAME.tpdo.NUMBER]`: how this installation wants a TPDO sent. Written to the device as the mapping's own keys are.
#[derive(Clone, Debug, Default, PartialEq, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct TpdoEntry {
    /// Transmission type, 0..=255.
    pub transmission_type: Option<At<u64>>,
    /// Event timer, 0..=65535 ms.
    pub event_timer_ms: Option<At<u64>>,
    /// Inhibit time in microseconds, 0..=6553500 in steps of 100.
    pub inhibit_time_us: Option<At<u64>>,
}

/// `[node.NAME.tag.TAG]`: what this installation changes of a tag.
#[derive(Clone, Debug, Default, PartialEq, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct TagEntry {
    /// Invert all its bits (R-DET-051); tags of a TPDO only.
    pub invert: Option<At<bool>>,
    /// Order of its bytes (R-DET-050); tags of a TPDO only.
    pub byte_order: Option<At<ByteOrderWord>>,
    /// A smaller change is not published by itself; in engineering units.
    pub deadband: Option<At<f64>>,
    /// One sentence.
    pub description: Option<String>,
}

/// `[node.NAME.alarm.ALARM]`: what this installation changes of an alarm.
#[derive(Clone, Debug, Default, PartialEq, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct AlarmEntry {
    /// Off: the condition is never raised.
    pub enabled: Option<bool>,
    /// How urgent.
    pub priority: Option<PriorityWord>,
    /// The condition must hold this long, 0..=86400000 ms.
    pub on_delay_ms: Option<At<u64>>,
    /// The condition must be gone this long, 0..=86400000 ms.
    pub off_delay_ms: Option<At<u64>>,
    /// Stay until acknowledged and reset.
    pub latch: Option<bool>,
}

/// `on_loss`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum OnLossWord {
    /// A value that cannot be mistaken: 0xFFFF, 0x8000, NaN.
    #[default]
    Invalid,
    /// The last value; the status word tells.
    Hold,
    /// Exception 0x0B for a range that touches invalid data.
    Exception,
}

impl From<OnLossWord> for OnLoss {
    fn from(word: OnLossWord) -> Self {
        match word {
            OnLossWord::Invalid => Self::Invalid,
            OnLossWord::Hold => Self::Hold,
            OnLossWord::Exception => Self::Exception,
        }
    }
}

/// How the life of a node is watched.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum ErrorControlWord {
    /// The gateway asks by remote frame.
    #[default]
    Guarding,
    /// The node tells by itself.
    Heartbeat,
    /// Not at all.
    None,
}

/// What a wrong toggle bit means.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum ToggleWord {
    /// As if the reply had not come.
    #[default]
    Strict,
    /// Counted, but accepted.
    Warn,
    /// Not looked at.
    Off,
}

impl From<ToggleWord> for TogglePolicy {
    fn from(word: ToggleWord) -> Self {
        match word {
            ToggleWord::Strict => Self::Strict,
            ToggleWord::Warn => Self::Warn,
            ToggleWord::Off => Self::Off,
        }
    }
}

/// Order of the bytes of a field.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum ByteOrderWord {
    /// Least significant byte first, as CANopen does.
    #[default]
    Little,
    /// Most significant byte first.
    Big,
}

/// How urgent an alarm is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum PriorityWord {
    /// To be seen in time.
    Low,
    /// To be acted on soon.
    Medium,
    /// To be acted on at once.
    High,
    /// Damage or danger.
    Critical,
}

impl From<PriorityWord> for Priority {
    fn from(word: PriorityWord) -> Self {
        match word {
            PriorityWord::Low => Self::Low,
            PriorityWord::Medium => Self::Medium,
            PriorityWord::High => Self::High,
            PriorityWord::Critical => Self::Critical,
        }
    }
}
