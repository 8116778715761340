//! Objects of nodes through the gateway: the core's side of it, CiA 309-3 and FC 43/13, all against the simulated transmitter,
//! and both servers as they are, over streams.

use std::sync::Arc;
use std::time::Duration;

use cangate::can::interface::Interface;
use cangate::can::{self, BusIndex, Link};
use cangate::canopen::{NmtRequest, NodeId};
use cangate::cia309::{self, Session, Step};
use cangate::gateway::command::{AbortCode, Door, ObjectId};
use cangate::gateway::{self, Action, Desk, Gateway, Health, Outcome};
use cangate::mapping::installation::RoleWord;
use cangate::mapping::{Sketch, TagTable};
use cangate::modbus::pdu::ExceptionCode;
use cangate::modbus::{ModbusSettings, RegisterBank, RegisterMap, connection, general_reference};
use cangate::process_image::{Event, EventKind, NodeIndex, process_image};
use cangate::simulator::task::BusEnd;
use cangate::simulator::{self, DevicePlan, Kind, Scenario};
use cangate::slots::{Clients, Limits, Place, ServerName};
use cangate::time::Clock;
use tokio::io::{AsyncBufReadExt, AsyncReadExt, AsyncWriteExt, BufReader, DuplexStream};
use tokio::sync::{mpsc, watch};
use tokio_util::sync::CancellationToken;

use super::support::modbus::{LONG, frame};
use super::support::world::World;

const DETCON: NodeIndex = NodeIndex(0);
const TRANSMITTER: NodeIndex = NodeIndex(1);

fn sketch() -> Sketch {
    Sketch::new().node("node001", 1, "motortech-detcon", |_| ()).node(
        "node002",
        2,
        "danfoss-dst-p92c",
        |_| (),
    )
}

fn plant() -> Arc<TagTable> {
    Arc::new(sketch().build().unwrap().0)
}

fn transmitter() -> DevicePlan {
    DevicePlan::new(NodeId::new(2).unwrap(), Scenario::shipped(Kind::DstP92c, "quiet").unwrap())
}

fn running() -> World {
    let mut world = World::with(plant(), 1);
    world.power_on(1, "quiet");
    world.connect(&transmitter());
    world.run_for(1000);
    world.start_gateway();
    world.run_for(5000);
    world
}

fn read(node: NodeIndex, object: &str) -> Action {
    Action::SdoRead { node, object: object.parse().unwrap(), len: None, timeout: None }
}

fn write(node: NodeIndex, object: &str, data: &[u8]) -> Action {
    Action::SdoWrite { node, object: object.parse().unwrap(), data: data.to_vec(), timeout: None }
}

fn journalled(world: &World, name: &str) -> Vec<Event> {
    world.image.journal.after(0).0.into_iter().filter(|event| event.name == name).collect()
}

#[test]
fn r_dst_066_068_objects_are_read_expedited_and_in_segments_and_reads_leave_no_trace() {
    let mut world = running();
    assert_eq!(world.ask(read(TRANSMITTER, "0x1018:1")), Outcome::Read(vec![0x3D, 2, 0, 0]));
    let Outcome::Read(name) = world.ask(read(TRANSMITTER, "0x1008:0")) else { panic!() };
    assert!(name.len() > 4 && name.is_ascii(), "{name:?}");
    assert!(!world.image.journal.newest_first().any(|event| event.kind == EventKind::Command));
    assert!(world.is_good(1) && world.is_good(2));
}

#[test]
fn r_dst_067_a_write_is_confirmed_by_the_device_and_journalled_with_who_and_what() {
    let mut world = running();
    let value = (-1.5_f32).to_le_bytes();
    assert_eq!(world.ask(write(TRANSMITTER, "0x6124:1", &value)), Outcome::Done);
    assert_eq!(world.ask(read(TRANSMITTER, "0x6124:1")), Outcome::Read(value.to_vec()));
    let events = journalled(&world, "sdo_write");
    let [event] = &events[..] else { panic!("{events:?}") };
    assert_eq!((event.kind, event.node.as_deref()), (EventKind::Command, Some("node002")));
    assert_eq!((event.from.as_str(), event.to.as_str()), ("cia309 test", "done"));
    assert_eq!(event.text, "0x6124:1 = 0000C0BF");
}

