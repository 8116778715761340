//! From the entries of a mapping to the tags of one node.

use std::collections::BTreeMap;
use std::ops::Range;

use super::super::file::{
    DerivedSection, EncodingWord, MappingFile, ParameterSection, RegisterSection, ScaleSection, SharedKeys,
    TagSection,
};
use super::super::installation::{ByteOrderWord, NodeEntry, TagEntry};
use super::super::table::{
    BusDef, Derived, Encoding, Field, FieldKind, RegisterDef, Scale, Source, Space, TagDef,
};
use super::super::{At, SourceText};
use super::items::{Element, Entry, Item, Items};
use super::node::Tpdo;
use super::order::causes_first;
use super::problems::{Problems, matched};
use super::rpdo::Rpdo;
use super::{derived, emergency, esd, fields, node, rpdo, units, writable};
use crate::process_image::{NodeIndex, TagIndex};

/// Lowest register address of device data; below are those of the node itself.
pub const FIRST_REGISTER: u64 = 100;
/// Bit addresses of the alarms of the node itself.
pub const ALARM_BITS: Range<u64> = 128..192;

/// What kind of value a tag has, as far as conditions and registers care.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// A bit.
    Bool,
    /// A whole number without sign and without scale, of so many bits.
    Bits(u8),
    /// Any other number that stands in a frame as a whole number, of so many bits.
    Whole(u8),
    /// Any other number.
    Number,
}

/// The kind of the tags of an entry.
fn kind(entry: Entry<'_>) -> Kind {
    match entry {
        Entry::Parameter(_) => Kind::Number,
        Entry::Tag(section) => fields::kind(section),
        Entry::Derived(section) => derived::kind(section),
    }
}

/// What the parts of the work on one node share.
pub struct Context<'a> {
    /// The mapping file.
    pub source: &'a SourceText,
    /// Its content.
    pub file: &'a MappingFile,
    /// The configuration.
    pub config: &'a SourceText,
    /// What it says of the node.
    pub entry: &'a NodeEntry,
    /// Its bus; `None` where there is no such bus, which was told.
    pub bus: Option<BusDef>,
    /// Its TPDOs, by their numbers.
    pub tpdos: Vec<Tpdo<'a>>,
    /// Its RPDOs, by their numbers.
    pub rpdos: Vec<Rpdo<'a>>,
    /// All tags, unrolled.
    pub items: Items<'a>,
    /// The node.
    pub node: NodeIndex,
    /// Place of its first tag in the tag table.
    pub base: usize,
}

impl Context<'_> {
    /// The kind of a tag.
    pub fn kind(&self, index: usize) -> Kind {
        self.items.get(index).map_or(Kind::Number, |item| kind(item.entry))
    }

    /// A bool tag, by its name.
    pub fn bool_tag(
        &self,
        problems: &mut Problems,
        name: &At<String>,
        element: &Element,
        what: &str,
    ) -> Option<TagIndex> {
        let filled = element.fill(&name.value);
        let index = self.items.find(problems, self.source, &filled, &name.span)?;
        if self.kind(index) != Kind::Bool {
            let message = format!("`{filled}` is a number, but {what} must be a bool tag");
            problems.error(self.source, &name.span, message, "make a derived tag of it: when = \"tag > 5\"");
        }
        Some(TagIndex(index))
    }
}

