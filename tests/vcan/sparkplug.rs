//! Sparkplug B before a foreign host: pysparkplug decodes every message, and what the specification forbids is told; it writes, too.

use std::cell::RefCell;
use std::process::Command;
use std::time::Duration;

use serde_json::Value;

use crate::harness::broker::Broker;
use crate::harness::bus::{Capture, take_the_bus};
use crate::harness::device::Device;
use crate::harness::gateway::{NAME, Setup};
use crate::harness::process::Process;
use crate::harness::proxy::Cable;
use crate::harness::wait::{give_it, wait_for, wait_until};

const GROUP: &str = "works";
/// Of channel 1.
const INTENSITY_RAW: u16 = 140;

/// The host application.
struct Host {
    process: Process,
    messages: RefCell<Vec<Value>>,
}

impl Host {
    fn start(broker: &Broker) -> Self {
        let python = std::env::var("CANGATE_TEST_PYTHON")
            .expect("CANGATE_TEST_PYTHON names a python with pysparkplug; `tests/all vcan` sets it");
        let file = format!("{}/tests/vcan/peers/sparkplug_judge.py", env!("CARGO_MANIFEST_DIR"));
        let port = broker.port.to_string();
        let mut command = Command::new(python);
        command.args(["-u", &file, &port, GROUP, NAME]);
        let mut process = Process::start("sparkplug_judge.py", &mut command);
        wait_until("the judge", || {
            assert!(process.runs(), "the judge ended: {:?}", process.stderr());
            process.stdout_count() > 0
        });
        Self { process, messages: RefCell::default() }
    }

    /// How many messages came so far; fails where one is wrong.
    fn count(&self) -> usize {
        let mut messages = self.messages.borrow_mut();
        // The first line says that it is ready.
        for line in self.process.stdout(1 + messages.len()) {
            let message: Value = serde_json::from_str(&line.text).unwrap();
            assert_eq!(message["wrong"], serde_json::json!([]), "{message}");
            messages.push(message);
        }
        messages.len()
    }

    /// Waits for a message from number `from` on.
    fn wait_for(&self, kind: &str, device: &str, from: usize, wanted: impl Fn(&Value) -> bool) -> Value {
        self.find(&format!("{kind} of {device}"), from, |message| {
            message["kind"] == kind && message["device"] == device && wanted(message)
        })
    }

    /// As [`wait_for`](Self::wait_for), of whatever kind and device.
    fn find(&self, what: &str, from: usize, wanted: impl Fn(&Value) -> bool) -> Value {
        wait_for(what, || {
            self.count();
            let messages = self.messages.borrow();
            messages.iter().skip(from).find(|message| wanted(message)).cloned()
        })
    }

    fn births(&self, from: usize, devices: usize) -> Value {
        let birth = self.wait_for("NBIRTH", "", from, |_| true);
        for device in 1..=devices {
            self.wait_for("DBIRTH", &format!("engine{device}"), from, |_| true);
        }
        birth
    }
}

fn any(_: &Value) -> bool {
    true
}

/// Whether a metric has this value as the present one.
fn shows(message: &Value, metric: &str, value: f64) -> bool {
    let readings = message["metrics"][metric].as_array();
    readings.into_iter().flatten().any(|reading| reading[0].as_f64() == Some(value) && reading[2] == false)
}

fn feed(devices: &[Device], knock: u8, status: u8) {
    for device in devices {
        device.send_periodically([
            &[knock; 8],
            &[2; 8],
            &[status, 128, 0xFF, 0xFF, 0, 0, 153, 204],
            &[4, 4, 4, 4, 15, 0],
        ]);
    }
}

fn setup(ids: &[u8], more: &str) -> Setup {
    Setup::detcons(ids)
        .mqtt_key("reconnect_max_s = 1")
        .more(&format!("[mqtt.sparkplug]\nenabled = true\ngroup_id = '{GROUP}'\n{more}"))
}

