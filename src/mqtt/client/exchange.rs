//! The task goes on with what a reload brings \[IO\]: in the session that it has, where that is to be the same.

use std::sync::Arc;

use tokio::sync::watch;
use tokio_util::sync::CancellationToken;

use super::super::back_off::Pace;
use super::super::commands::Commands;
use super::super::payload::Identity;
use super::super::publisher::Publisher;
use super::super::requests::{Requests, VerbTopics};
use super::super::settings::MqttSettings;
use super::super::store_link::StoreLink;
use super::super::uplink::{SessionSettings, Uplink};
use super::stopping::{Flushed, OFFLINE_TIMEOUT};
use super::{ImageWatch, MqttStatus, Phase, Task};
use crate::gateway::command::Desk;
use crate::mapping::TagTable;
use crate::process_image::{ImageReader, LineIndex};
use crate::time::Clock;

/// What a task goes on with.
#[derive(Debug)]
pub struct Exchange {
    /// What the configuration says.
    pub settings: MqttSettings,
    /// What there is.
    pub table: Arc<TagTable>,
    /// Who tells of it.
    pub identity: Identity,
    /// How it is.
    pub reader: ImageReader,
    /// Where commands go.
    pub desk: Desk,
    /// For each line of the table its place in the one before, where it is the same one.
    pub lines: Vec<Option<LineIndex>>,
}

/// How to open a session, and the topics of requests that are read in it.
fn session(
    settings: &MqttSettings,
    gateway: &str,
    publisher: &Publisher,
    desk: &Desk,
) -> (SessionSettings, Vec<VerbTopics>) {
    let mut session = SessionSettings::new(settings, gateway, publisher.last_will());
    let lines = publisher.command_topics();
    session.subscriptions = lines.iter().map(|(topic, _)| topic.to_string()).collect();
    session.subscriptions.extend(publisher.subscriptions());
    let requests = desk.access().of_broker().map(|_| publisher.request_topics()).unwrap_or_default();
    session.subscriptions.extend(requests.iter().map(|topics| topics.request.to_string()));
    (session, requests)
}

impl Task {
    #[expect(clippy::too_many_arguments, reason = "as for `run`")]
    pub(super) fn begin(
        settings: MqttSettings,
        gateway: &str,
        publisher: Publisher,
        reader: ImageReader,
        desk: Desk,
        clock: Clock,
        stop: CancellationToken,
        status: watch::Sender<MqttStatus>,
        store: Option<StoreLink>,
        pace: Pace,
    ) -> Self {
        let (session, requests) = session(&settings, gateway, &publisher, &desk);
        status.send_modify(|status| status.broker = session.url.to_string());
        let requests = Requests::new(requests, Arc::clone(publisher.table()), desk.clone(), clock);
        let commands = Commands::new(publisher.command_topics(), requests, desk);
        Self::new(settings, session, publisher, reader, commands, clock, stop, status, store, pace)
    }

    /// Goes on with what a reload brings.
    pub(super) async fn exchange<U: Uplink>(&mut self, phase: Phase<U>, exchange: Exchange) -> Phase<U> {
        let Exchange { settings, table, identity, reader, desk, lines } = exchange;
        self.read_to_the_end();
        let gateway = table.gateway.clone();
        let is_same =
            has_same_session(&self.settings, &settings) && self.publisher.table().gateway == gateway;
        let mut phase = if is_same { phase } else { self.leave(phase).await };
        self.publisher.exchange(&settings, Arc::clone(&table), identity, &lines);
        let (mut next, requests) = session(&settings, &gateway, &self.publisher, &desk);
        if is_same {
            // The certificates that it watches, and the one that it holds.
            next.tls = self.session.tls.take();
            let before = &self.session.subscriptions;
            let new = next.subscriptions.iter().filter(|topic| !before.contains(topic));
            let new: Vec<String> = new.cloned().collect();
            if let Phase::Session { uplink, began: Some(_), .. } = &mut phase
                && self.attempts.subscription.is_made()
            {
                // What is not read any more is let go with the session: nobody looks at it.
                uplink.subscribe(&new);
            }
        }
        self.commands.exchange(self.publisher.command_topics(), requests, table, desk);
        if settings.reconnect_max_s != self.settings.reconnect_max_s {
            self.attempts.set_pace(Pace::of(&settings));
        }
        if settings.keep_alive_s != self.settings.keep_alive_s {
            self.silence = Pace::default().silence.max(next.keep_alive * 3 / 2);
        }
        self.status.send_modify(|status| status.broker = next.url.to_string());
        (self.settings, self.session, self.reader) = (settings, next, reader);
        self.image = ImageWatch::new();
        phase
    }

    /// Takes what the image before still has to tell, as far as there is room for it; its journal goes on in the next one.
    fn read_to_the_end(&mut self) {
        self.image.demand();
        while (self.image.has_changed() || self.publisher.has_more()) && !self.publisher.waits_for_store() {
            self.image.allow();
            self.read_image();
        }
    }

    /// Ends the session in good order, for another one that begins at once. What waits for the broker stays.
    async fn leave<U: Uplink>(&mut self, phase: Phase<U>) -> Phase<U> {
        if let Phase::Session { mut uplink, began: Some(_), .. } = phase {
            self.publisher.handle_pause();
            if self.flush(&mut uplink, OFFLINE_TIMEOUT, Publisher::has_said_farewell).await == Flushed::Done {
                uplink.disconnect().await;
            }
            tracing::info!(broker = %self.session.url, "MQTT session ends, as the configuration asks for another one");
        }
        self.publisher.handle_session_down();
        self.publisher.handle_pause_end();
        self.attempts.handle_new_session();
        self.drops = 0;
        Phase::Waiting { until: self.clock.now().instant }
    }
}

/// Whether both ask for the same session, so that it can go on.
#[must_use]
pub fn has_same_session(old: &MqttSettings, new: &MqttSettings) -> bool {
    let same = MqttSettings {
        url: old.url.clone(),
        version: old.version,
        base_topic: old.base_topic.clone(),
        client_id: old.client_id.clone(),
        username: old.username.clone(),
        password_file: old.password_file.clone(),
        keep_alive_s: old.keep_alive_s,
        inflight: old.inflight,
        tls: old.tls.clone(),
        ..new.clone()
    };
    same == *new
}
