//! The parts that run, each in a task of its own, and how one is exchanged while the others go on. \[IO\]

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use tokio::sync::{mpsc, oneshot, watch};
use tokio_util::sync::CancellationToken;
use tracing::{error, info};

use super::listeners::Listener;
use super::mqtt_tasks::MqttLinks;
use super::plan::Plan;
use super::reload::Prepared;
use super::tasks::Tasks;
use super::wiring::{COMMANDS, Installation, LAST_FRAMES, Parts, TRANSMIT, bind_cia309};
use super::{certificates, health};
use crate::can::interface::Interface;
use crate::can::task::Sending;
use crate::can::{self, BusEvent, BusIndex, CanFrame};
use crate::canopen::Role;
use crate::gateway::order::{Exchange, Order};
use crate::gateway::{Desk, Health};
use crate::modbus::connection::Shared;
use crate::modbus::{self, RegisterBank};
use crate::mqtt::Identity;
use crate::process_image::{Current, ImageReader, ImageWriter};
use crate::slots::Places;
use crate::time::Clock;
use crate::web;
use crate::web::server::Shown;
use crate::{cia309, serial};

/// A listener that was free a moment ago is tried again this often, and so many times.
const AGAIN: Duration = Duration::from_millis(200);
const TIMES: usize = 25;

/// Names of the tasks of servers.
const MODBUS: &str = "modbus";
const SECURITY: &str = "modbus security";
const RTU: &str = "modbus rtu";
const WEB: &str = "web";
const CIA309: &str = "cia309";
const SERIAL: &str = "serial";

/// Everything that runs.
pub(super) struct Running {
    pub(super) installation: Installation,
    pub(super) tasks: Tasks,
    pub(super) stop: CancellationToken,
    pub(super) stop_buses: CancellationToken,
    pub(super) clock: Clock,
    pub(super) identity: Identity,
    pub(super) parts: Parts,
    /// By [`BusIndex`].
    pub(super) buses: Vec<BusPart>,
    pub(super) next_port: usize,
    pub(super) events: mpsc::Sender<(BusIndex, BusEvent)>,
    pub(super) orders: mpsc::Sender<Order>,
    pub(super) health: watch::Sender<Health>,
    pub(super) reader: ImageReader,
    pub(super) desk: Desk,
    pub(super) modbus_shown: Current<Shared>,
    /// Of clients of Modbus, with certificates or not.
    pub(super) places: Places,
    pub(super) web_shown: Shown,
    pub(super) mqtt: MqttLinks,
    /// Listeners whose addresses another program took in the moment of a reload, and what to say of it: the next reload has
    /// them try again.
    pub(super) lost: BTreeMap<Listener, String>,
}

/// The task of one bus.
#[derive(Clone, Debug)]
pub(super) struct BusPart {
    /// Its name.
    task: String,
    /// The number under which it tells events: never used again for another.
    pub(super) port: usize,
    /// Frames to it.
    pub(super) transmit: mpsc::Sender<CanFrame>,
}

/// A bus whose task is not started yet.
#[derive(Debug)]
pub(super) struct NewBus {
    interface: Interface,
    sending: Sending,
    pub(super) part: BusPart,
    frames: mpsc::Receiver<CanFrame>,
}

impl Running {
    /// A bus of this installation, for the gateway to know before its task tells anything.
    pub(super) fn new_bus(&mut self, installation: &Installation, index: usize) -> Option<NewBus> {
        let interface = installation.interfaces.get(index)?.clone();
        let role = installation.table.buses.get(index).map(|bus| bus.role);
        let (transmit, frames) = mpsc::channel(TRANSMIT);
        let (port, task) = (self.next_port, format!("bus {interface}"));
        self.next_port += 1;
        let known = BusPart { task, port, transmit };
        let sending = if role == Some(Role::Passive) { Sending::Never } else { Sending::Told };
        Some(NewBus { interface, sending, part: known, frames })
    }

    /// Starts the task of a bus.
    pub(super) fn spawn_bus(&mut self, new: NewBus) {
        let NewBus { interface, sending, part, frames } = new;
        let (events, clock) = (self.events.clone(), self.clock);
        self.tasks.spawn_part(part.task, &self.stop_buses, |stop| {
            can::task::run(BusIndex(part.port), interface, sending, events, frames, clock, stop)
        });
    }

    pub(super) fn spawn_modbus(&mut self, server: modbus::Plain) {
        self.tasks.spawn_part(MODBUS, &self.stop, |stop| server.run(stop));
    }

    pub(super) fn spawn_security(&mut self, server: Option<modbus::SecureServer>) {
        if let Some(server) = server {
            self.tasks.spawn_part(SECURITY, &self.stop, |stop| server.run(stop));
        }
    }

