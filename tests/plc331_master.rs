//! The gateway in the place of an esd CAN-CBM-PLC/331 as CANopen master, and beside one that rules the bus: SYNC, error control,
//! emergencies, start and boot, as the configuration says.

use std::sync::Arc;

use cangate::canopen::{NmtState, NodeId};
use cangate::mapping::installation::{
    AlarmEntry, BusEntry, ErrorControlWord, NodeEntry, ProducerWord, RoleWord, SyncEntry,
};
use cangate::mapping::{At, Sketch, SourceText, TagTable};
use cangate::process_image::Quality;
use cangate::simulator::{DevicePlan, Kind, Scenario};

use super::support::conversation::Conversation;
use super::support::world::World;

/// A device with one TPDO of one byte, nothing else said.
const PLAIN: &str = "format = 1\ndevice = { vendor = 'esd', model = 'CAN-CBM-DIO8' }\n\
    [tpdo.1]\ncob_id = \"$NODEID+0x180\"\nlength = 1\ntimeout_ms = 2000\n[[tag]]\nname = \"inputs\"\ntpdo = 1\nbit = 0\ntype = \"u8\"\n";

fn at<T>(value: T) -> At<T> {
    At::nowhere(value)
}

/// Devices 6 and 7 of a mapping.
fn table(mapping: &str, bus: impl FnOnce(&mut BusEntry), node: impl Fn(&mut NodeEntry)) -> TagTable {
    let sketch = Sketch::new().mapping(SourceText::new("own", mapping)).bus(bus);
    let sketch = sketch.node("node006", 6, "own", &node).node("node007", 7, "own", &node);
    sketch.build().unwrap_or_else(|problems| panic!("{problems:#?}")).0
}

fn sync(change: impl FnOnce(&mut SyncEntry)) -> impl FnOnce(&mut BusEntry) {
    let mut entry = SyncEntry { period_us: Some(at(50_000)), ..SyncEntry::default() };
    change(&mut entry);
    move |bus| bus.sync = Some(at(entry))
}

/// All that was sent and begins so.
fn sent(conversation: &Conversation, beginning: &str) -> Vec<String> {
    let frames = conversation.all_sent.iter().map(ToString::to_string);
    frames.filter(|frame| frame.starts_with(beginning)).collect()
}

/// A TPDO that comes with SYNC.
fn synchronous() -> String {
    PLAIN.replace("length = 1", "length = 1\ntransmission_type = 1")
}

#[test]
fn r_esd_113_sync_is_sent_and_received_with_the_identifier_of_the_configuration() {
    let usual = table(&synchronous(), sync(|_| ()), |_| ());
    let own = table(&synchronous(), sync(|sync| sync.cob_id = Some(at(0x85))), |_| ());
    for (table, id) in [(usual, "080#"), (own, "085#")] {
        let mut conversation = Conversation::new(table);
        conversation.run_to(1000);
        assert!(sent(&conversation, id).len() >= 20, "{id}");
        assert!(["080#", "085#"].iter().all(|other| *other == id || sent(&conversation, other).is_empty()));
    }
    let other = |sync: &mut SyncEntry| {
        sync.producer = ProducerWord::Other;
        sync.cob_id = Some(at(0x85));
        sync.window_us = Some(at(10_000));
    };
    let mut conversation = Conversation::new(table(&synchronous(), sync(other), |_| ()));
    conversation.answer_guarding(6, 5);
    for (millis, frame) in [(1000, "080#"), (1020, "186#01")] {
        conversation.run_to(millis);
        conversation.frame(frame);
    }
    assert_eq!(conversation.node().counters.late_pdos, 0, "that is nobody's SYNC");
    for (millis, frame) in [(1100, "085#"), (1120, "186#01")] {
        conversation.run_to(millis);
        conversation.frame(frame);
    }
    assert_eq!(conversation.node().counters.late_pdos, 1);
    assert_eq!(sent(&conversation, "08"), Vec::<String>::new());
}

