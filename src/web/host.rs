//! Who a request is meant for, pure: a web page from elsewhere must not read this gateway through its visitor's browser by
//! giving its own name our address (DNS rebinding). Such a request carries the foreign name in `Host`.

use core::net::IpAddr;

/// Names under which the gateway answers, beside its addresses.
#[derive(Clone, Debug, Default)]
pub struct Hosts {
    names: Vec<String>,
}

impl Hosts {
    /// The gateway's own name and those of the settings.
    #[must_use]
    pub fn new(gateway: &str, allowed: &[String]) -> Self {
        let names = allowed.iter().map(String::as_str).chain([gateway, "localhost"]);
        Self { names: names.map(str::to_ascii_lowercase).collect() }
    }

    /// Whether a `Host` header names us: an address, a known name, or a name without a dot, which nobody can register in
    /// the public name system (containers and hosts of the plant call each other so).
    #[must_use]
    pub fn names_us(&self, host: &str) -> bool {
        let name = without_port(host).trim_end_matches('.').to_ascii_lowercase();
        let literal = name.trim_start_matches('[').trim_end_matches(']').parse::<IpAddr>().is_ok();
        let local = !name.is_empty() && !name.contains('.');
        literal || local || self.names.contains(&name)
    }
}

fn without_port(host: &str) -> &str {
    match host.rsplit_once(':') {
        Some((name, port)) if !port.contains(']') && (name.ends_with(']') || !name.contains(':')) => name,
        _ => host,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn addresses_and_known_names_are_us_and_names_of_strangers_are_not() {
        let hosts = Hosts::new("hall-1", &["Gateway.plant.example".to_owned()]);
        for ours in [
            "127.0.0.1",
            "10.0.0.7:8080",
            "[::1]:8080",
            "[fe80::1]",
            "::1",
            "localhost:8080",
            "LOCALHOST",
            "hall-1",
            "cangate:8080",
            "gateway.plant.example",
            "gateway.plant.example.:80",
        ] {
            assert!(hosts.names_us(ours), "{ours}");
        }
        for strange in
            ["evil.example", "evil.example:8080", "127.0.0.1.evil.example", "", ":8080", "x.plant.example"]
        {
            assert!(!hosts.names_us(strange), "{strange}");
        }
    }
}
