//! A device that falls silent, comes back, or answers wrongly (V-DET-02, 03, 14, 15).

use crate::harness::broker::{Broker, Subscriber};
use crate::harness::bus::{Capture, cansend, take_the_bus};
use crate::harness::device::Device;
use crate::harness::gateway::{Gateway, Setup, TOPICS};
use crate::harness::modbus::{Table, mbpoll};
use crate::harness::wait::wait_until;

/// Input registers of the node block.
const NMT_STATE: u16 = 2;
const RESTARTS: u16 = 12;
const GUARD_MISSES: u16 = 13;
const TOGGLE_ERRORS: u16 = 14;

const TPDOS: [&[u8]; 4] = [
    &[16, 32, 48, 64, 80, 96, 112, 128],
    &[9; 8],
    &[0, 128, 0xFF, 0xFF, 0, 0, 153, 204],
    &[1, 2, 3, 4, 15, 0],
];

struct Hall {
    subscriber: Subscriber,
    _broker: Broker,
    capture: Capture,
    device: Device,
    gateway: Gateway,
}

/// A gateway with a device that is operational and sends TPDOs, and everybody who watches.
fn running() -> Hall {
    let broker = Broker::start();
    let subscriber = Subscriber::start(&broker, TOPICS);
    let capture = Capture::start();
    let device = Device::start(1, 5);
    device.send_periodically(TPDOS);
    let gateway = Setup::one_detcon().broker(&broker).start();
    gateway.node(1).wait_for_status("good data", |status| status.supervision_ok() && status.all_good());
    wait_until("guarding", || device.replies() >= 2);
    Hall { subscriber, _broker: broker, capture, device, gateway }
}

#[test]
fn r_det_033_036_037_a_silent_device_is_lost_within_its_life_time_and_found_again() {
    let _bus = take_the_bus();
    let hall = running();
    let before = hall.subscriber.count();

    hall.device.send_nothing();
    hall.device.answer(false);
    let lost = hall.subscriber.wait_for_event("node_lost", before);

    // Causality first: three requests without an answer, then the alarm.
    let frames = hall.capture.timed();
    let last_reply = frames.iter().rposition(|(_, frame)| frame == "701#05" || frame == "701#85").unwrap();
    let lost_at = lost.payload["ts"].as_f64().unwrap() / 1000.0;
    let unanswered =
        frames[last_reply..].iter().filter(|(at, frame)| frame == "701#R1" && *at <= lost_at).count();
    assert_eq!(unanswered, 3, "requests without an answer before the alarm");
    let life_time = lost_at - frames[last_reply].0;
    println!("node_lost: {life_time:.3} s after the last reply");
    // Not sooner; how much later is printed, as a guest may stall.
    assert!(life_time >= 1.0, "{life_time} s");

    let registers = hall.gateway.node(1);
    registers.wait_for_status("node_lost on Modbus", |status| !status.online() && status.alarm_active());
    assert_eq!(
        mbpoll(hall.gateway.modbus, 1, Table::Input, 100, 20),
        Ok(vec![0xFFFF; 20]),
        "knock intensities of a lost node"
    );
    assert_eq!(registers.input(120, 3), [0xFFFF; 3]);
    assert_eq!(registers.discrete(96, 20), [0; 20], "validity of the channels");
    assert!(registers.bit(128), "alarm bit of node_lost");
    hall.subscriber.wait_for("engine1/availability", before, |payload| payload["state"] == "offline");
    hall.subscriber.wait_for("engine1/alarm/node_lost", before, |payload| payload["active"] == true);
    hall.subscriber.wait_for("engine1/state", before, |payload| payload["quality"] == "bad");

    // It keeps asking, and the device is back by itself.
    let asked = hall.device.requests().len();
    wait_until("guard requests to a lost node", || hall.device.requests().len() > asked);
    let before = hall.subscriber.count();
    hall.device.set_state(127);
    hall.device.send_periodically(TPDOS);
    hall.device.answer(true);
    hall.subscriber.wait_for("engine1/alarm/node_lost", before, |payload| payload["active"] == false);
    hall.subscriber.wait_for("engine1/availability", before, |payload| payload["state"] == "online");
    registers
        .wait_for_status("recovery", |status| status.online() && status.operational() && status.all_good());
    assert_eq!(registers.register(100), 627, "16 of 255");
    assert_eq!(hall.device.state(), 5, "the gateway started it");
}

