//! The page over TLS: certificates, their exchange, clients that want something else, and curl as a foreign judge.

use std::process::{Child, Command, Stdio};
use std::time::Duration;

use cangate::gateway::Desk;
use cangate::tls::{Reason, TlsClientSettings};
use cangate::web::{Server, WebSettings};
use serde_json::Value;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;

use crate::support::pki::{Authority, Folder, expires_in};
use crate::support::ports::free_address;
use crate::support::secure_web::{SecureWeb, connect, files, state};
use crate::support::{PATIENCE, plant, until};

#[tokio::test]
async fn cr_4_1_the_page_and_what_it_shows_come_over_tls() {
    let web = SecureWeb::start().await;
    let (code, body) = web.get("/api/v1/status").await.unwrap();
    assert_eq!(code, 200);
    assert_eq!(serde_json::from_str::<Value>(&body).unwrap()["gateway"], "hall-1");
    assert!(web.get("/").await.unwrap().1.contains("<title>cangate</title>"));
    // One connection for several requests.
    let mut stream = web.connect().await.unwrap();
    for _ in 0..3 {
        stream.write_all(b"GET /livez HTTP/1.1\r\nHost: localhost\r\n\r\n").await.unwrap();
        let mut answer = Vec::new();
        while !answer.ends_with(b"}") {
            answer.push(stream.read_u8().await.unwrap());
        }
        assert!(answer.starts_with(b"HTTP/1.1 200"));
    }
}

#[tokio::test]
async fn a_client_that_trusts_another_authority_does_not_go_on() {
    let web = SecureWeb::start().await;
    let ca_file = Some(web.folder.write("other.pem", &Authority::new("other").pem));
    let reason = connect(web.address, TlsClientSettings { ca_file, ..TlsClientSettings::default() }).await;
    assert_eq!(reason.map(|_| ()).unwrap_err(), Reason::UnknownAuthority);
    assert_eq!(web.get("/livez").await.unwrap().0, 200);
}

#[tokio::test]
async fn plain_http_at_the_tls_port_is_told_so_and_gets_nothing_else() {
    let web = SecureWeb::start().await;
    for request in [
        "GET /api/v1/status HTTP/1.1\r\nHost: localhost\r\n\r\n",
        "POST /api/v1/commands/reset HTTP/1.1\r\nHost: localhost\r\nAuthorization: Bearer 0123456789abcdef\r\n\r\n",
    ] {
        let mut stream = TcpStream::connect(web.address).await.unwrap();
        stream.write_all(request.as_bytes()).await.unwrap();
        let mut answer = String::new();
        stream.read_to_string(&mut answer).await.unwrap();
        let (head, body) = answer.split_once("\r\n\r\n").unwrap();
        assert!(head.starts_with("HTTP/1.1 400 "), "{answer}");
        assert!(head.contains(&format!("Content-Length: {}", body.len())), "{answer}");
        assert!(body.contains("https://") && !answer.contains("hall-1"), "{answer}");
    }
    assert_eq!(web.get("/livez").await.unwrap().0, 200);
}

#[tokio::test]
async fn what_is_no_tls_ends_without_harm() {
    let web = SecureWeb::start().await;
    for bytes in [
        &b"\x00\x01\x02\r\n\r\n"[..],
        b"\x16\x03\x01\xff\xff\xff",
        b"\x16\x03\x01\x00\x02\x01\x00",
        b"\x80\x2e\x01",
    ] {
        let mut stream = TcpStream::connect(web.address).await.unwrap();
        stream.write_all(bytes).await.unwrap();
        stream.shutdown().await.unwrap();
        let mut answer = Vec::new();
        let ended = tokio::time::timeout(PATIENCE, stream.read_to_end(&mut answer)).await;
        assert!(ended.is_ok(), "{bytes:?}");
        assert!(!answer.starts_with(b"HTTP"), "{answer:?}");
    }
    assert_eq!(web.get("/livez").await.unwrap().0, 200);
}

