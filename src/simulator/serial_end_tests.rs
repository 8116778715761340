//! Outside ends as programs see them: a simulated module between a pseudo-terminal, or a TCP client, and a bus that the test
//! holds.

use std::time::Duration;

use tokio::net::TcpStream;
use tokio::task::JoinHandle;
use tokio_util::sync::CancellationToken;

use super::*;
use crate::can::{BusEvent, BusIndex, CanFrame, Link as BusLink};
use crate::simulator::task::{BusEnd, run_with_ends};
use crate::simulator::{DeviceNumber, DevicePlan, Kind, Scenario};
use crate::time::Clock;

/// Longer than anything here takes.
const LONG: Duration = Duration::from_secs(60);

/// An SIO4 with switches 1A, which sends at once, and the other end of its bus.
struct Rig {
    events: mpsc::Sender<(BusIndex, BusEvent)>,
    sent: mpsc::Receiver<CanFrame>,
    paper: mpsc::Receiver<String>,
    clock: Clock,
    stop: CancellationToken,
    task: JoinHandle<()>,
}

impl Rig {
    async fn start(place: &SerialPlace) -> Self {
        let end = SerialEnd::open(place).await.unwrap();
        let text = "description = \"x\"\n[device]\nfirst_tx_delay_ms = 0\ncan_tx_mode = [0x0081]\nserial_mode = [0xEE13]";
        let mut scenario = Scenario::parse(Kind::CbmSio4, "s.toml", text).unwrap();
        let crate::simulator::Settings::CbmSio(settings) = &mut scenario.settings else { panic!() };
        settings.lines[0] = crate::simulator::cbm_sio::line::LineKind::External;
        let plan = DevicePlan::new(DeviceNumber::new(0x1A).unwrap(), scenario);
        let (events, events_end) = mpsc::channel(16);
        let (transmit, sent) = mpsc::channel(10_000);
        let (report, paper) = mpsc::channel(1000);
        let (_, lines) = mpsc::channel(1);
        let (clock, stop) = (Clock::start(), CancellationToken::new());
        let bus = BusEnd { events: events_end, transmit };
        let task =
            tokio::spawn(run_with_ends(vec![plan], vec![end], bus, lines, report, clock, stop.clone()));
        let rig = Self { events, sent, paper, clock, stop, task };
        let up = BusEvent::Link { link: BusLink::ErrorActive, at: rig.clock.now() };
        rig.events.send((BusIndex(0), up)).await.unwrap();
        rig
    }

    /// The next report that has this in it.
    async fn told(&mut self, part: &str) -> String {
        loop {
            let text = tokio::time::timeout(LONG, self.paper.recv()).await.unwrap().unwrap();
            if text.contains(part) {
                return text;
            }
        }
    }

    async fn frame(&self, frame: CanFrame) {
        self.events.send((BusIndex(0), BusEvent::Frame { frame, at: self.clock.now() })).await.unwrap();
    }

    /// So many bytes that came to the bus.
    async fn bytes(&mut self, count: usize) -> Vec<u8> {
        let mut bytes = Vec::new();
        while bytes.len() < count {
            let frame = tokio::time::timeout(LONG, self.sent.recv()).await.unwrap().unwrap();
            assert_eq!(frame.id().raw(), 0x104);
            bytes.extend(frame.data());
        }
        bytes
    }

    async fn end(self) {
        self.stop.cancel();
        tokio::time::timeout(LONG, self.task).await.unwrap().unwrap();
    }
}

fn tcp() -> SerialPlace {
    "1=tcp:127.0.0.1:0".parse().unwrap()
}

async fn connect(rig: &mut Rig) -> TcpStream {
    let told = rig.told("channel 1: tcp ").await;
    TcpStream::connect(told.strip_prefix("channel 1: tcp ").unwrap()).await.unwrap()
}

async fn read_exactly(from: &mut (impl AsyncRead + Unpin), count: usize) -> Vec<u8> {
    let mut bytes = vec![0; count];
    tokio::time::timeout(LONG, from.read_exact(&mut bytes)).await.unwrap().unwrap();
    bytes
}

#[tokio::test]
async fn a_tcp_client_talks_through_the_module_to_the_bus() {
    let mut rig = Rig::start(&tcp()).await;
    let mut client = connect(&mut rig).await;
    client.write_all(b"hello").await.unwrap();
    assert_eq!(rig.bytes(5).await, b"hello");
    rig.frame("109#776F726C64".parse().unwrap()).await;
    assert_eq!(read_exactly(&mut client, 5).await, b"world");
    rig.end().await;
}

#[tokio::test]
async fn much_comes_through_in_order_and_nothing_is_lost_because_the_client_has_to_wait_for_the_line() {
    let mut rig = Rig::start(&tcp()).await;
    let mut client = connect(&mut rig).await;
    let bytes: Vec<u8> = (0..8000_u32).map(|number| (number % 251).to_le_bytes()[0]).collect();
    client.write_all(&bytes).await.unwrap();
    assert!(rig.bytes(8000).await == bytes);
    for piece in bytes.chunks(8).take(50) {
        rig.frame(CanFrame::data_frame(crate::can::CanId::Standard(0x109), piece).unwrap()).await;
        assert_eq!(read_exactly(&mut client, 8).await, piece);
    }
    while let Ok(text) = rig.paper.try_recv() {
        assert!(!text.contains("overflow") && !text.contains("lost"), "{text}");
    }
    rig.end().await;
}

