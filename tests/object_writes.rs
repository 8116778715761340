//! Tags that are objects and can be written: from the key of the mapping to the download on the bus, and by HTTP the whole way.

use std::sync::Arc;
use std::time::Duration;

use cangate::access::{Access, AccessEntry, Role};
use cangate::can::interface::Interface;
use cangate::can::{self, BusEvent, BusIndex};
use cangate::canopen::NodeId;
use cangate::gateway::{self, Action, Desk, Gateway, Health, Outcome};
use cangate::mapping::installation::RoleWord;
use cangate::mapping::{At, ReadOnly, Sketch, SourceText, TagTable, check_mapping};
use cangate::modbus::{MapFormat, ModbusSettings, RegisterMap, map_text};
use cangate::process_image::{NodeIndex, TagIndex, Value, process_image};
use cangate::simulator::task::BusEnd;
use cangate::simulator::{self, DevicePlan, Kind, Scenario};
use cangate::time::Clock;
use cangate::web::{Server, WebSettings};
use tokio::net::TcpStream;
use tokio::sync::{mpsc, watch};
use tokio_util::sync::CancellationToken;

use super::support::http::converse;
use super::support::secure_web::state_of;
use super::support::until;
use super::support::world::World;

/// The offset of the first input of the transmitter (0x6124:1), which it keeps and tells.
const OFFSET: &str = r#"
format = 1
device = { vendor = "Danfoss", model = "DST" }
[error_control]
kind = "heartbeat"
heartbeat_ms = 500
[[tag]]
name = "offset"
object = "0x6124:1"
type = "f32"
poll_ms = 100
writable = true
minimum = -5
maximum = 5
registers = [{ address = 100, type = "f32" }]
[[tag]]
name = "other"
object = "0x6125:1"
type = "f32"
poll_ms = 100
"#;

const TOKEN: &str = "0123456789abcdef-token";

fn sketch() -> Sketch {
    Sketch::new().mapping(SourceText::new("offset", OFFSET)).node("press", 2, "offset", |_| ())
}

fn plant() -> Arc<TagTable> {
    Arc::new(sketch().build().unwrap().0)
}

fn transmitter() -> DevicePlan {
    DevicePlan::new(NodeId::new(2).unwrap(), Scenario::shipped(Kind::DstP92c, "quiet").unwrap())
}

/// The transmitter and its gateway, past their start.
fn running(table: &Arc<TagTable>) -> World {
    let mut world = World::with(Arc::clone(table), 1);
    world.connect(&transmitter());
    world.start_gateway();
    world.run_for(5_000);
    world.sent.clear();
    world
}

fn tag(table: &TagTable, name: &str) -> TagIndex {
    table.find_tag(NodeIndex(0), name).unwrap()
}

fn write(table: &TagTable, name: &str, value: Value) -> Action {
    Action::WriteTags { writes: vec![(tag(table, name), value)] }
}

#[test]
fn a_written_object_leaves_as_one_download_and_is_shown_when_the_device_tells_it() {
    let table = plant();
    let mut world = running(&table);
    assert_eq!(world.ask(write(&table, "offset", Value::Float(-1.5))), Outcome::Done);
    assert!(world.sent.contains("602#232461010000C0BF"), "{:?}", world.sent);
    world.run_for(1_000);
    let shown = *world.image.tag(tag(&table, "offset"));
    assert_eq!((shown.value, shown.quality.is_usable()), (Value::Float(-1.5), true));
    let journal = world.image.journal.after(0).0;
    let written: Vec<_> = journal.iter().filter(|event| event.name == "write").collect();
    assert_eq!(
        (written.len(), written[0].to.as_str(), written[0].text.as_str()),
        (1, "done", "offset = -1.5")
    );
}

#[test]
fn what_is_out_of_range_or_not_writable_or_not_alone_leaves_no_frame() {
    let table = plant();
    let mut world = running(&table);
    let both = [(tag(&table, "offset"), Value::Float(1.0)), (tag(&table, "offset"), Value::Float(2.0))];
    for action in [
        write(&table, "offset", Value::Float(5.1)),
        write(&table, "offset", Value::Float(f64::NAN)),
        write(&table, "offset", Value::Bool(true)),
        write(&table, "other", Value::Float(1.0)),
        Action::WriteTags { writes: both.to_vec() },
    ] {
        let outcome = world.ask(action.clone());
        assert!(matches!(outcome, Outcome::Rejected(_)), "{action:?}: {outcome:?}");
    }
    assert!(!world.sent.iter().any(|frame| frame.starts_with("602#2")), "{:?}", world.sent);
}

