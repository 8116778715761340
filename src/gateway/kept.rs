//! What stays the same from one tag table to the next, pure: buses, nodes, and with them their tags, alarms and lines.
//!
//! Places differ between two tables; names do not. A bus stays where its name, its interface and its role stay. A node stays where its bus
//! does and all that the core makes of its definition is the same: then it keeps its state. How it is shown (registers, topics, texts) is
//! not compared. The esd modules of a bus stay together or not at all, because they share one dialogue.
//!
//! Whatever is not recognised here as the same begins anew, which is never wrong.

use crate::can::BusIndex;
use crate::mapping::{
    AlarmCondition, AlarmDef, AlarmOwner, NodeDef, OnLoss, PublishDef, Source, TagDef, TagTable,
};
use crate::process_image::{AlarmIndex, LineIndex, NodeIndex, TagIndex};

/// For each place in the new table the place in the old one, where that stays.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Kept {
    /// By [`BusIndex`].
    pub buses: Vec<Option<BusIndex>>,
    /// By [`NodeIndex`].
    pub nodes: Vec<Option<NodeIndex>>,
    /// By [`TagIndex`].
    pub tags: Vec<Option<TagIndex>>,
    /// By [`AlarmIndex`].
    pub alarms: Vec<Option<AlarmIndex>>,
    /// By [`LineIndex`].
    pub lines: Vec<Option<LineIndex>>,
    /// By the old [`TagIndex`]: the new one.
    new_tags: Vec<Option<TagIndex>>,
}

impl Kept {
    /// Compares two tables. `same_interface` tells, for a bus of the same name and role, whether it is reached as before: first the old
    /// one.
    #[must_use]
    pub fn new(old: &TagTable, new: &TagTable, same_interface: impl Fn(BusIndex, BusIndex) -> bool) -> Self {
        let mut kept = Self {
            buses: new
                .buses
                .iter()
                .enumerate()
                .map(|(place, bus)| {
                    let from =
                        old.buses.iter().position(|each| each.name == bus.name && each.role == bus.role)?;
                    same_interface(BusIndex(from), BusIndex(place)).then_some(BusIndex(from))
                })
                .collect(),
            ..Self::default()
        };
        let modules: Vec<bool> =
            (0..new.buses.len()).map(|bus| kept.keeps_modules(old, new, BusIndex(bus))).collect();
        kept.nodes =
            (0..new.nodes.len()).map(|node| kept.node(old, new, NodeIndex(node), &modules)).collect();
        kept.tags = vec![None; new.tags.len()];
        kept.new_tags = vec![None; old.tags.len()];
        for (place, from) in kept.nodes.iter().enumerate() {
            let Some((now, before)) = new.nodes.get(place).zip(from.and_then(|from| old.node(from))) else {
                continue;
            };
            for (tag, from) in now.tags.clone().zip(before.tags.clone()) {
                if let Some(entry) = kept.tags.get_mut(tag) {
                    *entry = Some(TagIndex(from));
                }
                if let Some(entry) = kept.new_tags.get_mut(from) {
                    *entry = Some(TagIndex(tag));
                }
            }
        }
        kept.alarms = new.alarms.iter().map(|alarm| kept.alarm(old, alarm)).collect();
        kept.lines = new
            .lines
            .iter()
            .map(|line| {
                let node = kept.nodes.get(line.node.0).copied().flatten()?;
                let from =
                    old.lines.iter().position(|each| (each.node, each.channel) == (node, line.channel))?;
                Some(LineIndex(from))
            })
            .collect();
        kept
    }

    /// Whether an old node stays.
    #[must_use]
    pub fn has_node(&self, old: NodeIndex) -> bool {
        self.nodes.contains(&Some(old))
    }

    /// The new place of an old alarm.
    #[must_use]
    pub fn new_alarm(&self, old: AlarmIndex) -> Option<AlarmIndex> {
        self.alarms.iter().position(|from| *from == Some(old)).map(AlarmIndex)
    }

    /// The new place of an old tag.
    #[must_use]
    pub fn new_tag(&self, old: TagIndex) -> Option<TagIndex> {
        self.new_tags.get(old.0).copied().flatten()
    }

    /// The new place of an old node.
    #[must_use]
    pub fn new_node(&self, old: NodeIndex) -> Option<NodeIndex> {
        self.nodes.iter().position(|from| *from == Some(old)).map(NodeIndex)
    }

    /// The new place of an old line.
    #[must_use]
    pub fn new_line(&self, old: LineIndex) -> Option<LineIndex> {
        self.lines.iter().position(|from| *from == Some(old)).map(LineIndex)
    }

    /// Whether the modules of a bus, the nodes that they are, and what they have in common, are the same as before. A module that
    /// goes on tells what changes: a node that begins anew beside it would never learn how it is.
    #[must_use]
    pub fn keeps_modules(&self, old: &TagTable, new: &TagTable, bus: BusIndex) -> bool {
        let Some(from) = self.buses.get(bus.0).copied().flatten() else { return false };
        let (Some(before), Some(now)) = (old.buses.get(from.0), new.buses.get(bus.0)) else { return false };
        modules(old, from).eq(modules(new, bus)) && before.esd == now.esd && before.bit_rate == now.bit_rate
    }

