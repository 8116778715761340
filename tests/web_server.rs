//! Health, metrics, the JSON interface and the page, over loopback sockets.

use std::net::SocketAddr;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use cangate::canopen::emcy::Emergency;
use cangate::gateway::Desk;
use cangate::process_image::handles::process_image;
use cangate::process_image::{
    AlarmState, AlarmStatus, ImageWriter, ProcessImage, Quality, Reason, Revision, Sample, Value,
};
use cangate::time::Clock;
use cangate::web::server::{OPENAPI, ROUTES};
use cangate::web::{
    About, ProgramHealth, Reading, ReadingKind, Server, SessionHealth, WebSettings, WebState,
};
use serde_json::{Value as Json, json};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;
use tokio::task::JoinHandle;
use tokio_util::sync::CancellationToken;

use crate::support::plant;
use crate::support::secure_web::state;

struct Web {
    address: SocketAddr,
    writer: ImageWriter,
    health: Arc<Mutex<ProgramHealth>>,
    stop: CancellationToken,
    task: JoinHandle<()>,
}

struct Answer {
    code: u16,
    head: String,
    body: String,
}

impl Answer {
    fn json(&self) -> Json {
        serde_json::from_str(&self.body).unwrap()
    }
}

impl Web {
    async fn start() -> Self {
        let table = plant::table(2);
        let (writer, reader) = process_image(plant::image(&table));
        let health = Arc::new(Mutex::new(ProgramHealth::default()));
        let source = Arc::clone(&health);
        let state = WebState {
            table,
            reader,
            desk: Desk::new(1).0,
            clock: Clock::start(),
            about: About {
                version: "0.1.0".into(),
                map_version: 1,
                map_hash: "00c0ffee".into(),
                ..About::default()
            },
            health: Arc::new(move || source.lock().unwrap().clone()),
            map_json: r#"{"version":1}"#.into(),
            map_csv: "node,tag\n".into(),
        };
        let settings = WebSettings {
            listen: "127.0.0.1:0".parse().unwrap(),
            allowed_hosts: vec!["gateway.plant.example".into()],
            ..WebSettings::default()
        };
        let server = Server::bind(&settings, state).await.unwrap();
        let (address, stop) = (server.local_addr(), CancellationToken::new());
        let task = tokio::spawn(server.run(stop.clone()));
        Self { address, writer, health, stop, task }
    }

    async fn request(&self, line: &str) -> Answer {
        self.request_of(line, "Host: 127.0.0.1\r\n").await
    }

    async fn request_of(&self, line: &str, header: &str) -> Answer {
        let mut stream = TcpStream::connect(self.address).await.unwrap();
        let request = format!("{line} HTTP/1.1\r\n{header}Connection: close\r\n\r\n");
        stream.write_all(request.as_bytes()).await.unwrap();
        let mut text = String::new();
        stream.read_to_string(&mut text).await.unwrap();
        let (head, body) = text.split_once("\r\n\r\n").unwrap();
        let code = head.split(' ').nth(1).unwrap().parse().unwrap();
        Answer { code, head: head.to_ascii_lowercase(), body: body.to_owned() }
    }

    async fn get(&self, path: &str) -> Answer {
        self.request(&format!("GET {path}")).await
    }

    /// Asks until the answer is of the image as it is now: for a moment an answer is used again.
    async fn fresh(&self, path: &str, is_fresh: impl Fn(&Json) -> bool) -> Json {
        let asking = async {
            loop {
                let answer = self.get(path).await.json();
                if is_fresh(&answer) {
                    return answer;
                }
                // No faster than an address may ask.
                tokio::time::sleep(Duration::from_millis(20)).await;
            }
        };
        tokio::time::timeout(Duration::from_secs(60), asking).await.expect("in time")
    }

    fn change(&mut self, change: impl FnOnce(&mut ProcessImage)) {
        self.writer.apply(|image| {
            image.revision = Revision(image.revision.0 + 1);
            change(image);
        });
    }
}

