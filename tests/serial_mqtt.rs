//! Serial lines by MQTT: messages that came in are published, those of command topics go out.

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use cangate::gateway::command::{CommandSource, Outcome};
use cangate::mapping::{LineDef, LineEncoding, LineMqtt, TagTable};
use cangate::mqtt::back_off::Pace;
use cangate::mqtt::broker::EmbeddedBroker;
use cangate::mqtt::client::run;
use cangate::mqtt::{Identity, MqttSettings, MqttStatus, Publisher};
use cangate::time::{Clock, Timestamp};
use rumqttc::{AsyncClient, Event, MqttOptions, Packet, QoS};
use serde_json::{Value, json};
use tokio::sync::{mpsc, watch};
use tokio::task::JoinHandle;
use tokio_util::sync::CancellationToken;

use crate::support::fake_broker::{FakeBroker, Script};
use crate::support::lines::{self, Bench};
use crate::support::{PATIENCE, plant, until};

const RX: &str = "cangate/hall-1/engine1/serial/1/rx";
const TX: &str = "cangate/hall-1/engine1/serial/1/tx";
const RESPONSE: &str = "cangate/hall-1/bridge/response/serial_send";

fn line(encoding: LineEncoding, write: bool) -> LineDef {
    LineDef { mqtt: LineMqtt { publish: true, encoding, write }, ..lines::line() }
}

fn publisher(table: &Arc<TagTable>) -> Publisher {
    let identity = Identity { sid: "s".into(), ..Identity::default() };
    Publisher::new(Arc::clone(table), &MqttSettings::default(), identity)
}

/// What a publisher sends of a topic now; all is acknowledged.
fn sent(publisher: &mut Publisher, bench: &Bench, topic: &str) -> Vec<Value> {
    let mut sent = Vec::new();
    loop {
        bench.reader.read(|image| publisher.handle_image(plant::at(0), image));
        while let Some(out) = publisher.poll_output() {
            publisher.handle_acknowledged(out.id);
            if &*out.message.topic == topic {
                assert!(out.message.at_least_once && !out.message.retain);
                sent.push(serde_json::from_str(&out.message.payload).unwrap());
            }
        }
        if !publisher.has_more() {
            return sent;
        }
    }
}

#[test]
fn r_esd_034_a_message_is_published_with_its_time_number_and_end() {
    let table = lines::table(vec![line(LineEncoding::Text, false)]);
    let (mut publisher, mut bench) = (publisher(&table), Bench::new(&table));
    publisher.handle_session_up();
    assert!(sent(&mut publisher, &bench, RX).is_empty());
    bench.message(1_763_760_000_123, b"4711\tok", "delimiter");
    bench.message(1_763_760_000_200, "Säge".as_bytes(), "idle");
    assert_eq!(
        sent(&mut publisher, &bench, RX),
        [
            json!({"v":1,"ts":1_763_760_000_123_u64,"sid":"s","seq":1,"encoding":"text","data":"4711\tok","bytes":7,
                   "end":"delimiter","missed":0}),
            json!({"v":1,"ts":1_763_760_000_200_u64,"sid":"s","seq":2,"encoding":"text","data":"Säge","bytes":5,
                   "end":"idle","missed":0}),
        ]
    );
    assert!(sent(&mut publisher, &bench, RX).is_empty(), "once");
}

#[test]
fn what_is_no_plain_text_is_base64_and_says_so() {
    let table = lines::table(vec![line(LineEncoding::Text, false)]);
    let (mut publisher, mut bench) = (publisher(&table), Bench::new(&table));
    publisher.handle_session_up();
    for (bytes, data) in [(b"\xFFA".as_slice(), "/0E="), (b"a\rb", "YQ1i"), (b"\x7F", "fw=="), (b"", "")] {
        bench.message(0, bytes, "length");
        let sent = sent(&mut publisher, &bench, RX);
        let encoding = if bytes.is_empty() { "text" } else { "base64" };
        assert_eq!((&sent[0]["encoding"], &sent[0]["data"]), (&json!(encoding), &json!(data)));
        assert_eq!(sent[0]["bytes"], json!(bytes.len()));
    }
    let table = lines::table(vec![line(LineEncoding::Base64, false)]);
    let mut bench = Bench::new(&table);
    let mut publisher = self::publisher(&table);
    publisher.handle_session_up();
    bench.message(0, b"text", "length");
    assert_eq!(sent(&mut publisher, &bench, RX)[0]["data"], json!("dGV4dA=="));
}

