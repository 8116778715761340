//! Listens, and keeps the heartbeat registers. \[IO\]

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use tokio::net::{TcpListener, TcpStream};
use tokio::task::JoinSet;
use tokio::time::MissedTickBehavior;
use tokio_util::sync::CancellationToken;

use super::accounts::Accounts;
use super::connection::{self, Objects, Shared};
use super::counters::Counters;
use super::register_bank::RegisterBank;
use super::rtu::{self, RtuSettings};
use super::security::{Door, SecuritySettings, door};
use super::writers::Writers;
use super::{ModbusSettings, ObjectAccess};
use crate::gateway::command::Desk;
use crate::process_image::{Current, ImageReader};
use crate::slots::{BindError, Clients, Limits, Place, Places, ServerName, Service, listening};
use crate::time::Clock;
use crate::tls::{ServerKeeper, TlsError};

/// A Modbus TCP server that listens already.
#[derive(Debug)]
pub struct Server {
    plain: Plain,
    /// What is done with a desk, once there is one.
    objects: ObjectAccess,
    lines: Lines,
    security: Option<SecureServer>,
}

/// Clients by TCP alone; and the heartbeat registers, which go on with it.
#[derive(Debug)]
pub struct Plain {
    listeners: Vec<TcpListener>,
    limits: Limits,
    places: Places,
    shared: Current<Shared>,
}

/// Modbus/TCP Security, listening already.
#[derive(Debug)]
pub struct SecureServer {
    listeners: Vec<TcpListener>,
    settings: SecuritySettings,
    keeper: Arc<ServerKeeper>,
    limits: Limits,
    places: Places,
    shared: Current<Shared>,
}

/// Serial lines.
#[derive(Clone, Debug)]
pub struct Lines {
    settings: Vec<RtuSettings>,
    shared: Current<Shared>,
}

/// Why Modbus/TCP Security cannot be served.
#[derive(Debug, thiserror::Error)]
pub enum SecurityError {
    /// An address.
    #[error(transparent)]
    Listen(#[from] BindError),
    /// A file.
    #[error("Modbus/TCP Security cannot be served: {0}")]
    Files(#[from] TlsError),
}

fn name() -> ServerName {
    ServerName::new("Modbus", "[modbus]")
}

fn secure_name() -> ServerName {
    ServerName::new("Modbus/TCP Security", "[modbus.security]")
}

/// Where clients with certificates are told of: who may come, and how many, stands in one table for both doors of TCP.
fn secure_clients() -> ServerName {
    ServerName::new(&secure_name().what, &name().table)
}

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
        let shared = Shared::new(settings, bank.into(), reader, clock);
        Self::bind_shown(settings, shared.into()).await
    }

    /// The same with what it shows already made.
    ///
    /// # Errors
    /// The first address that cannot be listened on.
    pub async fn bind_shown(settings: &ModbusSettings, shared: Current<Shared>) -> Result<Self, BindError> {
        let limits = settings.limits();
        let plain = Plain::bind(settings, Places::new(&limits), shared.clone()).await?;
        let lines = Lines { settings: settings.rtu.clone(), shared };
        Ok(Self { plain, objects: settings.canopen_objects, lines, security: None })
    }

    /// Serves clients with certificates too, where the settings say so. They share the places of the others.
    ///
    /// # Errors
    /// A file cannot be used, or an address cannot be listened on.
    pub async fn with_security(mut self, settings: &SecuritySettings) -> Result<Self, SecurityError> {
        let Plain { limits, places, shared, .. } = &self.plain;
        if let Some(keeper) = door::prepare(settings, shared.get().clock).await? {
            let places = (limits.clone(), places.clone());
            self.security = Some(SecureServer::bind(settings, keeper, places, shared.clone()).await?);
        }
        Ok(self)
    }

    /// The addresses at which clients with certificates are served.
    #[must_use]
    pub fn secure_addrs(&self) -> Vec<SocketAddr> {
        self.security.as_ref().map(SecureServer::local_addrs).unwrap_or_default()
    }

