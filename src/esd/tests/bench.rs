//! A network on a test bench, with pretended modules on the bus; everything that comes of it as lines of text.

use std::collections::BTreeMap;
use std::time::Duration;

use crate::can::{CanFrame, CanId};
use crate::esd::parameters::{can_tx_mode_of, serial_mode_of};
use crate::esd::{
    ChannelSettings, FlowControl, Framing, InitCommand, ManagementSettings, ModuleEvent, ModuleIndex,
    ModuleKind, ModuleNumber, ModuleSettings, Network, NetworkOutput, NetworkSettings, Order, Request,
    SerialBits, Setting, WatchdogMode, WatchdogSettings,
};
use crate::time::{Instant, Now, Timestamp};

/// The identifier of answers, as in the examples of the manual.
pub(super) const REPLY_ID: u16 = 0x567;

pub(super) fn number(number: u8) -> ModuleNumber {
    ModuleNumber::new(number).unwrap()
}

pub(super) fn id(id: u16) -> CanId {
    CanId::standard(id).unwrap()
}

/// The modules of a bus, managed.
pub(super) fn network(modules: Vec<ModuleSettings>) -> NetworkSettings {
    // Nothing is to wait for the bus unless a test asks for it.
    let bit_rate = 1_000_000;
    NetworkSettings { reply_id: Some(id(REPLY_ID)), bit_rate, modules, ..NetworkSettings::default() }
}

/// A module whose identifiers follow from its number as its switch, with all its lines at 9600 bit/s.
pub(super) fn module(kind: ModuleKind, switch: u8) -> ModuleSettings {
    ModuleSettings {
        number: number(switch),
        kind,
        management: Some(management()),
        channels: (1..=kind.channels()).map(|channel| line(kind, switch, channel)).collect(),
    }
}

/// SIO1 with the switch 0x12, that of the examples.
pub(super) fn sio1() -> ModuleSettings {
    module(ModuleKind::Sio1, 0x12)
}

/// The same, managed in another way.
pub(super) fn managed(change: impl FnOnce(&mut ManagementSettings)) -> ModuleSettings {
    let mut module = sio1();
    change(module.management.as_mut().unwrap());
    module
}

pub(super) fn management() -> ManagementSettings {
    ManagementSettings {
        switch: None,
        check_kind: true,
        configure: true,
        store: false,
        first_tx_delay: None,
        min_char_high: false,
        status_period: Duration::from_secs(1),
        watchdog: None,
        never_seen_after: Duration::from_secs(15),
    }
}

pub(super) fn watchdog(mode: WatchdogMode) -> WatchdogSettings {
    WatchdogSettings { id: id(0x512), time: Duration::from_secs(1), factor: 3, mode }
}

pub(super) fn line(kind: ModuleKind, switch: u8, channel: u8) -> ChannelSettings {
    let [tx_id, rx_id] = kind.identifiers(switch, channel).unwrap();
    ChannelSettings {
        number: channel,
        tx_id,
        rx_id,
        can_tx_mode: None,
        serial_mode: None,
        serial_bits: SerialBits::ALL,
        stop_bit_set: 2,
        gap: None,
        byte_time: Duration::from_nanos(1_041_667),
        flow_control: FlowControl::None,
        framing: Framing { delimiter: b"\n".to_vec(), longest: 64, idle: None },
    }
}

/// A module as it is on the bus, so far as its management goes.
#[derive(Clone, Debug)]
pub(super) struct Pretended {
    pub(super) number: u8,
    pub(super) kind: u8,
    pub(super) protocol: u8,
    pub(super) switch: u8,
    /// It answers and sends.
    pub(super) on: bool,
    pub(super) status: u8,
    /// Bits of the status that cannot be cleared.
    pub(super) stuck: u8,
    /// Questions of these heads it does not answer.
    pub(super) mute: Vec<[u8; 2]>,
    /// Questions of these heads it does not know.
    pub(super) unknown: Vec<[u8; 2]>,
    /// Nothing can be set.
    pub(super) stubborn: bool,
    pub(super) ids: BTreeMap<(u8, u8), u16>,
    pub(super) parameters: BTreeMap<u8, u16>,
    pub(super) watchdog: (u16, u16, u8),
    toggle: bool,
    stored: Option<Memory>,
}

/// Identifiers and parameters.
type Memory = (BTreeMap<(u8, u8), u16>, BTreeMap<u8, u16>);

