//! The store against a disk that can do all that real ones do.

#[path = "damage_tests.rs"]
mod damage;
#[path = "fault_tests.rs"]
mod faults;
#[path = "kill_tests.rs"]
mod kills;

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use uuid::Uuid;

use super::keeper::RETRY_INTERVAL;
use super::log::length;
use super::model_disk::ModelDisk;
use super::reading::Want;
use super::*;
use crate::time::Now;

fn fresh() -> Uuid {
    static NEXT: AtomicU64 = AtomicU64::new(1);
    Uuid::from_u128(NEXT.fetch_add(1, Ordering::Relaxed).into())
}

fn settings() -> StoreSettings {
    let memory = Limits { records: 10_000, bytes: 1 << 20 };
    let boot = Uuid::from_u128(7);
    StoreSettings { bytes: 1 << 20, age: None, sync: Sync::Balanced, memory, boot, fresh }
}

const ALL: [Want; 2] = [Want { records: 1000, bytes: 1 << 20, below: u64::MAX }; 2];

fn text(class: Class, number: u64) -> Arc<str> {
    // Some are long enough to be deflated.
    let longer = if class == Class::Sample && number.is_multiple_of(5) { 600 } else { 0 };
    let filler = "x".repeat(usize::try_from(number * 37 % 400 + longer).unwrap());
    format!("{}-{number}-{filler}", class.word()).into()
}

/// A store, and what a caller of it knows.
struct Bench {
    store: Store<ModelDisk>,
    now: Now,
    /// Newest number of each class.
    numbers: [u64; 2],
}

impl Bench {
    fn new(disk: ModelDisk, settings: StoreSettings, now: Now) -> Self {
        Self { store: Store::open(disk, settings, now), now, numbers: [0; 2] }
    }

    fn entries(&mut self, class: Class, count: u64) -> Vec<Entry> {
        let newest = &mut self.numbers[class.place()];
        let numbers = *newest + 1..=*newest + count;
        *newest += count;
        numbers.map(|number| Entry { class, number, body: text(class, number) }).collect()
    }

    fn append(&mut self, class: Class, count: u64) -> Done {
        let append = self.entries(class, count);
        self.turn(Turn { append, ..Turn::default() })
    }

    fn turn(&mut self, turn: Turn) -> Done {
        self.store.turn(self.now, turn)
    }

    fn wait(&mut self, duration: Duration) {
        self.now = self.now.later(duration);
        self.turn(Turn::default());
    }

    /// All that can be read, acknowledged where `acknowledge` says so.
    fn drain(&mut self, acknowledge: bool) -> [Vec<Item>; 2] {
        let mut all = [Vec::new(), Vec::new()];
        loop {
            let done = self.turn(Turn { want: ALL, ..Turn::default() });
            for class in Class::ALL {
                let items = &done.items[class.place()];
                if acknowledge {
                    let acknowledged = items.iter().map(|item| (class, item.position)).collect();
                    self.turn(Turn { acknowledged, ..Turn::default() });
                }
                all[class.place()].extend(items.iter().cloned());
            }
            if !done.more.contains(&true) {
                return all;
            }
        }
    }
}

fn numbers(items: &[Item]) -> Vec<u64> {
    items.iter().map(|item| item.number).collect()
}

#[test]
fn p1_records_outlive_the_process_in_order_and_leave_when_they_are_acknowledged() {
    let mut bench = Bench::new(ModelDisk::default(), settings(), Now::default());
    bench.append(Class::Event, 30);
    bench.append(Class::Sample, 20);
    let [events, samples] = bench.drain(false);
    assert_eq!((numbers(&events), numbers(&samples)), ((1..=30).collect(), (1..=20).collect()));
    let (stream, newest) = bench.store.stream();
    assert_eq!(newest, 30);
    // Only the first ten were acknowledged, and the process is killed later.
    let acknowledged = (1..=10).map(|position| (Class::Event, position)).collect();
    bench.turn(Turn { acknowledged, ..Turn::default() });
    bench.wait(Duration::from_secs(11));
    let disk = bench.store.disk_mut().after_kill();
    let mut next = Bench::new(disk, settings(), Now::default());
    assert_eq!(next.store.stream(), (stream, 30));
    next.numbers = [30, 20];
    next.append(Class::Event, 1);
    let [events, samples] = next.drain(true);
    assert_eq!(numbers(&events), (11..=31).collect::<Vec<_>>());
    assert!(events.iter().all(|item| item.stream == stream && item.body == text(Class::Event, item.number)));
    assert_eq!(numbers(&samples), (1..=20).collect::<Vec<_>>());
    assert_eq!(next.store.report().records, [0, 0]);
    next.store.close(next.now);
    let mut last = Bench::new(next.store.disk_mut().after_power_cut(0, false), settings(), Now::default());
    assert_eq!(last.drain(true), [Vec::new(), Vec::new()]);
    assert_eq!(last.store.stream(), (stream, 31), "closed in good order: the stream goes on");
}

