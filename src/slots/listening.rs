//! Listens, accepts, and serves each client in a task of its own; survives whatever comes. \[IO\]

use std::io;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use nix::errno::Errno;
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::mpsc;
use tokio::task::{JoinError, JoinSet};

use super::clients::{Clients, Place, ServerName, TurnedAway};

/// An address could not be listened on.
#[derive(Debug, thiserror::Error)]
#[error("cannot listen for {what} on {address}: {source}; {hint}")]
pub struct BindError {
    /// For what.
    pub what: String,
    /// The address.
    pub address: SocketAddr,
    /// What the system says.
    pub source: io::Error,
    /// How to mend it.
    pub hint: String,
}

impl BindError {
    fn new(name: &ServerName, address: SocketAddr, source: io::Error) -> Self {
        let (kind, table) = (source.kind(), &name.table);
        let hint = if kind == io::ErrorKind::AddrInUse {
            format!("another program has this port: stop it, or change `listen` in {table}")
        } else if kind == io::ErrorKind::PermissionDenied {
            format!(
                "ports below 1024 need a privilege: change `listen` in {table}, or allow it (net.ipv4.ip_unprivileged_port_start)"
            )
        } else if kind == io::ErrorKind::AddrNotAvailable {
            format!("this host has no such address: change `listen` in {table}")
        } else {
            format!("check `listen` in {table}")
        };
        Self { what: name.what.clone(), address, source, hint }
    }
}

/// Listens on an address. Clients wait in the kernel until they are [served](serve).
///
/// # Errors
/// The address cannot be listened on.
pub async fn bind(name: &ServerName, address: SocketAddr) -> Result<TcpListener, BindError> {
    TcpListener::bind(address).await.map_err(|source| BindError::new(name, address, source))
}

/// Whether an address could be listened on now; it is let go at once.
///
/// # Errors
/// It cannot.
pub fn try_address(address: SocketAddr) -> io::Result<()> {
    std::net::TcpListener::bind(address).map(drop)
}

/// What is done for each client.
pub trait Service: Send + Sync + 'static {
    /// Serves a client until it, the network or [`Place::must_leave`] ends it; why is for the log.
    fn serve(
        &self,
        stream: TcpStream,
        peer: SocketAddr,
        place: Place,
    ) -> impl Future<Output = &'static str> + Send;

    /// A client could not be accepted. For those who count it.
    fn accept_failed(&self) {}

    /// A client was not let in: its address may not come, or finds no place. For those who count it.
    fn turned_away(&self, _peer: SocketAddr) {}
}

/// Accepted connections that wait to be served. When full, accepting waits and the kernel's backlog holds the rest.
const ACCEPTED: usize = 16;
/// First pause after a failed accept; doubled at each further one.
const ACCEPT_PAUSE: Duration = Duration::from_millis(10);
/// Longest pause after a failed accept.
const LONGEST_ACCEPT_PAUSE: Duration = Duration::from_secs(1);

/// Serves whoever comes to one of the listeners until the gateway stops and the last client has left.
///
/// # Panics
/// Where serving a client panicked, which is a bug of ours: it ends the server, and the supervisor tells.
pub async fn serve<S: Service>(listeners: Vec<TcpListener>, clients: Clients, service: Arc<S>) {
    let (arrived, mut arrivals) = mpsc::channel(ACCEPTED);
    let mut acceptors = JoinSet::new();
    for listener in listeners {
        acceptors.spawn(accept(listener, clients.name().clone(), arrived.clone(), Arc::clone(&service)));
    }
    let mut tasks = JoinSet::new();
    loop {
        tokio::select! {
            () = clients.stopped() => break,
            Some(ended) = tasks.join_next() => pass_on_panic(ended),
            Some(arrival) = arrivals.recv() => match arrival {
                Arrival::Client(stream, peer) => {
                    match clients.admit(&stream, peer).await {
                        Ok(place) => {
                            tasks.spawn(attend(Arc::clone(&service), clients.clone(), stream, peer, place));
                        }
                        Err(TurnedAway::NotAllowed | TurnedAway::NoPlace) => service.turned_away(peer),
                        Err(TurnedAway::Gone) => {}
                    }
                    // In a flood no task that has ended is left lying.
                    while let Some(ended) = tasks.try_join_next() {
                        pass_on_panic(ended);
                    }
                }
                Arrival::NoDescriptor => clients.give_way().await,
            },
        }
    }
    acceptors.shutdown().await;
    while let Some(ended) = tasks.join_next().await {
        pass_on_panic(ended);
    }
}

async fn attend<S: Service>(
    service: Arc<S>,
    clients: Clients,
    stream: TcpStream,
    peer: SocketAddr,
    place: Place,
) {
    let what = &clients.name().what;
    tracing::debug!(%peer, "{what} connection opened");
    let end = service.serve(stream, peer, place).await;
    tracing::debug!(%peer, end, "{what} connection ended");
}

fn pass_on_panic(ended: Result<(), JoinError>) {
    if let Err(error) = ended
        && let Ok(panic) = error.try_into_panic()
    {
        std::panic::resume_unwind(panic);
    }
}

