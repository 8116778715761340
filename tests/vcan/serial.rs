//! Serial lines of a CAN-CBM-SIO4 from end to end: what is written into a TCP port comes out of a serial line, and the other
//! way round; by way of a pty and socat, and of MQTT; and what becomes of it when the module or the bus fails.
//!
//! The amount of data is small here, as a line of 38,400 bit/s needs 273 s for a megabyte.
//! `CANGATE_TEST_SERIAL_BYTES=1000000` makes it one.

use std::fmt::Write as _;
use std::io::{ErrorKind, Read, Write};
use std::net::{Shutdown, TcpStream};
use std::os::unix::fs::FileTypeExt;
use std::process::{Command, Stdio};
use std::thread;
use std::time::{Duration, Instant};

use nix::sys::signal::Signal;
use tempfile::TempDir;

use crate::harness::broker::{Broker, Subscriber};
use crate::harness::bus::{Capture, cansend, ip, take_the_bus};
use crate::harness::gateway::{Gateway, Setup, simulate, simulator};
use crate::harness::modbus::{Table, mbpoll};
use crate::harness::process::{Process, free_port};
use crate::harness::wait::{give_it, wait_for, wait_until};

/// Module number and coding switch; its identifiers are free beside any CANopen node.
const MODULE: u8 = 0x1A;
const CHANNELS: u8 = 5;
/// What a `DetCon` of node 1 sends.
const DETCON_IDS: [u16; 7] = [0x081, 0x181, 0x281, 0x381, 0x481, 0x581, 0x701];
/// Bytes each way on each line, unless the environment says otherwise.
const BYTES: usize = 24_576;

/// A gateway with a `DetCon` of node 1 and a module whose lines are TCP ports.
struct Plant {
    gateway: Gateway,
    module: Process,
    detcon: Process,
    capture: Capture,
    /// Frames of the `DetCon` that the gateway had counted at the begin, and frames on the bus a moment later.
    begin: (u32, usize),
    folder: TempDir,
    /// Ports of the gateway, by channel.
    ports: Vec<u16>,
    /// Ports of the ends of the lines, by channel; none where the end is something else.
    ends: Vec<Option<u16>>,
}

impl Plant {
    /// `ends`: what is behind a line, instead of a TCP port. `keys`: lines for the module's node.
    fn start(ends: &[(u8, &str)], (keys, packing): (&str, &str), setup: impl FnOnce(Setup) -> Setup) -> Self {
        let folder = TempDir::new().unwrap();
        let scenario = folder.path().join("lines.toml");
        let text =
            "description = \"Lines that the test holds.\"\n[device]\nfirst_tx_delay_ms = 0\nbus_kbit = 0\n";
        std::fs::write(&scenario, text).unwrap();
        let mut arguments = vec!["--scenario".to_owned(), scenario.to_str().unwrap().to_owned()];
        let mut end_ports = Vec::new();
        for channel in 1..=CHANNELS {
            let other = ends.iter().find(|(number, _)| *number == channel).map(|(_, end)| *end);
            let port = free_port();
            let end = other.map_or_else(|| format!("tcp:127.0.0.1:{port}"), str::to_owned);
            end_ports.push(other.is_none().then_some(port));
            arguments.extend(["--serial".to_owned(), format!("{channel}={end}")]);
        }
        let detcon = simulator(1, &[]);
        let arguments: Vec<&str> = arguments.iter().map(String::as_str).collect();
        let module = simulate("cbm-sio4", MODULE, &arguments);
        let ports: Vec<u16> = (0..CHANNELS).map(|_| free_port()).collect();
        // Long enough for a machine that stalls: what counts is that nothing is lost.
        let detcon_keys = "guard_time_ms = 2000\nguard_reply_ms = 2000\npdo_timeout_ms = 5000";
        let both = Setup::one_detcon().node_key(detcon_keys).bus_key("bit_rate = 1000000");
        let gateway = setup(both.more(&config(&ports, keys, packing))).start();
        let (capture, begin) = (Capture::start_of(&DETCON_IDS), (0, 0));
        let mut plant = Self { gateway, module, detcon, capture, begin, folder, ports, ends: end_ports };
        plant.gateway.node(MODULE).wait_for_status("a configured module", |status| {
            status.online() && status.operational() && status.supervision_ok() && status.all_good()
        });
        // In this order: what is counted in between hides a frame that is lost, and invents none.
        plant.begin = (plant.detcon_counted(), plant.capture.mark());
        plant
    }

