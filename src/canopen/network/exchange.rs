//! A network with other settings goes on with the nodes that stay.

use super::{Network, Slot};
use crate::canopen::NodeId;
use crate::time::Now;

impl Network {
    /// Takes over from the network that ran on this bus until now: the state of the bus, and the nodes `stay`, whose settings are to
    /// be the same in both. Those go on as if nothing had happened, with the identifiers that they told of; the others begin as
    /// when the bus comes up. `broadcasts`: SYNC, TIME and the own heartbeat go on too. Nothing may wait in its outputs.
    pub fn take_over(&mut self, mut old: Self, now: Now, stay: &[NodeId], broadcasts: bool) {
        self.link_up = old.link_up;
        self.clock_synchronised = old.clock_synchronised;
        self.foreign_lss = old.foreign_lss;
        let places: Vec<(usize, usize)> =
            stay.iter().filter_map(|id| Some((self.place(*id)?, old.place(*id)?))).collect();
        for (to, from) in &places {
            if let (Some(node), Some(old)) = (self.nodes.get_mut(*to), old.nodes.get_mut(*from)) {
                std::mem::swap(node, old);
            }
        }
        let stays = |slot: Slot| slot.node().is_some_and(|node| places.iter().any(|(to, _)| *to == node));
        self.standard.iter_mut().filter(|slot| stays(**slot)).for_each(|slot| *slot = Slot::Unknown);
        self.extended.retain(|_, slot| !stays(*slot));
        for (id, slot) in old.claimed() {
            let to = places.iter().find(|(_, from)| slot.node() == Some(*from)).map(|(to, _)| *to);
            if let Some(slot) = to.and_then(|to| slot.at(to)) {
                self.claim(id, slot);
            }
        }
        self.strangers = old.strangers;
        if broadcasts {
            self.broadcasts = old.broadcasts;
        } else if self.link_up {
            self.broadcasts.resume(now.instant, self.clock_synchronised);
        }
        for place in (0..self.nodes.len()).filter(|place| places.iter().all(|(to, _)| to != place)) {
            if let Some(node) = self.nodes.get_mut(place).filter(|_| self.link_up) {
                node.resume(now.instant);
                node.transfer(now.instant, &mut self.outputs);
                node.drive_rpdos(now.instant, &mut self.outputs);
            }
        }
        self.look_ahead();
    }

    fn place(&self, id: NodeId) -> Option<usize> {
        self.nodes.iter().position(|node| node.id == id)
    }
}
