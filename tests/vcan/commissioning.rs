//! The commissioning tools: what they send, and what they do not.

use std::process::Command;

use tempfile::TempDir;

use crate::harness::bus::{BUS, Capture, cansend, take_the_bus};
use crate::harness::device::Device;
use crate::harness::gateway::simulator;
use crate::harness::process::Process;
use crate::harness::wait::{GENEROUS, wait_until, within};

/// A tool that runs to its end: exit code, standard output, standard error.
pub fn cangate(arguments: &[&str]) -> (i32, String, String) {
    let output = Command::new(env!("CARGO_BIN_EXE_cangate"))
        .current_dir(env!("CARGO_MANIFEST_DIR"))
        .args(arguments)
        .output()
        .unwrap();
    let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
    (output.status.code().unwrap_or(-1), text(&output.stdout), text(&output.stderr))
}

const TPDOS: [&[u8]; 4] = [&[1; 8], &[2; 8], &[0, 128, 0xFF, 0xFF, 0, 0, 153, 204], &[4, 4, 4, 4, 15, 0]];

/// Frames of the played or simulated DetCon of node 1.
fn is_of_the_device(frame: &str) -> bool {
    ["701#", "181#", "281#", "381#", "481#"].iter().any(|id| frame.starts_with(id)) && !frame.contains('R')
}

#[test]
fn a_scan_sends_nothing_and_names_the_detcon() {
    let _bus = take_the_bus();
    let capture = Capture::start();
    let device = Device::start(1, 5);
    device.send_periodically(TPDOS);
    capture.wait_for("481#", 0);
    let begin = capture.mark();
    let (code, stdout, stderr) = cangate(&["scan", "-i", BUS, "--seconds", "3"]);
    capture.mark();
    let other: Vec<String> =
        capture.frames().into_iter().skip(begin).filter(|frame| !is_of_the_device(frame)).collect();
    assert!(other.is_empty(), "sent by the scan: {other:?}");
    assert_eq!(code, 0, "{stderr}");
    assert!(stdout.contains("MOTORTECH DetCon") && !stdout.contains("perhaps"), "{stdout}");
}

#[test]
fn an_active_scan_finds_a_detcon_that_waits_and_asks_each_node_once_by_sdo_and_guarding() {
    let _bus = take_the_bus();
    let capture = Capture::start();
    let device = Device::start(1, 127);
    let (code, stdout, stderr) =
        cangate(&["scan", "-i", BUS, "--active", "--seconds", "1", "--nodes", "1-3", "--format", "json"]);
    assert_eq!(code, 0, "{stderr}");
    let report: serde_json::Value = serde_json::from_str(&stdout).unwrap();
    assert_eq!(report["nodes"][0]["id"], 1, "{stdout}");
    assert_eq!(report["nodes"][0]["state"], "pre_operational");
    assert_eq!(report["nodes"].as_array().unwrap().len(), 1);
    capture.mark();
    assert_eq!(
        capture.frames(),
        [
            "601#4000100000000000",
            "602#4000100000000000",
            "603#4000100000000000",
            "701#R1",
            "701#7F",
            "702#R1",
            "703#R1",
        ]
    );
    assert_eq!(device.state(), 127, "nobody started it");
}

#[test]
fn nmt_sends_exactly_one_frame_and_stopping_all_must_be_meant() {
    let _bus = take_the_bus();
    let capture = Capture::start();
    let (code, stdout, stderr) = cangate(&["nmt", "-i", BUS, "start", "1"]);
    assert_eq!(code, 0, "{stderr}");
    assert!(stdout.contains("000#0101"), "{stdout}");
    let (code, _, stderr) = cangate(&["nmt", "-i", BUS, "stop", "all"]);
    assert_eq!(code, 64, "{stderr}");
    assert!(stderr.contains("--yes"), "{stderr}");
    assert_eq!(cangate(&["nmt", "-i", BUS, "stop", "all", "--yes"]).0, 0);
    capture.mark();
    assert_eq!(capture.frames(), ["000#0101", "000#0200"]);
}

