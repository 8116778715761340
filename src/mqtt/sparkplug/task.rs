//! The task that keeps the session of the edge node \[IO\]: opens it, feeds it, waits, opens it again.
//!
//! Everything is sent with quality of service 0: a message counts as sent when it has left the process, so a window of such
//! messages keeps the library's queue short.

use std::collections::BTreeSet;
use std::time::Duration;

use tokio::sync::{mpsc, watch};
use tokio_util::sync::CancellationToken;

use super::commands::Commands;
use super::edge::{EdgeNode, Packet, SparkplugReport};
use crate::gateway::command::Desk;
use crate::mqtt::MqttSettings;
use crate::mqtt::attempts::Attempts;
use crate::mqtt::back_off::Pace;
use crate::mqtt::client::sleep_until;
use crate::mqtt::image_watch::ImageWatch;
use crate::mqtt::outbox::MessageId;
use crate::mqtt::uplink::{
    Content, Happening, NotTaken, Publication, Session, SessionError, SessionSettings, Uplink, Will,
};
use crate::process_image::ImageReader;
use crate::time::{Clock, Instant};

mod exchange;

pub use exchange::Exchange;

/// Time for NDEATH to be acknowledged.
const FAREWELL_TIMEOUT: Duration = Duration::from_secs(2);

/// How the session is, for metrics.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct SparkplugStatus {
    /// A session is up.
    pub connected: bool,
    /// The births of the session are out: values are sent as they come.
    pub live: bool,
    /// Sessions since the start.
    pub sessions: u64,
    /// Attempts that failed and sessions that ended, since the start.
    pub failures: u64,
    /// Counters.
    pub report: SparkplugReport,
}

/// A session that takes payloads of bytes.
pub trait Link: Uplink {
    /// Hands a message over without waiting, as [`Uplink::send`] does.
    fn publish(&mut self, packet: Packet) -> bool;
}

impl Link for Session {
    fn publish(&mut self, packet: Packet) -> bool {
        let Packet { id, topic, payload, at_least_once } = packet;
        let content = Content::Bytes;
        self.hand_over(Publication { id, topic: &topic, payload, at_least_once, retain: false, content })
    }
}

/// Runs until `stop`, whatever the broker does.
#[expect(clippy::too_many_arguments, reason = "the task's own inputs; each is named by its type")]
pub async fn run(
    settings: MqttSettings,
    gateway: &str,
    node: EdgeNode,
    reader: ImageReader,
    desk: Desk,
    clock: Clock,
    stop: CancellationToken,
    status: watch::Sender<SparkplugStatus>,
    exchanges: mpsc::Receiver<Exchange>,
    pace: Pace,
) {
    let task = Task::new(settings, gateway, node, reader, desk, clock, stop, status, pace);
    Task { exchanges, ..task }.run::<Session>().await;
}

struct Task {
    settings: MqttSettings,
    session: SessionSettings,
    node: EdgeNode,
    commands: Commands,
    reader: ImageReader,
    clock: Clock,
    stop: CancellationToken,
    status: watch::Sender<SparkplugStatus>,
    /// What a reload brings.
    exchanges: mpsc::Receiver<Exchange>,
    attempts: Attempts,
    /// The STATE of the primary host was subscribed in this session.
    asked_for_host: bool,
    /// Of this session it was told that messages are not taken.
    told_not_taken: bool,
    /// Messages that may be handed over and not have left.
    window: usize,
    outstanding: BTreeSet<MessageId>,
    image: ImageWatch,
}

/// Where the task stands.
enum Phase<U> {
    /// No session: the next attempt is due then.
    Waiting { until: Instant },
    /// A session is being opened or is up.
    Session { uplink: U, began: Option<Instant> },
}

/// What the task woke up for.
enum Wake {
    Stop,
    Image(bool),
    Timer,
    Session(Happening),
    Exchange(Box<Exchange>),
}

