//! A session with a broker \[IO\]: the trait that the client needs, and its form over `rumqttc`.
//!
//! The library's event loop runs in a task of its own that never waits for a message to be taken: with one task for
//! both, a full request channel would stop the very loop that empties it. Every session has a new event loop, so that
//! nothing of the session before is kept by the library; what was not acknowledged is in our outbox.

use std::future::Future;
use std::path::PathBuf;
use std::time::Duration;

use rumqttc::{
    AsyncClient, ConnectReturnCode, ConnectionError, Event, EventLoop, LastWill, MqttOptions, NetworkOptions,
    Outgoing as Packets, Packet, PublishOptions, QoS,
};
use tokio::sync::mpsc;
use tokio::task::{JoinHandle, JoinSet};

use super::outbox::{MessageId, Outgoing};
use super::publisher::LARGEST_MESSAGE;
use super::settings::{BrokerUrl, MqttSettings};

/// Time for name resolution, TCP and the broker's answer together.
const CONNECT_TIMEOUT_S: u64 = 5;
/// Largest packet taken from the broker; we subscribe to nothing.
const LARGEST_INCOMING: usize = 64 * 1024;
/// Time that a DISCONNECT may take.
const DISCONNECT_TIMEOUT: Duration = Duration::from_secs(1);

/// How to open a session.
#[derive(Clone, Debug)]
pub struct SessionSettings {
    /// Where.
    pub url: BrokerUrl,
    /// As whom.
    pub client_id: String,
    /// User name.
    pub username: Option<String>,
    /// File whose first line is the password.
    pub password_file: Option<PathBuf>,
    /// A dead link is noticed within one and a half times this.
    pub keep_alive: Duration,
    /// Messages in flight.
    pub inflight: u16,
    /// Topic and payload of the last will; acknowledged, retained.
    pub last_will: (String, &'static str),
}

impl SessionSettings {
    /// From the settings of a gateway of this name.
    #[must_use]
    pub fn new(settings: &MqttSettings, gateway: &str, last_will: (&str, &'static str)) -> Self {
        Self {
            url: settings.url.clone(),
            client_id: settings.client_id_for(gateway),
            username: settings.username.clone(),
            password_file: settings.password_file.clone(),
            keep_alive: Duration::from_secs(settings.keep_alive_s.into()),
            inflight: settings.inflight,
            last_will: (last_will.0.to_owned(), last_will.1),
        }
    }
}

/// Why a session did not begin, or ended.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum SessionError {
    /// The broker says no, for a reason that only a person can mend.
    #[error("the broker refuses the session: {0}")]
    Refused(&'static str),
    /// The password file cannot be read.
    #[error("cannot read the password file `{path}`: {error}; check `password_file` and its permissions")]
    Password {
        /// As configured.
        path: String,
        /// What the system says.
        error: String,
    },
    /// Network or protocol.
    #[error("{0}")]
    Lost(String),
    /// Messages were sent and nothing was acknowledged for this long.
    #[error("the broker acknowledged nothing for {} s", .0.as_secs())]
    Silent(Duration),
}

impl SessionError {
    /// Whether both are to be mended in the same way; the words may differ.
    #[must_use]
    pub fn is_kind_of(&self, other: &Self) -> bool {
        match (self, other) {
            (Self::Refused(one), Self::Refused(other)) => one == other,
            _ => std::mem::discriminant(self) == std::mem::discriminant(other),
        }
    }
}

/// What happens in a session.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Happening {
    /// The broker accepted the session.
    Connected,
    /// The broker has a message.
    Acknowledged(MessageId),
    /// The session is over; every acknowledgement that arrived was told before.
    Closed(SessionError),
}

/// A session with a broker. The client is written against this, so that the library behind it can be exchanged.
pub trait Uplink: Send + Sized {
    /// Begins to open a session; [`Happening::Connected`] or [`Happening::Closed`] follows.
    fn open(settings: &SessionSettings) -> impl Future<Output = Result<Self, SessionError>> + Send;

    /// Waits for what happens next. Cancel-safe.
    fn next(&mut self) -> impl Future<Output = Happening> + Send;

    /// Hands a message over without waiting. `false` when it cannot be taken, which ends the session.
    fn send(&mut self, outgoing: &Outgoing) -> bool;

    /// Ends the session in good order: the broker does not publish the last will.
    fn disconnect(self) -> impl Future<Output = ()> + Send;
}

/// A session over `rumqttc`.
#[derive(Debug)]
pub struct RumqttcSession {
    client: Option<AsyncClient>,
    driver: JoinHandle<SessionError>,
    connected: mpsc::Receiver<()>,
    notices: JoinSet<Option<MessageId>>,
    ended: Option<SessionError>,
}

impl Uplink for RumqttcSession {
    async fn open(settings: &SessionSettings) -> Result<Self, SessionError> {
        let options = options(settings).await?;
        let (client, mut event_loop) =
            AsyncClient::builder(options).capacity(usize::from(settings.inflight)).build();
        let mut network = NetworkOptions::new();
        network.set_connection_timeout(CONNECT_TIMEOUT_S);
        network.set_tcp_nodelay(true);
        event_loop.set_network_options(network);
        let (connected_sender, connected) = mpsc::channel(1);
        let driver = tokio::spawn(drive(event_loop, connected_sender));
        Ok(Self { client: Some(client), driver, connected, notices: JoinSet::new(), ended: None })
    }

