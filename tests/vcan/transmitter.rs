//! A pressure transmitter (DST P92C) from its box to its values: found beside a `DetCon` of the same node id, moved to another
//! id, configured, read, watched, and never written to without need.

use std::time::Duration;

use tempfile::TempDir;

use crate::commissioning::cangate;
use crate::harness::broker::{Broker, Subscriber};
use crate::harness::bus::{BUS, Capture, cansend, take_the_bus};
use crate::harness::gateway::{Gateway, Setup, TOPICS, simulate, simulator};
use crate::harness::modbus::{Table, mbpoll, pymodbus};
use crate::harness::process::Process;
use crate::harness::wait::{give_it, wait_until};

/// Node id that the transmitter is moved to, as in section 4.2 of its manual.
const NEW: u8 = 5;

/// A transmitter from its box, one of those that send by themselves as soon as they are started (K-DST-01).
struct Transmitter {
    process: Process,
    _folder: TempDir,
}

impl Transmitter {
    fn plug_in(node: u8) -> Self {
        let folder = TempDir::new().unwrap();
        let file = folder.path().join("box.toml");
        let text = "description = \"As delivered.\"\n\
                    [device]\ndefault_transmission_type = 255\nnoise = false\nbus_kbit = 0\n";
        std::fs::write(&file, text).unwrap();
        let process = simulate("dst-p92c", node, &["--scenario", file.to_str().unwrap()]);
        Self { process, _folder: folder }
    }

    fn order(&mut self, line: &str) {
        self.process.say(line);
        wait_until(format!("the order `{line}`"), || {
            self.process.stdout(0).iter().any(|report| report.text.ends_with(&format!("ok: {line}")))
        });
    }
}

/// The shipped mapping with TPDO1 every 100 ms and a heartbeat every 500 ms.
fn press_mapping() -> String {
    let mut text = cangate::mapping::shipped("danfoss-dst-p92c").unwrap().to_owned();
    for (from, to) in [
        ("event_timer_ms = 1000", "event_timer_ms = 100"),
        ("heartbeat_ms = 1000", "heartbeat_ms = 500"),
        ("heartbeat_timeout_ms = 3000", "heartbeat_timeout_ms = 1500"),
    ] {
        assert!(text.contains(from), "{from}");
        text = text.replacen(from, to, 1);
    }
    text
}

/// A gateway for a `DetCon` of node 1 and a transmitter of node 5.
fn plant() -> Setup {
    Setup::one_detcon().mapping("press", &press_mapping()).node("press", NEW, "press")
}

fn wait_until_press_is_good(gateway: &Gateway) {
    gateway.node(NEW).wait_for_status("a good transmitter", |status| {
        status.online() && status.operational() && status.supervision_ok() && status.all_good()
    });
}

fn f32_of(words: &[u16]) -> f32 {
    f32::from_bits(u32::from(words[0]) << 16 | u32::from(words[1]))
}

/// Commands, LSS, SDO and boot-up messages: what is left when process data and guarding are taken away.
fn conversation(frames: &[String]) -> Vec<&str> {
    let is_spoken = |frame: &&str| {
        let id = frame.split('#').next().unwrap();
        ["000", "7E4", "7E5"].contains(&id)
            || ["58", "60"].iter().any(|sdo| id.starts_with(sdo))
            || id.starts_with("70") && frame.ends_with("#00")
    };
    frames.iter().map(String::as_str).filter(is_spoken).collect()
}

/// SDO requests that write an object of the transmitter.
fn writes(frames: &[String]) -> Vec<&String> {
    frames.iter().filter(|frame| is_write_to(frame, "605#")).collect()
}

/// Whether a frame is an SDO request to this identifier that begins to write.
pub fn is_write_to(frame: &str, id: &str) -> bool {
    let command = frame.strip_prefix(id).and_then(|data| u8::from_str_radix(data.get(..2)?, 16).ok());
    command.is_some_and(|command| matches!(command & 0xE0, 0x20 | 0xC0))
}

