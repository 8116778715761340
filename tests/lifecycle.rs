//! The program as a process: exit codes, start without the outside world, stop, demo.

use std::ffi::OsStr;
use std::io::{BufRead, BufReader, Read};
use std::net::{SocketAddr, TcpListener};
use std::os::unix::ffi::OsStrExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};

use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio_modbus::client::{Context, Reader, tcp};
use tokio_modbus::slave::Slave;

use crate::support::ports::free_address;
use crate::support::{PATIENCE, until};

/// The program under test.
fn cangate() -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_cangate"));
    command.env_remove("CANGATE_LOG").stdin(Stdio::null());
    command
}

fn run(arguments: &[&str]) -> Output {
    cangate().args(arguments).output().unwrap()
}

/// A process that does not outlive its test.
struct Running(Child);

impl Running {
    fn start(command: &mut Command) -> Self {
        Self(command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap())
    }

    fn signal(&self, signal: Signal) {
        kill(Pid::from_raw(self.0.id().try_into().unwrap()), signal).unwrap();
    }

    /// Its exit code and what it said.
    fn wait(mut self) -> (Option<i32>, String) {
        let status = self.0.wait().unwrap();
        let mut said = String::new();
        self.0.stderr.take().unwrap().read_to_string(&mut said).unwrap();
        (status.code(), said)
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

fn configuration(folder: &Path, bus: &str, modbus: SocketAddr, http: SocketAddr) -> PathBuf {
    let file = folder.join("cangate.toml");
    let text = format!(
        "version = 1\n[gateway]\nname = \"test\"\n[bus.can0]\ninterface = \"{bus}\"\n\
         [node.engine1]\nbus = \"can0\"\nid = 1\nmapping = \"motortech-detcon\"\n\
         [modbus]\nlisten = [\"{modbus}\"]\n[http]\nlisten = \"{http}\"\n\
         [mqtt]\nurl = \"mqtt://127.0.0.1:1\"\n"
    );
    std::fs::write(&file, text).unwrap();
    file
}

/// A Modbus client to a unit, once somebody listens.
async fn connect(address: SocketAddr, unit: u8) -> Context {
    until("the Modbus server listens", async || tcp::connect_slave(address, Slave(unit)).await.ok()).await
}

#[test]
fn a_wrong_command_line_exits_with_64() {
    for arguments in
        [&["rnu"][..], &["run", "--nonsense"], &["sim", "detcon", "-i", "can0", "--node", "128"], &[]]
    {
        let output = run(arguments);
        assert_eq!(output.status.code(), Some(64), "{arguments:?}");
        assert!(!output.stderr.is_empty());
    }
}

#[test]
fn help_and_version_exit_with_0() {
    for arguments in [&["--help"][..], &["--version"], &["run", "--help"]] {
        assert_eq!(run(arguments).status.code(), Some(0), "{arguments:?}");
    }
}

#[test]
fn a_wrong_configuration_exits_with_78_and_says_where() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("cangate.toml");
    std::fs::write(&file, "version = 1\n[gateway]\nname = \"x\"\n[bus.can0]\ninterfase = \"can0\"\n")
        .unwrap();
    let file = file.to_str().unwrap();
    for arguments in [&["run", "-c", file][..], &["check", file], &["map", "-c", file]] {
        let output = run(arguments);
        let said = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(78), "{arguments:?}: {said}");
        assert!(said.contains(&format!("{file}:5:1")), "{said}");
        assert!(said.contains("hint"), "{said}");
    }
}

#[test]
fn a_file_that_cannot_be_read_exits_with_74_and_is_named_whatever_the_command() {
    let folder = tempfile::tempdir().unwrap();
    let good = configuration(folder.path(), "can0", free_address(), free_address());
    let good = good.to_str().unwrap();
    let missing = "/nowhere/file";
    for arguments in [
        &["run", "-c", missing][..],
        &["check", missing],
        &["check", good, missing],
        &["map", "-c", missing],
        &["map", "diff", missing, missing],
        &["replay", missing, "-c", good],
        &["replay", missing, "-c", missing],
        &["sim", "detcon", "-i", "cgtest-none", "--node", "1", "--scenario", missing],
        &["health", "-c", missing],
    ] {
        let output = run(arguments);
        let said = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(74), "{arguments:?}: {said}");
        assert!(said.contains(missing), "{arguments:?}: {said}");
    }
}