    async fn next(&mut self) -> Happening {
        loop {
            if let Some(error) = &self.ended {
                // The library has let go of every message: each notice resolves now.
                match self.notices.join_next().await {
                    Some(Ok(Some(id))) => return Happening::Acknowledged(id),
                    Some(_) => continue,
                    None => return Happening::Closed(error.clone()),
                }
            }
            tokio::select! {
                Some(()) = self.connected.recv() => return Happening::Connected,
                Some(notice) = self.notices.join_next(), if !self.notices.is_empty() => {
                    if let Ok(Some(id)) = notice {
                        return Happening::Acknowledged(id);
                    }
                }
                ended = &mut self.driver => {
                    self.client = None;
                    let failed = |error| SessionError::Lost(format!("the MQTT library failed: {error}"));
                    self.ended = Some(ended.unwrap_or_else(failed));
                }
            }
        }
    }

    fn send(&mut self, outgoing: &Outgoing) -> bool {
        let Some(client) = &self.client else { return false };
        let message = &outgoing.message;
        let qos = if message.at_least_once { QoS::AtLeastOnce } else { QoS::AtMostOnce };
        let options = PublishOptions::new(qos).retain(message.retain);
        let Ok(notice) = client.try_publish_tracked(&*message.topic, &*message.payload, options) else {
            return false;
        };
        let id = outgoing.id;
        self.notices.spawn(async move { notice.wait_async().await.ok().map(|_| id) });
        true
    }

    async fn disconnect(mut self) {
        let Some(client) = self.client.take() else { return };
        if client.try_disconnect_now().is_ok() {
            // A broker that does not take it within the time is left without.
            let _ = tokio::time::timeout(DISCONNECT_TIMEOUT, &mut self.driver).await;
        }
    }
}

impl Drop for RumqttcSession {
    fn drop(&mut self) {
        self.driver.abort();
    }
}

/// Polls the event loop until the session ends. Dropping the loop resolves the notices of all messages in it.
async fn drive(mut event_loop: EventLoop, connected: mpsc::Sender<()>) -> SessionError {
    loop {
        match event_loop.poll().await {
            // One CONNACK in a session; the library ends the session at a second.
            Ok(Event::Incoming(Packet::ConnAck(_))) => {
                let _ = connected.try_send(());
            }
            Ok(Event::Outgoing(Packets::Disconnect)) => {
                return SessionError::Lost("disconnected".to_owned());
            }
            Ok(_) => {}
            Err(error) => return reason(&error),
        }
    }
}

#[expect(clippy::wildcard_enum_match_arm, reason = "the library's enum is open")]
fn reason(error: &ConnectionError) -> SessionError {
    match error {
        ConnectionError::ConnectionRefused(code) => match code {
            ConnectReturnCode::BadUserNamePassword => {
                SessionError::Refused("wrong user name or password; check `username` and `password_file`")
            }
            ConnectReturnCode::NotAuthorized => SessionError::Refused(
                "not authorised; the broker asks for a user name, or its access list forbids this one",
            ),
            ConnectReturnCode::BadClientId => {
                SessionError::Refused("it does not take this client id; set `client_id`")
            }
            ConnectReturnCode::RefusedProtocolVersion => {
                SessionError::Refused("it does not speak MQTT 3.1.1")
            }
            ConnectReturnCode::ServiceUnavailable | ConnectReturnCode::Success => {
                SessionError::Lost("the broker says that it is not available".to_owned())
            }
        },
        ConnectionError::NetworkTimeout => {
            SessionError::Lost(format!("no answer within {CONNECT_TIMEOUT_S} s"))
        }
        other => SessionError::Lost(other.to_string()),
    }
}

/// Options of the library. None of its setters that panic is called with what a user wrote.
async fn options(settings: &SessionSettings) -> Result<MqttOptions, SessionError> {
    let host = &settings.url.host;
    let host = if host.contains(':') { format!("[{host}]") } else { host.clone() };
    let mut options = MqttOptions::new(settings.client_id.clone(), (host, settings.url.port));
    // The library notices a missing answer at the second ping, after twice its interval: three quarters of ours, so
    // that a dead link is noticed within one and a half times what the user wrote.
    let interval = settings.keep_alive.as_secs() * 3 / 4;
    options.set_keep_alive(u16::try_from(interval.max(1)).unwrap_or(u16::MAX));
    let (topic, payload) = &settings.last_will;
    options.set_last_will(LastWill::new(topic.clone(), *payload, QoS::AtLeastOnce, true));
    options.set_max_packet_size(LARGEST_INCOMING, 2 * LARGEST_MESSAGE);
    options.set_clean_session(true);
    // Our window is smaller: a broker that acknowledges out of order does not make the library wait.
    options.set_inflight(settings.inflight.saturating_mul(4).max(1));
    if let Some(username) = &settings.username {
        match &settings.password_file {
            Some(path) => {
                let password = tokio::fs::read_to_string(path).await.map_err(|error| {
                    SessionError::Password { path: path.display().to_string(), error: error.to_string() }
                })?;
                let password = password.lines().next().unwrap_or_default().to_owned();
                options.set_credentials(username.clone(), password);
            }
            None => {
                options.set_username(username.clone());
            }
        }
    }
    let patience = u32::try_from((settings.keep_alive * 3 / 2).as_millis()).unwrap_or(u32::MAX);
    options.set_socket_connector(move |address, network| async move {
        let stream = rumqttc::default_socket_connect(address, network).await?;
        // What is sent but never taken by the peer's system ends the connection in the same time.
        nix::sys::socket::setsockopt(&stream, nix::sys::socket::sockopt::TcpUserTimeout, &patience)?;
        Ok(stream)
    });
    Ok(options)
}
