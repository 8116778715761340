//! Whoever asks without a right, at every door and over real sockets: nothing of it reaches the bus, all of it the audit.
//!
//! `CANGATE_REFUSALS` is how many attempts there are, 1,000 unless it is set. With 100,000 of them it takes about a minute.

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use cangate::access::{Access, AccessEntry, Role};
use cangate::cia309;
use cangate::gateway::command::Door;
use cangate::gateway::command::desk::{Request, Requests};
use cangate::gateway::command::request::VERBS;
use cangate::gateway::{Desk, Input};
use cangate::mapping::{At, SourceText, TagTable};
use cangate::mqtt::back_off::Pace;
use cangate::mqtt::broker::EmbeddedBroker;
use cangate::mqtt::client::run;
use cangate::mqtt::{Identity, MqttSettings, MqttStatus, Publisher};
use cangate::process_image::process_image;
use cangate::time::Clock;
use cangate::web::{Server, WebSettings};
use tokio::io::{AsyncBufReadExt, AsyncReadExt, AsyncWriteExt, BufReader};
use tokio::net::{TcpSocket, TcpStream};
use tokio::sync::watch;
use tokio_util::sync::CancellationToken;

use super::commands::{commands_sent, forbidden};
use super::conversations::{detcon, running};
use super::support::conversation::Conversation;
use super::support::modbus::{RawClient, frame};
use super::support::mosquitto::Probe;
use super::support::plant;
use super::support::secure_modbus::{READ, Secure, WRITE};
use super::support::secure_web::state_of;
use super::support::until;

/// Requests that are sent before their answers are waited for.
const WINDOW: usize = 16;

fn attempts() -> usize {
    std::env::var("CANGATE_REFUSALS").map_or(1_000, |text| text.parse().unwrap())
}

/// Every kind of write by Modbus, to a node and to the gateway, and FC 43/13, each with the exception that answers it.
const MODBUS: [(u8, &[u8], u8); 14] = [
    (1, &[5, 0, 0, 0xFF, 0], 2),
    (1, &[6, 0, 100, 0, 1], 2),
    (1, &[15, 0, 0, 0, 3, 1, 7], 2),
    (1, &[16, 0, 100, 0, 2, 4, 0, 1, 0, 2], 2),
    (1, &[22, 0, 100, 0, 1, 0, 2], 2),
    (1, &[23, 0, 0, 0, 1, 0, 100, 0, 1, 2, 0, 1], 2),
    // All alarms are acknowledged, of a node and of the gateway.
    (1, &[5, 0x23, 0x28, 0xFF, 0], 2),
    (247, &[5, 0x23, 0x28, 0xFF, 0], 2),
    // The command block: node 1 is stopped.
    (247, &[16, 2, 0x58, 0, 4, 8, 0, 1, 0, 2, 0xFF, 0xFD, 0, 3], 2),
    (247, &[6, 2, 0x5B, 0, 4], 2),
    // What is not even well formed.
    (1, &[6, 0, 100], 3),
    (1, &[16, 0, 100, 0, 2, 4, 0, 1], 3),
    // Objects, read and written.
    (1, &[43, 13, 0, 0, 1, 0x10, 0x18, 1, 0, 0, 0, 4], 1),
    (1, &[43, 13, 1, 0, 1, 0x10, 0x17, 0, 0, 0, 0, 2, 0, 0], 1),
];

async fn by_modbus(address: SocketAddr, count: usize) {
    let mut client = RawClient(TcpStream::connect(address).await.unwrap());
    let numbers: Vec<usize> = (0..count).collect();
    for window in numbers.chunks(WINDOW) {
        for number in window {
            let (unit, pdu, _) = MODBUS[number % MODBUS.len()];
            client.send(&frame(7, unit, pdu)).await;
        }
        for number in window {
            let (unit, pdu, code) = MODBUS[number % MODBUS.len()];
            assert_eq!(client.receive().await, Some((7, unit, vec![pdu[0] | 0x80, code])), "{pdu:?}");
        }
    }
}

/// With certificates: a role that may only read writes, and one that may do nothing reads.
async fn by_secure_modbus(server: &Secure, count: usize) {
    let (mut reader, mut visitor) =
        (server.client(&["Operator"]).await.unwrap(), server.client(&["Visitor"]).await.unwrap());
    for number in 0..count {
        let answer = if number % 2 == 0 { reader.ask(WRITE).await } else { visitor.ask(READ).await };
        assert_eq!(answer, Ok(vec![if number % 2 == 0 { 0x86 } else { 0x84 }, 1]));
    }
}

