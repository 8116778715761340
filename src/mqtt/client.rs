//! The task that keeps a session with the broker \[IO\]: opens it, feeds it, waits, opens it again.

use std::time::Duration;

use tokio::sync::watch;
use tokio_util::sync::CancellationToken;

use super::back_off::{BackOff, Pace};
use super::outbox::OutboxReport;
use super::publisher::Publisher;
use super::settings::MqttSettings;
use super::uplink::{Happening, RumqttcSession, SessionError, SessionSettings, Uplink};
use crate::process_image::ImageReader;
use crate::time::{Clock, Instant};

/// The image is read at most this often: changes in between come together.
const READ_INTERVAL: Duration = Duration::from_millis(5);
/// At a stop: time for what still waits.
const FLUSH_TIMEOUT: Duration = Duration::from_secs(1);
/// At a stop: time for the acknowledgement of `offline`.
const OFFLINE_TIMEOUT: Duration = Duration::from_secs(2);
/// After this many sessions that the broker took and soon dropped, the likely cause is named.
const SUSPICIOUS_DROPS: u32 = 3;

/// How the session is, for health, metrics and pages.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct MqttStatus {
    /// A session is up.
    pub connected: bool,
    /// Address of the broker.
    pub broker: String,
    /// Sessions since the start.
    pub sessions: u64,
    /// Attempts that failed and sessions that ended, since the start.
    pub failures: u64,
    /// Why the last session did not begin or ended; empty before the first.
    pub last_error: String,
    /// Fill and counters of the outbox.
    pub outbox: OutboxReport,
}

/// Runs until `stop`, whatever the broker does.
pub async fn run(
    settings: MqttSettings,
    gateway: &str,
    publisher: Publisher,
    reader: ImageReader,
    clock: Clock,
    stop: CancellationToken,
    status: watch::Sender<MqttStatus>,
) {
    let longest = Duration::from_secs(settings.reconnect_max_s.into());
    let pace = Pace { longest, ..Pace::default() };
    run_at_pace(settings, gateway, publisher, reader, clock, stop, status, pace).await;
}

/// The same with other waits between the attempts.
#[expect(clippy::too_many_arguments, reason = "the task's own inputs; each is named by its type")]
pub async fn run_at_pace(
    settings: MqttSettings,
    gateway: &str,
    publisher: Publisher,
    reader: ImageReader,
    clock: Clock,
    stop: CancellationToken,
    status: watch::Sender<MqttStatus>,
    pace: Pace,
) {
    let session = SessionSettings::new(&settings, gateway, publisher.last_will());
    status.send_modify(|status| status.broker = session.url.to_string());
    let task = Task::new(session, publisher, reader, clock, stop, status, pace);
    task.run::<RumqttcSession>().await;
}

struct Task {
    session: SessionSettings,
    publisher: Publisher,
    reader: ImageReader,
    clock: Clock,
    stop: CancellationToken,
    status: watch::Sender<MqttStatus>,
    back_off: BackOff,
    silence: Duration,
    /// Sessions in a row that the broker took and soon dropped.
    drops: u32,
    /// Why the attempt before failed; `None` after a session began.
    told: Option<SessionError>,
    image: ImageWatch,
}

/// When the image has to be read.
struct ImageWatch {
    /// The writer still exists.
    alive: bool,
    /// It changed since the last read.
    changed: bool,
    /// Not before.
    next_read: Instant,
}

/// Where the task stands.
enum Phase<U> {
    /// No session: the next attempt is due then.
    Waiting { until: Instant },
    /// A session is being opened or is up.
    Session { uplink: U, began: Option<Instant>, progress: Instant },
}

/// How sending the rest at a stop ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Flushed {
    /// The broker has what it was to have.
    Done,
    /// Not within the time.
    Late,
    /// The session ended.
    Closed,
}

/// What the task woke up for.
enum Wake {
    Stop,
    Image(bool),
    Timer,
    Session(Happening),
}

