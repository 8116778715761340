//! The client against brokers in numbers.

use std::collections::VecDeque;

use super::super::outbox::{MessageId, Outgoing};
use super::super::payload::Identity;
use super::*;
use crate::mapping::TagTable;
use crate::process_image::{Event, EventKind, ImageWriter, ProcessImage, process_image};

/// How long the broker below takes for an acknowledgement.
const SLOW: Duration = Duration::from_secs(2);

/// A broker that takes every session and acknowledges everything, slowly.
struct SlowBroker {
    clock: Clock,
    connected: bool,
    sent: VecDeque<(Instant, MessageId)>,
}

impl Uplink for SlowBroker {
    async fn open(_: &SessionSettings) -> Result<Self, SessionError> {
        Ok(Self { clock: Clock::start(), connected: false, sent: VecDeque::new() })
    }

    async fn next(&mut self) -> Happening {
        if !self.connected {
            self.connected = true;
            return Happening::Connected;
        }
        let Some((due, id)) = self.sent.front().copied() else { std::future::pending().await };
        tokio::time::sleep_until(self.clock.deadline(due)).await;
        self.sent.pop_front();
        Happening::Acknowledged(id)
    }

    fn send(&mut self, outgoing: &Outgoing, _: Instant) -> bool {
        self.sent.push_back((self.clock.now().instant + SLOW, outgoing.id));
        true
    }

    fn subscribe(&mut self, _: &[String]) {}

    async fn disconnect(self) {}
}

/// A broker with a retained command that is too large: it comes after each subscription.
struct LargeCommand {
    subscribed: bool,
    connected: bool,
    sent: VecDeque<MessageId>,
}

impl Uplink for LargeCommand {
    async fn open(_: &SessionSettings) -> Result<Self, SessionError> {
        Ok(Self { subscribed: false, connected: false, sent: VecDeque::new() })
    }

    async fn next(&mut self) -> Happening {
        if !std::mem::replace(&mut self.connected, true) {
            return Happening::Connected;
        }
        if self.subscribed {
            return Happening::Closed(SessionError::TooLarge);
        }
        let Some(id) = self.sent.pop_front() else { std::future::pending().await };
        Happening::Acknowledged(id)
    }

    fn send(&mut self, outgoing: &Outgoing, _: Instant) -> bool {
        self.sent.push_back(outgoing.id);
        true
    }

    fn subscribe(&mut self, _: &[String]) {
        self.subscribed = true;
    }

    async fn disconnect(self) {}
}

fn task(keep_alive_s: u16) -> (Task, ImageWriter, watch::Receiver<MqttStatus>, CancellationToken) {
    let settings = MqttSettings { keep_alive_s, ..MqttSettings::default() };
    let publisher = Publisher::new(Arc::new(TagTable::default()), &settings, Identity::default());
    let (writer, reader) = process_image(ProcessImage::new(0, 0, 0, 0));
    let (sender, status) = watch::channel(MqttStatus::default());
    let stop = CancellationToken::new();
    let (desk, clock) = (Desk::new(1).0, Clock::start());
    let (stopping, pace) = (stop.clone(), Pace::default());
    let task = Task::begin(settings, "hall-1", publisher, reader, desk, clock, stopping, sender, None, pace);
    (task, writer, status, stop)
}

#[tokio::test(start_paused = true)]
async fn a_time_in_which_nothing_was_to_be_said_is_no_silence_of_the_broker() {
    // Health goes out every 30 s; a broker is silent after 10 s.
    let (task, _writer, status, stop) = task(5);
    let running = tokio::spawn(task.run::<SlowBroker>());
    tokio::time::sleep(Duration::from_secs(200)).await;
    let seen = status.borrow().clone();
    assert_eq!((seen.sessions, seen.failures), (1, 0), "{}", seen.last_error);
    assert!(seen.outbox.acknowledged >= 12, "{:?}", seen.outbox);
    stop.cancel();
    running.await.unwrap();
}

#[tokio::test(start_paused = true)]
async fn a_command_that_is_too_large_ends_a_session_every_ten_minutes_and_not_each() {
    let (task, _writer, status, stop) = task(5);
    let running = tokio::spawn(task.run::<LargeCommand>());
    tokio::time::sleep(Duration::from_secs(25 * 60)).await;
    let seen = status.borrow().clone();
    assert_eq!((seen.sessions, seen.failures, seen.connected), (4, 3, true), "{}", seen.last_error);
    assert!(seen.last_error.contains("empty retained message"), "{}", seen.last_error);
    stop.cancel();
    running.await.unwrap();
}

#[tokio::test(start_paused = true)]
async fn events_that_a_disk_did_not_take_before_a_stop_are_counted() {
    let folder = tempfile::tempdir().unwrap();
    // Who opens a pipe waits until somebody reads from it.
    let lock = folder.path().join("lock");
    nix::unistd::mkfifo(&lock, nix::sys::stat::Mode::S_IRWXU).unwrap();
    let settings = MqttSettings { buffer_dir: Some(folder.path().to_owned()), ..MqttSettings::default() };
    let (opened, ()) = tokio::join!(StoreLink::open(&settings, "hall-1", Clock::start()), async {
        tokio::task::yield_now().await;
        tokio::time::advance(Duration::from_secs(3)).await;
    });
    let opened = opened.unwrap();
    let (mut task, mut writer, status, stop) = task(5);
    task.publisher.take_store(&settings, &opened.done, opened.newest_event);
    task.store = Some(opened.link);
    let event = |seq| Event {
        seq,
        ts: crate::time::Timestamp::default(),
        kind: EventKind::Gateway,
        node: None,
        bus: None,
        name: "something".to_owned(),
        from: String::new(),
        to: String::new(),
        alarm: None,
        priority: None,
        value: None,
        text: String::new(),
    };
    let happen = |writer: &mut ImageWriter, numbers: std::ops::RangeInclusive<u64>| {
        writer.apply(|image| numbers.for_each(|seq| image.journal.append(event(seq))));
    };
    happen(&mut writer, 1..=1000);
    let running = tokio::spawn(task.run::<SlowBroker>());
    for _ in 0..100 {
        tokio::time::advance(Duration::from_millis(10)).await;
        tokio::task::yield_now().await;
    }
    // The store waits for the disk with what fits, and the journal with the rest.
    happen(&mut writer, 1001..=1500);
    stop.cancel();
    let clock = Clock::start();
    while !running.is_finished() {
        tokio::time::advance(Duration::from_millis(100)).await;
        tokio::task::yield_now().await;
    }
    running.await.unwrap();
    let took = clock.now().instant;
    assert!(took <= Instant::START + STOP_LIMIT, "{took:?}");
    // Else the test would wait for the thread that opens the disk.
    let _answers = std::fs::File::open(lock).unwrap();
    assert_eq!(status.borrow().outbox.events_missed, 1500);
}