    /// Frames of the `DetCon` that the gateway has received.
    fn detcon_counted(&self) -> u32 {
        let words = mbpoll(self.gateway.modbus, 1, Table::Input, 20, 2).unwrap();
        u32::from(words[0]) << 16 | u32::from(words[1])
    }

    /// Every frame of the `DetCon` on the bus since the begin was received by the gateway.
    fn assert_that_all_frames_of_the_detcon_were_received(&self) {
        // What is not a request of the gateway.
        let is_its = |frame: &&String| !frame.contains('R');
        let (counted, from) = self.begin;
        let until = self.capture.mark();
        let sent = self.capture.frames()[from..until].iter().filter(is_its).count();
        assert!(sent > 0, "it sends nothing");
        wait_until(format!("{sent} frames of the DetCon"), || {
            usize::try_from(self.detcon_counted() - counted).unwrap() >= sent
        });
    }

    fn tcp(&self, channel: u8) -> TcpStream {
        connect(self.ports[usize::from(channel) - 1])
    }

    /// The module is there for it: what came out of a line before would be lost.
    fn end(&self, channel: u8) -> TcpStream {
        let stream = connect(self.ends[usize::from(channel) - 1].unwrap());
        let said = format!("channel {channel}: {} is connected", stream.local_addr().unwrap());
        wait_until(&said, || self.module.stdout(0).iter().any(|line| line.text.ends_with(&said)));
        stream
    }

    /// A counter of a channel, two registers at this offset.
    fn counter(&self, channel: u8, offset: u16) -> u32 {
        let address = 100 + 100 * u16::from(channel) + offset;
        let words = mbpoll(self.gateway.modbus, MODULE, Table::Input, address, 2).unwrap();
        u32::from(words[0]) << 16 | u32::from(words[1])
    }

    fn order(&mut self, line: &str) {
        self.module.say(line);
        wait_until(format!("the order `{line}`"), || {
            self.module.stdout(0).iter().any(|report| report.text.ends_with(&format!("ok: {line}")))
        });
    }

    /// Bytes that the simulated module had no room for.
    fn overflowed(&self) -> bool {
        self.module.stdout(0).iter().any(|line| line.text.contains("overflow"))
    }

    fn detcon_is_good(&self) -> bool {
        let status = self.gateway.node(1).status();
        status.online() && status.operational() && status.supervision_ok() && status.all_good()
    }

    /// It lost nothing since the gateway started: no restart, no guard request without an answer, no wrong toggle bit, no
    /// TPDO of a wrong length or in a wrong state; none came late, and every frame that was on the bus was received.
    fn assert_that_the_detcon_lost_nothing(&self) {
        assert!(self.detcon_is_good());
        let counters = mbpoll(self.gateway.modbus, 1, Table::Input, 12, 8).unwrap();
        assert_eq!([&counters[..4], &counters[7..]].concat(), [0; 5], "{counters:?}");
        let late = self.gateway.get("/api/v1/events");
        assert!(!late.contains("pdo_timeout"), "{late}");
        self.assert_that_all_frames_of_the_detcon_were_received();
    }

    fn wait_for_module(&self, what: &str) {
        self.gateway.node(MODULE).wait_for_status(what, |status| status.operational() && status.all_good());
    }
}

const BYTES_RECEIVED: u16 = 0;
const BYTES_SENT: u16 = 6;
const BYTES_NOT_SENT: u16 = 10;
const BYTES_WAITING: u16 = 12;

/// What comes in on a line goes out at once, as long as it is not more than 50 frames/s.
const SOON: &str = "max_char = 8\nmin_char = 1\ninhibit_ms = 20";
/// Full frames only, as fast as they fill.
const FULL: &str = "max_char = 8\nmin_char = 8\ninhibit_ms = 0";

fn config(ports: &[u16], keys: &str, packing: &str) -> String {
    let mut text = format!(
        "[bus.can0.esd]\nreply_id = 0x6E0\nreply_timeout_ms = 1000\n[node.lines]\nbus = \"can0\"\nid = {MODULE}\n\
         mapping = \"esd-can-cbm-sio4\"\nstatus_period_ms = 500\n{keys}\n"
    );
    for (place, port) in ports.iter().enumerate() {
        write!(
            text,
            "[node.lines.channel.{}]\nbaud = 38400\nstop_bits = 1\n{packing}\n\
             listen = \"127.0.0.1:{port}\"\nmqtt_write = true\ndelimiter = \"\\n\"\n",
            place + 1
        )
        .unwrap();
    }
    text
}