    fn node(&self, old: &TagTable, new: &TagTable, node: NodeIndex, modules: &[bool]) -> Option<NodeIndex> {
        let def = new.node(node)?;
        let from = old.find_node(&def.name)?;
        let bus = self.buses.get(def.bus.0).copied().flatten()?;
        let modules = def.protocol.module().is_none() || modules.get(def.bus.0).copied().unwrap_or(false);
        let same_bus = old.node(from).is_some_and(|before| before.bus == bus);
        (modules && same_bus && Shape::new(old, from) == Shape::new(new, node)).then_some(from)
    }

    fn alarm(&self, old: &TagTable, alarm: &AlarmDef) -> Option<AlarmIndex> {
        let owner = match alarm.owner {
            AlarmOwner::Gateway => AlarmOwner::Gateway,
            AlarmOwner::Bus(bus) => AlarmOwner::Bus(self.buses.get(bus.0).copied().flatten()?),
            AlarmOwner::Node(node) => AlarmOwner::Node(self.nodes.get(node.0).copied().flatten()?),
        };
        let like = |each: &AlarmDef| {
            each.owner == owner
                && each.name == alarm.name
                && (each.on_delay, each.off_delay, each.latch)
                    == (alarm.on_delay, alarm.off_delay, alarm.latch)
        };
        old.alarms.iter().position(like).map(AlarmIndex)
    }
}

/// The nodes of a bus that are modules, in their order.
fn modules(table: &TagTable, bus: BusIndex) -> impl Iterator<Item = Option<Shape>> {
    let nodes = table.nodes.iter().enumerate();
    let modules = nodes.filter(move |(_, node)| node.bus == bus && node.protocol.module().is_some());
    modules.map(|(place, _)| Shape::new(table, NodeIndex(place)))
}

/// What the core makes of a node, whatever its places in the table are.
#[derive(Debug, PartialEq)]
struct Shape {
    def: NodeDef,
    tags: Vec<TagDef>,
    alarms: Vec<AlarmDef>,
    /// By alarm: the names of those that tell its cause, each with whose it is.
    causes: Vec<Vec<(u8, String)>>,
}

impl Shape {
    fn new(table: &TagTable, node: NodeIndex) -> Option<Self> {
        let mut def = table.node(node)?.clone();
        let first = def.tags.start;
        let local = |tag: &mut TagIndex| tag.0 = tag.0.wrapping_sub(first);
        let mut tags = table.tags.get(def.tags.clone())?.to_vec();
        for tag in &mut tags {
            tag.node = NodeIndex(0);
            tag.valid.iter_mut().chain(&mut tag.doubtful).for_each(local);
            if let Source::Derived(derived) = &mut tag.source {
                derived.for_each_input_mut(&mut |input| local(input));
            }
            // How it is shown.
            tag.registers.clear();
            tag.description.clear();
            (tag.decimals, tag.published, tag.deadband) = (0, false, 0.0);
        }
        let mut alarms = table.alarms.get(def.alarms.clone())?.to_vec();
        let mut causes = Vec::new();
        for alarm in &mut alarms {
            alarm.owner = AlarmOwner::Node(NodeIndex(0));
            if let AlarmCondition::Tags(expression) = &mut alarm.condition {
                expression.for_each_tag_mut(&mut |tag| local(tag));
            }
            alarm.value.iter_mut().for_each(local);
            let of = std::mem::take(&mut alarm.suppressed_by)
                .into_iter()
                .filter_map(|cause| table.alarms.get(cause));
            causes.push(of.map(|cause| (owner_kind(cause.owner), cause.name.clone())).collect());
            alarm.bit = None;
            alarm.text.clear();
            alarm.action.clear();
        }
        forget_what_is_shown(&mut def);
        Some(Self { def, tags, alarms, causes })
    }
}

/// Places, and what views alone look at.
fn forget_what_is_shown(def: &mut NodeDef) {
    def.bus = BusIndex(0);
    def.tags = 0..def.tags.len();
    def.alarms = 0..def.alarms.len();
    (def.unit_id, def.offset, def.on_loss, def.zero_on_bad) = (0, 0, OnLoss::default(), false);
    def.publish = PublishDef {
        min_interval: std::time::Duration::ZERO,
        fast_interval: std::time::Duration::ZERO,
        fast_while: None,
        max_interval: std::time::Duration::ZERO,
    };
    def.device.description.clear();
    def.device.vendor.clear();
    def.device.model.clear();
    def.device.mapping.clear();
}

fn owner_kind(owner: AlarmOwner) -> u8 {
    match owner {
        AlarmOwner::Gateway => 0,
        AlarmOwner::Bus(_) => 1,
        AlarmOwner::Node(_) => 2,
    }
}
