//! The JSON of `/api/v1`, pure: copied out of the process image under its lock, written as text outside it.

use std::borrow::Cow;

use serde::Serialize;

use super::health::{CertificateHealth, ClientHealth, ConfigurationHealth, ProgramHealth, SessionHealth};
use crate::mapping::{
    AlarmDef, AlarmOwner, Derived, FieldKind, LineDef, NodeDef, Objection, Source, TagTable,
};
use crate::process_image::value::rounded;
use crate::process_image::{
    AlarmState, AlarmStatus, ErrorLog, ErrorRecord, Event, NmtState, NodeIndex, NodeStatus, Priority,
    ProcessImage, Quality, SerialLine, TagIndex, Value,
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
    modbus_clients: Vec<ClientHealth>,
    certificates: Vec<CertificateHealth>,
    configuration: ConfigurationView,
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
            modbus_clients: health.modbus_clients,
            certificates: health.certificates,
            configuration: ConfigurationView::new(health.configuration),
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

/// The configuration that runs.
#[derive(Debug, Serialize)]
pub struct ConfigurationView {
    loaded: i64,
    reloads: u64,
    rejections: u64,
    rejected: Option<String>,
}

impl ConfigurationView {
    fn new(health: ConfigurationHealth) -> Self {
        let ConfigurationHealth { loaded, reloads, rejections, rejected } = health;
        Self { loaded: loaded.as_millis(), reloads, rejections, rejected }
    }
}

/// A bus.
#[derive(Debug, Serialize)]
pub struct BusView<'a> {
    name: &'a str,
    state: &'static str,
    load_percent: Option<f64>,
    frames_per_second: u32,
    #[serde(flatten)]
    counters: Counters<7>,
}

impl<'a> BusView<'a> {
    fn all(table: &'a TagTable, image: &ProcessImage) -> Vec<Self> {
        let view = |(def, bus): (&'a crate::mapping::BusDef, &crate::process_image::BusStatus)| Self {
            name: &def.name,
            state: bus.state.word(),
            load_percent: bus.load_permille.map(|permille| f64::from(permille) / 10.0),
            frames_per_second: bus.frames_per_second,
            counters: Counters(bus.named()),
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
    lines: Vec<LineView<'a>>,
    errors: ErrorsView<'a>,
    counters: Counters<12>,
    tags: Vec<TagView<'a>>,
}

/// What a node told of its errors.
#[derive(Debug, Serialize)]
struct ErrorsView<'a> {
    /// Those that are there, the oldest first.
    active: Vec<ErrorView<'a>>,
    /// What was told, the newest first.
    history: Vec<ErrorView<'a>>,
}

#[derive(Debug, Serialize)]
struct ErrorView<'a> {
    ts: i64,
    code: String,
    meaning: &'static str,
    /// Its alarm, where the mapping names it.
    name: Option<&'a str>,
    register: u8,
    /// Manufacturer bytes in hexadecimal.
    vendor: String,
    count: u64,
}

impl<'a> ErrorsView<'a> {
    fn new(def: &'a NodeDef, errors: &ErrorLog) -> Self {
        let view = |record: &ErrorRecord| ErrorView {
            ts: record.at.as_millis(),
            code: format!("0x{:04X}", record.emergency.code),
            meaning: record.meaning(),
            name: record.entry.and_then(|entry| def.emergency.errors.get(entry)).map(|def| def.name.as_str()),
            register: record.emergency.register,
            vendor: record.emergency.vendor.map(|byte| format!("{byte:02X}")).concat(),
            count: record.count,
        };
        Self {
            active: errors.active().iter().map(view).collect(),
            history: errors.history().map(view).collect(),
        }
    }
}

/// A serial line of a module.
#[derive(Debug, Serialize)]
struct LineView<'a> {
    number: u8,
    description: &'a str,
    open: bool,
    /// Since the gateway started.
    bytes_received: u64,
    messages: u64,
    last_message: Option<i64>,
    /// How often what came in may have a gap.
    breaks: u64,
}

