//! A session with a broker \[IO\]: the trait that the tasks need, and its form over `rumqttc`.
//!
//! The library's event loop runs in a task of its own that never waits for a message to be taken: with one task for
//! both, a full request channel would stop the very loop that empties it. Every session has a new event loop, so that
//! nothing of the session before is kept by the library; what was not acknowledged is in our outbox.

use std::future::Future;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use tokio::sync::mpsc;
use tokio::task::{JoinHandle, JoinSet};
use tokio::time::{Interval, interval};

use super::outbox::{MessageId, Outgoing};
use super::settings::{BrokerUrl, MqttSettings};
use super::thrown_away::ThrownAway;
use super::version::MqttVersion;
use crate::time::{Clock, Instant};
use crate::tls::ClientKeeper;

mod connect;
mod error;
mod reasons;
mod v4;
mod v5;

pub use error::{Refusal, SessionError};

/// Messages of subscribed topics that wait to be looked at; more are thrown away, though the broker has its acknowledgement.
const INCOMING: usize = 64;
/// How often is told how many were thrown away, where some were.
const TELL_THROWN_AWAY: Duration = Duration::from_secs(60);
/// Time that a DISCONNECT may take.
const DISCONNECT_TIMEOUT: Duration = Duration::from_secs(1);

/// How to open a session.
#[derive(Clone, Debug)]
pub struct SessionSettings {
    /// Where.
    pub url: BrokerUrl,
    /// Which MQTT.
    pub version: MqttVersion,
    /// As whom.
    pub client_id: String,
    /// User name.
    pub username: Option<String>,
    /// File whose first line is the password.
    pub password_file: Option<PathBuf>,
    /// Certificates, where it is encrypted.
    pub tls: Option<Arc<ClientKeeper>>,
    /// A dead link is noticed within one and a half times this.
    pub keep_alive: Duration,
    /// Messages in flight.
    pub inflight: u16,
    /// What the broker says when the session ends without a goodbye.
    pub last_will: Will,
    /// Topics that are to be subscribed in each session.
    pub subscriptions: Vec<String>,
}

/// A last will; always with quality of service 1.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Will {
    /// Where to.
    pub topic: String,
    /// What.
    pub payload: Vec<u8>,
    /// The broker keeps it for later subscribers.
    pub retain: bool,
    /// Its payload is JSON.
    pub is_json: bool,
}

impl SessionSettings {
    /// From the settings of a gateway of this name.
    #[must_use]
    pub fn new(settings: &MqttSettings, gateway: &str, last_will: (&str, &'static str)) -> Self {
        Self {
            url: settings.url.clone(),
            version: settings.version,
            client_id: settings.client_id_for(gateway),
            username: settings.username.clone(),
            password_file: settings.password_file.clone(),
            tls: settings
                .url
                .tls
                .then(|| Arc::new(ClientKeeper::new("[mqtt.tls]", settings.tls.clone(), Clock::start()))),
            keep_alive: Duration::from_secs(settings.keep_alive_s.into()),
            inflight: settings.inflight,
            last_will: Will {
                topic: last_will.0.to_owned(),
                payload: last_will.1.as_bytes().to_vec(),
                retain: true,
                is_json: true,
            },
            subscriptions: Vec::new(),
        }
    }

    /// Requests that the library may hold: a window of messages, and the subscriptions of the session in front of them.
    fn capacity(&self) -> usize {
        usize::from(self.inflight) + 2
    }

    /// How long a link may be dead before it is noticed.
    fn patience(&self) -> Duration {
        self.keep_alive * 3 / 2
    }

    /// What to encrypt with; `None` where nothing is encrypted.
    async fn tls_config(&self) -> Result<Option<Arc<rustls::ClientConfig>>, SessionError> {
        let Some(tls) = &self.tls else { return Ok(None) };
        tls.current_async().await.map(Some).map_err(|error| SessionError::Tls(error.into()))
    }
}

/// A message of a subscribed topic.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Incoming {
    /// Its topic.
    pub topic: String,
    /// As it came.
    pub payload: Vec<u8>,
    /// The broker had kept it.
    pub retain: bool,
    /// Where an answer is wanted.
    pub reply_to: ReplyTo,
}

/// Where the answer to a message is wanted, as MQTT 5 can say; nobody has looked yet whether it may go there.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct ReplyTo {
    /// Response Topic.
    pub topic: Option<String>,
    /// Correlation Data, to be found in the answer.
    pub correlation: Option<Arc<[u8]>>,
}

