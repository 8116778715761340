//! What the boot of a node tells: to the journal, to its status, to its alarms.

use super::Gateway;
use super::node::BootTrouble;
use crate::canopen::boot::{BootEvent, BootFailure, MappedPdo};
use crate::process_image::NodeIndex;
use crate::time::Now;

impl Gateway {
    /// Takes an event of the boot of a node.
    pub(super) fn boot_event(&mut self, at: (Now, NodeIndex), told: &BootEvent) {
        match told {
            // Values that nothing is made of yet are for the journal of the network, not of the plant.
            BootEvent::Object { .. } | BootEvent::Wrote { .. } => {}
            BootEvent::Refused { object, error } => self.tell(at, "setting_refused", |event| {
                event.text = format!("{object}: {error}");
            }),
            BootEvent::Deviation { pdo } => {
                let number = self.pdo_number(at.1, *pdo);
                self.tell(at, "pdo_mapping_differs", |event| {
                    event.text =
                        format!("TPDO{number} is mapped otherwise in the device than in its mapping file");
                });
            }
            BootEvent::Mapped(mapped) => self.mapped(at, mapped),
            BootEvent::Done { written } => {
                self.change(at.1, |node| {
                    node.boot_trouble = None;
                    node.status.identity_mismatch = false;
                });
                self.tell(at, "node_configured", |event| {
                    event.text = format!("{written} object(s) had to be written");
                });
            }
            BootEvent::Failed(failure) => self.boot_failed(at, failure),
        }
    }

    fn mapped(&mut self, at: (Now, NodeIndex), mapped: &MappedPdo) {
        if mapped.cob_id.is_none() {
            let number = self.pdo_number(at.1, mapped.pdo);
            self.tell(at, "pdo_switched_off", |event| {
                event.text = format!("TPDO{number} is switched off in the device (bit 31 of its COB-ID)");
            });
        }
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
        self.tell(at, "node_boot_failed", |event| event.text = failure.to_string());
    }
}
