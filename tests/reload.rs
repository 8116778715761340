//! Another configuration is taken in while everything runs: nobody who is not concerned notices; a bad file changes nothing.

use std::collections::{BTreeMap, BTreeSet};
use std::net::{SocketAddr, TcpListener};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use cangate::can::interface::Interface;
use cangate::can::task::Sending;
use cangate::can::{self, BusEvent, BusIndex, CanFrame};
use cangate::config;
use cangate::mapping::SourceText;
use cangate::modbus::RegisterMap;
use cangate::modbus::writing::Writable;
use cangate::simulator::{self, task::BusEnd};
use cangate::supervisor::plan::Change;
use cangate::supervisor::wiring::ReloadSettings;
use cangate::supervisor::{self, Ended, Fresh, Installation, Plan, Refusal, Reloads, Sources, Tasks};
use cangate::time::{Clock, Instant};
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;
use tokio::sync::mpsc;
use tokio_modbus::client::{Context, Reader, tcp};
use tokio_modbus::slave::Slave;
use tokio_util::sync::CancellationToken;

use crate::support::mosquitto::{Mosquitto, Probe, Seen};
use crate::support::ports::free_address;
use crate::support::until;

pub fn fresh(text: &str) -> Result<Fresh, Refusal> {
    let source = SourceText::new("cangate.toml", text);
    let loaded = config::load(&source, [], &mut |_| Err(std::io::ErrorKind::NotFound.into()));
    let loaded = loaded.map_err(|problems| Refusal {
        problems: problems.iter().map(ToString::to_string).collect(),
        files: Vec::new(),
    })?;
    let settings = loaded.settings;
    let topic = settings.mqtt.clone().unwrap_or_default().base_topic;
    let writable = Writable::of(&loaded.access);
    let map = RegisterMap::build_for(&loaded.table, &settings.modbus, topic.as_str(), writable).unwrap();
    let installation = Installation {
        table: Arc::new(loaded.table),
        interfaces: loaded.interfaces,
        map: Arc::new(map),
        modbus: settings.modbus,
        mqtt: settings.mqtt,
        http: settings.http,
        cia309: settings.cia309,
        access: Arc::new(loaded.access),
        reload: ReloadSettings {
            mode: settings.gateway.reload,
            allow_map_change: settings.gateway.allow_map_change,
        },
    };
    Ok(Fresh { installation, sources: Sources::default(), warnings: Vec::new() })
}

/// A request of HTTP, and the body of its answer.
async fn get(address: SocketAddr, path: &str) -> Option<String> {
    let mut stream = TcpStream::connect(address).await.ok()?;
    stream.write_all(format!("GET {path} HTTP/1.0\r\n\r\n").as_bytes()).await.ok()?;
    let mut answer = String::new();
    stream.read_to_string(&mut answer).await.ok()?;
    let (head, body) = answer.split_once("\r\n\r\n")?;
    // Not an answer: who asks more often than an address may (429) asks again later.
    head.starts_with("HTTP/1.0 200").then(|| body.to_owned())
}

pub async fn status(address: SocketAddr) -> serde_json::Value {
    until("the status is served", async || serde_json::from_str(&get(address, "/api/v1/status").await?).ok())
        .await
}

/// What a metric shows.
async fn metric(address: SocketAddr, name: &str) -> f64 {
    until(name, async || {
        let text = get(address, "/metrics").await?;
        let line = text.lines().find(|line| line.starts_with(name))?;
        Some(line.rsplit(' ').next()?.parse().unwrap())
    })
    .await
}

pub async fn reloads(address: SocketAddr) -> u64 {
    status(address).await["configuration"]["reloads"].as_u64().unwrap()
}

/// The engine that is there, and how the rest of the installation changes from one reload to the next.
fn variant(round: usize, bus: &str, modbus: SocketAddr, http: SocketAddr) -> String {
    let extra = match round % 5 {
        0 => "",
        1 => "[node.aaa]\nbus = 'can0'\nid = 77\nmapping = 'motortech-detcon'\n",
        2 => "[node.zzz]\nbus = 'can0'\nid = 78\nmapping = 'danfoss-dst-p92c'\n",
        3 => {
            "[bus.can9]\ninterface = 'virtual:nobody'\n[node.far]\nbus = 'can9'\nid = 79\nmapping = 'motortech-detcon'\n"
        }
        _ => {
            "[mqtt]\nurl = 'mqtt://127.0.0.1:1'\nbuffer_dir = ''\n[access.hmi]\nrole = 'operator'\nmodbus = ['10.0.0.7']\n"
        }
    };
    let idle = if round.is_multiple_of(2) { "idle_timeout_s = 600\n" } else { "" };
    format!(
        "version = 1\n[gateway]\nname = 'hall'\nallow_map_change = true\n[bus.can0]\ninterface = 'virtual:{bus}'\n\
         [node.engine1]\nbus = 'can0'\nid = 1\nmapping = 'motortech-detcon'\n{extra}\
         [modbus]\nlisten = ['{modbus}']\n{idle}[http]\nlisten = '{http}'\n"
    )
}

/// When the first engine was asked for its state.
type Requests = Arc<Mutex<Vec<Instant>>>;

