//! What each event of a node does: to its tags, its counters, its status, its alarms and the journal.

use std::time::Duration;

use super::Gateway;
use super::events::Name;
use super::node::{Loss, Node};
use super::tags::CarrierIndex;
use crate::can::{CanFrame, CanId};
use crate::canopen::object::ObjectId;
use crate::canopen::{ErrorControl, NmtRequest, NmtState, NodeEvent, PdoIndex};
use crate::mapping::{AlarmOwner, BuiltIn, NodeDef};
use crate::process_image::{Event, NodeCounters, NodeIndex, Quality, Reason, Value};
use crate::time::Now;

/// Wrong toggle bits within so many guard times of each other raise the alarm (N02).
const TOGGLE_WINDOW: u32 = 10;

impl Gateway {
    /// Takes an event of a node.
    pub(super) fn node_event(&mut self, now: Now, index: NodeIndex, event: &NodeEvent) {
        let at = (now, index);
        match *event {
            NodeEvent::Boot(ref told) => self.boot_event(at, told),
            NodeEvent::Polled { poll, ref result } => self.polled(at, poll, result),
            NodeEvent::Sdo { id, ref result } => self.transfer_done(now, id, result),
            NodeEvent::FrameSeen => return self.frame_seen(at),
            NodeEvent::Pdo { pdo, data, length } => return self.pdo(at, pdo, data, length),
            NodeEvent::PdoLength { pdo, received, discarded } => {
                self.pdo_length(at, pdo, received, discarded);
            }
            NodeEvent::PdoTimeout { pdo } => self.pdo_timeout(at, pdo),
            NodeEvent::PdoOutsideWindow { pdo, after } => self.pdo_outside_window(at, pdo, after),
            NodeEvent::RpdosStarted => self.rpdos_started(at),
            NodeEvent::RpdosStopped => self.rpdos_stopped(at),
            NodeEvent::RpdoSent { rpdo, data } => return self.rpdo_sent(at, rpdo, data),
            NodeEvent::RpdoNotSent { rpdo } => return self.rpdo_not_sent(at, rpdo),
            NodeEvent::PdoInUnexpectedState { pdo, state } => self.pdo_in_unexpected_state(at, pdo, state),
            NodeEvent::Malformed { frame } => self.malformed(at, &frame),
            NodeEvent::Seen => self.seen(at),
            NodeEvent::NeverSeen => self.never_seen(at),
            NodeEvent::State { from, to, ordered } => self.state(at, from, to, ordered),
            NodeEvent::Restarted => self.restarted(at),
            NodeEvent::InvalidState { raw } => self.invalid_state(at, raw),
            NodeEvent::UnsolicitedState => self.unsolicited_state(at),
            NodeEvent::GuardMissed { consecutive } => self.guard_missed(at, consecutive),
            NodeEvent::ToggleError { consecutive } => self.toggle_error(at, consecutive),
            NodeEvent::Lost { stuck_toggle } => self.lost(at, stuck_toggle),
            NodeEvent::Recovered => self.recovered(at),
            NodeEvent::Supervised => self.change(index, |node| node.supervised = true),
            NodeEvent::ForeignGuardMaster => {
                self.change(index, |node| node.foreign_guard = true);
                self.tell(at, "foreign_guard_master", |event| {
                    event.text =
                        "somebody else sends guard requests to this node; both see wrong toggle bits".into();
                });
            }
            NodeEvent::ForeignGuardMasterGone => {
                self.change(index, |node| node.foreign_guard = false);
                self.tell(at, "foreign_guard_master_gone", |_| ());
            }
            NodeEvent::ForeignSdo { object, write } => self.foreign_sdo(at, object, write),
            NodeEvent::StartHeldBack { wait } => {
                self.change(index, |node| node.start_held_back = true);
                self.tell(at, "start_held_back", |event| {
                    event.text =
                        format!("it restarts again and again; its next start waits {} s", wait.as_secs());
                });
            }
            NodeEvent::DuplicateSuspected { evidence } => self.duplicate_suspected(at, evidence),
            NodeEvent::DuplicateToldApart { pdo } => self.told_apart(at, pdo),
            NodeEvent::DuplicateCleared => {
                self.change(index, |node| {
                    node.duplicate = None;
                    node.watches.iter_mut().for_each(|watch| watch.told_apart = false);
                });
                self.show_errors(now, index);
                self.tell(at, "duplicate_node_cleared", |_| ());
            }
            NodeEvent::NmtSent { request } => self.nmt_sent(at, request),
            NodeEvent::StartFailed { attempts } => self.start_failed(at, attempts),
            NodeEvent::StartSucceeded => {
                self.change(index, |node| node.start_failed = None);
                self.tell(at, "node_start_succeeded", |_| ());
            }
            NodeEvent::Emergency { code, register, vendor } => self.emergency(at, code, register, vendor),
            NodeEvent::ErrorsForgotten => self.errors_forgotten(at),
        }
        self.refresh_node(now, index);
    }

