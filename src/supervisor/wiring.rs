//! Builds the parts of the gateway, binds its listeners, spawns its tasks. \[IO\]

use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use tokio::sync::{mpsc, watch};
use tokio_util::sync::CancellationToken;
use tracing::info;

use super::descriptors;
use super::mqtt_tasks::MqttLinks;
use super::program::Program;
use super::reload::{self, Reloads};
use super::running::{Running, simulated};
use super::tasks::{Ended, Tasks};
use crate::access::Access;
use crate::can::interface::Interface;
use crate::cia309::{self, Cia309Settings};
use crate::config::ReloadMode;
use crate::gateway::command::desk::Requests;
use crate::gateway::{self, Desk, Gateway, Health};
use crate::mapping::TagTable;
use crate::modbus::connection::Shared;
use crate::modbus::gateway_block::MAP_VERSION;
use crate::modbus::{
    self, Accounts, Counters, MapFormat, ModbusSettings, RegisterBank, RegisterMap, map_text,
};
use crate::mqtt::sparkplug::SparkplugStatus;
use crate::mqtt::store_link::Opened;
use crate::mqtt::{Identity, MqttSettings, MqttStatus, StoreLink};
use crate::process_image::{ImageReader, ImageWriter, process_image};
use crate::serial;
use crate::slots::BindError;
use crate::time::Clock;
use crate::tls::Life;
use crate::web::server::WebError;
use crate::web::{self, About, ConfigurationHealth, WebSettings, WebState};

/// Bus events that wait for the gateway; beyond it the bus tasks wait, and the kernel's receive buffer absorbs.
const BUS_EVENTS: usize = 1024;
/// Frames that wait for a bus; beyond it a command fails as "busy" and a guard request is dropped, never sent late.
pub(super) const TRANSMIT: usize = 64;
/// Requests of northbounds that wait for the gateway; beyond it they are answered "busy".
pub(super) const COMMANDS: usize = 32;
/// Orders of a reload that wait for the gateway; a reload waits for each.
const ORDERS: usize = 4;

/// How long buses have to send what the gateway said last.
pub(super) const LAST_FRAMES: Duration = Duration::from_millis(50);

/// A checked installation: everything that has to be known before anything is started.
#[derive(Clone, Debug)]
pub struct Installation {
    /// Nodes, tags, alarms.
    pub table: Arc<TagTable>,
    /// How each bus of the table is reached.
    pub interfaces: Vec<Interface>,
    /// The register map, built from the table.
    pub map: Arc<RegisterMap>,
    /// Modbus TCP.
    pub modbus: ModbusSettings,
    /// MQTT, where there is a broker.
    pub mqtt: Option<MqttSettings>,
    /// HTTP.
    pub http: WebSettings,
    /// CiA 309-3.
    pub cia309: Cia309Settings,
    /// Who may ask for what.
    pub access: Arc<Access>,
    /// How another one is taken in while this one runs.
    pub reload: ReloadSettings,
}

/// How another configuration is taken in while this one runs.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ReloadSettings {
    /// What makes the files be read again.
    pub mode: ReloadMode,
    /// Published addresses may change their meaning by it.
    pub allow_map_change: bool,
}

