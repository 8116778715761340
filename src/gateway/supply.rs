//! What nodes are sent in RPDOs: the values that were written, and what became of sending them.
//!
//! The network decides when an RPDO is sent, and whether its node takes part; here is what it carries. A tag of an RPDO shows
//! what was sent last, not what was written: as soon as the device may not have it, its quality says so.

mod carry;

use std::collections::BTreeMap;

use super::command::Outcome;
use super::core::{Gateway, Output};
use super::operate::Carrying;
use super::tags::CarrierIndex;
use crate::can::BusIndex;
use crate::canopen::RpdoIndex;
use crate::canopen::boot::MappedPdo;
use crate::canopen::object::ObjectId;
use crate::canopen::sdo::SdoRequest;
use crate::mapping::{Field, ReadOnly, Scale, Source, TagTable, WriteLimits, Writing, codec};
use crate::process_image::{NodeIndex, Quality, Reason, TagIndex, Value};
use crate::time::Now;

/// What all nodes are sent.
#[derive(Debug)]
pub(super) struct Supply {
    /// By node.
    nodes: Vec<NodeSupply>,
}

#[derive(Debug)]
struct NodeSupply {
    /// The node takes part.
    running: bool,
    /// By the RPDOs of its definition.
    rpdos: Vec<RpdoSupply>,
}

#[derive(Debug)]
struct RpdoSupply {
    /// What was written stays when the node is gone for a while.
    keeps_last: bool,
    /// The device takes it otherwise than its mapping file: nothing is sent.
    differs: bool,
    slots: Vec<Slot>,
}

/// A tag and its place.
#[derive(Debug)]
struct Slot {
    tag: TagIndex,
    field: Field,
    scale: Scale,
    limits: WriteLimits,
    value: Option<Value>,
}

/// A write that can be taken back.
#[derive(Clone, Copy, Debug)]
pub(super) struct Undo {
    node: NodeIndex,
    rpdo: RpdoIndex,
    tag: TagIndex,
    before: Option<Value>,
}

impl Supply {
    /// The defaults.
    pub(super) fn new(table: &TagTable) -> Self {
        let mut nodes: Vec<NodeSupply> = Vec::with_capacity(table.nodes.len());
        for def in &table.nodes {
            let rpdo = |rpdo: &crate::mapping::RpdoDef| RpdoSupply {
                keeps_last: rpdo.keeps_last,
                differs: false,
                slots: Vec::new(),
            };
            nodes.push(NodeSupply { running: false, rpdos: def.rpdos.iter().map(rpdo).collect() });
        }
        for (place, def) in table.tags.iter().enumerate() {
            let Source::Rpdo { rpdo, field, scale, limits } = &def.source else { continue };
            let node = nodes.get_mut(def.node.0);
            if let Some(rpdo) = node.and_then(|node| node.rpdos.get_mut(*rpdo)) {
                let (field, scale, limits) = (*field, *scale, *limits);
                rpdo.slots.push(Slot { tag: TagIndex(place), field, scale, limits, value: limits.default });
            }
        }
        Self { nodes }
    }

    fn rpdo(&mut self, node: NodeIndex, rpdo: RpdoIndex) -> Option<&mut RpdoSupply> {
        self.nodes.get_mut(node.0)?.rpdos.get_mut(rpdo.0)
    }

    /// The bytes of an RPDO, where all its values are known.
    fn data(&self, node: NodeIndex, rpdo: RpdoIndex) -> Option<[u8; 8]> {
        let rpdo = self.nodes.get(node.0)?.rpdos.get(rpdo.0)?;
        let mut data = [0; 8];
        for slot in &rpdo.slots {
            codec::encode(&slot.field, &slot.scale, slot.value?, &mut data).ok()?;
        }
        (!rpdo.slots.is_empty()).then_some(data)
    }
}

