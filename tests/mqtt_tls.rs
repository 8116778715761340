//! MQTT over TLS, against a real broker: mosquitto with certificates of a test's own authority.

use std::net::SocketAddr;
use std::path::PathBuf;
use std::process::{Child, Command, Stdio};
use std::time::Duration;

use cangate::gateway::command::Desk;
use cangate::mqtt::back_off::Pace;
use cangate::mqtt::client::run;
use cangate::mqtt::{Identity, MqttSettings, MqttStatus, Publisher};
use cangate::process_image::{ImageWriter, SessionTrouble, process_image};
use cangate::time::Clock;
use cangate::tls::TlsClientSettings;
use tokio::net::TcpListener;
use tokio::sync::watch;
use tokio::task::JoinHandle;
use tokio_util::sync::CancellationToken;

use crate::support::pki::{Authority, Folder, begins_tomorrow, expires_in};
use crate::support::ports::free_address;
use crate::support::{PATIENCE, plant};

/// mosquitto that wants TLS, and ends with the test.
struct Mosquitto {
    address: SocketAddr,
    process: Child,
}

impl Mosquitto {
    /// With `server.pem`, `server.key` and `ca.pem` of a folder; `more` are lines of its configuration. `None` where it is not
    /// installed; in CI that is a failure.
    async fn start(folder: &Folder, more: &str) -> Option<Self> {
        Self::start_at(free_address(), folder, more).await
    }

    async fn start_at(address: SocketAddr, folder: &Folder, more: &str) -> Option<Self> {
        let found = Command::new("mosquitto").arg("-h").stdout(Stdio::null()).stderr(Stdio::null()).status();
        if found.is_err() {
            assert!(
                std::env::var_os("CI").is_none(),
                "mosquitto is not installed, and CI has to run this test"
            );
            eprintln!("skipped: mosquitto is not installed (apt-get install mosquitto)");
            return None;
        }
        let file = |name: &str| folder.path(name).display().to_string();
        // Started by root it would become another user, who could not read the key.
        let text = format!(
            "listener {} 127.0.0.1\nuser root\nallow_anonymous true\npersistence false\nlog_type all\n\
             cafile {}\ncertfile {}\nkeyfile {}\n{more}\n",
            address.port(),
            file("ca.pem"),
            file("server.pem"),
            file("server.key"),
        );
        let settings = folder.write("mosquitto.conf", &text);
        let log = std::fs::File::create(folder.path("mosquitto.log")).unwrap();
        let process = Command::new("mosquitto")
            .arg("-c")
            .arg(settings)
            .stdout(Stdio::null())
            .stderr(log)
            .spawn()
            .unwrap();
        let broker = Self { address, process };
        crate::support::until("mosquitto listens", async || {
            tokio::net::TcpStream::connect(address).await.ok()
        })
        .await;
        Some(broker)
    }
}

impl Drop for Mosquitto {
    fn drop(&mut self) {
        let _ = self.process.kill();
        let _ = self.process.wait();
    }
}

/// A gateway's MQTT client.
struct Client {
    _writer: ImageWriter,
    status: watch::Receiver<MqttStatus>,
    stop: CancellationToken,
    task: JoinHandle<()>,
}

impl Client {
    fn start(url: &str, tls: &TlsClientSettings) -> Self {
        let settings =
            MqttSettings { url: url.parse().unwrap(), tls: tls.clone(), ..MqttSettings::default() };
        let table = plant::table(1);
        let (writer, reader) = process_image(plant::image(&table));
        let publisher = Publisher::new(table, &settings, Identity::default());
        let (sender, status) = watch::channel(MqttStatus::default());
        let stop = CancellationToken::new();
        let soon = Duration::from_millis(50);
        let pace = Pace { first: soon, longest: soon, refused: soon, ..Pace::default() };
        let (desk, clock, stopping) = (Desk::new(1).0, Clock::start(), stop.clone());
        let task = tokio::spawn(async move {
            let exchanges = tokio::sync::mpsc::channel(1).1;
            let session = run(
                settings, "hall-1", publisher, reader, desk, clock, stopping, sender, None, exchanges, pace,
            );
            Box::pin(session).await;
        });
        Self { _writer: writer, status, stop, task }
    }

