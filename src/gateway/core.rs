//! The gateway's four verbs.

use std::collections::VecDeque;
use std::sync::Arc;

use super::allowed_frames::AllowedFrames;
use super::bus::Bus;
use super::conditions::Conditions;
use super::events::{EventLog, Name};
use super::intruders::Intruders;
use super::lines::Lines;
use super::marks::Marks;
use super::node::Node;
use super::objects::Transfers;
use super::operate::Finished;
use super::supply::Supply;
use super::tags::{CarrierIndex, Tags};
use super::{Command, Outcome, Refused};
use crate::can::{BusEvent, BusIndex, CanFrame};
use crate::canopen::{PdoIndex, Role};
use crate::mapping::{AlarmOwner, BuiltIn, TagTable};
use crate::process_image::{
    Journal, NodeIndex, ProcessImage, Quality, Revision, SerialLine, SessionTrouble, Value,
};
use crate::time::{Instant, Now};

/// What the gateway is told.
#[derive(Clone, Debug, PartialEq)]
pub enum Input {
    /// Something happened on a bus; the event carries its own time.
    Bus {
        /// Which bus.
        bus: BusIndex,
        /// What.
        event: BusEvent,
    },
    /// A northbound asks for something.
    Command(Command),
    /// Northbounds refused requests for want of a right.
    Refused(Vec<Refused>),
    /// How the rest of the program is.
    Health(Health),
}

/// A certificate that is valid for fewer days is told of (G06).
const DAYS_TO_EXPIRY: i64 = 30;
/// And for fewer than these, urgently.
const DAYS_TO_EXPIRY_SOON: i64 = 7;

/// How the rest of the program is.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Health {
    /// The MQTT session is up; `None` where MQTT is not configured.
    pub mqtt_connected: Option<bool>,
    /// The wall clock is synchronised.
    pub clock_synchronised: bool,
    /// Why there is no MQTT session, where that is known.
    pub mqtt_trouble: Option<SessionTrouble>,
    /// Whole days until the first certificate expires, negative once it has; `None` where there is none.
    pub certificate_days: Option<i64>,
    /// What is kept for the broker fills four fifths of its room.
    pub buffer_filling: bool,
    /// The disk that it is kept on cannot be used.
    pub buffer_fault: bool,
}

/// What the gateway wants done.
#[derive(Clone, Debug, PartialEq)]
pub enum Output {
    /// Send a frame.
    Transmit {
        /// On which bus.
        bus: BusIndex,
        /// It.
        frame: CanFrame,
    },
    /// Answer a command.
    Reply {
        /// Its id.
        id: u64,
        /// What came of it.
        outcome: Outcome,
    },
}

/// The core of the program.
#[derive(Debug)]
pub struct Gateway {
    pub(super) table: Arc<TagTable>,
    pub(super) allowed: AllowedFrames,
    pub(super) buses: Vec<Bus>,
    pub(super) nodes: Vec<Node>,
    pub(super) tags: Tags,
    pub(super) supply: Supply,
    pub(super) lines: Lines,
    pub(super) conditions: Conditions,
    pub(super) events: EventLog,
    /// Number of the newest event before the start.
    newest_event: u64,
    pub(super) health: Health,
    /// Nodes of which a tag changed, while one input is worked off.
    changed_nodes: Marks,
    pub(super) dirty_nodes: Marks,
    pub(super) dirty_buses: Marks,
    /// Taken after each input, so that it holds what one input causes and no more.
    pub(super) outputs: VecDeque<Output>,
    /// Commands that are answered when all outputs were taken. No more than were asked for by one input.
    pub(super) finished: Vec<Finished>,
    pub(super) transfers: Transfers,
    pub(super) intruders: Intruders,
    /// When alarms that are held back are to be looked at again.
    pub(super) next_look: Option<Instant>,
    /// When the data of a TPDO may be too old.
    pub(super) next_expiry: Option<Instant>,
}

impl Gateway {
    /// A gateway that has seen nothing yet.
    #[must_use]
    pub fn new(table: Arc<TagTable>, now: Now) -> Self {
        Self::after_event(table, now, 0)
    }