/// A device of python-canopen, node 5, with a device name that takes a segmented transfer.
fn foreign_device() -> Process {
    let python = std::env::var("CANGATE_TEST_PYTHON")
        .expect("CANGATE_TEST_PYTHON names a python with canopen; `tests/all vcan` sets it");
    let process = Process::start(
        "python-canopen",
        Command::new(python)
            .current_dir(env!("CARGO_MANIFEST_DIR"))
            .args(["tests/vcan/peers/canopen_device.py", BUS]),
    );
    wait_until("python-canopen", || process.stdout_count() > 0);
    process
}

#[test]
fn objects_of_a_foreign_device_are_read_written_and_scanned() {
    let _bus = take_the_bus();
    let _device = foreign_device();
    let sdo = |arguments: &[&str]| cangate(&[&["sdo", "-i", BUS, "--node", "5"], arguments].concat());
    let (code, stdout, stderr) = sdo(&["read", "0x1000:0"]);
    assert_eq!(code, 0, "{stderr}");
    assert!(stdout.contains("0x00020194"), "{stdout}");
    assert!(sdo(&["read", "0x1008:0"]).1.contains("P92C and friends"), "a segmented transfer");
    assert_eq!(sdo(&["write", "0x1017:0", "0"]).0, 0);
    let (code, _, stderr) = sdo(&["read", "0x2000:0"]);
    assert_eq!(code, 1, "{stderr}");
    assert!(stderr.contains("0x06020000, object does not exist"), "{stderr}");
    // A device that answers later than a scan waits, on a machine that stalls, is asked by the next scan.
    let wanted = serde_json::json!([5, 0x23D, 3, "P92C and friends"]);
    let mut report = String::new();
    let found = within(GENEROUS, || {
        report =
            cangate(&["scan", "-i", BUS, "--active", "--seconds", "1", "--nodes", "4-6", "--format", "json"])
                .1;
        let node = &serde_json::from_str::<serde_json::Value>(&report).unwrap()["nodes"][0];
        (serde_json::json!([node["id"], node["vendor"], node["serial"], node["name"]]) == wanted)
            .then_some(())
    });
    assert!(found.is_some(), "{report}");
}

#[test]
fn a_node_that_does_not_answer_ends_with_1_and_an_interface_that_is_down_with_74() {
    let _bus = take_the_bus();
    let (code, _, stderr) =
        cangate(&["sdo", "-i", BUS, "--node", "9", "--timeout-ms", "50", "read", "0x1000:0"]);
    assert_eq!(code, 1, "{stderr}");
    assert!(stderr.contains("no answer within 50 ms, 3 request(s)"), "{stderr}");
    let (code, _, stderr) = cangate(&["scan", "-i", "nocan77"]);
    assert_eq!(code, 74, "{stderr}");
    assert!(stderr.contains("`nocan77` is not there"), "{stderr}");
}

#[test]
fn init_makes_a_configuration_of_what_is_there_and_never_overwrites_one() {
    let _bus = take_the_bus();
    let folder = TempDir::new().unwrap();
    let file = folder.path().join("cangate.toml");
    let file = file.to_str().unwrap();
    let _device = simulator(1, &[]);
    let capture = Capture::start();
    // The simulator waits for its start.
    wait_until("process data", || {
        cansend("000#0101");
        capture.frames().iter().any(|frame| frame.starts_with("481#"))
    });
    let (code, stdout, stderr) = cangate(&["init", "-i", BUS, "-o", file, "--seconds", "3"]);
    assert_eq!(code, 0, "{stderr}");
    assert!(stdout.contains("1 of 1 nodes"), "{stdout}");
    assert_eq!(cangate(&["check", file]).0, 0);
    assert!(std::fs::read_to_string(file).unwrap().contains("[node.detcon-1]"));
    assert_eq!(cangate(&["init", "-i", BUS, "-o", file]).0, 74, "it is there already");
}
