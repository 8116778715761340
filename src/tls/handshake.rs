//! The server's side of a handshake, within its time: a disk that does not answer takes no longer either. \[IO\]

use std::sync::Arc;
use std::time::Duration;

use tokio::io::{AsyncRead, AsyncWrite};
use tokio_rustls::TlsAcceptor;
use tokio_rustls::server::TlsStream;

use super::keeper::ServerKeeper;
use super::reason::{HANDSHAKE_LIMIT_S, Reason};

/// Makes TLS of a connection that a client opened, with the certificates of this moment.
///
/// # Errors
/// Why not; the client was told by an alert where TLS has one for it.
pub async fn accept<S>(stream: S, keeper: &Arc<ServerKeeper>) -> Result<TlsStream<S>, Reason>
where
    S: AsyncRead + AsyncWrite + Unpin,
{
    let accepting = async {
        let config = keeper.current_async().await?;
        TlsAcceptor::from(config).accept(stream).await.map_err(|error| Reason::of_handshake(&error))
    };
    let limit = Duration::from_secs(HANDSHAKE_LIMIT_S);
    tokio::time::timeout(limit, accepting).await.unwrap_or(Err(Reason::Slow))
}

/// The certificate that the client showed, DER.
#[must_use]
pub fn client_certificate<S>(stream: &TlsStream<S>) -> Option<&[u8]> {
    let (_, connection) = stream.get_ref();
    connection.peer_certificates()?.first().map(AsRef::as_ref)
}