#[test]
fn r_dst_009_068_what_the_device_refuses_is_told_with_its_abort_code() {
    let mut world = running();
    assert_eq!(world.ask(read(TRANSMITTER, "0x2FFF:0")), Outcome::Aborted(AbortCode(0x0602_0000)));
    assert_eq!(world.ask(write(TRANSMITTER, "0x1000:0", &[0; 4])), Outcome::Aborted(AbortCode(0x0601_0002)));
    let failed = journalled(&world, "sdo_read_failed");
    assert_eq!(failed[0].text, "0x2FFF:0: 0x06020000, object does not exist");
    let written = journalled(&world, "sdo_write");
    assert_eq!(written[0].to, "aborted");
    assert_eq!(written[0].text, "0x1000:0 = 00000000: 0x06010002, attempt to write a read-only object");
    world.run_for(3000);
    assert!(world.is_good(2) && world.raised.is_empty(), "{:?}", world.raised);
}

#[test]
fn a_node_that_cannot_be_asked_is_not_asked() {
    let mut world = running();
    world.sent.clear();
    assert_eq!(world.ask(read(NodeIndex(9), "0x1000:0")), Outcome::Unknown);
    let Outcome::Rejected(why) = world.ask(write(DETCON, "0x1000:0", &[1])) else { panic!() };
    assert!(why.contains("mapping"), "{why}");
    assert!(!world.sent.iter().any(|frame| frame.starts_with("601#")), "a DetCon knows no SDO");
    assert_eq!(world.ask(Action::Nmt { node: TRANSMITTER, request: NmtRequest::Stop }), Outcome::Done);
    world.run_for(3000);
    assert_eq!(world.ask(read(TRANSMITTER, "0x1000:0")), Outcome::NodeUnavailable, "R-DST-071");
    world.link(Link::Down);
    assert_eq!(world.ask(read(TRANSMITTER, "0x1000:0")), Outcome::NodeUnavailable);
    assert_eq!(journalled(&world, "sdo_write").len(), 1, "a write that was refused is journalled too");
}

#[test]
fn in_the_passive_role_nothing_is_asked() {
    let table = sketch().bus(|bus| bus.role = RoleWord::Passive).build().unwrap().0;
    let mut world = World::with(Arc::new(table), 1);
    world.connect(&transmitter());
    world.start_gateway();
    world.run_for(1000);
    for action in [read(TRANSMITTER, "0x1000:0"), write(TRANSMITTER, "0x1017:0", &[0, 0])] {
        assert!(matches!(world.ask(action), Outcome::Rejected(why) if why.contains("passive")));
    }
    assert!(world.sent.is_empty(), "{:?}", world.sent);
}

#[test]
fn requests_beyond_the_queue_of_a_node_are_busy_and_process_data_goes_on() {
    let mut world = running();
    let asked: Vec<u64> = (0..40).map(|_| world.command(read(TRANSMITTER, "0x1008:0"))).collect();
    world.run_for(3000);
    let replies: Vec<Outcome> = asked.into_iter().map(|id| world.reply(id).expect("an answer")).collect();
    let read = replies.iter().filter(|outcome| matches!(outcome, Outcome::Read(_))).count();
    assert!((8..=9).contains(&read), "{read}: one under way, eight that wait");
    assert_eq!(replies.iter().filter(|outcome| **outcome == Outcome::Busy).count(), 40 - read);
    assert!(world.is_good(1) && world.is_good(2) && world.raised.is_empty(), "{:?}", world.raised);
}

