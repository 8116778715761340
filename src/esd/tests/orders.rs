//! What somebody else orders, the passive role, and whose an identifier is.

use super::bench::{Bench, Pretended, id, managed, module, network, number, sio1, watchdog};
use crate::can::CanId;
use crate::esd::{ModuleIndex, ModuleKind, NetworkSettings, SendRefused, SerialMode, WatchdogMode};

/// The time of a line of the protocol.
fn millis(line: &str) -> u64 {
    line.split(' ').next().unwrap().parse().unwrap()
}

/// A module that passes bytes on slowly, and has much to pass on.
fn busy() -> Bench {
    let mut settings = sio1();
    // 150 bit/s on the way out.
    settings.channels[0].serial_mode = SerialMode::from_value(0x2873);
    let mut bench = Bench::settled(settings);
    bench.send(600, 1, &[0x55; 1000]).run(1100);
    bench.take();
    bench
}

/// When the last data left for the line.
fn last_data(lines: &[String]) -> Option<u64> {
    lines.iter().filter(|line| line.contains(" 0B5#")).map(|line| millis(line)).max()
}

#[test]
fn r_esd_072_109_a_reset_that_somebody_else_orders_ends_what_is_under_way_at_once() {
    for order in ["700#FF000012AAAA", "700#FF000000AAAA", "700#FF030012AAAA"] {
        let mut bench = busy();
        bench.order(1200, order);
        let lines = bench.take();
        let is_broken =
            |line: &&String| line.starts_with("1200 0 line 0 job 1 Broken") && line.contains("why: Reset");
        assert_eq!(lines.iter().filter(is_broken).count(), 1, "{lines:?}");
        bench.run(4000);
        let lines = bench.take();
        assert_eq!(last_data(&lines), None, "{lines:?}");
        let is_done = |line: &&String| line.contains("0 Configured ") || line.ends_with("Restarted");
        assert_eq!(lines.iter().filter(is_done).count(), 2, "it is configured again: {lines:?}");
    }
}

#[test]
fn r_esd_071_orders_to_others_and_those_with_wrong_parameters_change_nothing() {
    let mut bench = busy();
    for order in ["700#FF000013AAAA", "700#FF000012AAAB", "700#FF000012AA", "700#FF0400135A5A"] {
        bench.frame(1200, order);
    }
    bench.run(1500);
    assert!(!bench.events().iter().any(|event| event.contains("Broken")));
    bench.run(3000);
    assert!(last_data(&bench.take()).is_some());
}

#[test]
fn r_esd_041_042_043_nothing_is_sent_to_a_module_that_somebody_else_suspends_and_what_waits_follows() {
    let mut bench = Bench::settled(sio1());
    bench.order(600, "700#FF0400125A5A").send(601, 1, b"abc").run(5000);
    let lines = bench.take();
    assert_eq!(last_data(&lines), None);
    let told = lines.iter().find(|line| line.contains("Status 43")).unwrap();
    assert!(millis(told) < 700, "asked at once: {told}");
    bench.order(5000, "700#FF040012A5A5").run(6000);
    assert!(bench.frames().contains(&"0B5#616263".to_owned()));
}

#[test]
fn r_esd_041_what_waits_for_a_suspended_module_is_given_up_after_a_minute_and_never_carried_out_later() {
    let mut bench = Bench::settled(sio1());
    bench.order(600, "700#FF0400125A5A").send(10_000, 1, b"abc").send(69_000, 2, b"de").run(69_999);
    assert!(!bench.events().iter().any(|event| event.contains("Broken")));
    bench.run(70_001);
    let events = bench.events();
    assert_eq!(
        events
            .iter()
            .filter(|event| event.ends_with("Broken { handed: 0, sent: 0, why: Suspended }"))
            .count(),
        2,
        "{events:?}"
    );
    // What comes now waits a minute of its own.
    bench.send(80_000, 3, b"f").run(139_000);
    assert!(!bench.events().iter().any(|event| event.contains("Broken")));
    bench.run(140_001);
    assert!(bench.events().iter().any(|event| event.contains("job 3 Broken")));
    bench.order(200_000, "700#FF040012A5A5").run(210_000);
    assert_eq!(last_data(&bench.take()), None);
    bench.send(210_000, 4, b"g").run(211_000);
    assert!(bench.frames().contains(&"0B5#67".to_owned()));
}

#[test]
fn r_esd_041_042_a_module_that_does_not_tell_its_status_goes_on_when_somebody_says_so() {
    let mut bench = Bench::settled(sio1());
    bench.modules[0].mute = vec![[1, 2]];
    bench.run(20_000);
    bench.order(20_000, "700#FF0400005A5A").send(20_001, 1, b"abc").run(25_000);
    assert_eq!(last_data(&bench.take()), None);
    bench.order(25_000, "700#FF040000A5A5").run(26_000);
    assert!(bench.frames().contains(&"0B5#616263".to_owned()));
}

#[test]
fn r_esd_041_a_module_that_says_it_is_suspended_is_not_sent_to() {
    let mut bench = Bench::settled(sio1());
    bench.modules[0].status |= 0x02;
    bench.run(2000);
    bench.send(2000, 1, b"abc").run(3000);
    assert_eq!(last_data(&bench.take()), None);
}

#[test]
fn a_module_that_stores_because_somebody_said_so_is_left_alone_for_a_moment() {
    let mut bench = Bench::settled(sio1());
    bench.run(1450);
    bench.take();
    bench.frame(1450, "700#810000121200").run(2400);
    assert_eq!(bench.frames(), Vec::<String>::new());
    bench.run(2500);
    assert_eq!(bench.frames(), ["700#010200120567"]);
}

