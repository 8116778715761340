//! Listens, accepts, limits; survives whatever comes. \[IO\]

use std::io;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use nix::sys::socket::{setsockopt, sockopt};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::mpsc;
use tokio::task::{JoinError, JoinSet};
use tokio::time::MissedTickBehavior;
use tokio_util::sync::CancellationToken;

use super::connection::{self, Objects, Shared, Stops};
use super::counters::{Counters, End};
use super::register_bank::RegisterBank;
use super::{ModbusSettings, ObjectAccess};
use crate::gateway::command::Desk;
use crate::process_image::ImageReader;
use crate::slots::{SlotId, Slots};
use crate::time::Clock;

/// A Modbus TCP server that listens already.
#[derive(Debug)]
pub struct Server {
    listeners: Vec<TcpListener>,
    max_connections: usize,
    shared: Shared,
    /// What is done with a desk, once there is one.
    objects: ObjectAccess,
}

/// An address could not be listened on.
#[derive(Debug, thiserror::Error)]
#[error("cannot listen for Modbus on {address}: {source}; {}", hint(source))]
pub struct BindError {
    /// The address.
    pub address: SocketAddr,
    /// What the system says.
    pub source: io::Error,
}

fn hint(error: &io::Error) -> &'static str {
    let kind = error.kind();
    if kind == io::ErrorKind::AddrInUse {
        "another program has this port: stop it, or change `listen` in [modbus]"
    } else if kind == io::ErrorKind::PermissionDenied {
        "ports below 1024 need a privilege: use port 5020, or allow it (net.ipv4.ip_unprivileged_port_start)"
    } else if kind == io::ErrorKind::AddrNotAvailable {
        "this host has no such address: change `listen` in [modbus]"
    } else {
        "check `listen` in [modbus]"
    }
}

/// Accepted connections that wait to be served. When full, accepting waits and the kernel's backlog holds the rest.
const ACCEPTED: usize = 16;
/// First pause after a failed accept; doubled at each further one.
const ACCEPT_PAUSE: Duration = Duration::from_millis(10);
/// Longest pause after a failed accept.
const LONGEST_ACCEPT_PAUSE: Duration = Duration::from_secs(1);

impl Server {
    /// Listens on every address of the settings.
    ///
    /// # Errors
    /// The first address that cannot be listened on.
    pub async fn bind(
        settings: &ModbusSettings,
        bank: RegisterBank,
        reader: ImageReader,
        clock: Clock,
    ) -> Result<Self, BindError> {
        let mut listeners = Vec::new();
        for address in &settings.listen {
            let listener = TcpListener::bind(address).await;
            listeners.push(listener.map_err(|source| BindError { address: *address, source })?);
        }
        let shared = Shared {
            bank,
            reader,
            clock,
            counters: Arc::new(Counters::default()),
            idle_timeout: settings.idle_timeout(),
            partial_frame_timeout: settings.partial_frame_timeout(),
            send_timeout: settings.send_timeout(),
            objects: None,
        };
        let max_connections = usize::from(settings.max_connections);
        Ok(Self { listeners, max_connections, shared, objects: settings.canopen_objects })
    }

    /// Asks for objects of nodes at this desk, as far as the settings allow it. Without a desk FC 43/13 is not offered.
    #[must_use]
    pub fn with_desk(mut self, desk: Desk) -> Self {
        self.shared.objects = match self.objects {
            ObjectAccess::Off => None,
            ObjectAccess::Read => Some(Objects { desk, write: false }),
            ObjectAccess::Write => Some(Objects { desk, write: true }),
        };
        self
    }

    /// The addresses that it listens on, in the order of the settings; port 0 has become a real one.
    #[must_use]
    pub fn local_addrs(&self) -> Vec<SocketAddr> {
        self.listeners.iter().filter_map(|listener| listener.local_addr().ok()).collect()
    }

    /// The counters, for metrics.
    #[must_use]
    pub fn counters(&self) -> Arc<Counters> {
        Arc::clone(&self.shared.counters)
    }

