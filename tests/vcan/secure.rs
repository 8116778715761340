//! Modbus/TCP Security with a foreign client: pymodbus, with certificates made as docs/security.md says.

use std::fs;
use std::path::Path;
use std::process::Command;

use super::harness::bus::take_the_bus;
use super::harness::gateway::Setup;
use super::harness::process::{free_port, run};

/// Runs the commands of the page that make certificates, in a folder.
fn make_certificates(folder: &Path) {
    let page = fs::read_to_string(concat!(env!("CARGO_MANIFEST_DIR"), "/docs/security.md")).unwrap();
    let commands: Vec<&str> = page
        .split("```sh\n")
        .skip(1)
        .filter_map(|block| block.split("```").next())
        .filter(|block| block.starts_with("umask") || block.starts_with("openssl req"))
        .collect();
    assert_eq!(commands.len(), 5, "the page has a step for each");
    let status =
        Command::new("bash").arg("-euc").arg(commands.concat()).current_dir(folder).output().unwrap();
    assert!(status.status.success(), "{}", String::from_utf8_lossy(&status.stderr));
}

#[test]
fn mbs_pymodbus_reads_with_the_role_of_its_certificate_and_not_without() {
    let _bus = take_the_bus();
    let folder = tempfile::tempdir().unwrap();
    make_certificates(folder.path());
    let file = |name: &str| folder.path().join(name).display().to_string();
    let port = free_port();
    let gateway = Setup::one_detcon()
        .more(&format!(
            "[modbus.security]\nlisten = [\"127.0.0.1:{port}\"]\ncert_file = \"{}\"\nkey_file = \"{}\"\n\
             client_ca_file = \"{}\"\nroles = [{{ name = \"Operator\", rights = [\"read\"] }}]",
            file("gateway.pem"),
            file("gateway.key"),
            file("ca.pem"),
        ))
        .start();
    let python = std::env::var("CANGATE_TEST_PYTHON").expect("`tests/all vcan` sets CANGATE_TEST_PYTHON");
    let script = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/vcan/peers/modbus_tls_client.py");
    let read = |certificate: &str, key: &str| {
        let authority = file("ca.pem");
        run(&python, &[script, &port.to_string(), &authority, certificate, key, "247", "90"])
    };
    let (good, register, error) = read(&file("plc.pem"), &file("plc.key"));
    assert!(good, "{error}");
    assert_eq!(register.trim(), "4660");
    let (good, _, error) = read("-", "-");
    assert!(!good, "without a certificate nobody gets in: {error}");
    // The gateway's own certificate is trusted, and has no role.
    let (good, _, error) = read(&file("gateway.pem"), &file("gateway.key"));
    assert!(!good && error.contains("exception_code=1"), "{error}");
    drop(gateway);
}
