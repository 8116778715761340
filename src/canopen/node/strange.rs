//! TPDOs of the predefined connection set that come in a node's name, but not from its mapping.
//!
//! A mapping may leave a TPDO out; or another device with the same node id sends it. A node that has objects is asked: one
//! that has no such TPDO does not send it.

use super::super::outputs::Outputs;
use super::super::sdo::{SdoError, SdoRequest, TransferId};
use super::super::{NmtState, NodeId};
use super::Node;
use crate::can::{CanFrame, CanId};
use crate::canopen::object::ObjectId;
use crate::time::Instant;

/// Marks the transfers that ask for this; the two bits above belong to the boot and to polling.
const STRANGE_ID: u64 = 1 << 61;
/// Communication parameter of TPDO1.
const TPDO: u16 = 0x1800;
/// A COB-ID whose PDO does not exist, and its number of 11 bits.
const NOT_VALID: u32 = 1 << 31;
const NUMBER: u32 = 0x7FF;

/// What is known of each of the four TPDOs.
pub(super) type Strange = [Known; 4];

/// What is known of a TPDO that the mapping does not have.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) enum Known {
    /// It was not seen, or not asked for since the node booted.
    #[default]
    Nothing,
    /// The node is asked, or its answer says nothing.
    Unclear,
    /// The node has it.
    Own,
    /// The node has no such TPDO.
    Foreign,
}

/// The node and the number, 1 to 4, of a TPDO of the predefined connection set.
pub(in crate::canopen) fn predefined_tpdo(id: CanId) -> Option<(NodeId, u8)> {
    let CanId::Standard(id) = id else { return None };
    let node = u8::try_from(id & 0x7F).ok().and_then(NodeId::new)?;
    let number = match id >> 7 {
        3 => 1,
        5 => 2,
        7 => 3,
        9 => 4,
        _ => return None,
    };
    Some((node, number))
}

impl Node {
    /// Such a TPDO came.
    pub(in crate::canopen) fn handle_strange_tpdo(
        &mut self,
        now: Instant,
        number: u8,
        frame: &CanFrame,
        outputs: &mut Outputs,
    ) {
        let Some(known) = self.strange.get(usize::from(number) - 1).copied() else { return };
        let ready = self.boot.is_done() && !frame.is_remote() && self.state != Some(NmtState::Stopped);
        match known {
            Known::Foreign => {
                let evidence = self.duplicate.handle_strange_tpdo(now);
                self.suspect(evidence, outputs);
            }
            Known::Nothing if ready => {
                let object = ObjectId::new(TPDO + u16::from(number) - 1, 1);
                let id = TransferId(STRANGE_ID | u64::from(number));
                let request = SdoRequest::read(object).of_len(4);
                let taken = self.sdo.as_mut().is_some_and(|sdo| sdo.request(now, id, request).is_ok());
                if taken {
                    self.learn(number, Known::Unclear);
                    self.transfer(now, outputs);
                }
            }
            Known::Nothing | Known::Unclear | Known::Own => {}
        }
    }

    fn learn(&mut self, number: u8, what: Known) {
        if let Some(known) = self.strange.get_mut(usize::from(number).saturating_sub(1)) {
            *known = what;
        }
    }

    /// The answer, if this is one.
    pub(super) fn handle_strange_answer(
        &mut self,
        id: TransferId,
        result: &Result<Vec<u8>, SdoError>,
    ) -> bool {
        let Some(number) = u8::try_from(id.0 & !STRANGE_ID).ok().filter(|_| id.0 & STRANGE_ID != 0) else {
            return false;
        };
        let own = CanId::Standard(0x080 + 0x100 * u16::from(number) + u16::from(self.id.get()));
        match result {
            Ok(bytes) => {
                let cob_id = bytes.iter().rev().fold(0, |value: u32, byte| value << 8 | u32::from(*byte));
                let sends = cob_id & NOT_VALID == 0 && cob_id & NUMBER == own.raw();
                self.learn(number, if sends { Known::Own } else { Known::Foreign });
            }
            Err(SdoError::Abort(code)) if code.is_missing() => self.learn(number, Known::Foreign),
            Err(_) => {}
        }
        true
    }
}
