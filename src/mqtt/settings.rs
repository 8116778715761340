//! The `[mqtt]` table of the configuration. A value that cannot work is refused where it is read, so that the message
//! carries its place in the file.

use std::fmt;
use std::path::PathBuf;
use std::str::FromStr;
use std::time::Duration;

use schemars::JsonSchema;
use serde::{Deserialize, Deserializer, Serialize};

/// First wait after a lost or refused session; doubled at each further failure, with full jitter.
pub const BACK_OFF_FIRST: Duration = Duration::from_secs(1);
/// Longest wait between two attempts, unless `reconnect_max_s` says otherwise.
pub const BACK_OFF_LONGEST: Duration = Duration::from_secs(60);
/// Longest wait after a refusal that only a person can mend, whatever `reconnect_max_s` says.
pub const REFUSED: Duration = Duration::from_secs(60);
/// A session must last this long before the waits start again from [`BACK_OFF_FIRST`].
pub const HEALTHY_AFTER: Duration = Duration::from_secs(60);
/// Shortest time without an acknowledgement that ends a session.
pub const SILENCE: Duration = Duration::from_secs(10);
/// Names that no node may have, because topics of the gateway itself stand there.
pub const RESERVED_NODE_NAMES: [&str; 2] = ["bridge", "event"];

/// How to reach the broker, and what is kept while it is away.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct MqttSettings {
    /// Where the broker is: `mqtt://host` or `mqtt://host:port`; the port is 1883 unless given.
    #[schemars(with = "String")]
    pub url: BrokerUrl,
    /// First part of every topic. May have several levels (`plant/north`), no wildcards.
    #[schemars(with = "String")]
    pub base_topic: BaseTopic,
    /// Client id, unique at the broker; `cangate-<gateway name>` unless given.
    #[serde(deserialize_with = "client_id", skip_serializing_if = "Option::is_none")]
    pub client_id: Option<String>,
    /// User name; none unless given.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub username: Option<String>,
    /// File whose first line is the password; read at each attempt, so that a changed password needs no restart. Only with
    /// `username`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub password_file: Option<PathBuf>,
    /// Keep alive in seconds, 5..=3600: a link that died without a word is noticed within one and a half times this.
    #[serde(deserialize_with = "keep_alive")]
    #[schemars(range(min = 5, max = 3600))]
    pub keep_alive_s: u16,
    /// Longest wait in seconds between two attempts to reach the broker, 1..=3600. The waits double from 1 s up to it.
    #[serde(deserialize_with = "reconnect_max")]
    #[schemars(range(min = 1, max = 3600))]
    pub reconnect_max_s: u16,
    /// Quality of service of `<node>/state`: 0 or 1. Everything else is always sent with 1.
    #[schemars(with = "u8", range(min = 0, max = 1))]
    pub qos_state: StateQos,
    /// Messages that may wait for their acknowledgement at the same time, 1..=1000.
    #[serde(deserialize_with = "inflight")]
    #[schemars(range(min = 1, max = 1000))]
    pub inflight: u16,
    /// Most events that wait while the broker is away or slow, 100..=1,000,000; beyond it the oldest leave. Retained
    /// messages do not count: of each topic only the newest waits.
    #[serde(deserialize_with = "outbox_messages")]
    #[schemars(range(min = 100, max = 1_000_000))]
    pub outbox_messages: usize,
    /// Most bytes of such events (topics and payloads), 65,536..=1,073,741,824.
    #[serde(deserialize_with = "outbox_bytes")]
    #[schemars(range(min = 65_536, max = 1_073_741_824))]
    pub outbox_bytes: usize,
}

impl Default for MqttSettings {
    fn default() -> Self {
        Self {
            url: BrokerUrl::default(),
            base_topic: BaseTopic::default(),
            client_id: None,
            username: None,
            password_file: None,
            keep_alive_s: 20,
            reconnect_max_s: 60,
            qos_state: StateQos::AtLeastOnce,
            inflight: 16,
            outbox_messages: 20_000,
            outbox_bytes: 16 * 1024 * 1024,
        }
    }
}

impl MqttSettings {
    /// The client id for a gateway of this name.
    #[must_use]
    pub fn client_id_for(&self, gateway: &str) -> String {
        self.client_id.clone().unwrap_or_else(|| format!("cangate-{gateway}"))
    }

    /// What does not fit together, each with the key within `[mqtt]` that it is about, and a hint.
    #[must_use]
    pub fn problems(&self) -> Vec<(&'static str, &'static str, &'static str)> {
        let lonely = self.password_file.is_some() && self.username.is_none();
        let password = (
            "password_file",
            "a password without a `username` would not be sent: MQTT 3.1.1 has no such session",
            "add `username`, or take `password_file` away",
        );
        lonely.then_some(password).into_iter().collect()
    }
}

