//! The sessions with the broker, each a task; and how each goes on with another configuration. \[IO\]

use std::sync::Arc;

use tokio::sync::{mpsc, oneshot};
use tracing::error;

use super::plan::{Change, Plan};
use super::running::Running;
use crate::gateway::order::Order;
use crate::mqtt::back_off::Pace;
use crate::mqtt::client::STOP_LIMIT;
use crate::mqtt::sparkplug::{self, EdgeNode};
use crate::mqtt::store_link::Opened;
use crate::mqtt::{self, MqttSettings, MqttStatus, Publisher, StoreLink};

/// What goes on with another configuration waits for its task here; a reload waits where it is full.
const EXCHANGES: usize = 4;

/// The ways to the sessions that run.
#[derive(Debug, Default)]
pub(super) struct MqttLinks {
    mqtt: Option<mpsc::Sender<mqtt::client::Exchange>>,
    sparkplug: Option<mpsc::Sender<sparkplug::task::Exchange>>,
    /// Number of the last event that a session took; what comes after it is for the next one.
    told: u64,
}

impl Running {
    /// Begins the session with the broker, where there is one, with what outlives the process of what is for it, and with the events
    /// that no session before it took.
    pub(super) fn spawn_mqtt(&mut self, store: Option<Opened>) {
        let Some(settings) = self.installation.mqtt.clone() else { return };
        let table = Arc::clone(&self.installation.table);
        let name = table.gateway.clone();
        let mut publisher = Publisher::new(table, &settings, self.identity.clone());
        self.mqtt.told = self.mqtt.told.max(store.as_ref().map_or(0, |opened| opened.newest_event));
        publisher.begin_after(self.mqtt.told);
        let store = store.map(|Opened { link, done, newest_event }| {
            publisher.take_store(&settings, &done, newest_event);
            link
        });
        let (reader, desk, status) = (self.reader.clone(), self.desk.clone(), self.parts.mqtt_status.clone());
        let (clock, pace, (link, exchanges)) = (self.clock, Pace::of(&settings), mpsc::channel(EXCHANGES));
        self.mqtt.mqtt = Some(link);
        self.tasks.spawn_part("mqtt", &self.stop, |stop| async move {
            let session = mqtt::client::run(
                settings, &name, publisher, reader, desk, clock, stop, status, store, exchanges, pace,
            );
            Box::pin(session).await;
        });
    }

    /// Begins the session of Sparkplug, where it is asked for.
    pub(super) fn spawn_sparkplug(&mut self) {
        let Some(settings) = self.installation.mqtt.clone().filter(|mqtt| mqtt.sparkplug.enabled) else {
            return;
        };
        let name = self.installation.table.gateway.clone();
        let node = self.edge_node(&settings);
        let (reader, desk) = (self.reader.clone(), self.desk.clone());
        let (clock, pace) = (self.clock, Pace::of(&settings));
        let (status, (link, exchanges)) = (self.parts.sparkplug_status.clone(), mpsc::channel(EXCHANGES));
        self.mqtt.sparkplug = Some(link);
        self.tasks.spawn_part("sparkplug", &self.stop, |stop| async move {
            let session = sparkplug::task::run(
                settings, &name, node, reader, desk, clock, stop, status, exchanges, pace,
            );
            Box::pin(session).await;
        });
    }

    fn edge_node(&self, settings: &MqttSettings) -> EdgeNode {
        EdgeNode::new(Arc::clone(&self.installation.table), &settings.sparkplug, &self.identity)
    }

    /// Has the sessions go on with the configuration that runs now, or ends them, or begins them.
    pub(super) async fn exchange_mqtt(&mut self, plan: &Plan) {
        match (plan.mqtt, self.installation.mqtt.clone()) {
            (Change::None, _) | (Change::Exchange, None) => {}
            (Change::Exchange, Some(settings)) => {
                let exchange = mqtt::client::Exchange {
                    settings,
                    table: Arc::clone(&self.installation.table),
                    identity: self.identity.clone(),
                    reader: self.reader.clone(),
                    desk: self.desk.clone(),
                    lines: plan.kept_lines(&self.installation),
                };
                send(self.mqtt.mqtt.as_ref(), exchange).await;
            }
            (Change::Anew, settings) => self.begin_mqtt_anew(settings.as_ref()).await,
        }
        match (plan.sparkplug, self.installation.mqtt.clone()) {
            (Change::Exchange, Some(settings)) => {
                let exchange = sparkplug::task::Exchange {
                    gateway: self.installation.table.gateway.clone(),
                    node: self.edge_node(&settings),
                    reader: self.reader.clone(),
                    desk: self.desk.clone(),
                    nodes: plan.kept_nodes(&self.installation),
                    settings,
                };
                send(self.mqtt.sparkplug.as_ref(), exchange).await;
            }
            (Change::None | Change::Exchange, _) => {}
            (Change::Anew, _) => {
                self.tasks.stop_part("sparkplug").await;
                self.mqtt.sparkplug = None;
                self.spawn_sparkplug();
            }
        }
    }

    /// Ends the session with the broker in good order, and what it keeps on disk with it; begins another one, where there is to be
    /// one, behind what that disk holds.
    async fn begin_mqtt_anew(&mut self, settings: Option<&MqttSettings>) {
        // A disk that does not answer keeps the folder's lock until it does; until then the next store has memory alone.
        self.tasks.stop_part_within("mqtt", STOP_LIMIT).await;
        self.tasks.stop_part("health").await;
        self.mqtt.mqtt = None;
        self.mqtt.told = self.mqtt.told.max(self.parts.mqtt_status.borrow().events_taken);
        let Some(settings) = settings else {
            self.parts.mqtt_status.send_replace(MqttStatus::default());
            self.health.send_modify(|health| {
                health.mqtt_connected = None;
                (health.mqtt_trouble, health.buffer_filling, health.buffer_fault) = (None, false, false);
            });
            return self.spawn_health();
        };
        let store = StoreLink::open(settings, &self.installation.table.gateway, self.clock).await;
        if let Some(opened) = &store {
            // The stream on disk is gone on with, whatever the journal counts; what nobody was told yet comes behind it.
            let (told, newest) = (self.mqtt.told, opened.newest_event);
            let (done, numbered) = oneshot::channel();
            let sent = self.orders.send(Order::NumberAfter { told, newest, done }).await;
            if sent.is_err() || numbered.await.is_err() {
                // The gateway's task is gone only when everything stops.
                return;
            }
        }
        // States are counted anew: by another name, so that no number stands for two of them.
        self.identity.sid = uuid::Uuid::new_v4().to_string();
        self.spawn_health();
        self.spawn_mqtt(store);
    }
}

async fn send<T>(link: Option<&mpsc::Sender<T>>, exchange: T) {
    if let Some(link) = link
        && link.send(exchange).await.is_err()
    {
        error!("a session with the broker has ended: this is a bug in cangate");
    }
}