/// Why the gateway could not start: something outside is not as it has to be.
#[derive(Debug, thiserror::Error)]
pub enum StartError {
    /// A listener for Modbus, CiA 309-3 or a serial line.
    #[error(transparent)]
    Listen(#[from] BindError),
    /// Modbus/TCP Security.
    #[error(transparent)]
    Security(#[from] modbus::SecurityError),
    /// The HTTP listener.
    #[error(transparent)]
    Web(#[from] WebError),
}

/// A gateway whose listeners are bound, but of which nothing runs yet.
#[derive(Debug)]
pub struct Bound {
    installation: Installation,
    gateway: Gateway,
    writer: ImageWriter,
    reader: ImageReader,
    modbus: modbus::Server,
    web: web::Server,
    cia309: Option<cia309::Server>,
    serial: serial::Server,
    desk: Desk,
    requests: Requests,
    parts: Parts,
    /// What outlives the process of what is for the broker.
    store: Option<Opened>,
    identity: Identity,
    clock: Clock,
}

/// What views are made of beside the image, the same for as long as the program runs, but for the register bank.
#[derive(Clone, Debug)]
pub(super) struct Parts {
    pub(super) bank: Arc<RegisterBank>,
    pub(super) counters: Arc<Counters>,
    pub(super) accounts: Arc<Accounts>,
    pub(super) mqtt_status: watch::Sender<MqttStatus>,
    pub(super) sparkplug_status: watch::Sender<SparkplugStatus>,
    pub(super) lives: watch::Sender<Vec<Life>>,
    pub(super) configuration: watch::Sender<ConfigurationHealth>,
    /// Set once every task is spawned: then `/readyz` says so.
    pub(super) ready: Arc<AtomicBool>,
    clock: Clock,
}

impl Parts {
    fn new(shared: &Shared, clock: Clock) -> Self {
        let loaded = clock.now().utc;
        Self {
            bank: Arc::clone(&shared.bank),
            counters: Arc::clone(&shared.counters),
            accounts: Arc::clone(&shared.accounts),
            mqtt_status: watch::Sender::default(),
            sparkplug_status: watch::Sender::default(),
            lives: watch::Sender::default(),
            configuration: watch::Sender::new(ConfigurationHealth { loaded, ..Default::default() }),
            ready: Arc::new(AtomicBool::new(false)),
            clock,
        }
    }

    /// What HTTP shows.
    pub(super) fn web_state(
        &self,
        installation: &Installation,
        identity: &Identity,
        reader: &ImageReader,
        desk: &Desk,
    ) -> WebState {
        // Nobody looks where there is no such task.
        let mqtt = installation.mqtt.as_ref().map(|_| self.mqtt_status.subscribe());
        let sparkplug = installation.mqtt.as_ref().filter(|mqtt| mqtt.sparkplug.enabled);
        let program = Program {
            ready: Arc::clone(&self.ready),
            mqtt,
            sparkplug: sparkplug.map(|_| self.sparkplug_status.subscribe()),
            modbus: Arc::clone(&self.counters),
            clients: Arc::clone(&self.accounts),
            certificates: self.lives.subscribe(),
            desk: desk.clone(),
            configuration: self.configuration.subscribe(),
        };
        WebState {
            table: Arc::clone(&installation.table),
            reader: reader.clone(),
            desk: desk.clone(),
            clock: self.clock,
            about: About {
                version: identity.version.clone(),
                map_version: identity.map_version,
                map_hash: identity.map_hash.clone(),
                started: identity.started,
            },
            health: Arc::new(move || program.health()),
            map_json: map_text::render(&installation.map, MapFormat::Json).into(),
            map_csv: map_text::render(&installation.map, MapFormat::Csv).into(),
        }
    }
}

/// Names this run for ever.
fn identity(map: &RegisterMap, clock: Clock) -> Identity {
    Identity {
        sid: uuid::Uuid::new_v4().to_string(),
        version: env!("CARGO_PKG_VERSION").to_owned(),
        map_version: MAP_VERSION.into(),
        map_hash: map.hash_text(),
        started: clock.now(),
    }
}

/// Builds everything and binds every listener.
///
/// # Errors
/// A listener's address cannot be used.
pub async fn bind(installation: Installation, clock: Clock) -> Result<Bound, StartError> {
    descriptors::raise_limit();
    let Installation { table, map, modbus, http, .. } = &installation;
    let store = open_store(&installation, clock).await;
    // Events are numbered on where those on disk end.
    let newest = store.as_ref().map_or(0, |opened| opened.newest_event);
    let gateway = new_gateway(&installation, newest, clock);
    let (writer, reader) = process_image(gateway.empty_image());
    let bank = RegisterBank::new(Arc::clone(table), Arc::clone(map));
    let (desk, commands) = Desk::new(COMMANDS);
    desk.set_access(Arc::clone(&installation.access));
    let requests = Requests::new(&desk, commands);
    let shared = Shared::new(modbus, bank.into(), reader.clone(), clock);
    let shared = shared.with_desk(modbus.canopen_objects, desk.clone());
    let parts = Parts::new(&shared, clock);
    let modbus_server = modbus::Server::bind_shown(modbus, shared.into()).await?;
    let modbus = modbus_server.with_security(&modbus.security).await?;
    let serial = serial::Server::bind(table, &desk, &reader, clock).await?;
    let cia309 = bind_cia309(&installation, desk.clone(), clock).await?;
    let identity = identity(map, clock);
    let web = web::Server::bind(http, parts.web_state(&installation, &identity, &reader, &desk)).await?;
    Ok(Bound {
        installation,
        gateway,
        writer,
        reader,
        modbus,
        web,
        cia309,
        serial,
        desk,
        requests,
        parts,
        store,
        identity,
        clock,
    })
}

fn new_gateway(installation: &Installation, newest_event: u64, clock: Clock) -> Gateway {
    let mut gateway = Gateway::after_event(Arc::clone(&installation.table), clock.now(), newest_event);
    for bus in simulated(&installation.interfaces) {
        gateway.mark_simulated(bus);
    }
    gateway
}

async fn open_store(installation: &Installation, clock: Clock) -> Option<Opened> {
    let settings = installation.mqtt.as_ref()?;
    StoreLink::open(settings, &installation.table.gateway, clock).await
}

pub(super) async fn bind_cia309(
    installation: &Installation,
    desk: Desk,
    clock: Clock,
) -> Result<Option<cia309::Server>, StartError> {
    let settings = &installation.cia309;
    let Some(address) = settings.listen else { return Ok(None) };
    let shared = cia309::connection::Shared {
        table: Arc::clone(&installation.table),
        desk,
        writes: settings.writes,
        clock,
        idle_timeout: settings.idle_timeout(),
    };
    Ok(Some(cia309::Server::bind(address, settings.max_connections, shared).await?))
}

impl Bound {
    /// Where Modbus TCP listens.
    #[must_use]
    pub fn modbus_addresses(&self) -> Vec<SocketAddr> {
        self.modbus.local_addrs()
    }

    /// Where the page is.
    #[must_use]
    pub fn http_address(&self) -> SocketAddr {
        self.web.local_addr()
    }

    /// Runs everything until `stop`, or until a bug of ours ends a task. `tasks` are those that already run beside the
    /// gateway, as the engines of a demo; they are watched like its own.
    pub async fn run(self, tasks: Tasks, stop: CancellationToken) -> Ended {
        let (_never, none) = mpsc::channel(1);
        Box::pin(self.run_with_reloads(tasks, stop, Reloads::none(none))).await
    }

    /// The same, with another configuration taken in whenever that is asked for.
    pub async fn run_with_reloads(self, tasks: Tasks, stop: CancellationToken, reloads: Reloads) -> Ended {
        self.log_where_it_listens();
        let (events, event_queue) = mpsc::channel(BUS_EVENTS);
        let (orders, order_queue) = mpsc::channel(ORDERS);
        let (health, health_seen) = watch::channel(Health::default());
        let (modbus_shown, web_shown) = (self.modbus.shown(), self.web.shown());
        let (modbus, security, lines, places) = self.modbus.into_doors();
        let mut running = Running {
            tasks,
            stop: stop.clone(),
            // The buses outlive the gateway: what it says last is to leave.
            stop_buses: CancellationToken::new(),
            clock: self.clock,
            identity: self.identity,
            buses: Vec::new(),
            next_port: 0,
            events,
            orders,
            health,
            reader: self.reader,
            desk: self.desk,
            modbus_shown,
            places,
            web_shown,
            mqtt: MqttLinks::default(),
            lost: BTreeMap::new(),
            parts: self.parts,
            installation: self.installation,
        };
        let installation = running.installation.clone();
        for index in 0..installation.interfaces.len() {
            if let Some(bus) = running.new_bus(&installation, index) {
                running.buses.push(bus.part.clone());
                running.spawn_bus(bus);
            }
        }
        let transmit = running.buses.iter().map(|bus| bus.transmit.clone()).collect();
        let gateway = gateway::task::run(
            self.gateway,
            self.writer,
            event_queue,
            transmit,
            self.requests,
            health_seen,
            order_queue,
            self.clock,
            stop.clone(),
        );
        let stop_buses = running.stop_buses.clone();
        running.tasks.spawn("gateway", async move {
            let _buses_end_with_it = stop_buses.drop_guard();
            let _kept_open = gateway.await;
            tokio::time::sleep(LAST_FRAMES).await;
        });
        running.spawn_modbus(modbus);
        running.spawn_security(security);
        running.spawn_rtu(lines);
        running.spawn_web(self.web);
        running.spawn_cia309(self.cia309);
        running.spawn_serial(self.serial);
        running.spawn_health();
        running.spawn_certificates();
        running.spawn_mqtt(self.store);
        running.spawn_sparkplug();
        running.parts.ready.store(true, Ordering::Release);
        reload::run(&mut running, reloads).await;
        running.tasks.run(stop).await
    }

    fn log_where_it_listens(&self) {
        let table = &self.installation.table;
        info!(
            gateway = table.gateway,
            version = env!("CARGO_PKG_VERSION"),
            map = self.installation.map.hash_text(),
            "started"
        );
        for address in self.modbus.local_addrs() {
            info!(%address, "Modbus TCP");
        }
        for address in self.modbus.secure_addrs() {
            info!(%address, "Modbus/TCP Security");
        }
        info!("page {}", self.web.url());
        if let Some(server) = &self.cia309 {
            info!(address = %server.local_addr(), writes = self.installation.cia309.writes, "CiA 309-3");
        }
        for (line, address) in self.serial.addresses() {
            info!("{line} at {address}");
        }
        for (bus, interface) in table.buses.iter().zip(&self.installation.interfaces) {
            info!(bus = bus.name, %interface, role = ?bus.role, "CAN bus");
        }
        for node in &table.nodes {
            let bus = table.buses.get(node.bus.0).map_or("", |bus| bus.name.as_str());
            info!(
                node = node.name,
                bus,
                id = node.number(),
                unit = node.unit_id,
                mapping = node.device.mapping,
                "node"
            );
        }
    }
}