/// The simulated engines, and one who takes note of the guard requests to the first.
async fn engines(bus: &str, clock: Clock, requests: Requests, stop: CancellationToken) {
    let interface = || Interface::Virtual(bus.to_owned());
    let (to_us, events) = mpsc::channel(256);
    let (transmit, to_send) = mpsc::channel(256);
    let (_, lines) = mpsc::channel(1);
    let (report, _) = mpsc::channel(1);
    let devices = simulator::task::run(
        simulator::demo(),
        BusEnd { events, transmit },
        lines,
        report,
        clock,
        stop.clone(),
    );
    let (to_spy, mut heard) = mpsc::channel(256);
    let (_silent, nothing) = mpsc::channel::<CanFrame>(1);
    let spy = async {
        while let Some((_, event)) = heard.recv().await {
            if let BusEvent::Frame { frame, at, .. } = event
                && frame.to_string() == "701#R1"
            {
                requests.lock().unwrap().push(at.instant);
            }
        }
    };
    tokio::join!(
        can::task::run(BusIndex(0), interface(), Sending::Untold, to_us, to_send, clock, stop.clone()),
        can::task::run(BusIndex(0), interface(), Sending::Never, to_spy, nothing, clock, stop.clone()),
        devices,
        spy
    );
}

/// Takes note of the moments in which this machine let no thread of ours run, from one to the other.
fn watch_for_stalls(clock: Clock, stop: CancellationToken) -> Arc<Mutex<Vec<(Instant, Instant)>>> {
    let stalls = Arc::<Mutex<Vec<(Instant, Instant)>>>::default();
    let noted = Arc::clone(&stalls);
    std::thread::spawn(move || {
        let mut before = clock.now().instant;
        while !stop.is_cancelled() {
            std::thread::sleep(Duration::from_millis(5));
            let now = clock.now().instant;
            if now.since(before) > Duration::from_millis(40) {
                noted.lock().unwrap().push((before, now));
            }
            before = now;
        }
    });
    stalls
}

/// So many reloads as the full proof takes; fewer where nobody asks for all.
fn rounds() -> usize {
    std::env::var("CANGATE_RELOADS").ok().and_then(|text| text.parse().ok()).unwrap_or(40)
}

#[tokio::test(flavor = "multi_thread", worker_threads = 3)]
async fn p29_s10_good_reloads_under_polling_drop_no_session_and_no_guard_request_and_a_bad_one_changes_nothing()
 {
    const BUS: &str = "polled-reloads";
    let (modbus, http) = (free_address(), free_address());
    let (clock, stop) = (Clock::start(), CancellationToken::new());
    let requests = Requests::default();
    let stalls = watch_for_stalls(clock, stop.clone());
    let mut tasks = Tasks::default();
    tasks.spawn("engines", engines(BUS, clock, Arc::clone(&requests), stop.clone()));
    let text = Arc::new(Mutex::new(variant(0, BUS, modbus, http)));
    let first = fresh(&text.lock().unwrap()).unwrap();
    let (ask, asked) = mpsc::channel(1);
    let shared = Arc::clone(&text);
    let reloads_of =
        Reloads { read: Some(Arc::new(move || fresh(&shared.lock().unwrap()))), ..Reloads::none(asked) };
    let bound = supervisor::bind(first.installation, clock).await.unwrap();
    let running = bound.run_with_reloads(tasks, stop.clone(), reloads_of);
    let proof = async {
        let mut plc: Context =
            until("Modbus listens", async || tcp::connect_slave(modbus, Slave(1)).await.ok()).await;
        until("the engine is read", async || {
            let registers = plc.read_input_registers(100, 20).await.unwrap().unwrap();
            registers.iter().all(|register| *register <= 10_000).then_some(())
        })
        .await;
        let begin = clock.now().instant;
        let mut polls = 0_u64;
        for round in 1..=rounds() {
            let bad = round % 8 == 7;
            let next = variant(round, BUS, modbus, http);
            *text.lock().unwrap() =
                if bad { next.replace("id = 1\n", "id = 1\nnonsense = 2\n") } else { next };
            let before = status(http).await;
            ask.send(()).await.unwrap();
            // Polled all the time, on one and the same connection.
            loop {
                for _ in 0..10 {
                    let registers = plc.read_input_registers(100, 20).await.unwrap().unwrap();
                    assert!(
                        registers.iter().all(|register| *register <= 10_000),
                        "round {round}: {registers:?}"
                    );
                    polls += 1;
                }
                let now = status(http).await;
                let count =
                    |status: &serde_json::Value, what: &str| status["configuration"][what].as_u64().unwrap();
                if bad && count(&now, "rejections") > count(&before, "rejections") {
                    let why = now["configuration"]["rejected"].as_str().unwrap();
                    assert!(why.contains("cangate.toml:10:1: error") && why.contains("nonsense"), "{why}");
                    assert_eq!(
                        now["nodes"].as_array().unwrap().len(),
                        before["nodes"].as_array().unwrap().len()
                    );
                    assert_eq!(now["map_hash"], before["map_hash"]);
                    break;
                }
                if !bad && count(&now, "reloads") > count(&before, "reloads") {
                    assert!(now["configuration"]["rejected"].is_null());
                    break;
                }
            }
        }
        let asked: Vec<Instant> =
            requests.lock().unwrap().iter().copied().filter(|at| *at >= begin).collect();
        let stalls = stalls.lock().unwrap().clone();
        let stalled =
            |from: Instant, to: Instant| stalls.iter().any(|stall| stall.0 <= to && from <= stall.1);
        let late: Vec<_> = asked.windows(2).filter(|pair| pair[1].since(pair[0]).as_millis() > 600).collect();
        println!(
            "{} reloads and {polls} polls in {:?}; {} guard requests, {} of them late, {} stalls of the machine",
            rounds(),
            clock.now().instant.since(begin),
            asked.len(),
            late.len(),
            stalls.len()
        );
        // One that is late was sent; where two guard times pass without any, one is missing.
        for pair in late.iter().filter(|pair| pair[1].since(pair[0]).as_millis() >= 1000) {
            assert!(stalled(pair[0], pair[1]), "no guard request from {:?} to {:?}", pair[0], pair[1]);
        }
        let now = status(http).await;
        let engine = now["nodes"].as_array().unwrap().iter().find(|node| node["name"] == "engine1").unwrap();
        for counter in ["restarts", "toggle_errors"] {
            assert_eq!(engine["counters"][counter].as_u64(), Some(0), "{counter}");
        }
        let missed = engine["counters"]["guard_misses"].as_u64().unwrap();
        assert!(missed <= u64::try_from(stalls.len()).unwrap(), "{missed} answers missed");
        assert_eq!(
            metric(http, "cangate_modbus_connections_total").await.to_bits(),
            1_f64.to_bits(),
            "one session"
        );
        assert_eq!(metric(http, "cangate_modbus_connections_open").await.to_bits(), 1_f64.to_bits());
        stop.cancel();
    };
    let (ended, ()) = tokio::join!(running, proof);
    assert_eq!(ended, Ended::Stopped);
}

