//! An esd module, a `DetCon` and a gateway on one bus: found, configured, watched; what goes over its serial lines, and what
//! becomes of it when the module or the bus fails.

use std::sync::Arc;

use cangate::can::Link;
use cangate::config;
use cangate::gateway::{Action, Outcome};
use cangate::mapping::{SourceText, TagTable};
use cangate::process_image::{LineIndex, Quality, Reason, SerialLine};
use cangate::simulator::{DeviceNumber, DevicePlan, Kind, Scenario};

use super::support::world::World;

/// Module number and coding switch.
const MODULE: u8 = 0x1A;
const REPLY_ID: &str = "[bus.can0.esd]\nreply_id = 0x6E0\n";
const CHANNEL: &str = "[node.node026.channel.1]\nbaud = 38400\nstop_bits = 1\nmax_char = 8\ninhibit_ms = 2\n";

fn table(bus: &str, node: &str, more: &str) -> Arc<TagTable> {
    table_of("sio4", bus, node, more)
}

fn table_of(kind: &str, bus: &str, node: &str, more: &str) -> Arc<TagTable> {
    let text = format!(
        "version = 1\n[gateway]\nname = \"hall\"\n[bus.can0]\ninterface = \"can0\"\nbit_rate = 1000000\n{bus}\
         [node.node001]\nbus = \"can0\"\nid = 1\nmapping = \"motortech-detcon\"\n\
         [node.node026]\nbus = \"can0\"\nid = {MODULE}\nmapping = \"esd-can-cbm-{kind}\"\n{node}\n{more}"
    );
    let source = SourceText::new("cangate.toml", text);
    let loaded = config::load(&source, [], &mut |_| Err(std::io::ErrorKind::NotFound.into()));
    Arc::new(loaded.unwrap_or_else(|problems| panic!("{problems:#?}")).table)
}

/// A module with an echo behind every line, which does not make one wait after a reset.
fn connect(world: &mut World) {
    connect_with(world, "first_tx_delay_ms = 100");
}

fn connect_with(world: &mut World, keys: &str) {
    let text = format!(
        "description = \"Echoes.\"\n[device]\n{keys}\nbus_kbit = 0\n\
         lines = [\"echo\", \"echo\", \"echo\", \"echo\", \"echo\"]\n"
    );
    let scenario = Scenario::parse(Kind::CbmSio4, "echoes.toml", &text).unwrap();
    world.connect(&DevicePlan::new(DeviceNumber::new(MODULE).unwrap(), scenario));
}

/// A bus with both devices and a gateway that has run for 5 s.
fn world(bus: &str, node: &str, more: &str) -> World {
    world_of(table(bus, node, more))
}

fn world_of(table: Arc<TagTable>) -> World {
    let mut world = World::with(table, 1);
    world.power_on(1, "quiet");
    connect(&mut world);
    world.start_gateway();
    world.run_for(5000);
    world
}

fn managed() -> World {
    world(REPLY_ID, "status_period_ms = 500", CHANNEL)
}

fn line(world: &World) -> &SerialLine {
    &world.image.lines[0]
}

fn send(bytes: &[u8]) -> Action {
    Action::SerialSend { line: LineIndex(0), bytes: bytes.to_vec() }
}

fn detcon_is_good(world: &World) -> bool {
    let counters = &world.node(1).counters;
    let faults =
        [counters.restarts, counters.guard_misses, counters.toggle_errors, counters.unexpected_states];
    let is_missed = world.raised.iter().any(|alarm| alarm.starts_with("pdo_timeout"));
    world.is_good(1) && world.node(1).online && faults == [0; 4] && !is_missed
}

#[test]
fn r_esd_006_076_a_module_is_found_configured_and_shown() {
    let world = managed();
    let module = world.node(MODULE);
    assert_eq!((module.online, module.supervised, module.reason.as_str()), (true, true, ""));
    assert!(module.data_good);
    assert_eq!(world.events("module_configured"), 1);
    assert_eq!(world.active_alarms(), Vec::<&str>::new());
    assert!(detcon_is_good(&world));
    assert!(line(&world).open);
}