#[test]
fn p4_after_a_power_cut_numbers_that_may_have_been_told_are_not_used_again() {
    let cut = |sync, share, garbage| {
        let settings = StoreSettings { sync, ..settings() };
        let mut bench = Bench::new(ModelDisk::default(), settings, Now::default());
        bench.append(Class::Event, 5);
        bench.wait(Duration::from_secs(1));
        bench.append(Class::Event, 5);
        let (stream, _) = bench.store.stream();
        let disk = bench.store.disk_mut().after_power_cut(share, garbage);
        let booted = StoreSettings { boot: Uuid::from_u128(8), ..settings };
        let mut next = Bench::new(disk, booted, Now::default());
        let same = next.store.stream().0 == stream;
        let [events, _] = next.drain(true);
        assert!(events.iter().all(|item| item.stream == stream));
        (same, numbers(&events).len())
    };
    assert_eq!(cut(Sync::Strict, 0, false), (true, 10), "strict: nothing was lost");
    assert_eq!(
        cut(Sync::Balanced, 0, false),
        (false, 5),
        "half a second was lost, and nobody knows how much"
    );
    assert_eq!(cut(Sync::Balanced, 0, true), (false, 5));
    assert!(!cut(Sync::Balanced, 255, true).0);
}

#[test]
fn p11_when_full_whole_segments_of_samples_go_first_and_events_only_when_no_others_are_left() {
    let mut bench = Bench::new(ModelDisk::default(), settings(), Now::default());
    for _ in 0..300 {
        bench.append(Class::Event, 3);
        bench.append(Class::Sample, 20);
    }
    let report = bench.store.report();
    assert!(report.bytes <= 1 << 20, "{report:?}");
    assert!(report.filling && report.dropped[1] > 0 && report.dropped[0] == 0, "{report:?}");
    let disk = bench.store.disk_mut().after_kill();
    let [events, samples] = bench.drain(true);
    assert_eq!(numbers(&events), (1..=900).collect::<Vec<_>>());
    let held: u64 = length(samples.len());
    assert_eq!(held + report.dropped[1], 6000, "exact");
    assert_eq!(samples[0].lost_before, report.dropped[1], "the reader is told");
    assert!(samples[1..].iter().all(|item| item.lost_before == 0));
    assert_eq!(bench.store.report().damaged, [0, 0]);
    // A process that starts there is told the same.
    let mut next = Bench::new(disk, settings(), Now::default());
    let [_, again] = next.drain(true);
    assert_eq!((again[0].lost_before, again.len()), (report.dropped[1], samples.len()));
    assert_eq!(next.store.report().damaged, [0, 0], "dropped is not damaged");
    // Events alone: the oldest of them leave.
    let mut bench = Bench::new(ModelDisk::default(), settings(), Now::default());
    bench.append(Class::Sample, 10);
    for _ in 0..300 {
        bench.append(Class::Event, 30);
    }
    let report = bench.store.report();
    assert_eq!(report.dropped[1], 10);
    let [events, samples] = bench.drain(true);
    assert_eq!(samples.len(), 0);
    assert_eq!(length(events.len()) + report.dropped[0], 9000);
    assert_eq!(events[0].lost_before, report.dropped[0]);
}

