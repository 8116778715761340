//! Logging in to the page: passwords, sessions, guesses, requests from elsewhere, and who may read.

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use cangate::access::{Access, AccessEntry, PasswordHash, Role, SecretText};
use cangate::gateway::{Command, Desk, Outcome};
use cangate::mapping::{At, SourceText};
use cangate::process_image::ImageWriter;
use cangate::time::Clock;
use cangate::web::server::ROUTES;
use cangate::web::{Readers, Server, WebSettings};
use serde_json::{Value, json};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;
use tokio::sync::{mpsc, oneshot};
use tokio_util::sync::CancellationToken;

use crate::support::http::{Answer, converse};
use crate::support::secure_web::{SecureWeb, state};
use crate::support::{PATIENCE, plant};

const PASSWORD: &str = "correct horse battery";
const OTHER: &str = "staple staple staple";
const TOKEN: &str = "0123456789abcdef-token";
const JSON: &str = "Content-Type: application/json\r\n";

fn hash(password: &str) -> PasswordHash {
    PasswordHash::of(password, [7; 16]).unwrap()
}

/// maria, an operator, by password; jo, a viewer, by a file with one; scada, an engineer, by token.
fn access(folder: &std::path::Path, maria: Role, password: &str) -> Access {
    let file = |name: &str| Some(At::nowhere(folder.join(name).display().to_string()));
    let maria = AccessEntry {
        role: maria,
        password: Some(At::nowhere(SecretText(hash(password).as_str().to_owned()))),
        ..AccessEntry::default()
    };
    let jo = AccessEntry { role: Role::Viewer, password_file: file("jo"), ..AccessEntry::default() };
    let scada = AccessEntry { role: Role::Engineer, token_file: file("scada"), ..AccessEntry::default() };
    let entries = [("maria", maria), ("jo", jo), ("scada", scada)];
    let entries = entries.map(|(name, entry)| (At::nowhere(name.to_owned()), entry)).into();
    let (access, problems) = Access::build(&SourceText::new("", ""), &entries, &plant::table(1));
    assert_eq!(problems, []);
    access
}

struct Door {
    address: SocketAddr,
    desk: Desk,
    queue: mpsc::Receiver<(Command, oneshot::Sender<Outcome>)>,
    folder: tempfile::TempDir,
    stop: CancellationToken,
    _writer: ImageWriter,
}

impl Drop for Door {
    fn drop(&mut self) {
        self.stop.cancel();
    }
}

async fn door(change: impl FnOnce(&mut WebSettings)) -> Door {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("jo"), format!("{}\n", hash(OTHER).as_str())).unwrap();
    std::fs::write(folder.path().join("scada"), TOKEN).unwrap();
    let (desk, queue) = Desk::new(8);
    desk.set_access(Arc::new(access(folder.path(), Role::Operator, PASSWORD)));
    let (state, writer) = state(plant::table(1), desk.clone());
    let mut settings = WebSettings { listen: "127.0.0.1:0".parse().unwrap(), ..WebSettings::default() };
    change(&mut settings);
    let server = Server::bind(&settings, state).await.unwrap();
    let (address, stop) = (server.local_addr(), CancellationToken::new());
    tokio::spawn(server.run(stop.clone()));
    Door { address, desk, queue, folder, stop, _writer: writer }
}

async fn ask(address: SocketAddr, line: &str, headers: &str, body: &str) -> Answer {
    converse(TcpStream::connect(address).await.unwrap(), line, headers, body).await
}

async fn log_in(address: SocketAddr, name: &str, password: &str) -> Answer {
    let body = json!({"name": name, "password": password}).to_string();
    ask(address, "POST /api/v1/login", JSON, &body).await
}

/// A command as the page sends it: its code.
async fn command(address: SocketAddr, headers: &str) -> Answer {
    let headers = format!("{JSON}{headers}");
    ask(address, "POST /api/v1/commands/acknowledge_all", &headers, "{}").await
}

const OURS: &str = "Origin: http://localhost\r\nSec-Fetch-Site: same-origin\r\n";

/// Answers every command that gets through; the names of those who asked.
fn attend(door: &mut Door) -> mpsc::Receiver<String> {
    let (told, names) = mpsc::channel(64);
    let mut queue = std::mem::replace(&mut door.queue, mpsc::channel(1).1);
    tokio::spawn(async move {
        while let Some((command, reply)) = queue.recv().await {
            let _ = told.try_send(command.source.to_string());
            let _ = reply.send(Outcome::Done);
        }
    });
    names
}

