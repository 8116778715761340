//! A session by MQTT 5, over `rumqttc` for it \[IO\].
//!
//! The session is as with MQTT 3.1.1: it begins clean, and ends with the connection. Topic aliases are not used. What the broker
//! says that it does not take is looked at before it is sent: it would end the session.

use std::sync::{Arc, OnceLock};
use std::time::Duration;

use rumqttc5::mqttbytes;
use rumqttc5::{
    AsyncClient, ClientError, ConnAck, ConnectionError, Event, EventLoop, LastWill, LastWillProperties,
    MqttOptions, Outgoing, Packet, Publish, PublishNotice, PublishNoticeError, PublishOptions,
    PublishProperties, PublishResult, QoS, StateError, SubscribeFilter, SubscribeReasonCode,
    TlsConfiguration, Transport,
};
use tokio::task::JoinSet;

use super::connect::{Credentials, connect, network_options, of_io, of_tls, ping_interval_s};
use super::error::{CONNECT_TIMEOUT, LARGEST_INCOMING, Refusal, SessionError};
use super::reasons::{dropped, not_taken, refused};
use super::{
    Content, Happening, Incoming, NotTaken, Pipes, Publication, ReplyTo, SessionSettings, Will, tell_refused,
};
use crate::mqtt::labels::labels;
use crate::mqtt::settings::BrokerUrl;
use crate::process_image::SessionTrouble;

/// Payload Format Indicator: the payload is text.
const UTF_8: u8 = 1;
/// Content Type.
const JSON: &str = "application/json";

/// The side of the library that takes requests.
#[derive(Debug)]
pub(super) struct Client {
    requests: AsyncClient,
    largest: Arc<OnceLock<u32>>,
}

/// The side of the library that speaks with the broker.
pub(super) struct Loop {
    events: EventLoop,
    /// Largest packet that the broker takes, once it said so.
    largest: Arc<OnceLock<u32>>,
    /// The last will is retained, and so are most messages.
    retains: bool,
}

/// Both sides of the library. Nothing happens until the second is driven.
pub(super) async fn open(settings: &SessionSettings) -> Result<(Client, Loop), SessionError> {
    let options = options(settings).await?;
    let (requests, events) = AsyncClient::builder(options).capacity(settings.capacity()).build();
    let largest = Arc::new(OnceLock::new());
    let client = Client { requests, largest: Arc::clone(&largest) };
    Ok((client, Loop { events, largest, retains: settings.last_will.retain }))
}

impl Client {
    /// Hands a message over. `false` where it cannot be taken; a session that is over takes it.
    pub(super) fn publish(&self, message: Publication<'_>, notices: &mut JoinSet<Option<Happening>>) -> bool {
        let id = message.id;
        let qos = if message.at_least_once { QoS::AtLeastOnce } else { QoS::AtMostOnce };
        if matches!(message.content, Content::Json { expires_in: Some(Duration::ZERO), .. }) {
            notices.spawn(std::future::ready(Some(Happening::NotTaken(id, NotTaken::EXPIRED))));
            return true;
        }
        let properties = properties(&message);
        let largest = self.largest.get().copied();
        if largest.is_some_and(|largest| size(&message, qos, properties.clone()) > largest) {
            notices.spawn(std::future::ready(Some(Happening::NotTaken(id, NotTaken::TOO_LARGE))));
            return true;
        }
        let options = PublishOptions::new(qos).retain(message.retain).properties(properties);
        let notice = match self.requests.try_publish_tracked(message.topic, message.payload, options) {
            Ok(notice) => notice,
            Err(error) => return matches!(error, ClientError::RequestChannelDisconnected(_)),
        };
        notices.spawn(async move { outcome(notice).await.map(|why| told(id, why)) });
        true
    }