#[test]
fn s10_it_is_read_only_without_the_key_on_a_passive_bus_and_where_no_sdo_is_used() {
    let writing = |sketch: Sketch| {
        let table = sketch.build().unwrap().0;
        table.writing(tag(&table, "offset")).map(|_| ())
    };
    let without =
        OFFSET.replace("writable = true", "writable = false").replace("minimum = -5\nmaximum = 5", "");
    let of = |text: &str| Sketch::new().mapping(SourceText::new("offset", text));
    assert_eq!(writing(sketch()), Ok(()));
    assert_eq!(writing(of(&without).node("press", 2, "offset", |_| ())), Err(ReadOnly::Device));
    assert_eq!(writing(sketch().bus(|bus| bus.role = RoleWord::Passive)), Err(ReadOnly::Passive));
    let silent = of(OFFSET).node("press", 2, "offset", |node| node.configure = Some(false));
    assert_eq!(writing(silent), Err(ReadOnly::Sdo("press".into())));
}

#[test]
fn a_tag_that_a_tpdo_carries_can_be_written_too_though_nothing_else_needs_sdo() {
    let text = "format = 1\ndevice = { vendor = \"x\", model = \"y\" }\n[tpdo.1]\ncob_id = \"$NODEID+0x180\"\ntimeout_ms = 100\n\
                maps = [\"0x2000:1/16\"]\nmapping = \"fixed\"\n[[tag]]\nname = \"speed\"\nobject = \"0x2000:1\"\ntype = \"i16\"\n";
    let table = |text: &str| {
        Sketch::new().mapping(SourceText::new("y", text)).node("y", 2, "y", |_| ()).build().unwrap().0
    };
    let uses_sdo = |table: &TagTable| table.node(NodeIndex(0)).unwrap().canopen().unwrap().sdo.is_some();
    assert!(!uses_sdo(&table(text)));
    let table = table(&format!("{text}writable = true\n"));
    assert!(uses_sdo(&table) && table.writing(tag(&table, "speed")).is_ok());
}

#[test]
fn each_mistake_is_told_with_a_hint() {
    let head = "format = 1\ndevice = { vendor = \"x\", model = \"y\" }\n[tpdo.1]\ncob_id = \"$NODEID+0x180\"\nlength = 2\ntimeout_ms = 100\n\
                [rpdo.1]\ncob_id = \"$NODEID+0x200\"\nlength = 2\n[[tag]]\nname = \"a\"\nrpdo = 1\nbit = 0\ntype = \"u8\"\n[[tag]]\nname = \"t\"\n";
    for (keys, message) in [
        ("tpdo = 1\nbit = 0\ntype = \"u8\"\nwritable = true", "`t` names no object"),
        ("rpdo = 1\nbit = 8\ntype = \"u8\"\nwritable = true", "so `writable` means nothing"),
        ("emergency = \"code\"\ntype = \"u16\"\nwritable = true", "`writable` means nothing"),
        (
            "object = \"0x1017:0\"\ntype = \"u16\"\npoll_ms = 100\nwritable = true",
            "communication of the device",
        ),
        (
            "object = \"0x2000:1\"\ntype = \"u4\"\npoll_ms = 100\nwritable = true",
            "no object is of the type `u4`",
        ),
        (
            "object = \"0x2000:1\"\ntype = \"i16\"\npoll_ms = 100\nunit = \"bar\"\nunit_object = \"0x2001:1\"\nwritable = true",
            "shown otherwise than the device has it",
        ),
        (
            "object = \"0x2000:1\"\ntype = \"u8\"\npoll_ms = 100\nwritable = true\ndefault = 1",
            "`default` means nothing",
        ),
        ("object = \"0x2000:1\"\ntype = \"u8\"\npoll_ms = 100\nmaximum = 1", "`maximum` means nothing"),
        (
            "object = \"0x2000:1\"\ntype = \"u8\"\npoll_ms = 100\nwritable = true\nminimum = 2\nmaximum = 1",
            "no value of `t`",
        ),
        (
            "object = \"0x2000:1\"\ntype = \"bool\"\npoll_ms = 100\nwritable = true\nmaximum = 1",
            "`t` is a bit",
        ),
    ] {
        let problems = check_mapping(&SourceText::new("y.toml", format!("{head}{keys}\n"))).unwrap_err();
        let errors: Vec<String> = problems.iter().map(ToString::to_string).collect();
        assert_eq!(errors.len(), 1, "{keys}: {errors:#?}");
        assert!(errors[0].contains(message) && errors[0].contains("hint: "), "{keys}: {errors:#?}");
    }
}