    /// Serves until `stop`. Connections end with it.
    pub async fn run(self, stop: CancellationToken) {
        let (accepted, mut newcomers) = mpsc::channel(ACCEPTED);
        let mut acceptors = JoinSet::new();
        for listener in self.listeners {
            let counters = Arc::clone(&self.shared.counters);
            acceptors.spawn(accept(listener, accepted.clone(), counters));
        }
        let mut clients = Clients {
            slots: Slots::new(self.max_connections),
            tasks: JoinSet::new(),
            shared: Arc::new(self.shared),
            stop,
        };
        let mut second = tokio::time::interval(Duration::from_secs(1));
        second.set_missed_tick_behavior(MissedTickBehavior::Skip);
        let stop = clients.stop.clone();
        loop {
            tokio::select! {
                () = stop.cancelled() => break,
                _ = second.tick() => clients.tick(),
                Some(arrival) = newcomers.recv() => match arrival {
                    Arrival::Client(stream, peer) => clients.admit(stream, peer).await,
                    Arrival::NoDescriptor => clients.give_way().await,
                },
                Some(ended) = clients.tasks.join_next() => clients.ended(ended),
            }
        }
        acceptors.abort_all();
        while let Some(ended) = clients.tasks.join_next().await {
            clients.ended(ended);
        }
    }
}

/// The connections that are open.
struct Clients {
    slots: Slots<CancellationToken>,
    tasks: JoinSet<(SlotId, End)>,
    shared: Arc<Shared>,
    stop: CancellationToken,
}

impl Clients {
    /// Once a second: the heartbeat registers.
    fn tick(&self) {
        let Shared { bank, reader, clock, .. } = &*self.shared;
        let now = clock.now();
        reader.read(|image| bank.tick(image, now));
    }

    /// Serves a newcomer; somebody else makes room if need be.
    async fn admit(&mut self, stream: TcpStream, peer: SocketAddr) {
        while let Some(ended) = self.tasks.try_join_next() {
            self.ended(ended);
        }
        if let Err(error) = configure(&stream) {
            tracing::debug!(%peer, %error, "Modbus connection was gone before it was served");
            return;
        }
        let evict = CancellationToken::new();
        let taken = self.slots.take(peer.ip(), evict.clone());
        if let Some(other) = taken.evicted {
            self.make_room(&other, self.slots.in_use()).await;
        }
        self.shared.counters.accepted(self.slots.in_use());
        tracing::debug!(%peer, "Modbus connection opened");
        let (shared, stops) = (Arc::clone(&self.shared), Stops { evict, stop: self.stop.clone() });
        self.tasks.spawn(async move {
            let end = connection::serve(stream, peer, &shared, &taken.activity, &stops).await;
            tracing::debug!(%peer, end = end.word(), "Modbus connection ended");
            (taken.id, end)
        });
    }

    /// No file descriptor is left for a client that waits outside: one of those inside ends.
    async fn give_way(&mut self) {
        if let Some(other) = self.slots.evict() {
            self.make_room(&other, self.slots.in_use() + 1).await;
        }
    }

    /// Ends a connection and waits until there are fewer than `places`: so there are never more tasks than places.
    async fn make_room(&mut self, other: &CancellationToken, places: usize) {
        if self.shared.counters.values().ended(End::Evicted) == 0 {
            tracing::warn!(
                open = places,
                "no room for another Modbus connection: one that never asked, or has been silent for longest, ends (told \
                 once; raise `max_connections` in [modbus], or the limit of open files, if all of them are wanted)"
            );
        }
        other.cancel();
        while self.tasks.len() >= places {
            let Some(ended) = self.tasks.join_next().await else { break };
            self.ended(ended);
        }
    }

    fn ended(&mut self, ended: Result<(SlotId, End), JoinError>) {
        match ended {
            Ok((id, end)) => {
                self.slots.release(id);
                self.shared.counters.ended(end);
                self.shared.counters.set_open(self.slots.in_use());
            }
            // A panic is our bug; it ends the server as it would in this task, and the supervisor tells.
            Err(error) => {
                if let Ok(panic) = error.try_into_panic() {
                    std::panic::resume_unwind(panic);
                }
            }
        }
    }
}

