//! Objects of a node that others want read or written: asked of its network, answered when the node has answered.

use std::collections::BTreeMap;

use super::core::{Gateway, Output};
use super::events::Name;
use super::{CommandSource, Outcome};
use crate::canopen::object::{DataType, ObjectId};
use crate::canopen::sdo::{Refused, SdoAction, SdoError, SdoRequest, TransferId};
use crate::canopen::{Role, SdoRefused};
use crate::process_image::NodeIndex;
use crate::time::Now;

/// Bytes of a written value that the journal shows.
const SHOWN: usize = 32;

/// Transfers under way. Their number is bounded by the queues of the SDO clients: a few for each node.
#[derive(Debug, Default)]
pub(super) struct Transfers {
    newest: u64,
    open: BTreeMap<TransferId, Asked>,
}

/// Who asked for a transfer, and for which.
#[derive(Clone, Debug)]
pub(super) struct Asked {
    /// The number of the request.
    pub(super) id: u64,
    pub(super) source: CommandSource,
    pub(super) node: NodeIndex,
    /// In words: the object, and what is written.
    pub(super) what: String,
    pub(super) writes: bool,
}

impl Gateway {
    /// Asks the node. Its answer, or why it is not even asked, becomes the answer to the request.
    pub(super) fn request_object(
        &mut self,
        now: Now,
        (id, source): (u64, CommandSource),
        node: NodeIndex,
        request: SdoRequest,
    ) {
        let (what, writes) = in_words(&request);
        let asked = Asked { id, source, node, what, writes };
        if let Err(outcome) = self.begin_transfer(now, asked.clone(), request) {
            self.conclude(now, asked, outcome);
        }
    }

    fn begin_transfer(&mut self, now: Now, asked: Asked, request: SdoRequest) -> Result<(), Outcome> {
        let node = asked.node;
        let def = self.table.nodes.get(node.0).ok_or(Outcome::Unknown)?;
        let bus_def = self.table.buses.get(def.bus.0).ok_or(Outcome::Unknown)?;
        if bus_def.role == Role::Passive {
            let name = &bus_def.name;
            return Err(Outcome::Rejected(format!(
                "the gateway is passive on bus `{name}`: it sends nothing there"
            )));
        }
        let (node_id, index) = (def.canopen.id, def.bus);
        let bus = self.buses.get_mut(index.0).ok_or(Outcome::Unknown)?;
        if !bus.is_up() {
            return Err(Outcome::NodeUnavailable);
        }
        self.transfers.newest += 1;
        let transfer = TransferId(self.transfers.newest);
        bus.network.request_sdo(now, node_id, transfer, request).map_err(refusal)?;
        self.transfers.open.insert(transfer, asked);
        self.drain_network(now, index);
        Ok(())
    }

    /// A transfer that was asked for is over.
    pub(super) fn transfer_done(&mut self, now: Now, id: TransferId, result: &Result<Vec<u8>, SdoError>) {
        let Some(asked) = self.transfers.open.remove(&id) else { return };
        let outcome = match result {
            Ok(_) if asked.writes => Outcome::Done,
            Ok(data) => Outcome::Read(data.clone()),
            Err(SdoError::Abort(code)) => Outcome::Aborted(*code),
            Err(SdoError::Timeout { .. } | SdoError::TooSlow { .. }) => Outcome::Timeout,
            Err(SdoError::BusUnavailable) => Outcome::NodeUnavailable,
            Err(error @ (SdoError::Protocol(_) | SdoError::Interrupted | SdoError::TooLong { .. })) => {
                Outcome::Failed(error.to_string())
            }
        };
        self.conclude(now, asked, outcome);
    }

    /// Answers a request. A write is journalled, whatever came of it; a read only if it failed, and many alike as one.
    fn conclude(&mut self, now: Now, asked: Asked, outcome: Outcome) {
        if asked.writes {
            return self.finish_write(now, asked, outcome);
        }
        if !matches!(outcome, Outcome::Read(_) | Outcome::Busy) {
            let owner = self.owner_of_node(asked.node);
            self.events.record(now, owner, Name::Word("sdo_read_failed"), |event| {
                event.from = super::operate::source_text(&asked.source);
                super::operate::outcome_word(&outcome).clone_into(&mut event.to);
                event.text = super::operate::told(&outcome, asked.what);
            });
        }
        self.outputs.push_back(Output::Reply { id: asked.id, outcome });
    }
}

fn in_words(request: &SdoRequest) -> (String, bool) {
    match &request.action {
        SdoAction::Read => (request.object.to_string(), false),
        SdoAction::Write(data) => (written(request.object, data), true),
    }
}

/// `0x6132:1 = 02`; of long values the beginning and the number of bytes.
fn written(object: ObjectId, data: &[u8]) -> String {
    let shown = data.get(..SHOWN).unwrap_or(data);
    let hex = DataType::OctetString.decode(shown).unwrap_or_default();
    if shown.len() == data.len() {
        format!("{object} = {hex}")
    } else {
        format!("{object} = {hex}... ({} bytes)", data.len())
    }
}

fn refusal(refused: SdoRefused) -> Outcome {
    match refused {
        SdoRefused::NoSdo => {
            Outcome::Rejected("the gateway uses no SDO with this node: its mapping asks for none".to_owned())
        }
        SdoRefused::Stopped | SdoRefused::Client(Refused::BusUnavailable) => Outcome::NodeUnavailable,
        SdoRefused::Booting | SdoRefused::Client(Refused::QueueFull { .. }) => Outcome::Busy,
        SdoRefused::Client(error @ Refused::TooLong { .. }) => Outcome::Rejected(error.to_string()),
    }
}
