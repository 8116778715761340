//! The program, killed with signal 9 again and again beside a real mosquitto; a checker of its own (`oracle/received.py`) judges
//! what a subscriber received. `CANGATE_KILLS` says how often; few unless given.

use std::fs::File;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpListener, TcpStream};
use tokio::task::JoinSet;

use crate::support::ports::free_address;
use crate::support::until;

const MAPPING: &str = r#"
format = 1

[device]
vendor = "Test"
model = "Toggle"
description = "It trips all the time."

[tpdo.1]
cob_id = "$NODEID+0x180"
length = 2
timeout_ms = 60000

[[tag]]
name = "level"
description = "A number."
tpdo = 1
bit = 0
type = "u8"

[[tag]]
name = "trip"
description = "A bit."
tpdo = 1
bit = 8
type = "bool"

[[alarm]]
name = "trip"
when = "trip"
value = "level"
priority = "high"
text = "It tripped."
action = "Nothing."
"#;

/// A child that does not outlive its test.
pub(crate) struct Running(pub(crate) Child);

impl Running {
    pub(crate) fn start(command: &mut Command) -> Self {
        Self(command.stdin(Stdio::null()).spawn().unwrap())
    }

    pub(crate) fn signal(&mut self, signal: Signal) {
        kill(Pid::from_raw(self.0.id().try_into().unwrap()), signal).unwrap();
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// Whether the programs that this needs are there; in CI they have to be.
pub(crate) fn has_judges() -> bool {
    let missing = ["mosquitto -h", "mosquitto_sub --help", "python3 --version"].into_iter().find(|command| {
        let (program, argument) = command.split_once(' ').unwrap();
        let found = Command::new(program).arg(argument).stdout(Stdio::null()).stderr(Stdio::null()).status();
        found.is_err()
    });
    if let Some(missing) = missing {
        assert!(std::env::var_os("CI").is_none(), "`{missing}` does not run, and CI has to run this test");
        eprintln!("skipped: `{missing}` does not run (apt-get install mosquitto mosquitto-clients python3)");
    }
    missing.is_none()
}

/// An adapter whose bus has one device: its trip comes and goes fifty times a second, and its state ten times, until it is to be
/// `quiet`.
pub(crate) async fn adapter(quiet: Arc<AtomicBool>) -> SocketAddr {
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let address = listener.local_addr().unwrap();
    tokio::spawn(async move {
        let (mut level, mut ticks) = (0_u8, 0_u32);
        loop {
            let Ok((mut stream, _)) = listener.accept().await else { return };
            let mut is_open = false;
            let mut tick = tokio::time::interval(Duration::from_millis(20));
            loop {
                let mut bytes = [0; 256];
                let going = tokio::select! {
                    read = stream.read(&mut bytes) => match read {
                        Ok(count) if count > 0 => {
                            let text = String::from_utf8_lossy(&bytes[..count]).into_owned();
                            is_open |= text.contains('L') || text.contains('O');
                            let answers: String =
                                text.matches(['\r', 'F']).map(|found| if found == "F" { "F00" } else { "\r" }).collect();
                            stream.write_all(answers.as_bytes()).await.is_ok()
                        }
                        _ => false,
                    },
                    _ = tick.tick(), if is_open => {
                        let is_quiet = quiet.load(Ordering::Acquire);
                        level = level.wrapping_add(u8::from(!is_quiet));
                        ticks = ticks.wrapping_add(1);
                        let state = if is_quiet || ticks % 10 == 0 { "05" } else { "7F" };
                        let state = if ticks % 5 == 0 { format!("t7011{state}\r") } else { String::new() };
                        let frames = format!("t1812{level:02X}{:02X}\r{state}", level & 1);
                        stream.write_all(frames.as_bytes()).await.is_ok()
                    }
                };
                if !going {
                    break;
                }
            }
        }
    });
    address
}

/// The way to the broker, which can be cut.
pub(crate) struct Way {
    pub(crate) address: SocketAddr,
    open: Arc<AtomicBool>,
}

impl Way {
    pub(crate) async fn to(broker: SocketAddr) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let address = listener.local_addr().unwrap();
        let open = Arc::new(AtomicBool::new(true));
        let is_open = Arc::clone(&open);
        tokio::spawn(async move {
            let mut connections = JoinSet::new();
            let mut look = tokio::time::interval(Duration::from_millis(10));
            loop {
                tokio::select! {
                    accepted = listener.accept() => {
                        let Ok((mut near, _)) = accepted else { return };
                        if is_open.load(Ordering::Acquire) {
                            connections.spawn(async move {
                                let mut far = TcpStream::connect(broker).await?;
                                tokio::io::copy_bidirectional(&mut near, &mut far).await
                            });
                        }
                    }
                    _ = look.tick() => {
                        if !is_open.load(Ordering::Acquire) {
                            connections.abort_all();
                        }
                        while connections.try_join_next().is_some() {}
                    }
                }
            }
        });
        Self { address, open }
    }

    pub(crate) fn set(&self, open: bool) {
        self.open.store(open, Ordering::Release);
    }
}

/// mosquitto, and a subscriber that writes all it gets into a file.
pub(crate) struct Broker {
    pub(crate) address: SocketAddr,
    received: PathBuf,
    _processes: [Running; 2],
}

impl Broker {
    pub(crate) async fn start(folder: &Path) -> Self {
        let address = free_address();
        let file = folder.join("mosquitto.conf");
        let text = format!(
            "listener {} 127.0.0.1\nallow_anonymous true\npersistence false\nmax_queued_messages 0\nmax_inflight_messages 0\n",
            address.port()
        );
        std::fs::write(&file, text).unwrap();
        let broker = Running::start(
            Command::new("mosquitto").arg("-c").arg(&file).stdout(Stdio::null()).stderr(Stdio::null()),
        );
        until("mosquitto listens", async || TcpStream::connect(address).await.ok()).await;
        let received = folder.join("received");
        let subscriber = Running::start(
            Command::new("mosquitto_sub")
                .args([
                    "-h",
                    "127.0.0.1",
                    "-p",
                    &address.port().to_string(),
                    "-q",
                    "1",
                    "-t",
                    "cangate/#",
                    "-t",
                    "probe",
                ])
                .args(["-F", "%t %p"])
                .stdout(File::create(&received).unwrap()),
        );
        let probe = address.port().to_string();
        let arguments = ["-h", "127.0.0.1", "-p", &probe, "-t", "probe", "-m", "x"];
        let has = received.clone();
        until("the subscriber has what is published", async || {
            Command::new("mosquitto_pub").args(arguments).status().ok()?;
            std::fs::read_to_string(&has).ok().filter(|text| text.contains("probe"))
        })
        .await;
        Self { address, received, _processes: [broker, subscriber] }
    }

