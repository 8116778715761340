//! Why a handshake failed, in plain words. They follow the name of the peer: "TLS with the broker failed: its certificate has
//! expired".

use std::io;

use rustls::{AlertDescription, CertificateError, Error, InvalidMessage, PeerIncompatible};

use super::TlsError;

/// How long a handshake may take, in seconds.
pub const HANDSHAKE_LIMIT_S: u64 = 5;

/// Why there is no connection.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum Reason {
    /// Its certificate is too old.
    #[error("its certificate has expired: it needs a new one there (or the clock of this host is wrong)")]
    Expired,
    /// Its certificate is too young.
    #[error(
        "its certificate is not valid yet: look at the clock of this host and at the certificate's dates"
    )]
    NotYetValid,
    /// Its certificate is for others.
    #[error(
        "its certificate is for another host{0}; use a name in the address that stands in the certificate"
    )]
    WrongHost(String),
    /// Nobody whom we trust vouches for it.
    #[error(
        "its certificate comes from a certification authority that is not trusted here: check the CA file"
    )]
    UnknownAuthority,
    /// Something else about its certificate.
    #[error("its certificate cannot be accepted: {0}")]
    BadCertificate(String),
    /// A client that has to show a certificate did not.
    #[error("it showed no client certificate")]
    NoClientCertificate,
    /// It wants a certificate of ours, and there is none.
    #[error("it asks for a client certificate and got none: set `cert_file` and `key_file`")]
    WantsClientCertificate,
    /// It does not take our certificate.
    #[error("it refuses our certificate: {0}")]
    RefusesOurs(&'static str),
    /// It speaks other versions of TLS.
    #[error("there is no common version of TLS: 1.2 and 1.3 are spoken here, nothing older")]
    NoCommonVersion,
    /// It has other ciphers, curves or signatures.
    #[error("there is no common cipher suite, key exchange or signature")]
    NoCommonSuite,
    /// It ended the handshake without saying why.
    #[error("it ended the handshake: there is no common cipher suite, or it asks for a client certificate")]
    Refuses,
    /// What it says is no TLS.
    #[error("it does not speak TLS at this port")]
    NoTls,
    /// It went away.
    #[error("it closed the connection during the handshake; does it speak TLS at this port?")]
    Closed,
    /// It took too long.
    #[error("the handshake was not done within {HANDSHAKE_LIMIT_S} s")]
    Slow,
    /// Our own files.
    #[error("{0}")]
    Files(#[from] TlsError),
    /// All else.
    #[error("{0}")]
    Other(String),
}

impl Reason {
    /// The word in metrics and logs.
    #[must_use]
    pub fn word(&self) -> &'static str {
        match self {
            Self::Expired => "expired",
            Self::NotYetValid => "not_yet_valid",
            Self::WrongHost(_) => "wrong_host",
            Self::UnknownAuthority => "unknown_authority",
            Self::BadCertificate(_) => "bad_certificate",
            Self::NoClientCertificate => "no_client_certificate",
            Self::WantsClientCertificate => "wants_client_certificate",
            Self::RefusesOurs(_) => "refuses_ours",
            Self::NoCommonVersion => "no_common_version",
            Self::NoCommonSuite => "no_common_suite",
            Self::Refuses => "refuses",
            Self::NoTls => "no_tls",
            Self::Closed => "closed",
            Self::Slow => "slow",
            Self::Files(_) => "files",
            Self::Other(_) => "other",
        }
    }

    /// Whether it may go away by itself: nobody has to do something about it.
    #[must_use]
    pub fn is_passing(&self) -> bool {
        matches!(self, Self::Closed | Self::Slow | Self::Other(_))
    }

    /// From an error of a stream over TLS, during the handshake or, as TLS 1.3 has it, at the first answer after it. `None` for
    /// what has nothing to do with TLS.
    #[must_use]
    pub fn of_stream(error: &io::Error) -> Option<Self> {
        let inner = error.get_ref()?;
        inner.downcast_ref::<Error>().map(Self::from)
    }

    /// From an error during a handshake.
    #[must_use]
    pub fn of_handshake(error: &io::Error) -> Self {
        const GONE: [io::ErrorKind; 4] = [
            io::ErrorKind::UnexpectedEof,
            io::ErrorKind::ConnectionReset,
            io::ErrorKind::ConnectionAborted,
            io::ErrorKind::BrokenPipe,
        ];
        let other = || {
            if GONE.contains(&error.kind()) { Self::Closed } else { Self::Other(error.to_string()) }
        };
        Self::of_stream(error).unwrap_or_else(other)
    }
}

