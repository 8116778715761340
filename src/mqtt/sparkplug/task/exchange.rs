//! The task goes on with what a reload brings \[IO\]: in the session that it has, where that is to be the same.

use std::collections::BTreeSet;

use tokio::sync::{mpsc, watch};
use tokio_util::sync::CancellationToken;

use super::super::commands::Commands;
use super::super::edge::EdgeNode;
use super::{Link, Phase, SparkplugStatus, Task};
use crate::gateway::command::Desk;
use crate::mqtt::MqttSettings;
use crate::mqtt::attempts::Attempts;
use crate::mqtt::back_off::Pace;
use crate::mqtt::client::has_same_session;
use crate::mqtt::image_watch::ImageWatch;
use crate::mqtt::uplink::SessionSettings;
use crate::process_image::{ImageReader, NodeIndex};
use crate::time::Clock;

/// What a task goes on with.
#[derive(Debug)]
pub struct Exchange {
    /// What the configuration says.
    pub settings: MqttSettings,
    /// Name of the gateway.
    pub gateway: String,
    /// What there is.
    pub node: EdgeNode,
    /// How it is.
    pub reader: ImageReader,
    /// Where commands are handed in.
    pub desk: Desk,
    /// For each node its place in the table before, where it goes on as it is.
    pub nodes: Vec<Option<NodeIndex>>,
}

fn session(settings: &MqttSettings, gateway: &str, node: &EdgeNode) -> SessionSettings {
    let mut session = SessionSettings::new(settings, gateway, ("", ""));
    session.client_id = settings.sparkplug.client_id_beside(&session.client_id);
    session.subscriptions = node.command_subscriptions();
    session
}

impl Task {
    #[expect(clippy::too_many_arguments, reason = "as for `run`")]
    pub(super) fn new(
        settings: MqttSettings,
        gateway: &str,
        node: EdgeNode,
        reader: ImageReader,
        desk: Desk,
        clock: Clock,
        stop: CancellationToken,
        status: watch::Sender<SparkplugStatus>,
        pace: Pace,
    ) -> Self {
        let session = session(&settings, gateway, &node);
        Self {
            window: usize::from(session.inflight),
            settings,
            session,
            node,
            commands: Commands::new(desk),
            reader,
            clock,
            stop,
            status,
            exchanges: mpsc::channel(1).1,
            attempts: Attempts::new(pace),
            asked_for_host: false,
            told_not_taken: false,
            outstanding: BTreeSet::new(),
            image: ImageWatch::new(),
        }
    }

    /// Goes on with what a reload brings.
    pub(super) async fn exchange<U: Link>(&mut self, phase: Phase<U>, exchange: Exchange) -> Phase<U> {
        let Exchange { settings, gateway, node, reader, desk, nodes } = exchange;
        let mut next = session(&settings, &gateway, &node);
        // The last will has the name of the edge node, and so have the topics of its commands.
        let is_same = has_same_session(&self.settings, &settings)
            && next.client_id == self.session.client_id
            && next.subscriptions == self.session.subscriptions
            && node.host_subscription() == self.node.host_subscription();
        let phase = if is_same {
            next.tls = self.session.tls.take();
            next.last_will = self.session.last_will.clone();
            phase
        } else {
            self.say_farewell(phase).await;
            self.node.handle_session_down();
            self.outstanding.clear();
            self.attempts.handle_new_session();
            self.asked_for_host = false;
            Phase::Waiting { until: self.clock.now().instant }
        };
        self.node.exchange(self.clock.now(), node, &nodes);
        self.commands.set_desk(desk);
        if settings.reconnect_max_s != self.settings.reconnect_max_s {
            self.attempts.set_pace(Pace::of(&settings));
        }
        self.window = usize::from(next.inflight);
        (self.settings, self.session, self.reader) = (settings, next, reader);
        self.image = ImageWatch::new();
        phase
    }
}
