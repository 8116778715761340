//! What happens on a bus that is no configured node's: other masters and producers, frames of nobody.

use super::Gateway;
use crate::can::{BusIndex, CanId};
use crate::canopen::{ForeignEvent, NodeId, Role, cob_id};
use crate::mapping::{AlarmOwner, BuiltIn};
use crate::process_image::{NodeIndex, Value};
use crate::time::Now;

impl Gateway {
    /// A frame that belongs to nobody used an identifier of a node.
    pub(super) fn count_foreign_frame_of(&mut self, node: NodeIndex) {
        if let Some(def) = self.table.nodes.get(node.0) {
            self.count_foreign_frame(def.bus);
        }
    }

    pub(super) fn count_foreign_frame(&mut self, index: BusIndex) {
        if let Some(bus) = self.buses.get_mut(index.0) {
            bus.foreign = bus.foreign.saturating_add(1);
            bus.status.foreign_frames = bus.status.foreign_frames.saturating_add(1);
            self.dirty_buses.mark(index.0);
        }
    }

    pub(super) fn foreign_event(&mut self, now: Now, index: BusIndex, event: &ForeignEvent) {
        match event {
            ForeignEvent::NmtCommand { command, node } => {
                self.foreign_master(now, index);
                self.tell_bus(now, index, "foreign_nmt_command", |event| {
                    event.value = Some(Value::Unsigned((*command).into()));
                    event.text =
                        format!("somebody else sent NMT command 0x{command:02X} to node {node} (0 = all)");
                });
            }
            ForeignEvent::Sync { produced, first } => {
                // Somebody who was told of is nobody to tell of.
                let def = self.table.buses.get(index.0);
                if *produced || def.is_none_or(|bus| bus.sync.is_none()) {
                    self.foreign_broadcast(now, index, "SYNC", *produced, *first);
                }
            }
            ForeignEvent::Time { produced, first } => {
                self.foreign_broadcast(now, index, "TIME", *produced, *first);
            }
            ForeignEvent::Lss => {
                self.foreign_master(now, index);
                self.tell_bus(now, index, "foreign_lss", |event| {
                    event.text =
                        "somebody else looks for devices by LSS, or changes a node id or bit rate".into();
                });
            }
            ForeignEvent::UnknownId { id, node, first } => {
                self.count_foreign_frame(index);
                if *first {
                    let node = *node;
                    let known = node.is_some_and(|node| self.is_configured(index, node));
                    self.tell_bus(now, index, "unknown_id", |event| {
                        event.value = Some(Value::Unsigned(id.raw().into()));
                        event.text = stranger(*id, node, known);
                    });
                }
            }
        }
    }

    /// SYNC or TIME of somebody else: of a second producer, or of one that the configuration does not know.
    fn foreign_broadcast(
        &mut self,
        now: Now,
        index: BusIndex,
        what: &'static str,
        produced: bool,
        first: bool,
    ) {
        self.count_foreign_frame(index);
        if produced {
            self.conditions.pulse(now, AlarmOwner::Bus(index), BuiltIn::ForeignProducer);
            let name = if what == "SYNC" { "foreign_sync" } else { "foreign_time" };
            self.tell_bus(now, index, name, |event| {
                event.text = format!("somebody else sends {what}, which this gateway sends too");
            });
        } else if first {
            self.tell_bus(now, index, "unknown_id", |event| {
                event.text = format!("{what} comes from somebody else");
            });
        }
    }

    /// Somebody else does what a master does. In the passive role that is as it should be.
    pub(super) fn foreign_master(&mut self, now: Now, index: BusIndex) {
        if self.buses.get(index.0).is_some_and(|bus| bus.role == Role::Master) {
            self.conditions.pulse(now, AlarmOwner::Bus(index), BuiltIn::ForeignMaster);
        }
    }

    fn is_configured(&self, index: BusIndex, node: NodeId) -> bool {
        let bus = self.buses.get(index.0);
        bus.and_then(|bus| bus.by_id.get(usize::from(node.get()))).is_some_and(Option::is_some)
    }
}

/// What the first frame of an identifier of nobody's may mean. `known`: its node id is that of a configured node.
fn stranger(id: CanId, node: Option<NodeId>, known: bool) -> String {
    let Some(node) = node else { return format!("{id} belongs to no configured node") };
    if known && is_rpdo(id) {
        return format!("somebody else sends node {node} process data, {id}");
    }
    if known {
        return format!(
            "{id} stands for node {node}, but the mapping of that node does not know it: it leaves something out, or \
             another device has the same node id"
        );
    }
    if id == cob_id::error_control(node) {
        return format!(
            "{id} is a heartbeat, boot-up message or guard request of node {node}, which is not configured: another \
             master, or a device that the configuration leaves out"
        );
    }
    format!("{id} comes from node {node}, which is not configured")
}

/// Whether an identifier is that of an RPDO of the predefined connection set: what a master sends its nodes.
fn is_rpdo(id: CanId) -> bool {
    matches!(id, CanId::Standard(id) if matches!(id >> 7, 4 | 6 | 8 | 10))
}
