//! Settings of the Modbus TCP server: the `[modbus]` table of the configuration.

// Addresses only; `core` has no sockets.
use core::net::{Ipv4Addr, SocketAddr};
use std::ops::RangeInclusive;
use std::time::Duration;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::rtu::RtuSettings;
use super::security::SecuritySettings;
use crate::slots::{AllowList, Limits, Network, Rate};

/// The `[modbus]` table.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct ModbusSettings {
    /// Addresses to listen on, `IP:PORT`. An empty list switches Modbus off.
    pub listen: Vec<SocketAddr>,
    /// Order of the two registers of a 32-bit value: `big` = high word first (ABCD), `little` = low word first (CDAB).
    /// The bytes within a register are always high byte first, as Modbus demands.
    pub word_order: WordOrder,
    /// Unit id, 1..=247, under which the gateway itself answers, beside 0 and 255, which always do.
    #[schemars(range(min = 1, max = 247))]
    pub gateway_unit_id: u8,
    /// Connections at the same time, 1..=1024. When all are in use, a new one takes the place of the one that has been
    /// silent for longest.
    #[schemars(range(min = 1, max = 1024))]
    pub max_connections: u16,
    /// Connections of one address at the same time, 1..=1024; beyond it the one of its own that was silent for longest ends.
    /// 0 = as many as there are.
    #[schemars(range(min = 0, max = 1024))]
    pub max_connections_per_client: u16,
    /// Addresses and networks of clients that may come at all; an empty list lets everybody in.
    #[serde(skip_serializing_if = "AllowList::is_open")]
    pub allow: AllowList,
    /// Addresses and networks of the PLCs that always find a place, whether or not they are in `allow`: another client, the one that
    /// was silent for longest, ends for them, and they for nobody but one another.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub reserved: Vec<Network>,
    /// Requests a second that one connection may make, as many at once; further ones wait for their answer. 0 = no limit. Clients of
    /// `reserved` have none.
    #[schemars(range(max = 10000))]
    pub max_requests_per_s: u32,
    /// Close a connection after this many seconds without a request; 0 = never. Dead peers are found by TCP keep-alive
    /// all the same.
    pub idle_timeout_s: u32,
    /// Close a connection whose request stays incomplete for this many milliseconds, at least 100.
    #[schemars(range(min = 100))]
    pub partial_frame_timeout_ms: u32,
    /// Close a connection that does not take an answer for this many milliseconds, at least 100.
    #[schemars(range(min = 100))]
    pub send_timeout_ms: u32,
    /// FC 43/13, objects of the nodes by SDO: `off`, `read`, or `write` for both. Whoever reaches the port can then read, or
    /// change, every object of every node.
    pub canopen_objects: ObjectAccess,
    /// Serial lines on which the registers can be read too.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub rtu: Vec<RtuSettings>,
    /// Modbus/TCP Security: TLS with certificates on both sides, and the client's role in its certificate.
    #[serde(skip_serializing_if = "SecuritySettings::is_default")]
    pub security: SecuritySettings,
}

/// What FC 43/13 may do.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum ObjectAccess {
    /// Nothing: exception 01.
    #[default]
    Off,
    /// Read objects; a write answers exception 03.
    Read,
    /// Read and write them.
    Write,
}

/// Order of the two registers of a 32-bit value.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum WordOrder {
    /// High word first (ABCD).
    #[default]
    Big,
    /// Low word first (CDAB).
    Little,
}

impl WordOrder {
    /// The usual name of the byte order of a 32-bit value: `ABCD` or `CDAB`.
    #[must_use]
    pub fn letters(self) -> &'static str {
        match self {
            Self::Big => "ABCD",
            Self::Little => "CDAB",
        }
    }
}

impl Default for ModbusSettings {
    fn default() -> Self {
        Self {
            listen: vec![SocketAddr::from((Ipv4Addr::LOCALHOST, 5020))],
            word_order: WordOrder::Big,
            gateway_unit_id: 247,
            max_connections: 64,
            max_connections_per_client: 0,
            allow: AllowList::default(),
            reserved: Vec::new(),
            max_requests_per_s: 0,
            idle_timeout_s: 0,
            partial_frame_timeout_ms: 10_000,
            send_timeout_ms: 5_000,
            canopen_objects: ObjectAccess::Off,
            rtu: Vec::new(),
            security: SecuritySettings::default(),
        }
    }
}

/// A setting outside its range.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("`{key}` is {value}, but must be {lowest}..={highest}")]
pub struct SettingsError {
    /// The key within `[modbus]`.
    pub key: &'static str,
    /// What it is.
    pub value: u32,
    /// Lowest value allowed.
    pub lowest: u32,
    /// Highest value allowed.
    pub highest: u32,
}

