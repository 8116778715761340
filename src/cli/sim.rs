//! `cangate sim`: simulated devices on a bus, with orders from the standard input. \[IO\]

use std::fs::File;
use std::io::{self, BufRead, BufReader, IsTerminal, Read, Write};
use std::os::fd::AsFd;
use std::time::Duration;

use nix::poll::{PollFd, PollFlags, PollTimeout, poll};
use nix::unistd::{getpgrp, tcgetpgrp};
use tokio::sync::{mpsc, oneshot};
use tokio_util::sync::CancellationToken;

use super::Exit;
use super::args::{SimArguments, SimDevice};
use super::output::{block_on, print_error, stop_on_signal};
use crate::can::interface::Interface;
use crate::can::task::Sending;
use crate::can::{self, BusIndex};
use crate::simulator::cbm_sio::line::LineKind;
use crate::simulator::serial_end::SerialEnd;
use crate::simulator::serial_place::SerialPlace;
use crate::simulator::task::{self, BusEnd};
use crate::simulator::{DeviceNumber, DevicePlan, Kind, Scenario, Settings, SimulatorError};
use crate::time::Clock;

/// Frames that wait for the bus: what fills it for a second at 1 Mbit/s, so that a machine that stalls for that long loses none.
const TRANSMIT_QUEUE: usize = 8192;
/// Events that wait for the devices.
const EVENT_QUEUE: usize = 1024;
/// Lines that wait; when there are more, reading pauses.
const LINE_QUEUE: usize = 64;
/// Longest line in bytes; what is longer is cut into several, so that a file without line ends takes no memory.
const LONGEST_LINE: u64 = 4096;
/// Reports that wait to be printed; when there are more, they are left out.
const REPORT_QUEUE: usize = 1024;
/// How long the end waits for reports that are still to be printed: a paused terminal does not hold it up.
const LAST_REPORTS: Duration = Duration::from_millis(500);
/// How often a terminal is looked at that belongs to another job now.
const FOREGROUND_PERIOD_MS: u16 = 500;

/// What `cangate sim` is asked for.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct SimOptions {
    /// The device.
    pub kind: Kind,
    /// The bus.
    pub interface: Interface,
    /// Number of the first device.
    pub node: DeviceNumber,
    /// How many devices, at least one; their numbers follow each other.
    pub count: u8,
    /// Outside ends of serial channels.
    pub serial: Vec<SerialPlace>,
    /// A file, or the name of a scenario that comes with the program; `quiet` when `None`.
    pub scenario: Option<String>,
    /// Equal seeds give equal values; each device has its own noise all the same.
    pub seed: u64,
}

/// Why the simulation does not begin.
#[derive(Debug, thiserror::Error)]
pub enum SimError {
    /// The last number would be above the highest of its kind.
    #[error("{count} devices from node {node} on need numbers up to {last}, but {highest} is the highest of a {}", kind.word())]
    Numbers {
        /// The device.
        kind: Kind,
        /// Its highest number.
        highest: u8,
        /// The first.
        node: DeviceNumber,
        /// How many.
        count: u8,
        /// The last.
        last: u16,
    },
    /// An outside end for what has none.
    #[error("--serial {place}: {reason}")]
    Serial {
        /// As the user wrote it.
        place: SerialPlace,
        /// What is wrong, and how to mend it.
        reason: String,
    },
    /// An outside end cannot be opened.
    #[error(
        "--serial {place} cannot be opened: {source}; give a name that no other file has, or an address of this host"
    )]
    OpenSerial {
        /// As the user wrote it.
        place: SerialPlace,
        /// What the system says.
        source: std::io::Error,
    },
    /// A bus inside this process, where nobody else can be.
    #[error(
        "`{interface}` is a bus inside this process: nobody else could ever be on it; simulate on an interface of the host, \
         for example `-i vcan0`, or let `cangate demo` show a gateway and devices in one process"
    )]
    Alone {
        /// As the user wrote it.
        interface: String,
    },
    /// The scenario is neither a name nor a file that can be read.
    #[error("scenario `{scenario}` cannot be read: {source}; give a file, or one of {}", names(*kind))]
    ReadScenario {
        /// The device, which has scenarios of its own.
        kind: Kind,
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
            Self::Numbers { .. } | Self::Serial { .. } | Self::Alone { .. } => Exit::Usage,
            Self::ReadScenario { .. } | Self::OpenSerial { .. } => Exit::Io,
            Self::Scenario(_) => Exit::Configuration,
        }
    }
}