#[tokio::test]
async fn every_route_answers_and_is_described_and_every_description_is_a_route() {
    let web = Web::start().await;
    let described: Json = serde_json::from_str(OPENAPI).unwrap();
    let paths: Vec<_> = described["paths"].as_object().unwrap().keys().cloned().collect();
    let mut routes = ROUTES.map(str::to_owned).to_vec();
    routes.sort();
    let mut sorted = paths.clone();
    sorted.sort();
    assert_eq!(sorted, routes);
    for path in paths {
        let answer = web.get(&path.replace("{name}", "engine1")).await;
        if described["paths"][&path].get("get").is_none() {
            assert_eq!(answer.code, 405, "{path}");
            continue;
        }
        assert_eq!(answer.code, 200, "{path}");
        let described = described["paths"][&path]["get"]["responses"]["200"]["content"].as_object().unwrap();
        let kind = described.keys().next().unwrap();
        assert!(answer.head.contains(&format!("content-type: {kind}")), "{path}: {}", answer.head);
    }
}

#[tokio::test]
async fn what_the_interface_says_is_as_its_description_promises() {
    let mut web = Web::start().await;
    web.change(|image| {
        image.tags[0] = Sample::NEVER;
        image.tags[5].quality = Quality::Stale(Reason::PdoTimeout);
        plant::lose(image, &plant::table(2), 1, plant::at(10));
        plant::happen(image, 3);
    });
    web.health.lock().unwrap().mqtt = Some(SessionHealth::default());
    let openapi: Json = serde_json::from_str(OPENAPI).unwrap();
    for (path, schema) in
        [
            ("/api/v1/status", json!({"$ref": "#/components/schemas/Status"})),
            ("/api/v1/nodes/engine2", json!({"$ref": "#/components/schemas/Node"})),
            (
                "/api/v1/alarms",
                openapi["paths"]["/api/v1/alarms"]["get"]["responses"]["200"]["content"]["application/json"]
                    ["schema"]
                    .clone(),
            ),
            (
                "/api/v1/events?after=1",
                openapi["paths"]["/api/v1/events"]["get"]["responses"]["200"]["content"]["application/json"]
                    ["schema"]
                    .clone(),
            ),
        ]
    {
        let mut schema = schema;
        schema["components"] = openapi["components"].clone();
        let validator = jsonschema::validator_for(&schema).unwrap();
        let answer = web.get(path).await.json();
        let wrong: Vec<_> =
            validator.iter_errors(&answer).map(|error| format!("{}: {error}", error.instance_path)).collect();
        assert_eq!(wrong, [""; 0], "{path}");
    }
    let described = openapi["components"]["schemas"].as_object().unwrap();
    let status = web.get("/api/v1/status").await.json();
    for (name, shown) in [
        ("Status", &status),
        ("Node", &status["nodes"][0]),
        ("Tag", &status["nodes"][0]["tags"][0]),
        ("Bus", &status["buses"][0]),
        ("Alarm", &status["alarms"][0]),
        ("Event", &status["events"][0]),
    ] {
        let promised: Vec<_> = described[name]["properties"].as_object().unwrap().keys().collect();
        let mut said: Vec<_> = shown.as_object().unwrap().keys().collect();
        said.sort();
        let mut promised = promised;
        promised.sort();
        assert_eq!(said, promised, "{name}");
    }
}

#[tokio::test]
async fn r_dst_078_a_node_shows_its_errors_and_those_that_were() {
    let mut web = Web::start().await;
    web.change(|image| {
        for (millis, data) in
            [(1, [0x11, 0xF0, 0x21, 1]), (2, [0x11, 0xF0, 0x21, 1]), (3, [0x00, 0x40, 0x29, 0])]
        {
            let emergency = Emergency::decode(&data).unwrap();
            image.nodes[0].errors.handle_message(plant::at(millis).utc, emergency, None);
        }
    });
    let errors = &web.get("/api/v1/nodes/engine1").await.json()["errors"];
    let first = json!({
        "ts": plant::at(1).utc.as_millis(), "code": "0xF011", "meaning": "additional functions", "name": null,
        "register": 0x21, "vendor": "0100000000", "count": 2,
    });
    assert_eq!(errors["active"][0], first);
    let codes = |list: &str| -> Vec<Json> {
        errors[list].as_array().unwrap().iter().map(|error| error["code"].clone()).collect()
    };
    assert_eq!(codes("active"), ["0xF011", "0x4000"]);
    assert_eq!(codes("history"), ["0x4000", "0xF011"]);
    let openapi: Json = serde_json::from_str(OPENAPI).unwrap();
    let mut schema = json!({"type": "array", "items": {"$ref": "#/components/schemas/DeviceError"}});
    schema["components"] = openapi["components"].clone();
    assert!(jsonschema::validator_for(&schema).unwrap().is_valid(&errors["active"]));
}

