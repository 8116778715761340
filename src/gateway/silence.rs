//! When nobody is heard on a bus: from when on that is the silence of the bus and not of its nodes.

use std::time::Duration;

use super::Gateway;
use super::bus::Bus;
use super::node::Node;
use crate::can::BusIndex;
use crate::canopen::{ErrorControl, NodeSettings};
use crate::mapping::{AlarmOwner, BuiltIn, NodeDef, Protocol};
use crate::time::{Instant, Now};

/// A bus is silent when nobody sent anything for this long (B03), or longer where its nodes speak more seldom.
pub(super) const SILENCE: Duration = Duration::from_millis(1_500);

/// How long a node that is well can be silent.
fn longest_silence(node: &NodeDef) -> Option<Duration> {
    match &node.protocol {
        Protocol::Canopen(settings) => longest_silence_of_node(settings),
        Protocol::Esd(settings) => {
            settings.management.as_ref().map(|management| management.status_period * 3)
        }
    }
}

fn longest_silence_of_node(node: &NodeSettings) -> Option<Duration> {
    match &node.error_control {
        ErrorControl::Guarding(guarding) if !guarding.guard_time.is_zero() => Some(guarding.guard_time * 3),
        ErrorControl::Heartbeat { timeout } => Some(*timeout),
        ErrorControl::Guarding(_) | ErrorControl::None => {
            node.pdos.iter().filter_map(|pdo| pdo.timeout).min()
        }
    }
}

/// How long a bus with these nodes can be silent: until two of them should have been heard, since the silence of one
/// is its own. `None` where there are no two.
pub(super) fn silence<'a>(nodes: impl Iterator<Item = &'a NodeDef>) -> Option<Duration> {
    let (mut shortest, mut second) = (None, None);
    for silence in nodes.filter_map(longest_silence) {
        if shortest.is_none_or(|shortest| silence < shortest) {
            second = shortest.replace(silence);
        } else if second.is_none_or(|second| silence < second) {
            second = Some(silence);
        }
    }
    second.map(|second| second.max(SILENCE))
}

impl Gateway {
    /// While the loss of a node may turn out to be the silence of its bus, or the node may only be slow to come back
    /// after that: until when that is decided.
    pub(super) fn undecided_until(&self, now: Now, node: &NodeDef) -> Option<Instant> {
        let bus = self.buses.get(node.bus.0)?;
        let back = bus.back_at.map(|at| at + longest_silence(node).unwrap_or(SILENCE));
        self.silent_from(now, node.bus).max(back).filter(|until| *until > now.instant)
    }

    /// While a bus has been quiet for so long that it may be silent altogether: from when on it will be.
    pub(super) fn silent_from(&self, now: Now, index: BusIndex) -> Option<Instant> {
        let bus = self.buses.get(index.0)?;
        let quiet = now.instant.since(bus.heard_at);
        if bus.silent_at().is_none() || quiet < bus.shortest_silence / 2 {
            return None;
        }
        let silence = self.silence_of(bus)?;
        (quiet >= silence / 2).then_some(bus.heard_at + silence).filter(|at| *at > now.instant)
    }

    /// How long a bus can be silent; `None` unless at least two nodes should be heard all the time. The silence of a
    /// single one is that node's own, and its own alarm tells of it better. So is that of a node that was missing
    /// already while others were heard.
    fn silence_of(&self, bus: &Bus) -> Option<Duration> {
        let expected = bus.members.iter().filter_map(|index| {
            let def: &NodeDef = self.table.nodes.get(index.0)?;
            let node: &Node = self.nodes.get(index.0)?;
            let missing = node.is_missing() && node.missing_since <= Some(bus.heard_at);
            (!missing && node.is_expected(def)).then_some(def)
        });
        silence(expected)
    }

    /// Frames come again, or can come again, after nobody could be heard. What was known of the nodes' absence says
    /// nothing any more: each has the time that it may be silent for to show itself, and until then the end of the
    /// bus's own alarm does not raise theirs.
    pub(super) fn begin_anew(&mut self, now: Now, index: BusIndex) {
        let Some(bus) = self.buses.get_mut(index.0) else { return };
        bus.back_at = Some(now.instant);
        for node in bus.members.clone() {
            let owner = AlarmOwner::Node(node);
            self.conditions.set(now, owner, BuiltIn::NodeLost, false);
            self.conditions.set(now, owner, BuiltIn::NodeNeverSeen, false);
        }
    }

    /// Looks whether a bus has fallen silent.
    pub(super) fn check_silence(&mut self, now: Now, index: BusIndex) {
        let Some(bus) = self.buses.get(index.0) else { return };
        if bus.silent_at().is_none_or(|at| at > now.instant) {
            return;
        }
        let silence = self.silence_of(bus);
        let Some(bus) = self.buses.get_mut(index.0) else { return };
        match silence {
            Some(silence) if bus.heard_at + silence <= now.instant => {
                bus.silent = true;
                self.conditions.set(now, AlarmOwner::Bus(index), BuiltIn::BusSilent, true);
                self.tell_bus(now, index, "bus_silent", |event| {
                    event.text = format!("no frame from anyone for {silence:?}");
                });
            }
            Some(silence) => bus.look_at = bus.heard_at + silence,
            None => bus.look_at = now.instant + bus.shortest_silence,
        }
        self.refresh_nodes_of(now, index);
    }
}
