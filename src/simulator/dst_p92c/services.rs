//! What a DST P92C does when it is asked: SDO, LSS, and what follows for its values and errors. Pure.

use super::super::lss_slave::{LssEffect, LssFacts};
use super::object_table::Key;
use super::protocol::DstP92c;
use crate::can::CanId;
use crate::canopen::{NmtState, cob_id};
use crate::time::Instant;

/// What LSS masters send, and what slaves answer (R-DST-091).
pub(super) const LSS_REQUEST: CanId = CanId::Standard(0x7E5);
const LSS_ANSWER: CanId = CanId::Standard(0x7E4);
/// SDO answers that wait for their time. One more is dropped.
const ANSWERS: usize = 256;
/// Error codes that the device finds by itself (R-DST-077).
const PRESSURE_ERROR: u16 = 0xF011;
const TEMPERATURE_ERROR: u16 = 0x4000;
pub(super) const START_UP_ERROR: u16 = 0x6300;

impl DstP92c {
    /// R-DST-065, R-DST-071.
    pub(super) fn serve(&mut self, now: Instant, data: &[u8]) {
        let silent = self.faults.mute_sdo
            || (self.state() == Some(NmtState::Stopped) && !self.settings.sdo_in_stopped);
        let Ok(request) = <[u8; 8]>::try_from(data) else { return };
        if silent {
            return;
        }
        let due = now + self.faults.late_sdo.unwrap_or(self.settings.reply_delay);
        for answer in self.sdo.handle_request(request, &mut self.objects) {
            if self.answers.len() < ANSWERS {
                self.answers.push_back((due, answer));
            }
        }
        if let Some(key) = self.objects.take_written() {
            self.apply(now, key);
        }
    }

    /// What follows from an entry that was written.
    pub(super) fn apply(&mut self, now: Instant, key: Key) {
        match key {
            (0x1010, 1) => {
                let objects = &self.objects;
                let zero_pa = self.measurement.zero_pa;
                self.store.save(objects.values(), zero_pa, |key| objects.default_of(key));
            }
            (0x1011, 1) => self.store.restore_defaults(),
            (0x1017, 0) => self.schedule_heartbeat(now),
            (0x1800, 2 | 5) | (0x1A00, 0) => self.tpdo.configure(now, &self.objects),
            (0x4F00 | 0x4F01, 0) if !self.settings.address_needs_save => {
                self.store.keep_address(self.objects.values());
            }
            (0x6125, 1) => self.measurement.autozero(),
            _ => {}
        }
        self.measure(now);
    }

    /// R-DST-092, and section 11 of the requirements.
    pub(super) fn configure(&mut self, now: Instant, data: &[u8]) {
        let Ok(request) = <[u8; 8]>::try_from(data) else { return };
        let quiet = self.state() == Some(NmtState::Stopped) && self.heartbeat_at.is_none();
        if !quiet && !self.settings.lss_in_any_state {
            return;
        }
        let facts = LssFacts { stored_node: self.store.node, unconfigured: self.settings.unconfigured };
        let reaction = self.lss.handle_request(request, facts);
        if let Some(answer) = reaction.answer {
            self.send(LSS_ANSWER, &answer);
        }
        match reaction.effect {
            Some(LssEffect::Store { node, bit_timing }) => {
                self.store.node = node.unwrap_or(self.store.node);
                self.store.bit_rate = bit_timing.unwrap_or(self.store.bit_rate);
                // R-DST-096: what is stored is shown.
                self.objects.put((0x4F01, 0), u32::from(self.store.node.get()));
                self.objects.put((0x4F00, 0), u32::from(self.store.bit_rate));
            }
            Some(LssEffect::ActivateBitTiming(delay)) => self.switched_at = Some(now + delay + delay),
            Some(LssEffect::Waiting) if self.store.node != self.node() => {
                // R-DST-098.
                self.slave.set_node(self.store.node);
                self.objects.set_node(self.store.node);
                self.slave.enter(NmtState::PreOperational);
                self.send_boot_up();
                self.tell_errors();
            }
            Some(LssEffect::Waiting) | None => {}
        }
    }

    /// Shows what is measured in all objects, and what follows from it.
    pub(super) fn measure(&mut self, now: Instant) {
        if self.state().is_none_or(|state| state == NmtState::Initialising) {
            return;
        }
        self.measurement.show(&mut self.objects);
        self.find_errors();
        self.tell_errors();
        self.tpdo.handle_values(now, &self.objects);
    }

    /// A status that is not good is an error (R-DST-077).
    pub(super) fn find_errors(&mut self) {
        for (status, code) in self.measurement.status().into_iter().zip([PRESSURE_ERROR, TEMPERATURE_ERROR]) {
            self.errors.set(code, status != 0 || self.faults.error == Some(code));
        }
        if !self.faults.boot_error {
            self.errors.set(START_UP_ERROR, false);
        }
        if let Some(code) = self.faults.error {
            self.errors.set(code, true);
        }
    }

    /// R-DST-074, R-DST-075, R-DST-080. In Stopped there are no emergency messages (CiA 301); what has changed is told
    /// afterwards.
    pub(super) fn tell_errors(&mut self) {
        let register = self.errors.register();
        self.objects.put((0x1001, 0), u32::from(register));
        if self.state() == Some(NmtState::Stopped) {
            return;
        }
        let Some(message) = self.errors.take_message() else { return };
        self.objects.put((0x1003, 0), 1);
        self.objects.put((0x1003, 1), u32::from(register) << 16 | u32::from(self.errors.code()));
        if !self.faults.mute_emcy {
            self.send(cob_id::emcy(self.node()), &message);
        }
    }
}