#[test]
fn messages_that_came_without_a_session_follow_and_those_that_are_gone_are_counted() {
    let table = lines::table(vec![line(LineEncoding::Text, false)]);
    let (mut publisher, mut bench) = (publisher(&table), Bench::new(&table));
    bench.message(1, b"kept", "idle");
    assert!(sent(&mut publisher, &bench, RX).is_empty());
    // More than the image keeps, before the publisher looks again.
    for number in 2..=200 {
        bench.message(number, number.to_string().as_bytes(), "idle");
    }
    publisher.handle_session_up();
    let messages = sent(&mut publisher, &bench, RX);
    assert_eq!(messages[0]["data"], json!("kept"));
    assert_eq!((&messages[1]["seq"], &messages[1]["missed"]), (&json!(73), &json!(71)));
    let numbers: Vec<_> = messages[1..].iter().map(|message| message["seq"].as_u64().unwrap()).collect();
    assert_eq!(numbers, (73..=200).collect::<Vec<_>>());
    assert!(messages[2..].iter().all(|message| message["missed"] == json!(0)));
}

#[test]
fn a_line_that_is_not_published_is_not() {
    let silent = LineDef { number: 2, ..lines::line() };
    let table = lines::table(vec![silent, line(LineEncoding::Text, false)]);
    let (mut publisher, mut bench) = (publisher(&table), Bench::new(&table));
    publisher.handle_session_up();
    bench.message(0, b"secret", "idle");
    bench.change(1, |line| line.append_message(Timestamp::default(), b"open".to_vec(), "idle"));
    assert!(sent(&mut publisher, &bench, "cangate/hall-1/engine1/serial/2/rx").is_empty());
    bench.change(1, |line| line.append_message(Timestamp::default(), b"again".to_vec(), "idle"));
    assert_eq!(sent(&mut publisher, &bench, RX)[0]["data"], json!("again"));
}

/// The gateway's client, against a broker.
struct Client {
    bench: Bench,
    status: watch::Receiver<MqttStatus>,
    stop: CancellationToken,
    task: JoinHandle<()>,
}

impl Client {
    async fn start(broker: SocketAddr, line: LineDef) -> Self {
        let table = lines::table(vec![line]);
        let bench = Bench::new(&table);
        let settings =
            MqttSettings { url: format!("mqtt://{broker}").parse().unwrap(), ..MqttSettings::default() };
        let (sender, mut status) = watch::channel(MqttStatus::default());
        let stop = CancellationToken::new();
        let pace =
            Pace { first: Duration::from_millis(20), longest: Duration::from_millis(40), ..Pace::default() };
        let (publisher, reader, desk) = (publisher(&table), bench.reader.clone(), bench.desk.clone());
        let stopping = stop.clone();
        let task = tokio::spawn(async move {
            let clock = Clock::start();
            let exchanges = tokio::sync::mpsc::channel(1).1;
            let session = run(
                settings, "hall-1", publisher, reader, desk, clock, stopping, sender, None, exchanges, pace,
            );
            Box::pin(session).await;
        });
        tokio::time::timeout(PATIENCE, status.wait_for(|status| status.connected)).await.unwrap().unwrap();
        Self { bench, status, stop, task }
    }

    async fn stop(self) {
        self.stop.cancel();
        tokio::time::timeout(PATIENCE, self.task).await.unwrap().unwrap();
    }
}

/// Somebody else at the broker, who reads everything below `cangate`.
struct Peer {
    client: AsyncClient,
    messages: mpsc::Receiver<(String, Vec<u8>)>,
    driver: JoinHandle<()>,
}

impl Peer {
    async fn start(broker: SocketAddr) -> Self {
        let options = MqttOptions::new("peer", (broker.ip().to_string(), broker.port()));
        let (client, mut event_loop) = AsyncClient::builder(options).capacity(64).build();
        let (sender, messages) = mpsc::channel(1024);
        let (subscribed, wait) = tokio::sync::oneshot::channel();
        let driver = tokio::spawn(async move {
            let mut subscribed = Some(subscribed);
            while let Ok(event) = event_loop.poll().await {
                match event {
                    Event::Incoming(Packet::SubAck(_)) => drop(subscribed.take().unwrap().send(())),
                    Event::Incoming(Packet::Publish(message)) => {
                        let topic = String::from_utf8(message.topic.to_vec()).unwrap();
                        let _ = sender.send((topic, message.payload.to_vec())).await;
                    }
                    _ => {}
                }
            }
        });
        client.subscribe("cangate/#", QoS::AtLeastOnce).await.unwrap();
        tokio::time::timeout(PATIENCE, wait).await.unwrap().unwrap();
        Self { client, messages, driver }
    }