#[tokio::test]
async fn s4_f44_handshakes_that_are_never_finished_keep_nobody_out() {
    let web = SecureWeb::start().await;
    let mut idle = Vec::new();
    for _ in 0..200 {
        let mut stream = TcpStream::connect(web.address).await.unwrap();
        let _ = stream.write_all(b"\x16\x03\x01\x02").await;
        idle.push(stream);
    }
    for _ in 0..5 {
        let asked = tokio::time::timeout(PATIENCE, web.get("/livez")).await;
        assert_eq!(asked.expect("at once").unwrap().0, 200);
    }
}

#[tokio::test]
async fn new_files_count_at_the_next_handshake_and_useless_ones_leave_the_old_at_work() {
    let web = SecureWeb::start().await;
    let mut before = web.connect().await.unwrap();
    web.folder.write_pair("gateway", &Authority::new("stranger").host());
    assert_eq!(web.get("/livez").await.unwrap_err(), Reason::UnknownAuthority);
    web.folder.write_pair("gateway", &web.authority.host());
    assert_eq!(web.get("/livez").await.unwrap().0, 200);
    web.folder.write("gateway.key", "-----BEGIN PRIVATE KEY-----\ngarbage\n-----END PRIVATE KEY-----\n");
    assert_eq!(web.get("/livez").await.unwrap().0, 200);
    before.write_all(b"GET /livez HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n").await.unwrap();
    let mut answer = String::new();
    before.read_to_string(&mut answer).await.unwrap();
    assert!(answer.starts_with("HTTP/1.1 200"), "who is connected stays");
}

#[tokio::test]
async fn files_that_cannot_be_used_at_the_start_are_named_before_anything_listens() {
    let (folder, authority) = (Folder::new(), Authority::new("plant"));
    let tls = files(&folder, &authority);
    folder.write_pair("other", &authority.host());
    std::fs::rename(folder.path("other.key"), &tls.key_file).unwrap();
    let settings = WebSettings { listen: "127.0.0.1:0".parse().unwrap(), tls, ..WebSettings::default() };
    let (state, _writer) = state(plant::table(1), Desk::new(1).0);
    let error = Server::bind(&settings, state).await.unwrap_err().to_string();
    assert!(error.contains("gateway.key` does not belong to the certificate in"), "{error}");
}

#[tokio::test]
async fn a_stop_ends_connections_and_handshakes() {
    let web = SecureWeb::start().await;
    let mut open = web.connect().await.unwrap();
    let _idle = TcpStream::connect(web.address).await.unwrap();
    web.stop.cancel();
    tokio::time::timeout(PATIENCE, web.task).await.unwrap().unwrap();
    assert!(!matches!(open.read(&mut [0; 16]).await, Ok(1..)));
}

/// What curl ends with, and what it got.
async fn curl(arguments: &[&str]) -> Option<(i32, String)> {
    let ran = tokio::process::Command::new("curl")
        .args(["--silent", "--show-error", "--max-time", "20", "--noproxy", "*"])
        .args(arguments)
        .stdin(Stdio::null())
        .output()
        .await;
    let Ok(output) = ran else {
        assert!(std::env::var_os("CI").is_none(), "curl is not installed, and CI has to run this test");
        eprintln!("skipped: curl is not installed (apt-get install curl)");
        return None;
    };
    let said =
        format!("{}{}", String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr));
    Some((output.status.code().unwrap(), said))
}

