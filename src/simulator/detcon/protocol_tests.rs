//! Tests of [`Detcon`], in numbers-time, in candump notation.

use super::super::bench::{Bench, channel, healthy, in_phase, sent};
use super::super::values::{Channel, StatusBit};
use super::*;

#[test]
fn v_det_02_power_up_guarding_start_stop() {
    let mut bench = Bench::powered(healthy());
    for (at, frame) in [
        (100, "701#R1"),
        (102, "000#0101"),
        (600, "701#R1"),
        (1100, "701#R1"),
        (1200, "000#0201"),
        (1600, "701#R1"),
        (2100, "701#R1"),
    ] {
        bench.frame(at, frame);
    }
    bench.run_to(3000);
    let states: Vec<_> = bench.take().into_iter().filter(|(_, frame)| frame.starts_with("701")).collect();
    assert_eq!(
        states,
        sent(&[
            (0, "701#00"),
            (101, "701#7F"),
            (601, "701#85"),
            (1101, "701#05"),
            (1601, "701#84"),
            (2101, "701#04")
        ])
    );
}

#[test]
fn v_det_01_r_det_007_008_009_010_start_and_stop_addressed_and_broadcast() {
    for (start, stop) in [("000#0101", "000#0201"), ("000#0100", "000#0200"), ("000#0100", "000#0201")] {
        let mut bench = Bench::powered(healthy());
        bench.frame(100, start);
        assert_eq!(bench.device.state(), Some(NmtState::Operational), "{start}");
        bench.frame(200, stop);
        assert_eq!(bench.device.state(), Some(NmtState::Stopped), "{stop}");
    }
    let mut last = Detcon::new(NodeId::new(127).unwrap(), healthy());
    last.power_on(Now::from_millis(0));
    last.handle_frame(Now::from_millis(100), &"000#017F".parse().unwrap());
    assert_eq!(last.state(), Some(NmtState::Operational));
}

#[test]
fn r_det_006_011_no_frame_but_11_bit_data_and_no_tpdo_before_start() {
    let mut bench = Bench::powered(healthy());
    bench.run_to(5000);
    assert_eq!(bench.take(), sent(&[(0, "701#00")]));
    bench.frame(5000, "00000000#0101");
    bench.frame(5001, "000#R2");
    bench.frame(5002, "00000701#R1");
    bench.frame(5003, "701#7F");
    bench.run_to(6000);
    assert_eq!(bench.take(), []);
    assert_eq!(bench.device.state(), Some(NmtState::PreOperational));
    bench.frame(6000, "000#0101");
    bench.run_to(7000);
    for (_, frame) in bench.take() {
        assert!(!frame.contains('R') && frame.find('#') == Some(3), "{frame}");
    }
}

#[test]
fn r_det_012_013_stopped_sends_no_tpdo_answers_guarding_and_starts_again() {
    let mut bench = Bench::operational(healthy(), 100);
    bench.frame(1000, "000#0201");
    bench.take();
    bench.run_to(3000);
    assert_eq!(bench.take(), []);
    assert_eq!(bench.guard(3000).as_deref(), Some("04"));
    bench.frame(3500, "000#0101");
    bench.run_to(3600);
    let ids: Vec<_> = bench.take().into_iter().map(|(_, frame)| frame[..3].to_owned()).collect();
    assert_eq!(ids, ["181", "281", "381", "481"]);
}

#[test]
fn r_det_014_start_while_operational_and_stop_while_stopped_change_nothing() {
    let mut bench = Bench::operational(in_phase(), 1000);
    bench.frame(1250, "000#0101");
    bench.run_to(2100);
    assert_eq!(bench.times("181"), [1000, 1500, 2000]);
    bench.frame(2100, "000#0201");
    bench.frame(2200, "000#0201");
    assert_eq!(bench.device.state(), Some(NmtState::Stopped));
    assert_eq!(bench.take(), []);
}

#[test]
fn r_det_015_foreign_and_malformed_nmt_commands_are_ignored() {
    let mut bench = Bench::powered(healthy());
    for frame in ["000#01", "000#", "000#010100", "000#0102", "000#0301", "000#0001", "000#FF00"] {
        bench.frame(100, frame);
        assert_eq!(bench.device.state(), Some(NmtState::PreOperational), "{frame}");
    }
}

#[test]
fn r_det_016_pre_operational_and_resets_work_unless_switched_off() {
    let mut bench = Bench::operational(healthy(), 100);
    bench.frame(200, "000#8001");
    assert_eq!(bench.device.state(), Some(NmtState::PreOperational));
    for reset in ["000#8101", "000#8200"] {
        let mut bench = Bench::operational(healthy(), 100);
        bench.run_to(300);
        bench.take();
        bench.frame(300, reset);
        assert_eq!(bench.take(), sent(&[(300, "701#00")]), "{reset}");
        assert_eq!(bench.device.state(), Some(NmtState::Initialising));
    }
    let mut bench = Bench::operational(DetconSettings { all_nmt_commands: false, ..healthy() }, 100);
    for ignored in ["000#8001", "000#8101", "000#8201"] {
        bench.frame(300, ignored);
        assert_eq!(bench.device.state(), Some(NmtState::Operational), "{ignored}");
    }
}

