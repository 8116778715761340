//! What a node is sent in RPDOs, and whether it is in a state to take it.

use super::super::outputs::Outputs;
use super::super::{NmtState, NodeEvent, PdoIndex, RpdoIndex};
use super::Node;
use super::watch::Watch;
use crate::can::{CanFrame, CanId};
use crate::canopen::object::MappedObject;
use crate::time::Instant;

impl Node {
    /// Whether a TPDO follows SYNC.
    pub(in crate::canopen) fn is_synchronous(&self, pdo: PdoIndex) -> bool {
        self.pdos.is_synchronous(pdo)
    }

    /// What an RPDO carries from now on; `None`: not known, so nothing is sent.
    pub(in crate::canopen) fn set_rpdo(
        &mut self,
        now: Instant,
        rpdo: RpdoIndex,
        data: Option<[u8; 8]>,
        outputs: &mut Outputs,
    ) {
        self.rpdos.set_data(now, rpdo, data);
        self.drive_rpdos(now, outputs);
    }

    /// The node has told how it takes an RPDO. Where that is not what the mapping file says, nothing is sent: it would be
    /// understood otherwise than it is meant.
    pub(super) fn rpdo_mapped(
        &mut self,
        now: Instant,
        rpdo: RpdoIndex,
        cob_id: Option<CanId>,
        maps: &[MappedObject],
    ) {
        let agreed = self.rpdos.settings(rpdo).is_some_and(|settings| cob_id == Some(settings.cob_id))
            && self.boot.wants_rpdo(rpdo).is_none_or(|wanted| wanted == maps);
        self.rpdos.set_agreed(now, rpdo, agreed);
    }

    /// A frame of ours did not leave.
    pub(in crate::canopen) fn rpdo_not_sent(
        &mut self,
        now: Instant,
        frame: &CanFrame,
        outputs: &mut Outputs,
    ) {
        if let Some(rpdo) = self.rpdos.handle_not_sent(now, frame) {
            outputs.node(self.id, NodeEvent::RpdoNotSent { rpdo });
        }
    }

    /// A SYNC went over the bus.
    pub(in crate::canopen) fn handle_sync(&mut self, now: Instant, outputs: &mut Outputs) {
        self.rpdos.handle_sync(now);
        self.send_rpdos(now, outputs);
    }

    /// Sees whether the node takes part, after anything that may have changed that, and sends what is due.
    pub(in crate::canopen) fn drive_rpdos(&mut self, now: Instant, outputs: &mut Outputs) {
        if self.rpdos.is_empty() {
            return;
        }
        let running = self.takes_part();
        if self.rpdos.set_running(now, running) {
            let event = if running { NodeEvent::RpdosStarted } else { NodeEvent::RpdosStopped };
            outputs.node(self.id, event);
        }
        self.send_rpdos(now, outputs);
    }

    fn send_rpdos(&mut self, now: Instant, outputs: &mut Outputs) {
        while let Some(sent) = self.rpdos.take_due(now) {
            outputs.transmit(sent.frame);
            outputs.node(self.id, NodeEvent::RpdoSent { rpdo: sent.rpdo, data: sent.data });
        }
    }

    /// In the role master, operational as far as is known and since the bus can be used, configured, and not ordered
    /// elsewhere.
    fn takes_part(&self) -> bool {
        let stays = matches!(self.ordered, None | Some(NmtState::Operational));
        let watched = self.supervised || matches!(self.watch, Watch::Nothing);
        self.start.is_some()
            && self.state == Some(NmtState::Operational)
            && self.heard
            && watched
            && stays
            && !self.told_to_leave
            && !self.watch.is_lost()
            && self.boot.is_done()
    }
}
