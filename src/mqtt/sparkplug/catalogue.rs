//! Which metrics there are, with their names, aliases and types, and how each reads at a moment. Pure.
//!
//! An *origin* is what is born and dies: the edge node (the gateway, origin 0) and its devices (the nodes, in their order).

use std::hash::{DefaultHasher, Hash, Hasher};
use std::ops::Range;

use super::payload::{DataType, Metric, MetricValue, PropertySet};
use crate::mapping::{AlarmOwner, DEVICE_UNIT, Derived, NodeDef, Source, TagDef, TagTable};
use crate::mqtt::kind::Kind;
use crate::mqtt::payload::Identity;
use crate::mqtt::told::differs;
use crate::process_image::value::rounded;
use crate::process_image::{
    AlarmIndex, BusState, BusStatus, NmtState, NodeIndex, ProcessImage, Quality, TagIndex, Value,
};
use crate::time::Timestamp;

/// Quality code of a value that may be used, also with a reservation.
pub const GOOD: u32 = 192;
/// Quality code of the last value, too old to act on.
pub const STALE: u32 = 500;
/// Quality code of no usable value.
pub const BAD: u32 = 0;
/// A bus load is told again when it moved by this many percent.
const LOAD_DEADBAND: f64 = 5.0;
/// Bits of an alias for the place of a metric: a million of them.
const PLACES: u32 = 20;
/// What is taken of the hash of all names.
const MARK: u64 = 0x7FFF;

/// What a metric shows.
#[derive(Clone, Debug, PartialEq, Eq)]
enum What {
    Tag(TagIndex),
    /// Whether it is active.
    Alarm(AlarmIndex),
    Nmt(NodeIndex),
    BusState(usize),
    /// In percent.
    BusLoad(usize),
    BusOffCount(usize),
    /// A text that never changes.
    Fixed(String),
}

/// A metric.
#[derive(Clone, Debug)]
pub struct MetricDef {
    /// Unique in its origin; `/` makes folders.
    pub name: String,
    /// Unique among all metrics of the edge node and its devices. One of another catalogue is hardly ever one here, so that a
    /// command to what was there before a reload or a start writes nothing else.
    pub alias: u64,
    /// Its type.
    pub data_type: DataType,
    what: What,
    unit: String,
    documentation: String,
    decimals: u8,
    deadband: f64,
}

/// A value of a metric.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Datum {
    /// Of a tag, an alarm or a counter.
    Value(Value),
    /// A state.
    Word(&'static str),
    /// The text that never changes.
    Fixed,
}

/// What a metric shows at a moment.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Reading {
    /// Its value; `None` where there is none.
    pub datum: Option<Datum>,
    /// [`GOOD`], [`STALE`] or [`BAD`].
    pub quality: u32,
    /// When it was received; `None` where that is not known.
    pub at: Option<Timestamp>,
}

/// All metrics.
#[derive(Clone, Debug)]
pub struct Catalogue {
    metrics: Vec<MetricDef>,
    /// By origin.
    origins: Vec<Range<usize>>,
}

impl Catalogue {
    /// Of everything in the table.
    #[must_use]
    pub fn new(table: &TagTable, identity: &Identity) -> Self {
        let mut catalogue = Self { metrics: Vec::new(), origins: Vec::new() };
        catalogue.add_gateway(table, identity);
        catalogue.origins.push(0..catalogue.metrics.len());
        for (place, node) in table.nodes.iter().enumerate() {
            let first = catalogue.metrics.len();
            catalogue.add_node(table, NodeIndex(place), node);
            catalogue.origins.push(first..catalogue.metrics.len());
        }
        catalogue.number();
        catalogue
    }

    /// Gives the aliases: the place in the lower bits, and above them what the names of all make.
    fn number(&mut self) {
        let mut hasher = DefaultHasher::new();
        for (place, metrics) in self.origins.iter().enumerate() {
            place.hash(&mut hasher);
            let metrics = self.metrics.get(metrics.clone()).unwrap_or_default();
            for metric in metrics {
                metric.name.hash(&mut hasher);
            }
        }
        // 35 bits are five bytes of a message.
        let mark = (hasher.finish() & MARK) << PLACES;
        for (place, metric) in (1..).zip(&mut self.metrics) {
            metric.alias = mark | place;
        }
    }

