//! How an esd module starts: power, resets, the EEPROM, and the coding switches (R-ESD-105 to R-ESD-109). Pure.

use std::time::Duration;

use super::module::{Module, Watchdog};
use super::parameters::Parameters;
use super::settings::SioSettings;
use crate::time::Instant;

/// Bit rate from the factory, as registers and as an index (R-ESD-003).
const FACTORY_BIT_RATE: ([u8; 2], [u8; 2]) = ([0x03, 0x1C], [0, 7]);
/// How long the EEPROM takes to be overwritten when the coding switches leave 00 (R-ESD-107).
pub const OVERWRITE_TIME: Duration = Duration::from_secs(10);

/// Why a module starts (R-ESD-105, R-ESD-109).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Reset {
    /// Power, a command, or its watchdog.
    Plain,
    /// With defaults, which replace what was stored.
    Defaults,
}

/// What it remembers without power.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Eeprom {
    /// What is in it can be read.
    pub ok: bool,
    /// Stored module number; 0 = defaults.
    pub number: u8,
    pub parameters: Parameters,
    pub bit_rate: [u8; 2],
}

/// The bit rate from the factory, in the form in which it is set.
pub(super) fn factory_bit_rate(settings: &SioSettings) -> [u8; 2] {
    let (registers, index) = FACTORY_BIT_RATE;
    if settings.bit_rate_by_index { index } else { registers }
}

impl Module {
    /// Switches the power on; no effect when it is.
    pub fn power_on(&mut self, now: Instant) {
        if !self.powered {
            self.powered = true;
            self.reset(now, Reset::Plain);
        }
    }

    /// Silence at once; what is not stored is lost.
    pub fn power_off(&mut self, now: Instant) {
        self.powered = false;
        self.overwritten_at = None;
        self.go_silent(now);
        self.outputs.clear();
        self.open(now);
    }

    fn go_silent(&mut self, now: Instant) {
        self.replies.clear();
        self.watchdog = Watchdog::default();
        for channel in &mut self.channels {
            channel.clear(now);
        }
    }

    /// Starts anew by the start table (R-ESD-106).
    pub fn reset(&mut self, now: Instant, reset: Reset) {
        if !self.powered {
            return;
        }
        if reset == Reset::Defaults {
            self.overwrite();
        }
        self.at_zero = self.switch == 0;
        if self.at_zero || !self.eeprom.ok {
            self.eeprom.number = 0;
        }
        if !self.eeprom.ok {
            self.eeprom.bit_rate = factory_bit_rate(&self.settings);
        }
        self.woke_with_defaults = self.eeprom.number == 0;
        if self.woke_with_defaults {
            self.number = self.switch;
            self.parameters = Parameters::defaults(&self.settings, self.switch, self.eeprom.bit_rate);
        } else {
            self.number = self.eeprom.number;
            self.parameters = Parameters { bit_rate: self.eeprom.bit_rate, ..self.eeprom.parameters };
        }
        self.told_number = self.eeprom.number;
        self.bit_rate = self.eeprom.bit_rate;
        (self.new_on_bus, self.can_error, self.suspended) = (true, false, false);
        (self.overwritten_at, self.started, self.silence_over) = (None, now, None);
        self.effective = self.parameters;
        self.go_silent(now);
        self.opened = (None, None);
        self.apply(now);
        self.open(now);
    }

    /// The EEPROM has the defaults, and no module number.
    fn overwrite(&mut self) {
        let bit_rate = factory_bit_rate(&self.settings);
        let parameters = Parameters::defaults(&self.settings, self.switch, bit_rate);
        self.eeprom = Eeprom { ok: true, number: 0, parameters, bit_rate };
    }

    /// Turns the coding switches. They count at the next reset, but for leaving 00 (R-ESD-107).
    pub fn turn_switches(&mut self, now: Instant, switch: u8) {
        self.switch = switch;
        if self.powered && self.at_zero && switch != 0 && self.overwritten_at.is_none() {
            self.overwrite();
            self.overwritten_at = Some(now + OVERWRITE_TIME);
        }
    }

    /// What is in the EEPROM can no longer be read.
    pub fn spoil_eeprom(&mut self) {
        self.eeprom.ok = false;
    }
}