impl Task {
    async fn run<U: Link>(mut self) {
        let mut phase: Phase<U> = Phase::Waiting { until: Instant::START };
        loop {
            self.read_image();
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
                Wake::Exchange(exchange) => self.exchange(phase, *exchange).await,
            };
        }
    }

    /// Opens a session that is due, sends what may be sent, ends a session after its NDEATH.
    async fn advance<U: Link>(&mut self, phase: Phase<U>) -> Phase<U> {
        let now = self.clock.now();
        match phase {
            Phase::Waiting { until } if until <= now.instant => {
                let (topic, payload) = self.node.begin_session(now);
                self.session.last_will = Will { topic, payload, retain: false, is_json: false };
                match U::open(&self.session).await {
                    Ok(uplink) => Phase::Session { uplink, began: None },
                    Err(error) => self.lost(None, &error),
                }
            }
            Phase::Session { uplink, began: Some(began) } if self.node.has_said_farewell() => {
                uplink.disconnect().await;
                self.lost(Some(began), &SessionError::Lost("the primary host is offline".to_owned()))
            }
            Phase::Session { mut uplink, began: Some(began) } => {
                if self.attempts.subscription.is_due(now.instant) {
                    uplink.subscribe(&self.session.subscriptions);
                }
                if !std::mem::replace(&mut self.asked_for_host, true) {
                    uplink.subscribe(&self.node.host_subscription());
                }
                if !self.send(&mut uplink) {
                    let error = SessionError::Lost("the session takes nothing more".to_owned());
                    return self.lost(Some(began), &error);
                }
                Phase::Session { uplink, began: Some(began) }
            }
            waiting @ (Phase::Waiting { .. } | Phase::Session { .. }) => waiting,
        }
    }

    fn send<U: Link>(&mut self, uplink: &mut U) -> bool {
        while self.outstanding.len() < self.window {
            let Some(packet) = self.node.poll_output() else { break };
            self.outstanding.insert(packet.id);
            if !uplink.publish(packet) {
                return false;
            }
        }
        true
    }

    /// Nothing is sent twice by Sparkplug: a host that misses a number asks for a rebirth.
    fn not_taken(&mut self, id: MessageId, why: NotTaken) {
        if !std::mem::replace(&mut self.told_not_taken, true) {
            tracing::warn!(broker = %self.session.url, "the broker does not take messages of Sparkplug: {}", why.words);
        }
        self.sent(id);
    }

    fn sent(&mut self, id: MessageId) {
        self.outstanding.remove(&id);
        self.node.handle_sent(id);
    }

    fn handle<U>(&mut self, phase: Phase<U>, happening: Happening) -> Phase<U> {
        let Phase::Session { uplink, began } = phase else { return phase };
        let now = self.clock.now();
        match happening {
            Happening::Connected => {
                tracing::info!(broker = %self.session.url, client = self.session.client_id, "Sparkplug session is up");
                self.node.handle_session_up();
                self.attempts.handle_session_up();
                self.image.demand();
                self.status.send_modify(|status| status.sessions = status.sessions.saturating_add(1));
                Phase::Session { uplink, began: Some(now.instant) }
            }
            Happening::Acknowledged(id) => {
                self.sent(id);
                Phase::Session { uplink, began }
            }
            Happening::NotTaken(id, why) => {
                self.not_taken(id, why);
                Phase::Session { uplink, began }
            }
            Happening::Subscribed => Phase::Session { uplink, began },
            Happening::Message(message) => {
                let asked = self.node.handle_message(now, &message.topic, &message.payload, message.retain);
                self.commands.handle(&message.topic, asked);
                self.image.demand();
                Phase::Session { uplink, began }
            }
            Happening::Closed(error) => {
                drop(uplink);
                self.lost(began, &error)
            }
        }
    }

    /// The session is over, or could not begin: waits before the next attempt.
    fn lost<U>(&mut self, began: Option<Instant>, error: &SessionError) -> Phase<U> {
        let now = self.clock.now().instant;
        self.node.handle_session_down();
        self.outstanding.clear();
        self.asked_for_host = false;
        self.told_not_taken = false;
        let lost = self.attempts.handle_lost(began, error, now, fastrand::f64());
        let wait = lost.wait;
        if lost.is_news {
            tracing::warn!(broker = %self.session.url, wait_ms = wait.as_millis(), "no Sparkplug session: {error}");
        } else {
            tracing::debug!(broker = %self.session.url, wait_ms = wait.as_millis(), "no Sparkplug session: {error}");
        }
        self.status.send_modify(|status| status.failures = status.failures.saturating_add(1));
        Phase::Waiting { until: now + wait }
    }

    /// Reads the image when it changed or when something is due.
    fn read_image(&mut self) {
        let now = self.clock.now();
        if self.image.take(now.instant, self.node.poll_timeout()) {
            self.reader.read(|image| self.node.handle_image(now, image));
        }
    }

    async fn wait<U: Link>(&mut self, phase: &mut Phase<U>) -> Wake {
        let read = self.image.poll_timeout(self.node.poll_timeout());
        let (attempt, is_up) = match phase {
            Phase::Waiting { until } => (Some(*until), false),
            Phase::Session { began, .. } => (None, began.is_some()),
        };
        let subscribe = self.attempts.subscription.poll_timeout().filter(|_| is_up);
        let deadline = [read, attempt, subscribe].into_iter().flatten().min();
        let timer = sleep_until(self.clock, deadline);
        let happening = async {
            match phase {
                Phase::Session { uplink, .. } => uplink.next().await,
                Phase::Waiting { .. } => std::future::pending().await,
            }
        };
        tokio::select! {
            () = self.stop.cancelled() => Wake::Stop,
            alive = self.reader.changed(), if self.image.listens() => Wake::Image(alive),
            happening = happening => Wake::Session(happening),
            () = timer => Wake::Timer,
            Some(exchange) = self.exchanges.recv() => Wake::Exchange(Box::new(exchange)),
        }
    }

    fn report(&self, connected: bool) {
        let (live, report) = (self.node.is_live(), self.node.report());
        self.status.send_if_modified(|status| {
            let before = (status.connected, status.live, status.report);
            (status.connected, status.live, status.report) = (connected, live, report);
            before != (connected, live, report)
        });
    }

    /// Ends the session.
    async fn stop<U: Link>(mut self, phase: Phase<U>) {
        self.say_farewell(phase).await;
        self.report(false);
    }

    /// Says NDEATH, so that no host waits for a last will that does not come, and ends the session.
    async fn say_farewell<U: Link>(&mut self, phase: Phase<U>) {
        let Phase::Session { mut uplink, began: Some(_) } = phase else { return };
        self.node.handle_stop(self.clock.now());
        let deadline = self.clock.deadline(self.clock.now().instant + FAREWELL_TIMEOUT);
        while self.send(&mut uplink) && !self.node.has_said_farewell() {
            tokio::select! {
                () = tokio::time::sleep_until(deadline) => break,
                happening = uplink.next() => match happening {
                    Happening::Acknowledged(id) => self.sent(id),
                    Happening::NotTaken(id, why) => self.not_taken(id, why),
                    Happening::Closed(_) => return,
                    Happening::Connected | Happening::Subscribed | Happening::Message(_) => {}
                },
            }
        }
        uplink.disconnect().await;
    }
}

#[cfg(test)]
#[path = "task_tests.rs"]
mod tests;
