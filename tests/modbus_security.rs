//! Modbus/TCP Security (MB-TCP-Security v36): certificates, roles, and a foreign judge.

use std::process::Stdio;
use std::time::Duration;

use cangate::modbus::End;
use cangate::modbus::security::Right;
use cangate::slots::AllowList;
use cangate::tls::{Reason, TlsClientSettings};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;

use crate::support::PATIENCE;
use crate::support::modbus::{LONG, RawClient, frame};
use crate::support::pki::{Authority, begins_tomorrow, expires_in, role_extension, tagged, utf8_string};
use crate::support::secure_modbus::{READ, Secure, SecureClient, WRITE};

const VALUE: &[u8] = &[4, 2, 0x12, 0x34];

#[tokio::test]
async fn mbs_r31_each_role_may_do_what_the_table_says_and_is_answered_01_for_the_rest() {
    let server = Secure::start(|_| {}).await;
    // What is asked, and answered where it is allowed: nothing can be written, so a write is answered 02.
    let requests: [(&[u8], &[u8], bool); 6] = [
        (READ, VALUE, false),
        (&[3, 0, 90, 0, 1], &[3, 2, 0x12, 0x34], false),
        (&[2, 0, 0, 0, 1], &[0x82, 2], false),
        (WRITE, &[0x86, 2], true),
        (&[5, 0, 0, 0xFF, 0], &[0x85, 2], true),
        (&[16, 0, 90, 0, 1, 2, 0, 1], &[0x90, 2], true),
    ];
    for (roles, may_read, may_write) in [
        (&["Operator"][..], true, false),
        (&["Engineer"], true, true),
        (&["Visitor"], false, false),
        (&["operator"], false, false),
        (&["Operator,Engineer"], false, false),
        (&[], false, false),
    ] {
        let mut client = server.client(roles).await.unwrap();
        for (pdu, answer, writes) in requests {
            let allowed = if writes { may_write } else { may_read };
            let expected = if allowed { answer.to_vec() } else { vec![pdu[0] | 0x80, 1] };
            assert_eq!(client.ask(pdu).await, Ok(expected), "{roles:?} {pdu:?}");
        }
        // A write and a read in one needs both.
        let both = [23, 0, 90, 0, 1, 0, 90, 0, 1, 2, 0, 1];
        let code = if may_read && may_write { 2 } else { 1 };
        assert_eq!(client.ask(&both).await, Ok(vec![0x97, code]));
    }
    assert!(server.counters.values().forbidden > 20);
}

#[tokio::test]
async fn mbs_r23_a_certificate_without_a_role_has_the_rights_of_no_role() {
    let server = Secure::start(|settings| settings.security.no_role = vec![Right::Read]).await;
    let mut client = server.client(&[]).await.unwrap();
    assert_eq!(client.ask(READ).await, Ok(VALUE.to_vec()));
    assert_eq!(client.ask(WRITE).await, Ok(vec![0x86, 1]));
    let mut visitor = server.client(&["Visitor"]).await.unwrap();
    assert_eq!(visitor.ask(READ).await, Ok(vec![0x84, 1]), "a role of its own goes before");
}

#[tokio::test]
async fn mbs_r02_r06_without_a_certificate_nobody_gets_in() {
    let server = Secure::start(|_| {}).await;
    let files = server.files("client", &server.authority.with_roles(&["Operator"]));
    let none = TlsClientSettings { cert_file: None, key_file: None, ..files };
    let refused = match SecureClient::connect(server.address, &none).await {
        Ok(mut client) => client.ask(READ).await.unwrap_err(),
        Err(reason) => reason,
    };
    assert_eq!(refused, Reason::WantsClientCertificate);
    let values = server.until(|values| values.ended(End::Handshake) == 1).await;
    assert_eq!((values.requests, values.open), (0, 0));
    let clients = server.accounts.values();
    assert_eq!((clients.len(), clients[0].refused, clients[0].connections), (1, 1, 0));
}

/// Tries to get in with a certificate; why it did not work.
async fn refused(server: &Secure, pair: &crate::support::pki::Pair) -> Reason {
    let files = server.files("client", pair);
    match SecureClient::connect(server.address, &files).await {
        // In TLS 1.3 the client learns of it at the first answer.
        Ok(mut client) => client.ask(READ).await.unwrap_err(),
        Err(reason) => reason,
    }
}