#[tokio::test]
async fn cr_1_1_who_logs_in_commands_under_the_name_of_its_table_until_it_logs_out() {
    let mut door = door(|_| {}).await;
    let mut names = attend(&mut door);
    let at = door.address;
    let session = ask(at, "GET /api/v1/session", "", "").await.json();
    assert_eq!(session, json!({"v": 1, "login": "offered", "read": "anyone", "name": null, "role": null}));
    let answer = log_in(at, "maria", PASSWORD).await;
    assert_eq!((answer.code, &answer.json()["role"]), (200, &json!("operator")));
    assert!(!answer.body.contains("argon2") && !answer.body.contains(PASSWORD));
    for part in ["cangate-hall-1=", "; Path=/;", "; HttpOnly;", "; SameSite=Strict;", "; Max-Age=43200"] {
        assert!(answer.head.contains(part), "{part}: {}", answer.head);
    }
    assert!(!answer.head.contains("Secure"), "a browser would not send it back without TLS");
    let cookie = answer.cookie();
    assert_eq!(ask(at, "GET /api/v1/session", &cookie, "").await.json()["name"], "maria");
    // A proxy before us may have a login of its own.
    let done = command(at, &format!("{cookie}{OURS}Authorization: Basic cHJveHk6eA==\r\n")).await;
    assert_eq!((done.code, &done.json()["result"]), (200, &json!("ok")));
    let name = names.recv().await.unwrap();
    assert!(name.starts_with("web 127.0.0.1:") && name.ends_with(" as maria"), "{name}");
    // A viewer has a session, and no right.
    let jo = log_in(at, "jo", OTHER).await.cookie();
    assert_eq!(command(at, &format!("{jo}{OURS}")).await.code, 403);
    let out = ask(at, "POST /api/v1/logout", &format!("{JSON}{cookie}{OURS}"), "{}").await;
    assert!(out.code == 200 && out.head.contains("Max-Age=0"), "{}", out.head);
    assert_eq!(command(at, &format!("{cookie}{OURS}")).await.code, 401);
    assert_eq!(command(at, &format!("{jo}{OURS}")).await.code, 403, "others stay");
    assert!(names.try_recv().is_err());
}

#[tokio::test]
async fn cr_1_10_unknown_names_and_wrong_passwords_get_the_same_answer_after_the_same_work() {
    let door = door(|_| {}).await;
    let (mut answers, clock) = (Vec::new(), Clock::start());
    let mut took = [Duration::MAX; 2];
    for (place, (name, password)) in
        [("maria", OTHER), ("nobody", PASSWORD), ("scada", TOKEN), ("maria", "")].into_iter().enumerate()
    {
        let before = clock.now().instant;
        answers.push(log_in(door.address, name, password).await);
        let least = &mut took[place % 2];
        *least = clock.now().instant.since(before).min(*least);
    }
    assert!(answers.iter().all(|answer| *answer == answers[0]), "{answers:?}");
    assert_eq!(answers[0].code, 401);
    // Without the work an unknown name would be answered in a hundredth of the time.
    assert!(took[1] > took[0] / 10, "{took:?}");
}

#[tokio::test]
async fn cr_1_11_five_wrong_logins_shut_the_address_out_of_passwords_and_tokens() {
    let door = door(|_| {}).await;
    let at = door.address;
    let session = log_in(at, "maria", PASSWORD).await.cookie();
    for name in ["maria", "x", "jo", "maria", "y"] {
        assert_eq!(log_in(at, name, "wrong wrong wrong").await.code, 401);
    }
    let answer = log_in(at, "maria", PASSWORD).await;
    assert!(answer.code == 429 && answer.head.contains("retry-after: 60"), "{}", answer.head);
    let token = format!("Authorization: Bearer {TOKEN}\r\n");
    assert_eq!(command(at, &token).await.code, 429);
    assert_eq!(ask(at, "GET /api/v1/session", &session, "").await.json()["name"], "maria", "who is in stays");
    let refused: u64 = door.desk.refused().into_iter().map(|(_, count)| count).sum();
    assert_eq!(refused, 7, "each is told to the journal");
}

