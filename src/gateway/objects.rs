//! Objects of a node that others want read or written: asked of its network, answered when the node has answered.

use std::collections::BTreeMap;

use super::core::{Gateway, Output};
use super::kept::Kept;
use super::operate::{no_canopen, outcome_word, told};
use super::refusals::Report;
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
    /// The word of the request in the journal.
    pub(super) name: &'static str,
    /// What is written.
    written: Option<(ObjectId, Vec<u8>)>,
}

impl Transfers {
    /// Takes over what is under way with nodes that stay; the others were broken off before. No number is given out twice.
    pub(super) fn take_over(&mut self, old: Self, kept: &Kept) {
        self.newest = old.newest;
        for (id, asked) in old.open {
            if let Some(node) = kept.new_node(asked.node) {
                self.open.insert(id, Asked { node, ..asked });
            }
        }
    }
}

impl Gateway {
    /// Whoever waits for one of these nodes gets this answer; what comes of the transfer is nobody's then.
    pub(super) fn break_off_transfers(
        &mut self,
        now: Now,
        of: impl Fn(NodeIndex) -> bool,
        outcome: &Outcome,
    ) {
        let open = std::mem::take(&mut self.transfers.open);
        let (gone, stay): (BTreeMap<_, _>, _) = open.into_iter().partition(|(_, asked)| of(asked.node));
        self.transfers.open = stay;
        for asked in gone.into_values() {
            self.conclude(now, asked, outcome.clone());
        }
    }

    /// Asks the node. Its answer, or why it is not even asked, becomes the answer to the request.
    pub(super) fn request_object(
        &mut self,
        now: Now,
        (id, source): (u64, CommandSource),
        node: NodeIndex,
        request: SdoRequest,
    ) {
        let what = in_words(&request);
        let name = if request.action == SdoAction::Read { "sdo_read" } else { "sdo_write" };
        self.request_as(now, (id, source), (node, what, name), request);
    }

    /// Writes a tag that is an object of its node; `what` tells it for the journal.
    pub(super) fn request_write(
        &mut self,
        now: Now,
        asker: (u64, CommandSource),
        (node, what): (NodeIndex, String),
        request: SdoRequest,
    ) {
        self.request_as(now, asker, (node, what, "write"), request);
    }

    fn request_as(
        &mut self,
        now: Now,
        (id, source): (u64, CommandSource),
        (node, what, name): (NodeIndex, String, &'static str),
        request: SdoRequest,
    ) {
        let written = match &request.action {
            SdoAction::Read => None,
            SdoAction::Write(data) => Some((request.object, data.clone())),
        };
        let asked = Asked { id, source, node, what, name, written };
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
        let canopen = def.canopen().ok_or_else(no_canopen)?;
        let (node_id, index) = (canopen.id, def.bus);
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

    /// A transfer that was asked for is over. A unit that was written is the device's from now on (R-DST-034).
    pub(super) fn transfer_done(&mut self, now: Now, id: TransferId, result: &Result<Vec<u8>, SdoError>) {
        let Some(asked) = self.transfers.open.remove(&id) else { return };
        let outcome = match result {
            Ok(_) if asked.written.is_some() => Outcome::Done,
            Ok(data) => Outcome::Read(data.clone()),
            Err(SdoError::Abort(code)) => Outcome::Aborted(*code),
            Err(SdoError::Timeout { .. } | SdoError::TooSlow { .. }) => Outcome::Timeout,
            Err(SdoError::BusUnavailable) => Outcome::NodeUnavailable,
            Err(error @ (SdoError::Protocol(_) | SdoError::Interrupted | SdoError::TooLong { .. })) => {
                Outcome::Failed(error.to_string())
            }
        };
        if let (Outcome::Done, Some((object, data))) = (&outcome, &asked.written) {
            self.learn((now, asked.node), *object, Some(data));
        }
        self.conclude(now, asked, outcome);
    }

    /// Answers a request. A write is journalled, whatever came of it, and what a grant allowed; any other read only if it failed. Refusals that repeat are told as one.
    fn conclude(&mut self, now: Now, asked: Asked, outcome: Outcome) {
        if asked.written.is_some() {
            return self.finish_write(now, asked, outcome);
        }
        if asked.source.access.is_some() {
            return self.finish_write(now, asked, outcome);
        }
        if !matches!(outcome, Outcome::Read(_) | Outcome::Busy) {
            let report = Report {
                source: asked.source,
                name: "sdo_read_failed",
                is_command: false,
                about: self.owner_of_node(asked.node),
                outcome: outcome_word(&outcome),
                text: told(&outcome, asked.what),
                count: 1,
            };
            self.events.record_refusal(now, report);
        }
        self.outputs.push_back(Output::Reply { id: asked.id, outcome });
    }
}

fn in_words(request: &SdoRequest) -> String {
    match &request.action {
        SdoAction::Read => request.object.to_string(),
        SdoAction::Write(data) => written(request.object, data),
    }
}

/// `0x6132:1 = 02`; of long values the beginning and the number of bytes.
pub(super) fn written(object: ObjectId, data: &[u8]) -> String {
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
