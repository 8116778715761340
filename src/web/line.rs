//! What a connection speaks: HTTP as it is, or HTTP inside TLS after a handshake. \[IO\]
//!
//! The handshake runs in the connection's own task, so nobody waits for a slow one; its time is that of
//! [`handshake::accept`], and its place may be given to another at any moment.

use std::io;
use std::net::SocketAddr;
use std::pin::Pin;
use std::sync::{Arc, Mutex, PoisonError};
use std::task::{Context, Poll, ready};
use std::time::Duration;

use tokio::io::{AsyncRead, AsyncReadExt, AsyncWrite, AsyncWriteExt, ReadBuf};
use tokio::net::TcpStream;
use tokio_rustls::server::TlsStream;

use super::pace::Pace;
use crate::time::Clock;
use crate::tls::reason::HANDSHAKE_LIMIT_S;
use crate::tls::{Reason, ServerKeeper, TlsError, TlsServerSettings, Told, handshake};

/// As much of a request is read before it is answered that it came to the wrong protocol.
const LONGEST_PLAIN: usize = 8_192;
/// The answer to HTTP where TLS is spoken. Nothing of what was asked is done or repeated.
const PLAIN_ANSWER: &[u8] = b"HTTP/1.1 400 Bad Request\r\nContent-Type: text/plain\r\nContent-Length: 65\r\n\
    Connection: close\r\n\r\nThis port speaks HTTP over TLS only: write https:// for http://.\n";

/// How connections become secure.
#[derive(Debug)]
pub struct Security {
    keeper: Arc<ServerKeeper>,
    told: Mutex<Told>,
    /// A handshake costs more than a request.
    pace: Mutex<Pace>,
    clock: Clock,
}

impl Security {
    /// Reads the files, so that what is wrong with them is known before anything listens.
    ///
    /// # Errors
    /// Which file is wrong, why, and how to mend it.
    pub async fn prepare(files: TlsServerSettings, clock: Clock) -> Result<Self, TlsError> {
        let keeper = Arc::new(ServerKeeper::new("[http.tls]", (files, None), clock));
        keeper.current_async().await?;
        Ok(Self { keeper, told: Mutex::default(), pace: Mutex::default(), clock })
    }

    /// Whether an address may begin another handshake now.
    fn admits(&self, peer: SocketAddr) -> bool {
        let now = self.clock.now().instant;
        self.pace.lock().unwrap_or_else(PoisonError::into_inner).take(now, peer.ip()).is_ok()
    }

    /// The same refusal of the same address is told once a minute.
    fn tell(&self, peer: SocketAddr, reason: &Reason) {
        let now = self.clock.now().instant;
        let mut told = self.told.lock().unwrap_or_else(PoisonError::into_inner);
        if told.is_news(now, peer.ip(), reason.word()) {
            tracing::warn!(%peer, "HTTP over TLS: a client did not get in: {reason}");
        } else {
            tracing::debug!(%peer, "HTTP over TLS: a client did not get in: {reason}");
        }
    }
}

type Shaking = Pin<Box<dyn Future<Output = io::Result<TlsStream<TcpStream>>> + Send>>;

/// A connection of a client.
pub enum Line {
    /// HTTP as it is.
    Plain(TcpStream),
    /// The handshake is under way.
    Shaking(Shaking),
    /// HTTP inside TLS.
    Tls(Box<TlsStream<TcpStream>>),
    /// The handshake failed.
    Over,
}

impl std::fmt::Debug for Line {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Self::Plain(_) => "Plain",
            Self::Shaking(_) => "Shaking",
            Self::Tls(_) => "Tls",
            Self::Over => "Over",
        })
    }
}

impl Line {
    /// Of a connection that a client opened.
    #[must_use]
    pub fn new(stream: TcpStream, peer: SocketAddr, security: Option<&Arc<Security>>) -> Self {
        match security {
            None => Self::Plain(stream),
            Some(security) => Self::Shaking(Box::pin(shake(stream, peer, Arc::clone(security)))),
        }
    }

    /// Goes on with the handshake, if there is one to be done.
    fn poll_ready(&mut self, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        match self {
            Self::Plain(_) | Self::Tls(_) => Poll::Ready(Ok(())),
            Self::Over => Poll::Ready(Err(io::ErrorKind::NotConnected.into())),
            Self::Shaking(shaking) => {
                let shaken = ready!(shaking.as_mut().poll(context));
                let (line, result) = match shaken {
                    Ok(stream) => (Self::Tls(Box::new(stream)), Ok(())),
                    Err(error) => (Self::Over, Err(error)),
                };
                *self = line;
                Poll::Ready(result)
            }
        }
    }
}