#[test]
fn r_esd_114_two_syncs_are_a_period_apart() {
    let mut conversation = Conversation::new(table(&synchronous(), sync(|_| ()), |_| ()));
    conversation.answer_guarding(6, 5);
    conversation.answer_guarding(7, 5);
    let mut counts = Vec::new();
    for millis in (975..=2475).step_by(50) {
        conversation.run_to(millis);
        counts.push(sent(&conversation, "080#").len());
    }
    assert!(counts.windows(2).all(|pair| pair[1] == pair[0] + 1), "{counts:?}");
}

#[test]
fn r_esd_115_a_synchronous_tpdo_after_the_window_is_counted_and_told() {
    for (window, late) in [(10_000, 1), (0, 0)] {
        let bus = sync(|sync| {
            sync.producer = ProducerWord::Other;
            sync.window_us = Some(at(window));
        });
        let mut conversation = Conversation::new(table(&synchronous(), bus, |_| ()));
        conversation.answer_guarding(6, 5);
        for (millis, frame) in [(1000, "080#"), (1009, "186#01"), (1050, "080#"), (1061, "186#02")] {
            conversation.run_to(millis);
            conversation.frame(frame);
        }
        assert_eq!(conversation.node().counters.late_pdos, late, "{window}");
        assert_eq!(conversation.events_named("pdo_outside_window").len() as u64, late, "{window}");
        assert_eq!(conversation.tag_text("inputs"), "2 good", "it is used all the same");
    }
}

#[test]
fn r_esd_127_guarding_is_set_for_each_device_or_off() {
    let guarded = |change: &dyn Fn(&mut NodeEntry)| {
        let mut conversation = Conversation::new(table(PLAIN, |_| (), |node| change(node)));
        conversation.answer_guarding(6, 5);
        conversation.answer_guarding(7, 5);
        conversation.run_to(10_000);
        conversation
    };
    let usual = sent(&guarded(&|_| ()), "706#R1").len();
    assert!((18..=22).contains(&usual), "every 500 ms: {usual}");
    let mut fast = guarded(&|node| {
        node.guard_time_ms = Some(at(200));
        node.life_time_factor = Some(at(4));
    });
    let often = sent(&fast, "706#R1").len();
    assert!((48..=52).contains(&often), "{often}");
    fast.stop_answering(6);
    fast.run_to(10_500);
    assert!(fast.is_normal("node_lost"), "not before four are missed");
    fast.run_to(11_500);
    assert!(!fast.is_normal("node_lost"));
    for off in [
        (&|node: &mut NodeEntry| node.error_control = Some(at(ErrorControlWord::None))) as &dyn Fn(&mut _),
        &|node: &mut NodeEntry| node.guard_time_ms = Some(at(0)),
    ] {
        assert_eq!(sent(&guarded(off), "706#"), Vec::<String>::new());
    }
}

