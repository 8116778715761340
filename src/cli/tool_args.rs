//! What can be typed after the commissioning tools: `scan`, `init`, `nmt`, `sdo`.

use std::fmt;
use std::path::PathBuf;
use std::str::FromStr;

use clap::{Args, ValueEnum};

use crate::can::interface::Interface;
use crate::canopen::object::{DataType, ObjectId, ParseObjectError};
use crate::canopen::{NmtRequest, NodeId};
use crate::mapping::build::is_snake_case;

/// What a scan does, for `scan` and `init` alike.
#[derive(Args, Clone, Copy, Debug)]
pub struct ScanOptions {
    /// Ask as well: each node id by SDO for what it is, and by a guard request where it does not answer. At most 20 frames a
    /// second, nothing is written. Do not use it beside a master at work that guards its nodes. Without this option NOTHING
    /// is sent.
    #[arg(long)]
    pub active: bool,
    /// How long to listen, in seconds; with --active, before asking.
    #[arg(long, default_value_t = 5, value_parser = clap::value_parser!(u32).range(1..=3600))]
    pub seconds: u32,
    /// The node ids to ask with --active.
    #[arg(long, default_value = "1-127", value_name = "FROM-TO", requires = "active")]
    pub nodes: NodeRange,
}

/// `cangate scan`
#[derive(Args, Debug)]
pub struct ScanArguments {
    /// The interface, for example `can0`.
    #[arg(short, long)]
    pub interface: Interface,
    /// How to scan.
    #[command(flatten)]
    pub options: ScanOptions,
    /// How the findings are written.
    #[arg(long, value_enum, default_value_t)]
    pub format: ScanFormat,
}

/// How the findings of a scan are written.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
pub enum ScanFormat {
    /// For people.
    #[default]
    Table,
    /// For machines, and for `cangate init --scan-file`.
    Json,
}

/// `cangate init`
#[derive(Args, Debug)]
pub struct InitArguments {
    /// The interface to scan, for example `can0`.
    #[arg(short, long, required_unless_present = "scan_file")]
    pub interface: Option<Interface>,
    /// Use these findings, written by `cangate scan --format json`, instead of scanning.
    #[arg(long, value_name = "FILE", conflicts_with_all = ["interface", "active", "seconds", "nodes"])]
    pub scan_file: Option<PathBuf>,
    /// How to scan.
    #[command(flatten)]
    pub options: ScanOptions,
    /// The configuration file to write.
    #[arg(short, long, default_value = "cangate.toml", value_name = "FILE")]
    pub output: PathBuf,
    /// Overwrite the file.
    #[arg(long)]
    pub force: bool,
    /// The name of the gateway, part of MQTT topics.
    #[arg(long, default_value = "cangate", value_name = "NAME")]
    pub name: String,
}

/// `cangate nmt`
#[derive(Args, Debug)]
pub struct NmtArguments {
    /// The interface, for example `can0`.
    #[arg(short, long)]
    pub interface: Interface,
    /// The command.
    #[arg(value_enum)]
    pub command: NmtWord,
    /// To whom: a node id, 1 to 127, or `all`.
    #[arg(value_name = "NODE|all")]
    pub node: NodeTarget,
    /// Yes, stop or reset all nodes of the bus.
    #[arg(long)]
    pub yes: bool,
}

/// The NMT commands.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum NmtWord {
    /// Operational: process data flows.
    Start,
    /// Stopped: only NMT and error control.
    Stop,
    /// Pre-operational: no process data, SDO works.
    PreOperational,
    /// Restart the device.
    ResetNode,
    /// Restart the communication of the device.
    ResetCommunication,
}

impl From<NmtWord> for NmtRequest {
    fn from(word: NmtWord) -> Self {
        match word {
            NmtWord::Start => Self::Start,
            NmtWord::Stop => Self::Stop,
            NmtWord::PreOperational => Self::EnterPreOperational,
            NmtWord::ResetNode => Self::ResetNode,
            NmtWord::ResetCommunication => Self::ResetCommunication,
        }
    }
}

