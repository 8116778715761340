//! What the gateway sends beside NMT commands and guard requests: RPDOs, and a transmitter that is read by SYNC.

use std::sync::Arc;
use std::time::Duration;

use cangate::can::{BusEvent, Link};
use cangate::canopen::{NmtState, NodeId};
use cangate::gateway::{Action, Command, CommandSource, Input, Outcome, Output};
use cangate::mapping::installation::{BusEntry, NodeEntry, ProducerWord, RoleWord, SyncEntry, TpdoEntry};
use cangate::mapping::{At, Diagnostic, Severity, Sketch, SourceText, TagTable, check_mapping};
use cangate::modbus::map_text::render;
use cangate::modbus::{MapFormat, ModbusSettings, RegisterMap};
use cangate::process_image::{Quality, Reason, TagIndex, Value};
use cangate::simulator::{DevicePlan, Kind, Scenario};
use cangate::time::Now;

use super::support::conversation::Conversation;
use super::support::world::World;

/// A guarded device with one TPDO, and one RPDO of four bytes: a set point, an enable bit, a mode.
const DRIVE: &str = r#"
format = 1
device = { vendor = "test", model = "drive" }

[tpdo.1]
cob_id = "$NODEID+0x180"
length = 1
timeout_ms = 1500

[rpdo.1]
cob_id = "$NODEID+0x200"
length = 4
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
scale = { multiply = 0.1 }
default = 20
minimum = -50
maximum = 150
unit = "°C"
registers = [{ address = 100, type = "i16", resolution = 0.1 }]

[[tag]]
name = "enable"
rpdo = 1
bit = 16
type = "bool"
default = false
bit_address = 0

[[tag]]
name = "mode"
rpdo = 1
bit = 24
type = "u8"
default = 1
"#;

fn sketch(mapping: &str, change: impl Fn(&mut BusEntry, &mut NodeEntry)) -> Sketch {
    let mut bus = BusEntry::virtual_bus("can0");
    let sketch = Sketch::new().mapping(SourceText::new("drive", mapping));
    let sketch = sketch.node("drive1", 1, "drive", |node| change(&mut bus, node));
    sketch.bus(|entry| *entry = bus)
}

/// The drive with outputs enabled, operational from 1 ms on.
fn drive_with(mapping: &str) -> Conversation {
    let mut conversation =
        Conversation::new(sketch(mapping, |_, node| node.outputs = At::nowhere(true)).build().unwrap().0);
    conversation.answer_guarding(1, 5);
    conversation
}

/// The frames of the RPDO so far.
fn rpdos(conversation: &Conversation) -> Vec<String> {
    let frames = conversation.all_sent.iter().map(ToString::to_string);
    frames.filter(|frame| frame.starts_with("201#")).collect()
}

fn write(conversation: &mut Conversation, tag: &str, value: Value) -> Outcome {
    let tag = conversation.tag_index(tag);
    conversation.command(Action::WriteTags { writes: vec![(tag, value)] })
}

#[test]
fn nothing_is_sent_unless_the_configuration_allows_it() {
    let mut conversation = Conversation::new(sketch(DRIVE, |_, _| ()).build().unwrap().0);
    conversation.answer_guarding(1, 5);
    conversation.send_cyclically("181#05", 500);
    conversation.run_to(10_000);
    assert_eq!(rpdos(&conversation), Vec::<String>::new());
    let Outcome::Rejected(why) = write(&mut conversation, "mode", Value::Unsigned(3)) else { panic!() };
    assert!(why.contains("[node.drive1] outputs = true"), "{why}");
    assert_eq!(conversation.tag("setpoint").quality, Quality::Bad(Reason::NotSent));
    assert!(conversation.node().data_good, "what is sent is not the device's data");
}

