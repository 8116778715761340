//! What an esd serial module is like: the switches where its manual leaves a choice, and the `[device]` table of its scenario.
//! Pure.

use std::time::Duration;

use serde::Deserialize;
use toml::Spanned;

use super::super::kind::Settings;
use super::super::scenario_file::{self, Reader};
use super::line::LineKind;
use super::parameters::{CHANNELS, Model, SerialMode, TxMode};

/// What a module is like. The default is what modules in the field are expected to be.
#[derive(Clone, Debug, PartialEq)]
pub struct SioSettings {
    /// Which module.
    pub model: Model,
    /// User parameter 00 from the factory, in ms (R-ESD-090).
    pub first_tx_delay_ms: u16,
    /// CAN Tx mode of each channel from the factory (R-ESD-091).
    pub can_tx_mode: [u16; CHANNELS],
    /// Serial mode of each channel from the factory (R-ESD-103).
    pub serial_mode: [u16; CHANNELS],
    /// What is at the end of each line.
    pub lines: [LineKind; CHANNELS],
    /// How often a scanner reads.
    pub scan_every: Duration,
    /// From a request to its reply; 10 ms at most (R-ESD-053).
    pub reply_delay: Duration,
    /// Requests are answered during the silence after a reset too (R-ESD-033).
    pub replies_in_delay: bool,
    /// What waits is sent when nothing came for so long; `None` = never (`sim_idle_timeout_ms`, R-ESD-025).
    pub idle_timeout: Option<Duration>,
    /// Line ends pause while RTS is off (R-ESD-011).
    pub heeds_rts: bool,
    /// Bit 5 of the serial mode means two stop bits; otherwise one, as without it (R-ESD-099).
    pub two_stop_bits: bool,
    /// `MinChar` is the high nibble of the CAN Tx mode (`esd_txmode_nibbles`, R-ESD-092).
    pub min_first: bool,
    /// The bit rate is set by an index instead of two registers (`esd_bitrate_format`, R-ESD-079).
    pub bit_rate_by_index: bool,
    /// The reply with the status has the status of the controller too (R-ESD-074).
    pub controller_status: bool,
    /// Bits 6 to 3 of the watchdog reply (`sim_wd_fill`, R-ESD-086).
    pub watchdog_fill: bool,
    /// Bits 2 to 0 of the watchdog reply.
    pub watchdog_state: u8,
    /// Seven characters (R-ESD-061).
    pub software: [u8; 7],
    /// Six characters (R-ESD-062).
    pub serial_number: [u8; 6],
    /// Five characters (R-ESD-060).
    pub ascii_id: [u8; 5],
    /// Bit rate of the bus in kbit/s; 0 = it takes every bit rate.
    pub bus_kbit: u16,
}

impl SioSettings {
    /// A module as it leaves the factory, with nothing at its lines.
    #[must_use]
    pub fn new(model: Model) -> Self {
        Self {
            model,
            first_tx_delay_ms: 10_000,
            can_tx_mode: [0x1411; CHANNELS],
            serial_mode: [0x2273; CHANNELS],
            lines: [LineKind::None; CHANNELS],
            scan_every: Duration::from_secs(5),
            reply_delay: Duration::from_micros(200),
            replies_in_delay: false,
            idle_timeout: None,
            heeds_rts: false,
            two_stop_bits: true,
            min_first: false,
            bit_rate_by_index: false,
            controller_status: false,
            watchdog_fill: true,
            watchdog_state: 5,
            software: *b"V1.0aE0",
            serial_number: *b"AA0012",
            ascii_id: match model {
                Model::Sio1 => *b"SIO11",
                Model::Sio4 => *b"SIO41",
            },
            bus_kbit: 125,
        }
    }
}

/// The table of either module.
#[derive(Deserialize, Default)]
#[serde(deny_unknown_fields)]
struct Table {
    first_tx_delay_ms: Option<Spanned<i64>>,
    can_tx_mode: Option<Vec<Spanned<i64>>>,
    serial_mode: Option<Vec<Spanned<i64>>>,
    lines: Option<Vec<Spanned<String>>>,
    scan_every_ms: Option<Spanned<i64>>,
    reply_delay_us: Option<Spanned<i64>>,
    replies_in_delay: Option<bool>,
    idle_timeout_ms: Option<u64>,
    heeds_rts: Option<bool>,
    two_stop_bits: Option<bool>,
    min_first: Option<bool>,
    bit_rate_by_index: Option<bool>,
    controller_status: Option<bool>,
    watchdog_fill: Option<bool>,
    watchdog_state: Option<Spanned<i64>>,
    software: Option<Spanned<String>>,
    serial_number: Option<Spanned<String>>,
    ascii_id: Option<Spanned<String>>,
    bus_kbit: Option<Spanned<i64>>,
}

/// The `[device]` table of an SIO1.
#[derive(Deserialize, Default)]
#[serde(transparent)]
pub(in super::super) struct Sio1Table(Table);

/// The `[device]` table of an SIO4.
#[derive(Deserialize, Default)]
#[serde(transparent)]
pub(in super::super) struct Sio4Table(Table);

impl scenario_file::DeviceTable for Sio1Table {
    fn settings(&self, reader: &mut Reader) -> Settings {
        self.0.settings(Model::Sio1, reader)
    }
}

impl scenario_file::DeviceTable for Sio4Table {
    fn settings(&self, reader: &mut Reader) -> Settings {
        self.0.settings(Model::Sio4, reader)
    }
}