impl Task {
    fn new(
        session: SessionSettings,
        publisher: Publisher,
        reader: ImageReader,
        clock: Clock,
        stop: CancellationToken,
        status: watch::Sender<MqttStatus>,
        pace: Pace,
    ) -> Self {
        Self {
            silence: pace.silence.max(session.keep_alive * 3 / 2),
            session,
            publisher,
            reader,
            clock,
            stop,
            status,
            back_off: BackOff::new(pace),
            drops: 0,
            told: None,
            image: ImageWatch { alive: true, changed: true, next_read: Instant::START },
        }
    }

    async fn run<U: Uplink>(mut self) {
        let mut phase: Phase<U> = Phase::Waiting { until: Instant::START };
        loop {
            self.read_image();
            phase = self.advance(phase).await;
            self.report(matches!(phase, Phase::Session { began: Some(_), .. }));
            phase = match self.wait(&mut phase).await {
                Wake::Stop => return self.stop(phase).await,
                Wake::Timer => phase,
                Wake::Image(alive) => {
                    self.image.alive = alive;
                    self.image.changed = true;
                    phase
                }
                Wake::Session(happening) => self.handle(phase, happening),
            };
        }
    }

    /// Opens a session that is due, sends what may be sent, ends a session that is silent.
    async fn advance<U: Uplink>(&mut self, phase: Phase<U>) -> Phase<U> {
        let now = self.clock.now().instant;
        match phase {
            Phase::Waiting { until } if until <= now => match U::open(&self.session).await {
                Ok(uplink) => Phase::Session { uplink, began: None, progress: now },
                Err(error) => self.lost(None, &error),
            },
            Phase::Session { began, progress, .. } if self.is_silent(began, progress, now) => {
                self.lost(began, &SessionError::Silent(self.silence))
            }
            Phase::Session { mut uplink, began, progress } => {
                // While nothing is in flight, nothing can be overdue: the patience begins with what is sent now.
                let progress = if self.publisher.in_flight() == 0 { now } else { progress };
                if began.is_some() && !self.send(&mut uplink) {
                    return self
                        .lost(began, &SessionError::Lost("the session takes nothing more".to_owned()));
                }
                Phase::Session { uplink, began, progress }
            }
            waiting @ Phase::Waiting { .. } => waiting,
        }
    }

    fn send<U: Uplink>(&mut self, uplink: &mut U) -> bool {
        while let Some(outgoing) = self.publisher.poll_output() {
            if !uplink.send(&outgoing) {
                return false;
            }
        }
        true
    }

    fn is_silent(&self, began: Option<Instant>, progress: Instant, now: Instant) -> bool {
        began.is_some() && self.publisher.in_flight() > 0 && now.since(progress) >= self.silence
    }

    fn handle<U>(&mut self, phase: Phase<U>, happening: Happening) -> Phase<U> {
        let Phase::Session { uplink, began, progress } = phase else { return phase };
        let now = self.clock.now().instant;
        match happening {
            Happening::Connected => {
                tracing::info!(broker = %self.session.url, "MQTT session is up");
                self.publisher.handle_session_up();
                self.told = None;
                self.image.changed = true;
                self.status.send_modify(|status| status.sessions = status.sessions.saturating_add(1));
                Phase::Session { uplink, began: Some(now), progress: now }
            }
            Happening::Acknowledged(id) => {
                self.publisher.handle_acknowledged(id);
                Phase::Session { uplink, began, progress: now }
            }
            Happening::Closed(error) => {
                drop((uplink, progress));
                self.lost(began, &error)
            }
        }
    }