#[test]
fn a_file_whose_content_is_wrong_exits_with_78_whatever_the_command() {
    let folder = tempfile::tempdir().unwrap();
    let good = configuration(folder.path(), "can0", free_address(), free_address());
    let (good, wrong) = (good.to_str().unwrap(), folder.path().join("wrong"));
    std::fs::write(&wrong, "this is nothing\n").unwrap();
    let wrong = wrong.to_str().unwrap();
    for arguments in [
        &["run", "-c", wrong][..],
        &["check", wrong],
        &["map", "-c", wrong],
        &["map", "diff", wrong, wrong],
        &["replay", wrong, "-c", good],
        &["sim", "detcon", "-i", "cgtest-none", "--node", "1", "--scenario", wrong],
    ] {
        let output = run(arguments);
        let said = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(78), "{arguments:?}: {said}");
        assert!(!said.is_empty(), "{arguments:?}");
    }
}

#[test]
fn variables_that_are_no_text_are_a_message_where_they_are_ours_and_nothing_elsewhere() {
    let folder = tempfile::tempdir().unwrap();
    let file = configuration(folder.path(), "can0", free_address(), free_address());
    let file = file.to_str().unwrap();
    let odd = OsStr::from_bytes(b"\xFF");
    for arguments in [&["check", file][..], &["map", "-c", file]] {
        let foreign = cangate().args(arguments).env("LESSOPEN", odd).output().unwrap();
        assert_eq!(foreign.status.code(), Some(0), "{}", String::from_utf8_lossy(&foreign.stderr));
        let ours = cangate().args(arguments).env("CANGATE__GATEWAY__NAME", odd).output().unwrap();
        let said = String::from_utf8_lossy(&ours.stderr);
        assert_eq!(ours.status.code(), Some(78), "{said}");
        assert!(said.contains("environment variable CANGATE__GATEWAY__NAME: error"), "{said}");
    }
}

#[test]
fn a_taken_port_exits_with_74_and_names_it() {
    let folder = tempfile::tempdir().unwrap();
    let taken = TcpListener::bind("127.0.0.1:0").unwrap();
    let file = configuration(folder.path(), "virtual:taken", taken.local_addr().unwrap(), free_address());
    let output = run(&["run", "-c", file.to_str().unwrap()]);
    let said = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(74), "{said}");
    assert!(said.contains(&taken.local_addr().unwrap().to_string()), "{said}");
}

#[tokio::test]
async fn without_can_and_without_a_broker_modbus_answers_with_invalid_values_and_sigterm_ends_it_with_0() {
    let folder = tempfile::tempdir().unwrap();
    let (modbus, http) = (free_address(), free_address());
    let file = configuration(folder.path(), "cgtest-none", modbus, http);
    let gateway = Running::start(cangate().args(["run", "-c", file.to_str().unwrap()]));
    let mut client = connect(modbus, 1).await;
    assert_eq!(client.read_input_registers(100, 2).await.unwrap().unwrap(), [0xFFFF, 0xFFFF]);
    let node = client.read_input_registers(0, 4).await.unwrap().unwrap();
    assert_eq!(
        (node[1] & 1, node[2], node[3]),
        (0, 0xFFFF, 65535),
        "not online, state unknown, never received"
    );
    gateway.signal(Signal::SIGTERM);
    let (code, said) = tokio::task::spawn_blocking(move || gateway.wait()).await.unwrap();
    assert_eq!(code, Some(0), "{said}");
}

#[test]
fn the_passive_role_and_only_it_opens_an_adapter_to_listen_only() {
    for (role, opening) in [("passive", "L"), ("master", "O")] {
        let adapter = TcpListener::bind("127.0.0.1:0").unwrap();
        let folder = tempfile::tempdir().unwrap();
        // Two lines of the file in the place of one.
        let bus = format!("slcan+tcp://{}\"\nrole = \"{role}", adapter.local_addr().unwrap());
        let file = configuration(folder.path(), &bus, free_address(), free_address());
        let _gateway = Running::start(cangate().args(["run", "-c", file.to_str().unwrap()]));
        let (stream, _) = adapter.accept().unwrap();
        stream.set_read_timeout(Some(PATIENCE)).unwrap();
        let commands =
            BufReader::new(stream).split(b'\r').map(|line| String::from_utf8(line.unwrap()).unwrap());
        let commands: Vec<String> = commands.filter(|line| !line.is_empty()).take(2).collect();
        assert_eq!(commands, ["C", opening], "{role}");
    }
}

