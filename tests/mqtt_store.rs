//! What is on disk for the broker: publisher and store on a real folder, in numbers instead of time.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;
use std::sync::Arc;

use cangate::mapping::TagTable;
use cangate::mqtt::outbox::MessageId;
use cangate::mqtt::{Identity, MqttSettings, Publisher};
use cangate::process_image::{Journal, ProcessImage, Revision, Value};
use cangate::store::{Files, Limits, State, Store, StoreSettings, Sync, Turn};
use cangate::time::Now;
use uuid::Uuid;

use crate::support::plant::{at, event, good, image, table};

/// All that a subscriber got, and what it may conclude.
#[derive(Default)]
struct Oracle {
    /// Payloads of events, by stream and number.
    events: BTreeMap<(String, u64), String>,
    /// First deliveries.
    order: Vec<u64>,
    /// Numbers that were told as lost.
    told_lost: u64,
    /// States, live or of the history, by run, node and number.
    samples: BTreeMap<(String, String), BTreeSet<u64>>,
    historical: u64,
    doubled: u64,
}

impl Oracle {
    fn see(&mut self, topic: &str, payload: &str) {
        let topic = topic.strip_prefix("cangate/hall-1/").unwrap();
        let Some((node, what)) = topic.split_once('/').or((topic == "event").then_some(("", "event"))) else {
            return;
        };
        let json: serde_json::Value = serde_json::from_str(payload).unwrap();
        let (sid, seq) = (json["sid"].as_str().unwrap_or_default().to_owned(), json["seq"].as_u64());
        match (what, seq) {
            ("event", Some(seq)) if json["name"] == "events_missed" => {
                self.told_lost += json["value"].as_u64().unwrap();
                self.order.push(seq);
            }
            ("event", Some(seq)) => match self.events.insert((sid, seq), payload.to_owned()) {
                Some(before) => {
                    assert_eq!(before, payload, "the same name, the same bytes");
                    self.doubled += 1;
                }
                None => self.order.push(seq),
            },
            ("state" | "history", Some(seq)) => {
                assert_eq!(json["historical"] == true, what == "history");
                self.historical += u64::from(what == "history");
                self.samples.entry((sid, node.to_owned())).or_default().insert(seq);
            }
            _ => {}
        }
    }

    /// Every event came, first deliveries in order.
    fn assert_events(&self, last: u64) {
        assert_eq!(self.order, (1..=last).collect::<Vec<_>>(), "in order and without a gap");
    }

    /// Of each node and run every state came, but for `end` at its end.
    fn assert_samples(&self, end: u64, made: &BTreeMap<(String, String), u64>) -> u64 {
        let mut lost = 0;
        for (key, numbers) in &self.samples {
            let newest = *numbers.last().unwrap();
            assert_eq!(*numbers, (1..=newest).collect(), "{key:?}: no gap");
            let made = made.get(key).copied().unwrap_or(newest);
            assert!(made - newest <= end, "{key:?}: {newest} of {made}");
            lost += made - newest;
        }
        lost
    }
}

/// One run of the process.
struct Life {
    publisher: Publisher,
    store: Store<Files>,
    image: ProcessImage,
    table: Arc<TagTable>,
    /// Since the start of the run.
    now: Now,
    in_flight: Vec<MessageId>,
}

impl Life {
    fn start(folder: &Path, settings: &MqttSettings, engines: u8, run: u64, now: Now) -> Self {
        let memory = Limits { records: settings.outbox_messages, bytes: settings.outbox_bytes };
        let store_settings = StoreSettings {
            bytes: settings.buffer_bytes,
            age: None,
            sync: settings.buffer_sync,
            memory,
            boot: Uuid::from_u128(1),
            fresh: Uuid::new_v4,
        };
        let mut store = Store::open(Files::new(folder), store_settings, now);
        let opened = store.turn(now, Turn::default());
        let newest = store.stream().1;
        let table = table(engines);
        let mut image = image(&table);
        image.journal = Journal::after_number(newest);
        let identity = Identity { sid: format!("run{run}"), started: now, ..Identity::default() };
        let mut publisher = Publisher::new(Arc::clone(&table), settings, identity);
        publisher.take_store(settings, &opened, newest);
        Self { publisher, store, image, table, now, in_flight: Vec::new() }
    }

