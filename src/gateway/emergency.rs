//! What the errors of a node do: to its alarms, its tags, its status and the journal.

use std::time::Duration;

use super::Gateway;
use super::tags::CarrierIndex;
use crate::canopen::emcy::{self, Emergency};
use crate::canopen::sdo::SdoError;
use crate::mapping::{AlarmOwner, BuiltIn, EmergencyDef};
use crate::process_image::{NodeIndex, Value};
use crate::time::Now;

/// After an emergency message what is read of the error register may be older than the message.
const READ_LATE: Duration = Duration::from_secs(2);

impl Gateway {
    /// An emergency message came (R-DET-091, R-DST-074 to 078).
    pub(super) fn emergency(&mut self, at: (Now, NodeIndex), code: u16, register: u8, vendor: [u8; 5]) {
        let (now, index) = at;
        let emergency = Emergency { code, register, vendor };
        self.count(index, |counters| &mut counters.emcys);
        let known = self.errors_of(index).and_then(|errors| errors.find(code));
        self.change(index, |node| {
            node.status.errors.handle_message(now.utc, emergency, known);
            node.last_emergency = Some(now.instant);
        });
        self.tell_error(at, "emergency", emergency);
        self.show_errors(now, index);
    }

    /// The node was asked what is wrong with it (R-DST-080, R-DST-081).
    pub(super) fn errors_read(&mut self, at: (Now, NodeIndex), register: Option<u8>, code: u16) {
        let (now, index) = at;
        let known = self.errors_of(index).and_then(|errors| errors.find(code));
        let mut is_new = false;
        self.change(index, |node| {
            is_new = node.status.errors.handle_reading(now.utc, register, code, known);
        });
        if is_new {
            let emergency = Emergency { code, register: register.unwrap_or_default(), vendor: [0; 5] };
            self.tell_error(at, "emergency_found", emergency);
        }
        self.show_errors(now, index);
    }

    /// The node has booted: the errors that it told of before are over.
    pub(super) fn errors_forgotten(&mut self, (now, index): (Now, NodeIndex)) {
        self.change(index, |node| node.status.errors.handle_boot_up());
        self.show_errors(now, index);
    }

    /// Whether this poll reads the error register, and not a tag. If so, what came of it is dealt with.
    pub(super) fn register_polled(
        &mut self,
        (now, index): (Now, NodeIndex),
        poll: usize,
        result: &Result<Vec<u8>, SdoError>,
    ) -> bool {
        if self.errors_of(index).and_then(|errors| errors.register_poll) != Some(poll) {
            return false;
        }
        let Some(register) = result.as_ref().ok().and_then(|data| data.first().copied()) else {
            self.count(index, |counters| &mut counters.sdo_errors);
            return true;
        };
        let mut news = false;
        self.change(index, |node| {
            let told_lately = node.last_emergency.is_some_and(|at| now.instant.since(at) < READ_LATE);
            news = !told_lately && node.status.errors.handle_register(register);
        });
        if news {
            self.show_errors(now, index);
        }
        true
    }

    /// Tags of the errors of a node that is not asked about them begin with what was told: as a rule nothing. They follow
    /// the node when it comes back.
    pub(super) fn show_errors_unasked(&mut self, now: Now, index: NodeIndex) {
        if self.nodes.get(index.0).is_some_and(|node| !node.asked_about_errors) {
            self.show_errors(now, index);
        }
    }

    /// Carries the errors of a node on to its alarms and tags.
    pub(super) fn show_errors(&mut self, now: Now, index: NodeIndex) {
        let (Some(def), Some(node)) = (self.table.nodes.get(index.0), self.nodes.get(index.0)) else {
            return;
        };
        let owner = AlarmOwner::Node(index);
        let errors = &node.status.errors;
        let code = |wanted: Option<usize>| {
            let error = errors.active().iter().find(|error| error.entry == wanted);
            error.map(|error| Value::Unsigned(error.emergency.code.into()))
        };
        self.conditions.set_with(now, owner, BuiltIn::Emergency, code(None));
        for place in 0..def.emergency.errors.len() {
            self.conditions.set_with(now, owner, BuiltIn::NamedError(place), code(Some(place)));
        }
        let quality = node.quality_of_new_data(self.comes_too_late(def.bus), false);
        let message = errors.last().encode();
        let active = [u8::try_from(errors.active().len()).unwrap_or(u8::MAX)];
        let [told, count] = CarrierIndex::of_emergencies(def);
        self.tags.apply(&self.table, now, (index, told), &message, quality);
        self.tags.apply(&self.table, now, (index, count), &active, quality);
        self.dirty_nodes.mark(index.0);
    }

    fn errors_of(&self, index: NodeIndex) -> Option<&EmergencyDef> {
        self.table.nodes.get(index.0).map(|def| &def.emergency)
    }

    fn tell_error(&mut self, at: (Now, NodeIndex), name: &'static str, emergency: Emergency) {
        let Emergency { code, register, vendor } = emergency;
        let errors = self.errors_of(at.1);
        let known = errors.and_then(|errors| errors.errors.get(errors.find(code)?.entry));
        let named = known.map_or_else(String::new, |error| format!(", {}", error.name));
        self.tell(at, name, |event| {
            event.value = Some(Value::Unsigned(code.into()));
            event.to = format!("0x{code:04X}");
            let vendor = vendor.map(|byte| format!("{byte:02X}")).concat();
            let words = emcy::register_words(register).collect::<Vec<_>>().join(", ");
            let words = if words.is_empty() { words } else { format!(" ({words})") };
            event.text = format!(
                "error code 0x{code:04X} ({}{named}), error register 0x{register:02X}{words}, manufacturer bytes \
                 {vendor}",
                emcy::meaning(code)
            );
        });
    }
}
