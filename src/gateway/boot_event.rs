//! What the boot of a node tells: to the journal, to its status, to its alarms.

use std::sync::Arc;

use super::Gateway;
use super::node::{BootTrouble, Node};
use super::tags::CarrierIndex;
use super::units::{Finding, What};
use crate::canopen::boot::{BootEvent, BootFailure, MappedPdo};
use crate::canopen::object::ObjectId;
use crate::canopen::sdo::SdoError;
use crate::canopen::{PdoIndex, Role, cob_id};
use crate::mapping::{DEVICE_UNIT, NodeDef};
use crate::process_image::{NodeIndex, Quality, Reason};
use crate::time::Now;

/// The identifier of emergency messages.
const EMERGENCY_ID: ObjectId = ObjectId::new(0x1014, 0);

impl Gateway {
    /// Takes an event of the boot of a node.
    pub(super) fn boot_event(&mut self, at: (Now, NodeIndex), told: &BootEvent) {
        match told {
            BootEvent::Object { object, data } => {
                if *object == EMERGENCY_ID {
                    self.tell_of_emergency_id(at, data.as_deref());
                }
                self.learn(at, *object, data.as_deref());
            }
            // What was written is counted, and told of when all is done.
            BootEvent::Wrote { .. } => {}
            BootEvent::Refused { object, error } => self.tell(at, "setting_refused", |event| {
                event.text = format!("{object}: {error}");
            }),
            BootEvent::Deviation { pdo } => {
                let number = self.pdo_number(at.1, *pdo);
                self.tell(at, "pdo_differs", |event| {
                    event.text = format!("TPDO{number} is otherwise in the device than in its mapping file");
                });
            }
            BootEvent::Errors { register, code } => self.errors_read(at, *register, *code),
            BootEvent::Begun => self.withhold(at.1),
            BootEvent::OtherDevice(difference) => {
                self.change(at.1, |node| {
                    node.other_device = true;
                    node.status.identity_mismatch = true;
                });
                self.tell(at, "identity_mismatch", |event| event.text = difference.to_string());
            }
            BootEvent::Mapped(mapped) => self.mapped(at, mapped),
            BootEvent::RpdoMapped(mapped) => self.rpdo_mapped(at, mapped),
            BootEvent::Done { written } => {
                self.tell_of_missing(at);
                self.change(at.1, |node| {
                    node.boot_trouble = None;
                    node.status.identity_mismatch = node.other_device;
                });
                self.tell(at, "node_configured", |event| {
                    event.text = format!("{written} object(s) had to be written");
                });
            }
            BootEvent::Failed(failure) => self.boot_failed(at, failure),
        }
    }

    /// The device is asked anew what its TPDOs carry and in which units: until it has said so, nothing in them is believed
    /// (R-DST-034).
    fn withhold(&mut self, index: NodeIndex) {
        self.tags.units().forget(index);
        self.change(index, |node| node.other_device = false);
        let (Some(def), Some(node)) = (self.table.nodes.get(index.0), self.nodes.get_mut(index.0)) else {
            return;
        };
        for (place, watch) in node.watches.iter_mut().enumerate() {
            watch.withheld = def.protocol.boot().is_some_and(|boot| boot.asks_about(PdoIndex(place)));
        }
    }

    /// The device said what is in an object: a unit, perhaps.
    pub(super) fn learn(&mut self, at: (Now, NodeIndex), object: ObjectId, data: Option<&[u8]>) {
        for Finding { tag, what } in self.tags.units().learn(at.1, object, data) {
            let Some(def) = self.table.tag(tag) else { continue };
            let (tag, wanted) = (def.name.clone(), def.unit.clone());
            match what {
                What::UnitChanged { from, to } => self.tell(at, "unit_changed", |event| {
                    event.text = format!("the device now gives `{tag}` in {to} instead of {from}");
                    (event.from, event.to) = (from, to);
                }),
                What::DigitsChanged { from, to } => self.tell(at, "digits_changed", |event| {
                    event.text =
                        format!("the device now gives `{tag}` with {to} decimal digit(s) instead of {from}");
                    (event.from, event.to) = (from.to_string(), to.to_string());
                }),
                What::Unreadable { reason, unit } => self.tell(at, reason.word(), |event| {
                    event.text = unreadable(&tag, reason, &unit, &wanted);
                    event.to = unit;
                }),
            }
        }
        self.dirty_nodes.mark(at.1.0);
    }

