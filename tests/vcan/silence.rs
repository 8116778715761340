//! What the gateway sends, which is little, and what it never sends.

use std::time::Duration;

use nix::sys::signal::Signal;

use crate::harness::bus::{Capture, cansend, take_the_bus};
use crate::harness::device::Device;
use crate::harness::gateway::Setup;
use crate::harness::wait::{give_it, wait_until};

const TPDOS: [&[u8]; 4] = [&[1; 8], &[2; 8], &[0, 128, 0xFF, 0xFF, 0, 0, 153, 204], &[4, 4, 4, 4, 15, 0]];

/// Frames that the played device sends: data on its own identifiers.
fn is_of_the_device(frame: &str) -> bool {
    frame.starts_with("701#") && !frame.contains('R')
        || ["181#", "281#", "381#", "481#"].iter().any(|tpdo| frame.starts_with(tpdo))
}

fn assert_only_start_and_guarding(capture: &Capture, allowed: &[&str]) {
    let frames = capture.frames();
    let other: Vec<_> = frames
        .iter()
        .filter(|frame| !is_of_the_device(frame) && !allowed.contains(&frame.as_str()))
        .collect();
    assert!(other.is_empty(), "frames that no gateway may send: {other:?}");
    assert!(frames.iter().any(|frame| frame == "701#R1"), "the capture saw nothing of the gateway");
}

#[test]
fn r_det_016_018_stopping_and_killing_the_gateway_sends_nothing_to_the_device() {
    let _bus = take_the_bus();
    let capture = Capture::start();
    let device = Device::start(1, 127);
    device.send_periodically(TPDOS);
    let mut gateway = Setup::one_detcon().start();
    let good = |gateway: &crate::harness::gateway::Gateway| {
        gateway.node(1).wait_for_status("good data", |status| status.operational() && status.all_good());
    };
    good(&gateway);

    for signal in [Signal::SIGTERM, Signal::SIGKILL, Signal::SIGINT] {
        gateway.process.signal(signal);
        let status = gateway.process.wait();
        if signal != Signal::SIGKILL {
            assert_eq!(status.code(), Some(0), "exit code after {signal}");
        }
        // Whatever it sent before its end stands before the mark.
        let frames = capture.mark();
        give_it(Duration::from_millis(700));
        capture.mark();
        let after: Vec<_> =
            capture.frames().into_iter().skip(frames).filter(|frame| !is_of_the_device(frame)).collect();
        assert!(after.is_empty(), "sent after {signal}: {after:?}");
        assert_eq!(device.state(), 5, "the device runs on");
        gateway.start_again();
        good(&gateway);
    }

    // Over all of it: one start, when the device was pre-operational, and guard requests. Nothing else, ever.
    assert_only_start_and_guarding(&capture, &["000#0101", "701#R1"]);
    assert_eq!(capture.frames().iter().filter(|frame| *frame == "000#0101").count(), 1);
}

#[test]
fn r_det_002_021_to_a_bus_without_devices_only_guard_requests_are_sent() {
    let _bus = take_the_bus();
    let capture = Capture::start();
    let mut gateway = Setup::detcons(&[1, 2]).start();
    wait_until("guarding", || capture.count() > 8);
    gateway.process.terminate();
    let frames = capture.frames();
    assert!(
        frames.iter().all(|frame| ["701#R1", "702#R1"].contains(&frame.as_str())),
        "all that was on the bus: {frames:?}"
    );
}

#[test]
fn the_passive_role_sends_nothing_and_still_tells_what_it_overhears() {
    let _bus = take_the_bus();
    let capture = Capture::start();
    let mut gateway = Setup::one_detcon().passive().start();
    let registers = gateway.node(1);
    let sent = [
        "701#00",
        "701#R1",
        "701#7F",
        "000#0101",
        "701#R1",
        "701#85",
        "181#1020304050607080",
        "281#0000000000000000",
        "381#0080FF0F000099CC",
        "481#000000000000",
    ];
    for frame in sent {
        cansend(frame);
    }
    wait_until("the values overheard", || registers.register(140) == 16);
    assert!(registers.status().passive(), "the status word says so");
    assert_eq!(registers.register(2), 5, "NMT state");
    // Long enough for every guard time, retry and life time.
    give_it(Duration::from_secs(4));
    gateway.process.terminate();
    assert_eq!(capture.frames(), sent, "the bus saw exactly what the test sent");
}