#[test]
fn a_scan_of_a_silent_bus_puts_not_one_frame_on_it() {
    let _bus = take_the_bus();
    let capture = Capture::start();
    let (code, stdout, stderr) = cangate(&["scan", "-i", BUS]);
    assert_eq!(code, 0, "{stderr}");
    assert!(stdout.contains("no node was heard"), "{stdout}");
    capture.mark();
    assert_eq!(capture.frames(), Vec::<String>::new());
}

#[test]
fn r_dst_001_five_seconds_of_listening_name_detcon_transmitter_and_what_is_neither_and_send_nothing() {
    let _bus = take_the_bus();
    let capture = Capture::start();
    let _detcon = simulator(1, &[]);
    let _press = Transmitter::plug_in(NEW);
    // A start that comes while a device is still booting is lost.
    wait_until("process data of both", || {
        cansend("000#0100");
        ["481#", "185#"].iter().all(|id| capture.frames().iter().any(|frame| frame.starts_with(id)))
    });
    // can-utils' cangen plays a node of which nobody knows anything.
    let _unknown = Process::start(
        "cangen",
        std::process::Command::new("cangen").args([BUS, "-g", "200", "-I", "18A", "-L", "3"]),
    );
    capture.wait_for("18A#", 0);
    let begin = capture.mark();
    let (code, stdout, stderr) = cangate(&["scan", "-i", BUS, "--format", "json"]);
    assert_eq!(code, 0, "{stderr}");
    let end = capture.mark();

    let participants = ["181#", "281#", "381#", "481#", "185#", "18A#"];
    let other: Vec<String> = capture.frames()[begin..end]
        .iter()
        .filter(|frame| !participants.iter().any(|id| frame.starts_with(id)))
        .cloned()
        .collect();
    assert!(other.is_empty(), "sent by the scan: {other:?}");

    let report: serde_json::Value = serde_json::from_str(&stdout).unwrap();
    println!("scan of {} frames: {}", report["frames"], cangate_table(&report));
    let ids: Vec<_> = report["nodes"].as_array().unwrap().iter().map(|node| &node["id"]).collect();
    assert_eq!(ids, [1, 5, 10]);
    let named = |node: usize| {
        let best = &report["nodes"][node]["mappings"][0];
        (best["mapping"].as_str().map(str::to_owned), best["probable"] == true)
    };
    assert_eq!(named(0), (Some("motortech-detcon".to_owned()), true));
    assert_eq!(named(2), (None, false), "three bytes on one TPDO are nobody that we know");
    // One TPDO of five bytes, as delivered: never more than a guess.
    assert_eq!(named(1), (Some("danfoss-dst-p92c".to_owned()), false), "{stdout}");
    assert!(
        report["nodes"].as_array().unwrap().iter().all(|node| node["suspicions"] == serde_json::json!([]))
    );
}

/// Node and name of each, for people who read the test's output.
fn cangate_table(report: &serde_json::Value) -> String {
    let line = |node: &serde_json::Value| {
        format!("{}: {}", node["id"], node["mappings"][0]["model"].as_str().unwrap_or("unknown"))
    };
    report["nodes"].as_array().unwrap().iter().map(line).collect::<Vec<_>>().join(", ")
}

#[test]
fn a_scan_while_a_transmitter_of_the_same_node_id_is_plugged_in_tells_of_the_clash() {
    let _bus = take_the_bus();
    let capture = Capture::start();
    let _detcon = simulator(1, &[]);
    capture.wait_for("701#00", 0);
    wait_until("process data", || {
        cansend("000#0101");
        capture.frames().iter().any(|frame| frame.starts_with("481#"))
    });
    let begin = capture.mark();
    let mut scan = Process::start(
        "cangate scan",
        std::process::Command::new(env!("CARGO_BIN_EXE_cangate")).args(["scan", "-i", BUS, "--seconds", "6"]),
    );
    // It must listen by then, and nothing tells that it does: it sends nothing.
    give_it(Duration::from_secs(1));
    let _press = Transmitter::plug_in(1);
    assert_eq!(scan.wait().code(), Some(0));
    let text: Vec<String> = scan.stdout(0).into_iter().map(|line| line.text).collect();
    assert!(
        text.iter().any(|line| line.starts_with("! two devices may share node id 1")),
        "nothing of the clash in {text:#?}"
    );
    capture.mark();
    assert_eq!(
        conversation(&capture.frames()[begin..]),
        ["701#00"],
        "the transmitter's boot-up, and no more"
    );
}

