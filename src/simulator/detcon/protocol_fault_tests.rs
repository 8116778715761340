//! Tests of [`Detcon`] that misbehaves, is not looked after, or meets anything at all.

use proptest::prelude::*;

use super::super::bench::{Bench, channel, healthy, in_phase, sent};
use super::*;
use crate::can::CanId;

#[test]
fn muted_guarding_answers_nothing_and_comes_back() {
    let mut bench = Bench::operational(healthy(), 100);
    assert_eq!(bench.guard(200).as_deref(), Some("05"));
    bench.faults(300, |faults| faults.mute_guarding = true);
    assert_eq!(bench.guard(400), None);
    bench.faults(500, |faults| faults.mute_guarding = false);
    assert_eq!(bench.guard(600).as_deref(), Some("85"));
}

#[test]
fn muted_pdos_are_silent_one_by_one() {
    let mut bench = Bench::operational(in_phase(), 1000);
    bench.faults(1100, |faults| faults.set_mute(Tpdo::Three, true));
    bench.take();
    bench.run_to(2000);
    let log = bench.take();
    assert!(log.iter().all(|(_, frame)| !frame.starts_with("381")));
    assert_eq!(log.len(), 6);
}

#[test]
fn v_det_14_a_stuck_toggle_repeats_the_same_bit() {
    let mut bench = Bench::operational(healthy(), 100);
    assert_eq!(bench.guard(200).as_deref(), Some("05"));
    bench.faults(300, |faults| faults.stuck_toggle = true);
    for at in [400, 900, 1400] {
        assert_eq!(bench.guard(at).as_deref(), Some("85"));
    }
    bench.faults(1500, |faults| faults.stuck_toggle = false);
    assert_eq!(bench.guard(1600).as_deref(), Some("85"));
    assert_eq!(bench.guard(1700).as_deref(), Some("05"));
}

#[test]
fn wrong_lengths_from_0_to_8_are_sent() {
    for dlc in 0..=8 {
        let mut bench = Bench::powered(in_phase());
        bench.faults(90, |faults| faults.set_length(Tpdo::Four, Some(dlc)));
        bench.frame(100, "000#0101");
        let log = bench.take();
        let frame = log.iter().find_map(|(_, frame)| frame.strip_prefix("481#")).unwrap();
        assert_eq!(frame.len(), 2 * usize::from(dlc));
    }
}

#[test]
fn r_det_052_reserved_bits_can_be_set_while_running() {
    let mut bench = Bench::operational(in_phase(), 1000);
    bench.take();
    bench.faults(1200, |faults| faults.reserved_bits = true);
    bench.run_to(1500);
    let log = bench.take();
    assert_eq!(log[0], (1200, "381#80000000000080CC".to_owned()));
    assert!(log.contains(&(1500, "481#00000000F0F0".to_owned())));
}

#[test]
fn a_second_master_stops_and_guards_the_device() {
    let mut bench = Bench::operational(healthy(), 100);
    bench.run_to(1000);
    bench.take();
    bench.slave_faults(1000, |faults| faults.second_master = true);
    assert_eq!(bench.device.state(), Some(NmtState::Stopped));
    bench.run_to(1701);
    let expected =
        sent(&[(1000, "000#0201"), (1000, "701#R1"), (1001, "701#04"), (1700, "701#R1"), (1701, "701#84")]);
    assert_eq!(bench.take(), expected);
    bench.slave_faults(1800, |faults| faults.second_master = false);
    bench.run_to(9000);
    assert_eq!(bench.take(), []);
}

#[test]
fn a_duplicate_sends_everything_twice() {
    let mut bench = Bench::operational(in_phase(), 1000);
    bench.slave_faults(1100, |faults| faults.duplicate = true);
    bench.take();
    bench.frame(1200, "701#R1");
    bench.run_to(1500);
    assert_eq!(bench.take().len(), 2 + 8);
}

#[test]
fn late_replies_come_late() {
    let mut bench = Bench::operational(healthy(), 100);
    bench.faults(300, |faults| faults.late_replies = Some(Duration::from_millis(150)));
    bench.frame(400, "701#R1");
    bench.run_to(700);
    assert_eq!(bench.times("701"), [550]);
}

#[test]
fn a_boot_loop_boots_again_and_again_until_switched_off() {
    let mut bench = Bench::operational(healthy(), 100);
    bench.run_to(1000);
    bench.take();
    bench.slave_faults(1000, |faults| faults.boot_loop = Some(Duration::from_secs(1)));
    bench.run_to(4500);
    assert_eq!(bench.times("701#00"), [2000, 3000, 4000]);
    bench.slave_faults(4600, |faults| faults.boot_loop = Some(Duration::ZERO));
    bench.run_to(4900);
    assert_eq!(bench.times("701#00"), [4700, 4800, 4900]);
    bench.slave_faults(4900, |faults| faults.boot_loop = None);
    bench.run_to(9000);
    assert!(bench.times("701#00").is_empty());
}

