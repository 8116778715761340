//! A simulated esd module: the module on the bus, what is at its lines, a scenario that tells its story. Pure.

use super::super::device::{Device, DeviceNumber, DevicePlan, Status};
use super::super::scenario::Player;
use super::action::{self, Action, Voice};
use super::channel::Channel;
use super::faults::Faults;
use super::line::LineKind;
use super::module::Module;
use super::settings::SioSettings;
use super::start::Reset;
use crate::can::{CanFrame, CanId};
use crate::canopen::NmtState;
use crate::time::{Instant, Now};

/// RS-232 goes up to so many bit/s (R-ESD-009).
const RS_232_LIMIT: u32 = 38_400;

/// A module with its lines and its story.
#[derive(Clone, Debug)]
pub struct SimulatedSio {
    number: DeviceNumber,
    module: Module,
    player: Player,
    /// The moment of the last call.
    now: Instant,
}

impl SimulatedSio {
    /// Powers a module on at `now`; its number is the value of its coding switches.
    #[must_use]
    pub fn power_on(plan: &DevicePlan, settings: &SioSettings, now: Now) -> Self {
        let mut device = Self {
            number: plan.node,
            module: Module::new(settings, plan.node.get(), now.instant),
            player: Player::new(&plan.scenario, now.instant + plan.story_after),
            now: now.instant,
        };
        device.module.power_on(now.instant);
        device.handle_timeout(now);
        device
    }

    /// The module.
    #[must_use]
    pub fn module(&self) -> &Module {
        &self.module
    }

    fn obey(&mut self, now: Instant, action: Action) {
        let module = &mut self.module;
        match action {
            Action::Power(true) => module.power_on(now),
            Action::Power(false) => module.power_off(now),
            Action::PowerCycle => {
                module.power_off(now);
                module.power_on(now);
            }
            Action::Reset => module.reset(now, Reset::Plain),
            Action::Switch(value) => module.turn_switches(now, value),
            Action::Send(channel, bytes) => self.with(channel, |own| own.say(now, &bytes)),
            Action::Cts(channel, on) => self.with(channel, |own| own.set_cts(now, on)),
            Action::Weight(channel, kg) => self.with(channel, |own| own.line().weigh(kg)),
            Action::Error => module.note_error(),
            Action::EepromError => module.spoil_eeprom(),
            Action::Bus(kbit) => module.set_bus(now, kbit),
            Action::ClearAll => {
                module.set_faults(now, Faults::default());
                for channel in 1..=module.settings.model.channels() {
                    self.with(channel, |own| own.set_cts(now, true));
                }
            }
            Action::Mute(..) | Action::ErrorStands(_) | Action::Unplug(_) | Action::StuckToggle(_) => {
                let mut faults = module.faults();
                switch_fault(&mut faults, &action);
                module.set_faults(now, faults);
            }
        }
    }

    /// Does something with a channel, from 1.
    fn with(&mut self, channel: u8, act: impl FnOnce(&mut Channel)) {
        if let Some(own) = usize::from(channel).checked_sub(1).and_then(|place| self.module.channel(place)) {
            act(own);
        }
    }

    fn remarks(&self) -> Vec<String> {
        let module = &self.module;
        let mut remarks = Vec::new();
        let mut remark = |holds: bool, text: &str| {
            if holds {
                remarks.push(text.to_owned());
            }
        };
        let on = module.is_powered();
        remark(on && module.new_on_bus, "new on bus");
        remark(on && module.can_error, "can error");
        remark(on && module.watchdog.asked.is_some(), "guarded");
        remark(on && module.is_at_zero(), "coding switches at 00");
        remark(module.is_overwriting(), "overwriting its eeprom");
        remark(module.faults().unplugged, "unplugged");
        remark(on && !module.is_at_bus_rate(), "not at the bit rate of the bus");
        for (number, channel) in (1..).zip(module.channels()) {
            let serial = channel.serial();
            if serial.receive.max(serial.send) > RS_232_LIMIT {
                remarks.push(format!("channel {number} too fast for RS-232"));
            }
        }
        for (number, (to_can, to_line)) in (1..).zip(module.told_overflows()) {
            for (lost, to) in [(to_can, "can"), (to_line, "line")] {
                if *lost > 0 {
                    remarks.push(format!("channel {number} to {to} overflow {lost}"));
                }
            }
        }
        remarks
    }
}

