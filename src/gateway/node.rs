//! One node: what is known of it, and what readers and alarms are told of that.
//!
//! What each event of its network does to it is in `node_event`.

use std::time::Duration;

use super::{Gateway, modules};
use crate::canopen::boot::BootSettings;
use crate::canopen::{ErrorControl, NmtState, PdoIndex};
use crate::mapping::{AlarmOwner, BuiltIn, NodeDef, Protocol};
use crate::process_image::{NodeIndex, NodeStatus, PdoStatus, Quality, Reason};
use crate::time::{Instant, Now};

/// What the gateway remembers of a node beside what readers see.
#[derive(Debug)]
pub(super) struct Node {
    pub(super) status: NodeStatus,
    /// The last state that it reported, or was seen to be in.
    pub(super) nmt: Option<NmtState>,
    /// A frame came since the bus came up, and the node was not reported as never seen.
    pub(super) contact: bool,
    pub(super) never_seen: bool,
    pub(super) lost: Option<Loss>,
    /// Start commands without effect.
    pub(super) start_failed: Option<u32>,
    /// It restarts again and again, so that its start waits.
    pub(super) start_held_back: bool,
    pub(super) stop_ordered: bool,
    /// It was found to be another device in the boot under way, and that is tolerated.
    pub(super) other_device: bool,
    /// Why its boot failed last.
    pub(super) boot_trouble: Option<BootTrouble>,
    /// A frame came at any time since the gateway started.
    pub(super) ever_seen: bool,
    /// The journal tells that it was lost.
    pub(super) told_lost: bool,
    /// What says that another node has the same id.
    pub(super) duplicate: Option<&'static str>,
    /// It told its state since it was lost or the bus could not be used.
    pub(super) supervised: bool,
    /// Somebody else guards it too.
    pub(super) foreign_guard: bool,
    pub(super) last_toggle_error: Option<Instant>,
    /// Guard requests stay without answer: until then it will have answered, or be lost.
    pub(super) suspect_until: Option<Instant>,
    /// When it was lost, or reported as never seen, the last time.
    pub(super) missing_since: Option<Instant>,
    /// When it came back the last time.
    pub(super) recovered_at: Option<Instant>,
    /// Nothing came since the data of all its supervised TPDOs became too old, and nothing else watches it.
    pub(super) fell_silent: bool,
    /// It is asked at every boot what is wrong with it.
    pub(super) asked_about_errors: bool,
    /// When its last emergency message came.
    pub(super) last_emergency: Option<Instant>,
    /// By TPDO.
    pub(super) watches: Vec<PdoWatch>,
}

/// What is remembered of a TPDO beside what readers see.
#[derive(Clone, Debug, Default)]
pub(super) struct PdoWatch {
    /// When its data is too old, where that can happen and has not yet.
    pub(super) fresh_until: Option<Instant>,
    /// Its alarm is not raised before: when it did not come, the cause could still have been another.
    pub(super) held_until: Option<Instant>,
    /// It has to come within this time; `None`: it is not supervised.
    pub(super) timeout: Option<Duration>,
    /// Bytes that it has.
    pub(super) length: u8,
    /// What it carries is not known: the device was not asked yet, or maps it otherwise than the mapping file (R-DST-034).
    pub(super) withheld: bool,
    /// Set reserved bits of the last frame.
    pub(super) reserved: u64,
    /// That it is too long has been told.
    pub(super) told_too_long: bool,
    /// Two nodes send it, but with different lengths: only one's frames count.
    pub(super) told_apart: bool,
}

/// Why a node cannot be booted.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum BootTrouble {
    /// It does not answer SDO requests. Where it is not there at all, that is told otherwise.
    NoAnswer,
    /// It is not the device that the mapping is for.
    OtherDevice(String),
    /// An object could not be read or written.
    Configuration(String),
}

/// How a node was lost.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Loss {
    Silence,
    StuckToggle,
}

