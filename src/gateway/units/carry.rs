//! What nodes that stay told of their units goes on in another table.

use super::Units;
use crate::gateway::kept::Kept;

impl Units {
    /// Takes over what is known of the tags that stay.
    pub(in crate::gateway) fn take_over(&mut self, old: Self, kept: &Kept) {
        for entry in old.list {
            let tag = kept.new_tag(entry.tag);
            if let Some(new) = self.list.iter_mut().find(|each| Some(each.tag) == tag) {
                (new.unit, new.digits, new.reading, new.before) =
                    (entry.unit, entry.digits, entry.reading, entry.before);
            }
        }
        self.changed = true;
    }
}