/// Actions that are no faults change nothing.
fn switch_fault(faults: &mut Faults, action: &Action) {
    match *action {
        Action::Mute(voice, on) => {
            for (own, mute) in [
                (Voice::Replies, &mut faults.mute_replies),
                (Voice::Watchdog, &mut faults.mute_watchdog),
                (Voice::Data, &mut faults.mute_data),
            ] {
                if voice.is_none_or(|voice| voice == own) {
                    *mute = on;
                }
            }
        }
        Action::ErrorStands(on) => faults.error_stands = on,
        Action::Unplug(on) => faults.unplugged = on,
        Action::StuckToggle(on) => faults.stuck_toggle = on,
        Action::Power(_)
        | Action::PowerCycle
        | Action::Reset
        | Action::Switch(_)
        | Action::Send(..)
        | Action::Cts(..)
        | Action::Weight(..)
        | Action::Error
        | Action::EepromError
        | Action::Bus(_)
        | Action::ClearAll => {}
    }
}

impl Device for SimulatedSio {
    fn node(&self) -> DeviceNumber {
        self.number
    }

    fn name(&self) -> String {
        format!("module {:#04X}", self.number.get())
    }

    /// In the words of NMT, which the module does not have: initialising until it may send, stopped while suspended.
    fn status(&self) -> Status {
        let state = if self.module.is_silent(self.now) {
            NmtState::Initialising
        } else if self.module.suspended {
            NmtState::Stopped
        } else {
            NmtState::Operational
        };
        Status { state: self.module.is_powered().then_some(state), remarks: self.remarks() }
    }

    fn hears(&self, id: CanId) -> bool {
        self.module.hears(id)
    }

    fn handle_frame(&mut self, now: Now, frame: &CanFrame) {
        self.handle_timeout(now);
        self.module.handle_frame(now.instant, frame);
    }

    fn handle_line(&mut self, now: Now, words: &[&str]) -> Result<(), String> {
        let action = action::check(&self.module.settings, words)?;
        self.handle_timeout(now);
        self.obey(now.instant, action);
        Ok(())
    }

    fn handle_timeout(&mut self, now: Now) {
        self.now = now.instant;
        while let Some(order) = self.player.poll(now.instant) {
            let words: Vec<&str> = order.split_whitespace().collect();
            // A scenario with an order that is not taken is refused when it is read.
            if let Ok(action) = action::check(&self.module.settings, &words) {
                self.module.handle_timeout(now.instant);
                self.obey(now.instant, action);
            }
        }
        self.module.handle_timeout(now.instant);
    }

    fn poll_output(&mut self) -> Option<CanFrame> {
        self.module.poll_output()
    }

    fn poll_timeout(&self) -> Option<Instant> {
        // The end of the silence is told.
        let silence = self.module.silent_until();
        let silence = Some(silence).filter(|until| self.module.is_powered() && *until > self.now);
        [self.player.poll_timeout(), self.module.poll_timeout(), silence].into_iter().flatten().min()
    }

    fn serial_room(&self, channel: u8) -> usize {
        let place = usize::from(channel).checked_sub(1);
        let own = place.and_then(|place| self.module.channels().get(place));
        own.filter(|own| own.line_kind() == LineKind::External).map_or(0, Channel::room)
    }

    fn handle_serial(&mut self, now: Now, channel: u8, bytes: &[u8]) {
        self.handle_timeout(now);
        self.with(channel, |own| own.say(now.instant, bytes));
    }

    fn poll_serial(&mut self) -> Option<(u8, Vec<u8>)> {
        (1..=self.module.settings.model.channels()).find_map(|channel| {
            let own = self.module.channel(usize::from(channel) - 1)?;
            Some((channel, own.take_outside())).filter(|(_, bytes)| !bytes.is_empty())
        })
    }
}