#[test]
fn r_dst_124_nothing_is_sent_in_the_passive_role() {
    let passive = |bus: &mut BusEntry, node: &mut NodeEntry| {
        bus.role = RoleWord::Passive;
        bus.sync = Some(At::nowhere(SyncEntry { period_ms: Some(At::nowhere(100)), ..SyncEntry::default() }));
        bus.time = Some(At::nowhere(cangate::mapping::installation::TimeEntry {
            period_s: At::nowhere(1),
            unsynchronised: true,
            ..Default::default()
        }));
        node.outputs = At::nowhere(true);
    };
    let (table, warnings) = sketch(DRIVE, passive).build().unwrap();
    let told: Vec<String> = warnings.iter().map(|warning| warning.message.clone()).collect();
    for part in ["sends no SYNC", "sends no TIME", "`outputs = true` means nothing here"] {
        assert!(told.iter().any(|line| line.contains(part)), "{part}: {told:?}");
    }
    let mut conversation = Conversation::new(table);
    for (millis, frame) in [(10, "701#00"), (20, "000#0101"), (30, "701#05"), (40, "181#05"), (50, "080#")] {
        conversation.run_to(millis);
        conversation.frame(frame);
    }
    let refused = write(&mut conversation, "mode", Value::Unsigned(3));
    assert!(matches!(refused, Outcome::Rejected(_)), "{refused:?}");
    conversation.run_to(60_000);
    assert_eq!(conversation.all_sent, []);
    assert_eq!(conversation.tag("level").value, Value::Unsigned(5), "and it listens all the same");
}

#[test]
fn defaults_are_sent_and_refreshed_and_a_write_at_once() {
    let mut conversation = drive_with(DRIVE);
    conversation.run_to(900);
    assert_eq!(rpdos(&conversation), ["201#C8000001", "201#C8000001", "201#C8000001"]);
    assert_eq!(conversation.tag_text("setpoint"), "20.00 good");
    assert_eq!(write(&mut conversation, "setpoint", Value::Float(-21.54)), Outcome::Done);
    assert_eq!(rpdos(&conversation).last().unwrap(), "201#29FF0001");
    assert_eq!(conversation.tag_text("setpoint"), "-21.50 good", "what was sent, not what was asked for");
    conversation.run_to(950);
    assert_eq!(write(&mut conversation, "enable", Value::Bool(true)), Outcome::Done);
    assert_eq!(rpdos(&conversation).last().unwrap(), "201#29FF0101");
    let writes = conversation.events_named("write");
    assert_eq!(writes.len(), 2, "each is journalled, with who asked");
    assert_eq!((writes[1].to.as_str(), writes[1].text.as_str()), ("done", "enable = true"));
}

#[test]
fn a_write_is_checked_whole_before_anything_is_sent() {
    let mut conversation = drive_with(DRIVE);
    conversation.run_to(100);
    let before = rpdos(&conversation);
    for (tag, value, part) in [
        ("setpoint", Value::Float(150.1), "not between -50 and 150"),
        ("setpoint", Value::Float(f64::NAN), "NaN"),
        ("setpoint", Value::Bool(true), "write a number"),
        ("mode", Value::Unsigned(256), "out of the range"),
        ("mode", Value::Signed(-1), "out of the range"),
        ("enable", Value::Unsigned(2), "write true or false"),
        ("level", Value::Unsigned(2), "comes from the device"),
    ] {
        let Outcome::Rejected(why) = write(&mut conversation, tag, value) else { panic!("{tag} = {value}") };
        assert!(why.contains(part), "{tag} = {value}: {why}");
    }
    let unknown = Action::WriteTags { writes: vec![(TagIndex(9_999), Value::Unsigned(1))] };
    assert_eq!(conversation.command(unknown), Outcome::Unknown);
    assert_eq!(rpdos(&conversation), before);
}