/// What happens in a session.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Happening {
    /// The broker accepted the session.
    Connected,
    /// The broker has a message.
    Acknowledged(MessageId),
    /// The broker does not have a message, and will not.
    NotTaken(MessageId, NotTaken),
    /// The broker answered the subscription: what it had kept of these topics until then comes, whatever is published from
    /// now on. Also where it refuses, or could not be asked.
    Subscribed,
    /// A message of a subscribed topic came.
    Message(Incoming),
    /// The session is over; every acknowledgement that arrived was told before.
    Closed(SessionError),
}

/// Why the broker does not take a message.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct NotTaken {
    /// In words.
    pub words: &'static str,
    /// It is of no use to send it once more.
    pub for_ever: bool,
}

impl NotTaken {
    /// It was not sent: the broker has said that it takes nothing so large.
    pub const TOO_LARGE: Self = Self::for_ever("it is larger than the broker takes");
    /// It was not sent: nobody waits for it any more.
    pub const EXPIRED: Self = Self::for_ever("it has expired");
    /// It was not sent: the broker has said that it keeps nothing.
    pub const NO_RETAIN: Self = Self::for_ever("the broker keeps no retained messages");

    /// It may be taken later.
    #[must_use]
    pub const fn for_now(words: &'static str) -> Self {
        Self { words, for_ever: false }
    }

    /// It will never be taken.
    #[must_use]
    pub const fn for_ever(words: &'static str) -> Self {
        Self { words, for_ever: true }
    }
}

/// A session with a broker. The client is written against this, so that the library behind it can be exchanged.
pub trait Uplink: Send + Sized {
    /// Begins to open a session; [`Happening::Connected`] or [`Happening::Closed`] follows.
    fn open(settings: &SessionSettings) -> impl Future<Output = Result<Self, SessionError>> + Send;

    /// Waits for what happens next. Cancel-safe.
    fn next(&mut self) -> impl Future<Output = Happening> + Send;

    /// Subscribes; [`Happening::Subscribed`] follows. To be called once the session is up, and again for topics that come later:
    /// every session is new to the broker, so that it knows of no subscription before. What is sent meanwhile may reach the
    /// broker first.
    fn subscribe(&mut self, topics: &[String]);

    /// Hands a message over without waiting. `false` when it cannot be taken, which ends the session; a session that is
    /// over takes it, and says that it is [`Happening::Closed`].
    fn send(&mut self, outgoing: &Outgoing, now: Instant) -> bool;

    /// Ends the session in good order: the broker does not publish the last will.
    fn disconnect(self) -> impl Future<Output = ()> + Send;
}

/// A message as it is handed to the library.
#[derive(Debug)]
pub(super) struct Publication<'a> {
    pub(super) id: MessageId,
    pub(super) topic: &'a str,
    pub(super) payload: Vec<u8>,
    /// Else it is sent once, never repeated.
    pub(super) at_least_once: bool,
    pub(super) retain: bool,
    pub(super) content: Content<'a>,
}

/// What MQTT 5 tells beside a message.
#[derive(Clone, Copy, Debug)]
pub(super) enum Content<'a> {
    /// Nothing: it is no text.
    Bytes,
    /// It is JSON.
    Json {
        /// Time that is left until nobody is to get it.
        expires_in: Option<Duration>,
        /// Of the request that it answers.
        correlation: Option<&'a Arc<[u8]>>,
    },
}

/// A session over `rumqttc`.
#[derive(Debug)]
pub struct Session {
    client: Option<Client>,
    driver: JoinHandle<SessionError>,
    connected: mpsc::Receiver<()>,
    incoming: mpsc::Receiver<Incoming>,
    thrown_away: ThrownAway,
    telling: Interval,
    notices: JoinSet<Option<Happening>>,
    ended: Option<SessionError>,
}

/// The side of a library that takes requests.
#[derive(Debug)]
enum Client {
    V4(v4::Client),
    V5(v5::Client),
}

/// What the task that drives the library tells the session. It never waits: the library would stop answering the broker.
#[derive(Debug)]
struct Pipes {
    connected: mpsc::Sender<()>,
    incoming: mpsc::Sender<Incoming>,
    thrown_away: ThrownAway,
}

impl Pipes {
    fn connected(&self) {
        let _ = self.connected.try_send(());
    }

    fn message(&self, message: Incoming) {
        if self.incoming.try_send(message).is_err() {
            self.thrown_away.count();
        }
    }
}

impl Uplink for Session {
    async fn open(settings: &SessionSettings) -> Result<Self, SessionError> {
        let (connected_sender, connected) = mpsc::channel(1);
        let (incoming_sender, incoming) = mpsc::channel(INCOMING);
        let thrown_away = ThrownAway::default();
        let pipes = Pipes {
            connected: connected_sender,
            incoming: incoming_sender,
            thrown_away: thrown_away.clone(),
        };
        let (client, driver) = match settings.version {
            MqttVersion::V3_1_1 => {
                let (client, event_loop) = v4::open(settings).await?;
                (Client::V4(client), tokio::spawn(v4::drive(event_loop, pipes)))
            }
            MqttVersion::V5 => {
                let (client, event_loop) = v5::open(settings).await?;
                (Client::V5(client), tokio::spawn(v5::drive(event_loop, pipes)))
            }
        };
        Ok(Self {
            client: Some(client),
            driver,
            connected,
            incoming,
            thrown_away,
            telling: interval(TELL_THROWN_AWAY),
            notices: JoinSet::new(),
            ended: None,
        })
    }