#[test]
fn what_is_too_old_leaves_in_whole_segments() {
    let settings = StoreSettings { age: Some(Duration::from_secs(3600)), ..settings() };
    let mut bench = Bench::new(ModelDisk::default(), settings, Now::default());
    for _ in 0..30 {
        bench.append(Class::Event, 10);
        bench.wait(Duration::from_secs(600));
    }
    let report = bench.store.report();
    let [events, _] = bench.drain(true);
    assert_eq!(length(events.len()) + report.dropped[0], 300);
    assert!(report.dropped[0] > 100 && events.len() >= 60, "{report:?}");
}

#[test]
fn p10_a_full_disk_is_told_records_stay_in_memory_and_it_resumes_by_itself() {
    let full = DiskError::Full("no space".into());
    let read_only = DiskError::Failed("read-only file system".into());
    for (fault, state) in [(full, State::Full), (read_only, State::Faulty)] {
        let mut bench = Bench::new(ModelDisk::default(), settings(), Now::default());
        bench.append(Class::Event, 5);
        let (stream, _) = bench.store.stream();
        bench.store.disk_mut().fault = Some(fault);
        let report = bench.append(Class::Event, 5).report;
        assert_eq!((report.state, report.faults), (state, 1));
        assert!(!report.reason.is_empty());
        bench.append(Class::Sample, 5);
        bench.store.disk_mut().fault = None;
        bench.wait(RETRY_INTERVAL);
        bench.append(Class::Event, 5);
        let report = bench.store.report();
        assert_eq!((report.state, &*report.reason, report.dropped), (State::Good, "", [0, 0]));
        let mut next = Bench::new(bench.store.disk_mut().after_kill(), settings(), Now::default());
        for store in [&mut bench, &mut next] {
            let [events, samples] = store.drain(true);
            assert_eq!(numbers(&events), (1..=15).collect::<Vec<_>>());
            assert_eq!(numbers(&samples), (1..=5).collect::<Vec<_>>());
            assert!(events.iter().chain(&samples).all(|item| item.lost_before == 0));
            // Those that only memory held have another name, should the process have ended before.
            assert!(events[5..].iter().all(|item| item.stream != stream));
        }
        assert_eq!(next.store.stream().1, 15);
    }
}

#[test]
fn p10_memory_is_bounded_and_drops_are_exact() {
    let memory = Limits { records: 100, bytes: 1 << 20 };
    let settings = StoreSettings { memory, ..settings() };
    let mut bench = Bench::new(ModelDisk::default(), settings, Now::default());
    bench.append(Class::Event, 5);
    bench.append(Class::Sample, 5);
    bench.store.disk_mut().fault = Some(DiskError::Failed("I/O error".into()));
    for _ in 0..30 {
        bench.append(Class::Sample, 10);
        bench.append(Class::Event, 3);
    }
    let report = bench.append(Class::Event, 100).report;
    // 95 new events fit beside the 5 that were not made sure of.
    assert_eq!((report.records, report.dropped), ([100, 0], [95, 305]));
    assert!(report.filling);
    bench.store.disk_mut().fault = None;
    bench.wait(RETRY_INTERVAL);
    let [events, samples] = bench.drain(true);
    assert_eq!((events.len(), samples.len()), (105, 5), "the first five are on disk, whoever doubted it");
    let told: u64 = events.iter().map(|item| item.lost_before).sum();
    assert_eq!(told + 105, 195);
}

#[test]
fn a_disk_that_comes_late_is_taken_and_what_it_held_comes_first() {
    let mut before = Bench::new(ModelDisk::default(), settings(), Now::default());
    before.append(Class::Event, 5);
    let (old, _) = before.store.stream();
    let mut disk = before.store.disk_mut().after_kill();
    disk.fault = Some(DiskError::Failed("not mounted".into()));
    let mut bench = Bench::new(disk, settings(), Now::default());
    assert_eq!(bench.store.report().state, State::Faulty);
    bench.append(Class::Event, 3);
    let first = bench.drain(false);
    assert_eq!(numbers(&first[0]), [1, 2, 3]);
    bench.store.disk_mut().fault = None;
    bench.wait(RETRY_INTERVAL);
    assert_eq!(bench.turn(Turn::default()).epoch, 1, "positions are others now");
    let [events, _] = bench.drain(true);
    assert_eq!(numbers(&events), [1, 2, 3, 4, 5, 1, 2, 3]);
    assert!(events[..5].iter().all(|item| item.stream == old));
    assert!(events[5..].iter().all(|item| item.stream == first[0][0].stream && item.stream != old));
    assert_eq!(bench.store.stream(), (first[0][0].stream, 3));
}

