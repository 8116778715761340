//! The watchdog of a module in its life.

use std::time::Duration;

use super::bench::{Bench, Pretended, managed, module, network, sio1, watchdog};
use crate::esd::{ModuleKind, ModuleSettings, WatchdogMode, WatchdogSettings};

fn guarded(mode: WatchdogMode) -> ModuleSettings {
    managed(|management| management.watchdog = Some(watchdog(mode)))
}

fn triggers(lines: &[String]) -> usize {
    lines.iter().filter(|line| line.contains("512#R1") || line.contains("700#FF02")).count()
}

#[test]
fn r_esd_081_082_087_v_esd_11_it_is_set_read_back_and_triggered_when_the_module_is_in_order() {
    for (mode, trigger) in [(WatchdogMode::Remote, "512#R1"), (WatchdogMode::Command, "700#FF0200120000")] {
        let mut bench =
            Bench::new(network(vec![guarded(mode)]), vec![Pretended::new(ModuleKind::Sio1, 0x12)]);
        bench.run(900);
        let lines = bench.take();
        let place = |text: &str| lines.iter().position(|line| line.contains(text)).unwrap();
        let order =
            ["700#810400120512", "700#8105031203E8", "700#010500120567", "Configured 0 false", trigger];
        let mut places = order.map(place);
        // Asked before and after it is set.
        places[2] = lines.iter().rposition(|line| line.contains(order[2])).unwrap();
        assert!(places.is_sorted(), "{lines:?}");
        assert_eq!(bench.modules[0].watchdog, (0x512, 1000, 3));
        bench.run(20_900);
        let lines = bench.take();
        assert_eq!(triggers(&lines), 20);
        assert!(!lines.iter().any(|line| line.contains("Miss") || line.contains("Toggle")), "{lines:?}");
    }
}

#[test]
fn r_esd_089_from_public_copies_a_module_that_takes_the_factor_otherwise_is_told_and_not_triggered() {
    let mut bench = Bench::new(
        network(vec![guarded(WatchdogMode::Remote)]),
        vec![Pretended::new(ModuleKind::Sio1, 0x12)],
    );
    bench.modules[0].stubborn = true;
    bench.modules[0].watchdog = (0x512, 1000, 0);
    bench.run(5000);
    let lines = bench.take();
    let told = lines.iter().find(|line| line.contains("NotConfigured")).unwrap();
    assert!(told.contains("WDtime of the watchdog of module 0x12 is 1000 ms times 0"), "{told}");
    assert_eq!(triggers(&lines), 0);
}

#[test]
fn r_esd_087_as_many_answers_that_do_not_come_as_the_factor_says_lose_the_module() {
    let mut bench = Bench::settled(guarded(WatchdogMode::Remote));
    bench.run(1400);
    bench.take();
    bench.modules[0].watchdog.0 = 0x513;
    bench.run(5900);
    let events: Vec<_> =
        bench.events().into_iter().filter(|it| it.contains("Miss") || it.contains("Lost")).collect();
    let miss = |in_a_row| format!("0 WatchdogMiss {{ in_a_row: {in_a_row} }}");
    assert_eq!(events[..4], [miss(1), miss(2), miss(3), "0 Lost".to_owned()]);
}

#[test]
fn r_esd_087_triggering_goes_on_while_the_module_is_lost_and_its_answer_brings_it_back() {
    let mut bench = Bench::settled(guarded(WatchdogMode::Remote));
    bench.modules[0].on = false;
    bench.run(6000);
    bench.take();
    bench.run(16_000);
    assert_eq!(triggers(&bench.take()), 10);
    bench.modules[0].on = true;
    bench.run(18_900);
    let events = bench.events();
    assert!(events.contains(&"0 Appeared".to_owned()), "{events:?}");
    assert!(events.contains(&"0 Configured 0 false".to_owned()), "{events:?}");
}

#[test]
fn r_esd_076_087_a_module_that_started_anew_is_not_triggered_before_it_is_configured() {
    let mut bench = Bench::settled(guarded(WatchdogMode::Remote));
    bench.run(1400);
    bench.take();
    bench.modules[0].restart();
    bench.run(4900);
    let lines = bench.take();
    let restarted = lines.iter().position(|line| line.contains("Restarted")).unwrap();
    let configured = lines.iter().position(|line| line.contains("Configured")).unwrap();
    let trigger = lines.iter().rposition(|line| line.contains("512#R1")).unwrap();
    assert!(restarted < configured && configured < trigger, "{lines:?}");
    assert_eq!(triggers(&lines[restarted..configured]), 0, "{lines:?}");
    assert_eq!(bench.modules[0].watchdog, (0x512, 1000, 3));
}

