//! What a mapping says of the gateway as master of the device: identity, supervision, start, TPDOs, settings.

use schemars::JsonSchema;
use serde::Deserialize;

use super::super::At;
use super::super::installation::{ErrorControlWord, ToggleWord};
use super::values::CobId;

/// `[error_control]`.
#[derive(Clone, Debug, Default, PartialEq, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct ErrorControlSection {
    /// Guarding, heartbeat or none. Default: guarding.
    #[serde(default)]
    pub kind: ErrorControlWord,
    /// Time between two guard requests, 20..=65535; 0 = guarding off. Default: 500.
    pub guard_time_ms: Option<At<u64>>,
    /// Missed replies in a row until the node is lost, 1..=255. Default: 3.
    pub life_time_factor: Option<At<u64>>,
    /// A guard reply later than this is missed; 1..= the guard time. Default: 100.
    pub guard_reply_ms: Option<At<u64>>,
    /// What a wrong toggle bit means. Default: strict.
    #[serde(default)]
    pub toggle_check: ToggleWord,
    /// Whether a wrong toggle bit becomes the one that the next is compared with. Default: false.
    #[serde(default)]
    pub toggle_resync: bool,
    /// Length code of the guard request, 0..=8. Default: 1.
    pub rtr_dlc: Option<At<u64>>,
    /// Pause between an NMT command and the next guard request, 0..=10000. Default: 20.
    pub settle_ms: Option<At<u64>>,
    /// Heartbeat that the node is to send (0x1017), 10..=65535; written where it differs. Absent: as the node has it.
    pub heartbeat_ms: Option<At<u64>>,
    /// A heartbeat node is lost after this long without a sign of life, 10..=65535. Default: 1500.
    pub heartbeat_timeout_ms: Option<At<u64>>,
}

/// `[start]`.
#[derive(Clone, Debug, Default, PartialEq, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct StartSection {
    /// Start the node whenever it waits for it. Default: true.
    pub auto_start: Option<bool>,
    /// Start at the latest this long after a boot-up message, 0..=65535. Default: 500.
    pub start_delay_ms: Option<At<u64>>,
    /// A start without effect for this long is repeated, 10..=65535. Default: 1000.
    pub start_confirm_ms: Option<At<u64>>,
    /// Time between repeated starts, 10..=65535. Default: 1000.
    pub start_retry_ms: Option<At<u64>>,
    /// Send reset node when a lost node comes back. Default: false.
    #[serde(default)]
    pub reset_on_recovery: bool,
    /// The node starts by itself (0x1F80): it is not started, and put into pre-operational only to be configured. Default: false.
    pub self_starting: Option<bool>,
    /// Store the parameters in the node (0x1010:1) after something was written. Its memory wears. Default: false.
    pub save_after_config: Option<bool>,
    /// How long the answer to a store may take, 100..=60000. Default: 3000.
    pub store_timeout_ms: Option<At<u64>>,
    /// How long any other SDO answer may take, 10..=60000. Default: 500.
    pub sdo_timeout_ms: Option<At<u64>>,
}

/// `[tpdo.NUMBER]`.
#[derive(Clone, Debug, PartialEq, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct TpdoSection {
    /// Its identifier: `"$NODEID+0x180"`, or a number; one above 0x7FF is a 29-bit identifier.
    pub cob_id: At<CobId>,
    /// Bytes that it has, 1..=8; a shorter frame is discarded. Follows from `maps` where that is given, and must agree with it.
    pub length: Option<At<u64>>,
    /// What it carries, in order, each `"0xINDEX:SUB/BITS"`, for example `"0x6130:1/32"`.
    #[serde(default)]
    pub maps: Vec<At<String>>,
    /// Bytes that it has in a device as it is shipped, 1..=8, where that differs: only for recognising it.
    pub shipped_length: Option<At<u64>>,
    /// What is done where the node has another mapping. Default: write; without `maps` nothing is read or written.
    #[serde(default)]
    pub mapping: MappingWord,
    /// Transmission type, 0..=255, written where it differs. Absent: as the node has it.
    pub transmission_type: Option<At<u64>>,
    /// Event timer, 0..=65535, written where it differs. Absent: as the node has it.
    pub event_timer_ms: Option<At<u64>>,
    /// Inhibit time in microseconds, 0..=6553500 in steps of 100, written where it differs. Absent: as the node has it.
    pub inhibit_time_us: Option<At<u64>>,
    /// Mark the PDO as not valid while its mapping is changed; only where it is. Default: false.
    #[serde(default)]
    pub set_pdo_invalid: At<bool>,
    /// Time between two frames when nothing happens, 1..=3600000.
    pub period_ms: Option<At<u64>>,
    /// Shortest time between two frames that the device is known to keep, 1..=3600000; a much faster rate is suspicious.
    pub shortest_period_ms: Option<At<u64>>,
    /// Stale after this long, 10..=3600000; 0 = not supervised. Default: three periods, or three times the event timer.
    pub timeout_ms: Option<At<u64>>,
    /// Discard a frame that is too long instead of using its first bytes. Default: false.
    #[serde(default)]
    pub strict_dlc: bool,
    /// Bits that the maker calls reserved, each as `[first bit, how many]`; a set one is counted.
    #[serde(default)]
    pub reserved_bits: Vec<At<[u64; 2]>>,
}

