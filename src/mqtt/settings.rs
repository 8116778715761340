//! The `[mqtt]` table of the configuration. A value that cannot work is refused where it is read, so that the message
//! carries its place in the file.

use std::fmt;
use std::path::PathBuf;
use std::str::FromStr;
use std::time::Duration;

use schemars::JsonSchema;
use serde::{Deserialize, Deserializer, Serialize};

use super::home_assistant::HomeAssistantSettings;
use super::sparkplug::SparkplugSettings;
use super::version::MqttVersion;
use crate::store::Sync;
use crate::tls::settings::TlsClientSettings;

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
    /// Where the broker is: `mqtt://host` or `mqtt://host:port`, with TLS `mqtts://host`; the port is 1883, with TLS 8883, unless
    /// given.
    #[schemars(with = "String")]
    pub url: BrokerUrl,
    /// Version of MQTT: `"3.1.1"`, or `"5"`, with which brokers say why they refuse something, and messages have an expiry and
    /// properties.
    #[schemars(with = "String", extend("enum" = ["3.1.1", "5"]))]
    pub version: MqttVersion,
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
    /// Seconds after which the broker lets go of a `<node>/state`, 30..=31,536,000, with MQTT 5 only; unless given it keeps the last
    /// one for ever. A state is told every 10 s or more often.
    #[serde(deserialize_with = "state_expiry", skip_serializing_if = "Option::is_none")]
    #[schemars(range(min = 30, max = 31_536_000))]
    pub state_expiry_s: Option<u32>,
    /// Messages that may wait for their acknowledgement at the same time, 1..=1000.
    #[serde(deserialize_with = "inflight")]
    #[schemars(range(min = 1, max = 1000))]
    pub inflight: u16,
    /// Most events that wait in memory while the broker is away or slow, 100..=1,000,000; beyond it the oldest leave. Retained
    /// messages do not count: of each topic only the newest waits. With a folder (`buffer_dir`) this holds while its disk
    /// fails, and for messages of serial lines.
    #[serde(deserialize_with = "outbox_messages")]
    #[schemars(range(min = 100, max = 1_000_000))]
    pub outbox_messages: usize,
    /// Most bytes of such events (topics and payloads), 65,536..=1,073,741,824.
    #[serde(deserialize_with = "outbox_bytes")]
    #[schemars(range(min = 65_536, max = 1_073_741_824))]
    pub outbox_bytes: usize,
    /// Certificates for `mqtts://`; without it the broker's is checked against the authorities that the host trusts.
    #[serde(skip_serializing_if = "TlsClientSettings::is_empty")]
    pub tls: TlsClientSettings,
    /// Discovery by Home Assistant.
    pub home_assistant: HomeAssistantSettings,
    /// Sparkplug B, beside the topics above.
    pub sparkplug: SparkplugSettings,
    /// Folder in which events are kept until the broker has them, and states while it is away; each gateway has its own. Unless
    /// given: `/var/lib/cangate/buffer/<gateway name>`, where `/var/lib/cangate` is there and can be written, else memory
    /// alone. Empty: memory alone.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub buffer_dir: Option<PathBuf>,
    /// Most bytes in that folder, 1,048,576..=1,099,511,627,776. Beyond it the oldest states leave, and events when no state
    /// is left.
    #[serde(deserialize_with = "buffer_bytes")]
    #[schemars(range(min = 1_048_576, max = 1_099_511_627_776_u64))]
    pub buffer_bytes: u64,
    /// What is older than so many hours by the clock of the host leaves, 1..=876,000; unless given nothing leaves for its age.
    #[serde(deserialize_with = "buffer_age", skip_serializing_if = "Option::is_none")]
    #[schemars(range(min = 1, max = 876_000))]
    pub buffer_age_h: Option<u32>,
    /// `balanced`: what is written is safe against a power cut within 500 ms. `strict`: before it is offered to the broker.
    pub buffer_sync: Sync,
    /// Most states that are sent on `<node>/history` in a second, 1..=100,000.
    #[serde(deserialize_with = "history_rate")]
    #[schemars(range(min = 1, max = 100_000))]
    pub history_rate: u32,
    /// While there is no session a state of a node is kept at most this often, in ms, 100..=3,600,000.
    #[serde(deserialize_with = "history_interval")]
    #[schemars(range(min = 100, max = 3_600_000))]
    pub history_interval_ms: u32,
}