#[test]
fn a_write_that_the_bus_does_not_take_is_busy_and_as_if_it_had_not_been_asked_for() {
    let mut conversation = drive_with(DRIVE);
    conversation.run_to(100);
    let now = Now::from_millis(100);
    let action = Action::WriteTags { writes: vec![(conversation.tag_index("mode"), Value::Unsigned(9))] };
    let command = Command { id: 7, source: CommandSource::mqtt("test".into()), action };
    conversation.gateway.handle_input(now, Input::Command(command));
    let mut outcome = None;
    while let Some(output) = conversation.gateway.poll_output() {
        match output {
            Output::Transmit { bus, frame } => conversation.gateway.handle_refused(now, bus, &frame),
            Output::Reply { outcome: reply, .. } => outcome = Some(reply),
        }
    }
    assert_eq!(outcome, Some(Outcome::Busy));
    let before = rpdos(&conversation).len();
    conversation.run_to(1_000);
    let after = rpdos(&conversation).split_off(before);
    assert!(!after.is_empty() && after.iter().all(|frame| frame == "201#C8000001"), "{after:?}");
    assert_eq!(conversation.tag_text("mode"), "1 good");
}

#[test]
fn outputs_stop_with_the_node_and_begin_again_with_the_defaults_or_the_last_values() {
    let keeps = DRIVE.replace("refresh_ms = 400", "refresh_ms = 400\non_start = \"last\"");
    for (mapping, expected) in [(DRIVE, "201#C8000001"), (keeps.as_str(), "201#C8000009")] {
        let mut conversation = drive_with(mapping);
        conversation.run_to(100);
        assert_eq!(write(&mut conversation, "mode", Value::Unsigned(9)), Outcome::Done);
        conversation.stop_answering(1);
        conversation.run_to(3_000);
        assert_eq!(conversation.tag("mode").quality, Quality::Bad(Reason::NodeLost));
        assert_eq!(write(&mut conversation, "mode", Value::Unsigned(5)), Outcome::NodeUnavailable);
        let sent = rpdos(&conversation).len();
        conversation.run_to(6_000);
        assert_eq!(rpdos(&conversation).len(), sent, "nothing goes to a lost node");
        conversation.answer_guarding(1, 5);
        conversation.run_to(6_600);
        assert_eq!(rpdos(&conversation)[sent], expected);
        assert!(conversation.tag("mode").quality.is_good());
    }
}

#[test]
fn what_a_node_is_sent_is_not_doubtful_because_another_has_its_id() {
    let mut conversation = drive_with(&DRIVE.replace("refresh_ms = 400\n", ""));
    conversation.send_cyclically("181#05", 500);
    conversation.run_to(1_000);
    conversation.frame("081#5081010000000000");
    for millis in [1_000, 60_000] {
        conversation.run_to(millis);
        assert_eq!(conversation.tag("setpoint").quality, Quality::Good, "{millis}");
    }
    assert_eq!(conversation.events_named("duplicate_node_cleared").len(), 1);
    conversation.frame("081#5081010000000000");
    assert_eq!(
        conversation.tag("level").quality,
        Quality::Uncertain(Reason::DuplicateNode),
        "it may be either's"
    );
}

#[test]
fn an_rpdo_without_all_its_values_waits_for_them() {
    let mapping = DRIVE.replace("default = 20\n", "");
    let mut conversation = drive_with(&mapping);
    conversation.run_to(1_000);
    assert_eq!(write(&mut conversation, "mode", Value::Unsigned(2)), Outcome::Done);
    conversation.run_to(2_000);
    assert_eq!(rpdos(&conversation), Vec::<String>::new());
    assert_eq!(write(&mut conversation, "setpoint", Value::Signed(0)), Outcome::Done);
    assert_eq!(rpdos(&conversation), ["201#00000002"]);
}

#[test]
fn nothing_is_sent_over_a_bus_that_is_down() {
    let mut conversation = drive_with(DRIVE);
    conversation.run_to(100);
    conversation.link(Link::Down);
    let sent = rpdos(&conversation).len();
    assert_eq!(write(&mut conversation, "mode", Value::Unsigned(5)), Outcome::NodeUnavailable);
    conversation.run_to(5_000);
    assert_eq!(rpdos(&conversation).len(), sent);
    assert_eq!(conversation.tag("mode").quality, Quality::Bad(Reason::BusUnavailable));
    conversation.link(Link::ErrorActive);
    conversation.run_to(5_600);
    assert!(rpdos(&conversation).len() > sent);
}