fn connect(port: u16) -> TcpStream {
    let stream = wait_for(format!("port {port}"), || TcpStream::connect(("127.0.0.1", port)).ok());
    stream.set_nodelay(true).unwrap();
    stream
}

/// Bytes that do not repeat; the same seed gives the same.
fn random(seed: u64, len: usize) -> Vec<u8> {
    let mut state = seed.wrapping_mul(0x9E37_79B9_7F4A_7C15) | 1;
    let mut next = || {
        state ^= state << 13;
        state ^= state >> 7;
        state ^= state << 17;
        state.to_le_bytes()
    };
    std::iter::repeat_with(&mut next).flatten().take(len).collect()
}

/// Reads so many bytes, or what came until nothing did for long.
fn read_exactly(stream: &mut TcpStream, len: usize) -> Vec<u8> {
    stream.set_read_timeout(Some(Duration::from_secs(30))).unwrap();
    let (mut bytes, mut part) = (Vec::new(), [0; 4096]);
    while bytes.len() < len {
        match stream.read(&mut part) {
            Ok(0) => break,
            Ok(count) => bytes.extend_from_slice(&part[..count]),
            Err(error) if error.kind() == ErrorKind::Interrupted => {}
            Err(_) => break,
        }
    }
    bytes
}

fn assert_same(what: &str, sent: &[u8], got: &[u8]) {
    let wrong = sent.iter().zip(got).position(|(sent, got)| sent != got);
    assert!(sent == got, "{what}: {} of {} bytes, first wrong at {wrong:?}", got.len(), sent.len());
}

#[test]
fn r_esd_032_034_037_random_data_each_way_on_five_lines_at_once_arrives_whole_and_overflows_nothing() {
    let _bus = take_the_bus();
    let plant = Plant::start(&[], ("", FULL), |setup| setup);
    let len = std::env::var("CANGATE_TEST_SERIAL_BYTES").map_or(BYTES, |text| text.parse().unwrap());
    let begin = Instant::now();
    thread::scope(|scope| {
        for channel in 1..=CHANNELS {
            let (mut tcp, mut end) = (plant.tcp(channel), plant.end(channel));
            let (mut tcp_reader, mut end_reader) = (tcp.try_clone().unwrap(), end.try_clone().unwrap());
            let (out, back) = (random(channel.into(), len), random(u64::from(channel) + 100, len));
            let (to_line, to_plant) = (out.clone(), back.clone());
            scope.spawn(move || tcp.write_all(&to_line).unwrap());
            scope.spawn(move || end.write_all(&to_plant).unwrap());
            scope.spawn(move || {
                assert_same("to the line", &out, &read_exactly(&mut end_reader, len));
            });
            scope.spawn(move || {
                assert_same("from the line", &back, &read_exactly(&mut tcp_reader, len));
            });
        }
    });
    let took = begin.elapsed();
    println!("{len} bytes each way on {CHANNELS} lines of 38,400 bit/s in {took:.1?}");
    assert!(!plant.overflowed(), "the module had no room for what came");
    // A guest that this load keeps busy all the time may be late with a guard reply; the other tests count them.
    wait_until("the other device", || plant.detcon_is_good());
    plant.assert_that_all_frames_of_the_detcon_were_received();
    for channel in 1..=CHANNELS {
        let len = u32::try_from(len).unwrap();
        assert_eq!(plant.counter(channel, BYTES_RECEIVED), len);
        assert_eq!(plant.counter(channel, BYTES_SENT), len);
        assert_eq!(plant.counter(channel, BYTES_NOT_SENT), 0);
    }
}