impl Pretended {
    /// As it is shipped, just started.
    pub(super) fn new(kind: ModuleKind, switch: u8) -> Self {
        let mut pretended = Self {
            number: switch,
            kind: kind.code(),
            protocol: b'E',
            switch,
            on: true,
            status: 0,
            stuck: 0,
            mute: Vec::new(),
            unknown: Vec::new(),
            stubborn: false,
            ids: BTreeMap::new(),
            parameters: BTreeMap::new(),
            watchdog: (0, 0, 0),
            toggle: false,
            stored: None,
        };
        let (mut ids, mut parameters) = (BTreeMap::new(), BTreeMap::from([(0, 10_000)]));
        for channel in 1..=kind.channels() {
            let [tx, rx] =
                kind.identifiers(switch, channel).unwrap().map(|id| u16::try_from(id.raw()).unwrap());
            ids.extend([((0x02, channel - 1), tx), ((0x03, channel - 1), rx)]);
            parameters.extend([(can_tx_mode_of(channel), 0x1411), (serial_mode_of(channel), 0x2273)]);
        }
        pretended.stored = Some((ids, parameters));
        pretended.restart();
        pretended
    }

    pub(super) fn restart(&mut self) {
        (self.ids, self.parameters) = self.stored.clone().unwrap();
        self.status = 0xC1;
        self.watchdog = (0, 0, 0);
        self.toggle = false;
    }

    /// What it sends because of a frame.
    pub(super) fn react(&mut self, frame: &CanFrame) -> Option<CanFrame> {
        if !self.on {
            return None;
        }
        if frame.is_remote() && frame.id() == id(self.watchdog.0) {
            return self.watchdog_answer();
        }
        let mine = |module: ModuleNumber| module.get() == self.number;
        match InitCommand::parse(frame)? {
            InitCommand::Request { request, .. } if self.mute.contains(&request.head()) => None,
            InitCommand::Request { module, request, reply_id } if mine(module) => {
                CanFrame::data_frame(id(reply_id), &self.answer(request))
            }
            InitCommand::Set { module, setting } if mine(module) => {
                self.set(setting);
                None
            }
            InitCommand::Supervisor { module, order } if module.is_none_or(mine) => match order {
                Order::Reset | Order::DefaultReset => {
                    self.restart();
                    None
                }
                Order::Watchdog => self.watchdog_answer(),
                Order::Suspend => {
                    self.status |= 0x02;
                    None
                }
                Order::Continue => {
                    self.status &= !0x02;
                    None
                }
                Order::ClearCanError => None,
            },
            InitCommand::Request { .. }
            | InitCommand::Set { .. }
            | InitCommand::Supervisor { .. }
            | InitCommand::Service { .. } => None,
        }
    }

    fn watchdog_answer(&mut self) -> Option<CanFrame> {
        let toggle = u8::from(self.toggle) << 7;
        self.toggle = !self.toggle;
        CanFrame::data_frame(id(self.watchdog.0), &[toggle | 0x7D])
    }

    fn answer(&self, request: Request) -> Vec<u8> {
        let head = request.head();
        if self.unknown.contains(&head) {
            return vec![0xFF];
        }
        let word = |value: u16| [head.to_vec(), value.to_be_bytes().to_vec()].concat();
        match request {
            Request::ModuleType => vec![0, 0, self.kind],
            Request::Switch => vec![0, 1, self.switch],
            Request::SoftwareRevision => [b"\0V1.0a".as_slice(), &[self.protocol, b'0']].concat(),
            Request::ActiveNumber => vec![1, 1, self.number],
            Request::Status => vec![1, 2, self.status],
            Request::WatchdogId => word(self.watchdog.0),
            Request::WatchdogTime => [word(self.watchdog.1), vec![self.watchdog.2]].concat(),
            Request::TxId(channel) => self.ids.get(&(2, channel)).map_or(vec![0xFF], |id| word(*id)),
            Request::RxId(channel) => self
                .ids
                .get(&(3, channel))
                .map_or(vec![0xFF], |id| [word(*id), id.to_be_bytes().to_vec()].concat()),
            Request::Parameter(number) => {
                self.parameters.get(&number).map_or(vec![0xFF], |value| word(*value))
            }
            Request::AsciiId
            | Request::SerialNumber
            | Request::SavedNumber
            | Request::BitRate
            | Request::TxActivateTime(_) => vec![0xFF],
        }
    }

