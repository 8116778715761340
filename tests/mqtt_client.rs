//! The MQTT client against good, slow and hostile brokers.

use std::net::SocketAddr;
use std::process::{Child, Command, Stdio};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use cangate::mqtt::MqttVersion;
use cangate::mqtt::broker::EmbeddedBroker;
use cangate::process_image::Value;
use proptest::prelude::*;
use tokio::io::{AsyncWriteExt, BufReader};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::watch;
use tokio::task::JoinHandle;

use crate::support::fake_broker::{Control, FakeBroker, Received, Script, read_packet, read_publish};
use crate::support::mqtt_client::{Client, WINDOW, assert_delivered, seq, until};
use crate::support::plant;
use crate::support::ports::free_address;

/// Runs a test with each version of MQTT.
async fn both(test: impl AsyncFn(MqttVersion)) {
    for version in [MqttVersion::V3_1_1, MqttVersion::V5] {
        test(version).await;
    }
}

#[tokio::test]
async fn a_session_has_the_last_will_and_the_client_id_and_begins_with_the_birth() {
    both(async |version| {
        let broker = FakeBroker::start(vec![Script::Good]).await;
        let mut client = Client::speaking(version, broker.address);
        client.until(|status| status.connected).await;
        until("online", || !broker.payloads("bridge/state").is_empty()).await;
        let connect = broker.seen(|seen| match &seen.control[0].1 {
            Control::Connect(body) => String::from_utf8_lossy(body).into_owned(),
            Control::Disconnect => panic!("CONNECT comes first"),
        });
        for part in ["cangate-hall-1", "cangate/hall-1/bridge/state", r#"{"state":"offline"}"#] {
            assert!(connect.contains(part), "{part} in {connect:?}");
        }
        broker.seen(|seen| {
            let last = seen.messages.last().unwrap();
            assert_eq!(
                (last.topic.as_str(), last.retain, last.qos),
                ("cangate/hall-1/bridge/state", true, 1)
            );
            assert_eq!(last.payload, r#"{"state":"online"}"#);
            assert!(seen.messages.iter().all(|message| message.retain && message.qos == 1));
        });
        client.stop().await;
    })
    .await;
}

#[tokio::test]
async fn a_stop_publishes_offline_and_disconnects() {
    both(async |version| {
        let broker = FakeBroker::start(vec![Script::Good]).await;
        let mut client = Client::speaking(version, broker.address);
        client.until(|status| status.connected).await;
        client.happen(3);
        client.stop().await;
        assert_delivered(&broker.payloads("/event"), 3);
        assert_eq!(broker.payloads("bridge/state").last().unwrap().1, r#"{"state":"offline"}"#);
        until("DISCONNECT", || broker.seen(|seen| seen.control.last() == Some(&(0, Control::Disconnect))))
            .await;
    })
    .await;
}

#[tokio::test]
async fn a_stop_does_not_wait_for_a_broker_that_is_not_there() {
    let client = Client::start("127.0.0.1:1".parse().unwrap());
    client.stop().await;
}

#[tokio::test]
async fn qos_0_is_for_states_only() {
    both(async |version| {
        let broker = FakeBroker::start(vec![Script::Good]).await;
        let mut client = Client::speaking_with(version, broker.address, |settings| {
            settings.qos_state = 0.try_into().unwrap();
        });
        client.until(|status| status.connected).await;
        until("online", || !broker.payloads("bridge/state").is_empty()).await;
        broker.seen(|seen| {
            for message in &seen.messages {
                let expected =
                    u8::from(!message.topic.ends_with("e1/state") && !message.topic.ends_with("e2/state"));
                assert_eq!(message.qos, expected, "{}", message.topic);
            }
        });
        client.until(|status| status.outbox.messages == 0).await;
        client.stop().await;
    })
    .await;
}

#[tokio::test]
async fn p7_a_broker_that_is_absent_at_the_start_is_found_when_it_comes() {
    let address = free_address();
    let mut client = Client::start(address);
    client.happen(5);
    client.until(|status| status.failures >= 3).await;
    let broker = EmbeddedBroker::start(address).await.unwrap();
    client.until(|status| status.connected && status.outbox.messages == 0).await;
    client.stop().await;
    broker.shutdown().await;
}

#[tokio::test]
async fn f50_a_broker_that_drops_the_session_twenty_times_under_load_loses_no_event() {
    both(async |version| {
        let mut random = fastrand::Rng::with_seed(11);
        let mut scripts: Vec<_> = (0..20).map(|_| Script::CloseAfter(random.usize(1..60))).collect();
        scripts.push(Script::Good);
        let broker = FakeBroker::start(scripts).await;
        let mut client = Client::speaking(version, broker.address);
        let mut last = 0;
        while broker.seen(|seen| seen.connections) <= 20 {
            last += 10;
            client.happen(last);
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
        client.until(|status| status.connected && status.sessions == 21 && status.outbox.messages == 0).await;
        client.stop().await;
        assert_delivered(&broker.payloads("/event"), last);
    })
    .await;
}

#[tokio::test]
async fn acknowledgements_out_of_order_stop_nothing() {
    both(async |version| {
        let broker = FakeBroker::start(vec![Script::OutOfOrder(7), Script::Good]).await;
        let mut client = Client::speaking(version, broker.address);
        client.until(|status| status.connected).await;
        client.happen(500);
        until("500 events", || broker.payloads("/event").len() >= 500).await;
        let events = broker.payloads("/event");
        assert!(events.iter().all(|(connection, _)| *connection == 0));
        assert_delivered(&events, 500);
    })
    .await;
}

#[tokio::test]
async fn at_a_stop_a_broker_that_does_not_acknowledge_offline_is_left_to_its_last_will() {
    both(async |version| {
        let broker = FakeBroker::start(vec![Script::NeverAcknowledge]).await;
        let mut client = Client::speaking(version, broker.address);
        client.until(|status| status.connected && status.outbox.sent > 0).await;
        client.stop().await;
        until("the end of the connection", || broker.seen(|seen| seen.closed == 1)).await;
        broker.seen(|seen| {
            assert!(!seen.control.contains(&(0, Control::Disconnect)), "it would discard the last will");
        });
    })
    .await;
}

#[tokio::test]
async fn f53_a_broker_that_never_acknowledges_is_left_with_no_more_than_a_window_in_flight() {
    both(async |version| {
        let broker = FakeBroker::start(vec![Script::NeverAcknowledge, Script::Good]).await;
        let mut client = Client::speaking_with(version, broker.address, |settings| settings.keep_alive_s = 1);
        client.happen(100);
        let status = client.until(|status| status.failures == 1).await;
        assert_eq!(broker.seen(|seen| seen.messages.len()), WINDOW);
        assert!(
            status.last_error.starts_with("the broker acknowledged nothing for "),
            "{}",
            status.last_error
        );
        client.until(|status| status.connected && status.outbox.messages == 0).await;
        client.stop().await;
        assert_delivered(&broker.payloads("/event"), 100);
    })
    .await;
}

#[tokio::test]
async fn f54_wrong_acknowledgements_end_the_session_and_are_counted() {
    both(async |version| {
        let broker = FakeBroker::start(vec![Script::WrongAcknowledge, Script::Good]).await;
        let mut client = Client::speaking(version, broker.address);
        client.happen(10);
        client.until(|status| status.failures >= 1).await;
        client.until(|status| status.connected && status.outbox.messages == 0).await;
        client.stop().await;
        assert_delivered(&broker.payloads("/event"), 10);
    })
    .await;
}

#[tokio::test]
async fn f55_a_refusal_says_what_to_mend() {
    for (code, text) in
        [(4, "wrong user name or password"), (5, "not authorised"), (2, "client id"), (1, "3.1.1")]
    {
        let broker = FakeBroker::start(vec![Script::Refuse(code), Script::Good]).await;
        let mut client = Client::start(broker.address);
        let status = client.until(|status| status.failures == 1).await;
        assert!(status.last_error.contains(text), "{code}: {}", status.last_error);
        client.until(|status| status.connected).await;
        client.stop().await;
    }
}

#[tokio::test]
async fn f56_sessions_that_are_taken_over_again_and_again_name_the_likely_cause() {
    let broker = FakeBroker::start(vec![Script::CloseAfter(1)]).await;
    let mut client = Client::start(broker.address);
    let status = client.until(|status| status.failures == 4).await;
    assert!(
        status.last_error.contains("another client using the id `cangate-hall-1`"),
        "{}",
        status.last_error
    );
    client.stop().await;
}

#[tokio::test]
async fn no_connack_ends_the_attempt_after_five_seconds() {
    both(async |version| {
        let broker = FakeBroker::start(vec![Script::Silent, Script::Good]).await;
        let mut client = Client::speaking(version, broker.address);
        let status = client.until(|status| status.failures == 1).await;
        assert_eq!(status.last_error, "no answer within 5 s");
        assert_eq!(status.sessions, 0);
        client.until(|status| status.connected).await;
        client.stop().await;
    })
    .await;
}

#[tokio::test]
async fn f61_whatever_a_hostile_broker_sends_the_next_session_is_good() {
    both(async |version| {
        let mut random = fastrand::Rng::with_seed(5);
        let mut hostile: Vec<Vec<u8>> =
            (0..40).map(|_| (0..random.usize(1..200)).map(|_| random.u8(..)).collect()).collect();
        // Packets that are well formed and make no sense here, and one that promises 256 MiB.
        hostile.extend([
            vec![0x20, 2, 0, 0],
            vec![0x90, 3, 0, 1, 0],
            vec![0x50, 2, 0, 1],
            vec![0x62, 2, 0, 1],
            vec![0x10, 0],
            vec![0x30, 0xFF, 0xFF, 0xFF, 0x7F],
            vec![0x32, 7, 0, 1, b'a', 0, 0, b'x', b'y'],
            vec![0xD0, 0, 0xD0, 0],
            vec![0xE0, 0],
        ]);
        let mut clients = tokio::task::JoinSet::new();
        for (round, bytes) in hostile.into_iter().enumerate() {
            clients.spawn(async move {
                let scripts = vec![Script::Garbage { after_connack: round % 2 == 0, bytes }, Script::Good];
                let broker = FakeBroker::start(scripts).await;
                let mut client =
                    Client::speaking_with(version, broker.address, |settings| settings.keep_alive_s = 1);
                client.happen(50);
                client.until(|status| status.connected && status.failures == 1).await;
                client.until(|status| status.outbox.messages == 0).await;
                client.stop().await;
                let seqs: Vec<_> =
                    broker.payloads("/event").iter().map(|(_, payload)| seq(payload)).collect();
                assert_eq!(seqs.last(), Some(&50));
            });
        }
        clients.join_all().await;
    })
    .await;
}

#[tokio::test]
async fn f49_what_does_not_fit_is_dropped_oldest_first_and_counted_exactly() {
    let mut client =
        Client::start_with("127.0.0.1:1".parse().unwrap(), |settings| settings.outbox_messages = 100);
    for last in (100..=1000).step_by(100) {
        client.happen(last);
        client.until(|status| status.outbox.events.0 == last).await;
    }
    let outbox = client.until(|status| status.outbox.events.0 == 1000).await.outbox;
    assert_eq!(outbox.messages, 100);
    assert_eq!(outbox.events_dropped, 900);
    assert_eq!(outbox.dropped(), [("sample", 0), ("status", 0), ("alarm", 0), ("event", 900)]);
    client.stop().await;
}

#[tokio::test]
async fn a_slow_broker_gets_the_newest_state_and_every_event() {
    both(async |version| {
        let broker = FakeBroker::start(vec![Script::OutOfOrder(5)]).await;
        let mut client = Client::speaking(version, broker.address);
        client.until(|status| status.connected).await;
        for round in 1..=200u32 {
            client.change(|image| image.tags[0] = plant::good(Value::Float(f64::from(round % 100))));
            client.happen(u64::from(round) * 5);
            tokio::task::yield_now().await;
        }
        until("all events", || broker.payloads("/event").len() >= 1000).await;
        assert_delivered(&broker.payloads("/event"), 1000);
        let seqs: Vec<_> = broker.payloads("engine1/state").iter().map(|(_, payload)| seq(payload)).collect();
        assert!(seqs.is_sorted(), "{seqs:?}");
    })
    .await;
}

/// What a subscriber to everything received, and whether it is subscribed now.
#[derive(Default)]
struct Subscription {
    subscribed: bool,
    connections: usize,
    messages: Vec<Received>,
}

/// Reads the socket itself, so that what the broker sent before it died is seen to the last byte.
struct Subscriber {
    shared: Arc<Mutex<Subscription>>,
    task: JoinHandle<()>,
}

impl Subscriber {
    /// `id` has ten letters.
    fn start(broker: SocketAddr, id: &'static str) -> Self {
        let shared = Arc::new(Mutex::new(Subscription::default()));
        let subscription = Arc::clone(&shared);
        let task = tokio::spawn(async move {
            loop {
                if let Ok(stream) = TcpStream::connect(broker).await {
                    Self::session(stream, id, &subscription).await;
                }
                subscription.lock().unwrap().subscribed = false;
                tokio::time::sleep(Duration::from_millis(10)).await;
            }
        });
        Self { shared, task }
    }

    async fn session(stream: TcpStream, id: &str, subscription: &Mutex<Subscription>) -> Option<()> {
        let mut stream = BufReader::new(stream);
        stream.write_all(b"\x10\x16\x00\x04MQTT\x04\x02\x00\x00\x00\x0a").await.ok()?;
        stream.write_all(id.as_bytes()).await.ok()?;
        stream.write_all(b"\x82\x06\x00\x01\x00\x01#\x00").await.ok()?;
        loop {
            let (first, body) = read_packet(&mut stream).await?;
            let mut subscription = subscription.lock().unwrap();
            match first >> 4 {
                9 => {
                    subscription.subscribed = true;
                    subscription.connections += 1;
                }
                3 => {
                    let (message, _) = read_publish(subscription.connections, first, &body);
                    subscription.messages.push(message);
                }
                _ => {}
            }
        }
    }

    fn is_subscribed(&self) -> bool {
        self.shared.lock().unwrap().subscribed
    }

    fn last(&self, topic: &str) -> Option<(String, bool)> {
        let shared = self.shared.lock().unwrap();
        let last = shared.messages.iter().rev().find(|message| message.topic.ends_with(topic));
        last.map(|message| (message.payload.clone(), message.retain))
    }

    fn events(&self) -> Vec<(usize, String)> {
        let shared = self.shared.lock().unwrap();
        let of_topic = shared.messages.iter().filter(|message| message.topic.ends_with("/event"));
        of_topic.map(|message| (message.connection, message.payload.clone())).collect()
    }
}

impl Drop for Subscriber {
    fn drop(&mut self) {
        self.task.abort();
    }
}

#[tokio::test]
async fn a_real_broker_delivers_events_keeps_state_and_publishes_the_last_will() {
    both(async |version| {
        let broker = EmbeddedBroker::start("127.0.0.1:0".parse().unwrap()).await.unwrap();
        let early = Subscriber::start(broker.local_addr(), "early-bird");
        until("subscribed", || early.is_subscribed()).await;
        let mut client = Client::speaking(version, broker.local_addr());
        client.until(|status| status.connected).await;
        client.happen(200);
        client.until(|status| status.outbox.events.0 == 200 && status.outbox.messages == 0).await;
        until("events", || early.events().len() == 200).await;
        assert_delivered(&early.events(), 200);

        let late = Subscriber::start(broker.local_addr(), "late-comer");
        until("retained", || late.last("engine2/state").is_some() && late.last("bridge/state").is_some())
            .await;
        assert_eq!(late.last("bridge/state").unwrap(), (r#"{"state":"online"}"#.to_owned(), true));
        assert!(late.last("engine1/availability").unwrap().1);
        assert!(late.events().is_empty(), "events are not retained");

        client.task.abort();
        until("last will", || late.last("bridge/state").unwrap().0 == r#"{"state":"offline"}"#).await;
        broker.shutdown().await;
    })
    .await;
}

/// mosquitto, killed and started again at the same place.
struct Mosquitto {
    address: SocketAddr,
    _folder: tempfile::TempDir,
    file: std::path::PathBuf,
    process: Child,
}

impl Mosquitto {
    /// `None` where it is not installed; in CI that is a failure.
    fn start() -> Option<Self> {
        let found = Command::new("mosquitto").arg("-h").stdout(Stdio::null()).stderr(Stdio::null()).status();
        if found.is_err() {
            assert!(
                std::env::var_os("CI").is_none(),
                "mosquitto is not installed, and CI has to run this test"
            );
            eprintln!("skipped: mosquitto is not installed (apt-get install mosquitto)");
            return None;
        }
        let address = free_address();
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("mosquitto.conf");
        let text =
            format!("listener {} 127.0.0.1\nallow_anonymous true\npersistence false\n", address.port());
        std::fs::write(&file, text).unwrap();
        let process = Self::spawn(&file);
        Some(Self { address, _folder: folder, file, process })
    }

    fn spawn(file: &std::path::Path) -> Child {
        let mut command = Command::new("mosquitto");
        command.arg("-c").arg(file).stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap()
    }

    /// SIGKILL.
    fn kill(&mut self) {
        self.process.kill().unwrap();
        self.process.wait().unwrap();
    }

    fn start_again(&mut self) {
        self.process = Self::spawn(&self.file);
    }
}

impl Drop for Mosquitto {
    fn drop(&mut self) {
        let _ = self.process.kill();
        let _ = self.process.wait();
    }
}

/// Forwards connections to the broker, while it is open: so that the gateway never meets a broker whose subscriber
/// is not back yet, which would lose messages that nobody is to blame for.
async fn gate(broker: SocketAddr, open: watch::Receiver<bool>) -> (SocketAddr, JoinHandle<()>) {
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let address = listener.local_addr().unwrap();
    let task = tokio::spawn(async move {
        let mut connections = tokio::task::JoinSet::new();
        loop {
            let (mut near, _) = listener.accept().await.unwrap();
            if !*open.borrow() {
                continue;
            }
            connections.spawn(async move {
                let mut far = TcpStream::connect(broker).await?;
                tokio::io::copy_bidirectional(&mut near, &mut far).await
            });
        }
    });
    (address, task)
}

#[tokio::test]
async fn p1_p5_p6_f50_mosquitto_killed_twenty_times_under_load_loses_no_event() {
    both(async |version| {
        let Some(mut mosquitto) = Mosquitto::start() else { return };
        let subscriber = Subscriber::start(mosquitto.address, "subscriber");
        let (open, opened) = watch::channel(false);
        let (address, gate) = gate(mosquitto.address, opened).await;
        let mut client = Client::speaking(version, address);
        let mut random = fastrand::Rng::with_seed(3);
        let mut last = 0;
        for round in 0..=20 {
            until("subscribed", || subscriber.is_subscribed()).await;
            open.send_replace(true);
            let before = client.until(|status| status.connected).await.outbox.acknowledged;
            for _ in 0..random.u32(1..40) {
                last += random.u64(1..30);
                client.happen(last);
                tokio::task::yield_now().await;
            }
            // Some messages of this session are through, others are on their way.
            client.until(|status| status.outbox.acknowledged > before || !status.connected).await;
            if round == 20 {
                break;
            }
            open.send_replace(false);
            mosquitto.kill();
            client.until(|status| !status.connected).await;
            until("subscriber noticed", || !subscriber.is_subscribed()).await;
            mosquitto.start_again();
        }
        client
            .until(|status| status.connected && status.outbox.messages == 0 && status.outbox.events.0 == last)
            .await;
        until("the last event", || {
            subscriber.events().last().is_some_and(|(_, payload)| seq(payload) == last)
        })
        .await;
        assert_delivered(&subscriber.events(), last);
        client.stop().await;
        until("offline", || subscriber.last("bridge/state").unwrap().0 == r#"{"state":"offline"}"#).await;
        gate.abort();
    })
    .await;
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 6, ..ProptestConfig::default() })]
    #[test]
    fn f61_random_bytes_of_a_broker_do_no_harm(bytes in proptest::collection::vec(any::<u8>(), 0..64), after: bool) {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
        runtime.block_on(async {
            let scripts = vec![Script::Garbage { after_connack: after, bytes }, Script::Good];
            let broker = FakeBroker::start(scripts).await;
            let client = Client::start_with(broker.address, |settings| settings.keep_alive_s = 1);
            until("a connection", || broker.seen(|seen| seen.connections) >= 1).await;
            client.stop().await;
        });
    }
}
