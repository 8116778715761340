//! From a TCP connection to one whose client is known, and back to the registers that all clients share. \[IO\]

use std::net::SocketAddr;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use tokio::io::AsyncWriteExt;
use tokio::net::TcpStream;
use tokio_rustls::server::TlsStream;

use super::rights::Rights;
use super::role::{self, PeerRole};
use super::settings::SecuritySettings;
use crate::modbus::caller::Caller;
use crate::modbus::connection::{self, Shared};
use crate::modbus::counters::End;
use crate::process_image::Current;
use crate::slots::{Leave, Place, Service};
use crate::time::Clock;
use crate::tls::{Reason, ServerKeeper, TlsError, Told, handshake};

/// The door for clients with certificates.
#[derive(Debug)]
pub struct Door {
    settings: SecuritySettings,
    keeper: Arc<ServerKeeper>,
    shared: Current<Shared>,
    told: Mutex<Told>,
}

/// Reads the files of the settings, so that what is wrong with them is known before anything listens; `None` where it is off.
///
/// # Errors
/// Which file is wrong, why, and how to mend it.
pub async fn prepare(
    settings: &SecuritySettings,
    clock: Clock,
) -> Result<Option<Arc<ServerKeeper>>, TlsError> {
    if settings.is_off() {
        return Ok(None);
    }
    let keeper = ServerKeeper::new("[modbus.security]", (settings.tls(), Some(role::check)), clock);
    let keeper = Arc::new(keeper);
    keeper.current_async().await?;
    Ok(Some(keeper))
}

impl Door {
    /// With files that were [prepared](prepare).
    #[must_use]
    pub fn new(settings: SecuritySettings, keeper: Arc<ServerKeeper>, shared: Current<Shared>) -> Self {
        Self { settings, keeper, shared, told: Mutex::default() }
    }

    async fn enter(&self, stream: TcpStream, peer: SocketAddr, place: &Place) -> End {
        let leave = |leave| match leave {
            Leave::Evicted => End::Evicted,
            Leave::Stopped => End::Stopped,
        };
        let shaken = tokio::select! {
            shaken = handshake::accept(stream, &self.keeper) => shaken,
            left = place.must_leave() => return leave(left),
        };
        let (mut stream, role) = match shaken.and_then(with_role) {
            Ok(known) => known,
            Err(reason) => {
                self.tell(peer, &reason);
                self.shared.get().accounts.refused(peer.ip());
                return End::Handshake;
            }
        };
        let rights = Rights::of_role(&role, &self.settings);
        tracing::debug!(%peer, ?rights, "Modbus/TCP Security: {role}");
        if rights.is_empty() && self.is_news(peer, "no_rights") {
            tracing::warn!(
                %peer,
                "Modbus/TCP Security: a client with {role} may do nothing: `roles` and `no_role` in [modbus.security] say who may"
            );
        }
        let caller = Caller::known(role, rights);
        let end = connection::serve_as(&mut stream, peer, caller, &self.shared, place).await;
        // The goodbye of TLS leaves where it can leave at once: a newcomer may wait for the place.
        let _ = tokio::time::timeout(Duration::ZERO, stream.shutdown()).await;
        end
    }

    fn tell(&self, peer: SocketAddr, reason: &Reason) {
        if self.is_news(peer, reason.word()) {
            tracing::warn!(%peer, "Modbus/TCP Security: a client did not get in: {reason}");
        } else {
            tracing::debug!(%peer, "Modbus/TCP Security: a client did not get in: {reason}");
        }
    }

    fn is_news(&self, peer: SocketAddr, reason: &'static str) -> bool {
        let now = self.shared.get().clock.now().instant;
        self.told.lock().unwrap_or_else(PoisonError::into_inner).is_news(now, peer.ip(), reason)
    }
}

/// The role was looked at during the handshake already; without a certificate there is none that ended well.
fn with_role(stream: TlsStream<TcpStream>) -> Result<(TlsStream<TcpStream>, PeerRole), Reason> {
    let certificate = handshake::client_certificate(&stream).ok_or(Reason::NoClientCertificate)?;
    let role = PeerRole::of_certificate(certificate);
    let role = role.map_err(|error| Reason::BadCertificate(error.to_string()))?;
    Ok((stream, role))
}

impl Service for Door {
    async fn serve(&self, stream: TcpStream, peer: SocketAddr, place: Place) -> &'static str {
        let counters = Arc::clone(&self.shared.get().counters);
        counters.accepted();
        let end = self.enter(stream, peer, &place).await;
        counters.ended(end);
        end.word()
    }

    fn accept_failed(&self) {
        self.shared.accept_failed();
    }

    fn turned_away(&self, peer: SocketAddr) {
        self.shared.turned_away(peer);
    }
}
