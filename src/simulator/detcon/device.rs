//! A simulated device: a `DetCon` on the bus, an engine behind it, a scenario that tells its story. Pure.

use std::collections::BTreeMap;

use super::super::device::{Device, DeviceNumber, DevicePlan, Status};
use super::super::scenario::Player;
use super::super::slave::{SlaveFaults, SlaveOrder};
use super::control::{self, Control, Point};
use super::engine::Engine;
use super::faults::Faults;
use super::protocol::{Detcon, DetconSettings};
use super::values::{StatusBit, Tpdo};
use crate::can::{CanFrame, CanId};
use crate::canopen::cob_id;
use crate::time::{Instant, Now};

/// A device with its engine and its story.
#[derive(Clone, Debug)]
pub struct SimulatedDetcon {
    settings: DetconSettings,
    detcon: Detcon,
    engine: Engine,
    player: Player,
    overrides: BTreeMap<Point, u8>,
}

impl SimulatedDetcon {
    /// Powers a device on at `now`.
    #[must_use]
    pub fn power_on(plan: &DevicePlan, settings: &DetconSettings, now: Now) -> Self {
        let mut device = Self {
            settings: settings.clone(),
            detcon: Detcon::new(plan.node.node_id(), settings.clone()),
            engine: Engine::new(settings.cylinders, plan.seed, now.instant),
            player: Player::new(&plan.scenario, now.instant + plan.story_after),
            overrides: BTreeMap::new(),
        };
        device.detcon.power_on(now);
        device.show(now);
        device.handle_timeout(now);
        device
    }

    fn obey(&mut self, now: Now, control: Control) {
        match control {
            Control::Slave(SlaveOrder::Power(true)) => self.detcon.power_on(now),
            Control::Slave(SlaveOrder::Power(false)) => self.detcon.power_off(now),
            Control::Slave(order) => self.detcon.update_slave_faults(now, |faults| faults.switch(order)),
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
                self.detcon.update_slave_faults(now, |faults| *faults = SlaveFaults::default());
            }
            Control::MuteGuarding(_)
            | Control::MutePdo(..)
            | Control::StuckToggle(_)
            | Control::WrongLength(..)
            | Control::LateReplies(_)
            | Control::ReservedBits(_) => {
                self.detcon.update_faults(now, |faults| switch_fault(faults, control));
            }
        }
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

impl Device for SimulatedDetcon {
    fn node(&self) -> DeviceNumber {
        self.detcon.node().into()
    }

    fn status(&self) -> Status {
        let values = self.detcon.values();
        let remarks = [(values.is_knocking(), "knocking"), (values.status(StatusBit::Trip), "trip")];
        let remarks = remarks.into_iter().filter(|(holds, _)| *holds).map(|(_, remark)| remark.to_owned());
        Status { state: self.detcon.state(), remarks: remarks.collect() }
    }

    fn hears(&self, id: CanId) -> bool {
        id == cob_id::NMT || id == cob_id::error_control(self.detcon.node())
    }

    fn handle_frame(&mut self, now: Now, frame: &CanFrame) {
        self.handle_timeout(now);
        self.detcon.handle_frame(now, frame);
    }

    fn handle_line(&mut self, now: Now, words: &[&str]) -> Result<(), String> {
        let control = control::check(&self.settings, words)?;
        self.obey(now, control);
        self.show(now);
        Ok(())
    }

    /// What happens at one moment is shown at once, in one frame.
    fn handle_timeout(&mut self, now: Now) {
        let mut changed = false;
        while let Some(order) = self.player.poll(now.instant) {
            let words: Vec<&str> = order.split_whitespace().collect();
            // A scenario with an order that is not taken is refused when it is read.
            if let Ok(control) = control::check(&self.settings, &words) {
                self.obey(now, control);
                changed = true;
            }
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

    fn poll_output(&mut self) -> Option<CanFrame> {
        self.detcon.poll_output()
    }

    fn poll_timeout(&self) -> Option<Instant> {
        let others = [self.player.poll_timeout(), self.detcon.poll_timeout()];
        others.into_iter().flatten().chain([self.engine.poll_timeout()]).min()
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
        Control::LateReplies(delay) => faults.late_replies = delay,
        Control::ReservedBits(on) => faults.reserved_bits = on,
        Control::Slave(_)
        | Control::Knock(..)
        | Control::SensorBad(..)
        | Control::Trip(_)
        | Control::Set(..)
        | Control::Clear(_)
        | Control::ClearAll => {}
    }
}
