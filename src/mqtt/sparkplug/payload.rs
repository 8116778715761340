//! The payload of Sparkplug B as its `sparkplug_b.proto` defines it (Sparkplug 3.0, chapter 6), and what is read of commands.
//!
//! The messages and field numbers are those of the specification; of data sets, templates and files nothing is sent or read.

use prost::Message;

/// Data types of metrics (Sparkplug 3.0, 6.4.16).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum DataType {
    /// 32 bits with sign; narrower numbers are sent as this one, because hosts differ in how they extend their sign.
    Int32,
    /// 64 bits with sign.
    Int64,
    /// 8 bits.
    UInt8,
    /// 16 bits.
    UInt16,
    /// 32 bits.
    UInt32,
    /// 64 bits.
    UInt64,
    /// IEEE 754, 64 bits.
    Double,
    /// True or false.
    Boolean,
    /// Text.
    String,
}

impl DataType {
    /// Its number.
    #[must_use]
    pub fn code(self) -> u32 {
        match self {
            Self::Int32 => 3,
            Self::Int64 => 4,
            Self::UInt8 => 5,
            Self::UInt16 => 6,
            Self::UInt32 => 7,
            Self::UInt64 => 8,
            Self::Double => 10,
            Self::Boolean => 11,
            Self::String => 12,
        }
    }
}

/// A payload.
#[derive(Clone, PartialEq, Message)]
pub struct Payload {
    /// When it was sent, ms since 1970 UTC.
    #[prost(uint64, optional, tag = "1")]
    pub timestamp: Option<u64>,
    /// Its metrics.
    #[prost(message, repeated, tag = "2")]
    pub metrics: Vec<Metric>,
    /// Sequence number, 0..=255; none in NDEATH.
    #[prost(uint64, optional, tag = "3")]
    pub seq: Option<u64>,
}

/// A metric.
#[derive(Clone, PartialEq, Message)]
pub struct Metric {
    /// Its name: in births.
    #[prost(string, optional, tag = "1")]
    pub name: Option<String>,
    /// Its number: in births beside the name, in data instead of it.
    #[prost(uint64, optional, tag = "2")]
    pub alias: Option<u64>,
    /// When the value was received, ms since 1970 UTC.
    #[prost(uint64, optional, tag = "3")]
    pub timestamp: Option<u64>,
    /// [`DataType::code`]; in births.
    #[prost(uint32, optional, tag = "4")]
    pub datatype: Option<u32>,
    /// It was kept, and is not the present value.
    #[prost(bool, optional, tag = "5")]
    pub is_historical: Option<bool>,
    /// There is no value.
    #[prost(bool, optional, tag = "7")]
    pub is_null: Option<bool>,
    /// What else is said of it.
    #[prost(message, optional, tag = "9")]
    pub properties: Option<PropertySet>,
    /// Its value.
    #[prost(oneof = "MetricValue", tags = "10, 11, 12, 13, 14, 15")]
    pub value: Option<MetricValue>,
}

/// A value of a metric.
#[derive(Clone, PartialEq, prost::Oneof)]
pub enum MetricValue {
    /// Whole numbers of up to 32 bits; with sign as two's complement.
    #[prost(uint32, tag = "10")]
    Int(u32),
    /// Whole numbers of 64 bits; with sign as two's complement.
    #[prost(uint64, tag = "11")]
    Long(u64),
    /// IEEE 754, 32 bits.
    #[prost(float, tag = "12")]
    Float(f32),
    /// IEEE 754, 64 bits.
    #[prost(double, tag = "13")]
    Double(f64),
    /// True or false.
    #[prost(bool, tag = "14")]
    Boolean(bool),
    /// Text.
    #[prost(string, tag = "15")]
    String(String),
}

