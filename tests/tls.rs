//! TLS: files, handshakes, and what is said of those that fail.

use std::path::PathBuf;
use std::sync::Arc;

use cangate::time::Clock;
use cangate::tls::files::load_server;
use cangate::tls::{
    ClientKeeper, Reason, ServerKeeper, TlsClientSettings, TlsError, TlsServerSettings, Watched, handshake,
};
use tokio::io::{AsyncReadExt, AsyncWriteExt, DuplexStream, duplex};
use tokio_rustls::TlsConnector;

use crate::support::pki::{Authority, Folder, Pair, begins_tomorrow, expires_in, name};

/// A plant's authority and the files of a server and a client.
struct Plant {
    folder: Folder,
    authority: Authority,
    server: TlsServerSettings,
    client: TlsClientSettings,
}

impl Plant {
    /// Both sides trust the authority and show a certificate of it.
    fn new() -> Self {
        let (folder, authority) = (Folder::new(), Authority::new("plant"));
        let ca = folder.write("ca.pem", &authority.pem);
        let (cert_file, key_file) = folder.write_pair("server", &authority.host());
        let server = TlsServerSettings { cert_file, key_file, client_ca_file: Some(ca.clone()) };
        let (cert, key) = folder.write_pair("client", &authority.make("client", &[], |_| {}));
        let client = TlsClientSettings { ca_file: Some(ca), cert_file: Some(cert), key_file: Some(key) };
        Self { folder, authority, server, client }
    }

    fn server_shows(&self, pair: &Pair) {
        self.folder.write_pair("server", pair);
    }

    fn client_shows(&self, pair: &Pair) {
        self.folder.write_pair("client", pair);
    }

    async fn meet(&self) -> [Result<(), Reason>; 2] {
        meet(&client(&self.client), &server(&self.server), "localhost").await
    }
}

fn server(settings: &TlsServerSettings) -> Arc<ServerKeeper> {
    Arc::new(ServerKeeper::new("[test]", (settings.clone(), None), Clock::start()))
}

fn client(settings: &TlsClientSettings) -> Arc<ClientKeeper> {
    Arc::new(ClientKeeper::new("[test]", settings.clone(), Clock::start()))
}

/// A handshake and one byte each way: what the client says of it, and the server.
async fn meet(client: &Arc<ClientKeeper>, server: &Arc<ServerKeeper>, host: &str) -> [Result<(), Reason>; 2] {
    let (near, far) = duplex(65_536);
    let host = rustls::pki_types::ServerName::try_from(host.to_owned()).unwrap();
    let connector = TlsConnector::from(client.current().unwrap());
    let connecting = async {
        let mut stream = connector.connect(host, near).await.map_err(|error| Reason::of_handshake(&error))?;
        // In TLS 1.3 the client learns only now that its certificate was refused.
        stream.write_all(b"?").await.map_err(|error| Reason::of_handshake(&error))?;
        let mut byte = [0];
        stream.read_exact(&mut byte).await.map_err(|error| Reason::of_handshake(&error))?;
        Ok(())
    };
    let accepting = async {
        let mut stream = handshake::accept(far, server).await?;
        let mut byte = [0];
        stream.read_exact(&mut byte).await.map_err(|error| Reason::of_handshake(&error))?;
        stream.write_all(&byte).await.unwrap();
        stream.flush().await.unwrap();
        Ok(())
    };
    let (client, server) = tokio::join!(connecting, accepting);
    [client, server]
}

#[tokio::test]
async fn two_that_trust_each_other_meet() {
    assert_eq!(Plant::new().meet().await, [Ok(()), Ok(())]);
}

#[tokio::test]
async fn a_server_whose_certificate_cannot_be_accepted_is_refused_and_both_sides_say_why() {
    type Expected = fn(&Reason) -> bool;
    let stranger = Authority::new("stranger");
    let plant = Plant::new();
    let authority = &plant.authority;
    let cases: [(Pair, Expected, &str); 4] = [
        (
            authority.make("localhost", &["localhost"], |params| expires_in(params, -1)),
            |reason| *reason == Reason::Expired,
            "it has expired",
        ),
        (
            authority.make("localhost", &["localhost"], begins_tomorrow),
            |reason| *reason == Reason::NotYetValid,
            "it has expired, or is not valid yet",
        ),
        (
            authority.make("mqtt.plant", &["mqtt.plant"], |_| {}),
            |reason| matches!(reason, Reason::WrongHost(names) if names.contains("mqtt.plant")),
            "not what is expected",
        ),
        (stranger.host(), |reason| *reason == Reason::UnknownAuthority, "not trusted there"),
    ];
    for (pair, expected, told) in cases {
        plant.server_shows(&pair);
        let [client, server] = plant.meet().await;
        let (client, server) = (client.unwrap_err(), server.unwrap_err());
        assert!(expected(&client), "{client}");
        assert!(matches!(server, Reason::RefusesOurs(_)) && server.to_string().contains(told), "{server}");
        assert!(!client.is_passing() && !server.is_passing());
    }
}

