//! An esd serial module on the bus: what it is and does as time passes, and its channels. Pure.
//!
//! [`start`](super::start) has power and resets, `protocol` the commands, [`channel`](super::channel) what happens on each line.

use std::collections::VecDeque;
use std::time::Duration;

use super::channel::{Channel, Gates, Step};
use super::faults::Faults;
use super::line::Line;
use super::parameters::{
    BIT_RATES, FIRST_TX_DELAY, Parameters, SerialMode, TxMode, bits_per_second, serial_mode_number,
    tx_mode_number,
};
use super::settings::SioSettings;
use super::start::{Eeprom, Reset, factory_bit_rate};
use crate::can::{CanFrame, CanId};
use crate::time::Instant;

/// All commands come with this identifier (R-ESD-044).
pub const INIT: CanId = CanId::Standard(0x700);
/// Frames that wait for the bus from which on channels send no more.
const BUSY: usize = 64;
/// Frames that wait for the bus; replies beyond are lost.
const QUEUE_LIMIT: usize = 256;
/// Lost bytes are told once in so long.
const OVERFLOW_PERIOD: Duration = Duration::from_secs(1);

/// The watchdog (R-ESD-081 to R-ESD-086).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Watchdog {
    /// The last request since it is enabled.
    pub asked: Option<Instant>,
    /// Bit 7 of the next reply.
    pub toggle: bool,
}

/// What is told of lost bytes, and since when.
#[derive(Clone, Debug)]
struct Told {
    counts: Vec<(u64, u64)>,
    at: Option<Instant>,
}

/// A module.
#[derive(Clone, Debug)]
pub struct Module {
    pub(super) settings: SioSettings,
    pub(super) switch: u8,
    pub(super) powered: bool,
    /// The coding switches were at 00 when it started: it has no identifiers.
    pub(super) at_zero: bool,
    pub(super) overwritten_at: Option<Instant>,
    pub(super) eeprom: Eeprom,
    /// As they were set.
    pub(super) parameters: Parameters,
    /// As they are in effect; the same unless suspended.
    pub(super) effective: Parameters,
    /// Active module number.
    pub(super) number: u8,
    /// Stored module number as the module tells it.
    pub(super) told_number: u8,
    pub(super) woke_with_defaults: bool,
    pub(super) new_on_bus: bool,
    pub(super) can_error: bool,
    pub(super) suspended: bool,
    pub(super) watchdog: Watchdog,
    /// The bit rate that it runs at.
    pub(super) bit_rate: [u8; 2],
    bus_kbit: u16,
    faults: Faults,
    pub(super) started: Instant,
    /// When the silence was over, once it was: a parameter that is set later does not bring it back.
    pub(super) silence_over: Option<Instant>,
    /// Since when it could send to CAN, and to the lines; `None` = it cannot.
    pub(super) opened: (Option<Instant>, Option<Instant>),
    pub(super) channels: Vec<Channel>,
    pub(super) replies: VecDeque<(Instant, CanFrame)>,
    pub(super) outputs: VecDeque<CanFrame>,
    told: Told,
}

impl Module {
    /// A module without power, as it comes from the factory.
    #[must_use]
    pub fn new(settings: &SioSettings, switch: u8, now: Instant) -> Self {
        let bit_rate = factory_bit_rate(settings);
        let parameters = Parameters::defaults(settings, switch, bit_rate);
        let channels = (0..usize::from(settings.model.channels())).filter_map(|channel| {
            let (tx, serial) = modes(settings, &parameters, channel)?;
            let kind = settings.lines.get(channel).copied()?;
            let line = Line::new(kind, settings.scan_every, now);
            Some(Channel::new(line, tx, serial, settings.idle_timeout, settings.heeds_rts))
        });
        Self {
            switch,
            powered: false,
            at_zero: false,
            overwritten_at: None,
            eeprom: Eeprom { ok: true, number: 0, parameters, bit_rate },
            parameters,
            effective: parameters,
            number: switch,
            told_number: 0,
            woke_with_defaults: true,
            new_on_bus: true,
            can_error: false,
            suspended: false,
            watchdog: Watchdog::default(),
            bit_rate,
            bus_kbit: settings.bus_kbit,
            faults: Faults::default(),
            started: now,
            silence_over: None,
            opened: (None, None),
            channels: channels.collect(),
            replies: VecDeque::new(),
            outputs: VecDeque::new(),
            told: Told { counts: vec![(0, 0); usize::from(settings.model.channels())], at: None },
            settings: settings.clone(),
        }
    }

    /// The controller has seen an error on the bus.
    pub fn note_error(&mut self) {
        self.can_error |= self.powered;
    }

    /// The bus runs at another bit rate, in kbit/s; 0 = it takes every bit rate.
    pub fn set_bus(&mut self, now: Instant, kbit: u16) {
        self.bus_kbit = kbit;
        self.open(now);
    }

