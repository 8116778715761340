//! What the gateway is told about the rest of the program: the MQTT session and the clock. \[IO\]

use std::path::Path;
use std::time::Duration;

use tokio::sync::watch;
use tokio_util::sync::CancellationToken;

use crate::gateway::Health;
use crate::mqtt::MqttStatus;

/// Written by systemd-timesyncd once the clock is synchronised. Where another program keeps the clock, or inside a
/// container, this file is not there, and the clock counts as not known to be synchronised.
const SYNCHRONISED: &str = "/run/systemd/timesync/synchronized";

/// How often the clock is looked at.
const CLOCK_INTERVAL: Duration = Duration::from_secs(10);

/// Whether the clock is known to be synchronised.
#[must_use]
pub fn clock_is_synchronised() -> bool {
    Path::new(SYNCHRONISED).exists()
}

/// Keeps `health` up to date until `stop`. `mqtt` is `None` where MQTT is not configured.
pub async fn run(
    mut mqtt: Option<watch::Receiver<MqttStatus>>,
    health: watch::Sender<Health>,
    stop: CancellationToken,
) {
    loop {
        let now = Health {
            mqtt_connected: mqtt.as_mut().map(|session| session.borrow_and_update().connected),
            clock_synchronised: clock_is_synchronised(),
        };
        health.send_if_modified(|seen| std::mem::replace(seen, now) != now);
        let session_changed = async {
            let gone = match &mut mqtt {
                Some(session) => session.changed().await.is_err(),
                None => true,
            };
            if gone {
                std::future::pending::<()>().await;
            }
        };
        tokio::select! {
            () = stop.cancelled() => return,
            () = tokio::time::sleep(CLOCK_INTERVAL) => {}
            () = session_changed => {}
        }
    }
}