#[tokio::test]
async fn curl_takes_the_right_certificate_and_no_wrong_one() {
    let web = SecureWeb::start().await;
    let (url, ca) = (format!("https://{}/api/v1/alarms", web.address), web.folder.path("ca.pem"));
    let (ca, other) = (ca.display().to_string(), web.folder.write("other.pem", &Authority::new("other").pem));
    let other = other.display().to_string();
    let by_name = format!("https://elsewhere.example:{}/livez", web.address.port());
    let resolve = format!("elsewhere.example:{}:127.0.0.1", web.address.port());
    for (arguments, code, says) in [
        (vec!["--cacert", &ca, &url], 0, "\"alarms\""),
        (vec!["--cacert", &ca, "--tlsv1.3", &url], 0, "\"alarms\""),
        (vec!["--cacert", &ca, "--tls-max", "1.2", &url], 0, "\"alarms\""),
        (vec!["--cacert", &ca, "--http2", &url], 0, "\"alarms\""),
        (vec!["--cacert", &ca, "--tls-max", "1.1", "--ciphers", "DEFAULT:@SECLEVEL=0", &url], 35, ""),
        (vec!["--cacert", &other, &url], 60, ""),
        (vec![&url], 60, ""),
        // Another name than those of the certificate.
        (vec!["--cacert", &ca, "--resolve", &resolve, &by_name], 60, ""),
    ] {
        let Some((got, said)) = curl(&arguments).await else { return };
        assert_eq!(got, code, "{arguments:?}: {said}");
        assert!(said.contains(says), "{arguments:?}: {said}");
    }
    let plain = format!("http://{}/livez", web.address);
    let Some((got, said)) = curl(&[&plain]).await else { return };
    assert!(got == 0 && said.contains("https://"), "{said}");
    // A certificate that has expired is shown all the same, and refused by who knows the time.
    let web = SecureWeb::start_with(|authority| {
        authority.make("localhost", &["127.0.0.1"], |params| expires_in(params, -1))
    })
    .await;
    let (url, ca) =
        (format!("https://{}/livez", web.address), web.folder.path("ca.pem").display().to_string());
    let Some((got, said)) = curl(&["--cacert", &ca, &url]).await else { return };
    assert_eq!(got, 60, "{said}");
}

/// A program that does not outlive its test.
struct Running(Child);

impl Drop for Running {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

#[tokio::test]
async fn the_program_serves_tls_watches_its_certificate_and_asks_itself_whether_it_is_well() {
    let (folder, authority) = (Folder::new(), Authority::new("plant"));
    let tls = files(&folder, &authority);
    let ca = folder.write("ca.pem", &authority.pem);
    let http = free_address();
    let configuration = format!(
        "version = 1\n[gateway]\nname = \"hall-1\"\n[modbus]\nlisten = []\n[http]\nlisten = \"{http}\"\n\
         [http.tls]\ncert_file = \"{}\"\nkey_file = \"{}\"\n",
        tls.cert_file.display(),
        tls.key_file.display()
    );
    let file = folder.write("cangate.toml", &configuration).display().to_string();
    let program = || {
        let mut command = Command::new(env!("CARGO_BIN_EXE_cangate"));
        command
            .env_remove("CANGATE_LOG")
            .env_remove("SSL_CERT_FILE")
            .stdin(Stdio::null())
            .stderr(Stdio::piped());
        command
    };
    let _gateway = Running(program().args(["run", "-c", &file]).stderr(Stdio::null()).spawn().unwrap());
    let health = |arguments: &[&str], authorities: Option<&str>| {
        let mut command = program();
        command.arg("health").args(arguments).envs(authorities.map(|file| ("SSL_CERT_FILE", file)));
        let output = command.output().unwrap();
        (output.status.code(), String::from_utf8_lossy(&output.stderr).into_owned())
    };
    until("the gateway is ready", async || {
        let ready = health(&["-c", &file], None).0 == Some(0);
        ready.then_some(())
    })
    .await;
    let url = format!("https://127.0.0.1:{}/livez", http.port());
    let other = folder.write("other.pem", &Authority::new("other").pem);
    let [ca, other] = [&ca, &other].map(|file| file.display().to_string());
    assert_eq!(health(&[&url], Some(&ca)), (Some(0), String::new()));
    let (code, said) = health(&[&url], Some(&other));
    assert_eq!(code, Some(1));
    assert!(said.contains(&url) && said.contains("certification authority that is not trusted"), "{said}");

    let life = until("the certificate is watched", async || {
        let ca_file = Some(folder.path("ca.pem"));
        let files = TlsClientSettings { ca_file, ..TlsClientSettings::default() };
        let mut stream = connect(http, files).await.ok()?;
        let request = b"GET /api/v1/status HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n";
        stream.write_all(request).await.ok()?;
        let mut answer = String::new();
        tokio::time::timeout(Duration::from_secs(5), stream.read_to_string(&mut answer)).await.ok()?.ok()?;
        let status: Value = serde_json::from_str(answer.split_once("\r\n\r\n")?.1).ok()?;
        Some(status["certificates"][0].clone()).filter(|life| !life.is_null())
    })
    .await;
    assert_eq!(life["file"], tls.cert_file.display().to_string());
}
