//! What the gateway is told about the rest of the program: the MQTT session, certificates and the clock. \[IO\]

use std::time::Duration;

use tokio::sync::watch;
use tokio_util::sync::CancellationToken;

use crate::gateway::Health;
use crate::mqtt::MqttStatus;
use crate::tls::Life;

/// Written by systemd-timesyncd once the clock is synchronised. Where another program keeps the clock, or inside a
/// container, this file is not there, and the clock counts as not known to be synchronised.
const SYNCHRONISED: &str = "/run/systemd/timesync/synchronized";

/// How often the clock is looked at.
const CLOCK_INTERVAL: Duration = Duration::from_secs(10);

/// Whether the clock is known to be synchronised.
async fn clock_is_synchronised() -> bool {
    tokio::fs::try_exists(SYNCHRONISED).await.unwrap_or(false)
}

/// What is told of a session.
fn seen(before: Health, session: &MqttStatus) -> Health {
    let store = session.buffer.as_ref().map(|buffer| &buffer.store);
    Health {
        mqtt_connected: Some(session.connected),
        mqtt_trouble: session.trouble,
        buffer_filling: store.is_some_and(|store| store.filling),
        buffer_fault: store.is_some_and(|store| store.state.is_fault()),
        ..before
    }
}

/// Keeps `health` up to date until `stop`, from what it says already. `mqtt` is `None` where MQTT is not configured.
pub async fn run(
    mut mqtt: Option<watch::Receiver<MqttStatus>>,
    mut certificates: watch::Receiver<Vec<Life>>,
    health: watch::Sender<Health>,
    stop: CancellationToken,
) {
    let mut clock = tokio::time::interval(CLOCK_INTERVAL);
    let mut now = *health.borrow();
    if let Some(session) = &mqtt {
        now = seen(now, &session.borrow());
    }
    // Those of before are looked at once a minute, and told of only when they change.
    certificates.mark_changed();
    loop {
        // Every message moves the counters of the session; here only whether there is one counts, and how its disk is.
        let session_changed = async {
            let changed = match &mut mqtt {
                Some(session) => {
                    let changed = session.wait_for(|session| seen(now, session) != now).await;
                    changed.ok().map(|session| seen(now, &session))
                }
                None => None,
            };
            match changed {
                Some(changed) => changed,
                None => std::future::pending().await,
            }
        };
        tokio::select! {
            () = stop.cancelled() => return,
            _ = clock.tick() => now.clock_synchronised = clock_is_synchronised().await,
            changed = session_changed => now = changed,
            Ok(()) = certificates.changed() => {
                now.certificate_days = certificates.borrow().iter().map(|life| life.days_left).min();
            }
        }
        health.send_if_modified(|told| std::mem::replace(told, now) != now);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mqtt::BufferReport;
    use crate::process_image::SessionTrouble;
    use crate::store::{State, StoreReport};

    #[tokio::test(start_paused = true)]
    async fn only_the_beginning_and_the_end_of_a_session_are_told() {
        let (session, seen) = watch::channel(MqttStatus::default());
        let (health, mut told) = watch::channel(Health::default());
        let stop = CancellationToken::new();
        let task = tokio::spawn(run(Some(seen), watch::channel(Vec::new()).1, health, stop.clone()));
        told.wait_for(|health| health.mqtt_connected == Some(false)).await.unwrap();
        session.send_modify(|status| status.connected = true);
        told.wait_for(|health| health.mqtt_connected == Some(true)).await.unwrap();
        for _ in 0..100 {
            session.send_modify(|status| status.outbox.sent += 1);
            tokio::task::yield_now().await;
        }
        assert!(!told.has_changed().unwrap(), "messages are no news");
        session.send_modify(|status| status.trouble = Some(SessionTrouble::Expired));
        told.wait_for(|health| health.mqtt_trouble == Some(SessionTrouble::Expired)).await.unwrap();
        session.send_modify(|status| status.buffer = Some(BufferReport::default()));
        tokio::task::yield_now().await;
        assert!(!told.has_changed().unwrap(), "a disk that is well is no news");
        session.send_modify(|status| {
            let store = StoreReport { state: State::Full, filling: true, ..StoreReport::default() };
            status.buffer = Some(BufferReport { store, hours_left: None });
        });
        told.wait_for(|health| health.buffer_fault && health.buffer_filling).await.unwrap();
        session.send_modify(|status| status.connected = false);
        told.wait_for(|health| health.mqtt_connected == Some(false)).await.unwrap();
        stop.cancel();
        task.await.unwrap();
    }

    #[tokio::test(start_paused = true)]
    async fn g06_of_all_certificates_the_one_that_expires_first_counts() {
        let (lives, seen) = watch::channel(Vec::new());
        let (health, mut told) = watch::channel(Health::default());
        let stop = CancellationToken::new();
        let task = tokio::spawn(run(None, seen, health, stop.clone()));
        let life = |days_left| Life {
            file: String::new(),
            subject: String::new(),
            not_after: crate::time::Timestamp::default(),
            days_left,
        };
        lives.send_replace(vec![life(40), life(-2), life(7)]);
        told.wait_for(|health| health.certificate_days == Some(-2)).await.unwrap();
        lives.send_replace(Vec::new());
        told.wait_for(|health| health.certificate_days.is_none()).await.unwrap();
        stop.cancel();
        task.await.unwrap();
    }

    #[tokio::test(start_paused = true)]
    async fn g06_what_was_known_of_certificates_and_clock_is_not_forgotten_when_a_session_begins_anew() {
        let life = Life {
            file: String::new(),
            subject: String::new(),
            not_after: crate::time::Timestamp::default(),
            days_left: 3,
        };
        let (lives, _) = watch::channel(vec![life]);
        let known = Health { certificate_days: Some(3), ..Health::default() };
        for before in [known, Health::default()] {
            let (health, mut told) = watch::channel(before);
            let (stop, session) = (CancellationToken::new(), watch::channel(MqttStatus::default()).1);
            let task = tokio::spawn(run(Some(session), lives.subscribe(), health, stop.clone()));
            told.wait_for(|health| health.mqtt_connected == Some(false)).await.unwrap();
            let days = told.borrow_and_update().certificate_days;
            assert!(days == Some(3) || before != known, "an alarm would end and begin");
            let learnt = told.wait_for(|health| health.certificate_days == Some(3));
            tokio::time::timeout(Duration::from_secs(60), learnt).await.unwrap().unwrap();
            stop.cancel();
            task.await.unwrap();
        }
    }
}