#[test]
fn written_tags_stand_in_the_register_map_and_say_where_they_go() {
    let table = sketch(DRIVE, |_, _| ()).build().unwrap().0;
    let map = RegisterMap::build(&table, &ModbusSettings::default(), "cangate").unwrap();
    let text = render(&map, MapFormat::Json);
    let line = text.lines().find(|line| line.contains("\"setpoint\"")).unwrap();
    for part in ["\"address\":100", "\"source\":\"RPDO1 bytes 0-1\"", "\"writable\":false"] {
        assert!(line.contains(part), "{line}");
    }
}

fn told(result: Result<(TagTable, Vec<Diagnostic>), Vec<Diagnostic>>) -> Vec<String> {
    let problems = match result {
        Ok((_, warnings)) => warnings,
        Err(problems) => problems,
    };
    problems.iter().map(ToString::to_string).collect()
}

#[test]
fn mistakes_about_rpdos_are_told_with_the_way_out() {
    for (right, wrong, message) in [
        ("cob_id = \"$NODEID+0x200\"", "cob_id = 0x701", "RPDO 1 of node `drive1` has identifier 701"),
        ("length = 4\n", "", "the length of RPDO 1 is not known"),
        ("length = 4", "length = 3", "`mode` takes bits 24 to 31, but RPDO 1 has only 24"),
        ("refresh_ms = 400", "refresh_ms = 5", "refresh_ms 5 is out of range"),
        ("refresh_ms = 400", "transmission_type = 252", "cannot be sent with transmission type 252"),
        (
            "refresh_ms = 400",
            "refresh_ms = 400\ntransmission_type = 1",
            "refresh_ms means nothing for an RPDO that follows SYNC",
        ),
        (
            "refresh_ms = 400",
            "inhibit_ms = 20\ntransmission_type = 1",
            "inhibit_ms means nothing for an RPDO that follows SYNC",
        ),
        ("refresh_ms = 400", "transmission_type = 1", "RPDO 1 waits for SYNC (transmission type 1)"),
        ("rpdo = 1\nbit = 16", "rpdo = 2\nbit = 16", "there is no RPDO `2`"),
        ("rpdo = 1\nbit = 16", "rpdo = 1\nbit = 8", "`setpoint` and `enable` are written to the same bits"),
        ("rpdo = 1\nbit = 16", "rpdo = 1", "`enable` needs either `rpdo` and `bit`"),
        (
            "rpdo = 1\nbit = 16",
            "rpdo = 1\ntpdo = 1\nbit = 16",
            "`enable` is sent in an RPDO, so `tpdo` means",
        ),
        ("default = 1\n", "default = 256\n", "the default 256 cannot be written to `mode`"),
        ("default = 20\n", "default = 151\n", "the default 151 cannot be written to `setpoint`"),
        ("default = false", "default = 2", "the default 2 cannot be written to `enable`"),
        ("minimum = -50", "minimum = 200", "no value of `setpoint` lies between 200 and 150"),
        (
            "bit = 0\ntype = \"u8\"",
            "bit = 0\ntype = \"u8\"\ndefault = 1",
            "`default` means nothing for a tag that the",
        ),
    ] {
        let text = DRIVE.replacen(right, wrong, 1);
        assert_ne!(text, DRIVE, "{right}");
        let told = told(sketch(&text, |_, node| node.outputs = At::nowhere(true)).build());
        assert!(
            told.iter().any(|line| line.contains(message) && line.contains("hint: ")),
            "{wrong}: {told:#?}"
        );
    }
    assert_eq!(check_mapping(&SourceText::new("drive", DRIVE)), Ok(Vec::new()));
}

