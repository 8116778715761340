//! What can be typed.

use std::net::SocketAddr;
use std::path::PathBuf;

use clap::{Args, Parser, ValueEnum};
use clap_complete::Shell;

use super::health::Url;
use super::lss_args::LssArguments;
use super::schema::Schema;
use super::tool_args::{InitArguments, NmtArguments, ScanArguments, SdoArguments};
use crate::can::interface::Interface;
use crate::config::DEFAULT_FILE;
use crate::modbus::MapFormat;
use crate::telemetry::{DEFAULT_FILTER, LogFormat};

/// A CANopen gateway to Modbus TCP and MQTT that tells stale values from live ones.
///
/// Start with `cangate demo`: it needs no hardware, no broker and no file.
#[derive(Debug, Parser)]
#[command(name = "cangate", version, max_term_width = 100)]
pub struct CommandLine {
    /// What is logged to standard error, for example `warn,cangate::canopen=debug`.
    #[arg(long, global = true, env = "CANGATE_LOG", default_value = DEFAULT_FILTER, value_name = "FILTER")]
    pub log: String,
    /// How log lines look.
    #[arg(long, global = true, env = "CANGATE_LOG_FORMAT", value_enum, default_value_t)]
    pub log_format: LogFormat,
    /// What to do.
    #[command(subcommand)]
    pub command: Subcommand,
}

/// What to do.
#[derive(Debug, clap::Subcommand)]
pub enum Subcommand {
    /// Run the gateway.
    Run(RunArguments),
    /// Show everything with simulated devices: no hardware, no broker, no file.
    Demo(DemoArguments),
    /// Check configuration and mapping files; every problem with file, line, column and a hint.
    Check(CheckArguments),
    /// Print the register and topic map of a configuration, or what differs between two maps.
    Map(MapArguments),
    /// Make a device mapping from an EDS or DCF, or update one.
    Import(ImportArguments),
    /// Put a simulated device on an interface.
    Sim(SimArguments),
    /// Run a candump log through the gateway; the same log gives the same output, always.
    Replay(ReplayArguments),
    /// Print the JSON Schema of a file format, for editors.
    Schema(SchemaArguments),
    /// Print the completion script of a shell.
    Completions(CompletionsArguments),
    /// Print the manual page, or write one for each command.
    Man(ManArguments),
    /// Ask the gateway on this host whether it is ready; exit code 1 when it is not. For containers and watchdogs.
    Health(HealthArguments),
    /// Tell who is on a bus. Without --active NOTHING is sent, not one frame; where the controller can, not even
    /// acknowledges.
    Scan(ScanArguments),
    /// Write a first configuration from what a scan finds.
    Init(InitArguments),
    /// Send an NMT command to a node, or to all.
    Nmt(NmtArguments),
    /// Read or write an object of a node.
    Sdo(SdoArguments),
    /// Find devices by their LSS address, give them node ids and bit rates.
    Lss(LssArguments),
}

/// `cangate run`
#[derive(Args, Debug)]
pub struct RunArguments {
    /// The configuration file.
    #[arg(short, long, default_value = DEFAULT_FILE, value_name = "FILE")]
    pub config: PathBuf,
}

/// `cangate demo`
#[derive(Args, Debug)]
pub struct DemoArguments {
    /// Where Modbus TCP listens.
    #[arg(long, default_value = "127.0.0.1:5020", value_name = "ADDRESS")]
    pub modbus: SocketAddr,
    /// Where the broker inside the demo listens.
    #[arg(long, default_value = "127.0.0.1:1883", value_name = "ADDRESS")]
    pub mqtt: SocketAddr,
    /// Publish to this broker instead of the one inside, for example `mqtt://mosquitto:1883`.
    #[arg(long, value_name = "URL", conflicts_with = "mqtt")]
    pub broker: Option<String>,
    /// Where the status page listens.
    #[arg(long, default_value = "127.0.0.1:8080", value_name = "ADDRESS")]
    pub http: SocketAddr,
}

/// `cangate check`
#[derive(Args, Debug)]
pub struct CheckArguments {
    /// Configuration and mapping files.
    #[arg(required = true, value_name = "FILE")]
    pub files: Vec<PathBuf>,
}

