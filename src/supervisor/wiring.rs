//! Builds the parts of the gateway, binds its listeners, spawns its tasks. \[IO\]

use std::net::SocketAddr;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use tokio::sync::{mpsc, oneshot, watch};
use tokio_util::sync::CancellationToken;
use tracing::info;

use super::tasks::{Ended, Tasks};
use super::{descriptors, health, readings};
use crate::can::interface::Interface;
use crate::can::{self, BusIndex};
use crate::canopen::Role;
use crate::cia309::{self, Cia309Settings};
use crate::gateway::{self, Command, Desk, Gateway, Health, Outcome};
use crate::mapping::TagTable;
use crate::modbus::gateway_block::MAP_VERSION;
use crate::modbus::{self, MapFormat, ModbusSettings, RegisterBank, RegisterMap, map_text};
use crate::mqtt::{self, Identity, MqttSettings, MqttStatus, Publisher};
use crate::process_image::{ImageReader, ImageWriter, process_image};
use crate::time::Clock;
use crate::web::server::WebError;
use crate::web::{self, About, WebSettings, WebState};

/// Bus events that wait for the gateway; beyond it the bus tasks wait, and the kernel's receive buffer absorbs.
const BUS_EVENTS: usize = 1024;
/// Frames that wait for a bus; beyond it a command fails as "busy" and a guard request is dropped, never sent late.
const TRANSMIT: usize = 64;
/// Requests of northbounds that wait for the gateway; beyond it they are answered "busy".
const COMMANDS: usize = 32;

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
}

/// Why the gateway could not start: something outside is not as it has to be.
#[derive(Debug, thiserror::Error)]
pub enum StartError {
    /// A Modbus listener.
    #[error(transparent)]
    Modbus(#[from] modbus::BindError),
    /// The HTTP listener.
    #[error(transparent)]
    Web(#[from] WebError),
    /// The CiA 309-3 listener.
    #[error(transparent)]
    Cia309(#[from] cia309::BindError),
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
    commands: mpsc::Receiver<(Command, oneshot::Sender<Outcome>)>,
    mqtt_status: watch::Sender<MqttStatus>,
    identity: Identity,
    /// Set once every task is spawned: then `/readyz` says so.
    ready: Arc<AtomicBool>,
    clock: Clock,
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
    let mut gateway = Gateway::new(Arc::clone(table), clock.now());
    for (index, interface) in installation.interfaces.iter().enumerate() {
        // Nothing real can be on a bus inside this process.
        if matches!(interface, Interface::Virtual(_)) {
            gateway.mark_simulated(BusIndex(index));
        }
    }
    let (writer, reader) = process_image(gateway.empty_image());
    let bank = RegisterBank::new(Arc::clone(table), Arc::clone(map));
    let (desk, commands) = Desk::new(COMMANDS);
    let modbus = modbus::Server::bind(modbus, bank, reader.clone(), clock).await?.with_desk(desk.clone());
    let cia309 = bind_cia309(&installation, desk, clock).await?;
    let (mqtt_status, mqtt_seen) = watch::channel(MqttStatus::default());
    let identity = identity(map, clock);
    let counters = modbus.counters();
    let mqtt_seen = installation.mqtt.is_some().then_some(mqtt_seen);
    let ready = Arc::new(AtomicBool::new(false));
    let running = Arc::clone(&ready);
    let health = move || {
        let starting = (!running.load(Ordering::Acquire)).then(|| "the tasks are being started".to_owned());
        let session = mqtt_seen.as_ref().map(|seen| seen.borrow().clone());
        readings::program_health(starting.into_iter().collect(), &counters.values(), session.as_ref())
    };
    let state = WebState {
        table: Arc::clone(table),
        reader: reader.clone(),
        clock,
        about: About {
            version: identity.version.clone(),
            map_version: identity.map_version,
            map_hash: identity.map_hash.clone(),
            started: identity.started,
        },
        health: Arc::new(health),
        map_json: map_text::render(map, MapFormat::Json).into(),
        map_csv: map_text::render(map, MapFormat::Csv).into(),
    };
    let web = web::Server::bind(http, state).await?;
    Ok(Bound {
        installation,
        gateway,
        writer,
        reader,
        modbus,
        web,
        cia309,
        commands,
        mqtt_status,
        identity,
        ready,
        clock,
    })
}

async fn bind_cia309(
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
    pub async fn run(self, mut tasks: Tasks, stop: CancellationToken) -> Ended {
        self.log_where_it_listens();
        let (events, event_queue) = mpsc::channel(BUS_EVENTS);
        let mut transmit = Vec::new();
        for (index, interface) in self.installation.interfaces.iter().enumerate() {
            let (frames, frame_queue) = mpsc::channel(TRANSMIT);
            transmit.push(frames);
            let role = self.installation.table.buses.get(index).map(|bus| bus.role);
            let bus = can::task::run(
                BusIndex(index),
                interface.clone(),
                role == Some(Role::Passive),
                events.clone(),
                frame_queue,
                self.clock,
                stop.clone(),
            );
            tasks.spawn(format!("bus {interface}"), bus);
        }
        drop(events);
        let (health, health_seen) = watch::channel(Health::default());
        tasks.spawn(
            "gateway",
            gateway::task::run(
                self.gateway,
                self.writer,
                event_queue,
                transmit,
                self.commands,
                health_seen,
                self.clock,
                stop.clone(),
            ),
        );
        tasks.spawn("modbus", self.modbus.run(stop.clone()));
        tasks.spawn("web", self.web.run(stop.clone()));
        if let Some(server) = self.cia309 {
            tasks.spawn("cia309", server.run(stop.clone()));
        }
        let session = self.installation.mqtt.is_some().then(|| self.mqtt_status.subscribe());
        tasks.spawn("health", health::run(session, health, stop.clone()));
        if let Some(settings) = self.installation.mqtt {
            let table = self.installation.table;
            let name = table.gateway.clone();
            let publisher = Publisher::new(table, &settings, self.identity);
            let (reader, clock, status, stop) = (self.reader, self.clock, self.mqtt_status, stop.clone());
            tasks.spawn("mqtt", async move {
                mqtt::client::run(settings, &name, publisher, reader, clock, stop, status).await;
            });
        }
        self.ready.store(true, Ordering::Release);
        tasks.run(stop).await
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
        info!("page http://{}/", self.web.local_addr());
        if let Some(server) = &self.cia309 {
            info!(address = %server.local_addr(), writes = self.installation.cia309.writes, "CiA 309-3");
        }
        for (bus, interface) in table.buses.iter().zip(&self.installation.interfaces) {
            info!(bus = bus.name, %interface, role = ?bus.role, "CAN bus");
        }
        for node in &table.nodes {
            let bus = table.buses.get(node.bus.0).map_or("", |bus| bus.name.as_str());
            info!(
                node = node.name,
                bus,
                id = node.canopen.id.get(),
                unit = node.unit_id,
                mapping = node.device.mapping,
                "node"
            );
        }
    }
}
