//! A broker that is killed again and again while events come.

use std::collections::BTreeSet;
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering::SeqCst};
use std::time::Duration;

use crate::harness::broker::{Broker, Message, Subscriber};
use crate::harness::bus::take_the_bus;
use crate::harness::device::Device;
use crate::harness::gateway::{Setup, TOPICS};
use crate::harness::proxy::Cable;
use crate::harness::wait::{give_it, wait_until};

const KILLS: u32 = 20;

/// Sequence numbers of the events, in the order of their arrival.
fn sequence(messages: &[Message]) -> Vec<u64> {
    messages.iter().map(|message| message.payload["seq"].as_u64().unwrap()).collect()
}

#[test]
fn every_event_arrives_in_order_though_the_broker_is_killed_twenty_times() {
    let _bus = take_the_bus();
    let mut broker = Broker::start();
    let subscriber = Subscriber::start(&broker, TOPICS);
    let cable = Cable::to(&broker);
    let device = Device::start(1, 5);
    let status = |bad: u16| {
        let [low, high] = bad.to_le_bytes();
        [0, 128, 0xFF, 0xFF, low, high, 153, 204]
    };
    device.send_periodically([&[1; 8], &[2; 8], &status(0), &[4, 4, 4, 4, 15, 0]]);
    let gateway = Setup::one_detcon()
        .broker_port(cable.port)
        .mqtt_key("reconnect_max_s = 1")
        .more("[node.engine1.alarm.\"sensor_fault_*\"]\non_delay_ms = 0\noff_delay_ms = 0")
        .start();
    gateway.node(1).wait_for_status("good data", |status| status.all_good());
    // Load: alarms that rise and fall, each so seldom that none chatters and no event is folded into a count.
    let (done, rises) = (AtomicBool::new(false), AtomicU32::new(0));
    let mut connections = cable.connections();
    let mut generations = vec![0];
    std::thread::scope(|scope| {
        scope.spawn(|| {
            while !done.load(SeqCst) {
                for bad in [1_u16.rotate_left(rises.load(SeqCst)), 0] {
                    device.send(0x381, &status(bad));
                    device.send(0x181, &[rises.load(SeqCst) as u8; 8]);
                    give_it(Duration::from_secs(1));
                }
                rises.fetch_add(1, SeqCst);
            }
        });
        for _ in 0..KILLS {
            let events = subscriber.of("event", 0).len();
            wait_until("events", || subscriber.of("event", 0).len() > events + 2);
            cable.pull();
            broker.kill();
            cable.cut();
            broker.restart();
            subscriber.wait_until_subscribed(&broker);
            generations.push(subscriber.count());
            cable.plug();
            wait_until("the gateway to connect again", || cable.connections() > connections);
            connections = cable.connections();
        }
        done.store(true, SeqCst);
    });
    let rises = rises.load(SeqCst);
    let faults = || {
        let events = subscriber.of("event", 0);
        let is_ours = |event: &&Message| {
            let name = event.payload["name"].as_str().unwrap_or_default();
            event.payload["kind"] == "alarm" && name.starts_with("sensor_fault_")
        };
        events
            .iter()
            .filter(is_ours)
            .filter_map(|event| event.payload["seq"].as_u64())
            .collect::<BTreeSet<_>>()
    };
    // A rise is one event at least, its end another.
    wait_until("all events", || faults().len() as u32 >= 2 * rises);

    // Whole: no number is missing between the first and the last.
    let all = sequence(&subscriber.of("event", 0));
    let distinct: BTreeSet<u64> = all.iter().copied().collect();
    let (first, last) = (*distinct.first().unwrap(), *distinct.last().unwrap());
    let missing: Vec<u64> = (first..=last).filter(|number| !distinct.contains(number)).collect();
    println!(
        "broker: {KILLS} kills, {} events, {} duplicates, {rises} rises",
        distinct.len(),
        all.len() - distinct.len()
    );
    assert!(missing.is_empty(), "events that never arrived: {missing:?}");
    // In order: within one connection each number is higher than the one before, so a repetition needs a reconnection.
    generations.push(subscriber.count());
    for range in generations.windows(2) {
        let messages = subscriber.since(range[0]);
        let part = &messages[..range[1].saturating_sub(range[0]).min(messages.len())];
        let events: Vec<Message> = part.iter().filter(|message| message.topic == "event").cloned().collect();
        let numbers = sequence(&events);
        assert!(numbers.windows(2).all(|pair| pair[0] < pair[1]), "out of order or repeated: {numbers:?}");
    }
    // One stream: the gateway was never restarted.
    let streams: BTreeSet<String> =
        subscriber.of("event", 0).iter().map(|event| event.payload["sid"].to_string()).collect();
    assert_eq!(streams.len(), 1, "{streams:?}");
}

#[test]
fn the_last_will_tells_that_a_killed_gateway_is_gone() {
    let _bus = take_the_bus();
    let broker = Broker::start();
    let subscriber = Subscriber::start(&broker, TOPICS);
    let mut gateway = Setup::one_detcon().broker(&broker).start();
    subscriber.wait_for("bridge/state", 0, |payload| payload["state"] == "online");
    for kill in [true, false] {
        let messages = subscriber.count();
        if kill {
            gateway.process.kill();
        } else {
            assert_eq!(gateway.process.terminate().code(), Some(0));
        }
        subscriber.wait_for("bridge/state", messages, |payload| payload["state"] == "offline");
        let messages = subscriber.count();
        gateway.start_again();
        subscriber.wait_for("bridge/state", messages, |payload| payload["state"] == "online");
    }
    // Who comes late hears it from the broker.
    let late = Subscriber::start(&broker, TOPICS);
    let state = late.wait_for("bridge/state", 0, |payload| payload["state"] == "online");
    assert!(state.retained);
}