#[test]
fn r_esd_034_039_an_echo_behind_a_pty_answers_socat_through_tcp_and_mosquitto_line_by_line() {
    let _bus = take_the_bus();
    let broker = Broker::start();
    let ends = TempDir::new().unwrap();
    let tty = ends.path().join("line3");
    let pty = format!("pty:{}", tty.display());
    let plant = Plant::start(&[(3, &pty)], ("", SOON), |setup| setup.broker(&broker));
    wait_until("the pty", || std::fs::metadata(&tty).is_ok_and(|found| found.file_type().is_char_device()));
    // The device on the line: whatever it is sent, it sends back.
    let echo = Process::start(
        "socat",
        Command::new("socat").arg(format!("{},raw,echo=0", tty.display())).arg("EXEC:cat"),
    );
    let port = plant.ports[2];
    // An answer that comes after its client had gone is sent to the next one: each asks something else.
    let mut tries = 0;
    wait_until("an answer through socat", || {
        tries += 1;
        let asked = format!("is anybody there? {tries}\n");
        let mut client = Command::new("socat")
            .args(["-t", "3", "-", &format!("TCP:127.0.0.1:{port}")])
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .unwrap();
        client.stdin.take().unwrap().write_all(asked.as_bytes()).unwrap();
        let answered = client.wait_with_output().unwrap().stdout;
        answered.ends_with(asked.as_bytes())
    });

    let subscriber = Subscriber::start(&broker, "cangate/hall-1/");
    let from = subscriber.count();
    for line in ["first", "second", "third"] {
        broker.publish("cangate/hall-1/lines/serial/3/tx", &format!("{line}\n"));
        let message = subscriber.wait_for("lines/serial/3/rx", from, |payload| payload["data"] == line);
        assert_eq!(message.payload["end"], "delimiter", "{message:?}");
    }
    drop(echo);
}

/// Writes into a port until it is full or closed; how much it took.
fn pour(port: u16, len: usize) -> thread::JoinHandle<usize> {
    let mut stream = connect(port);
    thread::spawn(move || {
        let bytes = random(7, len);
        let mut written = 0;
        while written < len {
            match stream.write(&bytes[written..(written + 512).min(len)]) {
                Ok(0) | Err(_) => break,
                Ok(count) => written += count,
            }
        }
        let _ = stream.shutdown(Shutdown::Write);
        // The gateway closes it when it could not send all.
        let _ = stream.read(&mut [0; 1]);
        written
    })
}

#[test]
fn r_esd_076_a_module_that_resets_during_a_transfer_is_told_configured_again_and_its_bytes_are_accounted_for()
{
    let _bus = take_the_bus();
    let broker = Broker::start();
    let mut plant = Plant::start(&[], ("", SOON), |setup| setup.broker(&broker));
    let subscriber = Subscriber::start(&broker, "cangate/hall-1/");
    let from = subscriber.count();
    let mut end = plant.end(1);
    let reading = thread::spawn(move || read_exactly(&mut end, usize::MAX));
    let pouring = pour(plant.ports[0], 200_000);
    wait_until("bytes on their way", || plant.counter(1, BYTES_SENT) > 1_000);
    plant.order("reset");
    let restarted = subscriber.wait_for_event("node_restarted", from);
    assert_eq!(restarted.payload["node"], "lines");
    plant.wait_for_module("the module after its reset");
    let poured = pouring.join().unwrap();
    let (sent, not_sent) = (plant.counter(1, BYTES_SENT), plant.counter(1, BYTES_NOT_SENT));
    assert!(not_sent > 0, "{poured} poured, {sent} sent");
    assert!(
        usize::try_from(sent + not_sent).unwrap() <= poured,
        "{poured} poured, {sent} sent, {not_sent} not"
    );
    plant.assert_that_the_detcon_lost_nothing();
    // The line works again, from its first byte on.
    let mut tcp = plant.tcp(1);
    let before = plant.counter(1, BYTES_SENT);
    tcp.write_all(b"again").unwrap();
    wait_until("the next bytes", || plant.counter(1, BYTES_SENT) == before + 5);
    // What came out of the line is what went in, from its first byte on, without what the module had when it was reset.
    thread::sleep(Duration::from_secs(1));
    plant.module.terminate();
    let got = reading.join().unwrap();
    let before = got.strip_suffix(b"again").unwrap_or_else(|| panic!("{} bytes, and not again", got.len()));
    assert!(
        before.len() > 500 && before.len() <= usize::try_from(sent).unwrap(),
        "{} of {sent}",
        before.len()
    );
    let poured = random(7, 200_000);
    let whole = poured.iter().zip(before).take_while(|(sent, got)| sent == got).count();
    let rest = &before[whole..];
    // What came after the reset and before anybody knew of it went out too, in its order, as far as a module takes it that has
    // forgotten the rate of its line.
    let mut handed_over = poured[whole..usize::try_from(sent).unwrap()].iter();
    let in_order = rest.iter().all(|byte| handed_over.any(|sent| sent == byte));
    assert!(whole > 500 && in_order, "{whole} of {} bytes are in order", before.len());
}

