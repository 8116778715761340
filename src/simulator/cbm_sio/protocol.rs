//! The commands that an esd module understands, and its replies (R-ESD-044 to R-ESD-072). Pure.

use super::module::Module;
use super::parameters::{BIT_RATES, HIGHEST_ID, SerialMode, TxMode, USER_PARAMETERS};
use super::start::Reset;
use crate::time::Instant;

/// The whole answer to what is not known (R-ESD-052).
const UNKNOWN: [u8; 1] = [0xFF];
/// What byte 3 of the module type says: serial. Public copies of the protocol list it; for these modules it is not defined.
const IO_MODE: u8 = 5;
/// Status register of a CAN controller that has nothing to do.
const IDLE_CONTROLLER: u8 = 0x0C;

/// Bits of the status byte (R-ESD-074).
const RUNS: u8 = 1;
const SUSPENDED: u8 = 1 << 1;
const CAN_ERROR: u8 = 1 << 2;
const WOKE_WITH_DEFAULTS: u8 = 1 << 6;
const NEW_ON_BUS: u8 = 1 << 7;

/// A module number that the protocol can set (R-ESD-049).
const NUMBERS: std::ops::RangeInclusive<u8> = 1..=0xFE;

impl Module {
    /// Takes what came with the INIT identifier; wrong lengths have no effect (R-ESD-045).
    pub(super) fn command(&mut self, now: Instant, data: &[u8]) {
        let [command, sub, second, number, high, low] = *data else { return };
        let value = u16::from_be_bytes([high, low]);
        match command {
            0x7F => self.service_request(now, sub, second, value),
            0xFF if number == 0 || number == self.number => self.supervise(now, sub, value),
            _ if number == 0 || number != self.number => {}
            0x00..0x7F => {
                let mute = self.faults().mute_replies;
                let reply = self.answer(command, sub);
                if !mute {
                    self.reply(now, value, reply.as_deref().unwrap_or(&UNKNOWN));
                }
            }
            0x80.. => {
                self.set(command, sub, second, value);
                self.apply(now);
                self.open(now);
            }
        }
    }

    /// Modules with news answer with an empty frame (R-ESD-069).
    fn service_request(&mut self, now: Instant, low: u8, high: u8, reply_to: u16) {
        let asked = (low..=high).contains(&self.number);
        let news = self.status() & (NEW_ON_BUS | CAN_ERROR) != 0;
        if asked && news && !self.faults().mute_replies {
            self.reply(now, reply_to, &[]);
        }
    }

    /// Commands that need their exact parameters (R-ESD-071).
    fn supervise(&mut self, now: Instant, sub: u8, value: u16) {
        match (sub, value) {
            (0x00, 0xAAAA) => self.reset(now, Reset::Plain),
            (0x02, _) => self.guard(now),
            (0x03, 0xAAAA) => self.reset(now, Reset::Defaults),
            (0x04, 0x5A5A) => {
                self.suspended = true;
                self.open(now);
            }
            (0x04, 0xA5A5) => {
                self.suspended = false;
                self.apply(now);
                self.open(now);
            }
            (0x05, _) => self.can_error = false,
            _ => {}
        }
    }

    /// A request of the watchdog, by remote frame or by command (R-ESD-082 to R-ESD-086).
    pub(super) fn guard(&mut self, now: Instant) {
        if self.watchdog_time().is_some() {
            self.watchdog.asked = Some(now);
        }
        let id = self.effective.watchdog_id;
        if id == 0 || self.faults().mute_watchdog {
            return;
        }
        let toggle = if self.watchdog.toggle { 0x80 } else { 0 };
        let fill = if self.settings.watchdog_fill { 0x78 } else { 0 };
        self.watchdog.toggle ^= !self.faults().stuck_toggle;
        self.reply(now, id, &[toggle | fill | self.settings.watchdog_state]);
    }

    /// The status byte (R-ESD-074).
    #[must_use]
    pub fn status(&self) -> u8 {
        let bits = [
            (true, RUNS),
            (self.suspended, SUSPENDED),
            (self.can_error || self.faults().error_stands, CAN_ERROR),
            (self.woke_with_defaults, WOKE_WITH_DEFAULTS),
            (self.new_on_bus, NEW_ON_BUS),
        ];
        bits.into_iter().filter(|(holds, _)| *holds).fold(0, |status, (_, bit)| status | bit)
    }

