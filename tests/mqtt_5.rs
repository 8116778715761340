//! What MQTT 5 adds: reasons, and limits that the broker tells.

use std::net::SocketAddr;
use std::process::Stdio;
use std::sync::{Arc, Mutex};

use cangate::access::{Access, AccessEntry, Role};
use cangate::gateway::command::Desk;
use cangate::mapping::{At, SourceText};
use cangate::mqtt::{MqttStatus, MqttVersion};
use cangate::process_image::{SessionTrouble, Value};
use tokio::io::{AsyncBufReadExt, BufReader};
use tokio::process::{Child, Command};
use tokio::task::JoinHandle;

use crate::support::fake_broker::{Control, FakeBroker, Script};
use crate::support::mosquitto::Mosquitto;
use crate::support::mqtt_client::{Client, WINDOW, assert_delivered, until};
use crate::support::plant;

/// A client of MQTT 5.
fn start(broker: &FakeBroker) -> Client {
    Client::speaking(MqttVersion::V5, broker.address)
}

#[tokio::test]
async fn a_session_begins_clean_and_ends_with_the_connection() {
    let broker = FakeBroker::start(vec![Script::Good]).await;
    let mut client = start(&broker);
    client.until(|status| status.connected).await;
    let connect = broker.seen(|seen| match &seen.control[0].1 {
        Control::Connect(body) => body.clone(),
        Control::Disconnect => panic!("CONNECT comes first"),
    });
    // Level 5; last will with quality of service 1, retained, and Clean Start.
    assert_eq!((connect[6], connect[7]), (5, 0b0010_1110));
    // One property, the largest packet that is taken: no Session Expiry Interval, which is as good as 0.
    assert_eq!(connect[10..16], [5, 0x27, 0, 1, 0, 0]);
    client.stop().await;
}

#[tokio::test]
async fn f55_a_refusal_says_what_to_mend() {
    for (code, text, trouble) in [
        (0x84, "it does not speak MQTT 5", SessionTrouble::Protocol),
        (0x85, "client id", SessionTrouble::ClientId),
        (0x86, "wrong user name or password", SessionTrouble::Login),
        (0x87, "not authorised", SessionTrouble::NotAuthorised),
        (0x88, "not available", SessionTrouble::NotAvailable),
        (0x8A, "banned", SessionTrouble::NotAuthorised),
        (0x97, "used up", SessionTrouble::Quota),
        (0x9A, "keeps no retained messages", SessionTrouble::Unsupported),
        (0x9D, "it has moved", SessionTrouble::Moved),
    ] {
        let broker = FakeBroker::start(vec![Script::Refuse(code), Script::Good]).await;
        let mut client = start(&broker);
        let status = client.until(|status| status.failures == 1).await;
        assert!(status.last_error.contains(text), "{code:x}: {}", status.last_error);
        assert_eq!(status.trouble, Some(trouble), "{code:x}");
        client.until(|status| status.connected).await;
        client.stop().await;
    }
}

#[tokio::test]
async fn a_broker_that_speaks_3_1_1_only_is_told_from_one_that_is_broken() {
    let broker = FakeBroker::start(vec![Script::OldVersion]).await;
    let mut client = start(&broker);
    let status = client.until(|status| status.failures == 1).await;
    assert!(
        status.last_error.contains("if the broker does not speak MQTT 5, set `version = \"3.1.1\"`"),
        "{}",
        status.last_error
    );
    client.stop().await;
}

#[tokio::test]
async fn a_session_that_the_broker_ends_says_why() {
    for (code, text, trouble) in [
        (0x8E, "another client took it over", SessionTrouble::TakenOver),
        (0x8B, "it is being stopped", SessionTrouble::NotAvailable),
        (0x98, "an administrator asked for it", SessionTrouble::Ended),
        (0x96, "used up", SessionTrouble::Quota),
    ] {
        let broker = FakeBroker::start(vec![Script::DisconnectAfter(5, code), Script::Good]).await;
        let mut client = start(&broker);
        client.happen(20);
        let status = client.until(|status| status.failures == 1).await;
        assert!(status.last_error.contains(text), "{code:x}: {}", status.last_error);
        assert_eq!((status.sessions, status.trouble), (1, Some(trouble)), "{code:x}");
        client.until(|status| status.connected && status.outbox.messages == 0).await;
        client.stop().await;
        assert_delivered(&broker.payloads("/event"), 20);
    }
}

#[tokio::test]
async fn what_the_broker_lacks_is_named_before_it_is_needed() {
    for (property, text) in [(vec![0x24, 0], "quality of service 1"), (vec![0x25, 0], "no retained messages")]
    {
        let lacking = Script::Properties { good: true, bytes: property };
        let broker = FakeBroker::start(vec![lacking, Script::Good]).await;
        let mut client = start(&broker);
        let status = client.until(|status| status.failures == 1).await;
        assert!(status.last_error.contains(text), "{}", status.last_error);
        assert_eq!((status.sessions, status.trouble), (0, Some(SessionTrouble::Unsupported)));
        client.stop().await;
    }
}