impl Slot {
    /// Why a value cannot be written, if it cannot.
    fn refusal(&self, value: Value) -> Option<String> {
        let WriteLimits { minimum, maximum, .. } = self.limits;
        let outside = !matches!(value, Value::Bool(_)) && !(minimum..=maximum).contains(&value.as_f64());
        match codec::encode(&self.field, &self.scale, value, &mut [0; 8]) {
            Err(error) => Some(error.to_string()),
            Ok(()) if outside => Some(format!("it is not between {minimum} and {maximum}")),
            Ok(()) => None,
        }
    }
}

/// A tag that is never written is no fault of the moment.
fn read_only(why: &ReadOnly) -> Outcome {
    match why {
        ReadOnly::Unknown => Outcome::Unknown,
        ReadOnly::Passive | ReadOnly::Outputs(_) | ReadOnly::Sdo(_) | ReadOnly::Device => {
            Outcome::Rejected(why.to_string())
        }
    }
}

impl Gateway {
    /// Hands all defaults to the networks.
    pub(super) fn begin_supply(&mut self, now: Now) {
        for node in (0..self.nodes.len()).map(NodeIndex) {
            self.supply_node(now, node);
        }
    }

    fn supply_node(&mut self, now: Now, node: NodeIndex) {
        let rpdos = self.table.nodes.get(node.0).map_or(0, |def| def.rpdos.len());
        for rpdo in (0..rpdos).map(RpdoIndex) {
            self.supply_rpdo(now, node, rpdo);
        }
    }

    fn supply_rpdo(&mut self, now: Now, node: NodeIndex, rpdo: RpdoIndex) {
        let Some(def) = self.table.nodes.get(node.0) else { return };
        let data = self.supply.data(node, rpdo);
        if let Some(bus) = self.buses.get_mut(def.bus.0)
            && let Some(canopen) = def.canopen()
        {
            bus.network.set_rpdo(now, canopen.id, rpdo, data);
        }
    }

    /// Checks all of these writes, then does them: those of RPDOs at once; the one of an object is given back as what is to be
    /// asked of which node. `frames` gets those that carry them, where they are sent at once.
    ///
    /// # Errors
    /// What becomes of the request; nothing was written then.
    pub(super) fn write_tags(
        &mut self,
        now: Now,
        writes: &[(TagIndex, Value)],
        frames: &mut Vec<Carrying>,
    ) -> Result<Option<(NodeIndex, SdoRequest)>, Outcome> {
        let mut places = Vec::with_capacity(writes.len());
        for (tag, value) in writes {
            let name = self.table.tag(*tag).map(|def| def.name.clone()).unwrap_or_default();
            let with_name = |outcome: Outcome| {
                if let (Outcome::Rejected(why), true) = (&outcome, writes.len() > 1) {
                    return Outcome::Rejected(format!("`{name}`: {why}"));
                }
                outcome
            };
            let writing = self.table.writing(*tag).map_err(|why| read_only(&why)).map_err(with_name)?;
            if let Writing::Object(object, limits) = writing {
                return match writes {
                    [_] => self.object_write(*tag, *value, (object, limits)).map(Some),
                    _ => Err(Outcome::Rejected(format!("`{name}` is an object: it is written by itself"))),
                };
            }
            if writes.iter().filter(|(other, _)| other == tag).count() > 1 {
                return Err(with_name(Outcome::Rejected("it is written twice".to_owned())));
            }
            places.push(self.check_write(*tag, *value).map_err(with_name)?);
        }
        if places.is_empty() {
            return Err(Outcome::Rejected("there is nothing to write".to_owned()));
        }
        let mut undo: BTreeMap<(NodeIndex, RpdoIndex, BusIndex), Vec<Undo>> = BTreeMap::new();
        for ((node, rpdo, bus), (tag, value)) in places.into_iter().zip(writes) {
            let Some(slot) = self.slot(node, rpdo, *tag) else { continue };
            let before = slot.value.replace(*value);
            undo.entry((node, rpdo, bus)).or_default().push(Undo { node, rpdo, tag: *tag, before });
        }
        for ((node, rpdo, bus), undo) in undo {
            frames.extend(self.send_written((node, rpdo, bus), now, undo));
        }
        Ok(None)
    }

