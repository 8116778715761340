//! python-canopen on the same bus: as a device that is known by its EDS alone, as the judge of our SDO client and of our
//! SDO server, and as a second client of a device that the gateway reads.

use std::collections::{BTreeMap, BTreeSet};
use std::process::Command;
use std::time::Duration;

use cangate::can::{CanFrame, CanId};
use cangate::canopen::NodeId;
use cangate::canopen::object::ObjectId;
use cangate::canopen::sdo::{self, SdoClient, SdoError, SdoOutput, SdoRequest, SdoSettings, TransferId};
use cangate::simulator::random::Random;
use cangate::simulator::sdo_server::{Abort, Dictionary, SdoServer};
use cangate::time::Instant;
use serde_json::Value;
use socketcan::{
    CanDataFrame, CanFilter, CanSocket, EmbeddedFrame, Frame, Socket, SocketOptions, StandardId,
};
use tempfile::TempDir;

use crate::commissioning::cangate;
use crate::harness::broker::{Broker, Subscriber};
use crate::harness::bus::{BUS, Capture, take_the_bus};
use crate::harness::gateway::{Setup, TOPICS, simulate};
use crate::harness::modbus::{Table, mbpoll};
use crate::harness::process::Process;
use crate::harness::wait::{wait_until, within};
use crate::transmitter::is_write_to;

/// Names how many random sizes are written and read back in each of two tests; 200 unless told. 10000 take half an hour.
const TRANSFERS: &str = "CANGATE_SDO_TRANSFERS";

fn transfers() -> usize {
    std::env::var(TRANSFERS)
        .map_or(200, |count| count.parse().unwrap_or_else(|_| panic!("{TRANSFERS}={count}")))
}

/// A script of `tests/vcan/peers`, run by a python that has canopen.
fn peer(script: &str, arguments: &[&str]) -> Process {
    let python = std::env::var("CANGATE_TEST_PYTHON")
        .expect("CANGATE_TEST_PYTHON names a python with canopen; `tests/all vcan` sets it");
    let file = format!("{}/tests/vcan/peers/{script}", env!("CARGO_MANIFEST_DIR"));
    Process::start(script, Command::new(python).args(["-u", &file]).args(arguments))
}

/// One that says `ready`.
fn ready_peer(script: &str, arguments: &[&str]) -> Process {
    let mut process = peer(script, arguments);
    wait_until(script, || {
        assert!(process.runs(), "{script} ended: {:?}", process.stderr());
        process.stdout_count() > 0
    });
    process
}

/// What a client of python-canopen says at its end.
fn verdict(mut client: Process, limit: Duration) -> Value {
    let done = within(limit, || (!client.runs()).then_some(()));
    assert!(done.is_some(), "python-canopen took longer than {limit:?}");
    let said = within(Duration::from_secs(5), || client.stdout(0).into_iter().next());
    let line = said.unwrap_or_else(|| panic!("python-canopen failed: {:#?}", client.stderr()));
    serde_json::from_str(&line.text).unwrap()
}