impl Node {
    pub(super) fn new(def: &NodeDef, passive: bool) -> Self {
        let pdos = &def.pdos();
        let status = NodeStatus {
            passive,
            pdos: pdos.iter().map(|pdo| PdoStatus { number: pdo.number, ..PdoStatus::default() }).collect(),
            ..NodeStatus::default()
        };
        let asked = |place: usize| {
            !passive
                && def.protocol.has_sdo()
                && def.protocol.boot().is_some_and(|boot| boot.asks_about(PdoIndex(place)))
        };
        Self {
            status,
            nmt: None,
            contact: false,
            never_seen: false,
            lost: None,
            start_failed: None,
            start_held_back: false,
            stop_ordered: false,
            other_device: false,
            boot_trouble: None,
            ever_seen: false,
            told_lost: false,
            duplicate: None,
            supervised: false,
            foreign_guard: false,
            last_toggle_error: None,
            suspect_until: None,
            missing_since: None,
            recovered_at: None,
            fell_silent: false,
            asked_about_errors: !passive && def.protocol.boot().is_some_and(BootSettings::asks_about_errors),
            last_emergency: None,
            watches: pdos
                .iter()
                .enumerate()
                .map(|(place, pdo)| PdoWatch {
                    withheld: asked(place),
                    timeout: pdo.timeout,
                    length: pdo.length,
                    ..PdoWatch::default()
                })
                .collect(),
        }
    }

    /// How far data that comes now can be trusted (R-DET-037, P22). `too_late`: its bus is known to be down, so that it
    /// was on its way before. `told_apart`: it is this node's even if another has the same id.
    pub(super) fn quality_of_new_data(&self, too_late: bool, told_apart: bool) -> Quality {
        if too_late {
            Quality::Uncertain(Reason::BusUnavailable)
        } else if self.lost.is_some() {
            Quality::Uncertain(Reason::NodeLost)
        } else if self.duplicate.is_some() && !told_apart {
            Quality::Uncertain(Reason::DuplicateNode)
        } else {
            Quality::Good
        }
    }

    /// Its bus cannot be used any more: whether it is there is not known until a frame comes.
    pub(super) fn lose_contact(&mut self) {
        self.contact = false;
        self.supervised = false;
        self.suspect_until = None;
        self.clear_stale_pdos();
    }

    /// Lost, or never seen.
    pub(super) fn is_missing(&self) -> bool {
        self.lost.is_some() || self.never_seen
    }

    /// It is about to be lost, or to be reported as never seen.
    pub(super) fn begin_missing(&mut self, now: Now) {
        if !self.is_missing() {
            self.missing_since = Some(now.instant);
        }
    }

    /// It is optional, and has not come since the gateway started.
    pub(super) fn may_be_absent(&self, def: &NodeDef) -> bool {
        !def.required && !self.ever_seen
    }

    /// Whether frames are to be expected of it all the time.
    pub(super) fn is_expected(&self, def: &NodeDef) -> bool {
        let sends_pdos = self.watches.iter().any(|pdo| pdo.timeout.is_some());
        // Another module is looked at once a minute only.
        let is_other =
            def.canopen().is_none() && matches!(self.boot_trouble, Some(BootTrouble::OtherDevice(_)));
        if self.may_be_absent(def) || is_other {
            return false;
        }
        let may_send = matches!(self.nmt, None | Some(NmtState::Operational));
        is_watched(def) || (sends_pdos && may_send)
    }

    /// The data of a TPDO, or of all, is not usable any more and need not be watched.
    pub(super) fn lose_data_of(&mut self, pdo: Option<PdoIndex>) {
        let pdos = self.watches.iter_mut().zip(&mut self.status.pdos).enumerate();
        for (_, (watch, status)) in pdos.filter(|(place, _)| pdo.is_none_or(|pdo| pdo.0 == *place)) {
            watch.fresh_until = None;
            status.usable = false;
        }
    }

    /// TPDOs are not expected any more.
    pub(super) fn clear_stale_pdos(&mut self) {
        self.status.pdos.iter_mut().for_each(|pdo| pdo.stale = false);
    }