#[test]
fn r_esd_088_v_esd_11_who_stops_on_purpose_switches_it_off_and_sends_nothing_more() {
    let mut bench = Bench::settled(guarded(WatchdogMode::Remote));
    bench.stop(2400);
    assert_eq!(bench.frames().last().unwrap(), "700#810500120000");
    bench.link(2500, true).run(10_000);
    assert_eq!(bench.take(), Vec::<String>::new());
}

#[test]
fn r_esd_088_a_module_whose_watchdog_was_not_set_going_is_left_as_it_is() {
    let mut bench = Bench::settled(sio1());
    bench.take();
    bench.stop(600).run(5000);
    assert_eq!(bench.take(), Vec::<String>::new());
}

#[test]
fn triggers_that_do_not_leave_or_a_bus_that_is_down_are_not_the_modules_fault() {
    let mut bench = Bench::settled(guarded(WatchdogMode::Remote));
    bench.refuse = vec!["512#"];
    bench.run(20_000);
    assert!(!bench.events().iter().any(|event| event.contains("Miss")));
    bench.refuse.clear();
    bench.link(20_000, false).run(60_000).link(60_000, true).run(62_900);
    let lines = bench.take();
    assert!(!lines.iter().any(|line| line.contains("Miss")), "{lines:?}");
    assert!(triggers(&lines) >= 2);
}

#[test]
fn r_esd_081_087_a_module_that_reset_itself_is_lost_once_however_short_its_watchdog_is() {
    for millis in [20, 50, 100] {
        let settings = managed(|management| {
            let time = Duration::from_millis(millis);
            management.watchdog = Some(WatchdogSettings { time, ..watchdog(WatchdogMode::Remote) });
        });
        let mut bench = Bench::settled(settings);
        bench.modules[0].on = false;
        bench.run(3000);
        bench.modules[0].on = true;
        bench.modules[0].restart();
        bench.run(20_000);
        let events = bench.events();
        assert_eq!(events.iter().filter(|event| event.contains("Lost")).count(), 1, "{events:?}");
        assert_eq!(events.last().unwrap(), "0 Configured 0 false", "at {millis} ms");
    }
}

#[test]
fn r_esd_083_a_module_is_triggered_at_once_after_an_outage_and_its_answers_judged_when_it_is_configured() {
    let switches = 0x12..0x2A;
    let mut modules: Vec<_> = switches.clone().map(|switch| module(ModuleKind::Sio1, switch)).collect();
    let settings = guarded(WatchdogMode::Remote);
    modules[0] = settings;
    let pretended = switches.map(|switch| Pretended::new(ModuleKind::Sio1, switch)).collect();
    let mut bench = Bench::new(network(modules), pretended);
    bench.run(9900);
    bench.take();
    bench.link(10_000, false).link(10_100, true).run(10_100);
    assert_eq!(triggers(&bench.take()), 1, "the others are not waited for");
    // It does not answer to that, which is nobody's fault yet.
    bench.modules[0].watchdog.0 = 0x513;
    bench.run(10_500);
    assert!(!bench.events().iter().any(|event| event.contains("Miss") || event.contains("Lost")));
}

#[test]
fn r_esd_088_the_watchdog_of_a_module_that_turns_out_another_is_switched_off_before_its_triggering_ends() {
    let mut bench = Bench::settled(guarded(WatchdogMode::Remote));
    bench.modules[0].kind = 0x31;
    bench.link(1000, false).link(1001, true).run(30_000);
    let lines = bench.take();
    let other = lines.iter().position(|line| line.contains("OtherModule")).unwrap();
    assert_eq!(lines.iter().filter(|line| line.contains("700#810500120000")).count(), 1, "{lines:?}");
    assert_eq!(triggers(&lines[other + 2..]), 0, "{lines:?}");
    assert_eq!(bench.modules[0].watchdog.1, 0);
}

#[test]
fn r_esd_083_a_module_that_differs_later_goes_on_being_triggered() {
    let mut settings = guarded(WatchdogMode::Remote);
    settings.management.as_mut().unwrap().configure = false;
    let mut bench = Bench::settled(settings);
    bench.modules[0].ids.insert((2, 0), 0x1AA);
    bench.link(1000, false).link(1001, true).run(11_000);
    let lines = bench.take();
    assert!(lines.iter().any(|line| line.contains("NotConfigured")), "{lines:?}");
    assert!(triggers(&lines) >= 9, "{lines:?}");
    assert!(!lines.iter().any(|line| line.contains("Lost") || line.contains("Miss")), "{lines:?}");
}
