//! The event ring: the last 32 events, in registers of the gateway's unit, readable without any write.
//!
//! An event keeps its place, sequence number modulo 32, until the event 32 numbers later takes it. A client reads the
//! newest sequence number, then the places that it has not seen; a record carries its own number, so that a client that
//! was too slow notices.

use std::collections::BTreeMap;

use super::encoding::{Cell, low_16};
use crate::mapping::{AlarmCondition, AlarmDef, AlarmOwner, BuiltIn, TagTable};
use crate::process_image::{
    AlarmIndex, AlarmState, BusState, Event, EventKind, Journal, NmtState, Priority, ProcessImage,
};

/// Address of the newest sequence number.
pub const ADDRESS: u16 = 200;
/// Address of the first record.
pub const FIRST_RECORD: u16 = 202;
/// Registers of a record.
pub const RECORD: u16 = 12;
/// Records.
pub const RECORDS: u16 = 32;

/// A field of a record.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum EventField {
    /// Sequence number, low 32 bits; 0 = empty.
    Sequence,
    /// UTC seconds.
    Seconds,
    /// Milliseconds within the second.
    Millis,
    /// [`EventKind::code`].
    Kind,
    /// CANopen node id, 0 = none.
    NodeId,
    /// Bus, counted from 1, 0 = none.
    Bus,
    /// Alarm: 0-31 the node's alarm bit, 101-107 a bus alarm, 201 the gateway's; 65535 = none.
    Alarm,
    /// Place within an array of alarms, counted from 1; 0 = no array.
    Instance,
    /// New state; 65535 = none.
    State,
    /// Priority, 0 = none.
    Priority,
}

/// The fields and where in a record they begin.
pub const FIELDS: [(u16, EventField); 10] = [
    (0, EventField::Sequence),
    (2, EventField::Seconds),
    (4, EventField::Millis),
    (5, EventField::Kind),
    (6, EventField::NodeId),
    (7, EventField::Bus),
    (8, EventField::Alarm),
    (9, EventField::Instance),
    (10, EventField::State),
    (11, EventField::Priority),
];

impl EventField {
    /// Registers that it takes.
    #[must_use]
    pub fn count(self) -> u16 {
        if matches!(self, Self::Sequence | Self::Seconds) { 2 } else { 1 }
    }

    /// What it shows when there is no event.
    fn empty(self) -> Cell {
        if self.count() == 2 { Cell::Double(0) } else { Cell::Word(0) }
    }
}

/// What an event's names stand for in numbers; made once.
#[derive(Clone, Debug, Default)]
pub struct EventCodes {
    /// Node id and bus of each node.
    nodes: BTreeMap<String, (u16, u16)>,
    /// Each bus, counted from 1.
    buses: BTreeMap<String, u16>,
    /// Code and instance, by [`AlarmIndex`].
    alarms: Vec<(u16, u16)>,
}

impl EventCodes {
    /// Those of an installation.
    #[must_use]
    pub fn new(table: &TagTable) -> Self {
        let number = |place: usize| u16::try_from(place + 1).unwrap_or(u16::MAX);
        let node = |node: &crate::mapping::NodeDef| (u16::from(node.number()), number(node.bus.0));
        Self {
            nodes: table.nodes.iter().map(|def| (def.name.clone(), node(def))).collect(),
            buses: table
                .buses
                .iter()
                .enumerate()
                .map(|(place, bus)| (bus.name.clone(), number(place)))
                .collect(),
            alarms: table.alarms.iter().map(|alarm| (alarm_code(alarm), instance(table, alarm))).collect(),
        }
    }

    /// The number of an alarm, by its place in the table.
    #[must_use]
    pub fn code(&self, alarm: usize) -> Option<u16> {
        self.alarms.get(alarm).map(|(code, _)| *code)
    }

    /// A field of the record at `place`, 0..32.
    #[must_use]
    pub fn register(&self, image: &ProcessImage, place: u16, field: EventField) -> Cell {
        let Some(event) = event_at(&image.journal, place) else { return field.empty() };
        match field {
            EventField::Sequence => Cell::low_double(event.seq),
            EventField::Seconds => Cell::low_double(event.ts.as_secs().max(0).unsigned_abs()),
            EventField::Millis => Cell::Word(low_16(event.ts.subsec_millis().unsigned_abs())),
            EventField::Kind => Cell::Word(event.kind.code()),
            EventField::NodeId => Cell::Word(self.node_and_bus(event).0),
            EventField::Bus => Cell::Word(self.node_and_bus(event).1),
            EventField::Alarm => Cell::Word(self.alarm(event).map_or(u16::MAX, |(code, _)| code)),
            EventField::Instance => Cell::Word(self.alarm(event).map_or(0, |(_, instance)| instance)),
            EventField::State => Cell::Word(state_code(event).unwrap_or(u16::MAX)),
            EventField::Priority => Cell::Word(event.priority.map_or(0, Priority::code)),
        }
    }

