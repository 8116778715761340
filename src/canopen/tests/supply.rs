//! RPDOs: to whom they are sent, and to whom not.

use std::time::Duration;

use super::bench::{Bench, master, mute, passive};
use crate::can::CanId;
use crate::canopen::{
    ErrorControl, NetworkSettings, NmtRequest, NodeId, NodeSettings, RpdoIndex, RpdoSettings, RpdoTrigger,
    SyncSettings, cob_id,
};
use crate::time::Now;

fn rpdo(number: u16, trigger: RpdoTrigger) -> RpdoSettings {
    RpdoSettings {
        number,
        cob_id: CanId::Standard(0x101 + 0x100 * number),
        length: 2,
        trigger,
        refresh: (trigger == RpdoTrigger::Event).then_some(Duration::from_millis(200)),
        inhibit: Duration::ZERO,
    }
}

/// A guarded node with one RPDO that is sent on change.
fn node() -> NodeSettings {
    NodeSettings { rpdos: vec![rpdo(1, RpdoTrigger::Event)], ..mute() }
}

fn write(bench: &mut Bench, millis: u64, rpdo: usize, byte: u8) {
    let data = Some([byte, 0, 0, 0, 0, 0, 0, 0]);
    bench.run(millis);
    bench.network.set_rpdo(Now::from_millis(millis), NodeId::new(1).unwrap(), RpdoIndex(rpdo), data);
    bench.drain();
}

/// The frames of RPDOs since the last call.
fn sent(bench: &mut Bench) -> Vec<String> {
    bench.take().into_iter().filter(|line| line.contains(" 201#") || line.contains(" 301#")).collect()
}

#[test]
fn an_rpdo_goes_to_an_operational_node_and_stops_with_it() {
    let mut bench = Bench::new(master(vec![node()]));
    write(&mut bench, 0, 0, 7);
    bench.frame(10, "701#7F").run(400);
    assert!(sent(&mut bench).is_empty(), "it is pre-operational");
    bench.frame(501, "701#85").run(950);
    assert_eq!(sent(&mut bench), ["501 201#0700", "701 201#0700", "901 201#0700"]);
    write(&mut bench, 960, 0, 8);
    assert_eq!(sent(&mut bench), ["960 201#0800"], "a change is not waited with");
    bench.frame(1_001, "701#05").run(2_700);
    let lines = bench.take();
    assert!(lines.iter().any(|line| line.ends_with("Lost { stuck_toggle: false }")), "{lines:?}");
    assert!(lines.iter().any(|line| line.ends_with("RpdosStopped")), "{lines:?}");
    bench.run(10_000);
    assert!(sent(&mut bench).is_empty(), "the node is lost");
    bench.frame(10_001, "701#05").run(10_050);
    assert_eq!(sent(&mut bench), ["10001 201#0800"]);
}

#[test]
fn a_node_that_an_operator_stops_is_sent_nothing_from_the_order_on() {
    let mut bench = Bench::new(master(vec![node()]));
    write(&mut bench, 0, 0, 7);
    bench.frame(10, "701#05").take();
    assert!(bench.request(100, 1, NmtRequest::Stop));
    bench.run(400);
    assert!(sent(&mut bench).is_empty());
}

#[test]
fn a_node_that_another_master_stops_is_sent_nothing_until_it_tells_its_state() {
    for command in ["000#0201", "000#8001", "000#8101", "000#0200"] {
        let mut bench = Bench::new(master(vec![node()]));
        write(&mut bench, 0, 0, 7);
        bench.frame(10, "701#05").take();
        bench.frame(100, command).run(400);
        assert!(sent(&mut bench).is_empty(), "{command}");
        bench.frame(501, "701#85").run(510);
        assert_eq!(sent(&mut bench), ["501 201#0700"], "{command} did not reach it");
    }
}

#[test]
fn a_stop_that_did_not_leave_changes_nothing() {
    let mut bench = Bench::new(master(vec![node()]));
    write(&mut bench, 0, 0, 7);
    bench.frame(10, "701#05").take();
    assert!(bench.request(100, 1, NmtRequest::Stop));
    bench.not_sent(110, "000#0201").run(150);
    assert_eq!(sent(&mut bench), ["110 201#0700"]);
}

#[test]
fn nothing_is_sent_while_the_bus_cannot_be_used_nor_before_the_node_is_heard_again() {
    let mut bench = Bench::new(master(vec![node()]));
    write(&mut bench, 0, 0, 7);
    bench.frame(10, "701#05").take();
    bench.link(100, false).run(5_000);
    write(&mut bench, 5_000, 0, 9);
    bench.link(6_000, true).run(6_300);
    assert!(sent(&mut bench).is_empty());
    bench.frame(6_310, "701#85").run(6_320);
    assert_eq!(sent(&mut bench), ["6310 201#0900"]);
}

#[test]
fn r_dst_124_in_the_passive_role_no_rpdo_is_sent() {
    let mut bench = Bench::new(passive(vec![NodeSettings { error_control: ErrorControl::None, ..node() }]));
    write(&mut bench, 0, 0, 7);
    bench.frames(&[(10, "701#00"), (20, "000#0101"), (30, "701#05"), (40, "080#")]).run(10_000);
    let left: Vec<String> = bench.take().into_iter().filter(|line| line.contains('#')).collect();
    assert_eq!(left, Vec::<String>::new(), "not one frame of any kind");
}

#[test]
fn synchronous_rpdos_follow_our_sync_or_that_of_somebody_else() {
    let rpdos = vec![rpdo(1, RpdoTrigger::Sync(2)), rpdo(2, RpdoTrigger::Sync(0))];
    for produced in [true, false] {
        let sync = SyncSettings {
            cob_id: cob_id::SYNC,
            produced,
            period: Some(Duration::from_millis(100)),
            overflow: None,
            window: None,
        };
        let node = NodeSettings { rpdos: rpdos.clone(), ..mute() };
        let mut bench = Bench::new(NetworkSettings { sync: Some(sync), ..master(vec![node]) });
        write(&mut bench, 0, 0, 1);
        write(&mut bench, 0, 1, 1);
        bench.frame(10, "701#05");
        for millis in [100, 200, 300, 400] {
            if produced {
                bench.run(millis);
            } else {
                bench.frame(millis, "080#");
            }
        }
        assert_eq!(
            sent(&mut bench),
            ["100 301#0100", "200 201#0100", "400 201#0100"],
            "produced: {produced}; the acyclic one only after a change"
        );
    }
}

#[test]
fn an_rpdo_that_did_not_leave_is_told_and_tried_again() {
    let mut bench = Bench::new(master(vec![node()]));
    write(&mut bench, 0, 0, 7);
    bench.frame(10, "701#05").take();
    bench.not_sent(11, "201#0700").run(150);
    let lines = bench.take();
    assert_eq!(lines[0], "11 RpdoNotSent { rpdo: RpdoIndex(0) }", "{lines:?}");
    assert!(lines.iter().any(|line| line == "111 201#0700"), "{lines:?}");
}
