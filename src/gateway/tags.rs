//! The current value of every tag: decoding, qualities, and which derived tags have to be computed again.
//!
//! Nothing here allocates once it is made. What depends on what is worked out at the start; after that new data
//! touches the tags that stand in it and those that are computed from them, and no others.
//!
//! What carries values from a device is called a carrier here. Where in it each tag stands is taken over from the
//! table at the start, so that nothing that is done with received data looks at the source of a tag.

use std::collections::{BTreeMap, BTreeSet};

use crate::canopen::{PdoIndex, RpdoIndex};
use crate::mapping::{
    Derived, EmergencyPart, Field, FieldKind, ModuleCarrier, NodeDef, Scale, Source, TagTable, codec,
};
use crate::process_image::{NodeIndex, ProcessImage, Quality, Reason, Revision, Sample, TagIndex, Value};
use crate::time::{Instant, Now};

use super::derived::{self, Memory};
use super::marks::Marks;
use super::units::Units;

mod adopted;
mod carry;
#[cfg(test)]
mod module_tests;
use adopted::Adopted;

/// All tags.
#[derive(Debug)]
pub(super) struct Tags {
    layout: Layout,
    state: State,
    units: Units,
}

/// What depends on what.
#[derive(Debug)]
struct Layout {
    nodes: Vec<NodeLayout>,
    /// By tag: the derived tags that look at it.
    dependents: Vec<Vec<TagIndex>>,
}

/// Which carrier of a node: its TPDOs, by their places in its settings; then the objects that are polled, by theirs; then
/// those of its errors; then the values of an esd module and its lines; then the RPDOs of its definition.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct CarrierIndex(pub(super) usize);

impl CarrierIndex {
    /// That of an RPDO.
    pub(super) fn of_rpdo(node: &NodeDef, rpdo: RpdoIndex) -> Self {
        let [_, last] = Self::of_emergencies(node);
        Self(last.0 + 1 + node.protocol.module().map_or(0, ModuleCarrier::count) + rpdo.0)
    }

    /// That of a value of an esd module: 8 bytes, the lowest first. `None` for any other node.
    pub(super) fn of_module(node: &NodeDef, value: ModuleCarrier) -> Option<Self> {
        let [_, last] = Self::of_emergencies(node);
        Some(Self(last.0 + 1 + value.place(node.protocol.module()?.channels.len())))
    }
}

impl From<PdoIndex> for CarrierIndex {
    fn from(pdo: PdoIndex) -> Self {
        Self(pdo.0)
    }
}

impl CarrierIndex {
    /// What emergency messages told last, as the 8 bytes of one; and how many errors there are, in one byte.
    pub(super) fn of_emergencies(node: &NodeDef) -> [Self; 2] {
        let first = node.pdos().len() + node.protocol.polls().len();
        [Self(first), Self(first + 1)]
    }
}

#[derive(Debug)]
struct NodeLayout {
    /// By [`CarrierIndex`].
    carriers: Vec<CarrierLayout>,
    /// How many of them, from the first on, come from the node. What a module is not asked for does not count.
    received: usize,
    /// In the order of the table: inputs come before what is computed from them.
    derived: Vec<TagIndex>,
    /// Tags that stand where the device says.
    adopted: Vec<Adopted>,
}

#[derive(Debug, Default)]
struct CarrierLayout {
    /// Tags that stand in it.
    placed: Vec<Placed>,
    /// Tags that are computed from those, however indirectly, in the order of the table.
    computed: Vec<TagIndex>,
}

/// A tag and its place in a carrier.
#[derive(Clone, Copy, Debug)]
struct Placed {
    tag: TagIndex,
    field: Field,
    /// From raw to engineering units; `None` where the raw value is the value.
    scale: Option<Scale>,
    /// The place of its unit among [`Units`], where the device is asked for it: that goes before `scale`.
    unit: Option<usize>,
}

#[derive(Debug)]
struct State {
    samples: Vec<Sample>,
    /// By tag; unused for tags that are not derived.
    memories: Vec<Memory>,
    /// By tag: an input has changed since it was computed.
    outdated: Vec<bool>,
    /// Not yet published.
    unpublished: Marks,
    /// Value or quality changed since conditions were looked at.
    changed: Marks,
    /// Edges of counted bits.
    edges: Vec<(TagIndex, bool)>,
    /// Tags that change by mere time.
    running: Marks,
    next_second: Option<Instant>,
}

