//! Values of nodes that stay go on in another table.

use super::{NodeLayout, Placed, Tags};
use crate::gateway::kept::Kept;
use crate::gateway::units::Units;
use crate::process_image::TagIndex;
use crate::time::{Instant, Now};

impl Tags {
    /// Takes over values, memories and places of the tags that stay.
    pub(in crate::gateway) fn take_over(&mut self, mut old: Self, kept: &Kept, now: Now) {
        self.units.take_over(old.units, kept);
        let Self { layout, state, units } = self;
        // To readers of alarms and nodes only what is new is a change.
        let changed: Vec<usize> =
            state.changed.drain().filter(|tag| kept.tags.get(*tag).is_none_or(Option::is_none)).collect();
        for tag in changed {
            state.changed.mark(tag);
        }
        for (place, from) in kept.tags.iter().enumerate() {
            let Some(TagIndex(from)) = *from else { continue };
            copy(&mut state.samples, place, &old.state.samples, from);
            copy(&mut state.outdated, place, &old.state.outdated, from);
            if let (Some(memory), Some(old)) =
                (state.memories.get_mut(place), old.state.memories.get_mut(from))
            {
                std::mem::swap(memory, old);
            }
            // Whether it changes by mere time is seen at the next second.
            state.running.mark(place);
        }
        if old.state.next_second.is_some() {
            state.next_second = Some(Instant::from_millis((now.instant.as_millis() / 1_000 + 1) * 1_000));
        }
        for (place, from) in kept.nodes.iter().enumerate() {
            let Some(before) = from.and_then(|from| old.layout.nodes.get_mut(from.0)) else { continue };
            let Some(node) = layout.nodes.get_mut(place) else { continue };
            std::mem::swap(node, before);
            node.renumber(&|tag| kept.new_tag(tag), units);
        }
    }
}

fn copy<T: Clone>(to: &mut [T], place: usize, of: &[T], from: usize) {
    if let (Some(to), Some(of)) = (to.get_mut(place), of.get(from)) {
        to.clone_from(of);
    }
}

impl NodeLayout {
    /// Its tags have other places now.
    fn renumber(&mut self, new: &dyn Fn(TagIndex) -> Option<TagIndex>, units: &Units) {
        let place = |placed: &mut Placed| {
            placed.tag = new(placed.tag).unwrap_or(placed.tag);
            placed.unit = units.place_of(placed.tag);
        };
        let tag = |tag: &mut TagIndex| *tag = new(*tag).unwrap_or(*tag);
        for carrier in &mut self.carriers {
            carrier.placed.iter_mut().for_each(place);
            carrier.computed.iter_mut().for_each(tag);
        }
        self.derived.iter_mut().for_each(tag);
        self.adopted.iter_mut().for_each(|adopted| place(&mut adopted.placed));
    }
}