#[test]
fn r_esd_128_heartbeats_are_set_supervised_and_sent_and_exclude_guarding() {
    let mapping = PLAIN.replace("[tpdo.1]", "error_control = { kind = \"heartbeat\" }\n[tpdo.1]");
    let bus = |bus: &mut BusEntry| {
        bus.own_node_id = Some(at(127));
        bus.own_heartbeat_ms = Some(at(100));
    };
    let node = |node: &mut NodeEntry| {
        node.heartbeat_ms = Some(at(300));
        node.heartbeat_timeout_ms = Some(at(700));
    };
    let mut conversation = Conversation::new(table(&mapping, bus, node));
    conversation.frame("706#7F");
    conversation.run_to(5);
    assert!(sent(&conversation, "606#40171000").len() == 1, "0x1017 is read, to be set where it differs");
    conversation.frame("586#4B17100000000000");
    conversation.run_to(100);
    assert_eq!(sent(&conversation, "606#2"), ["606#2B1710002C010000"], "300 ms");
    conversation.send_cyclically("706#05", 300);
    conversation.run_to(5000);
    assert!(conversation.alarm_of(0, "node_lost").state == cangate::process_image::AlarmState::Normal);
    assert!(sent(&conversation, "77F#05").len() >= 49);
    assert_eq!(sent(&conversation, "706#R"), Vec::<String>::new());
    conversation.stop_sending("706#05");
    conversation.run_to(5800);
    assert!(conversation.alarm_of(0, "node_lost").state != cangate::process_image::AlarmState::Normal);
    // A heartbeat to be set and guarding: one of them.
    let both = PLAIN.replace("[tpdo.1]", "error_control = { heartbeat_ms = 300 }\n[tpdo.1]");
    let sketch = Sketch::new().mapping(SourceText::new("own", both));
    let problems = sketch.node("a", 6, "own", |_| ()).build().unwrap_err();
    assert!(
        problems.iter().any(|problem| problem.message.contains("cannot be guarded as well")),
        "{problems:?}"
    );
}

#[test]
fn r_esd_129_emergencies_are_taken_with_their_identifier_and_their_alarm_can_be_off() {
    let own = PLAIN.replace("[tpdo.1]", "emergency = { cob_id = \"$NODEID+0xC0\" }\n[tpdo.1]");
    let off = |node: &mut NodeEntry| {
        node.alarm
            .insert(at("emergency".to_owned()), AlarmEntry { enabled: Some(false), ..AlarmEntry::default() });
    };
    for (mapping, heard, deaf) in [(PLAIN, "086", "0C6"), (own.as_str(), "0C6", "086")] {
        for is_off in [false, true] {
            let table = table(
                mapping,
                |_| (),
                |node| {
                    if is_off {
                        off(node);
                    }
                },
            );
            let mut conversation = Conversation::new(table);
            conversation.answer_guarding(6, 5);
            conversation.run_to(1000);
            conversation.frame(&format!("{deaf}#0010010000000000"));
            assert_eq!(conversation.node().counters.emcys, 0);
            conversation.frame(&format!("{heard}#0010010000000000"));
            assert_eq!(conversation.node().counters.emcys, 1);
            conversation.run_to(1100);
            assert_eq!(conversation.active().contains(&"emergency"), !is_off, "{heard}");
        }
    }
}

#[test]
fn r_esd_130_nodes_are_started_one_by_one_all_at_once_or_not_and_none_is_stopped_for_another() {
    let running = |bus: &dyn Fn(&mut BusEntry), node: &dyn Fn(&mut NodeEntry)| {
        let mut conversation = Conversation::new(table(PLAIN, |entry| bus(entry), |entry| node(entry)));
        for id in [6, 7] {
            conversation.frame(&format!("70{id}#00"));
            conversation.answer_guarding(id, 0x7F);
        }
        conversation.run_to(900);
        conversation.answer_guarding(6, 5);
        conversation.answer_guarding(7, 5);
        conversation.run_to(5000);
        conversation
    };
    let mut one_by_one = running(&|_| (), &|_| ());
    let mut commands = sent(&one_by_one, "000#");
    commands.sort();
    commands.dedup();
    assert_eq!(commands, ["000#0106", "000#0107"]);
    let together = running(&|bus| bus.start_broadcast = true, &|_| ());
    let commands = sent(&together, "000#");
    assert!(commands.iter().all(|command| command == "000#0100") && !commands.is_empty(), "{commands:?}");
    assert_eq!(sent(&running(&|_| (), &|node| node.auto_start = Some(false)), "000#"), Vec::<String>::new());
    // A node that fails: the other goes on, and nothing is stopped or reset.
    one_by_one.all_sent.clear();
    one_by_one.stop_answering(6);
    one_by_one.run_to(30_000);
    assert!(one_by_one.active().contains(&"node_lost"));
    assert_eq!(sent(&one_by_one, "000#"), Vec::<String>::new());
    // A reset before it is configured and started again only where somebody asks for that.
    one_by_one.answer_guarding(6, 5);
    one_by_one.run_to(40_000);
    assert_eq!(sent(&one_by_one, "000#81"), Vec::<String>::new());
    let mut resetting = running(&|_| (), &|node| node.reset_on_recovery = Some(true));
    resetting.stop_answering(6);
    resetting.run_to(30_000);
    resetting.answer_guarding(6, 5);
    resetting.run_to(40_000);
    assert_eq!(sent(&resetting, "000#81"), ["000#8106"]);
}

