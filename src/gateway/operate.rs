//! What operators ask for: checked, done, journalled, answered.

use super::core::{Gateway, Output};
use super::node_event::request_word;
use super::objects::{Asked, written};
use super::refusals::Report;
use super::supply::Undo;
use super::{Action, Command, CommandSource, Outcome};
use crate::alarms::AcknowledgeError;
use crate::can::{BusIndex, CanFrame};
use crate::canopen::sdo::SdoRequest;
use crate::canopen::{NmtRequest, Role, cob_id};
use crate::mapping::AlarmOwner;
use crate::process_image::{AlarmIndex, NodeIndex, TagIndex};
use crate::time::Now;

/// Writes of one request that the journal shows.
const SHOWN: usize = 8;

/// A command that has been dealt with but for its answer.
#[derive(Debug)]
pub(super) struct Finished {
    id: u64,
    at: Now,
    source: CommandSource,
    /// Its word in the journal.
    name: &'static str,
    about: AlarmOwner,
    /// What was asked for, in words.
    what: String,
    outcome: Outcome,
    /// The frames that do it, each with what is to hold again if the bus does not even take it.
    frames: Vec<Carrying>,
    /// Of those: not taken.
    refused: usize,
}

/// A frame of a command.
#[derive(Debug)]
pub(super) struct Carrying {
    pub(super) bus: BusIndex,
    pub(super) frame: CanFrame,
    /// What was written for it.
    pub(super) undo: Vec<Undo>,
}

impl Finished {
    /// Bytes for a serial line that were not sent, or not all.
    pub(super) fn of_send(
        at: Now,
        (id, source): (u64, CommandSource),
        about: AlarmOwner,
        what: String,
        outcome: Outcome,
    ) -> Self {
        Self { id, at, source, name: "serial_send", about, what, outcome, frames: Vec::new(), refused: 0 }
    }
}

impl Gateway {
    /// Does what is asked for, if it is allowed. The answer, and the line in the journal that tells who asked and what
    /// came of it, follow when its frame was handed over: see [`Gateway::answer_commands`].
    pub(super) fn command(&mut self, now: Now, command: Command) {
        let Command { id, source, action } = command;
        let name = action.word();
        let (about, what) = self.in_words(&action);
        let mut frames = Vec::new();
        let outcome = match action {
            Action::SdoRead { node, object, len, timeout } => {
                let request = SdoRequest { len, timeout, ..SdoRequest::read(object) };
                self.request_object(now, (id, source), node, request);
                return self.settle(now);
            }
            Action::SdoWrite { node, object, data, timeout } => {
                let request = SdoRequest { timeout, ..SdoRequest::write(object, data) };
                self.request_object(now, (id, source), node, request);
                return self.settle(now);
            }
            Action::SerialSend { line, bytes } => {
                self.serial_send(now, (id, source), line, bytes);
                return self.settle(now);
            }
            Action::Nmt { node, request } => self.request_nmt(now, node, request, &mut frames),
            Action::WriteTags { writes } => match self.write_tags(now, &writes, &mut frames) {
                Ok(None) => Outcome::Done,
                Ok(Some((node, request))) => {
                    self.request_write(now, (id, source), (node, what), request);
                    return self.settle(now);
                }
                Err(outcome) => outcome,
            },
            Action::Acknowledge { alarm, raise } => self.acknowledge(now, alarm, raise),
            Action::AcknowledgeAll { node } => self.acknowledge_all(now, node),
            Action::Reset { alarm } => {
                if alarm.0 >= self.table.alarms.len() {
                    Outcome::Unknown
                } else if self.conditions.list_mut().reset(now, alarm) {
                    Outcome::Done
                } else {
                    Outcome::Rejected("the alarm is not latched, or not acknowledged yet".into())
                }
            }
        };
        self.finished.push(Finished { id, at: now, source, name, about, what, outcome, frames, refused: 0 });
        self.settle(now);
    }