#[test]
fn r_esd_034_035_039_bytes_go_out_on_a_line_and_what_comes_in_is_a_stream_and_messages() {
    let mut world = managed();
    let mut cursor = line(&world).cursor();
    assert_eq!(world.ask(send(b"hello\r\nworld\r\n")), Outcome::Done);
    world.run_for(500);
    assert_eq!(line(&world).read(&mut cursor, 100), (b"hello\r\nworld\r\n".to_vec(), 0));
    let messages: Vec<(Vec<u8>, &str)> =
        line(&world).messages_after(0).0.map(|message| (message.bytes.clone(), message.end)).collect();
    assert_eq!(messages, [(b"hello".to_vec(), "delimiter"), (b"world".to_vec(), "delimiter")]);
    for (tag, number) in [
        ("channel_1_bytes_received", 14.0),
        ("channel_1_bytes_sent", 14.0),
        ("channel_1_messages_received", 2.0),
    ] {
        assert!((world.number(MODULE, tag) - number).abs() < 0.5, "{tag} {}", world.number(MODULE, tag));
    }
    world.run_for(3_000);
    assert!((2.0..5.0).contains(&world.number(MODULE, "channel_1_seconds_since_received")));
}

#[test]
fn r_esd_034_the_time_of_a_message_is_that_of_its_last_byte_whatever_ended_it() {
    let mut world = managed();
    let mut times = Vec::new();
    for (frame, wait) in [("104#61", 30), ("104#62", 500), ("104#63", 20)] {
        times.push(world.now().utc);
        world.say(frame);
        world.run_for(wait);
    }
    world.link(Link::Down);
    let messages = line(&world).messages_after(0).0;
    let messages: Vec<_> = messages.map(|message| (message.at, message.bytes.clone(), message.end)).collect();
    assert_eq!(messages, [(times[1], b"ab".to_vec(), "idle"), (times[2], b"c".to_vec(), "cut")]);
}

/// What was sent and what was given up, of so many bytes for the first line.
fn accounts(world: &World) -> [f64; 3] {
    ["channel_1_bytes_sent", "channel_1_bytes_not_sent", "channel_1_bytes_waiting"]
        .map(|tag| world.number(MODULE, tag))
}

fn is_good_again(world: &World) -> bool {
    let module = world.node(MODULE);
    module.online && module.supervised && module.data_good && module.reason.is_empty() && line(world).open
}

#[test]
fn r_esd_037_a_long_text_goes_out_at_the_pace_of_the_line() {
    let mut world = managed();
    let bytes = vec![b'x'; 3_840];
    let begin = world.millis();
    assert_eq!(world.ask(send(&bytes)), Outcome::Done);
    let took = world.millis() - begin;
    assert!((900..1_300).contains(&took), "{took} ms for what the line needs 1 s for");
    world.run_for(1_500);
    assert_eq!(line(&world).cursor(), 3_840);
    assert!(detcon_is_good(&world));
}

#[test]
fn r_esd_076_083_a_module_that_starts_anew_during_a_transfer_is_told_and_configured_and_its_bytes_are_accounted_for()
 {
    let mut world = managed();
    let request = world.command(send(&[b'x'; 4_000]));
    world.run_until(2_000, |world| world.number(MODULE, "channel_1_bytes_sent") > 1_000.0);
    let breaks = line(&world).breaks;
    world.order("node 26 reset");
    world.run_until(10_000, |world| world.events("node_restarted") > 0);
    let Some(Outcome::Failed(text)) = world.reply(request) else { panic!("it was not told") };
    let [sent, not_sent, waiting] = accounts(&world);
    assert!(text.contains(&format!("{sent} of 4000 bytes")), "{text}");
    assert!((sent + not_sent - 4_000.0).abs() < 0.5 && waiting < 0.5, "{sent} {not_sent} {waiting}");
    assert!(line(&world).breaks > breaks);
    world.run_until(20_000, is_good_again);
    assert_eq!(world.node(MODULE).counters.restarts, 1);
    assert_eq!(world.ask(send(b"again")), Outcome::Done);
    assert!(detcon_is_good(&world));
}

/// A module as it is shipped but for one line of 9600 bit/s, silent for 10 s after each start, and 4000 bytes on their way; what
/// asked for them.
fn transferring() -> (World, u64) {
    let channel = CHANNEL.replace("38400", "9600");
    let mut world = World::with(table(REPLY_ID, "", &channel), 1);
    world.power_on(1, "quiet");
    connect_with(&mut world, "");
    world.start_gateway();
    world.run_for(15_000);
    let request = world.command(send(&[b'x'; 4_000]));
    world.run_until(15_000, |world| accounts(world)[0] > 1_000.0);
    (world, request)
}