#[test]
fn r_esd_131_an_optional_device_that_is_missing_is_no_alarm_delays_nobody_and_is_started_when_it_comes() {
    let mapping = SourceText::new("own", PLAIN);
    let sketch =
        Sketch::new()
            .mapping(mapping)
            .node("node006", 6, "own", |_| ())
            .node("node007", 7, "own", |node| node.required = Some(false));
    let mut conversation = Conversation::new(sketch.build().unwrap().0);
    conversation.frame("706#00");
    conversation.answer_guarding(6, 0x7F);
    conversation.run_to(900);
    assert!(sent(&conversation, "000#0106").len() == 1, "the other is not delayed");
    conversation.answer_guarding(6, 5);
    conversation.send_cyclically("186#01", 500);
    conversation.run_to(30_000);
    assert_eq!(conversation.raised(), Vec::<String>::new());
    assert!(sent(&conversation, "707#R1").len() > 10, "it is asked for again and again");
    conversation.frame("707#00");
    conversation.answer_guarding(7, 0x7F);
    conversation.run_to(31_000);
    assert_eq!(sent(&conversation, "000#0107").len(), 1);
}

/// A transmitter at node 6, its mapping with `[identity]`, a heartbeat and a setting, and the gateway, after 5 s.
fn transmitter(more: &str, change: impl Fn(&mut NodeEntry)) -> World {
    let mapping = format!(
        "format = 1\ndevice = {{ vendor = 'x', model = 'y' }}\nidentity = {{ vendor_id = 0x23D }}\n\
         error_control = {{ kind = 'heartbeat', heartbeat_ms = 500 }}\n\
         [tpdo.1]\ncob_id = \"$NODEID+0x180\"\nmaps = [\"0x6130:1/32\"]\nmapping = \"write\"\ntransmission_type = 255\nevent_timer_ms = 100\n\
         [[tag]]\nname = \"pressure\"\nobject = \"0x6130:1\"\ntype = \"f32\"\n{more}"
    );
    let sketch = Sketch::new().mapping(SourceText::new("own", mapping)).node("node006", 6, "own", change);
    let mut world = World::with(Arc::new(sketch.build().unwrap().0), 1);
    let scenario = Scenario::shipped(Kind::DstP92c, "quiet").unwrap();
    world.connect(&DevicePlan::new(NodeId::new(6).unwrap(), scenario));
    world.run_for(1000);
    world.log = Some(Vec::new());
    world.start_gateway();
    world.run_for(5000);
    world
}

#[test]
fn r_esd_132_a_device_without_initialisation_is_started_without_any_sdo() {
    let mut world = transmitter("", |node| node.configure = Some(false));
    // It was delivered without a heartbeat, and nobody set one: it comes with a boot-up message.
    world.order("node 6 power cycle");
    world.run_for(3000);
    assert!(world.sent.contains("000#0106"), "{:?}", world.sent);
    assert!(!world.sent.iter().any(|frame| frame.starts_with("606#")), "{:?}", world.sent);
}

