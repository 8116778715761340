//! The transmit allow-list: what may be sent on CAN, and that nothing else can leave.

use std::collections::BTreeSet;
use std::process::Command as Process;
use std::sync::Arc;

use cangate::can::{BusEvent, BusIndex, CanFrame, CanId, Link};
use cangate::canopen::NmtRequest;
use cangate::gateway::allowed_frames::AllowedFrames;
use cangate::gateway::command::ObjectId;
use cangate::gateway::{Action, Command, CommandSource, Gateway, Health, Input, Output};
use cangate::mapping::{SourceText, TagTable};
use cangate::process_image::{FrameKind, LineIndex, NodeIndex, TagIndex, Value};
use cangate::time::Now;
use proptest::prelude::*;

/// A guarded node 1 with outputs, a transmitter 2 with SDO, a module 0x1A with one line, and everything that a bus may send.
pub const EVERYTHING: &str = r#"
version = 1
[gateway]
name = "hall"
[bus.can0]
interface = "can0"
bit_rate = 1000000
start_broadcast = true
sync = { period_ms = 100, counter = 10 }
time = { period_s = 60, unsynchronised = true }
own_node_id = 120
own_heartbeat_ms = 1000
[bus.can0.esd]
reply_id = 0x6E0
[bus.can1]
interface = "can1"
role = "passive"
[node.drive]
bus = "can0"
id = 1
mapping = "./drive.toml"
outputs = true
[node.press]
bus = "can0"
id = 2
mapping = "danfoss-dst-p92c"
[node.scales]
bus = "can0"
id = 0x1A
mapping = "esd-can-cbm-sio1"
watchdog_id = 0x512
save_after_config = true
[node.scales.channel.1]
baud = 9600
max_char = 8
inhibit_ms = 8
[node.quiet]
unit_id = 9
bus = "can1"
id = 1
mapping = "motortech-detcon"
"#;

pub const DRIVE: &str = r#"
format = 1
device = { vendor = "test", model = "drive" }
[tpdo.1]
cob_id = "$NODEID+0x180"
length = 1
timeout_ms = 1500
[rpdo.1]
cob_id = "$NODEID+0x200"
length = 3
refresh_ms = 400
[[tag]]
name = "level"
tpdo = 1
bit = 0
type = "u8"
[[tag]]
name = "setpoint"
rpdo = 1
bit = 0
type = "i16"
default = 20
minimum = -50
maximum = 150
[[tag]]
name = "mode"
rpdo = 1
bit = 16
type = "u8"
default = 1
"#;

const BUS: BusIndex = BusIndex(0);
const PASSIVE: BusIndex = BusIndex(1);

pub fn table_of(text: &str) -> Arc<TagTable> {
    let source = SourceText::new("etc/cangate.toml", text);
    let loaded = cangate::config::load(&source, [], &mut |path| match path {
        "etc/./drive.toml" => Ok(DRIVE.to_owned()),
        _ => Err(std::io::ErrorKind::NotFound.into()),
    });
    Arc::new(loaded.unwrap_or_else(|problems| panic!("{problems:#?}")).table)
}

fn table() -> Arc<TagTable> {
    table_of(EVERYTHING)
}

/// The identifiers on which the configuration above lets anything leave, worked out by hand.
const IDS: [u16; 9] = [0x000, 0x080, 0x100, 0x201, 0x602, 0x700, 0x701, 0x778, 0x512];

/// The line of the module: `RxId` of a SIO1 with coding switch 0x1A.
const LINE: u16 = 0x1A * 10 + 1;

fn is_allowed(frame: &CanFrame) -> bool {
    let CanId::Standard(id) = frame.id() else { return false };
    match (id, frame.is_remote(), frame.data()) {
        (0x000, false, [0x01, 0]) | (0x778, false, [0x05]) => true,
        (0x000, false, [code, node]) => {
            [0x01, 0x02, 0x80, 0x81, 0x82].contains(code) && [1, 2].contains(node)
        }
        (0x080, false, [count]) => (1..=10).contains(count),
        (0x100, false, data) => data.len() == 6,
        (0x201, false, data) => data.len() == 3,
        (0x602, false, data) => data.len() == 8,
        (0x701 | 0x512, true, _) => frame.dlc() == 1,
        (LINE, false, data) => !data.is_empty(),
        // Questions to the module, answered on 0x6E0.
        (0x700, false, [question, which, 0, 0x1A, 0x06, 0xE0]) => match question {
            0x00 => matches!(which, 0x00..=0x03 | 0x05),
            0x01 => *which <= 0x05,
            0x02..=0x04 => true,
            0x06 => *which <= 0x7F,
            _ => false,
        },
        _ => false,
    }
}

