//! Modules are found, compared with what is wanted, written where they differ, and looked after.

use std::time::Duration;

use super::bench::{Bench, Pretended, id, managed, module, network, sio1, watchdog};
use crate::esd::{
    CanTxMode, MinChar, ModuleKind, ModuleSettings, Rate, SerialBits, SerialMode, WatchdogMode,
};

/// SIO1 with wishes that a module as it is shipped does not fulfil.
fn demanding() -> ModuleSettings {
    let mut module = managed(|management| management.first_tx_delay = Some(Duration::ZERO));
    let rate = Rate::new(19_200).unwrap();
    let default = SerialMode::from_value(SerialMode::DEFAULT_VALUE).unwrap();
    let line = &mut module.channels[0];
    line.tx_id = id(0x1AA);
    line.rx_id = id(0x155);
    line.can_tx_mode = Some(CanTxMode { inhibit: 20, max_char: 8, min_char: MinChar::CrDropped });
    line.serial_mode = Some(SerialMode { receive: rate, transmit: rate, ..default });
    module
}

fn shipped() -> Vec<Pretended> {
    vec![Pretended::new(ModuleKind::Sio1, 0x12)]
}

const SETS: [&str; 5] = ["700#81", "700#82", "700#83", "700#86", "700#FF"];

fn sets(frames: &[String]) -> Vec<&str> {
    let is_set = |frame: &&str| SETS.iter().any(|set| frame.starts_with(set));
    frames.iter().map(String::as_str).filter(is_set).collect()
}

#[test]
fn r_esd_054_076_a_module_that_is_as_wanted_is_only_asked_and_its_news_cleared() {
    let mut bench = Bench::new(network(vec![sio1()]), shipped());
    bench.run(900);
    let lines = bench.take();
    let events: Vec<_> =
        lines.iter().filter(|line| !line.contains('#') && !line.ends_with(" Frame")).collect();
    assert_eq!(events.len(), 4, "{events:?}");
    for (event, word) in events.iter().zip(["Appeared", "Status C1", "Status 41", "Configured 0 false"]) {
        assert!(event.ends_with(word), "{event}");
    }
    let frames: Vec<_> =
        lines.iter().filter_map(|line| line.split(' ').nth(1)).filter(|it| it.contains('#')).collect();
    let expected = [
        "700#010100120567",
        "700#000000120567",
        "700#000300120567",
        "700#010200120567",
        "700#810200120000",
        "700#010200120567",
        "700#020000120567",
        "700#030000120567",
        "700#060200120567",
        "700#060000120567",
        "700#010200120567",
    ];
    assert_eq!(frames, expected);
}

#[test]
fn r_esd_054_063_064_066_104_v_esd_06_v_esd_09_what_differs_is_set_and_read_back() {
    let mut bench = Bench::new(network(vec![demanding()]), shipped());
    bench.run(900);
    let frames = bench.frames();
    let expected = [
        "700#810200120000",
        "700#8200001201AA",
        "700#830000120155",
        "700#86010012148B",
        "700#860200121173",
        "700#860000120000",
    ];
    assert_eq!(sets(&frames), expected);
    // Each is asked before and after.
    for question in ["0200", "0300", "0601", "0602", "0600"] {
        let question = format!("700#{question}00120567");
        assert_eq!(frames.iter().filter(|frame| **frame == question).count(), 2, "{question}");
    }
    // What it has now is what was wanted: a second look writes nothing.
    bench.link(1000, false).link(1001, true).run(2000);
    assert_eq!(sets(&bench.frames()), Vec::<&str>::new());
}

#[test]
fn r_esd_095_097_099_bits_of_the_serial_mode_that_nobody_asks_for_stay_as_the_module_has_them() {
    let mut settings = sio1();
    // 19200 bit/s both ways is all that is asked for.
    settings.channels[0].serial_mode = SerialMode::from_value(0x1173);
    settings.channels[0].serial_bits = SerialBits::RECEIVE.and(true, SerialBits::TRANSMIT);
    // Two of these are of a meaning that is not known: parity modes 01 and 11.
    for (has, written) in
        [(0x2293, Some("1193")), (0x22CF, Some("11CF")), (0x221B, Some("111B")), (0x110A, None)]
    {
        let mut pretended = Pretended::new(ModuleKind::Sio1, 0x12);
        pretended.parameters.insert(2, has);
        let mut bench = Bench::new(network(vec![settings.clone()]), vec![pretended]);
        bench.run(900);
        let lines = bench.take();
        let set = lines.iter().find_map(|line| line.split_once("700#86020012")).map(|(_, value)| value);
        assert_eq!(set, written, "{has:04X}");
        assert!(lines.iter().any(|line| line.contains("0 Configured")), "{has:04X}: {lines:?}");
    }
}

