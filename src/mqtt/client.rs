//! The task that keeps a session with the broker \[IO\]: opens it, feeds it, waits, opens it again.

use std::collections::BTreeSet;
use std::sync::Arc;
use std::time::Duration;

use tokio::sync::{mpsc, watch};
use tokio_util::sync::CancellationToken;

use super::attempts::Attempts;
use super::back_off::Pace;
use super::buffer::BufferReport;
use super::commands::{Answer, Commands};
use super::image_watch::ImageWatch;
use super::outbox::OutboxReport;
use super::publisher::Publisher;
use super::settings::MqttSettings;
use super::store_link::{NO_ANSWER, StoreLink};
use super::uplink::{Happening, Session, SessionError, SessionSettings, Uplink};

use crate::gateway::command::Desk;
use crate::process_image::{ImageReader, SessionTrouble};
use crate::store::{Done, State};
use crate::time::{Clock, Instant};

mod exchange;
mod not_taken;
mod stopping;

pub use exchange::{Exchange, has_same_session};
pub use stopping::STOP_LIMIT;

/// After this many sessions that the broker took and soon dropped, the likely cause is named.
const SUSPICIOUS_DROPS: u32 = 3;

/// How the session is, for health, metrics and pages.
#[derive(Clone, Debug, Default, PartialEq)]
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
    /// The same as a number.
    pub trouble: Option<SessionTrouble>,
    /// Fill and counters of the outbox.
    pub outbox: OutboxReport,
    /// Fill, counters and forecast of the store; `None` where there is none.
    pub buffer: Option<BufferReport>,
    /// Number of the last event that was taken from the journal.
    pub events_taken: u64,
}

/// Runs until `stop`, whatever the broker does. Commands go to the `desk`, what must outlive the process to the store.
#[expect(clippy::too_many_arguments, reason = "the task's own inputs; each is named by its type")]
pub async fn run(
    settings: MqttSettings,
    gateway: &str,
    publisher: Publisher,
    reader: ImageReader,
    desk: Desk,
    clock: Clock,
    stop: CancellationToken,
    status: watch::Sender<MqttStatus>,
    store: Option<StoreLink>,
    exchanges: mpsc::Receiver<Exchange>,
    pace: Pace,
) {
    let task = Task::begin(settings, gateway, publisher, reader, desk, clock, stop, status, store, pace);
    Task { exchanges, ..task }.run::<Session>().await;
}

struct Task {
    settings: MqttSettings,
    session: SessionSettings,
    publisher: Publisher,
    reader: ImageReader,
    commands: Commands,
    clock: Clock,
    stop: CancellationToken,
    status: watch::Sender<MqttStatus>,
    store: Option<StoreLink>,
    /// What a reload brings.
    exchanges: mpsc::Receiver<Exchange>,
    attempts: Attempts,
    silence: Duration,
    /// Sessions in a row that the broker took and soon dropped.
    drops: u32,
    /// Topics of which it was told that the broker does not take what goes there, in this session.
    not_taken: BTreeSet<Arc<str>>,
    image: ImageWatch,
}

/// Where the task stands.
enum Phase<U> {
    /// No session: the next attempt is due then.
    Waiting { until: Instant },
    /// A session is being opened or is up.
    Session { uplink: U, began: Option<Instant>, progress: Instant },
}

/// What the task woke up for.
enum Wake {
    Stop,
    Image(bool),
    Timer,
    Session(Happening),
    Answer(Answer),
    Stored(Done),
    Exchange(Box<Exchange>),
}

impl Task {
    #[expect(clippy::too_many_arguments, reason = "as for `run`")]
    fn new(
        settings: MqttSettings,
        session: SessionSettings,
        publisher: Publisher,
        reader: ImageReader,
        commands: Commands,
        clock: Clock,
        stop: CancellationToken,
        status: watch::Sender<MqttStatus>,
        store: Option<StoreLink>,
        pace: Pace,
    ) -> Self {
        Self {
            silence: pace.silence.max(session.keep_alive * 3 / 2),
            settings,
            session,
            publisher,
            reader,
            commands,
            clock,
            stop,
            status,
            store,
            exchanges: mpsc::channel(1).1,
            attempts: Attempts::new(pace),
            drops: 0,
            not_taken: BTreeSet::new(),
            image: ImageWatch::new(),
        }
    }

