//! A simulated device: a `DetCon` on the bus, an engine behind it, a scenario that tells its story. Pure.

use std::collections::BTreeMap;
use std::fmt;
use std::time::Duration;

use super::control::{Control, Point};
use super::detcon::Detcon;
use super::engine::Engine;
use super::faults::Faults;
use super::scenario::{Player, Scenario};
use super::values::{StatusBit, Tpdo};
use crate::can::CanFrame;
use crate::canopen::{NmtState, NodeId};
use crate::time::{Instant, Now};

/// A device that is to be simulated.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct DevicePlan {
    /// Its node id.
    pub node: NodeId,
    /// What it is like and what happens to it.
    pub scenario: Scenario,
    /// Equal seeds behave alike.
    pub seed: u64,
    /// The story begins so long after power-on.
    pub story_after: Duration,
}

impl DevicePlan {
    /// A device whose story begins at once.
    #[must_use]
    pub fn new(node: NodeId, scenario: Scenario) -> Self {
        Self { node, scenario, seed: u64::from(node.get()), story_after: Duration::ZERO }
    }
}

/// A device with its engine and its story.
#[derive(Clone, Debug)]
pub struct SimulatedDevice {
    detcon: Detcon,
    engine: Engine,
    player: Player,
    overrides: BTreeMap<Point, u8>,
}

/// What an operator would see of a device.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Status {
    /// `None` = powered off.
    pub state: Option<NmtState>,
    /// A cylinder knocks.
    pub knocking: bool,
    /// The trip bit is set.
    pub trip: bool,
}

impl SimulatedDevice {
    /// Powers a device on at `now`.
    #[must_use]
    pub fn power_on(plan: &DevicePlan, now: Now) -> Self {
        let mut device = Self {
            detcon: Detcon::new(plan.node, plan.scenario.settings.clone()),
            engine: Engine::new(plan.scenario.cylinders, plan.seed, now.instant),
            player: Player::new(&plan.scenario, now.instant + plan.story_after),
            overrides: BTreeMap::new(),
        };
        device.detcon.power_on(now);
        device.show(now);
        device.handle_timeout(now);
        device
    }

    /// Its node id.
    #[must_use]
    pub fn node(&self) -> NodeId {
        self.detcon.node()
    }

    /// What an operator would see.
    #[must_use]
    pub fn status(&self) -> Status {
        Status {
            state: self.detcon.state(),
            knocking: self.detcon.values().is_knocking(),
            trip: self.detcon.values().status(StatusBit::Trip),
        }
    }

    /// Takes an order.
    pub fn handle_control(&mut self, now: Now, control: Control) {
        self.obey(now, control);
        self.show(now);
    }

    fn obey(&mut self, now: Now, control: Control) {
        match control {
            Control::Power(true) => self.detcon.power_on(now),
            Control::Power(false) => self.detcon.power_off(now),
            Control::Knock(channel, level) => self.engine.knock(channel, level),
            Control::SensorBad(channel, bad) => self.engine.break_sensor(channel, bad),
            Control::Trip(pulse) => self.engine.trip(now.instant, pulse),
            Control::Set(point, raw) => {
                self.overrides.insert(point, raw);
            }
            Control::Clear(point) => {
                self.overrides.remove(&point);
            }
            Control::ClearAll => {
                self.overrides.clear();
                self.engine.mend();
                self.detcon.update_faults(now, |faults| *faults = Faults::default());
            }
            Control::MuteGuarding(_)
            | Control::MutePdo(..)
            | Control::StuckToggle(_)
            | Control::WrongLength(..)
            | Control::SecondMaster(_)
            | Control::Duplicate(_)
            | Control::LateReplies(_)
            | Control::ReservedBits(_)
            | Control::BootLoop(_)
            | Control::RefuseStart(_) => {
                self.detcon.update_faults(now, |faults| switch_fault(faults, control));
            }
        }
    }

    /// Takes a frame that another participant sent.
    pub fn handle_frame(&mut self, now: Now, frame: &CanFrame) {
        self.handle_timeout(now);
        self.detcon.handle_frame(now, frame);
    }

    /// What became due. What happens at one moment is shown at once, in one frame.
    pub fn handle_timeout(&mut self, now: Now) {
        let mut changed = false;
        while let Some(control) = self.player.poll(now.instant) {
            self.obey(now, control);
            changed = true;
        }
        if self.engine.poll_timeout() <= now.instant {
            self.engine.handle_timeout(now.instant);
            changed = true;
        }
        if changed {
            self.show(now);
        }
        self.detcon.handle_timeout(now);
    }

    /// The next frame to send; call until `None`.
    pub fn poll_output(&mut self) -> Option<CanFrame> {
        self.detcon.poll_output()
    }

    /// When `handle_timeout` is to be called at the latest.
    #[must_use]
    pub fn poll_timeout(&self) -> Option<Instant> {
        let others = [self.player.poll_timeout(), self.detcon.poll_timeout()];
        others.into_iter().flatten().chain([self.engine.poll_timeout()]).min()
    }

    /// Shows the device what the engine does, but for the values that were set.
    fn show(&mut self, now: Now) {
        let mut values = self.engine.values();
        for (point, raw) in &self.overrides {
            point.write(&mut values, *raw);
        }
        self.detcon.update(now, |shown| *shown = values);
    }
}

/// Controls that are no faults change nothing.
fn switch_fault(faults: &mut Faults, control: Control) {
    match control {
        Control::MuteGuarding(on) => faults.mute_guarding = on,
        Control::MutePdo(Some(tpdo), on) => faults.set_mute(tpdo, on),
        Control::MutePdo(None, on) => {
            for tpdo in Tpdo::ALL {
                faults.set_mute(tpdo, on);
            }
        }
        Control::StuckToggle(on) => faults.stuck_toggle = on,
        Control::WrongLength(tpdo, dlc) => faults.set_length(tpdo, dlc),
        Control::SecondMaster(on) => faults.second_master = on,
        Control::Duplicate(on) => faults.duplicate = on,
        Control::LateReplies(delay) => faults.late_replies = delay,
        Control::ReservedBits(on) => faults.reserved_bits = on,
        Control::BootLoop(interval) => faults.boot_loop = interval,
        Control::RefuseStart(on) => faults.refuse_start = on,
        Control::Power(_)
        | Control::Knock(..)
        | Control::SensorBad(..)
        | Control::Trip(_)
        | Control::Set(..)
        | Control::Clear(_)
        | Control::ClearAll => {}
    }
}

impl fmt::Display for Status {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.state.map_or("off", NmtState::word))?;
        if self.knocking {
            f.write_str(", knocking")?;
        }
        if self.trip {
            f.write_str(", trip")?;
        }
        Ok(())
    }
}
