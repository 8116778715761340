//! esd modules: what becomes of what their network tells.
//!
//! Their serial lines are in [`lines`](super::lines).

use super::Gateway;
use super::node::{BootTrouble, Loss, Node};
use super::tags::CarrierIndex;
use crate::can::{BusIndex, CanFrame, DEFAULT_BIT_RATE};
use crate::canopen::{NmtState, Role};
use crate::esd::{CanStatus, ModuleEvent, ModuleIndex, NetworkOutput, NetworkSettings};
use crate::mapping::{AlarmOwner, BuiltIn, ModuleCarrier, ModuleValue, NodeDef, TagTable};
use crate::process_image::{NodeIndex, Quality, Value};
use crate::time::Now;

/// The modules of a bus, as their network has to know them; and the nodes that they are.
pub(super) fn settings(table: &TagTable, index: BusIndex) -> (NetworkSettings, Vec<NodeIndex>) {
    let def = table.buses.get(index.0);
    let esd = def.map(|bus| bus.esd.clone()).unwrap_or_default();
    let mut settings = NetworkSettings {
        passive: def.is_none_or(|bus| bus.role == Role::Passive),
        reply_id: esd.reply_id,
        reply_timeout: esd.reply_timeout,
        repetitions: esd.repetitions,
        bit_rate: def.map_or(DEFAULT_BIT_RATE, |bus| bus.bit_rate),
        modules: Vec::new(),
    };
    let mut nodes = Vec::new();
    for (place, node) in table.nodes.iter().enumerate().filter(|(_, node)| node.bus == index) {
        if let Some(module) = node.protocol.module() {
            settings.modules.push(module.clone());
            nodes.push(NodeIndex(place));
        }
    }
    (settings, nodes)
}

/// Why a module is not online, or not as it should be; empty when all is well.
pub(super) fn reason(node: &Node, def: &NodeDef) -> String {
    let Some(module) = def.protocol.module() else { return String::new() };
    let number = module.number;
    if node.never_seen || (node.lost.is_some() && !node.ever_seen) {
        return format!(
            "module {number} has not answered since the gateway started; possible causes: power or cable, another \
             module number or coding switch, another bit rate, another firmware"
        );
    }
    match (&node.boot_trouble, node.lost) {
        (Some(BootTrouble::OtherDevice(why)), _) if node.contact => return format!("left alone: {why}"),
        (_, Some(Loss::StuckToggle)) => {
            return format!("module {number} answers its watchdog with a toggle bit that does not change");
        }
        (_, Some(Loss::Silence)) => {
            return format!("module {number} does not answer; check its power and cable");
        }
        (Some(_) | None, None) => {}
    }
    if !node.contact {
        return format!("waiting for its {} sign of life", if node.ever_seen { "next" } else { "first" });
    }
    match (&node.boot_trouble, node.nmt) {
        (Some(BootTrouble::OtherDevice(why) | BootTrouble::Configuration(why)), _) => {
            format!("not as configured: {why}")
        }
        (Some(BootTrouble::NoAnswer), _) => format!("module {number} does not answer"),
        (None, Some(NmtState::Stopped)) => "suspended: nothing is passed on, on any of its lines".to_owned(),
        (None, Some(NmtState::PreOperational | NmtState::Initialising)) => "being configured".to_owned(),
        (None, Some(NmtState::Operational) | None) => String::new(),
    }
}

impl Gateway {
    /// Takes what the network of the modules of a bus has to say.
    pub(super) fn drain_modules(&mut self, now: Now, index: BusIndex) {
        while let Some(bus) = self.buses.get_mut(index.0)
            && let Some(output) = bus.modules.poll_output()
        {
            match output {
                NetworkOutput::Transmit(frame) => self.transmit(index, frame),
                NetworkOutput::Module(ModuleIndex(place), event) => {
                    if let Some(node) = bus.module_nodes.get(place).copied() {
                        self.module_event(now, node, event);
                    }
                }
                NetworkOutput::ForeignCommand(frame) => self.foreign_module_command(now, index, &frame),
            }
        }
    }

    fn foreign_module_command(&mut self, now: Now, index: BusIndex, frame: &CanFrame) {
        self.foreign_master(now, index);
        self.tell_bus(now, index, "foreign_module_command", |event| {
            event.text = format!("somebody else sends commands to esd modules: {frame}");
        });
    }