/// What is set in the module: the identifiers and parameters of its one line, its watchdog, and its status is cleared.
fn is_setting(frame: &CanFrame) -> bool {
    let (rx, tx) = (LINE.to_be_bytes(), (LINE - 1).to_be_bytes());
    frame.id() == CanId::Standard(0x700)
        && match *frame.data() {
            [0x81, sub, third, 0x1A, high, low] => [
                [0x00, 0, 0x1A, 0],
                [0x02, 0, 0, 0],
                [0x04, 0, 0x05, 0x12],
                [0x05, 3, 0x03, 0xE8],
                [0x05, 0, 0, 0],
            ]
            .contains(&[sub, third, high, low]),
            [0x82, 0, 0, 0x1A, high, low] => [high, low] == tx,
            [0x83, 0, 0, 0x1A, high, low] => [high, low] == rx,
            // Values are those of the plan; which, the tests of the procedure tell.
            [0x86, parameter, 0, 0x1A, ..] => parameter <= 0x7F,
            _ => false,
        }
}

#[track_caller]
fn check(allowed: &AllowedFrames, frame: &CanFrame) {
    let permitted = allowed.permit(BUS, frame);
    if permitted == Some(FrameKind::EsdSetting) {
        assert!(is_setting(frame), "{frame}");
    } else {
        assert_eq!(permitted.is_some(), is_allowed(frame), "{frame} as {permitted:?}");
    }
    assert_eq!(allowed.permit(PASSIVE, frame), None, "{frame}");
    assert_eq!(allowed.permit(BusIndex(2), frame), None, "{frame}");
}

#[test]
fn every_identifier_with_every_length_passes_only_where_it_is_listed() {
    let allowed = AllowedFrames::new(&table());
    let mut passing = BTreeSet::new();
    for id in 0..=0x7FF_u16 {
        for long in [CanId::Standard(id), CanId::Extended(id.into())] {
            for length in 0..=8_u8 {
                check(&allowed, &CanFrame::remote_frame(long, length).unwrap());
                for byte in [0x00, 0x01, 0x05, 0x40, 0x80, 0xFF] {
                    let frame = CanFrame::data_frame(long, &vec![byte; length.into()]).unwrap();
                    check(&allowed, &frame);
                    passing.extend(allowed.permit(BUS, &frame).map(|_| id));
                }
            }
        }
    }
    let listed: BTreeSet<CanId> = allowed.list().iter().map(|frame| frame.id).collect();
    let by_hand: BTreeSet<CanId> = IDS.into_iter().chain([LINE]).map(CanId::Standard).collect();
    assert_eq!(listed, by_hand);
    assert!(passing.contains(&0x602) && passing.contains(&LINE));
}

#[test]
fn every_nmt_command_and_every_command_to_a_module_is_looked_at() {
    let allowed = AllowedFrames::new(&table());
    for code in 0..=255 {
        for node in 0..=255 {
            check(&allowed, &CanFrame::data_frame(CanId::Standard(0), &[code, node]).unwrap());
            for [third, number, high, low] in [
                [0, 0x1A, 0x06, 0xE0],
                [0, 0x1A, 0xAA, 0xAA],
                [0, 0x00, 0xAA, 0xAA],
                [0, 0x1B, 0x06, 0xE0],
                [3, 0x1A, 0x03, 0xE8],
                [0, 0x1A, 0x1A, 0x00],
            ] {
                let data = [code, node, third, number, high, low];
                check(&allowed, &CanFrame::data_frame(CanId::Standard(0x700), &data).unwrap());
            }
        }
    }
}

#[test]
fn r_esd_099_of_a_serial_mode_the_bits_that_are_asked_for_are_fixed_and_the_others_as_they_were_found() {
    let allowed = AllowedFrames::new(&table());
    let permitted = |text: &str| allowed.permit(BUS, &text.parse().unwrap()).is_some();
    // 9600 bit/s both ways is all that the configuration asks for.
    for value in 0..=u16::MAX {
        assert_eq!(permitted(&format!("700#8602001A{value:04X}")), value >> 8 == 0x22, "{value:04X}");
    }
    for other in
        ["700#8602001A22", "700#8602001A227300", "700#8601001A2273", "701#8602001A2273", "700#8602001B2273"]
    {
        assert!(!permitted(other), "{other}");
    }
}

#[test]
fn r_dst_124_in_the_passive_role_the_list_is_empty() {
    let passive = EVERYTHING.replace("bit_rate = 1000000", "role = \"passive\"");
    let allowed = AllowedFrames::new(&table_of(&passive));
    assert_eq!(allowed.list(), []);
}

