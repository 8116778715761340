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
    /// Names with a dot under which this gateway is called in a browser's address, beside its addresses, `localhost` and its
    /// own name. Requests for other names are refused, so that a web page from elsewhere cannot read values through the
    /// browser of somebody in the plant.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub allowed_hosts: Vec<String>,
}

impl Default for WebSettings {
    fn default() -> Self {
        Self { listen: SocketAddr::new(IpAddr::V4(Ipv4Addr::LOCALHOST), 8080), allowed_hosts: Vec::new() }
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