#[test]
fn r_esd_133_identity_settings_and_error_control_come_before_the_start_and_a_failed_step_is_named() {
    let mut world = transmitter("", |_| ());
    let log = world.log.take().unwrap();
    let place = |frame: &str| {
        log.iter().position(|sent| sent.starts_with(frame)).unwrap_or_else(|| panic!("{frame}: {log:#?}"))
    };
    let order = [
        place("606#4018100100000000"),
        place("606#2B171000F4010000"),
        place("606#2F001A0000000000"),
        place("606#23001A0120013061"),
        place("000#0106"),
    ];
    assert!(order.is_sorted(), "{order:?}");
    assert_eq!(world.tag(6, "pressure").quality, Quality::Good);
    assert_eq!(world.node(6).nmt, Some(NmtState::Operational));
    // Started again, it finds everything as it should be, and writes nothing.
    world.sent.clear();
    world.start_gateway();
    world.run_for(5000);
    assert!(!world.sent.iter().any(|frame| frame.starts_with("606#2")), "{:?}", world.sent);
    // An object that the device does not let anybody write.
    let setup = "[[setup]]\nobject = \"0x1000:0\"\ntype = \"u32\"\nvalue = 5\n";
    let refused = transmitter(setup, |_| ());
    let told = refused.image.journal.newest_first().find(|event| event.name == "node_boot_failed").unwrap();
    assert!(told.text.contains("0x1000:0") && told.text.contains("06010002"), "{}", told.text);
    assert_eq!(told.node.as_deref(), Some("node006"));
    assert!(!refused.sent.contains("000#0106"));
}

#[test]
fn beside_a_plc_331_that_rules_the_bus_the_gateway_overhears_sync_guarding_and_start_and_sends_nothing() {
    let bus = |bus: &mut BusEntry| {
        bus.role = RoleWord::Passive;
        let other =
            SyncEntry { producer: ProducerWord::Other, window_us: Some(at(20_000)), ..SyncEntry::default() };
        bus.sync = Some(at(other));
    };
    let mut conversation = Conversation::new(table(&synchronous(), bus, |_| ()));
    conversation.play(
        "0     <- 706#00
         10    <- 000#0106
         20    <- 707#00
         30    <- 000#0107",
    );
    // Its cycle: SYNC, the synchronous TPDOs, and guarding of both devices.
    let mut toggle = false;
    for cycle in 0..100_u64 {
        let begin = 100 + cycle * 100;
        conversation.run_to(begin);
        conversation.frame("080#");
        conversation.run_to(begin + 5);
        conversation.frame("186#2A");
        conversation.frame("187#2B");
        if cycle % 5 == 0 {
            let byte = if toggle { "85" } else { "05" };
            for node in ["706", "707"] {
                conversation.frame(&format!("{node}#R1"));
                conversation.frame(&format!("{node}#{byte}"));
            }
            toggle = !toggle;
        }
    }
    assert_eq!(conversation.all_sent, [], "not one frame");
    assert_eq!(conversation.raised(), Vec::<String>::new(), "two masters, but only one of them speaks");
    assert_eq!(conversation.tag_text("inputs"), "42 good");
    assert_eq!(conversation.node().nmt, Some(NmtState::Operational));
    assert!(conversation.node().online && conversation.node().passive);
    assert_eq!(conversation.node().counters.late_pdos, 0);
    // It stops a device: that is seen, and left to it.
    conversation.play(
        "10100 <- 080#
         10130 <- 187#2B
         10140 <- 000#0206
         10150 <- 706#R1
         10151 <- 706#04",
    );
    assert_eq!(conversation.node().nmt, Some(NmtState::Stopped));
    assert_eq!(conversation.image.nodes[1].counters.late_pdos, 1, "its SYNC opens the window");
    // A device dies: its master goes on asking, and the answers that are missing tell.
    for cycle in 0..20_u64 {
        conversation.run_to(10_500 + cycle * 500);
        conversation.frame("080#");
        conversation.frame("707#R1");
    }
    assert!(conversation.active().contains(&"node_lost"), "{:?}", conversation.active());
    conversation.run_to(60_000);
    assert_eq!(conversation.all_sent, []);
}
