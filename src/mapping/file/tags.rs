//! Entries of a mapping that make tags, from data of the device or computed.

use schemars::JsonSchema;
use serde::Deserialize;

use super::super::At;
use super::super::installation::ByteOrderWord;
use super::emergency::EmergencyWord;
use super::esd::ModuleWord;
use super::values::NameList;

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
            /// A bool tag that is true while the value is to be used with a reservation, such as outside its range.
            pub doubtful: Option<At<String>>,
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
                    doubtful: self.doubtful.as_ref(),
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
    /// A bool tag that is true while the value is to be used with a reservation.
    pub doubtful: Option<&'a At<String>>,
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
        /// Number of the RPDO in which the gateway sends it, with `bit` or `object`.
        pub rpdo: Option<At<u64>>,
        /// Place of its lowest bit: byte b bit i = 8 b + i.
        pub bit: Option<At<u64>>,
        /// What is sent before anything was written; tags of an RPDO only. Default: nothing is sent before.
        pub default: Option<At<WrittenValue>>,
        /// Lowest value that can be written; tags of an RPDO and with `writable`. Default: what its type can hold.
        pub minimum: Option<At<f64>>,
        /// Highest value that can be written; tags of an RPDO and with `writable`. Default: what its type can hold.
        pub maximum: Option<At<f64>>,
        /// The object that it is, `"0xINDEX:SUB"`: taken from the TPDO that maps it, else read every `poll_ms`.
        pub object: Option<At<String>>,
        /// How often an object that no TPDO maps is read by SDO, 100..=86400000.
        pub poll_ms: Option<At<u64>>,
        /// It may be written by SDO, by clients whose `[access.NAME]` lists it; tags with `object` only. Default: false.
        pub writable: Option<At<bool>>,
        /// What of the emergency messages it shows, instead of `tpdo` and `bit` or `object`.
        pub emergency: Option<At<EmergencyWord>>,
        /// What of an esd module it shows, instead of all these.
        pub module: Option<At<ModuleWord>>,
        /// The number of the serial line that `module` means; that of the first of an array.
        pub channel: Option<At<u64>>,
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
        /// The object in which the device tells the unit, `"0xINDEX:SUB"`. Values are converted to `unit`; that is
        /// `"device"` where they are to stay in the device's own.
        pub unit_object: Option<At<String>>,
        /// The object in which the device tells how many decimal digits its whole numbers have, instead of `scale`.
        pub digits_object: Option<At<String>>,
    }
    /// Digits after the decimal point, 0..=12. Default: 2 where it is scaled or a float, else 0.
    decimals
}

/// A value that can be written: a bit, or a number.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize, JsonSchema)]
#[serde(untagged)]
pub enum WrittenValue {
    /// A bit.
    Bit(bool),
    /// A whole number.
    Whole(i64),
    /// Any other.
    Real(f64),
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
    /// Registers from one element of an array to the next. Default: those that one takes.
    pub stride: Option<At<u64>>,
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
