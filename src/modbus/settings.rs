//! Settings of the Modbus TCP server: the `[modbus]` table of the configuration.

// Addresses only; `core` has no sockets.
use core::net::{Ipv4Addr, SocketAddr};
use std::ops::RangeInclusive;
use std::time::Duration;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

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
            idle_timeout_s: 0,
            partial_frame_timeout_ms: 10_000,
            send_timeout_ms: 5_000,
            canopen_objects: ObjectAccess::Off,
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
        let checks: [(&'static str, u32, RangeInclusive<u32>); 4] = [
            ("gateway_unit_id", self.gateway_unit_id.into(), 1..=247),
            ("max_connections", self.max_connections.into(), 1..=1024),
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
    fn unknown_keys_and_numbers_out_of_range_are_found() {
        assert!(toml::from_str::<ModbusSettings>("lisen = []").is_err());
        let settings: ModbusSettings =
            toml::from_str("gateway_unit_id = 0\nmax_connections = 0\nsend_timeout_ms = 1").unwrap();
        let keys: Vec<_> = settings.problems().iter().map(|problem| problem.key).collect();
        assert_eq!(keys, ["gateway_unit_id", "max_connections", "send_timeout_ms"]);
    }
}