    async fn run<U: Uplink>(mut self) {
        let mut phase: Phase<U> = Phase::Waiting { until: Instant::START };
        loop {
            self.read_image();
            self.turn_store();
            phase = self.advance(phase).await;
            self.report(matches!(phase, Phase::Session { began: Some(_), .. }));
            phase = match self.wait(&mut phase).await {
                Wake::Stop => return self.stop(phase).await,
                Wake::Timer => phase,
                Wake::Image(alive) => {
                    self.image.handle_wake(alive);
                    phase
                }
                Wake::Session(happening) => self.handle(phase, happening),
                Wake::Answer(answer) => {
                    self.publish(&answer);
                    phase
                }
                Wake::Stored(done) => {
                    self.publisher.handle_turn(done);
                    phase
                }
                Wake::Exchange(exchange) => self.exchange(phase, *exchange).await,
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
                if began.is_some() && self.attempts.subscription.is_due(now) {
                    uplink.subscribe(&self.session.subscriptions);
                }
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
            if !uplink.send(&outgoing, self.clock.now().instant) {
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
                if self.attempts.subscription.poll_timeout().is_some_and(|from| from > now) {
                    // Nothing is subscribed for now, and nothing to wait for.
                    self.publisher.handle_subscribed();
                }
                self.attempts.handle_session_up();
                self.not_taken.clear();
                self.image.demand();
                self.status.send_modify(|status| status.sessions = status.sessions.saturating_add(1));
                Phase::Session { uplink, began: Some(now), progress: now }
            }
            Happening::Acknowledged(id) => {
                self.publisher.handle_acknowledged(id);
                Phase::Session { uplink, began, progress: now }
            }
            Happening::NotTaken(id, why) => {
                self.not_taken(id, why);
                Phase::Session { uplink, began, progress: now }
            }
            Happening::Subscribed => {
                self.publisher.handle_subscribed();
                self.image.demand();
                Phase::Session { uplink, began, progress }
            }
            Happening::Message(message) => {
                self.publisher.handle_message(&message.topic, &message.payload, message.retain);
                if let Some(answer) = self.commands.handle(&message) {
                    self.publish(&answer);
                }
                Phase::Session { uplink, began, progress }
            }
            Happening::Closed(error) => {
                drop((uplink, progress));
                self.lost(began, &error)
            }
        }
    }

    fn publish(&mut self, answer: &Answer) {
        let now = self.clock.now();
        match answer {
            Answer::Serial(answer) => self.publisher.handle_serial_answer(now, answer),
            Answer::Response(response) => self.publisher.handle_response(now, response),
        }
    }

    /// The session is over, or could not begin: waits before the next attempt.
    fn lost<U>(&mut self, began: Option<Instant>, error: &SessionError) -> Phase<U> {
        let now = self.clock.now().instant;
        self.publisher.handle_session_down();
        let lost = self.attempts.handle_lost(began, error, now, fastrand::f64());
        let wait = lost.wait;
        self.drops =
            if lost.soon_dropped { self.drops.saturating_add(1) } else { u32::from(began.is_some()) };
        let mut text = error.to_string();
        if self.drops >= SUSPICIOUS_DROPS {
            text = format!(
                "{text}; the broker dropped {} sessions soon after it took them: is another client using the id `{}`?",
                self.drops, self.session.client_id
            );
        }
        if lost.is_news {
            tracing::warn!(broker = %self.session.url, wait_ms = wait.as_millis(), "no MQTT session: {text}");
        } else {
            tracing::debug!(broker = %self.session.url, wait_ms = wait.as_millis(), "no MQTT session: {text}");
        }
        self.status.send_modify(|status| {
            status.failures = status.failures.saturating_add(1);
            status.last_error = text;
            status.trouble = Some(error.trouble());
        });
        Phase::Waiting { until: now + wait }
    }

    /// Reads the image when it changed or when something is due.
    fn read_image(&mut self) {
        let now = self.clock.now();
        if self.image.take(now.instant, self.publisher.poll_timeout()) {
            self.reader.read(|image| self.publisher.handle_image(now, image));
        }
    }

    /// Begins the next turn with the store, where one is due and none is under way.
    fn turn_store(&mut self) {
        let Some(store) = self.store.as_mut().filter(|store| !store.is_busy()) else { return };
        let now = self.clock.now();
        if let Some(turn) = self.publisher.poll_turn(now) {
            store.begin(now, turn);
        }
    }

    /// When to come back at the latest.
    fn deadline<U>(&self, phase: &Phase<U>) -> Option<Instant> {
        let read = self.image.poll_timeout(self.publisher.poll_timeout());
        let is_up = matches!(phase, Phase::Session { began: Some(_), .. });
        let subscribe = self.attempts.subscription.poll_timeout().filter(|_| is_up);
        let phase = match phase {
            Phase::Waiting { until } => Some(*until),
            Phase::Session { progress, .. } if self.publisher.in_flight() > 0 => {
                Some(*progress + self.silence)
            }
            Phase::Session { .. } => None,
        };
        let now = self.clock.now().instant;
        let stuck = self.store.as_ref().and_then(|store| store.poll_timeout(now));
        [read, phase, subscribe, stuck].into_iter().flatten().min()
    }

    async fn wait<U: Uplink>(&mut self, phase: &mut Phase<U>) -> Wake {
        let timer = sleep_until(self.clock, self.deadline(phase));
        let happening = async {
            match phase {
                Phase::Session { uplink, .. } => uplink.next().await,
                Phase::Waiting { .. } => std::future::pending().await,
            }
        };
        let listening = self.image.listens();
        tokio::select! {
            () = self.stop.cancelled() => Wake::Stop,
            alive = self.reader.changed(), if listening => Wake::Image(alive),
            () = timer => Wake::Timer,
            happening = happening => Wake::Session(happening),
            answer = self.commands.next() => Wake::Answer(answer),
            done = turn_done(&mut self.store) => Wake::Stored(done),
            Some(exchange) = self.exchanges.recv() => Wake::Exchange(Box::new(exchange)),
        }
    }

    fn report(&self, connected: bool) {
        let now = self.clock.now();
        let outbox = *self.publisher.report();
        let mut buffer = self.publisher.buffer_report(now);
        if let (Some(link), Some(buffer)) = (&self.store, &mut buffer)
            && link.is_stuck(now.instant)
        {
            buffer.store.state = State::Faulty;
            buffer.store.reason = NO_ANSWER.into();
        }
        self.status.send_if_modified(|status| {
            let before = status.buffer.as_ref().map(|buffer| &buffer.store);
            let moved = status.connected != connected
                || status.outbox != outbox
                || before != buffer.as_ref().map(|buffer| &buffer.store);
            status.connected = connected;
            status.outbox = outbox;
            status.buffer = buffer;
            // Nobody waits for this one.
            status.events_taken = self.publisher.taken_through();
            moved
        });
    }
}

/// Until that moment; for ever where there is none.
pub(super) async fn sleep_until(clock: Clock, deadline: Option<Instant>) {
    match deadline {
        Some(deadline) => tokio::time::sleep_until(clock.deadline(deadline)).await,
        None => std::future::pending().await,
    }
}

/// Waits for the turn that is under way; for ever where none is. Cancel-safe.
async fn turn_done(store: &mut Option<StoreLink>) -> Done {
    match store {
        Some(store) => store.done().await,
        None => std::future::pending().await,
    }
}

#[cfg(test)]
#[path = "client/client_tests.rs"]
mod tests;