    fn happen(&mut self) {
        let seq = self.image.journal.newest() + 1;
        self.image.revision = Revision(self.image.revision.0 + 1);
        self.image.journal.append(event(seq));
    }

    fn change(&mut self, node: usize, value: f64) {
        self.image.revision = Revision(self.image.revision.0 + 1);
        let tag = self.table.nodes[node].tags.start;
        self.image.tags[tag] = good(Value::Float(value));
    }

    /// Everything that is due now; what goes out is received, and acknowledged up to `acknowledge` messages.
    fn work(&mut self, oracle: &mut Oracle, acknowledge: usize) {
        let mut left = acknowledge;
        loop {
            self.publisher.handle_image(self.now, &self.image);
            let turn = self.publisher.poll_turn(self.now);
            let mut moved = turn.is_some();
            if let Some(turn) = turn {
                let done = self.store.turn(self.now, turn);
                self.publisher.handle_turn(done);
            }
            while let Some(out) = self.publisher.poll_output() {
                oracle.see(&out.message.topic, &out.message.payload);
                self.in_flight.push(out.id);
                moved = true;
            }
            for id in self.in_flight.drain(..left.min(self.in_flight.len())) {
                self.publisher.handle_acknowledged(id);
                left -= 1;
                moved = true;
            }
            if !moved && !self.publisher.has_more() {
                return;
            }
        }
    }

    fn connect(&mut self) {
        self.publisher.handle_session_up();
    }

    fn disconnect(&mut self) {
        self.in_flight.clear();
        self.publisher.handle_session_down();
    }
}

fn settings() -> MqttSettings {
    MqttSettings { buffer_bytes: 64 * 1024 * 1024, ..MqttSettings::default() }
}

#[test]
fn p1_p6_thirteen_days_without_a_broker_at_sixteen_nodes_lose_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let mut oracle = Oracle::default();
    let mut life = Life::start(folder.path(), &settings(), 16, 1, at(0));
    // A look every five minutes: in each, an event a minute and a state of every node.
    let day = 24 * 3600;
    for second in (0..13 * day).step_by(300) {
        life.now = at(second * 1000);
        (0..5).for_each(|_| life.happen());
        life.work(&mut oracle, 0);
    }
    let report = life.publisher.buffer_report(life.now).unwrap();
    assert_eq!((report.store.state, report.store.dropped), (State::Good, [0, 0]), "{report:?}");
    assert_eq!(report.store.records, [13 * 288 * 5, 13 * 288 * 16]);
    assert!(oracle.order.is_empty());
    // 64 MiB hold more than 13 days of this, and the forecast says how much.
    let hours = report.hours_left.unwrap();
    let used = 13.0 * 24.0;
    let thousandths = report.store.bytes_limit * 1000 / report.store.bytes;
    let truth = used * f64::from(u32::try_from(thousandths).unwrap()) / 1000.0 - used;
    assert!((hours / truth - 1.0).abs() < 0.05, "{hours} of {truth}");
    life.connect();
    let start = life.now;
    while life.publisher.buffer_report(life.now).unwrap().store.records != [0, 0] {
        life.now = life.now.later(std::time::Duration::from_millis(10));
        life.work(&mut oracle, usize::MAX);
    }
    let seconds = life.now.instant.since(start.instant).as_secs_f64();
    println!("13 days: {} events, {} states in {seconds} s", oracle.order.len(), oracle.historical);
    oracle.assert_events(13 * 288 * 5);
    assert_eq!(oracle.assert_samples(0, &BTreeMap::new()), 0);
    assert!(oracle.historical >= 13 * 288 * 16);
    // 2,000 a second, not more, and not much less.
    assert!((29.0..34.0).contains(&seconds), "{seconds}");
}