impl ModbusSettings {
    /// Every number that is out of its range.
    #[must_use]
    pub fn problems(&self) -> Vec<SettingsError> {
        let checks: [(&'static str, u32, RangeInclusive<u32>); 6] = [
            ("gateway_unit_id", self.gateway_unit_id.into(), 1..=247),
            ("max_connections", self.max_connections.into(), 1..=1024),
            ("max_connections_per_client", self.max_connections_per_client.into(), 0..=1024),
            ("max_requests_per_s", self.max_requests_per_s, 0..=10_000),
            ("partial_frame_timeout_ms", self.partial_frame_timeout_ms, 100..=u32::MAX),
            ("send_timeout_ms", self.send_timeout_ms, 100..=u32::MAX),
        ];
        checks
            .into_iter()
            .filter(|(_, value, range)| !range.contains(value))
            .map(|(key, value, range)| SettingsError {
                key,
                value,
                lowest: *range.start(),
                highest: *range.end(),
            })
            .collect()
    }

    /// Who may come, and how many at once.
    #[must_use]
    pub fn limits(&self) -> Limits {
        let share = usize::from(self.max_connections_per_client);
        Limits {
            places: self.max_connections.into(),
            allow: self.allow.clone(),
            reserved: self.reserved.clone(),
            share: if share == 0 { usize::MAX } else { share },
        }
    }

    /// How often one connection may ask; `None`: as often as it likes.
    #[must_use]
    pub fn rate(&self) -> Option<Rate> {
        let each = Duration::from_secs(1).checked_div(self.max_requests_per_s)?;
        Some(Rate { each, burst: self.max_requests_per_s })
    }

    /// Whether others than this host can reach the objects of the nodes (FC 43/13), and what they can do then; with a hint.
    #[must_use]
    pub fn warning(&self) -> Option<(String, String)> {
        let listen = self.listen.iter().find(|listen| !listen.ip().is_loopback())?;
        if !self.allow.is_open() {
            return None;
        }
        let (what, mend) = match self.canopen_objects {
            ObjectAccess::Off => return None,
            ObjectAccess::Read => ("read every object", "with \"off\" only registers are read"),
            ObjectAccess::Write => ("read and change every device", "with \"read\" nothing can be changed"),
        };
        Some((
            format!("whoever reaches {listen} can {what} by FC 43/13 without a login"),
            format!("name the clients in `allow`, or listen on 127.0.0.1; {mend}"),
        ))
    }

    /// How long a connection may be silent; `None` = for ever.
    #[must_use]
    pub fn idle_timeout(&self) -> Option<Duration> {
        (self.idle_timeout_s > 0).then(|| Duration::from_secs(self.idle_timeout_s.into()))
    }

    /// How long a request may stay incomplete.
    #[must_use]
    pub fn partial_frame_timeout(&self) -> Duration {
        Duration::from_millis(self.partial_frame_timeout_ms.into())
    }

    /// How long an answer may wait for the client to take it.
    #[must_use]
    pub fn send_timeout(&self) -> Duration {
        Duration::from_millis(self.send_timeout_ms.into())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_empty_table_gives_the_defaults_and_they_are_in_range() {
        let settings: ModbusSettings = toml::from_str("").unwrap();
        assert_eq!(settings, ModbusSettings::default());
        assert_eq!(settings.problems(), []);
        assert!(settings.listen.iter().all(|address| address.ip().is_loopback()));
    }

    #[test]
    fn word_order_is_written_as_big_or_little() {
        let settings: ModbusSettings = toml::from_str("word_order = \"little\"").unwrap();
        assert_eq!(settings.word_order.letters(), "CDAB");
        assert!(toml::from_str::<ModbusSettings>("word_order = \"CDAB\"").is_err());
    }

    #[test]
    fn objects_that_other_hosts_reach_are_warned_of_with_what_can_be_done_to_them() {
        let warning = |text: &str| toml::from_str::<ModbusSettings>(text).unwrap().warning();
        assert_eq!(warning("listen = ['0.0.0.0:5020']"), None, "registers are there to be read");
        assert_eq!(warning("canopen_objects = 'write'"), None, "only this host reaches it");
        assert_eq!(warning("listen = []\ncanopen_objects = 'write'"), None);
        let named = "listen = ['0.0.0.0:502']\nallow = ['10.0.0.5']\ncanopen_objects = 'write'";
        assert_eq!(warning(named), None);
        let listen = "listen = ['127.0.0.1:5020', '10.0.0.1:502']\n";
        let (message, hint) = warning(&format!("{listen}canopen_objects = 'read'")).unwrap();
        assert!(message.contains("10.0.0.1:502 can read every object"), "{message}");
        assert!(hint.contains("with \"off\""), "{hint}");
        let (message, hint) = warning(&format!("{listen}canopen_objects = 'write'")).unwrap();
        assert!(message.contains("read and change") && hint.contains("with \"read\""), "{message} {hint}");
    }

    #[test]
    fn unknown_keys_and_numbers_out_of_range_are_found() {
        assert!(toml::from_str::<ModbusSettings>("lisen = []").is_err());
        let settings: ModbusSettings =
            toml::from_str("gateway_unit_id = 0\nmax_connections = 0\nsend_timeout_ms = 1").unwrap();
        let keys: Vec<_> = settings.problems().iter().map(|problem| problem.key).collect();
        assert_eq!(keys, ["gateway_unit_id", "max_connections", "send_timeout_ms"]);
    }
}