#[tokio::test]
async fn health_exits_with_0_while_the_gateway_is_ready_and_with_1_when_it_is_not() {
    let folder = tempfile::tempdir().unwrap();
    let (modbus, http) = (free_address(), free_address());
    let file = configuration(folder.path(), "cgtest-none", modbus, http);
    let file = file.to_str().unwrap();
    let ask = |what: &[&str]| run(&[&["health"], what].concat());
    assert_eq!(ask(&["-c", file]).status.code(), Some(1), "nobody listens yet");
    let gateway = Running::start(cangate().args(["run", "-c", file]));
    connect(modbus, 1).await;
    until("the gateway is ready", async || (ask(&["-c", file]).status.code() == Some(0)).then_some(())).await;
    assert_eq!(ask(&[&format!("http://{http}/livez")]).status.code(), Some(0));
    let absent = ask(&[&format!("http://{http}/absent")]);
    assert_eq!(absent.status.code(), Some(1));
    assert!(String::from_utf8_lossy(&absent.stderr).contains("answers 404"));
    assert_eq!(ask(&["ftp://x"]).status.code(), Some(64));
    gateway.signal(Signal::SIGTERM);
    let (code, said) = tokio::task::spawn_blocking(move || gateway.wait()).await.unwrap();
    assert_eq!(code, Some(0), "{said}");
    assert_eq!(ask(&["-c", file]).status.code(), Some(1), "it has gone");
}

#[tokio::test]
async fn the_demo_shows_values_and_prints_what_to_connect_where() {
    let (modbus, mqtt, http) = (free_address(), free_address(), free_address());
    let [modbus_text, mqtt_text, http_text] = [modbus, mqtt, http].map(|address| address.to_string());
    let mut arguments = vec!["demo", "--modbus", &modbus_text, "--mqtt", &mqtt_text, "--http", &http_text];
    arguments.extend(["--serial", "127.0.0.1:0"]);
    let mut demo = Running::start(cangate().args(arguments));
    let mut lines = BufReader::new(demo.0.stdout.take().unwrap()).lines();
    let said: Vec<String> =
        tokio::task::spawn_blocking(move || lines.by_ref().map_while(Result::ok).take(13).collect())
            .await
            .unwrap();
    let said = said.join("\n");
    for part in [
        "mbpoll",
        &modbus.port().to_string(),
        "mosquitto_sub",
        &mqtt.port().to_string(),
        &format!("http://{http}/"),
        "hydraulics",
        "'cangate/demo/serial/serial/+/rx'",
    ] {
        assert!(said.contains(part), "`{part}` is missing in:\n{said}");
    }
    let balance = said.lines().find(|line| line.contains("balance")).unwrap();
    let [address, port] = [2, 3].map(|word| balance.split_whitespace().nth(word).unwrap());
    let mut client = connect(modbus, 1).await;
    let value = until("engine 1 has a knock intensity", async || {
        let registers = client.read_input_registers(100, 20).await.ok()?.ok()?;
        registers.iter().all(|register| *register <= 10_000).then_some(registers)
    });
    assert_eq!(value.await.len(), 20);
    let mut hydraulics = connect(modbus, 5).await;
    let pressure = until("the transmitter is configured and has a pressure", async || {
        let registers = hydraulics.read_input_registers(100, 2).await.ok()?.ok()?;
        let pressure = f32::from_bits(u32::from(registers[0]) << 16 | u32::from(registers[1]));
        (100.0..450.0).contains(&pressure).then_some(pressure)
    });
    assert!(pressure.await > 0.0, "in bar, not in the psi of its shipping state");
    let mut line = tokio::net::TcpStream::connect(format!("{address}:{port}")).await.unwrap();
    line.write_all(b"S\n").await.unwrap();
    let mut weight = [0; 19];
    tokio::time::timeout(PATIENCE, line.read_exact(&mut weight)).await.unwrap().unwrap();
    assert!(weight.starts_with(b"S S ") && weight.ends_with(b" kg\r\n"), "{}", weight.escape_ascii());
    demo.signal(Signal::SIGINT);
    let (code, said) = tokio::task::spawn_blocking(move || demo.wait()).await.unwrap();
    assert_eq!(code, Some(0), "{said}");
}