#[test]
fn a_foreign_host_finds_births_deaths_rebirth_and_the_wrap_of_the_sequence_right() {
    let _bus = take_the_bus();
    let broker = Broker::start();
    let mut host = Host::start(&broker);
    let cable = Cable::to(&broker);
    let devices = [1, 2, 3].map(|node| Device::start(node, 5));
    feed(&devices, 51, 0);
    let mut gateway = setup(&[1, 2, 3], "").broker_port(cable.port).start();
    for node in 1..=3 {
        gateway.node(node).wait_for_status("good data", |status| status.all_good());
    }
    let birth = host.births(0, 3);
    assert_eq!(birth["bdseq"], 0);
    // A birth tells it where the devices spoke before the broker answered.
    host.find("the value of engine1", 0, |message| {
        message["device"] == "engine1" && shows(message, "knock_intensity_1", 20.0)
    });

    // While an engine knocks, up to ten messages a second are made of it: the sequence number wraps.
    feed(&devices, 51, 0x01);
    let before = host.count();
    let mut rounds = 0_u8;
    while host.count() <= before + 300 {
        assert!(rounds < u8::MAX, "{} messages", host.count() - before);
        rounds += 1;
        for (node, device) in (1..).zip(&devices) {
            device.send(0x180 + node, &[rounds; 8]);
        }
        give_it(Duration::from_millis(110));
    }
    feed(&devices, 51, 0);

    let before = host.count();
    host.process.say("rebirth");
    let again = host.births(before, 3);
    assert_eq!((&again["bdseq"], &again["seq"]), (&birth["bdseq"], &Value::from(0)));
    host.process.say("dcmd engine1 trip");

    let before = host.count();
    devices[1].send_nothing();
    devices[1].answer(false);
    host.wait_for("DDEATH", "engine2", before, any);
    devices[1].answer(true);
    feed(&devices, 51, 0);
    host.wait_for("DBIRTH", "engine2", before, any);

    // The cable is pulled: what changes meanwhile follows, as historical.
    let before = host.count();
    cable.pull();
    cable.cut();
    assert_eq!(host.wait_for("NDEATH", "", before, any)["bdseq"], 0, "by the broker");
    for knock in [102, 153, 204] {
        feed(&devices, knock, 0);
        wait_until("the value in the registers", || {
            gateway.node(3).register(INTENSITY_RAW) == u16::from(knock)
        });
        // A state of it is made within `min_interval_ms`.
        give_it(Duration::from_secs(1));
    }
    cable.plug();
    let second = host.births(before, 3);
    assert_ne!(second["bdseq"], 0, "each attempt counts");
    for value in [40.0, 60.0] {
        host.wait_for("DDATA", "engine3", before, |data| {
            let readings = data["metrics"]["knock_intensity_1"].as_array();
            readings.into_iter().flatten().any(|reading| reading[0] == value && reading[2] == true)
        });
    }

    // Killed: the broker says so. Stopped: it says so itself.
    let before = host.count();
    gateway.process.kill();
    assert_eq!(host.wait_for("NDEATH", "", before, any)["bdseq"], second["bdseq"]);
    let before = host.count();
    gateway.start_again();
    host.births(before, 3);
    let before = host.count();
    assert_eq!(gateway.process.terminate().code(), Some(0));
    host.wait_for("NDEATH", "", before, any);
    println!("sparkplug: {} messages decoded and judged by pysparkplug", host.count());
}

/// A device that is told a set point.
const PUMP: &str = r#"
format = 1
device = { vendor = "test", model = "pump" }

[tpdo.1]
cob_id = "$NODEID+0x180"
length = 1

[rpdo.1]
cob_id = "$NODEID+0x200"
length = 2

[[tag]]
name = "level"
tpdo = 1
bit = 0
type = "u8"

[[tag]]
name = "setpoint"
rpdo = 1
bit = 0
type = "i16"
scale = { multiply = 0.1 }
maximum = 150
"#;

#[test]
fn a_foreign_host_writes_a_set_point_by_dcmd_and_nothing_that_it_may_not() {
    let _bus = take_the_bus();
    let broker = Broker::start();
    let mut host = Host::start(&broker);
    let pump = Device::start(9, 5);
    let capture = Capture::start();
    let access = "[access.scada]\nrole = 'operator'\nmqtt = true\nwrite = ['pump9/setpoint']";
    let gateway = setup(&[], access)
        .mapping("pump", PUMP)
        .more("[node.pump9]\nbus = 'can0'\nid = 9\nmapping = 'pump'\noutputs = true")
        .broker(&broker)
        .start();
    pump.send(0x189, &[5]);
    host.wait_for("DBIRTH", "pump9", 0, any);
    let before = host.count();
    host.process.say("dcmd pump9 setpoint 12.5");
    capture.wait_for("209#7D00", 0);
    host.wait_for("DDATA", "pump9", before, |data| shows(data, "setpoint", 12.5));
    let mark = capture.mark();
    for refused in [
        "pump9 setpoint 150.1",
        "pump9 level 3",
        "pump9 nonsense 3",
        "pump9 Alarm/node_lost",
        "pump8 setpoint 1",
    ] {
        host.process.say(&format!("dcmd {refused}"));
    }
    host.process.say("dcmd pump9 setpoint -1");
    capture.wait_for("209#F6FF", mark);
    let sent: Vec<String> =
        capture.frames()[mark..].iter().filter(|frame| frame.starts_with("209#")).cloned().collect();
    assert!(sent.iter().all(|frame| frame == "209#F6FF" || frame == "209#7D00"), "{sent:?}");
    let events = gateway.get("/api/v1/events");
    assert!(events.contains("DCMD/hall-1/pump9"), "the journal tells of them: {events}");
}

#[test]
fn nothing_is_published_by_sparkplug_while_the_primary_host_is_away() {
    let _bus = take_the_bus();
    let broker = Broker::start();
    let mut host = Host::start(&broker);
    let devices = [Device::start(1, 5)];
    feed(&devices, 51, 0);
    let gateway = setup(&[1], "primary_host = 'scada'").broker(&broker).start();
    gateway.node(1).wait_for_status("good data", |status| status.all_good());
    wait_until("the session", || gateway.get("/metrics").contains("cangate_sparkplug_connected 1"));
    assert_eq!(host.count(), 0);
    for round in 0..2 {
        let before = host.count();
        host.process.say("state scada online");
        let birth = host.births(before, 1);
        assert_eq!(birth["bdseq"], round);
        let before = host.count();
        host.process.say("state scada offline");
        assert_eq!(host.wait_for("NDEATH", "", before, any)["bdseq"], round);
        wait_until("the next session", || {
            gateway.get("/metrics").contains(&format!("cangate_sparkplug_sessions_total {}", round + 2))
        });
    }
}
