//! The MQTT client with an image that tests change, and what it must deliver.

use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::time::Duration;

use cangate::gateway::command::Desk;
use cangate::mqtt::back_off::Pace;
use cangate::mqtt::client::run;
use cangate::mqtt::{Identity, MqttSettings, MqttStatus, MqttVersion, Publisher};
use cangate::process_image::handles::process_image;
use cangate::process_image::{ImageWriter, ProcessImage, Revision};
use cangate::time::Clock;
use tokio::sync::watch;
use tokio::task::JoinHandle;
use tokio_util::sync::CancellationToken;

use super::plant;

/// Long enough for the slowest machine; no test waits this long when all is well.
pub const PATIENCE: Duration = Duration::from_secs(60);
/// Messages in flight.
pub const WINDOW: usize = 16;

/// A client with its image.
pub struct Client {
    pub writer: ImageWriter,
    pub status: watch::Receiver<MqttStatus>,
    pub stop: CancellationToken,
    pub task: JoinHandle<()>,
}

impl Client {
    pub fn start(broker: SocketAddr) -> Self {
        Self::start_with(broker, |_| {})
    }

    pub fn speaking(version: MqttVersion, broker: SocketAddr) -> Self {
        Self::speaking_with(version, broker, |_| {})
    }

    pub fn speaking_with(
        version: MqttVersion,
        broker: SocketAddr,
        change: impl FnOnce(&mut MqttSettings),
    ) -> Self {
        Self::start_with(broker, |settings| {
            settings.version = version;
            change(settings);
        })
    }

    pub fn start_with(broker: SocketAddr, change: impl FnOnce(&mut MqttSettings)) -> Self {
        Self::start_at(Desk::new(1).0, broker, change)
    }

    /// Commands go to this desk.
    pub fn start_at(desk: Desk, broker: SocketAddr, change: impl FnOnce(&mut MqttSettings)) -> Self {
        let mut settings = MqttSettings {
            url: format!("mqtt://{broker}").parse().unwrap(),
            inflight: u16::try_from(WINDOW).unwrap(),
            ..MqttSettings::default()
        };
        change(&mut settings);
        let table = plant::table(2);
        let identity = Identity { sid: "s".into(), ..Identity::default() };
        let (writer, reader) = process_image(plant::image(&table));
        let publisher = Publisher::new(table, &settings, identity);
        let (status_sender, status) = watch::channel(MqttStatus::default());
        let stop = CancellationToken::new();
        let pace = Pace {
            first: Duration::from_millis(20),
            longest: Duration::from_millis(40),
            refused: Duration::from_millis(40),
            silence: Duration::from_millis(200),
            ..Pace::default()
        };
        let stopping = stop.clone();
        let task = tokio::spawn(async move {
            let exchanges = tokio::sync::mpsc::channel(1).1;
            let (clock, status) = (Clock::start(), status_sender);
            let session = run(
                settings, "hall-1", publisher, reader, desk, clock, stopping, status, None, exchanges, pace,
            );
            Box::pin(session).await;
        });
        Self { writer, status, stop, task }
    }

    pub fn change(&mut self, change: impl FnOnce(&mut ProcessImage)) {
        self.writer.apply(|image| {
            image.revision = Revision(image.revision.0 + 1);
            change(image);
        });
    }

    pub fn happen(&mut self, seq: u64) {
        self.writer.apply(|image| plant::happen(image, seq));
    }

    pub async fn until(&mut self, what: impl FnMut(&MqttStatus) -> bool) -> MqttStatus {
        tokio::time::timeout(PATIENCE, self.status.wait_for(what)).await.expect("in time").unwrap().clone()
    }

    pub async fn stop(self) {
        self.stop.cancel();
        tokio::time::timeout(PATIENCE, self.task).await.expect("in time").unwrap();
    }
}

/// Waits until a condition holds.
pub async fn until(what: &str, mut condition: impl FnMut() -> bool) {
    let waiting = async {
        while !condition() {
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
    };
    tokio::time::timeout(PATIENCE, waiting).await.unwrap_or_else(|_| panic!("never: {what}"));
}

pub fn seq(payload: &str) -> u64 {
    serde_json::from_str::<serde_json::Value>(payload).unwrap()["seq"].as_u64().unwrap()
}

/// The oracle: every event up to `last` arrived, first deliveries in order; the same event twice only with a
/// reconnect between, the same bytes, and no more than a window of them for each reconnect.
pub fn assert_delivered(events: &[(usize, String)], last: u64) {
    let mut first: BTreeMap<u64, (usize, &str)> = BTreeMap::new();
    let mut doubled: BTreeMap<usize, usize> = BTreeMap::new();
    let mut newest = 0;
    for (connection, payload) in events {
        let seq = seq(payload);
        if let Some((before, bytes)) = first.get(&seq) {
            assert!(before < connection, "event {seq} twice in connection {connection}");
            assert_eq!(bytes, payload, "event {seq} changed");
            *doubled.entry(*connection).or_default() += 1;
        } else {
            assert_eq!(seq, newest + 1, "first deliveries are in order without a gap");
            newest = seq;
        }
        first.insert(seq, (*connection, payload));
    }
    assert_eq!(newest, last);
    assert!(doubled.values().all(|count| *count <= WINDOW), "{doubled:?}");
}
