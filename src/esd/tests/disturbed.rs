//! Modules that do not answer, answers that come late, frames that do not leave, a bus that fails.

use super::bench::{Bench, Pretended, managed, module, network, sio1};
use crate::esd::{ModuleKind, ModuleSettings, NetworkSettings};

fn nobody(settings: ModuleSettings) -> Bench {
    Bench::new(network(vec![settings]), Vec::new())
}

#[test]
fn r_esd_033_a_module_that_shows_nothing_is_looked_for_and_reported_when_its_time_is_over() {
    let mut bench = nobody(sio1());
    bench.run(14_999);
    let lines = bench.take();
    assert_eq!(lines[..3], ["10 700#010100120567", "2110 700#010100120567", "4210 700#010100120567"]);
    assert!(lines.iter().all(|line| line.contains('#')), "{lines:?}");
    bench.run(60_000);
    assert_eq!(bench.events(), ["0 NeverSeen"], "once");
}

#[test]
fn r_esd_053_a_question_is_repeated_twice_and_three_in_a_row_lose_the_module() {
    let mut bench = Bench::settled(sio1());
    bench.modules[0].on = false;
    bench.run(6000);
    let lines = bench.take();
    let lost = lines.iter().position(|line| line.ends_with("Lost")).unwrap();
    let polls = lines[..lost].iter().filter(|line| line.contains("700#0102")).count();
    // After the first doubtful one it is asked for its number instead.
    let numbers = lines[..lost].iter().filter(|line| line.contains("700#0101")).count();
    assert_eq!((polls, numbers), (3, 6), "{lines:?}");
    let first: u64 = lines[0].split(' ').next().unwrap().parse().unwrap();
    assert!(lines[1].starts_with(&format!("{} ", first + 100)), "{lines:?}");
}

#[test]
fn a_lost_module_is_looked_for_every_two_seconds_and_configured_when_it_comes_back() {
    let mut bench = Bench::settled(sio1());
    bench.modules[0].on = false;
    bench.run(10_000);
    assert_eq!(bench.events(), ["0 Lost"]);
    bench.run(20_000);
    assert_eq!(bench.frames(), ["700#010100120567"; 5]);
    bench.modules[0].on = true;
    bench.modules[0].restart();
    bench.run(23_500);
    let events = bench.events();
    let expected = ["0 Appeared", "0 Status C1", "0 Restarted", "0 Status 41", "0 Configured 0 false"];
    assert_eq!(events, expected);
}

#[test]
fn data_is_a_sign_of_life_and_no_answer() {
    let mut bench = nobody(sio1());
    bench.frame(500, "0B4#41").run(1000);
    let lines = bench.take();
    assert!(lines.contains(&"500 0 Appeared".to_owned()), "{lines:?}");
    assert!(lines.contains(&"500 700#010100120567".to_owned()), "asked at once: {lines:?}");
    assert!(!lines.iter().any(|line| line.contains("Configured")));
}

#[test]
fn a_module_that_sends_data_and_answers_nothing_is_told_once_and_does_not_come_and_go() {
    let mut bench = nobody(sio1());
    for second in 1..100 {
        bench.frame(second * 1000, "0B4#41");
    }
    let events = bench.events();
    let events: Vec<_> = events.iter().filter(|event| !event.contains("line")).collect();
    assert_eq!(events.len(), 2, "{events:?}");
    assert_eq!(events[0], "0 Appeared");
    assert!(events[1].contains("sends data but answers no commands"), "{}", events[1]);
    bench.send(100_500, 1, b"x").run(100_600);
    assert!(bench.frames().contains(&"0B5#78".to_owned()), "its lines are used all the same");
}

#[test]
fn r_esd_055_a_late_answer_is_not_taken_for_that_of_another_module() {
    let modules = [0x12, 0x13].map(|switch| module(ModuleKind::Sio1, switch)).to_vec();
    let mut pretended = [0x12, 0x13].map(|switch| Pretended::new(ModuleKind::Sio1, switch));
    for module in &mut pretended {
        module.status = 0x41;
    }
    let mut bench = Bench::new(network(modules), pretended.to_vec());
    bench.run(900);
    bench.take();
    // The first does not answer any more; its answers come 190 ms late, and say that it started anew.
    bench.modules[0].on = false;
    bench.run(3000);
    let lines = bench.take();
    let asked = |line: &&String| line.contains("700#010200120567");
    let times: Vec<u64> =
        lines.iter().filter(asked).map(|line| line.split(' ').next().unwrap().parse().unwrap()).collect();
    let mut bench =
        Bench::new(network([0x12, 0x13].map(|it| module(ModuleKind::Sio1, it)).to_vec()), pretended.to_vec());
    bench.run(900);
    bench.modules[0].on = false;
    for time in times {
        bench.frame(time + 190, "567#0102C1");
    }
    bench.run(4000);
    let events = bench.events();
    let second: Vec<_> = events.iter().filter(|event| event.starts_with("1 ")).collect();
    assert_eq!(second, ["1 Appeared", "1 Status 41", "1 Configured 0 false"]);
}

#[test]
fn r_esd_055_after_a_question_without_answer_the_next_module_is_asked_who_it_is_first() {
    let mut bench = Bench::new(
        network([0x12, 0x13].map(|switch| module(ModuleKind::Sio1, switch)).to_vec()),
        [0x12, 0x13].map(|switch| Pretended::new(ModuleKind::Sio1, switch)).to_vec(),
    );
    bench.run(900);
    bench.take();
    bench.modules[0].on = false;
    bench.run(1900);
    let frames = bench.frames();
    let second = frames.iter().position(|frame| frame.ends_with("00130567")).unwrap();
    let first = frames.iter().position(|frame| frame.ends_with("00120567")).unwrap();
    let after = frames[first..].iter().find(|frame| frame.ends_with("00130567")).unwrap();
    assert!(second < first || after == "700#010100130567", "{frames:?}");
    let identified = frames.iter().filter(|frame| *frame == "700#010100130567").count();
    assert!(identified >= 1, "{frames:?}");
}

