//! A gateway and simulated devices on one bus, in numbers-time: no socket, no task, no clock.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::Duration;

use cangate::can::{BusEvent, BusIndex, CanFrame, Link};
use cangate::canopen::NodeId;
use cangate::gateway::kept::Kept;
use cangate::gateway::{Action, Command, CommandSource, Gateway, Input, Outcome, Output};
use cangate::mapping::{Sketch, Source, TagTable};
use cangate::process_image::{NodeIndex, NodeStatus, ProcessImage, Quality, Sample};
use cangate::simulator::random::Random;
use cangate::simulator::{Device, DevicePlan, Kind, Order, Scenario};
use cangate::time::{Instant, Now, Timestamp};

const BUS: BusIndex = BusIndex(0);

/// An installation of `count` devices on one bus: `node001` with node id 1, and so on.
pub fn installation(count: u8) -> Arc<TagTable> {
    let sketch = (1..=count).fold(Sketch::new(), |sketch, id| {
        sketch.node(&format!("node{id:03}"), id, "motortech-detcon", |_| ())
    });
    Arc::new(sketch.build().unwrap().0)
}

/// What the bus does to frames. The default is a good bus: each frame arrives once, 200 us later.
#[derive(Clone, Copy, Debug)]
pub struct Weather {
    /// Of 1000 frames, so many do not arrive.
    pub lost: i32,
    /// Of 1000 frames, so many arrive twice.
    pub doubled: i32,
    /// A frame takes up to so long; the order is kept, as on a bus.
    pub longest_delay: Duration,
}

impl Default for Weather {
    fn default() -> Self {
        Self { lost: 0, doubled: 0, longest_delay: Duration::from_micros(200) }
    }
}

/// Who sent a frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Sender {
    Gateway,
    Device(usize),
    Stranger,
}

/// The bus, who is on it, and the time.
pub struct World {
    pub table: Arc<TagTable>,
    pub image: ProcessImage,
    pub weather: Weather,
    gateway: Option<Gateway>,
    devices: Vec<Box<dyn Device>>,
    in_flight: BTreeMap<(Instant, u64), (Sender, CanFrame)>,
    sequence: u64,
    last_arrival: Instant,
    random: Random,
    now: Instant,
    /// What the gateway sent, without repetitions.
    pub sent: BTreeSet<String>,
    /// Everything that was sent on the bus in its order, by whom ever, once a test asks for it with `Some`.
    pub log: Option<Vec<String>>,
    /// Names of all alarms that an operator was called by, whether they still hold or not.
    pub raised: BTreeSet<String>,
    /// The last event that was looked at.
    cursor: u64,
    /// What came of commands, by their numbers.
    replies: BTreeMap<u64, Outcome>,
    commands: u64,
}

impl World {
    /// An empty bus for `count` devices, at 0 s. `seed` chooses the weather's luck.
    pub fn new(count: u8, seed: u64) -> Self {
        Self::with(installation(count), seed)
    }

    /// The same for any installation.
    pub fn with(table: Arc<TagTable>, seed: u64) -> Self {
        Self {
            table,
            image: ProcessImage::default(),
            weather: Weather::default(),
            gateway: None,
            devices: Vec::new(),
            in_flight: BTreeMap::new(),
            sequence: 0,
            last_arrival: Instant::START,
            random: Random::new(seed),
            now: Instant::START,
            sent: BTreeSet::new(),
            log: None,
            raised: BTreeSet::new(),
            cursor: 0,
            replies: BTreeMap::new(),
            commands: 0,
        }
    }

    /// A gateway and `count` healthy devices that have run for 5 s.
    pub fn running(count: u8) -> Self {
        let mut world = Self::new(count, 1);
        world.start_gateway();
        for id in 1..=count {
            world.power_on(id, "quiet");
        }
        world.run_for(5000);
        world
    }

    pub fn now(&self) -> Now {
        let micros = i64::try_from(self.now.as_micros()).unwrap();
        Now { instant: self.now, utc: Timestamp::from_micros(micros) }
    }

    /// Milliseconds since the begin.
    pub fn millis(&self) -> u64 {
        self.now.as_millis()
    }

    /// The gateway starts now, on a bus that is up.
    pub fn start_gateway(&mut self) {
        let mut gateway = Gateway::new(Arc::clone(&self.table), self.now());
        self.image = gateway.empty_image();
        self.cursor = 0;
        let event = BusEvent::Link { link: Link::ErrorActive, at: self.now() };
        gateway.handle_input(self.now(), Input::Bus { bus: BUS, event });
        self.gateway = Some(gateway);
        self.settle();
    }

    /// The gateway stops in order; what it says last leaves.
    pub fn stop_gateway(&mut self) {
        let now = self.now();
        self.gateway.as_mut().expect("a gateway").handle_stop(now);
        self.settle();
        self.gateway = None;
    }