#[test]
fn r_esd_041_a_suspended_module_is_told_of_and_what_waits_goes_out_when_it_continues() {
    let _bus = take_the_bus();
    let broker = Broker::start();
    let plant = Plant::start(&[], ("", SOON), |setup| setup.broker(&broker));
    let subscriber = Subscriber::start(&broker, "cangate/hall-1/");
    let from = subscriber.count();
    cansend(&format!("700#FF0400{MODULE:02X}5A5A"));
    subscriber.wait_for_event("module_suspended", from);
    plant
        .gateway
        .node(MODULE)
        .wait_for_status("a suspended module", |status| status.online() && !status.operational());
    let (mut tcp, mut end) = (plant.tcp(2), plant.end(2));
    tcp.write_all(b"kept").unwrap();
    wait_until("four bytes that wait", || plant.counter(2, BYTES_WAITING) == 4);
    give_it(Duration::from_millis(500));
    assert_eq!(plant.counter(2, BYTES_SENT), 0);
    cansend(&format!("700#FF0400{MODULE:02X}A5A5"));
    assert_eq!(read_exactly(&mut end, 4), b"kept");
    subscriber.wait_for_event("module_continued", from);
    plant.wait_for_module("the module after it was continued");
    plant.assert_that_the_detcon_lost_nothing();
}

#[test]
fn r_esd_083_087_088_a_watchdog_that_expires_is_told_and_one_of_a_gateway_that_stops_in_order_is_switched_off()
 {
    let _bus = take_the_bus();
    let broker = Broker::start();
    // Longer than this machine may stand still: then the module would start anew unasked.
    let keys = "watchdog_id = 0x6E1\nwatchdog_ms = 1000\nwatchdog_factor = 5";
    let mut plant = Plant::start(&[], (keys, SOON), |setup| setup.broker(&broker));
    let capture = Capture::start();
    wait_until("requests and replies of the watchdog", || {
        let frames = capture.frames();
        ["6E1#R1", "6E1#7D", "6E1#FD"].iter().all(|frame| frames.iter().any(|seen| seen == frame))
    });
    let subscriber = Subscriber::start(&broker, "cangate/hall-1/");
    let from = subscriber.count();
    // A gateway that hangs: the module resets itself, and is configured again when the gateway is back.
    let before = plant.module.stdout(0).len();
    plant.gateway.process.signal(Signal::SIGSTOP);
    wait_until("the watchdog expires", || {
        plant.module.stdout(before).iter().any(|line| line.text.contains("new on bus"))
    });
    plant.gateway.process.signal(Signal::SIGCONT);
    subscriber.wait_for_event("node_restarted", from);
    plant.wait_for_module("the module after its watchdog");
    // One that is told to stop says so first: then the module does not reset itself.
    let mark = capture.mark();
    plant.gateway.process.terminate();
    capture.wait_for(&format!("700#810500{MODULE:02X}0000"), mark);
    thread::sleep(Duration::from_secs(7));
    cansend(&format!("700#010200{MODULE:02X}06DF"));
    let place = capture.wait_for("6DF#", mark);
    let status = capture.frames()[place].clone();
    let status = u8::from_str_radix(&status[8..10], 16).unwrap();
    assert_eq!(status & 0x80, 0, "it did not start anew: {status:02X}");
}

#[test]
fn a_bus_that_goes_down_during_a_transfer_is_told_and_everything_is_back_by_itself() {
    let _bus = take_the_bus();
    let broker = Broker::start();
    let plant = Plant::start(&[], ("", SOON), |setup| setup.broker(&broker));
    let subscriber = Subscriber::start(&broker, "cangate/hall-1/");
    let from = subscriber.count();
    let pouring = pour(plant.ports[0], 100_000);
    wait_until("bytes on their way", || plant.counter(1, BYTES_SENT) > 1_000);
    ip(&["link", "set", "vcan0", "down"]);
    plant.gateway.node(MODULE).wait_for_status("no module", |status| !status.online());
    subscriber.wait_for_event("interface_down", from);
    let poured = pouring.join().unwrap();
    let (sent, not_sent) = (plant.counter(1, BYTES_SENT), plant.counter(1, BYTES_NOT_SENT));
    assert!(
        not_sent > 0 && usize::try_from(sent + not_sent).unwrap() <= poured,
        "{poured}, {sent}, {not_sent}"
    );
    ip(&["link", "set", "vcan0", "up"]);
    plant.wait_for_module("the module after the bus");
    wait_until("the other device", || plant.detcon_is_good());
    let mut tcp = plant.tcp(1);
    let before = plant.counter(1, BYTES_SENT);
    tcp.write_all(b"again").unwrap();
    wait_until("the next bytes", || plant.counter(1, BYTES_SENT) == before + 5);
}