#[test]
fn refused_starts_leave_the_device_pre_operational() {
    let mut bench = Bench::powered(healthy());
    bench.slave_faults(100, |faults| faults.refuse_start = true);
    bench.frame(200, "000#0101");
    assert_eq!(bench.device.state(), Some(NmtState::PreOperational));
}

#[test]
fn outputs_that_nobody_drains_are_bounded() {
    let mut device = Detcon::new(NodeId::new(1).unwrap(), healthy());
    device.power_on(Now::from_millis(0));
    device.handle_frame(Now::from_millis(100), &"000#0101".parse().unwrap());
    for second in 1..1000 {
        device.handle_timeout(Now::from_millis(second * 1000));
    }
    assert_eq!(std::iter::from_fn(|| device.poll_output()).count(), QUEUE_LIMIT);
}

#[test]
fn a_stalled_process_does_not_make_frames_bunch() {
    let mut device = Detcon::new(NodeId::new(1).unwrap(), in_phase());
    device.power_on(Now::from_millis(0));
    device.handle_frame(Now::from_millis(100), &"000#0101".parse().unwrap());
    while device.poll_output().is_some() {}
    device.handle_timeout(Now::from_millis(60_000));
    assert_eq!(std::iter::from_fn(|| device.poll_output()).count(), 4);
}

/// What can happen to a device, with the time since what happened before, in ms.
fn happenings() -> impl Strategy<Value = Vec<(u64, Happening)>> {
    let frame = (0_u16..=0x7FF, any::<bool>(), proptest::collection::vec(any::<u8>(), 0..=8));
    let happening = prop_oneof![
        Just(Happening::Nothing),
        Just(Happening::Guard),
        prop_oneof![Just(0x01), Just(0x02), Just(0x80), Just(0x81), Just(0x82), any::<u8>()]
            .prop_map(Happening::Nmt),
        frame.prop_map(|(id, remote, data)| {
            let id = CanId::Standard(id);
            let frame = if remote {
                CanFrame::remote_frame(id, u8::try_from(data.len()).unwrap())
            } else {
                CanFrame::data_frame(id, &data)
            };
            Happening::Frame(frame.unwrap())
        }),
        any::<bool>().prop_map(Happening::Power),
        (any::<u8>(), any::<bool>()).prop_map(|(raw, knock)| Happening::Change(raw, knock)),
    ];
    proptest::collection::vec((0_u64..300, happening), 0..200)
}

#[derive(Clone, Debug)]
enum Happening {
    Nothing,
    Guard,
    Nmt(u8),
    Frame(CanFrame),
    Power(bool),
    Change(u8, bool),
}

fn happen(bench: &mut Bench, at: u64, happening: &Happening) {
    match happening {
        Happening::Nothing => bench.run_to(at),
        Happening::Guard => bench.frame(at, "701#R1"),
        Happening::Nmt(command) => bench.frame(at, &format!("000#{command:02X}00")),
        Happening::Frame(frame) => bench.frame(at, &frame.to_string()),
        Happening::Power(on) => bench.power(at, *on),
        Happening::Change(raw, knock) => bench.update(at, |values| {
            values.analog_output = *raw;
            values.knock(channel(18), *knock);
        }),
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    #[test]
    fn whatever_happens_tpdo3_keeps_its_inhibit_time_and_replies_alternate(
        happenings in happenings(),
        restart in any::<bool>(),
    ) {
        // Without replies during initialisation, `00` is a boot-up message and nothing else.
        let settings =
            DetconSettings { event_restarts_period: restart, guard_in_boot: false, ..healthy() };
        let mut bench = Bench::powered(settings);
        let mut now = 0;
        for (pause, happening) in &happenings {
            now += pause;
            happen(&mut bench, now, happening);
        }
        bench.run_to(now + 2000);
        let log = bench.take();
        let status: Vec<u64> =
            log.iter().filter(|(_, frame)| frame.starts_with("381#")).map(|(at, _)| *at).collect();
        prop_assert!(status.windows(2).all(|pair| pair[1] - pair[0] >= 100), "{:?}", status);
        let mut expected = 0;
        for (_, frame) in &log {
            let Some(data) = frame.strip_prefix("701#") else { continue };
            let byte = u8::from_str_radix(data, 16).unwrap();
            if byte == 0 {
                expected = 0;
            } else {
                prop_assert_eq!(byte & 0x80, expected, "{:?}", &log);
                expected ^= 0x80;
            }
        }
    }

    #[test]
    fn whatever_time_passes_work_comes_to_an_end(jumps in proptest::collection::vec(any::<u64>(), 0..20)) {
        let mut device = Detcon::new(NodeId::new(1).unwrap(), healthy());
        for micros in jumps {
            let now = Now { instant: Instant::from_micros(micros), ..Now::default() };
            device.power_on(now);
            device.update_slave_faults(now, |faults| {
                faults.second_master = true;
                faults.boot_loop = Some(Duration::ZERO);
            });
            device.handle_frame(now, &"000#0101".parse().unwrap());
            device.update(now, |values| values.knock(channel(1), micros % 2 == 0));
            device.handle_timeout(now);
            while device.poll_output().is_some() {}
        }
    }
}
