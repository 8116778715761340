//! One bus: its link, its silence, its counters, and what happens on it that concerns no configured node.

use std::time::Duration;

use super::events::Name;
use super::node::Node;
use super::{Gateway, Output};
use crate::can::{BusCounters, BusIndex, CanFrame, Link};
use crate::canopen::{
    ErrorControl, ForeignEvent, Network, NetworkOutput, NetworkSettings, NodeSettings, Role,
};
use crate::mapping::{AlarmOwner, BuiltIn, NodeDef, TagTable};
use crate::process_image::{BusState, BusStatus, Event, NodeIndex, Quality, Reason, Value};
use crate::time::{Instant, Now};

/// A bus is silent when nobody sent anything for this long (B03), or longer where its nodes speak more seldom.
const SILENCE: Duration = Duration::from_millis(1_500);

/// The load is too high above this many tenths of a percent (B06).
const HIGH_LOAD_PERMILLE: u16 = 800;

/// Rates are computed from counters at least this far apart.
const RATE_INTERVAL: Duration = Duration::from_millis(500);

/// More new errors than this between two reports, without one frame since the start, hint at a wrong bit rate.
const ERROR_BURST: u64 = 10;

/// A bus with its network.
#[derive(Debug)]
pub(super) struct Bus {
    pub(super) network: Network,
    pub(super) status: BusStatus,
    role: Role,
    link: Option<Link>,
    /// By node id.
    by_id: Vec<Option<NodeIndex>>,
    members: Vec<NodeIndex>,
    /// When a frame came last, or since when frames can come.
    heard_at: Instant,
    silent: bool,
    silence: Duration,
    counters: BusCounters,
    counted_at: Option<Instant>,
    /// Frames for which the queue to the bus was full.
    refused: u64,
    /// 29-bit and remote frames on identifiers of configured nodes, and frames of unknown identifiers.
    foreign: u64,
}

impl Bus {
    pub(super) fn new(table: &TagTable, index: BusIndex, now: Now) -> Self {
        let (role, start_broadcast) =
            table.buses.get(index.0).map_or((Role::Passive, false), |bus| (bus.role, bus.start_broadcast));
        let mut by_id = vec![None; 128];
        let mut members = Vec::new();
        let mut nodes: Vec<NodeSettings> = Vec::new();
        for (place, node) in table.nodes.iter().enumerate().filter(|(_, node)| node.bus == index) {
            if let Some(entry) = by_id.get_mut(usize::from(node.canopen.id.get())) {
                *entry = Some(NodeIndex(place));
            }
            members.push(NodeIndex(place));
            nodes.push(node.canopen.clone());
        }
        let silence = nodes.iter().filter_map(longest_silence).min().unwrap_or(SILENCE).max(SILENCE);
        Self {
            network: Network::new(NetworkSettings { role, start_broadcast, nodes }, now),
            status: BusStatus::default(),
            role,
            link: None,
            by_id,
            members,
            heard_at: now.instant,
            silent: false,
            silence,
            counters: BusCounters::default(),
            counted_at: None,
            refused: 0,
            foreign: 0,
        }
    }

    /// Whether frames can come; not before the bus says so.
    pub(super) fn is_up(&self) -> bool {
        self.link.is_some_and(Link::is_up)
    }

    /// When it has been silent for too long, if no frame comes until then.
    pub(super) fn silent_at(&self) -> Option<Instant> {
        let watched = self.members.len() > 1 && self.is_up() && !self.silent;
        watched.then_some(self.heard_at + self.silence)
    }
}

/// How long a node that is well can be silent.
fn longest_silence(node: &NodeSettings) -> Option<Duration> {
    match &node.error_control {
        ErrorControl::Guarding(guarding) if !guarding.guard_time.is_zero() => Some(guarding.guard_time * 3),
        ErrorControl::Heartbeat { timeout } => Some(*timeout),
        ErrorControl::Guarding(_) | ErrorControl::None => {
            node.pdos.iter().filter_map(|pdo| pdo.timeout).min()
        }
    }
}

