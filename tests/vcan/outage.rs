//! A broker that is away for long while the gateway of a whole plant is killed again and again.
//!
//! Twenty seconds and four kills unless told otherwise; `CANGATE_TEST_OUTAGE_S=1800 CANGATE_TEST_KILLS=200` is the long form. What
//! came is judged by `oracle/received.py`, which has no line of our code, and here by what the simulated plant did.

use std::collections::BTreeMap;
use std::path::Path;
use std::process::Command;
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use serde_json::Value;
use tempfile::TempDir;

use crate::harness::broker::Broker;
use crate::harness::bus::take_the_bus;
use crate::harness::gateway::{Gateway, Setup, simulator};
use crate::harness::process::Process;
use crate::harness::proxy::Cable;
use crate::harness::wait::{give_it, wait_for, wait_until, within};

const NODES: u8 = 16;
/// What each engine does all the time: it knocks, so that its values are sent ten times a second and never stand still, says that
/// it trips without a stop, and loses a sensor.
const STORY: &str = "description = \"It knocks and trips.\"\nrepeat_ms = 8000\n\
    [[step]]\nat_ms = 0\nfor_ms = 7900\ndo = \"knock 7 on\"\n\
    [[step]]\nat_ms = 1000\nfor_ms = 500\ndo = \"set trip 1\"\n\
    [[step]]\nat_ms = 4000\nfor_ms = 2000\ndo = \"sensor 3 bad\"\n";
/// A run that lasted so long before its kill has told states of all engines.
const SETTLED: Duration = Duration::from_secs(5);

fn number(variable: &str, otherwise: u64) -> u64 {
    std::env::var(variable).map_or(otherwise, |text| text.parse().unwrap())
}

fn now_ms() -> u64 {
    SystemTime::now().duration_since(UNIX_EPOCH).unwrap().as_millis() as u64
}

/// Events and states that a gateway found on its disk when it started, as it says.
fn found(gateway: &Gateway) -> [u64; 2] {
    let figure = |text: &str, name| {
        text.split(' ').find_map(|word| word.strip_prefix(name)).and_then(|text| text.parse().ok())
    };
    wait_for("what was found on the disk", || {
        let lines = gateway.process.stderr();
        let text = &lines.iter().find(|line| line.text.contains("INFO buffer "))?.text;
        Some([figure(text, "events=")?, figure(text, "samples=")?])
    })
}

/// Events and states that are kept for the broker.
fn waiting(gateway: &Gateway) -> Option<[u64; 2]> {
    let text = gateway.get("/metrics");
    let lines = text.lines().filter(|line| line.starts_with("cangate_mqtt_buffer_waiting{"));
    let figures: Vec<u64> =
        lines.filter_map(|line| line.rsplit(' ').next()?.trim_end_matches(".0").parse().ok()).collect();
    figures.try_into().ok()
}

/// Every message of the gateway, into a file.
fn record(broker: &Broker, file: &Path) -> Process {
    let mut shell = Command::new("sh");
    shell.args(["-c", "exec mosquitto_sub \"$@\" > \"$0\"", file.to_str().unwrap()]);
    shell.args(["-h", "127.0.0.1", "-p", &broker.port.to_string(), "-q", "1"]);
    shell.args(["-t", "cangate/#", "-t", "probe", "-F", "%t %p"]);
    let recorder = Process::start("mosquitto_sub", &mut shell);
    wait_until("the recorder to be subscribed", || {
        broker.publish("probe", "0");
        std::fs::read_to_string(file).is_ok_and(|text| text.contains("probe"))
    });
    recorder
}

/// The times of the states of all engines that were told, in ms since 1970, in order, by run.
fn times_of_states(text: &str) -> BTreeMap<String, Vec<u64>> {
    let mut times = BTreeMap::<String, Vec<u64>>::new();
    for line in text.lines() {
        let Some((topic, payload)) = line.split_once(' ') else { continue };
        let is_of_a_node =
            topic.contains("/engine") && (topic.ends_with("/state") || topic.ends_with("/history"));
        let Some(state) = is_of_a_node.then(|| serde_json::from_str::<Value>(payload).ok()).flatten() else {
            continue;
        };
        let (Some(sid), Some(at)) = (state["sid"].as_str(), state["ts"].as_u64()) else { continue };
        times.entry(sid.to_owned()).or_default().push(at);
    }
    for times in times.values_mut() {
        times.sort_unstable();
    }
    times
}