    /// The session is over, or could not begin: waits before the next attempt.
    fn lost<U>(&mut self, began: Option<Instant>, error: &SessionError) -> Phase<U> {
        let now = self.clock.now().instant;
        self.publisher.handle_session_down();
        let lasted = began.map_or(Duration::ZERO, |began| now.since(began));
        let before = self.back_off.failures();
        let wait = match error {
            SessionError::Refused(_) | SessionError::Password { .. } => {
                self.back_off.after_refusal(fastrand::f64())
            }
            SessionError::Lost(_) | SessionError::Silent(_) => {
                self.back_off.after_session(lasted, fastrand::f64())
            }
        };
        let soon_dropped = began.is_some() && self.back_off.failures() > 1;
        self.drops = if soon_dropped { self.drops.saturating_add(1) } else { u32::from(began.is_some()) };
        let mut text = error.to_string();
        if self.drops >= SUSPICIOUS_DROPS {
            text = format!(
                "{text}; the broker dropped {} sessions soon after it took them: is another client using the id `{}`?",
                self.drops, self.session.client_id
            );
        }
        // Once at WARN, and again when the cause is another one; an absence that lasts does not fill the log.
        let told = self.told.replace(error.clone());
        let is_news = before == 0 || began.is_some() || !told.is_some_and(|told| told.is_kind_of(error));
        if is_news {
            tracing::warn!(broker = %self.session.url, wait_ms = wait.as_millis(), "no MQTT session: {text}");
        } else {
            tracing::debug!(broker = %self.session.url, wait_ms = wait.as_millis(), "no MQTT session: {text}");
        }
        self.status.send_modify(|status| {
            status.failures = status.failures.saturating_add(1);
            status.last_error = text;
        });
        Phase::Waiting { until: now + wait }
    }

    /// Reads the image when it changed or when something is due.
    fn read_image(&mut self) {
        let now = self.clock.now();
        let due = self.publisher.poll_timeout().is_some_and(|due| due <= now.instant);
        if (self.image.changed || due) && self.image.next_read <= now.instant {
            self.reader.read(|image| self.publisher.handle_image(now, image));
            self.image.changed = false;
            self.image.next_read = now.instant + READ_INTERVAL;
        }
    }

    /// When to come back at the latest.
    fn deadline<U>(&self, phase: &Phase<U>) -> Option<Instant> {
        let changed = self.image.changed.then_some(self.image.next_read);
        let due = self.publisher.poll_timeout().map(|due| due.max(self.image.next_read));
        let phase = match phase {
            Phase::Waiting { until } => Some(*until),
            Phase::Session { progress, .. } if self.publisher.in_flight() > 0 => {
                Some(*progress + self.silence)
            }
            Phase::Session { .. } => None,
        };
        [changed, due, phase].into_iter().flatten().min()
    }

    async fn wait<U: Uplink>(&mut self, phase: &mut Phase<U>) -> Wake {
        let deadline = self.deadline(phase).map(|instant| self.clock.deadline(instant));
        let timer = async {
            match deadline {
                Some(deadline) => tokio::time::sleep_until(deadline).await,
                None => std::future::pending().await,
            }
        };
        let happening = async {
            match phase {
                Phase::Session { uplink, .. } => uplink.next().await,
                Phase::Waiting { .. } => std::future::pending().await,
            }
        };
        let listening = self.image.alive && !self.image.changed;
        tokio::select! {
            () = self.stop.cancelled() => Wake::Stop,
            alive = self.reader.changed(), if listening => Wake::Image(alive),
            () = timer => Wake::Timer,
            happening = happening => Wake::Session(happening),
        }
    }

    fn report(&self, connected: bool) {
        let outbox = *self.publisher.report();
        self.status.send_if_modified(|status| {
            let moved = status.connected != connected || status.outbox != outbox;
            status.connected = connected;
            status.outbox = outbox;
            moved
        });
    }

    /// A stop in good order: what waits, then `offline`, then DISCONNECT. A broker that did not acknowledge `offline` in
    /// time is left without a DISCONNECT: then it publishes the last will, which says the same.
    async fn stop<U: Uplink>(mut self, phase: Phase<U>) {
        let Phase::Session { mut uplink, began: Some(_), .. } = phase else { return self.report(false) };
        self.image.changed = true;
        while self.image.changed || self.publisher.has_more() {
            self.image.next_read = Instant::START;
            self.read_image();
        }
        let rest = self.flush(&mut uplink, FLUSH_TIMEOUT, Publisher::is_idle).await;
        self.publisher.handle_stop();
        if rest != Flushed::Closed
            && self.flush(&mut uplink, OFFLINE_TIMEOUT, Publisher::has_said_farewell).await == Flushed::Done
        {
            uplink.disconnect().await;
        }
        self.report(false);
    }

