//! Where an outside end of a simulated serial channel is, as it is typed: `1=pty:/tmp/ttyS1`, `2=tcp:127.0.0.1:7001`. Pure.

use std::fmt;
// Addresses only; `core` has no sockets.
use core::net::SocketAddr;
use std::path::PathBuf;
use std::str::FromStr;

/// An end for a channel.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct SerialPlace {
    /// From 1.
    pub channel: u8,
    /// What it is.
    pub kind: PlaceKind,
}

/// A kind of end.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum PlaceKind {
    /// A pseudo-terminal, which gets a link of this name.
    Pty(PathBuf),
    /// A TCP server, for one client at a time.
    Tcp(SocketAddr),
}

impl FromStr for SerialPlace {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let wrong = |what: &str| {
            format!("`{text}`: {what}; give for example 1=pty:/tmp/ttyS1 or 2=tcp:127.0.0.1:7001")
        };
        let (channel, place) = text.split_once('=').ok_or_else(|| wrong("no `=` behind the channel"))?;
        let channel = channel.parse().ok().filter(|channel| *channel > 0);
        let channel = channel.ok_or_else(|| wrong("no channel before the `=`"))?;
        let kind = match place.split_once(':') {
            Some(("pty", path)) if !path.is_empty() => PlaceKind::Pty(path.into()),
            Some(("tcp", address)) => {
                PlaceKind::Tcp(address.parse().map_err(|_| wrong("no IP address and port behind `tcp:`"))?)
            }
            _ => return Err(wrong("neither `pty:` and a path nor `tcp:` and an address")),
        };
        Ok(Self { channel, kind })
    }
}

impl fmt::Display for SerialPlace {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match &self.kind {
            PlaceKind::Pty(path) => write!(f, "{}=pty:{}", self.channel, path.display()),
            PlaceKind::Tcp(address) => write!(f, "{}=tcp:{address}", self.channel),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_place_is_read_as_it_is_written_and_what_is_wrong_is_told() {
        for text in ["1=pty:/tmp/ttyS1", "5=tcp:127.0.0.1:7001", "2=tcp:[::1]:7001"] {
            assert_eq!(text.parse::<SerialPlace>().unwrap().to_string(), text);
        }
        for (text, reason) in [
            ("pty:/tmp/x", "no `=`"),
            ("0=pty:/tmp/x", "no channel"),
            ("one=pty:/tmp/x", "no channel"),
            ("1=pty:", "neither"),
            ("1=/tmp/x", "neither"),
            ("1=tcp:localhost:7001", "no IP address"),
        ] {
            let error = text.parse::<SerialPlace>().unwrap_err();
            assert!(error.contains(reason) && error.contains("1=pty:/tmp/ttyS1"), "{error}");
        }
    }
}