#[test]
fn a_sync_that_failed_is_not_believed_later() {
    let mut bench = Bench::new(ModelDisk::default(), settings(), Now::default());
    bench.append(Class::Event, 5);
    bench.store.disk_mut().fault = Some(DiskError::Failed("I/O error".into()));
    bench.wait(Duration::from_secs(1));
    assert_eq!(bench.store.report().state, State::Faulty);
    bench.store.disk_mut().fault = None;
    bench.wait(RETRY_INTERVAL);
    // The system threw away what it could not write, as it may.
    let mut disk = bench.store.disk_mut().after_power_cut(0, false);
    let oldest = disk.files.keys().find(|name| name.starts_with("event")).unwrap().clone();
    disk.files.get_mut(&oldest).unwrap().bytes.truncate(88);
    let mut next = Bench::new(disk, settings(), Now::default());
    assert_eq!(numbers(&next.drain(true)[0]), [1, 2, 3, 4, 5]);
}

#[test]
fn a_disk_that_cannot_be_read_is_tried_three_times_and_no_more_often_than_every_five_seconds() {
    let mut bench = Bench::new(ModelDisk::default(), settings(), Now::default());
    bench.append(Class::Event, 5);
    bench.wait(Duration::from_secs(1));
    bench.store.disk_mut().unreadable = true;
    for _ in 0..100 {
        let done = bench.turn(Turn { want: ALL, ..Turn::default() });
        assert!(done.items[0].is_empty() && !done.more[0], "no reader comes back at once");
        assert!(done.due.is_some_and(|due| due > bench.now.instant));
    }
    assert_eq!(bench.store.report().faults, 1);
    for _ in 0..2 {
        bench.now = bench.now.later(RETRY_INTERVAL);
        bench.turn(Turn { want: ALL, ..Turn::default() });
    }
    // What comes after it is not held up for ever.
    bench.store.disk_mut().unreadable = false;
    bench.now = bench.now.later(RETRY_INTERVAL);
    bench.append(Class::Event, 1);
    let [events, _] = bench.drain(true);
    assert_eq!((numbers(&events), events[0].lost_before), (vec![6], 5));
    assert_eq!(bench.store.report().damaged, [5, 0]);
}

#[test]
fn a_record_that_is_acknowledged_before_it_is_read_does_not_come() {
    let mut bench = Bench::new(ModelDisk::default(), settings(), Now::default());
    let placed = bench.append(Class::Sample, 5).placed;
    bench.turn(Turn { acknowledged: vec![(Class::Sample, placed[1])], ..Turn::default() });
    let [_, samples] = bench.drain(true);
    assert_eq!(numbers(&samples), [1, 3, 4, 5]);
    assert!(samples.iter().all(|item| item.lost_before == 0));
    assert_eq!(bench.store.report().records, [0, 0]);
}

#[test]
fn a_record_that_is_still_told_elsewhere_holds_those_behind_it_until_it_is_acknowledged() {
    let mut bench = Bench::new(ModelDisk::default(), settings(), Now::default());
    let placed = bench.append(Class::Sample, 5).placed;
    let held = [Want::default(), Want { below: placed[2], ..ALL[1] }];
    let done = bench.turn(Turn { want: held, ..Turn::default() });
    assert_eq!((numbers(&done.items[1]), done.more), (vec![1, 2], [false, true]));
    assert_eq!(bench.turn(Turn { want: held, ..Turn::default() }).items[1], []);
    let acknowledged = vec![(Class::Sample, placed[2])];
    bench.turn(Turn { acknowledged, ..Turn::default() });
    assert_eq!(numbers(&bench.drain(true)[1]), [4, 5]);
}