/// Why a setting cannot work.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum SettingsError {
    /// Not `mqtt://host[:port]`.
    #[error("`{0}` is not a broker's address; write `mqtt://HOST` or `mqtt://HOST:PORT`")]
    Url(String),
    /// TLS was asked for.
    #[error(
        "`{0}`: this version does not speak TLS to the broker; use `mqtt://` on a network that you trust, or a TLS tunnel \
         on this host"
    )]
    Tls(String),
    /// A user name or password stands in the address.
    #[error(
        "user name and password do not belong into the broker's address, where every log shows them; use `username` and \
         `password_file`"
    )]
    Credentials,
    /// A topic that MQTT does not allow, or that would surprise.
    #[error(
        "`{0}` cannot be a topic: levels of 1 or more characters separated by `/`, at most 200 bytes, without `+`, `#`, \
         control characters, and not starting with `$`"
    )]
    Topic(String),
    /// Neither 0 nor 1.
    #[error("quality of service {0} is not offered; use 0 or 1")]
    Qos(u8),
}

/// Address of a broker.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct BrokerUrl {
    /// Name or address, without brackets.
    pub host: String,
    /// TCP port.
    pub port: u16,
}

impl Default for BrokerUrl {
    fn default() -> Self {
        Self { host: "127.0.0.1".into(), port: 1883 }
    }
}

impl FromStr for BrokerUrl {
    type Err = SettingsError;

    fn from_str(text: &str) -> Result<Self, SettingsError> {
        let wrong = || SettingsError::Url(text.to_owned());
        if text.contains('@') {
            return Err(SettingsError::Credentials);
        }
        if text.starts_with("mqtts://") {
            return Err(SettingsError::Tls(text.to_owned()));
        }
        let rest = text.strip_prefix("mqtt://").ok_or_else(wrong)?;
        let rest = rest.strip_suffix('/').unwrap_or(rest);
        let (host, port) = if let Some(bracketed) = rest.strip_prefix('[') {
            let (host, after) = bracketed.split_once(']').ok_or_else(wrong)?;
            host.parse::<core::net::Ipv6Addr>().map_err(|_| wrong())?;
            (host, if after.is_empty() { None } else { Some(after.strip_prefix(':').ok_or_else(wrong)?) })
        } else {
            rest.split_once(':').map_or((rest, None), |(host, port)| (host, Some(port)))
        };
        let allowed = |c: char| c.is_ascii_alphanumeric() || matches!(c, '.' | '-' | '_' | ':');
        if host.is_empty() || !host.chars().all(allowed) {
            return Err(wrong());
        }
        let port = match port {
            None => 1883,
            Some(port) => port.parse().ok().filter(|port| *port != 0).ok_or_else(wrong)?,
        };
        Ok(Self { host: host.to_owned(), port })
    }
}

impl fmt::Display for BrokerUrl {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if self.host.contains(':') {
            write!(f, "mqtt://[{}]:{}", self.host, self.port)
        } else {
            write!(f, "mqtt://{}:{}", self.host, self.port)
        }
    }
}

impl TryFrom<String> for BrokerUrl {
    type Error = SettingsError;

    fn try_from(text: String) -> Result<Self, SettingsError> {
        text.parse()
    }
}

impl From<BrokerUrl> for String {
    fn from(url: BrokerUrl) -> Self {
        url.to_string()
    }
}

/// First part of every topic: one or more levels.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct BaseTopic(String);

impl BaseTopic {
    /// As written.
    #[must_use]
    pub fn as_str(&self) -> &str {
        &self.0
    }
}

impl Default for BaseTopic {
    fn default() -> Self {
        Self("cangate".into())
    }
}

impl TryFrom<String> for BaseTopic {
    type Error = SettingsError;

    fn try_from(text: String) -> Result<Self, SettingsError> {
        let levels_good = text.split('/').all(|level| {
            !level.is_empty() && !level.chars().any(|c| matches!(c, '+' | '#') || c.is_control())
        });
        if levels_good && text.len() <= 200 && !text.starts_with('$') {
            Ok(Self(text))
        } else {
            Err(SettingsError::Topic(text))
        }
    }
}

impl From<BaseTopic> for String {
    fn from(topic: BaseTopic) -> Self {
        topic.0
    }
}

/// Quality of service of what is soon replaced by newer values.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "u8", into = "u8")]
pub enum StateQos {
    /// 0: sent once, never repeated.
    AtMostOnce,
    /// 1: repeated until acknowledged.
    #[default]
    AtLeastOnce,
}

impl TryFrom<u8> for StateQos {
    type Error = SettingsError;

    fn try_from(number: u8) -> Result<Self, SettingsError> {
        match number {
            0 => Ok(Self::AtMostOnce),
            1 => Ok(Self::AtLeastOnce),
            other => Err(SettingsError::Qos(other)),
        }
    }
}

