//! Which frames a table allows, and why: one function for each kind of node and for what all have in common.

use std::time::Duration;

use super::{AllowedFrame, Shape};
use crate::can::{BusIndex, CanFrame, CanId};
use crate::canopen::sdo::request_id;
use crate::canopen::{
    ErrorControl, NmtRequest, NmtState, NodeSettings, Role, RpdoSettings, RpdoTrigger, cob_id,
};
use crate::esd::{
    BUS_PERCENT, INIT_ID, InitCommand, ManagementSettings, ModuleSettings, Order, SerialBits, Setting,
    WatchdogMode, WatchdogSettings, allowed_settings,
};
use crate::mapping::{BusDef, TagTable};
use crate::process_image::{FrameKind, NodeIndex};

const FOR_A_COMMAND: &str = "once for each command";

/// The list of one table.
pub(super) fn frames(table: &TagTable) -> Vec<AllowedFrame> {
    let mut list = List::default();
    for (place, bus) in table.buses.iter().enumerate() {
        if bus.role == Role::Passive {
            continue;
        }
        list.bus = BusIndex(place);
        list.node = None;
        list.of_bus(bus);
        for (node, def) in table.nodes.iter().enumerate().filter(|(_, node)| node.bus.0 == place) {
            list.node = Some(NodeIndex(node));
            if let Some(settings) = def.canopen() {
                list.of_node(settings);
            }
            if let Some(settings) = def.protocol.module() {
                list.of_module(bus, settings);
            }
        }
    }
    list.frames
}

#[derive(Default)]
struct List {
    frames: Vec<AllowedFrame>,
    bus: BusIndex,
    node: Option<NodeIndex>,
}

impl List {
    fn add(&mut self, kind: FrameKind, id: CanId, shape: Shape, why: impl Into<String>, at_most: String) {
        let (bus, node, why) = (self.bus, self.node, why.into());
        self.frames.push(AllowedFrame { bus, id, kind, node, shape, why, at_most });
    }

    fn exactly(&mut self, kind: FrameKind, frame: CanFrame, why: impl Into<String>, at_most: String) {
        self.add(kind, frame.id(), Shape::Exactly(frame), why, at_most);
    }

    /// What goes to everybody.
    fn of_bus(&mut self, bus: &BusDef) {
        if bus.start_broadcast {
            let frame = NmtRequest::Start.frame(None);
            let often = "once while nodes wait for a start, then after their `retry`".to_owned();
            self.exactly(FrameKind::NmtStart, frame, "`start_broadcast`", often);
        }
        if let Some((sync, period)) =
            bus.sync.filter(|sync| sync.produced).and_then(|sync| Some((sync, sync.period?)))
        {
            let shape = sync.overflow.map_or(Shape::Bytes(0, 0), Shape::Counter);
            self.add(FrameKind::Sync, sync.cob_id, shape, "[bus.NAME.sync]", every(period));
        }
        if let Some(time) = bus.time {
            self.add(FrameKind::Time, time.cob_id, Shape::Bytes(6, 6), "[bus.NAME.time]", every(time.period));
        }
        if let Some(own) = bus.own_heartbeat
            && let Some(frame) =
                CanFrame::data_frame(cob_id::error_control(own.node), &[NmtState::Operational.code()])
        {
            let why = "the gateway's own heartbeat is configured";
            self.exactly(FrameKind::Heartbeat, frame, why, every(own.period));
        }
    }

    fn of_node(&mut self, node: &NodeSettings) {
        self.nmt(node);
        if let ErrorControl::Guarding(guarding) = &node.error_control
            && let Some(frame) = CanFrame::remote_frame(cob_id::error_control(node.id), guarding.rtr_dlc)
            && !guarding.guard_time.is_zero()
        {
            let often = every(guarding.guard_time) + ", and after a boot-up";
            self.exactly(FrameKind::GuardRequest, frame, "the node is guarded", often);
        }
        if node.sdo.is_some() {
            let mut why = Vec::new();
            if !node.boot.steps.is_empty() {
                why.push("it is checked and configured before it is started");
            }
            if !node.polls.is_empty() {
                why.push("objects are polled");
            }
            why.push("by a command");
            let often = match node.polls.iter().map(|poll| poll.period).min() {
                Some(period) => format!("one transfer at a time; polls not before {} ms", period.as_millis()),
                None => "one transfer at a time".to_owned(),
            };
            self.add(FrameKind::SdoRequest, request_id(node.id), Shape::Bytes(8, 8), why.join("; "), often);
        }
        for rpdo in &node.rpdos {
            let shape = Shape::Bytes(rpdo.length, rpdo.length);
            let why = format!("`outputs = true`, RPDO {}", rpdo.number);
            self.add(FrameKind::Rpdo, rpdo.cob_id, shape, why, rpdo_often(rpdo));
        }
    }

