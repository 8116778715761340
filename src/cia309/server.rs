//! Listens, accepts, limits. \[IO\]

use std::io;
use std::net::SocketAddr;
use std::time::Duration;

use nix::sys::socket::{setsockopt, sockopt};
use tokio::net::{TcpListener, TcpStream};
use tokio::task::{JoinError, JoinSet};
use tokio_util::sync::CancellationToken;

use super::connection::{self, Shared, Stops};
use crate::slots::{SlotId, Slots};

/// A CiA 309-3 gateway that listens already.
#[derive(Debug)]
pub struct Server {
    listener: TcpListener,
    address: SocketAddr,
    max_connections: usize,
    shared: Shared,
}

/// An address could not be listened on.
#[derive(Debug, thiserror::Error)]
#[error("cannot listen for CiA 309-3 on {address}: {source}; change `listen` in [cia309]")]
pub struct BindError {
    /// The address.
    pub address: SocketAddr,
    /// What the system says.
    pub source: io::Error,
}

/// Pause after a failed accept, for example when there are no file descriptors left.
const ACCEPT_PAUSE: Duration = Duration::from_millis(100);

impl Server {
    /// Listens.
    ///
    /// # Errors
    /// The address cannot be listened on.
    pub async fn bind(address: SocketAddr, max_connections: u16, shared: Shared) -> Result<Self, BindError> {
        let failed = |source| BindError { address, source };
        let listener = TcpListener::bind(address).await.map_err(failed)?;
        let address = listener.local_addr().map_err(failed)?;
        Ok(Self { listener, address, max_connections: max_connections.into(), shared })
    }

    /// Where it listens; port 0 has become a real one.
    #[must_use]
    pub fn local_addr(&self) -> SocketAddr {
        self.address
    }

    /// Serves until `stop`. Connections end with it.
    pub async fn run(self, stop: CancellationToken) {
        let mut clients = Clients {
            slots: Slots::new(self.max_connections),
            tasks: JoinSet::new(),
            shared: self.shared,
            stop,
        };
        let stop = clients.stop.clone();
        loop {
            tokio::select! {
                () = stop.cancelled() => break,
                accepted = self.listener.accept() => match accepted {
                    Ok((stream, peer)) => clients.admit(stream, peer).await,
                    Err(error) => {
                        tracing::debug!(%error, "cannot accept a CiA 309-3 connection for now");
                        tokio::time::sleep(ACCEPT_PAUSE).await;
                    }
                },
                Some(ended) = clients.tasks.join_next() => clients.ended(ended),
            }
        }
        while let Some(ended) = clients.tasks.join_next().await {
            clients.ended(ended);
        }
    }
}

/// The connections that are open.
struct Clients {
    slots: Slots<CancellationToken>,
    tasks: JoinSet<SlotId>,
    shared: Shared,
    stop: CancellationToken,
}

impl Clients {
    /// Serves a newcomer; somebody else makes room if need be.
    async fn admit(&mut self, stream: TcpStream, peer: SocketAddr) {
        while let Some(ended) = self.tasks.try_join_next() {
            self.ended(ended);
        }
        if let Err(error) = configure(&stream) {
            tracing::debug!(%peer, %error, "CiA 309-3 connection was gone before it was served");
            return;
        }
        let evict = CancellationToken::new();
        let taken = self.slots.take(peer.ip(), evict.clone());
        if let Some(other) = taken.evicted {
            other.cancel();
            // So that there are never more tasks than places.
            while self.tasks.len() >= self.slots.in_use() {
                let Some(ended) = self.tasks.join_next().await else { break };
                self.ended(ended);
            }
        }
        tracing::debug!(%peer, "CiA 309-3 connection opened");
        let (shared, stops) = (self.shared.clone(), Stops { evict, stop: self.stop.clone() });
        self.tasks.spawn(async move {
            let end = connection::serve(stream, peer.to_string(), &shared, &taken.activity, &stops).await;
            tracing::debug!(%peer, end, "CiA 309-3 connection ended");
            taken.id
        });
    }

    fn ended(&mut self, ended: Result<SlotId, JoinError>) {
        match ended {
            Ok(id) => self.slots.release(id),
            // A panic is our bug; it ends the server as it would in this task, and the supervisor tells.
            Err(error) => {
                if let Ok(panic) = error.try_into_panic() {
                    std::panic::resume_unwind(panic);
                }
            }
        }
    }
}

/// Answers leave at once; a client that vanished is noticed after 25 s and not after two hours.
fn configure(stream: &TcpStream) -> io::Result<()> {
    stream.set_nodelay(true)?;
    setsockopt(stream, sockopt::KeepAlive, &true)?;
    setsockopt(stream, sockopt::TcpKeepIdle, &10)?;
    setsockopt(stream, sockopt::TcpKeepInterval, &5)?;
    setsockopt(stream, sockopt::TcpKeepCount, &3)?;
    Ok(())
}