/// A bus with SYNC every 100 ms, sent by the gateway or by somebody else.
fn synchronised(bus: &mut BusEntry, producer: ProducerWord) {
    let sync = SyncEntry { producer, period_ms: Some(At::nowhere(100)), ..SyncEntry::default() };
    bus.sync = Some(At::nowhere(sync));
}

/// A transmitter at node 1 that is to be read by SYNC.
fn by_sync(producer: Option<ProducerWord>) -> Result<(TagTable, Vec<Diagnostic>), Vec<Diagnostic>> {
    let sketch = Sketch::new().bus(|bus| {
        if let Some(producer) = producer {
            synchronised(bus, producer);
        }
    });
    let by_sync = TpdoEntry { transmission_type: Some(At::nowhere(1)), ..TpdoEntry::default() };
    let change = |node: &mut NodeEntry| {
        node.tpdo.insert(At::nowhere("1".into()), by_sync.clone());
    };
    sketch.node("node001", 1, "danfoss-dst-p92c", change).build()
}

#[test]
fn r_dst_050_the_timeout_of_a_synchronous_tpdo_is_three_of_its_cycles() {
    let timeout =
        |result: Result<(TagTable, Vec<Diagnostic>), _>| result.unwrap().0.nodes[0].pdos()[0].timeout;
    assert_eq!(timeout(by_sync(Some(ProducerWord::Gateway))), Some(Duration::from_millis(300)));
    assert_eq!(timeout(by_sync(Some(ProducerWord::Other))), Some(Duration::from_millis(300)));
    let usual = Sketch::new().node("node001", 1, "danfoss-dst-p92c", |_| ()).build();
    assert_eq!(
        timeout(usual),
        Some(Duration::from_secs(3)),
        "R-DST-044: by its event timer unless asked for"
    );
}

#[test]
fn a_synchronous_tpdo_on_a_bus_without_sync_is_told() {
    let told = told(by_sync(None));
    let line = told.iter().find(|line| line.contains("TPDO 1 waits for SYNC (transmission type 1)"));
    assert!(line.is_some_and(|line| line.contains("[bus.can0.sync]")), "{told:#?}");
    for producer in [ProducerWord::Gateway, ProducerWord::Other] {
        assert_eq!(by_sync(Some(producer)).unwrap().1, []);
    }
}

#[test]
fn mistakes_about_sync_and_time_are_told() {
    let config = |lines: &str| {
        let text = format!("version = 1\n[bus.can0]\ninterface = \"virtual:a\"\n{lines}\n");
        let source = SourceText::new("cangate.toml", text);
        let loaded = cangate::config::load(&source, [], &mut |_| Err(std::io::ErrorKind::NotFound.into()));
        let problems = loaded.map_or_else(|problems| problems, |loaded| loaded.warnings);
        problems.iter().map(|problem| (problem.severity, problem.to_string())).collect::<Vec<_>>()
    };
    for (lines, message) in [
        ("sync = {}", "SYNC has no period"),
        ("sync = { period_ms = 60001 }", "period_ms 60001 is out of range"),
        ("sync = { period_us = 999 }", "period_us 999 is out of range"),
        ("sync = { period_ms = 1, period_us = 1000 }", "SYNC has two periods"),
        ("sync = { period_ms = 10, counter = 1 }", "counter 1 is out of range"),
        ("sync = { period_ms = 10, counter = 241 }", "counter 241 is out of range"),
        ("sync = { period_ms = 10, window_us = 10000 }", "is not shorter than the period"),
        ("sync = { period_ms = 10, cob_id = 0x701 }", "701 is kept for"),
        ("time = { period_s = 0 }", "period_s 0 is out of range"),
        ("time = { period_s = 1, cob_id = 0x581 }", "581 is kept for"),
        (
            "sync = { period_ms = 10, cob_id = 0x181 }\n[node.a]\nbus = \"can0\"\nid = 1\nmapping = \"danfoss-dst-p92c\"",
            "SYNC of bus `can0` (line 4) and TPDO 1 of node `a` have the same identifier 181",
        ),
    ] {
        let told = config(lines);
        assert!(
            told.iter().any(|(severity, line)| *severity == Severity::Error && line.contains(message)),
            "{lines}: {told:#?}"
        );
    }
    assert!(
        config("sync = { period_us = 1500, counter = 240, window_us = 700 }\ntime = { period_s = 60 }")
            .iter()
            .all(|(severity, _)| *severity == Severity::Warning)
    );
}