    /// The same, whose first event has the number `newest_event` + 1.
    #[must_use]
    pub fn after_event(table: Arc<TagTable>, now: Now, newest_event: u64) -> Self {
        let mut gateway = Self::bare(table, now);
        gateway.newest_event = newest_event;
        gateway.events = EventLog::new(Arc::clone(&gateway.table), newest_event);
        gateway.events.record(now, AlarmOwner::Gateway, Name::Word("gateway_started"), |_| ());
        gateway.begin(now, |_| true);
        gateway
    }

    /// Nothing was asked of its networks yet, and nothing told.
    pub(super) fn bare(table: Arc<TagTable>, now: Now) -> Self {
        let buses = (0..table.buses.len()).map(|bus| Bus::new(&table, BusIndex(bus), now)).collect();
        let is_passive = |bus: BusIndex| table.buses.get(bus.0).is_none_or(|bus| bus.role == Role::Passive);
        let nodes: Vec<Node> = table.nodes.iter().map(|node| Node::new(node, is_passive(node.bus))).collect();
        let mut gateway = Self {
            allowed: AllowedFrames::new(&table),
            buses,
            tags: Tags::new(&table, now),
            supply: Supply::new(&table),
            lines: Lines::new(&table, now),
            conditions: Conditions::new(&table),
            events: EventLog::new(Arc::clone(&table), 0),
            newest_event: 0,
            health: Health::default(),
            changed_nodes: Marks::new(nodes.len()),
            dirty_nodes: Marks::new(nodes.len()),
            dirty_buses: Marks::new(table.buses.len()),
            outputs: VecDeque::new(),
            finished: Vec::new(),
            transfers: Transfers::default(),
            intruders: Intruders::default(),
            next_look: None,
            next_expiry: None,
            nodes,
            table,
        };
        gateway.believe_mappings(now);
        gateway.begin_supply(now);
        gateway
    }

    /// The nodes of a bus are made up by a simulator: status bit 6 of their node blocks says so.
    pub fn mark_simulated(&mut self, bus: BusIndex) {
        for (place, (node, def)) in self.nodes.iter_mut().zip(&self.table.nodes).enumerate() {
            if def.bus == bus {
                node.status.simulated = true;
                self.dirty_nodes.mark(place);
            }
        }
    }

    /// An image of the right size that shows what is known now; right after [`new`](Self::new): nothing.
    #[must_use]
    pub fn empty_image(&self) -> ProcessImage {
        let table = &self.table;
        let mut image = ProcessImage::new(0, 0, 0, table.alarms.len());
        image.tags = self.tags.shown(table);
        image.units = self.tags.units_shown();
        image.nodes = self.nodes.iter().map(|node| node.status.clone()).collect();
        image.buses = self.buses.iter().map(|bus| bus.status).collect();
        image.lines = vec![SerialLine::default(); table.lines.len()];
        image.journal = Journal::after_number(self.newest_event);
        image
    }

    /// Takes what came in.
    pub fn handle_input(&mut self, now: Now, input: Input) {
        match input {
            Input::Bus { bus, event } => self.bus_event(bus, &event),
            Input::Command(command) => self.command(now, command),
            Input::Refused(refused) => self.requests_refused(now, refused),
            Input::Health(health) => self.set_health(now, health),
        }
    }

    /// The queue of frames to a bus was full, so that a frame of ours could not even be handed over.
    /// To be told before the next [`poll_output`](Self::poll_output): a command whose frame it was is answered "busy".
    pub fn handle_refused(&mut self, now: Now, bus: BusIndex, frame: &CanFrame) {
        self.refuse_command(now, bus, frame);
        self.bus_refused(now, bus, frame);
        self.settle(now);
    }

    /// What the clock shows. Events that waited are told of with the times at which they happened; what leaves meanwhile leaves
    /// now. To be told before events that may have waited.
    pub fn handle_clock(&mut self, now: Now) {
        for bus in &mut self.buses {
            bus.modules.handle_clock(now);
        }
    }