    async fn until(&mut self, what: impl FnMut(&MqttStatus) -> bool) -> MqttStatus {
        tokio::time::timeout(PATIENCE, self.status.wait_for(what)).await.expect("in time").unwrap().clone()
    }

    async fn stop(self) {
        self.stop.cancel();
        tokio::time::timeout(PATIENCE, self.task).await.expect("in time").unwrap();
    }
}

/// Files of a broker for localhost, and of a client.
struct Plant {
    folder: Folder,
    authority: Authority,
    tls: TlsClientSettings,
}

impl Plant {
    fn new() -> Self {
        let (folder, authority) = (Folder::new(), Authority::new("plant"));
        let ca_file = Some(folder.write("ca.pem", &authority.pem));
        folder.write_pair("server", &authority.host());
        let (cert, key) = folder.write_pair("client", &authority.make("gateway", &[], |_| {}));
        Self {
            folder,
            authority,
            tls: TlsClientSettings { ca_file, cert_file: Some(cert), key_file: Some(key) },
        }
    }
}

fn url(broker: &Mosquitto, host: &str) -> String {
    format!("mqtts://{host}:{}", broker.address.port())
}

/// Tries to get a session; the reason why there is none.
async fn refused(url: &str, tls: &TlsClientSettings) -> (SessionTrouble, String) {
    let mut client = Client::start(url, tls);
    let seen = client.until(|status| status.failures > 0).await;
    assert!(!seen.connected && seen.sessions == 0, "{seen:?}");
    client.stop().await;
    (seen.trouble.unwrap(), seen.last_error)
}

const REQUIRE: &str = "require_certificate true";

#[tokio::test]
async fn mosquitto_with_certificates_on_both_sides_takes_the_session_by_name_and_by_address() {
    let plant = Plant::new();
    let Some(broker) = Mosquitto::start(&plant.folder, REQUIRE).await else { return };
    for host in ["localhost", "127.0.0.1"] {
        let mut client = Client::start(&url(&broker, host), &plant.tls);
        client.until(|status| status.connected && status.outbox.acknowledged > 0).await;
        client.stop().await;
    }
}

#[tokio::test]
async fn a_broker_whose_certificate_is_wrong_is_refused_with_the_reason() {
    let stranger = Authority::new("stranger");
    let plant = Plant::new();
    let authority = &plant.authority;
    let cases = [
        (
            authority.make("localhost", &["localhost"], |params| expires_in(params, -1)),
            SessionTrouble::Expired,
            "its certificate has expired",
        ),
        (
            authority.make("localhost", &["localhost"], begins_tomorrow),
            SessionTrouble::NotYetValid,
            "not valid yet",
        ),
        (authority.make("mqtt.plant", &["mqtt.plant"], |_| {}), SessionTrouble::WrongHost, "mqtt.plant"),
        (stranger.host(), SessionTrouble::UnknownAuthority, "not trusted here"),
    ];
    for (pair, trouble, says) in cases {
        plant.folder.write_pair("server", &pair);
        let Some(broker) = Mosquitto::start(&plant.folder, "").await else { return };
        let (told, text) = refused(&url(&broker, "localhost"), &plant.tls).await;
        assert_eq!(told, trouble);
        assert!(text.starts_with("TLS with the broker failed: ") && text.contains(says), "{text}");
    }
}

