//! The JSON of `/api/v1`, pure: copied out of the process image under its lock, written as text outside it.

use serde::Serialize;
use serde_json::Number;

use super::health::{ProgramHealth, SessionHealth};
use crate::mapping::{AlarmDef, AlarmOwner, Derived, FieldKind, NodeDef, Source, TagTable};
use crate::process_image::{
    AlarmState, AlarmStatus, Event, NmtState, NodeIndex, NodeStatus, Priority, ProcessImage, Quality, Reason,
    Sample, TagIndex, Value,
};
use crate::time::{Instant, Now, Timestamp};

/// Events in `/api/v1/status`.
const EVENTS_SHOWN: usize = 50;

/// What does not change while the program runs.
#[derive(Clone, Debug, Default)]
pub struct About {
    /// Version of the program.
    pub version: String,
    /// Version of the register map's layout.
    pub map_version: u32,
    /// Hash of the register map.
    pub map_hash: String,
    /// When the program started.
    pub started: Now,
}

/// `/api/v1/status`: everything at one moment.
#[derive(Debug, Serialize)]
pub struct Status<'a> {
    v: u8,
    gateway: &'a str,
    version: &'a str,
    map_version: u32,
    map_hash: &'a str,
    ts: i64,
    uptime_s: u64,
    revision: u64,
    clock_synchronised: bool,
    not_ready: Vec<String>,
    mqtt: Option<SessionHealth>,
    buses: Vec<BusView<'a>>,
    nodes: Vec<NodeView<'a>>,
    /// All that are not normal.
    alarms: Vec<AlarmView<'a>>,
    /// The newest first.
    events: Vec<EventView>,
}

impl<'a> Status<'a> {
    /// Of this moment.
    #[must_use]
    pub fn new(
        table: &'a TagTable,
        about: &'a About,
        image: &ProcessImage,
        health: ProgramHealth,
        now: Now,
    ) -> Self {
        let nodes = (0..table.nodes.len()).map(NodeIndex);
        Self {
            v: 1,
            gateway: &table.gateway,
            version: &about.version,
            map_version: about.map_version,
            map_hash: &about.map_hash,
            ts: now.utc.as_millis(),
            uptime_s: now.instant.since(about.started.instant).as_secs(),
            revision: image.revision.0,
            clock_synchronised: image.clock_synchronised,
            not_ready: health.not_ready,
            mqtt: health.mqtt,
            buses: BusView::all(table, image),
            nodes: nodes.filter_map(|node| NodeView::new(table, image, node, now.instant)).collect(),
            alarms: AlarmView::list(table, image, |status| status.state != AlarmState::Normal),
            events: image
                .journal
                .newest_first()
                .take(EVENTS_SHOWN)
                .map(|event| EventView::new(table, event))
                .collect(),
        }
    }
}

/// A bus.
#[derive(Debug, Serialize)]
pub struct BusView<'a> {
    name: &'a str,
    state: &'static str,
    load_percent: Option<f64>,
    frames_per_second: u32,
    frames_received: u64,
    frames_sent: u64,
    frames_not_sent: u64,
    errors: u64,
    bus_off_count: u64,
    overruns: u64,
    foreign_frames: u64,
}

impl<'a> BusView<'a> {
    fn all(table: &'a TagTable, image: &ProcessImage) -> Vec<Self> {
        let view = |(def, bus): (&'a crate::mapping::BusDef, &crate::process_image::BusStatus)| Self {
            name: &def.name,
            state: bus.state.word(),
            load_percent: bus.load_permille.map(|permille| f64::from(permille) / 10.0),
            frames_per_second: bus.frames_per_second,
            frames_received: bus.frames_received,
            frames_sent: bus.frames_sent,
            frames_not_sent: bus.frames_not_sent,
            errors: bus.errors,
            bus_off_count: bus.bus_off_count,
            overruns: bus.overruns,
            foreign_frames: bus.foreign_frames,
        };
        table.buses.iter().zip(&image.buses).map(view).collect()
    }
}

/// A node with its tags.
#[derive(Debug, Serialize)]
pub struct NodeView<'a> {
    name: &'a str,
    bus: Option<&'a str>,
    id: u8,
    unit_id: u8,
    mapping: &'a str,
    vendor: &'a str,
    model: &'a str,
    online: bool,
    reason: String,
    nmt: Option<&'static str>,
    supervised: bool,
    passive: bool,
    simulated: bool,
    identity_mismatch: bool,
    /// The worst of its tags.
    quality: &'static str,
    ts: Option<i64>,
    pdos: Vec<PdoView>,
    counters: CountersView,
    tags: Vec<TagView<'a>>,
}

#[derive(Debug, Serialize)]
struct PdoView {
    number: u16,
    age_ms: Option<u64>,
    stale: bool,
    received: u64,
}

#[derive(Debug, Serialize)]
struct CountersView {
    frames_received: u64,
    restarts: u64,
    guard_misses: u64,
    toggle_errors: u64,
    pdo_length_errors: u64,
    nmt_commands_sent: u64,
    emcys: u64,
    sdo_errors: u64,
    unexpected_states: u64,
    malformed: u64,
    reserved_bits: u64,
}