impl Tags {
    /// All tags as they are before anything was received.
    pub(super) fn new(table: &TagTable, now: Now) -> Self {
        let units = Units::new(table);
        let layout = Layout::new(table, &units);
        let size = table.tags.len();
        let mut state = State {
            samples: table.tags.iter().map(|tag| never_received(&tag.source)).collect(),
            memories: (0..size).map(|_| Memory::default()).collect(),
            outdated: vec![true; size],
            unpublished: Marks::new(size),
            changed: Marks::new(size),
            edges: Vec::new(),
            running: Marks::new(size),
            next_second: None,
        };
        for (tag, sample) in table.tags.iter().zip(&mut state.samples) {
            if matches!(&tag.source, Source::Derived(Derived::Constant { .. })) {
                sample.received = now.utc;
                sample.received_at = Some(now.instant);
            }
        }
        for node in &layout.nodes {
            state.compute_outdated(table, &layout, &node.derived, now);
        }
        Self { layout, state, units }
    }

    /// The units of tags that are shown in the device's own, as far as they are known.
    pub(super) fn units_shown(&self) -> BTreeMap<TagIndex, String> {
        self.units.shown()
    }

    /// The units of the tags.
    pub(super) fn units(&mut self) -> &mut Units {
        &mut self.units
    }

    /// The current samples, by tag.
    pub(super) fn samples(&self) -> &[Sample] {
        &self.state.samples
    }

    /// Takes new data of a carrier: its tags, and all that is computed from them. A tag of which the unit is not known
    /// stays as it is (R-DST-034).
    pub(super) fn apply(
        &mut self,
        table: &TagTable,
        now: Now,
        (node, carrier): (NodeIndex, CarrierIndex),
        data: &[u8],
        quality: Quality,
    ) {
        let Self { layout, state, units } = self;
        let node = layout.nodes.get(node.0);
        let Some(carrier) = node.and_then(|node| node.carriers.get(carrier.0)) else { return };
        for Placed { tag, field, scale, unit } in &carrier.placed {
            let (scale, best) = match unit.map(|unit| units.reading(unit)) {
                None => (*scale, Quality::Good),
                Some(Some((scale, best))) => (Some(scale), best),
                Some(None) => continue,
            };
            let Some(raw) = codec::decode(field, data) else { continue };
            let value = scale.map_or(raw, |scale| codec::scale(&scale, raw));
            state.store(layout, *tag, raw, value, quality_of(value, quality.worst(best)));
            state.receive(*tag, now);
        }
        for tag in &carrier.computed {
            state.receive(*tag, now);
        }
        state.compute_outdated(table, layout, &carrier.computed, now);
    }

    /// The tags of a node, or of one of its carriers, can be trusted less from now on. A quality never gets better this
    /// way: only newly received data makes a tag good again (R-DET-037).
    pub(super) fn degrade(
        &mut self,
        table: &TagTable,
        now: Now,
        node: NodeIndex,
        carrier: Option<CarrierIndex>,
        quality: Quality,
    ) {
        let Self { layout, state, .. } = self;
        let Some(node) = layout.nodes.get(node.0) else { return };
        let carriers = node.carriers.iter().enumerate();
        let of = carriers.filter(|(place, _)| carrier.is_none_or(|carrier| carrier.0 == *place));
        for placed in of.flat_map(|(_, carrier)| &carrier.placed) {
            let Some(sample) = state.samples.get(placed.tag.0).copied() else { continue };
            let worse = degraded(sample.quality, quality);
            state.store(layout, placed.tag, sample.raw, sample.value, worse);
        }
        state.compute_outdated(table, layout, &node.derived, now);
    }

    /// Whether all that a node's device sends is good: each tag that stands in one of its carriers, or should.
    pub(super) fn all_good(&self, node: NodeIndex) -> bool {
        let carriers = self.layout.nodes.get(node.0).map(|node| node.carriers.as_slice()).unwrap_or_default();
        let node = self.layout.nodes.get(node.0);
        let adopted = node.map(|node| node.adopted.as_slice()).unwrap_or_default();
        let received = node.map_or(0, |node| node.received);
        let mut placed = carriers
            .iter()
            .take(received)
            .flat_map(|carrier| &carrier.placed)
            .chain(adopted.iter().map(|adopted| &adopted.placed));
        placed
            .all(|placed| self.state.samples.get(placed.tag.0).is_some_and(|sample| sample.quality.is_good()))
    }