    /// All that the subscriber got so far.
    pub(crate) fn text(&self) -> String {
        std::fs::read_to_string(&self.received).unwrap_or_default()
    }
}

pub(crate) async fn get(address: SocketAddr, path: &str) -> Option<String> {
    let mut stream = TcpStream::connect(address).await.ok()?;
    let request = format!("GET {path} HTTP/1.1\r\nHost: 127.0.0.1\r\nConnection: close\r\n\r\n");
    stream.write_all(request.as_bytes()).await.ok()?;
    let mut answer = String::new();
    stream.read_to_string(&mut answer).await.ok()?;
    let (head, body) = answer.split_once("\r\n\r\n")?;
    head.starts_with("HTTP/1.1 200").then(|| body.to_owned())
}

/// A sum of the values of a metric.
pub(crate) fn metric(text: &str, name: &str) -> f64 {
    let of = |line: &&str| line.starts_with(name) && line[name.len()..].starts_with([' ', '{']);
    text.lines().filter(of).filter_map(|line| line.rsplit_once(' ')?.1.parse::<f64>().ok()).sum()
}

pub(crate) fn configuration(
    folder: &Path,
    adapter: SocketAddr,
    broker: SocketAddr,
    http: SocketAddr,
) -> PathBuf {
    std::fs::create_dir_all(folder.join("mappings")).unwrap();
    std::fs::write(folder.join("mappings/toggle.toml"), MAPPING).unwrap();
    let buffer = folder.join("buffer");
    let text = format!(
        "version = 1\n[gateway]\nname = \"test\"\n[bus.can0]\ninterface = \"slcan+tcp://{adapter}\"\nrole = \"passive\"\n\
         [node.engine1]\nbus = \"can0\"\nid = 1\nmapping = \"toggle\"\n[modbus]\nlisten = []\n[http]\nlisten = \"{http}\"\n\
         [mqtt]\nurl = \"mqtt://{broker}\"\nreconnect_max_s = 1\nbuffer_dir = \"{}\"\n",
        buffer.display()
    );
    let file = folder.join("cangate.toml");
    std::fs::write(&file, text).unwrap();
    file
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn p1_p3_p5_p6_killed_again_and_again_with_the_broker_away_and_back_no_event_is_lost() {
    if !has_judges() {
        return;
    }
    let kills: u32 = std::env::var("CANGATE_KILLS").map_or(4, |kills| kills.parse().unwrap());
    let mut random = fastrand::Rng::with_seed(kills.into());
    let folder = tempfile::tempdir().unwrap();
    let broker = Broker::start(folder.path()).await;
    let way = Way::to(broker.address).await;
    let http = free_address();
    let quiet = Arc::new(AtomicBool::new(false));
    let file = configuration(folder.path(), adapter(Arc::clone(&quiet)).await, way.address, http);
    let start = || {
        let mut command = Command::new(env!("CARGO_BIN_EXE_cangate"));
        command.args(["run", "-c", file.to_str().unwrap()]).env("CANGATE_LOG", "warn");
        Running::start(command.stdout(Stdio::null()).stderr(File::create(folder.path().join("log")).unwrap()))
    };
    for kill in 0..kills {
        way.set(random.bool() || kill == 0);
        let mut gateway = start();
        for _ in 0..random.u32(1..4) {
            tokio::time::sleep(Duration::from_millis(random.u64(50..700))).await;
            way.set(random.u8(0..3) > 0);
        }
        gateway.signal(Signal::SIGKILL);
        gateway.0.wait().unwrap();
    }
    way.set(true);
    quiet.store(true, Ordering::Release);
    let mut gateway = start();
    let figures = judge(&mut gateway, &broker, http, folder.path()).await;
    println!("{kills} kills: {figures}");
    assert!(figures["events"].as_u64().unwrap() > u64::from(kills) * 5, "{figures}");
}

/// Waits until the broker has all, stops the gateway, and has the checker judge what the subscriber got; gives its figures.
pub(crate) async fn judge(
    gateway: &mut Running,
    broker: &Broker,
    http: SocketAddr,
    folder: &Path,
) -> serde_json::Value {
    let newest = until("all is with the broker", async || {
        let metrics = get(http, "/metrics").await?;
        let events: serde_json::Value = serde_json::from_str(&get(http, "/api/v1/events").await?).ok()?;
        let is_done = metric(&metrics, "cangate_mqtt_sessions_total") > 0.0
            && metric(&metrics, "cangate_mqtt_buffer_waiting") == 0.0
            && metrics.contains("cangate_mqtt_buffer_state 1");
        events["newest"].as_u64().filter(|_| is_done)
    })
    .await;
    until("the subscriber has the newest event", async || {
        (newest_event(&broker.text()) >= newest).then_some(())
    })
    .await;
    gateway.signal(Signal::SIGTERM);
    assert!(gateway.0.wait().unwrap().success());
    until("offline", async || broker.text().contains("{\"state\":\"offline\"}").then_some(())).await;
    let (is_good, said) = ask_oracle(&broker.received, newest);
    assert!(is_good, "{said}");
    // The checker sees a tail that is missing: the number is not from what it judges.
    let text = broker.text();
    let last = text.lines().rfind(|line| line.starts_with("cangate/test/event ")).unwrap();
    let cut = folder.join("cut");
    std::fs::write(&cut, text.replace(last, "cangate/test/nothing")).unwrap();
    let (is_good, said_of_cut) = ask_oracle(&cut, newest_event(&text));
    assert!(!is_good && said_of_cut.contains("the last event is"), "{said_of_cut}");
    let figures: serde_json::Value = serde_json::from_str(said.lines().next().unwrap()).unwrap();
    assert_eq!(figures["told_missed"], 0);
    figures
}

/// Whether the checker finds nothing wrong, and what it says.
fn ask_oracle(received: &Path, newest: u64) -> (bool, String) {
    let oracle = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/oracle/received.py");
    let judged = Command::new("python3").arg(oracle).arg(received).arg(newest.to_string()).output().unwrap();
    let said = [judged.stdout, judged.stderr].concat();
    (judged.status.success(), String::from_utf8_lossy(&said).into_owned())
}

/// The highest number of an event in what was received.
pub(crate) fn newest_event(text: &str) -> u64 {
    let events = text.lines().filter_map(|line| line.strip_prefix("cangate/test/event "));
    let number = |payload: &str| serde_json::from_str::<serde_json::Value>(payload).ok()?["seq"].as_u64();
    events.filter_map(number).max().unwrap_or(0)
}

#[tokio::test]
async fn p10_a_disk_that_cannot_be_used_is_an_alarm_and_is_taken_when_it_can_be() {
    let folder = tempfile::tempdir().unwrap();
    let http = free_address();
    let file = configuration(folder.path(), free_address(), free_address(), http);
    let place = folder.path().join("buffer");
    std::fs::write(&place, "a file where a folder should be").unwrap();
    let mut command = Command::new(env!("CARGO_BIN_EXE_cangate"));
    command.args(["run", "-c", file.to_str().unwrap()]).stdout(Stdio::null()).stderr(Stdio::null());
    let mut gateway = Running::start(&mut command);
    until("the alarm", async || {
        let status = get(http, "/api/v1/status").await?;
        status.contains("\"buffer_fault\"").then_some(())
    })
    .await;
    std::fs::remove_file(&place).unwrap();
    until("the disk is taken", async || {
        let metrics = get(http, "/metrics").await?;
        metrics.contains("cangate_mqtt_buffer_state 1").then_some(())
    })
    .await;
    gateway.signal(Signal::SIGTERM);
    assert!(gateway.0.wait().unwrap().success());
    let kept = std::fs::read(place.join("event-00000001.log")).unwrap();
    let kept = String::from_utf8_lossy(&kept);
    assert!(kept.contains("\"name\":\"gateway_started\""), "what memory held is on disk: {kept}");
}
