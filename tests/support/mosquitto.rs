//! A real broker, mosquitto, and a client of it that sees every byte.

use std::net::SocketAddr;
use std::process::{Child, Command, Stdio};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use rumqttc::{AsyncClient, Event, MqttOptions, Packet, PublishOptions, QoS};
use tokio::task::JoinHandle;

use super::until;
use crate::support::ports::free_address;

/// mosquitto on a port of its own.
pub struct Mosquitto {
    pub address: SocketAddr,
    _folder: tempfile::TempDir,
    process: Child,
}

impl Mosquitto {
    /// `None` where it is not installed; in CI that is a failure.
    pub async fn start() -> Option<Self> {
        Self::start_with("").await
    }

    /// As [`start`](Self::start), with more lines of configuration.
    pub async fn start_with(more: &str) -> Option<Self> {
        let found = Command::new("mosquitto").arg("-h").stdout(Stdio::null()).stderr(Stdio::null()).status();
        if found.is_err() {
            assert!(
                std::env::var_os("CI").is_none(),
                "mosquitto is not installed, and CI has to run this test"
            );
            eprintln!("skipped: mosquitto is not installed (apt-get install mosquitto)");
            return None;
        }
        let address = free_address();
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("mosquitto.conf");
        let text = format!(
            "listener {} 127.0.0.1\nallow_anonymous true\npersistence false\n{more}\n",
            address.port()
        );
        std::fs::write(&file, text).unwrap();
        let mut command = Command::new("mosquitto");
        let process =
            command.arg("-c").arg(file).stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap();
        until("mosquitto listens", async || tokio::net::TcpStream::connect(address).await.ok()).await;
        Some(Self { address, _folder: folder, process })
    }
}

impl Drop for Mosquitto {
    fn drop(&mut self) {
        let _ = self.process.kill();
        let _ = self.process.wait();
    }
}

/// A message as the broker gave it.
#[derive(Clone, Debug)]
pub struct Seen {
    pub topic: String,
    pub payload: Vec<u8>,
    pub retain: bool,
    pub qos: QoS,
}

/// A client that is subscribed to everything.
pub struct Probe {
    client: AsyncClient,
    seen: Arc<Mutex<Vec<Seen>>>,
    task: JoinHandle<()>,
}

impl Probe {
    pub async fn start(broker: SocketAddr, id: &str) -> Self {
        let mut options = MqttOptions::new(id, (broker.ip().to_string(), broker.port()));
        options.set_max_packet_size(1 << 20, 1 << 20);
        let (client, mut events) = AsyncClient::builder(options).capacity(64).build();
        client.subscribe("#", QoS::AtLeastOnce).await.unwrap();
        let seen = Arc::new(Mutex::new(Vec::new()));
        let shared = Arc::clone(&seen);
        let (subscribed, mut is_subscribed) = tokio::sync::mpsc::channel(1);
        let task = tokio::spawn(async move {
            loop {
                match events.poll().await {
                    Ok(Event::Incoming(Packet::SubAck(_))) => subscribed.try_send(()).unwrap(),
                    Ok(Event::Incoming(Packet::Publish(message))) => shared.lock().unwrap().push(Seen {
                        topic: String::from_utf8(message.topic.to_vec()).unwrap(),
                        payload: message.payload.to_vec(),
                        retain: message.retain,
                        qos: message.qos,
                    }),
                    Ok(_) => {}
                    Err(_) => tokio::time::sleep(Duration::from_millis(10)).await,
                }
            }
        });
        is_subscribed.recv().await.unwrap();
        Self { client, seen, task }
    }

    pub async fn publish(&self, topic: &str, payload: &[u8], retain: bool) {
        let options = PublishOptions::new(QoS::AtLeastOnce).retain(retain);
        self.client.publish(topic, payload.to_vec(), options).await.unwrap();
    }

    /// What came since the start.
    pub fn seen(&self) -> Vec<Seen> {
        self.seen.lock().unwrap().clone()
    }

    /// Waits for a message from number `from` on.
    pub async fn wait_for(&self, what: &str, from: usize, wanted: impl Fn(&Seen) -> bool) -> Seen {
        until(what, async || self.seen().into_iter().skip(from).find(|seen| wanted(seen))).await
    }
}

impl Drop for Probe {
    fn drop(&mut self) {
        self.task.abort();
    }
}