    /// Why it is not online, or not as it should be; empty when all is well.
    pub(super) fn reason(&self, def: &NodeDef, bus_trouble: Option<&str>) -> String {
        if let Some(trouble) = bus_trouble {
            return trouble.to_owned();
        }
        let Some(id) = def.canopen().map(|settings| settings.id) else { return modules::reason(self, def) };
        if self.never_seen || (self.lost.is_some() && !self.ever_seen) {
            return format!(
                "no frame from node {id} since the gateway started; possible causes: power or cable, the device is \
                 not in its CANopen mode, another node id, another bit rate"
            );
        }
        // It answers, but is given no heartbeat: that it is lost says less.
        if let Some(BootTrouble::OtherDevice(why)) = self.boot_trouble.as_ref().filter(|_| self.contact) {
            return format!("not started: {why}");
        }
        match self.lost {
            Some(Loss::StuckToggle) => {
                return format!(
                    "node {id} answers guarding with a toggle bit that does not change; its CPU may be dead, or \
                     another master guards it too"
                );
            }
            Some(Loss::Silence) => {
                let silent = match def.canopen().map(|settings| &settings.error_control) {
                    Some(ErrorControl::Guarding(_)) => "does not answer guarding",
                    Some(ErrorControl::Heartbeat { .. }) => "sends no heartbeat",
                    Some(ErrorControl::None) | None => "is silent",
                };
                return format!("node {id} {silent}; check its power and cable");
            }
            None => {}
        }
        if !self.contact {
            return format!("waiting for its {} frame", if self.ever_seen { "next" } else { "first" });
        }
        match &self.boot_trouble {
            Some(BootTrouble::NoAnswer) => {
                return format!("node {id} answers no SDO request, so it is not started");
            }
            Some(BootTrouble::OtherDevice(why) | BootTrouble::Configuration(why)) => {
                return format!("not started: {why}");
            }
            None => {}
        }
        if let Some(attempts) = self.start_failed {
            return format!("{attempts} start commands had no effect");
        }
        if self.start_held_back {
            return "restarts again and again; its start waits".to_owned();
        }
        match self.nmt {
            Some(NmtState::Stopped) if self.stop_ordered => return "stopped by a command".to_owned(),
            Some(_) | None if self.fell_silent => {
                return format!("nothing comes from node {id}; check its power and cable");
            }
            Some(state @ (NmtState::Stopped | NmtState::PreOperational | NmtState::Initialising)) => {
                return format!("not operational: {}", state.word());
            }
            Some(NmtState::Operational) | None => {}
        }
        let stale: Vec<String> = self
            .status
            .pdos
            .iter()
            .filter(|pdo| pdo.stale)
            .map(|pdo| format!("TPDO{}", pdo.number))
            .collect();
        if !stale.is_empty() {
            return format!("does not come: {}", stale.join(", "));
        }
        let shared = |evidence| format!("two devices seem to share node id {id}: {evidence}");
        self.duplicate.map_or_else(String::new, shared)
    }
}

/// Whether guarding or heartbeat is configured (R-DET-031: a guard time of zero is no guarding), or a module is managed.
fn is_watched(def: &NodeDef) -> bool {
    let settings = match &def.protocol {
        Protocol::Canopen(settings) => settings,
        Protocol::Esd(module) => return module.management.is_some(),
    };
    match &settings.error_control {
        ErrorControl::Guarding(guarding) => !guarding.guard_time.is_zero(),
        ErrorControl::Heartbeat { .. } => true,
        ErrorControl::None => false,
    }
}