#[tokio::test]
async fn f45_expired_foreign_and_malformed_certificates_do_not_get_in() {
    let server = Secure::start(|_| {}).await;
    let authority = &server.authority;
    let role = || role_extension(&utf8_string(b"Operator"));
    let with = |change: &dyn Fn(&mut rcgen::CertificateParams)| {
        authority.make("plc", &[], |params| {
            params.custom_extensions.push(role());
            change(params);
        })
    };
    let odd = |content: &[u8]| {
        authority.make("plc", &[], |params| params.custom_extensions.push(role_extension(content)))
    };
    let wrong = [
        with(&|params| expires_in(params, -1)),
        with(&begins_tomorrow),
        Authority::new("plant").with_roles(&["Operator"]),
        // two roles, also the same one twice.
        authority.with_roles(&["Operator", "Engineer"]),
        authority.with_roles(&["Operator", "Operator"]),
        // no UTF8String.
        odd(&tagged(0x13, b"Operator")),
        odd(b"Operator"),
        odd(&utf8_string(&[0xFF, 0xFE])),
        odd(&utf8_string(&vec![b'x'; 60_000])),
        odd(&utf8_string(b"")),
        // For servers only.
        with(&|params| params.extended_key_usages = vec![rcgen::ExtendedKeyUsagePurpose::ServerAuth]),
    ];
    for (place, pair) in wrong.iter().enumerate() {
        let reason = refused(&server, pair).await;
        assert!(
            matches!(reason, Reason::RefusesOurs(_) | Reason::Closed | Reason::Other(_)),
            "{place}: {reason:?}"
        );
    }
    let many = u64::try_from(wrong.len()).unwrap();
    let values = server.until(|values| values.ended(End::Handshake) == many).await;
    assert_eq!(values.requests, 0);
    assert!(server.client(&["Operator"]).await.unwrap().ask(READ).await.is_ok(), "and the next one does");
}

#[tokio::test]
async fn s4_f44_handshakes_that_are_never_finished_keep_nobody_out() {
    let server = Secure::start(|settings| settings.max_connections = 4).await;
    let mut plc = RawClient(TcpStream::connect(server.plain).await.unwrap());
    assert!(plc.works().await);
    let mut idle = Vec::new();
    for _ in 0..50 {
        idle.push(TcpStream::connect(server.address).await.unwrap());
        assert!(plc.works().await, "the places are shared, and who never asked goes first");
    }
    let mut client = server.client(&["Operator"]).await.unwrap();
    assert_eq!(client.ask(READ).await, Ok(VALUE.to_vec()));
    assert!(plc.works().await);
    assert!(server.counters.values().ended(End::Evicted) >= 46);
}

#[tokio::test]
async fn plain_modbus_at_the_secure_port_gets_no_answer() {
    let server = Secure::start(|_| {}).await;
    let mut client = RawClient(TcpStream::connect(server.address).await.unwrap());
    client.send(&frame(1, 247, READ)).await;
    client.closed().await;
    server.until(|values| values.ended(End::Handshake) == 1).await;
    assert_eq!(server.counters.values().requests, 0);
}

#[tokio::test]
async fn a_role_that_is_taken_away_by_a_new_authority_holds_for_the_next_connection() {
    let server = Secure::start(|_| {}).await;
    let files = server.files("client", &server.authority.with_roles(&["Operator"]));
    let mut before = SecureClient::connect(server.address, &files).await.unwrap();
    assert!(before.ask(READ).await.is_ok());
    server.folder.write("ca.pem", &Authority::new("plant 2").pem);
    let after = match SecureClient::connect(server.address, &files).await {
        Ok(mut client) => client.ask(READ).await.map(|_| ()),
        Err(reason) => Err(reason),
    };
    assert!(after.is_err());
    assert!(before.ask(READ).await.is_ok(), "who is in stays");
    // A new certificate of the gateway is shown to the next one.
    server.folder.write("ca.pem", &server.authority.pem);
    server.folder.write_pair("gateway", &Authority::new("stranger").host());
    assert_eq!(server.client(&["Operator"]).await.map(|_| ()).unwrap_err(), Reason::UnknownAuthority);
}