fn names(kind: Kind) -> String {
    kind.shipped().iter().map(|(name, _)| *name).collect::<Vec<_>>().join(", ")
}

/// Runs until a signal, with orders from the standard input.
pub(super) fn command(arguments: &SimArguments) -> Exit {
    let kind = match arguments.device {
        SimDevice::Detcon => Kind::Detcon,
        SimDevice::DstP92c => Kind::DstP92c,
        SimDevice::CbmSio1 => Kind::CbmSio1,
        SimDevice::CbmSio4 => Kind::CbmSio4,
    };
    let options = SimOptions {
        kind,
        interface: arguments.interface.clone(),
        node: arguments.node,
        count: arguments.count,
        serial: arguments.serial.clone(),
        scenario: arguments.scenario.clone(),
        seed: arguments.seed,
    };
    if let Err(error) = check_company(&options.interface) {
        return refuse(&error);
    }
    block_on(async {
        let stop = match stop_on_signal() {
            Ok(stop) => stop,
            Err(exit) => return exit,
        };
        match run(options, orders(), io::stdout(), Clock::start(), stop).await {
            Ok(()) => Exit::Ok,
            Err(error) => refuse(&error),
        }
    })
}

fn refuse(error: &SimError) -> Exit {
    print_error(&error.to_string());
    error.exit()
}

/// A simulator is for somebody else on the bus.
fn check_company(interface: &Interface) -> Result<(), SimError> {
    match interface {
        Interface::Virtual(_) => Err(SimError::Alone { interface: interface.to_string() }),
        Interface::SocketCan(_) | Interface::Slcan { .. } | Interface::SlcanTcp { .. } => Ok(()),
    }
}

/// The standard input, as the orders come in by it.
fn orders() -> Box<dyn BufRead + Send> {
    let input = io::stdin();
    match input.as_fd().try_clone_to_owned() {
        Ok(terminal) if input.is_terminal() => Box::new(BufReader::new(Terminal(File::from(terminal)))),
        Ok(_) | Err(_) => Box::new(BufReader::new(input)),
    }
}

/// A terminal that is read only while this job is in its foreground and something was typed: the system stops a job of the
/// background that reads (`SIGTTIN`), and with it all its devices.
struct Terminal(File);

impl Terminal {
    /// Whether this job is in the foreground; of a terminal without jobs, always.
    fn is_ours(&self) -> bool {
        !tcgetpgrp(&self.0).is_ok_and(|foreground| foreground != getpgrp())
    }
}

impl Read for Terminal {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        loop {
            if !self.is_ours() {
                std::thread::sleep(Duration::from_millis(u64::from(FOREGROUND_PERIOD_MS)));
                continue;
            }
            let mut waiting = [PollFd::new(self.0.as_fd(), PollFlags::POLLIN)];
            if poll(&mut waiting, PollTimeout::from(FOREGROUND_PERIOD_MS))? > 0 && self.is_ours() {
                return self.0.read(buffer);
            }
        }
    }
}

/// The devices that are asked for. Reads the scenario's file.
pub fn plan(options: &SimOptions) -> Result<Vec<DevicePlan>, SimError> {
    let mut scenario = scenario(options.kind, options.scenario.as_deref().unwrap_or("quiet"))?;
    for (at, place) in options.serial.iter().enumerate() {
        let wrong = |reason: String| Err(SimError::Serial { place: place.clone(), reason });
        let Settings::CbmSio(settings) = &mut scenario.settings else {
            return wrong(format!("a {} has no serial channels", options.kind.word()));
        };
        let channels = settings.model.channels();
        if place.channel > channels {
            return wrong(format!("a {} has no channel beyond {channels}", options.kind.word()));
        }
        if options.serial.iter().take(at).any(|other| other.channel == place.channel) {
            return wrong("the channel has an end already; give each one once".to_owned());
        }
        if options.count > 1 {
            return wrong("which of the devices is meant? start one at a time (--count 1)".to_owned());
        }
        if let Some(line) = settings.lines.get_mut(usize::from(place.channel) - 1) {
            *line = LineKind::External;
        }
    }
    let (kind, count, highest) = (options.kind, options.count.max(1), options.kind.highest_number());
    (0..count)
        .map(|place| {
            let number = options.node.get().checked_add(place).filter(|number| *number <= highest);
            let last = u16::from(options.node.get()) + u16::from(count) - 1;
            let node = number.and_then(DeviceNumber::new);
            let node = node.ok_or(SimError::Numbers { kind, highest, node: options.node, count, last })?;
            let seed = options.seed.wrapping_add(u64::from(node.get()));
            Ok(DevicePlan { seed, ..DevicePlan::new(node, scenario.clone()) })
        })
        .collect()
}

