//! What a mapping says of the emergency messages of the device, and of the errors that they tell of.

use schemars::JsonSchema;
use serde::Deserialize;

use super::super::At;
use super::super::installation::PriorityWord;
use super::values::CobId;

/// `[emergency]`.
#[derive(Clone, Debug, Default, PartialEq, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct EmergencySection {
    /// Identifier of its emergency messages; one above 0x7FF is a 29-bit identifier. Default: `"$NODEID+0x80"`.
    pub cob_id: Option<At<CobId>>,
    /// Ask it before every start what is wrong: error register (0x1001) and newest error (0x1003:1). Default: false.
    #[serde(default)]
    pub read_at_boot: bool,
    /// How often the error register is read besides, 100..=86400000, so that a message that was lost is made good. Absent:
    /// never.
    pub register_poll_ms: Option<At<u64>>,
    /// Errors that have alarms of their own.
    #[serde(default)]
    pub error: Vec<ErrorSection>,
}

/// `[[emergency.error]]`.
#[derive(Clone, Debug, PartialEq, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct ErrorSection {
    /// Error code, 1..=65535.
    pub code: At<u64>,
    /// The bits of the code that count, 1..=65535: 0xFF00 makes a class of it. Of several that match, the one with most bits
    /// counts. Default: all.
    pub mask: Option<At<u64>>,
    /// Name of its alarm, unique among alarms, snake case.
    pub name: At<String>,
    /// How urgent.
    pub priority: PriorityWord,
    /// What it means, one sentence.
    pub text: String,
    /// What the operator should do.
    pub action: String,
    /// The bit of the error register that it sets besides bit 0, 1..=7: without it the error is gone.
    pub register_bit: Option<At<u64>>,
    /// The error must be there this long, 0..=86400000. Default: 0.
    pub on_delay_ms: Option<At<u64>>,
    /// The error must be gone this long, 0..=86400000. Default: 0.
    pub off_delay_ms: Option<At<u64>>,
    /// Stay until acknowledged and reset. Default: false.
    #[serde(default)]
    pub latch: bool,
    /// Take part in the node's first-out. Default: false.
    #[serde(default)]
    pub first_out: bool,
    /// Alarms that tell the cause, besides those of the bus and `node_lost`.
    #[serde(default)]
    pub suppressed_by: Vec<At<String>>,
    /// Its bit at discrete inputs 128 (active) and 160 (unacknowledged), 16..=31; several errors may share one.
    pub bit: Option<At<u64>>,
    /// Off: its code raises no alarm. Default: true.
    pub enabled: Option<bool>,
}

/// What of the emergency messages a tag shows.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum EmergencyWord {
    /// Error code of the last; 0 = none.
    Code,
    /// Error register, of the last or as it was read.
    Register,
    /// Manufacturer bytes of the last.
    Vendor,
    /// How many errors are there.
    ActiveCount,
}