impl Gateway {
    /// Why a bus cannot be used; `None` where it can.
    pub(super) fn bus_trouble(&self, index: BusIndex) -> Option<String> {
        let bus = self.buses.get(index.0)?;
        let name = self.table.buses.get(index.0).map_or("", |bus| bus.name.as_str());
        match bus.link? {
            Link::Absent => Some(format!("the interface of bus `{name}` is not there")),
            Link::Down => Some(format!("the interface of bus `{name}` is down")),
            Link::BusOff => Some(format!("the controller of bus `{name}` is bus-off")),
            Link::ErrorActive | Link::ErrorPassive => None,
        }
    }

    /// While a bus has been quiet for so long that it may be silent altogether: until when that is decided.
    pub(super) fn quiet_until(&self, now: Now, index: BusIndex) -> Option<Instant> {
        let bus = self.buses.get(index.0)?;
        let silent_at = bus.silent_at().filter(|at| *at > now.instant)?;
        (now.instant.since(bus.heard_at) >= bus.silence / 2 && self.expects_frames(bus)).then_some(silent_at)
    }

    /// Whether at least two nodes should be heard all the time. The silence of a single one is that node's own, and
    /// its own alarm tells of it better.
    fn expects_frames(&self, bus: &Bus) -> bool {
        let expected = bus.members.iter().filter(|index| {
            let def: Option<&NodeDef> = self.table.nodes.get(index.0);
            let node: Option<&Node> = self.nodes.get(index.0);
            def.zip(node).is_some_and(|(def, node)| node.is_expected(def))
        });
        expected.count() > 1
    }

    pub(super) fn bus_frame(&mut self, now: Now, index: BusIndex, frame: &CanFrame) {
        let was_quiet = self.quiet_until(now, index).is_some();
        let Some(bus) = self.buses.get_mut(index.0) else { return };
        bus.heard_at = now.instant;
        let was_silent = std::mem::take(&mut bus.silent);
        bus.network.handle_frame(now, frame);
        if was_silent {
            self.conditions.set(now, AlarmOwner::Bus(index), BuiltIn::BusSilent, false);
            self.tell_bus(now, index, "bus_heard", |_| ());
        }
        self.drain_network(now, index);
        if was_quiet || was_silent {
            self.refresh_nodes_of(now, index);
        }
    }

    pub(super) fn bus_link(&mut self, now: Now, index: BusIndex, link: Link) {
        let Some(bus) = self.buses.get_mut(index.0) else { return };
        if bus.link == Some(link) {
            return;
        }
        let (was_up, before) = (bus.is_up(), bus.status.state);
        bus.link = Some(link);
        bus.status.state = state(link);
        let (after, up) = (bus.status.state, bus.is_up());
        if up != was_up {
            bus.heard_at = now.instant;
            bus.silent = false;
            bus.network.handle_link(now, up);
        }
        let never_heard = bus.counters.frames_received == 0;
        let members = if up { Vec::new() } else { bus.members.clone() };
        self.dirty_buses.mark(index.0);
        self.tell_bus(now, index, "bus_state", |event| {
            before.word().clone_into(&mut event.from);
            after.word().clone_into(&mut event.to);
            if never_heard && matches!(after, BusState::BusOff | BusState::ErrorPassive) {
                event.text = "no frame was ever received here; possible causes: a wrong bit rate, wiring, a \
                              missing terminator, nobody else on the bus"
                    .into();
            }
        });
        let owner = AlarmOwner::Bus(index);
        self.conditions.set(now, owner, BuiltIn::BusOff, after == BusState::BusOff);
        let down = matches!(after, BusState::Absent | BusState::Down);
        self.conditions.set(now, owner, BuiltIn::InterfaceDown, down);
        self.conditions.set(now, owner, BuiltIn::ErrorPassive, after == BusState::ErrorPassive);
        if !up {
            self.conditions.set(now, owner, BuiltIn::BusSilent, false);
        }
        for node in members {
            if let Some(node) = self.nodes.get_mut(node.0) {
                node.lose_contact();
            }
            self.degrade(now, node, None, Quality::Bad(Reason::BusUnavailable));
        }
        self.drain_network(now, index);
        self.refresh_nodes_of(now, index);
    }