    /// Asks for topics. `false` where that cannot be asked.
    pub(super) fn subscribe(&self, topics: &[String], notices: &mut JoinSet<Option<Happening>>) -> bool {
        let filters = topics.iter().map(|topic| SubscribeFilter::new(topic.clone(), QoS::AtLeastOnce));
        let topics = topics.to_vec();
        let asked = self.requests.try_subscribe_many_tracked(filters);
        let is_asked = asked.is_ok();
        notices.spawn(async move {
            if let Ok(notice) = asked {
                let codes = notice.wait_async().await.ok()?.return_codes;
                let refused = |code: &_| !matches!(code, SubscribeReasonCode::Success(_));
                tell_refused(&topics, codes.iter().map(refused));
            }
            Some(Happening::Subscribed)
        });
        is_asked
    }

    /// Says DISCONNECT. `false` where that cannot be said.
    pub(super) fn disconnect(&self) -> bool {
        self.requests.try_disconnect_now().is_ok()
    }
}

/// What became of a message: `Some(None)` where the broker has it, `None` where it was not told.
async fn outcome(notice: PublishNotice) -> Option<Option<NotTaken>> {
    match notice.wait_async().await {
        Ok(PublishResult::Qos1(answer)) => Some(not_taken(answer.reason)),
        Ok(_) => Some(None),
        Err(PublishNoticeError::RetainNotSupported) => Some(Some(NotTaken::NO_RETAIN)),
        // The session is over, and says why itself.
        Err(_) => None,
    }
}

fn told(id: super::MessageId, why: Option<NotTaken>) -> Happening {
    why.map_or(Happening::Acknowledged(id), |why| Happening::NotTaken(id, why))
}

/// What is told beside a message.
fn properties(message: &Publication<'_>) -> PublishProperties {
    let Content::Json { expires_in, correlation } = message.content else {
        return PublishProperties::default();
    };
    if message.payload.is_empty() {
        // Clears a retained topic: there is nothing to tell of.
        return PublishProperties::default();
    }
    PublishProperties {
        payload_format_indicator: Some(UTF_8),
        content_type: Some(JSON.to_owned()),
        message_expiry_interval: expires_in.map(|left| {
            let seconds = left.as_secs() + u64::from(left.subsec_nanos() > 0);
            u32::try_from(seconds).unwrap_or(u32::MAX)
        }),
        correlation_data: correlation.map(|data| data.to_vec().into()),
        user_properties: labels(&message.payload),
        ..PublishProperties::default()
    }
}

/// Where an answer is wanted.
fn reply_to(properties: Option<PublishProperties>) -> ReplyTo {
    let Some(properties) = properties else { return ReplyTo::default() };
    ReplyTo {
        topic: properties.response_topic,
        correlation: properties.correlation_data.map(|data| data.to_vec().into()),
    }
}

/// Bytes of a message on the wire.
fn size(message: &Publication<'_>, qos: QoS, properties: PublishProperties) -> u32 {
    let mut publish = Publish::new(message.topic, qos, message.payload.clone(), Some(properties));
    // Its number is part of the packet.
    publish.pkid = 1;
    u32::try_from(publish.size()).unwrap_or(u32::MAX)
}

/// Polls the event loop until the session ends. Dropping the loop resolves the notices of all messages in it.
pub(super) async fn drive(mut session: Loop, pipes: Pipes) -> SessionError {
    let mut is_answered = false;
    loop {
        match session.events.poll().await {
            // One CONNACK in a session; the library ends the session at a second.
            Ok(Event::Incoming(Packet::ConnAck(answer))) => {
                if let Some(lacking) = session.lacks(&answer) {
                    return SessionError::Refused(lacking);
                }
                is_answered = true;
                pipes.connected();
            }
            Ok(Event::Incoming(Packet::Publish(message))) => pipes.message(Incoming {
                topic: String::from_utf8_lossy(&message.topic).into_owned(),
                payload: message.payload.to_vec(),
                retain: message.retain,
                reply_to: reply_to(message.properties),
            }),
            Ok(Event::Outgoing(Outgoing::Disconnect)) => {
                return SessionError::Lost("disconnected".to_owned());
            }
            Ok(_) => {}
            Err(error) => return with_hint(reason(&error), is_answered),
        }
    }
}