#[test]
fn r_dst_073_a_device_that_was_switched_off_times_out_and_the_others_do_not_notice() {
    let mut world = running();
    world.order("node 2 power off");
    let before = world.millis();
    assert_eq!(world.ask(read(TRANSMITTER, "0x1000:0")), Outcome::Timeout);
    assert!(world.millis() - before <= 1600, "{}", world.millis() - before);
    // It is lost by now: what is polled of it is not asked for any more, and nothing stands before the next request.
    world.run_for(10_000);
    let patient = Action::SdoWrite {
        node: TRANSMITTER,
        object: ObjectId::new(0x1017, 0),
        data: vec![0, 0],
        timeout: Some(Duration::from_secs(5)),
    };
    let before = world.millis();
    assert_eq!(world.ask(patient), Outcome::Timeout);
    assert!((5000..7000).contains(&(world.millis() - before)), "a write is sent once, and waits as told");
    assert!(world.is_good(1));
}

#[test]
fn refused_writes_that_repeat_are_journalled_as_a_count_and_those_that_may_have_been_done_one_by_one() {
    let mut world = running();
    for value in 0..3 {
        let refused = world.ask(write(TRANSMITTER, "0x1000:0", &[value; 4]));
        assert_eq!(refused, Outcome::Aborted(AbortCode(0x0601_0002)));
    }
    assert_eq!(journalled(&world, "sdo_write").len(), 1);
    world.run_for(61_000);
    let told = &journalled(&world, "sdo_write")[1];
    assert_eq!(told.to, "aborted");
    assert!(
        told.text.starts_with("2 more of these within 60 s, the last: 0x1000:0 = 02020202"),
        "{}",
        told.text
    );
    world.order("node 2 power off");
    for _ in 0..2 {
        assert_eq!(world.ask(write(TRANSMITTER, "0x1017:0", &[0, 0])), Outcome::Timeout);
    }
    assert_eq!(journalled(&world, "sdo_write").len(), 4);
}

#[test]
fn nobody_comes_between_the_steps_of_a_boot() {
    let mut world = running();
    world.order("node 2 power off");
    world.run_for(4000);
    world.order("node 2 power on");
    let (mut busy, mut served) = (0, 0);
    for _ in 0..3000 {
        let id = world.command(read(TRANSMITTER, "0x1018:1"));
        world.run_for(1);
        match world.reply(id) {
            Some(Outcome::Busy) => busy += 1,
            Some(_) | None => served += 1,
        }
    }
    world.run_for(5000);
    assert!(busy > 0 && served > 0, "{busy} {served}");
    assert!(world.is_good(2) && world.node(2).online, "{}", world.node(2).reason);
}

/// A line, and its answer from the simulated plant.
fn talk(world: &mut World, session: &mut Session, line: &str) -> String {
    match session.handle_line(line.as_bytes()) {
        Step::Nothing | Step::End => String::new(),
        Step::Answer(text) | Step::NotUnderstood(text) | Step::Last(text) | Step::Refused(text, _) => text,
        Step::Ask(action, asked) => asked.answer(&world.ask(action)),
    }
}

#[test]
fn a_transmitter_is_read_and_written_in_the_words_of_cia_309_3() {
    let mut world = running();
    let mut session = Session::new(plant(), true);
    for (line, answer) in [
        ("[1] 2 r 0x1018 1 u32", "[1] 573"),
        ("[2] 2 r 0x1018 1 x32", "[2] 0x0000023D"),
        ("[3] set node 2", "[3] OK"),
        ("[4] r 0x1018 1", "[4] 3D 02 00 00"),
        ("[5] w 0x6124 1 r32 -1.5", "[5] OK"),
        ("[6] r 0x6124 1 r32", "[6] -1.5"),
        ("[7] r 0x2fff 0 u8", "[7] ERROR:0x06020000 #object does not exist"),
        ("[8] w 0x1000 0 u32 1", "[8] ERROR:0x06010002 #attempt to write a read-only object"),
        (
            "[9] r 0x1018 1 u16",
            "[9] ERROR:0x06070010 #the object is of another type; it begins with 3D020000",
        ),
        ("[10] preop", "[10] OK"),
        ("[11] start", "[11] OK"),
    ] {
        assert_eq!(talk(&mut world, &mut session, line), answer, "{line}");
    }
    assert!(world.sent.contains("000#8002") && world.sent.contains("000#0102"));
    let name = talk(&mut world, &mut session, "[12] r 0x1008 0 vs");
    assert!(name.starts_with("[12] \"") && name.ends_with('"'), "{name}");
}