/// `cangate map`
#[derive(Args, Debug)]
#[command(args_conflicts_with_subcommands = true)]
pub struct MapArguments {
    /// Compare two maps instead.
    #[command(subcommand)]
    pub command: Option<MapCommand>,
    /// The configuration file.
    #[arg(short, long, default_value = DEFAULT_FILE, value_name = "FILE")]
    pub config: PathBuf,
    /// How the map is written.
    #[arg(long, value_enum, default_value_t)]
    pub format: MapFormat,
    /// Where to; standard output without it.
    #[arg(short, long, value_name = "FILE")]
    pub output: Option<PathBuf>,
}

/// `cangate map diff`
#[derive(Debug, clap::Subcommand)]
pub enum MapCommand {
    /// What differs between two maps written with `--format json`; exit code 1 where a published address, or the topic of
    /// what stands there, changed its meaning.
    ///
    /// Maps list what has an address. Topics without one are not compared: tags without a register, availability, alarms
    /// of buses and of the gateway, bridge/... and event.
    Diff {
        /// The older map.
        old: PathBuf,
        /// The newer map.
        new: PathBuf,
    },
}

/// `cangate import`
#[derive(Args, Debug)]
pub struct ImportArguments {
    /// The EDS or DCF.
    #[arg(value_name = "FILE")]
    pub file: PathBuf,
    /// Where to; standard output without it. A file of a former import is updated: its names, addresses and what was
    /// written by hand stay.
    #[arg(short, long, value_name = "FILE")]
    pub output: Option<PathBuf>,
}

/// `cangate sim`
#[derive(Args, Debug)]
pub struct SimArguments {
    /// The device.
    #[arg(value_enum)]
    pub device: SimDevice,
    /// The interface, for example `vcan0`.
    #[arg(short, long)]
    pub interface: Interface,
    /// Its CANopen node id, 1 to 127.
    #[arg(long, value_parser = clap::value_parser!(u8).range(1..=127))]
    pub node: u8,
    /// How many devices, on node ids that follow each other.
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u8).range(1..=127))]
    pub count: u8,
    /// A scenario file, or the name of a shipped one (see docs/simulator.md).
    #[arg(long, value_name = "FILE")]
    pub scenario: Option<String>,
    /// Seed of the pretended noise; the same seed gives the same values.
    #[arg(long, default_value_t = 1)]
    pub seed: u64,
}

/// The devices that can be simulated.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum SimDevice {
    /// MOTORTECH DetCon detonation controller.
    Detcon,
    /// Danfoss DST P92C pressure transmitter.
    #[value(name = "dst-p92c")]
    DstP92c,
}

/// `cangate replay`
#[derive(Args, Debug)]
pub struct ReplayArguments {
    /// A recording as `candump -L` writes it.
    #[arg(value_name = "LOG")]
    pub recording: PathBuf,
    /// The bus of the configuration that the log was recorded on; needed only where it cannot be told.
    #[arg(long, value_name = "NAME")]
    pub bus: Option<String>,
    /// The configuration file.
    #[arg(short, long, default_value = DEFAULT_FILE, value_name = "FILE")]
    pub config: PathBuf,
}

/// `cangate schema`
#[derive(Args, Debug)]
pub struct SchemaArguments {
    /// Of which file.
    #[arg(value_enum)]
    pub of: Schema,
}

/// `cangate completions`
#[derive(Args, Debug)]
pub struct CompletionsArguments {
    /// The shell.
    #[arg(value_enum)]
    pub shell: Shell,
}

/// `cangate man`
#[derive(Args, Debug)]
pub struct ManArguments {
    /// Write a page for each command into this folder instead, as `cangate-run.1`.
    #[arg(short, long, value_name = "FOLDER")]
    pub output: Option<PathBuf>,
}

/// `cangate health`
#[derive(Args, Debug)]
pub struct HealthArguments {
    /// What to ask. Without it: /readyz at the address that the configuration says under `[http]`.
    #[arg(value_name = "URL")]
    pub url: Option<Url>,
    /// The configuration file [default: /etc/cangate/cangate.toml, or 127.0.0.1:8080 where that does not exist].
    #[arg(short, long, value_name = "FILE", conflicts_with = "url")]
    pub config: Option<PathBuf>,
}