    fn add_gateway(&mut self, table: &TagTable, identity: &Identity) {
        self.add_fixed("Software", "cangate");
        self.add_fixed("Version", &identity.version);
        self.add_fixed("Map Hash", &identity.map_hash);
        for (place, bus) in table.buses.iter().enumerate() {
            let name = |of: &str| format!("Bus/{}/{of}", bus.name);
            self.add(name("State"), DataType::String, What::BusState(place));
            let load = self.add(name("Load"), DataType::Double, What::BusLoad(place));
            (load.unit, load.decimals, load.deadband) = ("%".to_owned(), 1, LOAD_DEADBAND);
            self.add(name("Bus-Off Count"), DataType::UInt64, What::BusOffCount(place));
        }
        self.add_alarms(table, |owner| match owner {
            AlarmOwner::Gateway => Some("Alarm".to_owned()),
            AlarmOwner::Bus(bus) => table.buses.get(bus.0).map(|bus| format!("Bus/{}/Alarm", bus.name)),
            AlarmOwner::Node(_) => None,
        });
    }

    fn add_node(&mut self, table: &TagTable, index: NodeIndex, node: &NodeDef) {
        self.add_fixed("Vendor", &node.device.vendor);
        self.add_fixed("Model", &node.device.model);
        self.add_fixed("Mapping", &node.device.mapping);
        if node.canopen().is_some() {
            self.add("NMT State".to_owned(), DataType::String, What::Nmt(index));
        }
        for tag in node.tags.clone().map(TagIndex) {
            let Some(def) = table.tag(tag).filter(|def| def.published) else { continue };
            let metric = self.add(def.name.clone(), data_type(def), What::Tag(tag));
            metric.documentation.clone_from(&def.description);
            (metric.decimals, metric.deadband) = (def.decimals, def.deadband);
            if def.unit != DEVICE_UNIT {
                metric.unit.clone_from(&def.unit);
            }
        }
        self.add_alarms(table, |owner| (owner == AlarmOwner::Node(index)).then(|| "Alarm".to_owned()));
    }

    fn add_alarms(&mut self, table: &TagTable, folder: impl Fn(AlarmOwner) -> Option<String>) {
        for (place, def) in table.alarms.iter().enumerate() {
            if let Some(folder) = folder(def.owner) {
                let what = What::Alarm(AlarmIndex(place));
                let metric = self.add(format!("{folder}/{}", def.name), DataType::Boolean, what);
                metric.documentation.clone_from(&def.text);
            }
        }
    }

    fn add_fixed(&mut self, name: &str, text: &str) {
        self.add(format!("Properties/{name}"), DataType::String, What::Fixed(text.to_owned()));
    }

    fn add(&mut self, name: String, data_type: DataType, what: What) -> &mut MetricDef {
        let metric = MetricDef {
            name,
            alias: 0,
            data_type,
            what,
            unit: String::new(),
            documentation: String::new(),
            decimals: 3,
            deadband: 0.0,
        };
        self.metrics.push_mut(metric)
    }

    /// How many metrics there are.
    #[must_use]
    pub fn len(&self) -> usize {
        self.metrics.len()
    }

    /// Whether there is none; the edge node always has some.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.metrics.is_empty()
    }

    /// How many origins there are.
    #[must_use]
    pub fn origins(&self) -> usize {
        self.origins.len()
    }

    /// The places of an origin's metrics.
    #[must_use]
    pub fn of(&self, origin: usize) -> Range<usize> {
        self.origins.get(origin).cloned().unwrap_or_default()
    }

    /// A metric by its place.
    #[must_use]
    pub fn metric(&self, place: usize) -> Option<&MetricDef> {
        self.metrics.get(place)
    }
}

impl MetricDef {
    /// What it shows now.
    #[must_use]
    pub fn read(&self, table: &TagTable, image: &ProcessImage) -> Reading {
        let of_bus =
            |bus: usize, datum: fn(&BusStatus) -> Option<Datum>| state(image.buses.get(bus).and_then(datum));
        match &self.what {
            What::Tag(index) => {
                table.tag(*index).map_or(state(None), |tag| read_tag(table, tag, *index, image))
            }
            What::Alarm(alarm) => {
                let active = image.alarm(*alarm).is_some_and(|status| status.state.is_active());
                state(Some(Datum::Value(Value::Bool(active))))
            }
            What::Nmt(node) => {
                state(image.node(*node).and_then(|status| status.nmt).map(NmtState::word).map(Datum::Word))
            }
            What::BusState(bus) => of_bus(*bus, |bus| Some(Datum::Word(BusState::word(bus.state)))),
            What::BusLoad(bus) => of_bus(*bus, |bus| {
                bus.load_permille.map(|load| Datum::Value(Value::Float(f64::from(load) / 10.0)))
            }),
            What::BusOffCount(bus) => {
                of_bus(*bus, |bus| Some(Datum::Value(Value::Unsigned(bus.bus_off_count))))
            }
            What::Fixed(_) => state(Some(Datum::Fixed)),
        }
    }

