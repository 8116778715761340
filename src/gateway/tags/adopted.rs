//! Tags that stand where the device itself maps their objects (R-DST-024): their places change when the device says so.

use super::{CarrierIndex, CarrierLayout, NodeLayout, Placed, Tags, computed_from};
use crate::canopen::PdoIndex;
use crate::canopen::object::{MappedObject, ObjectId};
use crate::mapping::TagTable;
use crate::process_image::{NodeIndex, Quality, Reason, TagIndex};
use crate::time::Now;

/// A tag whose place is for the device to say.
#[derive(Debug)]
pub(super) struct Adopted {
    pub(super) object: ObjectId,
    /// What carries it where no TPDO does.
    pub(super) poll: Option<CarrierIndex>,
    /// As it stands at the begin of a carrier.
    pub(super) placed: Placed,
}

impl Tags {
    /// A device maps a TPDO so: the tags whose objects it has stand there from now on.
    pub(in crate::gateway) fn adopt(&mut self, node: NodeIndex, pdo: PdoIndex, maps: &[MappedObject]) {
        if let Some(layout) = self.layout.nodes.get_mut(node.0) {
            layout.adopt(pdo, maps, &self.layout.dependents);
        }
    }

    /// A device has said what all its TPDOs carry. What none of them carries and nobody reads is bad; which tags that are.
    pub(in crate::gateway) fn finish_adoption(
        &mut self,
        table: &TagTable,
        now: Now,
        node: NodeIndex,
    ) -> Vec<TagIndex> {
        let Self { layout, state, .. } = self;
        let Some(node) = layout.nodes.get(node.0) else { return Vec::new() };
        let missing = node.missing();
        for tag in &missing {
            if let Some(sample) = state.samples.get(tag.0).copied() {
                state.store(layout, *tag, sample.raw, sample.value, Quality::Bad(Reason::NotMapped));
            }
        }
        state.compute_outdated(table, layout, &node.derived, now);
        missing
    }
}

impl NodeLayout {
    fn adopt(&mut self, pdo: PdoIndex, maps: &[MappedObject], dependents: &[Vec<TagIndex>]) {
        let Self { carriers, adopted, .. } = self;
        let Some(carrier) = carriers.get_mut(pdo.0) else { return };
        carrier.placed.retain(|placed| adopted.iter().all(|adopted| adopted.placed.tag != placed.tag));
        let mut bit = 0_u32;
        for mapped in maps {
            // Of fewer bits than its type has, no value can be made; nor of what lies behind the 64th.
            let whole = adopted.iter().filter(|tag| {
                let width = tag.placed.field.width;
                tag.object == mapped.object && width <= mapped.bits && bit + u32::from(width) <= 64
            });
            carrier.placed.extend(whole.filter_map(|tag| {
                let mut placed = tag.placed;
                placed.field.bit = u8::try_from(bit).ok()?;
                Some(placed)
            }));
            bit += u32::from(mapped.bits);
        }
        self.place_polled(dependents);
    }

    /// What no TPDO carries stands where it is read; and what is computed from what each carrier holds.
    pub(super) fn place_polled(&mut self, dependents: &[Vec<TagIndex>]) {
        let pdos = self.carriers.len();
        for place in 0..self.adopted.len() {
            let Some(adopted) = self.adopted.get(place) else { continue };
            let (tag, placed) = (adopted.placed.tag, adopted.placed);
            let Some(poll) = adopted.poll.filter(|poll| poll.0 < pdos) else { continue };
            let sent = self.is_sent(tag, poll);
            if let Some(carrier) = self.carriers.get_mut(poll.0) {
                carrier.placed.retain(|placed| placed.tag != tag);
                carrier.placed.extend((!sent).then_some(placed));
            }
        }
        for carrier in &mut self.carriers {
            carrier.computed = computed_from(carrier.placed.iter().map(|placed| placed.tag), dependents);
        }
    }

    /// Whether another carrier than this has the tag.
    fn is_sent(&self, tag: TagIndex, poll: CarrierIndex) -> bool {
        let others = self.carriers.iter().enumerate().filter(|(place, _)| *place != poll.0);
        others.flat_map(|(_, carrier)| &carrier.placed).any(|placed| placed.tag == tag)
    }

    /// The tags that nothing carries.
    fn missing(&self) -> Vec<TagIndex> {
        let has = |carrier: &CarrierLayout, tag| carrier.placed.iter().any(|placed| placed.tag == tag);
        let tags = self.adopted.iter().map(|adopted| adopted.placed.tag);
        tags.filter(|tag| !self.carriers.iter().any(|carrier| has(carrier, *tag))).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mapping::{Field, FieldKind};

    /// In which carriers one signed tag of 32 bits stands, and whether it is missing: carrier 0 is a TPDO with this
    /// content, carrier 1 what is read.
    fn places(maps: &[u32], read: bool) -> (Vec<usize>, bool) {
        let field = Field { bit: 0, width: 32, kind: FieldKind::Signed, big_endian: false, invert: false };
        let tag = Adopted {
            object: ObjectId::new(0x9130, 2),
            poll: read.then_some(CarrierIndex(1)),
            placed: Placed { tag: TagIndex(0), field, scale: None, unit: None },
        };
        let carriers = vec![CarrierLayout::default(), CarrierLayout::default()];
        let mut layout = NodeLayout { carriers, received: 2, derived: Vec::new(), adopted: vec![tag] };
        let maps: Vec<_> = maps.iter().copied().map(MappedObject::from_entry).collect();
        layout.adopt(PdoIndex(0), &maps, &[Vec::new()]);
        let has = |place: &usize| layout.carriers[*place].placed.len() == 1;
        ((0..2).filter(has).collect(), !layout.missing().is_empty())
    }

    #[test]
    fn r_dst_024_a_tag_of_which_too_few_bits_come_is_read_or_missing() {
        for (maps, sent) in [
            (&[0x9130_0220][..], true),
            (&[0x9130_0240], true),
            (&[0x9130_0120, 0x9130_0220], true),
            (&[0x9130_0210], false),
            (&[0x9130_0120, 0x6150_0108, 0x9130_0220], false),
            (&[0x6130_01FF, 0x6130_01FF, 0x9130_0220], false),
        ] {
            assert_eq!(places(maps, true), (vec![usize::from(!sent)], false), "{maps:X?}");
            assert_eq!(places(maps, false), (if sent { vec![0] } else { vec![] }, !sent), "{maps:X?}");
        }
    }
}