/// Small answers leave at once; a client that vanished is noticed after 25 s and not after two hours.
fn configure(stream: &TcpStream) -> io::Result<()> {
    stream.set_nodelay(true)?;
    setsockopt(stream, sockopt::KeepAlive, &true)?;
    setsockopt(stream, sockopt::TcpKeepIdle, &10)?;
    setsockopt(stream, sockopt::TcpKeepInterval, &5)?;
    setsockopt(stream, sockopt::TcpKeepCount, &3)?;
    setsockopt(stream, sockopt::TcpUserTimeout, &25_000)?;
    Ok(())
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
async fn accept(mut listener: impl Accept, accepted: mpsc::Sender<Arrival>, counters: Arc<Counters>) {
    let mut pause = ACCEPT_PAUSE;
    loop {
        match listener.accept().await {
            Ok((stream, peer)) => {
                pause = ACCEPT_PAUSE;
                if accepted.send(Arrival::Client(stream, peer)).await.is_err() {
                    return;
                }
            }
            Err(error) => {
                counters.accept_error();
                if pause == ACCEPT_PAUSE {
                    tracing::warn!(%error, "cannot accept Modbus connections for now");
                }
                let code = error.raw_os_error().map(nix::errno::Errno::from_raw);
                if matches!(code, Some(nix::errno::Errno::EMFILE | nix::errno::Errno::ENFILE)) {
                    // Where this queue is full, clients are being let in, and descriptors come free by that.
                    let _ = accepted.try_send(Arrival::NoDescriptor);
                }
                tokio::time::sleep(pause).await;
                pause = (pause * 2).min(LONGEST_ACCEPT_PAUSE);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use tokio::io::AsyncReadExt;

    use super::*;

    struct OutOfDescriptors {
        failures: usize,
        listener: TcpListener,
    }

    impl Accept for OutOfDescriptors {
        async fn accept(&mut self) -> io::Result<(TcpStream, SocketAddr)> {
            if self.failures > 0 {
                self.failures -= 1;
                return Err(io::Error::from(nix::errno::Errno::EMFILE));
            }
            TcpListener::accept(&self.listener).await
        }
    }

    #[tokio::test(start_paused = true)]
    async fn accepting_goes_on_after_the_file_descriptors_ran_out() {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let address = listener.local_addr().unwrap();
        let _client = std::net::TcpStream::connect(address).unwrap();
        let (sender, mut accepted) = mpsc::channel(1);
        let counters = Arc::new(Counters::default());
        let acceptor = OutOfDescriptors { failures: 20, listener };
        let accepting = tokio::spawn(accept(acceptor, sender, Arc::clone(&counters)));
        assert!(matches!(accepted.recv().await, Some(Arrival::NoDescriptor)), "somebody has to give way");
        while !matches!(accepted.recv().await, Some(Arrival::Client(..))) {}
        assert_eq!(counters.values().accept_errors, 20);
        drop(accepted);
        accepting.abort();
    }

    fn clients(places: usize) -> Clients {
        Clients {
            slots: Slots::new(places),
            tasks: JoinSet::new(),
            shared: Arc::new(connection::tests::shared()),
            stop: CancellationToken::new(),
        }
    }

    #[tokio::test]
    async fn without_a_file_descriptor_one_client_gives_way_and_the_others_stay() {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let mut clients = clients(8);
        clients.give_way().await;
        let mut near = Vec::new();
        for _ in 0..3 {
            near.push(TcpStream::connect(listener.local_addr().unwrap()).await.unwrap());
            let (stream, peer) = listener.accept().await.unwrap();
            clients.admit(stream, peer).await;
        }
        clients.give_way().await;
        assert_eq!((clients.slots.in_use(), clients.tasks.len()), (2, 2));
        let mut byte = [0];
        assert_eq!(near[0].read(&mut byte).await.unwrap(), 0, "the oldest of those that never asked");
        assert_eq!(clients.shared.counters.values().ended(End::Evicted), 1);
        clients.stop.cancel();
    }

    #[tokio::test]
    async fn f46_a_taken_port_is_named_with_a_hint() {
        let taken = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let address = taken.local_addr().unwrap();
        let source = TcpListener::bind(address).await.unwrap_err();
        let message = BindError { address, source }.to_string();
        assert!(message.contains(&address.to_string()) && message.contains("another program"), "{message}");
    }
}