#[test]
fn p6_live_states_do_not_wait_for_the_history() {
    let folder = tempfile::tempdir().unwrap();
    let mut oracle = Oracle::default();
    let mut life = Life::start(folder.path(), &settings(), 2, 1, at(0));
    for second in 0..2000_u32 {
        life.now = at(u64::from(second) * 1000);
        life.change(0, second.into());
        life.work(&mut oracle, 0);
    }
    life.connect();
    life.work(&mut oracle, 100);
    // A slow broker: eight messages a step. What changes is told in the step in which it changes.
    for step in 0..100_u32 {
        life.now = at(2_000_000 + u64::from(step) * 1000);
        life.change(1, step.into());
        let before = life.publisher.report().acknowledged;
        let seen = oracle.samples[&("run1".to_owned(), "engine2".to_owned())].len();
        life.work(&mut oracle, 8);
        assert!(life.publisher.report().acknowledged > before);
        assert!(oracle.samples[&("run1".to_owned(), "engine2".to_owned())].len() > seen, "step {step}");
    }
    assert!(oracle.historical > 200, "{}", oracle.historical);
}

#[test]
fn p3_killed_at_300_random_moments_no_event_is_lost_and_no_state_but_those_in_memory() {
    let folder = tempfile::tempdir().unwrap();
    let mut random = fastrand::Rng::with_seed(5);
    let mut oracle = Oracle::default();
    let mut made: BTreeMap<(String, String), u64> = BTreeMap::new();
    let (mut now, mut last) = (at(0), 0);
    for run in 0..300 {
        let mut life = Life::start(folder.path(), &settings(), 2, run, now);
        assert_eq!(life.image.journal.newest(), last, "numbers go on");
        let mut connected = false;
        for _ in 0..random.usize(1..40) {
            match random.u8(0..10) {
                0 => {
                    if connected {
                        life.disconnect();
                    } else {
                        life.connect();
                    }
                    connected = !connected;
                }
                1..=4 => life.happen(),
                5..=7 => life.change(random.usize(0..2), random.f64() * 100.0),
                _ => life.now = life.now.later(std::time::Duration::from_millis(random.u64(0..3000))),
            }
            // The link may swallow everything for a while.
            let acknowledge = if random.bool() { random.usize(0..30) } else { 0 };
            life.work(&mut oracle, acknowledge);
        }
        last = life.image.journal.newest();
        now = life.now;
        for (place, sent) in life.publisher.states_made().enumerate() {
            made.insert((format!("run{run}"), format!("engine{}", place + 1)), sent);
        }
        // SIGKILL: nobody says goodbye, no file is closed.
    }
    let mut life = Life::start(folder.path(), &settings(), 2, 1000, now);
    life.connect();
    for _ in 0..100 {
        life.now = life.now.later(std::time::Duration::from_millis(100));
        life.work(&mut oracle, usize::MAX);
    }
    oracle.assert_events(last);
    assert_eq!(oracle.told_lost, 0);
    assert_eq!(oracle.events.keys().map(|(sid, _)| sid).collect::<BTreeSet<_>>().len(), 1, "one stream");
    // Within a run at most what was made in its last second, at two a second, and the birth.
    let gone = oracle.assert_samples(4, &made);
    println!("300 kills: {last} events, {} twice, {gone} states of the last second", oracle.doubled);
}

#[test]
fn p10_a_folder_that_cannot_be_used_is_told_and_taken_when_it_can() {
    let folder = tempfile::tempdir().unwrap();
    let place = folder.path().join("buffer");
    std::fs::write(&place, "this is no folder").unwrap();
    let mut oracle = Oracle::default();
    let mut life = Life::start(&place, &settings(), 2, 1, at(0));
    let state = |life: &Life| life.publisher.buffer_report(life.now).unwrap().store;
    assert_eq!(state(&life).state, State::Faulty);
    assert!(state(&life).reason.contains("buffer"), "{}", state(&life).reason);
    life.connect();
    life.happen();
    life.work(&mut oracle, usize::MAX);
    oracle.assert_events(1);
    life.disconnect();
    life.happen();
    life.work(&mut oracle, 0);
    std::fs::remove_file(&place).unwrap();
    life.now = at(6000);
    life.work(&mut oracle, 0);
    assert_eq!((state(&life).state, state(&life).dropped), (State::Good, [0, 0]));
    drop(life);
    let mut life = Life::start(&place, &settings(), 2, 2, at(10_000));
    life.connect();
    life.work(&mut oracle, usize::MAX);
    oracle.assert_events(2);
}

