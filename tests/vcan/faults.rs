//! What happens to a bus, and a bus that is full.

use std::time::Duration;

use crate::harness::broker::{Broker, Subscriber};
use crate::harness::bus::{BUS, Capture, cansend, create_interface, ip, take_the_bus};
use crate::harness::device::Device;
use crate::harness::flood::flood;
use crate::harness::gateway::{Gateway, Setup, TOPICS};
use crate::harness::wait::{GENEROUS, give_it, wait_until, within};

const TPDOS: [&[u8]; 4] = [&[1; 8], &[2; 8], &[0, 128, 0xFF, 0xFF, 0, 0, 153, 204], &[4, 4, 4, 4, 15, 0]];

/// Registers of the first bus in the gateway's own unit.
const BUS_OFF_COUNT: u16 = 34;
const OVERRUNS: u16 = 35;
/// Frames received from a node, two registers.
const NODE_FRAMES: u16 = 20;

struct Hall {
    broker: Broker,
    subscriber: Subscriber,
    gateway: Gateway,
}

impl Hall {
    fn new() -> Self {
        let broker = Broker::start();
        let subscriber = Subscriber::start(&broker, TOPICS);
        let gateway = Setup::one_detcon().broker(&broker).start();
        Self { broker, subscriber, gateway }
    }

    fn wait_until_good(&self) {
        self.gateway.node(1).wait_for_status("good data", |status| status.online() && status.all_good());
    }

    fn wait_for_alarm(&self, alarm: &str, active: bool, from: usize) {
        self.subscriber
            .wait_for(&format!("bridge/alarm/can0_{alarm}"), from, |payload| payload["active"] == active);
    }
}

/// A device that runs and sends.
fn device() -> Device {
    let device = Device::start(1, 5);
    device.send_periodically(TPDOS);
    device
}

#[test]
fn an_interface_that_goes_down_is_one_alarm_and_comes_back_by_itself() {
    let _bus = take_the_bus();
    let _device = device();
    let hall = Hall::new();
    hall.wait_until_good();

    let messages = hall.subscriber.count();
    ip(&["link", "set", BUS, "down"]);
    hall.wait_for_alarm("interface_down", true, messages);
    hall.gateway.node(1).wait_for_status("the node to be offline", |status| !status.online());
    assert_eq!(hall.gateway.node(1).register(100), 0xFFFF);
    // Beyond every life time and time-out: an alarm of the node would have come by now.
    give_it(Duration::from_secs(4));
    let raised: Vec<_> = hall
        .subscriber
        .since(messages)
        .into_iter()
        .filter(|message| message.topic.contains("/alarm/") && message.payload["active"] == true)
        .map(|message| message.topic)
        .collect();
    let expected = "bridge/alarm/can0_interface_down";
    assert!(
        !raised.is_empty() && raised.iter().all(|topic| topic == expected),
        "one cause, one alarm: {raised:?}"
    );

    let messages = hall.subscriber.count();
    ip(&["link", "set", BUS, "up"]);
    hall.wait_for_alarm("interface_down", false, messages);
    hall.wait_until_good();
}

#[test]
fn an_interface_that_is_deleted_and_made_again_is_used_again() {
    let _bus = take_the_bus();
    let first = device();
    let hall = Hall::new();
    hall.wait_until_good();

    let messages = hall.subscriber.count();
    drop(first);
    ip(&["link", "del", BUS]);
    hall.wait_for_alarm("interface_down", true, messages);

    let messages = hall.subscriber.count();
    create_interface();
    let _second = device();
    hall.wait_for_alarm("interface_down", false, messages);
    hall.wait_until_good();
}

#[test]
fn an_interface_that_is_absent_at_the_start_is_waited_for() {
    let _bus = take_the_bus();
    ip(&["link", "del", BUS]);
    let hall = Hall::new();
    hall.wait_for_alarm("interface_down", true, 0);
    create_interface();
    let _device = device();
    hall.wait_for_alarm("interface_down", false, 0);
    hall.wait_until_good();
}

#[test]
fn a_bus_off_is_counted_and_alarmed_and_over_when_frames_come() {
    let _bus = take_the_bus();
    let device = device();
    let hall = Hall::new();
    hall.wait_until_good();
    let count = hall.gateway.unit().register(BUS_OFF_COUNT);

    device.send_nothing();
    device.answer(false);
    let messages = hall.subscriber.count();
    // An error frame with the bus-off bit, as a driver sends it.
    cansend("20000040#0000000000000000");
    hall.wait_for_alarm("bus_off", true, messages);
    // Counters are told once a second.
    wait_until("the bus-off to be counted", || hall.gateway.unit().register(BUS_OFF_COUNT) == count + 1);

    let messages = hall.subscriber.count();
    // What a driver sends when the controller is back: the restarted bit.
    cansend("20000100#0000000000000000");
    device.send_periodically(TPDOS);
    device.answer(true);
    hall.wait_for_alarm("bus_off", false, messages);
    hall.wait_until_good();
}

#[test]
fn r_det_078_079_a_bus_of_1_mbit_s_at_full_load_loses_no_frame() {
    let _bus = take_the_bus();
    let device = Device::start(1, 5);
    let gateway = Setup::one_detcon().start();
    let registers = gateway.node(1);
    registers.wait_for_status("a guarded device", |status| status.supervision_ok());

    let sent = flood(&[(0x181, 8), (0x281, 8), (0x381, 8), (0x481, 6)], 8000, Duration::from_secs(60));
    println!(
        "full load: {} frames in {:?}, {:.0} frames/s",
        sent.frames,
        sent.time,
        f64::from(sent.frames) / sent.time.as_secs_f64()
    );
    // A sender that cannot keep up would prove a bus that is less than full.
    assert!(sent.time < Duration::from_secs(75), "60 s of frames took {:?}", sent.time);
    // Silence, so that the counts can be compared.
    device.answer(false);
    let expected = || sent.frames + device.replies();
    let _ = within(GENEROUS, || (registers.u32(NODE_FRAMES) >= expected()).then_some(()));

    let received = registers.u32(NODE_FRAMES);
    let overruns = gateway.unit().register(OVERRUNS);
    println!("full load: {received} frames counted of {}, {overruns} overruns", expected());
    assert_eq!(overruns, 0, "frames lost by the socket");
    assert_eq!(received, expected(), "frames of the node: TPDOs and guard replies");
    // The last frame's data arrived too, not only its count.
    let last = u64::from(sent.each - 1).to_le_bytes();
    assert_eq!(registers.input(140, 8), last.map(u16::from));
}

#[test]
fn requests_that_a_bus_that_is_down_could_not_take_are_not_made_up_for() {
    let _bus = take_the_bus();
    let gateway = Setup::one_detcon().start();
    let capture = Capture::start();
    capture.wait_for("701#R1", 0);
    ip(&["link", "set", BUS, "down"]);
    // Six guard times.
    give_it(Duration::from_secs(3));
    let frames = capture.count();
    ip(&["link", "set", BUS, "up"]);
    capture.wait_for("701#R1", frames);
    wait_until("more requests", || capture.count() >= frames + 12);
    let times: Vec<f64> = capture.timed().iter().skip(frames).map(|(at, _)| *at).collect();
    // Eleven guard times of 500 ms; six less if what was missed came at once. One late request makes single gaps short.
    let span = times[11] - times[0];
    assert!(span > 4.0, "twelve requests in {span} s: {times:?}");
    drop(gateway);
}
