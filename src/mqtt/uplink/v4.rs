//! A session by MQTT 3.1.1, over `rumqttc` \[IO\].

use rumqttc::{
    AsyncClient, ClientError, ConnectReturnCode, ConnectionError, Event, EventLoop, LastWill, MqttOptions,
    Outgoing, Packet, PublishOptions, QoS, StateError, SubscribeFilter, SubscribeReasonCode,
    TlsConfiguration, Transport, mqttbytes,
};
use tokio::task::JoinSet;

use super::connect::{Credentials, connect, network_options, of_io, of_tls, ping_interval_s};
use super::error::{LARGEST_INCOMING, Refusal, SessionError};
use super::{Happening, Incoming, Pipes, Publication, ReplyTo, SessionSettings, Will, tell_refused};
use crate::mqtt::publisher::LARGEST_MESSAGE;
use crate::mqtt::settings::BrokerUrl;
use crate::process_image::SessionTrouble;

/// The side of the library that takes requests.
#[derive(Debug)]
pub(super) struct Client(AsyncClient);

/// Both sides of the library. Nothing happens until the second is driven.
pub(super) async fn open(settings: &SessionSettings) -> Result<(Client, EventLoop), SessionError> {
    let (client, mut event_loop) =
        AsyncClient::builder(options(settings).await?).capacity(settings.capacity()).build();
    event_loop.set_network_options(network_options());
    Ok((Client(client), event_loop))
}

impl Client {
    /// Hands a message over. `false` where it cannot be taken; a session that is over takes it.
    pub(super) fn publish(&self, message: Publication<'_>, notices: &mut JoinSet<Option<Happening>>) -> bool {
        let qos = if message.at_least_once { QoS::AtLeastOnce } else { QoS::AtMostOnce };
        let options = PublishOptions::new(qos).retain(message.retain);
        let notice = match self.0.try_publish_tracked(message.topic, message.payload, options) {
            Ok(notice) => notice,
            Err(error) => return matches!(error, ClientError::RequestChannelDisconnected(_)),
        };
        let id = message.id;
        notices.spawn(async move { notice.wait_async().await.ok().map(|_| Happening::Acknowledged(id)) });
        true
    }

    /// Asks for topics. `false` where that cannot be asked.
    pub(super) fn subscribe(&self, topics: &[String], notices: &mut JoinSet<Option<Happening>>) -> bool {
        let filters = topics.iter().map(|topic| SubscribeFilter::new(topic.clone(), QoS::AtLeastOnce));
        let topics = topics.to_vec();
        let asked = self.0.try_subscribe_many_tracked(filters);
        let is_asked = asked.is_ok();
        notices.spawn(async move {
            if let Ok(notice) = asked {
                let codes = notice.wait_async().await.ok()?.return_codes;
                tell_refused(&topics, codes.iter().map(|code| *code == SubscribeReasonCode::Failure));
            }
            Some(Happening::Subscribed)
        });
        is_asked
    }

    /// Says DISCONNECT. `false` where that cannot be said.
    pub(super) fn disconnect(&self) -> bool {
        self.0.try_disconnect_now().is_ok()
    }
}

/// Polls the event loop until the session ends. Dropping the loop resolves the notices of all messages in it.
pub(super) async fn drive(mut event_loop: EventLoop, pipes: Pipes) -> SessionError {
    loop {
        match event_loop.poll().await {
            // One CONNACK in a session; the library ends the session at a second.
            Ok(Event::Incoming(Packet::ConnAck(_))) => pipes.connected(),
            Ok(Event::Incoming(Packet::Publish(message))) => pipes.message(Incoming {
                topic: String::from_utf8_lossy(&message.topic).into_owned(),
                payload: message.payload.to_vec(),
                retain: message.retain,
                reply_to: ReplyTo::default(),
            }),
            Ok(Event::Outgoing(Outgoing::Disconnect)) => {
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
        ConnectionError::ConnectionRefused(code) => refused(*code),
        ConnectionError::MqttState(StateError::Deserialization(
            mqttbytes::Error::PayloadSizeLimitExceeded(_),
        )) => SessionError::TooLarge,
        ConnectionError::NetworkTimeout => SessionError::NoAnswer,
        ConnectionError::Tls(error) => of_tls(error),
        ConnectionError::Io(error)
        | ConnectionError::MqttState(
            StateError::Io(error) | StateError::Deserialization(mqttbytes::Error::Io(error)),
        ) => of_io(error),
        other => SessionError::Lost(other.to_string()),
    }
}

fn refused(code: ConnectReturnCode) -> SessionError {
    SessionError::Refused(match code {
        ConnectReturnCode::ServiceUnavailable | ConnectReturnCode::Success => {
            return SessionError::NotAvailable;
        }
        ConnectReturnCode::BadUserNamePassword => Refusal::LOGIN,
        ConnectReturnCode::NotAuthorized => Refusal::NOT_AUTHORISED,
        ConnectReturnCode::BadClientId => Refusal::CLIENT_ID,
        ConnectReturnCode::RefusedProtocolVersion => {
            Refusal::new("it does not speak MQTT 3.1.1", SessionTrouble::Protocol)
        }
    })
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
    let Will { topic, payload, retain, .. } = settings.last_will.clone();
    options.set_last_will(LastWill::new(topic, payload, QoS::AtLeastOnce, retain));
    let largest = usize::try_from(LARGEST_INCOMING).unwrap_or(usize::MAX);
    options.set_max_packet_size(largest, 2 * LARGEST_MESSAGE);
    options.set_clean_session(true);
    // Our window is smaller: a broker that acknowledges out of order does not make the library wait.
    options.set_inflight(settings.inflight.saturating_mul(4).max(1));
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