#[test]
fn p1_p3_a_plant_of_sixteen_engines_loses_no_event_while_the_broker_is_away_and_the_gateway_is_killed() {
    let (seconds, kills) = (number("CANGATE_TEST_OUTAGE_S", 20), number("CANGATE_TEST_KILLS", 4));
    let history = number("CANGATE_TEST_HISTORY_MS", 500);
    let _bus = take_the_bus();
    let folder = TempDir::new().unwrap();
    let received = folder.path().join("received");
    let broker = Broker::start();
    let _recorder = record(&broker, &received);
    let cable = Cable::to(&broker);
    let story = folder.path().join("story.toml");
    std::fs::write(&story, STORY).unwrap();
    let arguments = ["--count", &NODES.to_string(), "--scenario", story.to_str().unwrap()];
    let mut plant = simulator(1, &arguments);
    let buffer = folder.path().join("buffer");
    let mut gateway = Setup::detcons(&(1..=NODES).collect::<Vec<u8>>())
        .broker_port(cable.port)
        .mqtt_key(&format!(
            "reconnect_max_s = 1\nhistory_interval_ms = {history}\nbuffer_dir = \"{}\"",
            buffer.display()
        ))
        .node_key("guard_time_ms = 2000\npdo_timeout_ms = 20000")
        .start();
    for node in 1..=NODES {
        gateway.node(node).wait_for_status("good data", |status| status.all_good());
    }
    wait_until("a session", || cable.connections() > 0);

    cable.pull();
    cable.cut();
    let begin = Instant::now();
    let mut random = fastrand::Rng::with_seed(kills);
    let mut moments: Vec<u64> = (0..kills).map(|_| random.u64(0..seconds * 1000)).collect();
    moments.sort_unstable();
    let (mut killed, mut started, mut slowest) = (Vec::new(), begin, Duration::ZERO);
    let (mut all_kept, mut all_found) = (0, 0);
    for moment in moments {
        give_it(Duration::from_millis(moment).saturating_sub(begin.elapsed()));
        let kept = wait_for("the figures of the buffer", || waiting(&gateway));
        killed.push((now_ms(), started.elapsed()));
        gateway.process.kill();
        started = Instant::now();
        gateway.start_again();
        slowest = slowest.max(started.elapsed());
        let found = found(&gateway);
        assert!(
            found[0] >= kept[0] && found[1] >= kept[1],
            "of events and states {kept:?} were kept before the kill, {found:?} were found after it"
        );
        all_kept += kept[1];
        all_found += found[1];
    }
    give_it(Duration::from_secs(seconds).saturating_sub(begin.elapsed()));
    let (connections, away) = (cable.connections(), begin.elapsed());
    cable.plug();
    wait_until("the gateway to connect again", || cable.connections() > connections);
    // The engines stop, so that there is a newest event.
    plant.kill();
    let patience = Duration::from_secs(60 + seconds);
    let drained = within(patience, || {
        let is_empty = waiting(&gateway) == Some([0, 0]);
        let lost = gateway.get("/api/v1/events").matches("\"node_lost\"").count();
        (is_empty && lost >= usize::from(NODES)).then_some(())
    });
    assert!(drained.is_some(), "not all was sent within {patience:?}: {}", gateway.get("/metrics"));
    let events = gateway.get("/api/v1/events");
    let events: Value = serde_json::from_str(events.split_once("\r\n\r\n").unwrap().1).unwrap();
    let newest = events["newest"].as_u64().unwrap();
    // More may follow, as alarms have delays.
    wait_until("the newest event", || {
        let text = std::fs::read_to_string(&received).unwrap();
        let last = text.lines().rev().find_map(|line| line.strip_prefix("cangate/hall-1/event "));
        let last = last.and_then(|payload| serde_json::from_str::<Value>(payload).ok());
        last.is_some_and(|event| event["seq"].as_u64() >= Some(newest))
    });
    assert_eq!(gateway.process.terminate().code(), Some(0));

    let oracle = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/oracle/received.py");
    let judged = Command::new("python3").arg(oracle).arg(&received).arg(newest.to_string()).output().unwrap();
    let figures = String::from_utf8_lossy(&judged.stdout).into_owned();
    let text = std::fs::read_to_string(&received).unwrap();
    let told = times_of_states(&text);
    let settled: Vec<u64> = killed.iter().filter(|(_, ran)| *ran >= SETTLED).map(|(at, _)| *at).collect();
    let newest: Vec<u64> = told.values().filter_map(|times| times.last().copied()).collect();
    let missing = |at: &u64| Some(at - newest.iter().copied().filter(|newest| newest <= at).max()?);
    let mut missing: Vec<u64> = settled.iter().filter_map(missing).collect();
    // What lies between two states anyway is no loss: they are told at intervals, and by a machine that may stand still.
    let mut gaps: Vec<u64> = told
        .values()
        .flat_map(|times| times.windows(2).map(|pair| pair[1] - pair[0]))
        .filter(|gap| *gap > 0)
        .collect();
    missing.sort_unstable();
    gaps.sort_unstable();
    let middle_and_most = |sorted: &[u64]| (sorted.get(sorted.len() / 2).copied(), sorted.last().copied());
    println!(
        "broker away for {away:?}, {kills} kills, the slowest start {slowest:?}: {}; {all_kept} states kept before the \
         kills, {all_found} found after them; ms from the newest state to a kill \
         (median, most): {:?}; from one state to the next within a run: {:?}",
        figures.trim_end(),
        middle_and_most(&missing),
        middle_and_most(&gaps),
    );
    assert!(judged.status.success(), "{}", String::from_utf8_lossy(&judged.stderr));
    // How late the last of them was is printed: a machine that stands still before a kill is no loss.
    assert!(told.len() > settled.len(), "{} runs told states, {} lasted", told.len(), settled.len());
}