    fn slot(&mut self, node: NodeIndex, rpdo: RpdoIndex, tag: TagIndex) -> Option<&mut Slot> {
        self.supply.rpdo(node, rpdo)?.slots.iter_mut().find(|slot| slot.tag == tag)
    }

    /// Where a tag of an RPDO is written, if this value can be written there now.
    fn check_write(
        &mut self,
        tag: TagIndex,
        value: Value,
    ) -> Result<(NodeIndex, RpdoIndex, BusIndex), Outcome> {
        let (node, rpdo, bus) = self.written_in(tag).ok_or(Outcome::Unknown)?;
        self.may_write(node, rpdo)?;
        let slot = self.slot(node, rpdo, tag).ok_or(Outcome::Unknown)?;
        slot.refusal(value).map_or(Ok((node, rpdo, bus)), |why| Err(Outcome::Rejected(why)))
    }

    /// Hands an RPDO to its network; gives the frame, where one is sent at once.
    fn send_written(
        &mut self,
        (node, rpdo, bus): (NodeIndex, RpdoIndex, BusIndex),
        now: Now,
        undo: Vec<Undo>,
    ) -> Option<Carrying> {
        let sent_before = self.outputs.len();
        self.supply_rpdo(now, node, rpdo);
        self.drain_network(now, bus);
        let settings = self.table.nodes.get(node.0).and_then(|def| def.protocol.rpdos().get(rpdo.0));
        let cob_id = settings.map(|settings| settings.cob_id);
        let frame = self.outputs.iter().skip(sent_before).find_map(|output| match output {
            Output::Transmit { frame, .. } if Some(frame.id()) == cob_id => Some(*frame),
            Output::Transmit { .. } | Output::Reply { .. } => None,
        })?;
        Some(Carrying { bus, frame, undo })
    }

    /// What is to be asked of a node so that an object gets a value, if that can be asked now.
    fn object_write(
        &self,
        tag: TagIndex,
        value: Value,
        (object, limits): (ObjectId, WriteLimits),
    ) -> Result<(NodeIndex, SdoRequest), Outcome> {
        let def = self.table.tag(tag).ok_or(Outcome::Unknown)?;
        let (Source::Pdo { field, scale, .. }
        | Source::Polled { field, scale, .. }
        | Source::Adopted { field, scale, .. }) = def.source
        else {
            return Err(read_only(&ReadOnly::Device));
        };
        // By SDO it stands alone, wherever a TPDO may carry it.
        let slot = Slot { tag, field: Field { bit: 0, ..field }, scale, limits, value: None };
        if let Some(why) = slot.refusal(value) {
            return Err(Outcome::Rejected(why));
        }
        let mut data = [0; 8];
        let encoded = codec::encode(&slot.field, &scale, value, &mut data);
        encoded.map_err(|error| Outcome::Rejected(error.to_string()))?;
        let bytes = usize::from(field.width.div_ceil(8));
        let data = data.get(..bytes).unwrap_or_default().to_vec();
        Ok((def.node, SdoRequest::write(object, data)))
    }

    fn written_in(&self, tag: TagIndex) -> Option<(NodeIndex, RpdoIndex, BusIndex)> {
        let def = self.table.tag(tag)?;
        let Source::Rpdo { rpdo, .. } = def.source else { return None };
        Some((def.node, RpdoIndex(rpdo), self.table.node(def.node)?.bus))
    }

    fn may_write(&mut self, node: NodeIndex, rpdo: RpdoIndex) -> Result<(), Outcome> {
        let Some(def) = self.table.node(node) else { return Err(Outcome::Unknown) };
        let number = def.rpdos.get(rpdo.0).map_or(0, |rpdo| rpdo.number);
        let running = self.supply.nodes.get(node.0).is_some_and(|node| node.running);
        if !running {
            return Err(Outcome::NodeUnavailable);
        }
        if self.supply.rpdo(node, rpdo).is_some_and(|rpdo| rpdo.differs) {
            let message =
                format!("the device takes RPDO{number} otherwise than its mapping file: nothing is sent");
            return Err(Outcome::Rejected(message));
        }
        Ok(())
    }

