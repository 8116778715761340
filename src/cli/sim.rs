//! `cangate sim`: simulated devices on a bus, with orders from the standard input. \[IO\]

use std::io::{BufRead, BufReader, Write};

use tokio::sync::mpsc;
use tokio_util::sync::CancellationToken;

use super::Exit;
use super::args::{SimArguments, SimDevice};
use super::output::{block_on, print_error};
use crate::can::interface::Interface;
use crate::can::{self, BusIndex};
use crate::canopen::NodeId;
use crate::simulator::scenario::{SHIPPED, Scenario};
use crate::simulator::task::{self, BusEnd};
use crate::simulator::{DevicePlan, SimulatorError};
use crate::supervisor::shutdown;
use crate::time::Clock;

/// Frames that wait for the bus. 127 devices that start at once send 508.
const TRANSMIT_QUEUE: usize = 1024;
/// Events that wait for the devices.
const EVENT_QUEUE: usize = 1024;
/// Lines that wait; when there are more, reading pauses.
const LINE_QUEUE: usize = 64;

/// What `cangate sim detcon` is asked for.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct SimOptions {
    /// The bus.
    pub interface: Interface,
    /// Node id of the first device.
    pub node: NodeId,
    /// How many devices, at least one; their node ids follow each other.
    pub count: u8,
    /// A file, or the name of a scenario that comes with the program; `quiet` when `None`.
    pub scenario: Option<String>,
    /// Equal seeds give equal values; each device has its own noise all the same.
    pub seed: u64,
}

/// Why the simulation does not begin.
#[derive(Debug, thiserror::Error)]
pub enum SimError {
    /// The last node id would be above 127.
    #[error("{count} devices from node {node} on need node ids up to {last}, but 127 is the highest")]
    NodeIds {
        /// The first.
        node: NodeId,
        /// How many.
        count: u8,
        /// The last.
        last: u16,
    },
    /// The scenario is neither a name nor a file that can be read.
    #[error("scenario `{scenario}` cannot be read: {source}; give a file, or one of {}", names())]
    ReadScenario {
        /// As the user wrote it.
        scenario: String,
        /// What the system says.
        source: std::io::Error,
    },
    /// The scenario has problems.
    #[error(transparent)]
    Scenario(#[from] SimulatorError),
}

impl SimError {
    /// How the command ends.
    #[must_use]
    pub fn exit(&self) -> Exit {
        match self {
            Self::NodeIds { .. } => Exit::Usage,
            Self::ReadScenario { .. } => Exit::Io,
            Self::Scenario(_) => Exit::Configuration,
        }
    }
}

fn names() -> String {
    SHIPPED.map(|(name, _)| name).join(", ")
}

/// Runs until a signal, with orders from the standard input.
pub(super) fn command(arguments: &SimArguments) -> Exit {
    let SimDevice::Detcon = arguments.device;
    let Some(node) = NodeId::new(arguments.node) else { return Exit::Usage };
    let options = SimOptions {
        interface: arguments.interface.clone(),
        node,
        count: arguments.count,
        scenario: arguments.scenario.clone(),
        seed: arguments.seed,
    };
    block_on(async {
        let stop = CancellationToken::new();
        if let Err(error) = shutdown::on_signal(stop.clone()) {
            print_error(&format!("signals cannot be handled: {error}"));
            return Exit::Io;
        }
        let input = BufReader::new(std::io::stdin());
        match run(options, input, std::io::stdout(), Clock::start(), stop).await {
            Ok(()) => Exit::Ok,
            Err(error) => {
                print_error(&error.to_string());
                error.exit()
            }
        }
    })
}

/// The devices that are asked for. Reads the scenario's file.
pub fn plan(options: &SimOptions) -> Result<Vec<DevicePlan>, SimError> {
    let scenario = scenario(options.scenario.as_deref().unwrap_or("quiet"))?;
    let count = options.count.max(1);
    (0..count)
        .map(|place| {
            let id = options.node.get().checked_add(place).and_then(NodeId::new);
            let last = u16::from(options.node.get()) + u16::from(count) - 1;
            let node = id.ok_or(SimError::NodeIds { node: options.node, count, last })?;
            let seed = options.seed.wrapping_add(u64::from(node.get()));
            Ok(DevicePlan { seed, ..DevicePlan::new(node, scenario.clone()) })
        })
        .collect()
}

fn scenario(name: &str) -> Result<Scenario, SimError> {
    if let Some(shipped) = Scenario::shipped(name) {
        return Ok(shipped);
    }
    let text = std::fs::read_to_string(name)
        .map_err(|source| SimError::ReadScenario { scenario: name.to_owned(), source })?;
    Ok(Scenario::parse(name, &text)?)
}

/// Runs until `stop`. Orders come from `input`, line by line; what happens is told to `report`.
///
/// `input` is read by a thread of its own that ends with it, or with the process.
pub async fn run(
    options: SimOptions,
    input: impl BufRead + Send + 'static,
    report: impl Write + Send,
    clock: Clock,
    stop: CancellationToken,
) -> Result<(), SimError> {
    let plans = plan(&options)?;
    let (events_to_us, events) = mpsc::channel(EVENT_QUEUE);
    let (transmit, to_send) = mpsc::channel(TRANSMIT_QUEUE);
    let (lines_to_us, lines) = mpsc::channel(LINE_QUEUE);
    std::thread::spawn(move || {
        for line in input.lines() {
            let Ok(line) = line else { return };
            if lines_to_us.blocking_send(line).is_err() {
                return;
            }
        }
    });
    let bus =
        can::task::run(BusIndex(0), options.interface, false, events_to_us, to_send, clock, stop.clone());
    let devices = task::run(plans, BusEnd { events, transmit }, lines, report, clock, stop);
    tokio::join!(bus, devices);
    Ok(())
}

#[cfg(test)]
mod tests {
    use std::io::Cursor;
    use std::time::Duration;