    /// A TPDO that the device maps otherwise than the mapping file carries nobody knows what: its tags are withheld.
    fn mapped(&mut self, at: (Now, NodeIndex), mapped: &MappedPdo) {
        let (now, index) = at;
        let boot = self.table.nodes.get(index.0).and_then(|def| def.protocol.boot());
        let adopts = boot.and_then(|boot| boot.adopts(mapped.pdo));
        let wanted = boot.and_then(|boot| boot.setup_of(mapped.pdo));
        let differs = adopts.is_none() && wanted.is_some_and(|wanted| wanted.maps != mapped.maps);
        let watch = self.nodes.get_mut(index.0).and_then(|node| node.watches.get_mut(mapped.pdo.0));
        if let Some(watch) = watch {
            watch.withheld = differs;
            watch.length = mapped.length();
            if adopts == Some(true) {
                watch.timeout = mapped.timeout();
            }
        }
        if adopts.is_some() {
            self.adopted(at, mapped);
        }
        self.tell_of_identifier(at, mapped);
        if differs {
            self.degrade(now, index, Some(mapped.pdo), Quality::Bad(Reason::MappingDiffers));
            let number = self.pdo_number(index, mapped.pdo);
            let maps = mapped.maps.iter().map(ToString::to_string).collect::<Vec<_>>().join(", ");
            self.tell(at, "pdo_mapping_differs", |event| {
                event.text = format!("the device maps TPDO{number} as: {maps}; its values are withheld");
            });
        }
        if mapped.cob_id.is_none() {
            let number = self.pdo_number(at.1, mapped.pdo);
            self.tell(at, "pdo_switched_off", |event| {
                event.text = format!("TPDO{number} is switched off in the device (bit 31 of its COB-ID)");
            });
        }
    }

    /// Emergency messages with another identifier than that of the mapping, or of CiA 301, are heard all the same, and told
    /// of (R-DST-119).
    fn tell_of_emergency_id(&mut self, at: (Now, NodeIndex), data: Option<&[u8]>) {
        let settings = self.table.nodes.get(at.1.0).and_then(NodeDef::canopen);
        let Some(settings) = settings else { return };
        let expected = settings.emergency.unwrap_or_else(|| cob_id::emcy(settings.id));
        let Some(told) = data.and_then(|data| <[u8; 4]>::try_from(data).ok()).map(u32::from_le_bytes) else {
            return;
        };
        let found = cob_id::in_use(told);
        if found == Some(expected) {
            return;
        }
        self.tell(at, "emergency_id_differs", |event| {
            event.from = expected.to_string();
            event.to = found.map_or_else(String::new, |found| found.to_string());
            event.text = match found {
                Some(found) => {
                    format!(
                        "the device sends its emergency messages as {found}, not as {expected}; that is used"
                    )
                }
                None => {
                    format!("the device has its emergency messages switched off ({EMERGENCY_ID}, bit 31)")
                }
            };
        });
    }

    /// A TPDO is taken as the device has it (R-DST-024).
    fn adopted(&mut self, at: (Now, NodeIndex), mapped: &MappedPdo) {
        let maps = if mapped.cob_id.is_some() { mapped.maps.as_slice() } else { &[] };
        self.tags.adopt(at.1, mapped.pdo, maps);
        let number = self.pdo_number(at.1, mapped.pdo);
        let supervised = self
            .nodes
            .get(at.1.0)
            .and_then(|node| node.watches.get(mapped.pdo.0))
            .is_some_and(|watch| watch.timeout.is_some());
        let maps = maps.iter().map(ToString::to_string).collect::<Vec<_>>().join(", ");
        self.tell(at, "pdo_adopted", |event| {
            let warning = if supervised { "" } else { "; nothing says how often, so it is not supervised" };
            event.text = format!("the device sends in TPDO{number}: {maps}{warning}");
        });
    }

    /// An identifier that is not the one of the mapping file is used all the same, and told (R-DST-119).
    fn tell_of_identifier(&mut self, at: (Now, NodeIndex), mapped: &MappedPdo) {
        let settings = self.table.nodes.get(at.1.0).and_then(|def| def.pdos().get(mapped.pdo.0));
        let expected = settings.map(|pdo| pdo.cob_id);
        if let (Some(found), Some(expected)) = (mapped.cob_id, expected)
            && found != expected
        {
            let number = self.pdo_number(at.1, mapped.pdo);
            self.tell(at, "pdo_id_differs", |event| {
                event.text =
                    format!("the device sends TPDO{number} as {found}, not as {expected}; that is used");
                (event.from, event.to) = (expected.to_string(), found.to_string());
            });
        }
    }