#[test]
fn an_active_scan_says_what_it_is_that_shares_its_node_id_with_a_detcon() {
    let _bus = take_the_bus();
    let capture = Capture::start();
    let _detcon = simulator(1, &[]);
    wait_until("process data", || {
        cansend("000#0101");
        capture.frames().iter().any(|frame| frame.starts_with("481#"))
    });
    // As the object dictionary of the guide has it: it waits for SYNC and sends no heartbeat, so that nothing is heard of it.
    let press = simulate("dst-p92c", 1, &[]);
    wait_until("the transmitter", || {
        press.stdout(0).iter().any(|line| line.text.ends_with("pre_operational"))
    });
    let (code, stdout, stderr) =
        cangate(&["scan", "-i", BUS, "--active", "--seconds", "2", "--nodes", "1-3"]);
    assert_eq!(code, 0, "{stderr}");
    println!("{stdout}");
    assert!(stdout.contains("! two devices may share node id 1"), "{stdout}");
    assert!(stdout.contains("DST P92C") && stdout.contains("DetCon"), "{stdout}");
    capture.mark();
    let writes = |frame: &String| ["601#", "602#", "603#"].iter().any(|id| is_write_to(frame, id));
    let asked: Vec<String> = capture.frames().into_iter().filter(writes).collect();
    assert_eq!(asked, Vec::<String>::new(), "it writes nothing");
}

#[test]
fn r_dst_113_the_node_id_is_changed_with_the_frames_of_the_manual() {
    let _bus = take_the_bus();
    let capture = Capture::start();
    let _press = Transmitter::plug_in(1);
    capture.wait_for("701#00", 0);
    let (code, stdout, stderr) =
        cangate(&["lss", "-i", BUS, "set-node-id", "--to", "5", "--only-one-device"]);
    assert_eq!(code, 0, "{stdout}{stderr}");
    capture.mark();
    let frames = capture.frames();
    assert_eq!(
        conversation(&frames)[..8],
        [
            "701#00",
            "000#0200",
            "7E5#0401000000000000",
            "7E5#1105000000000000",
            "7E4#1100000000000000",
            "7E5#1700000000000000",
            "7E4#1700000000000000",
            "7E5#0400000000000000",
        ]
    );
    assert_eq!(conversation(&frames)[8], "705#00", "active at once: boots with its new id (R-DST-098)");
    let commands_after: Vec<_> = conversation(&frames)[9..].to_vec();
    assert!(commands_after.iter().all(|frame| frame.starts_with("000#80")), "{commands_after:?}");
}

#[test]
fn r_dst_113_114_node_id_and_bit_rate_are_changed_with_the_frames_of_the_manual_and_a_power_cycle() {
    let _bus = take_the_bus();
    let capture = Capture::start();
    let mut press = Transmitter::plug_in(1);
    capture.wait_for("701#00", 0);
    let (code, stdout, stderr) =
        cangate(&["lss", "-i", BUS, "set-node-id", "--to", "5", "--bit-rate", "250", "--only-one-device"]);
    assert_eq!(code, 0, "{stdout}{stderr}");
    assert!(stdout.contains("off and on"), "{stdout}");
    press.order("power cycle");
    capture.wait_for("705#00", 0);
    let frames = capture.frames();
    let spoken = conversation(&frames);
    assert_eq!(
        spoken[..9],
        [
            "701#00",
            "000#0200",
            "7E5#0401000000000000",
            "7E5#1105000000000000",
            "7E4#1100000000000000",
            "7E5#1300030000000000",
            "7E4#1300000000000000",
            "7E5#1700000000000000",
            "7E4#1700000000000000",
        ]
    );
    assert_eq!(spoken.last(), Some(&"705#00"));
    let (_, stdout, _) = cangate(&["sdo", "-i", BUS, "--node", "5", "read", "0x4F00:0", "--type", "u8"]);
    assert!(stdout.contains('3'), "index 3 = 250 kbit/s: {stdout}");
}

