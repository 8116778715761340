//! The core, frames in and values out.

use super::*;
use crate::can::{BusCounters, Link};
use crate::gateway::{Action, CommandSource, fixture};
use crate::process_image::{BusState, EventKind, Reason, Value};

/// A gateway with its image; time in milliseconds.
struct Bench {
    gateway: Gateway,
    image: ProcessImage,
}

const BUS: BusIndex = BusIndex(0);
const ENGINE1: NodeIndex = NodeIndex(0);

impl Bench {
    fn new(table: TagTable) -> Self {
        let gateway = Gateway::new(Arc::new(table), Now::from_millis(0));
        let image = gateway.empty_image();
        let mut bench = Self { gateway, image };
        bench.link(0, Link::ErrorActive);
        bench
    }

    fn bus(&mut self, event: BusEvent) {
        self.gateway.handle_input(Now::from_millis(0), Input::Bus { bus: BUS, event });
        self.publish();
    }

    fn frame(&mut self, millis: u64, frame: &str) {
        let at = Now::from_millis(millis);
        self.bus(BusEvent::Frame { frame: frame.parse().unwrap(), at });
    }

    fn link(&mut self, millis: u64, link: Link) {
        self.bus(BusEvent::Link { link, at: Now::from_millis(millis) });
    }

    fn run_to(&mut self, millis: u64) {
        let end = Now::from_millis(millis);
        while let Some((due, _)) = self.gateway.poll_timeout()
            && due <= end.instant
        {
            self.gateway.handle_timeout(Now::from_millis(due.as_micros().div_ceil(1_000)));
            while self.gateway.poll_output().is_some() {}
        }
        self.publish();
    }

    fn publish(&mut self) {
        while self.gateway.poll_output().is_some() {}
        self.gateway.publish(&mut self.image);
    }

    fn sample(&self, name: &str) -> crate::process_image::Sample {
        let tag = self.gateway.table.find_tag(ENGINE1, name).unwrap();
        *self.image.tag(tag)
    }

    fn events(&self) -> Vec<&str> {
        let mut names: Vec<&str> =
            self.image.journal.newest_first().map(|event| event.name.as_str()).collect();
        names.reverse();
        names
    }
}

#[test]
fn a_tpdo_becomes_values_with_quality_time_and_revision() {
    let mut bench = Bench::new(fixture::table());
    assert_eq!(bench.sample("level").quality, Quality::NEVER);
    assert_eq!(bench.sample("trip").value, Value::Bool(false), "of the right kind from the start");
    bench.frame(40, "181#3301");
    let level = bench.sample("level");
    assert_eq!((level.raw, level.value), (Value::Unsigned(51), Value::Float(20.0)));
    assert_eq!((level.quality, level.received), (Quality::Good, Now::from_millis(40).utc));
    assert_eq!(level.revision, bench.image.revision);
    assert_eq!(bench.sample("margin").quality, Quality::NEVER, "its limit comes in another TPDO");
    bench.frame(50, "281#66");
    assert_eq!(bench.sample("margin").value, Value::Float(20.0));
}

#[test]
fn the_same_data_again_is_no_change_but_fresh() {
    let mut bench = Bench::new(fixture::table());
    bench.frame(40, "181#3301");
    bench.run_to(45);
    let before = (bench.image.revision, bench.image.nodes[0].revision);
    bench.frame(60, "181#3301");
    assert_eq!((bench.image.revision, bench.image.nodes[0].revision), before);
    assert_eq!(bench.sample("level").received, Now::from_millis(60).utc);
    assert_eq!(bench.sample("trips").received, Now::from_millis(60).utc, "computed tags too");
    assert_eq!(bench.image.nodes[0].counters.frames_received, 2);
    bench.frame(70, "181#3401");
    assert!(bench.image.revision > before.0 && bench.image.nodes[0].revision > before.1);
}

#[test]
fn a_bus_that_goes_down_makes_the_data_bad_and_keeps_the_value() {
    let mut bench = Bench::new(fixture::table());
    bench.link(0, Link::ErrorActive);
    bench.frame(40, "181#3301");
    bench.link(100, Link::Down);
    let level = bench.sample("level");
    assert_eq!((level.value, level.quality), (Value::Float(20.0), Quality::Bad(Reason::BusUnavailable)));
    assert_eq!(bench.sample("limit").quality, Quality::NEVER);
    assert_eq!(bench.image.buses[0].state, BusState::Down);
    let node = &bench.image.nodes[0];
    assert!(!node.online && node.reason.contains("`can0` is down"), "{}", node.reason);
    bench.link(200, Link::ErrorActive);
    assert_eq!(bench.sample("level").quality, Quality::Bad(Reason::BusUnavailable));
    bench.frame(210, "181#3301");
    assert_eq!(bench.sample("level").quality, Quality::Good);
    assert!(bench.image.nodes[0].online);
}