#[test]
fn r_esd_037_099_one_stop_bit_is_reckoned_with_only_where_it_was_ordered_whatever_the_field_means() {
    for (ordered, stop_bit_set, has, most) in [
        (false, 2, 0x2253, 89),
        (false, 2, 0x2273, 89),
        (true, 2, 0x2253, 98),
        (true, 2, 0x2273, 98),
        (true, 1, 0x2253, 98),
    ] {
        let mut settings = module(ModuleKind::Sio4, 0x12);
        settings.channels[0].stop_bit_set = stop_bit_set;
        if ordered {
            settings.channels[0].serial_mode = SerialMode::from_value(0x2253);
            settings.channels[0].serial_bits = SerialBits::STOP_BITS;
        }
        let mut pretended = Pretended::new(ModuleKind::Sio4, 0x12);
        // 9600 bit/s.
        pretended.status = 0x41;
        pretended.parameters.insert(2, has);
        let mut bench = Bench::new(network(vec![settings]), vec![pretended]);
        bench.run(900);
        let one = if stop_bit_set == 1 { 0x2273 } else { 0x2253 };
        assert_eq!(bench.modules[0].parameters[&2], if ordered { one } else { has });
        bench.send(1000, 1, &[0x55; 4000]).run(3000);
        bench.take();
        bench.run(4000);
        let bytes = 8 * bench.frames().iter().filter(|frame| frame.starts_with("0B9")).count();
        assert!(
            (most * 960 / 100 - 16..=most * 960 / 100 + 8).contains(&bytes),
            "{ordered} {has:04X} {bytes}"
        );
    }
}

#[test]
fn r_esd_066_096_all_channels_of_a_sio4_have_their_own_parameters() {
    let mut settings = module(ModuleKind::Sio4, 0x11);
    for line in &mut settings.channels {
        line.can_tx_mode = Some(CanTxMode { inhibit: 2, max_char: 8, min_char: MinChar::Bytes(1) });
    }
    let pretended = Pretended::new(ModuleKind::Sio4, 0x11);
    let mut bench = Bench::new(network(vec![settings]), vec![pretended]);
    bench.run(900);
    assert_eq!(
        sets(&bench.frames())[1..],
        ["700#860100110281", "700#860900110281", "700#861100110281", "700#861900110281", "700#862100110281"]
    );
}

#[test]
fn r_esd_092_the_halves_of_the_packing_can_be_the_other_way_round() {
    let mut settings = managed(|management| management.min_char_high = true);
    settings.channels[0].can_tx_mode =
        Some(CanTxMode { inhibit: 20, max_char: 8, min_char: MinChar::Bytes(4) });
    let mut bench = Bench::new(network(vec![settings]), shipped());
    bench.run(900);
    assert!(sets(&bench.frames()).contains(&"700#860100121448"));
}

#[test]
fn r_esd_067_073_parameters_are_stored_only_where_it_is_asked_for_and_something_was_written() {
    for (store, expected) in [(true, 1), (false, 0)] {
        let mut settings = demanding();
        settings.management.as_mut().unwrap().store = store;
        let mut bench = Bench::new(network(vec![settings]), shipped());
        bench.run(3000);
        let lines = bench.take();
        let stores = lines.iter().filter(|line| line.contains("700#810000121200")).count();
        assert_eq!(stores, expected);
        assert!(lines.iter().any(|line| line.ends_with(&format!("Configured 5 {store}"))), "{lines:?}");
        // Nothing to write: nothing to store.
        bench.link(3100, false).link(3101, true).run(6000);
        assert!(!bench.take().iter().any(|line| line.contains("700#8100")));
    }
}

