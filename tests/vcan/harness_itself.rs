//! The harness itself: what the other tests rely on, without the gateway.

use std::time::Duration;

use crate::harness::broker::{Broker, Subscriber};
use crate::harness::bus::{Capture, cansend, take_the_bus};
use crate::harness::device::Device;
use crate::harness::flood::flood;
use crate::harness::proxy::Cable;
use crate::harness::wait::{wait_until, within};

#[test]
fn the_played_device_answers_guarding_and_obeys() {
    let _bus = take_the_bus();
    let capture = Capture::start();
    let device = Device::start(1, 127);
    device.send_periodically([&[1; 8], &[2; 8], &[3; 8], &[4; 6]]);
    cansend("701#R1");
    capture.wait_for_sequence(&["701#R1", "701#7F"], 0);
    cansend("000#0101");
    capture.wait_for("181#0101010101010101", 0);
    cansend("701#R1");
    capture.wait_for("701#85", 0);
    device.restart();
    let boot_up = capture.wait_for("701#00", 0);
    cansend("701#R1");
    capture.wait_for("701#7F", boot_up);
    assert_eq!(device.replies(), 3);
    // Silence is silence.
    device.answer(false);
    let frames = capture.count();
    cansend("701#R1");
    let other = within(Duration::from_millis(700), || (capture.count() > frames + 1).then_some(()));
    assert_eq!(other, None, "{:?}", capture.frames());
}

#[test]
fn a_flood_is_as_many_frames_as_it_says() {
    let _bus = take_the_bus();
    let capture = Capture::start();
    let sent = flood(&[(0x181, 8), (0x481, 6)], 1000, Duration::from_secs(2));
    assert_eq!((sent.frames, sent.each), (2000, 1000));
    wait_until("all frames", || capture.count() >= 2000);
    assert_eq!(capture.count(), 2000);
    assert!(sent.time >= Duration::from_millis(1900), "{:?}", sent.time);
}

#[test]
fn the_subscriber_sees_what_is_published_through_a_cable_and_after_a_kill() {
    let _bus = take_the_bus();
    let mut broker = Broker::start();
    let subscriber = Subscriber::start(&broker, "a/");
    broker.publish("a/b", r#"{"name":"x","seq":1}"#);
    let message = subscriber.wait_for("b", 0, |payload| payload["name"] == "x");
    assert_eq!((message.payload["seq"].as_u64(), message.retained), (Some(1), false));

    let cable = Cable::to(&broker);
    let connects = || std::net::TcpStream::connect(("127.0.0.1", cable.port)).is_ok();
    assert!(connects());
    wait_until("a connection through the cable", || cable.connections() == 1);
    cable.pull();
    assert!(connects(), "the listener is still there");
    broker.kill();
    broker.restart();
    subscriber.wait_until_subscribed(&broker);
    assert_eq!(cable.connections(), 1, "nothing passes a pulled cable");
}