#[test]
fn check_accepts_what_is_shipped() {
    let mappings = Path::new(env!("CARGO_MANIFEST_DIR")).join("mappings");
    let mut files = 0;
    for entry in std::fs::read_dir(mappings).unwrap() {
        let file = entry.unwrap().path();
        if file.extension().is_some_and(|extension| extension == "toml") {
            files += 1;
            let output = run(&["check", file.to_str().unwrap()]);
            assert_eq!(output.status.code(), Some(0), "{}", String::from_utf8_lossy(&output.stderr));
            assert!(
                output.stderr.is_empty(),
                "a shipped file has a warning: {}",
                String::from_utf8_lossy(&output.stderr)
            );
        }
    }
    assert!(files > 0);
}

#[test]
fn map_writes_json_that_diff_finds_equal_and_a_moved_address_exits_with_1() {
    let folder = tempfile::tempdir().unwrap();
    let file = configuration(folder.path(), "can0", free_address(), free_address());
    let file = file.to_str().unwrap();
    let (old, new) = (folder.path().join("old.json"), folder.path().join("new.json"));
    let (old, new) = (old.to_str().unwrap(), new.to_str().unwrap());
    assert_eq!(run(&["map", "-c", file, "--format", "json", "-o", old]).status.code(), Some(0));
    assert_eq!(run(&["map", "diff", old, old]).status.code(), Some(0));
    let text = std::fs::read_to_string(old).unwrap();
    let map: serde_json::Value = serde_json::from_str(&text).unwrap();
    let point =
        map["points"].as_array().unwrap().iter().find(|point| point["tag"] == "knock_intensity_1").unwrap();
    assert_eq!((point["address"].as_u64(), point["reference"].as_str()), (Some(100), Some("300101")));
    let moved = std::fs::read_to_string(file).unwrap().replace("id = 1\n", "id = 1\noffset = 300\n");
    std::fs::write(file, moved).unwrap();
    assert_eq!(run(&["map", "-c", file, "--format", "json", "-o", new]).status.code(), Some(0));
    let diff = run(&["map", "diff", old, new]);
    assert_eq!(diff.status.code(), Some(1));
    assert!(String::from_utf8(diff.stdout).unwrap().contains("knock_intensity_1"));
}

#[test]
fn schemas_are_json_and_completions_are_not_empty() {
    for of in ["config", "mapping"] {
        let schema: serde_json::Value = serde_json::from_slice(&run(&["schema", of]).stdout).unwrap();
        assert!(schema["$schema"].is_string(), "{of}");
    }
    for shell in ["bash", "zsh", "fish"] {
        assert!(run(&["completions", shell]).stdout.len() > 1_000, "{shell}");
    }
}

#[test]
fn man_prints_the_page_of_the_program_or_writes_one_for_each_command() {
    let page = String::from_utf8(run(&["man"]).stdout).unwrap();
    assert!(page.contains(".TH cangate 1") && page.contains(".SH SYNOPSIS"), "{page}");
    let folder = tempfile::tempdir().unwrap();
    assert_eq!(run(&["man", "-o", folder.path().to_str().unwrap()]).status.code(), Some(0));
    for name in ["cangate.1", "cangate-run.1", "cangate-map-diff.1"] {
        let page = std::fs::read_to_string(folder.path().join(name)).unwrap();
        assert!(page.contains(".SH NAME"), "{name}");
    }
    assert_eq!(run(&["man", "-o", "/nowhere"]).status.code(), Some(74));
}

#[test]
fn replay_gives_the_same_output_every_time() {
    let folder = tempfile::tempdir().unwrap();
    let file = configuration(folder.path(), "can0", free_address(), free_address());
    let log = folder.path().join("bus.log");
    let text = "(1763760000.000000) can0 701#05\n(1763760000.100000) can0 181#00FF80017FFE3340\n(1763760000.200000) can0 381#02800F0F000099CC\n";
    std::fs::write(&log, text).unwrap();
    let replay = || run(&["replay", log.to_str().unwrap(), "-c", file.to_str().unwrap()]);
    let (first, second) = (replay(), replay());
    assert_eq!(first.status.code(), Some(0), "{}", String::from_utf8_lossy(&first.stderr));
    assert_eq!(first.stdout, second.stdout);
    let said = String::from_utf8(first.stdout).unwrap();
    assert!(said.contains("knock_intensity_2") && said.contains("trip"), "{said}");
}