    /// The gateway is gone from one moment to the next.
    pub fn crash_gateway(&mut self) {
        self.gateway = None;
    }

    /// The gateway goes on with another table; its interfaces stay.
    pub fn exchange(&mut self, table: Arc<TagTable>) {
        let kept = Kept::new(&self.table, &table, |_, _| true);
        let now = self.now();
        self.gateway.as_mut().expect("a gateway").prepare_exchange(now, &table, &kept);
        self.settle();
        let old = self.gateway.take().expect("a gateway");
        let (gateway, image) = old.exchange(Arc::clone(&table), &kept, now, &self.image);
        (self.gateway, self.image, self.table) = (Some(gateway), image, table);
        self.settle();
    }

    /// A `DetCon` is connected and powered on now, with a shipped scenario.
    pub fn power_on(&mut self, id: u8, scenario: &str) {
        let scenario = Scenario::shipped(Kind::Detcon, scenario).unwrap();
        self.connect(&DevicePlan::new(NodeId::new(id).unwrap(), scenario));
    }

    /// A device of any kind is connected and powered on now.
    pub fn connect(&mut self, plan: &DevicePlan) {
        self.devices.push(plan.power_on(self.now()));
        self.settle();
    }

    /// An order to one device (`node 2 power off`) or to all.
    #[track_caller]
    pub fn order(&mut self, line: &str) {
        let order: Order = line.parse().unwrap();
        let now = self.now();
        for device in &mut self.devices {
            if order.node.is_none_or(|node| node == device.node()) {
                device.handle_line(now, &order.words()).unwrap();
            }
        }
        self.settle();
    }

    /// Somebody else sends a frame now, to everybody.
    pub fn say(&mut self, frame: &str) {
        let (now, frame) = (self.now(), frame.parse().unwrap());
        self.deliver(now, Sender::Stranger, frame);
        self.settle();
    }

    /// Lets time pass.
    pub fn run_for(&mut self, millis: u64) {
        let end = self.now + Duration::from_millis(millis);
        while let Some(next) = self.next_due().filter(|next| *next <= end) {
            self.now = next.max(self.now);
            self.step();
        }
        self.now = end;
    }

    /// Lets time pass until something holds, and gives how many milliseconds that took.
    #[track_caller]
    pub fn run_until(&mut self, at_most: u64, holds: impl Fn(&Self) -> bool) -> u64 {
        let (start, end) = (self.millis(), self.now + Duration::from_millis(at_most));
        while !holds(self) {
            let next = self.next_due().filter(|next| *next <= end);
            let Some(next) = next else {
                panic!("did not happen within {at_most} ms; active: {:?}", self.active_alarms());
            };
            self.now = next.max(self.now);
            self.step();
        }
        self.millis() - start
    }

    fn next_due(&self) -> Option<Instant> {
        let devices = self.devices.iter().filter_map(|device| device.poll_timeout());
        let gateway = self.gateway.iter().filter_map(|gateway| Some(gateway.poll_timeout()?.0));
        devices.chain(gateway).chain(self.in_flight.keys().next().map(|(due, _)| *due)).min()
    }

    fn step(&mut self) {
        let now = self.now();
        while let Some(entry) = self.in_flight.first_entry().filter(|entry| entry.key().0 <= now.instant) {
            let (sender, frame) = entry.remove();
            self.deliver(now, sender, frame);
        }
        for device in &mut self.devices {
            if device.poll_timeout().is_some_and(|due| due <= now.instant) {
                device.handle_timeout(now);
            }
        }
        if let Some(gateway) = &mut self.gateway
            && gateway.poll_timeout().is_some_and(|(due, _)| due <= now.instant)
        {
            gateway.handle_timeout(now);
        }
        self.settle();
    }

    /// A frame in candump notation comes to the gateway now, from nobody who is simulated.
    pub fn overhear(&mut self, frame: &str) {
        let event = BusEvent::Frame { frame: frame.parse().unwrap(), at: self.now() };
        let now = self.now();
        self.gateway.as_mut().unwrap().handle_input(now, Input::Bus { bus: BUS, event });
        self.settle();
    }

    /// Everybody but the sender sees a frame.
    fn deliver(&mut self, now: Now, sender: Sender, frame: CanFrame) {
        for (place, device) in self.devices.iter_mut().enumerate() {
            if sender != Sender::Device(place) && device.hears(frame.id()) {
                device.handle_frame(now, &frame);
            }
        }
        if let (Some(gateway), Sender::Device(_) | Sender::Stranger) = (&mut self.gateway, sender) {
            let event = BusEvent::Frame { frame, at: now };
            gateway.handle_input(now, Input::Bus { bus: BUS, event });
            // Frames are worked off one by one, as the task does.
            self.settle_gateway();
        }
    }

    fn settle(&mut self) {
        self.settle_gateway();
        for place in 0..self.devices.len() {
            while let Some(frame) = self.devices[place].poll_output() {
                self.send(Sender::Device(place), frame);
            }
        }
    }

