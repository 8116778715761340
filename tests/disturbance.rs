//! Nodes whose SDO frames are lost, doubled and delayed, beside guarded nodes: what the ones cost the others.
//!
//! Only SDO frames suffer, so that whatever is seen at the other nodes is the gateway's own doing.
//!
//! Time is that of a model in which a frame takes [`WIRE`] and computing takes none. So what is printed in time of the bus is
//! what the gateway adds to the constants of the model (nothing, where all is well); the time that it takes to compute is
//! measured on this machine.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use cangate::can::{BusEvent, BusIndex, CanFrame, Link};
use cangate::canopen::{NmtState, NodeId};
use cangate::gateway::{Gateway, Input, Output};
use cangate::mapping::{Sketch, SourceText, TagTable};
use cangate::process_image::{NodeIndex, ProcessImage, Quality};
use cangate::simulator::random::Random;
use cangate::simulator::{Device, DevicePlan, Kind, Scenario};
use cangate::time::{Clock, Instant, Now, Timestamp};

const BUS: BusIndex = BusIndex(0);
/// Guarded nodes without SDO.
const GUARDED: [u8; 3] = [1, 2, 3];
/// Nodes that are configured and polled by SDO.
const ASKED: [u8; 4] = [11, 12, 13, 14];
/// What a frame takes on a bus at 125 kbit/s that is not full.
const WIRE: Duration = Duration::from_micros(1000);
/// In µs; what an SDO frame takes at the most.
const LATEST: i32 = 40_000;
const GUARD_TIME: Duration = Duration::from_millis(500);

/// All tags that are polled come ten times a second instead of once.
fn plant() -> Arc<TagTable> {
    let busy =
        cangate::mapping::shipped("danfoss-dst-p92c").unwrap().replace("poll_ms = 1000", "poll_ms = 100");
    let mut sketch = Sketch::new().mapping(SourceText::new("busy", busy.as_str()));
    for id in GUARDED {
        sketch = sketch.node(&format!("node{id:03}"), id, "motortech-detcon", |_| ());
    }
    for id in ASKED {
        sketch = sketch.node(&format!("node{id:03}"), id, "busy", |_| ());
    }
    Arc::new(sketch.build().unwrap().0)
}

fn is_sdo(frame: &CanFrame) -> bool {
    matches!(frame.id().raw() >> 7, 0xB | 0xC)
}

/// What was measured at the guarded nodes.
#[derive(Debug, Default)]
struct Worst {
    guard_requests: u64,
    /// How much later than a guard time after the one before a request was sent; 0 where the gateway keeps its times.
    request_late: Duration,
    /// From a request to the moment at which the gateway had taken its reply; two frames of the model at the least.
    reply: Duration,
    tpdos: u64,
    /// From the arrival of a TPDO until its values stand in the process image, in time of the bus; 0 where the gateway takes
    /// a frame when it comes.
    in_image: Duration,
    /// The same in the time that this machine took.
    computed: Duration,
}

struct Hall {
    table: Arc<TagTable>,
    gateway: Gateway,
    image: ProcessImage,
    devices: Vec<Box<dyn Device>>,
    /// By arrival. `None`: sent by the gateway, else the place of the device.
    in_flight: BTreeMap<(Instant, u64), (Option<usize>, CanFrame)>,
    sequence: u64,
    /// Per identifier: frames of one do not overtake each other.
    last_arrival: BTreeMap<u32, Instant>,
    bad_weather: bool,
    random: Random,
    now: Instant,
    clock: Clock,
    last_request: BTreeMap<u32, Instant>,
    worst: Worst,
    sdo: [u64; 3],
}

impl Hall {
    fn new(seed: u64) -> Self {
        let table = plant();
        let mut gateway = Gateway::new(Arc::clone(&table), Now::default());
        let image = gateway.empty_image();
        let at = Now::default();
        gateway
            .handle_input(at, Input::Bus { bus: BUS, event: BusEvent::Link { link: Link::ErrorActive, at } });
        let mut hall = Self {
            table,
            gateway,
            image,
            devices: Vec::new(),
            in_flight: BTreeMap::new(),
            sequence: 0,
            last_arrival: BTreeMap::new(),
            bad_weather: true,
            random: Random::new(seed),
            now: Instant::START,
            clock: Clock::start(),
            last_request: BTreeMap::new(),
            worst: Worst::default(),
            sdo: [0; 3],
        };
        for id in GUARDED {
            hall.power_on(id, Kind::Detcon);
        }
        for id in ASKED {
            hall.power_on(id, Kind::DstP92c);
        }
        hall
    }