    /// The frame of a write was not taken: what held before holds again.
    pub(super) fn take_back(&mut self, now: Now, undo: Undo) {
        let Undo { node, rpdo, tag, before } = undo;
        if let Some(rpdo) = self.supply.rpdo(node, rpdo) {
            rpdo.slots.iter_mut().filter(|slot| slot.tag == tag).for_each(|slot| slot.value = before);
        }
        self.supply_rpdo(now, node, rpdo);
    }

    pub(super) fn rpdos_started(&mut self, at: (Now, NodeIndex)) {
        if let Some(node) = self.supply.nodes.get_mut(at.1.0) {
            node.running = true;
        }
        self.tell(at, "outputs_started", |_| ());
    }

    /// What was written for a node that is gone need not be right for the one that comes back.
    pub(super) fn rpdos_stopped(&mut self, at: (Now, NodeIndex)) {
        let (now, index) = at;
        let Some(node) = self.supply.nodes.get_mut(index.0) else { return };
        node.running = false;
        for slot in node.rpdos.iter_mut().filter(|rpdo| !rpdo.keeps_last).flat_map(|rpdo| &mut rpdo.slots) {
            slot.value = slot.limits.default;
        }
        self.supply_node(now, index);
        let rpdos = self.table.nodes.get(index.0).map_or(0, |def| def.rpdos.len());
        for rpdo in (0..rpdos).map(RpdoIndex) {
            self.degrade_rpdo(at, rpdo, Quality::Stale(Reason::NodeNotOperational));
        }
        self.tell(at, "outputs_stopped", |_| ());
    }

    /// The tags of an RPDO show what was sent.
    pub(super) fn rpdo_sent(&mut self, (now, index): (Now, NodeIndex), rpdo: RpdoIndex, data: [u8; 8]) {
        let Some(def) = self.table.nodes.get(index.0) else { return };
        let carrier = CarrierIndex::of_rpdo(def, rpdo);
        self.tags.apply(&self.table, now, (index, carrier), &data, Quality::Good);
        self.dirty_nodes.mark(index.0);
    }

    pub(super) fn rpdo_not_sent(&mut self, at: (Now, NodeIndex), rpdo: RpdoIndex) {
        self.degrade_rpdo(at, rpdo, Quality::Bad(Reason::NotSent));
    }

    fn degrade_rpdo(&mut self, (now, index): (Now, NodeIndex), rpdo: RpdoIndex, quality: Quality) {
        let Some(def) = self.table.nodes.get(index.0) else { return };
        let carrier = CarrierIndex::of_rpdo(def, rpdo);
        self.tags.degrade(&self.table, now, index, Some(carrier), quality);
        self.dirty_nodes.mark(index.0);
    }

    /// How the device takes an RPDO: where that is not what the mapping file says, nothing is sent.
    pub(super) fn rpdo_mapped(&mut self, at: (Now, NodeIndex), mapped: &MappedPdo) {
        let rpdo = RpdoIndex(mapped.pdo.0);
        let Some(def) = self.table.nodes.get(at.1.0) else { return };
        let Some(settings) = def.protocol.rpdos().get(rpdo.0) else { return };
        let maps_differ = def
            .protocol
            .boot()
            .and_then(|boot| boot.setup_of_rpdo(rpdo))
            .is_some_and(|wanted| wanted.maps != mapped.maps);
        let differs = maps_differ || mapped.cob_id != Some(settings.cob_id);
        let (number, wanted) = (settings.number, settings.cob_id);
        if let Some(rpdo) = self.supply.rpdo(at.1, rpdo) {
            rpdo.differs = differs;
        }
        if differs {
            let maps = mapped.maps.iter().map(ToString::to_string).collect::<Vec<_>>().join(", ");
            let found = mapped.cob_id.map_or("switched off".to_owned(), |id| id.to_string());
            self.tell(at, "rpdo_differs", |event| {
                event.text = format!(
                    "the device takes RPDO{number} at {found} (mapping file: {wanted}) as: {maps}; nothing is sent"
                );
            });
        }
    }
}
