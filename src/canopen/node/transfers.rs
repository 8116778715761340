//! What a node is asked by SDO: its boot, the objects that are polled, and what others want of it.

use std::time::Duration;

use super::super::boot::{Boot, BootEvent, BootOutput, MappedPdo};
use super::super::network::FOREIGN_QUIET;
use super::super::object::ObjectId;
use super::super::outputs::Outputs;
use super::super::polls::Polls;
use super::super::sdo::{Refused, SdoClient, SdoError, SdoOutput, SdoRequest, TransferId};
use super::super::start::Start;
use super::super::{NmtRequest, NmtState, NodeEvent, RpdoIndex, cob_id};
use super::watch::Watch;
use super::{Moved, Node, ON_ITS_WAY, SdoRefused};
use crate::can::{CanFrame, CanId};
use crate::time::Instant;

/// The identifier of emergency messages.
const EMERGENCY_ID: ObjectId = ObjectId::new(0x1014, 0);

impl Node {
    /// Asks for a transfer.
    pub(in crate::canopen) fn request_sdo(
        &mut self,
        now: Instant,
        id: TransferId,
        request: SdoRequest,
        outputs: &mut Outputs,
    ) -> Result<(), SdoRefused> {
        if self.state == Some(NmtState::Stopped) {
            return Err(SdoRefused::Stopped);
        }
        if self.boot.is_under_way() {
            return Err(SdoRefused::Booting);
        }
        self.sdo.as_mut().ok_or(SdoRefused::NoSdo)?.request(now, id, request)?;
        self.transfer(now, outputs);
        Ok(())
    }

    /// An SDO request of somebody else. Of a transfer only its begin says what it is about.
    pub(in crate::canopen) fn handle_foreign_sdo(
        &mut self,
        now: Instant,
        frame: &CanFrame,
        outputs: &mut Outputs,
    ) {
        self.duplicate.handle_sdo_request(now, frame);
        let &[command, low, high, sub, ..] = frame.data() else { return };
        let write = match (command >> 5, command & 0x01) {
            (1, _) | (6, 0) => true,
            (2, _) | (5, 0) => false,
            _ => return,
        };
        let object = ObjectId::new(u16::from_le_bytes([low, high]), sub);
        let told = !write && self.foreign_read.is_some_and(|last| now.since(last) <= FOREIGN_QUIET);
        if write {
            self.polls.handle_write(now, object);
        } else {
            self.foreign_read = Some(now);
        }
        if !told {
            outputs.node(self.id, NodeEvent::ForeignSdo { object, write });
        }
    }

    /// An SDO request of ours did not leave.
    pub(in crate::canopen) fn sdo_not_sent(&mut self, frame: &CanFrame) {
        if let Some(sdo) = &mut self.sdo {
            sdo.handle_not_sent(frame);
        }
    }

    /// What has another identifier than before; `None`: it is switched off.
    pub(in crate::canopen) fn take_moved(&mut self) -> Vec<(Moved, Option<CanId>)> {
        std::mem::take(&mut self.moved)
    }

    /// Carries requests from the boot to the SDO client, and results back, until both have nothing more to say.
    pub(in crate::canopen) fn transfer(&mut self, now: Instant, outputs: &mut Outputs) {
        loop {
            if let Some(output) = self.boot.poll_output() {
                self.boot_output(now, output, outputs);
            } else if let Some(output) = self.sdo.as_mut().and_then(SdoClient::poll_output) {
                match output {
                    SdoOutput::Transmit(frame) => {
                        self.duplicate.handle_sdo_request(now, &frame);
                        outputs.transmit(frame);
                    }
                    SdoOutput::Done(id, result) if Boot::is_mine(id) => self.boot.handle_sdo(now, id, result),
                    SdoOutput::Done(id, result) if Polls::is_mine(id) => {
                        if let Some(poll) = self.polls.handle_sdo(id) {
                            outputs.node(self.id, NodeEvent::Polled { poll, result });
                        }
                    }
                    SdoOutput::Done(id, result) => {
                        if !self.handle_strange_answer(id, &result) {
                            outputs.node(self.id, NodeEvent::Sdo { id, result });
                        }
                    }
                }
            } else {
                return;
            }
        }
    }

    /// Reads the next object that is due. A stopped node answers no SDO (R-DST-071): that reading has failed. Where others
    /// ask for so much that there is no room, it waits a little.
    pub(super) fn poll(&mut self, now: Instant, outputs: &mut Outputs) {
        let Some((id, request)) = self.polls.handle_timeout(now) else { return };
        let sdo = self.sdo.as_mut().filter(|_| self.state != Some(NmtState::Stopped));
        match sdo.map(|sdo| sdo.request(now, id, request)) {
            Some(Ok(())) => {
                self.polls.handle_taken();
                self.transfer(now, outputs);
            }
            Some(Err(Refused::QueueFull { .. })) if self.polls.postpone(now) => {}
            Some(Err(_)) | None => {
                if let Some(poll) = self.polls.handle_sdo(id) {
                    let result = Err(SdoError::BusUnavailable);
                    outputs.node(self.id, NodeEvent::Polled { poll, result });
                }
            }
        }
    }

