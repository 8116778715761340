//! A gateway in a network namespace of its own, as in a container, reached through a vxcan tunnel (docker/README.md).

use std::process::Command;

use tempfile::TempDir;

use crate::harness::bus::{BUS, Capture, ip, take_the_bus};
use crate::harness::gateway::simulator;
use crate::harness::process::{Process, run};
use crate::harness::wait::wait_until;

const NAMESPACE: &str = "cangate-test";

/// Removes what outlives the processes.
struct Tunnel;

impl Tunnel {
    fn dig() -> Self {
        let tunnel = Self;
        ip(&["netns", "add", NAMESPACE]);
        ip(&["link", "add", "vxcan0", "type", "vxcan", "peer", "name", "can0", "netns", NAMESPACE]);
        ip(&["link", "set", "vxcan0", "up"]);
        ip(&["-n", NAMESPACE, "link", "set", "lo", "up"]);
        ip(&["-n", NAMESPACE, "link", "set", "can0", "up"]);
        for (from, to) in [(BUS, "vxcan0"), ("vxcan0", BUS)] {
            let (good, _, stderr) = run("cangw", &["-A", "-s", from, "-d", to, "-e"]);
            assert!(good, "cangw from {from} to {to}: {stderr}");
        }
        tunnel
    }
}

impl Drop for Tunnel {
    fn drop(&mut self) {
        let _ = run("cangw", &["-F"]);
        let _ = run("ip", &["link", "del", "vxcan0"]);
        let _ = run("ip", &["netns", "del", NAMESPACE]);
    }
}

#[test]
fn a_gateway_in_a_namespace_of_its_own_starts_and_guards_through_a_vxcan_tunnel() {
    let _bus = take_the_bus();
    let _tunnel = Tunnel::dig();
    let capture = Capture::start();
    let _device = simulator(1, &[]);
    let folder = TempDir::new().unwrap();
    let file = folder.path().join("cangate.toml");
    let text = "version = 1\n[gateway]\nname = \"box\"\n[bus.can0]\ninterface = \"can0\"\n\
                [node.engine1]\nbus = \"can0\"\nid = 1\nmapping = \"motortech-detcon\"\n\
                [modbus]\nlisten = [\"127.0.0.1:5020\"]\n[http]\nlisten = \"127.0.0.1:8080\"\n";
    std::fs::write(&file, text).unwrap();
    let _gateway = Process::start(
        "cangate run",
        Command::new("ip")
            .current_dir(env!("CARGO_MANIFEST_DIR"))
            .args(["netns", "exec", NAMESPACE, env!("CARGO_BIN_EXE_cangate"), "run", "-c"])
            .arg(&file),
    );

    // The state that it is asked for comes with either toggle bit: the first request may still find it initialising.
    capture.wait_for_sequence(&["701#R1", "000#0101", "181#"], 0);
    let read = |address: &str| {
        let (_, stdout, _) = run(
            "ip",
            &[
                "netns",
                "exec",
                NAMESPACE,
                "mbpoll",
                "-m",
                "tcp",
                "-1",
                "-q",
                "-0",
                "-a",
                "1",
                "-t",
                "3",
                "-r",
                address,
                "-p",
                "5020",
                "127.0.0.1",
            ],
        );
        let line = stdout.lines().find(|line| line.starts_with('['));
        line.and_then(|line| line.split_whitespace().nth(1)?.parse::<u16>().ok())
    };
    // Online, operational, supervised, all process data good.
    wait_until("good data through the tunnel", || read("1").is_some_and(|status| status & 0b1111 == 0b1111));
}