    pub(super) fn frame_seen(&mut self, (now, index): (Now, NodeIndex)) {
        let Some(node) = self.nodes.get_mut(index.0) else { return };
        let counters = &mut node.status.counters;
        counters.frames_received = counters.frames_received.saturating_add(1);
        node.ever_seen = true;
        self.dirty_nodes.mark(index.0);
        let fell_silent = std::mem::take(&mut node.fell_silent);
        let had_contact = self.make_contact(index);
        if !had_contact {
            self.show_errors_unasked(now, index);
        }
        if !had_contact || fell_silent {
            self.refresh_node(now, index);
        }
    }

    /// The node showed itself, unless what it sent was on its way before its bus went down. Whether it had contact.
    fn make_contact(&mut self, index: NodeIndex) -> bool {
        let too_late = self.table.nodes.get(index.0).is_some_and(|def| self.comes_too_late(def.bus));
        let Some(node) = self.nodes.get_mut(index.0) else { return true };
        let had_contact = node.contact;
        node.contact |= !too_late;
        had_contact
    }

    fn pdo(&mut self, at: (Now, NodeIndex), pdo: PdoIndex, mut data: [u8; 8], length: u8) {
        let (now, index) = at;
        let Some(def) = self.table.nodes.get(index.0) else { return };
        let too_late = self.comes_too_late(def.bus);
        let Some(node) = self.nodes.get_mut(index.0) else { return };
        let told_apart = node.watches.get(pdo.0).is_some_and(|watch| watch.told_apart);
        let quality = node.quality_of_new_data(too_late, told_apart);
        let (Some(status), Some(watch)) = (node.status.pdos.get_mut(pdo.0), node.watches.get_mut(pdo.0))
        else {
            return;
        };
        if watch.withheld {
            return;
        }
        status.last_received = Some(now.instant);
        status.received = status.received.saturating_add(1);
        let was_stale = std::mem::take(&mut status.stale);
        let number = status.number;
        status.usable = true;
        node.status.newest_data = Some(now.utc);
        watch.fresh_until = watch.timeout.map(|timeout| now.instant + timeout);
        watch.held_until = None;
        let fresh_until = watch.fresh_until;

        if let Some(padding) = data.get_mut(usize::from(length)..) {
            padding.fill(0);
        }
        let reserved = def.reserved_bits.get(pdo.0).copied().unwrap_or(0) & u64::from_le_bytes(data);
        let before = std::mem::replace(&mut watch.reserved, reserved);
        let used = data.get(..usize::from(length)).unwrap_or(&data);
        self.tags.apply(&self.table, now, (index, pdo.into()), used, quality);
        self.dirty_nodes.mark(index.0);
        if let Some(until) = fresh_until {
            self.expire_at(until);
        }
        if reserved != 0 {
            self.count(index, |counters| &mut counters.reserved_bits);
            if before != reserved {
                self.tell(at, "reserved_bits", |event| {
                    event.value = Some(Value::Unsigned(reserved));
                    event.text = format!("TPDO{number} has bits set that are reserved: 0x{reserved:016X}");
                });
            }
        }
        if was_stale {
            self.tell(at, "pdo_recovered", |event| event.text = format!("TPDO{number} comes again"));
            self.refresh_node(now, index);
        }
    }

    fn pdo_length(&mut self, at: (Now, NodeIndex), pdo: PdoIndex, received: u8, discarded: bool) {
        let (now, index) = at;
        let number = self.pdo_number(index, pdo);
        self.count(index, |counters| &mut counters.pdo_length_errors);
        let Some(watch) = self.nodes.get_mut(index.0).and_then(|node| node.watches.get_mut(pdo.0)) else {
            return;
        };
        let expected = watch.length;
        let too_long = received > expected;
        let told = too_long && std::mem::replace(&mut watch.told_too_long, true);
        // One whose first bytes are used needs somebody to look at it once; data that is discarded is missing.
        if discarded || !told {
            self.conditions.pulse(now, AlarmOwner::Node(index), BuiltIn::PdoLength);
        }
        if told {
            return;
        }
        let name = if too_long { "pdo_length_exceeded" } else { "pdo_length_error" };
        self.tell(at, name, |event| {
            let consequence = if discarded { "discarded" } else { "the bytes beyond are ignored" };
            event.value = Some(Value::Unsigned(received.into()));
            event.text = format!("TPDO{number} has {received} bytes instead of {expected}: {consequence}");
        });
    }

