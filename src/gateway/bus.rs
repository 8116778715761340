//! One bus: its link, its silence, its counters, and what happens on it that concerns no configured node.

use std::time::Duration;

use super::events::Name;
use super::node::Node;
use super::{Gateway, Output};
use crate::can::{BusCounters, BusIndex, CanFrame, CanId, Link};
use crate::canopen::{
    ErrorControl, ForeignEvent, Network, NetworkOutput, NetworkSettings, NodeId, NodeSettings, Role, cob_id,
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
    ever_heard: bool,
    silent: bool,
    /// Silence is not looked for before so much of it, whichever nodes are expected.
    shortest_silence: Duration,
    /// When it is looked for next, if no frame comes until then.
    look_at: Instant,
    /// When frames came again after the bus was silent or could not be used.
    back_at: Option<Instant>,
    counters: BusCounters,
    counted_at: Option<Instant>,
    /// Frames for which the queue to the bus was full.
    refused: u64,
    /// 29-bit and remote frames on identifiers of configured nodes, and frames of unknown identifiers.
    foreign: u64,
}

impl Bus {
    pub(super) fn new(table: &TagTable, index: BusIndex, now: Now) -> Self {
        let def = table.buses.get(index.0);
        let role = def.map_or(Role::Passive, |bus| bus.role);
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
        let shortest_silence = silence(nodes.iter()).unwrap_or(SILENCE);
        Self {
            network: Network::new(
                NetworkSettings {
                    role,
                    start_broadcast: def.is_some_and(|bus| bus.start_broadcast),
                    sync: def.and_then(|bus| bus.sync),
                    time: def.and_then(|bus| bus.time),
                    own_heartbeat: def.and_then(|bus| bus.own_heartbeat),
                    nodes,
                },
                now,
            ),
            status: BusStatus::default(),
            role,
            link: None,
            by_id,
            members,
            heard_at: now.instant,
            ever_heard: false,
            silent: false,
            shortest_silence,
            look_at: now.instant + shortest_silence,
            back_at: None,
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

    /// Whether the bus said that no frames can come.
    fn is_known_down(&self) -> bool {
        self.link.is_some_and(|link| !link.is_up())
    }

    /// When its silence is to be looked for, if no frame comes until then.
    pub(super) fn silent_at(&self) -> Option<Instant> {
        let watched = self.members.len() > 1 && self.is_up() && !self.silent;
        watched.then_some(self.look_at)
    }

    /// A frame came, or frames can come from now on.
    fn listen_from(&mut self, now: Instant) {
        self.heard_at = now;
        self.look_at = now + self.shortest_silence;
        self.silent = false;
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

/// How long a bus with these nodes can be silent: until two of them should have been heard, since the silence of one
/// is its own. `None` where there are no two.
fn silence<'a>(nodes: impl Iterator<Item = &'a NodeSettings>) -> Option<Duration> {
    let (mut shortest, mut second) = (None, None);
    for silence in nodes.filter_map(longest_silence) {
        if shortest.is_none_or(|shortest| silence < shortest) {
            second = shortest.replace(silence);
        } else if second.is_none_or(|second| silence < second) {
            second = Some(silence);
        }
    }
    second.map(|second| second.max(SILENCE))
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

    /// Whether a frame that comes now was on its way when the bus went down.
    pub(super) fn comes_too_late(&self, index: BusIndex) -> bool {
        self.buses.get(index.0).is_some_and(Bus::is_known_down)
    }

    /// While the loss of a node may turn out to be the silence of its bus, or the node may only be slow to come back
    /// after that: until when that is decided.
    pub(super) fn undecided_until(&self, now: Now, node: &NodeSettings, index: BusIndex) -> Option<Instant> {
        let bus = self.buses.get(index.0)?;
        let back = bus.back_at.map(|at| at + longest_silence(node).unwrap_or(SILENCE));
        self.silent_from(now, index).max(back).filter(|until| *until > now.instant)
    }

    /// While a bus has been quiet for so long that it may be silent altogether: from when on it will be.
    fn silent_from(&self, now: Now, index: BusIndex) -> Option<Instant> {
        let bus = self.buses.get(index.0)?;
        let quiet = now.instant.since(bus.heard_at);
        if bus.silent_at().is_none() || quiet < bus.shortest_silence / 2 {
            return None;
        }
        let silence = self.silence_of(bus)?;
        (quiet >= silence / 2).then_some(bus.heard_at + silence).filter(|at| *at > now.instant)
    }

    /// How long a bus can be silent; `None` unless at least two nodes should be heard all the time. The silence of a
    /// single one is that node's own, and its own alarm tells of it better. So is that of a node that was missing
    /// already while others were heard.
    fn silence_of(&self, bus: &Bus) -> Option<Duration> {
        let expected = bus.members.iter().filter_map(|index| {
            let def: &NodeDef = self.table.nodes.get(index.0)?;
            let node: &Node = self.nodes.get(index.0)?;
            let missing = node.is_missing() && node.missing_since <= Some(bus.heard_at);
            (!missing && node.is_expected(def)).then_some(&def.canopen)
        });
        silence(expected)
    }

    /// Frames come again, or can come again, after nobody could be heard. What was known of the nodes' absence says
    /// nothing any more: each has the time that it may be silent for to show itself, and until then the end of the
    /// bus's own alarm does not raise theirs.
    fn begin_anew(&mut self, now: Now, index: BusIndex) {
        let Some(bus) = self.buses.get_mut(index.0) else { return };
        bus.back_at = Some(now.instant);
        for node in bus.members.clone() {
            let owner = AlarmOwner::Node(node);
            self.conditions.set(now, owner, BuiltIn::NodeLost, false);
            self.conditions.set(now, owner, BuiltIn::NodeNeverSeen, false);
        }
    }

    pub(super) fn bus_frame(&mut self, now: Now, index: BusIndex, frame: &CanFrame) {
        let was_quiet = self.silent_from(now, index).is_some();
        let Some(bus) = self.buses.get_mut(index.0) else { return };
        let was_silent = bus.silent;
        bus.listen_from(now.instant);
        bus.ever_heard = true;
        if was_silent {
            self.begin_anew(now, index);
            self.conditions.set(now, AlarmOwner::Bus(index), BuiltIn::BusSilent, false);
            self.tell_bus(now, index, "bus_heard", |_| ());
        }
        if let Some(bus) = self.buses.get_mut(index.0) {
            bus.network.handle_frame(now, frame);
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
            bus.listen_from(now.instant);
            bus.network.handle_link(now, up);
        }
        let never_heard = !bus.ever_heard;
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
        if up && !was_up {
            self.begin_anew(now, index);
        }
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
            bus.status.frames_not_sent = bus.status.frames_not_sent.saturating_add(1);
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
        if new_errors > 0 && counters.bit_rate_is_suspect() {
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
        let silence = self.silence_of(bus);
        let Some(bus) = self.buses.get_mut(index.0) else { return };
        match silence {
            Some(silence) if bus.heard_at + silence <= now.instant => {
                bus.silent = true;
                self.conditions.set(now, AlarmOwner::Bus(index), BuiltIn::BusSilent, true);
                self.tell_bus(now, index, "bus_silent", |event| {
                    event.text = format!("no frame from anyone for {silence:?}");
                });
            }
            Some(silence) => bus.look_at = bus.heard_at + silence,
            None => bus.look_at = now.instant + bus.shortest_silence,
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

    pub(super) fn count_foreign_frame(&mut self, index: BusIndex) {
        if let Some(bus) = self.buses.get_mut(index.0) {
            bus.foreign = bus.foreign.saturating_add(1);
            bus.status.foreign_frames = bus.status.foreign_frames.saturating_add(1);
            self.dirty_buses.mark(index.0);
        }
    }

    fn foreign_event(&mut self, now: Now, index: BusIndex, event: &ForeignEvent) {
        match event {
            ForeignEvent::NmtCommand { command, node } => {
                self.foreign_master(now, index);
                self.tell_bus(now, index, "foreign_nmt_command", |event| {
                    event.value = Some(Value::Unsigned((*command).into()));
                    event.text =
                        format!("somebody else sent NMT command 0x{command:02X} to node {node} (0 = all)");
                });
            }
            ForeignEvent::Sync { produced, first } => {
                // Somebody who was told of is nobody to tell of.
                let def = self.table.buses.get(index.0);
                if *produced || def.is_none_or(|bus| bus.sync.is_none()) {
                    self.foreign_broadcast(now, index, "SYNC", *produced, *first);
                }
            }
            ForeignEvent::Time { produced, first } => {
                self.foreign_broadcast(now, index, "TIME", *produced, *first);
            }
            ForeignEvent::Lss => {
                self.foreign_master(now, index);
                self.tell_bus(now, index, "foreign_lss", |event| {
                    event.text =
                        "somebody else looks for devices by LSS, or changes a node id or bit rate".into();
                });
            }
            ForeignEvent::UnknownId { id, node, first } => {
                self.count_foreign_frame(index);
                if *first {
                    let node = *node;
                    let known = node.is_some_and(|node| self.is_configured(index, node));
                    self.tell_bus(now, index, "unknown_id", |event| {
                        event.value = Some(Value::Unsigned(id.raw().into()));
                        event.text = stranger(*id, node, known);
                    });
                }
            }
        }
    }

    /// SYNC or TIME of somebody else: of a second producer, or of one that the configuration does not know.
    fn foreign_broadcast(
        &mut self,
        now: Now,
        index: BusIndex,
        what: &'static str,
        produced: bool,
        first: bool,
    ) {
        self.count_foreign_frame(index);
        if produced {
            self.conditions.pulse(now, AlarmOwner::Bus(index), BuiltIn::ForeignProducer);
            let name = if what == "SYNC" { "foreign_sync" } else { "foreign_time" };
            self.tell_bus(now, index, name, |event| {
                event.text = format!("somebody else sends {what}, which this gateway sends too");
            });
        } else if first {
            self.tell_bus(now, index, "unknown_id", |event| {
                event.text = format!("{what} comes from somebody else");
            });
        }
    }

    /// Somebody else does what a master does. In the passive role that is as it should be.
    pub(super) fn foreign_master(&mut self, now: Now, index: BusIndex) {
        if self.buses.get(index.0).is_some_and(|bus| bus.role == Role::Master) {
            self.conditions.pulse(now, AlarmOwner::Bus(index), BuiltIn::ForeignMaster);
        }
    }

    fn is_configured(&self, index: BusIndex, node: NodeId) -> bool {
        let bus = self.buses.get(index.0);
        bus.and_then(|bus| bus.by_id.get(usize::from(node.get()))).is_some_and(Option::is_some)
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

/// What the first frame of an identifier of nobody's may mean. `known`: its node id is that of a configured node.
fn stranger(id: CanId, node: Option<NodeId>, known: bool) -> String {
    let Some(node) = node else { return format!("{id} belongs to no configured node") };
    if known && is_rpdo(id) {
        return format!("somebody else sends node {node} process data, {id}");
    }
    if known {
        return format!(
            "{id} stands for node {node}, but the mapping of that node does not know it: it leaves something out, or \
             another device has the same node id"
        );
    }
    if id == cob_id::error_control(node) {
        return format!(
            "{id} is a heartbeat, boot-up message or guard request of node {node}, which is not configured: another \
             master, or a device that the configuration leaves out"
        );
    }
    format!("{id} comes from node {node}, which is not configured")
}

/// Whether an identifier is that of an RPDO of the predefined connection set: what a master sends its nodes.
fn is_rpdo(id: CanId) -> bool {
    matches!(id, CanId::Standard(id) if matches!(id >> 7, 4 | 6 | 8 | 10))
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