impl<'a> NodeView<'a> {
    /// A node at this moment; `None` where there is none.
    #[must_use]
    pub fn new(table: &'a TagTable, image: &ProcessImage, node: NodeIndex, now: Instant) -> Option<Self> {
        let (def, status) = (table.node(node)?, image.node(node)?);
        let quality = image.worst_quality(def.tags.clone().map(TagIndex));
        Some(Self {
            name: &def.name,
            bus: table.buses.get(def.bus.0).map(|bus| bus.name.as_str()),
            id: def.canopen.id.get(),
            unit_id: def.unit_id,
            mapping: &def.device.mapping,
            vendor: &def.device.vendor,
            model: &def.device.model,
            online: status.online,
            reason: status.reason.clone(),
            nmt: status.nmt.map(NmtState::word),
            supervised: status.supervised,
            passive: status.passive,
            simulated: status.simulated,
            identity_mismatch: status.identity_mismatch,
            quality: quality.word(),
            ts: status.newest_data.map(Timestamp::as_millis),
            pdos: pdos(status, now),
            counters: counters(status),
            tags: tags(table, image, def, now),
        })
    }
}

fn pdos(status: &NodeStatus, now: Instant) -> Vec<PdoView> {
    let views = status.pdos.iter().map(|pdo| PdoView {
        number: pdo.number,
        age_ms: age_ms(pdo.last_received, now),
        stale: pdo.stale,
        received: pdo.received,
    });
    views.collect()
}

fn counters(status: &NodeStatus) -> CountersView {
    let counters = &status.counters;
    CountersView {
        frames_received: counters.frames_received,
        restarts: counters.restarts,
        guard_misses: counters.guard_misses,
        toggle_errors: counters.toggle_errors,
        pdo_length_errors: counters.pdo_length_errors,
        nmt_commands_sent: counters.nmt_commands_sent,
        emcys: counters.emcys,
        sdo_errors: counters.sdo_errors,
        unexpected_states: counters.unexpected_states,
        malformed: counters.malformed,
        reserved_bits: counters.reserved_bits,
    }
}

fn tags<'a>(table: &'a TagTable, image: &ProcessImage, def: &NodeDef, now: Instant) -> Vec<TagView<'a>> {
    let tags = def.tags.clone().map(TagIndex).filter_map(|index| Some((index, table.tag(index)?)));
    let view = |(index, tag): (TagIndex, &'a crate::mapping::TagDef)| {
        let sample = image.tag(index);
        TagView {
            name: &tag.name,
            description: &tag.description,
            kind: kind(&tag.source),
            value: shown(sample, def.zero_on_bad).map(|value| Json::new(value, tag.decimals)),
            unit: &tag.unit,
            decimals: tag.decimals,
            quality: sample.quality.word(),
            reason: sample.quality.reason().map(Reason::word),
            valid: tag.valid.is_none_or(|valid| image.tag(valid).value.is_true()),
            age_ms: age_ms(sample.received_at, now),
        }
    };
    tags.map(view).collect()
}

/// The value to show: nothing where nothing was ever received; the last one otherwise, or 0 where the installation
/// asks for it (R-DET-084).
fn shown(sample: &Sample, zero_on_bad: bool) -> Option<Value> {
    match (sample.quality.is_usable(), zero_on_bad, sample.value) {
        (true, _, value) => Some(value),
        (false, true, Value::Bool(_)) => Some(Value::Bool(false)),
        (false, true, _) => Some(Value::Unsigned(0)),
        (false, false, value) => sample.received_at.map(|_| value),
    }
}

/// Whether a source gives bits or numbers.
fn kind(source: &Source) -> &'static str {
    let bit = match source {
        Source::Pdo { field, .. } => field.kind == FieldKind::Bool,
        Source::Derived(derived) => {
            matches!(derived, Derived::Bit { .. } | Derived::Logic { .. } | Derived::Latch { .. })
        }
    };
    if bit { "bool" } else { "number" }
}

/// A tag.
#[derive(Debug, Serialize)]
pub struct TagView<'a> {
    name: &'a str,
    description: &'a str,
    /// `bool` or `number`, also while there is no value.
    #[serde(rename = "type")]
    kind: &'static str,
    value: Option<Json>,
    unit: &'a str,
    decimals: u8,
    quality: &'static str,
    reason: Option<&'static str>,
    /// The device itself says that the value means something.
    valid: bool,
    age_ms: Option<u64>,
}

/// A value as JSON: a bit, or a number rounded to its decimals; `null` for what is no number.
#[derive(Debug, Serialize)]
#[serde(untagged)]
enum Json {
    Bit(bool),
    Number(Option<Number>),
}

