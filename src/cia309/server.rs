//! Listens. \[IO\]

use std::net::SocketAddr;
use std::sync::Arc;

use tokio::net::{TcpListener, TcpStream};
use tokio_util::sync::CancellationToken;

use super::connection::{self, Shared};
use crate::slots::{BindError, Clients, Limits, Place, ServerName, Service, listening};

/// A CiA 309-3 gateway that listens already.
#[derive(Debug)]
pub struct Server {
    listener: TcpListener,
    address: SocketAddr,
    max_connections: usize,
    shared: Shared,
}

fn name() -> ServerName {
    ServerName::new("CiA 309-3", "[cia309]")
}

impl Server {
    /// Listens.
    ///
    /// # Errors
    /// The address cannot be listened on.
    pub async fn bind(address: SocketAddr, max_connections: u16, shared: Shared) -> Result<Self, BindError> {
        let listener = listening::bind(&name(), address).await?;
        let address = listener.local_addr().unwrap_or(address);
        Ok(Self { listener, address, max_connections: max_connections.into(), shared })
    }

    /// Where it listens; port 0 has become a real one.
    #[must_use]
    pub fn local_addr(&self) -> SocketAddr {
        self.address
    }

    /// Serves until `stop`. Connections end with it.
    pub async fn run(self, stop: CancellationToken) {
        let clients = Clients::new(name(), Limits::places(self.max_connections), stop);
        listening::serve(vec![self.listener], clients, Arc::new(self.shared)).await;
    }
}

impl Service for Shared {
    async fn serve(&self, stream: TcpStream, peer: SocketAddr, place: Place) -> &'static str {
        connection::serve(stream, peer.to_string(), self, &place).await
    }
}