#[test]
fn r_esd_038_a_module_that_is_unplugged_in_the_middle_of_a_transfer_is_fed_no_longer_than_it_takes_to_miss_an_answer()
 {
    let (mut world, request) = transferring();
    let begin = accounts(&world)[0];
    world.order("node 26 unplug on");
    world.run_until(10_000, |world| world.active_alarms() == ["node_lost"]);
    let Some(Outcome::Failed(text)) = world.reply(request) else { panic!("{:?}", world.reply(request)) };
    let [sent, not_sent, waiting] = accounts(&world);
    assert!(text.contains(&format!("{sent} of 4000 bytes")), "{text}");
    assert!((sent + not_sent - 4_000.0).abs() < 0.5 && waiting < 0.5, "{sent} {not_sent} {waiting}");
    // Asked every 2 s, three times 100 ms for an answer, 960 bytes a second.
    assert!(sent - begin <= 2.3 * 960.0 + 64.0, "{begin} {sent}");
}

#[test]
fn r_esd_033_109_a_reset_by_somebody_else_breaks_a_transfer_off_and_its_silence_is_no_loss() {
    let (mut world, request) = transferring();
    let begin = accounts(&world)[0];
    world.say("700#FF00001AAAAA");
    assert!(matches!(world.reply(request), Some(Outcome::Failed(_))), "{:?}", world.reply(request));
    let [sent, not_sent, waiting] = accounts(&world);
    assert!(sent - begin < 100.0 && waiting < 0.5, "{begin} {sent} {waiting}");
    assert!((sent + not_sent - 4_000.0).abs() < 0.5, "{sent} {not_sent}");
    world.run_until(20_000, |world| world.events("node_restarted") > 0);
    world.run_until(20_000, is_good_again);
    assert!(!world.raised.contains("node_lost"), "{:?}", world.raised);
    assert_eq!(world.ask(send(b"again")), Outcome::Done);
    assert!(detcon_is_good(&world));
}

#[test]
fn r_esd_033_a_module_whose_supply_fails_in_the_middle_of_a_transfer_is_missed_while_it_is_silent_and_found_again()
 {
    let (mut world, request) = transferring();
    world.order("node 26 power cycle");
    world.run_until(10_000, |world| world.active_alarms() == ["node_lost"]);
    assert!(matches!(world.reply(request), Some(Outcome::Failed(_))), "{:?}", world.reply(request));
    let [sent, not_sent, waiting] = accounts(&world);
    assert!((sent + not_sent - 4_000.0).abs() < 0.5 && waiting < 0.5, "{sent} {not_sent} {waiting}");
    assert!(sent < 3_600.0, "{sent}");
    world.run_until(20_000, |world| is_good_again(world) && !world.active_alarms().contains(&"node_lost"));
}

#[test]
fn r_esd_041_042_what_is_sent_to_a_suspended_module_waits_until_it_goes_on() {
    let mut world = managed();
    world.say("700#FF04001A5A5A");
    world.run_until(2_000, |world| world.events("module_suspended") > 0);
    assert!(!world.node(MODULE).reason.is_empty() && world.node(MODULE).online);
    let request = world.command(send(b"kept"));
    world.run_for(2_000);
    assert_eq!(world.reply(request), None);
    world.say("700#FF04001AA5A5");
    world.run_until(5_000, |world| line(world).cursor() == 4);
    assert_eq!(world.events("module_continued"), 1);
    assert_eq!(world.reply(request), Some(Outcome::Done));
}

#[test]
fn r_esd_087_a_module_that_is_unplugged_is_lost_and_found_again_by_itself() {
    let mut world = managed();
    world.order("node 26 unplug on");
    world.run_until(10_000, |world| world.active_alarms() == ["node_lost"]);
    assert!(!world.node(MODULE).online && !line(&world).open);
    assert_eq!(world.tag(MODULE, "can_status").quality, Quality::Bad(Reason::NodeLost));
    assert_eq!(world.ask(send(b"x")), Outcome::NodeUnavailable);
    world.order("node 26 unplug off");
    world.run_until(20_000, is_good_again);
    assert_eq!(world.active_alarms(), Vec::<&str>::new());
    assert!(detcon_is_good(&world));
}

#[test]
fn a_bus_that_goes_down_breaks_off_a_transfer_and_everything_is_back_when_it_is_up() {
    let mut world = managed();
    let request = world.command(send(&[b'x'; 4_000]));
    world.run_until(2_000, |world| world.number(MODULE, "channel_1_bytes_sent") > 1_000.0);
    world.link(Link::Down);
    assert!(matches!(world.reply(request), Some(Outcome::Failed(_))));
    assert_eq!(world.tag(MODULE, "can_status").quality, Quality::Bad(Reason::BusUnavailable));
    assert_eq!(
        world.tag(MODULE, "channel_1_bytes_sent").quality,
        Quality::Good,
        "it is the gateway that counts"
    );
    assert_eq!(world.ask(send(b"x")), Outcome::NodeUnavailable);
    world.run_for(5_000);
    world.link(Link::ErrorActive);
    world.run_until(20_000, |world| is_good_again(world) && world.is_good(1));
    let [sent, not_sent, waiting] = accounts(&world);
    assert!((sent + not_sent - 4_000.0).abs() < 0.5 && waiting < 0.5, "{sent} {not_sent} {waiting}");
    assert_eq!(world.ask(send(b"again")), Outcome::Done);
}