impl Table {
    fn settings(&self, model: Model, reader: &mut Reader) -> Settings {
        let usual = SioSettings::new(model);
        let delay = reader.number(self.first_tx_delay_ms.as_ref(), "delay in milliseconds", 0, u16::MAX);
        let scan = reader.number(self.scan_every_ms.as_ref(), "time in milliseconds", 100, u32::MAX);
        let reply =
            reader.number(self.reply_delay_us.as_ref(), "time of a reply in microseconds", 0, 10_000_u32);
        let state = reader.number(self.watchdog_state.as_ref(), "state of three bits", 0, 7);
        let bus = reader.number(self.bus_kbit.as_ref(), "bit rate in kbit/s", 0, 1000);
        let settings = SioSettings {
            first_tx_delay_ms: delay.unwrap_or(usual.first_tx_delay_ms),
            scan_every: scan.map_or(usual.scan_every, |ms| Duration::from_millis(u64::from(ms))),
            reply_delay: reply.map_or(usual.reply_delay, |us| Duration::from_micros(u64::from(us))),
            replies_in_delay: self.replies_in_delay.unwrap_or(usual.replies_in_delay),
            idle_timeout: self.idle_timeout_ms.filter(|ms| *ms > 0).map(Duration::from_millis),
            heeds_rts: self.heeds_rts.unwrap_or(usual.heeds_rts),
            two_stop_bits: self.two_stop_bits.unwrap_or(usual.two_stop_bits),
            min_first: self.min_first.unwrap_or(usual.min_first),
            bit_rate_by_index: self.bit_rate_by_index.unwrap_or(usual.bit_rate_by_index),
            controller_status: self.controller_status.unwrap_or(usual.controller_status),
            watchdog_fill: self.watchdog_fill.unwrap_or(usual.watchdog_fill),
            watchdog_state: state.unwrap_or(usual.watchdog_state),
            software: text(self.software.as_ref(), usual.software, reader),
            serial_number: text(self.serial_number.as_ref(), usual.serial_number, reader),
            ascii_id: text(self.ascii_id.as_ref(), usual.ascii_id, reader),
            bus_kbit: bus.unwrap_or(usual.bus_kbit),
            ..usual
        };
        Settings::CbmSio(Box::new(self.channels(settings, reader)))
    }

    /// What is said of each channel, from channel 1 on; the last word holds for those that follow too.
    fn channels(&self, mut settings: SioSettings, reader: &mut Reader) -> SioSettings {
        let copy = settings.clone();
        let is_tx_mode = |_, raw| TxMode::decode(raw, copy.min_first).is_some();
        modes(
            self.can_tx_mode.as_deref(),
            &mut settings.can_tx_mode,
            "CAN Tx mode",
            reader,
            copy.model,
            is_tx_mode,
        );
        let is_serial_mode = |channel, raw| SerialMode::decode(raw, &copy, channel).is_some();
        let serial = self.serial_mode.as_deref();
        modes(serial, &mut settings.serial_mode, "serial mode", reader, copy.model, is_serial_mode);
        let lines = self.lines.as_deref().unwrap_or_default();
        for place in 0..copy.model.channels() {
            let Some(word) = lines.get(usize::from(place)).or(lines.last()) else { break };
            let kind = LineKind::named(word.get_ref());
            if kind.is_none() && usize::from(place) < lines.len() {
                let hint = LineKind::NAMED.map(|(name, _)| name).join(", ");
                let message = format!("`{}` is nothing that can be at a line", word.get_ref());
                reader.problem(&word.span(), &message, &format!("give one of {hint}"));
            }
            if let (Some(kind), Some(line)) = (kind, settings.lines.get_mut(usize::from(place))) {
                *line = kind;
            }
        }
        too_many(lines, copy.model, reader);
        settings
    }
}

fn modes(
    given: Option<&[Spanned<i64>]>,
    into: &mut [u16; CHANNELS],
    what: &str,
    reader: &mut Reader,
    model: Model,
    holds: impl Fn(usize, u16) -> bool,
) {
    let given = given.unwrap_or_default();
    for (channel, mode) in into.iter_mut().enumerate().take(usize::from(model.channels())) {
        let Some(number) = given.get(channel).or(given.last()) else { break };
        if let Some(raw) = u16::try_from(*number.get_ref()).ok().filter(|raw| holds(channel, *raw)) {
            *mode = raw;
        } else {
            let message = format!("{:#06X} is not a {what} of channel {}", number.get_ref(), channel + 1);
            reader.problem(&number.span(), &message, "docs/simulator.md says what the bits mean");
        }
    }
    too_many(given, model, reader);
}

fn too_many<T>(given: &[Spanned<T>], model: Model, reader: &mut Reader) {
    if let Some(more) = given.get(usize::from(model.channels())) {
        let hint = format!("give at most {}", model.channels());
        reader.problem(&more.span(), "the module has no such channel", &hint);
    }
}

fn text<const N: usize>(given: Option<&Spanned<String>>, usual: [u8; N], reader: &mut Reader) -> [u8; N] {
    let Some(given) = given else { return usual };
    let bytes = given.get_ref().as_bytes();
    let text = bytes.try_into().ok().filter(|text: &[u8; N]| text.iter().all(u8::is_ascii_graphic));
    if text.is_none() {
        let message = format!("`{}` does not have {N} printable characters", given.get_ref());
        reader.problem(&given.span(), &message, &format!("give {N} letters, digits and signs"));
    }
    text.unwrap_or(usual)
}
