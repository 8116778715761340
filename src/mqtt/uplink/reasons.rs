//! What the reason codes of MQTT 5 mean here. Nothing is done with them but to read them; \[IO\] only because the library has them.

use rumqttc5::{ConnectReturnCode, DisconnectReasonCode, PubAckReason};

use super::NotTaken;
use super::error::{Refusal, SessionError};
use crate::process_image::SessionTrouble;

const MOVED: Refusal = Refusal::new("it has moved: look for its new address", SessionTrouble::Moved);
const QUOTA: Refusal =
    Refusal::new("this client has used up what it is allowed: its quota or its rate", SessionTrouble::Quota);
const NO_RETAIN: Refusal = Refusal::new("it keeps no retained messages", SessionTrouble::Unsupported);
const NO_QOS: Refusal =
    Refusal::new("it takes no messages with quality of service 1", SessionTrouble::Unsupported);
const TOPIC: Refusal =
    Refusal::new("it does not take a topic; look at `base_topic`", SessionTrouble::Unsupported);
const TOO_LARGE: Refusal = Refusal::new("a message was larger than it takes", SessionTrouble::Unsupported);

/// Why a session is refused.
pub(super) fn refused(code: ConnectReturnCode) -> SessionError {
    use ConnectReturnCode as Code;
    SessionError::Refused(match code {
        Code::Success | Code::ServiceUnavailable | Code::ServerUnavailable | Code::ServerBusy => {
            return SessionError::NotAvailable;
        }
        Code::BadUserNamePassword => Refusal::LOGIN,
        Code::BadAuthenticationMethod => {
            Refusal::new("it asks for another way of authentication", SessionTrouble::Login)
        }
        Code::NotAuthorized => Refusal::NOT_AUTHORISED,
        Code::Banned => Refusal::new("it has banned this client", SessionTrouble::NotAuthorised),
        Code::ClientIdentifierNotValid | Code::BadClientId => Refusal::CLIENT_ID,
        Code::UnsupportedProtocolVersion | Code::RefusedProtocolVersion => Refusal::NOT_MQTT_5,
        Code::QuotaExceeded | Code::ConnectionRateExceeded => QUOTA,
        Code::UseAnotherServer | Code::ServerMoved => MOVED,
        Code::RetainNotSupported => NO_RETAIN,
        Code::QoSNotSupported => NO_QOS,
        Code::TopicNameInvalid => TOPIC,
        Code::PacketTooLarge => TOO_LARGE,
        Code::UnspecifiedError
        | Code::MalformedPacket
        | Code::ProtocolError
        | Code::ImplementationSpecificError
        | Code::PayloadFormatInvalid => Refusal::UNNAMED,
    })
}

/// Why the broker ended a session.
pub(super) fn dropped(code: DisconnectReasonCode) -> SessionError {
    use DisconnectReasonCode as Code;
    let ended = |words| (Refusal::new(words, SessionTrouble::Ended), true);
    let (why, is_passing) = match code {
        Code::SessionTakenOver => (
            Refusal::new(
                "another client took it over; give each its own `client_id`",
                SessionTrouble::TakenOver,
            ),
            false,
        ),
        Code::NotAuthorized => (
            Refusal::new(
                "this client is not authorised for what it sent or asked for; look at its access list",
                SessionTrouble::NotAuthorised,
            ),
            false,
        ),
        Code::QuotaExceeded
        | Code::MessageRateTooHigh
        | Code::ReceiveMaximumExceeded
        | Code::ConnectionRateExceeded => (QUOTA, false),
        Code::UseAnotherServer | Code::ServerMoved => (MOVED, false),
        Code::RetainNotSupported => (NO_RETAIN, false),
        Code::QoSNotSupported => (NO_QOS, false),
        Code::PacketTooLarge => (TOO_LARGE, false),
        Code::TopicFilterInvalid
        | Code::TopicNameInvalid
        | Code::SharedSubscriptionNotSupported
        | Code::SubscriptionIdentifiersNotSupported
        | Code::WildcardSubscriptionsNotSupported => (TOPIC, false),
        Code::ServerBusy => (Refusal::new("it has too much to do", SessionTrouble::NotAvailable), true),
        Code::ServerShuttingDown => (Refusal::new("it is being stopped", SessionTrouble::NotAvailable), true),
        Code::KeepAliveTimeout => ended("nothing came from here for too long"),
        Code::AdministrativeAction => ended("an administrator asked for it"),
        Code::MaximumConnectTime => ended("it lasted as long as it may"),
        Code::MalformedPacket
        | Code::ProtocolError
        | Code::TopicAliasInvalid
        | Code::PayloadFormatInvalid => ended("it did not understand what it got"),
        Code::NormalDisconnection
        | Code::DisconnectWithWillMessage
        | Code::UnspecifiedError
        | Code::ImplementationSpecificError => ended("for a reason that it does not name"),
    };
    SessionError::Dropped { why, is_passing }
}

/// Why the broker does not take a message; `None` where it does.
pub(super) fn not_taken(code: PubAckReason) -> Option<NotTaken> {
    use PubAckReason as Code;
    Some(match code {
        Code::Success | Code::NoMatchingSubscribers => return None,
        Code::NotAuthorized => NotTaken::for_now("its access list does not let this client write it"),
        Code::QuotaExceeded => NotTaken::for_now("its quota is used up"),
        Code::UnspecifiedError | Code::ImplementationSpecificError | Code::PacketIdentifierInUse => {
            NotTaken::for_now("for a reason that it does not name")
        }
        Code::TopicNameInvalid => NotTaken::for_ever("it does not take such a topic"),
        Code::PayloadFormatInvalid => NotTaken::for_ever("its payload is not what it says it is"),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_only_a_person_can_mend_is_not_tried_often() {
        for (error, often) in [
            (refused(ConnectReturnCode::NotAuthorized), false),
            (refused(ConnectReturnCode::ServerMoved), false),
            (refused(ConnectReturnCode::ServerBusy), true),
            (dropped(DisconnectReasonCode::SessionTakenOver), false),
            (dropped(DisconnectReasonCode::ServerShuttingDown), true),
        ] {
            assert_eq!(!error.is_refusal(), often, "{error}");
        }
    }

    #[test]
    fn two_reasons_are_two_kinds_of_trouble() {
        let taken_over = dropped(DisconnectReasonCode::SessionTakenOver);
        assert_eq!(taken_over.trouble(), SessionTrouble::TakenOver);
        assert!(!taken_over.is_kind_of(&dropped(DisconnectReasonCode::ServerShuttingDown)));
        assert!(taken_over.is_kind_of(&taken_over));
        assert!(!refused(ConnectReturnCode::Banned).is_kind_of(&refused(ConnectReturnCode::NotAuthorized)));
    }

    #[test]
    fn a_message_without_a_reader_is_taken_and_one_that_is_refused_is_not() {
        assert_eq!(not_taken(PubAckReason::NoMatchingSubscribers), None);
        assert!(!not_taken(PubAckReason::QuotaExceeded).unwrap().for_ever);
        assert!(not_taken(PubAckReason::PayloadFormatInvalid).unwrap().for_ever);
    }
}
