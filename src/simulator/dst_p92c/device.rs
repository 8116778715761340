//! A simulated pressure transmitter: a DST P92C on the bus, a plant at its sensors, a scenario that tells its story. Pure.

use std::time::Duration;

use super::super::device::{Device, DeviceNumber, DevicePlan, Status};
use super::super::scenario::Player;
use super::super::slave::{SlaveFaults, SlaveOrder};
use super::action::{self, Action, Voice};
use super::faults::Faults;
use super::hydraulics::Hydraulics;
use super::protocol::DstP92c;
use super::services::LSS_REQUEST;
use super::settings::DstSettings;
use crate::can::{CanFrame, CanId};
use crate::canopen::cob_id;
use crate::time::{Instant, Now};

/// A device with its plant and its story.
#[derive(Clone, Debug)]
pub struct SimulatedDst {
    dst: DstP92c,
    plant: Hydraulics,
    player: Player,
}

impl SimulatedDst {
    /// Powers a device on at `now`.
    #[must_use]
    pub fn power_on(plan: &DevicePlan, settings: &DstSettings, now: Now) -> Self {
        let mut device = Self {
            dst: DstP92c::new(plan.node.node_id(), settings.clone()),
            plant: Hydraulics::new(settings, plan.seed, now.instant),
            player: Player::new(&plan.scenario, now.instant + plan.story_after),
        };
        device.show(now);
        device.dst.power_on(now);
        device.handle_timeout(now);
        device
    }

    /// The device on the bus.
    #[must_use]
    pub fn dst(&self) -> &DstP92c {
        &self.dst
    }

    fn obey(&mut self, now: Now, action: Action) {
        match action {
            Action::Slave(SlaveOrder::Power(true)) => self.dst.power_on(now),
            Action::Slave(SlaveOrder::Power(false)) => self.dst.power_off(now),
            Action::Slave(order) => self.dst.update_faults(now, |_, slave| slave.switch(order)),
            Action::PowerCycle => {
                self.dst.power_off(now);
                self.dst.power_on(now);
            }
            Action::Pressure(bar, ramp) => self.plant.order_pressure(now.instant, bar, ramp),
            Action::Temperature(celsius) => self.plant.order_temperature(now.instant, celsius),
            Action::Abort(key, code) => self.dst.objects.set_abort(key, code),
            Action::Set(key, raw) => self.dst.set_object(now, key, raw),
            Action::Bus(kbit) => self.dst.set_bus(now, kbit),
            Action::ClearAll => {
                self.plant.order_pressure(now.instant, None, Duration::ZERO);
                self.plant.order_temperature(now.instant, None);
                self.dst.objects.clear();
                self.dst.update_faults(now, |faults, slave| {
                    *faults = Faults::default();
                    *slave = SlaveFaults::default();
                });
            }
            Action::SensorBad(..)
            | Action::Emcy(_)
            | Action::Mute(..)
            | Action::LateSdo(_)
            | Action::BootError(_) => {
                self.dst.update_faults(now, |faults, _| switch_fault(faults, action));
            }
        }
        self.show(now);
    }

    /// Shows the device what the plant does.
    fn show(&mut self, now: Now) {
        self.dst.update(now, self.plant.reading());
    }
}

/// Actions that are no faults change nothing.
fn switch_fault(faults: &mut Faults, action: Action) {
    match action {
        Action::SensorBad(sensor, bad) => {
            if let Some(broken) = faults.broken.get_mut(usize::from(sensor.saturating_sub(1))) {
                *broken = bad;
            }
        }
        Action::Emcy(code) => faults.error = code,
        Action::Mute(Voice::Sdo, on) => faults.mute_sdo = on,
        Action::Mute(Voice::Heartbeat, on) => faults.mute_heartbeat = on,
        Action::Mute(Voice::Emcy, on) => faults.mute_emcy = on,
        Action::Mute(Voice::Pdo, on) => faults.mute_pdo = on,
        Action::LateSdo(delay) => faults.late_sdo = delay,
        Action::BootError(on) => faults.boot_error = on,
        Action::Slave(_)
        | Action::PowerCycle
        | Action::Pressure(..)
        | Action::Temperature(_)
        | Action::Abort(..)
        | Action::Set(..)
        | Action::Bus(_)
        | Action::ClearAll => {}
    }
}

impl Device for SimulatedDst {
    fn node(&self) -> DeviceNumber {
        self.dst.node().into()
    }

    fn status(&self) -> Status {
        let (state, error) = (self.dst.state(), self.dst.error());
        let mut remarks = Vec::new();
        if state.is_some() && error != 0 {
            remarks.push(format!("error {error:04X}"));
        }
        if self.dst.lss.is_in_configuration() {
            remarks.push("lss configuration".to_owned());
        }
        if !self.dst.is_on_the_air() {
            remarks.push("not at the bit rate of the bus".to_owned());
        }
        Status { state, remarks }
    }

    fn hears(&self, id: CanId) -> bool {
        id == cob_id::NMT || id == LSS_REQUEST || id == self.dst.sdo_request() || Some(id) == self.dst.sync()
    }

    fn handle_frame(&mut self, now: Now, frame: &CanFrame) {
        self.handle_timeout(now);
        self.dst.handle_frame(now, frame);
    }

    fn handle_line(&mut self, now: Now, words: &[&str]) -> Result<(), String> {
        let action = action::parse(words)?;
        self.obey(now, action);
        Ok(())
    }

    fn handle_timeout(&mut self, now: Now) {
        while let Some(order) = self.player.poll(now.instant) {
            let words: Vec<&str> = order.split_whitespace().collect();
            // A scenario with an order that is not taken is refused when it is read.
            if let Ok(action) = action::parse(&words) {
                self.obey(now, action);
            }
        }
        if self.plant.poll_timeout() <= now.instant {
            self.plant.handle_timeout(now.instant);
            self.show(now);
        }
        self.dst.handle_timeout(now);
    }

    fn poll_output(&mut self) -> Option<CanFrame> {
        self.dst.poll_output()
    }

    fn poll_timeout(&self) -> Option<Instant> {
        let others = [self.player.poll_timeout(), self.dst.poll_timeout()];
        others.into_iter().flatten().chain([self.plant.poll_timeout()]).min()
    }
}