/// Where connections come from.
trait Accept: Send + 'static {
    fn accept(&mut self) -> impl Future<Output = io::Result<(TcpStream, SocketAddr)>> + Send;
}

impl Accept for TcpListener {
    async fn accept(&mut self) -> io::Result<(TcpStream, SocketAddr)> {
        Self::accept(self).await
    }
}

/// What an acceptor tells.
#[derive(Debug)]
enum Arrival {
    /// A client.
    Client(TcpStream, SocketAddr),
    /// A client waits, but the process or the system has no file descriptor for it.
    NoDescriptor,
}

/// Accepts for ever. A failed accept is counted and tried again after a pause; where file descriptors have run out, an open
/// connection is asked to give way.
async fn accept<S: Service>(
    mut listener: impl Accept,
    name: ServerName,
    arrived: mpsc::Sender<Arrival>,
    service: Arc<S>,
) {
    let mut pause = ACCEPT_PAUSE;
    loop {
        match listener.accept().await {
            Ok((stream, peer)) => {
                pause = ACCEPT_PAUSE;
                if arrived.send(Arrival::Client(stream, peer)).await.is_err() {
                    return;
                }
            }
            Err(error) => {
                service.accept_failed();
                if pause == ACCEPT_PAUSE {
                    tracing::warn!(%error, "cannot accept {} connections for now", name.what);
                }
                let code = error.raw_os_error().map(Errno::from_raw);
                if matches!(code, Some(Errno::EMFILE | Errno::ENFILE)) {
                    // Where this queue is full, clients are being let in, and descriptors come free by that.
                    let _ = arrived.try_send(Arrival::NoDescriptor);
                }
                tokio::time::sleep(pause).await;
                pause = (pause * 2).min(LONGEST_ACCEPT_PAUSE);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::{AtomicUsize, Ordering};

    use tokio::io::AsyncReadExt;
    use tokio_util::sync::CancellationToken;

    use super::*;
    use crate::slots::Limits;

    fn name() -> ServerName {
        ServerName::new("test", "[test]")
    }

    /// Lets clients sit there.
    #[derive(Default)]
    struct Bench {
        failures: AtomicUsize,
    }

    impl Service for Bench {
        async fn serve(&self, stream: TcpStream, _: SocketAddr, place: Place) -> &'static str {
            place.must_leave().await;
            drop(stream);
            "left"
        }

        fn accept_failed(&self) {
            self.failures.fetch_add(1, Ordering::Relaxed);
        }
    }

    struct OutOfDescriptors {
        failures: usize,
        listener: TcpListener,
    }

    impl Accept for OutOfDescriptors {
        async fn accept(&mut self) -> io::Result<(TcpStream, SocketAddr)> {
            if self.failures > 0 {
                self.failures -= 1;
                return Err(io::Error::from(Errno::EMFILE));
            }
            TcpListener::accept(&self.listener).await
        }
    }

    #[tokio::test(start_paused = true)]
    async fn accepting_goes_on_after_the_file_descriptors_ran_out() {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let address = listener.local_addr().unwrap();
        let _client = std::net::TcpStream::connect(address).unwrap();
        let (sender, mut arrivals) = mpsc::channel(1);
        let bench = Arc::new(Bench::default());
        let acceptor = OutOfDescriptors { failures: 20, listener };
        let accepting = tokio::spawn(accept(acceptor, name(), sender, Arc::clone(&bench)));
        assert!(matches!(arrivals.recv().await, Some(Arrival::NoDescriptor)), "somebody has to give way");
        while !matches!(arrivals.recv().await, Some(Arrival::Client(..))) {}
        assert_eq!(bench.failures.load(Ordering::Relaxed), 20);
        drop(arrivals);
        accepting.abort();
    }

    #[tokio::test]
    async fn one_client_makes_room_and_all_leave_when_the_gateway_stops() {
        let listener = bind(&name(), "127.0.0.1:0".parse().unwrap()).await.unwrap();
        let (address, stop) = (listener.local_addr().unwrap(), CancellationToken::new());
        let clients = Clients::new(name(), Limits::places(2), stop.clone());
        let serving = tokio::spawn(serve(vec![listener], clients.clone(), Arc::new(Bench::default())));
        let mut near = Vec::new();
        for _ in 0..3 {
            near.push(TcpStream::connect(address).await.unwrap());
        }
        let mut byte = [0];
        assert_eq!(near[0].read(&mut byte).await.unwrap(), 0, "the oldest of those that never asked");
        stop.cancel();
        serving.await.unwrap();
        assert_eq!(clients.in_use(), 0);
        assert!(TcpStream::connect(address).await.is_err());
    }

    #[tokio::test]
    async fn f46_a_taken_port_is_named_with_a_hint() {
        let taken = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let address = taken.local_addr().unwrap();
        let message = bind(&name(), address).await.unwrap_err().to_string();
        for part in [&address.to_string(), "listen for test", "another program", "in [test]"] {
            assert!(message.contains(part), "{message}");
        }
    }
}
