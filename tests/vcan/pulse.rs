//! A trip that is over long before the client looks again.

use std::time::Duration;

use crate::harness::broker::{Broker, Subscriber};
use crate::harness::bus::take_the_bus;
use crate::harness::device::Device;
use crate::harness::gateway::{Setup, TOPICS};
use crate::harness::modbus::{Table, mbpoll};
use crate::harness::wait::{give_it, wait_for};

const TRIP: u16 = 1;
const LATCHED_TRIP: u16 = 17;
const TRIP_RISES: u16 = 171;
const SECONDS_SINCE_TRIP: u16 = 181;

#[test]
fn r_det_092_a_trip_of_100_ms_is_seen_by_a_client_that_polls_every_five_seconds() {
    let _bus = take_the_bus();
    let broker = Broker::start();
    let subscriber = Subscriber::start(&broker, TOPICS);
    let device = Device::start(1, 5);
    let quiet: &[u8] = &[0, 128, 0xFF, 0xFF, 0, 0, 153, 204];
    device.send_periodically([&[1; 8], &[2; 8], quiet, &[3, 3, 3, 3, 15, 0]]);
    let gateway = Setup::one_detcon().broker(&broker).start();
    gateway.node(1).wait_for_status("good data", |status| status.all_good());

    let read = |table, address| mbpoll(gateway.modbus, 1, table, address, 1).unwrap()[0];
    assert_eq!((read(Table::Discrete, TRIP), read(Table::Discrete, LATCHED_TRIP)), (0, 0));
    assert_eq!(read(Table::Input, SECONDS_SINCE_TRIP), 65535, "never");
    let rises = read(Table::Input, TRIP_RISES);
    let newest_event = gateway.unit().u32(200);
    let messages = subscriber.count();

    give_it(Duration::from_secs(2));
    device.send(0x381, &[2, 128, 0xFF, 0xFF, 0, 0, 153, 204]);
    give_it(Duration::from_millis(100));
    device.send(0x381, quiet);
    give_it(Duration::from_secs(3));

    assert_eq!(read(Table::Discrete, TRIP), 0, "the trip itself is over");
    assert_eq!(read(Table::Discrete, LATCHED_TRIP), 1, "latched until acknowledged");
    assert_eq!(read(Table::Input, TRIP_RISES), rises + 1, "counted once");
    assert!(read(Table::Input, SECONDS_SINCE_TRIP) < 60);
    assert!(gateway.unit().u32(200) > newest_event, "an event in the ring");
    let alarm = |state: &str| {
        wait_for(format!("the trip alarm to be {state}"), || {
            let seen = subscriber.of("engine1/alarm/trip", messages);
            seen.into_iter().find(|message| message.payload["state"] == state)
        })
    };
    let (came, went) = (alarm("unacknowledged"), alarm("latched_unacknowledged"));
    assert_eq!(came.payload["priority"], "critical");
    assert_eq!(went.payload["active"], true, "it waits for somebody to see it");
    let event =
        subscriber.wait_for("event", messages, |event| event["kind"] == "alarm" && event["name"] == "trip");
    assert_eq!(event.payload["node"], "engine1");
}
