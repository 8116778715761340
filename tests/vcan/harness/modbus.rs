//! Foreign Modbus clients: mbpoll, one process for each reading, and pymodbus in one long-lived process.

use std::process::Command;
use std::sync::{Mutex, OnceLock};
use std::time::Duration;

use serde_json::{Value, json};

use super::process::{Process, run};
use super::wait::{wait_for, within};

/// One of the four tables of a Modbus server.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Table {
    /// FC 1.
    Coil,
    /// FC 2.
    Discrete,
    /// FC 3.
    Holding,
    /// FC 4.
    Input,
}

impl Table {
    fn mbpoll(self) -> &'static str {
        match self {
            Self::Coil => "0",
            Self::Discrete => "1",
            Self::Holding => "4",
            Self::Input => "3",
        }
    }

    fn pymodbus(self) -> &'static str {
        match self {
            Self::Coil => "coil",
            Self::Discrete => "discrete_input",
            Self::Holding => "holding_register",
            Self::Input => "input_register",
        }
    }
}

/// Reads with mbpoll.
pub fn mbpoll(port: u16, unit: u8, table: Table, address: u16, count: u16) -> Result<Vec<u16>, String> {
    let port = port.to_string();
    mbpoll_by(&["-m", "tcp", "-p", &port], "127.0.0.1", unit, table, address, count)
}

/// Reads with mbpoll on a serial line with the settings that every device offers.
pub fn mbpoll_rtu(line: &str, unit: u8, table: Table, address: u16, count: u16) -> Result<Vec<u16>, String> {
    mbpoll_by(&["-m", "rtu", "-b", "19200", "-P", "even"], line, unit, table, address, count)
}

fn mbpoll_by(
    way: &[&str],
    to: &str,
    unit: u8,
    table: Table,
    address: u16,
    count: u16,
) -> Result<Vec<u16>, String> {
    let (unit, address, count) = (unit.to_string(), address.to_string(), count.to_string());
    let what =
        ["-1", "-q", "-o", "5", "-0", "-a", &unit, "-t", table.mbpoll(), "-r", &address, "-c", &count, to];
    let (good, stdout, stderr) = run("mbpoll", &[way, &what].concat());
    if !good {
        return Err(format!("{stdout}{stderr}"));
    }
    // Lines like `[100]:   65535 (-1)`.
    Ok(stdout
        .lines()
        .filter_map(|line| {
            line.strip_prefix('[')?.split_once("]:")?.1.split_whitespace().next()?.parse().ok()
        })
        .collect())
}

/// pymodbus, which takes a second to start: one process serves all tests.
static PYMODBUS: OnceLock<Mutex<Peer>> = OnceLock::new();

struct Peer {
    process: Process,
    answers: usize,
}

impl Peer {
    fn start() -> Mutex<Self> {
        let python = std::env::var("CANGATE_TEST_PYTHON")
            .expect("CANGATE_TEST_PYTHON names a python with pymodbus; `tests/all vcan` sets it");
        let script = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/vcan/peers/modbus_client.py");
        let process = Process::start("pymodbus", Command::new(python).args(["-u", script]));
        Mutex::new(Self { process, answers: 0 })
    }

    fn ask(&mut self, request: &Value) -> Result<Value, String> {
        assert!(self.process.runs(), "the pymodbus peer ended: {:?}", self.process.stderr());
        self.process.say(&request.to_string());
        let line = wait_for(format!("pymodbus to answer {request}"), || {
            self.process.stdout(self.answers).into_iter().next()
        });
        self.answers += 1;
        let mut answer: Value = serde_json::from_str(&line.text).unwrap();
        match answer.get("error").and_then(Value::as_str) {
            Some(error) => Err(error.to_owned()),
            None => Ok(answer["result"].take()),
        }
    }
}

fn pymodbus_ask(request: &Value) -> Result<Value, String> {
    PYMODBUS.get_or_init(Peer::start).lock().unwrap_or_else(|error| error.into_inner()).ask(request)
}

/// Reads with pymodbus. The connection stays open for the next reading.
pub fn pymodbus(port: u16, unit: u8, table: Table, address: u16, count: u16) -> Result<Vec<u16>, String> {
    let request =
        json!({"port": port, "unit": unit, "read": table.pymodbus(), "address": address, "count": count});
    pymodbus_ask(&request).map(|values| serde_json::from_value(values).unwrap())
}

/// Device identification (FC 43/14) by pymodbus: objects by their number.
pub fn pymodbus_identification(port: u16, unit: u8) -> Result<Value, String> {
    pymodbus_ask(&json!({"port": port, "unit": unit, "identify": true}))
}

/// What a PLC sees of one node.
#[derive(Clone, Copy, Debug)]
pub struct Registers {
    /// Port of the gateway.
    pub port: u16,
    /// Unit id.
    pub unit: u8,
}

impl Registers {
    /// Input registers, by pymodbus; the reading must succeed.
    pub fn input(self, address: u16, count: u16) -> Vec<u16> {
        pymodbus(self.port, self.unit, Table::Input, address, count).unwrap_or_else(|error| {
            panic!("input registers {address}+{count} of unit {}: {error}", self.unit)
        })
    }

    /// Discrete inputs, by pymodbus; the reading must succeed.
    pub fn discrete(self, address: u16, count: u16) -> Vec<u16> {
        pymodbus(self.port, self.unit, Table::Discrete, address, count).unwrap_or_else(|error| {
            panic!("discrete inputs {address}+{count} of unit {}: {error}", self.unit)
        })
    }

    /// One input register.
    pub fn register(self, address: u16) -> u16 {
        self.input(address, 1)[0]
    }

    /// One discrete input.
    pub fn bit(self, address: u16) -> bool {
        self.discrete(address, 1)[0] != 0
    }

    /// Two input registers, high word first.
    pub fn u32(self, address: u16) -> u32 {
        let words = self.input(address, 2);
        u32::from(words[0]) << 16 | u32::from(words[1])
    }

    /// The status word of the node block.
    pub fn status(self) -> Status {
        Status(self.register(1))
    }

    /// Waits until the status word is as wanted.
    pub fn wait_for_status(self, what: &str, wanted: impl Fn(Status) -> bool) -> Status {
        let mut last = Status(0);
        let found = within(Duration::from_secs(30), || {
            last = self.status();
            wanted(last).then_some(last)
        });
        found.unwrap_or_else(|| panic!("waited for {what}; node block: {:?}", self.input(0, 40)))
    }
}

/// Status word of a node, register 1.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Status(pub u16);

impl Status {
    fn bit(self, bit: u32) -> bool {
        self.0 >> bit & 1 != 0
    }
    pub fn online(self) -> bool {
        self.bit(0)
    }
    pub fn operational(self) -> bool {
        self.bit(1)
    }
    pub fn supervision_ok(self) -> bool {
        self.bit(2)
    }
    pub fn all_good(self) -> bool {
        self.bit(3)
    }
    pub fn alarm_active(self) -> bool {
        self.bit(4)
    }
    pub fn passive(self) -> bool {
        self.bit(12)
    }
}