#[tokio::test]
async fn a_client_without_a_certificate_or_with_a_wrong_one_is_refused_and_both_sides_say_why() {
    let plant = Plant::new();
    let none = TlsClientSettings { cert_file: None, key_file: None, ..plant.client.clone() };
    let [client, server] = meet(&self::client(&none), &self::server(&plant.server), "localhost").await;
    assert_eq!(client, Err(Reason::WantsClientCertificate));
    assert_eq!(server, Err(Reason::NoClientCertificate));

    let stranger = Authority::new("stranger");
    let cases = [
        (stranger.make("client", &[], |_| {}), Reason::UnknownAuthority, "not trusted there"),
        (
            plant.authority.make("client", &[], |params| expires_in(params, -1)),
            Reason::Expired,
            "has expired",
        ),
        (plant.authority.make("client", &[], begins_tomorrow), Reason::NotYetValid, "is not valid yet"),
    ];
    for (pair, expected, told) in cases {
        plant.client_shows(&pair);
        let [client, server] = plant.meet().await;
        assert_eq!(server, Err(expected));
        let client = client.unwrap_err();
        assert!(client.to_string().contains(told), "{client}");
    }
}

/// Says these bytes to a server, and gives what the server says of it and answers.
async fn say(server: &Arc<ServerKeeper>, bytes: &[u8]) -> (Reason, Vec<u8>) {
    let (mut near, far) = duplex(65_536);
    near.write_all(bytes).await.unwrap();
    let accepting = async {
        let failed = handshake::accept(far, server).await;
        failed.map(|_: tokio_rustls::server::TlsStream<DuplexStream>| ()).unwrap_err()
    };
    let reason = accepting.await;
    let mut answer = Vec::new();
    near.read_to_end(&mut answer).await.unwrap();
    (reason, answer)
}

/// The hello of a client that speaks no more than this version.
fn old_hello(minor: u8) -> Vec<u8> {
    // Version, 32 random bytes, no session, two cipher suites, no compression, no extension.
    let mut body = vec![3, minor];
    body.extend([0x5A; 32]);
    body.extend([0, 0, 4, 0xC0, 0x13, 0, 0x2F, 1, 0]);
    let handshake = [&[1, 0, 0, u8::try_from(body.len()).unwrap()][..], &body].concat();
    [&[0x16, 3, 1, 0, u8::try_from(handshake.len()).unwrap()][..], &handshake].concat()
}

#[tokio::test]
async fn mbs_r01_ssl_3_and_tls_1_0_and_1_1_are_refused() {
    let plant = Plant::new();
    let server = server(&plant.server);
    for minor in 0..=2 {
        let (reason, answer) = say(&server, &old_hello(minor)).await;
        assert!(
            matches!(reason, Reason::NoCommonVersion | Reason::NoTls | Reason::NoCommonSuite),
            "{reason:?}"
        );
        if minor > 0 {
            assert_eq!(reason, Reason::NoCommonVersion, "3.{minor}");
            // A fatal alert, and nothing else.
            assert_eq!((answer[0], answer.len(), answer[5]), (0x15, 7, 2), "{answer:?}");
        }
    }
}

#[tokio::test]
async fn who_speaks_no_tls_is_told_apart() {
    let plant = Plant::new();
    let server = server(&plant.server);
    // Modbus, MQTT's CONNECT, HTTP.
    for bytes in
        [&[0, 1, 0, 0, 0, 6, 1, 3, 0, 0, 0, 1][..], &[0x10, 13, 0, 4, b'M'], b"GET / HTTP/1.1\r\n\r\n"]
    {
        let (reason, _) = say(&server, bytes).await;
        assert_eq!(reason, Reason::NoTls, "{bytes:?}");
    }
    // A server that answers a hello with something else.
    let (near, mut far) = duplex(1024);
    let connector = TlsConnector::from(client(&plant.client).current().unwrap());
    let host = rustls::pki_types::ServerName::try_from("localhost").unwrap();
    far.write_all(b"220 mail.example ESMTP\r\n").await.unwrap();
    let error = connector.connect(host.clone(), near).await.unwrap_err();
    assert_eq!(Reason::of_handshake(&error), Reason::NoTls);
    // One that hangs up, as MQTT brokers do.
    let (near, far) = duplex(1024);
    drop(far);
    let error = connector.connect(host, near).await.unwrap_err();
    assert_eq!(Reason::of_handshake(&error), Reason::Closed);
}