    /// What is answered to a request; `None` = it is not known.
    fn answer(&self, command: u8, sub: u8) -> Option<Vec<u8>> {
        let place = usize::from(sub);
        let channel = Some(place).filter(|place| *place < self.channels().len());
        let own = &self.parameters;
        let word = |value: u16| {
            let [high, low] = value.to_be_bytes();
            vec![command, sub, high, low]
        };
        match command {
            0x00 => self.describe(sub),
            0x01 => self.system(sub),
            0x02 => own.tx_ids.get(channel?).copied().map(word),
            0x03 => own.rx_ids.get(channel?).copied().map(|id| {
                let [high, low] = id.to_be_bytes();
                vec![command, sub, high, low, high, low]
            }),
            0x04 => own.tx_activate.get(channel?).copied().map(word),
            0x06 => own.user(place).map(word),
            _ => None,
        }
    }

    /// What the module is (R-ESD-058 to R-ESD-062).
    fn describe(&self, sub: u8) -> Option<Vec<u8>> {
        let digit = |value: u8| {
            char::from_digit(u32::from(value), 16)
                .map_or(b'0', |c| u8::try_from(c.to_ascii_uppercase()).unwrap_or(b'0'))
        };
        let settings = &self.settings;
        Some(match sub {
            0x00 => vec![0, sub, settings.model.type_code(), IO_MODE],
            0x01 => vec![0, sub, self.switch],
            0x02 => {
                let number = [digit(self.number >> 4), digit(self.number & 0xF)];
                [&[0], settings.ascii_id.as_slice(), &number].concat()
            }
            0x03 => [&[0], settings.software.as_slice()].concat(),
            0x05 => [&[0, sub], settings.serial_number.as_slice()].concat(),
            _ => return None,
        })
    }

    fn system(&self, sub: u8) -> Option<Vec<u8>> {
        let [id_high, id_low] = self.parameters.watchdog_id.to_be_bytes();
        let [time_high, time_low] = self.parameters.watchdog_ms.to_be_bytes();
        let [rate0, rate1] = self.eeprom.bit_rate;
        Some(match sub {
            0x00 => vec![1, sub, self.told_number],
            0x01 => vec![1, sub, self.number],
            0x02 if self.settings.controller_status => vec![1, sub, self.status(), IDLE_CONTROLLER],
            0x02 => vec![1, sub, self.status()],
            0x03 => vec![1, sub, rate0, rate1],
            0x04 => vec![1, sub, id_high, id_low],
            0x05 => vec![1, sub, time_high, time_low, self.parameters.life_time_factor],
            _ => return None,
        })
    }

    /// Sets something; values out of range have no effect, and nothing is answered (R-ESD-054).
    fn set(&mut self, command: u8, sub: u8, second: u8, value: u16) {
        let place = usize::from(sub);
        let exists = place < self.channels().len();
        let is_id = value <= HIGHEST_ID;
        if command == 0x81 {
            return self.set_system(sub, second, value);
        }
        let holds = place < USER_PARAMETERS && self.holds(place, value);
        let own = &mut self.parameters;
        let target = match command {
            0x82 => own.tx_ids.get_mut(place).filter(|_| exists && is_id),
            0x83 => own.rx_ids.get_mut(place).filter(|_| exists && is_id),
            0x84 => own.tx_activate.get_mut(place).filter(|_| exists),
            0x86 => own.user.get_mut(place).filter(|_| holds),
            _ => None,
        };
        if let Some(target) = target {
            *target = value;
        }
    }

    fn set_system(&mut self, sub: u8, second: u8, value: u16) {
        let [first, _] = value.to_be_bytes();
        match sub {
            0x00 if first == self.number => self.store(),
            0x01 if NUMBERS.contains(&first) => self.number = first,
            0x02 => (self.can_error, self.new_on_bus) = (false, false),
            0x03 => {
                let known = !self.settings.bit_rate_by_index || usize::from(value) < BIT_RATES.len();
                if known {
                    self.parameters.bit_rate = value.to_be_bytes();
                }
            }
            0x04 if value <= HIGHEST_ID => self.parameters.watchdog_id = value,
            0x05 => (self.parameters.watchdog_ms, self.parameters.life_time_factor) = (value, second),
            _ => {}
        }
    }

    /// Whether a user parameter can have this value.
    fn holds(&self, number: usize, value: u16) -> bool {
        let channel = number / 8;
        let exists = channel < self.channels().len();
        match number % 8 {
            1 if exists => TxMode::decode(value, self.settings.min_first).is_some(),
            2 if exists => SerialMode::decode(value, &self.settings, channel).is_some(),
            _ => true,
        }
    }

    /// Everything survives from now on, the module number too (R-ESD-067).
    fn store(&mut self) {
        self.eeprom.ok = true;
        self.eeprom.number = self.number;
        self.eeprom.parameters = self.parameters;
        self.eeprom.bit_rate = self.parameters.bit_rate;
        self.told_number = self.number;
    }
}