    /// Opens the latches of a node, or of all nodes, whose source is not set.
    pub(super) fn acknowledge_latches(&mut self, table: &TagTable, now: Now, node: Option<NodeIndex>) {
        let Self { layout, state, .. } = self;
        let nodes = layout.nodes.iter().enumerate();
        for (_, node) in nodes.filter(|(place, _)| node.is_none_or(|node| node.0 == *place)) {
            for tag in &node.derived {
                let opened = state.memories.get_mut(tag.0).is_some_and(Memory::acknowledge);
                if let (true, Some(outdated)) = (opened, state.outdated.get_mut(tag.0)) {
                    *outdated = true;
                }
            }
            state.compute_outdated(table, layout, &node.derived, now);
        }
    }

    /// Values that change by mere time are computed once a second, while there are any.
    pub(super) fn handle_timeout(&mut self, table: &TagTable, now: Now) {
        if self.state.next_second.is_none_or(|due| due > now.instant) {
            return;
        }
        let Self { layout, state, .. } = self;
        state.next_second = None;
        for tag in state.running.drain() {
            if let Some(outdated) = state.outdated.get_mut(tag) {
                *outdated = true;
            }
        }
        for node in &layout.nodes {
            state.compute_outdated(table, layout, &node.derived, now);
        }
    }

    /// When the next second is due.
    pub(super) fn poll_timeout(&self) -> Option<Instant> {
        self.state.next_second
    }

    /// Takes the tags of which value or quality changed.
    pub(super) fn drain_changed(&mut self) -> impl Iterator<Item = TagIndex> + '_ {
        self.state.changed.drain().map(TagIndex)
    }

    /// Takes the edges of counted bits.
    pub(super) fn drain_edges(&mut self) -> impl Iterator<Item = (TagIndex, bool)> + '_ {
        self.state.edges.drain(..)
    }

    /// Copies what was received or changed since the last call. `true` when a value or a quality is another.
    pub(super) fn publish(&mut self, table: &TagTable, image: &mut ProcessImage, revision: Revision) -> bool {
        let State { samples, unpublished, .. } = &mut self.state;
        let mut moved = false;
        for place in unpublished.drain() {
            let (Some(sample), Some(shown)) = (samples.get(place), image.tags.get_mut(place)) else {
                continue;
            };
            let sample = as_shown(table, TagIndex(place), sample);
            if same(&sample, shown) {
                *shown = Sample { revision: shown.revision, ..sample };
            } else {
                *shown = Sample { revision, ..sample };
                moved = true;
            }
        }
        moved
    }

    /// All tags as readers see them.
    pub(super) fn shown(&self, table: &TagTable) -> Vec<Sample> {
        let samples = self.state.samples.iter().enumerate();
        samples.map(|(place, sample)| as_shown(table, TagIndex(place), sample)).collect()
    }
}

impl Layout {
    fn new(table: &TagTable, units: &Units) -> Self {
        let mut dependents: Vec<Vec<TagIndex>> = vec![Vec::new(); table.tags.len()];
        for (place, tag) in table.tags.iter().enumerate() {
            if let Source::Derived(derived) = &tag.source {
                derived.for_each_input(&mut |input| {
                    if let Some(dependents) = dependents.get_mut(input.0) {
                        dependents.push(TagIndex(place));
                    }
                });
            }
        }
        let nodes = table.nodes.iter().map(|node| NodeLayout::new(table, node, &dependents, units));
        let nodes = nodes.collect();
        Self { nodes, dependents }
    }
}

