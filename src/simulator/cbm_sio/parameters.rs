//! What can be set of an esd serial module: its parameters, their defaults, and what the numbers mean. Pure.

use std::time::Duration;

use super::settings::SioSettings;

/// Channels of the larger module.
pub const CHANNELS: usize = 5;
/// Identifiers have 11 bits (R-ESD-002).
pub const HIGHEST_ID: u16 = 0x7FF;
/// User parameters that there are (R-ESD-066).
pub const USER_PARAMETERS: usize = 128;
/// The user parameter with the silence after a reset (R-ESD-090).
pub const FIRST_TX_DELAY: usize = 0;
/// Bytes that a frame takes at most.
pub const FRAME: u8 = 8;

/// One of the two modules.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Model {
    /// CAN-CBM-SIO1, one channel.
    Sio1,
    /// CAN-CBM-SIO4, four channels and the terminal interface as the fifth.
    Sio4,
}

impl Model {
    /// Serial channels; they are numbered from 1.
    #[must_use]
    pub const fn channels(self) -> u8 {
        match self {
            Self::Sio1 => 1,
            Self::Sio4 => 5,
        }
    }

    /// The code by which it names itself (R-ESD-058).
    #[must_use]
    pub const fn type_code(self) -> u8 {
        match self {
            Self::Sio1 => 0x30,
            Self::Sio4 => 0x31,
        }
    }

    /// The highest value of the coding switches whose identifiers have 11 bits (R-ESD-021).
    #[must_use]
    pub const fn highest_switch(self) -> u8 {
        match self {
            Self::Sio1 => 0xCC,
            Self::Sio4 => 0xCB,
        }
    }

    /// Whether a channel, from 0, is at the DSUB9 socket: it ignores CTS and takes fewer settings (R-ESD-011, R-ESD-012).
    #[must_use]
    pub const fn is_terminal(self, channel: usize) -> bool {
        match self {
            Self::Sio1 => true,
            Self::Sio4 => channel == 4,
        }
    }

    /// Identifiers of a channel, from 0, to CAN and from CAN, by the coding switches (R-ESD-013 to R-ESD-015).
    #[must_use]
    pub fn identifiers(self, switch: u8, channel: u8) -> (u16, u16) {
        let transmit = 10 * u16::from(switch) + u16::from(channel);
        (transmit, transmit + u16::from(self.channels()))
    }
}

/// Everything that is set by the protocol and can be stored, but for the module number.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Parameters {
    /// Identifiers of the channels to CAN.
    pub tx_ids: [u16; CHANNELS],
    /// Identifiers of the channels from CAN.
    pub rx_ids: [u16; CHANNELS],
    /// Kept, without effect on serial channels, in ms (R-ESD-065).
    pub tx_activate: [u16; CHANNELS],
    /// By their numbers.
    pub user: [u16; USER_PARAMETERS],
    /// Identifier of the watchdog; 0 = none was set.
    pub watchdog_id: u16,
    /// In ms; 0 = no watchdog.
    pub watchdog_ms: u16,
    /// So many times the watchdog time may pass.
    pub life_time_factor: u8,
    /// As it was set: two bus timing registers, or an index.
    pub bit_rate: [u8; 2],
}

impl Parameters {
    /// What a module starts with from the factory, with its coding switches as they are.
    #[must_use]
    pub fn defaults(settings: &SioSettings, switch: u8, bit_rate: [u8; 2]) -> Self {
        let mut own = Self {
            tx_ids: [0; CHANNELS],
            rx_ids: [0; CHANNELS],
            tx_activate: [0; CHANNELS],
            user: [0; USER_PARAMETERS],
            watchdog_id: 0,
            watchdog_ms: 0,
            life_time_factor: 0,
            bit_rate,
        };
        for (channel, (tx, rx)) in
            (0..settings.model.channels()).zip(own.tx_ids.iter_mut().zip(&mut own.rx_ids))
        {
            (*tx, *rx) = settings.model.identifiers(switch, channel);
        }
        own.set_user(FIRST_TX_DELAY, settings.first_tx_delay_ms);
        let modes = settings.can_tx_mode.into_iter().zip(settings.serial_mode);
        for (channel, (tx, serial)) in modes.enumerate().take(usize::from(settings.model.channels())) {
            own.set_user(tx_mode_number(channel), tx);
            own.set_user(serial_mode_number(channel), serial);
        }
        own
    }

    /// A user parameter; `None` where there is none of that number.
    #[must_use]
    pub fn user(&self, number: usize) -> Option<u16> {
        self.user.get(number).copied()
    }

    /// Sets a user parameter.
    pub fn set_user(&mut self, number: usize, value: u16) {
        if let Some(own) = self.user.get_mut(number) {
            *own = value;
        }
    }
}

/// The number of the user parameter with the CAN Tx mode of a channel, from 0.
#[must_use]
pub const fn tx_mode_number(channel: usize) -> usize {
    1 + 8 * channel
}

/// The number of the user parameter with the serial mode of a channel, from 0.
#[must_use]
pub const fn serial_mode_number(channel: usize) -> usize {
    2 + 8 * channel
}

/// What makes a channel send to CAN (R-ESD-024, R-ESD-093).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Trigger {
    /// At least so many bytes wait.
    Count(u8),
    /// This byte came.
    Mark(u8, Keep),
}

/// Which bytes are sent besides the data.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Keep {
    /// The mark too.
    All,
    /// Not the mark.
    NoMark,
    /// Neither CR nor LF.
    NoLineEnds,
}

/// How a channel sends to CAN.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TxMode {
    /// Shortest time from frame to frame.
    pub inhibit: Duration,
    /// Longest frame, 1..=8.
    pub most: u8,
    /// When it sends.
    pub trigger: Trigger,
}

