//! What operators ask for: checked, done, journalled, answered.

use super::core::{Gateway, Output};
use super::node_event::request_word;
use super::objects::Asked;
use super::supply::Undo;
use super::{Action, Command, CommandSource, Outcome};
use crate::alarms::AcknowledgeError;
use crate::can::{BusIndex, CanFrame};
use crate::canopen::sdo::SdoRequest;
use crate::canopen::{NmtRequest, Role, cob_id};
use crate::mapping::AlarmOwner;
use crate::process_image::{AlarmIndex, NodeIndex};
use crate::time::Now;

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
    /// The frame that does it: if the bus does not even take it, nothing was done.
    frame: Option<(BusIndex, CanFrame)>,
    /// What is to hold again in that case.
    undo: Option<Undo>,
}

impl Gateway {
    /// Does what is asked for, if it is allowed. The answer, and the line in the journal that tells who asked and what
    /// came of it, follow when its frame was handed over: see [`Gateway::answer_commands`].
    pub(super) fn command(&mut self, now: Now, command: Command) {
        let Command { id, source, action } = command;
        let (mut frame, mut undo) = (None, None);
        let (name, about, outcome, what) = match action {
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
            Action::Nmt { node, request } => {
                let outcome = self.request_nmt(now, node, request, &mut frame);
                ("nmt", self.owner_of_node(node), outcome, request_word(request).to_owned())
            }
            Action::WriteTag { tag, value } => {
                let outcome;
                (outcome, undo) = self.write_tag(now, tag, value, &mut frame);
                let def = self.table.tag(tag);
                let about = def.map_or(AlarmOwner::Gateway, |def| AlarmOwner::Node(def.node));
                let what = def.map(|def| format!("{} = {value}", def.name)).unwrap_or_default();
                ("write", about, outcome, what)
            }
            Action::Acknowledge { alarm } => {
                let outcome = match self.conditions.list_mut().acknowledge(now, alarm) {
                    Ok(()) => Outcome::Done,
                    Err(AcknowledgeError::Unknown) => Outcome::Unknown,
                    Err(error @ AcknowledgeError::NothingToAcknowledge) => {
                        Outcome::Rejected(error.to_string())
                    }
                };
                ("acknowledge", self.owner_of_alarm(alarm), outcome, self.name_of_alarm(alarm))
            }
            Action::AcknowledgeAll { node } => {
                let outcome = self.acknowledge_all(now, node);
                let about = node.map_or(AlarmOwner::Gateway, |node| self.owner_of_node(node));
                ("acknowledge_all", about, outcome, String::new())
            }
            Action::Reset { alarm } => {
                let outcome = if alarm.0 >= self.table.alarms.len() {
                    Outcome::Unknown
                } else if self.conditions.list_mut().reset(now, alarm) {
                    Outcome::Done
                } else {
                    Outcome::Rejected("the alarm is not latched, or not acknowledged yet".into())
                };
                ("reset", self.owner_of_alarm(alarm), outcome, self.name_of_alarm(alarm))
            }
        };
        self.finished.push(Finished { id, at: now, source, name, about, what, outcome, frame, undo });
        self.settle(now);
    }

    /// The bus did not take a frame: the command that it was for failed.
    pub(super) fn refuse_command(&mut self, now: Now, bus: BusIndex, frame: &CanFrame) {
        let mut undone = Vec::new();
        for command in &mut self.finished {
            if command.frame == Some((bus, *frame)) {
                command.outcome = Outcome::Busy;
                undone.extend(command.undo.take());
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
            self.events.record_command(at, about, name, |event| {
                event.from = source_text(&source);
                outcome_word(&outcome).clone_into(&mut event.to);
                event.text = told(&outcome, what);
            });
            self.outputs.push_back(Output::Reply { id, outcome });
        }
    }

    /// A write by SDO is over, or was not even begun.
    pub(super) fn finish_write(&mut self, at: Now, asked: Asked, outcome: Outcome) {
        let Asked { id, source, node, what, .. } = asked;
        let about = self.owner_of_node(node);
        self.finished.push(Finished {
            id,
            at,
            source,
            name: "sdo_write",
            about,
            what,
            outcome,
            frame: None,
            undo: None,
        });
    }

    /// `frame` becomes the one that carries the command.
    fn request_nmt(
        &mut self,
        now: Now,
        node: NodeIndex,
        request: NmtRequest,
        frame: &mut Option<(BusIndex, CanFrame)>,
    ) -> Outcome {
        let Some(def) = self.table.nodes.get(node.0) else { return Outcome::Unknown };
        let Some(bus_def) = self.table.buses.get(def.bus.0) else { return Outcome::Unknown };
        let (id, index) = (def.canopen.id, def.bus);
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
        *frame = self.outputs.iter().skip(before).find_map(|output| match output {
            Output::Transmit { bus, frame } if frame.id() == cob_id::NMT => Some((*bus, *frame)),
            Output::Transmit { .. } | Output::Reply { .. } => None,
        });
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

/// What was asked for, and why it was not done.
pub(super) fn told(outcome: &Outcome, what: String) -> String {
    let reason = match outcome {
        Outcome::Rejected(reason) | Outcome::Failed(reason) => reason.clone(),
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

pub(super) fn source_text(source: &CommandSource) -> String {
    match source {
        CommandSource::Modbus(who) => format!("modbus {who}"),
        CommandSource::Mqtt(who) => format!("mqtt {who}"),
        CommandSource::Web(who) => format!("web {who}"),
        CommandSource::Cia309(who) => format!("cia309 {who}"),
    }
}

pub(super) fn outcome_word(outcome: &Outcome) -> &'static str {
    match outcome {
        Outcome::Done => "done",
        Outcome::Unknown => "unknown",
        Outcome::Rejected(_) => "rejected",
        Outcome::Busy => "busy",
        Outcome::NodeUnavailable => "node_unavailable",
        Outcome::Read(_) => "read",
        Outcome::Aborted(_) => "aborted",
        Outcome::Timeout => "timeout",
        Outcome::Failed(_) => "failed",
    }
}