#[test]
fn v_det_02_r_det_021_to_028_power_up_guarding_start_and_stop() {
    let _bus = take_the_bus();
    let capture = Capture::start();
    let device = Device::start(1, 0);
    device.answer(false);
    device.send_periodically(TPDOS);
    let broker = Broker::start();
    let subscriber = Subscriber::start(&broker, TOPICS);
    let gateway = Setup::one_detcon().broker(&broker).start();

    device.answer(true);
    device.restart();
    let registers = gateway.node(1);
    registers.wait_for_status("start", |status| status.operational() && status.all_good());
    capture.wait_for_sequence(
        &["701#00", "701#R1", "701#7F", "000#0101", "701#R1", "701#85", "701#R1", "701#05"],
        0,
    );

    // A stop that somebody else sent: seen as it is, then undone (R-DET-017, R-DET-038).
    let (before, frames) = (subscriber.count(), capture.count());
    cansend("000#0201");
    subscriber.wait_for_event("node_state_unexpected", before);
    let stopped = capture.wait_for("000#0101", frames);
    assert!(
        capture.frames()[frames..stopped].iter().any(|frame| frame == "701#04" || frame == "701#84"),
        "the gateway starts the device after it reported that it is stopped"
    );
    registers.wait_for_status("start after stop", |status| status.operational() && status.all_good());
    assert_eq!(registers.register(TOGGLE_ERRORS), 0);
}

#[test]
fn v_det_03_r_det_023_029_040_041_every_guarding_byte_is_read_as_what_it_is() {
    let _bus = take_the_bus();
    let hall = running();
    let registers = hall.gateway.node(1);
    let restarts = registers.register(RESTARTS);
    hall.device.obey(false);

    for (state, name, replies) in [
        (4, "stopped", ["701#04", "701#84"]),
        (127, "pre_operational", ["701#7F", "701#FF"]),
        (5, "operational", ["701#05", "701#85"]),
    ] {
        let (frames, messages) = (hall.capture.count(), hall.subscriber.count());
        hall.device.set_state(state);
        // TPDOs would say that it is operational (R-DET-083).
        if state == 5 {
            hall.device.send_periodically(TPDOS);
        } else {
            hall.device.send_nothing();
        }
        for reply in replies {
            hall.capture.wait_for(reply, frames);
        }
        wait_until(name, || registers.register(NMT_STATE) == u16::from(state));
        hall.subscriber.wait_for("engine1/state", messages, |payload| payload["nmt"] == name);
    }
    for raw in [6, 126] {
        let (frames, messages) = (hall.capture.count(), hall.subscriber.count());
        hall.device.set_state(raw);
        hall.subscriber.wait_for_event("node_state_invalid", messages);
        hall.capture.wait_for(&format!("701#{raw:02X}"), frames);
        hall.capture.wait_for(&format!("701#{:02X}", raw | 0x80), frames);
        assert_eq!(registers.register(NMT_STATE), 5, "an undefined code leaves the state in place");
        assert!(registers.status().supervision_ok(), "it is a sign of life");
    }
    assert_eq!(registers.register(RESTARTS), restarts, "no restart so far");
    hall.device.send_nothing();
    let frames = hall.capture.count();
    hall.device.set_state(0);
    hall.capture.wait_for("701#80", frames);
    hall.capture.wait_for("701#00", frames);
    wait_until("state boot-up", || registers.register(NMT_STATE) == 0);
    assert_eq!(registers.register(TOGGLE_ERRORS), 0);
}

#[test]
fn v_det_14_r_det_034_035_one_repeated_toggle_bit_is_counted_and_no_alarm() {
    let _bus = take_the_bus();
    let hall = running();
    let registers = hall.gateway.node(1);

    hall.device.repeat_once();
    wait_until("a toggle error", || registers.register(TOGGLE_ERRORS) > 0);
    let replies = hall.device.replies();
    wait_until("more replies", || hall.device.replies() > replies + 4);
    assert_eq!(registers.register(TOGGLE_ERRORS), 1, "the count goes on though the bit alternates");
    assert!(registers.status().supervision_ok() && !registers.bit(128), "no node_lost");
}