fn scenario(kind: Kind, name: &str) -> Result<Scenario, SimError> {
    if let Some(shipped) = Scenario::shipped(kind, name) {
        return Ok(shipped);
    }
    let text = std::fs::read_to_string(name).map_err(|source| SimError::ReadScenario {
        kind,
        scenario: name.to_owned(),
        source,
    })?;
    Ok(Scenario::parse(kind, name, &text)?)
}

/// Runs until `stop`. Orders come from `input`, line by line; what happens is told to `report`.
///
/// `input` and `report` have a thread of their own each; both end with their streams, or with the process.
pub async fn run(
    options: SimOptions,
    input: impl BufRead + Send + 'static,
    report: impl Write + Send + 'static,
    clock: Clock,
    stop: CancellationToken,
) -> Result<(), SimError> {
    let plans = plan(&options)?;
    let mut ends = Vec::new();
    for place in &options.serial {
        let end = SerialEnd::open(place).await;
        ends.push(end.map_err(|source| SimError::OpenSerial { place: place.clone(), source })?);
    }
    let (events_to_us, events) = mpsc::channel(EVENT_QUEUE);
    let (transmit, to_send) = mpsc::channel(TRANSMIT_QUEUE);
    let (lines_to_us, lines) = mpsc::channel(LINE_QUEUE);
    let (reports, to_print) = mpsc::channel(REPORT_QUEUE);
    let (printed_to_us, printed) = oneshot::channel();
    std::thread::spawn(move || read_lines(input, &lines_to_us));
    std::thread::spawn(move || {
        print_reports(report, to_print);
        // Nobody waits any more when the simulation was given up.
        let _ = printed_to_us.send(());
    });
    let bus = can::task::run(
        BusIndex(0),
        options.interface,
        Sending::Untold,
        events_to_us,
        to_send,
        clock,
        stop.clone(),
    );
    let devices = task::run_with_ends(plans, ends, BusEnd { events, transmit }, lines, reports, clock, stop);
    tokio::join!(bus, devices);
    // What is not printed by now is not worth waiting for.
    let _ = tokio::time::timeout(LAST_REPORTS, printed).await;
    Ok(())
}

/// Until the end of the input, or of the simulation. What is not UTF-8 becomes a line that nobody understands.
fn read_lines(mut input: impl BufRead, lines: &mpsc::Sender<String>) {
    let mut line = Vec::new();
    loop {
        line.clear();
        match input.by_ref().take(LONGEST_LINE).read_until(b'\n', &mut line) {
            Ok(0) | Err(_) => return,
            Ok(_) => {}
        }
        if lines.blocking_send(String::from_utf8_lossy(&line).trim().to_owned()).is_err() {
            return;
        }
    }
}

/// Until the simulation ends. Reports that cannot be written are no reason to stop.
fn print_reports(mut to: impl Write, mut reports: mpsc::Receiver<String>) {
    while let Some(text) = reports.blocking_recv() {
        let _ = writeln!(to, "{text}").and_then(|()| to.flush());
    }
}

#[cfg(test)]
mod tests {
    use std::io::Cursor;

    use clap::ValueEnum;

    use super::*;
    use crate::can::virtual_bus;
    use crate::can::{BusEvent, BusReader, BusWriter};

