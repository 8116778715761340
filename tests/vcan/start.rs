//! Which of the two is there first, and what happens when the device loses its power.

use std::time::{Duration, Instant};

use crate::harness::broker::{Broker, Subscriber};
use crate::harness::bus::{Capture, take_the_bus};
use crate::harness::device::Device;
use crate::harness::gateway::{Gateway, Setup, TOPICS, simulator};
use crate::harness::wait::wait_for;

/// Operational, supervised, all data good and no node alarm: what a PLC waits for.
fn wait_until_good(gateway: &Gateway) {
    gateway.node(1).wait_for_status("a good DetCon", |status| {
        status.online() && status.operational() && status.supervision_ok() && status.all_good()
    });
}

#[test]
fn r_det_017_019_046_cold_start_with_the_device_there_first() {
    let _bus = take_the_bus();
    let broker = Broker::start();
    let subscriber = Subscriber::start(&broker, TOPICS);
    let capture = Capture::start();
    let _device = simulator(1, &[]);
    capture.wait_for("701#00", 0);

    let gateway = Setup::one_detcon().broker(&broker).start();
    wait_until_good(&gateway);

    capture.wait_for_sequence(&["701#00", "701#R1", "000#0101"], 0);
    assert_eq!(gateway.node(1).register(2), 5, "NMT state");
    let lost = subscriber.of("event", 0).into_iter().find(|event| event.payload["name"] == "frame_not_sent");
    assert!(lost.is_none(), "the first request is sent when the interface is open: {lost:?}");
    subscriber.wait_for("engine1/availability", 0, |payload| payload["state"] == "online");
    subscriber.wait_for("engine1/state", 0, |payload| {
        payload["quality"] == "good" && payload["nmt"] == "operational"
    });
}

#[test]
fn r_det_017_019_cold_start_with_the_gateway_there_first() {
    let _bus = take_the_bus();
    let broker = Broker::start();
    let subscriber = Subscriber::start(&broker, TOPICS);
    let capture = Capture::start();
    let gateway = Setup::one_detcon().broker(&broker).start();
    capture.wait_for("701#R1", 0);
    assert_eq!(gateway.node(1).register(2), 0xFFFF, "NMT state of a device that never answered");
    assert_eq!(gateway.node(1).register(100), 0xFFFF, "knock intensity that was never received");

    let _device = simulator(1, &[]);
    wait_until_good(&gateway);

    let boot_up = capture.wait_for("701#00", 0);
    capture.wait_for("000#0101", boot_up);
    subscriber.wait_for("engine1/availability", 0, |payload| payload["state"] == "online");
    subscriber.wait_for("engine1/state", 0, |payload| payload["quality"] == "good");
}

#[test]
fn r_det_017_a_device_that_runs_already_is_not_started() {
    let _bus = take_the_bus();
    let capture = Capture::start();
    let device = Device::start(1, 5);
    device.send_periodically([&[1; 8], &[2; 8], &[0, 3, 0xFF, 0x0F, 0, 0, 9, 9], &[4, 4, 4, 4, 0, 0]]);

    let gateway = Setup::one_detcon().start();
    wait_until_good(&gateway);

    let commands: Vec<_> = capture.frames().into_iter().filter(|frame| frame.starts_with("000#")).collect();
    assert!(commands.is_empty(), "{commands:?}");
}

#[test]
fn r_det_039_084_power_cycle_ends_in_good_data_within_two_seconds_of_the_boot_up() {
    let _bus = take_the_bus();
    let broker = Broker::start();
    let subscriber = Subscriber::start(&broker, TOPICS);
    let capture = Capture::start();
    let mut device = simulator(1, &[]);
    let gateway = Setup::one_detcon().broker(&broker).start();
    wait_until_good(&gateway);
    let restarts = gateway.node(1).register(12);

    let (frames, messages) = (capture.count(), subscriber.count());
    device.kill();
    let _device = simulator(1, &[]);
    let boot_up = capture.wait_for("701#00", frames);
    let client_begin = Instant::now();
    // Without this the status of before the restart would do.
    subscriber.wait_for_event("node_restarted", messages);
    wait_until_good(&gateway);
    let client_time = client_begin.elapsed();

    assert_eq!(gateway.node(1).register(12), restarts + 1, "restarts");
    let good = ["181#", "281#", "381#", "481#"].map(|tpdo| {
        wait_for(tpdo, || {
            capture
                .timed()
                .into_iter()
                .skip(boot_up)
                .find(|(_, frame)| frame.starts_with(tpdo))
                .map(|(at, _)| at)
        })
    });
    let bus_time = good.into_iter().fold(0.0, f64::max) - capture.timed()[boot_up].0;
    println!(
        "power cycle: boot-up to the last of the four TPDOs {bus_time:.3} s, to good data at the client {client_time:?}"
    );
    assert!(bus_time <= 2.0, "{bus_time} s from the boot-up to data on the bus");
    // The client has its own processes on a slow machine: its time shows only that nothing waits for a long period.
    assert!(
        client_time < Duration::from_secs(10),
        "{client_time:?} from the boot-up to good data at the client"
    );
}
