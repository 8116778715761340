//! Watches for how long the certificates of all doors are valid yet. \[IO\]

use std::path::PathBuf;
use std::time::Duration;

use tokio::sync::watch;
use tokio_util::sync::CancellationToken;

use super::Installation;
use crate::time::Clock;
use crate::tls::{Life, Watched};

/// How often the files are looked at: a new one is known within this time.
const INTERVAL: Duration = Duration::from_secs(60);

/// The files with certificates that the doors of an installation use.
#[must_use]
pub fn watched(installation: &Installation) -> Watched {
    let mqtt = installation.mqtt.as_ref().filter(|mqtt| mqtt.url.tls);
    let files = mqtt.into_iter().flat_map(|mqtt| mqtt.tls.certificates());
    let mut files: Vec<PathBuf> = files.map(PathBuf::from).collect();
    let security = &installation.modbus.security;
    if !security.is_off() {
        files.extend(security.tls().certificates().into_iter().map(PathBuf::from));
    }
    if let Some(tls) = installation.http.tls.files() {
        files.extend(tls.certificates().into_iter().map(PathBuf::from));
    }
    files.sort();
    files.dedup();
    Watched(files)
}

/// Looks at them until `stop`.
pub async fn run(watched: Watched, lives: watch::Sender<Vec<Life>>, clock: Clock, stop: CancellationToken) {
    let mut interval = tokio::time::interval(INTERVAL);
    if watched.0.is_empty() {
        lives.send_if_modified(|told| !std::mem::take(told).is_empty());
    }
    while !watched.0.is_empty() {
        tokio::select! {
            () = stop.cancelled() => return,
            _ = interval.tick() => {}
        }
        let (files, now, before) = (watched.clone(), clock.now().utc, lives.borrow().clone());
        if let Ok(read) = tokio::task::spawn_blocking(move || files.lives(now, &before)).await {
            lives.send_if_modified(|told| {
                let moved = *told != read;
                *told = read;
                moved
            });
        }
    }
    stop.cancelled().await;
}