#[test]
fn answers_of_a_wrong_length_or_to_nothing_are_ignored() {
    let mut bench = Bench::settled(sio1());
    for text in ["567#0102C1", "567#", "567#FF", "567#010200000000", "567#R3", "568#0102C1"] {
        bench.frame(600, text);
    }
    assert_eq!(bench.events(), Vec::<String>::new());
}

#[test]
fn r_esd_052_a_module_that_does_not_know_a_command_is_not_configured() {
    let mut bench = Bench::new(network(vec![sio1()]), vec![Pretended::new(ModuleKind::Sio1, 0x12)]);
    bench.modules[0].ids.remove(&(3, 0));
    bench.run(2000);
    let events = bench.events();
    let told = events.iter().find(|event| event.contains("NotConfigured")).unwrap();
    assert!(told.contains("RxId of channel 1 of module 0x12: it does not know this command"), "{told}");
}

#[test]
fn a_question_that_does_not_leave_is_not_the_modules_fault() {
    let mut bench = Bench::settled(sio1());
    bench.refuse = vec!["700#"];
    bench.run(30_000);
    assert_eq!(bench.events(), Vec::<String>::new());
    bench.refuse.clear();
    bench.run(33_000);
    assert_eq!(bench.events(), Vec::<String>::new());
    assert!(!bench.take().iter().any(|line| line.contains("Lost")));
}

#[test]
fn a_setting_that_does_not_leave_is_sent_again_and_nothing_is_called_stored_that_is_not() {
    let mut settings = managed(|management| management.store = true);
    settings.channels[0].tx_id = super::bench::id(0x1AA);
    let mut bench = Bench::new(network(vec![settings]), vec![Pretended::new(ModuleKind::Sio1, 0x12)]);
    bench.refuse = vec!["700#82", "700#8102"];
    bench.run(5000);
    let events = bench.events();
    assert!(!events.iter().any(|event| event.contains("onfigured")), "{events:?}");
    bench.refuse = vec!["700#8100"];
    bench.run(9000);
    assert!(!bench.events().iter().any(|event| event.contains("onfigured")));
    assert_eq!(bench.modules[0].ids[&(2, 0)], 0x1AA);
    bench.refuse.clear();
    bench.run(12_000);
    assert_eq!(bench.events(), ["0 Configured 1 true"]);
    bench.modules[0].restart();
    assert_eq!(bench.modules[0].ids[&(2, 0)], 0x1AA, "stored");
}

#[test]
fn while_the_bus_is_down_nothing_is_sent_and_nobody_is_blamed() {
    let mut bench = Bench::settled(sio1());
    bench.link(1000, false).run(60_000);
    assert_eq!(bench.take(), Vec::<String>::new());
    bench.link(60_000, true).run(60_900);
    assert_eq!(bench.events(), ["0 Appeared", "0 Status 41", "0 Configured 0 false"]);
}

#[test]
fn without_a_reply_identifier_no_module_is_managed_and_its_lines_are_used() {
    let settings = NetworkSettings { reply_id: None, ..network(vec![sio1()]) };
    let mut bench = Bench::new(settings, Vec::new());
    bench.send(0, 1, b"x").run(60_000);
    assert_eq!(bench.frames(), ["0B5#78"]);
}

#[test]
fn a_module_that_is_not_managed_appears_with_its_data_and_is_never_lost() {
    let mut settings = sio1();
    settings.management = None;
    let mut bench = nobody(settings);
    bench.frame(1000, "0B4#41").run(1_000_000);
    let events = bench.events();
    assert_eq!(events, ["0 Appeared", "0 line 0 received A"]);
    bench.link(1_000_001, false).link(1_000_002, true).frame(1_000_003, "0B4#42");
    assert!(bench.events().contains(&"0 Appeared".to_owned()), "again");
}

#[test]
fn a_busy_reply_identifier_does_not_stop_the_managing() {
    let mut bench = Bench::new(network(vec![sio1()]), vec![Pretended::new(ModuleKind::Sio1, 0x12)]);
    for millis in (0..20_000).step_by(5) {
        bench.frame(millis, "567#AABB");
    }
    assert!(bench.events().contains(&"0 Configured 0 false".to_owned()));
}

#[test]
fn one_question_that_a_module_never_answers_is_named_and_does_not_make_it_come_and_go() {
    for (head, what) in [
        ([0, 0], "its type"),
        ([0, 3], "its software revision"),
        ([1, 2], "its status"),
        ([3, 0], "its RxId of channel 1"),
        ([6, 0], "its user parameter 0x00"),
    ] {
        let mut pretended = Pretended::new(ModuleKind::Sio1, 0x12);
        pretended.mute = vec![head];
        let mut bench = Bench::new(network(vec![sio1()]), vec![pretended]);
        bench.run(100_000);
        let events = bench.events();
        let count = |text: &str| events.iter().filter(|event| event.contains(text)).count();
        assert_eq!(
            (count("Lost"), count("Appeared"), count("NotConfigured")),
            (0, 1, 1),
            "{what}: {events:?}"
        );
        assert_eq!(count(&format!("does not answer the question for {what}")), 1, "{events:?}");
        bench.modules[0].mute.clear();
        bench.run(200_000);
        assert!(bench.events().contains(&"0 Configured 0 false".to_owned()), "{what}");
    }
}
