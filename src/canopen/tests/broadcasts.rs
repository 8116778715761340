//! SYNC and TIME: who sends them, when, and who must not.

use std::time::Duration;

use super::bench::{Bench, master, mute};
use crate::can::CanId;
use crate::canopen::{
    ErrorControl, Network, NetworkOutput, NetworkSettings, NodeId, NodeSettings, OwnHeartbeatSettings,
    PdoSettings, Role, SyncSettings, TimeSettings, cob_id,
};
use crate::time::{Instant, Now, Timestamp};

const SYNC: SyncSettings = SyncSettings {
    cob_id: cob_id::SYNC,
    produced: true,
    period: Some(Duration::from_millis(100)),
    overflow: None,
    window: None,
};

const TIME: TimeSettings =
    TimeSettings { cob_id: cob_id::TIME, period: Duration::from_secs(10), unsynchronised: false };

/// A bus without nodes.
fn with(sync: Option<SyncSettings>, time: Option<TimeSettings>) -> NetworkSettings {
    NetworkSettings { sync, time, ..NetworkSettings::default() }
}

#[test]
fn r_dst_045_sync_is_sent_with_its_period_and_identifier_and_without_data() {
    let mut bench = Bench::new(with(Some(SYNC), None));
    assert_eq!(bench.run(350).take(), ["0 080#", "100 080#", "200 080#", "300 080#"]);
    let other = SyncSettings { cob_id: CanId::Extended(0x1234_5678), ..SYNC };
    assert_eq!(Bench::new(with(Some(other), None)).run(50).take(), ["0 12345678#"]);
}

#[test]
fn r_dst_045_no_sync_without_being_asked_for_nor_in_the_passive_role_nor_where_another_sends_it() {
    assert!(Bench::new(with(None, None)).run(10_000).take().is_empty());
    let passive = NetworkSettings { role: Role::Passive, ..with(Some(SYNC), Some(TIME)) };
    let mut bench = Bench::new(passive);
    bench.network.handle_clock(Now::from_millis(0), true);
    assert!(bench.run(60_000).take().is_empty());
    let other = SyncSettings { produced: false, ..SYNC };
    assert!(Bench::new(with(Some(other), None)).run(10_000).take().is_empty());
}

#[test]
fn r_dst_062_the_own_heartbeat_says_operational_while_the_bus_can_be_used_and_is_off_in_the_passive_role() {
    let node = NodeId::new(126).unwrap();
    let own_heartbeat = Some(OwnHeartbeatSettings { node, period: Duration::from_secs(1) });
    let settings = NetworkSettings { own_heartbeat, ..NetworkSettings::default() };
    let mut bench = Bench::new(settings.clone());
    assert_eq!(bench.run(2_500).take(), ["0 77E#05", "1000 77E#05", "2000 77E#05"]);
    bench.link(2_600, false).run(9_000);
    assert!(bench.take().is_empty(), "nothing while the bus cannot be used");
    bench.link(9_100, true).run(9_200);
    assert_eq!(bench.take(), ["9100 77E#05"]);
    let passive = NetworkSettings { role: Role::Passive, ..settings };
    assert!(Bench::new(passive).run(60_000).take().is_empty());
}

#[test]
fn sync_stops_with_the_bus_and_its_counter_begins_anew() {
    let mut bench = Bench::new(with(Some(SyncSettings { overflow: Some(3), ..SYNC }), None));
    assert_eq!(bench.run(450).take(), ["0 080#01", "100 080#02", "200 080#03", "300 080#01", "400 080#02"]);
    bench.link(460, false).run(9_990);
    assert!(bench.take().is_empty(), "no SYNC while the bus cannot be used");
    bench.link(9_995, true).run(10_100);
    assert_eq!(bench.take(), ["9995 080#01", "10095 080#02"]);
    bench.link(10_100, false).link(10_110, true).run(10_200);
    assert_eq!(bench.take(), ["10195 080#01"], "not sooner than its period after the one before");
}

