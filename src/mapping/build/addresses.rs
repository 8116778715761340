//! Who owns which Modbus address: no address of a unit may have two owners. And where nodes stand that are to be placed.

use std::collections::BTreeMap;
use std::ops::Range;

use super::super::SourceText;
use super::super::installation::Offset;
use super::super::table::{LineDef, Space, TagDef};
use super::offers;
use super::problems::Problems;
use super::tags::{ALARM_BITS, Context, FIRST_REGISTER};
use crate::process_image::NodeIndex;

/// A range of addresses and its owner.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
struct Claim {
    space: Space,
    addresses: Range64,
    owner: String,
    span: Option<(usize, usize)>,
}

/// `start..end`, with an order.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
struct Range64 {
    start: u64,
    end: u64,
}

impl From<Range<u64>> for Range64 {
    fn from(range: Range<u64>) -> Self {
        Self { start: range.start, end: range.end }
    }
}

/// All addresses of one node, offset added.
#[derive(Clone, Debug)]
pub struct Claims {
    /// Its name.
    node: String,
    /// Where the name stands in the configuration.
    span: Range<usize>,
    index: NodeIndex,
    unit_id: u64,
    /// It is to be placed; until then its addresses are without offset.
    is_auto: bool,
    list: Vec<Claim>,
}

impl Claims {
    /// From its first address to behind its last, registers and bits alike, as both have the same offset.
    fn extent(&self) -> Range<u64> {
        let start = self.list.iter().map(|claim| claim.addresses.start).min();
        let end = self.list.iter().map(|claim| claim.addresses.end).max();
        start.unwrap_or_default()..end.unwrap_or_default()
    }

    fn shift(&mut self, offset: u64) {
        for claim in &mut self.list {
            claim.addresses.start += offset;
            claim.addresses.end += offset;
        }
    }
}

fn word(space: Space) -> &'static str {
    match space {
        Space::Register => "register",
        Space::Bit => "bit",
    }
}

/// Collects the addresses of a node, and tells those that two of its tags share.
pub fn of_node(
    problems: &mut Problems,
    context: &Context<'_>,
    name: &super::super::At<String>,
    unit_id: u64,
    (tags, places): (&[TagDef], &[usize]),
    lines: &[LineDef],
) -> Claims {
    let mut list = Vec::new();
    for (item, place) in places.iter().enumerate() {
        let (Some(item), Some(tag)) = (context.items.get(item), tags.get(*place)) else { continue };
        for register in &tag.registers {
            let start = u64::from(register.address);
            list.push(Claim {
                space: register.space,
                addresses: (start..start + u64::from(register.encoding.count())).into(),
                owner: format!("`{}`", item.name),
                span: Some((item.span.start, item.span.end)),
            });
        }
    }
    list.sort();
    for mut pair in overlaps(&list) {
        pair.sort_by_key(|claim| claim.span);
        let [one, other] = pair;
        let span = other.span.map_or(0..0, |(start, end)| start..end);
        let message = format!(
            "{} and {} share {} {}",
            one.owner,
            other.owner,
            word(other.space),
            other.addresses.start.max(one.addresses.start)
        );
        problems.error(context.source, &span, message, "give each tag addresses of its own");
    }
    let own = |space, addresses: Range<u64>, owner: &str| Claim {
        space,
        addresses: addresses.into(),
        owner: owner.to_owned(),
        span: None,
    };
    list.push(own(Space::Register, 0..FIRST_REGISTER, "its node block"));
    list.push(own(Space::Bit, ALARM_BITS, "its alarm bits"));
    for (addresses, owner, span) in offers::texts(context, lines) {
        let text = own(Space::Register, addresses, &owner);
        let meets = |other: &&Claim| {
            other.space == text.space
                && other.addresses.start < text.addresses.end
                && text.addresses.start < other.addresses.end
        };
        if let Some(other) = list.iter().find(meets) {
            let address = other.addresses.start.max(text.addresses.start);
            let message = format!("{} and {owner} share register {address}", other.owner);
            problems.error(
                context.config,
                &span,
                message,
                "use another `text_register`, or a shorter `text_length`",
            );
        }
        list.push(text);
    }
    let offset = offset(problems, context, &list);
    let is_auto = context.entry.offset.as_ref().is_some_and(|offset| offset.value == Offset::Auto);
    let (node, span) = (name.value.clone(), name.span.clone());
    let mut claims = Claims { node, span, index: context.node, unit_id, is_auto, list };
    claims.shift(offset);
    claims
}