    /// What a request is about, and what it asks for, for the journal.
    pub(super) fn in_words(&self, action: &Action) -> (AlarmOwner, String) {
        match action {
            Action::Nmt { node, request } => (self.owner_of_node(*node), request_word(*request).to_owned()),
            Action::WriteTags { writes } => {
                let def = |tag: &TagIndex| self.table.tag(*tag);
                let node = writes.first().and_then(|(tag, _)| def(tag)).map(|def| def.node);
                let name = |tag| def(tag).map_or("?", |def| def.name.as_str());
                let shown = writes.iter().take(SHOWN).map(|(tag, value)| format!("{} = {value}", name(tag)));
                let mut what = shown.collect::<Vec<_>>().join(", ");
                if writes.len() > SHOWN {
                    what = format!("{what} and {} more", writes.len() - SHOWN);
                }
                (node.map_or(AlarmOwner::Gateway, AlarmOwner::Node), what)
            }
            Action::Acknowledge { alarm, .. } | Action::Reset { alarm } => {
                (self.owner_of_alarm(*alarm), self.name_of_alarm(*alarm))
            }
            Action::AcknowledgeAll { node } => {
                (node.map_or(AlarmOwner::Gateway, |node| self.owner_of_node(node)), String::new())
            }
            Action::SdoRead { node, object, .. } => (self.owner_of_node(*node), object.to_string()),
            Action::SdoWrite { node, object, data, .. } => {
                (self.owner_of_node(*node), written(*object, data))
            }
            Action::SerialSend { line, .. } => {
                let def = self.table.line(*line);
                let about = def.map_or(AlarmOwner::Gateway, |def| self.owner_of_node(def.node));
                (about, def.map(|def| format!("serial channel {}", def.number)).unwrap_or_default())
            }
        }
    }

    /// The bus did not take a frame: what it was for was not done.
    pub(super) fn refuse_command(&mut self, now: Now, bus: BusIndex, frame: &CanFrame) {
        let mut undone = Vec::new();
        for command in &mut self.finished {
            for carrying in command.frames.iter_mut().filter(|each| (each.bus, each.frame) == (bus, *frame)) {
                command.refused += 1;
                undone.append(&mut carrying.undo);
            }
            if command.refused > 0 {
                let (all, refused) = (command.frames.len(), command.refused);
                command.outcome = if refused >= all {
                    Outcome::Busy
                } else {
                    Outcome::Failed(format!("{refused} of {all} frames were not taken by the bus"))
                };
            }
        }
        for undo in undone {
            self.take_back(now, undo);
        }
    }

    /// Answers the commands that were dealt with. To be called when everything else was handed over.
    pub(super) fn answer_commands(&mut self) {
        for command in std::mem::take(&mut self.finished) {
            let Finished { id, at, source, name, about, what, outcome, .. } = command;
            let text = told(&outcome, what);
            let report = Report {
                source,
                name,
                is_command: true,
                about,
                outcome: outcome_word(&outcome),
                text,
                count: 1,
            };
            if changed_nothing(&outcome) {
                self.events.record_refusal(at, report);
            } else {
                self.events.record_request(at, report);
            }
            self.outputs.push_back(Output::Reply { id, outcome });
        }
    }

    /// A write by SDO is over, or was not even begun.
    pub(super) fn finish_write(&mut self, at: Now, asked: Asked, outcome: Outcome) {
        let Asked { id, source, node, what, name, .. } = asked;
        let about = self.owner_of_node(node);
        self.finished.push(Finished {
            id,
            at,
            source,
            name,
            about,
            what,
            outcome,
            frames: Vec::new(),
            refused: 0,
        });
    }

    /// Acknowledges one alarm, if it is still the one that the asker saw.
    fn acknowledge(&mut self, now: Now, alarm: AlarmIndex, raise: Option<u64>) -> Outcome {
        let count = self.conditions.list_mut().status(alarm).map(|status| status.count);
        if let (Some(raise), Some(count)) = (raise, count)
            && raise != count
        {
            return Outcome::Rejected(format!(
                "the alarm was raised {count} times by now, not {raise}: look again"
            ));
        }
        match self.conditions.list_mut().acknowledge(now, alarm) {
            Ok(()) => Outcome::Done,
            Err(AcknowledgeError::Unknown) => Outcome::Unknown,
            Err(error @ AcknowledgeError::NothingToAcknowledge) => Outcome::Rejected(error.to_string()),
        }
    }