impl Gateway {
    /// Works out what readers and alarms are told of a node, from all that is known of it and of its bus.
    pub(super) fn refresh_node(&mut self, now: Now, index: NodeIndex) {
        let Some(def) = self.table.nodes.get(index.0) else { return };
        let bus_trouble = self.bus_trouble(def.bus);
        let undecided_until = self.undecided_until(now, def);
        let is_module = def.canopen().is_none();
        let Some(node) = self.nodes.get_mut(index.0) else { return };
        let status = &mut node.status;
        status.online = node.contact && node.lost.is_none() && !node.fell_silent && bus_trouble.is_none();
        status.nmt = node.nmt.filter(|_| status.online);
        status.supervised = status.online && node.supervised;
        node.status.reason = node.reason(def, bus_trouble.as_deref());
        node.status.may_be_absent = node.may_be_absent(def);
        self.dirty_nodes.mark(index.0);

        let owner = AlarmOwner::Node(index);
        // A node that never was there was not lost: that has an alarm of its own, which names other causes.
        let (lost, never_seen) = (node.lost.is_some() && node.ever_seen, node.never_seen && def.required);
        let boot_failed = node.contact && node.boot_trouble.is_some();
        let other_device = node.contact && matches!(node.boot_trouble, Some(BootTrouble::OtherDevice(_)));
        let start_failed = node.start_failed.is_some() || node.start_held_back || boot_failed;
        let (duplicate, foreign_guard) = (node.duplicate.is_some(), node.foreign_guard);
        self.raise(now, owner, BuiltIn::NodeLost, lost, undecided_until);
        self.raise(now, owner, BuiltIn::NodeNeverSeen, never_seen, undecided_until);
        self.conditions.set(now, owner, BuiltIn::IdentityMismatch, other_device);
        self.conditions.set(now, owner, BuiltIn::NotOperational, start_failed && !is_module);
        // A module is not started; all that can go wrong is how it is set.
        self.conditions.set(now, owner, BuiltIn::NotConfigured, boot_failed && is_module && !other_device);
        self.conditions.set(now, owner, BuiltIn::DuplicateNode, duplicate);
        self.conditions.set(now, owner, BuiltIn::ForeignGuardMaster, foreign_guard);
        let pdos = self.nodes.get(index.0).map_or(0, |node| node.watches.len());
        for pdo in 0..pdos {
            let Some(node) = self.nodes.get(index.0) else { continue };
            let stale = node.status.pdos.get(pdo).is_some_and(|status| status.stale);
            let held_until = node.watches.get(pdo).and_then(|watch| watch.held_until);
            let held_until = held_until.filter(|until| *until > now.instant);
            self.raise(now, owner, BuiltIn::PdoTimeout(pdo), stale, held_until);
        }
    }

    /// Sets a condition, but holds a new one back while the cause may turn out to be another: one cause, one alarm.
    /// A node of which guarding misses replies may be lost altogether, and a quiet bus may have no node left at all.
    fn raise(&mut self, now: Now, owner: AlarmOwner, condition: BuiltIn, holds: bool, held: Option<Instant>) {
        match held {
            Some(until) if holds && !self.conditions.is_set(owner, condition) => self.look_again_at(until),
            Some(_) | None => self.conditions.set(now, owner, condition, holds),
        }
    }

    pub(super) fn look_again_at(&mut self, at: Instant) {
        self.next_look = Some(self.next_look.map_or(at, |next| next.min(at)));
    }

    /// No data older than the timeout of its TPDO is usable, whatever the network believes of the node: it watches
    /// TPDOs only while they have to come, not while a node is lost, or was told to stop.
    pub(super) fn expire_data(&mut self, now: Now) {
        if self.next_expiry.is_none_or(|due| due > now.instant) {
            return;
        }
        self.next_expiry = None;
        for index in (0..self.nodes.len()).map(NodeIndex) {
            let pdos = self.table.nodes.get(index.0).map_or(0, |def| def.pdos().len());
            for pdo in (0..pdos).map(PdoIndex) {
                self.expire_pdo(now, index, pdo);
            }
        }
    }

    fn expire_pdo(&mut self, now: Now, index: NodeIndex, pdo: PdoIndex) {
        let Some(node) = self.nodes.get(index.0) else { return };
        match node.watches.get(pdo.0).and_then(|watch| watch.fresh_until) {
            Some(until) if until <= now.instant => {
                let lost = node.lost.is_some();
                let quality =
                    if lost { Quality::Bad(Reason::NodeLost) } else { Quality::Stale(Reason::PdoTimeout) };
                self.degrade(now, index, Some(pdo), quality);
                self.look_for_silence(now, index);
            }
            Some(until) => self.expire_at(until),
            None => {}
        }
    }

    /// A node that nothing watches but the time-outs of its TPDOs is there no longer than the last of them.
    pub(super) fn look_for_silence(&mut self, now: Now, index: NodeIndex) {
        let (Some(def), Some(node)) = (self.table.nodes.get(index.0), self.nodes.get_mut(index.0)) else {
            return;
        };
        let mut supervised =
            node.watches.iter().zip(&node.status.pdos).filter(|(watch, _)| watch.timeout.is_some());
        if !is_watched(def) && supervised.all(|(_, status)| !status.usable) {
            node.fell_silent = true;
            self.refresh_node(now, index);
        }
    }

    pub(super) fn expire_at(&mut self, at: Instant) {
        self.next_expiry = Some(self.next_expiry.map_or(at, |next| next.min(at)));
    }
}