#[expect(clippy::wildcard_enum_match_arm, reason = "the library's enums are open")]
impl From<&Error> for Reason {
    fn from(error: &Error) -> Self {
        match error {
            Error::InvalidCertificate(certificate) => of_certificate(certificate),
            Error::NoCertificatesPresented => Self::NoClientCertificate,
            Error::AlertReceived(alert) => of_alert(*alert),
            Error::PeerIncompatible(
                // Who is older than TLS 1.2 has no such extension.
                PeerIncompatible::SignatureAlgorithmsExtensionRequired
                | PeerIncompatible::ServerDoesNotSupportTls12Or13
                | PeerIncompatible::ServerTlsVersionIsDisabledByOurConfig
                | PeerIncompatible::SupportedVersionsExtensionRequired
                | PeerIncompatible::Tls12NotOffered
                | PeerIncompatible::Tls12NotOfferedOrEnabled,
            )
            | Error::InvalidMessage(InvalidMessage::UnknownProtocolVersion) => Self::NoCommonVersion,
            Error::PeerIncompatible(_) => Self::NoCommonSuite,
            // Its first bytes are no record of TLS.
            Error::InvalidMessage(
                InvalidMessage::InvalidContentType
                | InvalidMessage::MessageTooLarge
                | InvalidMessage::InvalidEmptyPayload,
            )
            | Error::PeerSentOversizedRecord => Self::NoTls,
            other => Self::Other(other.to_string()),
        }
    }
}

#[expect(clippy::wildcard_enum_match_arm, reason = "the library's enum is open")]
fn of_certificate(error: &CertificateError) -> Reason {
    match error {
        CertificateError::Expired | CertificateError::ExpiredContext { .. } => Reason::Expired,
        CertificateError::NotValidYet | CertificateError::NotValidYetContext { .. } => Reason::NotYetValid,
        CertificateError::NotValidForName => Reason::WrongHost(String::new()),
        CertificateError::NotValidForNameContext { expected, presented } => {
            let names = if presented.is_empty() { "nobody".to_owned() } else { presented.join(", ") };
            Reason::WrongHost(format!(" than `{}`: it names {names}", expected.to_str()))
        }
        CertificateError::UnknownIssuer => Reason::UnknownAuthority,
        CertificateError::Revoked => Reason::BadCertificate("it was revoked".to_owned()),
        CertificateError::InvalidPurpose | CertificateError::InvalidPurposeContext { .. } => {
            Reason::BadCertificate("it was made for another purpose (extended key usage)".to_owned())
        }
        CertificateError::UnhandledCriticalExtension => {
            Reason::BadCertificate("it has a critical extension that is not known here".to_owned())
        }
        CertificateError::Other(other) => Reason::BadCertificate(of_other(&other.0.to_string())),
        other => Reason::BadCertificate(other.to_string()),
    }
}

/// What the library says of certificates that are their own authority.
fn of_other(text: &str) -> String {
    if text.contains("CaUsedAsEndEntity") {
        "it is that of an authority itself; the host needs one of its own, made without `CA:TRUE`".to_owned()
    } else {
        text.to_owned()
    }
}

#[expect(clippy::wildcard_enum_match_arm, reason = "the library's enum is open")]
fn of_alert(alert: AlertDescription) -> Reason {
    match alert {
        AlertDescription::CertificateRequired => Reason::WantsClientCertificate,
        AlertDescription::CertificateExpired => Reason::RefusesOurs("it has expired, or is not valid yet"),
        AlertDescription::UnknownCA => {
            Reason::RefusesOurs("it comes from a certification authority that is not trusted there")
        }
        AlertDescription::CertificateRevoked => Reason::RefusesOurs("it was revoked"),
        AlertDescription::UnsupportedCertificate => Reason::RefusesOurs("it was made for another purpose"),
        AlertDescription::BadCertificate | AlertDescription::CertificateUnknown => {
            Reason::RefusesOurs("it is not what is expected there")
        }
        AlertDescription::AccessDenied => Reason::RefusesOurs("it gives no right to enter"),
        AlertDescription::DecryptError => Reason::RefusesOurs("its signature does not hold"),
        AlertDescription::ProtocolVersion => Reason::NoCommonVersion,
        AlertDescription::InsufficientSecurity => Reason::NoCommonSuite,
        AlertDescription::HandshakeFailure => Reason::Refuses,
        AlertDescription::UnrecognisedName => {
            Reason::WrongHost(": it knows no host of the name in the address".to_owned())
        }
        other => Reason::Other(format!("it ended the connection with the TLS alert {other:?}")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_a_stream_says_after_the_handshake_is_understood_too() {
        let late = io::Error::new(
            io::ErrorKind::InvalidData,
            Error::AlertReceived(AlertDescription::CertificateRequired),
        );
        assert_eq!(Reason::of_stream(&late), Some(Reason::WantsClientCertificate));
        assert_eq!(Reason::of_stream(&io::Error::from(io::ErrorKind::ConnectionReset)), None);
        assert_eq!(Reason::of_handshake(&io::Error::from(io::ErrorKind::ConnectionReset)), Reason::Closed);
    }

    #[test]
    fn a_wrong_name_is_told_with_those_that_would_be_right() {
        let expected = rustls::pki_types::ServerName::try_from("broker.plant").unwrap();
        let error = Error::InvalidCertificate(CertificateError::NotValidForNameContext {
            expected,
            presented: vec!["DnsName(\"mqtt.plant\")".into()],
        });
        let text = Reason::from(&error).to_string();
        assert!(text.contains("than `broker.plant`") && text.contains("mqtt.plant"), "{text}");
    }

    #[test]
    fn what_a_person_must_mend_is_told_apart_from_what_passes() {
        assert!(Reason::Slow.is_passing() && Reason::Closed.is_passing());
        for reason in [Reason::Expired, Reason::UnknownAuthority, Reason::WantsClientCertificate] {
            assert!(!reason.is_passing(), "{reason}");
        }
    }
}
