//! Who is at the other end of a connection, and what may be asked there, pure.

use super::security::{PeerRole, Rights};

/// A client.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Caller {
    /// What its certificate says; `None`: it came without TLS.
    pub role: Option<PeerRole>,
    /// What it may ask.
    pub rights: Rights,
}

impl Caller {
    /// One that came without TLS.
    pub const WITHOUT_TLS: Self = Self { role: None, rights: Rights::WITHOUT_TLS };

    /// One whose certificate is known.
    #[must_use]
    pub fn known(role: PeerRole, rights: Rights) -> Self {
        Self { role: Some(role), rights }
    }
}