    fn node_and_bus(&self, event: &Event) -> (u16, u16) {
        let node = event.node.as_ref().and_then(|name| self.nodes.get(name)).copied();
        let bus = event.bus.as_ref().and_then(|name| self.buses.get(name)).copied();
        node.unwrap_or((0, bus.unwrap_or(0)))
    }

    fn alarm(&self, event: &Event) -> Option<(u16, u16)> {
        let AlarmIndex(index) = event.alarm?;
        self.alarms.get(index).copied()
    }
}

/// The newest event whose sequence number is `place` modulo 32, where it is among the last 32.
fn event_at(journal: &Journal, place: u16) -> Option<&Event> {
    let records = u64::from(RECORDS);
    let back = (journal.newest() % records + records - u64::from(place)) % records;
    let event = journal.newest_first().nth(usize::try_from(back).ok()?)?;
    (event.seq % records == u64::from(place)).then_some(event)
}

/// The number of an alarm that does not depend on what else is configured.
fn alarm_code(alarm: &AlarmDef) -> u16 {
    if let (AlarmOwner::Node(_), Some(bit)) = (alarm.owner, alarm.bit) {
        return u16::from(bit);
    }
    match alarm.condition {
        AlarmCondition::BuiltIn(BuiltIn::BusOff) => 101,
        AlarmCondition::BuiltIn(BuiltIn::InterfaceDown) => 102,
        AlarmCondition::BuiltIn(BuiltIn::BusSilent) => 103,
        AlarmCondition::BuiltIn(BuiltIn::ErrorPassive) => 104,
        AlarmCondition::BuiltIn(BuiltIn::FramesLost) => 105,
        AlarmCondition::BuiltIn(BuiltIn::HighLoad) => 106,
        AlarmCondition::BuiltIn(BuiltIn::ForeignMaster) => 107,
        AlarmCondition::BuiltIn(BuiltIn::ForeignProducer) => 108,
        AlarmCondition::BuiltIn(BuiltIn::MqttDown) => 201,
        AlarmCondition::BuiltIn(BuiltIn::ConfigurationRejected) => 203,
        AlarmCondition::BuiltIn(BuiltIn::CertificateExpires) => 211,
        AlarmCondition::BuiltIn(BuiltIn::CertificateExpiresSoon) => 212,
        AlarmCondition::BuiltIn(BuiltIn::CertificateExpired) => 213,
        AlarmCondition::BuiltIn(BuiltIn::AccessRefused) => 202,
        AlarmCondition::BuiltIn(BuiltIn::BufferFilling) => 204,
        AlarmCondition::BuiltIn(BuiltIn::BufferFault) => 205,
        AlarmCondition::BuiltIn(_) | AlarmCondition::Tags(_) => u16::MAX,
    }
}

/// Place among the alarms that share its bit, counted from 1; 0 for one that stands alone.
fn instance(table: &TagTable, alarm: &AlarmDef) -> u16 {
    let group = table
        .alarms
        .iter()
        .filter(|other| alarm.bit.is_some() && other.owner == alarm.owner && other.bit == alarm.bit);
    if group.clone().count() < 2 {
        return 0;
    }
    let place = group.take_while(|other| other.name != alarm.name).count();
    u16::try_from(place + 1).unwrap_or(u16::MAX)
}

/// The new state as a number: of an alarm, of a bus, or the NMT state of a node.
fn state_code(event: &Event) -> Option<u16> {
    match event.kind {
        EventKind::Alarm => {
            ALARM_STATES.iter().find(|state| state.word() == event.to).map(|state| state.code())
        }
        EventKind::Bus => BUS_STATES.iter().find(|state| state.word() == event.to).map(|state| state.code()),
        EventKind::Node => {
            NMT_STATES.iter().find(|state| state.word() == event.to).map(|state| u16::from(state.code()))
        }
        EventKind::Command | EventKind::Gateway => None,
    }
}

const ALARM_STATES: [AlarmState; 9] = [
    AlarmState::Normal,
    AlarmState::Unacknowledged,
    AlarmState::Acknowledged,
    AlarmState::ReturnedUnacknowledged,
    AlarmState::LatchedUnacknowledged,
    AlarmState::LatchedAcknowledged,
    AlarmState::Shelved,
    AlarmState::Suppressed,
    AlarmState::OutOfService,
];

const BUS_STATES: [BusState; 5] =
    [BusState::Absent, BusState::Down, BusState::BusOff, BusState::ErrorPassive, BusState::ErrorActive];

const NMT_STATES: [NmtState; 4] =
    [NmtState::Initialising, NmtState::Stopped, NmtState::Operational, NmtState::PreOperational];
