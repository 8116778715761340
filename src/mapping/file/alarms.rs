//! Entries of a mapping about alarms.

use schemars::JsonSchema;
use serde::Deserialize;

use super::super::At;
use super::super::installation::PriorityWord;
use super::tags::ArraySection;

/// `[[alarm]]`.
#[derive(Clone, Debug, PartialEq, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct AlarmSection {
    /// Its name, unique among alarms, snake case. With `array` it holds `{}`.
    pub name: At<String>,
    /// The condition.
    pub when: At<String>,
    /// How urgent.
    pub priority: PriorityWord,
    /// The condition must hold this long, 0..=86400000. Default: 0.
    pub on_delay_ms: Option<At<u64>>,
    /// The condition must be gone this long, 0..=86400000. Default: 0.
    pub off_delay_ms: Option<At<u64>>,
    /// Stay until acknowledged and reset. Default: false.
    #[serde(default)]
    pub latch: bool,
    /// Take part in the node's first-out. Default: false.
    #[serde(default)]
    pub first_out: bool,
    /// Alarms that tell the cause, of this file, built in, or of the bus.
    #[serde(default)]
    pub suppressed_by: Vec<At<String>>,
    /// The tag whose value is shown with the alarm.
    pub value: Option<At<String>>,
    /// What it means, one sentence.
    pub text: String,
    /// What the operator should do.
    pub action: String,
    /// Its bit at discrete inputs 128 (active) and 160 (unacknowledged), 16..=31; an array shares one bit.
    pub bit: Option<At<u64>>,
    /// Default: true.
    pub enabled: Option<bool>,
    /// Makes several alarms of one entry.
    pub array: Option<At<ArraySection>>,
}

/// `[builtin_alarm.NAME]`: what the device changes of an alarm that every node has.
#[derive(Clone, Debug, Default, PartialEq, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct BuiltinAlarmSection {
    /// How urgent.
    pub priority: Option<PriorityWord>,
    /// The condition must hold this long, 0..=86400000.
    pub on_delay_ms: Option<At<u64>>,
    /// The condition must be gone this long, 0..=86400000.
    pub off_delay_ms: Option<At<u64>>,
    /// Stay until acknowledged and reset.
    pub latch: Option<bool>,
    /// Off: the condition is never raised.
    pub enabled: Option<bool>,
    /// What it means for this device, one sentence.
    pub text: Option<String>,
    /// What the operator should do.
    pub action: Option<String>,
}