    pub(super) fn bus_not_sent(&mut self, now: Now, index: BusIndex, frame: &CanFrame) {
        let Some(bus) = self.buses.get_mut(index.0) else { return };
        bus.network.handle_not_sent(now, frame);
        self.tell_bus(now, index, "frame_not_sent", |event| {
            event.text = format!("{frame} did not leave");
        });
        self.drain_network(now, index);
    }

    /// The queue of frames to a bus is full.
    pub(super) fn bus_refused(&mut self, now: Now, index: BusIndex, frame: &CanFrame) {
        if let Some(bus) = self.buses.get_mut(index.0) {
            bus.refused = bus.refused.saturating_add(1);
            bus.status.frames_not_sent = bus.counters.frames_not_sent.saturating_add(bus.refused);
            self.dirty_buses.mark(index.0);
        }
        self.bus_not_sent(now, index, frame);
    }

    pub(super) fn bus_counters(&mut self, now: Now, index: BusIndex, counters: BusCounters) {
        let bit_rate = self.table.buses.get(index.0).map_or(0, |bus| bus.bit_rate);
        let Some(bus) = self.buses.get_mut(index.0) else { return };
        let new_overruns = counters.overruns.saturating_sub(bus.status.overruns);
        let new_errors = counters.error_frames.saturating_sub(bus.status.errors);
        let status = &mut bus.status;
        status.frames_received = counters.frames_received;
        status.frames_sent = counters.frames_sent;
        status.frames_not_sent = counters.frames_not_sent.saturating_add(bus.refused);
        status.errors = counters.error_frames;
        status.bus_off_count = counters.bus_off_count;
        status.overruns = counters.overruns;
        status.foreign_frames = bus.foreign.saturating_add(counters.fd_frames);
        match bus.counted_at.map(|at| now.instant.since(at)) {
            Some(passed) if passed < RATE_INTERVAL => {}
            Some(passed) => {
                let old = std::mem::replace(&mut bus.counters, counters);
                bus.counted_at = Some(now.instant);
                let frames = (counters.frames_received.saturating_sub(old.frames_received))
                    .saturating_add(counters.frames_sent.saturating_sub(old.frames_sent));
                let bits = counters.wire_bits.saturating_sub(old.wire_bits);
                status.frames_per_second = u32::try_from(per_second(frames, passed)).unwrap_or(u32::MAX);
                let bit_rate = u64::from(counters.bit_rate.unwrap_or(bit_rate));
                let load = per_second(bits, passed).saturating_mul(1_000).checked_div(bit_rate);
                status.load_permille = load.map(|load| u16::try_from(load).unwrap_or(u16::MAX));
            }
            None => {
                bus.counters = counters;
                bus.counted_at = Some(now.instant);
            }
        }
        let high = status.load_permille.is_some_and(|load| load > HIGH_LOAD_PERMILLE);
        self.dirty_buses.mark(index.0);
        let owner = AlarmOwner::Bus(index);
        self.conditions.set(now, owner, BuiltIn::HighLoad, high);
        if new_overruns > 0 {
            self.conditions.pulse(now, owner, BuiltIn::FramesLost);
            self.tell_bus(now, index, "frames_lost", |event| {
                event.value = Some(Value::Unsigned(new_overruns));
                event.text =
                    format!("the kernel dropped {new_overruns} frames: this host is too slow or too busy");
            });
        }
        if new_errors > ERROR_BURST && counters.frames_received == 0 {
            self.tell_bus(now, index, "bus_errors", |event| {
                event.value = Some(Value::Unsigned(new_errors));
                event.text =
                    format!("{new_errors} error frames and no valid frame yet; the bit rate may be wrong");
            });
        }
    }