    use super::*;
    use crate::can::virtual_bus;
    use crate::can::{BusEvent, BusReader, BusWriter};

    fn options() -> SimOptions {
        SimOptions {
            interface: "virtual:cli-sim-test".parse().unwrap(),
            node: NodeId::new(1).unwrap(),
            count: 1,
            scenario: None,
            seed: 1,
        }
    }

    #[tokio::test]
    async fn a_simulated_device_boots_starts_and_takes_orders() {
        let (clock, stop) = (Clock::start(), CancellationToken::new());
        let (mut heard, mut say) = virtual_bus::join("cli-sim-test", clock);
        let input = Cursor::new("node 1 knock 7 on\n");
        let sim = tokio::spawn(run(options(), input, std::io::sink(), clock, stop.clone()));
        let started = async {
            loop {
                let BusEvent::Frame { frame, .. } = heard.recv().await.unwrap() else { continue };
                let text = frame.to_string();
                if text == "701#00" || text == "701#80" {
                    say.send(&"701#R1".parse().unwrap()).await.unwrap();
                } else if text.starts_with("701#") {
                    say.send(&"000#0101".parse().unwrap()).await.unwrap();
                } else if text.starts_with("381#01") {
                    return;
                }
            }
        };
        tokio::time::timeout(Duration::from_secs(60), started).await.unwrap();
        stop.cancel();
        sim.await.unwrap().unwrap();
    }

    #[test]
    fn devices_get_the_node_ids_that_follow() {
        let ids = |node, count| {
            let options = SimOptions { node: NodeId::new(node).unwrap(), count, ..options() };
            plan(&options).map(|plans| plans.iter().map(|plan| plan.node.get()).collect::<Vec<_>>())
        };
        assert_eq!(ids(3, 2).unwrap(), [3, 4]);
        assert_eq!(ids(1, 127).unwrap().len(), 127);
        let error = ids(100, 29).unwrap_err();
        assert_eq!(error.exit(), Exit::Usage);
        assert!(error.to_string().contains("up to 128"), "{error}");
        assert_eq!(ids(127, 255).unwrap_err().exit(), Exit::Usage);
    }

    #[test]
    fn a_scenario_is_a_name_or_a_file() {
        let with = |scenario: &str| plan(&SimOptions { scenario: Some(scenario.to_owned()), ..options() });
        assert_eq!(with("trip").unwrap().len(), 1);
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("story.toml");
        std::fs::write(&path, "description = \"a story\"\n").unwrap();
        assert_eq!(with(path.to_str().unwrap()).unwrap().len(), 1);
        std::fs::write(&path, "descripion = \"a story\"\n").unwrap();
        let error = with(path.to_str().unwrap()).unwrap_err();
        assert_eq!(error.exit(), Exit::Configuration);
        assert!(error.to_string().contains("story.toml:1:1: error"), "{error}");
        let error = with("unheard_of").unwrap_err();
        assert_eq!(error.exit(), Exit::Io);
        assert!(error.to_string().contains("knock_cylinder_7"), "{error}");
    }
}