impl Default for MqttSettings {
    fn default() -> Self {
        Self {
            url: BrokerUrl::default(),
            version: MqttVersion::default(),
            base_topic: BaseTopic::default(),
            client_id: None,
            username: None,
            password_file: None,
            keep_alive_s: 20,
            reconnect_max_s: 60,
            qos_state: StateQos::AtLeastOnce,
            state_expiry_s: None,
            inflight: 16,
            outbox_messages: 20_000,
            outbox_bytes: 16 * 1024 * 1024,
            tls: TlsClientSettings::default(),
            home_assistant: HomeAssistantSettings::default(),
            sparkplug: SparkplugSettings::default(),
            buffer_dir: None,
            buffer_bytes: 1024 * 1024 * 1024,
            buffer_age_h: None,
            buffer_sync: Sync::Balanced,
            history_rate: 2_000,
            history_interval_ms: 1_000,
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
        let unused = (
            "tls",
            "these certificates would not be used: the `url` begins with `mqtt://`, which is not encrypted",
            "write `mqtts://`, or take [mqtt.tls] away",
        );
        let unused = (!self.tls.is_empty() && !self.url.tls).then_some(unused);
        let tls = self.tls.problems().map(|(_, message, hint)| ("tls", message, hint));
        let lasting = (
            "state_expiry_s",
            "messages do not expire with MQTT 3.1.1",
            "write `version = \"5\"`, or take `state_expiry_s` away",
        );
        let is_lasting = self.state_expiry_s.is_some() && self.version == MqttVersion::V3_1_1;
        [lonely.then_some(password), is_lasting.then_some(lasting), unused, tls]
            .into_iter()
            .flatten()
            .collect()
    }

    /// A password that everybody on the way to the broker can read, with a hint.
    #[must_use]
    pub fn warning(&self) -> Option<(String, String)> {
        let host = &self.url.host;
        let near = host == "localhost" || host.parse::<core::net::IpAddr>().is_ok_and(|ip| ip.is_loopback());
        (self.password_file.is_some() && !self.url.tls && !near).then(|| {
            (
                format!("the password goes to `{host}` unencrypted: whoever is on the way can read it"),
                "use `mqtts://` where the broker speaks TLS".to_owned(),
            )
        })
    }
}

/// Why a setting cannot work.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum SettingsError {
    /// Not `mqtt://host[:port]`, and not `mqtts://` either.
    #[error(
        "`{0}` is not a broker's address; write `mqtt://HOST` or `mqtt://HOST:PORT`, with TLS `mqtts://HOST`"
    )]
    Url(String),
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
    /// Encrypted, by TLS.
    pub tls: bool,
}

impl Default for BrokerUrl {
    fn default() -> Self {
        Self { host: "127.0.0.1".into(), port: 1883, tls: false }
    }
}

impl BrokerUrl {
    /// Host and port as one word.
    #[must_use]
    pub fn place(&self) -> String {
        let Self { host, port, .. } = self;
        if host.contains(':') { format!("[{host}]:{port}") } else { format!("{host}:{port}") }
    }
}

impl FromStr for BrokerUrl {
    type Err = SettingsError;

    fn from_str(text: &str) -> Result<Self, SettingsError> {
        let wrong = || SettingsError::Url(text.to_owned());
        if text.contains('@') {
            return Err(SettingsError::Credentials);
        }
        let (tls, rest) = match text.strip_prefix("mqtts://") {
            Some(rest) => (true, rest),
            None => (false, text.strip_prefix("mqtt://").ok_or_else(wrong)?),
        };
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
            None if tls => 8883,
            None => 1883,
            Some(port) => port.parse().ok().filter(|port| *port != 0).ok_or_else(wrong)?,
        };
        Ok(Self { host: host.to_owned(), port, tls })
    }
}

impl fmt::Display for BrokerUrl {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let scheme = if self.tls { "mqtts" } else { "mqtt" };
        write!(f, "{scheme}://{}", self.place())
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

fn buffer_bytes<'de, D: Deserializer<'de>>(deserializer: D) -> Result<u64, D::Error> {
    within(deserializer, 1_048_576..=1_099_511_627_776)
}

fn buffer_age<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Option<u32>, D::Error> {
    within(deserializer, 1..=876_000).map(Some)
}

fn state_expiry<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Option<u32>, D::Error> {
    within(deserializer, 30..=31_536_000).map(Some)
}

fn history_interval<'de, D: Deserializer<'de>>(deserializer: D) -> Result<u32, D::Error> {
    within(deserializer, 100..=3_600_000)
}

fn history_rate<'de, D: Deserializer<'de>>(deserializer: D) -> Result<u32, D::Error> {
    within(deserializer, 1..=100_000)
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
        assert_eq!(url("mqtts://broker").unwrap(), "mqtts://broker:8883");
        assert_eq!(url("mqtts://[::1]:8884/").unwrap(), "mqtts://[::1]:8884");
        assert!(matches!(url("mqtts://user@broker"), Err(SettingsError::Credentials)));
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
    fn certificates_that_would_not_be_used_are_refused_and_a_password_in_the_open_is_warned_of() {
        let problems = |text: &str| read(text).unwrap().problems();
        let tls = "[tls]\nca_file = 'ca.pem'\n";
        assert_eq!(problems(&format!("url = 'mqtts://broker'\n{tls}")), []);
        assert_eq!(problems(&format!("url = 'mqtt://broker'\n{tls}"))[0].0, "tls");
        assert!(problems("url = 'mqtts://broker'\ntls = { cert_file = 'c' }")[0].2.contains("key_file"));
        let warns = |url: &str| {
            let text = format!("url = '{url}'\nusername = 'u'\npassword_file = 'p'");
            read(&text).unwrap().warning().is_some()
        };
        assert!(warns("mqtt://broker") && warns("mqtt://10.0.0.1"));
        for url in ["mqtts://broker", "mqtt://localhost", "mqtt://127.0.0.1", "mqtt://[::1]"] {
            assert!(!warns(url), "{url}");
        }
    }

    #[test]
    fn states_expire_with_mqtt_5_only() {
        let problems = |text: &str| read(text).unwrap().problems();
        assert_eq!(problems("state_expiry_s = 60")[0].0, "state_expiry_s");
        assert_eq!(problems("state_expiry_s = 60\nversion = '5'"), []);
    }

    #[test]
    fn what_cannot_work_is_refused_with_a_reason() {
        for (text, reason) in [
            ("keep_alive_s = 0", "0 is outside 5..=3600"),
            ("reconnect_max_s = 0", "0 is outside 1..=3600"),
            ("inflight = 0", "0 is outside 1..=1000"),
            ("qos_state = 2", "quality of service 2 is not offered; use 0 or 1"),
            ("state_expiry_s = 20", "20 is outside 30..=31536000"),
            ("version = '4'", "MQTT `4` is not spoken here; write \"3.1.1\" or \"5\""),
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