#[test]
fn a_late_timer_sends_one_sync_and_goes_on_in_the_old_rhythm() {
    let mut network = Network::new(with(Some(SYNC), None), Now::from_millis(0));
    network.handle_link(Now::from_millis(0), true);
    let mut sent = Vec::new();
    for millis in [0, 730, 731, 799, 800, 905] {
        network.handle_timeout(Now::from_millis(millis));
        sent.extend(std::iter::from_fn(|| network.poll_output()).map(|_| millis));
    }
    assert_eq!(sent, [0, 730, 800, 905]);
    assert_eq!(network.poll_timeout(), Some((Instant::from_millis(1000), "SYNC")));
}

#[test]
fn sync_and_time_of_somebody_else_are_told_as_such_and_as_a_second_producer_where_we_send_them() {
    let mut bench = Bench::new(with(Some(SYNC), None));
    bench.frame(50, "080#").frame(60, "080#07").frame(70, "100#000000000000").frame(80, "080#R0");
    assert_eq!(
        bench.take(),
        [
            "0 080#",
            "50 Sync { produced: true, first: true }",
            "60 Sync { produced: true, first: false }",
            "70 Time { produced: false, first: true }",
            "80 UnknownId { id: 080, node: None, first: false }",
        ]
    );
    let mut moved =
        Bench::new(with(Some(SyncSettings { cob_id: CanId::Standard(0x70), ..SYNC }), Some(TIME)));
    moved.run(0).take();
    moved.frame(1, "080#").frame(2, "070#").frame(3, "100#000000000000");
    assert_eq!(
        moved.take(),
        [
            "1 UnknownId { id: 080, node: None, first: true }",
            "2 Sync { produced: true, first: true }",
            "3 Time { produced: true, first: true }",
        ]
    );
}

/// What a network with TIME sends while its clock is, or is not, known to be right.
#[test]
fn time_is_sent_while_the_clock_is_right_and_tells_utc() {
    let at = |millis: u64| {
        let utc = Timestamp::from_millis(1_763_797_593_123 + i64::try_from(millis).unwrap());
        Now { instant: Instant::from_millis(millis), utc }
    };
    let run = |settings: TimeSettings, clock: &[(u64, bool)]| {
        let mut network = Network::new(with(None, Some(settings)), at(0));
        network.handle_link(at(0), true);
        let mut sent = Vec::new();
        for millis in 0..40_000 {
            for (_, right) in clock.iter().filter(|(from, _)| *from == millis) {
                network.handle_clock(at(millis), *right);
            }
            if network.poll_timeout().is_some_and(|(due, _)| due <= at(millis).instant) {
                network.handle_timeout(at(millis));
            }
            while let Some(NetworkOutput::Transmit(frame)) = network.poll_output() {
                sent.push(format!("{millis} {frame}"));
            }
        }
        sent
    };
    assert_eq!(run(TIME, &[]), Vec::<String>::new(), "nobody said that the clock is right");
    assert_eq!(
        run(TIME, &[(5_000, true), (16_000, false), (31_000, true)]),
        ["5000 100#AB37AB01C53B", "15000 100#BB5EAB01C53B", "31000 100#3B9DAB01C53B"]
    );
    let always = TimeSettings { unsynchronised: true, ..TIME };
    assert_eq!(run(always, &[(5_000, false)]).len(), 4);
}

#[test]
fn a_synchronous_tpdo_that_comes_after_the_window_is_told() {
    let pdo = |number: u16, synchronous| PdoSettings {
        number,
        cob_id: CanId::Standard(0x081 + 0x100 * number),
        length: 1,
        strict_length: false,
        timeout: None,
        synchronous,
        shortest_period: None,
    };
    let node =
        NodeSettings { error_control: ErrorControl::None, pdos: vec![pdo(1, true), pdo(2, false)], ..mute() };
    for produced in [true, false] {
        let sync = SyncSettings { window: Some(Duration::from_millis(10)), produced, ..SYNC };
        let mut bench = Bench::new(NetworkSettings { sync: Some(sync), ..master(vec![node.clone()]) });
        for millis in [100, 200] {
            if !produced {
                bench.frame(millis, "080#");
            }
        }
        bench.frame(210, "181#00").frame(211, "181#00").frame(290, "281#00");
        bench.frame(291, "181#R1").frame(292, "181#");
        let told = bench.take_those_with("Window");
        assert_eq!(told, ["211 PdoOutsideWindow { pdo: PdoIndex(0), after: 11ms }"], "produced: {produced}");
    }
}