#[test]
fn r_esd_073_nothing_is_reset_and_no_bit_rate_set_by_itself() {
    let mut settings = demanding();
    settings.management.as_mut().unwrap().watchdog = Some(watchdog(WatchdogMode::Remote));
    let mut bench = Bench::new(network(vec![settings]), shipped());
    bench.run(30_000);
    bench.modules[0].on = false;
    bench.run(60_000);
    bench.modules[0].on = true;
    bench.modules[0].restart();
    bench.run(90_000);
    for frame in bench.frames() {
        assert!(
            !["700#FF", "700#8103", "700#8101", "700#8100"].iter().any(|begin| frame.starts_with(begin)),
            "{frame}"
        );
    }
}

#[test]
fn without_configure_nothing_is_written_and_differences_are_told() {
    let mut settings = demanding();
    settings.management.as_mut().unwrap().configure = false;
    let mut bench = Bench::new(network(vec![settings]), shipped());
    bench.run(50_000);
    let lines = bench.take();
    assert!(!lines.iter().any(|line| line.contains("700#82") || line.contains("700#86")));
    let told: Vec<_> = lines.iter().filter(|line| line.contains("NotConfigured")).collect();
    assert_eq!(told.len(), 1);
    assert!(told[0].contains("TxId of channel 1 of module 0x12 is 0x0B4, wanted is 0x1AA"), "{}", told[0]);
    assert!(told[0].contains("`configure` is off"), "{}", told[0]);
    assert!(!lines.iter().any(|line| line.contains(" Configured")));
    // Somebody puts it right by hand.
    bench.modules[0].ids.extend([((2, 0), 0x1AA), ((3, 0), 0x155)]);
    bench.modules[0].parameters.extend([(0, 0), (1, 0x148B), (2, 0x1173)]);
    bench.run(70_000);
    assert_eq!(bench.events(), ["0 Configured 0 false"]);
}

#[test]
fn r_esd_054_a_module_that_does_not_take_what_is_written_is_not_configured() {
    let mut settings = demanding();
    settings.management.as_mut().unwrap().store = true;
    let mut bench = Bench::new(network(vec![settings]), shipped());
    bench.modules[0].stubborn = true;
    bench.run(130_000);
    let lines = bench.take();
    let told: Vec<_> = lines.iter().filter(|line| line.contains("onfigured")).collect();
    assert_eq!(told.len(), 1, "once, and never configured: {told:?}");
    assert!(
        told[0].contains("Serial mode of channel 1 (user parameter 0x02) of module 0x12 is 0x2273"),
        "{}",
        told[0]
    );
    assert!(!lines.iter().any(|line| line.contains("700#8100")), "what is wrong is not stored");
    bench.modules[0].stubborn = false;
    bench.run(250_000);
    assert!(bench.events().contains(&"0 Configured 5 true".to_owned()));
}

#[test]
fn r_esd_004_005_from_public_copies_a_module_that_speaks_cms_is_left_alone() {
    let mut bench = Bench::new(network(vec![demanding()]), shipped());
    bench.modules[0].protocol = b'C';
    bench.run(59_000);
    let lines = bench.take();
    let told: Vec<_> = lines.iter().filter(|line| line.contains("OtherModule")).collect();
    assert_eq!(told.len(), 1);
    assert!(told[0].contains("V1.0aC0"), "{}", told[0]);
    assert_eq!(lines.iter().filter(|line| line.contains("700#")).count(), 3, "{lines:?}");
    bench.run(61_000);
    assert_eq!(bench.frames().len(), 3, "looked at again after a minute");
    bench.modules[0].protocol = b'E';
    bench.run(125_000);
    assert!(bench.events().contains(&"0 Configured 5 false".to_owned()));
}

#[test]
fn r_esd_058_another_kind_of_module_is_left_alone() {
    let mut bench = Bench::new(network(vec![sio1()]), vec![Pretended::new(ModuleKind::Sio4, 0x12)]);
    bench.run(59_000);
    let events = bench.events();
    assert_eq!(events.len(), 2, "{events:?}");
    assert!(events[1].contains("has the type 0x31; a CAN-CBM-SIO1 has 0x30"), "{}", events[1]);
}