const CR: u8 = 0x0D;
const LF: u8 = 0x0A;

impl TxMode {
    /// What a value says; `None` outside its range (R-ESD-091 to R-ESD-094). `min_first`: the nibbles in the other order.
    #[must_use]
    pub fn decode(raw: u16, min_first: bool) -> Option<Self> {
        let [inhibit, low] = raw.to_be_bytes();
        let (most, least) = if min_first { (low & 0xF, low >> 4) } else { (low >> 4, low & 0xF) };
        let trigger = match least {
            1..=8 => Trigger::Count(least),
            0x9 => Trigger::Mark(CR, Keep::All),
            0xA => Trigger::Mark(LF, Keep::All),
            0xB => Trigger::Mark(CR, Keep::NoMark),
            0xC => Trigger::Mark(LF, Keep::NoMark),
            0xD => Trigger::Mark(CR, Keep::NoLineEnds),
            0xE => Trigger::Mark(LF, Keep::NoLineEnds),
            _ => return None,
        };
        let inhibit = Duration::from_millis(u64::from(inhibit));
        (1..=FRAME).contains(&most).then_some(Self { inhibit, most, trigger })
    }
}

/// Rates by their code, in bit/s (R-ESD-096).
pub const RATES: [u32; 16] = [
    38_400, 19_200, 9_600, 4_800, 2_400, 1_200, 600, 300, 150, 7_200, 14_400, 28_800, 57_600, 115_200,
    230_400, 76_800,
];

/// Rates that the processor's own port has instead of some, in tenths of bit/s (R-ESD-010).
const PORT_RATES: [(u32, u64); 8] = [
    (38_400, 384_620),
    (19_200, 192_310),
    (9_600, 96_150),
    (4_800, 48_080),
    (2_400, 24_040),
    (1_200, 11_990),
    (600, 6_002),
    (300, 2_999),
];

/// How a serial line works.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SerialMode {
    /// Nominal rate from the line, in bit/s.
    pub receive: u32,
    /// Nominal rate to the line, in bit/s.
    pub send: u32,
    /// The module waits for CTS.
    pub cts: bool,
    /// Two stop bits.
    pub two_stop_bits: bool,
    /// `None` = no parity; otherwise whether it is odd.
    pub odd_parity: Option<bool>,
    /// 5 to 8.
    pub data_bits: u8,
    /// The line is at the processor's own port, whose rates differ a little.
    pub port: bool,
}

impl SerialMode {
    /// What a value says for a channel, from 0; `None` for what the terminal interface cannot (R-ESD-012, R-ESD-095 to
    /// R-ESD-103).
    #[must_use]
    pub fn decode(raw: u16, settings: &SioSettings, channel: usize) -> Option<Self> {
        let [rates, mode] = raw.to_be_bytes();
        let rate = |code: u8| RATES.get(usize::from(code)).copied();
        let terminal = settings.model.is_terminal(channel);
        let parity = mode & 0x18 == 0;
        let own = Self {
            receive: rate(rates >> 4)?,
            send: rate(rates & 0xF)?,
            cts: mode & 0x40 != 0 && !terminal,
            two_stop_bits: mode & 0x20 != 0 && settings.two_stop_bits && !terminal,
            odd_parity: parity.then_some(mode & 0x04 != 0),
            data_bits: 5 + (mode & 3),
            port: terminal,
        };
        let fits = !terminal || own.data_bits == 8 || (own.data_bits == 7 && parity);
        fits.then_some(own)
    }

    /// Bits that a character takes on the line, start and stop included.
    #[must_use]
    pub fn bits(&self) -> u64 {
        let stop = if self.two_stop_bits { 2 } else { 1 };
        1 + u64::from(self.data_bits) + u64::from(self.odd_parity.is_some()) + stop
    }

    /// What the data bits leave of a byte.
    #[must_use]
    pub fn cut(&self, byte: u8) -> u8 {
        byte & (0xFF_u8 >> 8_u8.saturating_sub(self.data_bits))
    }

    /// How long so many characters take from the line.
    #[must_use]
    pub fn receive_time(&self, characters: u64) -> Duration {
        self.time(self.receive, characters)
    }

    /// How long so many characters take to the line.
    #[must_use]
    pub fn send_time(&self, characters: u64) -> Duration {
        self.time(self.send, characters)
    }

    fn time(&self, rate: u32, characters: u64) -> Duration {
        let known = PORT_RATES.iter().find(|(nominal, _)| self.port && *nominal == rate);
        let tenths = known.map_or(u64::from(rate) * 10, |(_, tenths)| *tenths);
        let bits = characters.saturating_mul(self.bits());
        Duration::from_micros(bits.saturating_mul(10_000_000) / tenths.max(1))
    }
}

/// Bus timing registers by their index (R-ESD-078).
pub const BIT_RATES: [[u8; 2]; 15] = [
    [0x00, 0x14],
    [0x00, 0x16],
    [0x00, 0x18],
    [0x00, 0x1C],
    [0x01, 0x18],
    [0x01, 0x1C],
    [0x02, 0x1C],
    [0x03, 0x1C],
    [0x04, 0x1C],
    [0x45, 0x2F],
    [0x09, 0x1C],
    [0x4B, 0x2F],
    [0x18, 0x1C],
    [0x5F, 0x2F],
    [0x31, 0x1C],
];

/// The bit rate of two bus timing registers of an SJA1000 at 16 MHz, in bit/s.
#[must_use]
pub fn bits_per_second([btr0, btr1]: [u8; 2]) -> u32 {
    let prescaler = u32::from(btr0 & 0x3F) + 1;
    let quanta = 3 + u32::from(btr1 & 0xF) + u32::from((btr1 >> 4) & 7);
    16_000_000 / (2 * prescaler * quanta)
}
