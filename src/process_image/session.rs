//! Why there is no session with the MQTT broker, as a number for alarms and as a sentence for people.

/// Why there is none.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum SessionTrouble {
    /// Name, address, port, network.
    Unreachable,
    /// It takes the connection and says nothing.
    NoAnswer,
    /// User name or password.
    Login,
    /// Its access list.
    NotAuthorised,
    /// The client id.
    ClientId,
    /// The version of MQTT.
    Protocol,
    /// It says that it is not available.
    NotAvailable,
    /// A session ended, by the broker or the network.
    Ended,
    /// Messages were sent and nothing was acknowledged.
    Unacknowledged,
    /// A message on a command topic was too large.
    LargeCommand,
    /// The password file.
    PasswordFile,
    /// Another client took the session over.
    TakenOver,
    /// The broker is somewhere else now.
    Moved,
    /// A quota, or a rate.
    Quota,
    /// Something that is needed and that the broker does not have.
    Unsupported,
    /// Files of `[mqtt.tls]`.
    TlsFiles,
    /// Its certificate is too old.
    Expired,
    /// Its certificate is too young.
    NotYetValid,
    /// Its certificate is for another host.
    WrongHost,
    /// Nobody whom we trust vouches for its certificate.
    UnknownAuthority,
    /// Something else about its certificate.
    BadCertificate,
    /// It asks for a certificate, and there is none.
    WantsClientCertificate,
    /// It does not take our certificate.
    RefusesOurs,
    /// No common version of TLS.
    NoCommonVersion,
    /// No common cipher suite.
    NoCommonSuite,
    /// No TLS at this port.
    NoTls,
    /// The handshake failed otherwise.
    Handshake,
}

impl SessionTrouble {
    /// All of them.
    pub const ALL: [Self; 27] = [
        Self::Unreachable,
        Self::NoAnswer,
        Self::Login,
        Self::NotAuthorised,
        Self::ClientId,
        Self::Protocol,
        Self::NotAvailable,
        Self::Ended,
        Self::Unacknowledged,
        Self::LargeCommand,
        Self::PasswordFile,
        Self::TakenOver,
        Self::Moved,
        Self::Quota,
        Self::Unsupported,
        Self::TlsFiles,
        Self::Expired,
        Self::NotYetValid,
        Self::WrongHost,
        Self::UnknownAuthority,
        Self::BadCertificate,
        Self::WantsClientCertificate,
        Self::RefusesOurs,
        Self::NoCommonVersion,
        Self::NoCommonSuite,
        Self::NoTls,
        Self::Handshake,
    ];

    /// Its number, the value of the alarm: 1.. for the session, 20.. for TLS. None changes its meaning.
    #[must_use]
    pub fn code(self) -> u16 {
        self.told().0
    }

    /// What it is, a sentence about the broker.
    #[must_use]
    pub fn meaning(self) -> &'static str {
        self.told().1
    }

    /// The one of a number.
    #[must_use]
    pub fn of_code(code: u64) -> Option<Self> {
        Self::ALL.into_iter().find(|trouble| u64::from(trouble.code()) == code)
    }

    fn told(self) -> (u16, &'static str) {
        match self {
            Self::Unreachable => (1, "It cannot be reached."),
            Self::NoAnswer => (2, "It does not answer."),
            Self::Login => (3, "It refuses the user name or the password."),
            Self::NotAuthorised => (4, "It does not authorise this client."),
            Self::ClientId => (5, "It does not take the client id."),
            Self::Protocol => (6, "It does not speak this version of MQTT."),
            Self::NotAvailable => (7, "It says that it is not available."),
            Self::Ended => (8, "The session ended."),
            Self::Unacknowledged => (9, "It acknowledges nothing."),
            Self::LargeCommand => (10, "A message on a command topic was too large."),
            Self::PasswordFile => (11, "The password file cannot be read."),
            Self::TakenOver => (12, "Another client took the session over."),
            Self::Moved => (13, "It has moved."),
            Self::Quota => (14, "A quota or a rate is used up."),
            Self::Unsupported => (15, "It does not take what is sent to it."),
            Self::TlsFiles => (20, "The files of TLS cannot be used."),
            Self::Expired => (21, "Its certificate has expired."),
            Self::NotYetValid => (22, "Its certificate is not valid yet."),
            Self::WrongHost => (23, "Its certificate is for another host."),
            Self::UnknownAuthority => {
                (24, "Its certificate comes from an authority that is not trusted here.")
            }
            Self::BadCertificate => (25, "Its certificate cannot be accepted."),
            Self::WantsClientCertificate => (26, "It asks for a client certificate and got none."),
            Self::RefusesOurs => (27, "It refuses our certificate."),
            Self::NoCommonVersion => (28, "There is no common version of TLS."),
            Self::NoCommonSuite => (29, "There is no common cipher suite."),
            Self::NoTls => (30, "It does not speak TLS at this port."),
            Self::Handshake => (31, "The TLS handshake failed."),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_trouble_has_a_number_of_its_own() {
        for trouble in SessionTrouble::ALL {
            assert_eq!(SessionTrouble::of_code(trouble.code().into()), Some(trouble));
        }
        assert_eq!(SessionTrouble::of_code(0), None);
    }
}
