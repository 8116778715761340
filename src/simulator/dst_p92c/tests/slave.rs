//! NMT, boot-up, heartbeat, self-start, and the mishaps of any slave.

use proptest::prelude::*;

use super::bench::{Bench, quiet};
use crate::can::{CanFrame, CanId};
use crate::canopen::NmtState;
use crate::simulator::Device;
use crate::simulator::dst_p92c::DstSettings;

#[test]
fn v_dst_12_r_dst_006_051_054_055_060_boot_up_start_heartbeat() {
    let mut bench = Bench::powered(&quiet());
    assert_eq!(bench.state(), Some(NmtState::Initialising));
    bench.run_for(150);
    assert_eq!(bench.take(), [(100, "701#00".to_owned())]);
    assert_eq!(bench.state(), Some(NmtState::PreOperational));
    bench.talk(&[("601#2B171000E8030000", "581#6017100000000000")]);
    let written = bench.now() - 2;
    bench.run_to(written + 1000);
    assert_eq!(bench.take(), [(written + 1000, "701#7F".to_owned())]);
    for (command, heartbeat) in
        [("000#0101", "701#05"), ("000#0200", "701#04"), ("000#8001", "701#7F"), ("000#0100", "701#05")]
    {
        bench.frame(command);
        bench.run_for(1000);
        assert_eq!(bench.of("701"), [heartbeat], "{command}");
    }
    bench.frame("000#0202");
    assert_eq!(bench.state(), Some(NmtState::Operational), "not for this node");
    bench.talk(&[("601#2B17100000000000", "581#6017100000000000")]);
    bench.run_for(5000);
    assert!(bench.of("701").is_empty());
}

#[test]
fn r_dst_052_an_error_at_power_up_is_told_instead_of_the_boot_up_message_or_after_it() {
    for (boot_on_error, expected) in
        [(false, &["081#0063810000000000"][..]), (true, &["701#00", "081#0063810000000000"])]
    {
        let mut bench = Bench::ready_as(&DstSettings { boot_on_error, ..quiet() });
        bench.order("boot error on");
        bench.order("power cycle");
        bench.run_for(200);
        assert_eq!(bench.frames(), expected);
        assert_eq!(bench.state(), Some(NmtState::PreOperational));
        assert_eq!(bench.read(0x1001, 0), 0x81);
        bench.take();
        bench.order("boot error off");
        assert_eq!(bench.frames(), ["081#0000000000000000"]);
        bench.order("power cycle");
        bench.run_for(200);
        assert_eq!(bench.frames(), ["701#00"]);
    }
}

#[test]
fn r_dst_052_an_overload_at_power_up_is_such_an_error() {
    let mut bench = Bench::powered(&DstSettings { pressure_bar: 500.0, ..quiet() });
    bench.run_for(200);
    assert_eq!(bench.frames(), ["081#11F0210000000000"]);
}

#[test]
fn r_dst_056_reset_node_and_reset_communication_boot_again() {
    let mut bench = Bench::ready();
    for (command, own) in [("000#8101", 0), ("000#8200", 7)] {
        bench.write(0x1800, 5, 2, 50);
        bench.write(0x61A1, 1, 1, 7);
        bench.take();
        bench.frame(command);
        assert_eq!(bench.state(), Some(NmtState::Initialising));
        assert_eq!(bench.ask("601#4000100000000000"), "-");
        bench.run_for(200);
        assert_eq!(bench.read(0x1800, 5), 1000, "{command}");
        let expected = if own == 0 { 30 } else { own };
        assert_eq!(bench.read(0x61A1, 1), expected, "{command}");
    }
}

#[test]
fn r_dst_058_a_self_starting_device_is_operational_after_it_has_booted() {
    let settings = DstSettings { default_transmission_type: 255, ..quiet() };
    let mut bench = Bench::ready_as(&settings);
    assert_eq!(bench.write(0x1F80, 0, 4, 8), 0);
    bench.order("power cycle");
    bench.run_for(200);
    assert_eq!(bench.state(), Some(NmtState::PreOperational), "not saved");
    bench.write(0x1F80, 0, 4, 8);
    bench.write(0x1010, 1, 4, 0x6576_6173);
    bench.take();
    bench.order("power cycle");
    bench.run_for(1250);
    assert_eq!(bench.frames(), ["701#00", "181#80A8120100", "181#80A8120100"]);
    assert_eq!(bench.state(), Some(NmtState::Operational));
}

