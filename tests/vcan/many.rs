//! Two devices, two kinds of client, a second master.

use std::collections::BTreeSet;
use std::process::Command;

use tempfile::TempDir;

use crate::harness::broker::{Broker, Subscriber};
use crate::harness::bus::{Capture, cansend, take_the_bus};
use crate::harness::gateway::{Setup, TOPICS, simulator};
use crate::harness::modbus::{Table, mbpoll, mbpoll_rtu, pymodbus, pymodbus_identification};
use crate::harness::process::Process;
use crate::harness::wait::wait_until;

#[test]
fn r_det_043_two_detcons_and_a_second_master() {
    let _bus = take_the_bus();
    let broker = Broker::start();
    let subscriber = Subscriber::start(&broker, TOPICS);
    let capture = Capture::start();
    let mut first = simulator(1, &[]);
    let _second = simulator(2, &["--seed", "7"]);
    let gateway = Setup::detcons(&[1, 2]).broker(&broker).start();
    for node in [1, 2] {
        gateway
            .node(node)
            .wait_for_status("both devices", |status| status.operational() && status.all_good());
        subscriber.wait_for(&format!("engine{node}/state"), 0, |payload| payload["quality"] == "good");
    }
    // Node id n is bit n mod 16 of register 4 + n / 16; 12 on are the configured ones.
    assert_eq!(gateway.unit().input(4, 8), [0b110, 0, 0, 0, 0, 0, 0, 0], "online nodes");
    assert_eq!(gateway.unit().input(12, 8), [0b110, 0, 0, 0, 0, 0, 0, 0], "configured nodes");

    // Another master guards node 1 and stops it again and again.
    let (messages, frames) = (subscriber.count(), capture.count());
    first.say("second master on");
    subscriber.wait_for("engine1/alarm/foreign_guard_master", messages, |payload| payload["active"] == true);
    subscriber.wait_for("bridge/alarm/can0_foreign_master", messages, |payload| payload["active"] == true);
    capture.wait_for_sequence(&["000#0201", "000#0101"], frames);
    first.say("second master off");
    gateway.node(1).wait_for_status("node 1 again", |status| status.operational() && status.all_good());

    // The same by a program that is not ours, to node 2.
    cansend("000#0202");
    capture.wait_for_sequence(&["000#0202", "000#0102"], frames);
    gateway.node(2).wait_for_status("node 2 again", |status| status.operational() && status.all_good());
    // Each stop was undone for the node that it hit, and nothing else was commanded.
    let commands: BTreeSet<_> =
        capture.frames().into_iter().skip(frames).filter(|frame| frame.starts_with("000#")).collect();
    let expected = ["000#0201", "000#0101", "000#0202", "000#0102"];
    assert_eq!(commands, expected.map(str::to_owned).into());
}

#[test]
fn mbpoll_and_pymodbus_read_every_published_block() {
    let _bus = take_the_bus();
    let _device = simulator(1, &[]);
    let gateway = Setup::one_detcon().start();
    gateway.node(1).wait_for_status("good data", |status| status.all_good());

    for (table, address, count) in [
        (Table::Input, 0, 100),
        (Table::Holding, 0, 100),
        (Table::Input, 100, 31),
        (Table::Input, 140, 23),
        (Table::Input, 170, 18),
        (Table::Input, 200, 46),
        (Table::Holding, 200, 46),
        (Table::Discrete, 0, 23),
        (Table::Discrete, 32, 20),
        (Table::Discrete, 64, 20),
        (Table::Discrete, 96, 20),
        (Table::Discrete, 128, 64),
        (Table::Coil, 0, 7),
    ] {
        let what = format!("{table:?} {address}+{count} of unit 1");
        let by_mbpoll =
            mbpoll(gateway.modbus, 1, table, address, count).unwrap_or_else(|e| panic!("{what}: {e}"));
        let by_pymodbus =
            pymodbus(gateway.modbus, 1, table, address, count).unwrap_or_else(|e| panic!("{what}: {e}"));
        assert_eq!((by_mbpoll.len(), by_pymodbus.len()), (usize::from(count), usize::from(count)), "{what}");
    }
    for unit in [0, 247, 255] {
        for (address, count) in [(0, 36), (90, 10), (200, 100)] {
            let what = format!("input registers {address}+{count} of unit {unit}");
            pymodbus(gateway.modbus, unit, Table::Input, address, count)
                .unwrap_or_else(|e| panic!("{what}: {e}"));
            let values = mbpoll(gateway.modbus, unit, Table::Input, address, count);
            assert_eq!(values.unwrap_or_else(|e| panic!("{what}: {e}")).len(), usize::from(count), "{what}");
        }
    }
    // The test pattern, by a client that knows nothing of us.
    assert_eq!(
        mbpoll(gateway.modbus, 247, Table::Input, 90, 5),
        Ok(vec![0x1234, 0x1234, 0x5678, 0x449A, 0x5000]),
        "0x1234, 0x12345678, 1234.5"
    );
    let identification = pymodbus_identification(gateway.modbus, 247).unwrap();
    assert!(identification["0"].is_string() && identification["1"].is_string(), "{identification}");
    let unknown = pymodbus(gateway.modbus, 77, Table::Input, 0, 1);
    assert!(unknown.as_ref().is_err_and(|error| error.contains("11")), "exception 0x0B: {unknown:?}");

    // The three ways to read a value agree: 0.01 %, raw, as bits of one and the same frame.
    wait_until("an integer and a raw value of the same frame", || {
        let (scaled, raw) = (gateway.node(1).input(100, 8), gateway.node(1).input(140, 8));
        scaled
            .iter()
            .zip(&raw)
            .all(|(scaled, raw)| (u32::from(*raw) * 10000 + 127) / 255 == u32::from(*scaled))
    });
}

#[test]
fn mbpoll_reads_the_same_registers_on_a_serial_line_and_of_other_units_nothing() {
    let _bus = take_the_bus();
    let _device = simulator(1, &[]);
    let folder = TempDir::new().unwrap();
    let [ours, theirs] = ["ours", "theirs"].map(|end| folder.path().join(end).display().to_string());
    let gateway = Setup::one_detcon().more(&format!("[[modbus.rtu]]\ndevice = \"{ours}\"")).start();
    gateway.node(1).wait_for_status("good data", |status| status.all_good());
    // The port appears after the gateway has started: it is tried again.
    let end = |path: &str| format!("pty,raw,echo=0,link={path}");
    let mut cable = Process::start("socat", Command::new("socat").args([end(&ours), end(&theirs)]));
    wait_until("an answer on the line", || mbpoll_rtu(&theirs, 247, Table::Input, 90, 1) == Ok(vec![0x1234]));
    for (table, address, count) in
        [(Table::Input, 200, 46), (Table::Holding, 120, 3), (Table::Discrete, 32, 20)]
    {
        let by_line = mbpoll_rtu(&theirs, 1, table, address, count).unwrap();
        assert_eq!(by_line.len(), usize::from(count));
        assert_eq!(by_line, mbpoll(gateway.modbus, 1, table, address, count).unwrap());
    }
    let silent = mbpoll_rtu(&theirs, 9, Table::Input, 0, 1).unwrap_err();
    assert!(silent.contains("timed out"), "{silent}");
    // An adapter that is unplugged and plugged in again.
    cable.kill();
    let _cable = Process::start("socat", Command::new("socat").args([end(&ours), end(&theirs)]));
    wait_until("an answer again", || mbpoll_rtu(&theirs, 247, Table::Input, 90, 1) == Ok(vec![0x1234]));
}