#[test]
fn a_device_of_python_canopen_works_with_what_import_makes_of_its_eds_and_nothing_else() {
    let _bus = take_the_bus();
    let folder = TempDir::new().unwrap();
    let path = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
    let (eds, mapping) = (path("tank.eds"), path("tank.toml"));
    let capture = Capture::start();
    let mut device = ready_peer("eds_device.py", &[BUS, "7", &eds]);
    capture.wait_for("707#00", 0);

    let (code, _, stderr) = cangate(&["import", &eds, "-o", &mapping]);
    assert_eq!(code, 0, "{stderr}");
    println!("import: {}", stderr.lines().last().unwrap_or_default());
    let mapping = std::fs::read_to_string(&mapping).unwrap();
    let broker = Broker::start();
    let subscriber = Subscriber::start(&broker, TOPICS);
    let setup = Setup::detcons(&[]).broker(&broker).mapping("tank", &mapping).node("tank", 7, "tank");
    let gateway = setup.start();
    gateway.node(7).wait_for_status("a good device", |status| {
        status.online() && status.operational() && status.supervision_ok() && status.all_good()
    });

    for (line, register, value) in
        [("6000 1 5", 100, 5), ("6401 1 1234", 101, 1234), ("6401 2 -1234", 102, 0xFB2E)]
    {
        device.say(line);
        wait_until(format!("{line} on Modbus"), || {
            mbpoll(gateway.modbus, 7, Table::Input, register, 1) == Ok(vec![value])
        });
    }
    // What no TPDO carries was asked for by SDO: 123456 h, 61.25 as a float.
    assert_eq!(gateway.node(7).u32(104), 123_456);
    assert_eq!(gateway.node(7).u32(106), 61.25_f32.to_bits());
    subscriber.wait_for("tank/state", 0, |payload| {
        payload["tags"]["analogue_input_level"] == 1234 && payload["tags"]["oil_temperature"] == 61.25
    });
    // Its heartbeat was off; nothing else was written, and it was started by its own id.
    let sent: Vec<String> = capture.frames().into_iter().filter(|frame| is_write_to(frame, "607#")).collect();
    assert_eq!(sent, ["607#2B171000E8030000"]);
    capture.wait_for("000#0107", 0);
    device.kill();
    subscriber.wait_for_event("node_lost", 0);
}

/// Our SDO client on vcan0: what `cangate sdo` and the gateway are made of, without a process for each transfer.
struct OurClient {
    socket: CanSocket,
    client: SdoClient,
    begin: std::time::Instant,
}

impl OurClient {
    fn new(node: u8, block: bool) -> Self {
        let id = NodeId::new(node).unwrap();
        let socket = CanSocket::open(BUS).unwrap();
        socket.set_filters(&[CanFilter::new(sdo::answer_id(id).raw(), 0xC000_07FF)]).unwrap();
        socket.set_read_timeout(Duration::from_millis(20)).unwrap();
        let settings = SdoSettings { block, timeout: Duration::from_secs(5), ..SdoSettings::default() };
        Self { socket, client: SdoClient::new(id, settings), begin: std::time::Instant::now() }
    }

    fn now(&self) -> Instant {
        Instant::from_micros(u64::try_from(self.begin.elapsed().as_micros()).unwrap())
    }

    fn transfer(&mut self, request: SdoRequest) -> Result<Vec<u8>, SdoError> {
        self.client.request(self.now(), TransferId(1), request).unwrap();
        loop {
            while let Some(output) = self.client.poll_output() {
                match output {
                    SdoOutput::Transmit(frame) => write(&self.socket, &frame),
                    SdoOutput::Done(_, result) => return result,
                }
            }
            let answer = self.socket.read_frame().ok().and_then(|frame| our_frame(&frame));
            let now = self.now();
            if let Some(frame) = answer {
                self.client.handle_answer(now, &frame);
            }
            if self.client.poll_timeout().is_some_and(|(at, _)| at <= now) {
                self.client.handle_timeout(now);
            }
        }
    }
}

fn write(socket: &CanSocket, frame: &CanFrame) {
    let id = StandardId::new(u16::try_from(frame.id().raw()).unwrap()).unwrap();
    socket.write_frame(&CanDataFrame::new(id, frame.data()).unwrap()).unwrap();
}

fn our_frame(frame: &socketcan::CanFrame) -> Option<CanFrame> {
    let id = CanId::standard(u16::try_from(frame.raw_id() & 0x7FF).ok()?)?;
    CanFrame::data_frame(id, frame.data())
}

fn random_bytes(random: &mut Random, sizes: (i32, i32)) -> Vec<u8> {
    let size = random.between(sizes.0, sizes.1);
    (0..size).map(|_| u8::try_from(random.between(0, 255)).unwrap()).collect()
}

/// As zlib has it.
fn crc32(data: &[u8]) -> u32 {
    !data.iter().fold(u32::MAX, |crc, byte| {
        (0..8).fold(crc ^ u32::from(*byte), |crc, _| crc >> 1 ^ (0xEDB8_8320 & (crc & 1).wrapping_neg()))
    })
}