    fn boot_output(&mut self, now: Instant, output: BootOutput, outputs: &mut Outputs) {
        match output {
            BootOutput::Sdo(id, request) => {
                // In Stopped a node takes no SDO requests (R-DST-071). Who stopped it wants it to stay so.
                let stopped = self.state == Some(NmtState::Stopped);
                let held = self.start.as_ref().is_some_and(Start::is_held);
                if stopped && held {
                    return self.boot.postpone(now);
                }
                if stopped {
                    self.enter_pre_operational(now, outputs);
                }
                let taken = self.sdo.as_mut().is_some_and(|sdo| sdo.request(now, id, request).is_ok());
                if !taken {
                    self.boot.handle_refused(now);
                }
            }
            BootOutput::EnterPreOperational => self.enter_pre_operational(now, outputs),
            BootOutput::Tell(event) => {
                if event == BootEvent::Begun {
                    self.pdos.forget_lengths(|pdo| self.boot.asks_about(pdo));
                    self.polls.forget_carried();
                    if let Some(start) = &mut self.start {
                        start.handle_boot_begun();
                    }
                } else if let BootEvent::Mapped(mapped) = &event {
                    self.mapped(mapped);
                }
                if let BootEvent::Object { object: EMERGENCY_ID, data } = &event {
                    self.emergency_id(data.as_deref());
                }
                if let BootEvent::RpdoMapped(mapped) = &event {
                    self.rpdo_mapped(now, RpdoIndex(mapped.pdo.0), mapped.cob_id, &mapped.maps);
                }
                self.told_errors |= matches!(event, BootEvent::Errors { code, .. } if code != 0);
                let done = matches!(event, BootEvent::Done { .. });
                outputs.node(self.id, NodeEvent::Boot(event));
                if done {
                    self.polls.begin(now);
                    self.give_back(now, outputs);
                }
                if let Some(start) = self.start.as_mut().filter(|_| done) {
                    // A node that runs already will say so within the time of a heartbeat, and is not started for nothing.
                    let wait = match &self.watch {
                        Watch::Heartbeat(heartbeat) if self.state.is_none() => heartbeat.timeout() * 2 / 3,
                        Watch::Heartbeat(_) | Watch::Guarding(_) | Watch::Nothing => Duration::ZERO,
                    };
                    start.handle_boot_done(now, self.state == Some(NmtState::Operational), wait);
                    // One that answers but does not tell its state is started when it does.
                    if self.watch.is_lost() {
                        start.cancel();
                    }
                }
            }
        }
    }

    /// A node that nobody starts, and that was taken out of operation, is operational again (R-DST-059).
    fn give_back(&mut self, now: Instant, outputs: &mut Outputs) {
        let held = self.start.as_ref().is_some_and(Start::is_held);
        if std::mem::take(&mut self.taken_out) && self.self_starting && !held {
            let request = NmtRequest::Start;
            outputs.transmit(request.frame(Some(self.id)));
            self.command_sent(now, request, false, outputs);
        }
    }

    /// The node said how it sends a TPDO.
    fn mapped(&mut self, mapped: &MappedPdo) {
        self.pdos.set_length(mapped.pdo, mapped.length());
        self.moved.push((Moved::Pdo(mapped.pdo), mapped.cob_id));
        if let Some(timed) = self.boot.adopts(mapped.pdo) {
            if timed {
                self.pdos.set_timeout(mapped.pdo, mapped.timeout());
            }
            if mapped.cob_id.is_some() {
                self.polls.carry(&mapped.maps);
            }
        }
    }

    /// The node said which identifier its emergency messages have, or would not tell (R-DST-119).
    fn emergency_id(&mut self, data: Option<&[u8]>) {
        let told = data.and_then(|data| <[u8; 4]>::try_from(data).ok()).map(u32::from_le_bytes);
        self.moved.push((Moved::Emergency, told.map_or(Some(self.emergency), cob_id::in_use)));
    }

    /// So that its configuration can be changed; it is started when that is done. One whose state is not known may run.
    fn enter_pre_operational(&mut self, now: Instant, outputs: &mut Outputs) {
        let request = NmtRequest::EnterPreOperational;
        let before = self.state;
        self.taken_out |=
            matches!(before, None | Some(NmtState::Operational)) || self.boot.is_self_starting();
        outputs.transmit(request.frame(Some(self.id)));
        self.note_sent(now, request, outputs);
        self.set_state(NmtState::PreOperational, true, outputs);
        self.entered = Some((now + ON_ITS_WAY, before));
    }
}