    /// Looks whether a bus has fallen silent.
    pub(super) fn check_silence(&mut self, now: Now, index: BusIndex) {
        let Some(bus) = self.buses.get(index.0) else { return };
        if bus.silent_at().is_none_or(|at| at > now.instant) {
            return;
        }
        let expected = self.expects_frames(bus);
        let Some(bus) = self.buses.get_mut(index.0) else { return };
        if expected {
            bus.silent = true;
            let silence = bus.silence;
            self.conditions.set(now, AlarmOwner::Bus(index), BuiltIn::BusSilent, true);
            self.tell_bus(now, index, "bus_silent", |event| {
                event.text = format!("no frame from anyone for {silence:?}");
            });
        } else {
            bus.heard_at = now.instant;
        }
        self.refresh_nodes_of(now, index);
    }

    /// Takes what a network has to say.
    pub(super) fn drain_network(&mut self, now: Now, index: BusIndex) {
        while let Some(bus) = self.buses.get_mut(index.0)
            && let Some(output) = bus.network.poll_output()
        {
            match output {
                // A passive gateway sends nothing at all, whatever anyone asks for.
                NetworkOutput::Transmit(_) if bus.role == Role::Passive => {}
                NetworkOutput::Transmit(frame) => {
                    self.outputs.push_back(Output::Transmit { bus: index, frame });
                }
                NetworkOutput::Node(id, event) => {
                    if let Some(Some(node)) = bus.by_id.get(usize::from(id.get())).copied() {
                        self.node_event(now, node, &event);
                    }
                }
                NetworkOutput::Foreign(event) => self.foreign_event(now, index, &event),
            }
        }
    }

    /// A frame that belongs to nobody used an identifier of a node.
    pub(super) fn count_foreign_frame_of(&mut self, node: NodeIndex) {
        if let Some(def) = self.table.nodes.get(node.0) {
            self.count_foreign_frame(def.bus);
        }
    }

    fn count_foreign_frame(&mut self, index: BusIndex) {
        if let Some(bus) = self.buses.get_mut(index.0) {
            bus.foreign = bus.foreign.saturating_add(1);
            bus.status.foreign_frames = bus.status.foreign_frames.saturating_add(1);
            self.dirty_buses.mark(index.0);
        }
    }

    fn foreign_event(&mut self, now: Now, index: BusIndex, event: &ForeignEvent) {
        match event {
            ForeignEvent::NmtCommand { command, node } => {
                if self.buses.get(index.0).is_some_and(|bus| bus.role == Role::Master) {
                    self.conditions.pulse(now, AlarmOwner::Bus(index), BuiltIn::ForeignMaster);
                }
                self.tell_bus(now, index, "foreign_nmt_command", |event| {
                    event.value = Some(Value::Unsigned((*command).into()));
                    event.text =
                        format!("somebody else sent NMT command 0x{command:02X} to node {node} (0 = all)");
                });
            }
            ForeignEvent::UnknownId { id, node, first } => {
                self.count_foreign_frame(index);
                if *first {
                    self.tell_bus(now, index, "unknown_id", |event| {
                        event.value = Some(Value::Unsigned(id.raw().into()));
                        event.text = match node {
                            Some(node) => format!("{id} comes from node {node}, which is not configured"),
                            None => format!("{id} belongs to no configured node"),
                        };
                    });
                }
            }
        }
    }

    pub(super) fn refresh_nodes_of(&mut self, now: Now, index: BusIndex) {
        let members = self.buses.get(index.0).map_or(0, |bus| bus.members.len());
        for place in 0..members {
            let member = self.buses.get(index.0).and_then(|bus| bus.members.get(place)).copied();
            if let Some(member) = member {
                self.refresh_node(now, member);
            }
        }
    }

    fn tell_bus(&mut self, now: Now, index: BusIndex, name: &'static str, fill: impl FnOnce(&mut Event)) {
        self.events.record(now, AlarmOwner::Bus(index), Name::Word(name), fill);
    }
}

fn state(link: Link) -> BusState {
    match link {
        Link::Absent => BusState::Absent,
        Link::Down => BusState::Down,
        Link::BusOff => BusState::BusOff,
        Link::ErrorPassive => BusState::ErrorPassive,
        Link::ErrorActive => BusState::ErrorActive,
    }
}

fn per_second(count: u64, passed: Duration) -> u64 {
    let micros = u64::try_from(passed.as_micros()).unwrap_or(u64::MAX).max(1);
    count.saturating_mul(1_000_000) / micros
}
