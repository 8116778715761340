//! `cangate` as its own process: the gateway and the simulator.

use std::fmt::Write;
use std::net::TcpStream;
use std::process::Command;

use tempfile::TempDir;

use super::broker::Broker;
use super::bus::BUS;
use super::modbus::Registers;
use super::process::{Process, free_port};
use super::wait::wait_until;

/// The gateway's name in all tests.
pub const NAME: &str = "hall-1";
/// What stands before each of its topics.
pub const TOPICS: &str = "cangate/hall-1/";

/// What the configuration file says; [`start`](Self::start) writes it.
pub struct Setup {
    role: &'static str,
    mqtt: Option<String>,
    nodes: Vec<(String, u8)>,
    bus_keys: String,
    node_keys: String,
    mqtt_keys: String,
    mappings: Vec<(String, String)>,
    more: String,
}

impl Setup {
    /// A master with one DetCon `engine1`, node 1, and no broker.
    pub fn one_detcon() -> Self {
        Self::detcons(&[1])
    }

    /// A master with DetCons `engine<n>` of these node ids.
    pub fn detcons(ids: &[u8]) -> Self {
        let nodes = ids.iter().map(|id| (format!("engine{id}"), *id)).collect();
        Self {
            role: "master",
            mqtt: None,
            nodes,
            bus_keys: String::new(),
            node_keys: String::new(),
            mqtt_keys: String::new(),
            mappings: Vec::new(),
            more: String::new(),
        }
    }

    /// With a broker.
    pub fn broker(self, broker: &Broker) -> Self {
        self.broker_port(broker.port)
    }

    /// With something on this port that behaves like a broker.
    pub fn broker_port(self, port: u16) -> Self {
        self.broker_at(&format!("127.0.0.1:{port}"))
    }

    /// With a broker at this address, `HOST:PORT`.
    pub fn broker_at(mut self, address: &str) -> Self {
        self.mqtt = Some(address.to_owned());
        self
    }

    /// Sends nothing.
    pub fn passive(mut self) -> Self {
        self.role = "passive";
        self
    }

    /// A line for the bus.
    pub fn bus_key(mut self, line: &str) -> Self {
        writeln!(self.bus_keys, "{line}").unwrap();
        self
    }

    /// A line for each node.
    pub fn node_key(mut self, line: &str) -> Self {
        writeln!(self.node_keys, "{line}").unwrap();
        self
    }

    /// A line for the broker.
    pub fn mqtt_key(mut self, line: &str) -> Self {
        writeln!(self.mqtt_keys, "{line}").unwrap();
        self
    }

    /// A mapping file of its own.
    pub fn mapping(mut self, name: &str, text: &str) -> Self {
        self.mappings.push((name.to_owned(), text.to_owned()));
        self
    }

    /// One more node.
    pub fn node(self, name: &str, id: u8, mapping: &str) -> Self {
        self.more(&format!("[node.{name}]\nbus = \"can0\"\nid = {id}\nmapping = \"{mapping}\""))
    }

    /// Text at the end of the file.
    pub fn more(mut self, text: &str) -> Self {
        writeln!(self.more, "{text}").unwrap();
        self
    }

    fn text(&self, modbus: u16, http: u16) -> String {
        let mut text = format!(
            "version = 1\n[gateway]\nname = \"{NAME}\"\n[bus.can0]\ninterface = \"{BUS}\"\nrole = \"{}\"\n",
            self.role
        );
        text.push_str(&self.bus_keys);
        for (name, id) in &self.nodes {
            write!(text, "[node.{name}]\nbus = \"can0\"\nid = {id}\nmapping = \"motortech-detcon\"\n")
                .unwrap();
            text.push_str(&self.node_keys);
        }
        write!(text, "[modbus]\nlisten = [\"127.0.0.1:{modbus}\"]\n[http]\nlisten = \"127.0.0.1:{http}\"\n")
            .unwrap();
        if let Some(address) = &self.mqtt {
            write!(text, "[mqtt]\nurl = \"mqtt://{address}\"\n").unwrap();
        }
        text + &self.mqtt_keys + &self.more
    }

    /// Starts the gateway and waits until it answers Modbus.
    pub fn start(self) -> Gateway {
        let folder = TempDir::new().unwrap();
        let (modbus, http) = (free_port(), free_port());
        std::fs::write(folder.path().join("cangate.toml"), self.text(modbus, http)).unwrap();
        std::fs::create_dir(folder.path().join("mappings")).unwrap();
        for (name, text) in &self.mappings {
            std::fs::write(folder.path().join("mappings").join(format!("{name}.toml")), text).unwrap();
        }
        let process = Gateway::spawn(&folder);
        let mut gateway = Gateway { modbus, http, process, folder };
        gateway.wait_until_it_serves();
        gateway
    }
}

/// `cangate run`.
pub struct Gateway {
    /// Port of its Modbus server.
    pub modbus: u16,
    /// Port of its web server.
    pub http: u16,
    /// The process.
    pub process: Process,
    folder: TempDir,
}

impl Gateway {
    fn spawn(folder: &TempDir) -> Process {
        Process::start(
            "cangate run",
            Command::new(env!("CARGO_BIN_EXE_cangate"))
                .current_dir(env!("CARGO_MANIFEST_DIR"))
                .args(["run", "-c"])
                .arg(folder.path().join("cangate.toml")),
        )
    }

    fn wait_until_it_serves(&mut self) {
        wait_until("the gateway to serve Modbus and HTTP", || {
            assert!(self.process.runs(), "cangate run ended");
            [self.modbus, self.http].iter().all(|port| TcpStream::connect(("127.0.0.1", *port)).is_ok())
        });
    }

    /// Starts it again with the same configuration, after its end.
    pub fn start_again(&mut self) {
        self.process = Self::spawn(&self.folder);
        self.wait_until_it_serves();
    }

    /// Registers of a node.
    pub fn node(&self, id: u8) -> Registers {
        Registers { port: self.modbus, unit: id }
    }

    /// Registers of the gateway itself.
    pub fn unit(&self) -> Registers {
        Registers { port: self.modbus, unit: 247 }
    }

    /// Body of a page of its web server.
    pub fn get(&self, path: &str) -> String {
        use std::io::{Read, Write};
        let mut stream = TcpStream::connect(("127.0.0.1", self.http)).unwrap();
        write!(stream, "GET {path} HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n").unwrap();
        let mut text = String::new();
        stream.read_to_string(&mut text).unwrap();
        text
    }
}

/// `cangate sim detcon` on vcan0.
pub fn simulator(node: u8, arguments: &[&str]) -> Process {
    simulate("detcon", node, arguments)
}

/// `cangate sim` of any device on vcan0.
pub fn simulate(device: &str, node: u8, arguments: &[&str]) -> Process {
    Process::start(
        "cangate sim",
        Command::new(env!("CARGO_BIN_EXE_cangate"))
            .current_dir(env!("CARGO_MANIFEST_DIR"))
            .args(["sim", device, "-i", BUS, "--node", &node.to_string()])
            .args(arguments),
    )
}