    /// Hands writes in at this desk, and asks for objects of nodes, as far as the settings allow it. Without a desk FC 43/13 is
    /// not offered, and nothing is written.
    #[must_use]
    pub fn with_desk(self, desk: Desk) -> Self {
        let shared = Shared::clone(&self.plain.shared.get());
        self.plain.shared.set(shared.with_desk(self.objects, desk));
        self
    }

    /// What it shows, to exchange it while connections go on: each request is answered from one piece.
    #[must_use]
    pub fn shown(&self) -> Current<Shared> {
        self.plain.shared.clone()
    }

    /// The addresses that it listens on, in the order of the settings; port 0 has become a real one.
    #[must_use]
    pub fn local_addrs(&self) -> Vec<SocketAddr> {
        self.plain.local_addrs()
    }

    /// The counters, for metrics.
    #[must_use]
    pub fn counters(&self) -> Arc<Counters> {
        Arc::clone(&self.plain.shared.get().counters)
    }

    /// The counters of each client, for metrics and the page.
    #[must_use]
    pub fn accounts(&self) -> Arc<Accounts> {
        Arc::clone(&self.plain.shared.get().accounts)
    }

    /// Its doors, each of which can be run, and ended, by itself; and the places that both doors of TCP share.
    #[must_use]
    pub fn into_doors(self) -> (Plain, Option<SecureServer>, Lines, Places) {
        let places = self.plain.places.clone();
        (self.plain, self.security, self.lines, places)
    }

    /// Serves until `stop`. Connections end with it.
    pub async fn run(self, stop: CancellationToken) {
        let (plain, secure, lines, _) = self.into_doors();
        let secure = async {
            if let Some(secure) = secure {
                secure.run(stop.clone()).await;
            }
        };
        tokio::join!(plain.run(stop.clone()), secure, lines.run(stop.clone()));
    }
}

impl Plain {
    /// Listens on every address of the settings.
    ///
    /// # Errors
    /// The first address that cannot be listened on.
    pub async fn bind(
        settings: &ModbusSettings,
        places: Places,
        shared: Current<Shared>,
    ) -> Result<Self, BindError> {
        let mut listeners = Vec::new();
        for address in &settings.listen {
            listeners.push(listening::bind(&name(), *address).await?);
        }
        Ok(Self { listeners, limits: settings.limits(), places, shared })
    }

    /// The addresses that it listens on, in the order of the settings; port 0 has become a real one.
    #[must_use]
    pub fn local_addrs(&self) -> Vec<SocketAddr> {
        self.listeners.iter().filter_map(|listener| listener.local_addr().ok()).collect()
    }

    /// Serves until `stop`. Connections end with it.
    pub async fn run(self, stop: CancellationToken) {
        let clients = Clients::at(name(), self.limits, self.places, stop);
        let shared = self.shared;
        tokio::select! {
            () = listening::serve(self.listeners, clients, Arc::new(shared.clone())) => {}
            () = beat(&shared) => {}
        }
    }
}

impl SecureServer {
    /// Listens on every address of the settings, with files that were [prepared](door::prepare). `places`: who may come, and where.
    ///
    /// # Errors
    /// The first address that cannot be listened on.
    pub async fn bind(
        settings: &SecuritySettings,
        keeper: Arc<ServerKeeper>,
        (limits, places): (Limits, Places),
        shared: Current<Shared>,
    ) -> Result<Self, BindError> {
        let mut listeners = Vec::new();
        for address in &settings.listen {
            listeners.push(listening::bind(&secure_name(), *address).await?);
        }
        Ok(Self { listeners, settings: settings.clone(), keeper, limits, places, shared })
    }

    /// The addresses that it listens on.
    #[must_use]
    pub fn local_addrs(&self) -> Vec<SocketAddr> {
        self.listeners.iter().filter_map(|listener| listener.local_addr().ok()).collect()
    }

