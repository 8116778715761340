//! The TOML form of a device mapping, as `mappings/README.md` teaches it.
//!
//! Numbers are read wide and names as text; [`build`](super::build()) checks them, so that all problems are told at once.

use std::collections::BTreeMap;

use schemars::JsonSchema;
use serde::Deserialize;

use super::At;
use super::file_values::{CobId, NameList};
use super::installation::{ByteOrderWord, ErrorControlWord, PriorityWord, ToggleWord};

/// A device mapping.
#[derive(Clone, Debug, PartialEq, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
#[schemars(title = "cangate device mapping")]
pub struct MappingFile {
    /// Version of this format: 1.
    pub format: At<u64>,
    /// What device it is.
    pub device: DeviceSection,
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
    /// Objects that are written before it is started, where it has them otherwise.
    #[serde(default)]
    pub setup: Vec<SetupSection>,
    /// Constants that an installation can set for each node.
    #[serde(default)]
    pub parameter: Vec<ParameterSection>,
    /// Values that stand in its TPDOs.
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

/// `[tpdo.NUMBER]`.
#[derive(Clone, Debug, PartialEq, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct TpdoSection {
    /// Its identifier: `"$NODEID+0x180"`, or a number; one above 0x7FF is a 29-bit identifier.
    pub cob_id: At<CobId>,
    /// Bytes that it has, 1..=8; a shorter frame is discarded. Follows from `maps` where that is given.
    pub length: Option<At<u64>>,
    /// What it carries, in order, each `"0xINDEX:SUB/BITS"`, for example `"0x6130:1/32"`.
    #[serde(default)]
    pub maps: Vec<At<String>>,
    /// What is done where the node has another mapping. Default: write; without `maps` nothing is read or written.
    #[serde(default)]
    pub mapping: MappingWord,
    /// Transmission type, 0..=255, written where it differs. Absent: as the node has it.
    pub transmission_type: Option<At<u64>>,
    /// Event timer, 0..=65535, written where it differs. Absent: as the node has it.
    pub event_timer_ms: Option<At<u64>>,
    /// Inhibit time in microseconds, 0..=6553500 in steps of 100, written where it differs. Absent: as the node has it.
    pub inhibit_time_us: Option<At<u64>>,
    /// Mark the PDO as not valid while its mapping is changed. Default: false.
    #[serde(default)]
    pub set_pdo_invalid: bool,
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
    /// It is told, and its values are withheld.
    Verify,
    /// Nothing is read or written: the file is believed.
    Fixed,
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

/// An entry that makes tags: keys of its own among those that all such entries share.
///
/// The shared ones stand here once, and no reader of TOML is between them and the file: a `flatten` would lose the
/// places of the values and the unknown keys. `decimals` has a text for each kind of entry, as its default differs.
macro_rules! tag_entry {
    (
        $(#[$about:meta])*
        pub struct $name:ident { $($own:tt)* }
        $(#[$decimals:meta])*
        decimals
    ) => {
        $(#[$about])*
        #[derive(Clone, Debug, PartialEq, Deserialize, JsonSchema)]
        #[serde(deny_unknown_fields)]
        pub struct $name {
            /// Its name, unique, snake case. With `array` it holds `{}`.
            pub name: At<String>,
            /// One sentence.
            #[serde(default)]
            pub description: String,
            $($own)*
            /// Engineering unit.
            #[serde(default)]
            pub unit: String,
            $(#[$decimals])*
            pub decimals: Option<At<u64>>,
            /// A smaller change is not published by itself; in engineering units. Default: 0.
            pub deadband: Option<At<f64>>,
            /// A bool tag that tells whether the value means anything.
            pub valid: Option<At<String>>,
            /// Part of the MQTT state message. Default: true.
            pub publish: Option<bool>,
            /// Where it stands in the register map.
            #[serde(default)]
            pub registers: Vec<RegisterSection>,
            /// Address among the discrete inputs and coils; bool tags only.
            pub bit_address: Option<At<u64>>,
            /// Makes several tags of one entry.
            pub array: Option<At<ArraySection>>,
        }

        impl $name {
            /// The keys that it shares with other entries that make tags.
            #[must_use]
            pub fn shared(&self) -> SharedKeys<'_> {
                SharedKeys {
                    description: &self.description,
                    unit: &self.unit,
                    decimals: self.decimals.as_ref(),
                    deadband: self.deadband.as_ref(),
                    valid: self.valid.as_ref(),
                    publish: self.publish,
                    registers: &self.registers,
                    bit_address: self.bit_address.as_ref(),
                }
            }
        }
    };
}

/// What all entries that make tags say of them, whatever their values come from; name and array apart.
#[derive(Clone, Copy, Debug)]
pub struct SharedKeys<'a> {
    /// One sentence.
    pub description: &'a str,
    /// Engineering unit.
    pub unit: &'a str,
    /// Digits after the decimal point.
    pub decimals: Option<&'a At<u64>>,
    /// A smaller change is not published by itself; in engineering units.
    pub deadband: Option<&'a At<f64>>,
    /// A bool tag that tells whether the value means anything.
    pub valid: Option<&'a At<String>>,
    /// Part of the MQTT state message.
    pub publish: Option<bool>,
    /// Where it stands in the register map.
    pub registers: &'a [RegisterSection],
    /// Address among the discrete inputs and coils.
    pub bit_address: Option<&'a At<u64>>,
}

tag_entry! {
    /// `[[tag]]`.
    pub struct TagSection {
        /// Number of the TPDO that carries it, with `bit`; or `object` instead of both.
        pub tpdo: Option<At<u64>>,
        /// Place of its lowest bit: byte b bit i = 8 b + i.
        pub bit: Option<At<u64>>,
        /// The object that it is, `"0xINDEX:SUB"`: taken from the TPDO that maps it, else read every `poll_ms`.
        pub object: Option<At<String>>,
        /// How often an object that no TPDO maps is read by SDO, 100..=86400000.
        pub poll_ms: Option<At<u64>>,
        /// `bool`, `u1`..`u64`, `i2`..`i64`, `f32` or `f64`.
        #[serde(rename = "type")]
        #[schemars(regex(pattern = r"^(bool|f32|f64|[ui]([1-9]|[1-5][0-9]|6[0-4]))$"))]
        pub kind: At<String>,
        /// Order of its bytes; `big` needs whole bytes. Default: little.
        #[serde(default)]
        pub byte_order: ByteOrderWord,
        /// Invert all its bits. Default: false.
        #[serde(default)]
        pub invert: bool,
        /// From the raw number to engineering units. Default: as it is.
        pub scale: Option<At<ScaleSection>>,
    }
    /// Digits after the decimal point, 0..=12. Default: 2 where it is scaled or a float, else 0.
    decimals
}

/// `value = raw * multiply / divide + add`.
#[derive(Clone, Debug, PartialEq, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct ScaleSection {
    /// Multiplied first. Default: 1.
    pub multiply: Option<f64>,
    /// Divided then. Default: 1.
    pub divide: Option<f64>,
    /// Added last. Default: 0.
    pub add: Option<f64>,
}

/// One place in the register map.
#[derive(Clone, Debug, PartialEq, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct RegisterSection {
    /// 0-based address as on the wire, 100..=65535, of the first of an array.
    pub address: At<u64>,
    /// How the value is written there.
    #[serde(rename = "type")]
    pub encoding: At<EncodingWord>,
    /// Engineering units per count, for u16, i16, u32 and i32. Default: 1.
    pub resolution: Option<At<f64>>,
}

/// How a value is written into registers.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum EncodingWord {
    /// One register without sign.
    U16,
    /// One register, two's complement.
    I16,
    /// Two registers without sign.
    U32,
    /// Two registers, two's complement.
    I32,
    /// Two registers, IEEE 754.
    F32,
    /// The raw value in one register.
    Raw16,
    /// The raw value in two registers.
    Raw32,
}