/// Who may write what, as the configuration says.
fn access(table: &TagTable, file: &std::path::Path) -> Access {
    let entry = AccessEntry {
        role: Role::Operator,
        token_file: Some(At::nowhere(file.display().to_string())),
        modbus: vec![At::nowhere("127.0.0.1".parse().unwrap())],
        write: vec![At::nowhere("press/*".to_owned())],
        ..AccessEntry::default()
    };
    let entries = [(At::nowhere("maria".to_owned()), entry)].into();
    let (access, problems) = Access::build(&SourceText::new("", ""), &entries, table);
    assert_eq!(problems, []);
    access
}

#[test]
fn the_map_shows_which_registers_can_be_written() {
    let table = plant();
    let access = access(&table, "maria.token".as_ref());
    let settings = ModbusSettings::default();
    let writable = cangate::modbus::writing::Writable::of(&access);
    let map = RegisterMap::build_for(&table, &settings, "cangate", writable).unwrap();
    let csv = map_text::render(&map, MapFormat::Csv);
    let row = csv.lines().find(|line| line.contains(",holding") && line.contains(",offset,")).unwrap();
    assert!(row.contains(",true,"), "{row}");
    assert!(!csv.lines().any(|line| line.contains(",true,") && line.contains(",other,")));
}

/// An end of the bus inside the process.
fn bus(name: &str, clock: Clock, stop: &CancellationToken) -> BusEnd {
    let (events_to, events) = mpsc::channel(1024);
    let (transmit, frames) = mpsc::channel(64);
    let interface = Interface::Virtual(name.to_owned());
    tokio::spawn(can::task::run(
        BusIndex(0),
        interface,
        can::task::Sending::Untold,
        events_to,
        frames,
        clock,
        stop.clone(),
    ));
    BusEnd { events, transmit }
}

#[tokio::test]
async fn a_request_by_http_writes_the_object_of_the_device_and_the_value_comes_back() {
    let (table, clock, stop) = (plant(), Clock::start(), CancellationToken::new());
    let _stops = stop.clone().drop_guard();
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("maria.token");
    std::fs::write(&file, TOKEN).unwrap();
    let name = "object-writes";
    let (lines, report) = (mpsc::channel(1).1, mpsc::channel(1).0);
    let device = bus(name, clock, &stop);
    tokio::spawn(simulator::task::run(vec![transmitter()], device, lines, report, clock, stop.clone()));
    let mut listener = bus(name, clock, &stop);
    let gateway = Gateway::new(Arc::clone(&table), clock.now());
    let (writer, reader) = process_image(gateway.empty_image());
    let (desk, commands) = Desk::new(32);
    desk.set_access(Arc::new(access(&table, &file)));
    let requests = gateway::command::desk::Requests::new(&desk, commands);
    let BusEnd { events, transmit } = bus(name, clock, &stop);
    let health = watch::channel(Health::default()).1;
    let transmit = vec![transmit];
    tokio::spawn(gateway::task::run(
        gateway,
        writer,
        events,
        transmit,
        requests,
        health,
        mpsc::channel(1).1,
        clock,
        stop.clone(),
    ));
    let state = state_of(Arc::clone(&table), reader.clone(), desk, clock);
    let settings = WebSettings { listen: "127.0.0.1:0".parse().unwrap(), ..WebSettings::default() };
    let server = Server::bind(&settings, state).await.unwrap();
    let address = server.local_addr();
    tokio::spawn(server.run(stop.clone()));
    let offset = tag(&table, "offset");
    let shown = async || {
        tokio::time::sleep(Duration::from_millis(10)).await;
        reader.read(|image| {
            (image.nodes[0].online && image.tag(offset).quality.is_usable()).then(|| image.tag(offset).value)
        })
    };
    assert_eq!(until("the device tells its offset", shown).await, Value::Float(0.0));
    let body = r#"{"node":"press","tag":"offset","value":-1.5}"#;
    let headers = format!("Content-Type: application/json\r\nAuthorization: Bearer {TOKEN}\r\n");
    // While the node boots it is busy: what it shows already came from the boot.
    let answer = until("the node takes it", async || {
        let stream = TcpStream::connect(address).await.unwrap();
        let answer = converse(stream, "POST /api/v1/commands/write", &headers, body).await;
        (answer.body != r#"{"result":"busy","message":"too much waits; try again"}"#).then_some(answer)
    })
    .await;
    assert_eq!((answer.code, answer.body.as_str()), (200, r#"{"result":"ok","message":""}"#));
    let mut downloads = Vec::new();
    while let Ok((_, event)) = listener.events.try_recv() {
        match event {
            BusEvent::Frame { frame, .. } if frame.to_string().starts_with("602#23") => {
                downloads.push(frame.to_string());
            }
            _ => {}
        }
    }
    assert_eq!(downloads, ["602#232461010000C0BF"]);
    until("it comes back", async || (shown().await == Some(Value::Float(-1.5))).then_some(())).await;
}