    /// Where a device may not be asked, what its mapping file says of TPDOs that would be adopted is believed.
    pub(super) fn believe_mappings(&mut self, now: Now) {
        let table = Arc::clone(&self.table);
        for (place, def) in table.nodes.iter().enumerate() {
            let index = NodeIndex(place);
            let passive = table.buses.get(def.bus.0).is_none_or(|bus| bus.role == Role::Passive)
                || !def.protocol.has_sdo();
            for pdo in (0..def.pdos().len()).map(PdoIndex).filter(|_| passive) {
                if let Some(boot) = def.protocol.boot()
                    && let (Some(_), Some(setup)) = (boot.adopts(pdo), boot.setup_of(pdo))
                {
                    self.tags.adopt(index, pdo, &setup.maps);
                }
            }
            if passive {
                self.tags.finish_adoption(&table, now, index);
            }
        }
    }

    /// What none of the TPDOs of a device carries and nobody reads has no value.
    fn tell_of_missing(&mut self, at: (Now, NodeIndex)) {
        let missing = self.tags.finish_adoption(&self.table, at.0, at.1);
        let names: Vec<&str> =
            missing.iter().filter_map(|tag| self.table.tag(*tag)).map(|tag| tag.name.as_str()).collect();
        if !names.is_empty() {
            let text = format!("no TPDO of the device carries: {}", names.join(", "));
            self.tell(at, "not_mapped", |event| event.text = text);
        }
    }

    /// An object that is polled was read, or could not be.
    pub(super) fn polled(&mut self, at: (Now, NodeIndex), poll: usize, result: &Result<Vec<u8>, SdoError>) {
        let (now, index) = at;
        if self.register_polled(at, poll, result) {
            return;
        }
        let (Some(def), Some(node)) = (self.table.nodes.get(index.0), self.nodes.get(index.0)) else {
            return;
        };
        let carrier = CarrierIndex(def.pdos().len() + poll);
        // Of fewer bytes than its type has, no value can be made.
        let length = def.protocol.polls().get(poll).map_or(0, |poll| poll.length);
        let object = def.protocol.polls().get(poll).map(|poll| poll.object);
        if let Some(data) = result.as_ref().ok().filter(|data| data.len() >= length) {
            let quality = node.quality_of_new_data(false, false);
            self.tags.apply(&self.table, now, (index, carrier), data, quality);
            if let Some(object) = object {
                self.learn(at, object, Some(data));
            }
        } else {
            self.count(index, |counters| &mut counters.sdo_errors);
            let quality = Quality::Bad(Reason::ReadFailed);
            self.tags.degrade(&self.table, now, index, Some(carrier), quality);
        }
        self.dirty_nodes.mark(index.0);
    }

    fn boot_failed(&mut self, at: (Now, NodeIndex), failure: &BootFailure) {
        let trouble = match failure {
            BootFailure::NoAnswer => BootTrouble::NoAnswer,
            BootFailure::Identity { .. } => BootTrouble::OtherDevice(failure.to_string()),
            BootFailure::Configuration { .. } | BootFailure::NotKept { .. } | BootFailure::Length { .. } => {
                BootTrouble::Configuration(failure.to_string())
            }
        };
        self.change(at.1, |node| {
            node.status.identity_mismatch = matches!(trouble, BootTrouble::OtherDevice(_));
            node.boot_trouble = Some(trouble);
        });
        let absent = |(node, def): (&Node, _)| node.may_be_absent(def);
        if !self.nodes.get(at.1.0).zip(self.table.nodes.get(at.1.0)).is_some_and(absent) {
            self.tell(at, "node_boot_failed", |event| event.text = failure.to_string());
        }
    }
}

/// Why no value, or only a raw number, is made of what a device sends.
fn unreadable(tag: &str, reason: Reason, unit: &str, wanted: &str) -> String {
    let what = if reason == Reason::UnknownDigits {
        "the device does not tell how many decimal digits it has".to_owned()
    } else if reason == Reason::OtherUnit {
        format!("the device gives it in {unit}, of which no {wanted} can be made")
    } else {
        format!("the device gives it in a unit that is not known: {unit}")
    };
    let consequence = if wanted == DEVICE_UNIT && reason != Reason::UnknownDigits {
        "the raw number is shown"
    } else {
        "it is bad"
    };
    format!("`{tag}`: {what}; {consequence}")
}
