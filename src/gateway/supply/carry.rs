//! What was written for nodes that stay goes on in another table.

use super::Supply;
use crate::gateway::kept::Kept;

impl Supply {
    /// Takes over what the nodes that stay are sent.
    pub(in crate::gateway) fn take_over(&mut self, mut old: Self, kept: &Kept) {
        for (place, from) in kept.nodes.iter().enumerate() {
            let Some(before) = from.and_then(|from| old.nodes.get_mut(from.0)) else { continue };
            let Some(node) = self.nodes.get_mut(place) else { continue };
            std::mem::swap(node, before);
            for slot in node.rpdos.iter_mut().flat_map(|rpdo| &mut rpdo.slots) {
                slot.tag = kept.new_tag(slot.tag).unwrap_or(slot.tag);
            }
        }
    }
}