/// A broker that does not know MQTT 5 answers what MQTT 5 cannot read, if anything, and ends the connection.
fn with_hint(error: SessionError, is_answered: bool) -> SessionError {
    let SessionError::Lost(why) = &error else { return error };
    if is_answered {
        return error;
    }
    let hint = "in place of an answer; if the broker does not speak MQTT 5, set `version = \"3.1.1\"`";
    SessionError::Lost(format!("{why}, {hint}"))
}

impl Loop {
    /// What is needed and the broker does not have.
    fn lacks(&self, answer: &ConnAck) -> Option<Refusal> {
        let properties = answer.properties.as_ref()?;
        if let Some(largest) = properties.max_packet_size {
            // Only the first answer counts, and there is but one.
            let _ = self.largest.set(largest);
        }
        if properties.max_qos == Some(0) {
            let words = "it takes no messages with quality of service 1";
            return Some(Refusal::new(words, SessionTrouble::Unsupported));
        }
        let keeps_none = properties.retain_available == Some(0) && self.retains;
        keeps_none.then(|| Refusal::new("it keeps no retained messages", SessionTrouble::Unsupported))
    }
}

#[expect(clippy::wildcard_enum_match_arm, reason = "the library's enum is open")]
fn reason(error: &ConnectionError) -> SessionError {
    match error {
        ConnectionError::ConnectionRefused(code)
        | ConnectionError::MqttState(StateError::ConnFail { reason: code }) => refused(*code),
        ConnectionError::MqttState(StateError::ServerDisconnect { reason_code, .. }) => dropped(*reason_code),
        ConnectionError::MqttState(StateError::Deserialization(
            mqttbytes::Error::PayloadSizeLimitExceeded { .. },
        )) => SessionError::TooLarge,
        ConnectionError::Timeout(_) => SessionError::NoAnswer,
        ConnectionError::Tls(error) => of_tls(error),
        ConnectionError::Io(error)
        | ConnectionError::MqttState(
            StateError::Io(error) | StateError::Deserialization(mqttbytes::Error::Io(error)),
        ) => of_io(error),
        other => SessionError::Lost(other.to_string()),
    }
}

/// Options of the library. None of its setters that panic is called with what a user wrote.
async fn options(settings: &SessionSettings) -> Result<MqttOptions, SessionError> {
    // The name that the broker's certificate must have: without the brackets of an address. The connector below knows the way.
    let BrokerUrl { host, port, .. } = settings.url.clone();
    let mut options = MqttOptions::new(settings.client_id.clone(), (host, port));
    if let Some(tls) = settings.tls_config().await? {
        options.set_transport(Transport::tls_with_config(TlsConfiguration::Rustls(tls)));
    }
    options.set_keep_alive(ping_interval_s(settings.keep_alive));
    options.set_connect_timeout(CONNECT_TIMEOUT);
    options.set_network_options(network_options());
    let Will { topic, payload, retain, is_json } = settings.last_will.clone();
    let told = is_json.then(|| LastWillProperties {
        delay_interval: None,
        payload_format_indicator: Some(UTF_8),
        message_expiry_interval: None,
        content_type: Some(JSON.to_owned()),
        response_topic: None,
        correlation_data: None,
        user_properties: Vec::new(),
    });
    options.set_last_will(LastWill::new(topic, payload, QoS::AtLeastOnce, retain, told));
    options.set_max_packet_size(Some(LARGEST_INCOMING));
    // Without a session expiry the session ends with the connection (MQTT 5, 3.1.2.11.2); so Sparkplug 3.0 wants it, too
    // (tck-id-principles-persistence-clean-session-50).
    options.set_clean_start(true);
    // Our window is smaller: a broker that acknowledges out of order does not make the library wait. The broker's Receive
    // Maximum counts where it is smaller still.
    options.set_outgoing_inflight_upper_limit(settings.inflight.saturating_mul(4).max(1));
    match Credentials::read(settings).await? {
        Credentials::None => {}
        Credentials::Username(username) => {
            options.set_username(username);
        }
        Credentials::Both(username, password) => {
            options.set_credentials(username, password);
        }
    }
    let (place, patience) = (settings.url.place(), settings.patience());
    options.set_socket_connector(move |_, network| connect(place.clone(), network, patience));
    Ok(options)
}