    fn power_on(&mut self, id: u8, kind: Kind) {
        let plan = DevicePlan::new(NodeId::new(id).unwrap(), Scenario::shipped(kind, "quiet").unwrap());
        self.devices.push(plan.power_on(self.now()));
    }

    fn now(&self) -> Now {
        let micros = i64::try_from(self.now.as_micros()).unwrap();
        Now { instant: self.now, utc: Timestamp::from_micros(micros) }
    }

    fn run_for(&mut self, time: Duration) {
        let end = self.now + time;
        loop {
            self.settle();
            let devices = self.devices.iter().filter_map(|device| device.poll_timeout());
            let gateway = self.gateway.poll_timeout().map(|(due, _)| due);
            let arrival = self.in_flight.keys().next().map(|(due, _)| *due);
            let Some(next) = devices.chain(gateway).chain(arrival).min().filter(|next| *next <= end) else {
                break;
            };
            self.now = next.max(self.now);
            self.step();
        }
        self.now = end;
    }

    fn step(&mut self) {
        let now = self.now();
        while let Some(entry) = self.in_flight.first_entry().filter(|entry| entry.key().0 <= now.instant) {
            let (sender, frame) = entry.remove();
            for (place, device) in self.devices.iter_mut().enumerate() {
                if sender != Some(place) && device.hears(frame.id()) {
                    device.handle_frame(now, &frame);
                }
            }
            if sender.is_some() {
                self.receive(now, frame);
            }
        }
        for device in &mut self.devices {
            if device.poll_timeout().is_some_and(|due| due <= now.instant) {
                device.handle_timeout(now);
            }
        }
        if self.gateway.poll_timeout().is_some_and(|(due, _)| due <= now.instant) {
            self.gateway.handle_timeout(now);
        }
    }

    /// The gateway takes a frame, and what it does with those of guarded nodes is measured.
    fn receive(&mut self, now: Now, frame: CanFrame) {
        let begin = self.clock.now().instant;
        let event = BusEvent::Frame { frame, at: now };
        self.gateway.handle_input(now, Input::Bus { bus: BUS, event });
        self.gateway.publish(&mut self.image);
        let computed = self.clock.now().instant.since(begin);
        let id = frame.id().raw();
        let node = u8::try_from(id & 0x7F).unwrap();
        if !GUARDED.contains(&node) {
            return;
        }
        match id >> 7 {
            0xE => {
                if let Some(asked) = self.last_request.get(&id) {
                    self.worst.reply = self.worst.reply.max(now.instant.since(*asked));
                }
            }
            0x3 => {
                self.worst.tpdos += 1;
                self.worst.computed = self.worst.computed.max(computed);
                let tag = self.table.find_tag(self.index(node), "knock_intensity_1").unwrap();
                let taken = self.image.tag(tag).received_at.unwrap();
                self.worst.in_image = self.worst.in_image.max(now.instant.since(taken));
                assert_eq!(self.image.tag(tag).quality, Quality::Good, "node {node} at {:?}", self.now);
            }
            _ => {}
        }
    }

    fn settle(&mut self) {
        while let Some(output) = self.gateway.poll_output() {
            if let Output::Transmit { frame, .. } = output {
                self.measure_request(&frame);
                self.send(None, frame);
            }
        }
        for place in 0..self.devices.len() {
            while let Some(frame) = self.devices[place].poll_output() {
                self.send(Some(place), frame);
            }
        }
        self.gateway.publish(&mut self.image);
    }

    fn measure_request(&mut self, frame: &CanFrame) {
        if frame.is_remote()
            && let Some(before) = self.last_request.insert(frame.id().raw(), self.now)
        {
            self.worst.guard_requests += 1;
            let late = self.now.since(before).saturating_sub(GUARD_TIME);
            self.worst.request_late = self.worst.request_late.max(late);
        }
    }

    fn send(&mut self, sender: Option<usize>, frame: CanFrame) {
        let (mut copies, mut delay) = (1, WIRE);
        if is_sdo(&frame) && self.bad_weather {
            self.sdo[0] += 1;
            delay = Duration::from_micros(u64::try_from(self.random.between(1000, LATEST)).unwrap());
            match self.random.between(0, 99) {
                0..5 => {
                    self.sdo[1] += 1;
                    copies = 0;
                }
                5..10 => {
                    self.sdo[2] += 1;
                    copies = 2;
                }
                _ => {}
            }
        }
        for _ in 0..copies {
            let last = self.last_arrival.entry(frame.id().raw()).or_insert(self.now);
            *last = (self.now + delay).max(*last);
            self.sequence += 1;
            self.in_flight.insert((*last, self.sequence), (sender, frame));
        }
    }

