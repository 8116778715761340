//! Files of the store that are damaged in every way while nobody looks (promise P12).

use proptest::prelude::*;

use super::super::record::{HEAD, OVERHEAD, Piece};
use super::*;

/// What can happen to files that nobody writes.
#[derive(Clone, Debug)]
enum Damage {
    Flip { file: usize, bit: usize },
    Truncate { file: usize, to: usize },
    Zero { file: usize, page: usize },
    Garbage { file: usize, at: usize, bytes: Vec<u8> },
    Swap { one: usize, other: usize },
    Copy { from: usize, to: usize },
    Remove { file: usize },
    Move { file: usize, from: usize, to: usize, length: usize },
}

fn damage() -> impl Strategy<Value = Damage> {
    let n = || any::<proptest::sample::Index>().prop_map(|index| index.index(1 << 30));
    prop_oneof![
        4 => (n(), n()).prop_map(|(file, bit)| Damage::Flip { file, bit }),
        2 => (n(), n()).prop_map(|(file, to)| Damage::Truncate { file, to }),
        2 => (n(), n()).prop_map(|(file, page)| Damage::Zero { file, page }),
        2 => (n(), n(), proptest::collection::vec(any::<u8>(), 1..200))
            .prop_map(|(file, at, bytes)| Damage::Garbage { file, at, bytes }),
        1 => (n(), n()).prop_map(|(one, other)| Damage::Swap { one, other }),
        1 => (n(), n()).prop_map(|(from, to)| Damage::Copy { from, to }),
        1 => n().prop_map(|file| Damage::Remove { file }),
        1 => (n(), n(), n(), n()).prop_map(|(file, from, to, length)| Damage::Move { file, from, to, length }),
    ]
}

fn do_damage(disk: &mut ModelDisk, damage: &Damage) {
    let names: Vec<String> = disk.files.keys().cloned().collect();
    if names.is_empty() {
        return;
    }
    let name = |place: usize| names[place % names.len()].clone();
    let mut change = |place: usize, change: &dyn Fn(&mut Vec<u8>)| {
        let bytes = &mut disk.files.get_mut(&name(place)).unwrap().bytes;
        if !bytes.is_empty() {
            change(bytes);
        }
    };
    match damage {
        Damage::Flip { file, bit } => change(*file, &|bytes| {
            let bit = bit % (bytes.len() * 8);
            bytes[bit / 8] ^= 1 << (bit % 8);
        }),
        Damage::Truncate { file, to } => change(*file, &|bytes| bytes.truncate(to % bytes.len())),
        Damage::Zero { file, page } => change(*file, &|bytes| {
            let start = page % bytes.len() / 512 * 512;
            bytes.iter_mut().skip(start).take(512).for_each(|byte| *byte = 0);
        }),
        Damage::Garbage { file, at, bytes: garbage } => change(*file, &|bytes| {
            let at = at % bytes.len();
            bytes.splice(at..at, garbage.iter().copied());
        }),
        Damage::Move { file, from, to, length } => change(*file, &|bytes| {
            let (from, to) = (from % bytes.len(), to % bytes.len());
            let part: Vec<u8> = bytes[from..].iter().take(length % 2000).copied().collect();
            bytes.iter_mut().skip(to).zip(part).for_each(|(byte, new)| *byte = new);
        }),
        Damage::Swap { one, other } => {
            let (one, other) = (name(*one), name(*other));
            let (first, second) = (disk.files[&one].clone(), disk.files[&other].clone());
            disk.files.insert(one, second);
            disk.files.insert(other, first);
        }
        Damage::Copy { from, to } => {
            let file = disk.files[&name(*from)].clone();
            disk.files.insert(name(*to), file);
        }
        Damage::Remove { file } => {
            disk.files.remove(&name(*file));
        }
    }
}

/// A disk with several segments of both classes, of which some is acknowledged.
fn worn_disk() -> (ModelDisk, Uuid) {
    let settings = settings();
    let mut bench = Bench::new(ModelDisk::default(), settings, Now::default());
    for _ in 0..30 {
        bench.append(Class::Event, 6);
        bench.append(Class::Sample, 5);
    }
    let acknowledged = (1..=20).map(|position| (Class::Event, position)).collect();
    bench.turn(Turn { acknowledged, want: ALL, ..Turn::default() });
    let acknowledged = (1..=20).map(|position| (Class::Event, position)).collect();
    bench.turn(Turn { acknowledged, ..Turn::default() });
    bench.wait(Duration::from_secs(20));
    let stream = bench.store.stream().0;
    let disk = bench.store.disk_mut().after_kill();
    assert!(disk.files.len() >= 4, "{:?}", disk.files.keys());
    (disk, stream)
}