/// From so many addresses that none is too fast for the server.
async fn by_http(address: SocketAddr, count: usize) {
    let numbers: Vec<usize> = (0..count).collect();
    for (place, own) in numbers.chunks(300).enumerate() {
        let place = u16::try_from(place).unwrap().to_be_bytes();
        let socket = TcpSocket::new_v4().unwrap();
        socket.bind(SocketAddr::from(([127, 1, place[0], place[1]], 0))).unwrap();
        post(BufReader::new(socket.connect(address).await.unwrap()), own.len()).await;
    }
}

async fn post(mut stream: BufReader<TcpStream>, count: usize) {
    for number in 0..count {
        let token = if number % 2 == 0 { "" } else { "Authorization: Bearer wrong-wrong-wrong-wrong\r\n" };
        let request = format!(
            "POST /api/v1/commands/{} HTTP/1.1\r\nHost: localhost\r\n{token}Content-Type: application/json\r\n\
             Content-Length: 2\r\n\r\n{{}}",
            VERBS[number % VERBS.len()]
        );
        stream.write_all(request.as_bytes()).await.unwrap();
        let (mut length, mut code) = (0, String::new());
        stream.read_line(&mut code).await.unwrap();
        loop {
            let mut header = String::new();
            stream.read_line(&mut header).await.unwrap();
            if let Some(value) = header.to_ascii_lowercase().strip_prefix("content-length:") {
                length = value.trim().parse().unwrap();
            }
            if header.trim().is_empty() {
                break;
            }
        }
        stream.read_exact(&mut vec![0; length]).await.unwrap();
        // After five wrong tokens the address is shut out.
        let refused = code.starts_with("HTTP/1.1 401") || (number > 9 && code.starts_with("HTTP/1.1 429"));
        assert!(refused, "{number}: {code}");
    }
}

async fn by_cia309(address: SocketAddr, count: usize) {
    let lines = ["1 w 0x1017 0 u16 500", "1 stop", "1 reset node", "1 1 preop", "1 99 start"];
    let mut stream = BufReader::new(TcpStream::connect(address).await.unwrap());
    let numbers: Vec<usize> = (0..count).collect();
    for window in numbers.chunks(WINDOW) {
        for number in window {
            let line = format!("[{number}] {}\r\n", lines[number % lines.len()]);
            stream.write_all(line.as_bytes()).await.unwrap();
        }
        for number in window {
            let mut answer = String::new();
            stream.read_line(&mut answer).await.unwrap();
            assert!(answer.starts_with(&format!("[{number}] ERROR:100 ")), "{answer}");
        }
    }
}

/// Through the broker, where a viewer is known: it may look at everything and ask for nothing.
async fn by_mqtt(probe: &Probe, desk: &Desk, count: usize) {
    let members = |verb: &str| match verb {
        "acknowledge_all" => "",
        "nmt" => r#","node":"engine1","request":"stop""#,
        "write" => r#","node":"engine1","tag":"trip","value":true"#,
        "sdo_read" => r#","node":"engine1","object":"0x1018:1""#,
        "sdo_write" => r#","node":"engine1","object":"0x1017:0","data":"0000""#,
        _ => r#","node":"engine1","alarm":"trip""#,
    };
    let refused = || desk.refused().into_iter().find(|(door, _)| *door == Door::Mqtt).unwrap().1;
    let numbers: Vec<usize> = (0..count).collect();
    for window in numbers.chunks(WINDOW) {
        for number in window {
            let verb = VERBS[number % VERBS.len()];
            let payload = format!("{{\"transaction\":\"t{number}\"{}}}", members(verb));
            probe.publish(&format!("cangate/hall-1/bridge/request/{verb}"), payload.as_bytes(), false).await;
        }
        let all = u64::try_from(window[0] + window.len()).unwrap();
        until("requests are refused", async || (refused() == all).then_some(())).await;
    }
    let rejected = || {
        let seen = probe.seen().into_iter().filter(|seen| seen.topic.contains("/bridge/response/"));
        seen.filter(|seen| String::from_utf8_lossy(&seen.payload).contains("`scada` is viewer")).count()
    };
    until("all are answered", async || (rejected() == count).then_some(())).await;
}

/// A viewer at the broker, and nobody else.
fn access(table: &TagTable) -> Access {
    let mqtt = Some(At::nowhere(true));
    let entry = AccessEntry { role: Role::Viewer, mqtt, ..AccessEntry::default() };
    let entries = [(At::nowhere("scada".to_owned()), entry)].into();
    let (access, problems) = Access::build(&SourceText::new("", ""), &entries, table);
    assert_eq!(problems, []);
    access
}

