//! Units and decimal digits that devices tell: what each node was heard to say, and how its raw numbers are read.
//!
//! What a device said is forgotten when it is asked anew; until it has answered, no value is made of its numbers (R-DST-034).

mod carry;

use std::collections::BTreeMap;

use crate::canopen::Role;
use crate::canopen::object::ObjectId;
use crate::mapping::{DeviceUnit, Reading, Scale, Source, TagTable, Told};
use crate::process_image::{NodeIndex, ProcessImage, Quality, Reason, TagIndex};

/// The units of all tags for which devices are asked.
#[derive(Debug)]
pub(super) struct Units {
    list: Vec<Entry>,
    /// A text is another since it was published.
    changed: bool,
}

/// The unit of one tag.
#[derive(Debug)]
struct Entry {
    tag: TagIndex,
    node: NodeIndex,
    def: DeviceUnit,
    /// The scale of the mapping.
    scale: Scale,
    unit: Answer,
    digits: Answer,
    /// How numbers are read; `None` while that is not known.
    reading: Option<Reading>,
    /// How they were read the last time, and with how many digits.
    before: Option<(Reading, Option<u32>)>,
}

/// What a device said.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Answer {
    /// Nothing yet.
    Awaited,
    /// This; `None`: it would not tell.
    Given(Option<u32>),
}

impl Answer {
    /// Of an object that nobody asks for, nothing is awaited.
    fn awaited(told: Option<&Told>) -> Self {
        if told.is_some() { Self::Awaited } else { Self::Given(None) }
    }
}

/// Something that is to be told of a tag.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Finding {
    pub(super) tag: TagIndex,
    pub(super) what: What,
}

/// What is to be told.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum What {
    /// The device counts in another unit than before.
    UnitChanged { from: String, to: String },
    /// Its whole numbers have another number of decimal digits than before.
    DigitsChanged { from: u32, to: u32 },
    /// No value, or only a raw number, can be made of what it sends.
    Unreadable { reason: Reason, unit: String },
}

impl Units {
    /// Nothing is known, but of devices that may not be asked: those are believed to be as the mapping has them.
    pub(super) fn new(table: &TagTable) -> Self {
        let tags = table.tags.iter().enumerate();
        let list = tags.filter_map(|(place, tag)| {
            let scale = match &tag.source {
                Source::Pdo { scale, .. }
                | Source::Polled { scale, .. }
                | Source::Adopted { scale, .. }
                | Source::Rpdo { scale, .. } => *scale,
                Source::Derived(_) | Source::Emergency { .. } | Source::Module { .. } => return None,
            };
            let def = tag.device_unit.clone()?;
            let node = table.node(tag.node)?;
            let master = table.buses.get(node.bus.0).is_some_and(|bus| bus.role == Role::Master);
            let (unit, digits) = (Answer::awaited(def.unit.as_ref()), Answer::awaited(def.digits.as_ref()));
            let mut entry = Entry {
                tag: TagIndex(place),
                node: tag.node,
                scale,
                unit,
                digits,
                reading: None,
                before: None,
                def,
            };
            if !master || !node.protocol.has_sdo() {
                let assumed = |told: Option<&Told>| Answer::Given(told.and_then(|told| told.assumed));
                entry.unit = assumed(entry.def.unit.as_ref());
                entry.digits = assumed(entry.def.digits.as_ref());
                let _nobody_said_it = entry.resolve();
            }
            Some(entry)
        });
        Self { list: list.collect(), changed: true }
    }

    /// The place of a tag's unit here; `None` where the device is not asked for it.
    pub(super) fn place_of(&self, tag: TagIndex) -> Option<usize> {
        self.list.iter().position(|entry| entry.tag == tag)
    }

    /// How numbers of a tag are read; `None`: that is not known.
    pub(super) fn reading(&self, place: usize) -> Option<(Scale, Quality)> {
        let reading = self.list.get(place)?.reading.as_ref()?;
        Some((reading.scale, reading.quality))
    }

    /// A node is asked anew.
    pub(super) fn forget(&mut self, node: NodeIndex) {
        for entry in self.list.iter_mut().filter(|entry| entry.node == node) {
            entry.unit = Answer::awaited(entry.def.unit.as_ref());
            entry.digits = Answer::awaited(entry.def.digits.as_ref());
            entry.reading = None;
        }
    }

    /// A node said what is in an object; `None`: it would not tell.
    pub(super) fn learn(&mut self, node: NodeIndex, object: ObjectId, data: Option<&[u8]>) -> Vec<Finding> {
        let number = data.and_then(number);
        let mut findings = Vec::new();
        for entry in self.list.iter_mut().filter(|entry| entry.node == node) {
            let is = |told: &Option<Told>| told.is_some_and(|told| told.object == object);
            let (unit, digits) = (is(&entry.def.unit), is(&entry.def.digits));
            let before = (entry.unit, entry.digits);
            if unit {
                entry.unit = Answer::Given(number);
            }
            if digits {
                entry.digits = Answer::Given(number);
            }
            // It is asked again and again, and says the same as a rule.
            if before != (entry.unit, entry.digits) {
                self.changed = true;
                findings.extend(entry.resolve().into_iter().map(|what| Finding { tag: entry.tag, what }));
            }
        }
        findings
    }

    /// Copies the units of tags that are shown in the device's own. `true` where one is another than before.
    pub(super) fn publish(&mut self, image: &mut ProcessImage) -> bool {
        if !std::mem::take(&mut self.changed) {
            return false;
        }
        let units = self.shown();
        let moved = image.units != units;
        image.units = units;
        moved
    }

    /// The units of tags that are shown in the device's own, as far as they are known.
    pub(super) fn shown(&self) -> BTreeMap<TagIndex, String> {
        let own = self.list.iter().filter(|entry| entry.def.unit.is_some() && entry.def.target.is_none());
        let known = own.filter_map(|entry| {
            let reading = entry.reading.as_ref().or(entry.before.as_ref().map(|(reading, _)| reading))?;
            Some((entry.tag, reading.unit.clone()))
        });
        known.collect()
    }
}

impl Entry {
    /// Works out how numbers are read, once all is known that has to be, and what is to be told of that.
    fn resolve(&mut self) -> Vec<What> {
        let (Answer::Given(unit), Answer::Given(digits)) = (self.unit, self.digits) else {
            return Vec::new();
        };
        let reading = self.def.reading(self.scale, unit, digits);
        let mut told = Vec::new();
        let before = self.before.as_ref();
        if let Some((before, digits_before)) = before {
            if before.unit != reading.unit {
                told.push(What::UnitChanged { from: before.unit.clone(), to: reading.unit.clone() });
            }
            if let (Some(from), Some(to)) = (*digits_before, digits)
                && from != to
            {
                told.push(What::DigitsChanged { from, to });
            }
        }
        if let Some(reason) = reading.quality.reason()
            && before.is_none_or(|(before, _)| *before != reading)
        {
            told.push(What::Unreadable { reason, unit: reading.unit.clone() });
        }
        self.before = Some((reading.clone(), digits));
        self.reading = Some(reading);
        told
    }
}

/// A number of 1 to 4 bytes, little-endian.
fn number(data: &[u8]) -> Option<u32> {
    let mut bytes = [0; 4];
    bytes.get_mut(..data.len()).filter(|_| !data.is_empty())?.copy_from_slice(data);
    Some(u32::from_le_bytes(bytes))
}