#[tokio::test]
async fn s6_a_session_is_no_good_for_requests_of_other_pages() {
    let mut door = door(|_| {}).await;
    let mut names = attend(&mut door);
    let at = door.address;
    let cookie = log_in(at, "maria", PASSWORD).await.cookie();
    for (headers, code) in [
        (String::new(), 403),
        ("Origin: null\r\n".to_owned(), 403),
        ("Origin: http://evil.example\r\n".to_owned(), 403),
        ("Origin: http://localhost:81\r\n".to_owned(), 403),
        ("Origin: localhost\r\n".to_owned(), 403),
        ("Sec-Fetch-Site: cross-site\r\n".to_owned(), 403),
        ("Sec-Fetch-Site: none\r\n".to_owned(), 403),
        ("Origin: http://localhost\r\nSec-Fetch-Site: same-site\r\n".to_owned(), 403),
        ("Origin: http://localhost\r\n".to_owned(), 200),
        ("Sec-Fetch-Site: same-origin\r\n".to_owned(), 200),
        // A proxy before us that speaks TLS.
        ("Origin: https://localhost\r\n".to_owned(), 200),
    ] {
        assert_eq!(command(at, &format!("{cookie}{headers}")).await.code, code, "{headers}");
        assert_eq!(names.try_recv().is_ok(), code == 200, "{headers}");
    }
    let plain = format!("Content-Type: text/plain\r\n{cookie}{OURS}");
    assert_eq!(ask(at, "POST /api/v1/commands/acknowledge_all", &plain, "{}").await.code, 415);
    // Nor is a login made from elsewhere.
    let body = json!({"name": "maria", "password": PASSWORD}).to_string();
    for (headers, code) in [
        ("Content-Type: text/plain\r\n".to_owned(), 415),
        (format!("{JSON}Origin: http://evil.example\r\n"), 403),
        (format!("{JSON}Origin: http://localhost\r\n"), 200),
    ] {
        assert_eq!(ask(at, "POST /api/v1/login", &headers, &body).await.code, code, "{headers}");
    }
    for body in
        ["", "17", "{}", r#"{"name":"maria"}"#, r#"{"name":"maria","password":"x","role":"engineer"}"#]
    {
        let answer = ask(at, "POST /api/v1/login", JSON, body).await;
        assert_eq!(answer.code, 400, "{body}");
    }
    let login = |length: usize| {
        let rest = json!({"name": "maria", "password": ""}).to_string().len();
        json!({"name": "maria", "password": "x".repeat(length - rest)}).to_string()
    };
    assert_eq!(ask(at, "POST /api/v1/login", JSON, &login(4096)).await.code, 401);
    let answer = ask(at, "POST /api/v1/login", JSON, &login(4097)).await;
    assert_eq!((answer.code, &answer.json()["error"]), (413, &json!("a request has at most 4096 bytes")));
}

#[tokio::test]
async fn s11_another_role_another_password_or_no_table_counts_at_the_next_request() {
    let mut door = door(|_| {}).await;
    let _names = attend(&mut door);
    let (at, folder) = (door.address, door.folder.path().to_owned());
    let maria = format!("{}{OURS}", log_in(at, "maria", PASSWORD).await.cookie());
    let jo = log_in(at, "jo", OTHER).await.cookie();
    assert_eq!(command(at, &maria).await.code, 200);
    door.desk.set_access(Arc::new(access(&folder, Role::Viewer, PASSWORD)));
    assert_eq!(command(at, &maria).await.code, 403, "the session stays, with the new role");
    door.desk.set_access(Arc::new(access(&folder, Role::Operator, OTHER)));
    assert_eq!(command(at, &maria).await.code, 401);
    door.desk.set_access(Arc::new(access(&folder, Role::Operator, PASSWORD)));
    assert_eq!(command(at, &maria).await.code, 401, "it does not come back");
    let name = async || ask(at, "GET /api/v1/session", &jo, "").await.json()["name"].clone();
    assert_eq!(name().await, "jo");
    std::fs::write(folder.join("jo"), hash(PASSWORD).as_str()).unwrap();
    assert_eq!(name().await, Value::Null);
    assert_eq!(log_in(at, "jo", OTHER).await.code, 401);
    assert_eq!(log_in(at, "jo", PASSWORD).await.code, 200, "a new password counts at once");
    for content in ["", "plain text", "$argon2id$v=19$"] {
        std::fs::write(folder.join("jo"), content).unwrap();
        assert_eq!(log_in(at, "jo", content).await.code, 401, "{content}");
    }
}

#[tokio::test]
async fn cr_2_1_with_read_for_viewers_nothing_but_health_and_the_login_is_open() {
    let door = door(|settings| settings.read = Readers::Viewer).await;
    let at = door.address;
    let token = format!("Authorization: Bearer {TOKEN}\r\n");
    let cookie = log_in(at, "jo", OTHER).await.cookie();
    let open = ["/", "/livez", "/readyz", "/api/v1/openapi.json", "/api/v1/session"];
    for route in ROUTES.into_iter().chain(["/nothing", "//api/v1/status", "/api/v1/status/", "/livez/"]) {
        let line = format!("GET {}", route.replace("{name}", "engine1").replace("{verb}", "reset"));
        let answer = ask(at, &line, "", "").await;
        let is_login = route.ends_with("/login") || route.ends_with("/logout");
        let expected = if open.contains(&route) {
            200
        } else if is_login {
            405
        } else {
            401
        };
        assert_eq!(answer.code, expected, "{route}");
        if answer.code == 401 {
            assert!(!answer.body.contains("engine1"), "{}", answer.body);
            for known in [&token, &cookie] {
                assert_ne!(ask(at, &line, known, "").await.code, 401, "{route} {known}");
            }
            let head = ask(at, &line.replace("GET", "HEAD"), "", "").await.code;
            assert_eq!(head, 401, "{route}");
        }
    }
    assert_eq!(ask(at, "GET /metrics", &token, "").await.code, 200);
    let wrong = "Authorization: Bearer wrong-wrong-wrong-wrong\r\n";
    for code in [401, 401, 401, 401, 401, 429] {
        assert_eq!(
            ask(at, "GET /metrics", wrong, "").await.code,
            code,
            "tokens are not to be guessed here either"
        );
    }
}

#[tokio::test]
async fn a_flood_of_logins_is_turned_away_and_keeps_nobody_from_reading() {
    let door = door(|_| {}).await;
    let at = door.address;
    let flood: Vec<_> = (0..50)
        .map(|number| {
            tokio::spawn(async move { log_in(at, &format!("name-{number}"), "wrong wrong wrong").await.code })
        })
        .collect();
    let asked = tokio::time::timeout(PATIENCE, ask(at, "GET /livez", "", "")).await.unwrap();
    assert_eq!(asked.code, 200);
    let mut looked_at = 0;
    for task in flood {
        // Whoever found no place was closed without an answer.
        match task.await {
            Ok(401) => looked_at += 1,
            Ok(code) => assert!(code == 429 || code == 503, "{code}"),
            Err(closed) => assert!(closed.is_panic()),
        }
    }
    assert!(looked_at <= 5, "{looked_at}");
}

#[tokio::test]
async fn cr_7_1_who_asks_too_often_is_told_to_wait_but_for_health() {
    let door = door(|_| {}).await;
    // In one go, so that they come faster than any bucket fills.
    let pipelined = async |path: &str, count: usize| {
        let one = format!("GET {path} HTTP/1.1\r\nHost: localhost\r\n\r\n");
        let last = one.replace("\r\n\r\n", "\r\nConnection: close\r\n\r\n");
        let mut stream = TcpStream::connect(door.address).await.unwrap();
        stream.write_all(format!("{}{last}", one.repeat(count - 1)).as_bytes()).await.unwrap();
        let mut answers = String::new();
        stream.read_to_string(&mut answers).await.unwrap();
        answers.split("HTTP/1.1 ").skip(1).map(str::to_owned).collect::<Vec<_>>()
    };
    let answers = pipelined("/nothing", 1000).await;
    let found = answers.iter().filter(|answer| answer.starts_with("404")).count();
    assert!((400..1000).contains(&found), "a page with all that it asks for has room: {found}");
    let late: Vec<_> = answers.iter().filter(|answer| answer.starts_with("429")).collect();
    assert_eq!(late.len() + found, 1000);
    assert!(late.iter().all(|answer| answer.contains("retry-after: 1\r\n")));
    let answers = pipelined("/livez", 1000).await;
    assert_eq!(answers.iter().filter(|answer| answer.starts_with("200")).count(), 1000);
}

#[tokio::test]
async fn over_tls_the_cookie_is_for_tls_only() {
    let web = SecureWeb::start().await;
    let entry = AccessEntry {
        role: Role::Operator,
        password: Some(At::nowhere(SecretText(hash(PASSWORD).as_str().to_owned()))),
        ..AccessEntry::default()
    };
    let entries = [(At::nowhere("maria".to_owned()), entry)].into();
    let (access, _) = Access::build(&SourceText::new("", ""), &entries, &plant::table(1));
    web.desk.set_access(Arc::new(access));
    let body = json!({"name": "maria", "password": PASSWORD}).to_string();
    let answer = converse(web.connect().await.unwrap(), "POST /api/v1/login", JSON, &body).await;
    assert_eq!(answer.code, 200, "{}", answer.body);
    assert!(answer.head.contains("set-cookie: __Host-cangate-hall-1="), "{}", answer.head);
    assert!(answer.head.contains("; Secure"), "{}", answer.head);
    let cookie = answer.cookie();
    let line = "POST /api/v1/commands/acknowledge_all";
    for (origin, is_refused) in [("http://localhost", true), ("https://localhost", false)] {
        let headers = format!("{JSON}{cookie}Origin: {origin}\r\n");
        let answer = converse(web.connect().await.unwrap(), line, &headers, "{}").await;
        assert_eq!(answer.code == 403, is_refused, "{origin}: {}", answer.body);
    }
}