#[test]
fn r_det_022_023_024_each_request_gets_one_byte_with_state_and_alternating_toggle() {
    let mut bench = Bench::operational(in_phase(), 100);
    bench.take();
    for (turn, expected) in ["05", "85", "05", "85"].into_iter().enumerate() {
        let at = 110 + 10 * u64::try_from(turn).unwrap();
        bench.frame(at, "701#R1");
        bench.run_to(at + 9);
        assert_eq!(bench.take(), sent(&[(at + 1, &format!("701#{expected}"))]));
    }
}

#[test]
fn v_det_14_r_det_025_only_a_reset_sets_the_toggle_back() {
    let mut bench = Bench::powered(healthy());
    assert_eq!(bench.guard(100).as_deref(), Some("7F"));
    bench.frame(110, "000#0101");
    assert_eq!(bench.guard(120).as_deref(), Some("85"));
    assert_eq!(bench.guard(130).as_deref(), Some("05"));
    bench.frame(140, "000#0201");
    assert_eq!(bench.guard(150).as_deref(), Some("84"));
    for reset in ["000#8101", "000#8201"] {
        bench.frame(1000, reset);
        assert_eq!(bench.guard(1100).as_deref(), Some("7F"), "{reset}");
        bench = Bench::powered(healthy());
        assert_eq!(bench.guard(100).as_deref(), Some("7F"));
    }
    bench.power(200, false);
    bench.power(200, true);
    assert_eq!(bench.guard(300).as_deref(), Some("7F"));
}

#[test]
fn v_det_15_r_det_026_027_power_on_in_the_middle_of_operation_boots_again() {
    let mut bench = Bench::operational(healthy(), 100);
    bench.power(1000, false);
    bench.take();
    bench.frame(1100, "701#R1");
    bench.frame(1101, "000#0101");
    bench.run_to(5000);
    assert_eq!(bench.take(), []);
    bench.power(5000, true);
    bench.run_to(5079);
    assert_eq!(bench.take(), sent(&[(5000, "701#00")]));
    assert_eq!(bench.device.state(), Some(NmtState::Initialising));
    bench.run_to(5080);
    assert_eq!(bench.device.state(), Some(NmtState::PreOperational));
    assert_eq!(bench.take(), []);
}

#[test]
fn r_det_028_start_leads_to_operational_from_pre_operational_and_stopped_and_stop_to_stopped() {
    let mut bench = Bench::powered(healthy());
    bench.frame(100, "000#0201");
    assert_eq!(bench.device.state(), Some(NmtState::Stopped));
    bench.frame(110, "000#0101");
    assert_eq!(bench.device.state(), Some(NmtState::Operational));
    let mut bench = Bench::powered(healthy());
    bench.frame(100, "000#0101");
    assert_eq!(bench.device.state(), Some(NmtState::Operational));
}

#[test]
fn r_det_030_guarding_is_answered_in_every_state_and_during_initialisation_by_choice() {
    let mut bench = Bench::powered(healthy());
    assert_eq!(bench.guard(10).as_deref(), Some("00"));
    assert_eq!(bench.guard(20).as_deref(), Some("80"));
    assert_eq!(bench.guard(100).as_deref(), Some("7F"));
    let mut bench = Bench::powered(DetconSettings { guard_in_boot: false, ..healthy() });
    assert_eq!(bench.guard(10), None);
    assert_eq!(bench.guard(100).as_deref(), Some("7F"));
}

#[test]
fn a_start_during_initialisation_is_lost() {
    let mut bench = Bench::powered(healthy());
    bench.frame(79, "000#0101");
    bench.run_to(1000);
    assert_eq!(bench.device.state(), Some(NmtState::PreOperational));
}

#[test]
fn r_det_049_to_067_tpdos_are_plain_frames_of_8_8_8_and_6_bytes() {
    let mut bench = Bench::powered(healthy());
    bench.update(90, |values| {
        for channel in Channel::all() {
            values.set_intensity(channel, channel.get());
        }
        values.set_used(channel(1), true);
        values.set_used(channel(16), true);
        values.set_bad(channel(9), true);
        values.set_used(channel(17), true);
        values.set_bad(channel(20), true);
        values.set_status(StatusBit::LoadReduction, true);
        values.analog_output = 0x40;
    });
    bench.take();
    bench.frame(100, "000#0101");
    bench.run_to(200);
    assert_eq!(
        bench.take(),
        sent(&[
            (105, "181#0102030405060708"),
            (110, "281#090A0B0C0D0E0F10"),
            (115, "381#04400180000180CC"),
            (120, "481#111213140108"),
        ])
    );
}

