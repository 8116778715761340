//! The `[http]` table of the configuration.

use core::net::{IpAddr, Ipv4Addr, SocketAddr};

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Where the page, the JSON interface, health and metrics are served.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct WebSettings {
    /// Address and port. Anyone who reaches it can read every value; nothing can be changed through it.
    #[schemars(with = "String")]
    pub listen: SocketAddr,
}

impl Default for WebSettings {
    fn default() -> Self {
        Self { listen: SocketAddr::new(IpAddr::V4(Ipv4Addr::LOCALHOST), 8080) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_page_is_for_this_host_unless_told_otherwise() {
        let settings: WebSettings = toml::from_str("").unwrap();
        assert_eq!(settings.listen, "127.0.0.1:8080".parse().unwrap());
        assert!(toml::from_str::<WebSettings>("listen = 'everywhere'").is_err());
        assert!(toml::from_str::<WebSettings>("port = 1").is_err());
    }
}