#[tokio::test]
async fn without_a_client_certificate_or_with_a_wrong_one_the_broker_refuses_and_the_reason_is_told() {
    let plant = Plant::new();
    for version in ["tlsv1.3", "tlsv1.2"] {
        let more = format!("{REQUIRE}\ntls_version {version}");
        let Some(broker) = Mosquitto::start(&plant.folder, &more).await else { return };
        let url = url(&broker, "localhost");
        let none = TlsClientSettings { cert_file: None, key_file: None, ..plant.tls.clone() };
        let (trouble, text) = refused(&url, &none).await;
        assert_eq!(trouble, SessionTrouble::WantsClientCertificate, "{version}: {text}");
        assert!(text.contains("client certificate"), "{version}: {text}");

        let stranger = Authority::new("stranger").make("gateway", &[], |_| {});
        let expired = plant.authority.make("gateway", &[], |params| expires_in(params, -1));
        for (pair, says) in [(stranger, "not trusted there"), (expired, "has expired")] {
            plant.folder.write_pair("client", &pair);
            let (trouble, text) = refused(&url, &plant.tls).await;
            assert_eq!(trouble, SessionTrouble::RefusesOurs, "{version}: {text}");
            assert!(text.contains("refuses our certificate") && text.contains(says), "{version}: {text}");
        }
    }
}

#[tokio::test]
async fn a_port_without_tls_a_port_without_anybody_and_files_that_are_wrong_are_told_apart() {
    let plant = Plant::new();
    let nobody = free_address();
    let (trouble, _) = refused(&format!("mqtts://{nobody}"), &plant.tls).await;
    assert_eq!(trouble, SessionTrouble::Unreachable);
    // Brokers without TLS take a hello for a malformed packet and hang up.
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let plain = listener.local_addr().unwrap();
    let hangs_up = tokio::spawn(async move { while listener.accept().await.is_ok() {} });
    let (trouble, text) = refused(&format!("mqtts://{plain}"), &plant.tls).await;
    assert_eq!(trouble, SessionTrouble::Handshake);
    assert!(text.contains("does it speak TLS at this port?"), "{text}");
    hangs_up.abort();
    let missing = TlsClientSettings { ca_file: Some(PathBuf::from("/nowhere/ca.pem")), ..plant.tls.clone() };
    let (trouble, text) = refused(&format!("mqtts://{nobody}"), &missing).await;
    assert_eq!(trouble, SessionTrouble::TlsFiles);
    assert!(text.starts_with("cannot read `/nowhere/ca.pem`"), "{text}");
}

#[tokio::test]
async fn a_client_certificate_that_was_refused_is_replaced_without_a_restart() {
    let plant = Plant::new();
    let Some(broker) = Mosquitto::start(&plant.folder, REQUIRE).await else { return };
    let expired = plant.authority.make("gateway", &[], |params| expires_in(params, -1));
    plant.folder.write_pair("client", &expired);
    let mut client = Client::start(&url(&broker, "localhost"), &plant.tls);
    client.until(|status| status.trouble == Some(SessionTrouble::RefusesOurs)).await;
    plant.folder.write_pair("client", &plant.authority.make("gateway", &[], |_| {}));
    client.until(|status| status.connected).await;
    client.stop().await;
}

#[tokio::test]
async fn certificates_of_both_sides_and_their_authority_are_exchanged_without_a_restart_of_the_gateway() {
    let plant = Plant::new();
    let Some(broker) = Mosquitto::start(&plant.folder, REQUIRE).await else { return };
    let address = broker.address;
    let mut client = Client::start(&url(&broker, "localhost"), &plant.tls);
    client.until(|status| status.connected).await;
    let new = Authority::new("plant 2");
    plant.folder.write_pair("server", &new.host());
    plant.folder.write_pair("client", &new.make("gateway", &[], |_| {}));
    plant.folder.write("ca.pem", &new.pem);
    drop(broker);
    client.until(|status| !status.connected).await;
    // The broker that comes back knows the new authority only.
    let Some(_broker) = Mosquitto::start_at(address, &plant.folder, REQUIRE).await else { return };
    client.until(|status| status.connected && status.sessions == 2).await;
    client.stop().await;
}