#[test]
fn r_det_046_nodes_are_asked_at_once_when_the_bus_can_be_used_and_not_before() {
    let mut gateway = Gateway::new(Arc::new(fixture::table()), Now::from_millis(0));
    gateway.handle_timeout(Now::from_millis(5_000));
    assert_eq!(gateway.poll_output(), None);
    let event = BusEvent::Link { link: Link::ErrorActive, at: Now::from_millis(6_000) };
    gateway.handle_input(Now::from_millis(6_000), Input::Bus { bus: BUS, event });
    gateway.handle_timeout(Now::from_millis(6_000));
    let request = Output::Transmit { bus: BUS, frame: "701#R1".parse().unwrap() };
    assert_eq!(std::iter::from_fn(|| gateway.poll_output()).collect::<Vec<_>>(), [request]);
}

#[test]
fn r_det_084_zero_on_bad_replaces_the_value_where_it_is_asked_for() {
    let mut table = fixture::table();
    table.nodes[0].zero_on_bad = true;
    let mut bench = Bench::new(table);
    bench.frame(40, "181#3301");
    bench.link(100, Link::BusOff);
    let (level, trip) = (bench.sample("level"), bench.sample("trip"));
    assert_eq!((level.value, level.raw), (Value::Float(0.0), Value::Unsigned(0)));
    assert_eq!(trip.value, Value::Bool(false));
}

#[test]
fn r_det_052_reserved_bits_are_counted_and_told_once() {
    let mut bench = Bench::new(fixture::table());
    for millis in [10, 20, 30] {
        bench.frame(millis, "181#3380");
    }
    assert_eq!(bench.image.nodes[0].counters.reserved_bits, 3);
    assert_eq!(bench.events().iter().filter(|name| **name == "reserved_bits").count(), 1);
    assert_eq!(bench.sample("trip").value, Value::Bool(false));
}

#[test]
fn an_edge_of_a_counted_bit_is_an_event_and_a_pulse_is_not_lost_between_two_readings() {
    let mut bench = Bench::new(fixture::table());
    bench.frame(0, "181#0000");
    let pulse = ["181#0001", "181#0000"].map(|frame| frame.parse().unwrap());
    for (millis, frame) in [(100, pulse[0]), (200, pulse[1])] {
        let event = BusEvent::Frame { frame, at: Now::from_millis(millis) };
        bench.gateway.handle_input(Now::from_millis(millis), Input::Bus { bus: BUS, event });
    }
    bench.publish();
    assert_eq!(bench.sample("trip").value, Value::Bool(false));
    assert_eq!(bench.sample("trips").value, Value::Unsigned(1));
    assert_eq!(bench.sample("trip_latched").value, Value::Bool(true));
    let edges = bench.image.journal.newest_first();
    assert_eq!(edges.filter(|event| event.name == "trip" && event.kind == EventKind::Node).count(), 2);
    bench.run_to(3_300);
    assert_eq!(bench.sample("trip_age").value, Value::Unsigned(2), "last computed at 3.0 s");
}

#[test]
fn r_det_089_load_and_rates_come_from_counters_with_the_configured_bit_rate() {
    let mut bench = Bench::new(fixture::table());
    let report = |seconds: u64, overruns| BusEvent::Counters {
        counters: BusCounters {
            frames_received: 1_000 * seconds,
            frames_sent: 10 * seconds,
            wire_bits: 112_500 * seconds,
            overruns,
            ..BusCounters::default()
        },
        at: Now::from_millis(1_000 * seconds),
    };
    bench.bus(report(1, 0));
    bench.bus(report(2, 0));
    let bus = bench.image.buses[0];
    assert_eq!((bus.load_permille, bus.frames_per_second), (Some(900), 1_010));
    assert!(bench.gateway.conditions.is_set(AlarmOwner::Bus(BUS), BuiltIn::HighLoad));
    bench.bus(report(3, 7));
    assert_eq!(bench.image.buses[0].overruns, 7);
    assert!(bench.events().contains(&"frames_lost"));
}

#[test]
fn a_full_queue_to_the_bus_is_counted_and_is_not_the_nodes_fault() {
    let mut bench = Bench::new(fixture::table());
    bench.link(0, Link::ErrorActive);
    let request = "701#R1".parse().unwrap();
    bench.gateway.handle_refused(Now::from_millis(1), BUS, &request);
    bench.publish();
    assert_eq!(bench.image.buses[0].frames_not_sent, 1);
    assert!(bench.events().contains(&"frame_not_sent"));
}
#[test]
fn frames_not_sent_never_become_fewer() {
    let mut bench = Bench::new(fixture::table());
    bench.link(0, Link::ErrorActive);
    let report = |millis, frames_not_sent| BusEvent::Counters {
        counters: BusCounters { frames_not_sent, ..BusCounters::default() },
        at: Now::from_millis(millis),
    };
    bench.bus(report(1_000, 1));
    bench.bus(report(1_100, 9));
    bench.gateway.handle_refused(Now::from_millis(1_200), BUS, &"701#R1".parse().unwrap());
    bench.publish();
    assert_eq!(bench.image.buses[0].frames_not_sent, 10);
    bench.bus(report(1_300, 9));
    assert_eq!(bench.image.buses[0].frames_not_sent, 10);
}