    fn options() -> SimOptions {
        SimOptions {
            kind: Kind::Detcon,
            interface: "virtual:cli-sim-test".parse().unwrap(),
            node: DeviceNumber::new(1).unwrap(),
            count: 1,
            serial: Vec::new(),
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
            let options = SimOptions { node: DeviceNumber::new(node).unwrap(), count, ..options() };
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
    fn an_esd_module_has_the_numbers_of_its_switches() {
        let last = |kind, node| {
            plan(&SimOptions { kind, node: DeviceNumber::new(node).unwrap(), ..options() }).map(|_| ())
        };
        assert!(last(Kind::CbmSio4, 0xCB).is_ok() && last(Kind::CbmSio1, 0xCC).is_ok());
        assert!(
            last(Kind::CbmSio4, 0xCC).unwrap_err().to_string().contains("203 is the highest of a cbm-sio4")
        );
        assert!(last(Kind::Detcon, 128).is_err());
    }

    #[test]
    fn an_outside_end_is_for_a_channel_that_there_is() {
        let with = |kind, count, places: &[&str]| {
            let serial = places.iter().map(|place| place.parse().unwrap()).collect();
            plan(&SimOptions { kind, count, serial, ..options() })
        };
        let plans = with(Kind::CbmSio4, 1, &["2=tcp:127.0.0.1:0"]).unwrap();
        let Settings::CbmSio(settings) = &plans[0].scenario.settings else { panic!() };
        assert_eq!(settings.lines[..2], [LineKind::Echo, LineKind::External]);
        for (kind, count, places, reason) in [
            (Kind::Detcon, 1, &["1=pty:/tmp/x"][..], "no serial channels"),
            (Kind::CbmSio1, 1, &["2=pty:/tmp/x"], "no channel beyond 1"),
            (Kind::CbmSio4, 1, &["2=pty:/tmp/x", "2=pty:/tmp/y"], "already"),
            (Kind::CbmSio4, 2, &["2=pty:/tmp/x"], "--count 1"),
        ] {
            let error = with(kind, count, places).unwrap_err();
            assert_eq!(error.exit(), Exit::Usage);
            assert!(error.to_string().contains(reason), "{error}");
        }
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

    #[test]
    fn the_devices_of_the_command_line_are_those_of_the_simulator() {
        let typed: Vec<_> =
            SimDevice::value_variants().iter().filter_map(SimDevice::to_possible_value).collect();
        let typed: Vec<_> = typed.iter().map(clap::builder::PossibleValue::get_name).collect();
        assert_eq!(typed, Kind::ALL.map(Kind::word));
        for kind in Kind::ALL {
            assert_eq!(plan(&SimOptions { kind, ..options() }).unwrap()[0].scenario.settings.kind(), kind);
        }
    }

    #[test]
    fn a_bus_inside_the_process_is_refused_with_the_way_out() {
        let error = check_company(&options().interface).unwrap_err();
        assert_eq!(error.exit(), Exit::Usage);
        assert!(
            error.to_string().contains("-i vcan0") && error.to_string().contains("cangate demo"),
            "{error}"
        );
        assert!(check_company(&"vcan0".parse().unwrap()).is_ok());
        let arguments = SimArguments {
            device: SimDevice::Detcon,
            interface: options().interface,
            node: DeviceNumber::new(1).unwrap(),
            count: 1,
            serial: Vec::new(),
            scenario: None,
            seed: 1,
        };
        assert_eq!(command(&arguments), Exit::Usage);
    }

    #[test]
    fn a_byte_that_is_not_utf_8_does_not_end_the_orders() {
        let (lines, mut read) = mpsc::channel(64);
        let long = "x".repeat(10_000);
        let text = [b"power off\nkn\xFFck\r\n", long.as_bytes(), b"\npower on"].concat();
        read_lines(Cursor::new(text), &lines);
        let read: Vec<String> = std::iter::from_fn(|| read.try_recv().ok()).collect();
        assert_eq!((read[0].as_str(), read[1].as_str()), ("power off", "kn\u{FFFD}ck"));
        assert!(read[2..].iter().all(|line| line.len() <= 4096));
        assert_eq!(read.last().unwrap(), "power on");
    }

    /// A report that is never read: as a terminal that is paused with Ctrl-S.
    struct Paused;

    impl Write for Paused {
        fn write(&mut self, _: &[u8]) -> std::io::Result<usize> {
            loop {
                std::thread::park();
            }
        }

        fn flush(&mut self) -> std::io::Result<()> {
            Ok(())
        }
    }

    #[tokio::test]
    async fn a_report_that_is_never_read_stops_neither_the_devices_nor_the_end() {
        let (clock, stop) = (Clock::start(), CancellationToken::new());
        let (mut heard, mut say) = virtual_bus::join("cli-sim-paused", clock);
        let options = SimOptions { interface: "virtual:cli-sim-paused".parse().unwrap(), ..options() };
        let sim = tokio::spawn(run(options, Cursor::new(""), Paused, clock, stop.clone()));
        let answered = async {
            loop {
                let BusEvent::Frame { frame, .. } = heard.recv().await.unwrap() else { continue };
                if frame.to_string() == "701#00" {
                    say.send(&"701#R1".parse().unwrap()).await.unwrap();
                } else {
                    return;
                }
            }
        };
        tokio::time::timeout(Duration::from_secs(60), answered).await.unwrap();
        stop.cancel();
        tokio::time::timeout(Duration::from_secs(60), sim).await.unwrap().unwrap().unwrap();
    }
}