#[test]
fn r_esd_052_058_where_the_type_is_not_to_be_looked_at_a_module_that_does_not_know_the_question_is_managed() {
    for (check, events) in [(false, "0 Configured 0 false"), (true, "OtherModule")] {
        let settings = managed(|management| management.check_kind = check);
        let mut bench = Bench::new(network(vec![settings]), shipped());
        bench.modules[0].unknown = vec![[0, 0]];
        bench.run(2000);
        let told = bench.events();
        assert!(told.iter().any(|event| event.contains(events)), "{told:?}");
    }
    let settings = managed(|management| management.check_kind = false);
    let mut bench = Bench::new(network(vec![settings]), shipped());
    bench.modules[0].mute = vec![[0, 0]];
    bench.run(20_000);
    let told = bench.events();
    assert!(told.contains(&"0 Configured 0 false".to_owned()), "nor one that says nothing: {told:?}");
}

#[test]
fn r_esd_059_a_coding_switch_other_than_wanted_is_told() {
    let settings = managed(|management| management.switch = Some(0x13));
    let mut bench = Bench::new(network(vec![settings]), shipped());
    bench.run(2000);
    let lines = bench.take();
    assert!(lines.iter().any(|line| line.contains("700#000100120567")));
    let told = lines.iter().find(|line| line.contains("NotConfigured")).unwrap();
    assert!(told.contains("coding switch of module 0x12 is 0x12, wanted is 0x13"), "{told}");
}

#[test]
fn the_status_is_asked_for_in_its_period_and_told_when_it_changes() {
    let mut bench = Bench::settled(sio1());
    bench.run(5400);
    assert_eq!(bench.frames(), ["700#010200120567"; 5]);
    bench.modules[0].status = 0x43;
    bench.run(7400);
    assert_eq!(bench.events(), ["0 Status 43"]);
}

#[test]
fn r_esd_076_a_module_that_started_anew_is_told_of_and_configured_again() {
    let mut settings = demanding();
    settings.management.as_mut().unwrap().first_tx_delay = None;
    let mut bench = Bench::new(network(vec![settings]), shipped());
    bench.run(900);
    bench.take();
    bench.modules[0].restart();
    bench.run(2000);
    let events = bench.events();
    assert_eq!(events, ["0 Status C1", "0 Restarted", "0 Status 41", "0 Configured 4 false"]);
}

#[test]
fn r_esd_076_a_module_that_starts_while_it_is_compared_is_not_called_configured_before_it_is() {
    // Whenever in the procedure that happens.
    for millis in 0..250 {
        let mut bench = Bench::new(network(vec![demanding()]), shipped());
        bench.run(millis);
        bench.modules[0].restart();
        bench.run(1900);
        let module = &bench.modules[0];
        assert_eq!(module.parameters[&2], 0x1173, "at {millis}");
        assert_eq!((module.ids[&(2, 0)], module.status), (0x1AA, 0x41), "at {millis}");
        assert!(bench.events().last().unwrap().contains("Configured"), "at {millis}");
    }
}

#[test]
fn r_esd_077_an_error_bit_that_stays_is_cleared_three_times_and_then_told_once() {
    let mut bench = Bench::new(network(vec![sio1()]), shipped());
    bench.modules[0].status = 0xC5;
    bench.modules[0].stuck = 0x04;
    bench.run(50_000);
    let lines = bench.take();
    assert_eq!(lines.iter().filter(|line| line.contains("700#8102")).count(), 3);
    assert_eq!(lines.iter().filter(|line| line.contains("CanErrorStays")).count(), 1);
    assert!(lines.iter().any(|line| line.contains("Configured")), "the rest is in order");
    bench.modules[0].stuck = 0;
    bench.run(70_000);
    assert_eq!(bench.events(), ["0 Status 41"], "tried again after a minute");
}

#[test]
fn r_esd_075_077_an_error_bit_is_cleared_when_it_is_seen() {
    let mut bench = Bench::settled(sio1());
    bench.modules[0].status = 0x45;
    bench.run(10_000);
    assert_eq!(bench.events(), ["0 Status 45", "0 Status 41"], "and nothing else is told");
}

