//! What is added to the Modbus addresses of a node.

use std::borrow::Cow;
use std::fmt;

use schemars::{JsonSchema, Schema, SchemaGenerator, json_schema};
use serde::de::{Error, Unexpected, Visitor};
use serde::{Deserialize, Deserializer};

/// `offset` of a node.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Offset {
    /// So many; above 65535 no address is left, which is told.
    Fixed(u64),
    /// Behind the node before it in the configuration that shares its unit id and is placed so too (R-ESD-118).
    Auto,
}

impl Offset {
    /// As a number of addresses, where it is one.
    #[must_use]
    pub fn fixed(self) -> Option<u16> {
        match self {
            Self::Fixed(number) => u16::try_from(number).ok(),
            Self::Auto => None,
        }
    }
}

const OFFSET: &str = "a whole number, not negative, or \"auto\"";

impl<'de> Deserialize<'de> for Offset {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct Reader;
        impl Visitor<'_> for Reader {
            type Value = Offset;
            fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str(OFFSET)
            }
            fn visit_i64<E: Error>(self, number: i64) -> Result<Offset, E> {
                let fixed = u64::try_from(number).map(Offset::Fixed);
                fixed.map_err(|_| E::invalid_value(Unexpected::Signed(number), &self))
            }
            fn visit_str<E: Error>(self, text: &str) -> Result<Offset, E> {
                if text == "auto" {
                    return Ok(Offset::Auto);
                }
                Err(E::invalid_value(Unexpected::Str(text), &self))
            }
        }
        deserializer.deserialize_any(Reader)
    }
}

impl JsonSchema for Offset {
    fn schema_name() -> Cow<'static, str> {
        "Offset".into()
    }

    fn json_schema(_: &mut SchemaGenerator) -> Schema {
        json_schema!({
            "description": OFFSET,
            "anyOf": [{ "type": "integer", "minimum": 0, "maximum": u16::MAX }, { "const": "auto" }],
        })
    }
}