proptest! {
    // Two of them in the mean: ten thousand.
    #![proptest_config(ProptestConfig { cases: 5_000, ..ProptestConfig::default() })]

    #[test]
    fn p12_no_damage_stops_the_start_or_gives_a_wrong_payload_and_what_is_lost_is_told(
        damages in proptest::collection::vec(damage(), 1..4),
    ) {
        static WORN: std::sync::OnceLock<(ModelDisk, Uuid)> = std::sync::OnceLock::new();
        let (disk, stream) = WORN.get_or_init(worn_disk);
        let mut disk = disk.clone();
        for damage in &damages {
            do_damage(&mut disk, damage);
        }
        let mut bench = Bench::new(disk, settings(), Now::default());
        prop_assert_eq!(bench.store.report().state, State::Good);
        let (new, newest) = bench.store.stream();
        // A file that is cut exactly between two records looks as if nothing had come after.
        let may_look_whole = damages.iter().any(|damage| matches!(damage, Damage::Truncate { .. }));
        prop_assert!(new != *stream || newest == 180 || may_look_whole, "a number is used twice: {}", newest);
        bench.numbers = [newest, 1000];
        bench.append(Class::Event, 1);
        bench.append(Class::Sample, 1);
        let found = bench.drain(true);
        for class in Class::ALL {
            let items = &found[class.place()];
            prop_assert!(items.iter().all(|item| item.body == text(class, item.number)));
            prop_assert!(items.windows(2).all(|pair| pair[0].position < pair[1].position));
            let old: Vec<u64> = items.iter().filter(|item| item.stream == *stream).map(|item| item.number).collect();
            prop_assert!(old.windows(2).all(|pair| pair[0] < pair[1]), "in order");
            // Whatever is missing between two that came was told.
            for pair in items.windows(2) {
                prop_assert_eq!(pair[1].position, pair[0].position + 1 + pair[1].lost_before);
            }
            prop_assert!(items.last().is_some_and(|last| last.number == bench.numbers[class.place()]), "new records come");
        }
        let report = bench.store.report();
        prop_assert_eq!((report.records, report.state), ([0, 0], State::Good));
    }
}

#[test]
fn p12_newest_records_under_a_copy_of_older_ones_do_not_make_a_file_look_whole() {
    // Five records of one length; nothing else is in the file.
    let mut bench = Bench::new(ModelDisk::default(), settings(), Now::default());
    let body = |number: u64| Arc::from(format!("body {number}"));
    let append = (1..=5).map(|number| Entry { class: Class::Event, number, body: body(number) }).collect();
    bench.turn(Turn { append, ..Turn::default() });
    let (stream, _) = bench.store.stream();
    let whole = bench.store.disk_mut().after_kill();
    assert_eq!(Bench::new(whole.clone(), settings(), Now::default()).store.stream(), (stream, 5));
    let (head, record) = (HEAD, OVERHEAD + 6);
    let name = whole.files.keys().find(|name| name.starts_with("event")).unwrap();
    // Records from the first place are copied over those from the second on.
    for (from, to) in [(1, 5), (2, 4), (4, 5), (1, 4)] {
        let mut disk = whole.clone();
        let bytes = &mut disk.files.get_mut(name).unwrap().bytes;
        assert_eq!(bytes.len(), head + 5 * record);
        bytes.copy_within(
            head + (from - 1) * record..head + (from + 5 - to) * record,
            head + (to - 1) * record,
        );
        let mut bench = Bench::new(disk, settings(), Now::default());
        assert_ne!(bench.store.stream().0, stream, "{from} over {to}: numbers of lost events are used again");
        let [events, _] = bench.drain(true);
        assert_eq!(numbers(&events), (1..u64::try_from(to).unwrap()).collect::<Vec<_>>(), "{from} over {to}");
    }
    // Before the newest record nothing can have been newer.
    let mut disk = whole.clone();
    disk.files.get_mut(name).unwrap().bytes[head + 2 * record] ^= 1;
    assert_eq!(Bench::new(disk, settings(), Now::default()).store.stream(), (stream, 5));
    // A record that cannot be read behind it, and something after that: it may have been one.
    let mut disk = whole.clone();
    let bytes = &mut disk.files.get_mut(name).unwrap().bytes;
    bytes[head + 4 * record] ^= 1;
    Piece::Marked { acked: 1, dropped: 0 }.write(Class::Event, bytes);
    assert_ne!(Bench::new(disk, settings(), Now::default()).store.stream().0, stream);
}

#[test]
fn p12_one_flipped_bit_costs_one_record() {
    let (disk, _) = worn_disk();
    let whole = Bench::new(disk.clone(), settings(), Now::default()).drain(true);
    let name = disk.files.keys().next().unwrap().clone();
    let bits = disk.files[&name].bytes.len() * 8;
    for bit in (0..bits).step_by(4099) {
        let mut disk = disk.clone();
        do_damage(&mut disk, &Damage::Flip { file: 0, bit });
        let mut bench = Bench::new(disk, settings(), Now::default());
        let [events, samples] = bench.drain(true);
        assert!(events.len() + 1 >= whole[0].len(), "bit {bit}: {} of {}", events.len(), whole[0].len());
        assert_eq!(samples.len(), whole[1].len());
        let lost: u64 = events.iter().map(|item| item.lost_before).sum();
        assert_eq!(lost + length(events.len()), length(whole[0].len()));
        assert_eq!(bench.store.report().damaged[0], lost);
    }
}
