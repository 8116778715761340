//! Which MQTT is spoken, pure.

use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Serialize};

/// Version of MQTT.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "Written", into = "String")]
pub enum MqttVersion {
    /// 3.1.1, which every broker speaks.
    #[default]
    V3_1_1,
    /// 5.0: brokers say why, messages expire and have properties.
    V5,
}

/// No version that is spoken here.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("MQTT `{0}` is not spoken here; write \"3.1.1\" or \"5\"")]
pub struct UnknownVersion(String);

impl FromStr for MqttVersion {
    type Err = UnknownVersion;

    fn from_str(text: &str) -> Result<Self, UnknownVersion> {
        match text {
            "3.1.1" => Ok(Self::V3_1_1),
            "5" | "5.0" => Ok(Self::V5),
            other => Err(UnknownVersion(other.to_owned())),
        }
    }
}

impl fmt::Display for MqttVersion {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::V3_1_1 => "3.1.1",
            Self::V5 => "5",
        })
    }
}

impl From<MqttVersion> for String {
    fn from(version: MqttVersion) -> Self {
        version.to_string()
    }
}

/// As it may stand in a file: whoever writes `version = 5` means the same, and deserves the same help when it is `4`.
#[derive(Deserialize)]
#[serde(untagged)]
enum Written {
    Text(String),
    Whole(i64),
    Decimal(f64),
}

impl TryFrom<Written> for MqttVersion {
    type Error = UnknownVersion;

    fn try_from(written: Written) -> Result<Self, UnknownVersion> {
        match written {
            Written::Text(text) => text.parse(),
            Written::Whole(number) => number.to_string().parse(),
            Written::Decimal(number) => format!("{number:?}").parse(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[derive(Debug, Deserialize)]
    struct Table {
        version: MqttVersion,
    }

    fn read(text: &str) -> Result<MqttVersion, String> {
        toml::from_str::<Table>(text).map(|table| table.version).map_err(|error| error.message().to_owned())
    }

    #[test]
    fn a_version_is_one_of_two_and_any_other_is_told_both() {
        for (text, version) in [
            ("'3.1.1'", MqttVersion::V3_1_1),
            ("'5'", MqttVersion::V5),
            ("5", MqttVersion::V5),
            ("5.0", MqttVersion::V5),
        ] {
            assert_eq!(read(&format!("version = {text}")), Ok(version));
        }
        for (text, shown) in [("'4'", "4"), ("4", "4"), ("3.1", "3.1"), ("''", "")] {
            let expected = format!("MQTT `{shown}` is not spoken here; write \"3.1.1\" or \"5\"");
            assert_eq!(read(&format!("version = {text}")), Err(expected));
        }
    }
}