    async fn next(&mut self) -> Happening {
        loop {
            if let Some(error) = &self.ended {
                // The library has let go of every message: each notice resolves now.
                match self.notices.join_next().await {
                    Some(Ok(Some(happening))) => return happening,
                    Some(_) => continue,
                    None => return Happening::Closed(error.clone()),
                }
            }
            tokio::select! {
                Some(()) = self.connected.recv() => return Happening::Connected,
                Some(message) = self.incoming.recv() => return Happening::Message(message),
                Some(notice) = self.notices.join_next(), if !self.notices.is_empty() => {
                    if let Ok(Some(happening)) = notice {
                        return happening;
                    }
                }
                _ = self.telling.tick() => tell(&self.thrown_away),
                ended = &mut self.driver => {
                    self.client = None;
                    let failed = |error| SessionError::Lost(format!("the MQTT library failed: {error}"));
                    self.ended = Some(ended.unwrap_or_else(failed));
                }
            }
        }
    }

    fn subscribe(&mut self, topics: &[String]) {
        let Some(client) = self.client.as_ref().filter(|_| !topics.is_empty()) else { return };
        let asked = match client {
            Client::V4(client) => client.subscribe(topics, &mut self.notices),
            Client::V5(client) => client.subscribe(topics, &mut self.notices),
        };
        if !asked {
            tracing::warn!("cannot subscribe to `{}` in this session, which ends", topics.join("`, `"));
            self.driver.abort();
        }
    }

    fn send(&mut self, outgoing: &Outgoing, now: Instant) -> bool {
        let message = &outgoing.message;
        self.hand_over(Publication {
            id: outgoing.id,
            topic: &message.topic,
            payload: message.payload.as_bytes().to_vec(),
            at_least_once: message.at_least_once,
            retain: message.retain,
            content: Content::Json {
                expires_in: message.expires.map(|expires| expires.since(now)),
                correlation: message.correlation.as_ref(),
            },
        })
    }

    async fn disconnect(mut self) {
        let Some(client) = self.client.take() else { return };
        let asked = match &client {
            Client::V4(client) => client.disconnect(),
            Client::V5(client) => client.disconnect(),
        };
        if asked {
            // A broker that does not take it within the time is left without.
            let _ = tokio::time::timeout(DISCONNECT_TIMEOUT, &mut self.driver).await;
        }
    }
}

impl Session {
    /// [`Uplink::send`] of any bytes. A message that is not to be acknowledged is [`Happening::Acknowledged`] once it has left.
    pub(super) fn hand_over(&mut self, message: Publication<'_>) -> bool {
        // A session that is over says why next; the message is not acknowledged, and is sent again.
        match &self.client {
            None => true,
            Some(Client::V4(client)) => client.publish(message, &mut self.notices),
            Some(Client::V5(client)) => client.publish(message, &mut self.notices),
        }
    }
}

impl Drop for Session {
    fn drop(&mut self) {
        self.driver.abort();
        tell(&self.thrown_away);
    }
}

/// Tells of each topic that the broker does not let this client read.
fn tell_refused(topics: &[String], codes: impl Iterator<Item = bool>) {
    for topic in refused(topics, codes) {
        tracing::warn!(
            topic,
            "the broker refuses to subscribe `{topic}`: its access list must let this client read it"
        );
    }
}

/// The topics that the broker does not let this client read: its answer has a code for each of them, in order, which says no or
/// not.
fn refused(topics: &[String], codes: impl Iterator<Item = bool>) -> impl Iterator<Item = &str> {
    topics.iter().zip(codes).filter(|(_, no)| *no).map(|(topic, _)| topic.as_str())
}

fn tell(thrown_away: &ThrownAway) {
    if let Some(count) = thrown_away.take() {
        tracing::warn!(count, "commands came faster than they are looked at: {count} were thrown away");
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_topic_that_the_broker_refuses_is_named() {
        let topics = ["a/tx", "b/tx", "c/tx"].map(str::to_owned);
        let names =
            |codes: &[bool]| refused(&topics, codes.iter().copied()).map(str::to_owned).collect::<Vec<_>>();
        assert_eq!(names(&[true, false, true]), ["a/tx", "c/tx"]);
        assert!(names(&[false; 3]).is_empty() && names(&[]).is_empty());
    }
}