    pub(super) fn spawn_rtu(&mut self, lines: modbus::Lines) {
        self.tasks.spawn_part(RTU, &self.stop, |stop| lines.run(stop));
    }

    pub(super) fn spawn_web(&mut self, server: web::Server) {
        self.tasks.spawn_part(WEB, &self.stop, |stop| server.run(stop));
    }

    pub(super) fn spawn_cia309(&mut self, server: Option<cia309::Server>) {
        if let Some(server) = server {
            self.tasks.spawn_part(CIA309, &self.stop, |stop| server.run(stop));
        }
    }

    pub(super) fn spawn_serial(&mut self, server: serial::Server) {
        self.tasks.spawn_part(SERIAL, &self.stop, |stop| server.run(stop));
    }

    /// Tells the gateway how the session with the broker, the certificates and the clock are.
    pub(super) fn spawn_health(&mut self) {
        let session = self.installation.mqtt.is_some().then(|| self.parts.mqtt_status.subscribe());
        let (health, lives) = (self.health.clone(), self.parts.lives.subscribe());
        self.tasks.spawn_part("health", &self.stop, |stop| health::run(session, lives, health, stop));
    }

    /// Looks after the certificates.
    pub(super) fn spawn_certificates(&mut self) {
        let watched = certificates::watched(&self.installation);
        let (lives, clock) = (self.parts.lives.clone(), self.clock);
        self.tasks
            .spawn_part("certificates", &self.stop, |stop| certificates::run(watched, lives, clock, stop));
    }

    /// Goes from the installation that runs to another one. Nothing here can be refused: what can was tried before. Who has to be
    /// stopped for it is stopped, and begins again, one after the other; the others do not notice.
    pub(super) async fn apply(&mut self, new: Installation, plan: &Plan, prepared: Prepared) {
        let old_writer = self.exchange_core(&new, plan).await;
        let bank = RegisterBank::new(Arc::clone(&new.table), Arc::clone(&new.map));
        bank.go_on_from(&self.parts.bank, &plan.kept_nodes(&new));
        self.parts.bank = Arc::new(bank);
        self.installation = new;
        self.identity = Identity { map_hash: self.installation.map.hash_text(), ..self.identity.clone() };
        let shared = self.modbus_shown.get().renewed(
            &self.installation.modbus,
            Arc::clone(&self.parts.bank),
            self.reader.clone(),
            self.desk.clone(),
        );
        self.modbus_shown.set(shared);
        self.web_shown.set(self.web_state());
        self.exchange_servers(plan, prepared).await;
        self.exchange_mqtt(plan).await;
        if plan.certificates {
            self.tasks.stop_part("certificates").await;
            self.spawn_certificates();
        }
        // Whoever still read the old image has the new one.
        drop(old_writer);
    }

    fn web_state(&self) -> web::WebState {
        self.parts.web_state(&self.installation, &self.identity, &self.reader, &self.desk)
    }

    /// Buses, core and desk. Where the table stays, others may ask from now on; else from the moment on in which there is another one.
    async fn exchange_core(&mut self, new: &Installation, plan: &Plan) -> Option<ImageWriter> {
        let Some(kept) = &plan.core else {
            self.desk.set_access(Arc::clone(&new.access));
            return None;
        };
        let mut begin = Vec::new();
        let mut buses = Vec::new();
        for (place, from) in kept.buses.iter().enumerate() {
            let part = from.and_then(|from| self.buses.get(from.0)).cloned();
            buses.extend(part.or_else(|| {
                begin.push(self.new_bus(new, place)?);
                begin.last().map(|new| new.part.clone())
            }));
        }
        let (desk, requests) = self.desk.renewed(COMMANDS, Arc::clone(&new.access));
        let (done, exchanged) = oneshot::channel();
        let exchange = Exchange {
            table: Arc::clone(&new.table),
            kept: kept.clone(),
            transmit: buses.iter().map(|bus| bus.transmit.clone()).collect(),
            ports: buses.iter().map(|bus| bus.port).collect(),
            simulated: simulated(&new.interfaces),
            requests,
            done,
        };
        let before = std::mem::replace(&mut self.buses, buses);
        // The gateway's task is gone only when everything stops.
        self.orders.send(Order::Exchange(Box::new(exchange))).await.ok()?;
        let (reader, writer) = exchanged.await.ok()?;
        (self.reader, self.desk) = (reader, desk);
        self.exchange_buses(before, begin).await;
        Some(writer)
    }