#[test]
fn r_det_068_070_base_period_is_500_ms() {
    let mut bench = Bench::operational(in_phase(), 1000);
    bench.run_to(3000);
    let log = bench.take();
    for id in ["181", "281", "381", "481"] {
        let times: Vec<_> =
            log.iter().filter(|(_, frame)| frame.starts_with(id)).map(|(at, _)| *at).collect();
        assert_eq!(times, [1000, 1500, 2000, 2500, 3000], "{id}");
    }
}

#[test]
fn v_det_19_r_det_069_070_076_knocking_on_channel_18_only() {
    let origin = 10_000;
    let mut bench = Bench::operational(in_phase(), origin);
    bench.update(origin + 1000, |values| values.knock(channel(18), true));
    bench.update(origin + 1350, |values| values.knock(channel(18), false));
    bench.run_to(origin + 2000);
    let log = bench.take();
    let of = |id: &str| -> Vec<_> {
        log.iter().filter(|(_, frame)| frame.starts_with(id)).map(|(at, _)| at - origin).collect()
    };
    for id in ["181", "281", "481"] {
        assert_eq!(of(id), [0, 500, 1000, 1100, 1200, 1300, 1800], "{id}");
    }
    assert_eq!(of("381"), [0, 500, 1000, 1350, 1850]);
    let flags: Vec<_> =
        log.iter().filter(|(_, frame)| frame.starts_with("381")).map(|(_, f)| &f[4..6]).collect();
    assert_eq!(flags, ["00", "00", "01", "00", "00"]);
}

/// The story of V-DET-18; `restart` is `sim_event_restarts_period`.
fn v_det_18(restart: bool) -> Vec<(u64, String)> {
    let origin = 10_000;
    let mut bench = Bench::powered(DetconSettings { event_restarts_period: restart, ..in_phase() });
    bench.update(origin, |values| values.analog_output = 0x10);
    bench.frame(origin, "000#0101");
    bench.update(origin + 30, |values| values.knock(channel(18), true));
    bench.update(origin + 60, |values| values.analog_output = 0x20);
    bench.update(origin + 250, |values| values.knock(channel(18), false));
    bench.update(origin + 300, |values| values.set_used(channel(1), true));
    bench.run_to(origin + 1000);
    let log = bench.take().into_iter().filter(|(_, frame)| frame.starts_with("381#"));
    log.map(|(at, frame)| (at - origin, frame[4..12].to_owned())).collect()
}

#[test]
fn v_det_18_r_det_070_071_072_075_event_and_inhibit_with_timer_restart() {
    let expected = sent(&[(0, "00100000"), (100, "01200000"), (250, "00200000"), (750, "00200100")]);
    assert_eq!(v_det_18(true), expected);
}

#[test]
fn v_det_18_r_det_075_event_and_inhibit_without_timer_restart() {
    let expected =
        sent(&[(0, "00100000"), (100, "01200000"), (250, "00200000"), (500, "00200100"), (1000, "00200100")]);
    assert_eq!(v_det_18(false), expected);
}

#[test]
fn r_det_073_change_and_reversal_inside_the_inhibit_window_still_sends_one_frame() {
    let mut bench = Bench::operational(in_phase(), 1000);
    bench.update(1030, |values| values.set_status(StatusBit::Trip, true));
    bench.update(1060, |values| values.set_status(StatusBit::Trip, false));
    bench.run_to(1400);
    assert_eq!(bench.times("381"), [1000, 1100]);
}

#[test]
fn a_pulse_as_long_as_the_inhibit_time_is_seen_whatever_its_phase() {
    for phase in 0..=500 {
        let mut bench = Bench::operational(in_phase(), 1000);
        bench.update(1500 + phase, |values| values.set_status(StatusBit::Trip, true));
        bench.update(1600 + phase, |values| values.set_status(StatusBit::Trip, false));
        bench.run_to(3000);
        let log = bench.take();
        assert!(log.iter().any(|(_, frame)| frame.starts_with("381#02")), "{phase}: {log:?}");
    }
}

#[test]
fn r_det_074_changes_of_bytes_2_to_7_alone_send_nothing() {
    let mut bench = Bench::operational(in_phase(), 1000);
    bench.update(1200, |values| {
        values.set_used(channel(3), true);
        values.set_bad(channel(4), true);
        values.ignition_reduction_limit = 1;
        values.immediate_stop_limit = 2;
    });
    bench.run_to(1600);
    let log: Vec<_> = bench.take().into_iter().filter(|(_, frame)| frame.starts_with("381")).collect();
    assert_eq!(log, sent(&[(1000, "381#00000000000080CC"), (1500, "381#0000040008000102")]));
}

#[test]
fn r_det_077_all_four_within_100_ms_of_the_start_whatever_the_stagger() {
    for stagger in [0, 5, 25, 1000] {
        let stagger = Duration::from_millis(stagger);
        let mut bench = Bench::operational(DetconSettings { stagger, ..healthy() }, 1000);
        bench.run_to(1100);
        let mut ids: Vec<_> = bench.take().into_iter().map(|(_, frame)| frame[..3].to_owned()).collect();
        ids.sort();
        assert_eq!(ids, ["181", "281", "381", "481"]);
    }
}