#[tokio::test]
async fn no_more_is_in_flight_than_the_broker_takes() {
    // Receive Maximum.
    let narrow = Script::Properties { good: false, bytes: vec![0x21, 0, 3] };
    let broker = FakeBroker::start(vec![narrow, Script::Good]).await;
    let mut client = start(&broker);
    client.happen(100);
    let status = client.until(|status| status.failures == 1).await;
    assert!(status.last_error.starts_with("the broker acknowledged nothing for "), "{}", status.last_error);
    broker.seen(|seen| {
        assert_eq!(seen.messages.iter().filter(|message| message.connection == 0).count(), 3);
    });
    client.until(|status| status.connected && status.outbox.messages == 0).await;
    client.stop().await;
    assert_delivered(&broker.payloads("/event"), 100);
}

#[tokio::test]
async fn a_message_that_is_larger_than_the_broker_takes_is_given_up_and_ends_no_session() {
    // Maximum Packet Size.
    let narrow = Script::Properties { good: true, bytes: vec![0x27, 0, 0, 0, 180] };
    let broker = FakeBroker::start(vec![narrow]).await;
    let mut client = start(&broker);
    client.happen(30);
    let status = client.until(|status| status.outbox.events.0 == 30 && status.outbox.messages == 0).await;
    assert_eq!((status.sessions, status.failures), (1, 0), "{}", status.last_error);
    assert!(status.outbox.refused >= 30, "{:?}", status.outbox);
    until("online", || !broker.payloads("bridge/state").is_empty()).await;
    assert!(broker.payloads("/event").is_empty());
    client.stop().await;
}

fn is_delivered(status: &MqttStatus) -> bool {
    status.outbox.messages == status.outbox.held.0
}

#[tokio::test]
async fn events_that_the_broker_does_not_take_for_now_are_kept_and_hold_up_nothing_else() {
    // Not authorised; quota.
    for reason in [0x87, 0x97] {
        let broker = FakeBroker::start(vec![Script::RefuseMessages("/event", reason)]).await;
        let mut client = start(&broker);
        client.happen(100);
        for round in 1..=10_u32 {
            client.change(|image| image.tags[0] = plant::good(Value::Float(f64::from(round))));
            until("the state", || {
                let states = broker.payloads("engine1/state");
                states.last().is_some_and(|(_, state)| state.contains(&format!(":{round},")))
            })
            .await;
        }
        let status = client.until(|status| status.connected && is_delivered(status)).await;
        assert_eq!(
            (status.sessions, status.failures, status.outbox.held.0),
            (1, 0, 100),
            "{:?}",
            status.outbox
        );
        let tried = broker.payloads("/event").len();
        assert!((1..=WINDOW).contains(&tried), "they are not tried again and again: {tried}");
        client.stop().await;
    }
}

#[tokio::test]
async fn events_that_the_broker_will_never_take_are_given_up_and_counted() {
    // Payload format invalid.
    let broker = FakeBroker::start(vec![Script::RefuseMessages("/event", 0x99)]).await;
    let mut client = start(&broker);
    client.happen(100);
    let status = client.until(|status| status.outbox.events.0 == 100 && status.outbox.messages == 0).await;
    assert_eq!((status.outbox.refused, status.failures), (100, 0));
    client.stop().await;
}

#[tokio::test]
async fn what_an_access_list_of_mosquitto_forbids_is_not_taken_for_delivered() {
    let folder = tempfile::tempdir().unwrap();
    let list = folder.path().join("acl");
    std::fs::write(
        &list,
        "topic readwrite cangate/hall-1/bridge/#\ntopic readwrite cangate/hall-1/engine1/#\n",
    )
    .unwrap();
    let Some(mosquitto) = Mosquitto::start_with(&format!("acl_file {}", list.display())).await else {
        return;
    };
    let mut client = Client::speaking(MqttVersion::V5, mosquitto.address);
    client.happen(40);
    // engine2 is forbidden too, and engine1 is not.
    let status = client
        .until(|status| {
            let outbox = &status.outbox;
            outbox.refused >= 2 && outbox.acknowledged >= 5 && outbox.held.0 == 40 && is_delivered(status)
        })
        .await;
    assert_eq!((status.sessions, status.failures), (1, 0), "{:?}", status.outbox);
    client.stop().await;
}

/// `mosquitto_sub`, subscribed to everything: what a program by others sees of each message.
struct Foreign {
    seen: Arc<Mutex<Vec<String>>>,
    _process: Child,
    task: JoinHandle<()>,
}

impl Foreign {
    fn start(broker: SocketAddr) -> Self {
        let mut process = Command::new("mosquitto_sub")
            .args(["-V", "5", "-q", "1", "-t", "#", "-h", "127.0.0.1", "-p", &broker.port().to_string()])
            // Topic, retained, format, type, expiry, user properties.
            .args(["-F", "%t|%r|%F|%C|%E|%P|%p"])
            .stdout(Stdio::piped())
            .kill_on_drop(true)
            .spawn()
            .expect("mosquitto_sub comes with mosquitto-clients");
        let mut lines = BufReader::new(process.stdout.take().unwrap()).lines();
        let seen = Arc::new(Mutex::new(Vec::new()));
        let shared = Arc::clone(&seen);
        let task = tokio::spawn(async move {
            while let Ok(Some(line)) = lines.next_line().await {
                shared.lock().unwrap().push(line);
            }
        });
        Self { seen, _process: process, task }
    }