    async fn publish(&self, retain: bool, payload: impl Into<Vec<u8>>) {
        let options = rumqttc::PublishOptions::new(QoS::AtLeastOnce).retain(retain);
        self.client.publish(TX, payload.into(), options).await.unwrap();
    }

    /// The next message of a topic.
    async fn next(&mut self, topic: &str) -> Value {
        let waiting = async {
            loop {
                let (of, payload) = self.messages.recv().await.unwrap();
                if of == topic {
                    return serde_json::from_slice(&payload).unwrap();
                }
            }
        };
        tokio::time::timeout(PATIENCE, waiting).await.expect("it does not come")
    }
}

impl Drop for Peer {
    fn drop(&mut self) {
        self.driver.abort();
    }
}

#[tokio::test]
async fn r_esd_039_requests_go_out_in_order_and_are_answered() {
    let broker = EmbeddedBroker::start("127.0.0.1:0".parse().unwrap()).await.unwrap();
    let mut peer = Peer::start(broker.local_addr()).await;
    let mut client = Client::start(broker.local_addr(), line(LineEncoding::Text, true)).await;
    // The subscription is there once something comes through.
    let bench = &mut client.bench;
    until("the command topic is read", async || {
        peer.publish(false, "?").await;
        tokio::time::timeout(Duration::from_millis(200), bench.asked()).await.ok()
    })
    .await
    .answer(Outcome::Done);
    peer.publish(false, r#"{"transaction":"t1","data":"START\r\n"}"#).await;
    peer.publish(false, r#"{"transaction":"t2","data":"AP8=","encoding":"base64"}"#).await;
    peer.publish(false, b"\x02plain\x03".as_slice()).await;
    peer.publish(false, r#"{"transaction":"t3","data":7}"#).await;
    peer.publish(false, "").await;
    let mut asked = client.bench.asked().await;
    while asked.bytes == b"?" {
        asked.answer(Outcome::Done);
        asked = client.bench.asked().await;
    }
    assert_eq!(asked.bytes, b"START\r\n");
    assert_eq!(asked.source, CommandSource::mqtt(TX.to_owned()));
    asked.answer(Outcome::Done);
    let asked = client.bench.asked().await;
    assert_eq!(asked.bytes, [0, 255]);
    asked.answer(Outcome::Failed("1 of 2 bytes were sent".into()));
    let asked = client.bench.asked().await;
    assert_eq!(asked.bytes, b"\x02plain\x03");
    asked.answer(Outcome::NodeUnavailable);
    let mut answers = Vec::new();
    while answers.len() < 3 {
        answers.push(peer.next(RESPONSE).await);
    }
    answers.sort_by_key(|answer| answer["transaction"].to_string());
    let answer = |transaction: Value, result: &str, message: &str| json!({"transaction":transaction,"node":"engine1","channel":1,"result":result,"message":message});
    assert_eq!(answers[0], answer(json!("t1"), "ok", ""));
    assert_eq!(answers[1], answer(json!("t2"), "failed", "1 of 2 bytes were sent"));
    assert_eq!(answers[2], answer(json!("t3"), "rejected", "`data` must be there, and be text"));
    assert!(client.bench.is_quiet());
    client.stop().await;
    broker.shutdown().await;
}

#[tokio::test]
async fn a_retained_command_is_never_carried_out() {
    let broker = EmbeddedBroker::start("127.0.0.1:0".parse().unwrap()).await.unwrap();
    let mut peer = Peer::start(broker.local_addr()).await;
    peer.publish(true, "retained").await;
    // The broker has it.
    let (topic, payload) =
        tokio::time::timeout(PATIENCE, peer.messages.recv()).await.unwrap().expect("the broker passes it on");
    assert_eq!((topic.as_str(), payload.as_slice()), (TX, b"retained".as_slice()));
    let mut client = Client::start(broker.local_addr(), line(LineEncoding::Text, true)).await;
    let bench = &mut client.bench;
    let first = until("the command topic is read", async || {
        peer.publish(false, "live").await;
        tokio::time::timeout(Duration::from_millis(200), bench.asked()).await.ok()
    })
    .await;
    assert_eq!(first.bytes, b"live", "a retained message comes before all others");
    client.stop().await;
    broker.shutdown().await;
}

#[tokio::test]
async fn more_requests_than_may_be_under_way_are_busy() {
    let broker = EmbeddedBroker::start("127.0.0.1:0".parse().unwrap()).await.unwrap();
    let mut peer = Peer::start(broker.local_addr()).await;
    let mut client = Client::start(broker.local_addr(), line(LineEncoding::Text, true)).await;
    let bench = &mut client.bench;
    until("the command topic is read", async || {
        peer.publish(false, r#"{"transaction":"knock","data":"?"}"#).await;
        tokio::time::timeout(Duration::from_millis(200), bench.asked()).await.ok()
    })
    .await
    .answer(Outcome::Done);
    peer.next(RESPONSE).await;
    for number in 1..=9 {
        peer.publish(false, format!(r#"{{"transaction":"t{number}","data":"x"}}"#)).await;
    }
    // Of a knock that came late, or of the ninth.
    let mut answer = peer.next(RESPONSE).await;
    while answer["transaction"] == json!("knock") {
        answer = peer.next(RESPONSE).await;
    }
    assert_eq!(answer["result"], json!("busy"));
    client.stop().await;
    broker.shutdown().await;
}

#[tokio::test]
async fn without_the_permission_nothing_is_subscribed() {
    for write in [false, true] {
        let broker = FakeBroker::start(vec![Script::Good]).await;
        let client = Client::start(broker.address, line(LineEncoding::Text, write)).await;
        if write {
            until("it subscribes", async || broker.seen(|seen| (seen.subscribed == [TX]).then_some(())))
                .await;
        }
        until("it is online", async || {
            let state = broker.payloads("bridge/state");
            (!state.is_empty()).then_some(())
        })
        .await;
        client.stop().await;
        assert_eq!(broker.seen(|seen| seen.subscribed.len()), usize::from(write));
    }
}

#[tokio::test]
async fn a_retained_command_that_is_too_large_ends_one_session_and_not_the_next() {
    let broker = FakeBroker::start(vec![Script::LargeRetained(70_000)]).await;
    let client = Client::start(broker.address, line(LineEncoding::Text, true)).await;
    // A session subscribes before it publishes.
    until("the second session publishes", async || {
        let sessions = broker.payloads("bridge/state");
        sessions.iter().any(|(session, _)| *session > 0).then_some(())
    })
    .await;
    let status = client.status.borrow().clone();
    assert_eq!(broker.seen(|seen| seen.subscribed.clone()), [TX], "{}", status.last_error);
    assert!(status.last_error.contains("empty retained message"), "{}", status.last_error);
    client.stop().await;
}

#[tokio::test]
async fn messages_wait_for_a_broker_that_is_away_and_none_is_lost() {
    // It acknowledges nothing of the last message before it goes.
    let broker = FakeBroker::start(vec![Script::CloseAfter(40), Script::CloseAfter(60), Script::Good]).await;
    let mut client = Client::start(broker.address, line(LineEncoding::Text, true)).await;
    for number in 1..=100 {
        client.bench.message(number, number.to_string().as_bytes(), "delimiter");
        // As fast as the client looks: the image keeps 128.
        tokio::task::yield_now().await;
    }
    let numbers = || -> Vec<u64> {
        let payloads = broker.payloads("serial/1/rx");
        let seq = |payload: &String| serde_json::from_str::<Value>(payload).unwrap()["seq"].as_u64().unwrap();
        let mut numbers: Vec<u64> = payloads.iter().map(|(_, payload)| seq(payload)).collect();
        numbers.sort_unstable();
        numbers.dedup();
        numbers
    };
    until("all have arrived", async || (numbers() == (1..=100).collect::<Vec<_>>()).then_some(())).await;
    assert!(client.status.borrow().sessions >= 2, "the broker was away");
    until("it subscribes in each session", async || {
        let (sessions, subscribed) = broker.seen(|seen| (seen.connections, seen.subscribed.len()));
        (subscribed == sessions).then_some(())
    })
    .await;
    client.stop().await;
}