#[tokio::test]
async fn status_shows_values_with_quality_reason_and_age() {
    let mut web = Web::start().await;
    web.change(|image| {
        image.tags[1].value = Value::Bool(false);
        image.tags[2] = Sample::NEVER;
        image.tags[3].quality = Quality::Stale(Reason::PdoTimeout);
        image.tags[4].value = Value::Float(f64::NAN);
    });
    let status = web.get("/api/v1/status").await.json();
    assert_eq!((&status["gateway"], &status["map_hash"]), (&json!("hall-1"), &json!("00c0ffee")));
    let tags = &status["nodes"][0]["tags"];
    assert_eq!(tags[0]["value"], 12.55);
    assert_eq!(
        (&tags[0]["unit"], &tags[0]["quality"], &tags[0]["valid"]),
        (&json!("%"), &json!("good"), &json!(false))
    );
    assert_eq!(
        (&tags[2]["value"], &tags[2]["reason"], &tags[2]["age_ms"]),
        (&Json::Null, &json!("never_received"), &Json::Null)
    );
    assert_eq!((&tags[3]["quality"], &tags[3]["reason"]), (&json!("stale"), &json!("pdo_timeout")));
    assert_eq!(status["nodes"][1]["tags"][0]["value"], Json::Null, "no number");
    assert_eq!(status["nodes"][0]["quality"], "bad");
    assert!(tags[0]["age_ms"].is_u64());
}

#[tokio::test]
async fn alarms_that_are_not_normal_are_in_the_status_and_all_in_the_list() {
    let mut web = Web::start().await;
    assert_eq!(web.get("/api/v1/status").await.json()["alarms"], json!([]));
    web.change(|image| {
        image.alarms[1] =
            AlarmStatus { state: AlarmState::Unacknowledged, count: 2, ..AlarmStatus::default() };
    });
    let status = web.fresh("/api/v1/status", |status| status["revision"] == 2).await;
    let shown = &status["alarms"];
    assert_eq!(shown.as_array().unwrap().len(), 1);
    assert_eq!(
        (&shown[0]["bus"], &shown[0]["name"], &shown[0]["active"]),
        (&json!("can0"), &json!("bus_off"), &json!(true))
    );
    assert_eq!(web.get("/api/v1/alarms").await.json()["alarms"].as_array().unwrap().len(), 8);
}

#[tokio::test]
async fn events_are_read_after_a_number_and_a_late_reader_learns_what_it_missed() {
    let mut web = Web::start().await;
    web.change(|image| plant::happen(image, 1030));
    let answer = web.get("/api/v1/events?after=1028").await.json();
    assert_eq!(
        answer["events"]
            .as_array()
            .unwrap()
            .iter()
            .map(|event| event["seq"].as_u64().unwrap())
            .collect::<Vec<_>>(),
        [1029, 1030]
    );
    assert_eq!((&answer["newest"], &answer["missed"]), (&json!(1030), &json!(0)));
    assert_eq!(web.get("/api/v1/events").await.json()["missed"], 6);
    for wrong in ["after=-1", "after=x", "before=1", "after="] {
        let answer = web.get(&format!("/api/v1/events?{wrong}")).await;
        assert_eq!(answer.code, 400, "{wrong}");
        assert!(answer.json()["error"].is_string());
    }
}

#[tokio::test]
async fn readiness_tells_its_reasons() {
    let web = Web::start().await;
    web.health.lock().unwrap().not_ready = vec!["the Modbus port is not bound".into()];
    let answer = web.get("/readyz").await;
    assert_eq!(
        (answer.code, answer.json()),
        (503, json!({"ready": false, "reasons": ["the Modbus port is not bound"]}))
    );
    assert_eq!(web.get("/livez").await.code, 200, "alive all the same");
    web.health.lock().unwrap().not_ready.clear();
    let answer = web.get("/readyz").await;
    assert_eq!((answer.code, answer.json()), (200, json!({"ready": true, "reasons": []})));
}