#[test]
fn r_esd_033_a_module_that_is_reset_by_order_may_be_silent_for_its_first_tx_activate_delay() {
    let mut bench = busy();
    bench.order(1200, "700#FF000012AAAA");
    bench.modules[0].on = false;
    bench.run(11_000);
    assert!(!bench.events().contains(&"0 Lost".to_owned()), "it may be silent for 10 s");
    bench.run(16_000);
    assert_eq!(bench.events(), ["0 Lost"], "and not for ever");
    let mut bench = busy();
    bench.order(1200, "700#FF000012AAAA");
    bench.modules[0].on = false;
    bench.run(11_200);
    bench.modules[0].on = true;
    bench.take();
    bench.run(15_000);
    let events = bench.events();
    assert_eq!(events, ["0 Status C1", "0 Restarted", "0 Status 41", "0 Configured 1 false"]);
}

#[test]
fn a_module_that_does_not_answer_is_sent_nothing_until_it_does() {
    let mut bench = busy();
    bench.modules[0].on = false;
    bench.run(12_000);
    let lines = bench.take();
    let asked = lines.iter().find(|line| line.contains("700#0102")).map(|line| millis(line)).unwrap();
    let last = last_data(&lines).unwrap();
    assert!(last <= asked + 300, "asked at {asked}, data until {last}");
    let broken = lines.iter().find(|line| line.contains("job 1 Broken")).unwrap();
    let told = lines.iter().find(|line| line.ends_with("Lost")).unwrap();
    assert_eq!(millis(broken), millis(told));
}

#[test]
fn a_module_that_is_not_as_wanted_and_does_not_answer_is_sent_nothing_either() {
    let mut settings = managed(|management| management.configure = false);
    settings.channels[0].serial_mode = SerialMode::from_value(0x2873);
    let mut pretended = Pretended::new(ModuleKind::Sio1, 0x12);
    pretended.status = 0x41;
    // Another format than wanted, at 150 bit/s.
    pretended.parameters.insert(2, 0x2833);
    let mut bench = Bench::new(network(vec![settings]), vec![pretended]);
    bench.run(900).send(900, 1, &[0x55; 1000]).run(1100);
    assert!(last_data(&bench.take()).is_some());
    bench.modules[0].on = false;
    bench.run(3000);
    bench.take();
    bench.run(3500);
    assert_eq!(last_data(&bench.take()), None);
}

#[test]
fn one_answer_that_was_lost_holds_data_up_and_loses_nothing() {
    let mut bench = busy();
    bench.modules[0].on = false;
    bench.run(2200);
    bench.modules[0].on = true;
    bench.take();
    bench.run(60_000);
    let lines = bench.take();
    assert!(!lines.iter().any(|line| line.contains("Broken") || line.contains("Lost")));
    assert!(last_data(&lines).unwrap() > 50_000);
}

#[test]
fn a_passive_network_sends_nothing_at_all_and_takes_what_comes() {
    let settings = managed(|management| management.watchdog = Some(watchdog(WatchdogMode::Command)));
    let settings = NetworkSettings { passive: true, ..network(vec![settings]) };
    let mut bench = Bench::new(settings, vec![Pretended::new(ModuleKind::Sio1, 0x12)]);
    bench.frame(10, "0B4#48690A").run(100_000);
    let now = bench.now();
    let refused = bench.network.send(now, ModuleIndex(0), 0, 1, vec![1]);
    assert_eq!(refused, Err(SendRefused::Passive));
    bench.stop(100_001);
    assert_eq!(bench.events(), ["0 Appeared", "0 line 0 received Hi\\n", "0 line 0 message Hi by delimiter"]);
}

#[test]
fn another_manager_is_told_of_once_until_it_was_quiet() {
    let mut bench = Bench::settled(sio1());
    for second in 1..100 {
        bench.frame(second * 1000, "700#8200001201AA");
    }
    assert_eq!(bench.events(), ["foreign 700#8200001201AA"]);
    bench.frame(200_000, "700#FF000000AAAA").frame(200_001, "700#R6");
    assert_eq!(bench.events(), ["foreign 700#FF000000AAAA"]);
}

#[test]
fn r_esd_022_023_identifiers_of_the_network_are_its_own() {
    let mut settings = module(ModuleKind::Sio4, 0x11);
    settings.management.as_mut().unwrap().watchdog = Some(watchdog(WatchdogMode::Remote));
    let bench = Bench::new(network(vec![settings]), Vec::new());
    for own in (0x0AA..=0x0B3).chain([0x700, 0x567, 0x512]) {
        assert!(bench.network.owns(id(own)), "{own:03X}");
    }
    for other in [0x000, 0x080, 0x0A9, 0x0B4, 0x701, 0x7E4] {
        assert!(!bench.network.owns(id(other)), "{other:03X}");
    }
    assert!(!bench.network.owns(CanId::extended(0x700).unwrap()));
    assert_eq!(number(0x11).to_string(), "0x11");
}

#[test]
fn r_esd_022_045_the_init_identifier_belongs_to_buses_with_modules_and_other_lengths_are_no_commands() {
    let mut none = NetworkSettings { reply_id: None, ..network(Vec::new()) };
    assert!(!Bench::new(none.clone(), Vec::new()).network.owns(id(0x700)));
    none.reply_id = Some(id(0x567));
    assert!(Bench::new(none, Vec::new()).network.owns(id(0x700)));
    let mut bench = Bench::settled(sio1());
    bench.frame(1000, "700#05").frame(1001, "700#").frame(1002, "700#82000012");
    assert_eq!(bench.events(), Vec::<String>::new());
    bench.frame(1003, "700#8200001201AA0000");
    assert_eq!(bench.events().len(), 1);
    assert!(SendRefused::Full.to_string().starts_with("16 "));
}