/// A process that does not outlive its test.
struct Process(Child);

impl Process {
    fn start(command: &mut Command) -> Self {
        Self(command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap())
    }

    fn hang_up(&self) {
        kill(Pid::from_raw(self.0.id().try_into().unwrap()), Signal::SIGHUP).unwrap();
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

struct Site {
    folder: tempfile::TempDir,
    modbus: SocketAddr,
    http: SocketAddr,
}

impl Site {
    fn new() -> Self {
        Self { folder: tempfile::tempdir().unwrap(), modbus: free_address(), http: free_address() }
    }

    fn file(&self) -> PathBuf {
        self.folder.path().join("cangate.toml")
    }

    fn text(&self, more: &str) -> String {
        format!(
            "version = 1\n[gateway]\nname = 'hall'\n[bus.can0]\ninterface = 'cgtest-none'\n\
             [node.engine1]\nbus = 'can0'\nid = 1\nmapping = 'motortech-detcon'\n\
             [modbus]\nlisten = ['{}']\n[http]\nlisten = '{}'\n{more}",
            self.modbus, self.http
        )
    }

    fn write(&self, text: &str) {
        std::fs::write(self.file(), text).unwrap();
    }

    fn command(&self) -> Command {
        let mut command = Command::new(env!("CARGO_BIN_EXE_cangate"));
        let state: &Path = self.folder.path();
        command.args(["run", "-c"]).arg(self.file()).arg("--state-dir").arg(state);
        command
    }

    async fn configuration(&self) -> serde_json::Value {
        status(self.http).await["configuration"].clone()
    }

    async fn rejected(&self, rejections: u64) -> String {
        until("the file is refused", async || {
            let configuration = self.configuration().await;
            let refused = configuration["rejections"].as_u64().unwrap() >= rejections;
            refused.then(|| configuration["rejected"].as_str().unwrap_or_default().to_owned())
        })
        .await
    }

    async fn reloaded(&self, times: u64) {
        until("the file is taken in", async || (reloads(self.http).await >= times).then_some(())).await;
    }

    async fn nodes(&self) -> Vec<String> {
        let status = status(self.http).await;
        status["nodes"]
            .as_array()
            .unwrap()
            .iter()
            .map(|node| node["name"].as_str().unwrap().to_owned())
            .collect()
    }

    /// Waits for a state of an alarm of the gateway: the image tells of it a moment after the count of reloads.
    async fn alarm_is(&self, name: &str, state: &str) {
        until(&format!("{name} {state}"), async || {
            let status = status(self.http).await;
            let alarm =
                status["alarms"].as_array().unwrap().iter().find(|alarm| alarm["name"] == name)?.clone();
            (alarm["state"] == state).then_some(())
        })
        .await;
    }
}

const SECOND: &str = "[node.engine2]\nbus = 'can0'\nid = 2\nmapping = 'motortech-detcon'\n";

#[tokio::test]
async fn p28_p29_g05_sighup_takes_in_a_good_file_and_a_bad_one_changes_nothing_but_status_event_and_alarm() {
    let site = Site::new();
    site.write(&site.text(""));
    let gateway = Process::start(&mut site.command());
    let mut plc =
        until("Modbus listens", async || tcp::connect_slave(site.modbus, Slave(1)).await.ok()).await;
    assert_eq!(site.nodes().await, ["engine1"]);
    site.write(&site.text(SECOND));
    gateway.hang_up();
    site.reloaded(1).await;
    assert_eq!(site.nodes().await, ["engine1", "engine2"]);
    plc.read_input_registers(100, 2).await.unwrap().unwrap();
    // Half a file, an empty one, a key that there is not, a node that is gone from a published address, one that cannot be read.
    let whole = site.text(SECOND);
    for (time, (text, expected)) in (1..).zip([
        (whole[..whole.len() - 30].to_owned(), "cangate.toml:"),
        (String::new(), "version"),
        (site.text("[modbvs]\n"), "cangate.toml:14:2: error"),
        (site.text(""), "published addresses"),
    ]) {
        site.write(&text);
        gateway.hang_up();
        let why = site.rejected(time).await;
        assert!(why.contains(expected), "{why}");
        assert_eq!(site.nodes().await, ["engine1", "engine2"]);
        site.alarm_is("configuration_rejected", "unacknowledged").await;
        plc.read_input_registers(100, 2).await.unwrap().unwrap();
    }
    let events = until("the events are served", async || get(site.http, "/api/v1/events").await).await;
    assert!(
        events.contains("\"configuration_rejected\"") && events.contains("cangate.toml:14:2"),
        "{events}"
    );
    site.write(&site.text("").replace("name = 'hall'", "name = 'hall'\nallow_map_change = true"));
    gateway.hang_up();
    site.reloaded(2).await;
    assert_eq!(site.nodes().await, ["engine1"]);
    assert!(site.configuration().await["rejected"].is_null());
    site.alarm_is("configuration_rejected", "returned_unacknowledged").await;
    plc.read_input_registers(100, 2).await.unwrap().unwrap();
    assert_eq!(metric(site.http, "cangate_modbus_connections_total").await.to_bits(), 1_f64.to_bits());
}

#[tokio::test]
async fn a_file_that_changed_is_taken_in_where_that_is_asked_for_and_listeners_move() {
    let site = Site::new();
    let watch = |text: String| text.replace("name = 'hall'", "name = 'hall'\nreload = 'watch'");
    site.write(&watch(site.text("")));
    let _gateway = Process::start(&mut site.command());
    until("Modbus listens", async || tcp::connect_slave(site.modbus, Slave(1)).await.ok()).await;
    let elsewhere = free_address();
    let text = watch(site.text(SECOND)).replace(&site.modbus.to_string(), &elsewhere.to_string());
    site.write(&text);
    site.reloaded(1).await;
    let mut plc =
        until("Modbus listens there", async || tcp::connect_slave(elsewhere, Slave(2)).await.ok()).await;
    plc.read_input_registers(100, 2).await.unwrap().unwrap();
    assert!(TcpStream::connect(site.modbus).await.is_err(), "and no longer where it did");
    // An address that is taken refuses the whole file.
    let taken = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = taken.local_addr().unwrap().to_string();
    site.write(&text.replace(&elsewhere.to_string(), &address));
    let why = site.rejected(1).await;
    assert!(why.contains(&address), "{why}");
    plc.read_input_registers(100, 2).await.unwrap().unwrap();
}

#[tokio::test]
async fn p29_a_listener_widens_and_narrows_on_its_own_port() {
    let site = Site::new();
    site.write(&site.text(""));
    let gateway = Process::start(&mut site.command());
    let port = site.modbus.port();
    let at = async |host: &str| tcp::connect_slave(format!("{host}:{port}").parse().unwrap(), Slave(1)).await;
    until("Modbus listens", async || at("127.0.0.1").await.ok()).await;
    site.write(&site.text("").replace(&site.modbus.to_string(), &format!("0.0.0.0:{port}")));
    gateway.hang_up();
    site.reloaded(1).await;
    assert!(site.configuration().await["rejected"].is_null());
    until("it is wider", async || at("127.0.0.2").await.ok()).await;
    site.write(&site.text(""));
    gateway.hang_up();
    site.reloaded(2).await;
    until("Modbus listens", async || at("127.0.0.1").await.ok()).await;
    assert!(at("127.0.0.2").await.is_err(), "it is narrower");
    // A host that is not this one's is found out before anything is touched, also at a port of ours.
    site.write(&site.text("").replace(&site.modbus.to_string(), &format!("0.0.0.0:{port}")));
    gateway.hang_up();
    site.reloaded(3).await;
    site.write(&site.text("").replace(&site.modbus.to_string(), &format!("192.0.2.7:{port}")));
    gateway.hang_up();
    let why = site.rejected(1).await;
    assert!(why.contains(&format!("cannot listen on 192.0.2.7:{port}")), "{why}");
    at("127.0.0.2").await.unwrap();
}

#[tokio::test]
async fn p29_as_many_clients_as_the_new_limits_say_are_served_at_once() {
    let site = Site::new();
    let limit = |more: &str| site.text("").replace("[modbus]\n", &format!("[modbus]\n{more}\n"));
    site.write(&limit("max_connections = 1"));
    let gateway = Process::start(&mut site.command());
    // Of three that ask, each on a connection of its own, so many are still there in the end.
    let served = async || {
        let mut clients: Vec<Context> = Vec::new();
        for _ in 0..3 {
            clients.push(
                until("a connection", async || tcp::connect_slave(site.modbus, Slave(1)).await.ok()).await,
            );
            clients.last_mut().unwrap().read_input_registers(100, 2).await.unwrap().unwrap();
        }
        let mut served = 0;
        for client in &mut clients {
            served += u8::from(client.read_input_registers(100, 2).await.is_ok());
        }
        served
    };
    assert_eq!(served().await, 1);
    for (reload, more, expected) in [
        (1, "max_connections = 2", 2),
        (2, "max_connections = 8", 3),
        (3, "max_connections = 8\nmax_connections_per_client = 1", 1),
        (4, "max_connections = 8\nmax_connections_per_client = 0", 3),
    ] {
        site.write(&limit(more));
        gateway.hang_up();
        site.reloaded(reload).await;
        assert_eq!(served().await, expected, "{more}");
    }
}

#[tokio::test]
async fn g05_a_listener_that_was_lost_is_tried_again_until_it_listens_and_the_alarm_stays_till_then() {
    let site = Site::new();
    site.write(&site.text(""));
    let gateway = Process::start(&mut site.command());
    let port = site.modbus.port();
    let connect = async || tcp::connect_slave(site.modbus, Slave(1)).await.ok();
    until("Modbus listens", connect).await;
    // Nobody can see that this is in the way before the gateway's own listener is gone.
    let in_the_way = TcpListener::bind(format!("127.0.0.2:{port}")).unwrap();
    let wide = format!("0.0.0.0:{port}");
    site.write(&site.text("").replace(&site.modbus.to_string(), &wide));
    gateway.hang_up();
    site.reloaded(1).await;
    let why = site.configuration().await["rejected"].as_str().unwrap().to_owned();
    assert!(why.contains("Modbus is not served any more") && why.contains(&wide), "{why}");
    site.alarm_is("configuration_rejected", "unacknowledged").await;
    assert!(connect().await.is_none());
    // The same file again: still in the way.
    gateway.hang_up();
    let why = site.rejected(1).await;
    assert!(why.contains(&wide), "{why}");
    site.alarm_is("configuration_rejected", "unacknowledged").await;
    drop(in_the_way);
    gateway.hang_up();
    site.reloaded(2).await;
    until("Modbus listens again", connect).await;
    assert!(site.configuration().await["rejected"].is_null());
    site.alarm_is("configuration_rejected", "returned_unacknowledged").await;
}

#[tokio::test]
async fn s10_without_file_descriptors_nothing_is_taken_in_and_nothing_falls_back_to_defaults() {
    let site = Site::new();
    site.write(&site.text(""));
    let mut limited = Command::new("sh");
    limited.args(["-c", "ulimit -n 64; exec \"$@\"", "sh"]);
    limited.arg(env!("CARGO_BIN_EXE_cangate")).args(["run", "-c"]).arg(site.file());
    let gateway = Process::start(&mut limited);
    let mut plc =
        until("Modbus listens", async || tcp::connect_slave(site.modbus, Slave(1)).await.ok()).await;
    site.write(&site.text(SECOND));
    // Connections take every descriptor that there is; those that ask stay.
    let mut crowd = Vec::new();
    for _ in 0..100 {
        if let Ok(Ok(stream)) =
            tokio::time::timeout(Duration::from_millis(200), tcp::connect_slave(site.modbus, Slave(1))).await
        {
            crowd.push(stream);
        }
        plc.read_input_registers(100, 2).await.unwrap().unwrap();
    }
    gateway.hang_up();
    tokio::time::sleep(Duration::from_secs(1)).await;
    plc.read_input_registers(100, 2).await.unwrap().unwrap();
    drop(crowd);
    // Either it was read in a moment in which a descriptor came free, or it was refused; never a part of it.
    let now = until("the status is served", async || {
        serde_json::from_str(&get(site.http, "/api/v1/status").await?).ok()
    });
    let now: serde_json::Value = now.await;
    let refused = now["configuration"]["rejected"].as_str().map(str::to_owned);
    let nodes = site.nodes().await;
    match refused {
        Some(why) => {
            assert!(why.contains("cannot read"), "{why}");
            assert_eq!(nodes, ["engine1"]);
        }
        None => assert_eq!(nodes, ["engine1", "engine2"]),
    }
    gateway.hang_up();
    until("the file is taken in", async || (site.nodes().await == ["engine1", "engine2"]).then_some(()))
        .await;
    plc.read_input_registers(100, 2).await.unwrap().unwrap();
}

#[tokio::test]
async fn p29_a_stop_is_heard_while_a_file_is_read_that_does_not_answer() {
    let text = Site::new().text("");
    let (begun, mut reading) = mpsc::channel(1);
    let (answer, held_up) = std::sync::mpsc::sync_channel::<()>(1);
    let held_up = Mutex::new(held_up);
    let read = move || {
        begun.blocking_send(()).unwrap();
        let _nobody_answers = held_up.lock().unwrap().recv();
        Err(Refusal::default())
    };
    let (ask, asked) = mpsc::channel(1);
    let reloads = Reloads { read: Some(Arc::new(read)), ..Reloads::none(asked) };
    let stop = CancellationToken::new();
    let bound = supervisor::bind(fresh(&text).unwrap().installation, Clock::start()).await.unwrap();
    let running = bound.run_with_reloads(Tasks::default(), stop.clone(), reloads);
    let stopping = async {
        ask.send(()).await.unwrap();
        reading.recv().await.unwrap();
        stop.cancel();
    };
    let both = Box::pin(async { tokio::join!(running, stopping) });
    let (ended, ()) = tokio::time::timeout(Duration::from_secs(30), both).await.unwrap();
    assert_eq!(ended, Ended::Stopped);
    drop(answer);
}

#[tokio::test]
async fn d_2_a_bad_file_at_the_start_begins_with_the_last_good_one_and_says_so() {
    let site = Site::new();
    site.write("version = 1\nnonsense = 1\n");
    let output = site.command().output().unwrap();
    assert_eq!(output.status.code(), Some(78), "there is no last good one");
    site.write(&site.text(""));
    drop({
        let gateway = Process::start(&mut site.command());
        until("Modbus listens", async || tcp::connect_slave(site.modbus, Slave(1)).await.ok()).await;
        until("it is kept", async || site.folder.path().join("last-good.json").exists().then_some(())).await;
        gateway
    });
    site.write("version = 1\nnonsense = 1\n");
    let other = site.folder.path().join("other.toml");
    std::fs::copy(site.file(), &other).unwrap();
    let mut of_another = Command::new(env!("CARGO_BIN_EXE_cangate"));
    let of_another = of_another.args(["run", "-c"]).arg(other).arg("--state-dir").arg(site.folder.path());
    assert_eq!(
        of_another.output().unwrap().status.code(),
        Some(78),
        "that is the last good one of another file"
    );
    let gateway = Process::start(&mut site.command());
    let why = site.rejected(1).await;
    assert!(why.contains("cangate.toml:2:1: error"), "{why}");
    assert_eq!(site.nodes().await, ["engine1"]);
    site.alarm_is("configuration_rejected", "unacknowledged").await;
    site.write(&site.text(SECOND));
    gateway.hang_up();
    site.reloaded(1).await;
    assert_eq!(site.nodes().await, ["engine1", "engine2"]);
}

#[test]
fn check_against_prints_what_a_reload_changes_and_whether_it_is_refused() {
    let site = Site::new();
    site.write(&site.text(""));
    let new = site.folder.path().join("new.toml");
    let run = |text: &str| {
        std::fs::write(&new, text).unwrap();
        let mut command = Command::new(env!("CARGO_BIN_EXE_cangate"));
        let output = command.arg("check").arg(&new).arg("--against").arg(site.file()).output().unwrap();
        (output.status.code(), String::from_utf8(output.stdout).unwrap())
    };
    assert_eq!(run(&site.text("# words only\n")), (Some(0), "nothing changes\n".to_owned()));
    let (code, said) = run(&site.text(SECOND));
    assert_eq!(code, Some(0), "{said}");
    assert!(said.contains("node engine2: new") && said.contains("1 of 2 nodes go on as they are"), "{said}");
    let (code, said) = run(&site.text("").replace("id = 1", "id = 1\noffset = 300"));
    assert_eq!(code, Some(1), "{said}");
    assert!(said.contains("how nodes are shown changes; all go on as they are"), "{said}");
    assert!(said.contains("map: moved: engine1/knock_intensity_1") && said.contains("refuses"), "{said}");
    let (code, said) = run(&site.text("[cia309]\nlisten = '127.0.0.1:0'\n"));
    assert_eq!((code, said.as_str()), (Some(0), "CiA 309-3: connections are closed and it begins anew\n"));
}

/// Numbers of the events that the broker was given, by their stream.
fn event_numbers(probe: &Probe) -> BTreeMap<String, BTreeSet<u64>> {
    let mut numbers: BTreeMap<String, BTreeSet<u64>> = BTreeMap::new();
    for seen in probe.seen().iter().filter(|seen| seen.topic == "cangate/hall/event") {
        let event: serde_json::Value = serde_json::from_slice(&seen.payload).unwrap();
        let stream = numbers.entry(event["sid"].as_str().unwrap().to_owned()).or_default();
        stream.insert(event["seq"].as_u64().unwrap());
    }
    numbers
}

#[tokio::test]
async fn p29_the_session_with_the_broker_and_its_stream_of_events_survive_a_reload() {
    let Some(broker) = Mosquitto::start().await else { return };
    let probe = Probe::start(broker.address, "probe").await;
    let site = Site::new();
    let mqtt = |more: &str| {
        let (address, folder) = (broker.address, site.folder.path().join("buffer"));
        format!("[mqtt]\nurl = 'mqtt://{address}'\nbuffer_dir = '{}'\n{more}", folder.display())
    };
    let allow = |text: String| text.replace("name = 'hall'", "name = 'hall'\nallow_map_change = true");
    site.write(&site.text(&mqtt("")));
    let gateway = Process::start(&mut site.command());
    let is = |topic: &'static str, text: &'static str| {
        move |seen: &Seen| {
            let of = seen.topic.strip_prefix("cangate/hall/");
            of == Some(topic) && String::from_utf8_lossy(&seen.payload).contains(text)
        }
    };
    probe.wait_for("the birth", 0, is("bridge/state", "online")).await;
    let sessions = async || metric(site.http, "cangate_mqtt_sessions_total").await.to_bits();

    site.write(&site.text(&(SECOND.to_owned() + &mqtt(""))));
    gateway.hang_up();
    site.reloaded(1).await;
    probe.wait_for("the new node", 0, is("engine2/state", "tags")).await;
    // One that goes leaves nothing behind.
    site.write(&allow(site.text(&mqtt(""))));
    gateway.hang_up();
    site.reloaded(2).await;
    let is_cleared = |seen: &Seen| seen.topic == "cangate/hall/engine2/state" && seen.payload.is_empty();
    probe.wait_for("what is kept of it is cleared", 0, is_cleared).await;
    assert_eq!(sessions().await, 1_f64.to_bits());
    assert!(!probe.seen().iter().any(is("bridge/state", "offline")), "it was there all the time");

    // Another session is begun where one is asked for, and the store goes on.
    let from = probe.seen().len();
    site.write(&allow(site.text(&mqtt("keep_alive_s = 30\n"))));
    gateway.hang_up();
    site.reloaded(3).await;
    probe.wait_for("the farewell", from, is("bridge/state", "offline")).await;
    // A state may still be of the session before; and the count is told a moment after the session is there.
    let session = async |number: f64| {
        until("the next session", async || (sessions().await == number.to_bits()).then_some(())).await;
    };
    session(2.0).await;
    probe.wait_for("a state", from, is("engine1/state", "tags")).await;
    let from = probe.seen().len();
    site.write(&allow(site.text(&mqtt("keep_alive_s = 30\nbuffer_bytes = 10000000\n"))));
    gateway.hang_up();
    site.reloaded(4).await;
    session(3.0).await;
    probe.wait_for("the birth", from, is("bridge/state", "online")).await;
    // A broker that comes only now is told from where the stream on disk ends.
    let from = probe.seen().len();
    site.write(&allow(site.text("")));
    gateway.hang_up();
    site.reloaded(5).await;
    probe.wait_for("the farewell", from, is("bridge/state", "offline")).await;
    let from = probe.seen().len();
    site.write(&allow(site.text(&mqtt(""))));
    gateway.hang_up();
    site.reloaded(6).await;
    probe.wait_for("the next session", from, is("bridge/state", "online")).await;
    let newest = metric(site.http, "cangate_events_total").await;
    let told = until("all events are told", async || {
        let numbers = event_numbers(&probe);
        let last = numbers.values().filter_map(BTreeSet::last).max().copied()?;
        (last >= 6).then_some(numbers)
    })
    .await;
    assert!(newest > 0.0);
    assert_eq!(told.len(), 1, "one stream: {:?}", told.keys());
    let numbers = told.values().next().unwrap();
    let expected: BTreeSet<u64> = (1..=*numbers.last().unwrap()).collect();
    assert_eq!(*numbers, expected, "without a gap");
}

#[tokio::test]
async fn p29_each_event_is_told_once_and_under_one_number_whatever_folder_the_store_gets() {
    let Some(broker) = Mosquitto::start().await else { return };
    let probe = Probe::start(broker.address, "probe").await;
    let site = Site::new();
    let with_folder = |folder: &str, idle: u64| {
        // Where there is no folder, another table comes with it.
        let more = if folder.is_empty() { SECOND } else { "" };
        let path = if folder.is_empty() { folder.into() } else { site.folder.path().join(folder) };
        let path = path.display();
        let mqtt = format!("{more}[mqtt]\nurl = 'mqtt://{}'\nbuffer_dir = '{path}'\n", broker.address);
        let text = site.text(&mqtt).replace("[modbus]\n", &format!("[modbus]\nidle_timeout_s = {idle}\n"));
        text.replace("name = 'hall'", "name = 'hall'\nallow_map_change = true")
    };
    let identity = |event: &serde_json::Value| ["ts", "name", "to", "text"].map(|key| event[key].to_string());
    // What was told, by its number. QoS 1 may give a message again, where a PUBACK came too late: under its own number.
    let told = || {
        let mut told = BTreeMap::new();
        for seen in probe.seen().into_iter().filter(|seen| seen.topic == "cangate/hall/event") {
            let event: serde_json::Value = serde_json::from_slice(&seen.payload).unwrap();
            let number = (event["sid"].to_string(), event["seq"].as_u64().unwrap());
            let first = told.entry(number).or_insert_with(|| identity(&event));
            assert_eq!(*first, identity(&event), "another event has this number: {event}");
        }
        told
    };
    // The same, without those of another run, as the gateway has it in its journal.
    let told_since = |other_run: &BTreeMap<_, _>| -> Vec<[String; 4]> {
        let of_this = told().into_iter().filter(|(number, _)| !other_run.contains_key(number));
        let mut events: Vec<_> = of_this.map(|(_, event)| event).collect();
        events.sort();
        events
    };
    let journal = async || -> Vec<[String; 4]> {
        let text = until("the events are served", async || get(site.http, "/api/v1/events").await).await;
        let events: serde_json::Value = serde_json::from_str(&text).unwrap();
        let mut events: Vec<_> = events["events"].as_array().unwrap().iter().map(identity).collect();
        events.sort();
        events
    };
    let all_told = async |other_run: &BTreeMap<_, _>, what: &str| {
        until(what, async || (told_since(other_run).len() >= journal().await.len()).then_some(())).await;
    };
    // Another run leaves a long stream in a folder.
    site.write(&with_folder("long", 600));
    let before = Process::start(&mut site.command());
    let none = BTreeMap::new();
    for reload in 1..=12 {
        all_told(&none, "all that came before").await;
        site.write(&with_folder("long", 600 + reload));
        before.hang_up();
        site.reloaded(reload).await;
    }
    all_told(&none, "the long stream").await;
    drop(before);

    let before = told();
    site.write(&with_folder("one", 600));
    let gateway = Process::start(&mut site.command());
    all_told(&before, "the start").await;
    for (reload, folder) in (1..).zip(["two", "long", "", "one", "long"]) {
        site.write(&with_folder(folder, 600 + reload));
        gateway.hang_up();
        site.reloaded(reload).await;
        all_told(&before, folder).await;
        assert_eq!(told_since(&before), journal().await, "{folder}");
    }
}

#[test]
fn only_what_changed_begins_anew() {
    let plan = |old: &str, new: &str| {
        let text = |more: &str| {
            format!(
                "version = 1\n[gateway]\nname = 'hall'\n[bus.can0]\ninterface = 'virtual:plan'\n\
                 [node.engine1]\nbus = 'can0'\nid = 1\nmapping = 'motortech-detcon'\n{more}"
            )
        };
        Plan::new(&fresh(&text(old)).unwrap().installation, &fresh(&text(new)).unwrap().installation)
    };
    let is = |plan: &Plan| {
        let doors = [plan.modbus, plan.security, plan.rtu, plan.http, plan.cia309, plan.serial];
        (doors.map(u8::from), plan.mqtt, plan.sparkplug, plan.access, plan.core.is_some())
    };
    let security = "[modbus.security]\nlisten = ['127.0.0.1:8020']\ncert_file = 'c'\nkey_file = 'k'\n\
                    client_ca_file = 'a'\nroles = [{ name = 'r', rights = ['read'] }]\n";
    let rtu = "[[modbus.rtu]]\ndevice = '/dev/ttyS9'\n";
    let mqtt = "[mqtt]\nbuffer_dir = ''\n";
    let access = "[access.hmi]\nrole = 'operator'\nmodbus = ['10.0.0.7']\n";
    let (none, same) = (Change::None, Change::Exchange);
    let other = |text: &str, from: &str, to: &str| text.replace(from, to);
    for (old, new, expected) in [
        ("", "", ([0, 0, 0, 0, 0, 0], none, none, false, false)),
        ("", "[modbus]\nidle_timeout_s = 9\n", ([0, 0, 0, 0, 0, 0], none, none, false, false)),
        ("", "[modbus]\nallow = ['10.0.0.0/8']\n", ([1, 0, 0, 0, 0, 0], none, none, false, false)),
        ("", security, ([0, 1, 0, 0, 0, 0], none, none, false, false)),
        (security, &other(security, "'k'", "'l'"), ([0, 1, 0, 0, 0, 0], none, none, false, false)),
        (
            security,
            &format!("[modbus]\nmax_connections = 9\n{security}"),
            ([1, 1, 0, 0, 0, 0], none, none, false, false),
        ),
        ("", rtu, ([0, 0, 1, 0, 0, 0], none, none, false, false)),
        ("", access, ([0, 0, 0, 0, 0, 0], none, none, true, false)),
        ("", mqtt, ([0, 0, 0, 0, 0, 0], Change::Anew, none, false, false)),
        (mqtt, &format!("{mqtt}keep_alive_s = 30\n"), ([0, 0, 0, 0, 0, 0], same, none, false, false)),
        (mqtt, &other(mqtt, "''", "'/x'"), ([0, 0, 0, 0, 0, 0], Change::Anew, none, false, false)),
        (
            mqtt,
            &format!("{mqtt}[mqtt.sparkplug]\nenabled = true\n"),
            ([0, 0, 0, 0, 0, 0], same, Change::Anew, false, false),
        ),
        (mqtt, &format!("{SECOND}{mqtt}"), ([0, 0, 0, 0, 0, 0], same, none, false, true)),
    ] {
        assert_eq!(is(&plan(old, new)), expected, "{old:?} to {new:?}");
    }
    let begins = |new: &str| plan(mqtt, new).lines.iter().any(|line| line.contains("session ends"));
    assert!(!begins(&format!("{mqtt}qos_state = 0\n")) && begins(&format!("{mqtt}inflight = 9\n")));
}