/// Properties of a metric: as many values as keys.
#[derive(Clone, PartialEq, Message)]
pub struct PropertySet {
    /// Their names.
    #[prost(string, repeated, tag = "1")]
    pub keys: Vec<String>,
    /// Their values.
    #[prost(message, repeated, tag = "2")]
    pub values: Vec<PropertyValue>,
}

impl PropertySet {
    /// Adds a text, unless it is empty.
    pub fn push_text(&mut self, key: &str, text: &str) {
        if !text.is_empty() {
            self.push(key, DataType::String, PropertyContent::String(text.to_owned()));
        }
    }

    /// Adds a quality code (tck-id-payloads-propertyset-quality-value-type: an Int32).
    pub fn push_quality(&mut self, code: u32) {
        self.push("Quality", DataType::Int32, PropertyContent::Int(code));
    }

    fn push(&mut self, key: &str, data_type: DataType, value: PropertyContent) {
        self.keys.push(key.to_owned());
        self.values.push(PropertyValue { data_type: Some(data_type.code()), value: Some(value) });
    }
}

/// A value of a property.
#[derive(Clone, PartialEq, Message)]
pub struct PropertyValue {
    /// [`DataType::code`].
    #[prost(uint32, optional, tag = "1")]
    pub data_type: Option<u32>,
    /// It.
    #[prost(oneof = "PropertyContent", tags = "3, 8")]
    pub value: Option<PropertyContent>,
}

/// What a property can hold here.
#[derive(Clone, PartialEq, prost::Oneof)]
pub enum PropertyContent {
    /// Whole numbers of up to 32 bits.
    #[prost(uint32, tag = "3")]
    Int(u32),
    /// Text.
    #[prost(string, tag = "8")]
    String(String),
}

/// A command with this name, and true, asks for births.
pub const REBIRTH: &str = "Node Control/Rebirth";

/// Whether a command asks for births (tck-id-operational-behavior-data-commands-ncmd-rebirth-name, -value). `false` for what is
/// no payload.
#[must_use]
pub fn asks_for_rebirth(payload: &[u8]) -> bool {
    Payload::decode(payload).is_ok_and(|payload| {
        payload.metrics.iter().any(|metric| {
            metric.name.as_deref() == Some(REBIRTH) && metric.value == Some(MetricValue::Boolean(true))
        })
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_payload_is_written_as_the_proto_file_says() {
        let metric = Metric {
            alias: Some(7),
            timestamp: Some(300),
            is_historical: Some(true),
            value: Some(MetricValue::Int(5)),
            ..Metric::default()
        };
        let payload = Payload { timestamp: Some(1), metrics: vec![metric], seq: Some(0) };
        // Field 1 varint 1; field 2 of 9 bytes: 2=7, 3=300, 5=true, 10=5; field 3 varint 0, written though it is 0.
        assert_eq!(
            payload.encode_to_vec(),
            [0x08, 1, 0x12, 9, 0x10, 7, 0x18, 0xAC, 0x02, 0x28, 1, 0x50, 5, 0x18, 0]
        );
    }

    #[test]
    fn tck_id_operational_behavior_data_commands_ncmd_rebirth_value_only_true_asks_for_births() {
        let command = |name: &str, value| {
            let metric = Metric { name: Some(name.to_owned()), value, ..Metric::default() };
            Payload { metrics: vec![metric], ..Payload::default() }.encode_to_vec()
        };
        assert!(asks_for_rebirth(&command(REBIRTH, Some(MetricValue::Boolean(true)))));
        assert!(!asks_for_rebirth(&command(REBIRTH, Some(MetricValue::Boolean(false)))));
        assert!(!asks_for_rebirth(&command(REBIRTH, Some(MetricValue::Int(1)))));
        assert!(!asks_for_rebirth(&command(REBIRTH, None)));
        assert!(!asks_for_rebirth(&command("Node Control/Reboot", Some(MetricValue::Boolean(true)))));
        assert!(!asks_for_rebirth(b"\xFF\xFF no payload"));
        assert!(!asks_for_rebirth(b""));
    }
}