    /// Switches faults on and off.
    pub fn set_faults(&mut self, now: Instant, faults: Faults) {
        let before = std::mem::replace(&mut self.faults, faults);
        if self.powered && before.unplugged && !faults.unplugged {
            self.can_error = true;
        }
        if faults.unplugged {
            self.replies.clear();
            self.outputs.clear();
        }
        self.open(now);
    }

    /// The faults that are on.
    #[must_use]
    pub fn faults(&self) -> Faults {
        self.faults
    }

    /// Whether it has power.
    #[must_use]
    pub fn is_powered(&self) -> bool {
        self.powered
    }

    /// Whether it can be heard: it has power and its cable, and runs at the bit rate of the bus.
    #[must_use]
    pub fn is_on_the_air(&self) -> bool {
        self.powered && !self.faults.unplugged && self.is_at_bus_rate()
    }

    /// Whether it runs at the bit rate of the bus.
    #[must_use]
    pub fn is_at_bus_rate(&self) -> bool {
        let [_, index] = self.bit_rate;
        let by_index = || BIT_RATES.get(usize::from(index)).copied();
        let registers = if self.settings.bit_rate_by_index { by_index() } else { Some(self.bit_rate) };
        let bus = 1000 * u32::from(self.bus_kbit);
        bus == 0 || registers.is_some_and(|registers| bits_per_second(registers).abs_diff(bus) * 100 < bus)
    }

    /// Whether the coding switches were at 00 when it started: it has no identifiers, and sends no data.
    #[must_use]
    pub fn is_at_zero(&self) -> bool {
        self.at_zero
    }

    /// Whether the EEPROM is being overwritten.
    #[must_use]
    pub fn is_overwriting(&self) -> bool {
        self.overwritten_at.is_some()
    }

    /// Whether nothing is sent yet (R-ESD-033).
    #[must_use]
    pub fn is_silent(&self, now: Instant) -> bool {
        now < self.silent_until()
    }

    /// When the silence ends.
    #[must_use]
    pub fn silent_until(&self) -> Instant {
        let delay = self.effective.user(FIRST_TX_DELAY).unwrap_or_default();
        self.silence_over.unwrap_or(self.started + Duration::from_millis(u64::from(delay)))
    }

    /// Puts into effect what was set; while suspended it waits (R-ESD-043).
    pub(super) fn apply(&mut self, now: Instant) {
        if self.suspended {
            return;
        }
        if self.is_silent(now) {
            // A shorter silence does not open the channels in the past.
            self.opened = (self.opened.0.map(|_| now), self.opened.1.map(|_| now));
        } else {
            self.silence_over = Some(self.silent_until());
        }
        self.effective = self.parameters;
        for (place, channel) in self.channels.iter_mut().enumerate() {
            if let Some((tx, serial)) = modes(&self.settings, &self.effective, place) {
                channel.set_modes(now, tx, serial);
            }
        }
        if self.watchdog_time().is_none() {
            self.watchdog.asked = None;
        }
    }

    /// Notes since when the channels can send, or that they cannot.
    pub(super) fn open(&mut self, now: Instant) {
        let runs = self.powered && !self.suspended && !self.at_zero;
        let sends = runs && self.is_on_the_air();
        let note = |since: Option<Instant>, open: bool| since.or(Some(now)).filter(|_| open);
        self.opened = (note(self.opened.0, sends), note(self.opened.1, runs));
    }

    fn gates(&self) -> Gates {
        let silent_until = self.silent_until();
        let since = |opened: Option<Instant>| opened.map(|opened| opened.max(silent_until));
        let can = since(self.opened.0).filter(|_| self.outputs.len() < BUSY);
        Gates { can, line: since(self.opened.1), power: self.powered && !self.at_zero }
    }

    /// A channel, from 0.
    pub fn channel(&mut self, channel: usize) -> Option<&mut Channel> {
        self.channels.get_mut(channel)
    }

    /// All channels.
    #[must_use]
    pub fn channels(&self) -> &[Channel] {
        &self.channels
    }

    /// Bytes that each channel lost, to CAN and to the line, as they are told: at most once a second.
    #[must_use]
    pub fn told_overflows(&self) -> &[(u64, u64)] {
        &self.told.counts
    }

    fn overflows(&self) -> Vec<(u64, u64)> {
        self.channels.iter().map(|channel| (channel.overflow_to_can, channel.overflow_to_line)).collect()
    }

    fn tell_at(&self) -> Option<Instant> {
        let news = self.told.counts != self.overflows();
        news.then(|| self.told.at.map_or(Instant::START, |at| at + OVERFLOW_PERIOD))
    }