    /// Waits for a message of a topic, and gives all but its topic.
    async fn message(&self, topic: &str) -> String {
        let begin = format!("{topic}|");
        let find = || {
            let seen = self.seen.lock().unwrap();
            seen.iter().rev().find_map(|line| line.strip_prefix(&begin).map(str::to_owned))
        };
        until(topic, || find().is_some()).await;
        find().unwrap()
    }
}

impl Drop for Foreign {
    fn drop(&mut self) {
        self.task.abort();
    }
}

#[tokio::test]
async fn mosquitto_sub_sees_properties_and_expiry() {
    let Some(mosquitto) = Mosquitto::start().await else { return };
    let mut client = Client::speaking_with(MqttVersion::V5, mosquitto.address, |settings| {
        settings.state_expiry_s = Some(100);
    });
    client.until(|status| status.connected).await;
    let foreign = Foreign::start(mosquitto.address);
    // Once it is there, the subscription is made.
    let online = foreign.message("cangate/hall-1/bridge/state").await;
    assert_eq!(online[1..], *r#"|1|application/json|||{"state":"online"}"#);
    client.happen(1);
    let event = foreign.message("cangate/hall-1/event").await;
    assert!(event.starts_with(r#"0|1|application/json||schema:1 stream:s seq:1|{"v":1,"#), "{event}");
    let state = foreign.message("cangate/hall-1/engine1/state").await;
    let parts: Vec<&str> = state.splitn(6, '|').collect();
    assert_eq!(parts[1..3], ["1", "application/json"]);
    assert!((1..=100).contains(&parts[3].parse::<u32>().unwrap()), "{state}");
    assert!(parts[4].starts_with("schema:1 stream:s seq:"), "{state}");
    let availability = foreign.message("cangate/hall-1/engine1/availability").await;
    assert!(
        availability[1..].starts_with("|1|application/json|||{"),
        "it holds until it changes: {availability}"
    );
    client.task.abort();
    until("the last will", || {
        let seen = foreign.seen.lock().unwrap();
        seen.iter().any(|line| line.ends_with(r#"bridge/state|0|1|application/json|||{"state":"offline"}"#))
    })
    .await;
}

#[tokio::test]
async fn with_3_1_1_mosquitto_sub_sees_no_properties() {
    let Some(mosquitto) = Mosquitto::start().await else { return };
    let mut client = Client::speaking(MqttVersion::V3_1_1, mosquitto.address);
    client.until(|status| status.connected).await;
    let foreign = Foreign::start(mosquitto.address);
    let online = foreign.message("cangate/hall-1/bridge/state").await;
    assert_eq!(online[1..], *r#"|||||{"state":"online"}"#);
    client.stop().await;
}

/// A desk at which somebody at the broker may look at everything and do nothing.
fn desk() -> Desk {
    let entry = AccessEntry { role: Role::Viewer, mqtt: Some(At::nowhere(true)), ..AccessEntry::default() };
    let entries = [(At::nowhere("scada".to_owned()), entry)].into();
    let (access, problems) = Access::build(&SourceText::new("", ""), &entries, &plant::table(2));
    assert_eq!(problems, []);
    let desk = Desk::new(1).0;
    desk.set_access(Arc::new(access));
    desk
}

#[tokio::test]
async fn mosquitto_rr_gets_its_answer_where_it_wants_it() {
    let Some(mosquitto) = Mosquitto::start().await else { return };
    let mut client =
        Client::start_at(desk(), mosquitto.address, |settings| settings.version = MqttVersion::V5);
    client.until(|status| status.connected).await;
    let port = mosquitto.address.port().to_string();
    let ask = async || {
        let request = Command::new("mosquitto_rr")
            .args(["-V", "5", "-q", "1", "-h", "127.0.0.1", "-p", &port, "-W", "2"])
            .args(["-t", "cangate/hall-1/bridge/request/acknowledge_all"])
            .args(["-e", "cangate/hall-1/bridge/response/scada/7", "-m", r#"{"transaction":"a1"}"#])
            .args(["-D", "publish", "correlation-data", "seven", "-F", "%t|%D|%E|%p"])
            .kill_on_drop(true)
            .output();
        let output = request.await.expect("mosquitto_rr comes with mosquitto-clients");
        String::from_utf8(output.stdout).ok().filter(|text| !text.is_empty())
    };
    // The gateway subscribes right after it is connected.
    let answer = crate::support::until("an answer", ask).await;
    let parts: Vec<&str> = answer.trim().splitn(4, '|').collect();
    assert_eq!(parts[..2], ["cangate/hall-1/bridge/response/scada/7", "seven"]);
    assert!((1..=60).contains(&parts[2].parse::<u32>().unwrap()), "{answer}");
    assert!(parts[3].contains(r#""transaction":"a1""#) && parts[3].contains("`scada` is viewer"), "{answer}");
    client.stop().await;
}