    /// Whether a change of it is told at once.
    #[must_use]
    pub fn is_urgent(&self) -> bool {
        matches!(self.what, What::Alarm(_))
    }

    /// Its tag, where it has one.
    #[must_use]
    pub fn tag(&self) -> Option<TagIndex> {
        if let What::Tag(tag) = self.what { Some(tag) } else { None }
    }

    /// Whether a value is another one than what was told, by the deadband or more.
    #[must_use]
    pub fn is_news(&self, told: Option<Datum>, now: Option<Datum>) -> bool {
        match (told, now) {
            (Some(Datum::Value(told)), Some(Datum::Value(now))) => differs(told, now, self.deadband),
            (told, now) => told != now,
        }
    }

    /// For data: alias, value, time; the quality by itself.
    #[must_use]
    pub fn data(&self, datum: Option<Datum>, at: Timestamp) -> Metric {
        let value = datum.and_then(|datum| self.value(datum));
        Metric {
            alias: Some(self.alias),
            timestamp: Some(millis(at)),
            is_null: value.is_none().then_some(true),
            value,
            ..Metric::default()
        }
    }

    /// For births: everything. `unit` is what the device told, where it did.
    #[must_use]
    pub fn birth(&self, reading: &Reading, at: Timestamp, unit: Option<&str>) -> Metric {
        let mut properties = PropertySet::default();
        properties.push_quality(reading.quality);
        properties.push_text("engUnit", unit.unwrap_or(&self.unit));
        properties.push_text("documentation", &self.documentation);
        Metric {
            name: Some(self.name.clone()),
            datatype: Some(self.data_type.code()),
            properties: Some(properties),
            ..self.data(reading.datum, at)
        }
    }

    /// A value in the metric's type; whole numbers that do not fit become the nearest that does, and what is no number is none.
    fn value(&self, datum: Datum) -> Option<MetricValue> {
        let value = match (datum, &self.what) {
            (Datum::Value(value), _) => value,
            (Datum::Word(word), _) => return Some(MetricValue::String(word.to_owned())),
            (Datum::Fixed, What::Fixed(text)) => return Some(MetricValue::String(text.clone())),
            (Datum::Fixed, _) => return None,
        };
        let unsigned = |highest: u32| {
            let whole = whole(value)?.clamp(0, highest.into());
            u32::try_from(whole).ok().map(MetricValue::Int)
        };
        match self.data_type {
            DataType::Boolean => Some(MetricValue::Boolean(value.is_true())),
            DataType::Double => {
                let number = value.as_f64();
                number.is_finite().then(|| MetricValue::Double(rounded(number, self.decimals)))
            }
            DataType::UInt8 => unsigned(u8::MAX.into()),
            DataType::UInt16 => unsigned(u16::MAX.into()),
            DataType::UInt32 => unsigned(u32::MAX),
            DataType::UInt64 => u64::try_from(whole(value)?.max(0)).ok().map(MetricValue::Long),
            DataType::Int32 => {
                let number = i32::try_from(whole(value)?.clamp(i32::MIN.into(), i32::MAX.into())).ok()?;
                Some(MetricValue::Int(number.cast_unsigned()))
            }
            DataType::Int64 => {
                i64::try_from(whole(value)?).ok().map(|long| MetricValue::Long(long.cast_unsigned()))
            }
            DataType::String => Some(MetricValue::String(value.to_string())),
        }
    }
}

/// What is known by itself: good where it is there.
fn state(datum: Option<Datum>) -> Reading {
    Reading { datum, quality: if datum.is_some() { GOOD } else { BAD }, at: None }
}

fn read_tag(table: &TagTable, tag: &TagDef, index: TagIndex, image: &ProcessImage) -> Reading {
    let sample = image.tag(index);
    let zero_on_bad = table.node(tag.node).is_some_and(|node| node.zero_on_bad);
    let quality = match tag.disowned(image).and(tag.valid).map(|valid| image.tag(valid).quality) {
        // Its device says that it means nothing.
        Some(Quality::Good) => BAD,
        Some(other) => code(other.worst(sample.quality)),
        None => code(sample.quality),
    };
    let shown = sample.shown(zero_on_bad);
    Reading {
        datum: shown.filter(|value| value.as_f64().is_finite()).map(Datum::Value),
        // What is no number is no value.
        quality: if shown.is_some_and(|value| !value.as_f64().is_finite()) { BAD } else { quality },
        at: sample.received_at.map(|_| sample.received),
    }
}

fn code(quality: Quality) -> u32 {
    match quality {
        Quality::Good | Quality::Uncertain(_) => GOOD,
        Quality::Stale(_) => STALE,
        Quality::Bad(_) => BAD,
    }
}