#[test]
fn r_dst_071_sdo_is_answered_in_each_state_but_stopped() {
    for (sdo_in_stopped, answered) in [(false, false), (true, true)] {
        let mut bench = Bench::ready_as(&DstSettings { sdo_in_stopped, ..quiet() });
        let ask = |bench: &mut Bench| bench.ask("601#4000100000000000") == "581#4300100094010200";
        assert!(ask(&mut bench));
        bench.frame("000#0101");
        assert!(ask(&mut bench));
        bench.frame("000#0201");
        assert_eq!(ask(&mut bench), answered);
        bench.frame("000#8001");
        assert!(ask(&mut bench));
    }
}

#[test]
fn r_dst_075_an_error_that_comes_in_stopped_is_told_afterwards() {
    let mut bench = Bench::ready();
    bench.frame("000#0201");
    bench.order("emcy F011");
    bench.run_for(100);
    assert!(bench.frames().is_empty());
    bench.frame("000#8001");
    assert_eq!(bench.frames(), ["081#11F0210000000000"]);
    bench.order("mute emcy on");
    bench.order("emcy clear");
    assert!(bench.frames().is_empty());
    assert_eq!(bench.read(0x1001, 0), 0);
}

#[test]
fn heartbeats_are_missing_when_they_are_muted() {
    let mut bench = Bench::ready();
    bench.write(0x1017, 0, 2, 100);
    bench.order("mute heartbeat on");
    bench.take();
    bench.run_for(1000);
    assert!(bench.frames().is_empty());
    bench.order("mute heartbeat off");
    bench.run_for(1000);
    assert_eq!(bench.of("701#7F").len(), 10);
}

#[test]
fn what_can_happen_to_any_slave_happens_to_this_one() {
    let mut bench = Bench::ready();
    bench.order("refuse start on");
    bench.frame("000#0101");
    assert_eq!(bench.state(), Some(NmtState::PreOperational));
    bench.order("clear all");
    bench.frame("000#0101");
    assert_eq!(bench.state(), Some(NmtState::Operational));
    bench.order("second master on");
    assert_eq!(bench.state(), Some(NmtState::Stopped));
    bench.order("second master off");
    bench.order("duplicate on");
    bench.take();
    bench.order("power cycle");
    bench.run_for(200);
    assert_eq!(bench.frames(), ["701#00", "701#00"]);
    bench.order("clear all");
    bench.order("boot loop 1000");
    bench.run_for(3500);
    assert_eq!(bench.of("701#00").len(), 3);
    bench.order("power off");
    bench.take();
    bench.run_for(5000);
    assert!(bench.frames().is_empty());
    assert_eq!(bench.state(), None);
}

#[derive(Clone, Debug)]
enum Happening {
    Frame(String),
    Order(&'static str),
}

fn happenings() -> impl Strategy<Value = Vec<(u64, Happening)>> {
    let ids = prop_oneof![Just(0x000_u16), Just(0x080), Just(0x601), Just(0x7E5), 0_u16..=0x7FF];
    let command = prop_oneof![Just(0x01_u8), Just(0x02), Just(0x04), Just(0x40), Just(0x23), any::<u8>()];
    let frame =
        (ids, command, proptest::collection::vec(any::<u8>(), 0..=7)).prop_map(|(id, first, rest)| {
            let data = [vec![first], rest].concat();
            let frame = CanFrame::data_frame(CanId::Standard(id), &data);
            Happening::Frame(frame.unwrap().to_string())
        });
    let orders = prop_oneof![
        Just("power cycle"),
        Just("pressure 500"),
        Just("pressure 100 700"),
        Just("clear all"),
        Just("duplicate on"),
        Just("boot loop 0"),
        Just("second master on"),
        Just("set 1800 5 1"),
        Just("set 1800 3 65535"),
        Just("emcy F011"),
        Just("late sdo 0"),
        Just("bus 0"),
    ];
    let happening = prop_oneof![3 => frame, 1 => orders.prop_map(Happening::Order)];
    proptest::collection::vec((0_u64..300, happening), 0..100)
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    #[test]
    fn whatever_happens_the_device_goes_on_and_answers_after_a_power_cycle(happenings in happenings()) {
        let mut bench = Bench::ready();
        for (pause, happening) in &happenings {
            bench.run_for(*pause);
            match happening {
                Happening::Frame(frame) => bench.frame(frame),
                Happening::Order(order) => bench.order(order),
            }
        }
        bench.order("clear all");
        bench.order("bus 0");
        bench.order("power off");
        bench.order("power on");
        bench.run_for(500);
        let node = bench.device.node().get();
        let answer = bench.ask(&format!("{:03X}#4000100000000000", 0x600 + u16::from(node)));
        prop_assert!(answer.ends_with("#4300100094010200"), "{}", answer);
    }
}