    fn pdo_timeout(&mut self, at: (Now, NodeIndex), pdo: PdoIndex) {
        let (now, index) = at;
        let Some(def) = self.table.nodes.get(index.0) else { return };
        // Decided once: what the node or its bus do later must not put off the alarm again and again.
        let undecided_until = self.undecided_until(now, def);
        self.change(index, |node| {
            let held_until = undecided_until.max(node.suspect_until);
            if let (Some(status), Some(watch)) =
                (node.status.pdos.get_mut(pdo.0), node.watches.get_mut(pdo.0))
            {
                status.stale = true;
                watch.held_until = held_until;
            }
        });
        self.degrade(now, index, Some(pdo), Quality::Stale(Reason::PdoTimeout));
        self.look_for_silence(now, index);
        let number = self.pdo_number(index, pdo);
        self.tell(at, "pdo_timeout", |event| event.text = format!("TPDO{number} did not come in time"));
    }

    fn pdo_outside_window(&mut self, at: (Now, NodeIndex), pdo: PdoIndex, after: Duration) {
        self.count(at.1, |counters| &mut counters.late_pdos);
        let number = self.pdo_number(at.1, pdo);
        self.tell(at, "pdo_outside_window", |event| {
            event.text = format!("TPDO{number} came {} us after SYNC", after.as_micros());
        });
    }

    fn pdo_in_unexpected_state(&mut self, at: (Now, NodeIndex), pdo: PdoIndex, state: Option<NmtState>) {
        self.count(at.1, |counters| &mut counters.unexpected_states);
        let number = self.pdo_number(at.1, pdo);
        self.tell(at, "pdo_in_unexpected_state", |event| {
            state_word(state).clone_into(&mut event.from);
            event.text = format!("TPDO{number} came though the node was not known to be operational");
        });
    }

    fn malformed(&mut self, at: (Now, NodeIndex), frame: &CanFrame) {
        self.count(at.1, |counters| &mut counters.malformed);
        if frame.is_remote() || matches!(frame.id(), CanId::Extended(_)) {
            self.count_foreign_frame_of(at.1);
        }
        self.tell(at, "malformed_frame", |event| event.text = format!("{frame} was not decoded"));
    }

    pub(super) fn seen(&mut self, at: (Now, NodeIndex)) {
        self.change(at.1, |node| node.never_seen = false);
        self.make_contact(at.1);
        self.tell(at, "node_seen", |_| ());
    }

    pub(super) fn never_seen(&mut self, at: (Now, NodeIndex)) {
        self.change(at.1, |node| {
            node.begin_missing(at.0);
            node.never_seen = true;
            node.contact = false;
        });
        let (def, node) = (self.table.nodes.get(at.1.0), self.nodes.get(at.1.0));
        let reason = def.zip(node).map(|(def, node)| node.reason(def, None)).unwrap_or_default();
        self.tell(at, "node_never_seen", |event| event.text = reason);
    }

    fn state(&mut self, at: (Now, NodeIndex), from: Option<NmtState>, to: NmtState, ordered: bool) {
        let (now, index) = at;
        let operational = to == NmtState::Operational;
        self.change(index, |node| {
            node.nmt = Some(to);
            if operational {
                node.start_failed = None;
                node.start_held_back = false;
            } else {
                node.clear_stale_pdos();
            }
        });
        if to == NmtState::Initialising {
            // Whoever ordered it: what is read is as old as what is sent, until the boot is done.
            self.degrade(now, index, None, Quality::Stale(Reason::NodeRestarted));
            self.show_errors_unasked(now, index);
        } else if !operational {
            // Objects are read in other states too.
            let pdos = self.table.nodes.get(index.0).map_or(0, |def| def.pdos().len());
            for pdo in (0..pdos).map(PdoIndex) {
                self.degrade(now, index, Some(pdo), Quality::Stale(Reason::NodeNotOperational));
            }
        }
        if !ordered {
            self.count(index, |counters| &mut counters.unexpected_states);
        }
        let name = if ordered { "state" } else { "node_state_unexpected" };
        self.tell(at, name, |event| {
            state_word(from).clone_into(&mut event.from);
            to.word().clone_into(&mut event.to);
        });
    }