    fn module_event(&mut self, now: Now, index: NodeIndex, event: ModuleEvent) {
        let at = (now, index);
        match event {
            ModuleEvent::Frame => return self.frame_seen(at),
            ModuleEvent::Received { channel, chunk } => {
                return self.line_received(at, channel, chunk.bytes());
            }
            ModuleEvent::Message { channel, bytes, end } => {
                return self.line_message(at, channel, bytes, end);
            }
            ModuleEvent::Sent { channel, bytes } => return self.line_sent(at, channel, bytes),
            ModuleEvent::NotSent { channel, bytes } => return self.line_not_sent(at, channel, bytes),
            ModuleEvent::SendDone { channel, id, outcome } => {
                return self.send_done(at, channel, id, outcome);
            }
            ModuleEvent::Appeared => self.module_appeared(at),
            ModuleEvent::Lost => self.lost(at, false),
            ModuleEvent::NeverSeen => self.never_seen(at),
            ModuleEvent::Restarted => {
                self.restarted(at);
                self.change(index, |node| node.nmt = Some(NmtState::PreOperational));
                self.break_lines(at);
            }
            ModuleEvent::Kind(code) => self.show_own(at, ModuleValue::ModuleType, code),
            ModuleEvent::Switch(value) => self.show_own(at, ModuleValue::ActiveSwitch, value),
            ModuleEvent::Status(status) => self.module_status(at, status),
            ModuleEvent::WatchdogMiss { .. } => self.count(index, |counters| &mut counters.guard_misses),
            ModuleEvent::ToggleError => {
                self.count(index, |counters| &mut counters.toggle_errors);
                self.conditions.pulse(now, AlarmOwner::Node(index), BuiltIn::GuardToggle);
                self.tell(at, "toggle_error", |event| {
                    event.text = "an answer of its watchdog had the toggle bit of the one before".into();
                });
            }
            ModuleEvent::Configured { written, stored } => self.module_configured(at, written, stored),
            ModuleEvent::NotConfigured(why) => {
                self.module_trouble(at, "module_not_configured", BootTrouble::Configuration(why));
            }
            ModuleEvent::OtherModule(why) => {
                self.module_trouble(at, "identity_mismatch", BootTrouble::OtherDevice(why));
            }
            ModuleEvent::CanErrorStays => self.tell(at, "can_error_stays", |event| {
                event.text =
                    "its CAN error bit stays set though it was cleared: its controller still sees errors"
                        .into();
            }),
        }
        self.refresh_node(now, index);
        self.refresh_lines(at);
        self.show_module_lines(at);
    }

    fn module_appeared(&mut self, at: (Now, NodeIndex)) {
        let managed = self.table.nodes.get(at.1.0).and_then(|def| def.protocol.module());
        let managed = managed.is_some_and(|module| module.management.is_some());
        let state = if managed { NmtState::PreOperational } else { NmtState::Operational };
        self.change(at.1, |node| node.nmt = Some(state));
        if self.nodes.get(at.1.0).is_some_and(|node| node.lost.is_some()) {
            self.recovered(at);
        } else {
            self.seen(at);
        }
    }

    fn module_configured(&mut self, at: (Now, NodeIndex), written: usize, stored: bool) {
        self.change(at.1, |node| {
            node.boot_trouble = None;
            node.supervised = true;
            node.status.identity_mismatch = false;
            if node.nmt != Some(NmtState::Stopped) {
                node.nmt = Some(NmtState::Operational);
            }
        });
        self.tell(at, "module_configured", |event| {
            event.value = u64::try_from(written).ok().map(Value::Unsigned);
            event.text = match (written, stored) {
                (0, _) => "the module has every parameter as configured; nothing was written".to_owned(),
                (_, true) => format!("{written} parameters were written and stored in the module"),
                (_, false) => {
                    format!("{written} parameters were written; a reset of the module forgets them")
                }
            };
        });
    }

    fn module_trouble(&mut self, at: (Now, NodeIndex), name: &'static str, trouble: BootTrouble) {
        let why = match &trouble {
            BootTrouble::OtherDevice(why) | BootTrouble::Configuration(why) => why.clone(),
            BootTrouble::NoAnswer => String::new(),
        };
        let is_other = matches!(trouble, BootTrouble::OtherDevice(_));
        let mut is_new = false;
        self.change(at.1, |node| node.status.identity_mismatch = is_other);
        self.change(at.1, |node| is_new = node.boot_trouble.replace(trouble.clone()) != Some(trouble));
        if is_new {
            self.tell(at, name, |event| event.text = why);
        }
    }

    fn module_status(&mut self, at: (Now, NodeIndex), status: CanStatus) {
        let idle = status.is_suspended() || !status.runs();
        let mut before = None;
        self.change(at.1, |node| {
            before = node.nmt;
            node.nmt = match node.nmt {
                _ if idle => Some(NmtState::Stopped),
                Some(NmtState::Stopped) if node.supervised => Some(NmtState::Operational),
                Some(NmtState::Stopped) => Some(NmtState::PreOperational),
                other => other,
            };
        });
        if idle && before != Some(NmtState::Stopped) {
            self.tell(at, "module_suspended", |event| {
                event.text =
                    "the module is suspended or stopped: nothing is passed on, on any of its lines".into();
            });
        } else if !idle && before == Some(NmtState::Stopped) {
            self.tell(at, "module_continued", |_| ());
        }
        self.show_own(at, ModuleValue::Status, status.0);
    }

    /// What a module tells of itself, to its tag.
    fn show_own(&mut self, at: (Now, NodeIndex), value: ModuleValue, number: u8) {
        let (Some(def), Some(node)) = (self.table.nodes.get(at.1.0), self.nodes.get(at.1.0)) else { return };
        let quality = node.quality_of_new_data(self.comes_too_late(def.bus), false);
        self.show_module(at, ModuleCarrier::Module(value), number.into(), quality);
    }

    /// A value of a module, to its tag.
    pub(super) fn show_module(
        &mut self,
        at: (Now, NodeIndex),
        value: ModuleCarrier,
        number: u64,
        quality: Quality,
    ) {
        let (now, index) = at;
        let Some(def) = self.table.nodes.get(index.0) else { return };
        let Some(carrier) = CarrierIndex::of_module(def, value) else { return };
        self.tags.apply(&self.table, now, (index, carrier), &number.to_le_bytes(), quality);
        self.dirty_nodes.mark(index.0);
    }

    /// The gateway stops: modules that would miss it are told so (R-ESD-088). Everything else stays as it is.
    pub fn handle_stop(&mut self, now: Now) {
        for index in (0..self.buses.len()).map(BusIndex) {
            if let Some(bus) = self.buses.get_mut(index.0) {
                bus.modules.handle_stop(now);
            }
            self.drain_modules(now, index);
        }
        self.settle(now);
    }
}