#[test]
fn a_transmitter_is_read_and_written_by_fc_43_13() {
    let mut world = running();
    let mut exchange = |pdu: &[u8]| {
        let reference = general_reference::decode(pdu).unwrap();
        let outcome = world.ask(reference.action(&plant(), 2).unwrap());
        let mut out = Vec::new();
        reference.answer(&outcome, &mut out).map(|()| out)
    };
    let request = [0x2B, 0x0D, 0, 0, 2, 0x10, 0x18, 1, 0, 0, 0, 4];
    assert_eq!(exchange(&request), Ok([&request[..], &[0x3D, 2, 0, 0]].concat()));
    let request = [0x2B, 0x0D, 1, 0, 2, 0x61, 0x24, 1, 0, 0, 0, 4];
    assert_eq!(exchange(&[&request[..], &1.5_f32.to_le_bytes()].concat()), Ok(request.to_vec()));
    let request = [0x2B, 0x0D, 0, 0, 2, 0x61, 0x24, 1, 0, 2, 0, 9];
    assert_eq!(exchange(&request).unwrap()[10..], [0, 2, 0xC0, 0x3F], "from its third byte to its end");
    let nothing = [0x2B, 0x0D, 0, 0, 2, 0x2F, 0xFF, 0, 0, 0, 0, 1];
    assert_eq!(exchange(&nothing), Err(ExceptionCode::ServerDeviceFailure));
}

/// The gateway and the transmitter as tasks on a bus inside the process, in tokio's paused time.
struct Tasks {
    desk: Desk,
    clock: Clock,
    stop: CancellationToken,
}

fn tasks(name: &str) -> Tasks {
    let (clock, stop) = (Clock::start(), CancellationToken::new());
    let bus = || {
        let (events_to, events) = mpsc::channel(1024);
        let (transmit, frames) = mpsc::channel(64);
        let interface = Interface::Virtual(name.to_owned());
        let run = can::task::run(
            BusIndex(0),
            interface,
            can::task::Sending::Untold,
            events_to,
            frames,
            clock,
            stop.clone(),
        );
        tokio::spawn(run);
        (events, transmit)
    };
    let (events, transmit) = bus();
    let (lines, report) = (mpsc::channel(1).1, mpsc::channel(1).0);
    let device = simulator::task::run(
        vec![transmitter()],
        BusEnd { events, transmit },
        lines,
        report,
        clock,
        stop.clone(),
    );
    tokio::spawn(device);
    let (events, transmit) = bus();
    let gateway = Gateway::new(plant(), clock.now());
    let (writer, _) = process_image(gateway.empty_image());
    let (desk, commands) = Desk::new(32);
    let (_, health) = watch::channel(Health::default());
    tokio::spawn(gateway::task::run(
        gateway,
        writer,
        events,
        vec![transmit],
        commands.into(),
        health,
        mpsc::channel(1).1,
        clock,
        stop.clone(),
    ));
    Tasks { desk, clock, stop }
}

impl Tasks {
    /// A place that nobody else wants.
    fn place(&self) -> Place {
        let clients = Clients::new(ServerName::new("test", "[test]"), Limits::places(1), self.stop.clone());
        clients.take([127, 0, 0, 1].into())
    }