/// All that must hold of one transmitter, in the order in which it happens in a plant.
#[test]
fn a_transmitter_with_the_node_id_of_a_detcon_is_moved_configured_read_and_watched() {
    let _bus = take_the_bus();
    let broker = Broker::start();
    let subscriber = Subscriber::start(&broker, TOPICS);
    let capture = Capture::start();
    let _detcon = simulator(1, &[]);
    let mut gateway = plant().broker(&broker).start();
    let detcon_is_good = |gateway: &Gateway| {
        gateway.node(1).wait_for_status("a good DetCon", |status| status.operational() && status.all_good());
    };
    detcon_is_good(&gateway);

    // The clash: both have node id 1.
    let messages = subscriber.count();
    let mut press = Transmitter::plug_in(1);
    subscriber.wait_for("engine1/alarm/duplicate_node", messages, |payload| payload["active"] == true);

    // A person moves the newcomer, by its identity: the DetCon has no SDO server and cannot be meant.
    gateway.process.terminate();
    let begin = capture.mark();
    let (code, stdout, stderr) = cangate(&["lss", "-i", BUS, "set-node-id", "--node", "1", "--to", "5"]);
    assert_eq!(code, 0, "{stdout}{stderr}");
    capture.mark();
    let frames = capture.frames();
    let spoken = conversation(&frames[begin..]);
    let lss: Vec<&str> = spoken.iter().copied().filter(|frame| frame.starts_with("7E")).collect();
    assert_eq!(
        lss,
        [
            "7E5#0400000000000000",
            "7E5#403D020000000000",
            "7E5#4178563412000000",
            "7E5#4203020100000000",
            "7E5#4340E20100000000",
            "7E4#4400000000000000",
            "7E5#1105000000000000",
            "7E4#1100000000000000",
            "7E5#1700000000000000",
            "7E4#1700000000000000",
            "7E5#0400000000000000",
        ],
        "R-DST-111: the device is selected by its address, as two share the id"
    );
    let stop = spoken.iter().position(|frame| *frame == "000#0201").unwrap();
    let boot = spoken.iter().position(|frame| *frame == "705#00").unwrap();
    assert!(stop < boot, "{spoken:?}");

    // The gateway knows a transmitter of node 5: it configures and starts it.
    press.order("pressure 123.4");
    press.order("temperature 41.5");
    let (begin, messages) = (capture.mark(), subscriber.count());
    gateway.start_again();
    wait_until_press_is_good(&gateway);
    detcon_is_good(&gateway);
    let frames = capture.frames();
    for write in [
        "605#2B171000F4010000",
        "605#23001A0120013061",
        "605#23001A0220023091",
        "605#2B00180564000000",
        "605#2331610100004E00",
    ] {
        assert!(frames[begin..].iter().any(|frame| frame == write), "{write} in {:?}", writes(&frames));
    }
    assert!(
        !frames[begin..].iter().any(|frame| frame.starts_with("605#231010")),
        "R-DST-090: nothing is stored"
    );

    // In bar and degrees, on the bus, on Modbus and MQTT: 123.4 as a float, 41.5 with one digit as an integer.
    capture.wait_for("185#CDCCF6429F010000", begin);
    let words = mbpoll(gateway.modbus, NEW, Table::Input, 100, 8).unwrap();
    assert!((f32_of(&words[0..2]) - 123.4).abs() < 0.001, "{words:?}");
    assert_eq!(u32::from(words[2]) << 16 | u32::from(words[3]), 123_400, "mbar");
    assert_eq!(words[4], 415, "tenths of a degree");
    assert_eq!(pymodbus(gateway.modbus, NEW, Table::Input, 100, 8).unwrap(), words);
    subscriber.wait_for("press/state", messages, |payload| {
        let is =
            |tag: &str, value: f64| payload["tags"][tag].as_f64().is_some_and(|is| (is - value).abs() < 0.01);
        is("pressure", 123.4) && is("temperature", 41.5)
    });

    let begin = capture.mark();
    give_it(Duration::from_secs(5));
    let timed = capture.timed();
    // The median: a guest that stalls is not the device's doing.
    let period = |id: &str| {
        let seen: Vec<f64> =
            timed[begin..].iter().filter(|(_, frame)| frame.starts_with(id)).map(|(at, _)| *at).collect();
        let mut gaps: Vec<f64> = seen.windows(2).map(|pair| pair[1] - pair[0]).collect();
        gaps.sort_by(f64::total_cmp);
        gaps[gaps.len() / 2]
    };
    println!("TPDO1 every {:.1} ms, heartbeat every {:.1} ms", period("185#") * 1e3, period("705#") * 1e3);
    assert!((0.09..0.15).contains(&period("185#")) && (0.45..0.7).contains(&period("705#")));

    // An error of the device, and its end.
    let (begin, messages) = (capture.mark(), subscriber.count());
    press.order("emcy F011");
    capture.wait_for("085#11F0210000000000", begin);
    subscriber.wait_for("press/alarm/pressure_error", messages, |payload| payload["active"] == true);
    let messages = subscriber.count();
    press.order("emcy clear");
    capture.wait_for("085#0000000000000000", begin);
    subscriber.wait_for("press/alarm/pressure_error", messages, |payload| payload["active"] == false);

    // Unplugged.
    wait_until_press_is_good(&gateway);
    let messages = subscriber.count();
    press.process.kill();
    let lost = subscriber.wait_for_event("node_lost", messages);
    let heard = capture.timed().into_iter().rfind(|(_, frame)| frame.starts_with("705#")).unwrap().0;
    let took = lost.payload["ts"].as_f64().unwrap() / 1000.0 - heard;
    println!("node_lost: {took:.3} s after the last heartbeat (heartbeat time 1.5 s)");
    // Not sooner; how much later is printed, as a guest may stall.
    assert!(took >= 1.4, "{took} s");
    subscriber.wait_for("press/availability", messages, |payload| payload["state"] == "offline");
    wait_until("invalid on Modbus", || f32_of(&gateway.node(NEW).input(100, 2)).is_nan());
    gateway.node(1).wait_for_status("the DetCon is not concerned", |status| status.all_good());
}

#[test]
fn r_dst_090_a_gateway_that_starts_again_twenty_times_writes_no_object_of_the_device() {
    let _bus = take_the_bus();
    let capture = Capture::start();
    let _press = Transmitter::plug_in(NEW);
    capture.wait_for("705#00", 0);
    let mut gateway = plant().start();
    wait_until_press_is_good(&gateway);
    let first = writes(&capture.frames()).len();
    assert!(first > 0, "the device came from its box");

    let begin = capture.mark();
    for restart in 0..20 {
        if restart % 2 == 0 {
            gateway.process.terminate();
        } else {
            gateway.process.kill();
        }
        gateway.start_again();
        wait_until_press_is_good(&gateway);
    }
    capture.mark();
    let frames = capture.frames()[begin..].to_vec();
    let reads = frames.iter().filter(|frame| frame.starts_with("605#40")).count();
    println!("first start: {first} writes; 20 more starts: {} writes, {reads} reads", writes(&frames).len());
    assert_eq!(writes(&frames), Vec::<&String>::new());
    assert!(!frames.iter().any(|frame| frame.starts_with("000#")), "nor was it commanded");
    assert!(reads >= 20, "it was looked at each time");
}