    fn set(&mut self, setting: Setting) {
        match setting {
            Setting::ClearStatus => self.status &= !0x84 | self.stuck,
            _ if self.stubborn => {}
            Setting::Store => self.stored = Some((self.ids.clone(), self.parameters.clone())),
            Setting::WatchdogId(id) => self.watchdog.0 = id,
            Setting::WatchdogTime { millis, factor } => (self.watchdog.1, self.watchdog.2) = (millis, factor),
            Setting::TxId(channel, id) => drop(self.ids.insert((2, channel), id)),
            Setting::RxId(channel, id) => drop(self.ids.insert((3, channel), id)),
            Setting::Parameter(number, value) => drop(self.parameters.insert(number, value)),
            Setting::Number(_) | Setting::BitRate(_) | Setting::TxActivateTime(..) => {}
        }
    }
}

/// A network, the modules on its bus, and the protocol of what it did.
pub(super) struct Bench {
    pub(super) network: Network,
    pub(super) modules: Vec<Pretended>,
    /// Frames that are given back as not sent, by how they begin.
    pub(super) refuse: Vec<&'static str>,
    /// Frames wait on their way to the bus: nobody is told that they left.
    pub(super) holds_back: bool,
    coming: BTreeMap<(u64, u64), CanFrame>,
    count: u64,
    now: u64,
    lines: Vec<String>,
}

impl Bench {
    /// At time 0, on a bus that can be used.
    pub(super) fn new(settings: NetworkSettings, modules: Vec<Pretended>) -> Self {
        let mut bench = Self::down(settings, modules);
        bench.link(0, true);
        bench
    }

    /// At time 0, on a bus that cannot be used yet.
    pub(super) fn down(settings: NetworkSettings, modules: Vec<Pretended>) -> Self {
        Self {
            network: Network::new(settings, Now::from_millis(0)),
            modules,
            refuse: Vec::new(),
            holds_back: false,
            coming: BTreeMap::new(),
            count: 0,
            now: 0,
            lines: Vec::new(),
        }
    }

    /// One module that is as wanted and was configured, with nothing new about it.
    pub(super) fn settled(settings: ModuleSettings) -> Self {
        let mut pretended = Pretended::new(settings.kind, settings.number.get());
        pretended.status = 0x41;
        let mut bench = Self::new(network(vec![settings]), vec![pretended]);
        bench.run(500);
        assert!(bench.take().iter().any(|line| line.contains("Configured")));
        bench
    }

    /// Runs until `millis`, with it.
    pub(super) fn run(&mut self, millis: u64) -> &mut Self {
        let end = millis * 1000 + 999;
        for round in 0.. {
            assert!(
                round < 1_000_000,
                "it does not come to rest at {} us: {:?}",
                self.now,
                self.network.poll_timeout()
            );
            let due = self.network.poll_timeout().map(|(at, _)| at.as_micros().max(self.now));
            let frame = self.coming.first_key_value().map(|((at, _), _)| *at);
            let Some(next) = due.into_iter().chain(frame).min().filter(|next| *next <= end) else { break };
            self.now = next;
            if frame.is_some_and(|at| at <= next) {
                let (_, frame) = self.coming.pop_first().unwrap();
                self.network.handle_frame(self.now(), &frame);
            } else {
                self.network.handle_timeout(self.now());
            }
            self.drain();
        }
        self.now = self.now.max(millis * 1000);
        self
    }

    /// A frame in candump notation, received at `millis`.
    pub(super) fn frame(&mut self, millis: u64, text: &str) -> &mut Self {
        self.run(millis);
        self.network.handle_frame(self.now(), &text.parse().unwrap());
        self.drain();
        self
    }

    /// Somebody else sends a frame at `millis`, which the modules hear as well.
    pub(super) fn order(&mut self, millis: u64, text: &str) -> &mut Self {
        self.run(millis);
        for module in &mut self.modules {
            module.react(&text.parse().unwrap());
        }
        self.frame(millis, text)
    }

    /// A frame of ours did not leave after all.
    pub(super) fn not_sent(&mut self, millis: u64, text: &str) -> &mut Self {
        self.run(millis);
        self.network.handle_not_sent(self.now(), &text.parse().unwrap());
        self.drain();
        self
    }