/// The tags of a node, in an order in which each derived tag comes after those that it is computed from, and the place of
/// each item among them.
pub fn tags(problems: &mut Problems, context: &Context<'_>) -> (Vec<TagDef>, Vec<usize>) {
    check_overrides(problems, context);
    let mut tags: Vec<TagDef> = context.items.list.iter().map(|item| tag(problems, context, item)).collect();
    let order = order(problems, context, &tags);
    let mut places = vec![0; tags.len()];
    for (place, item) in order.iter().enumerate() {
        if let Some(slot) = places.get_mut(*item) {
            *slot = place;
        }
    }
    for tag in &mut tags {
        let mut moved = |index: &mut TagIndex| {
            index.0 = context.base + places.get(index.0).copied().unwrap_or_default();
        };
        tag.valid.iter_mut().chain(&mut tag.doubtful).for_each(&mut moved);
        if let Source::Derived(derived) = &mut tag.source {
            derived.for_each_input_mut(&mut moved);
        }
    }
    let mut sorted: Vec<(usize, TagDef)> = places.iter().copied().zip(tags).collect();
    sorted.sort_by_key(|(place, _)| *place);
    (sorted.into_iter().map(|(_, tag)| tag).collect(), places)
}

fn order(problems: &mut Problems, context: &Context<'_>, tags: &[TagDef]) -> Vec<usize> {
    let inputs: Vec<Vec<usize>> = tags
        .iter()
        .map(|tag| {
            let mut inputs = Vec::new();
            if let Source::Derived(derived) = &tag.source {
                derived.for_each_input(&mut |index| inputs.push(index.0));
            }
            inputs
        })
        .collect();
    let (order, circle) = causes_first(&inputs);
    if let Some(item) = circle.first().and_then(|index| context.items.get(*index)) {
        let names: Vec<&str> = circle
            .iter()
            .filter_map(|index| context.items.get(*index))
            .map(|item| item.name.as_str())
            .collect();
        let message = format!("`{}` is computed from itself: {}", item.name, names.join(", "));
        problems.error(context.source, &item.span, message, "break the circle: use a tag of a TPDO instead");
    }
    order
}

fn tag(problems: &mut Problems, context: &Context<'_>, item: &Item<'_>) -> TagDef {
    match item.entry {
        Entry::Parameter(section) => parameter(problems, context, item, section),
        Entry::Tag(section) => from_pdo(problems, context, item, section),
        Entry::Derived(section) => computed(problems, context, item, section),
    }
}

fn parameter(
    problems: &mut Problems,
    context: &Context<'_>,
    item: &Item<'_>,
    section: &ParameterSection,
) -> TagDef {
    let set = context.entry.parameters.iter().find(|(name, _)| name.value == item.name);
    let (source, value) =
        set.map_or((context.source, &section.default), |(_, value)| (context.config, value));
    if !value.value.is_finite() {
        problems.error(
            source,
            &value.span,
            format!("{} is not a value for a parameter", value.value),
            "use a number",
        );
    }
    let unit = section.unit.clone();
    TagDef {
        node: context.node,
        name: item.name.clone(),
        description: section.description.clone(),
        unit,
        device_unit: None,
        decimals: 0,
        source: Source::Derived(Derived::Constant { value: value.value }),
        object: None,
        writable: None,
        valid: None,
        doubtful: None,
        registers: Vec::new(),
        published: false,
        deadband: 0.0,
    }
}