#[test]
fn p11_when_the_room_is_used_up_states_leave_first_and_every_drop_is_told() {
    let folder = tempfile::tempdir().unwrap();
    let settings = MqttSettings { buffer_bytes: 1024 * 1024, ..settings() };
    let mut oracle = Oracle::default();
    let mut life = Life::start(folder.path(), &settings, 8, 1, at(0));
    for second in 0..1500_u32 {
        life.now = at(u64::from(second) * 1000);
        life.happen();
        (0..8).for_each(|node| life.change(node, second.into()));
        life.work(&mut oracle, 0);
    }
    let store = life.publisher.buffer_report(life.now).unwrap().store;
    assert!(store.filling && store.bytes <= 1024 * 1024 && store.dropped[1] > 0, "{store:?}");
    assert_eq!(store.dropped[0], 0);
    let made: u64 = life.publisher.states_made().sum();
    assert_eq!(store.records[1] + store.dropped[1], made, "exact");
    life.connect();
    for _ in 0..300 {
        life.now = life.now.later(std::time::Duration::from_millis(100));
        life.work(&mut oracle, usize::MAX);
    }
    oracle.assert_events(1500);
    let made: u64 = life.publisher.states_made().sum();
    let came: usize = oracle.samples.values().map(BTreeSet::len).sum();
    assert_eq!(came as u64 + store.dropped[1], made);
    // Events alone, and too many.
    life.disconnect();
    for _ in 0..60 {
        for _ in 0..100 {
            life.happen();
        }
        life.work(&mut oracle, 0);
    }
    let dropped = life.publisher.buffer_report(life.now).unwrap().store.dropped[0];
    assert!(dropped > 0);
    life.connect();
    for _ in 0..300 {
        life.now = life.now.later(std::time::Duration::from_millis(100));
        life.work(&mut oracle, usize::MAX);
    }
    assert_eq!(oracle.told_lost, dropped, "in the place of those that are gone stands how many they are");
    assert_eq!(oracle.events.len() as u64 + dropped, 7500);
}

#[test]
fn a_state_that_waits_for_its_acknowledgement_is_on_disk_after_a_second_and_comes_once() {
    let folder = tempfile::tempdir().unwrap();
    let mut oracle = Oracle::default();
    let mut life = Life::start(folder.path(), &settings(), 2, 1, at(0));
    life.connect();
    life.work(&mut oracle, 0);
    let waiting = |life: &Life| life.publisher.buffer_report(life.now).unwrap().store.records[1];
    assert_eq!(waiting(&life), 0);
    assert!(life.publisher.poll_timeout().unwrap() <= at(1000).instant);
    life.now = at(1000);
    life.work(&mut oracle, 0);
    assert_eq!(waiting(&life), 2, "both");
    // The broker has them after all: they do not come again.
    life.work(&mut oracle, usize::MAX);
    life.now = at(1500);
    life.work(&mut oracle, usize::MAX);
    assert_eq!((waiting(&life), oracle.historical), (0, 0));
    // The next ones it never acknowledges: they come again, as history.
    life.change(0, 50.0);
    life.now = at(3000);
    life.work(&mut oracle, 0);
    life.now = at(5000);
    life.work(&mut oracle, 0);
    assert_eq!(waiting(&life), 1);
    life.disconnect();
    life.connect();
    life.now = at(6000);
    life.work(&mut oracle, usize::MAX);
    assert_eq!((waiting(&life), oracle.historical), (0, 1));
    assert_eq!(oracle.assert_samples(0, &BTreeMap::new()), 0);
}

#[test]
fn strict_makes_sure_of_an_event_before_it_is_offered() {
    let folder = tempfile::tempdir().unwrap();
    let settings = MqttSettings { buffer_sync: Sync::Strict, ..settings() };
    let mut oracle = Oracle::default();
    let mut life = Life::start(folder.path(), &settings, 2, 1, at(0));
    life.connect();
    life.work(&mut oracle, usize::MAX);
    let syncs = |life: &Life| life.publisher.buffer_report(life.now).unwrap().store.syncs;
    let before = syncs(&life);
    life.happen();
    life.work(&mut oracle, 0);
    assert_eq!((oracle.order.len(), syncs(&life)), (1, before + 1));
}