fn lines<'a>(table: &'a TagTable, image: &ProcessImage, node: NodeIndex) -> Vec<LineView<'a>> {
    let lines = table.lines.iter().zip(&image.lines).filter(|(def, _)| def.node == node);
    let view = |(def, line): (&'a LineDef, &SerialLine)| LineView {
        number: def.number,
        description: &def.description,
        open: line.open,
        bytes_received: line.cursor(),
        messages: line.newest_message(),
        last_message: line.last_message().map(|message| message.at.as_millis()),
        breaks: line.breaks,
    };
    lines.map(view).collect()
}

#[derive(Debug, Serialize)]
struct PdoView {
    number: u16,
    age_ms: Option<u64>,
    stale: bool,
    received: u64,
}

/// Counters by their names, in the order in which they are told.
#[derive(Debug)]
struct Counters<const N: usize>([(&'static str, &'static str, u64); N]);

impl<const N: usize> Serialize for Counters<N> {
    fn serialize<S: serde::Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_map(self.0.iter().map(|(name, _, count)| (name, count)))
    }
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
            id: def.number(),
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
            lines: lines(table, image, node),
            errors: ErrorsView::new(def, &status.errors),
            counters: Counters(status.counters.named()),
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

fn tags<'a>(table: &'a TagTable, image: &ProcessImage, def: &NodeDef, now: Instant) -> Vec<TagView<'a>> {
    let tags = def.tags.clone().map(TagIndex).filter_map(|index| Some((index, table.tag(index)?)));
    let view = |(index, tag): (TagIndex, &'a crate::mapping::TagDef)| {
        let sample = image.tag(index);
        TagView {
            name: &tag.name,
            description: &tag.description,
            kind: kind(&tag.source),
            value: sample.shown(def.zero_on_bad).map(|value| Json(value, tag.decimals)),
            unit: image
                .units
                .get(&index)
                .map_or(Cow::Borrowed(tag.unit.as_str()), |unit| Cow::Owned(unit.clone())),
            decimals: tag.decimals,
            quality: sample.quality.word(),
            reason: tag.objection(image, sample).map(Objection::word),
            valid: tag.disowned(image).is_none(),
            age_ms: age_ms(sample.received_at, now),
        }
    };
    tags.map(view).collect()
}

/// Whether a source gives bits or numbers.
fn kind(source: &Source) -> &'static str {
    let bit = match source {
        Source::Pdo { field, .. }
        | Source::Polled { field, .. }
        | Source::Adopted { field, .. }
        | Source::Rpdo { field, .. }
        | Source::Emergency { field, .. }
        | Source::Module { field, .. } => field.kind == FieldKind::Bool,
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
    unit: Cow<'a, str>,
    decimals: u8,
    quality: &'static str,
    /// Why it should not be used as it stands; the words are those of MQTT.
    reason: Option<&'static str>,
    /// The device itself says that the value means something, and what it says is good.
    valid: bool,
    age_ms: Option<u64>,
}

/// A value and its decimals, as JSON: a bit, or a number that is rounded when it is written; `null` for what is no number.
#[derive(Debug)]
struct Json(Value, u8);

impl Serialize for Json {
    fn serialize<S: serde::Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        match self.0 {
            Value::Bool(bit) => serializer.serialize_bool(bit),
            Value::Unsigned(whole) => serializer.serialize_u64(whole),
            Value::Signed(whole) => serializer.serialize_i64(whole),
            // What is not finite is written as `null`.
            Value::Float(number) => serializer.serialize_f64(rounded(number, self.1)),
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
    text: Cow<'a, str>,
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
            value: status.value.map(|value| Json(value, table.decimals(def.value))),
            text: def.told(status.value),
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
            value: event.value.map(|value| Json(value, table.decimals(alarm.and_then(|alarm| alarm.value)))),
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
        let (events, missed) = image.journal.since(after);
        let list = events.map(|event| EventView::new(table, event)).collect();
        Self { v: 1, newest: image.journal.newest(), missed, list }
    }
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
