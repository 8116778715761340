//! A broker inside the process \[IO\], for `cangate demo`: whoever tries the program needs no broker of his own.
//!
//! Anonymous, in memory, without TLS: for a loopback address and for trying out.

use std::net::SocketAddr;
use std::time::Duration;

use mqtt5::broker::config::{BrokerConfig, StorageConfig};
use mqtt5::broker::{BrokerShutdownHandle, MqttBroker};
use tokio::task::JoinHandle;

/// Time that connections get to end.
const SHUTDOWN_TIMEOUT: Duration = Duration::from_secs(2);

/// A running broker. Dropping it stops it.
pub struct EmbeddedBroker {
    address: SocketAddr,
    handle: BrokerShutdownHandle,
    task: JoinHandle<()>,
}

/// The broker could not be started.
#[derive(Debug, thiserror::Error)]
#[error("cannot start the broker on {address}: {reason}; is the port taken?")]
pub struct EmbeddedBrokerError {
    /// Where.
    address: SocketAddr,
    /// What the broker says.
    reason: String,
}

impl EmbeddedBroker {
    /// Starts a broker; when this returns, it accepts connections. Port 0 takes any free one.
    ///
    /// # Errors
    /// The address cannot be bound.
    pub async fn start(address: SocketAddr) -> Result<Self, EmbeddedBrokerError> {
        let failed = |reason: String| EmbeddedBrokerError { address, reason };
        let config = BrokerConfig::new()
            .with_bind_addresses(vec![address])
            .with_max_clients(100)
            .with_max_packet_size(1024 * 1024)
            .with_storage(StorageConfig::new().with_persistence(false))
            .with_sys_topics_enabled(false);
        let mut broker = MqttBroker::with_config(config).await.map_err(|error| failed(error.to_string()))?;
        let address = broker.local_addr().ok_or_else(|| failed("it has no address".to_owned()))?;
        let handle = broker.shutdown_handle();
        let mut ready = broker.ready_receiver();
        let task = tokio::spawn(async move {
            if let Err(error) = broker.run().await {
                tracing::error!("the broker inside the program ended: {error}");
            }
        });
        ready.wait_for(|ready| *ready).await.map_err(|_| failed("it ended at once".to_owned()))?;
        Ok(Self { address, handle, task })
    }

    /// Where it listens.
    #[must_use]
    pub fn local_addr(&self) -> SocketAddr {
        self.address
    }

    /// Waits until the broker ends by itself, which it should not.
    pub async fn ended(&mut self) {
        // Why, it has told itself; a panic has told it.
        let _ = (&mut self.task).await;
    }

    /// Ends all connections, then the broker.
    pub async fn shutdown(mut self) {
        self.handle.shutdown();
        if tokio::time::timeout(SHUTDOWN_TIMEOUT, &mut self.task).await.is_err() {
            self.task.abort();
        }
    }
}

impl Drop for EmbeddedBroker {
    fn drop(&mut self) {
        self.handle.shutdown();
        self.task.abort();
    }
}
