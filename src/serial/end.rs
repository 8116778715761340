//! How the connections to a serial line end, and what is told of that.

use core::net::SocketAddr;
use std::fmt::Display;

use super::connection::Line;
use super::told::Reason;

/// Why a connection ended.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum End {
    /// The client closed it.
    Closed,
    /// The network did, or the client was not reachable any more, or took nothing for 25 s.
    Broken {
        /// What the system says.
        why: String,
    },
    /// It took what came in too slowly: so many bytes are gone that it did not get.
    Slow {
        /// At least so many.
        missed: u64,
    },
    /// It sent, but another one writes.
    NotTheWriter,
    /// It sent a request of HTTP, or a hello of TLS.
    Http,
    /// What it sent did not go out.
    NotSent {
        /// Bytes of it that went out before.
        before: u64,
        /// How many of the piece that failed did, and why not all.
        why: String,
        /// Bytes that waited behind that piece.
        behind: usize,
    },
    /// It had to make room for another one.
    Evicted,
    /// The gateway stops.
    Stopped,
}

impl End {
    /// The network ended it.
    #[must_use]
    pub fn broken(error: &impl Display) -> Self {
        Self::Broken { why: error.to_string() }
    }

    /// For the log.
    #[must_use]
    pub fn word(&self) -> &'static str {
        match self {
            Self::Closed => "closed",
            Self::Broken { .. } => "broken",
            Self::Slow { .. } => "slow_client",
            Self::NotTheWriter => "not_the_writer",
            Self::Http => "http",
            Self::NotSent { .. } => "not_sent",
            Self::Evicted => "evicted",
            Self::Stopped => "stopped",
        }
    }

    /// Why somebody has to know of it, and in words what; `None`: nobody has to. Who lets a newcomer in tells of the one that
    /// made room.
    fn news(&self) -> Option<(Reason, String)> {
        Some(match self {
            Self::Slow { missed } => {
                let text =
                    format!("this client took what came in too slowly: {missed} bytes or more are gone");
                (Reason::Slow, text)
            }
            Self::NotSent { before, why, behind } => {
                let behind =
                    if *behind > 0 { format!(", {behind} behind them did not") } else { String::new() };
                let text = format!(
                    "not all that this client sent went out: {why}; {before} bytes before these did{behind}"
                );
                (Reason::NotSent, text)
            }
            Self::NotTheWriter => {
                (Reason::NotTheWriter, "this client sent, but another one writes".to_owned())
            }
            Self::Http => (Reason::Http, "this client sent a request of HTTP or TLS".to_owned()),
            Self::Broken { why } => (Reason::Lost, why.clone()),
            Self::Closed | Self::Stopped | Self::Evicted => return None,
        })
    }
}

/// Tells of the end of a connection what somebody has to know: once a minute of each address and reason.
pub fn tell(line: &Line, peer: SocketAddr, end: &End) {
    let Some((reason, what)) = end.news() else { return };
    let Some(untold) = line.due(reason, peer) else { return };
    let (name, word) = (&line.name, end.word());
    if reason == Reason::Lost {
        tracing::info!(%peer, untold, "{name}: connection lost (told once a minute): {what}");
    } else {
        tracing::warn!(
            %peer,
            end = word,
            untold,
            "{name}: {what}; its connection ends (told once a minute; {untold} times since it was told last)"
        );
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bytes_that_did_not_go_out_are_told_with_their_cause_once_and_the_sum_of_all_pieces() {
        let why = "12 of 1024 bytes were handed to the bus: the module does not answer any more".to_owned();
        let end = End::NotSent { before: 5120, why, behind: 1024 };
        assert_eq!(
            end.news().unwrap().1,
            "not all that this client sent went out: 12 of 1024 bytes were handed to the bus: the module does not answer any \
             more; 5120 bytes before these did, 1024 behind them did not"
        );
    }
}