impl From<StateQos> for u8 {
    fn from(qos: StateQos) -> Self {
        match qos {
            StateQos::AtMostOnce => 0,
            StateQos::AtLeastOnce => 1,
        }
    }
}

/// Reads a number that must lie within `range`.
fn within<'de, D, N>(deserializer: D, range: std::ops::RangeInclusive<N>) -> Result<N, D::Error>
where
    D: Deserializer<'de>,
    N: Deserialize<'de> + PartialOrd + fmt::Display,
{
    let number = N::deserialize(deserializer)?;
    if range.contains(&number) {
        Ok(number)
    } else {
        let (low, high) = (range.start(), range.end());
        Err(serde::de::Error::custom(format!("{number} is outside {low}..={high}")))
    }
}

fn keep_alive<'de, D: Deserializer<'de>>(deserializer: D) -> Result<u16, D::Error> {
    within(deserializer, 5..=3600)
}

fn reconnect_max<'de, D: Deserializer<'de>>(deserializer: D) -> Result<u16, D::Error> {
    within(deserializer, 1..=3600)
}

fn inflight<'de, D: Deserializer<'de>>(deserializer: D) -> Result<u16, D::Error> {
    within(deserializer, 1..=1000)
}

fn outbox_messages<'de, D: Deserializer<'de>>(deserializer: D) -> Result<usize, D::Error> {
    within(deserializer, 100..=1_000_000)
}

fn outbox_bytes<'de, D: Deserializer<'de>>(deserializer: D) -> Result<usize, D::Error> {
    within(deserializer, 65_536..=1_073_741_824)
}

/// Brokers must take 23 letters and digits; most take more. Control characters and an empty id are never right.
fn client_id<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Option<String>, D::Error> {
    let id = Option::<String>::deserialize(deserializer)?;
    match &id {
        Some(text) if text.is_empty() || text.len() > 128 || text.chars().any(char::is_control) => {
            Err(serde::de::Error::custom("a client id has 1 to 128 bytes and no control characters"))
        }
        Some(_) | None => Ok(id),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(text: &str) -> Result<MqttSettings, String> {
        toml::from_str(text).map_err(|error| error.message().to_owned())
    }

    #[test]
    fn an_empty_table_gives_the_defaults() {
        assert_eq!(read("").unwrap(), MqttSettings::default());
        assert_eq!(MqttSettings::default().client_id_for("hall-1"), "cangate-hall-1");
    }

    #[test]
    fn settings_survive_being_written_and_read() {
        let text = toml::to_string(&MqttSettings::default()).unwrap();
        assert_eq!(read(&text).unwrap(), MqttSettings::default());
    }

    #[test]
    fn broker_addresses() {
        let url = |text: &str| text.parse::<BrokerUrl>().map(|url| url.to_string());
        assert_eq!(url("mqtt://broker").unwrap(), "mqtt://broker:1883");
        assert_eq!(url("mqtt://10.0.0.1:1884/").unwrap(), "mqtt://10.0.0.1:1884");
        assert_eq!(url("mqtt://[::1]:1884").unwrap(), "mqtt://[::1]:1884");
        assert_eq!(url("mqtt://[::1]").unwrap(), "mqtt://[::1]:1883");
        assert!(matches!(url("mqtts://broker"), Err(SettingsError::Tls(_))));
        assert!(matches!(url("mqtt://user:secret@broker"), Err(SettingsError::Credentials)));
        for wrong in [
            "",
            "broker",
            "tcp://broker",
            "mqtt://",
            "mqtt://a b",
            "mqtt://a:0",
            "mqtt://a:99999",
            "mqtt://[x]:1",
        ] {
            assert!(matches!(url(wrong), Err(SettingsError::Url(_))), "{wrong}");
        }
    }

    #[test]
    fn what_cannot_work_is_refused_with_a_reason() {
        for (text, reason) in [
            ("keep_alive_s = 0", "0 is outside 5..=3600"),
            ("reconnect_max_s = 0", "0 is outside 1..=3600"),
            ("inflight = 0", "0 is outside 1..=1000"),
            ("qos_state = 2", "quality of service 2 is not offered; use 0 or 1"),
            ("outbox_messages = 1", "1 is outside 100..=1000000"),
            ("client_id = ''", "a client id has 1 to 128 bytes and no control characters"),
        ] {
            assert_eq!(read(text).unwrap_err(), reason, "{text}");
        }
        for topic in ["", "/a", "a/", "a//b", "a/+", "a/#", "$SYS", "a\\tb"] {
            assert!(read(&format!("base_topic = \"{topic}\"")).is_err(), "{topic}");
        }
        assert!(read("user = 'x'").unwrap_err().contains("unknown field"));
        assert_eq!(read("base_topic = 'plant/north'").unwrap().base_topic.as_str(), "plant/north");
    }
}