#[tokio::test]
async fn metrics_name_every_part() {
    let mut web = Web::start().await;
    web.change(|image| plant::lose(image, &plant::table(2), 1, plant::at(10)));
    {
        let mut health = web.health.lock().unwrap();
        health.mqtt = Some(SessionHealth { connected: true, ..SessionHealth::default() });
        for (class, value) in [("event", 7.0), ("sample", 8.0)] {
            health.readings.push(Reading {
                name: "mqtt_dropped",
                help: "Messages dropped because the outbox was full",
                kind: ReadingKind::Counter,
                labels: vec![("class", class.into())],
                value,
            });
        }
    }
    let text = web.get("/metrics").await.body;
    for line in [
        r#"cangate_build_info{version="0.1.0",gateway="hall-1",map_hash="00c0ffee"} 1.0"#,
        r#"cangate_bus_state{bus="can0"} 4.0"#,
        r#"cangate_bus_load_ratio{bus="can0"} 0.123"#,
        r#"cangate_bus_frames_received_total{bus="can0"} 1000.0"#,
        r#"cangate_node_online{node="engine1"} 1.0"#,
        r#"cangate_node_online{node="engine2"} 0.0"#,
        r#"cangate_node_nmt_state{node="engine1"} 5.0"#,
        r#"cangate_node_nmt_state{node="engine2"} -1.0"#,
        r#"cangate_node_quality{node="engine2"} 3.0"#,
        r#"cangate_node_pdo_stale{node="engine1",pdo="1"} 0.0"#,
        r#"cangate_alarm_active{owner="engine2",alarm="node_lost",priority="high"} 1.0"#,
        "cangate_mqtt_connected 1.0",
        r#"cangate_mqtt_dropped_total{class="event"} 7.0"#,
        r#"cangate_mqtt_dropped_total{class="sample"} 8.0"#,
        "# TYPE cangate_mqtt_dropped counter",
        "# EOF",
    ] {
        assert!(text.lines().any(|of| of == line), "{line}\nis not in\n{text}");
    }
    assert!(text.contains(r#"cangate_node_pdo_age_seconds{node="engine1",pdo="1"} "#));
    assert_eq!(text.matches("# HELP cangate_mqtt_dropped ").count(), 1, "one head for each family");
}

#[tokio::test]
async fn the_maps_are_what_was_handed_in() {
    let web = Web::start().await;
    assert_eq!(web.get("/map.json").await.body, r#"{"version":1}"#);
    assert_eq!(web.get("/map.csv").await.body, "node,tag\n");
}

#[tokio::test]
async fn whatever_is_not_there_or_would_change_something_is_refused_in_json() {
    let web = Web::start().await;
    for (line, code) in [
        ("GET /nothing", 404),
        ("GET /api/v1/nodes/engine9", 404),
        ("GET /api/v1/nodes/..%2f..%2fetc", 404),
        ("GET /api/v1/nodes/%FF", 404),
        ("POST /api/v1/status", 405),
        ("DELETE /api/v1/alarms", 405),
        ("PUT /", 405),
    ] {
        let answer = web.request(line).await;
        assert_eq!(answer.code, code, "{line}");
        assert!(answer.json()["error"].is_string(), "{line}");
    }
}

#[tokio::test]
async fn every_answer_carries_the_careful_headers() {
    let web = Web::start().await;
    for path in ["/", "/livez", "/metrics", "/api/v1/status", "/nothing", "/map.csv"] {
        let head = web.get(path).await.head;
        for header in [
            "cache-control: no-store",
            "x-content-type-options: nosniff",
            "x-frame-options: deny",
            "content-security-policy: default-src 'none';",
        ] {
            assert!(head.contains(header), "{path} lacks {header}");
        }
    }
}

#[tokio::test]
async fn the_page_is_whole_and_lets_no_text_become_markup() {
    let web = Web::start().await;
    let (one, two) = (web.get("/").await, web.get("/").await);
    let nonce = |answer: &Answer| answer.head.split("script-src 'nonce-").nth(1).unwrap()[..32].to_owned();
    assert_ne!(nonce(&one), nonce(&two));
    assert_eq!(one.body.matches(&format!(r#"nonce="{}""#, nonce(&one))).count(), 2);
    assert!(!one.body.contains("{nonce}"));
    for wrong in [
        "http://",
        "https://",
        "innerHTML",
        "outerHTML",
        "insertAdjacentHTML",
        "document.write",
        "eval(",
        " src=",
        "style=",
        "onclick=",
    ] {
        assert!(!one.body.contains(wrong), "the page contains `{wrong}`");
    }
}

#[tokio::test]
async fn connections_that_never_finish_their_request_do_not_keep_others_out() {
    let web = Web::start().await;
    let mut dribbling = Vec::new();
    for _ in 0..200 {
        let mut stream = TcpStream::connect(web.address).await.unwrap();
        stream.write_all(b"GET / HTTP/1.1\r\nX-").await.unwrap();
        dribbling.push(stream);
        // Those that are still open go on as slowly as they can.
        for stream in &mut dribbling {
            let _ = stream.write_all(b"x").await;
        }
    }
    for _ in 0..10 {
        let asked = tokio::time::timeout(Duration::from_secs(5), web.get("/livez")).await;
        assert_eq!(asked.expect("at once").code, 200);
    }
}

#[tokio::test]
async fn a_page_from_elsewhere_cannot_ask_under_its_own_name() {
    let web = Web::start().await;
    for (host, code) in [
        ("Host: 127.0.0.1:8080\r\n", 200),
        ("Host: localhost\r\n", 200),
        ("Host: hall-1:80\r\n", 200),
        ("Host: gateway.plant.example\r\n", 200),
        ("", 200),
        ("Host: evil.example\r\n", 421),
        ("Host: 127.0.0.1.evil.example:80\r\n", 421),
    ] {
        let answer = web.request_of("GET /api/v1/status", host).await;
        assert_eq!(answer.code, code, "{host}");
        if code == 421 {
            assert!(answer.json()["error"].as_str().unwrap().contains("allowed_hosts"));
        }
    }
}

#[tokio::test]
async fn a_value_whose_validity_is_not_known_is_not_called_valid() {
    let mut web = Web::start().await;
    web.change(|image| image.tags[1].quality = Quality::Stale(Reason::PdoTimeout));
    let tags = &web.get("/api/v1/nodes/engine1").await.json()["tags"];
    assert_eq!(
        (&tags[0]["quality"], &tags[0]["valid"], &tags[0]["reason"]),
        (&json!("good"), &json!(false), &json!("pdo_timeout"))
    );
}

#[tokio::test]
async fn garbage_is_answered_with_an_error_or_a_close() {
    let web = Web::start().await;
    for bytes in
        [&b"\x00\x01\x02\r\n\r\n"[..], b"GET / HTTP/9.9\r\n\r\n", b"GET\r\n\r\n", b"\x16\x03\x01\x02\x00\x01"]
    {
        let mut stream = TcpStream::connect(web.address).await.unwrap();
        stream.write_all(bytes).await.unwrap();
        stream.shutdown().await.unwrap();
        let mut answer = Vec::new();
        let _ = stream.read_to_end(&mut answer).await;
        assert!(answer.is_empty() || answer.starts_with(b"HTTP/1.1 400"), "{answer:?}");
    }
    assert_eq!(web.get("/livez").await.code, 200);
}

#[tokio::test]
async fn a_taken_port_is_a_message_that_says_so() {
    let web = Web::start().await;
    let taken = WebSettings { listen: web.address, ..WebSettings::default() };
    let (state, _writer) = state(plant::table(1), Desk::new(1).0);
    let error = Server::bind(&taken, state).await.unwrap_err().to_string();
    assert!(error.contains(&web.address.to_string()) && error.contains("is the port taken?"), "{error}");
}

#[tokio::test]
async fn a_stop_ends_the_server_even_with_open_connections() {
    let web = Web::start().await;
    let mut open = TcpStream::connect(web.address).await.unwrap();
    open.write_all(b"GET /livez HTTP/1.1\r\nHost: test\r\n\r\n").await.unwrap();
    assert!(open.read(&mut [0; 16]).await.unwrap() > 0);
    web.stop.cancel();
    tokio::time::timeout(Duration::from_secs(60), web.task).await.expect("in time").unwrap();
}
