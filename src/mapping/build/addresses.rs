//! Who owns which Modbus address: no address of a unit may have two owners.

use std::ops::Range;

use super::super::SourceText;
use super::super::table::{Space, TagDef};
use super::problems::Problems;
use super::tags::{ALARM_BITS, Context, FIRST_REGISTER};

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
    unit_id: u64,
    list: Vec<Claim>,
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
    tags: &[TagDef],
    places: &[usize],
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
    let offset = offset(problems, context, &list);
    for claim in &mut list {
        claim.addresses.start += offset;
        claim.addresses.end += offset;
    }
    Claims { node: name.value.clone(), span: name.span.clone(), unit_id, list }
}

/// What is added to all addresses of the node, none of which may leave the address space.
fn offset(problems: &mut Problems, context: &Context<'_>, list: &[Claim]) -> u64 {
    let Some(offset) = &context.entry.offset else { return 0 };
    let highest = u64::from(u16::MAX);
    let furthest = list.iter().max_by_key(|claim| claim.addresses.end);
    let (space, end) =
        furthest.map_or((Space::Register, FIRST_REGISTER), |claim| (claim.space, claim.addresses.end));
    let room = highest + 1 - end.min(highest + 1);
    if offset.value > room {
        let message = format!("with this offset {} {} is above {highest}", word(space), end - 1);
        problems.error(context.config, &offset.span, message, format!("use {room} at most"));
    }
    offset.value.min(room)
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