    /// Serves until `stop`. Connections end with it.
    pub async fn run(self, stop: CancellationToken) {
        let clients = Clients::at(secure_clients(), self.limits, self.places, stop);
        let door = Arc::new(Door::new(self.settings, self.keeper, self.shared));
        listening::serve(self.listeners, clients, door).await;
    }
}

impl Lines {
    /// Other lines that show the same.
    #[must_use]
    pub fn new(settings: &[RtuSettings], shared: Current<Shared>) -> Self {
        Self { settings: settings.to_vec(), shared }
    }

    /// Answers until `stop`.
    pub async fn run(self, stop: CancellationToken) {
        let run = |line| rtu::line::run(line, self.shared.clone(), stop.clone());
        let lines: JoinSet<()> = self.settings.into_iter().map(run).collect();
        tokio::select! {
            () = stop.cancelled() => {}
            () = watch(lines) => {}
        }
    }
}

/// Waits for ever; a panic of a line is a bug of ours, and is passed on.
async fn watch(lines: JoinSet<()>) {
    lines.join_all().await;
    std::future::pending::<()>().await;
}

/// Once a second, for ever: the heartbeat registers.
async fn beat(current: &Current<Shared>) {
    let mut second = tokio::time::interval(Duration::from_secs(1));
    second.set_missed_tick_behavior(MissedTickBehavior::Skip);
    loop {
        second.tick().await;
        let shared = current.get();
        let now = shared.clock.now();
        shared.reader.read(|image| shared.bank.tick(image, now));
    }
}

impl Shared {
    /// From settings and what they show, with counters that begin at zero; nothing is written, and FC 43/13 is not offered.
    #[must_use]
    pub fn new(
        settings: &ModbusSettings,
        bank: Arc<RegisterBank>,
        reader: ImageReader,
        clock: Clock,
    ) -> Self {
        Self {
            bank,
            reader,
            clock,
            counters: Arc::default(),
            accounts: Arc::new(Accounts::new(settings.reserved.clone())),
            rate: settings.rate(),
            idle_timeout: settings.idle_timeout(),
            partial_frame_timeout: settings.partial_frame_timeout(),
            send_timeout: settings.send_timeout(),
            objects: None,
            writers: None,
        }
    }

    /// Hands writes in at this desk, and asks for objects of nodes, as far as the settings allow it.
    #[must_use]
    pub fn with_desk(self, access: ObjectAccess, desk: Desk) -> Self {
        let writers = match &self.writers {
            Some(writers) => writers.at(desk.clone()),
            None => Writers::new(desk.clone()),
        };
        let objects = match access {
            ObjectAccess::Off => None,
            ObjectAccess::Read => Some(Objects { desk, write: false }),
            ObjectAccess::Write => Some(Objects { desk, write: true }),
        };
        Self { objects, writers: Some(writers), ..self }
    }

    /// What is shown from now on by other settings, registers and values; counters and command blocks go on.
    #[must_use]
    pub fn renewed(
        &self,
        settings: &ModbusSettings,
        bank: Arc<RegisterBank>,
        reader: ImageReader,
        desk: Desk,
    ) -> Self {
        self.accounts.set_reserved(settings.reserved.clone());
        let (counters, accounts) = (Arc::clone(&self.counters), Arc::clone(&self.accounts));
        let writers = self.writers.clone();
        Self { counters, accounts, writers, ..Self::new(settings, bank, reader, self.clock) }
            .with_desk(settings.canopen_objects, desk)
    }
}

impl Service for Current<Shared> {
    async fn serve(&self, stream: TcpStream, peer: SocketAddr, place: Place) -> &'static str {
        let counters = Arc::clone(&self.get().counters);
        counters.accepted();
        let end = connection::serve(stream, peer, self, &place).await;
        counters.ended(end);
        end.word()
    }

    fn accept_failed(&self) {
        self.get().counters.accept_error();
    }

    fn turned_away(&self, peer: SocketAddr) {
        let shared = self.get();
        shared.counters.turned_away();
        shared.accounts.refused(peer.ip());
    }
}