    /// A CiA 309-3 connection; gives the client's end and why it ended.
    fn cia309(&self, writes: bool) -> (DuplexStream, tokio::task::JoinHandle<&'static str>) {
        let (near, far) = tokio::io::duplex(1024);
        let shared = cia309::connection::Shared {
            table: plant(),
            desk: self.desk.clone(),
            writes,
            clock: self.clock,
            idle_timeout: Some(Duration::from_secs(600)),
        };
        let place = self.place();
        let serving =
            async move { cia309::connection::serve(near, "client".to_owned(), &shared, &place).await };
        (far, tokio::spawn(serving))
    }

    /// A Modbus connection.
    fn modbus(&self, objects: Option<connection::Objects>) -> DuplexStream {
        let (near, far) = tokio::io::duplex(4096);
        let (table, settings) = (plant(), ModbusSettings::default());
        let map = RegisterMap::build(&table, &settings, "cangate").unwrap();
        let (_, reader) = process_image(Gateway::new(Arc::clone(&table), self.clock.now()).empty_image());
        let shared = connection::Shared {
            bank: RegisterBank::new(table, Arc::new(map)).into(),
            reader,
            clock: self.clock,
            counters: Arc::default(),
            accounts: Arc::default(),
            rate: None,
            idle_timeout: None,
            partial_frame_timeout: settings.partial_frame_timeout(),
            send_timeout: settings.send_timeout(),
            objects,
            writers: None,
        };
        let (place, peer) = (self.place(), "127.0.0.1:1".parse().unwrap());
        tokio::spawn(async move { connection::serve(near, peer, &shared.into(), &place).await });
        far
    }
}

#[tokio::test(start_paused = true)]
async fn pipelined_lines_are_answered_in_order_while_the_device_is_asked() {
    let tasks = tasks("objects-309");
    // The transmitter boots, and is configured.
    tokio::time::sleep(Duration::from_secs(10)).await;
    let (client, ended) = tasks.cia309(true);
    let (reading, mut writing) = tokio::io::split(client);
    let asking = tokio::spawn(async move {
        for number in 1..=200 {
            let line = format!("[{number}] 2 r 0x1018 1 u32\r\n# a comment\r\n\r\n");
            writing.write_all(line.as_bytes()).await.unwrap();
        }
        writing.write_all(b"[201] 2 w 0x6124 1 r32 2.5\n[202] 2 r 0x6124 1 r32\n").await.unwrap();
        writing
    });
    let mut lines = BufReader::new(reading).lines();
    for number in 1..=200 {
        assert_eq!(lines.next_line().await.unwrap().unwrap(), format!("[{number}] 573"));
    }
    assert_eq!(lines.next_line().await.unwrap().unwrap(), "[201] OK");
    assert_eq!(lines.next_line().await.unwrap().unwrap(), "[202] 2.5");
    drop((lines, asking.await.unwrap()));
    assert_eq!(ended.await.unwrap(), "closed");
    tasks.stop.cancel();
}

#[tokio::test(start_paused = true)]
async fn clients_that_are_idle_slow_or_send_lines_without_end_do_not_stay() {
    let tasks = tasks("objects-309-bad");
    let (_idle, ended) = tasks.cia309(false);
    let begun = tasks.clock.now().instant;
    assert_eq!(ended.await.unwrap(), "idle");
    assert_eq!(tasks.clock.now().instant.since(begun).as_secs(), 600);

    let (mut dribbling, ended) = tasks.cia309(false);
    let dribble = tokio::spawn(async move {
        while dribbling.write_all(b"x").await.is_ok() {
            tokio::time::sleep(Duration::from_secs(60)).await;
        }
    });
    assert_eq!(ended.await.unwrap(), "idle", "bytes without a line are no activity");
    dribble.await.unwrap();

    let (mut deaf, ended) = tasks.cia309(false);
    let shout = tokio::spawn(async move {
        let mut sent = 0_usize;
        while deaf.write_all(b"[1] info version\n").await.is_ok() {
            sent += 17;
        }
        sent
    });
    assert_eq!(ended.await.unwrap(), "slow_client");
    assert!(shout.await.unwrap() < 10_000, "no more is taken than some buffers");

    let (mut browser, ended) = tasks.cia309(true);
    browser.write_all(b"POST / HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n[1] 2 stop\r\n").await.unwrap();
    let mut nothing = Vec::new();
    browser.read_to_end(&mut nothing).await.unwrap();
    assert_eq!((ended.await.unwrap(), nothing.len()), ("http", 0), "and no node was stopped");

    tasks.stop.cancel();
}