    /// What became due.
    pub fn handle_timeout(&mut self, now: Now) {
        for bus in (0..self.buses.len()).map(BusIndex) {
            // First the bus, then its nodes: the cause before what follows from it.
            self.check_silence(now, bus);
            let network = self.buses.get_mut(bus.0).map(|bus| &mut bus.network);
            if let Some(network) = network
                && network.poll_timeout().is_some_and(|(due, _)| due <= now.instant)
            {
                network.handle_timeout(now);
                self.drain_network(now, bus);
            }
            let modules = self.buses.get_mut(bus.0).map(|bus| &mut bus.modules);
            if let Some(modules) = modules
                && modules.poll_timeout().is_some_and(|(due, _)| due <= now.instant)
            {
                modules.handle_timeout(now);
                self.drain_modules(now, bus);
            }
        }
        self.look_at_lines(now);
        if self.next_look.is_some_and(|due| due <= now.instant) {
            self.next_look = None;
            for node in (0..self.nodes.len()).map(NodeIndex) {
                self.refresh_node(now, node);
            }
        }
        self.expire_data(now);
        self.look_at_intruders(now);
        self.tags.handle_timeout(&self.table, now);
        self.conditions.handle_timeout(now);
        self.events.handle_timeout(now);
        self.settle(now);
    }

    /// What is to be done; call until `None`.
    pub fn poll_output(&mut self) -> Option<Output> {
        if self.outputs.is_empty() {
            self.answer_commands();
        }
        self.outputs.pop_front()
    }

    /// When `handle_timeout` is to be called at the latest, and why.
    #[must_use]
    pub fn poll_timeout(&self) -> Option<(Instant, &'static str)> {
        let networks = self.buses.iter().filter_map(|bus| bus.network.poll_timeout());
        let modules = self.buses.iter().filter_map(|bus| bus.modules.poll_timeout());
        let silences = self.buses.iter().filter_map(|bus| Some((bus.silent_at()?, "bus silence")));
        let own = [
            (self.next_look, "alarm held back"),
            (self.next_expiry, "data too old"),
            (self.tags.poll_timeout(), "next second"),
            (self.lines.poll_timeout(), "serial lines"),
            (self.conditions.poll_timeout(), "alarm delay"),
            (self.events.poll_timeout(), "folded events"),
            (self.intruders.poll_timeout(), "refused requests"),
        ];
        let own = own.into_iter().filter_map(|(due, why)| Some((due?, why)));
        networks.chain(modules).chain(silences).chain(own).min_by_key(|(due, _)| *due)
    }

    /// Copies all that changed since the last call into the image, and appends the new events to its journal.
    /// The revision counts up where a reader has something new to see; that the same value came again, and the
    /// counters and times that move with every frame, are copied too but wake nobody.
    /// Allocates nothing when only values changed.
    pub fn publish(&mut self, image: &mut ProcessImage) {
        let revision = Revision(image.revision.0 + 1);
        let mut moved = self.tags.publish(&self.table, image, revision);
        moved |= self.tags.units().publish(image);
        for place in self.dirty_nodes.drain() {
            let (Some(node), Some(shown)) = (self.nodes.get(place), image.nodes.get_mut(place)) else {
                continue;
            };
            moved |= shown.update(&node.status, revision);
        }
        for place in self.dirty_buses.drain() {
            if let (Some(bus), Some(shown)) = (self.buses.get(place), image.buses.get_mut(place)) {
                moved |= *shown != bus.status;
                *shown = bus.status;
            }
        }
        moved |= self.lines.publish(image);
        moved |= self.conditions.publish(&mut image.alarms, revision);
        for event in self.events.drain() {
            image.journal.append(event);
            moved = true;
        }
        let mqtt_connected = self.health.mqtt_connected == Some(true);
        moved |= image.mqtt_connected != mqtt_connected;
        moved |= image.clock_synchronised != self.health.clock_synchronised;
        image.mqtt_connected = mqtt_connected;
        image.clock_synchronised = self.health.clock_synchronised;
        if moved {
            image.revision = revision;
        }
    }

    fn bus_event(&mut self, bus: BusIndex, event: &BusEvent) {
        let at = match *event {
            BusEvent::Frame { frame, at } => {
                self.bus_frame(at, bus, &frame);
                at
            }
            BusEvent::Link { link, at } => {
                self.bus_link(at, bus, link);
                at
            }
            // Time comes no further by that: frames that were received before it may still wait.
            BusEvent::Sent { frame, at } => return self.bus_sent(at, bus, &frame),
            BusEvent::NotSent { frame, at } => {
                self.bus_not_sent(at, bus, &frame);
                at
            }
            BusEvent::Counters { counters, at } => {
                self.bus_counters(at, bus, counters);
                at
            }
        };
        self.settle(at);
    }