/// `cangate sdo`
#[derive(Args, Debug)]
pub struct SdoArguments {
    /// The interface, for example `can0`.
    #[arg(short, long)]
    pub interface: Interface,
    /// Its CANopen node id, 1 to 127.
    #[arg(long, value_parser = node_id)]
    pub node: NodeId,
    /// Call objects by the names of tags: those of this mapping, one that comes with the program or a file.
    #[arg(long, value_name = "MAPPING", conflicts_with = "config")]
    pub mapping: Option<String>,
    /// The same: those of the node in this configuration that has this id.
    #[arg(short, long, value_name = "FILE")]
    pub config: Option<PathBuf>,
    /// How long an answer may take, in ms.
    #[arg(long, default_value_t = 500, value_name = "MS", value_parser = clap::value_parser!(u32).range(10..=60_000))]
    pub timeout_ms: u32,
    /// How long the answer to a write of 0x1010 (store) or 0x1011 (restore) may take, in ms.
    #[arg(long, default_value_t = 3000, value_name = "MS", value_parser = clap::value_parser!(u32).range(10..=60_000))]
    pub store_timeout_ms: u32,
    /// How often a read that is not answered is repeated. Writes are not.
    #[arg(long, default_value_t = 2, value_parser = clap::value_parser!(u32).range(0..=10))]
    pub repeat: u32,
    /// Transfer long objects in blocks where the device can do so.
    #[arg(long)]
    pub block: bool,
    /// What to do.
    #[command(subcommand)]
    pub action: SdoCommand,
}

/// `cangate sdo read` and `write`
#[derive(Debug, clap::Subcommand)]
pub enum SdoCommand {
    /// Read an object.
    Read {
        /// Index and sub-index, for example 0x1018:1; or the name of a tag, with --mapping or --config.
        object: ObjectOrTag,
        /// Its data type: bool, i8 to i64, u8 to u64, f32, f64, string, unicode, octets, domain, `time_of_day`,
        /// `time_difference`. Known for the objects that CiA 301 defines; without it all plausible readings are shown.
        #[arg(long = "type", value_name = "TYPE")]
        data_type: Option<DataType>,
        /// Print nothing but the bytes, as hexadecimal digits.
        #[arg(long, conflicts_with = "data_type")]
        raw: bool,
    },
    /// Write an object, once.
    Write {
        /// Index and sub-index, for example 0x1017:0; or the name of a tag, with --mapping or --config.
        object: ObjectOrTag,
        /// The value: 500, 0x1F4, 1.5, text; bytes as pairs of hexadecimal digits. Of a tag: in its unit.
        #[arg(allow_negative_numbers = true)]
        value: String,
        /// Its data type, as for `read`; needed where CiA 301 does not define the object.
        #[arg(long = "type", value_name = "TYPE")]
        data_type: Option<DataType>,
    },
}

/// How an object is called.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum ObjectOrTag {
    /// By index and sub-index.
    Object(ObjectId),
    /// By the name of the tag that it is.
    Tag(String),
}

impl FromStr for ObjectOrTag {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        if is_snake_case(text) {
            return Ok(Self::Tag(text.to_owned()));
        }
        text.parse().map(Self::Object).map_err(|error: ParseObjectError| error.to_string())
    }
}

/// A node id.
///
/// # Errors
/// It is none; the text says what is one.
pub fn node_id(text: &str) -> Result<NodeId, String> {
    let id = text.parse().ok().and_then(NodeId::new);
    id.ok_or_else(|| format!("`{text}` is no CANopen node id: it is 1 to 127"))
}

/// One node, or all.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct NodeTarget(pub Option<NodeId>);

impl FromStr for NodeTarget {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        if text == "all" { Ok(Self(None)) } else { node_id(text).map(|node| Self(Some(node))) }
    }
}

impl fmt::Display for NodeTarget {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.0 {
            Some(node) => write!(f, "node {node}"),
            None => f.write_str("all nodes"),
        }
    }
}

/// Node ids from one to another.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct NodeRange {
    first: NodeId,
    last: NodeId,
}

impl NodeRange {
    /// They.
    pub fn nodes(self) -> impl Iterator<Item = NodeId> {
        (self.first.get()..=self.last.get()).filter_map(NodeId::new)
    }
}

impl FromStr for NodeRange {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let (first, last) = text.split_once('-').unwrap_or((text, text));
        let range = Self { first: node_id(first)?, last: node_id(last)? };
        if range.first > range.last {
            return Err(format!("`{text}` holds no node id: write the lower one first"));
        }
        Ok(range)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_target_is_a_node_or_all() {
        assert_eq!("all".parse(), Ok(NodeTarget(None)));
        assert_eq!("127".parse(), Ok(NodeTarget(NodeId::new(127))));
        for wrong in ["0", "128", "ALL", "", "-1"] {
            let error = wrong.parse::<NodeTarget>().unwrap_err();
            assert!(error.contains("1 to 127"), "{error}");
        }
    }

    #[test]
    fn a_range_is_one_node_or_from_to() {
        let nodes = |text: &str| {
            text.parse::<NodeRange>().map(|range| range.nodes().map(NodeId::get).collect::<Vec<_>>())
        };
        assert_eq!(nodes("3-5"), Ok(vec![3, 4, 5]));
        assert_eq!(nodes("7"), Ok(vec![7]));
        for wrong in ["5-3", "0-3", "1-128", "1-", "-", "1-2-3"] {
            assert!(nodes(wrong).is_err(), "{wrong}");
        }
    }
}