#[test]
fn every_kind_is_in_the_list_and_says_why_and_how_often() {
    let allowed = AllowedFrames::new(&table());
    let kinds: BTreeSet<FrameKind> = allowed.list().iter().map(|frame| frame.kind).collect();
    assert_eq!(kinds, FrameKind::ALL.into_iter().collect());
    assert!(allowed.list().iter().all(|frame| !frame.why.is_empty() && !frame.at_most.is_empty()));
    let started_by_hand = EVERYTHING.replace("outputs = true", "outputs = true\nauto_start = false");
    let allowed = AllowedFrames::new(&table_of(&started_by_hand));
    let start: CanFrame = "000#0101".parse().unwrap();
    let listed = allowed.list().iter().find(|frame| frame.shape.to_string() == "0101").unwrap();
    assert_eq!(
        (listed.why.as_str(), allowed.permit(BUS, &start)),
        ("by a command", Some(FrameKind::NmtStart))
    );
}

/// One random step of two buses, an operator, or time.
#[derive(Clone, Debug)]
pub enum Step {
    Frame(usize, CanFrame),
    Link(usize, Link),
    NotSent(CanFrame),
    Command(Action),
    Clock(bool),
    Pass(u64),
}

fn frame() -> impl Strategy<Value = CanFrame> {
    let near = prop_oneof![
        Just(0x000_u16),
        prop::sample::select(vec![
            0x081, 0x082, 0x181, 0x182, 0x582, 0x602, 0x6E0, 0x701, 0x702, 0x512, 0x104, 0x080
        ]),
        0_u16..0x800,
    ];
    let data =
        prop::collection::vec(prop_oneof![any::<u8>(), Just(0), Just(5), Just(0x7F), Just(0x60)], 0..=8);
    prop_oneof![
        9 => (near.clone(), data).prop_map(|(id, data)| CanFrame::data_frame(CanId::Standard(id), &data).unwrap()),
        1 => (near, 0_u8..=8).prop_map(|(id, dlc)| CanFrame::remote_frame(CanId::Standard(id), dlc).unwrap()),
    ]
}

fn action() -> impl Strategy<Value = Action> {
    let request = prop::sample::select(vec![
        NmtRequest::Start,
        NmtRequest::Stop,
        NmtRequest::EnterPreOperational,
        NmtRequest::ResetNode,
        NmtRequest::ResetCommunication,
    ]);
    let node = || (0_usize..5).prop_map(NodeIndex);
    let object = || (any::<u16>(), any::<u8>()).prop_map(|(index, sub)| ObjectId { index, sub });
    let bytes = || prop::collection::vec(any::<u8>(), 0..40);
    prop_oneof![
        (node(), request).prop_map(|(node, request)| Action::Nmt { node, request }),
        (0_usize..60, -100_i64..200).prop_map(|(tag, value)| Action::WriteTags {
            writes: vec![(TagIndex(tag), Value::Signed(value))]
        }),
        (node(), object()).prop_map(|(node, object)| Action::SdoRead {
            node,
            object,
            len: None,
            timeout: None
        }),
        (node(), object(), bytes()).prop_map(|(node, object, data)| Action::SdoWrite {
            node,
            object,
            data,
            timeout: None
        }),
        (0_usize..2, bytes()).prop_map(|(line, bytes)| Action::SerialSend { line: LineIndex(line), bytes }),
    ]
}

pub fn step() -> impl Strategy<Value = Step> {
    let link = prop::sample::select(vec![Link::Down, Link::ErrorActive, Link::ErrorActive, Link::BusOff]);
    prop_oneof![
        30 => (0_usize..2, frame()).prop_map(|(bus, frame)| Step::Frame(bus, frame)),
        2 => (0_usize..2, link).prop_map(|(bus, link)| Step::Link(bus, link)),
        2 => frame().prop_map(Step::NotSent),
        6 => action().prop_map(Step::Command),
        1 => any::<bool>().prop_map(Step::Clock),
        20 => (0_u64..700).prop_map(Step::Pass),
    ]
}