    /// Sends until it is `done`, the time is over, or the session ends.
    async fn flush<U: Uplink>(
        &mut self,
        uplink: &mut U,
        limit: Duration,
        done: fn(&Publisher) -> bool,
    ) -> Flushed {
        let deadline = self.clock.deadline(self.clock.now().instant + limit);
        loop {
            if !self.send(uplink) {
                return Flushed::Closed;
            }
            if done(&self.publisher) {
                return Flushed::Done;
            }
            tokio::select! {
                () = tokio::time::sleep_until(deadline) => return Flushed::Late,
                happening = uplink.next() => match happening {
                    Happening::Acknowledged(id) => self.publisher.handle_acknowledged(id),
                    Happening::Closed(_) => return Flushed::Closed,
                    Happening::Connected => {}
                },
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use std::collections::VecDeque;
    use std::sync::Arc;

    use super::super::outbox::{MessageId, Outgoing};
    use super::super::payload::Identity;
    use super::*;
    use crate::mapping::TagTable;
    use crate::process_image::{ImageWriter, ProcessImage, process_image};

    /// How long the broker below takes for an acknowledgement.
    const SLOW: Duration = Duration::from_secs(2);

    /// A broker that takes every session and acknowledges everything, slowly.
    struct SlowBroker {
        clock: Clock,
        connected: bool,
        sent: VecDeque<(Instant, MessageId)>,
    }

    impl Uplink for SlowBroker {
        async fn open(_: &SessionSettings) -> Result<Self, SessionError> {
            Ok(Self { clock: Clock::start(), connected: false, sent: VecDeque::new() })
        }

        async fn next(&mut self) -> Happening {
            if !self.connected {
                self.connected = true;
                return Happening::Connected;
            }
            let Some((due, id)) = self.sent.front().copied() else { std::future::pending().await };
            tokio::time::sleep_until(self.clock.deadline(due)).await;
            self.sent.pop_front();
            Happening::Acknowledged(id)
        }

        fn send(&mut self, outgoing: &Outgoing) -> bool {
            self.sent.push_back((self.clock.now().instant + SLOW, outgoing.id));
            true
        }

        async fn disconnect(self) {}
    }

    fn task(keep_alive_s: u16) -> (Task, ImageWriter, watch::Receiver<MqttStatus>, CancellationToken) {
        let settings = MqttSettings { keep_alive_s, ..MqttSettings::default() };
        let publisher = Publisher::new(Arc::new(TagTable::default()), &settings, Identity::default());
        let (writer, reader) = process_image(ProcessImage::new(0, 0, 0, 0));
        let (sender, status) = watch::channel(MqttStatus::default());
        let stop = CancellationToken::new();
        let session = SessionSettings::new(&settings, "hall-1", publisher.last_will());
        let task =
            Task::new(session, publisher, reader, Clock::start(), stop.clone(), sender, Pace::default());
        (task, writer, status, stop)
    }

    #[tokio::test(start_paused = true)]
    async fn a_time_in_which_nothing_was_to_be_said_is_no_silence_of_the_broker() {
        // Health goes out every 30 s; a broker is silent after 10 s.
        let (task, _writer, status, stop) = task(5);
        let running = tokio::spawn(task.run::<SlowBroker>());
        tokio::time::sleep(Duration::from_secs(200)).await;
        let seen = status.borrow().clone();
        assert_eq!((seen.sessions, seen.failures), (1, 0), "{}", seen.last_error);
        assert!(seen.outbox.acknowledged >= 12, "{:?}", seen.outbox);
        stop.cancel();
        running.await.unwrap();
    }
}