/// `[rpdo.NUMBER]`: what the gateway sends the device, where the configuration allows it (`outputs = true`).
#[derive(Clone, Debug, PartialEq, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct RpdoSection {
    /// Its identifier: `"$NODEID+0x200"`, or a number; one above 0x7FF is a 29-bit identifier.
    pub cob_id: At<CobId>,
    /// Bytes that it has, 1..=8. Follows from `maps` where that is given, and must agree with it.
    pub length: Option<At<u64>>,
    /// What it carries, in order, each `"0xINDEX:SUB/BITS"`.
    #[serde(default)]
    pub maps: Vec<At<String>>,
    /// What is done where the node has another mapping: with `verify` nothing is sent; not `adopt`. Default: write; without
    /// `maps` nothing is read or written.
    #[serde(default)]
    pub mapping: At<MappingWord>,
    /// 254 and 255: sent when it changes; 1..=240: after every so many SYNCs; 0: after the next SYNC when it changed. With
    /// `maps` written where it differs. Default: 255, and as the node has it.
    pub transmission_type: Option<At<u64>>,
    /// Sent again after this long without a change, 10..=3600000; 0 = not. Default: 1000.
    pub refresh_ms: Option<At<u64>>,
    /// At least this long between two frames, 0..=65535; not with SYNC. Default: 10.
    pub inhibit_ms: Option<At<u64>>,
    /// What is sent when the node takes part again. Default: default.
    #[serde(default)]
    pub on_start: OnStartWord,
    /// Mark the PDO as not valid while its mapping is changed; only where it is. Default: false.
    #[serde(default)]
    pub set_pdo_invalid: At<bool>,
}

/// What an RPDO begins with when its node takes part again.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum OnStartWord {
    /// The defaults of its tags; a tag without one has to be written again.
    #[default]
    Default,
    /// The values that were written last.
    Last,
}

/// `[identity]`: each key that is given must be what the node says.
#[derive(Clone, Debug, Default, PartialEq, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct IdentitySection {
    /// Device type, 0x1000.
    pub device_type: Option<At<u64>>,
    /// Vendor, 0x1018:1.
    pub vendor_id: Option<At<u64>>,
    /// Product code, 0x1018:2.
    pub product_code: Option<At<u64>>,
    /// Revision, 0x1018:3.
    pub revision_number: Option<At<u64>>,
}

/// What is done where a node has another PDO mapping than the file.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum MappingWord {
    /// It is changed in the node.
    #[default]
    Write,
    /// It is told, and the values of another content are withheld; another transmission type or timer is told only.
    Verify,
    /// Nothing is read or written: the file is believed.
    Fixed,
    /// Nothing is written: tags that name an `object` are decoded where the node has it.
    Adopt,
}

/// `[[setup]]`: an object that is to have a value.
#[derive(Clone, Debug, PartialEq, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct SetupSection {
    /// Which, `"0xINDEX:SUB"`.
    pub object: At<String>,
    /// `u8`..`u64`, `i8`..`i64`, `f32` or `f64`.
    #[serde(rename = "type")]
    pub kind: At<String>,
    /// Its value.
    pub value: At<SetupValue>,
    /// A node that refuses it is started all the same. Default: false.
    #[serde(default)]
    pub optional: bool,
}

/// A number of either kind.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize, JsonSchema)]
#[serde(untagged)]
pub enum SetupValue {
    /// A whole number.
    Whole(i64),
    /// Any other.
    Real(f64),
}