async fn shake(
    mut stream: TcpStream,
    peer: SocketAddr,
    security: Arc<Security>,
) -> io::Result<TlsStream<TcpStream>> {
    let reason = match first_byte(&stream).await {
        // Methods of HTTP are capital letters; a handshake of TLS begins with 0x16.
        Ok(Some(first)) if first.is_ascii_uppercase() => {
            answer_plain(&mut stream).await;
            Reason::NoTls
        }
        Ok(Some(_)) if !security.admits(peer) => {
            Reason::Other("too many handshakes from this address within a second".to_owned())
        }
        Ok(Some(_)) => match handshake::accept(stream, &security.keeper).await {
            Ok(stream) => return Ok(stream),
            Err(reason) => reason,
        },
        Ok(None) => Reason::Closed,
        Err(reason) => reason,
    };
    security.tell(peer, &reason);
    Err(io::Error::new(io::ErrorKind::ConnectionAborted, reason))
}

/// What a connection begins with; `None` where it ends before.
async fn first_byte(stream: &TcpStream) -> Result<Option<u8>, Reason> {
    let mut first = [0];
    let peeking = stream.peek(&mut first);
    match tokio::time::timeout(Duration::from_secs(HANDSHAKE_LIMIT_S), peeking).await {
        Ok(Ok(0)) => Ok(None),
        Ok(Ok(_)) => Ok(first.first().copied()),
        Ok(Err(error)) => Err(Reason::of_handshake(&error)),
        Err(_elapsed) => Err(Reason::Slow),
    }
}

/// Tells a client that its protocol is the wrong one. Whoever does not take that has to do without.
async fn answer_plain(stream: &mut TcpStream) {
    let answering = async {
        // What is left unread would take the answer away from the client.
        let mut request = vec![0; LONGEST_PLAIN];
        let _whatever_it_was = stream.read(&mut request).await?;
        stream.write_all(PLAIN_ANSWER).await?;
        stream.shutdown().await
    };
    let _ = tokio::time::timeout(Duration::from_secs(1), answering).await;
}

impl AsyncRead for Line {
    fn poll_read(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        ready!(self.poll_ready(context))?;
        match &mut *self {
            Self::Plain(stream) => Pin::new(stream).poll_read(context, buffer),
            Self::Tls(stream) => Pin::new(stream).poll_read(context, buffer),
            Self::Shaking(_) | Self::Over => Poll::Ready(Err(io::ErrorKind::NotConnected.into())),
        }
    }
}

impl AsyncWrite for Line {
    fn poll_write(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        bytes: &[u8],
    ) -> Poll<io::Result<usize>> {
        ready!(self.poll_ready(context))?;
        match &mut *self {
            Self::Plain(stream) => Pin::new(stream).poll_write(context, bytes),
            Self::Tls(stream) => Pin::new(stream).poll_write(context, bytes),
            Self::Shaking(_) | Self::Over => Poll::Ready(Err(io::ErrorKind::NotConnected.into())),
        }
    }

    fn poll_flush(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        match &mut *self {
            Self::Plain(stream) => Pin::new(stream).poll_flush(context),
            Self::Tls(stream) => Pin::new(stream).poll_flush(context),
            // Nothing was written yet.
            Self::Shaking(_) | Self::Over => Poll::Ready(Ok(())),
        }
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        match &mut *self {
            Self::Plain(stream) => Pin::new(stream).poll_shutdown(context),
            Self::Tls(stream) => Pin::new(stream).poll_shutdown(context),
            Self::Shaking(_) | Self::Over => Poll::Ready(Ok(())),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cr_7_1_an_address_may_not_have_handshakes_without_end() {
        let (files, clock) = (TlsServerSettings::default(), Clock::start());
        let keeper = Arc::new(ServerKeeper::new("[http.tls]", (files, None), clock));
        let security = Security { keeper, told: Mutex::default(), pace: Mutex::default(), clock };
        let peer = |last: u8| SocketAddr::from(([10, 0, 0, last], 1));
        let admitted = (0..100_000).filter(|_| security.admits(peer(1))).count();
        assert!((400..100_000).contains(&admitted), "{admitted}");
        assert!(security.admits(peer(2)));
    }
}