    fn index(&self, id: u8) -> NodeIndex {
        self.table.find_node(&format!("node{id:03}")).unwrap()
    }

    fn power_cycle(&mut self, id: u8) {
        let now = self.now();
        let device = self.devices.iter_mut().find(|device| device.node().get() == id).unwrap();
        device.handle_line(now, &["power", "cycle"]).unwrap();
    }

    fn is_operational(&self, id: u8) -> bool {
        let node = self.image.node(self.index(id)).unwrap();
        node.online && node.nmt == Some(NmtState::Operational)
    }
}

#[test]
fn sdo_under_loss_duplication_and_delay_delays_nothing_of_the_other_nodes() {
    let mut hall = Hall::new(3);
    hall.run_for(Duration::from_secs(5));
    let mut boots: Vec<Duration> = Vec::new();
    // One of them restarts every 10 s and is configured anew, while all are polled.
    for restart in 0..20 {
        let id = ASKED[restart % ASKED.len()];
        hall.power_cycle(id);
        let begin = hall.now;
        hall.run_for(Duration::from_millis(200));
        while !hall.is_operational(id) {
            assert!(hall.now.since(begin) < Duration::from_secs(60), "node {id} does not come back");
            hall.run_for(Duration::from_millis(10));
        }
        boots.push(hall.now.since(begin));
        hall.run_for(Duration::from_secs(10));
    }
    let errors: u64 =
        ASKED.iter().map(|id| hall.image.node(hall.index(*id)).unwrap().counters.sdo_errors).sum();
    let worst = &hall.worst;
    boots.sort_unstable();
    println!(
        "{} s, {} SDO frames, of these {} lost and {} doubled, up to {} ms late; {errors} transfers failed by name, {} boots \
         took {:.1?} to {:.1?}",
        hall.now.as_millis() / 1000,
        hall.sdo[0],
        hall.sdo[1],
        hall.sdo[2],
        LATEST / 1000,
        boots.len(),
        boots[0],
        boots[boots.len() - 1],
    );
    println!(
        "other nodes, worst: guard request {:?} late (of {}), reply taken {:?} after its request ({:?} of these are the wire), TPDO \
         in the image after {:?} of the bus's time and {:?} of this machine's (of {})",
        worst.request_late,
        worst.guard_requests,
        worst.reply,
        2 * WIRE,
        worst.in_image,
        worst.computed,
        worst.tpdos
    );
    assert!(hall.sdo[1] > 100 && hall.sdo[2] > 100 && errors > 0, "the weather was not bad");
    // It was looked at: two requests and at least one TPDO a second from each, and no reply came before it could.
    let seconds = hall.now.as_millis() / 1000;
    let nodes = u64::try_from(GUARDED.len()).unwrap();
    assert!(worst.guard_requests >= 2 * nodes * (seconds - 10), "{}", worst.guard_requests);
    assert!(worst.tpdos >= nodes * (seconds - 10), "{}", worst.tpdos);
    assert!(worst.reply >= 2 * WIRE && worst.computed > Duration::ZERO, "{worst:?}");
    // A request goes out when it is due, to the millisecond; its reply needs two frames on the wire and 1 ms in the device.
    assert!(worst.request_late <= Duration::from_millis(1), "{:?}", worst.request_late);
    assert!(worst.reply <= 3 * WIRE + Duration::from_millis(1), "{:?}", worst.reply);
    assert_eq!(worst.in_image, Duration::ZERO);
    for id in GUARDED {
        let node = hall.image.node(hall.index(id)).unwrap();
        assert_eq!((node.counters.guard_misses, node.counters.toggle_errors), (0, 0), "node {id}");
        assert!(hall.is_operational(id), "node {id}");
    }

    hall.bad_weather = false;
    hall.run_for(Duration::from_secs(60));
    for id in ASKED {
        assert!(hall.is_operational(id), "node {id}");
        let tag = hall.table.find_tag(hall.index(id), "error_register").unwrap();
        assert_eq!(hall.image.tag(tag).quality, Quality::Good, "node {id}");
    }
}
