//! What the gateway is told about the rest of the program: the MQTT session and the clock. \[IO\]

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
async fn clock_is_synchronised() -> bool {
    tokio::fs::try_exists(SYNCHRONISED).await.unwrap_or(false)
}

/// Keeps `health` up to date until `stop`. `mqtt` is `None` where MQTT is not configured.
pub async fn run(
    mut mqtt: Option<watch::Receiver<MqttStatus>>,
    health: watch::Sender<Health>,
    stop: CancellationToken,
) {
    let mut clock = tokio::time::interval(CLOCK_INTERVAL);
    let mut now = Health {
        mqtt_connected: mqtt.as_ref().map(|session| session.borrow().connected),
        ..Health::default()
    };
    loop {
        // Every message moves the counters of the session; here only whether there is one counts.
        let session_changed = async {
            let shown = now.mqtt_connected;
            let seen = match &mut mqtt {
                Some(session) => {
                    let changed = session.wait_for(|session| Some(session.connected) != shown).await;
                    changed.ok().map(|session| session.connected)
                }
                None => None,
            };
            match seen {
                Some(connected) => connected,
                None => std::future::pending().await,
            }
        };
        tokio::select! {
            () = stop.cancelled() => return,
            _ = clock.tick() => now.clock_synchronised = clock_is_synchronised().await,
            connected = session_changed => now.mqtt_connected = Some(connected),
        }
        health.send_if_modified(|told| std::mem::replace(told, now) != now);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test(start_paused = true)]
    async fn only_the_beginning_and_the_end_of_a_session_are_told() {
        let (session, seen) = watch::channel(MqttStatus::default());
        let (health, mut told) = watch::channel(Health::default());
        let stop = CancellationToken::new();
        let task = tokio::spawn(run(Some(seen), health, stop.clone()));
        told.wait_for(|health| health.mqtt_connected == Some(false)).await.unwrap();
        session.send_modify(|status| status.connected = true);
        told.wait_for(|health| health.mqtt_connected == Some(true)).await.unwrap();
        for _ in 0..100 {
            session.send_modify(|status| status.outbox.sent += 1);
            tokio::task::yield_now().await;
        }
        assert!(!told.has_changed().unwrap(), "messages are no news");
        session.send_modify(|status| status.connected = false);
        told.wait_for(|health| health.mqtt_connected == Some(false)).await.unwrap();
        stop.cancel();
        task.await.unwrap();
    }
}