    /// Ends the tasks of buses that do not stay, once they had the time to send what the gateway said last there; then starts new
    /// ones, which the gateway knows by now: what they tell first is not lost. They may have the interface of one that ends.
    async fn exchange_buses(&mut self, before: Vec<BusPart>, begin: Vec<NewBus>) {
        let stays = |bus: &BusPart| self.buses.iter().any(|each| each.port == bus.port);
        // They end when nobody can send to them any more: their queues are let go last.
        let gone: Vec<BusPart> = before.into_iter().filter(|bus| !stays(bus)).collect();
        if !gone.is_empty() {
            tokio::time::sleep(LAST_FRAMES).await;
        }
        for bus in &gone {
            self.tasks.stop_part(&bus.task).await;
        }
        for new in begin {
            self.spawn_bus(new);
        }
    }

    /// Ends all that is to begin anew, so that one can have the address of another one; then begins it.
    async fn exchange_servers(&mut self, plan: &Plan, prepared: Prepared) {
        self.lost.clear();
        for (ends, task) in [
            (plan.modbus, MODBUS),
            (plan.security, SECURITY),
            (plan.rtu, RTU),
            (plan.http, WEB),
            (plan.cia309, CIA309),
            (plan.serial, SERIAL),
        ] {
            if ends {
                self.tasks.stop_part(task).await;
            }
        }
        self.begin_modbus(plan, prepared).await;
        if plan.http {
            let (settings, state) = (self.installation.http.clone(), self.web_state());
            match again("HTTP", async || web::Server::bind(&settings, state.clone()).await).await {
                Ok(server) => {
                    info!("page {}", server.url());
                    self.web_shown = server.shown();
                    self.spawn_web(server);
                }
                Err(problem) => drop(self.lost.insert(Listener::Http, problem)),
            }
        }
        if plan.cia309 {
            let (installation, desk, clock) = (self.installation.clone(), self.desk.clone(), self.clock);
            let bound = again("CiA 309-3", async || bind_cia309(&installation, desk.clone(), clock).await);
            match bound.await {
                Ok(server) => self.spawn_cia309(server),
                Err(problem) => drop(self.lost.insert(Listener::Cia309, problem)),
            }
        }
        if plan.serial {
            let (table, desk, reader, clock) =
                (Arc::clone(&self.installation.table), self.desk.clone(), self.reader.clone(), self.clock);
            let bind = async || serial::Server::bind(&table, &desk, &reader, clock).await;
            match again("serial lines", bind).await {
                Ok(server) => self.spawn_serial(server),
                Err(problem) => drop(self.lost.insert(Listener::Serial, problem)),
            }
        }
    }

    async fn begin_modbus(&mut self, plan: &Plan, prepared: Prepared) {
        let (settings, shared) = (self.installation.modbus.clone(), self.modbus_shown.clone());
        if plan.modbus {
            // Connections with certificates go on where the limits stay; then they keep their places.
            if plan.security || settings.security.is_off() {
                self.places = Places::new(&settings.limits());
            }
            let places = &self.places;
            let bind = async || modbus::Plain::bind(&settings, places.clone(), shared.clone()).await;
            match again("Modbus", bind).await {
                Ok(server) => {
                    server.local_addrs().iter().for_each(|address| info!(%address, "Modbus TCP"));
                    self.spawn_modbus(server);
                }
                Err(problem) => drop(self.lost.insert(Listener::Modbus, problem)),
            }
        }
        if plan.security
            && let Some(keeper) = prepared.keeper
        {
            let at = (settings.limits(), self.places.clone());
            let bind = async || {
                modbus::SecureServer::bind(
                    &settings.security,
                    Arc::clone(&keeper),
                    at.clone(),
                    shared.clone(),
                )
                .await
            };
            match again("Modbus/TCP Security", bind).await {
                Ok(server) => {
                    server.local_addrs().iter().for_each(|address| info!(%address, "Modbus/TCP Security"));
                    self.spawn_security(Some(server));
                }
                Err(problem) => drop(self.lost.insert(Listener::Security, problem)),
            }
        }
        if plan.rtu {
            self.spawn_rtu(modbus::Lines::new(&settings.rtu, shared));
        }
    }
}

/// Binds what was free when the reload was checked, and was our own until a moment ago.
async fn again<T, E: std::fmt::Display>(
    what: &str,
    mut bind: impl AsyncFnMut() -> Result<T, E>,
) -> Result<T, String> {
    let mut time = 1;
    loop {
        match bind().await {
            Ok(bound) => return Ok(bound),
            Err(problem) if time == TIMES => {
                let problem = format!(
                    "{what} is not served any more: {problem}; mend it and load the configuration again"
                );
                error!("{problem}");
                return Err(problem);
            }
            Err(_) => tokio::time::sleep(AGAIN).await,
        }
        time += 1;
    }
}

/// Nothing real can be on a bus inside this process.
pub(super) fn simulated(interfaces: &[Interface]) -> Vec<BusIndex> {
    let places = interfaces.iter().enumerate();
    places
        .filter(|(_, interface)| matches!(interface, Interface::Virtual(_)))
        .map(|(place, _)| BusIndex(place))
        .collect()
}
