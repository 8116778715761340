//! The `[mqtt.sparkplug]` table of the configuration.

use schemars::JsonSchema;
use serde::{Deserialize, Deserializer, Serialize};

/// A second publisher to the same broker: Sparkplug B, version 3.0 of its specification.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct SparkplugSettings {
    /// Publish by Sparkplug B, too.
    pub enabled: bool,
    /// Group of this edge node: 1 to 128 bytes without `/`, `+`, `#` and control characters.
    #[serde(deserialize_with = "id")]
    pub group_id: String,
    /// Name of this edge node, unique in its group; the name of the gateway unless given.
    #[serde(deserialize_with = "optional_id", skip_serializing_if = "Option::is_none")]
    pub edge_node_id: Option<String>,
    /// Client id of this session, unique at the broker; that of the first session and `-sparkplug` unless given.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub client_id: Option<String>,
    /// Primary host application, by its id: while it does not say that it is online, nothing is published and values are kept.
    #[serde(deserialize_with = "optional_id", skip_serializing_if = "Option::is_none")]
    pub primary_host: Option<String>,
    /// Most values that are kept in memory while the broker or the primary host is away, 0..=1,000,000; beyond it the oldest
    /// leave. A value takes about 64 bytes.
    #[serde(deserialize_with = "history")]
    #[schemars(range(min = 0, max = 1_000_000))]
    pub history_values: usize,
}

impl Default for SparkplugSettings {
    fn default() -> Self {
        Self {
            enabled: false,
            group_id: "cangate".to_owned(),
            edge_node_id: None,
            client_id: None,
            primary_host: None,
            history_values: 100_000,
        }
    }
}

impl SparkplugSettings {
    /// The edge node's name for a gateway of this name.
    #[must_use]
    pub fn edge_node_for<'a>(&'a self, gateway: &'a str) -> &'a str {
        self.edge_node_id.as_deref().unwrap_or(gateway)
    }

    /// The client id beside that of the first session.
    #[must_use]
    pub fn client_id_beside(&self, first: &str) -> String {
        self.client_id.clone().unwrap_or_else(|| format!("{first}-sparkplug"))
    }
}

/// Whether a name can be one level of a topic.
fn is_id(text: &str) -> bool {
    let plain = |c: char| !matches!(c, '/' | '+' | '#') && !c.is_control();
    (1..=128).contains(&text.len()) && text.chars().all(plain)
}

fn id<'de, D: Deserializer<'de>>(deserializer: D) -> Result<String, D::Error> {
    let text = String::deserialize(deserializer)?;
    if is_id(&text) {
        Ok(text)
    } else {
        Err(serde::de::Error::custom(format!(
            "`{text}` cannot be an id of Sparkplug: 1 to 128 bytes without `/`, `+`, `#` and control characters"
        )))
    }
}

fn optional_id<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Option<String>, D::Error> {
    id(deserializer).map(Some)
}

fn history<'de, D: Deserializer<'de>>(deserializer: D) -> Result<usize, D::Error> {
    let number = usize::deserialize(deserializer)?;
    if number <= 1_000_000 {
        Ok(number)
    } else {
        Err(serde::de::Error::custom(format!("{number} is outside 0..=1000000")))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(text: &str) -> Result<SparkplugSettings, String> {
        toml::from_str(text).map_err(|error| error.message().to_owned())
    }

    #[test]
    fn an_empty_table_is_off_and_survives_being_written() {
        let settings = read("").unwrap();
        assert_eq!(settings, SparkplugSettings::default());
        assert!(!settings.enabled);
        assert_eq!(read(&toml::to_string(&settings).unwrap()).unwrap(), settings);
        assert_eq!(settings.edge_node_for("hall-1"), "hall-1");
        assert_eq!(settings.client_id_beside("cangate-hall-1"), "cangate-hall-1-sparkplug");
    }

    #[test]
    fn tck_id_intro_group_id_chars_ids_are_levels_of_topics() {
        for wrong in ["", "a/b", "+", "#", "a\\u0000"] {
            for key in ["group_id", "edge_node_id", "primary_host"] {
                let error = read(&format!("{key} = \"{wrong}\"")).unwrap_err();
                assert!(error.contains("cannot be an id of Sparkplug"), "{error}");
            }
        }
        assert_eq!(read("group_id = 'Werk Süd'").unwrap().group_id, "Werk Süd");
        assert_eq!(read("edge_node_id = 'north'").unwrap().edge_node_for("hall-1"), "north");
        assert_eq!(read("history_values = 1000001").unwrap_err(), "1000001 is outside 0..=1000000");
    }
}