fn from_pdo(problems: &mut Problems, context: &Context<'_>, item: &Item<'_>, section: &TagSection) -> TagDef {
    if let Some((part, field)) = emergency::source(problems, context, item, section) {
        refuse_bits(problems, context, item, ("comes from emergency messages", "change it in the mapping"));
        rpdo::refuse_limits(problems, context, section);
        units::refuse_device_unit(problems, context, item, section, "comes from emergency messages");
        let scale = scale(problems, context, section.scale.as_ref());
        let usual_decimals = if scale == Scale::IDENTITY { 0 } else { 2 };
        let source = Source::Emergency { part, field, scale };
        return finished(problems, context, item, section.shared(), usual_decimals, source);
    }
    if let Some((carrier, field)) = esd::source(problems, context, item, section) {
        refuse_bits(problems, context, item, ("is told by the module", "change it in the mapping"));
        rpdo::refuse_limits(problems, context, section);
        let scale = scale(problems, context, section.scale.as_ref());
        let usual_decimals = if scale == Scale::IDENTITY { 0 } else { 2 };
        let source = Source::Module { carrier, field, scale };
        return finished(problems, context, item, section.shared(), usual_decimals, source);
    }
    let scale = scale(problems, context, section.scale.as_ref());
    let mut source = if let Some(rpdo) = &section.rpdo {
        units::refuse_device_unit(problems, context, item, section, "is sent in an RPDO");
        rpdo::source(problems, context, item, section, rpdo, scale)
    } else {
        let (pdo, field) = fields::field(problems, context, item, section);
        let poll = fields::poll(context, item).zip(fields::whole(section));
        match (node::adopted(context, section), poll) {
            (Some(object), poll) => {
                let field = Field { bit: 0, ..field };
                Source::Adopted { object, poll: poll.map(|(poll, _)| poll), field, scale }
            }
            (None, Some((poll, field))) => Source::Polled { poll, field, scale },
            (None, None) => Source::Pdo { pdo, field, scale },
        }
    };
    let mut is_float = false;
    if let Source::Pdo { field, .. }
    | Source::Polled { field, .. }
    | Source::Adopted { field, .. }
    | Source::Rpdo { field, .. } = &mut source
    {
        change_field(problems, context, item, field);
        is_float = field.kind == FieldKind::Float;
    }
    let received = section.rpdo.is_none();
    let device_unit = received.then(|| units::device_unit(problems, context, item, section)).flatten();
    let scaled = scale != Scale::IDENTITY || is_float || device_unit.is_some();
    let usual_decimals = if scaled { 2 } else { 0 };
    let tag = finished(problems, context, item, section.shared(), usual_decimals, source);
    // One that cannot be read was told of with its place.
    let object = section.object.as_ref().and_then(|object| object.value.parse().ok());
    let source = (&tag.source, object, device_unit.as_ref());
    let limits = received.then(|| writable::limits(problems, context, item, section, source)).flatten();
    TagDef { device_unit, object, writable: limits, ..tag }
}

/// What the installation changes of the bits of a tag.
fn change_field(problems: &mut Problems, context: &Context<'_>, item: &Item<'_>, field: &mut Field) {
    let overrides = overrides(context, &item.name);
    for (_, entry) in &overrides {
        field.invert = entry.invert.as_ref().map_or(field.invert, |invert| invert.value);
        if let Some(order) = &entry.byte_order {
            field.big_endian = order.value == ByteOrderWord::Big;
            fields::check_byte_order(problems, context.config, &order.span, &item.name, *field);
        }
    }
}

fn scale(problems: &mut Problems, context: &Context<'_>, section: Option<&At<ScaleSection>>) -> Scale {
    let Some(section) = section else { return Scale::IDENTITY };
    let scale = Scale {
        multiply: section.value.multiply.unwrap_or(1.0),
        divide: section.value.divide.unwrap_or(1.0),
        add: section.value.add.unwrap_or(0.0),
    };
    let finite = scale.multiply.is_finite() && scale.divide.is_finite() && scale.add.is_finite();
    if !finite || scale.divide == 0.0 || scale.multiply == 0.0 {
        let hint = "multiply and divide must not be 0, and all three must be finite numbers";
        problems.error(context.source, &section.span, "this scale gives no usable value", hint);
    }
    scale
}

fn computed(
    problems: &mut Problems,
    context: &Context<'_>,
    item: &Item<'_>,
    section: &DerivedSection,
) -> TagDef {
    refuse_bits(problems, context, item, ("is computed", "change the tags that it is computed from"));
    let derived = derived::derived(problems, context, item, section);
    let fraction = section.maximum.is_some() || section.margin.is_some();
    let usual_decimals = if fraction { 2 } else { 0 };
    finished(problems, context, item, section.shared(), usual_decimals, Source::Derived(derived))
}

