//! What it takes to reach a broker, whatever version of MQTT is spoken \[IO\]: the socket, the password, and why it failed.

use std::time::Duration;

use rumqttc::{NetworkOptions, TlsError};
use tokio::net::TcpStream;

use super::SessionSettings;
use super::error::{CONNECT_TIMEOUT, SessionError};
use crate::tls::Reason;

/// As whom a session is asked for.
pub(super) enum Credentials {
    /// Nobody.
    None,
    /// A user who has no password.
    Username(String),
    /// A user with his password.
    Both(String, String),
}

impl Credentials {
    /// Reads the password.
    pub(super) async fn read(settings: &SessionSettings) -> Result<Self, SessionError> {
        let Some(username) = settings.username.clone() else { return Ok(Self::None) };
        let Some(path) = &settings.password_file else { return Ok(Self::Username(username)) };
        let password = tokio::fs::read_to_string(path).await.map_err(|error| SessionError::Password {
            path: path.display().to_string(),
            error: error.to_string(),
        })?;
        Ok(Self::Both(username, password.lines().next().unwrap_or_default().to_owned()))
    }
}

/// The library notices a missing answer at the second ping, after twice its interval: three quarters of ours, so that a
/// dead link is noticed within one and a half times what the user wrote.
pub(super) fn ping_interval_s(keep_alive: Duration) -> u16 {
    u16::try_from((keep_alive.as_secs() * 3 / 4).max(1)).unwrap_or(u16::MAX)
}

/// How the library opens its socket.
pub(super) fn network_options() -> NetworkOptions {
    let mut network = NetworkOptions::new();
    network.set_connection_timeout(CONNECT_TIMEOUT.as_secs());
    network.set_tcp_nodelay(true);
    network
}

/// Opens the socket. What is sent but never taken by the peer's system ends the connection after `patience`.
pub(super) async fn connect(
    place: String,
    network: NetworkOptions,
    patience: Duration,
) -> std::io::Result<TcpStream> {
    let stream = rumqttc::default_socket_connect(place, network).await.map_err(unreachable)?;
    let patience = u32::try_from(patience.as_millis()).unwrap_or(u32::MAX);
    nix::sys::socket::setsockopt(&stream, nix::sys::socket::sockopt::TcpUserTimeout, &patience)?;
    Ok(stream)
}

/// There was no connection at all.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
struct NoConnection(std::io::Error);

fn unreachable(error: std::io::Error) -> std::io::Error {
    std::io::Error::other(NoConnection(error))
}

/// Why a socket failed. In TLS 1.3 a server looks at the client's certificate after the client's side of the handshake is
/// done, so that this may be about certificates too.
pub(super) fn of_io(error: &std::io::Error) -> SessionError {
    let lost = || match error.get_ref().and_then(|inner| inner.downcast_ref::<NoConnection>()) {
        Some(error) => SessionError::Unreachable(error.to_string()),
        None => SessionError::Lost(format!("I/O: {error}")),
    };
    Reason::of_stream(error).map_or_else(lost, SessionError::Tls)
}

/// Why TLS failed.
#[expect(clippy::wildcard_enum_match_arm, reason = "the library's enum is open")]
pub(super) fn of_tls(error: &TlsError) -> SessionError {
    SessionError::Tls(match error {
        TlsError::Io(error) => Reason::of_handshake(error),
        TlsError::TLS(error) => Reason::from(error),
        error => Reason::Other(error.to_string()),
    })
}