#[tokio::test]
async fn the_log_names_the_door_that_a_client_did_not_get_in_by_and_the_table_that_says_who_may() {
    let server =
        Secure::start(|settings| settings.allow = AllowList::new(vec!["10.0.0.5".parse().unwrap()])).await;
    let log = server.folder.write("log", "");
    let writer = std::sync::Mutex::new(std::fs::File::options().append(true).open(&log).unwrap());
    let subscriber = tracing_subscriber::fmt().with_ansi(false).with_writer(writer).finish();
    let _told = tracing::subscriber::set_default(subscriber);
    let mut stream = TcpStream::connect(server.address).await.unwrap();
    // It is told of before it is closed.
    let _ = tokio::time::timeout(PATIENCE, stream.read(&mut [0])).await.unwrap();
    let told = std::fs::read_to_string(log).unwrap();
    let expected = "Modbus/TCP Security connection of an address that is not allowed in [modbus] was closed";
    assert!(told.contains(expected), "{told}");
}

#[tokio::test]
async fn stopping_ends_connections_and_handshakes() {
    let server = Secure::start(|_| {}).await;
    let mut client = server.client(&["Operator"]).await.unwrap();
    assert!(client.ask(READ).await.is_ok());
    let _idle = TcpStream::connect(server.address).await.unwrap();
    server.until(|values| values.open == 2).await;
    server.stop.cancel();
    tokio::time::timeout(LONG, server.task).await.unwrap().unwrap();
    assert!(client.ask(READ).await.is_err());
}

/// `openssl s_client` with these arguments, told to send a request; what it prints and complains of.
async fn openssl(server: &Secure, arguments: &[&str]) -> Option<(Vec<u8>, String)> {
    let mut command = tokio::process::Command::new("openssl");
    let ca = server.folder.path("ca.pem");
    command
        .args(["s_client", "-quiet", "-verify_return_error", "-CAfile"])
        .arg(ca)
        .args(["-connect", &server.address.to_string()])
        .args(arguments)
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .kill_on_drop(true);
    let Ok(mut child) = command.spawn() else {
        assert!(std::env::var_os("CI").is_none(), "openssl is not installed, and CI has to run this test");
        eprintln!("skipped: openssl is not installed (apt-get install openssl)");
        return None;
    };
    let mut stdin = child.stdin.take().unwrap();
    let _ = stdin.write_all(&frame(1, 247, READ)).await;
    let _ = stdin.flush().await;
    let mut answer = vec![0; 11];
    let mut stdout = child.stdout.take().unwrap();
    let read = tokio::time::timeout(LONG, stdout.read_exact(&mut answer)).await;
    let complete = matches!(read, Ok(Ok(_)));
    if complete {
        let _ = child.kill().await;
    }
    let mut said = String::new();
    child.stderr.take().unwrap().read_to_string(&mut said).await.unwrap();
    let _ = tokio::time::timeout(Duration::from_secs(5), child.wait()).await;
    Some((if complete { answer } else { Vec::new() }, said))
}

#[tokio::test]
async fn mbs_r01_r12_openssl_gets_in_by_tls_1_2_and_1_3_with_the_suites_of_the_standard_and_by_nothing_older()
{
    let server = Secure::start(|_| {}).await;
    server.files("client", &server.authority.with_roles(&["Operator"]));
    let file = |name: &str| server.folder.path(name).display().to_string();
    let (cert, key) = (file("client.pem"), file("client.key"));
    let known = ["-cert", &cert, "-key", &key];
    let good = frame(1, 247, VALUE);
    let old = ["-cipher", "DEFAULT:@SECLEVEL=0"];
    let cases: [(&[&str], bool); 7] = [
        (&["-tls1_3"], true),
        (&["-tls1_2"], true),
        (&["-tls1_2", "-cipher", "ECDHE-ECDSA-AES128-GCM-SHA256"], true),
        (&["-tls1_2", "-cipher", "ECDHE-ECDSA-AES128-SHA"], false),
        (&["-tls1_2", "-cipher", "NULL-SHA256:@SECLEVEL=0"], false),
        (&["-tls1_1", old[0], old[1]], false),
        (&["-tls1", old[0], old[1]], false),
    ];
    for (arguments, works) in cases {
        let all = [&known[..], arguments].concat();
        let Some((answer, said)) = openssl(&server, &all).await else { return };
        assert_eq!(answer == good, works, "{arguments:?}: {said}");
        if !works {
            assert!(
                said.contains("alert") || said.contains("no ciphers") || said.contains("no protocols"),
                "{said}"
            );
        }
    }
    // No certificate.
    let Some((answer, said)) = openssl(&server, &["-tls1_2"]).await else { return };
    assert!(answer.is_empty() && said.contains("alert"), "{said}");
}