#[test]
fn r_esd_033_a_module_that_is_silent_after_its_start_is_not_missed_for_its_first_tx_activate_delay() {
    let mut world = World::with(table(REPLY_ID, "", CHANNEL), 1);
    world.power_on(1, "quiet");
    world.start_gateway();
    world.run_for(14_000);
    assert!(!world.raised.contains("node_never_seen"), "{:?}", world.raised);
    world.run_until(3_000, |world| world.raised.contains("node_never_seen"));
    assert!(world.node(MODULE).reason.contains("coding switch"), "{}", world.node(MODULE).reason);
}

#[test]
fn a_passive_gateway_hears_the_lines_and_sends_nothing() {
    let text = "role = \"passive\"\n";
    let mut world = world(text, "", CHANNEL);
    world.say("104#68656C6C6F0D0A");
    world.run_for(500);
    assert_eq!(line(&world).last_message().unwrap().bytes, b"hello");
    assert!(world.node(MODULE).online);
    assert!(matches!(world.ask(send(b"x")), Outcome::Rejected(why) if why.contains("passive")));
    world.run_for(60_000);
    assert_eq!(world.sent.iter().collect::<Vec<_>>(), Vec::<&String>::new());
}

#[test]
fn a_module_that_is_not_managed_carries_lines_and_is_asked_nothing() {
    let mut world = world("", "manage = false", CHANNEL);
    assert_eq!(world.ask(send(b"hello\r\n")), Outcome::Done);
    world.run_for(500);
    assert_eq!(line(&world).last_message().unwrap().bytes, b"hello");
    world.run_for(60_000);
    assert!(world.node(MODULE).online && world.node(MODULE).data_good);
    assert!(!world.sent.iter().any(|frame| frame.starts_with("700#")), "{:?}", world.sent);
    assert_eq!(world.active_alarms(), Vec::<&str>::new());
}

#[test]
fn r_esd_065_068_073_no_command_that_stores_resets_renumbers_or_changes_bit_rate_or_times_is_sent_by_itself()
{
    let mut world = managed();
    world.order("node 26 power cycle");
    world.run_for(30_000);
    let is_drastic = |frame: &&String| {
        ["700#FF", "700#8100", "700#8101", "700#8103", "700#84"].iter().any(|it| frame.starts_with(it))
    };
    assert_eq!(world.sent.iter().find(is_drastic), None);
    assert!(is_good_again(&world), "{:?}", world.node(MODULE));
}

#[test]
fn r_esd_058_another_module_is_left_alone_and_told_of_unless_its_type_is_not_to_be_looked_at() {
    let world = world_of(table_of("sio1", REPLY_ID, "", ""));
    assert_eq!(world.active_alarms(), ["identity_mismatch"]);
    assert!(
        world.node(MODULE).identity_mismatch && world.node(MODULE).reason.contains("0x31"),
        "{:?}",
        world.node(MODULE)
    );
    let sets = |frame: &&String| frame.starts_with("700#8");
    assert_eq!(world.sent.iter().find(sets), None);
    let world = world_of(table_of("sio1", REPLY_ID, "check_identity = false", ""));
    assert_eq!((world.active_alarms(), world.node(MODULE).supervised), (Vec::<&str>::new(), true));
}

#[test]
fn r_esd_054_a_module_that_may_not_be_set_and_is_otherwise_is_told_of_and_its_lines_work_all_the_same() {
    let mut world = world(REPLY_ID, "configure = false", CHANNEL);
    assert_eq!(world.active_alarms(), ["module_not_configured"]);
    assert!(world.node(MODULE).reason.contains("Serial mode"), "{}", world.node(MODULE).reason);
    let sets = |frame: &&String| ["700#82", "700#83", "700#86"].iter().any(|it| frame.starts_with(it));
    assert_eq!(world.sent.iter().find(sets), None);
    assert_eq!(world.ask(send(b"hello")), Outcome::Done);
}