/// What a web page makes a browser send: an address that is longer than a line may be, and lines of CiA 309-3 behind it.
#[tokio::test(start_paused = true)]
async fn a_line_that_is_too_long_is_the_last_one_and_what_follows_it_is_not_obeyed() {
    let tasks = tasks("objects-309-long");
    let (client, ended) = tasks.cia309(true);
    let (mut reading, mut writing) = tokio::io::split(client);
    let request = format!(
        "POST /{} HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n1 stop\r\n[5] info version\r\n",
        "x".repeat(20_000)
    );
    // Who has read the answer may hang up before all was sent.
    let browser = tokio::spawn(async move { drop(writing.write_all(request.as_bytes()).await) });
    let mut answers = String::new();
    reading.read_to_string(&mut answers).await.unwrap();
    assert_eq!(answers, "[0] ERROR:600 #a line has at most 16384 bytes\r\n", "and no node was stopped");
    assert_eq!(ended.await.unwrap(), "too_long");
    browser.await.unwrap();
    tasks.stop.cancel();
}

/// What a web page makes a browser send that speaks TLS: a session ticket of the page's choice in the hello.
#[tokio::test(start_paused = true)]
async fn a_line_that_is_no_text_is_the_last_one_and_what_follows_it_is_not_obeyed() {
    let tasks = tasks("objects-309-tls");
    let (mut client, ended) = tasks.cia309(true);
    client.write_all(b"\x16\x03\x01\x02\x00\x01\x00\n[5] info version\r\n1 stop\r\n").await.unwrap();
    let mut answers = String::new();
    client.read_to_string(&mut answers).await.unwrap();
    assert!(answers.starts_with("[0] ERROR:101 ") && answers.lines().count() == 1, "{answers}");
    assert_eq!(ended.await.unwrap(), "no_text");
    tasks.stop.cancel();
}

async fn answer(client: &mut DuplexStream) -> (u16, Vec<u8>) {
    let mut header = [0; 7];
    tokio::time::timeout(LONG, client.read_exact(&mut header)).await.unwrap().unwrap();
    let mut pdu = vec![0; usize::from(u16::from_be_bytes([header[4], header[5]])) - 1];
    client.read_exact(&mut pdu).await.unwrap();
    (u16::from_be_bytes([header[0], header[1]]), pdu)
}

const READ_VENDOR: [u8; 12] = [0x2B, 0x0D, 0, 0, 2, 0x10, 0x18, 1, 0, 0, 0, 4];
const WRITE_OFFSET: [u8; 16] = [0x2B, 0x0D, 1, 0, 2, 0x61, 0x24, 1, 0, 0, 0, 4, 0, 0, 0x80, 0x3F];