impl NodeLayout {
    fn new(table: &TagTable, node: &NodeDef, dependents: &[Vec<TagIndex>], units: &Units) -> Self {
        let mut carriers = Vec::new();
        let pdos = node.pdos().len();
        let [told, count] = CarrierIndex::of_emergencies(node);
        let first_value = count.0 + 1;
        let module = node.protocol.module();
        let first_sent = first_value + module.map_or(0, ModuleCarrier::count);
        carriers.resize_with(first_sent + node.rpdos.len(), CarrierLayout::default);
        let (mut derived, mut adopted) = (Vec::new(), Vec::new());
        for tag in node.tags.clone().map(TagIndex) {
            let placed = match table.tag(tag).map(|tag| &tag.source) {
                Some(Source::Pdo { pdo, field, scale }) => Some((*pdo, field, scale)),
                Some(Source::Polled { poll, field, scale }) => Some((pdos + poll, field, scale)),
                Some(Source::Adopted { object, poll, field, scale }) => {
                    let scale = (*scale != Scale::IDENTITY).then_some(*scale);
                    let placed = Placed { tag, field: *field, scale, unit: units.place_of(tag) };
                    let poll = poll.map(|poll| CarrierIndex(pdos + poll));
                    adopted.push(Adopted { object: *object, poll, placed });
                    None
                }
                Some(Source::Rpdo { rpdo, field, scale, .. }) => Some((first_sent + rpdo, field, scale)),
                Some(Source::Module { carrier, field, scale }) => module
                    .and_then(|module| ModuleCarrier::at(*carrier, module.channels.len()))
                    .and_then(|value| CarrierIndex::of_module(node, value))
                    .map(|carrier| (carrier.0, field, scale)),
                Some(Source::Emergency { part, field, scale }) => {
                    let carrier = if *part == EmergencyPart::ActiveCount { count } else { told };
                    Some((carrier.0, field, scale))
                }
                Some(Source::Derived(_)) => {
                    derived.push(tag);
                    None
                }
                None => None,
            };
            if let Some((carrier, field, scale)) = placed {
                let scale = (*scale != Scale::IDENTITY).then_some(*scale);
                if let Some(carrier) = carriers.get_mut(carrier) {
                    carrier.placed.push(Placed { tag, field: *field, scale, unit: units.place_of(tag) });
                }
            }
        }
        let received = first_value + module.map_or(0, ModuleCarrier::told);
        let mut layout = Self { carriers, received, derived, adopted };
        layout.place_polled(dependents);
        layout
    }
}

/// All tags that are computed from some tags, however indirectly.
fn computed_from(tags: impl Iterator<Item = TagIndex>, dependents: &[Vec<TagIndex>]) -> Vec<TagIndex> {
    let mut found = BTreeSet::new();
    let mut next: Vec<TagIndex> = tags.collect();
    while let Some(tag) = next.pop() {
        for dependent in dependents.get(tag.0).into_iter().flatten() {
            if found.insert(*dependent) {
                next.push(*dependent);
            }
        }
    }
    found.into_iter().collect()
}

impl State {
    /// Where value or quality is another than before, all that is computed from it is outdated.
    fn store(&mut self, layout: &Layout, tag: TagIndex, raw: Value, value: Value, quality: Quality) {
        let Some(sample) = self.samples.get_mut(tag.0) else { return };
        let new = Sample { raw, value, quality, ..*sample };
        if same(&new, sample) {
            return;
        }
        *sample = new;
        self.unpublished.mark(tag.0);
        self.changed.mark(tag.0);
        for dependent in layout.dependents.get(tag.0).into_iter().flatten() {
            if let Some(outdated) = self.outdated.get_mut(dependent.0) {
                *outdated = true;
            }
        }
    }

    /// New data came for the tag.
    fn receive(&mut self, tag: TagIndex, now: Now) {
        if let Some(sample) = self.samples.get_mut(tag.0) {
            sample.received = now.utc;
            sample.received_at = Some(now.instant);
            self.unpublished.mark(tag.0);
        }
    }

    /// Computes those of some derived tags of which an input has changed. Inputs are to come before what is computed
    /// from them, as in the table.
    fn compute_outdated(&mut self, table: &TagTable, layout: &Layout, derived: &[TagIndex], now: Now) {
        for tag in derived {
            let outdated = self.outdated.get_mut(tag.0).is_some_and(std::mem::take);
            if outdated {
                self.compute(table, layout, *tag, now);
            }
        }
    }