    fn settle_gateway(&mut self) {
        let Some(mut gateway) = self.gateway.take() else { return };
        while let Some(output) = gateway.poll_output() {
            match output {
                Output::Transmit { frame, .. } => {
                    self.sent.insert(frame.to_string());
                    self.send(Sender::Gateway, frame);
                    let at = self.now();
                    gateway.handle_input(at, Input::Bus { bus: BUS, event: BusEvent::Sent { frame, at } });
                }
                Output::Reply { id, outcome } => {
                    assert!(self.replies.insert(id, outcome).is_none(), "one answer to each request");
                }
            }
        }
        gateway.publish(&mut self.image);
        assert!(self.image.buses.iter().all(|bus| bus.frames_blocked == 0), "a frame that is not allowed");
        self.gateway = Some(gateway);
        if self.image.journal.newest() != self.cursor {
            let (events, _) = self.image.journal.after(self.cursor);
            self.cursor = self.image.journal.newest();
            let calls =
                events.into_iter().filter(|event| event.alarm.is_some() && event.to == "unacknowledged");
            self.raised.extend(calls.map(|event| event.name));
        }
    }

    fn send(&mut self, sender: Sender, frame: CanFrame) {
        if let Some(log) = &mut self.log {
            log.push(frame.to_string());
        }
        let copies = if self.random.between(0, 999) < self.weather.lost {
            0
        } else if self.random.between(0, 999) < self.weather.doubled {
            2
        } else {
            1
        };
        for _ in 0..copies {
            let longest = i32::try_from(self.weather.longest_delay.as_micros()).unwrap();
            let delay = u64::try_from(self.random.between(longest / 2, longest)).unwrap();
            let arrival = (self.now + Duration::from_micros(delay)).max(self.last_arrival);
            self.last_arrival = arrival;
            self.sequence += 1;
            self.in_flight.insert((arrival, self.sequence), (sender, frame));
        }
    }

    fn index(&self, id: u8) -> NodeIndex {
        self.table.find_node(&format!("node{id:03}")).unwrap()
    }

    /// Asks the gateway for something; gives the number of the request.
    pub fn command(&mut self, action: Action) -> u64 {
        self.commands += 1;
        let source = CommandSource::cia309("test".into());
        let (id, now) = (self.commands, self.now());
        let command = Command { id, source, action };
        self.gateway.as_mut().expect("a gateway").handle_input(now, Input::Command(command));
        self.settle();
        id
    }

    /// The answer to a request, where there is one by now.
    pub fn reply(&mut self, id: u64) -> Option<Outcome> {
        self.replies.remove(&id)
    }

    /// Asks the gateway for something and lets time pass until it answers.
    #[track_caller]
    pub fn ask(&mut self, action: Action) -> Outcome {
        let id = self.command(action);
        self.run_until(130_000, |world| world.replies.contains_key(&id));
        self.replies.remove(&id).unwrap()
    }

    /// The link of the bus changes.
    pub fn link(&mut self, link: Link) {
        let now = self.now();
        let event = BusEvent::Link { link, at: now };
        self.gateway.as_mut().expect("a gateway").handle_input(now, Input::Bus { bus: BUS, event });
        self.settle();
    }

    /// What the gateway knows of a node.
    pub fn node(&self, id: u8) -> &NodeStatus {
        self.image.node(self.index(id)).unwrap()
    }

    /// A tag of a node.
    pub fn tag(&self, id: u8, name: &str) -> Sample {
        *self.image.tag(self.table.find_tag(self.index(id), name).unwrap())
    }

    /// A number of a node.
    pub fn number(&self, id: u8, name: &str) -> f64 {
        self.tag(id, name).value.as_f64()
    }

    /// The qualities of all tags that come in TPDOs of a node, each once.
    pub fn qualities(&self, id: u8) -> Vec<Quality> {
        let mut qualities = Vec::new();
        for place in self.table.nodes[self.index(id).0].tags.clone() {
            let quality = self.image.tags[place].quality;
            let received = matches!(self.table.tags[place].source, Source::Pdo { .. });
            if received && !qualities.contains(&quality) {
                qualities.push(quality);
            }
        }
        qualities
    }

    /// Whether all process data of a node is good.
    pub fn is_good(&self, id: u8) -> bool {
        self.qualities(id) == [Quality::Good]
    }

    /// Names of the alarms that hold and are shown, in the order of the table.
    pub fn active_alarms(&self) -> Vec<&str> {
        let alarms = self.table.alarms.iter().zip(&self.image.alarms);
        alarms.filter(|(_, status)| status.state.is_active()).map(|(alarm, _)| alarm.name.as_str()).collect()
    }

    /// How often an event is in the journal.
    pub fn events(&self, name: &str) -> usize {
        self.image.journal.newest_first().filter(|event| event.name == name).count()
    }
}