#[test]
fn r_det_089_a_bus_that_was_heard_has_no_wrong_bit_rate() {
    let mut bench = Bench::new(fixture::table());
    bench.link(0, Link::ErrorActive);
    bench.frame(40, "181#3301");
    bench.link(100, Link::BusOff);
    let told = bench.image.journal.newest_first().find(|event| event.name == "bus_state").unwrap();
    assert_eq!(told.text, "");
}

#[test]
fn a_command_whose_frame_finds_the_queue_full_is_answered_busy() {
    let mut bench = Bench::new(fixture::table());
    bench.link(0, Link::ErrorActive);
    let action = Action::Nmt { node: ENGINE1, request: crate::canopen::NmtRequest::Stop };
    let command = Command { id: 3, source: CommandSource::web("test".into()), action };
    let now = Now::from_millis(50);
    bench.gateway.handle_input(now, Input::Command(command));
    let mut outcomes = Vec::new();
    while let Some(output) = bench.gateway.poll_output() {
        match output {
            Output::Transmit { bus, frame } => bench.gateway.handle_refused(now, bus, &frame),
            Output::Reply { id, outcome } => outcomes.push((id, outcome)),
        }
    }
    assert_eq!(outcomes, [(3, Outcome::Busy)]);
    bench.publish();
    let told = bench.image.journal.newest_first().find(|event| event.kind == EventKind::Command).unwrap();
    assert_eq!(told.to, "busy");
}

#[test]
fn r_dst_037_a_number_that_is_none_is_bad_and_clears_no_alarm() {
    const PRESSURE: &str = r#"
        format = 1
        device = { vendor = "test", model = "pressure" }
        [tpdo.1]
        cob_id = "$NODEID+0x180"
        length = 8
        period_ms = 100
        [[tag]]
        name = "pressure"
        tpdo = 1
        bit = 0
        type = "f32"
        [[tag]]
        name = "temperature"
        tpdo = 1
        bit = 32
        type = "i32"
        [[derived]]
        name = "margin"
        margin = { of = "pressure", to = "temperature" }
        [[alarm]]
        name = "high"
        when = "pressure > 5"
        priority = "high"
        text = ""
        action = ""
    "#;
    let mut bench = Bench::new(fixture::of(PRESSURE));
    let alarm = bench.gateway.table.alarms.iter().position(|alarm| alarm.name == "high").unwrap();
    bench.frame(10, "181#0000C84200000000");
    assert_eq!(
        (bench.sample("pressure").value, bench.sample("pressure").quality),
        (Value::Float(100.0), Quality::Good)
    );
    assert!(bench.image.alarms[alarm].state.is_active() && bench.image.nodes[0].data_good);
    for (millis, none) in [(20, "0000C07F"), (30, "0000807F"), (40, "000080FF")] {
        bench.frame(millis, &format!("181#{none}07000000"));
        assert_eq!(bench.sample("pressure").quality.to_string(), "bad (not_a_number)");
        assert_eq!(bench.sample("margin").quality.to_string(), "bad (not_a_number)");
        assert!(bench.image.alarms[alarm].state.is_active());
        assert_eq!(bench.sample("temperature").quality, Quality::Good);
        assert!(!bench.image.nodes[0].data_good && bench.image.nodes[0].pdos[0].usable);
    }
    bench.frame(50, "181#0000000000000000");
    assert_eq!(bench.sample("pressure").quality, Quality::Good);
    assert!(!bench.image.alarms[alarm].state.is_active());
}

#[test]
fn the_number_of_the_highest_is_that_of_its_name_where_numbers_are_left_out() {
    let level = |number: u8| {
        format!("[[tag]]\nname = 'level_{number}'\ntpdo = 1\nbit = {}\ntype = 'u8'\n", 8 * (number / 2))
    };
    let levels = [1, 4, 9].map(level).concat();
    let mapping = format!(
        "format = 1\ndevice = {{ vendor = 'test', model = 'levels' }}\n[tpdo.1]\ncob_id = '$NODEID+0x180'\n\
         length = 8\nperiod_ms = 100\n{levels}[[derived]]\nname = 'which'\narg_maximum = 'level_*'\n"
    );
    let mut bench = Bench::new(fixture::of(&mapping));
    for (millis, frame, number) in [(10, "01", 1), (20, "000002", 4), (30, "0000000003", 9)] {
        bench.frame(millis, &format!("181#{frame:0<16}"));
        assert_eq!(bench.sample("which").value, Value::Unsigned(number));
    }
}