#[test]
fn r_esd_088_a_gateway_that_stops_switches_off_the_watchdogs_that_it_set_going() {
    let keys = "watchdog_id = 0x6E1\nwatchdog_ms = 300";
    let mut world = world(REPLY_ID, keys, CHANNEL);
    assert!(world.sent.contains("6E1#R1") && is_good_again(&world), "{:?}", world.node(MODULE));
    world.stop_gateway();
    world.run_for(10_000);
    assert!(world.sent.contains("700#8105001A0000"));
    world.start_gateway();
    world.run_for(5_000);
    // A reset would have made it forget what the first gateway wrote.
    let told = world.image.journal.newest_first().find(|event| event.name == "module_configured").unwrap();
    assert!(told.text.contains("nothing was written"), "{}", told.text);
}

#[test]
fn p29_r_esd_088_a_module_whose_node_changes_begins_anew_with_it_and_who_waits_for_it_is_told() {
    let alarm = "\n[node.node026.alarm.node_lost]\non_delay_ms = 700\n";
    let changed = || table(REPLY_ID, "", &format!("{CHANNEL}{alarm}"));
    let mut world = world(REPLY_ID, "", CHANNEL);
    let requests: Vec<u64> = (0..8).map(|_| world.command(send(&[b'x'; 4_000]))).collect();
    world.run_for(200);
    world.exchange(changed());
    for request in requests {
        assert!(matches!(world.reply(request), Some(Outcome::Failed(_))), "{request}");
    }
    world.run_until(20_000, is_good_again);
    assert!(line(&world).open && detcon_is_good(&world));
    assert_eq!(world.ask(send(b"again")), Outcome::Done);
    // One that is lost is missed by the node that begins anew, too.
    world.order("node 26 unplug on");
    world.run_until(20_000, |world| world.active_alarms() == ["node_lost"]);
    world.exchange(table(REPLY_ID, "", CHANNEL));
    world.run_until(20_000, |world| world.active_alarms() == ["node_never_seen"]);
    // What is only shown otherwise is no change.
    world.order("node 26 unplug off");
    world.run_until(20_000, is_good_again);
    let configured = world.events("module_configured");
    world.exchange(table(REPLY_ID, "unit_id = 77", CHANNEL));
    world.run_for(5_000);
    assert!(is_good_again(&world));
    assert_eq!(world.events("module_configured"), configured);
}

#[test]
fn r_esd_083_a_module_whose_watchdog_is_not_asked_in_time_resets_itself_and_is_configured_again() {
    let keys = "watchdog_id = 0x6E1\nwatchdog_ms = 300";
    let mut world = world(REPLY_ID, keys, CHANNEL);
    let written = world.events("module_configured");
    world.crash_gateway();
    world.run_for(10_000);
    world.start_gateway();
    world.run_for(5_000);
    assert!(is_good_again(&world), "{:?}", world.node(MODULE));
    assert_eq!((written, world.events("module_configured")), (1, 1));
    let told = world.image.journal.newest_first().find(|event| event.name == "module_configured").unwrap();
    assert!(told.text.contains("parameters were written"), "{}", told.text);
}

#[test]
fn r_esd_056_nothing_but_commands_of_six_bytes_is_ever_sent_on_the_init_id() {
    let mut world = managed();
    assert_eq!(world.ask(send(b"hello")), Outcome::Done);
    world.run_for(60_000);
    let commands: Vec<&String> = world.sent.iter().filter(|frame| frame.starts_with("700#")).collect();
    assert!(commands.iter().all(|frame| frame.len() == "700#".len() + 12), "{commands:?}");
    assert!(commands.len() > 10, "{commands:?}");
}

#[test]
fn r_esd_077_a_can_error_that_stays_is_an_alarm_until_it_is_gone() {
    let mut world = managed();
    world.order("node 26 error on");
    world.run_until(60_000, |world| world.active_alarms() == ["module_can_error"]);
    world.order("node 26 error off");
    world.run_until(120_000, |world| world.active_alarms().is_empty());
}

#[test]
fn a_module_that_was_missed_again_after_an_outage_is_there_when_it_comes_back() {
    let mut world = managed();
    world.order("node 26 unplug on");
    world.run_until(10_000, |world| world.active_alarms() == ["node_lost"]);
    world.link(Link::Down);
    world.run_for(1_000);
    world.link(Link::ErrorActive);
    world.run_for(20_000);
    world.order("node 26 unplug off");
    world.run_until(20_000, is_good_again);
    world.run_for(1_000);
    assert_eq!(world.active_alarms(), Vec::<&str>::new());
}
