//! Addresses that may come to a server, pure.

use core::fmt;
use core::net::IpAddr;
use core::str::FromStr;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// An address, or all that begin with the same bits: `10.0.0.7`, `10.0.0.0/24`, `fd00::/8`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(try_from = "String", into = "String")]
#[schemars(with = "String")]
pub struct Network {
    address: IpAddr,
    /// Bits that count, 0..=32 or 0..=128.
    prefix: u8,
}

/// A text is no address and no network.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error(
    "`{0}` is no address and no network; write 10.0.0.7 or 10.0.0.0/24, and IPv4 as such, not behind ::ffff:"
)]
pub struct NotANetwork(String);

impl FromStr for Network {
    type Err = NotANetwork;

    fn from_str(text: &str) -> Result<Self, NotANetwork> {
        let (address, prefix) = match text.split_once('/') {
            Some((address, prefix)) => (address, Some(prefix)),
            None => (text, None),
        };
        let network = address.parse().ok().and_then(|address: IpAddr| {
            let prefix = prefix.map_or(Some(bits(address)), |prefix| prefix.parse().ok())?;
            (prefix <= bits(address)).then_some((address, prefix))
        });
        let network = network.and_then(|(address, prefix)| match address.to_canonical() {
            // An IPv4 address written as an IPv6 one. With fewer than all bits of the beginning that is the same for all of
            // them, it is unclear what is meant.
            own if bits(own) != bits(address) => {
                let prefix = prefix.checked_sub(bits(address) - bits(own))?;
                Some(Self { address: own, prefix })
            }
            _ => Some(Self { address, prefix }),
        });
        network.ok_or_else(|| NotANetwork(text.to_owned()))
    }
}

impl TryFrom<String> for Network {
    type Error = NotANetwork;

    fn try_from(text: String) -> Result<Self, NotANetwork> {
        text.parse()
    }
}

impl From<Network> for String {
    fn from(network: Network) -> Self {
        network.to_string()
    }
}

impl fmt::Display for Network {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(formatter, "{}/{}", self.address, self.prefix)
    }
}

impl Network {
    /// Whether an address is one of it. An IPv4 address is the same whether or not it is written as an IPv6 one.
    #[must_use]
    pub fn contains(&self, address: IpAddr) -> bool {
        let (own, other) = (self.address, address.to_canonical());
        let differ = u32::from(bits(own) - self.prefix);
        bits(own) == bits(other) && (value(own) ^ value(other)).checked_shr(differ).unwrap_or_default() == 0
    }

    /// Whether some address is one of both.
    #[must_use]
    pub fn overlaps(&self, other: &Self) -> bool {
        // Of two networks one holds the other, or they have nothing in common.
        let (wide, narrow) = if self.prefix <= other.prefix { (self, other) } else { (other, self) };
        wide.contains(narrow.address)
    }
}

/// Bits of an address.
fn bits(address: IpAddr) -> u8 {
    match address {
        IpAddr::V4(_) => 32,
        IpAddr::V6(_) => 128,
    }
}

fn value(address: IpAddr) -> u128 {
    match address {
        IpAddr::V4(address) => address.to_bits().into(),
        IpAddr::V6(address) => address.to_bits(),
    }
}

/// Who may come. An empty list lets everybody in.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(transparent)]
pub struct AllowList(Vec<Network>);

impl AllowList {
    /// These, or everybody where there is none.
    #[must_use]
    pub fn new(networks: Vec<Network>) -> Self {
        Self(networks)
    }

    /// Whether everybody may come.
    #[must_use]
    pub fn is_open(&self) -> bool {
        self.0.is_empty()
    }

    /// Whether an address may come.
    #[must_use]
    pub fn admits(&self, address: IpAddr) -> bool {
        self.0.is_empty() || self.0.iter().any(|network| network.contains(address))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn list(networks: &[&str]) -> AllowList {
        AllowList::new(networks.iter().map(|text| text.parse().unwrap()).collect())
    }

    fn admits(networks: &[&str], address: &str) -> bool {
        list(networks).admits(address.parse().unwrap())
    }

    #[test]
    fn only_who_is_in_the_list_may_come_and_an_empty_one_lets_everybody_in() {
        assert!(admits(&[], "10.0.0.7"));
        let networks = ["10.0.0.7", "192.168.4.0/23", "fd00:1::/32"];
        for address in ["10.0.0.7", "::ffff:10.0.0.7", "192.168.4.0", "192.168.5.255", "fd00:1::9"] {
            assert!(admits(&networks, address), "{address}");
        }
        for address in ["10.0.0.8", "192.168.6.0", "192.168.3.255", "fd00:2::9", "::10.0.0.7", "::1"] {
            assert!(!admits(&networks, address), "{address}");
        }
        assert!(admits(&["0.0.0.0/0"], "8.8.8.8") && !admits(&["0.0.0.0/0"], "fd00::1"));
        assert!(admits(&["::/0"], "fd00::1"));
    }

    #[test]
    fn ipv4_written_as_ipv6_is_ipv4() {
        for entry in ["::ffff:10.0.0.7", "::ffff:10.0.0.0/120", "::ffff:0a00:0007/128", "::ffff:0.0.0.0/96"] {
            assert!(admits(&[entry], "10.0.0.7") && admits(&[entry], "::ffff:10.0.0.7"), "{entry}");
        }
        assert!(!admits(&["::ffff:10.0.0.0/120"], "10.0.1.7"));
        let network: Network = "::ffff:10.0.0.0/120".parse().unwrap();
        assert_eq!(network.to_string(), "10.0.0.0/24");
        for entry in ["::ffff:10.0.0.0/95", "::ffff:10.0.0.0/24", "::ffff:0.0.0.0/0"] {
            assert!(entry.parse::<Network>().unwrap_err().to_string().contains("::ffff:"), "{entry}");
        }
    }

    #[test]
    fn networks_overlap_where_one_holds_the_other() {
        let overlap = |one: &str, other: &str| {
            let (one, other): (Network, Network) = (one.parse().unwrap(), other.parse().unwrap());
            assert_eq!(one.overlaps(&other), other.overlaps(&one));
            one.overlaps(&other)
        };
        assert!(overlap("10.0.0.0/24", "10.0.0.7") && overlap("10.0.0.7", "10.0.0.7"));
        assert!(overlap("10.0.0.0/24", "10.0.0.0/23") && overlap("::/0", "fd00::1"));
        assert!(!overlap("10.0.0.0/24", "10.0.1.0/24") && !overlap("0.0.0.0/0", "::/0"));
    }

    #[test]
    fn what_is_no_network_is_named() {
        for text in ["", "plant", "10.0.0", "10.0.0.0/33", "10.0.0.0/", "::/129", "10.0.0.0/-1"] {
            assert!(text.parse::<Network>().unwrap_err().to_string().contains(&format!("`{text}`")));
        }
        let network: Network = "10.0.0.0/24".parse().unwrap();
        assert_eq!(network.to_string(), "10.0.0.0/24");
    }
}