#[tokio::test(start_paused = true)]
async fn s4_f44_a_handshake_that_is_never_finished_ends_after_five_seconds() {
    let plant = Plant::new();
    let server = server(&plant.server);
    server.current().unwrap();
    let clock = Clock::start();
    for begun in [&[][..], &old_hello(3)[..7]] {
        let before = clock.now().instant;
        let (mut near, far) = duplex(1024);
        near.write_all(begun).await.unwrap();
        let reason = handshake::accept(far, &server).await.map(|_| ()).unwrap_err();
        assert_eq!(reason, Reason::Slow);
        assert_eq!(clock.now().instant.since(before).as_secs(), 5);
        drop(near);
    }
}

#[tokio::test(start_paused = true)]
async fn s4_files_that_cannot_be_read_to_their_end_hold_a_handshake_up_no_longer_than_a_client() {
    let plant = Plant::new();
    let server = server(&plant.server);
    // Whoever opens a pipe waits until somebody writes into it, as on a disk that has gone.
    let cert_file = plant.server.cert_file.clone();
    std::fs::remove_file(&cert_file).unwrap();
    assert!(std::process::Command::new("mkfifo").arg(&cert_file).status().unwrap().success());
    let (_near, far) = duplex(1024);
    let accepting = handshake::accept(far, &server);
    // Time stands still while a file is read.
    let waiting = async {
        tokio::time::advance(std::time::Duration::from_secs(6)).await;
        for _ in 0..10 {
            tokio::task::yield_now().await;
        }
    };
    let ended =
        tokio::select! { biased; accepted = accepting => Some(accepted.map(|_| ())), () = waiting => None };
    drop(std::fs::OpenOptions::new().write(true).open(cert_file).unwrap());
    assert_eq!(ended, Some(Err(Reason::Slow)));
}

#[tokio::test]
async fn a_new_certificate_is_taken_up_at_the_next_handshake() {
    let plant = Plant::new();
    let (server, client) = (server(&plant.server), client(&plant.client));
    assert_eq!(meet(&client, &server, "localhost").await, [Ok(()), Ok(())]);
    // The plant gets a new authority: first the server has a certificate of it, then the clients trust it, then they have one.
    let new = Authority::new("plant 2");
    plant.server_shows(&new.host());
    let [said, _] = meet(&client, &server, "localhost").await;
    assert_eq!(said, Err(Reason::UnknownAuthority), "the server shows the new one");
    plant.folder.write("ca.pem", &format!("{}{}", plant.authority.pem, new.pem));
    assert_eq!(meet(&client, &server, "localhost").await, [Ok(()), Ok(())]);
    plant.client_shows(&new.make("client", &[], |_| {}));
    assert_eq!(meet(&client, &server, "localhost").await, [Ok(()), Ok(())]);
    plant.folder.write("ca.pem", &new.pem);
    assert_eq!(meet(&client, &server, "localhost").await, [Ok(()), Ok(())]);
}

#[tokio::test]
async fn s10_new_files_that_cannot_be_used_leave_the_old_ones_at_work() {
    let plant = Plant::new();
    let server = server(&plant.server);
    let working = server.current().unwrap();
    let files =
        [&plant.server.cert_file, &plant.server.key_file].map(|path| std::fs::read_to_string(path).unwrap());
    let expired = plant.authority.make("localhost", &["localhost"], |params| expires_in(params, -1));
    let other = plant.authority.host();
    let half = &files[0][..files[0].len() / 2];
    for (certificate, key) in [
        ("", files[1].as_str()),
        (half, &files[1]),
        (&files[0], ""),
        // The first half of an exchange.
        (&other.certificate, &files[1]),
        (&expired.certificate, &expired.key),
    ] {
        plant.folder.write("server.pem", certificate);
        plant.folder.write("server.key", key);
        let kept = server.current().unwrap();
        assert!(Arc::ptr_eq(&kept, &working), "{certificate}");
    }
    std::fs::remove_file(&plant.server.cert_file).unwrap();
    assert!(Arc::ptr_eq(&server.current().unwrap(), &working));
    plant.server_shows(&other);
    let renewed = server.current().unwrap();
    assert!(!Arc::ptr_eq(&renewed, &working));
    assert!(Arc::ptr_eq(&renewed, &server.current().unwrap()), "nothing is read while nothing changes");
}

