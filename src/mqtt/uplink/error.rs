//! Why a session with a broker did not begin, or ended. Pure.

use std::time::Duration;

use crate::mqtt::subscription::WITHOUT_COMMANDS;
use crate::process_image::SessionTrouble;
use crate::tls::Reason;

/// Time for name resolution, TCP and the broker's answer together.
pub(super) const CONNECT_TIMEOUT: Duration = Duration::from_secs(5);
/// Largest packet taken from the broker. A message on a command topic that is larger ends the session.
pub(super) const LARGEST_INCOMING: u32 = 64 * 1024;

/// What a broker says no with.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Refusal {
    /// In words.
    pub words: &'static str,
    /// As a number for the alarm.
    pub trouble: SessionTrouble,
}

impl Refusal {
    /// For no reason that is known here.
    pub const UNNAMED: Self = Self::new("for a reason that it does not name", SessionTrouble::Ended);
    /// User name or password.
    pub const LOGIN: Self =
        Self::new("wrong user name or password; check `username` and `password_file`", SessionTrouble::Login);
    /// Its access list.
    pub const NOT_AUTHORISED: Self = Self::new(
        "not authorised; the broker asks for a user name, or its access list forbids this one",
        SessionTrouble::NotAuthorised,
    );
    /// The client id.
    pub const CLIENT_ID: Self =
        Self::new("it does not take this client id; set `client_id`", SessionTrouble::ClientId);

    /// MQTT 5.
    pub const NOT_MQTT_5: Self =
        Self::new("it does not speak MQTT 5; set `version = \"3.1.1\"`", SessionTrouble::Protocol);

    /// A refusal in words, and as a number.
    #[must_use]
    pub const fn new(words: &'static str, trouble: SessionTrouble) -> Self {
        Self { words, trouble }
    }
}

/// Why a session did not begin, or ended.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum SessionError {
    /// The broker says no, for a reason that only a person can mend.
    #[error("the broker refuses the session: {}", .0.words)]
    Refused(Refusal),
    /// The broker ended a session, and said why.
    #[error("the broker ended the session: {}", .why.words)]
    Dropped {
        /// Why.
        why: Refusal,
        /// It mends itself.
        is_passing: bool,
    },
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
    /// It cannot be reached.
    #[error("{0}")]
    Unreachable(String),
    /// It takes the connection and does not answer.
    #[error("no answer within {} s", CONNECT_TIMEOUT.as_secs())]
    NoAnswer,
    /// It says so itself.
    #[error("the broker says that it is not available")]
    NotAvailable,
    /// TLS.
    #[error("{prefix}{0}", prefix = if matches!(.0, Reason::Files(_)) { "" } else { "TLS with the broker failed: " })]
    Tls(Reason),
    /// A message on a command topic was too large to be taken.
    #[error(
        "a message of more than {} KiB came on a command topic: commands are not taken for {} minutes; if it is retained, clear \
         it with an empty retained message",
        LARGEST_INCOMING / 1024,
        WITHOUT_COMMANDS.as_secs() / 60
    )]
    TooLarge,
    /// Messages were sent and nothing was acknowledged for this long.
    #[error("the broker acknowledged nothing for {} s", .0.as_secs())]
    Silent(Duration),
}

impl SessionError {
    /// Whether both are to be mended in the same way; the words may differ.
    #[must_use]
    pub fn is_kind_of(&self, other: &Self) -> bool {
        match (self, other) {
            (Self::Refused(one), Self::Refused(other))
            | (Self::Dropped { why: one, .. }, Self::Dropped { why: other, .. }) => one == other,
            (Self::Tls(one), Self::Tls(other)) => one.word() == other.word(),
            _ => std::mem::discriminant(self) == std::mem::discriminant(other),
        }
    }

    /// Whether only a person can mend it, so that trying often is of no use.
    #[must_use]
    pub fn is_refusal(&self) -> bool {
        match self {
            Self::Refused(_) | Self::Password { .. } => true,
            Self::Dropped { is_passing, .. } => !is_passing,
            Self::Tls(reason) => !reason.is_passing(),
            Self::Lost(_)
            | Self::Unreachable(_)
            | Self::NoAnswer
            | Self::NotAvailable
            | Self::TooLarge
            | Self::Silent(_) => false,
        }
    }

    /// The same as a number for the alarm.
    #[must_use]
    pub fn trouble(&self) -> SessionTrouble {
        match self {
            Self::Refused(refusal) | Self::Dropped { why: refusal, .. } => refusal.trouble,
            Self::Password { .. } => SessionTrouble::PasswordFile,
            Self::Lost(_) => SessionTrouble::Ended,
            Self::Unreachable(_) => SessionTrouble::Unreachable,
            Self::NoAnswer => SessionTrouble::NoAnswer,
            Self::NotAvailable => SessionTrouble::NotAvailable,
            Self::TooLarge => SessionTrouble::LargeCommand,
            Self::Silent(_) => SessionTrouble::Unacknowledged,
            Self::Tls(reason) => trouble_of_tls(reason),
        }
    }
}

fn trouble_of_tls(reason: &Reason) -> SessionTrouble {
    match reason {
        Reason::Files(_) => SessionTrouble::TlsFiles,
        Reason::Expired => SessionTrouble::Expired,
        Reason::NotYetValid => SessionTrouble::NotYetValid,
        Reason::WrongHost(_) => SessionTrouble::WrongHost,
        Reason::UnknownAuthority => SessionTrouble::UnknownAuthority,
        Reason::BadCertificate(_) | Reason::NoClientCertificate => SessionTrouble::BadCertificate,
        Reason::WantsClientCertificate => SessionTrouble::WantsClientCertificate,
        Reason::RefusesOurs(_) => SessionTrouble::RefusesOurs,
        Reason::NoCommonVersion => SessionTrouble::NoCommonVersion,
        Reason::NoCommonSuite => SessionTrouble::NoCommonSuite,
        Reason::NoTls => SessionTrouble::NoTls,
        Reason::Refuses | Reason::Closed | Reason::Slow | Reason::Other(_) => SessionTrouble::Handshake,
    }
}
