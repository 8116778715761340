//! The store on a thread of its own \[IO\]: one turn at a time, so that no disk ever holds up the session.

use std::path::{Path, PathBuf};
use std::time::Duration;

use tokio::task::JoinHandle;
use uuid::Uuid;

use super::settings::MqttSettings;
use crate::store::{Done, Files, Limits, State, Store, StoreReport, StoreSettings, Turn};
use crate::time::{Clock, Instant, Now};

/// Where the store stands unless the installation says otherwise: used only if the folder above it is there.
pub const DEFAULT_FOLDER: &str = "/var/lib/cangate";
/// A turn that takes longer is told of as a fault.
const PATIENCE: Duration = Duration::from_secs(4);
/// The start does not wait longer for the disk; it goes on being opened meanwhile.
const OPEN_TIMEOUT: Duration = Duration::from_secs(2);
/// What is told of a disk that takes too long.
pub const NO_ANSWER: &str = "the disk does not answer";
/// At a stop: time for what is under way, and for the end.
pub(super) const CLOSE_TIMEOUT: Duration = Duration::from_secs(2);

/// A store, and the turn that is under way.
#[derive(Debug)]
pub struct StoreLink {
    /// `None` while a turn has it.
    store: Option<Box<Store<Files>>>,
    turn: Option<JoinHandle<(Box<Store<Files>>, Done)>>,
    since: Instant,
    /// The start did not wait for it any longer: the turn that is under way is the opening.
    late: bool,
    folder: PathBuf,
}

/// A store that was just opened, or still is being opened.
#[derive(Debug)]
pub struct Opened {
    /// It.
    pub link: StoreLink,
    /// What it holds; a fault where it still is being opened.
    pub done: Done,
    /// Number of the newest event that it ever held; 0 where it still is being opened.
    pub newest_event: u64,
}

/// Names the run of the system; a new one at each call where the system has none.
fn boot_id() -> Uuid {
    let text = std::fs::read_to_string("/proc/sys/kernel/random/boot_id").unwrap_or_default();
    text.trim().parse().unwrap_or_else(|_| Uuid::new_v4())
}

/// The folder for the store of a gateway of this name; `None` where none is to be used.
#[must_use]
pub fn folder(settings: &MqttSettings, gateway: &str) -> Option<PathBuf> {
    match &settings.buffer_dir {
        Some(folder) if folder.as_os_str().is_empty() => None,
        Some(folder) => Some(folder.clone()),
        None => {
            let base = Path::new(DEFAULT_FOLDER);
            let usable = nix::unistd::access(base, nix::unistd::AccessFlags::W_OK).is_ok();
            usable.then(|| base.join("buffer").join(gateway))
        }
    }
}

fn tell_opened(folder: &Path, report: &StoreReport) {
    let StoreReport { state, reason, records: [events, samples], damaged_places, .. } = report;
    if state.is_fault() {
        tracing::error!("messages for MQTT are kept in memory only, the disk is tried again: {reason}");
    } else {
        tracing::info!(folder = %folder.display(), events, samples, damaged_places, "buffer");
    }
}

impl StoreLink {
    /// Opens the store of a gateway of this name, where it is to have one. A disk that fails is told of in the report. One that
    /// is slow does not hold up the start: its store begins with its first turn, and events of this start with a new stream.
    pub async fn open(settings: &MqttSettings, gateway: &str, clock: Clock) -> Option<Opened> {
        let Some(folder) = folder(settings, gateway) else {
            if settings.buffer_dir.is_none() {
                tracing::warn!(
                    "events for MQTT are kept in memory only, and are lost when the gateway ends without a broker: make \
                     {DEFAULT_FOLDER} writable for it, or set `buffer_dir` under [mqtt] (an empty one silences this)"
                );
            }
            return None;
        };
        let settings = StoreSettings {
            bytes: settings.buffer_bytes,
            age: settings.buffer_age_h.map(|hours| Duration::from_secs(u64::from(hours) * 3600)),
            sync: settings.buffer_sync,
            memory: Limits { records: settings.outbox_messages, bytes: settings.outbox_bytes },
            boot: boot_id(),
            fresh: Uuid::new_v4,
        };
        let now = clock.now();
        let place = folder.clone();
        let mut opening = tokio::task::spawn_blocking(move || {
            let mut store = Box::new(Store::open(Files::new(&place), settings, now));
            let done = store.turn(now, Turn::default());
            (store, done)
        });
        let mut link = Self { store: None, turn: None, since: now.instant, late: false, folder };
        match tokio::time::timeout(OPEN_TIMEOUT, &mut opening).await {
            Ok(Ok((store, done))) => {
                let (_, newest_event) = store.stream();
                tell_opened(&link.folder, &done.report);
                link.store = Some(store);
                Some(Opened { link, done, newest_event })
            }
            Ok(Err(error)) => std::panic::resume_unwind(error.into_panic()),
            Err(_) => {
                tracing::error!(
                    folder = %link.folder.display(),
                    "{NO_ANSWER}: events for MQTT wait in memory until it does"
                );
                (link.turn, link.late) = (Some(opening), true);
                let report =
                    StoreReport { state: State::Faulty, reason: NO_ANSWER.into(), ..StoreReport::default() };
                Some(Opened { link, done: Done { report, ..Done::default() }, newest_event: 0 })
            }
        }
    }