    pub(super) fn link(&mut self, millis: u64, up: bool) -> &mut Self {
        self.run(millis);
        self.network.handle_link(self.now(), up);
        self.drain();
        self
    }

    pub(super) fn stop(&mut self, millis: u64) -> &mut Self {
        self.run(millis);
        self.network.handle_stop(self.now());
        self.drain();
        self
    }

    /// Bytes for the first line of the first module.
    pub(super) fn send(&mut self, millis: u64, id: u64, bytes: &[u8]) -> &mut Self {
        self.run(millis);
        self.network.send(self.now(), ModuleIndex(0), 0, id, bytes.to_vec()).unwrap();
        self.drain();
        self
    }

    /// What was done since the last call.
    pub(super) fn take(&mut self) -> Vec<String> {
        std::mem::take(&mut self.lines)
    }

    /// The frames of it, without their times.
    pub(super) fn frames(&mut self) -> Vec<String> {
        let frames = self.take().into_iter().filter(|line| line.contains('#') && !line.contains("foreign"));
        frames.map(|line| line.split(' ').nth(1).unwrap().to_owned()).collect()
    }

    /// The events of it, without their times and without counters.
    pub(super) fn events(&mut self) -> Vec<String> {
        let events = self.take().into_iter().filter(|line| !line.contains('#') || line.contains("foreign"));
        events
            .map(|line| line.split_once(' ').unwrap().1.to_owned())
            .filter(|event| !event.ends_with(" Frame"))
            .collect()
    }

    pub(super) fn now(&self) -> Now {
        Now {
            instant: Instant::from_micros(self.now),
            utc: Timestamp::from_micros(i64::try_from(self.now).unwrap()),
        }
    }

    pub(super) fn drain(&mut self) {
        while let Some(output) = self.network.poll_output() {
            let millis = self.now / 1000;
            match output {
                NetworkOutput::Transmit(frame) => {
                    let text = frame.to_string();
                    if self.refuse.iter().any(|begin| text.starts_with(begin)) {
                        self.network.handle_not_sent(self.now(), &frame);
                        continue;
                    }
                    self.lines.push(format!("{millis} {text}"));
                    if !self.holds_back {
                        self.network.handle_sent(self.now(), &frame);
                    }
                    for module in &mut self.modules {
                        if let Some(answer) = module.react(&frame) {
                            self.count += 1;
                            self.coming.insert((self.now + 200, self.count), answer);
                        }
                    }
                }
                // What it is, is told at each comparing; tests of that look at the words of the refusal.
                NetworkOutput::Module(_, ModuleEvent::Kind(_) | ModuleEvent::Switch(_)) => {}
                NetworkOutput::Module(ModuleIndex(module), event) => {
                    self.lines.push(format!("{millis} {module} {}", words(&event)));
                }
                NetworkOutput::ForeignCommand(frame) => self.lines.push(format!("{millis} foreign {frame}")),
            }
        }
    }
}

fn words(event: &ModuleEvent) -> String {
    match event {
        ModuleEvent::Received { channel, chunk } => {
            format!("line {channel} received {}", chunk.bytes().escape_ascii())
        }
        ModuleEvent::Message { channel, bytes, end } => {
            format!("line {channel} message {} by {}", bytes.escape_ascii(), end.word())
        }
        ModuleEvent::Sent { channel, bytes } => format!("line {channel} sent {bytes}"),
        ModuleEvent::NotSent { channel, bytes } => format!("line {channel} not sent {bytes}"),
        ModuleEvent::SendDone { channel, id, outcome } => format!("line {channel} job {id} {outcome:?}"),
        ModuleEvent::Configured { written, stored } => format!("Configured {written} {stored}"),
        ModuleEvent::Kind(code) => format!("Kind {code:02X}"),
        ModuleEvent::Switch(value) => format!("Switch {value:02X}"),
        ModuleEvent::Status(status) => format!("Status {:02X}", status.0),
        ModuleEvent::Frame
        | ModuleEvent::Appeared
        | ModuleEvent::Lost
        | ModuleEvent::NeverSeen
        | ModuleEvent::Restarted
        | ModuleEvent::WatchdogMiss { .. }
        | ModuleEvent::ToggleError
        | ModuleEvent::NotConfigured(_)
        | ModuleEvent::OtherModule(_)
        | ModuleEvent::CanErrorStays => format!("{event:?}"),
    }
}