#[tokio::test(start_paused = true)]
async fn fc_43_13_is_answered_between_registers_in_the_order_of_the_requests() {
    let tasks = tasks("objects-modbus");
    tokio::time::sleep(Duration::from_secs(10)).await;
    let mut client = tasks.modbus(Some(connection::Objects { desk: tasks.desk.clone(), write: true }));
    let pattern = [4, 0, 90, 0, 1];
    let mut requests = frame(1, 247, &pattern);
    requests.extend(frame(2, 2, &READ_VENDOR));
    requests.extend(frame(3, 247, &pattern));
    requests.extend(frame(4, 2, &WRITE_OFFSET));
    requests.extend(frame(5, 77, &READ_VENDOR));
    requests.extend(frame(6, 2, &READ_VENDOR[..11]));
    requests.extend(frame(7, 1, &READ_VENDOR));
    requests.extend(frame(8, 255, &READ_VENDOR));
    client.write_all(&requests).await.unwrap();
    assert_eq!(answer(&mut client).await, (1, vec![4, 2, 0x12, 0x34]));
    let vendor = [&READ_VENDOR[..], &[0x3D, 2, 0, 0]].concat();
    assert_eq!(answer(&mut client).await, (2, vendor.clone()));
    assert_eq!(answer(&mut client).await, (3, vec![4, 2, 0x12, 0x34]));
    assert_eq!(answer(&mut client).await, (4, WRITE_OFFSET[..12].to_vec()));
    assert_eq!(answer(&mut client).await, (5, vec![0xAB, 0x0B]), "no such unit");
    assert_eq!(answer(&mut client).await, (6, vec![0xAB, 3]), "cut off");
    assert_eq!(answer(&mut client).await, (7, vec![0xAB, 2]), "node 2 is not behind unit 1");
    assert_eq!(answer(&mut client).await, (8, vendor), "the gateway's unit reaches every node");
    tasks.stop.cancel();
}

#[tokio::test(start_paused = true)]
async fn fc_43_13_is_off_or_reads_only_unless_told_otherwise() {
    let tasks = tasks("objects-modbus-off");
    tokio::time::sleep(Duration::from_secs(10)).await;
    let mut client = tasks.modbus(None);
    client.write_all(&frame(1, 2, &READ_VENDOR)).await.unwrap();
    assert_eq!(answer(&mut client).await, (1, vec![0xAB, 1]));
    let mut client = tasks.modbus(Some(connection::Objects { desk: tasks.desk.clone(), write: false }));
    client.write_all(&frame(1, 2, &WRITE_OFFSET)).await.unwrap();
    assert_eq!(answer(&mut client).await, (1, vec![0xAB, 3]));
    assert_eq!(tasks.desk.refused()[0], (Door::Modbus, 1), "the write is told of");
    client.write_all(&frame(2, 2, &READ_VENDOR)).await.unwrap();
    assert_eq!(answer(&mut client).await.1.len(), 16);
    assert_eq!(tasks.desk.refused()[0], (Door::Modbus, 1));
    tasks.stop.cancel();
}

#[tokio::test]
async fn the_server_takes_so_many_clients_and_ends_when_told() {
    let (desk, _commands) = Desk::new(1);
    let shared = cia309::connection::Shared {
        table: plant(),
        desk,
        writes: false,
        clock: Clock::start(),
        idle_timeout: None,
    };
    let server = cia309::Server::bind("127.0.0.1:0".parse().unwrap(), 2, shared.clone()).await.unwrap();
    let address = server.local_addr();
    let taken = cia309::Server::bind(address, 2, shared).await.unwrap_err().to_string();
    assert!(taken.contains(&address.to_string()) && taken.contains("[cia309]"), "{taken}");
    let stop = CancellationToken::new();
    let task = tokio::spawn(server.run(stop.clone()));
    let mut clients = Vec::new();
    for _ in 0..3 {
        let mut client = tokio::net::TcpStream::connect(address).await.unwrap();
        client.write_all(b"[1] info version\r\n").await.unwrap();
        let mut line = [0; 4];
        tokio::time::timeout(LONG, client.read_exact(&mut line)).await.unwrap().unwrap();
        assert_eq!(&line, b"[1] ");
        clients.push(client);
    }
    let mut rest = Vec::new();
    let closed = tokio::time::timeout(LONG, clients[0].read_to_end(&mut rest)).await;
    assert!(closed.is_ok(), "the one that has been silent for longest made room");
    stop.cancel();
    tokio::time::timeout(LONG, task).await.unwrap().unwrap();
}