/// The installation can change the bits of tags that stand in TPDOs, and of no other.
fn refuse_bits(problems: &mut Problems, context: &Context<'_>, item: &Item<'_>, (why, hint): (&str, &str)) {
    for (name, entry) in overrides(context, &item.name) {
        for span in entry.invert.iter().map(|at| &at.span).chain(entry.byte_order.iter().map(|at| &at.span)) {
            let message = format!("`{}` {why}, it has no bits to change", name.value);
            problems.error(context.config, span, message, hint);
        }
    }
}

/// A tag with all that entries share, whatever its source is.
fn finished(
    problems: &mut Problems,
    context: &Context<'_>,
    item: &Item<'_>,
    keys: SharedKeys<'_>,
    usual_decimals: u8,
    source: Source,
) -> TagDef {
    let mut description = item.element.fill(keys.description);
    let mut deadband = keys.deadband.map(|value| (context.source, value));
    for (_, entry) in overrides(context, &item.name) {
        deadband = entry.deadband.as_ref().map(|value| (context.config, value)).or(deadband);
        description = entry.description.clone().unwrap_or(description);
    }
    if let Some((source, value)) = deadband
        && !(value.value.is_finite() && value.value >= 0.0)
    {
        problems.error(source, &value.span, "a deadband is a number, not negative", "use 0 for none");
    }
    let decimals =
        keys.decimals.map(|decimals| problems.within(context.source, decimals, "decimals", 0..=12));
    TagDef {
        node: context.node,
        name: item.name.clone(),
        description,
        unit: item.element.fill(keys.unit),
        device_unit: None,
        decimals: decimals.and_then(|decimals| u8::try_from(decimals).ok()).unwrap_or(usual_decimals),
        source,
        object: None,
        writable: None,
        valid: keys.valid.and_then(|valid| context.bool_tag(problems, valid, &item.element, "`valid`")),
        doubtful: keys.doubtful.and_then(|tag| context.bool_tag(problems, tag, &item.element, "`doubtful`")),
        registers: places(problems, context, item, keys),
        published: keys.publish.unwrap_or(true),
        deadband: deadband.map_or(0.0, |(_, value)| value.value),
    }
}

fn places(
    problems: &mut Problems,
    context: &Context<'_>,
    item: &Item<'_>,
    keys: SharedKeys<'_>,
) -> Vec<RegisterDef> {
    let kind = kind(item.entry);
    let mut places: Vec<RegisterDef> =
        keys.registers.iter().filter_map(|register| place(problems, context, item, register, kind)).collect();
    let Some(bit) = keys.bit_address else { return places };
    if kind != Kind::Bool {
        let hint = "give it `registers`, or make a derived tag with `when`";
        let message = format!("`{}` is a number and cannot stand among the discrete inputs", item.name);
        problems.error(context.source, &bit.span, message, hint);
    }
    let address = bit.value.saturating_add(item.element.index);
    if ALARM_BITS.contains(&address) {
        let hint = "bits 128 to 191 show the node's alarms; use another address";
        problems.error(context.source, &bit.span, format!("bit address {address} is taken"), hint);
    }
    places.extend(address_of(problems, context, bit, item, [1, 1]).map(|address| RegisterDef {
        space: Space::Bit,
        address,
        encoding: Encoding::Bool,
        resolution: 1.0,
    }));
    places
}