/// Takes what the gateway has to send; each frame is in the list that was made by itself.
fn drain(gateway: &mut Gateway, allowed: &AllowedFrames, now: Now) -> usize {
    let mut sent = 0;
    while let Some(output) = gateway.poll_output() {
        if let Output::Transmit { bus, frame } = output {
            assert!(allowed.permit(bus, &frame).is_some(), "{frame} on {bus:?}");
            gateway.handle_input(now, Input::Bus { bus, event: BusEvent::Sent { frame, at: now } });
            sent += 1;
        }
    }
    sent
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 64, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn whatever_comes_the_core_makes_no_frame_that_is_not_in_the_list(
        steps in prop::collection::vec(step(), 1..150)
    ) {
        let table = table();
        let allowed = AllowedFrames::new(&table);
        let mut millis = 0;
        let mut gateway = Gateway::new(Arc::clone(&table), Now::from_millis(0));
        let mut image = gateway.empty_image();
        for bus in [BUS, PASSIVE] {
            let event = BusEvent::Link { link: Link::ErrorActive, at: Now::from_millis(0) };
            gateway.handle_input(Now::from_millis(0), Input::Bus { bus, event });
        }
        let mut sent = drain(&mut gateway, &allowed, Now::from_millis(millis));
        for (id, step) in (0..).zip(steps) {
            let at = Now::from_millis(millis);
            match step {
                Step::Frame(bus, frame) => {
                    gateway.handle_input(at, Input::Bus { bus: BusIndex(bus), event: BusEvent::Frame { frame, at } });
                }
                Step::Link(bus, link) => {
                    gateway.handle_input(at, Input::Bus { bus: BusIndex(bus), event: BusEvent::Link { link, at } });
                }
                Step::NotSent(frame) => {
                    gateway.handle_input(at, Input::Bus { bus: BUS, event: BusEvent::NotSent { frame, at } });
                }
                Step::Command(action) => {
                    let command = Command { id, source: CommandSource::web("test".into()), action };
                    gateway.handle_input(at, Input::Command(command));
                }
                Step::Clock(clock_synchronised) => {
                    gateway.handle_input(at, Input::Health(Health { clock_synchronised, ..Health::default() }));
                }
                Step::Pass(time) => {
                    let end = millis + time;
                    while let Some((due, _)) = gateway.poll_timeout()
                        && due.as_millis() < end
                    {
                        millis = (due.as_micros().div_ceil(1_000)).max(millis);
                        gateway.handle_timeout(Now::from_millis(millis));
                        sent += drain(&mut gateway, &allowed, Now::from_millis(millis));
                    }
                    millis = end;
                }
            }
            sent += drain(&mut gateway, &allowed, Now::from_millis(millis));
        }
        gateway.handle_stop(Now::from_millis(millis));
        sent += drain(&mut gateway, &allowed, Now::from_millis(millis));
        gateway.publish(&mut image);
        // Told with the next counters of a bus.
        let at = Now::from_millis(millis);
        for bus in [BUS, PASSIVE] {
            let event = BusEvent::Counters { counters: cangate::can::BusCounters::default(), at };
            gateway.handle_input(at, Input::Bus { bus, event });
        }
        gateway.publish(&mut image);
        let counted = FrameKind::ALL.map(|kind| image.buses[0].sent.of(kind)).iter().sum::<u64>();
        prop_assert_eq!(counted, u64::try_from(sent).unwrap(), "each is counted");
        prop_assert!(image.buses.iter().all(|bus| bus.frames_blocked == 0));
        prop_assert!(FrameKind::ALL.iter().all(|kind| image.buses[1].sent.of(*kind) == 0), "passive");
    }
}

#[test]
fn the_command_lists_the_same_frames_as_table_csv_and_json() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("cangate.toml");
    std::fs::write(&file, EVERYTHING).unwrap();
    std::fs::write(folder.path().join("drive.toml"), DRIVE).unwrap();
    let run = |format: &str| {
        let mut process = Process::new(env!("CARGO_BIN_EXE_cangate"));
        let output = process.args(["map", "--frames", "--format", format, "-c"]).arg(&file).output().unwrap();
        (output.status.code(), String::from_utf8(output.stdout).unwrap())
    };
    let rows = AllowedFrames::new(&table()).list().len();
    let (code, json) = run("json");
    assert_eq!(code, Some(0), "{json}");
    let list: serde_json::Value = serde_json::from_str(&json).unwrap();
    assert_eq!(list["frames"].as_array().unwrap().len(), rows);
    let guard = list["frames"].as_array().unwrap().iter().find(|row| row["kind"] == "guard_request").unwrap();
    assert_eq!(
        (&guard["bus"], &guard["id"], &guard["node"]),
        (&"can0".into(), &"701".into(), &"drive".into())
    );
    assert_eq!(
        (&guard["data"], &guard["at_most"]),
        (&"R1".into(), &"every 500 ms, and after a boot-up".into())
    );
    for format in ["table", "csv"] {
        let (code, text) = run(format);
        assert_eq!((code, text.lines().count()), (Some(0), rows + 1), "{text}");
    }
    assert_eq!(run("st").0, Some(64));
}
