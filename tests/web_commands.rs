//! Commands by HTTP over a real socket: who gets through to the gateway, and who does not.

use std::sync::Arc;

use cangate::access::{Access, AccessEntry, Role};
use cangate::gateway::{Action, Command, Desk, Outcome};
use cangate::mapping::{At, SourceText};
use cangate::web::{Server, WebSettings};
use tokio::net::TcpStream;
use tokio::sync::{mpsc, oneshot};
use tokio_util::sync::CancellationToken;

use super::support::http::converse;
use super::support::plant;
use super::support::secure_web::state;

const TOKEN: &str = "0123456789abcdef-token";

struct Door {
    address: std::net::SocketAddr,
    desk: Desk,
    queue: mpsc::Receiver<(Command, oneshot::Sender<Outcome>)>,
    file: std::path::PathBuf,
    stop: CancellationToken,
}

impl Drop for Door {
    fn drop(&mut self) {
        self.stop.cancel();
        let _ = std::fs::remove_file(&self.file);
    }
}

/// A server at which the bearer of [`TOKEN`] has this role.
async fn door(name: &str, role: Role) -> Door {
    let file = std::env::temp_dir().join(format!("cangate-{name}-{}.token", std::process::id()));
    std::fs::write(&file, format!("{TOKEN}\n")).unwrap();
    let table = plant::table(1);
    let token_file = Some(At::nowhere(file.display().to_string()));
    let entry = AccessEntry { role, token_file, ..AccessEntry::default() };
    let entries = [(At::nowhere("maria".to_owned()), entry)].into();
    let (access, problems) = Access::build(&SourceText::new("", ""), &entries, &table);
    assert_eq!(problems, []);
    let (desk, queue) = Desk::new(8);
    desk.set_access(Arc::new(access));
    let (state, _writer) = state(table, desk.clone());
    let settings = WebSettings { listen: "127.0.0.1:0".parse().unwrap(), ..WebSettings::default() };
    let server = Server::bind(&settings, state).await.unwrap();
    let (address, stop) = (server.local_addr(), CancellationToken::new());
    tokio::spawn(server.run(stop.clone()));
    Door { address, desk, queue, file, stop }
}

impl Door {
    /// Code and body of the answer to a command with these headers.
    async fn post(&self, verb: &str, headers: &str, body: &str) -> (u16, String) {
        let stream = TcpStream::connect(self.address).await.unwrap();
        let answer = converse(stream, &format!("POST /api/v1/commands/{verb}"), headers, body).await;
        (answer.code, answer.body)
    }

    async fn ask(&self, verb: &str, body: &str) -> (u16, String) {
        let headers = format!("Authorization: Bearer {TOKEN}\r\nContent-Type: application/json\r\n");
        self.post(verb, &headers, body).await
    }

    fn refused(&self) -> u64 {
        self.desk.refused().into_iter().map(|(_, count)| count).sum()
    }
}

#[tokio::test]
async fn the_bearer_of_a_token_is_asked_for_by_name_and_gets_the_outcome() {
    let mut door = door("bearer", Role::Operator).await;
    for (outcome, code, result) in [
        (Outcome::Done, 200, "ok"),
        (Outcome::Busy, 503, "busy"),
        (Outcome::Timeout, 504, "timeout"),
        (Outcome::Rejected("why".into()), 400, "rejected"),
    ] {
        let gateway = async {
            let (command, reply) = door.queue.recv().await.unwrap();
            reply.send(outcome).unwrap();
            command
        };
        let desk = Door {
            address: door.address,
            desk: door.desk.clone(),
            queue: mpsc::channel(1).1,
            file: "".into(),
            stop: CancellationToken::new(),
        };
        let (command, (got, body)) = tokio::join!(gateway, desk.ask("acknowledge_all", "{}"));
        assert!(command.source.to_string().starts_with("web 127.0.0.1:"), "{}", command.source);
        assert!(command.source.to_string().ends_with(" as maria"), "{}", command.source);
        assert_eq!(command.action, Action::AcknowledgeAll { node: None });
        assert_eq!(got, code);
        assert!(body.contains(&format!("\"result\":\"{result}\"")), "{body}");
    }
    assert_eq!(door.refused(), 0);
}

#[tokio::test]
async fn who_has_no_token_no_right_or_no_proper_request_is_refused_and_counted() {
    let mut door = door("refused", Role::Operator).await;
    let json = "Content-Type: application/json\r\n";
    let token = format!("Authorization: Bearer {TOKEN}\r\n");
    let nmt = r#"{"node":"engine1","request":"stop"}"#;
    let long = format!("{{{}}}", " ".repeat(4095));
    for (headers, verb, body, code) in [
        (json.to_owned(), "acknowledge_all", "{}", 401),
        (format!("{json}Authorization: Bearer wrong-wrong-wrong-\r\n"), "acknowledge_all", "{}", 401),
        (format!("{json}Authorization: Basic bWFyaWE6eA==\r\n"), "acknowledge_all", "{}", 401),
        (token.clone(), "acknowledge_all", "{}", 415),
        (format!("{token}Content-Type: text/plain\r\n"), "acknowledge_all", "{}", 415),
        (format!("{token}{json}Origin: http://evil.example\r\n"), "acknowledge_all", "{}", 403),
        (format!("{token}{json}Origin: null\r\n"), "acknowledge_all", "{}", 403),
        (format!("{token}{json}"), "fly", "{}", 404),
        (json.to_owned(), "acknowledge_all", long.as_str(), 401),
        (format!("{token}{json}"), "acknowledge_all", long.as_str(), 413),
        (format!("{token}{json}"), "acknowledge_all", "17", 400),
        (format!("{token}{json}"), "acknowledge_all", r#"{"expires":1}"#, 400),
        (format!("{token}{json}"), "acknowledge", r#"{"node":"engine1","alarm":"nothing"}"#, 404),
        (format!("{token}{json}"), "nmt", nmt, 403),
    ] {
        let (got, body) = door.post(verb, &headers, body).await;
        assert_eq!(got, code, "{verb} {headers} {body}");
    }
    assert_eq!(door.refused(), 14);
    assert!(door.queue.try_recv().is_err(), "not one got through");
}

#[tokio::test]
async fn cr_1_11_five_wrong_tokens_shut_the_address_out() {
    let door = door("guess", Role::Engineer).await;
    let headers = "Authorization: Bearer guess-guess-guess-guess\r\nContent-Type: application/json\r\n";
    for _ in 0..5 {
        assert_eq!(door.post("acknowledge_all", headers, "{}").await.0, 401);
    }
    assert_eq!(door.post("acknowledge_all", headers, "{}").await.0, 429);
    assert_eq!(door.ask("acknowledge_all", "{}").await.0, 429, "the right one is not looked at either");
    assert_eq!(door.refused(), 7);
}

#[tokio::test]
async fn s11_a_token_whose_file_is_gone_lets_nobody_in() {
    let door = door("gone", Role::Engineer).await;
    std::fs::remove_file(&door.file).unwrap();
    assert_eq!(door.ask("acknowledge_all", "{}").await.0, 401);
    std::fs::write(&door.file, "").unwrap();
    assert_eq!(door.ask("acknowledge_all", "{}").await.0, 401);
}
