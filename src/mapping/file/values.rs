//! Values of a mapping file that can be written in more than one way.

use std::borrow::Cow;
use std::fmt;

use schemars::{JsonSchema, Schema, SchemaGenerator, json_schema};
use serde::de::{Error, SeqAccess, Visitor};
use serde::{Deserialize, Deserializer};

use super::At;
use crate::can::CanId;
use crate::canopen::NodeId;

/// Highest 11-bit identifier.
const HIGHEST_STANDARD: u32 = 0x7FF;
/// Highest 29-bit identifier.
const HIGHEST_EXTENDED: u32 = 0x1FFF_FFFF;

/// The identifier of a TPDO: fixed, or counted from the node id.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct CobId {
    /// The number, node id not yet added.
    pub base: u32,
    /// Whether the node id is added.
    pub plus_node_id: bool,
}

impl CobId {
    /// The identifier for a node; above 0x7FF it is one of 29 bits.
    #[must_use]
    pub fn of(self, node: NodeId) -> CanId {
        let id = self.base + if self.plus_node_id { u32::from(node.get()) } else { 0 };
        match u16::try_from(id) {
            Ok(standard) if id <= HIGHEST_STANDARD => CanId::Standard(standard),
            _ => CanId::Extended(id),
        }
    }

    fn parse(text: &str) -> Option<Self> {
        let (text, plus_node_id) = match text.trim().strip_prefix("$NODEID") {
            Some("") => ("0", true),
            Some(rest) => (rest.trim_start().strip_prefix('+')?.trim_start(), true),
            None => (text.trim(), false),
        };
        let base = match text.strip_prefix("0x").or_else(|| text.strip_prefix("0X")) {
            Some(hexadecimal) => u32::from_str_radix(hexadecimal, 16).ok()?,
            None => text.parse().ok()?,
        };
        // The highest node id must fit too.
        (base <= HIGHEST_EXTENDED - 127).then_some(Self { base, plus_node_id })
    }
}

const COB_ID: &str = "an identifier: \"$NODEID+0x180\", or a number such as 0x181";

impl<'de> Deserialize<'de> for CobId {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct Reader;
        impl Visitor<'_> for Reader {
            type Value = CobId;
            fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str(COB_ID)
            }
            fn visit_i64<E: Error>(self, number: i64) -> Result<CobId, E> {
                self.visit_str(&number.to_string())
            }
            fn visit_str<E: Error>(self, text: &str) -> Result<CobId, E> {
                CobId::parse(text).ok_or_else(|| E::invalid_value(serde::de::Unexpected::Str(text), &self))
            }
        }
        deserializer.deserialize_any(Reader)
    }
}

impl JsonSchema for CobId {
    fn schema_name() -> Cow<'static, str> {
        "CobId".into()
    }

    fn json_schema(_: &mut SchemaGenerator) -> Schema {
        json_schema!({
            "description": COB_ID,
            "anyOf": [
                { "type": "string", "pattern": r"^(\$NODEID( *\+ *)?)?(0[xX][0-9a-fA-F]+|[0-9]*)$" },
                { "type": "integer", "minimum": 0, "maximum": HIGHEST_EXTENDED },
            ],
        })
    }
}

/// Names of tags: one text, or a list of texts. A `*` stands for a number, and the matches come in the order of their
/// numbers.
#[derive(Clone, Debug, PartialEq)]
pub enum NameList {
    /// One name or pattern.
    One(String),
    /// Several.
    Several(Vec<At<String>>),
}

impl<'de> Deserialize<'de> for NameList {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct Reader;
        impl<'de> Visitor<'de> for Reader {
            type Value = NameList;
            fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str("a tag's name, a pattern such as \"level_*\", or a list of them")
            }
            fn visit_str<E: Error>(self, text: &str) -> Result<NameList, E> {
                Ok(NameList::One(text.to_owned()))
            }
            fn visit_seq<A: SeqAccess<'de>>(self, mut items: A) -> Result<NameList, A::Error> {
                let mut names = Vec::new();
                while let Some(name) = items.next_element()? {
                    names.push(name);
                }
                Ok(NameList::Several(names))
            }
        }
        deserializer.deserialize_any(Reader)
    }
}

impl JsonSchema for NameList {
    fn schema_name() -> Cow<'static, str> {
        "NameList".into()
    }

    fn json_schema(_: &mut SchemaGenerator) -> Schema {
        json_schema!({
            "description": "a tag's name, a pattern in which * stands for a number, or a list of them",
            "anyOf": [{ "type": "string" }, { "type": "array", "items": { "type": "string" } }],
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn identifiers_are_fixed_or_counted_from_the_node_id() {
        let node = NodeId::new(5).unwrap();
        for (text, id) in [
            ("$NODEID+0x180", CanId::Standard(0x185)),
            ("$NODEID + 640", CanId::Standard(0x285)),
            ("$NODEID", CanId::Standard(5)),
            ("0x1ABCDE", CanId::Extended(0x1A_BCDE)),
            ("385", CanId::Standard(385)),
        ] {
            assert_eq!(CobId::parse(text).unwrap().of(node), id, "{text}");
        }
        for text in ["", "$NODEID-1", "0x", "NODEID+1", "0x20000000", "-1", "0x1FFFFFFF"] {
            assert_eq!(CobId::parse(text), None, "{text}");
        }
    }
}
