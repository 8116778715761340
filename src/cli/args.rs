//! What can be typed.

use std::net::SocketAddr;
use std::path::PathBuf;

use clap::{Args, Parser, ValueEnum};
use clap_complete::Shell;

use super::buffer::{parse_hours, parse_size};
use super::esd_args::EsdArguments;
use super::health::Url;
use super::lss_args::LssArguments;
use super::schema::Schema;
use super::tool_args::{InitArguments, NmtArguments, ScanArguments, SdoArguments};
use crate::can::interface::Interface;
use crate::config::DEFAULT_FILE;
use crate::modbus::MapFormat;
use crate::simulator::DeviceNumber;
use crate::simulator::serial_place::SerialPlace;
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
    /// Write the DCF of nodes: their EDS with what this configuration sets them to.
    Dcf(DcfArguments),
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
    /// Plan how much room is needed for what is kept while the broker is away.
    Buffer(BufferArguments),
    /// Ask the gateway on this host whether it is ready; exit code 1 when it is not. For containers and watchdogs.
    Health(HealthArguments),
    /// Make the hash of a password, for `password` in [access.NAME]. It is asked for, or read from standard input.
    Password,
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
    /// Find, show and command esd modules: CAN-CBM-SIO1 and SIO4.
    Esd(EsdArguments),
}

/// `cangate run`
#[derive(Args, Debug)]
pub struct RunArguments {
    /// The configuration file.
    #[arg(short, long, default_value = DEFAULT_FILE, value_name = "FILE")]
    pub config: PathBuf,
    /// Folder for a copy of the last good configuration, which is started where the file is bad. Without it: /var/lib/cangate,
    /// where that is there and can be written to.
    #[arg(long, env = "CANGATE_STATE_DIR", value_name = "FOLDER")]
    pub state_dir: Option<PathBuf>,
    /// Let a reload change what stands at published Modbus addresses and topics; as `allow_map_change` under `[gateway]`, but
    /// for every reload of this run.
    #[arg(long)]
    pub allow_map_change: bool,
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
    /// Where the first of the three serial lines listens; the others take the next ports.
    #[arg(long, default_value = "127.0.0.1:4001", value_name = "ADDRESS", value_parser = first_of_three)]
    pub serial: SocketAddr,
}

/// An address with two more ports above its own; port 0 takes any three.
fn first_of_three(text: &str) -> Result<SocketAddr, String> {
    let address: SocketAddr = text.parse().map_err(|error| format!("{error}; give IP:PORT"))?;
    match address.port().checked_add(2) {
        Some(_) => Ok(address),
        None => Err("three ports are needed: 65533 is the highest for the first".to_owned()),
    }
}

/// `cangate check`
#[derive(Args, Debug)]
pub struct CheckArguments {
    /// Configuration and mapping files.
    #[arg(required = true, value_name = "FILE")]
    pub files: Vec<PathBuf>,
    /// The configuration that runs: print what a reload would change to go from it to the one FILE. Exit code 1 where the reload
    /// would be refused because published addresses change.
    #[arg(long, value_name = "RUNNING")]
    pub against: Option<PathBuf>,
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
    /// Instead of the map: every frame that this configuration lets the gateway send on CAN, whom it is for, why, and how often
    /// at most. Anything else cannot leave. As table, csv or json.
    #[arg(long)]
    pub frames: bool,
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
    /// The EDS or DCF; with --list a folder of them.
    #[arg(value_name = "FILE")]
    pub file: PathBuf,
    /// Where to; standard output without it. A file of a former import is updated: its names, addresses and what was
    /// written by hand stay.
    #[arg(short, long, value_name = "FILE")]
    pub output: Option<PathBuf>,
    /// Import nothing: print of which devices the EDS and DCF files of this folder are.
    #[arg(long, conflicts_with = "output")]
    pub list: bool,
}

/// `cangate dcf`
#[derive(Args, Debug)]
pub struct DcfArguments {
    /// Names of nodes of the configuration; all without them.
    #[arg(value_name = "NODE")]
    pub nodes: Vec<String>,
    /// The configuration file.
    #[arg(short, long, default_value = DEFAULT_FILE, value_name = "FILE")]
    pub config: PathBuf,
    /// An EDS, or a folder in which the one of each device is found by maker and product. May be given several times.
    #[arg(long, required = true, value_name = "PATH")]
    pub eds: Vec<PathBuf>,
    /// Folder for the DCFs, each called after its node, which replace those that are there. Without it the DCF of one node goes
    /// to standard output.
    #[arg(short, long, value_name = "FOLDER")]
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
    /// Its CANopen node id, 1 to 127; of an esd module its coding switches, 1 to 0xCC (SIO1) or 0xCB (SIO4).
    #[arg(long)]
    pub node: DeviceNumber,
    /// How many devices, on numbers that follow each other.
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u8).range(1..=127))]
    pub count: u8,
    /// Puts a serial channel of an esd module to where programs find it: `1=pty:/tmp/ttyS1`, or `2=tcp:127.0.0.1:7001`. Can be
    /// given for each channel.
    #[arg(long, value_name = "CHANNEL=PLACE")]
    pub serial: Vec<SerialPlace>,
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
    /// esd CAN-CBM-SIO1, a serial line behind CAN.
    #[value(name = "cbm-sio1")]
    CbmSio1,
    /// esd CAN-CBM-SIO4, five serial lines behind CAN.
    #[value(name = "cbm-sio4")]
    CbmSio4,
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

/// `cangate buffer`
#[derive(Args, Debug)]
pub struct BufferArguments {
    /// What to do.
    #[command(subcommand)]
    pub command: BufferCommand,
}

/// `cangate buffer ...`
#[derive(Debug, clap::Subcommand)]
pub enum BufferCommand {
    /// How many hours the room for what is kept on disk lasts while the broker is away, or how much room so many hours need,
    /// with the configured nodes.
    Plan(PlanArguments),
}

/// `cangate buffer plan`
#[derive(Args, Debug)]
pub struct PlanArguments {
    /// The configuration file.
    #[arg(short, long, default_value = DEFAULT_FILE, value_name = "FILE")]
    pub config: PathBuf,
    /// Hours without a broker: how much room do they need?
    #[arg(long, value_name = "HOURS", conflicts_with = "bytes", value_parser = parse_hours)]
    pub hours: Option<f64>,
    /// Room, for example 512M: how long does it last? `buffer_bytes` of the configuration unless given.
    #[arg(long, value_name = "BYTES", value_parser = parse_size)]
    pub bytes: Option<u64>,
}
