//! Tests of [`super`].

use super::*;
use crate::can::virtual_bus;
use crate::can::{BusEvent, BusReader, BusWriter};
use crate::cli::sim::{self, SimOptions};
use crate::simulator::Kind;

fn options(active: bool) -> ScanOptions {
    ScanOptions { active, seconds: 5, nodes: "1-10".parse().unwrap() }
}

/// All frames that somebody sent.
async fn frames(mut reader: virtual_bus::VirtualReader, stop: CancellationToken) -> Vec<String> {
    let mut frames = Vec::new();
    loop {
        tokio::select! {
            () = stop.cancelled() => return frames,
            event = reader.recv() => {
                if let BusEvent::Frame { frame, .. } = event.unwrap() {
                    frames.push(frame.to_string());
                }
            }
        }
    }
}

/// A scan beside a simulated DetCon of node id 3, which somebody has started or not.
async fn scan_beside_a_detcon(bus: &str, started: bool, active: bool) -> (ScanReport, Vec<String>) {
    let (clock, stop) = (Clock::start(), CancellationToken::new());
    let interface: Interface = format!("virtual:{bus}").parse().unwrap();
    let device = SimOptions {
        kind: Kind::Detcon,
        interface: interface.clone(),
        node: NodeId::new(3).unwrap().into(),
        count: 1,
        serial: Vec::new(),
        scenario: None,
        seed: 1,
    };
    let (mut heard, mut say) = virtual_bus::join(bus, clock);
    let simulator =
        tokio::spawn(sim::run(device, std::io::Cursor::new(""), std::io::sink(), clock, stop.clone()));
    loop {
        if let BusEvent::Frame { frame, .. } = heard.recv().await.unwrap()
            && frame.to_string() == "703#00"
        {
            break;
        }
    }
    // It takes a start only after its initialisation.
    tokio::time::sleep(Duration::from_secs(2)).await;
    if started {
        say.send(&"000#0103".parse().unwrap()).await.unwrap();
    }
    let (watch, _) = virtual_bus::join(bus, clock);
    let watching = tokio::spawn(frames(watch, stop.clone()));
    let (report, end) = scan(&interface, options(active), clock, stop.clone()).await.unwrap();
    assert_eq!(end, End::default());
    stop.cancel();
    simulator.await.unwrap().unwrap();
    (report, watching.await.unwrap())
}

#[tokio::test(start_paused = true)]
async fn a_scan_that_listens_sends_nothing_and_names_the_detcon() {
    let (report, frames) = scan_beside_a_detcon("scan-listens", true, false).await;
    assert!(
        frames.iter().all(|frame| ["183#", "283#", "383#", "483#"].iter().any(|id| frame.starts_with(id)))
    );
    let [node] = report.nodes.as_slice() else { panic!("{report:?}") };
    assert_eq!((node.id, node.heard), (3, true));
    assert_eq!(
        node.mappings.iter().map(|found| found.mapping.as_str()).collect::<Vec<_>>(),
        ["motortech-detcon"]
    );
    assert!(node.mappings[0].probable);
    assert!(!report.other_master && !report.active);
    let table = report.table();
    assert!(table.contains("MOTORTECH DetCon") && table.contains("TPDO4 6 bytes every 500 ms"), "{table}");
}

#[tokio::test(start_paused = true)]
async fn an_active_scan_finds_a_node_that_waits_for_its_start_and_is_no_sdo_server() {
    let (report, frames) = scan_beside_a_detcon("scan-active", false, true).await;
    let ours: Vec<&str> = frames.iter().map(String::as_str).filter(|frame| *frame != "703#7F").collect();
    let sdo: Vec<String> = (1..=10).map(|id| format!("6{id:02X}#4000100000000000")).collect();
    let guard: Vec<String> = (1..=10).map(|id| format!("7{id:02X}#R1")).collect();
    assert_eq!(ours, [sdo, guard].concat());
    let [node] = report.nodes.as_slice() else { panic!("{report:?}") };
    assert_eq!((node.id, node.state.as_deref()), (3, Some("pre_operational")));
    assert_eq!(node.error_control.as_deref(), Some("guarding"));
    assert!(!report.other_master, "our own guard requests make nobody a master");
    assert!(report.table().contains("answers guard requests"), "{}", report.table());
}

