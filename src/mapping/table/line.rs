//! Serial lines of esd modules, and where they are offered.

// Addresses only; `core` has no sockets.
use core::net::SocketAddr;

use crate::process_image::NodeIndex;
use crate::slots::AllowList;

/// A serial line that is used.
#[derive(Clone, Debug, PartialEq)]
pub struct LineDef {
    /// The node of its module.
    pub node: NodeIndex,
    /// Its place among the [channels](crate::esd::ModuleSettings::channels) of the module.
    pub channel: usize,
    /// The number of its channel, 1..=5.
    pub number: u8,
    /// One sentence; empty for none.
    pub description: String,
    /// The TCP port that it is offered at.
    pub tcp: Option<LineTcp>,
    /// The topics that it is offered at.
    pub mqtt: LineMqtt,
    /// Where its last message stands in the register map.
    pub text: Option<LineText>,
}

/// The TCP port of a line: raw bytes, as serial device servers have it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct LineTcp {
    /// Where it listens.
    pub listen: SocketAddr,
    /// Who may connect.
    pub allow: AllowList,
    /// Connections at the same time, 1..=64.
    pub max_connections: u16,
    /// Whether bytes of a client go out on the line.
    pub write: bool,
}

/// How a line is offered by MQTT.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct LineMqtt {
    /// Its messages are published.
    pub publish: bool,
    /// How their bytes are written.
    pub encoding: LineEncoding,
    /// Messages to its command topic go out on the line.
    pub write: bool,
}

/// How bytes of a line are written into text.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum LineEncoding {
    /// As text (UTF-8); a message that is none is written as Base64 and says so.
    #[default]
    Text,
    /// As Base64 (RFC 4648).
    Base64,
}

/// The last message of a line in registers: its length in bytes first, then two bytes in each, the first in the high
/// byte, filled up with 0.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct LineText {
    /// 0-based address of the length, offset not yet added.
    pub address: u16,
    /// Registers, that of the length included, 2..=65.
    pub registers: u16,
}