fn place(
    problems: &mut Problems,
    context: &Context<'_>,
    item: &Item<'_>,
    register: &RegisterSection,
    kind: Kind,
) -> Option<RegisterDef> {
    let encoding = encoding(register.encoding.value);
    let is_raw = matches!(encoding, Encoding::Raw16 | Encoding::Raw32);
    let raw_bits = match (kind, item.entry) {
        (Kind::Bool, Entry::Tag(_)) => Some(1),
        (Kind::Bits(width) | Kind::Whole(width), Entry::Tag(_)) => Some(u16::from(width)),
        _ => None,
    };
    if is_raw && raw_bits.is_none_or(|bits| bits > 16 * encoding.count()) {
        let message = format!("`{}` has no raw value of {} bits", item.name, 16 * encoding.count());
        let hint = "raw16 and raw32 are for whole numbers of a TPDO that fit; use u16, i16, u32, i32 or f32";
        problems.error(context.source, &register.encoding.span, message, hint);
    }
    if let Some(resolution) = &register.resolution {
        if is_raw || encoding == Encoding::F32 {
            let message = format!("a resolution means nothing for {}", encoding.word());
            problems.error(context.source, &resolution.span, message, "leave it out");
        } else if !(resolution.value.is_finite() && resolution.value > 0.0) {
            problems.error(
                context.source,
                &resolution.span,
                "a resolution is a number above 0",
                "for example 0.01",
            );
        }
    }
    if register.address.value < FIRST_REGISTER {
        let message = format!("register {} belongs to the node itself", register.address.value);
        problems.error(context.source, &register.address.span, message, "use addresses from 100 on");
    }
    let count = u64::from(encoding.count());
    let stride = register.stride.as_ref().map_or(count, |stride| {
        problems.within(context.source, stride, "stride", count..=u64::from(u16::MAX))
    });
    let address = address_of(problems, context, &register.address, item, [count, stride])?;
    let resolution = register.resolution.as_ref().map_or(1.0, |resolution| resolution.value);
    Some(RegisterDef { space: Space::Register, address, encoding, resolution })
}

fn encoding(word: EncodingWord) -> Encoding {
    match word {
        EncodingWord::U16 => Encoding::U16,
        EncodingWord::I16 => Encoding::I16,
        EncodingWord::U32 => Encoding::U32,
        EncodingWord::I32 => Encoding::I32,
        EncodingWord::F32 => Encoding::F32,
        EncodingWord::Raw16 => Encoding::Raw16,
        EncodingWord::Raw32 => Encoding::Raw32,
    }
}

/// The address of an element of an array, if it stays below 65536. An element takes `count`, the next is `stride` further.
fn address_of(
    problems: &mut Problems,
    context: &Context<'_>,
    address: &At<u64>,
    item: &Item<'_>,
    [count, stride]: [u64; 2],
) -> Option<u16> {
    let first = address.value.saturating_add(item.element.index.saturating_mul(stride));
    let last = first.saturating_add(count - 1);
    if last > u64::from(u16::MAX) {
        let message = format!("address {last} of `{}` is above 65535", item.name);
        problems.error(context.source, &address.span, message, "use a lower address");
        return None;
    }
    u16::try_from(first).ok()
}

/// What the installation changes of a tag.
fn overrides<'a>(context: &Context<'a>, name: &str) -> Vec<(&'a At<String>, &'a TagEntry)> {
    context.entry.tag.iter().filter(|(pattern, _)| matched(&pattern.value, name).is_some()).collect()
}

/// Names in the installation's changes that mean nothing.
fn check_overrides(problems: &mut Problems, context: &Context<'_>) {
    let names: BTreeMap<&str, bool> = context
        .items
        .list
        .iter()
        .map(|item| (item.name.as_str(), matches!(item.entry, Entry::Parameter(_))))
        .collect();
    for pattern in context.entry.tag.keys() {
        let mut found = names.iter().filter(|(name, _)| matched(&pattern.value, name).is_some()).peekable();
        if found.peek().is_none() {
            problems.unknown(context.config, &pattern.span, "tag", &pattern.value, names.keys().copied());
        } else if found.all(|(_, parameter)| *parameter) {
            let message = format!("`{}` is a parameter, not a tag of the device", pattern.value);
            let hint = "set it under [node.NAME.parameters]";
            problems.error(context.config, &pattern.span, message, hint);
        }
    }
    let parameters = names.iter().filter(|(_, parameter)| **parameter).map(|(name, _)| *name);
    for name in context.entry.parameters.keys() {
        if names.get(name.value.as_str()) != Some(&true) {
            problems.unknown(context.config, &name.span, "parameter", &name.value, parameters.clone());
        }
    }
}