#[test]
fn python_canopen_gets_and_gives_every_byte_of_our_transfers_of_random_sizes() {
    let _bus = take_the_bus();
    let server = ready_peer("sdo_server.py", &[BUS, "9"]);
    let count = transfers();
    let mut random = Random::new(2026);
    // One as is; one that asks for block transfer, which this server declines: downloads by an abort, uploads by segments.
    let mut clients = [OurClient::new(9, false), OurClient::new(9, true)];
    let (mut bytes, mut kinds) = (0, BTreeMap::from([("expedited", 0), ("segmented", 0)]));
    let begin = std::time::Instant::now();
    let mut expected = Vec::new();
    for number in 0..count {
        let sizes = [(1, 4), (5, 40), (41, 120), (121, 400)]
            [usize::from(number % 8 > 1) + usize::from(number % 8 > 4) + usize::from(number % 32 == 31)];
        let data = random_bytes(&mut random, sizes);
        let sub = u8::try_from(number % 8).unwrap() + 1;
        let client = &mut clients[number % 16 / 8];
        let object = ObjectId::new(0x2F00, sub);
        let written = client.transfer(SdoRequest::write(object, data.clone()));
        assert_eq!(written, Ok(Vec::new()), "write {number} of {} bytes", data.len());
        let read = client.transfer(SdoRequest::read(object));
        assert_eq!(read.as_ref(), Ok(&data), "read {number} of {} bytes", data.len());
        bytes += 2 * data.len();
        *kinds.get_mut(if data.len() > 4 { "segmented" } else { "expedited" }).unwrap() += 2;
        expected.push(format!("{sub} {} {}", data.len(), crc32(&data)));
    }
    let took = begin.elapsed();
    wait_until("the last line of python-canopen", || server.stdout_count() > count);
    let seen: Vec<String> = server.stdout(1).into_iter().map(|line| line.text).collect();
    assert_eq!(seen, expected, "what python-canopen says that it was given: object, length, CRC-32");
    println!(
        "our client, python-canopen's server: {count} random sizes written and read back ({kinds:?} transfers, {bytes} bytes) in {took:.1?}; 0 mismatches"
    );
}

#[test]
fn cangate_sdo_writes_and_reads_random_bytes_of_python_canopen() {
    let _bus = take_the_bus();
    let server = ready_peer("sdo_server.py", &[BUS, "9"]);
    let mut random = Random::new(7);
    for (number, sizes) in [(1, 1), (2, 4), (5, 7), (8, 60), (200, 300), (889, 900)].into_iter().enumerate() {
        let data = random_bytes(&mut random, sizes);
        let hex = data.iter().fold(String::new(), |hex, byte| hex + &format!("{byte:02X}"));
        let sdo = |arguments: &[&str]| {
            cangate(&[&["sdo", "-i", BUS, "--node", "9", "--timeout-ms", "5000"], arguments].concat())
        };
        let (code, _, stderr) = sdo(&["write", "0x2F00:1", &hex, "--type", "octets"]);
        assert_eq!(code, 0, "{} bytes: {stderr}", data.len());
        let (code, stdout, stderr) = sdo(&["read", "0x2F00:1", "--raw"]);
        assert_eq!(code, 0, "{} bytes: {stderr}", data.len());
        let read: String = stdout.chars().filter(char::is_ascii_hexdigit).collect();
        assert_eq!(read.to_uppercase(), hex, "{} bytes", data.len());
        wait_until("python-canopen", || server.stdout_count() > number + 1);
        assert_eq!(server.stdout(number + 1)[0].text, format!("1 {} {}", data.len(), crc32(&data)));
    }
}

/// One object that takes and gives anything.
#[derive(Default)]
struct Store(Vec<u8>);

impl Dictionary for Store {
    fn read(&mut self, index: u16, sub: u8) -> Result<Vec<u8>, Abort> {
        self.may_write(index, sub).map(|_| self.0.clone())
    }

    fn may_write(&self, index: u16, sub: u8) -> Result<Option<usize>, Abort> {
        if (index, sub) == (0x2F00, 1) { Ok(None) } else { Err(Abort::NO_OBJECT) }
    }

    fn write(&mut self, _index: u16, _sub: u8, data: &[u8]) -> Result<(), Abort> {
        self.0 = data.to_vec();
        Ok(())
    }
}

