//! Accepts connections \[IO\], within limits: so many at once, none of them silent for long, none that takes for ever to
//! ask. A newcomer always gets in: a watchdog that asks `/livez` cannot be kept out by others who only sit there.

use std::future::Future;
use std::io;
use std::net::SocketAddr;
use std::pin::Pin;
use std::sync::{Arc, Mutex, PoisonError};
use std::task::{Context, Poll};
use std::time::Duration;

use axum::extract::connect_info::Connected;
use axum::serve::IncomingStream;
use nix::errno::Errno;
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::net::{TcpListener, TcpStream};
use tokio::time::Sleep;
use tokio_util::sync::{CancellationToken, WaitForCancellationFutureOwned};

use super::line::{Line, Security};
use crate::slots::{Activity, SlotId, Slots};
use crate::time::Clock;

/// Connections at once; when all are in use, one of them makes room for a newcomer ([`Slots`]).
const MOST_CONNECTIONS: usize = 64;
/// A connection that neither sends nor takes anything for this long is closed.
const IDLE_TIMEOUT: Duration = Duration::from_secs(30);
/// From the first byte of a request, or from the beginning of the connection, until its answer begins.
const REQUEST_TIMEOUT: Duration = Duration::from_secs(10);
/// Pause after a failed accept, for example when there are no file descriptors left.
const ACCEPT_PAUSE: Duration = Duration::from_millis(100);

type Places = Arc<Mutex<Slots<CancellationToken>>>;

/// A listener with a limit.
#[derive(Debug)]
pub struct LimitedListener {
    listener: TcpListener,
    places: Places,
    security: Option<Arc<Security>>,
    clock: Clock,
}

impl LimitedListener {
    /// Over a bound socket. With `security` every connection begins with a handshake.
    #[must_use]
    pub fn new(listener: TcpListener, security: Option<Arc<Security>>, clock: Clock) -> Self {
        Self { listener, places: Arc::new(Mutex::new(Slots::new(MOST_CONNECTIONS))), security, clock }
    }

    fn admit(&self, stream: TcpStream, peer: SocketAddr) -> Connection<Line> {
        let _ = stream.set_nodelay(true);
        let place = Place::take(&self.places, peer);
        Connection::new(Line::new(stream, peer, self.security.as_ref()), place, self.clock)
    }
}

impl axum::serve::Listener for LimitedListener {
    type Io = Connection<Line>;
    type Addr = SocketAddr;

    async fn accept(&mut self) -> (Self::Io, SocketAddr) {
        loop {
            match self.listener.accept().await {
                Ok((stream, peer)) => return (self.admit(stream, peer), peer),
                Err(error) => {
                    tracing::debug!("cannot accept an HTTP connection: {error}");
                    let code = error.raw_os_error().map(Errno::from_raw);
                    if matches!(code, Some(Errno::EMFILE | Errno::ENFILE)) {
                        let other = lock(&self.places).evict();
                        other.inspect(CancellationToken::cancel);
                    }
                    tokio::time::sleep(ACCEPT_PAUSE).await;
                }
            }
        }
    }

    fn local_addr(&self) -> io::Result<SocketAddr> {
        self.listener.local_addr()
    }
}

/// Who is at the other end of a connection.
#[derive(Clone, Copy, Debug)]
pub struct Peer(pub SocketAddr);

impl Connected<IncomingStream<'_, LimitedListener>> for Peer {
    fn connect_info(stream: IncomingStream<'_, LimitedListener>) -> Self {
        Self(*stream.remote_addr())
    }
}

fn lock(places: &Places) -> std::sync::MutexGuard<'_, Slots<CancellationToken>> {
    places.lock().unwrap_or_else(PoisonError::into_inner)
}

/// A place among the connections; free again when dropped.
#[derive(Debug)]
struct Place {
    id: SlotId,
    activity: Arc<Activity>,
    evicted: CancellationToken,
    places: Places,
}

impl Place {
    fn take(places: &Places, peer: SocketAddr) -> Self {
        let evicted = CancellationToken::new();
        let taken = lock(places).take(peer.ip(), evicted.clone());
        taken.evicted.inspect(CancellationToken::cancel);
        Self { id: taken.id, activity: taken.activity, evicted, places: Arc::clone(places) }
    }
}

impl Drop for Place {
    fn drop(&mut self) {
        lock(&self.places).release(self.id);
    }
}

/// A connection that ends by itself when nothing moves, when a request takes too long, and when it has to make room.
#[derive(Debug)]
pub struct Connection<S> {
    stream: S,
    place: Place,
    clock: Clock,
    /// Ends when nothing has moved for too long.
    idle: Pin<Box<Sleep>>,
    /// Ends when the answer should have begun; counts only while `asking`.
    request: Pin<Box<Sleep>>,
    /// A request is expected or under way; `false` from its answer on, until the next byte comes.
    asking: bool,
    evicted: Pin<Box<WaitForCancellationFutureOwned>>,
}

impl<S> Connection<S> {
    fn new(stream: S, place: Place, clock: Clock) -> Self {
        let sleep = |patience| Box::pin(tokio::time::sleep(patience));
        let evicted = Box::pin(place.evicted.clone().cancelled_owned());
        let (idle, request) = (sleep(IDLE_TIMEOUT), sleep(REQUEST_TIMEOUT));
        Self { stream, place, clock, idle, request, asking: true, evicted }
    }

    /// Whether the connection has to end now. Wakes the task when it has to end later.
    fn is_over(&mut self, context: &mut Context<'_>) -> bool {
        let late = self.asking && self.request.as_mut().poll(context).is_ready();
        late || self.evicted.as_mut().poll(context).is_ready() || self.idle.as_mut().poll(context).is_ready()
    }