    /// Whether frames of this identifier concern it.
    #[must_use]
    pub fn hears(&self, id: CanId) -> bool {
        let CanId::Standard(raw) = id else { return false };
        id == INIT || self.is_watchdog_id(id) || self.own_rx_ids().any(|own| own == raw)
    }

    pub(super) fn is_watchdog_id(&self, id: CanId) -> bool {
        let own = self.effective.watchdog_id;
        own != 0 && id == CanId::Standard(own)
    }

    fn own_rx_ids(&self) -> impl Iterator<Item = u16> {
        self.effective.rx_ids.into_iter().take(self.channels.len())
    }

    /// Takes a frame that another participant sent.
    pub fn handle_frame(&mut self, now: Instant, frame: &CanFrame) {
        self.handle_timeout(now);
        if !self.is_on_the_air() {
            return;
        }
        if frame.is_remote() {
            if self.is_watchdog_id(frame.id()) {
                self.guard(now);
            }
        } else if frame.id() == INIT {
            self.command(now, frame.data());
        } else if !self.at_zero {
            let ids = self.effective.rx_ids;
            for (channel, id) in self.channels.iter_mut().zip(ids) {
                if frame.id() == CanId::Standard(id) {
                    channel.hear(now, frame.data());
                }
            }
        }
    }

    /// Sends a reply after its time, unless nothing is sent yet (R-ESD-033).
    pub(super) fn reply(&mut self, now: Instant, id: u16, data: &[u8]) {
        let at = now + self.settings.reply_delay;
        let silent = self.is_silent(at) && !self.settings.replies_in_delay;
        let frame = CanId::standard(id).and_then(|id| CanFrame::data_frame(id, data));
        if let Some(frame) = frame.filter(|_| !silent && self.replies.len() < QUEUE_LIMIT) {
            self.replies.push_back((at, frame));
        }
    }

    /// The time that may pass between two requests; `None` = the watchdog is not enabled (R-ESD-081).
    pub(super) fn watchdog_time(&self) -> Option<Duration> {
        let millis = u64::from(self.effective.watchdog_ms) * u64::from(self.effective.life_time_factor);
        (millis > 0).then_some(Duration::from_millis(millis))
    }

    fn watchdog_due(&self) -> Option<Instant> {
        Some(self.watchdog.asked? + self.watchdog_time()?)
    }

    /// When something is due.
    #[must_use]
    pub fn poll_timeout(&self) -> Option<Instant> {
        let gates = self.gates();
        let channels = self.channels.iter().filter_map(|channel| channel.poll_timeout(gates));
        channels.chain(self.own_due()).chain(self.tell_at()).min()
    }

    /// Of what does not belong to a channel.
    fn own_due(&self) -> Option<Instant> {
        let reply = self.replies.front().map(|(due, _)| *due);
        [reply, self.watchdog_due(), self.overwritten_at].into_iter().flatten().min()
    }

    /// Does what became due, each at its own moment.
    pub fn handle_timeout(&mut self, now: Instant) {
        loop {
            let own = self.own_due().filter(|due| *due <= now);
            let until = own.unwrap_or(now);
            if self.step_channels(until) {
                continue;
            }
            match own {
                Some(due) => self.step(due),
                None => break,
            }
        }
        if self.tell_at().is_some_and(|due| due <= now) {
            self.told = Told { counts: self.overflows(), at: Some(now) };
        }
    }

    /// One event of each channel that has one until then; whether there was any.
    fn step_channels(&mut self, until: Instant) -> bool {
        let mut any = false;
        for place in 0..self.channels.len() {
            let gates = self.gates();
            let id = self.effective.tx_ids.get(place).copied().and_then(CanId::standard);
            let step = self.channels.get_mut(place).and_then(|channel| channel.handle_timeout(until, gates));
            any |= step.is_some();
            if let (Some(Step::Frame(data)), Some(id), false) = (step, id, self.faults.mute_data) {
                self.outputs.extend(CanFrame::data_frame(id, &data));
            }
        }
        any
    }

    fn step(&mut self, due: Instant) {
        if self.watchdog_due() == Some(due) || self.overwritten_at == Some(due) {
            self.reset(due, Reset::Plain);
        } else if let Some((_, frame)) = self.replies.pop_front()
            && self.outputs.len() < QUEUE_LIMIT
        {
            self.outputs.push_back(frame);
        }
    }

    /// The next frame to send.
    pub fn poll_output(&mut self) -> Option<CanFrame> {
        self.outputs.pop_front()
    }
}

/// How a channel, from 0, works by parameters; `None` for what cannot be, which is never set.
fn modes(settings: &SioSettings, parameters: &Parameters, channel: usize) -> Option<(TxMode, SerialMode)> {
    let tx = TxMode::decode(parameters.user(tx_mode_number(channel))?, settings.min_first)?;
    let serial = SerialMode::decode(parameters.user(serial_mode_number(channel))?, settings, channel)?;
    Some((tx, serial))
}