#[test]
fn v_det_14_r_det_035_036_037_a_stuck_toggle_bit_ends_in_node_lost_with_uncertain_data() {
    let _bus = take_the_bus();
    let hall = running();
    let before = hall.subscriber.count();
    let frames = hall.capture.count();

    hall.device.toggle(false);
    hall.subscriber.wait_for_event("node_lost", before);

    assert!(hall.gateway.node(1).register(TOGGLE_ERRORS) >= 3);
    assert!(hall.capture.count() > frames, "it answered all the time");
    // TPDOs go on: they are published, but never as good.
    let before = hall.subscriber.count();
    let state = hall.subscriber.wait_for("engine1/state", before, |payload| payload["quality"] != "bad");
    assert_eq!(state.payload["quality"], "uncertain", "{:?}", state.payload);

    hall.device.toggle(true);
    hall.subscriber.wait_for("engine1/alarm/node_lost", before, |payload| payload["active"] == false);
    hall.gateway.node(1).wait_for_status("recovery", |status| status.all_good());
}

#[test]
fn v_det_14_r_det_034_after_a_missed_reply_either_toggle_bit_is_right() {
    let _bus = take_the_bus();
    let hall = running();
    let registers = hall.gateway.node(1);

    // The bit of the last reply again, as if the missed reply had been lost on its way; then the other, as if the request
    // had not reached the device.
    for repeated in [true, false] {
        let misses = registers.register(GUARD_MISSES);
        hall.device.answer(false);
        wait_until("a missed reply", || registers.register(GUARD_MISSES) > misses);
        hall.capture.mark();
        let last = hall.capture.frames().into_iter().rfind(|frame| frame == "701#05" || frame == "701#85");
        let last = last.unwrap() == "701#85";
        let replies = hall.device.replies();
        hall.device.answer_from(last == repeated);
        wait_until("replies", || hall.device.replies() > replies + 3);
        assert_eq!(registers.register(TOGGLE_ERRORS), 0, "repeated: {repeated}");
        assert!(registers.status().supervision_ok() && !registers.bit(128), "no node_lost");
    }
}

#[test]
fn v_det_15_r_det_019_039_084_a_boot_up_in_the_middle_makes_data_stale_until_new_data_comes() {
    let _bus = take_the_bus();
    let hall = running();
    let registers = hall.gateway.node(1);
    assert_eq!(registers.input(140, 8), [16, 32, 48, 64, 80, 96, 112, 128]);
    let (before, frames, restarts) =
        (hall.subscriber.count(), hall.capture.count(), registers.register(RESTARTS));

    hall.device.send_nothing();
    hall.device.obey(false);
    hall.device.restart();
    hall.subscriber.wait_for_event("node_restarted", before);
    assert_eq!(registers.register(RESTARTS), restarts + 1);
    let stale = hall.subscriber.wait_for("engine1/state", before, |payload| payload["quality"] == "stale");
    assert_eq!(
        stale.payload["tags"]["knock_intensity_1"], 6.27,
        "the last value is kept: {:?}",
        stale.payload
    );
    assert_eq!(registers.register(100), 0xFFFF, "but no PLC takes it for live");

    hall.device.obey(true);
    let start = hall.capture.wait_for("000#0101", frames);
    let reply = hall.capture.wait_for("701#7F", frames);
    assert!(reply < start, "started when it reported pre-operational");
    let before = hall.subscriber.count();
    hall.device.send(0x181, &[0; 8]);
    wait_until("the intensities of the new TPDO1", || registers.input(100, 8) == [0; 8]);
    hall.subscriber.wait_for("engine1/state", before, |payload| payload["tags"]["knock_intensity_1"] == 0.0);
    assert_eq!(registers.register(TOGGLE_ERRORS), 0, "the boot-up takes no part in the toggle check");
}
