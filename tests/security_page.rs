//! The page about security, run as it stands: its commands make certificates, with which a broker, the gateway and a PLC meet.

use std::io::{Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::path::Path;
use std::process::{Child, Command, Stdio};

use cangate::tls::TlsClientSettings;
use serde_json::Value;

use crate::support::ports::free_address;
use crate::support::secure_modbus::{READ, SecureClient};
use crate::support::until;

/// A program that does not outlive its test.
struct Running(Child);

impl Drop for Running {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// Whether a program is there; in CI it must be.
fn is_installed(program: &str, argument: &str) -> bool {
    let found = Command::new(program).arg(argument).stdout(Stdio::null()).stderr(Stdio::null()).status();
    if found.is_err() {
        assert!(std::env::var_os("CI").is_none(), "{program} is not installed, and CI has to run this test");
        eprintln!("skipped: {program} is not installed (apt-get install {program})");
    }
    found.is_ok()
}

/// Runs the commands of the page that make certificates, in a folder.
fn make_certificates(folder: &Path) {
    let page = std::fs::read_to_string(concat!(env!("CARGO_MANIFEST_DIR"), "/docs/security.md")).unwrap();
    let commands: Vec<&str> = page
        .split("```sh\n")
        .skip(1)
        .filter_map(|block| block.split("```").next())
        .filter(|block| block.starts_with("umask") || block.starts_with("openssl req"))
        .collect();
    assert_eq!(commands.len(), 5, "one for each step");
    let made = Command::new("bash").arg("-euc").arg(commands.concat()).current_dir(folder).output().unwrap();
    assert!(made.status.success(), "{}", String::from_utf8_lossy(&made.stderr));
}

/// `/api/v1/status`.
fn status(address: SocketAddr) -> Option<Value> {
    let mut stream = TcpStream::connect(address).ok()?;
    stream.write_all(b"GET /api/v1/status HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n").ok()?;
    let mut answer = String::new();
    stream.read_to_string(&mut answer).ok()?;
    let body = answer.split_once("\r\n\r\n")?.1;
    serde_json::from_str(&body[body.find('{')?..=body.rfind('}')?]).ok()
}

#[tokio::test]
async fn certificates_made_as_the_page_says_join_broker_gateway_and_plc() {
    if !is_installed("openssl", "version") || !is_installed("mosquitto", "-h") {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    make_certificates(folder.path());
    let file = |name: &str| folder.path().join(name).display().to_string();
    let [broker, modbus, secure, http] = [(); 4].map(|()| free_address());
    let mosquitto = format!(
        "listener {} 127.0.0.1\nuser root\nlog_type error\ncafile {}\ncertfile {}\nkeyfile {}\nrequire_certificate true\n\
         use_identity_as_username true\n",
        broker.port(),
        file("ca.pem"),
        file("broker.pem"),
        file("broker.key")
    );
    std::fs::write(folder.path().join("mosquitto.conf"), mosquitto).unwrap();
    let _mosquitto = Running(
        Command::new("mosquitto")
            .args(["-c", &file("mosquitto.conf")])
            .stderr(Stdio::null())
            .spawn()
            .unwrap(),
    );
    let configuration = format!(
        "version = 1\n[gateway]\nname = \"hall-1\"\n[bus.b]\ninterface = \"virtual:security\"\n\
         [node.engine1]\nbus = \"b\"\nid = 1\nmapping = \"motortech-detcon\"\n\
         [http]\nlisten = \"{http}\"\n[modbus]\nlisten = [\"{modbus}\"]\nreserved = [\"127.0.0.1\"]\n\
         [modbus.security]\nlisten = [\"{secure}\"]\ncert_file = \"{cert}\"\nkey_file = \"{key}\"\nclient_ca_file = \"{ca}\"\n\
         roles = [{{ name = \"Operator\", rights = [\"read\"] }}]\n\
         [mqtt]\nurl = \"mqtts://localhost:{port}\"\nreconnect_max_s = 1\n\
         [mqtt.tls]\nca_file = \"{ca}\"\ncert_file = \"{cert}\"\nkey_file = \"{key}\"\n",
        port = broker.port(),
        cert = file("gateway.pem"),
        key = file("gateway.key"),
        ca = file("ca.pem"),
    );
    std::fs::write(folder.path().join("cangate.toml"), configuration).unwrap();
    let program = || {
        let mut command = Command::new(env!("CARGO_BIN_EXE_cangate"));
        command.env_remove("CANGATE_LOG").stdin(Stdio::null());
        command
    };
    let checked = program().args(["check", &file("cangate.toml")]).output().unwrap();
    assert!(checked.status.success(), "{}", String::from_utf8_lossy(&checked.stderr));
    assert!(checked.stderr.is_empty(), "{}", String::from_utf8_lossy(&checked.stderr));
    let log = std::fs::File::create(folder.path().join("log")).unwrap();
    let _gateway = Running(program().args(["run", "-c", &file("cangate.toml")]).stderr(log).spawn().unwrap());

    let seen = until("the session with the broker", async || {
        status(http).filter(|status| status["mqtt"]["connected"] == true)
    })
    .await;
    let days: Vec<i64> = seen["certificates"]
        .as_array()
        .unwrap()
        .iter()
        .map(|life| life["days_left"].as_i64().unwrap())
        .collect();
    assert_eq!(days.len(), 2, "{}", seen["certificates"]);
    assert!(days.iter().all(|days| (363..3651).contains(days)), "{days:?}");

    let files = TlsClientSettings {
        ca_file: Some(file("ca.pem").into()),
        cert_file: Some(file("plc.pem").into()),
        key_file: Some(file("plc.key").into()),
    };
    let mut plc = SecureClient::connect(secure, &files).await.unwrap();
    assert_eq!(plc.ask(READ).await, Ok(vec![4, 2, 0x12, 0x34]));
    // An answer of the page is used again for a moment.
    let client = until("the PLC among the clients", async || {
        let clients = status(http)?["modbus_clients"].clone();
        clients.get(0).filter(|client| client["requests"] == 1).cloned()
    })
    .await;
    let seen = [&client["address"], &client["reserved"], &client["open"]];
    assert_eq!(seen, [&Value::from("127.0.0.1"), &true.into(), &1.into()]);
}