/// `array`: either numbered, or one for each of a list of words. `{}` in texts stands for the number or word.
#[derive(Clone, Debug, PartialEq, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct ArraySection {
    /// Number of the first. Default: 1.
    pub first: Option<At<u64>>,
    /// How many, 1..=1024.
    pub count: Option<At<u64>>,
    /// The words, instead of `first` and `count`.
    pub words: Option<Vec<At<String>>>,
    /// Bits from one to the next in the TPDO. Default: the width of the type.
    pub bit_stride: Option<At<u64>>,
}

tag_entry! {
    /// `[[derived]]`: a name and exactly one of the ways to compute it.
    pub struct DerivedSection {
        /// One bit of an unsigned tag; in an array each takes the next bit.
        pub bit: Option<BitSection>,
        /// Bool tags as the bits of a number, the first lowest.
        pub pack: Option<At<NameList>>,
        /// A condition.
        pub when: Option<At<String>>,
        /// The highest of several values.
        pub maximum: Option<At<NameList>>,
        /// The number of the highest of several values.
        pub arg_maximum: Option<At<NameList>>,
        /// The smallest distance of several values up to a limit; negative above it.
        pub margin: Option<MarginSection>,
        /// How many bool tags are true.
        pub count: Option<At<NameList>>,
        /// Rising edges of a bool tag since the start, modulo 65536.
        pub rising_edges: Option<At<String>>,
        /// Seconds since the last rising edge of a bool tag; 65535 = never.
        pub seconds_since_rise: Option<At<String>>,
        /// A bool tag that stays true until the node's alarms are acknowledged.
        pub latch: Option<At<String>>,
        /// Rising edges of a bool tag within the last seconds.
        pub edges_within: Option<EdgesSection>,
        /// For `maximum`, `arg_maximum` and `margin`: a bool tag for each value that tells whether it takes part.
        #[serde(rename = "where")]
        pub only_where: Option<At<NameList>>,
    }
    /// Digits after the decimal point, 0..=12. Default: 2 for `maximum` and `margin`, else 0.
    decimals
}

/// One bit of an unsigned tag.
#[derive(Clone, Debug, PartialEq, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct BitSection {
    /// The tag.
    pub of: At<String>,
    /// 0 = lowest.
    pub bit: At<u64>,
}

/// The smallest distance up to a limit.
#[derive(Clone, Debug, PartialEq, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct MarginSection {
    /// The values.
    pub of: At<NameList>,
    /// The tag that is the limit.
    pub to: At<String>,
}

/// Rising edges within the last seconds.
#[derive(Clone, Debug, PartialEq, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct EdgesSection {
    /// The bool tag.
    pub of: At<String>,
    /// How far back, 1..=86400.
    pub window_s: At<u64>,
}

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