/// Places the nodes whose offset is `auto` (R-ESD-118 to 122): unit id by unit id, in the order of the configuration, each
/// right behind the one before it that was placed so, round those that have an offset of their own. The same input gives the
/// same places.
pub fn place(problems: &mut Problems, config: &SourceText, nodes: &mut [Claims]) -> Vec<(NodeIndex, u16)> {
    let mut order: Vec<usize> =
        nodes.iter().enumerate().filter(|(_, node)| node.is_auto).map(|(place, _)| place).collect();
    // Nodes come by their names.
    order.sort_by_key(|place| nodes.get(*place).map(|node| node.span.start));
    let mut placed = Vec::new();
    let mut free_from: BTreeMap<u64, u64> = BTreeMap::new();
    for place in order {
        let Some(node) = nodes.get(place) else { continue };
        let (unit_id, length) = (node.unit_id, node.extent().end);
        let mut pinned: Vec<Range<u64>> = nodes
            .iter()
            .filter(|other| other.unit_id == unit_id && !other.is_auto)
            .map(Claims::extent)
            .collect();
        pinned.sort_by_key(|extent| extent.start);
        let free = free_from.entry(unit_id).or_default();
        let mut offset = *free;
        for extent in pinned {
            if extent.start < offset + length && offset < extent.end {
                offset = extent.end;
            }
        }
        let end = offset + length;
        if end > u64::from(u16::MAX) + 1 {
            let message = format!(
                "there is no room for node `{}` in unit id {unit_id}: it would end at address {}",
                node.node,
                end - 1
            );
            problems.error(config, &node.span, message, "give it, or others, another unit_id");
            // It stands nowhere, so it is in nobody's way.
            nodes.get_mut(place).into_iter().for_each(|node| node.list.clear());
            continue;
        }
        *free = end;
        placed.extend(u16::try_from(offset).map(|offset| (node.index, offset)));
        if let Some(node) = nodes.get_mut(place) {
            node.shift(offset);
        }
    }
    placed
}

/// What is added to all addresses of the node, none of which may leave the address space.
fn offset(problems: &mut Problems, context: &Context<'_>, list: &[Claim]) -> u64 {
    let Some((offset, value)) = context.entry.offset.as_ref().and_then(|at| match at.value {
        Offset::Fixed(value) => Some((at, value)),
        Offset::Auto => None,
    }) else {
        return 0;
    };
    let highest = u64::from(u16::MAX);
    let furthest = list.iter().max_by_key(|claim| claim.addresses.end);
    let (space, end) =
        furthest.map_or((Space::Register, FIRST_REGISTER), |claim| (claim.space, claim.addresses.end));
    let room = highest + 1 - end.min(highest + 1);
    if value > room {
        let message = format!("with this offset {} {} is above {highest}", word(space), end - 1);
        problems.error(context.config, &offset.span, message, format!("use {room} at most"));
    }
    value.min(room)
}

/// Neighbours that overlap, of a sorted list.
fn overlaps(sorted: &[Claim]) -> impl Iterator<Item = [&Claim; 2]> {
    let mut widest: Option<&Claim> = None;
    sorted.iter().filter_map(move |claim| {
        let before = widest.filter(|widest| widest.space == claim.space);
        let overlap = before.filter(|before| claim.addresses.start < before.addresses.end);
        if before.is_none_or(|before| before.addresses.end < claim.addresses.end) {
            widest = Some(claim);
        }
        overlap.map(|before| [before, claim])
    })
}

/// Tells nodes that share a unit id and addresses, naming both: once for each pair of nodes.
pub fn check_nodes(problems: &mut Problems, config: &SourceText, nodes: &[Claims]) {
    for (index, node) in nodes.iter().enumerate() {
        for other in nodes.iter().take(index).filter(|other| other.unit_id == node.unit_id) {
            let shared = node.list.iter().find_map(|claim| {
                let meets = |theirs: &&Claim| {
                    theirs.space == claim.space
                        && theirs.addresses.start < claim.addresses.end
                        && claim.addresses.start < theirs.addresses.end
                };
                other.list.iter().find(meets).map(|theirs| (claim, theirs))
            });
            if let Some((claim, theirs)) = shared {
                let address = claim.addresses.start.max(theirs.addresses.start);
                let message = format!(
                    "nodes `{}` and `{}` share unit id {} and addresses: {} {address} is {} of `{}` and {} of `{}`",
                    other.node,
                    node.node,
                    node.unit_id,
                    word(claim.space),
                    theirs.owner,
                    other.node,
                    claim.owner,
                    node.node
                );
                let hint =
                    "give one of them another unit_id, or an offset behind the last address of the other";
                problems.error(config, &node.span, message, hint);
            }
        }
    }
}
