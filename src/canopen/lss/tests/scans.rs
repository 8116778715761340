//! Scans among several slaves.

use super::slave::{Bus, Slave};
use super::*;

fn serial(serial: u32) -> LssAddress {
    LssAddress { serial, ..DST }
}

fn everything() -> LssRange {
    LssRange { vendor: DST.vendor, product: DST.product, revision: (0, u32::MAX), serial: (0, u32::MAX) }
}

fn found(mut addresses: Vec<LssAddress>) -> LssAnswer {
    addresses.sort_unstable();
    LssAnswer::Found(addresses)
}

fn sorted(answer: LssAnswer) -> LssAnswer {
    if let LssAnswer::Found(addresses) = answer { found(addresses) } else { answer }
}

#[test]
fn slowscan_finds_every_configured_slave_though_they_answer_alike() {
    let addresses = vec![
        serial(0),
        serial(1),
        serial(123_456),
        serial(u32::MAX),
        LssAddress { revision: 0x0002_0000, ..serial(123_456) },
    ];
    let strangers = [LssAddress { vendor: 1, ..DST }, LssAddress { product: 2, ..DST }];
    let slaves = addresses.iter().chain(&strangers).map(|address| Slave::new(*address, 1)).collect();
    let mut bus = Bus::new(slaves);
    // Overlapping ranges find nobody twice.
    let job = LssJob::Slowscan(vec![everything(), LssRange { serial: (0, 9), ..everything() }]);
    assert_eq!(bus.run(job).map(sorted), Ok(found(addresses)));
    assert!(bus.slaves.iter().all(|slave| !slave.configuring), "a scan changes nothing");
}

#[test]
fn slowscan_of_nobody_ends_with_nobody() {
    let mut bus = Bus::new(vec![]);
    assert_eq!(bus.run(LssJob::Slowscan(vec![everything()])), Ok(found(vec![])));
    assert_eq!(bus.run(LssJob::Slowscan(vec![])), Ok(found(vec![])));
}

#[test]
fn slowscan_of_one_slave_takes_a_few_seconds() {
    let mut bus = Bus::new(vec![Slave::new(DST, 1)]);
    let range = LssRange { revision: (DST.revision, DST.revision), ..everything() };
    assert_eq!(bus.run(LssJob::Slowscan(vec![range])), Ok(found(vec![DST])));
    assert!(bus.now < 5000, "{} ms", bus.now);
}

#[test]
fn slowscan_survives_lost_frames_or_says_that_something_is_wrong() {
    let mut right = 0;
    for lost in 20..60 {
        let mut bus = Bus::new(vec![Slave::new(DST, 1)]);
        bus.lost = lost;
        match bus.run(LssJob::Slowscan(vec![everything()])) {
            Ok(answer) if answer == LssAnswer::Found(vec![DST]) => right += 1,
            Ok(answer) => assert_eq!(answer, LssAnswer::Found(vec![])),
            Err(error) => assert_eq!(error, LssError::Inconsistent),
        }
    }
    assert!(right > 30, "{right} of 40");
}

#[test]
fn a_slave_that_says_yes_to_everything_does_not_keep_the_scan_for_ever() {
    let mut bus = Bus::new(vec![Slave::new(DST, 1)]);
    bus.slaves[0].liar = true;
    assert!(matches!(bus.run(LssJob::Slowscan(vec![everything()])), Err(LssError::Nonsense(_))));
}

#[test]
fn fastscan_finds_slaves_without_node_id_one_after_the_other() {
    let addresses = [
        DST,
        serial(7),
        LssAddress { vendor: 0, product: u32::MAX, revision: 0x8000_0000, serial: 1 },
        LssAddress { vendor: u32::MAX, product: 0, revision: 1, serial: u32::MAX },
    ];
    let mut bus = Bus::new(addresses.iter().map(|address| Slave::new(*address, 0xFF)).collect());
    bus.slaves.push(Slave::new(serial(99), 3));
    let mut all = Vec::new();
    for node in 1..=4 {
        let Ok(LssAnswer::Found(one)) = bus.run(LssJob::Fastscan(LssKnown::default())) else { panic!() };
        all.extend(one);
        let configuring: Vec<_> = bus.slaves.iter().filter(|slave| slave.configuring).collect();
        assert_eq!(configuring.len(), 1);
        // Only that one takes the node id.
        bus.run(LssJob::ConfigureNodeId(crate::canopen::NodeId::new(10 + node))).unwrap();
        bus.run(LssJob::SwitchGlobal { state: LssState::Waiting, only_slave: false }).unwrap();
    }
    assert_eq!(bus.run(LssJob::Fastscan(LssKnown::default())), Ok(found(vec![])));
    assert_eq!(found(all), found(addresses.to_vec()));
}

#[test]
fn fastscan_asks_known_parts_at_once() {
    let known = LssKnown { vendor: Some(0x23D), product: Some(DST.product), ..LssKnown::default() };
    let mut bus = Bus::new(vec![Slave::new(LssAddress { vendor: 1, ..DST }, 0xFF), Slave::new(DST, 0xFF)]);
    assert_eq!(bus.run(LssJob::Fastscan(known)), Ok(found(vec![DST])));
    let known = LssKnown { vendor: Some(2), ..known };
    let mut bus = Bus::new(vec![Slave::new(DST, 0xFF)]);
    assert_eq!(bus.run(LssJob::Fastscan(known)), Ok(found(vec![])));
    assert!(matches!(bus.run(LssJob::Store), Err(LssError::Nonsense(_))), "nobody was brought anywhere");
}

#[test]
fn answers_that_come_too_late_for_their_question_find_nobody_who_is_not_there() {
    for lag in 20..80 {
        let slaves = [DST, serial(7), LssAddress { vendor: u32::MAX, ..serial(u32::MAX) }, serial(8)];
        let mut bus = Bus::new(slaves.iter().map(|address| Slave::new(*address, 0xFF)).collect());
        bus.lag = lag;
        for job in [LssJob::Slowscan(vec![everything()]), LssJob::Fastscan(LssKnown::default())] {
            match bus.run(job) {
                Ok(LssAnswer::Found(found)) => {
                    assert!(found.iter().all(|address| slaves.contains(address)), "{lag} ms: {found:?}");
                }
                other => assert_eq!(other, Err(LssError::Inconsistent)),
            }
        }
    }
}

#[test]
fn a_fastscan_whose_answers_get_lost_is_no_wrong_address() {
    for lost in 3..40 {
        let mut bus = Bus::new(vec![Slave::new(DST, 0xFF)]);
        bus.lost = lost;
        let result = bus.run(LssJob::Fastscan(LssKnown::default()));
        assert!(result == Err(LssError::Inconsistent) || result == Ok(found(vec![])), "{lost}: {result:?}");
    }
}