#[tokio::test(start_paused = true)]
async fn a_scan_that_is_stopped_tells_what_it_has_found() {
    let (clock, stop) = (Clock::start(), CancellationToken::new());
    let (_reader, mut writer) = virtual_bus::join("scan-stopped", clock);
    let interface = "virtual:scan-stopped".parse().unwrap();
    let ending = stop.clone();
    tokio::spawn(async move {
        tokio::time::sleep(Duration::from_secs(1)).await;
        writer.send(&"705#05".parse().unwrap()).await.unwrap();
        tokio::time::sleep(Duration::from_secs(1)).await;
        ending.cancel();
        std::future::pending::<()>().await;
    });
    let (report, _) = scan(&interface, options(false), clock, stop).await.unwrap();
    assert_eq!(report.nodes.iter().map(|node| node.id).collect::<Vec<_>>(), [5]);
    assert!(clock.now().instant < Instant::from_millis(4000));
}

/// A report of frames at times in ms.
fn report(frames: &[(u64, &str)]) -> ScanReport {
    let mut survey = Survey::new(Instant::START, options(false));
    for (at, frame) in frames {
        survey.handle_frame(Now::from_millis(*at), &frame.parse().unwrap());
    }
    let mut report = ScanReport::of(&survey.census, "can0", Some(125_000), 0, false);
    report.nodes = survey.nodes();
    report
}

#[test]
fn the_table_says_what_was_seen_and_what_may_be_wrong() {
    let report = report(&[
        (0, "701#R1"),
        (1, "701#05"),
        (500, "701#R1"),
        (501, "701#85"),
        (510, "181#00FF80017FFE3340"),
        (520, "181#1027000000"),
        (530, "085#11F0210000000000"),
        (540, "604#4000100000000000"),
        (550, "080#"),
        (560, "7C1#0102"),
        (570, "000#0100"),
    ]);
    let table = report.table();
    for part in [
        "node  state ",
        "   1  operational  unknown ",
        "TPDO1 5 or 8 bytes every 10 ms, guarded by another master every 500 ms",
        "not heard itself",
        "EMCY 0xF011 (1 times)",
        "! two devices may share node id 1: frames of different lengths on one TPDO identifier",
        "another master is at work: start all (1 times)",
        "SYNC: 1 frames of 0 bytes, its producer cannot be told",
        "unknown identifier 7C1: 1 frames of 2 bytes",
    ] {
        assert!(table.contains(part), "`{part}` in\n{table}");
    }
}

#[test]
fn json_survives_a_round_trip() {
    let report = report(&[(0, "705#00"), (10, "705#05"), (510, "705#05"), (511, "185#1027000000")]);
    let json = text(&report, ScanFormat::Json);
    assert_eq!(serde_json::from_str::<ScanReport>(&json).unwrap(), report);
    assert!(json.contains("\"heartbeat_ms\": 500"), "{json}");
}

#[test]
fn an_empty_bus_is_said_to_be_empty() {
    assert_eq!(report(&[]).table(), "no node was heard\n");
}

/// A scan of a bus with these devices, of which all that were there by then were started; then those `late` came.
async fn scan_of(
    bus: &str,
    devices: &[(Kind, u8, &str)],
    late: &[(Kind, u8, &str)],
    active: bool,
) -> ScanReport {
    let (clock, stop) = (Clock::start(), CancellationToken::new());
    let interface: Interface = format!("virtual:{bus}").parse().unwrap();
    let (_heard, mut say) = virtual_bus::join(bus, clock);
    let mut running = Vec::new();
    for (batch, start) in [(devices, true), (late, false)] {
        for (kind, node, scenario) in batch {
            let device = SimOptions {
                kind: *kind,
                interface: interface.clone(),
                node: NodeId::new(*node).unwrap().into(),
                count: 1,
                serial: Vec::new(),
                scenario: Some((*scenario).to_owned()),
                seed: 1,
            };
            let run = sim::run(device, std::io::Cursor::new(""), std::io::sink(), clock, stop.clone());
            running.push(tokio::spawn(run));
        }
        tokio::time::sleep(Duration::from_secs(2)).await;
        if start {
            say.send(&"000#0100".parse().unwrap()).await.unwrap();
        }
    }
    let (report, _) = scan(&interface, options(active), clock, stop.clone()).await.unwrap();
    stop.cancel();
    for device in running {
        device.await.unwrap().unwrap();
    }
    report
}