    /// `frames` gets the one that carries the command.
    fn request_nmt(
        &mut self,
        now: Now,
        node: NodeIndex,
        request: NmtRequest,
        frames: &mut Vec<Carrying>,
    ) -> Outcome {
        let Some(def) = self.table.nodes.get(node.0) else { return Outcome::Unknown };
        let Some(bus_def) = self.table.buses.get(def.bus.0) else { return Outcome::Unknown };
        let Some(canopen) = def.canopen() else { return no_canopen() };
        let (id, index) = (canopen.id, def.bus);
        if bus_def.role == Role::Passive {
            return Outcome::Rejected(format!(
                "the gateway is passive on bus `{}`: it sends nothing there",
                bus_def.name
            ));
        }
        let Some(bus) = self.buses.get_mut(index.0) else { return Outcome::Unknown };
        if !bus.is_up() {
            return Outcome::NodeUnavailable;
        }
        let accepted = bus.network.request_nmt(now, Some(id), request);
        let before = self.outputs.len();
        self.drain_network(now, index);
        frames.extend(self.outputs.iter().skip(before).find_map(|output| match output {
            Output::Transmit { bus, frame } if frame.id() == cob_id::NMT => {
                Some(Carrying { bus: *bus, frame: *frame, undo: Vec::new() })
            }
            Output::Transmit { .. } | Output::Reply { .. } => None,
        }));
        if accepted { Outcome::Done } else { Outcome::Rejected("the network does not allow it".into()) }
    }

    /// Acknowledges every alarm that waits for it, and opens latches whose source is not set any more.
    fn acknowledge_all(&mut self, now: Now, node: Option<NodeIndex>) -> Outcome {
        if node.is_some_and(|node| node.0 >= self.table.nodes.len()) {
            return Outcome::Unknown;
        }
        let of = node.map(AlarmOwner::Node);
        let alarms = self.table.alarms.iter().enumerate();
        let concerned = alarms.filter(|(_, alarm)| of.is_none_or(|of| of == alarm.owner));
        // That most alarms wait for nothing is no fault of this request.
        self.conditions.list_mut().acknowledge_all(now, concerned.map(|(place, _)| AlarmIndex(place)));
        self.tags.acknowledge_latches(&self.table, now, node);
        Outcome::Done
    }

    pub(super) fn owner_of_node(&self, node: NodeIndex) -> AlarmOwner {
        if node.0 < self.table.nodes.len() { AlarmOwner::Node(node) } else { AlarmOwner::Gateway }
    }

    fn owner_of_alarm(&self, alarm: AlarmIndex) -> AlarmOwner {
        self.table.alarms.get(alarm.0).map_or(AlarmOwner::Gateway, |alarm| alarm.owner)
    }

    fn name_of_alarm(&self, alarm: AlarmIndex) -> String {
        self.table.alarms.get(alarm.0).map(|alarm| alarm.name.clone()).unwrap_or_default()
    }
}

/// A node that does not speak CANopen was asked for what only CANopen has.
pub(super) fn no_canopen() -> Outcome {
    Outcome::Rejected("this node is no CANopen device: it has no NMT state and no objects".into())
}

/// What was asked for, and why it was not done.
pub(super) fn told(outcome: &Outcome, what: String) -> String {
    let reason = match outcome {
        Outcome::Rejected(reason) | Outcome::Forbidden(reason) | Outcome::Failed(reason) => reason.clone(),
        Outcome::Aborted(code) => code.to_string(),
        Outcome::Done
        | Outcome::Unknown
        | Outcome::Busy
        | Outcome::NodeUnavailable
        | Outcome::Read(_)
        | Outcome::Timeout => return what,
    };
    if what.is_empty() { reason } else { format!("{what}: {reason}") }
}

/// Whether a request was refused, by us or by the device, so that everything is as before. What timed out or broke off may
/// have been done.
fn changed_nothing(outcome: &Outcome) -> bool {
    match outcome {
        Outcome::Unknown
        | Outcome::Rejected(_)
        | Outcome::Forbidden(_)
        | Outcome::Busy
        | Outcome::NodeUnavailable
        | Outcome::Aborted(_)
        | Outcome::Read(_) => true,
        Outcome::Done | Outcome::Timeout | Outcome::Failed(_) => false,
    }
}

pub(super) fn outcome_word(outcome: &Outcome) -> &'static str {
    match outcome {
        Outcome::Done => "done",
        Outcome::Unknown => "unknown",
        Outcome::Rejected(_) => "rejected",
        Outcome::Forbidden(_) => "forbidden",
        Outcome::Busy => "busy",
        Outcome::NodeUnavailable => "node_unavailable",
        Outcome::Read(_) => "read",
        Outcome::Aborted(_) => "aborted",
        Outcome::Timeout => "timeout",
        Outcome::Failed(_) => "failed",
    }
}