#[test]
fn python_canopen_reads_back_what_it_wrote_to_our_server_expedited_in_segments_and_in_blocks() {
    let _bus = take_the_bus();
    let stop = std::sync::Arc::new(std::sync::atomic::AtomicBool::new(false));
    let told = stop.clone();
    let server = std::thread::spawn(move || {
        let socket = CanSocket::open(BUS).unwrap();
        socket.set_filters(&[CanFilter::new(0x60A, 0xC000_07FF)]).unwrap();
        socket.set_read_timeout(Duration::from_millis(50)).unwrap();
        let (mut server, mut store) = (SdoServer::new(65_536), Store::default());
        while !told.load(std::sync::atomic::Ordering::SeqCst) {
            let Ok(frame) = socket.read_frame() else { continue };
            let Ok(request) = <[u8; 8]>::try_from(frame.data()) else { continue };
            for answer in server.handle_request(request, &mut store) {
                write(&socket, &CanFrame::data_frame(CanId::standard(0x58A).unwrap(), &answer).unwrap());
            }
        }
    });
    let count = transfers();
    let begin = std::time::Instant::now();
    let client = peer("sdo_client.py", &[BUS, "10", "judge", &count.to_string(), "2026"]);
    let found = verdict(client, Duration::from_secs(60 + count as u64));
    stop.store(true, std::sync::atomic::Ordering::SeqCst);
    server.join().unwrap();
    println!("python-canopen's client, our server: {found} in {:.1?}", begin.elapsed());
    assert_eq!(found["mismatches"], 0, "{found}");
    assert!(["expedited", "segmented", "block"].iter().all(|kind| found[kind].as_u64() > Some(0)), "{found}");
}

#[test]
fn python_canopen_as_a_second_client_of_a_transmitter_is_never_told_a_lie_and_disturbs_no_value() {
    let _bus = take_the_bus();
    let broker = Broker::start();
    let subscriber = Subscriber::start(&broker, TOPICS);
    let _press = simulate("dst-p92c", 5, &[]);
    // The long time-out: that the guest stalls for seconds is not the other client's doing.
    let fast = [
        ("poll_ms = 1000", "poll_ms = 100"),
        ("heartbeat_timeout_ms = 3000", "heartbeat_timeout_ms = 30000"),
    ]
    .iter()
    .fold(cangate::mapping::shipped("danfoss-dst-p92c").unwrap().to_owned(), |mapping, (from, to)| {
        assert!(mapping.contains(from), "{from}");
        mapping.replace(from, to)
    });
    let gateway =
        Setup::detcons(&[]).broker(&broker).mapping("press", &fast).node("press", 5, "press").start();
    let good = || {
        gateway.node(5).wait_for_status("a good transmitter", |status| {
            status.online() && status.operational() && status.supervision_ok() && status.all_good()
        });
    };
    good();
    let messages = subscriber.count();
    let found = verdict(peer("sdo_client.py", &[BUS, "5", "visit", "20"]), Duration::from_secs(90));
    println!("python-canopen beside the gateway, which polls three objects ten times a second: {found}");
    assert_eq!(found["wrong"], 0, "{found}");
    let right = found["right"].as_u64().unwrap();
    assert!(right > 20, "{found}");
    good();
    // What the gateway polls is 0 all the time; the answers to the other client are not.
    let states: Vec<_> = subscriber.of("press/state", messages);
    for tag in ["pressure_status", "temperature_status", "error_register"] {
        assert!(states.iter().all(|state| state.payload["tags"][tag] == 0), "{tag}");
    }
    assert!(states.len() >= 5, "the gateway went on publishing: {}", states.len());
    println!("{} states of the gateway, none of them wrong", states.len());
    // That somebody else writes to the device is told, once; no alarm of the node is raised by it.
    let alarms: BTreeSet<String> = subscriber
        .since(messages)
        .into_iter()
        .filter(|message| message.topic.contains("/alarm/") && message.payload["active"] == true)
        .map(|message| message.topic)
        .collect();
    assert_eq!(alarms, BTreeSet::from(["bridge/alarm/can0_foreign_master".to_owned()]));
}