    fn set_health(&mut self, now: Now, health: Health) {
        let before = std::mem::replace(&mut self.health, health);
        let word = |up| match up {
            None => "not_configured",
            Some(false) => "disconnected",
            Some(true) => "connected",
        };
        if before.mqtt_connected != health.mqtt_connected {
            self.events.record(now, AlarmOwner::Gateway, Name::Word("mqtt"), |event| {
                word(before.mqtt_connected).clone_into(&mut event.from);
                word(health.mqtt_connected).clone_into(&mut event.to);
                let trouble = health.mqtt_trouble.filter(|_| health.mqtt_connected == Some(false));
                trouble.map(SessionTrouble::meaning).unwrap_or_default().clone_into(&mut event.text);
            });
        }
        for bus in (0..self.buses.len()).map(BusIndex) {
            if let Some(bus) = self.buses.get_mut(bus.0) {
                bus.network.handle_clock(now, health.clock_synchronised);
            }
        }
        self.judge_health(now, health);
        self.settle(now);
    }

    /// The alarms of the gateway itself.
    fn judge_health(&mut self, now: Now, health: Health) {
        let down = health.mqtt_connected == Some(false);
        match health.mqtt_trouble.filter(|_| down) {
            Some(trouble) => {
                let why = Some(Value::Unsigned(trouble.code().into()));
                self.conditions.set_with(now, AlarmOwner::Gateway, BuiltIn::MqttDown, why);
            }
            None => self.conditions.set(now, AlarmOwner::Gateway, BuiltIn::MqttDown, down),
        }
        self.conditions.set(now, AlarmOwner::Gateway, BuiltIn::BufferFilling, health.buffer_filling);
        self.conditions.set(now, AlarmOwner::Gateway, BuiltIn::BufferFault, health.buffer_fault);
        let days = health.certificate_days;
        for (condition, range) in [
            (BuiltIn::CertificateExpires, DAYS_TO_EXPIRY_SOON..DAYS_TO_EXPIRY),
            (BuiltIn::CertificateExpiresSoon, 0..DAYS_TO_EXPIRY_SOON),
            (BuiltIn::CertificateExpired, i64::MIN..0),
        ] {
            let left = days.filter(|days| range.contains(days)).map(Value::Signed);
            self.conditions.set_with(now, AlarmOwner::Gateway, condition, left);
        }
    }

    /// The tags of a node, or of one of its TPDOs, can be trusted less.
    pub(super) fn degrade(&mut self, now: Now, node: NodeIndex, pdo: Option<PdoIndex>, quality: Quality) {
        let carrier = pdo.map(CarrierIndex::from);
        self.tags.degrade(&self.table, now, node, carrier, quality);
        self.dirty_nodes.mark(node.0);
        if let Some(node) = self.nodes.get_mut(node.0)
            && !quality.is_usable()
        {
            node.lose_data_of(pdo);
        }
    }

    /// Carries changes of tags on to the alarms, and those of alarms to the journal.
    pub(super) fn settle(&mut self, now: Now) {
        for (tag, level) in self.tags.drain_edges() {
            let Some(def) = self.table.tag(tag) else { continue };
            self.events.record(now, AlarmOwner::Node(def.node), Name::Edge(tag), |event| {
                event.from = (!level).to_string();
                event.to = level.to_string();
            });
        }
        for tag in self.tags.drain_changed() {
            self.conditions.tag_changed(tag);
            if let Some(def) = self.table.tag(tag) {
                self.changed_nodes.mark(def.node.0);
            }
        }
        for place in self.changed_nodes.drain() {
            if let Some(node) = self.nodes.get_mut(place) {
                node.status.data_good = self.tags.all_good(NodeIndex(place));
                node.status.generation = node.status.generation.wrapping_add(1);
            }
            self.dirty_nodes.mark(place);
        }
        self.conditions.evaluate(now, &self.table, self.tags.samples());
        while let Some(transition) = self.conditions.poll_transition() {
            self.events.record_transition(&transition);
        }
    }
}

#[cfg(test)]
#[path = "core_tests.rs"]
mod tests;
