//! The session of the edge node against brokers in numbers.

use std::collections::VecDeque;
use std::sync::Arc;

use super::*;
use crate::mapping::TagTable;
use crate::mqtt::Identity;
use crate::mqtt::outbox::Outgoing;
use crate::mqtt::sparkplug::SparkplugSettings;
use crate::mqtt::uplink::{Incoming, ReplyTo};
use crate::process_image::{ProcessImage, process_image};

/// A broker with a retained command that is too large, which comes after each subscription of commands. The primary host
/// is online.
struct LargeCommand {
    connected: bool,
    too_large: bool,
    happenings: VecDeque<Happening>,
}

impl Uplink for LargeCommand {
    async fn open(_: &SessionSettings) -> Result<Self, SessionError> {
        Ok(Self { connected: false, too_large: false, happenings: VecDeque::new() })
    }

    async fn next(&mut self) -> Happening {
        if !std::mem::replace(&mut self.connected, true) {
            return Happening::Connected;
        }
        if self.too_large {
            return Happening::Closed(SessionError::TooLarge);
        }
        match self.happenings.pop_front() {
            Some(happening) => happening,
            None => std::future::pending().await,
        }
    }

    fn send(&mut self, _: &Outgoing, _: Instant) -> bool {
        true
    }

    fn subscribe(&mut self, topics: &[String]) {
        self.too_large |= topics.iter().any(|topic| topic.contains("/NCMD/"));
        for topic in topics.iter().filter(|topic| topic.contains("/STATE/")) {
            let payload = br#"{"online":true,"timestamp":1763760000000}"#.to_vec();
            let state =
                Incoming { topic: topic.clone(), payload, retain: true, reply_to: ReplyTo::default() };
            self.happenings.push_back(Happening::Message(state));
        }
    }

    async fn disconnect(self) {}
}

impl Link for LargeCommand {
    fn publish(&mut self, packet: Packet) -> bool {
        self.happenings.push_back(Happening::Acknowledged(packet.id));
        true
    }
}

#[tokio::test(start_paused = true)]
async fn a_command_that_is_too_large_does_not_hide_the_primary_host() {
    let sparkplug = SparkplugSettings {
        enabled: true,
        primary_host: Some("scada".to_owned()),
        ..SparkplugSettings::default()
    };
    let settings = MqttSettings { sparkplug, ..MqttSettings::default() };
    let node = EdgeNode::new(Arc::new(TagTable::default()), &settings.sparkplug, &Identity::default());
    let (_writer, reader) = process_image(ProcessImage::new(0, 0, 0, 0));
    let (sender, status) = watch::channel(SparkplugStatus::default());
    let stop = CancellationToken::new();
    let (clock, stopping, pace) = (Clock::start(), stop.clone(), Pace::default());
    let (desk, _requests) = Desk::new(1);
    let task = Task::new(settings, "hall-1", node, reader, desk, clock, stopping, sender, pace);
    let running = tokio::spawn(task.run::<LargeCommand>());
    tokio::time::sleep(Duration::from_secs(60)).await;
    let seen = status.borrow().clone();
    assert_eq!((seen.connected, seen.live, seen.failures), (true, true, 1), "{seen:?}");
    stop.cancel();
    running.await.unwrap();
}