fn transmitter() -> DevicePlan {
    DevicePlan::new(NodeId::new(1).unwrap(), Scenario::shipped(Kind::DstP92c, "quiet").unwrap())
}

#[test]
fn v_dst_20_r_dst_043_045_a_transmitter_in_sync_operation_sends_a_tpdo_for_each_sync() {
    let mut world = World::with(Arc::new(by_sync(Some(ProducerWord::Gateway)).unwrap().0), 1);
    world.connect(&transmitter());
    world.run_for(1_000);
    world.start_gateway();
    world.run_for(5_000);
    assert_eq!(world.node(1).nmt, Some(NmtState::Operational), "{}", world.node(1).reason);
    assert!(world.sent.contains("080#"), "U-DST-12: without data");
    assert!(!world.sent.iter().any(|frame| frame.starts_with("080#0")), "{:?}", world.sent);
    let before = world.node(1).pdos[0].received;
    world.run_for(10_000);
    let came = world.node(1).pdos[0].received - before;
    assert!((99..=101).contains(&came), "{came}");
    assert_eq!(world.tag(1, "pressure").quality, Quality::Good);
    assert!(world.raised.is_empty(), "{:?}", world.raised);
}

#[test]
fn r_dst_050_when_sync_stops_the_tpdo_is_late_after_three_periods() {
    let mut world = World::with(Arc::new(by_sync(Some(ProducerWord::Gateway)).unwrap().0), 1);
    world.connect(&transmitter());
    world.start_gateway();
    world.run_for(5_000);
    assert!(world.is_good(1) || world.tag(1, "pressure").quality == Quality::Good);
    world.weather.lost = 1000;
    let took = world.run_until(400, |world| world.active_alarms().contains(&"pdo_timeout_1"));
    assert!((200..=301).contains(&took), "{took}");
    assert_eq!(world.tag(1, "pressure").quality, Quality::Stale(Reason::PdoTimeout));
}

#[test]
fn a_second_producer_of_sync_is_an_alarm_and_one_that_was_told_of_is_none() {
    for (producer, alarms) in [(Some(ProducerWord::Gateway), 1), (Some(ProducerWord::Other), 0), (None, 0)] {
        let mut conversation = Conversation::new(by_sync(producer).unwrap().0);
        conversation.run_to(150);
        conversation.frame("080#");
        let raised = conversation.raised();
        assert_eq!(raised.iter().filter(|name| *name == "foreign_producer").count(), alarms, "{producer:?}");
        assert_eq!(conversation.events_named("foreign_sync").len(), alarms, "{producer:?}");
        let unknown = usize::from(producer.is_none());
        assert_eq!(conversation.events_named("unknown_id").len(), unknown, "{producer:?}");
    }
}

#[test]
fn a_sync_that_the_bus_does_not_take_is_dropped_and_never_sent_later() {
    let mut conversation = Conversation::new(by_sync(Some(ProducerWord::Gateway)).unwrap().0);
    conversation.run_to(950);
    let syncs = |conversation: &Conversation| {
        conversation.all_sent.iter().filter(|frame| frame.to_string() == "080#").count()
    };
    assert_eq!(syncs(&conversation), 10);
    let at = Now::from_millis(950);
    for _ in 0..5 {
        conversation.bus_event(BusEvent::NotSent { frame: "080#".parse().unwrap(), at });
    }
    conversation.run_to(999);
    assert_eq!(syncs(&conversation), 10);
    conversation.run_to(1_050);
    assert_eq!(syncs(&conversation), 11);
}