#[test]
fn what_is_wrong_with_a_file_is_told_with_its_name_and_how_to_mend_it() {
    let plant = Plant::new();
    let good = plant.authority.host();
    let cert = |text: &str| (text.to_owned(), good.key.clone());
    let key = |text: &str| (good.certificate.clone(), text.to_owned());
    let encrypted = "-----BEGIN ENCRYPTED PRIVATE KEY-----\nAAAA\n-----END ENCRYPTED PRIVATE KEY-----\n";
    let odd = "-----BEGIN PRIVATE KEY-----\nAAAA\n-----END PRIVATE KEY-----\n";
    let cases = [
        (cert("hello"), "server.pem` holds no certificate in PEM form", "-----BEGIN CERTIFICATE-----"),
        (cert(&good.key), "server.pem` holds no certificate", "mixed up"),
        (cert("0\u{1}"), "server.pem` holds no certificate", "-inform der"),
        (cert(&good.certificate.replace("-----END", "====END")), "certificate in `", "copy the whole file"),
        (
            cert("-----BEGIN CERTIFICATE-----\nAAAA\n-----END CERTIFICATE-----\n"),
            "server.pem` is damaged",
            "copy",
        ),
        (key(""), "server.key` holds no private key", "certificate's request"),
        (key(&good.certificate), "server.key` holds no private key", "mixed up"),
        (key(encrypted), "server.key` holds no private key", "it is encrypted: `openssl pkey -in"),
        (key(odd), "the private key in `", "P-256"),
        (key(&plant.authority.host().key), "does not belong to the certificate in", "pair"),
    ];
    for ((certificate, key), says, mends) in cases {
        plant.folder.write("server.pem", &certificate);
        plant.folder.write("server.key", &key);
        let text = load_server(&plant.server, None).unwrap_err().to_string();
        assert!(text.contains(says) && text.contains(mends), "{text}");
        assert!(!text.contains(good.key.lines().nth(1).unwrap()), "no key in a message");
    }
    let nowhere = TlsServerSettings { key_file: PathBuf::from("/nowhere/x.key"), ..plant.server.clone() };
    plant.server_shows(&good);
    let error = load_server(&nowhere, None).unwrap_err();
    assert!(matches!(error, TlsError::Unreadable { .. }));
    assert!(error.to_string().contains("`/nowhere/x.key`: No such file"), "{error}");
    let everybody = std::os::unix::fs::PermissionsExt::from_mode(0o644);
    std::fs::set_permissions(&plant.server.key_file, everybody).unwrap();
    let warnings = load_server(&plant.server, None).unwrap().warnings;
    assert_eq!(warnings.len(), 1);
    assert!(warnings[0].contains("chmod 600") && warnings[0].contains(&name(&plant.server.key_file)));
}

#[test]
fn g06_of_a_file_the_certificate_that_expires_first_is_told() {
    let (folder, authority) = (Folder::new(), Authority::new("plant"));
    let one = authority.make("one", &[], |params| expires_in(params, 40));
    let two = authority.make("two", &[], |params| expires_in(params, 5));
    let old = authority.make("old", &[], |params| expires_in(params, -3));
    let files = vec![
        folder.write("both.pem", &format!("{}{}", one.certificate, two.certificate)),
        folder.path("missing.pem"),
        folder.write("old.pem", &old.certificate),
    ];
    let lives = Watched(files).lives(Clock::start().now().utc, &[]);
    let told: Vec<_> = lives.iter().map(|life| (life.subject.as_str(), life.days_left)).collect();
    assert_eq!(told, [("CN=two", 5), ("CN=old", -3)]);
    assert!(lives[0].file.ends_with("both.pem") && lives[0].expires().ends_with('Z'));
}

#[test]
fn g06_a_renewal_that_broke_hides_no_certificate_that_expires() {
    let (folder, authority) = (Folder::new(), Authority::new("plant"));
    let old = authority.make("old", &[], |params| expires_in(params, 5));
    let new = authority.make("new", &[], |params| expires_in(params, 90));
    let watched = Watched(vec![folder.write("gateway.pem", &old.certificate)]);
    let now = Clock::start().now().utc;
    let before = watched.lives(now, &[]);
    let tomorrow = cangate::time::Timestamp::from_millis(now.as_millis() + 86_400_000);
    let garbled =
        format!("{}{}", new.certificate, "-----BEGIN CERTIFICATE-----\nAAAA\n-----END CERTIFICATE-----\n");
    for broken in ["", "half a fi", garbled.as_str()] {
        folder.write("gateway.pem", broken);
        let lives = watched.lives(tomorrow, &before);
        assert_eq!(
            (lives.len(), lives[0].subject.as_str(), lives[0].days_left),
            (1, "CN=old", 4),
            "{broken}"
        );
    }
    std::fs::remove_file(&watched.0[0]).unwrap();
    assert_eq!(watched.lives(tomorrow, &before)[0].days_left, 4);
    folder.write("gateway.pem", &new.certificate);
    assert_eq!(watched.lives(tomorrow, &before)[0].subject, "CN=new");
}