    pub(super) fn restarted(&mut self, at: (Now, NodeIndex)) {
        let (now, index) = at;
        self.change(index, |node| node.watches.iter_mut().for_each(|watch| watch.told_too_long = false));
        self.count(index, |counters| &mut counters.restarts);
        self.degrade(now, index, None, Quality::Stale(Reason::NodeRestarted));
        self.tell(at, "node_restarted", |event| event.text = "the node restarted unasked".into());
        // That it was lost has an alarm of its own; the boot-up that ended the loss is no second cause.
        let was_lost = self.nodes.get(index.0).is_some_and(|node| node.recovered_at == Some(now.instant));
        if !was_lost {
            self.conditions.pulse(now, AlarmOwner::Node(index), BuiltIn::Restarted);
        }
    }

    fn invalid_state(&mut self, at: (Now, NodeIndex), raw: u8) {
        self.count(at.1, |counters| &mut counters.unexpected_states);
        self.tell(at, "node_state_invalid", |event| {
            event.value = Some(Value::Unsigned(raw.into()));
            event.to = raw.to_string();
            event.text = format!("the node reports state {raw}, which CiA 301 does not define");
        });
    }

    fn unsolicited_state(&mut self, at: (Now, NodeIndex)) {
        self.tell(at, "unsolicited_state", |event| {
            event.text = "the node told its state though nobody had asked".into();
        });
    }

    fn start_failed(&mut self, at: (Now, NodeIndex), attempts: u32) {
        self.change(at.1, |node| node.start_failed = Some(attempts));
        self.tell(at, "node_start_failed", |event| {
            event.text = format!("{attempts} start commands had no effect");
        });
    }

    fn guard_missed(&mut self, (now, index): (Now, NodeIndex), consecutive: u16) {
        self.count(index, |counters| &mut counters.guard_misses);
        self.suspect(now, index, consecutive);
    }

    fn toggle_error(&mut self, at: (Now, NodeIndex), consecutive: u16) {
        let (now, index) = at;
        self.count(index, |counters| &mut counters.toggle_errors);
        let settings = self.table.nodes.get(index.0).and_then(NodeDef::canopen);
        let guard_time = match settings.map(|settings| &settings.error_control) {
            Some(ErrorControl::Guarding(guarding)) => guarding.guard_time,
            Some(ErrorControl::Heartbeat { .. } | ErrorControl::None) | None => return,
        };
        let mut before = None;
        self.change(index, |node| before = node.last_toggle_error.replace(now.instant));
        // Errors in a row may be a stuck toggle bit, which loses the node and is told by that.
        let single = consecutive <= 1;
        if single && before.is_some_and(|before| now.instant.since(before) <= guard_time * TOGGLE_WINDOW) {
            self.conditions.pulse(now, AlarmOwner::Node(index), BuiltIn::GuardToggle);
        }
        self.suspect(now, index, consecutive);
        self.tell(at, "toggle_error", |event| {
            event.text = "a guard reply had the toggle bit of the one before".into();
        });
    }

    /// A node that misses its first reply will have answered, or be lost, within its life time.
    fn suspect(&mut self, now: Now, index: NodeIndex, consecutive: u16) {
        let settings = self.table.nodes.get(index.0).and_then(NodeDef::canopen);
        let Some(ErrorControl::Guarding(guarding)) = settings.map(|settings| &settings.error_control) else {
            return;
        };
        let life_time = guarding.guard_time * u32::from(guarding.life_time_factor) + guarding.reply_timeout;
        if consecutive == 1 {
            self.change(index, |node| node.suspect_until = Some(now.instant + life_time));
        }
    }

    pub(super) fn lost(&mut self, at: (Now, NodeIndex), stuck_toggle: bool) {
        let (now, index) = at;
        let loss = if stuck_toggle { Loss::StuckToggle } else { Loss::Silence };
        let mut was_there = false;
        self.change(index, |node| {
            node.begin_missing(now);
            node.lost = Some(loss);
            node.supervised = false;
            node.suspect_until = None;
            node.clear_stale_pdos();
            node.told_lost = node.ever_seen;
            was_there = node.ever_seen;
        });
        self.degrade(now, index, None, Quality::Bad(Reason::NodeLost));
        let (def, node) = (self.table.nodes.get(index.0), self.nodes.get(index.0));
        let reason = def.zip(node).map(|(def, node)| node.reason(def, None)).unwrap_or_default();
        if was_there {
            self.tell(at, "node_lost", |event| event.text = reason);
        }
    }

    pub(super) fn recovered(&mut self, at: (Now, NodeIndex)) {
        let mut told_lost = false;
        self.change(at.1, |node| {
            node.never_seen = false;
            node.lost = None;
            node.recovered_at = Some(at.0.instant);
            node.suspect_until = None;
            told_lost = std::mem::take(&mut node.told_lost);
        });
        self.make_contact(at.1);
        self.show_errors_unasked(at.0, at.1);
        if told_lost {
            self.tell(at, "node_recovered", |_| ());
        }
    }

