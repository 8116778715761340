//! Disks of which only some calls fail.

use super::*;

/// What a caller may know a record by, and what it says.
fn names(items: &[Item]) -> Vec<(Uuid, u64)> {
    items.iter().map(|item| (item.stream, item.number)).collect()
}

/// A store with five events and five samples that were read, whose process ended.
fn used() -> (ModelDisk, Uuid) {
    let mut bench = Bench::new(ModelDisk::default(), settings(), Now::default());
    bench.append(Class::Event, 5);
    bench.append(Class::Sample, 5);
    let (stream, _) = bench.store.stream();
    (bench.store.disk_mut().after_kill(), stream)
}

#[test]
fn p10_a_sync_that_fails_at_the_start_costs_nothing_of_what_was_found() {
    for failing in [vec![("sync", "event")], vec![("sync", "sample")], vec![("sync", "")]] {
        let (mut disk, stream) = used();
        disk.failing = failing.clone();
        let mut bench = Bench::new(disk, settings(), Now::default());
        assert_eq!(bench.store.report().state, State::Faulty, "{failing:?}");
        assert_eq!(bench.store.report().records, [5, 5], "{failing:?}");
        bench.numbers = [5, 5];
        bench.append(Class::Event, 1);
        bench.append(Class::Sample, 1);
        bench.store.disk_mut().failing.clear();
        bench.wait(RETRY_INTERVAL);
        assert_eq!(bench.store.report().state, State::Good, "{failing:?}");
        let mut next = Bench::new(bench.store.disk_mut().after_kill(), settings(), Now::default());
        for bench in [&mut bench, &mut next] {
            let [events, samples] = bench.drain(true);
            assert_eq!((numbers(&events), numbers(&samples)), ((1..=6).collect(), (1..=6).collect()));
            assert!(events[..5].iter().all(|item| item.stream == stream && item.lost_before == 0));
            assert_ne!(events[5].stream, stream, "only memory held it");
        }
    }
}

/// A disk that fails, comes back for a part of what is tried, and whose process is killed later: the names of the events that
/// were told, and what the next start calls new ones.
fn half_back(failing: &[(&'static str, &'static str)]) -> (Vec<(Uuid, u64)>, (Uuid, u64)) {
    let (disk, _) = used();
    let mut bench = Bench::new(disk, settings(), Now::default());
    bench.numbers = [5, 5];
    bench.store.disk_mut().fault = Some(DiskError::Failed("I/O error".into()));
    bench.append(Class::Event, 5);
    bench.append(Class::Sample, 5);
    bench.store.disk_mut().fault = None;
    bench.store.disk_mut().failing = failing.to_vec();
    bench.wait(RETRY_INTERVAL);
    assert_eq!(bench.store.report().state, State::Faulty, "{failing:?}");
    bench.append(Class::Event, 3);
    let told = names(&bench.drain(false)[0]);
    assert_eq!(told.len(), 13, "{failing:?}");
    let next = Bench::new(bench.store.disk_mut().after_kill(), settings(), Now::default());
    (told, next.store.stream())
}

#[test]
fn p4_no_number_is_used_twice_where_a_disk_came_back_for_a_part_only() {
    for failing in [
        &[("append", "sample")][..],
        &[("create", "sample")],
        &[("append", "event")],
        &[("sync", "event")],
        &[("sync", "event"), ("remove", "event")],
        &[("sync", "sample"), ("remove", "")],
    ] {
        let (told, (stream, newest)) = half_back(failing);
        let next = (stream, newest + 1);
        assert!(!told.contains(&next), "{failing:?}: {next:?} was told before");
        assert!(!told.iter().any(|told| told.0 == stream && told.1 > newest), "{failing:?}");
    }
}

#[test]
fn each_class_that_cannot_be_read_is_given_up_after_three_tries_of_its_own() {
    let mut bench = Bench::new(ModelDisk::default(), settings(), Now::default());
    bench.append(Class::Event, 5);
    bench.append(Class::Sample, 100);
    bench.store.disk_mut().failing = vec![("read", "event")];
    let want = [ALL[0], Want { records: 5, ..ALL[1] }];
    for tried in 1..=3 {
        assert_eq!(bench.store.report().damaged, [0, 0], "try {tried}");
        let samples = &bench.turn(Turn { want, ..Turn::default() }).items[1];
        assert_eq!(samples.len(), 5, "they can be read");
        bench.now = bench.now.later(RETRY_INTERVAL);
    }
    assert_eq!(bench.store.report().damaged, [5, 0], "what comes after them is not held up for ever");
}
