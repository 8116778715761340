//! The client against a server on a bad bus: frames get lost, come twice and come late, but in their order. Whatever
//! happens, a transfer ends in bounded time, and says success only if it is one.

use std::collections::{BTreeMap, VecDeque};
use std::time::Duration;

use proptest::prelude::*;

use super::*;

type Payload = [u8; 8];

/// The same for the same seed.
struct Random(u64);

impl Random {
    fn below(&mut self, bound: u64) -> u64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mixed = (self.0 ^ (self.0 >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        let mixed = (mixed ^ (mixed >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        (mixed ^ (mixed >> 31)) % bound
    }

    fn chance(&mut self, per_cent: u64) -> bool {
        self.below(100) < per_cent
    }

    fn bytes(&mut self, len: u64) -> Vec<u8> {
        (0..len).map(|_| u8::try_from(self.below(256)).unwrap()).collect()
    }
}

/// What goes wrong.
#[derive(Clone, Copy, Debug)]
struct Faults {
    /// Of 100 frames.
    lost: u64,
    /// Of 100 frames.
    twice: u64,
    /// Each way, in milliseconds.
    latest: u64,
}

/// How much later a copy comes, in milliseconds. Copies travel together: so do the answers to a request and its copy.
const COPY: u64 = 10;

/// One way of the bus: in order.
#[derive(Default)]
struct Way {
    frames: VecDeque<(u64, Payload, u64)>,
    last: u64,
}

impl Way {
    /// `onward`: how long the answer to this frame will take.
    fn send(
        &mut self,
        random: &mut Random,
        faults: Faults,
        now: u64,
        delay: u64,
        payload: Payload,
        onward: u64,
    ) {
        let copies = [!random.chance(faults.lost), random.chance(faults.twice)];
        for (copy, _) in copies.into_iter().enumerate().filter(|(_, sent)| *sent) {
            let lag = if copy == 0 { 0 } else { random.below(COPY) };
            self.last = self.last.max(now + delay + lag);
            self.frames.push_back((self.last, payload, onward));
        }
    }

    fn due(&self) -> u64 {
        self.frames.front().map_or(u64::MAX, |frame| frame.0)
    }
}

struct Bench {
    now: u64,
    random: Random,
    faults: Faults,
    client: SdoClient,
    server: Server,
    to_server: Way,
    to_client: Way,
    /// In 100 steps another client sends something so often.
    foreign: u64,
    /// Every value that an object had, and from when on.
    history: BTreeMap<ObjectId, Vec<(u64, Vec<u8>)>>,
}

impl Bench {
    fn new(seed: u64, faults: Faults, settings: SdoSettings, abilities: Abilities) -> Self {
        Self {
            now: 0,
            random: Random(seed),
            faults,
            client: SdoClient::new(NodeId::new(1).unwrap(), settings),
            server: Server::default().able(abilities),
            to_server: Way::default(),
            to_client: Way::default(),
            foreign: 0,
            history: BTreeMap::new(),
        }
    }

    fn set(&mut self, object: ObjectId, value: Vec<u8>) {
        self.server.objects.insert(object, value.clone());
        self.history.entry(object).or_default().push((self.now, value));
    }

    /// Until the transfer is over; gives its result.
    fn run(&mut self, request: SdoRequest) -> Result<Vec<u8>, SdoError> {
        self.client.request(Instant::from_millis(self.now), TransferId(0), request).unwrap();
        let started = self.now;
        loop {
            while let Some(output) = self.client.poll_output() {
                match output {
                    SdoOutput::Done(_, result) => return result,
                    SdoOutput::Transmit(frame) => {
                        let payload = frame.data().try_into().unwrap();
                        let latest = self.faults.latest + 1;
                        let (delay, onward) = (self.random.below(latest), self.random.below(latest));
                        self.to_server.send(&mut self.random, self.faults, self.now, delay, payload, onward);
                    }
                }
            }
            self.step();
            assert!(self.now - started < 150_000, "no end");
        }
    }

    /// Nothing is asked for some time.
    fn rest(&mut self, millis: u64) {
        let end = self.now + millis;
        while self.to_server.due().min(self.to_client.due()) <= end {
            self.step();
        }
        self.now = self.now.max(end);
    }

    /// Another client of the same server, who reads what we read, and writes something else.
    fn foreign_request(&mut self) {
        let sub = u8::try_from(self.random.below(3)).unwrap();
        let requests = [
            [0x40, 0x00, 0x20, sub, 0, 0, 0, 0],
            [0x40, 0x01, 0x20, sub, 0, 0, 0, 0],
            [0x60, 0, 0, 0, 0, 0, 0, 0],
            [0x70, 0, 0, 0, 0, 0, 0, 0],
            [0x2F, 0x01, 0x20, sub, 7, 0, 0, 0],
            [0xA3, 0, 0, 0, 0, 0, 0, 0],
        ];
        let request = requests[usize::try_from(self.random.below(6)).unwrap()];
        let onward = self.random.below(self.faults.latest + 1);
        self.to_server.send(&mut self.random, self.faults, self.now, 0, request, onward);
    }

    /// The next thing that happens.
    fn step(&mut self) {
        if self.random.chance(self.foreign) {
            self.foreign_request();
        }
        let timeout = self.client.poll_timeout().map_or(u64::MAX, |(at, _)| at.as_micros().div_ceil(1000));
        let (request, answer) = (self.to_server.due(), self.to_client.due());
        self.now = self.now.max(timeout.min(request).min(answer));
        if request <= self.now {
            let (_, payload, delay) = self.to_server.frames.pop_front().unwrap();
            let written = self.server.writes.len();
            for answer in self.server.handle(payload) {
                self.to_client.send(&mut self.random, self.faults, self.now, delay, answer, 0);
            }
            for (object, value) in self.server.writes[written..].iter().cloned() {
                self.history.entry(object).or_default().push((self.now, value));
            }
        } else if answer <= self.now {
            let (_, payload, _) = self.to_client.frames.pop_front().unwrap();
            let frame = CanFrame::data_frame(CanId::Standard(0x581), &payload).unwrap();
            self.client.handle_answer(Instant::from_millis(self.now), &frame);
        } else {
            self.client.handle_timeout(Instant::from_millis(self.now));
        }
    }

    /// Whether the object had this value at some time since.
    fn had(&self, object: ObjectId, value: &[u8], since: u64) -> bool {
        let values = &self.history[&object];
        let ends = values.iter().skip(1).map(|next| next.0).chain([u64::MAX]);
        values.iter().zip(ends).any(|(each, end)| each.1 == value && end >= since)
    }

    /// Random transfers of a few objects; gives how many succeeded.
    fn transfers(&mut self, count: usize, sizes: &[u64]) -> usize {
        let objects: Vec<ObjectId> = (0..3).map(|sub| ObjectId::new(0x2000, sub)).collect();
        for object in &objects {
            self.set(*object, vec![0]);
        }
        let mut succeeded = 0;
        for _ in 0..count {
            let object = objects[usize::try_from(self.random.below(3)).unwrap()];
            let size = sizes[usize::try_from(self.random.below(sizes.len().try_into().unwrap())).unwrap()];
            let len = self.random.below(size + 1);
            let value = self.random.bytes(len);
            let started = self.now;
            if self.random.chance(50) {
                if self.random.chance(80) {
                    self.set(object, value);
                }
                match self.run(SdoRequest::read(object)) {
                    Ok(read) => {
                        assert!(self.had(object, &read, started), "{object}: wrong bytes read");
                        succeeded += 1;
                    }
                    Err(error) => self.check_error(&error),
                }
            } else {
                let request = SdoRequest::write(object, value.clone());
                let request = if self.random.chance(30) { request.repeatable() } else { request };
                let written = self.server.writes.len();
                match self.run(request) {
                    Ok(data) => {
                        let write = self.server.writes[written..].contains(&(object, value));
                        assert!(write && data.is_empty(), "{object}: a write that was none");
                        succeeded += 1;
                    }
                    Err(error) => self.check_error(&error),
                }
            }
            let pause = self.random.below(50);
            self.rest(pause);
        }
        succeeded
    }

    /// Only what follows from the faults of the bus.
    fn check_error(&self, error: &SdoError) {
        let disturbed = self.faults.lost + self.faults.twice + self.foreign > 0;
        let named = match error {
            SdoError::Timeout { .. }
            | SdoError::Abort(_)
            | SdoError::Protocol(_)
            | SdoError::TooSlow { .. } => true,
            SdoError::Interrupted => self.foreign > 0,
            SdoError::BusUnavailable | SdoError::TooLong { .. } => false,
        };
        assert!(disturbed && named, "{error}");
    }
}

fn settings(block: bool) -> SdoSettings {
    SdoSettings { block, ..SdoSettings::default() }
}

#[test]
fn ten_thousand_random_sizes_arrive_on_a_good_bus() {
    let none = Faults { lost: 0, twice: 0, latest: 2 };
    for (seed, block) in [(1, false), (2, true)] {
        let mut bench = Bench::new(seed, none, settings(block), Abilities::default());
        assert_eq!(bench.transfers(5000, &[4, 7, 30, 100, 1500]), 5000);
    }
}

#[test]
fn transfers_under_loss_duplication_and_delay_succeed_or_fail_by_name_in_bounded_time() {
    let abilities = [
        Abilities::default(),
        Abilities { sizes: false, ..Abilities::default() },
        Abilities { block: 7, ..Abilities::default() },
        Abilities { crc: false, ..Abilities::default() },
        Abilities { blocks: false, ..Abilities::default() },
    ];
    let mut total = 0;
    for (seed, abilities) in (0..).zip(abilities) {
        for (block, faults) in [
            (false, Faults { lost: 5, twice: 5, latest: 20 }),
            (true, Faults { lost: 5, twice: 5, latest: 20 }),
            (true, Faults { lost: 20, twice: 20, latest: 300 }),
            (false, Faults { lost: 5, twice: 5, latest: 450 }),
            (true, Faults { lost: 1, twice: 1, latest: 450 }),
        ] {
            let mut bench = Bench::new(seed, faults, settings(block), abilities);
            total += bench.transfers(400, &[4, 4, 40, 400]);
        }
    }
    assert!(total > 4000, "{total} of 10,000 succeeded");
}

#[test]
fn another_client_of_the_same_server_makes_transfers_fail_but_never_lie() {
    let faults = Faults { lost: 0, twice: 0, latest: 20 };
    for (seed, block) in [(11, false), (12, true)] {
        for foreign in [2, 20] {
            let mut bench = Bench::new(seed, faults, settings(block), Abilities::default());
            bench.foreign = foreign;
            for sub in 0..3 {
                bench.set(ObjectId::new(0x2001, sub), vec![3; 20]);
            }
            let ok = bench.transfers(1000, &[4, 4, 40, 400]);
            assert!(ok > 500, "{ok} of 1000");
        }
    }
}

#[test]
fn single_reads_under_5_per_cent_loss_nearly_all_succeed() {
    let faults = Faults { lost: 5, twice: 5, latest: 20 };
    let mut bench = Bench::new(9, faults, settings(false), Abilities::default());
    bench.set(ObjectId::new(0x1000, 0), vec![1, 2, 3, 4]);
    let ok = (0..1000).filter(|_| bench.run(SdoRequest::read(ObjectId::new(0x1000, 0))).is_ok()).count();
    assert!(ok > 990, "{ok} of 1000");
}

/// One thing that can happen to a client.
#[derive(Clone, Debug)]
enum Happening {
    Request(SdoRequest),
    Answer(Vec<u8>),
    /// An answer that fits the object.
    Fitting(u8, [u8; 4]),
    NotSent,
    Pause,
    Resume,
    Wait(u64),
}

fn happening() -> impl Strategy<Value = Happening> {
    let object = (0_u8..2).prop_map(|sub| ObjectId::new(0x1018, sub));
    let action = prop_oneof![
        Just(SdoAction::Read),
        prop::collection::vec(any::<u8>(), 0..60).prop_map(SdoAction::Write)
    ];
    let request =
        (object, action, any::<bool>(), any::<bool>()).prop_map(|(object, action, boot, repeatable)| {
            let request = SdoRequest { action, ..SdoRequest::read(object) };
            let request = SdoRequest { idempotent: repeatable, ..request };
            if boot { request.for_boot() } else { request }
        });
    let command = prop::sample::select(vec![
        0x43, 0x41, 0x40, 0x42, 0x60, 0x80, 0xA4, 0xC6, 0xC2, 0xA0, 0x00, 0x10, 0x01, 0x20, 0x30, 0xA1, 0xA2,
        0xC1,
    ]);
    prop_oneof![
        4 => request.prop_map(Happening::Request),
        4 => prop::collection::vec(any::<u8>(), 0..=8).prop_map(Happening::Answer),
        20 => (command, any::<[u8; 4]>()).prop_map(|(command, rest)| Happening::Fitting(command, rest)),
        1 => Just(Happening::NotSent),
        1 => Just(Happening::Pause),
        2 => Just(Happening::Resume),
        6 => (0_u64..700).prop_map(Happening::Wait),
    ]
}

proptest! {
    #[test]
    fn whatever_comes_every_request_gets_one_result_in_bounded_time(
        block in any::<bool>(),
        happenings in prop::collection::vec(happening(), 1..200),
    ) {
        let settings = SdoSettings { within: Duration::from_secs(5), longest: 100, ..settings(block) };
        let mut client = SdoClient::new(NodeId::new(1).unwrap(), settings);
        let (mut asked, mut done, mut now) = (0, Vec::new(), 0);
        let mut last = None;
        let mut drain = |client: &mut SdoClient, last: &mut Option<CanFrame>| {
            while let Some(output) = client.poll_output() {
                match output {
                    SdoOutput::Transmit(frame) => {
                        assert_eq!((frame.id(), frame.dlc()), (CanId::Standard(0x601), 8));
                        *last = Some(frame);
                    }
                    SdoOutput::Done(id, result) => {
                        assert!(result.is_err() || result.is_ok_and(|data| data.len() <= 100));
                        done.push(id);
                    }
                }
            }
        };
        for happening in happenings {
            let at = Instant::from_millis(now);
            match happening {
                Happening::Request(request) => {
                    if client.request(at, TransferId(asked), request).is_ok() {
                        asked += 1;
                    }
                }
                Happening::Answer(data) => {
                    let frame = CanFrame::data_frame(CanId::Standard(0x581), &data).unwrap();
                    client.handle_answer(at, &frame);
                }
                Happening::Fitting(command, rest) => {
                    let sub = last.map_or(0, |frame: CanFrame| frame.data()[3]);
                    let data = [command, 0x18, 0x10, sub, rest[0], rest[1], rest[2], rest[3]];
                    let frame = CanFrame::data_frame(CanId::Standard(0x581), &data).unwrap();
                    client.handle_answer(at, &frame);
                }
                Happening::NotSent => {
                    if let Some(frame) = last {
                        client.handle_not_sent(&frame);
                    }
                }
                Happening::Pause => client.pause(),
                Happening::Resume => client.resume(at),
                Happening::Wait(millis) => {
                    now += millis;
                    client.handle_timeout(Instant::from_millis(now));
                }
            }
            drain(&mut client, &mut last);
        }
        client.resume(Instant::from_millis(now));
        let end = now + 17 * 10_000;
        while let Some((at, _)) = client.poll_timeout() {
            now = now.max(at.as_micros().div_ceil(1000));
            prop_assert!(now < end, "no end");
            client.handle_timeout(Instant::from_millis(now));
            drain(&mut client, &mut last);
        }
        drain(&mut client, &mut last);
        prop_assert!(client.is_idle());
        done.sort_unstable();
        prop_assert_eq!(done, (0..asked).map(TransferId).collect::<Vec<_>>());
    }
}