#[tokio::test]
async fn clients_come_one_after_the_other() {
    let mut rig = Rig::start(&tcp()).await;
    let first = connect(&mut rig).await;
    rig.told("is connected").await;
    let mut second = TcpStream::connect(first.peer_addr().unwrap()).await.unwrap();
    drop(first);
    rig.told("has gone").await;
    second.write_all(b"2").await.unwrap();
    assert_eq!(rig.bytes(1).await, b"2");
    rig.end().await;
}

#[tokio::test]
async fn a_client_that_has_said_its_last_still_gets_its_answer() {
    let mut rig = Rig::start(&tcp()).await;
    let mut client = connect(&mut rig).await;
    client.write_all(b"?").await.unwrap();
    client.shutdown().await.unwrap();
    assert_eq!(rig.bytes(1).await, b"?");
    rig.frame("109#21".parse().unwrap()).await;
    assert_eq!(read_exactly(&mut client, 1).await, b"!");
    rig.end().await;
}

/// Opens a pseudo-terminal as a program does that knows nothing of this.
async fn open(path: &std::path::Path) -> tokio::fs::File {
    tokio::fs::OpenOptions::new().read(true).write(true).open(path).await.unwrap()
}

#[tokio::test]
async fn a_program_opens_the_pseudo_terminal_talks_closes_it_and_opens_it_again() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("ttyS1");
    let place: SerialPlace = format!("1=pty:{}", path.display()).parse().unwrap();
    let mut rig = Rig::start(&place).await;
    for text in [b"ab\rc\x03", b"12\x00\n\xFF"] {
        let mut port = open(&path).await;
        rig.told("channel 1: opened").await;
        port.write_all(text).await.unwrap();
        port.flush().await.unwrap();
        assert_eq!(rig.bytes(5).await, text, "raw: nothing is changed or obeyed");
        rig.frame("109#0D0A0411".parse().unwrap()).await;
        assert_eq!(read_exactly(&mut port, 4).await, b"\r\n\x04\x11");
        drop(port);
        rig.told("channel 1: closed").await;
    }
    rig.end().await;
    assert!(std::fs::symlink_metadata(&path).is_err(), "the name goes with the simulation");
}

#[tokio::test]
async fn what_a_program_leaves_in_the_pseudo_terminal_before_it_goes_is_sent() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("ttyS1");
    let mut rig = Rig::start(&format!("1=pty:{}", path.display()).parse().unwrap()).await;
    std::fs::write(&path, b"scan").unwrap();
    assert_eq!(rig.bytes(4).await, b"scan");
    rig.end().await;
}

#[tokio::test]
async fn a_name_that_a_file_has_is_not_taken_and_one_that_leads_nowhere_is() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("ttyS1");
    let place: SerialPlace = format!("1=pty:{}", path.display()).parse().unwrap();
    std::fs::write(&path, b"precious").unwrap();
    assert_eq!(SerialEnd::open(&place).await.unwrap_err().kind(), io::ErrorKind::AlreadyExists);
    assert_eq!(std::fs::read(&path).unwrap(), b"precious");
    std::fs::remove_file(&path).unwrap();
    std::os::unix::fs::symlink("/nowhere", &path).unwrap();
    let end = SerialEnd::open(&place).await.unwrap();
    assert!(end.describe().contains("/dev/pts/"), "{}", end.describe());
}

#[tokio::test]
async fn what_goes_out_while_nobody_is_there_is_lost_and_what_comes_later_is_not() {
    let end = SerialEnd::open(&tcp()).await.unwrap();
    let Port::Tcp(listener) = &end.port else { panic!() };
    let address = listener.local_addr().unwrap();
    let (heard, mut told) = mpsc::channel(16);
    let mut wire = Wire::start(end, heard);
    assert!(wire.send(b"lost".to_vec()));
    while wire.pieces.capacity() < CHUNKS {
        tokio::task::yield_now().await;
    }
    let mut client = TcpStream::connect(address).await.unwrap();
    assert!(matches!(told.recv().await, Some((1, Heard::Said(_)))));
    assert!(wire.send(b"kept".to_vec()));
    assert_eq!(read_exactly(&mut client, 4).await, b"kept");
}

#[tokio::test]
async fn a_client_that_does_not_read_fills_the_queue_and_no_more() {
    let end = SerialEnd::open(&tcp()).await.unwrap();
    let Port::Tcp(listener) = &end.port else { panic!() };
    let address = listener.local_addr().unwrap();
    let (heard, mut told) = mpsc::channel(16);
    let mut wire = Wire::start(end, heard);
    let _client = TcpStream::connect(address).await.unwrap();
    told.recv().await.unwrap();
    let mut sent = 0;
    while wire.send(vec![0; 65_536]) {
        sent += 1;
        tokio::task::yield_now().await;
        assert!(sent < 100_000, "it is not bounded");
    }
}
