//! One bus: its link, its frames, its counters. Its silence is in [`silence`](super::silence), what is nobody's in
//! [`foreign`](super::foreign).

use std::collections::BTreeSet;
use std::time::Duration;

use super::events::Name;
use super::silence::{SILENCE, silence};
use super::{Gateway, Output, modules};
use crate::can::{BusCounters, BusIndex, CanFrame, CanId, Link};
use crate::canopen::{Network, NetworkOutput, NetworkSettings, NodeSettings, Role};
use crate::esd;
use crate::mapping::{AlarmOwner, BuiltIn, TagTable};
use crate::process_image::{BusState, BusStatus, Event, NodeIndex, Quality, Reason, Value};
use crate::time::{Instant, Now};

/// The load is too high above this many tenths of a percent (B06).
const HIGH_LOAD_PERMILLE: u16 = 800;

/// Rates are computed from counters at least this far apart.
const RATE_INTERVAL: Duration = Duration::from_millis(500);

/// A bus with its network.
#[derive(Debug)]
pub(super) struct Bus {
    pub(super) network: Network,
    /// Those of its nodes that are esd modules.
    pub(super) modules: esd::Network,
    /// By [`esd::ModuleIndex`].
    pub(super) module_nodes: Vec<NodeIndex>,
    /// Identifiers of what goes to serial lines.
    pub(super) line_ids: BTreeSet<CanId>,
    pub(super) status: BusStatus,
    pub(super) role: Role,
    pub(super) link: Option<Link>,
    /// By node id.
    pub(super) by_id: Vec<Option<NodeIndex>>,
    pub(super) members: Vec<NodeIndex>,
    /// When a frame came last, or since when frames can come.
    pub(super) heard_at: Instant,
    pub(super) ever_heard: bool,
    pub(super) silent: bool,
    /// Silence is not looked for before so much of it, whichever nodes are expected.
    pub(super) shortest_silence: Duration,
    /// When it is looked for next, if no frame comes until then.
    pub(super) look_at: Instant,
    /// When frames came again after the bus was silent or could not be used.
    pub(super) back_at: Option<Instant>,
    pub(super) counters: BusCounters,
    pub(super) counted_at: Option<Instant>,
    /// Frames for which the queue to the bus was full.
    pub(super) refused: u64,
    /// 29-bit and remote frames on identifiers of configured nodes, and frames of unknown identifiers.
    pub(super) foreign: u64,
}

impl Bus {
    pub(super) fn new(table: &TagTable, index: BusIndex, now: Now) -> Self {
        let def = table.buses.get(index.0);
        let role = def.map_or(Role::Passive, |bus| bus.role);
        let mut by_id = vec![None; 128];
        let mut members = Vec::new();
        let mut nodes: Vec<NodeSettings> = Vec::new();
        for (place, node) in table.nodes.iter().enumerate().filter(|(_, node)| node.bus == index) {
            members.push(NodeIndex(place));
            let Some(canopen) = node.canopen() else { continue };
            if let Some(entry) = by_id.get_mut(usize::from(canopen.id.get())) {
                *entry = Some(NodeIndex(place));
            }
            nodes.push(canopen.clone());
        }
        let of_bus = table.nodes.iter().filter(|node| node.bus == index);
        let shortest_silence = silence(of_bus).unwrap_or(SILENCE);
        let (module_settings, module_nodes) = modules::settings(table, index);
        let channels = module_settings.modules.iter().flat_map(|module| &module.channels);
        Self {
            line_ids: channels.map(|channel| channel.rx_id).collect(),
            modules: esd::Network::new(module_settings, now),
            module_nodes,
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
            if bus.modules.owns(frame.id()) {
                bus.modules.handle_frame(now, frame);
            } else {
                bus.network.handle_frame(now, frame);
            }
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
            bus.modules.handle_link(now, up);
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
            self.show_module_lines((now, node));
        }
        self.drain_network(now, index);
        self.refresh_nodes_of(now, index);
    }

    /// The interface took a frame: lines of modules are paced by that.
    pub(super) fn bus_sent(&mut self, now: Now, index: BusIndex, frame: &CanFrame) {
        if !self.can_wait(index, frame) {
            return;
        }
        if let Some(bus) = self.buses.get_mut(index.0) {
            bus.modules.handle_sent(now, frame);
        }
        self.drain_modules(now, index);
        self.settle(now);
    }

    pub(super) fn bus_not_sent(&mut self, now: Now, index: BusIndex, frame: &CanFrame) {
        let Some(bus) = self.buses.get_mut(index.0) else { return };
        if bus.modules.owns(frame.id()) {
            bus.modules.handle_not_sent(now, frame);
        } else {
            bus.network.handle_not_sent(now, frame);
        }
        self.tell_bus(now, index, "frame_not_sent", |event| {
            event.text = format!("{frame} did not leave");
        });
        self.drain_network(now, index);
    }

    /// Whether a frame carries bytes for a serial line: they can wait, and are to leave room for what cannot.
    #[must_use]
    pub fn can_wait(&self, index: BusIndex, frame: &CanFrame) -> bool {
        self.buses.get(index.0).is_some_and(|bus| bus.line_ids.contains(&frame.id()))
    }

    /// The queue of frames to a bus is full.
    pub(super) fn bus_refused(&mut self, now: Now, index: BusIndex, frame: &CanFrame) {
        if self.can_wait(index, frame) {
            // It is tried again soon: nothing is lost.
            if let Some(bus) = self.buses.get_mut(index.0) {
                bus.modules.handle_not_sent(now, frame);
            }
            return self.drain_modules(now, index);
        }
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

    /// The one way out: what the configuration does not allow is dropped. In the passive role that is everything.
    pub(super) fn transmit(&mut self, index: BusIndex, frame: CanFrame) {
        let Some(bus) = self.buses.get_mut(index.0) else { return };
        if let Some(kind) = self.allowed.permit(index, &frame) {
            bus.status.sent.count(kind);
            self.outputs.push_back(Output::Transmit { bus: index, frame });
        } else if bus.role == Role::Master {
            bus.status.frames_blocked = bus.status.frames_blocked.saturating_add(1);
            self.dirty_buses.mark(index.0);
            let bus = self.table.buses.get(index.0).map_or("", |bus| bus.name.as_str());
            tracing::error!(bus, %frame, "not sent, because the configuration does not allow it: this is a bug in cangate");
        }
    }

    /// Takes what the networks of a bus have to say.
    pub(super) fn drain_network(&mut self, now: Now, index: BusIndex) {
        while let Some(bus) = self.buses.get_mut(index.0)
            && let Some(output) = bus.network.poll_output()
        {
            match output {
                NetworkOutput::Transmit(frame) => self.transmit(index, frame),
                NetworkOutput::Node(id, event) => {
                    if let Some(Some(node)) = bus.by_id.get(usize::from(id.get())).copied() {
                        self.node_event(now, node, &event);
                    }
                }
                NetworkOutput::Foreign(event) => self.foreign_event(now, index, &event),
            }
        }
        self.drain_modules(now, index);
    }

    pub(super) fn refresh_nodes_of(&mut self, now: Now, index: BusIndex) {
        let members = self.buses.get(index.0).map_or(0, |bus| bus.members.len());
        for place in 0..members {
            let member = self.buses.get(index.0).and_then(|bus| bus.members.get(place)).copied();
            if let Some(member) = member {
                self.refresh_node(now, member);
                self.refresh_lines((now, member));
            }
        }
    }

    pub(super) fn tell_bus(
        &mut self,
        now: Now,
        index: BusIndex,
        name: &'static str,
        fill: impl FnOnce(&mut Event),
    ) {
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
