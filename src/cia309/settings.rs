//! The `[cia309]` table of the configuration.

use core::net::SocketAddr;
use std::time::Duration;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// The CiA 309-3 gateway. Without `listen` there is none.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Cia309Settings {
    /// Address and port, for example `127.0.0.1:60000`. Anyone who reaches it can read every object of every node; there is
    /// no login.
    #[schemars(with = "Option<String>")]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub listen: Option<SocketAddr>,
    /// Take SDO writes and NMT commands too. Anyone who reaches the port can then stop and change devices.
    pub writes: bool,
    /// Connections at the same time, 1..=64. When all are in use, a new one takes the place of the one that has been silent for
    /// longest.
    #[schemars(range(min = 1, max = 64))]
    pub max_connections: u16,
    /// Close a connection after this many seconds without a whole line; 0 = never.
    pub idle_timeout_s: u32,
}

impl Default for Cia309Settings {
    fn default() -> Self {
        Self { listen: None, writes: false, max_connections: 8, idle_timeout_s: 600 }
    }
}

impl Cia309Settings {
    /// What is wrong: the key, the message and a hint.
    #[must_use]
    pub fn problems(&self) -> Vec<(&'static str, String, String)> {
        let connections = self.max_connections;
        let wrong = !(1..=64).contains(&connections);
        let message = format!("`max_connections` is {connections}, but must be 1..=64");
        wrong.then(|| ("max_connections", message, "use 1 to 64".to_owned())).into_iter().collect()
    }

    /// Whether others than this host can reach it, and what they can do then; with a hint.
    #[must_use]
    pub fn warning(&self) -> Option<(String, String)> {
        let listen = self.listen.filter(|listen| !listen.ip().is_loopback())?;
        let what = if self.writes { "read and change every device" } else { "read every object" };
        let without = if self.writes { "; without `writes` nothing can be changed" } else { "" };
        Some((
            format!("whoever reaches {listen} can {what} without a login"),
            format!("let a firewall name the clients, or listen on 127.0.0.1{without}"),
        ))
    }

    /// How long a connection may be without a whole line; `None` = for ever.
    #[must_use]
    pub fn idle_timeout(&self) -> Option<Duration> {
        (self.idle_timeout_s > 0).then(|| Duration::from_secs(self.idle_timeout_s.into()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn it_is_off_and_takes_no_writes_unless_told_otherwise() {
        let settings: Cia309Settings = toml::from_str("").unwrap();
        assert_eq!((settings.listen, settings.writes), (None, false));
        assert_eq!((settings.problems().len(), settings.warning()), (0, None));
        assert!(toml::from_str::<Cia309Settings>("write = true").is_err());
        let settings: Cia309Settings = toml::from_str("max_connections = 65").unwrap();
        assert_eq!(settings.problems().len(), 1);
    }

    #[test]
    fn listening_for_other_hosts_is_warned_of_with_what_they_can_do() {
        let warning = |text: &str| toml::from_str::<Cia309Settings>(text).unwrap().warning();
        assert_eq!(warning("listen = '127.0.0.1:60000'\nwrites = true"), None);
        assert_eq!(warning("listen = '[::1]:60000'"), None);
        let (message, hint) = warning("listen = '0.0.0.0:60000'").unwrap();
        assert!(message.contains("read every object"), "{message}");
        assert!(!hint.contains("writes"), "they are off already: {hint}");
        let (message, hint) = warning("listen = '10.0.0.1:1'\nwrites = true").unwrap();
        assert!(message.contains("read and change") && hint.contains("without `writes`"), "{message} {hint}");
    }
}