    fn duplicate_suspected(&mut self, at: (Now, NodeIndex), evidence: &'static str) {
        let mut first = false;
        self.change(at.1, |node| first = node.duplicate.replace(evidence).is_none());
        if let Some(def) = self.table.nodes.get(at.1.0).filter(|_| first) {
            // What the node is sent reaches it, whoever else hears it.
            let [_, last] = CarrierIndex::of_emergencies(def);
            for carrier in (0..=last.0).map(CarrierIndex) {
                let quality = Quality::Uncertain(Reason::DuplicateNode);
                self.tags.degrade(&self.table, at.0, at.1, Some(carrier), quality);
            }
        }
        self.tell(at, "duplicate_node", |event| evidence.clone_into(&mut event.text));
    }

    /// Two nodes send this TPDO, but only one of them with the right length. What came before may have been the other's.
    fn told_apart(&mut self, at: (Now, NodeIndex), pdo: PdoIndex) {
        self.change(at.1, |node| {
            if let Some(watch) = node.watches.get_mut(pdo.0) {
                watch.told_apart = true;
            }
        });
        let number = self.pdo_number(at.1, pdo);
        self.tell(at, "duplicate_told_apart", |event| {
            event.text =
                format!("frames of TPDO{number} that have another length than the mapping says are ignored");
        });
    }

    /// Somebody else reads an object, which harms nobody, or writes one.
    fn foreign_sdo(&mut self, at: (Now, NodeIndex), object: ObjectId, write: bool) {
        self.count_foreign_frame_of(at.1);
        if !write {
            return self.tell(at, "foreign_sdo_read", |event| {
                event.text =
                    "somebody else reads objects of this node by SDO: another master, or a tool".into();
            });
        }
        if let Some(bus) = self.table.nodes.get(at.1.0).map(|def| def.bus) {
            self.foreign_master(at.0, bus);
        }
        self.tell(at, "foreign_sdo_write", |event| {
            event.to = object.to_string();
            event.text = format!("somebody else writes {object} of this node: it may not be set as it was");
        });
    }

    fn nmt_sent(&mut self, at: (Now, NodeIndex), request: NmtRequest) {
        self.count(at.1, |counters| &mut counters.nmt_commands_sent);
        self.change(at.1, |node| match request {
            NmtRequest::Start => node.stop_ordered = false,
            // Both hold the node back until an operator starts it.
            NmtRequest::Stop | NmtRequest::EnterPreOperational => {
                node.stop_ordered = true;
                node.start_failed = None;
                node.start_held_back = false;
            }
            NmtRequest::ResetNode | NmtRequest::ResetCommunication => {}
        });
        self.tell(at, "nmt_command_sent", |event| request_word(request).clone_into(&mut event.to));
    }

    pub(super) fn change(&mut self, index: NodeIndex, change: impl FnOnce(&mut Node)) {
        if let Some(node) = self.nodes.get_mut(index.0) {
            change(node);
        }
    }

    pub(super) fn count(&mut self, index: NodeIndex, counter: impl FnOnce(&mut NodeCounters) -> &mut u64) {
        if let Some(node) = self.nodes.get_mut(index.0) {
            let counter = counter(&mut node.status.counters);
            *counter = counter.saturating_add(1);
            self.dirty_nodes.mark(index.0);
        }
    }

    pub(super) fn tell(
        &mut self,
        (now, index): (Now, NodeIndex),
        name: &'static str,
        fill: impl FnOnce(&mut Event),
    ) {
        self.events.record(now, AlarmOwner::Node(index), Name::Word(name), fill);
    }

    /// The number of a TPDO as users know it.
    pub(super) fn pdo_number(&self, index: NodeIndex, pdo: PdoIndex) -> u16 {
        let settings = self.table.nodes.get(index.0).and_then(|def| def.pdos().get(pdo.0));
        settings.map_or(0, |pdo| pdo.number)
    }
}

fn state_word(state: Option<NmtState>) -> &'static str {
    state.map_or("unknown", NmtState::word)
}

/// The word of an NMT command in events.
pub(super) fn request_word(request: NmtRequest) -> &'static str {
    match request {
        NmtRequest::Start => "start",
        NmtRequest::Stop => "stop",
        NmtRequest::EnterPreOperational => "enter_pre_operational",
        NmtRequest::ResetNode => "reset_node",
        NmtRequest::ResetCommunication => "reset_communication",
    }
}