fn data_type(tag: &TagDef) -> DataType {
    // Seconds and edges go up to 65,535 and no further.
    let counts = matches!(tag.source, Source::Derived(Derived::EdgesWithin { .. }));
    match Kind::of(tag) {
        Kind::Bool => DataType::Boolean,
        Kind::Unsigned(0..=8) => DataType::UInt8,
        Kind::Unsigned(9..=16) => DataType::UInt16,
        Kind::Unsigned(17..=32) => DataType::UInt32,
        Kind::Unsigned(_) if counts => DataType::UInt32,
        Kind::Unsigned(_) => DataType::UInt64,
        Kind::Signed(0..=32) => DataType::Int32,
        Kind::Signed(_) => DataType::Int64,
        Kind::Real => DataType::Double,
    }
}

/// The nearest whole number; `None` for what is no number.
fn whole(value: Value) -> Option<i128> {
    match value {
        Value::Bool(bit) => Some(bit.into()),
        Value::Unsigned(number) => Some(number.into()),
        Value::Signed(number) => Some(number.into()),
        #[expect(clippy::as_conversions, clippy::cast_possible_truncation, reason = "saturates")]
        Value::Float(number) => number.is_finite().then(|| number.round() as i128),
    }
}

/// Milliseconds since 1970 UTC; 0 for what was before.
#[must_use]
pub fn millis(at: Timestamp) -> u64 {
    u64::try_from(at.as_millis()).unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use super::*;
    use crate::mapping::Sketch;

    fn metric(data_type: DataType) -> MetricDef {
        let identity = Identity::default();
        let mut metric = Catalogue::new(&TagTable::default(), &identity).metrics.remove(0);
        (metric.data_type, metric.what, metric.decimals) = (data_type, What::BusOffCount(0), 2);
        metric
    }

    #[test]
    fn the_aliases_of_two_sets_of_metrics_have_nothing_in_common_and_those_of_one_are_always_the_same() {
        let aliases = |nodes: &[&str]| {
            let sketch = nodes.iter().zip(1..).fold(Sketch::new(), |sketch, (mapping, id)| {
                sketch.node(&format!("node{id}"), id, mapping, |_| ())
            });
            let catalogue = Catalogue::new(&sketch.build().unwrap().0, &Identity::default());
            catalogue.metrics.iter().map(|metric| metric.alias).collect::<BTreeSet<_>>()
        };
        let (one, two) = (["motortech-detcon"], ["danfoss-dst-p92c", "motortech-detcon"]);
        assert!(aliases(&one).is_disjoint(&aliases(&two)));
        assert_eq!(aliases(&one), aliases(&one));
        assert!(aliases(&two).iter().all(|alias| *alias > 0 && *alias < 1 << 35), "five bytes of a message");
    }

    #[test]
    fn a_value_takes_the_type_of_its_metric() {
        for (data_type, value, expected) in [
            (DataType::Boolean, Value::Bool(true), Some(MetricValue::Boolean(true))),
            (DataType::Double, Value::Float(12.549), Some(MetricValue::Double(12.55))),
            (DataType::Double, Value::Float(f64::NAN), None),
            (DataType::UInt8, Value::Unsigned(300), Some(MetricValue::Int(255))),
            (DataType::UInt16, Value::Signed(-1), Some(MetricValue::Int(0))),
            (DataType::UInt32, Value::Float(f64::INFINITY), None),
            (DataType::Int32, Value::Signed(-2), Some(MetricValue::Int(0xFFFF_FFFE))),
            (DataType::Int32, Value::Float(-2.5), Some(MetricValue::Int(0xFFFF_FFFD))),
            (DataType::Int64, Value::Signed(-1), Some(MetricValue::Long(u64::MAX))),
            (DataType::UInt64, Value::Unsigned(u64::MAX), Some(MetricValue::Long(u64::MAX))),
            (DataType::String, Value::Unsigned(7), Some(MetricValue::String("7".into()))),
        ] {
            assert_eq!(metric(data_type).value(Datum::Value(value)), expected, "{data_type:?} {value}");
        }
    }

    #[test]
    fn tck_id_payloads_propertyset_quality_value_value_qualities_have_three_codes() {
        use crate::process_image::Reason::{NeverReceived, PdoTimeout, UnknownUnit};
        let all = [
            Quality::Good,
            Quality::Uncertain(UnknownUnit),
            Quality::Stale(PdoTimeout),
            Quality::Bad(NeverReceived),
        ];
        assert_eq!(all.map(code), [192, 192, 500, 0]);
    }
}