    /// Whether a turn is under way.
    #[must_use]
    pub fn is_busy(&self) -> bool {
        self.turn.is_some()
    }

    /// Begins a turn; none must be under way.
    pub fn begin(&mut self, now: Now, turn: Turn) {
        let Some(mut store) = self.store.take() else { return };
        self.since = now.instant;
        self.turn = Some(tokio::task::spawn_blocking(move || {
            let done = store.turn(now, turn);
            (store, done)
        }));
    }

    /// Waits for the end of the turn; for ever where none is under way. Cancel-safe.
    pub async fn done(&mut self) -> Done {
        let Some(turn) = &mut self.turn else { return std::future::pending().await };
        let ended = turn.await;
        self.turn = None;
        match ended {
            Ok((mut store, done)) => {
                if std::mem::take(&mut self.late) {
                    store.begin_stream();
                    tell_opened(&self.folder, &done.report);
                }
                self.store = Some(store);
                done
            }
            // A panic is our bug; it ends this task, and the supervisor tells.
            Err(error) => std::panic::resume_unwind(error.into_panic()),
        }
    }

    /// Waits for the turn that is under way, where one is, but not for long.
    pub async fn rest(&mut self) -> Option<Done> {
        self.turn.as_ref()?;
        tokio::time::timeout(CLOSE_TIMEOUT, self.done()).await.ok()
    }

    /// Whether a turn is under way that takes too long.
    #[must_use]
    pub fn is_stuck(&self, now: Instant) -> bool {
        self.turn.is_some() && now.since(self.since) >= PATIENCE
    }

    /// When [`is_stuck`](Self::is_stuck) may become true.
    #[must_use]
    pub fn poll_timeout(&self, now: Instant) -> Option<Instant> {
        (self.turn.is_some() && !self.is_stuck(now)).then(|| self.since + PATIENCE)
    }

    /// The last turn, and the end in good order; `false` where it is not known that the disk has all.
    pub async fn close(mut self, clock: Clock, last: Option<Turn>) -> bool {
        let closing = async {
            let mut store = self.store.take()?;
            let now = clock.now();
            let closed = tokio::task::spawn_blocking(move || {
                store.turn(now, last.unwrap_or_default());
                store.close(now);
                store.report().state
            });
            closed.await.ok()
        };
        match tokio::time::timeout(CLOSE_TIMEOUT, closing).await {
            Ok(Some(State::Good)) => return true,
            Ok(Some(State::Off | State::Full | State::Faulty)) => {
                tracing::warn!("messages for MQTT that only memory holds are lost with this stop");
            }
            Ok(None) | Err(_) => {
                tracing::warn!("{NO_ANSWER}: messages for MQTT may be lost with this stop");
            }
        }
        false
    }
}

#[cfg(test)]
mod tests {
    use nix::sys::stat::Mode;

    use super::*;
    use crate::store::{Class, Entry, Want};

    const ALL: [Want; 2] = [Want { records: 100, bytes: 1 << 20, below: u64::MAX }; 2];

    fn settings(folder: &Path) -> MqttSettings {
        MqttSettings { buffer_dir: Some(folder.to_owned()), ..MqttSettings::default() }
    }

    fn event(number: u64) -> Turn {
        let append = vec![Entry { class: Class::Event, number, body: format!("event {number}").into() }];
        Turn { append, want: ALL, ..Turn::default() }
    }

    async fn turn(link: &mut StoreLink, turn: Turn) -> Done {
        link.begin(Now::default(), turn);
        link.done().await
    }

    /// A folder whose lock is a pipe: opening it takes until somebody reads from it.
    fn slow(folder: &Path) -> PathBuf {
        let lock = folder.join("lock");
        let _ = std::fs::remove_file(&lock);
        nix::unistd::mkfifo(&lock, Mode::S_IRWXU).unwrap();
        lock
    }

    #[tokio::test(start_paused = true)]
    async fn p10_a_disk_that_answers_late_is_a_fault_until_then_and_keeps_what_it_held() {
        let folder = tempfile::tempdir().unwrap();
        let settings = settings(folder.path());
        let clock = Clock::start();
        let mut opened = StoreLink::open(&settings, "hall", clock).await.unwrap();
        let before = turn(&mut opened.link, event(1)).await.items[0][0].stream;
        assert!(opened.link.close(clock, None).await);
        let lock = slow(folder.path());
        let (opened, ()) = tokio::join!(StoreLink::open(&settings, "hall", clock), async {
            tokio::task::yield_now().await;
            tokio::time::advance(OPEN_TIMEOUT).await;
        });
        let Opened { mut link, done, newest_event } = opened.unwrap();
        assert_eq!((done.report.state, &*done.report.reason, newest_event), (State::Faulty, NO_ANSWER, 0));
        assert!(link.is_busy() && !done.more.contains(&true));
        let reader = std::thread::spawn(move || std::fs::File::open(lock).unwrap());
        let done = link.done().await;
        let _open = reader.join().unwrap();
        assert_eq!((done.report.state, done.report.records), (State::Good, [1, 0]));
        assert!(!link.is_busy());
        // Numbers of this start begin at 1: they are of another stream than those that were found.
        let done = turn(&mut link, event(1)).await;
        let [events, _] = done.items;
        let found: Vec<_> = events.iter().map(|item| (item.stream == before, item.number)).collect();
        assert_eq!(found, [(true, 1), (false, 1)]);
    }
}
