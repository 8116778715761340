//! The process is killed at any write, over several lives.

use std::collections::BTreeMap;

use proptest::prelude::*;

use super::*;

#[derive(Clone, Debug)]
enum Step {
    Append { class: Class, count: u64 },
    Read,
    Acknowledge { share: u8 },
    Wait { millis: u64 },
}

fn step() -> impl Strategy<Value = Step> {
    let class = prop_oneof![Just(Class::Event), Just(Class::Sample)];
    prop_oneof![
        4 => (class, 1u64..12).prop_map(|(class, count)| Step::Append { class, count }),
        3 => Just(Step::Read),
        3 => any::<u8>().prop_map(|share| Step::Acknowledge { share }),
        1 => prop_oneof![1u64..600, 5_000u64..20_000].prop_map(|millis| Step::Wait { millis }),
    ]
}

/// What a caller may rely on, over several lives of the process.
#[derive(Default)]
struct Oracle {
    /// Records that were taken in and not acknowledged.
    owed: [BTreeMap<u64, Arc<str>>; 2],
    /// Handed out in this life.
    handed: Vec<(Class, Item)>,
    /// The number handed out last in this life.
    last: [u64; 2],
}

impl Oracle {
    fn see(&mut self, class: Class, items: Vec<Item>) {
        for item in items {
            assert_eq!(item.body, text(class, item.number), "never a wrong payload");
            assert_eq!(item.lost_before, 0, "nothing is missing");
            assert!(item.number > self.last[class.place()], "in order, and never twice in one life");
            self.last[class.place()] = item.number;
            self.handed.push((class, item));
        }
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 300, ..ProptestConfig::default() })]

    #[test]
    fn p3_killed_at_any_write_nothing_that_was_taken_in_is_lost(
        lives in proptest::collection::vec(
            (proptest::collection::vec(step(), 1..40), 0u64..60, any::<u8>()), 1..6),
        strict: bool,
    ) {
        let sync = if strict { Sync::Strict } else { Sync::Balanced };
        // Small segments, so that many are begun and removed.
        let settings = StoreSettings { sync, ..settings() };
        let mut disk = ModelDisk::default();
        let mut oracle = Oracle::default();
        let mut numbers = [0, 0];
        for (steps, kill_in, torn) in lives {
            disk.kill_in = Some(kill_in + 4);
            disk.torn = torn;
            let mut bench = Bench::new(disk, settings, Now::default());
            bench.numbers = numbers;
            oracle.handed.clear();
            oracle.last = [0, 0];
            for step in steps {
                let mut turn = Turn::default();
                match step {
                    Step::Append { class, count } => turn.append = bench.entries(class, count),
                    Step::Read => turn.want = ALL,
                    Step::Acknowledge { share } => {
                        let count = oracle.handed.len() * usize::from(share) / 255;
                        turn.acknowledged = oracle.handed.drain(..count).map(|(class, item)| (class, item.position)).collect();
                    }
                    Step::Wait { millis } => bench.now = bench.now.later(Duration::from_millis(millis)),
                }
                let acknowledged: Vec<_> = turn.acknowledged.clone();
                let appended = turn.append.clone();
                let done = bench.turn(turn);
                let killed = bench.store.disk_mut().killed;
                for (class, position) in acknowledged {
                    // Positions are numbers here: both begin at 1 and go on over all lives.
                    oracle.owed[class.place()].remove(&position);
                }
                if killed {
                    break;
                }
                for (entry, position) in appended.into_iter().zip(done.placed) {
                    prop_assert_eq!(entry.number, position);
                    oracle.owed[entry.class.place()].insert(entry.number, entry.body);
                }
                let [events, samples] = done.items;
                oracle.see(Class::Event, events);
                oracle.see(Class::Sample, samples);
            }
            disk = bench.store.disk_mut().after_kill();
            let mut next = Bench::new(disk.clone(), settings, Now::default());
            let found = next.drain(false);
            for class in Class::ALL {
                let items: BTreeMap<u64, Arc<str>> = found[class.place()].iter().map(|item| (item.number, item.body.clone())).collect();
                for (number, body) in &oracle.owed[class.place()] {
                    prop_assert_eq!(items.get(number), Some(body), "{:?} {} is lost", class, number);
                }
                prop_assert!(found[class.place()].iter().all(|item| item.lost_before == 0 && item.body == text(class, item.number)));
                // What was being written when the process ended may be there or not.
                numbers[class.place()] = found[class.place()].last().map_or(0, |item| item.number).max(next.store.newest_position(class));
                oracle.owed[class.place()] = items;
            }
        }
    }
}