/// Tells a core, whose time stands still, what was refused, until nobody can ask any more.
async fn audit(mut requests: Requests, mut conversation: Conversation) -> Conversation {
    while let Some(request) = requests.next().await {
        match request {
            Request::Refused(refused) => conversation.input(Input::Refused(refused)),
            Request::Command(command, _) => panic!("this got through: {command:?}"),
        }
    }
    conversation
}

async fn attack(desk: Desk, total: usize) {
    let (clock, stop, table) = (Clock::start(), CancellationToken::new(), plant::table(1));
    let (_writer, reader) = process_image(plant::image(&table));
    let any = "127.0.0.1:0".parse().unwrap();
    let secure = Secure::start_with(Some(desk.clone()), |_| ()).await;
    let shared = cia309::connection::Shared {
        table: Arc::clone(&table),
        desk: desk.clone(),
        writes: false,
        clock,
        idle_timeout: None,
    };
    let cia309 = cia309::Server::bind(any, 2, shared).await.unwrap();
    let state = state_of(Arc::clone(&table), reader.clone(), desk.clone(), clock);
    let web = Server::bind(&WebSettings { listen: any, ..WebSettings::default() }, state).await.unwrap();
    let (cia309_at, web_at) = (cia309.local_addr(), web.local_addr());
    let broker = EmbeddedBroker::start(any).await.unwrap();
    let settings = MqttSettings {
        url: format!("mqtt://{}", broker.local_addr()).parse().unwrap(),
        ..MqttSettings::default()
    };
    let publisher = Publisher::new(table, &settings, Identity { sid: "s".into(), ..Identity::default() });
    let (status, mut session) = watch::channel(MqttStatus::default());
    let mqtt = {
        let (desk, stop) = (desk.clone(), stop.clone());
        let pace = Pace { first: Duration::from_millis(20), ..Pace::default() };
        let exchanges = tokio::sync::mpsc::channel(1).1;
        Box::pin(run(settings, "hall-1", publisher, reader, desk, clock, stop, status, None, exchanges, pace))
    };
    let tasks =
        [tokio::spawn(mqtt), tokio::spawn(cia309.run(stop.clone())), tokio::spawn(web.run(stop.clone()))];
    session.wait_for(|status| status.connected).await.unwrap();
    let probe = Probe::start(broker.local_addr(), "probe").await;
    // The gateway subscribes right after it is connected.
    let online = |seen: &super::support::mosquitto::Seen| seen.topic.ends_with("bridge/info");
    probe.wait_for("the gateway is there", 0, online).await;
    let each = total / 5;
    tokio::join!(
        by_modbus(secure.plain, total - 4 * each),
        by_secure_modbus(&secure, each),
        by_http(web_at, each),
        by_cia309(cia309_at, each),
        by_mqtt(&probe, &desk, each),
    );
    stop.cancel();
    secure.stop.cancel();
    for task in tasks.into_iter().chain([secure.task]) {
        task.await.unwrap();
    }
}

#[tokio::test]
async fn must_hold_no_attempt_without_a_right_sends_a_frame_and_all_stand_in_the_audit_whatever_the_door() {
    let total = attempts();
    let (desk, commands) = Desk::new(32);
    let requests = Requests::new(&desk, commands);
    desk.set_access(Arc::new(access(&plant::table(1))));
    let counts = desk.clone();
    let attack = async {
        attack(desk, total).await;
        let counted: u64 = counts.refused().into_iter().map(|(_, count)| count).sum();
        drop(counts);
        counted
    };
    let (mut conversation, counted) = tokio::join!(audit(requests, running(detcon())), attack);
    let expected = u64::try_from(total).unwrap();
    assert_eq!(counted, expected);
    let asked_until = conversation.now_millis();
    conversation.run_to(asked_until + 61_000);
    assert_eq!(commands_sent(&conversation), [""; 0]);
    let events = conversation.events();
    assert_eq!(forbidden(&events), expected);
    for door in [
        "modbus 127.0.0.1",
        "web 127.1.",
        "cia309 127.0.0.1",
        "mqtt cangate/hall-1/bridge/request/nmt as scada",
    ] {
        assert!(events.iter().any(|event| event.from.starts_with(door)), "{door}");
    }
    for verb in ["write", "sdo_read", "sdo_write", "nmt", "read", "acknowledge_all"] {
        assert!(events.iter().any(|event| event.name == verb && event.to == "forbidden"), "{verb}");
    }
    println!("{total} attempts, {} events, 0 frames", events.len());
}
