//! The `[access.NAME]` tables of the configuration.

use std::fmt;

use schemars::JsonSchema;
use serde::{Deserialize, Deserializer};

use super::Role;
use crate::mapping::At;
use crate::slots::Network;

/// `[access.NAME]`: who is known by what, and may do what. The name stands in the audit journal.
#[derive(Clone, Debug, Default, PartialEq, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct AccessEntry {
    /// `viewer` reads. `operator` acknowledges and resets alarms, writes the tags under `write`, and sends on serial lines.
    /// `engineer` also sends NMT commands and reads and writes objects by SDO.
    pub role: Role,
    /// Addresses and networks of Modbus clients without TLS: `"10.0.0.5"`, `"10.0.0.0/28"`. Default: none.
    #[serde(default)]
    pub modbus: Vec<At<Network>>,
    /// The role in the certificate of a client of Modbus/TCP Security. Default: none.
    pub modbus_role: Option<At<String>>,
    /// It is who comes through the MQTT broker, whose own access list says who may publish requests. Default: false.
    pub mqtt: Option<At<bool>>,
    /// A file with the token that HTTP clients send as `Authorization: Bearer`, 16 bytes or more. Read whenever it is needed.
    pub token_file: Option<At<String>>,
    /// The hash of the password by which somebody logs in to the page, as `cangate password` prints it. Default: none.
    pub password: Option<At<SecretText>>,
    /// A file with such a hash instead. Read whenever it is needed.
    pub password_file: Option<At<String>>,
    /// Tags that it may write: `"node/tag"`, or `"node/*"` for all of a node that can be written. Default: none.
    #[serde(default)]
    pub write: Vec<At<String>>,
}

/// A text that no message and no log shows.
#[derive(Clone, PartialEq, Eq, JsonSchema)]
#[schemars(transparent)]
pub struct SecretText(pub String);

impl fmt::Debug for SecretText {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("SecretText(..)")
    }
}

impl<'de> Deserialize<'de> for SecretText {
    /// The usual messages show what is of the wrong type.
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        match toml::Value::deserialize(deserializer) {
            Ok(toml::Value::String(text)) => Ok(Self(text)),
            Ok(_) | Err(_) => Err(serde::de::Error::custom("this is no text in quotation marks")),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_secret_is_shown_neither_when_it_is_right_nor_when_it_is_wrong() {
        let text = |password: &str| format!("role = 'viewer'\npassword = {password}");
        let entry: AccessEntry = toml::from_str(&text("'canary'")).unwrap();
        assert!(!format!("{entry:?}").contains("canary"), "{entry:?}");
        for wrong in ["8675309", "['8675309']", "{ canary = 8675309 }", "86753.09", "1867-05-30"] {
            let error = toml::from_str::<AccessEntry>(&text(wrong)).unwrap_err();
            let said = error.message();
            assert!(said.contains("no text") && !said.contains("867") && !said.contains("canary"), "{said}");
        }
    }
}