    fn compute(&mut self, table: &TagTable, layout: &Layout, tag: TagIndex, now: Now) {
        let Some(Source::Derived(derived)) = table.tag(tag).map(|tag| &tag.source) else { return };
        let Some(memory) = self.memories.get_mut(tag.0) else { return };
        let Some(before) = self.samples.get(tag.0) else { return };
        let (computed, edge) = derived::evaluate(now, derived, memory, before, &self.samples);
        if derived::runs_with_time(derived, memory, now) {
            self.running.mark(tag.0);
            let next = Instant::from_millis((now.instant.as_millis() / 1_000 + 1) * 1_000);
            self.next_second = Some(self.next_second.map_or(next, |due| due.min(next)));
        }
        self.edges.extend(edge);
        let quality = quality_of(computed.value, computed.quality);
        self.store(layout, tag, computed.raw, computed.value, quality);
    }
}

/// The quality of a value that came with some quality: one that is no number cannot be used (R-DST-037).
fn quality_of(value: Value, quality: Quality) -> Quality {
    match value {
        Value::Float(number) if !number.is_finite() => quality.worst(Quality::Bad(Reason::NotANumber)),
        Value::Float(_) | Value::Bool(_) | Value::Unsigned(_) | Value::Signed(_) => quality,
    }
}

/// The quality of a tag after something happened that makes it no better than `new`.
fn degraded(current: Quality, new: Quality) -> Quality {
    let rank = |quality| match quality {
        Quality::Good => 0,
        Quality::Uncertain(_) => 1,
        Quality::Stale(_) => 2,
        Quality::Bad(_) => 3,
    };
    // "Never received" stays the truth whatever else goes wrong. Within the same rank the newest reason is the one
    // to tell, but that a node is not operational says less than that it restarted or fell silent.
    let tells_less = new.reason() == Some(Reason::NodeNotOperational);
    if current == Quality::NEVER || rank(new) < rank(current) || (rank(new) == rank(current) && tells_less) {
        current
    } else {
        new
    }
}

/// A sample as readers see it: zero instead of a value that cannot be used, where the node asks for that (R-DET-084).
fn as_shown(table: &TagTable, tag: TagIndex, sample: &Sample) -> Sample {
    let zero_on_bad =
        table.tag(tag).and_then(|tag| table.node(tag.node)).is_some_and(|node| node.zero_on_bad);
    if zero_on_bad && !sample.quality.is_usable() {
        Sample { raw: zero(sample.raw), value: zero(sample.value), ..*sample }
    } else {
        *sample
    }
}

fn zero(value: Value) -> Value {
    match value {
        Value::Bool(_) => Value::Bool(false),
        Value::Unsigned(_) => Value::Unsigned(0),
        Value::Signed(_) => Value::Signed(0),
        Value::Float(_) => Value::Float(0.0),
    }
}

/// The same value and quality; a NaN is the same as itself here, so that it is no change for ever.
fn same(left: &Sample, right: &Sample) -> bool {
    let same_value = |left, right| match (left, right) {
        (Value::Float(left), Value::Float(right)) => f64::to_bits(left) == f64::to_bits(right),
        (left, right) => left == right,
    };
    left.quality == right.quality && same_value(left.raw, right.raw) && same_value(left.value, right.value)
}

/// A sample of the right kind in which nothing was received.
fn never_received(source: &Source) -> Sample {
    let (raw, scale) = match source {
        Source::Pdo { field, scale, .. }
        | Source::Polled { field, scale, .. }
        | Source::Adopted { field, scale, .. }
        | Source::Rpdo { field, scale, .. }
        | Source::Emergency { field, scale, .. }
        | Source::Module { field, scale, .. } => {
            let raw = match field.kind {
                FieldKind::Bool => Value::Bool(false),
                FieldKind::Unsigned => Value::Unsigned(0),
                FieldKind::Signed => Value::Signed(0),
                FieldKind::Float => Value::Float(0.0),
            };
            (raw, *scale)
        }
        Source::Derived(derived) => (derived::nothing(derived), Scale::IDENTITY),
    };
    let value = codec::scale(&scale, raw);
    let is_sent = matches!(source, Source::Rpdo { .. });
    let quality = if is_sent { Quality::Bad(Reason::NotSent) } else { Quality::NEVER };
    // What the offset of a scale makes of a zero was never measured.
    Sample { raw, value: zero(value), quality, ..Sample::NEVER }
}