/// Node id, best mapping, whether it is sure, whether two devices are suspected.
fn named(report: &ScanReport) -> Vec<(u8, &str, bool, bool)> {
    let named = report.nodes.iter().map(|node| {
        let best = node.mappings.first();
        let (mapping, sure) = best.map_or(("", false), |best| (best.mapping.as_str(), best.probable));
        (node.id, mapping, sure, !node.suspicions.is_empty())
    });
    named.collect()
}

#[tokio::test(start_paused = true)]
async fn r_dst_001_five_seconds_of_listening_name_both_devices_as_surely_as_they_can_be() {
    let devices = [(Kind::Detcon, 3, "quiet"), (Kind::DstP92c, 5, "demo"), (Kind::DstP92c, 6, "quiet")];
    let report = scan_of("scan-both", &devices, &[], false).await;
    assert_eq!(
        named(&report),
        [(3, "motortech-detcon", true, false), (5, "danfoss-dst-p92c", false, false)],
        "node 6 waits for SYNC and is not heard"
    );
    assert!(report.table().contains("perhaps Danfoss DST P92C"), "{}", report.table());
}

#[tokio::test(start_paused = true)]
async fn r_dst_001_who_is_asked_is_named_beyond_doubt_and_init_takes_its_mapping() {
    let devices = [(Kind::Detcon, 3, "quiet"), (Kind::DstP92c, 5, "demo"), (Kind::DstP92c, 6, "quiet")];
    let report = scan_of("scan-both-asked", &devices, &[], true).await;
    assert_eq!(
        named(&report),
        [
            (3, "motortech-detcon", true, false),
            (5, "danfoss-dst-p92c", true, false),
            (6, "danfoss-dst-p92c", true, false)
        ]
    );
    assert!(report.nodes[2].mappings[0].certain);
    let table = report.table();
    for part in ["TPDO1 only after SYNC (transmission type 1), once started", "no heartbeat", "serial 123461"]
    {
        assert!(table.contains(part), "`{part}` in\n{table}");
    }
    let text = super::super::init::configuration(&report, "hall-1");
    let source = crate::mapping::SourceText::new("nowhere/cangate.toml", text.as_str());
    let none = std::io::ErrorKind::NotFound;
    let loaded = crate::config::load(&source, [], &mut |_| Err(none.into())).unwrap();
    let nodes: Vec<_> = loaded.table.nodes.iter().map(|node| (node.name.as_str(), node.number())).collect();
    assert_eq!(nodes, [("detcon-3", 3), ("dst-p92c-5", 5), ("dst-p92c-6", 6)], "{text}");
    assert_eq!(loaded.warnings, []);
}

#[tokio::test(start_paused = true)]
async fn a_transmitter_that_shares_the_node_id_of_a_detcon_is_told_by_what_it_says() {
    let late = [(Kind::DstP92c, 3, "quiet")];
    let report = scan_of("scan-clash", &[(Kind::Detcon, 3, "quiet")], &late, true).await;
    assert_eq!(named(&report), [(3, "danfoss-dst-p92c", true, true)]);
    let table = report.table();
    let told = "! two devices may share node id 3: it says to be Danfoss DST P92C, but its process data are those of \
                MOTORTECH DetCon";
    assert!(table.contains(told), "{table}");
}

#[tokio::test(start_paused = true)]
async fn two_transmitters_from_their_boxes_are_told_by_their_answers() {
    let devices = [(Kind::DstP92c, 1, "quiet"), (Kind::DstP92c, 1, "bad_sensor")];
    let report = scan_of("scan-two", &devices, &[], true).await;
    assert_eq!(named(&report), [(1, "danfoss-dst-p92c", true, true)]);
    assert!(report.table().contains("requests were answered twice"), "{}", report.table());
}