impl Json {
    fn new(value: Value, decimals: u8) -> Self {
        match value {
            Value::Bool(bit) => Self::Bit(bit),
            Value::Unsigned(whole) => Self::Number(Some(whole.into())),
            Value::Signed(whole) => Self::Number(Some(whole.into())),
            Value::Float(number) => {
                let factor = 10f64.powi(i32::from(decimals));
                let rounded = (number * factor).round() / factor;
                // A number so large that the factor overflows has no digits to round.
                Self::Number(Number::from_f64(if rounded.is_finite() { rounded } else { number }))
            }
        }
    }
}

/// An alarm.
#[derive(Debug, Serialize)]
pub struct AlarmView<'a> {
    node: Option<&'a str>,
    bus: Option<&'a str>,
    name: &'a str,
    state: &'static str,
    active: bool,
    acknowledged: bool,
    priority: &'static str,
    since: Option<i64>,
    count: u64,
    first_out: bool,
    value: Option<Json>,
    text: &'a str,
    action: &'a str,
}

impl<'a> AlarmView<'a> {
    /// Every alarm of which `wanted` holds, in the order of the table.
    fn list(table: &'a TagTable, image: &ProcessImage, wanted: fn(&AlarmStatus) -> bool) -> Vec<Self> {
        let alarms = table.alarms.iter().zip(&image.alarms).filter(|(_, status)| wanted(status));
        alarms.map(|(def, status)| Self::new(table, def, status)).collect()
    }

    fn new(table: &'a TagTable, def: &'a AlarmDef, status: &AlarmStatus) -> Self {
        let (node, bus) = match def.owner {
            AlarmOwner::Gateway => (None, None),
            AlarmOwner::Bus(bus) => (None, table.buses.get(bus.0).map(|bus| bus.name.as_str())),
            AlarmOwner::Node(node) => (table.node(node).map(|node| node.name.as_str()), None),
        };
        Self {
            node,
            bus,
            name: &def.name,
            state: status.state.word(),
            active: status.state.is_active(),
            acknowledged: !status.state.is_unacknowledged(),
            priority: def.priority.word(),
            since: status.since.map(Timestamp::as_millis),
            count: status.count,
            first_out: status.first_out,
            value: status.value.map(|value| Json::new(value, decimals(table, def))),
            text: &def.text,
            action: &def.action,
        }
    }
}

/// `/api/v1/alarms`.
#[derive(Debug, Serialize)]
pub struct Alarms<'a> {
    v: u8,
    alarms: Vec<AlarmView<'a>>,
}

impl<'a> Alarms<'a> {
    /// Every alarm at this moment.
    #[must_use]
    pub fn new(table: &'a TagTable, image: &ProcessImage) -> Self {
        Self { v: 1, alarms: AlarmView::list(table, image, |_| true) }
    }
}

/// An event.
#[derive(Debug, Serialize)]
pub struct EventView {
    seq: u64,
    ts: i64,
    kind: &'static str,
    node: Option<String>,
    bus: Option<String>,
    name: String,
    from: String,
    to: String,
    priority: Option<&'static str>,
    value: Option<Json>,
    text: String,
}

impl EventView {
    fn new(table: &TagTable, event: &Event) -> Self {
        let alarm = event.alarm.and_then(|alarm| table.alarms.get(alarm.0));
        Self {
            seq: event.seq,
            ts: event.ts.as_millis(),
            kind: event.kind.word(),
            node: event.node.clone(),
            bus: event.bus.clone(),
            name: event.name.clone(),
            from: event.from.clone(),
            to: event.to.clone(),
            priority: event.priority.map(Priority::word),
            value: event.value.map(|value| Json::new(value, alarm.map_or(3, |alarm| decimals(table, alarm)))),
            text: event.text.clone(),
        }
    }
}

/// `/api/v1/events`.
#[derive(Debug, Serialize)]
pub struct Events {
    v: u8,
    /// Sequence number of the newest event there is.
    newest: u64,
    /// Events after the asked-for number that are gone.
    missed: u64,
    /// The oldest first.
    #[serde(rename = "events")]
    list: Vec<EventView>,
}

impl Events {
    /// The events after a sequence number.
    #[must_use]
    pub fn after(table: &TagTable, image: &ProcessImage, after: u64) -> Self {
        let (events, missed) = image.journal.after(after);
        let list = events.iter().map(|event| EventView::new(table, event)).collect();
        Self { v: 1, newest: image.journal.newest(), missed, list }
    }
}

/// Digits after the decimal point of an alarm's value.
fn decimals(table: &TagTable, alarm: &AlarmDef) -> u8 {
    alarm.value.and_then(|tag| table.tag(tag)).map_or(3, |tag| tag.decimals)
}

fn age_ms(received: Option<Instant>, now: Instant) -> Option<u64> {
    received.map(|received| u64::try_from(now.since(received).as_millis()).unwrap_or(u64::MAX))
}

/// How bad a quality is, for metrics: 0 good, 1 uncertain, 2 stale, 3 bad.
#[must_use]
pub fn quality_code(quality: Quality) -> u8 {
    match quality {
        Quality::Good => 0,
        Quality::Uncertain(_) => 1,
        Quality::Stale(_) => 2,
        Quality::Bad(_) => 3,
    }
}