#[test]
fn bit_7_that_cannot_be_cleared_is_a_fault_and_no_endless_restart() {
    let mut bench = Bench::new(network(vec![sio1()]), shipped());
    bench.modules[0].stuck = 0x80;
    bench.run(50_000);
    let events = bench.events();
    assert!(
        events.iter().any(|event| event.contains("NotConfigured") && event.contains("bit 7")),
        "{events:?}"
    );
    assert!(!events.iter().any(|event| event.contains("Restarted")), "{events:?}");
}

#[test]
fn r_esd_055_questions_to_several_modules_go_one_after_the_other() {
    let modules = [0x12, 0x13, 0x14].map(|switch| module(ModuleKind::Sio1, switch)).to_vec();
    let pretended = [0x12, 0x13, 0x14].map(|switch| Pretended::new(ModuleKind::Sio1, switch)).to_vec();
    let mut bench = Bench::new(network(modules), pretended);
    bench.run(900);
    let mut lines = bench.take();
    for module in 0..3 {
        assert!(
            lines.iter().any(|line| line.ends_with(&format!("{module} Configured 0 false"))),
            "{lines:?}"
        );
    }
    lines.retain(|line| (line.contains("700#0") || line.ends_with(" Frame")) && !line.contains("700#8"));
    for pair in lines.chunks(2) {
        assert!(pair[0].contains("700#") && pair[1].contains("Frame"), "{pair:?}");
    }
}

#[test]
fn r_esd_033_090_nothing_is_sent_to_the_lines_before_the_first_tx_activate_delay_is_over() {
    let mut bench = Bench::new(network(vec![sio1()]), shipped());
    bench.modules[0].parameters.insert(0, 3000);
    bench.send(900, 1, b"x").run(2900);
    assert_eq!(bench.frames().iter().filter(|frame| frame.starts_with("0B5")).count(), 0);
    bench.run(3200);
    assert!(bench.frames().contains(&"0B5#78".to_owned()));
}

#[test]
fn r_esd_033_a_module_that_started_long_ago_is_sent_to_at_once() {
    let mut bench = Bench::settled(sio1());
    bench.send(600, 1, b"x").run(601);
    assert_eq!(bench.frames(), ["0B5#78"]);
}

#[test]
fn r_esd_033_what_is_written_does_not_shorten_the_delay_of_the_start_that_is_under_way() {
    let settings = managed(|management| management.first_tx_delay = Some(Duration::ZERO));
    let mut bench = Bench::new(network(vec![settings]), shipped());
    bench.modules[0].parameters.insert(0, 5000);
    bench.send(900, 1, b"x").run(4900);
    assert!(!bench.frames().iter().any(|frame| frame.starts_with("0B5")));
    bench.run(5200);
    assert!(bench.frames().contains(&"0B5#78".to_owned()));
}

#[test]
fn r_esd_033_the_delay_of_a_start_goes_on_through_an_outage_of_the_bus() {
    let mut bench = Bench::new(network(vec![sio1()]), shipped());
    bench.run(900).link(1000, false).link(1001, true).send(1900, 1, b"x").run(9900);
    assert!(!bench.frames().iter().any(|frame| frame.starts_with("0B5")));
    bench.run(10_300);
    assert!(bench.frames().contains(&"0B5#78".to_owned()));
}

#[test]
fn r_esd_037_the_pace_follows_the_rate_that_the_module_has_configured_or_not() {
    for configure in [true, false] {
        let mut settings = managed(|management| management.configure = configure);
        if !configure {
            // Wanted is another rate than it has.
            settings.channels[0].serial_mode = SerialMode::from_value(0x2273);
        }
        let mut pretended = Pretended::new(ModuleKind::Sio1, 0x12);
        pretended.status = 0x41;
        // 300 bit/s on the way out: 30 bytes a second.
        pretended.parameters.insert(2, 0x2773);
        let mut bench = Bench::new(network(vec![settings]), vec![pretended]);
        bench.run(900);
        bench.take();
        bench.send(1000, 1, &[0x55; 1000]).run(3000);
        let bytes = 8 * bench.frames().iter().filter(|frame| frame.starts_with("0B5")).count();
        assert!((104..=128).contains(&bytes), "{bytes} bytes, configure {configure}");
    }
}