    fn nmt(&mut self, node: &NodeSettings) {
        let command = || FOR_A_COMMAND.to_owned();
        let configures = node.sdo.is_some() && !node.boot.steps.is_empty();
        let id = Some(node.id);
        let (why, often) = if node.start.auto_start {
            let often =
                format!("once in {} ms until it runs, or {}", node.start.retry.as_millis(), command());
            ("`auto_start`, or by a command", often)
        } else if configures && node.boot.self_starting {
            ("given back to itself when it is configured, or by a command", "once for each boot".to_owned())
        } else {
            ("by a command", command())
        };
        self.exactly(FrameKind::NmtStart, NmtRequest::Start.frame(id), why, often);
        let (why, often) = if configures {
            ("before it is configured while it runs, or by a command", "once for each boot".to_owned())
        } else {
            ("by a command", command())
        };
        let enter = NmtRequest::EnterPreOperational.frame(id);
        self.exactly(FrameKind::NmtPreOperational, enter, why, often);
        self.exactly(FrameKind::NmtStop, NmtRequest::Stop.frame(id), "by a command", command());
        let (why, often) = if node.start.reset_on_recovery {
            ("`reset_on_recovery`, or by a command", "once each time that it comes back".to_owned())
        } else {
            ("by a command", command())
        };
        self.exactly(FrameKind::NmtReset, NmtRequest::ResetNode.frame(id), why, often);
        let frame = NmtRequest::ResetCommunication.frame(id);
        self.exactly(FrameKind::NmtReset, frame, "by a command", command());
    }

    fn of_module(&mut self, bus: &BusDef, module: &ModuleSettings) {
        for channel in &module.channels {
            let why = format!("bytes for serial line {}", channel.number);
            let often = format!("at the pace of the line; {BUS_PERCENT} % of the bus");
            self.add(FrameKind::EsdData, channel.rx_id, Shape::Bytes(1, 8), why, often);
        }
        let (Some(management), Some(CanId::Standard(reply))) = (&module.management, bus.esd.reply_id) else {
            return;
        };
        let often = format!("one at a time; its status {}", every(management.status_period));
        let question = Shape::Question(module.number, reply);
        self.add(FrameKind::EsdRequest, INIT_ID, question, "the module is managed", often);
        self.settings(module, management);
        if let Some(watchdog) = management.watchdog {
            self.watchdog(module, watchdog);
        }
    }

    fn settings(&mut self, module: &ModuleSettings, management: &ManagementSettings) {
        for (setting, bits) in allowed_settings(management, &module.channels) {
            let frame = InitCommand::Set { module: module.number, setting }.frame();
            let why = match setting {
                Setting::ClearStatus => "a CAN error or a restart that it told of was noted",
                Setting::Store => "`store`",
                Setting::WatchdogTime { millis: 0, .. } => {
                    "its watchdog was set going, and the gateway stops or it is another module"
                }
                Setting::WatchdogId(_) | Setting::WatchdogTime { .. } => "its watchdog is used",
                Setting::TxId(..)
                | Setting::RxId(..)
                | Setting::Parameter(..)
                | Setting::TxActivateTime(..)
                | Setting::Number(_)
                | Setting::BitRate(_) => "`configure`, where it is found otherwise",
            };
            let often = "once for each round".to_owned();
            if bits == SerialBits::ALL {
                self.exactly(FrameKind::EsdSetting, frame, why, often);
            } else {
                self.add(FrameKind::EsdSetting, INIT_ID, Shape::Bits(frame, bits.0), why, often);
            }
        }
    }

    fn watchdog(&mut self, module: &ModuleSettings, watchdog: WatchdogSettings) {
        let order = InitCommand::Supervisor { module: Some(module.number), order: Order::Watchdog };
        let frame = match watchdog.mode {
            WatchdogMode::Remote => CanFrame::remote_frame(watchdog.id, 1),
            WatchdogMode::Command => Some(order.frame()),
        };
        if let Some(frame) = frame {
            self.exactly(FrameKind::EsdWatchdog, frame, "its watchdog is used", every(watchdog.time));
        }
    }
}

fn every(period: Duration) -> String {
    format!("every {} ms", period.as_millis())
}

fn rpdo_often(rpdo: &RpdoSettings) -> String {
    let often = match rpdo.trigger {
        RpdoTrigger::Sync(0) => "after a SYNC, when it changed".to_owned(),
        RpdoTrigger::Sync(1) => "after each SYNC".to_owned(),
        RpdoTrigger::Sync(syncs) => format!("after every {syncs} SYNCs"),
        RpdoTrigger::Event => {
            let refresh = rpdo.refresh.map(|refresh| format!(", and {}", every(refresh)));
            "when it changes".to_owned() + &refresh.unwrap_or_default()
        }
    };
    if rpdo.inhibit.is_zero() {
        often
    } else {
        format!("{often}; not before {} µs", rpdo.inhibit.as_micros())
    }
}