    /// Something moved.
    fn moved(&mut self) {
        let deadline = self.clock.deadline(self.clock.now().instant + IDLE_TIMEOUT);
        self.idle.as_mut().reset(deadline);
    }

    /// A byte of a request came.
    fn asked(&mut self) {
        if !self.asking {
            self.asking = true;
            let deadline = self.clock.deadline(self.clock.now().instant + REQUEST_TIMEOUT);
            self.request.as_mut().reset(deadline);
        }
    }

    /// The answer began: so there was a whole request.
    fn answered(&mut self) {
        self.asking = false;
        self.place.activity.touch(self.clock.now().instant);
    }
}

fn over<T>() -> Poll<io::Result<T>> {
    Poll::Ready(Err(io::ErrorKind::TimedOut.into()))
}

impl<S: AsyncRead + Unpin> AsyncRead for Connection<S> {
    fn poll_read(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        let polled = Pin::new(&mut self.stream).poll_read(context, buffer);
        if polled.is_ready() {
            self.moved();
            self.asked();
        }
        // Also when there was something to read: a sender that never pauses gets no longer for it.
        if self.is_over(context) { over() } else { polled }
    }
}

impl<S: AsyncWrite + Unpin> AsyncWrite for Connection<S> {
    fn poll_write(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        bytes: &[u8],
    ) -> Poll<io::Result<usize>> {
        let polled = Pin::new(&mut self.stream).poll_write(context, bytes);
        self.answered();
        if polled.is_ready() {
            self.moved();
            return polled;
        }
        if self.is_over(context) { over() } else { polled }
    }

    fn poll_flush(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        let polled = Pin::new(&mut self.stream).poll_flush(context);
        // What waits here for a client that takes nothing waits no longer than elsewhere.
        if polled.is_pending() && self.is_over(context) { over() } else { polled }
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        let polled = Pin::new(&mut self.stream).poll_shutdown(context);
        if polled.is_pending() && self.is_over(context) { over() } else { polled }
    }
}

#[cfg(test)]
mod tests {
    use tokio::io::{AsyncReadExt, AsyncWriteExt, DuplexStream};

    use super::*;

    fn connection() -> (Connection<DuplexStream>, DuplexStream, Places, Clock) {
        let clock = Clock::start();
        let places = Arc::new(Mutex::new(Slots::new(2)));
        let (near, far) = tokio::io::duplex(64);
        let place = Place::take(&places, "127.0.0.1:1".parse().unwrap());
        (Connection::new(near, place, clock), far, places, clock)
    }

    /// Writes a byte every so often for two minutes, if anybody reads that long.
    async fn dribble(mut far: DuplexStream, pause: Duration) {
        for _ in 0..120 {
            if far.write_all(b"x").await.is_err() {
                return;
            }
            tokio::time::sleep(pause).await;
        }
    }

    #[tokio::test(start_paused = true)]
    async fn a_request_that_dribbles_in_is_ended_after_ten_seconds() {
        let (mut connection, far, places, clock) = connection();
        tokio::spawn(dribble(far, Duration::from_secs(1)));
        let error = connection.read_to_end(&mut Vec::new()).await.unwrap_err();
        assert_eq!(error.kind(), io::ErrorKind::TimedOut);
        assert_eq!(clock.now().instant.as_millis() / 100, 100);
        drop(connection);
        assert_eq!(lock(&places).in_use(), 0);
    }

    #[tokio::test(start_paused = true)]
    async fn every_request_of_a_connection_has_its_own_time() {
        let (mut connection, mut far, _places, clock) = connection();
        let mut bytes = [0; 8];
        for _ in 0..5 {
            tokio::time::sleep(Duration::from_secs(8)).await;
            far.write_all(b"request").await.unwrap();
            assert_eq!(connection.read(&mut bytes).await.unwrap(), 7);
            connection.write_all(b"answer").await.unwrap();
            assert_eq!(far.read(&mut bytes).await.unwrap(), 6);
        }
        let before = clock.now().instant;
        assert!(connection.read(&mut bytes).await.is_err(), "and none may stay for ever without one");
        assert_eq!(clock.now().instant.since(before).as_secs(), IDLE_TIMEOUT.as_secs());
    }

    #[tokio::test(start_paused = true)]
    async fn an_answer_that_nobody_takes_is_given_up_after_half_a_minute_also_where_it_is_buffered() {
        let (connection, _far, places, clock) = connection();
        // As TLS does: what is written waits in the stream until it is flushed.
        let mut buffered = tokio::io::BufWriter::with_capacity(1024, connection.stream);
        buffered.write_all(&[0; 100]).await.unwrap();
        let mut connection = Connection::new(buffered, connection.place, clock);
        connection.answered();
        assert!(connection.flush().await.is_err());
        assert_eq!(clock.now().instant.as_millis(), 30_000);
        let mut connection = Connection::new(connection.stream, connection.place, clock);
        assert!(connection.shutdown().await.is_err(), "nor does a goodbye hold a place");
        drop(connection);
        assert_eq!(lock(&places).in_use(), 0);
    }

    #[tokio::test(start_paused = true)]
    async fn who_must_make_room_ends_at_once() {
        let (mut connection, _far, places, clock) = connection();
        let _others = [2, 3].map(|port| Place::take(&places, SocketAddr::from(([127, 0, 0, 1], port))));
        assert!(connection.read(&mut [0]).await.is_err());
        assert_eq!(clock.now().instant.as_millis(), 0);
        assert_eq!(lock(&places).in_use(), 2);
    }
}
