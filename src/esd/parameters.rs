//! User parameters of the SIO modules: how a channel packs bytes into frames, and its serial line (R-ESD-090..103).

use std::time::Duration;

/// Number of the parameter "First Tx activate delay", in ms.
pub const FIRST_TX_DELAY: u8 = 0x00;

/// First Tx activate delay of a module as it is shipped (R-ESD-033).
pub const DEFAULT_FIRST_TX_DELAY: Duration = Duration::from_secs(10);

/// Number of the parameter "CAN Tx mode" of a channel, 1..=5.
#[must_use]
pub fn can_tx_mode_of(channel: u8) -> u8 {
    channel.saturating_sub(1).saturating_mul(8).saturating_add(1)
}

/// Number of the parameter "Serial mode" of a channel, 1..=5.
#[must_use]
pub fn serial_mode_of(channel: u8) -> u8 {
    can_tx_mode_of(channel).saturating_add(1)
}

/// How a channel packs what comes in on its line into frames (R-ESD-091).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct CanTxMode {
    /// Shortest time between two frames in ms (R-ESD-028).
    pub inhibit: u8,
    /// Most bytes of a frame, 1..=8 (R-ESD-026).
    pub max_char: u8,
    /// What sets a frame off.
    pub min_char: MinChar,
}

/// What sets a frame off (R-ESD-093).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum MinChar {
    /// So many bytes, 1..=8.
    Bytes(u8),
    /// Carriage return, which is sent (code 9).
    Cr,
    /// Line feed, which is sent (code A).
    Lf,
    /// Carriage return, which is not sent (code B).
    CrDropped,
    /// Line feed, which is not sent (code C).
    LfDropped,
    /// Carriage return; neither it nor line feeds are sent (code D).
    CrDropsBoth,
    /// Line feed; neither it nor carriage returns are sent (code E).
    LfDropsBoth,
}

impl MinChar {
    /// Its code, 0x1..=0xE.
    #[must_use]
    pub fn code(self) -> u8 {
        match self {
            Self::Bytes(count) => count.clamp(1, 8),
            Self::Cr => 0x9,
            Self::Lf => 0xA,
            Self::CrDropped => 0xB,
            Self::LfDropped => 0xC,
            Self::CrDropsBoth => 0xD,
            Self::LfDropsBoth => 0xE,
        }
    }

    /// `None` for 0 and 0xF, which are reserved.
    #[must_use]
    pub fn from_code(code: u8) -> Option<Self> {
        Some(match code {
            1..=8 => Self::Bytes(code),
            0x9 => Self::Cr,
            0xA => Self::Lf,
            0xB => Self::CrDropped,
            0xC => Self::LfDropped,
            0xD => Self::CrDropsBoth,
            0xE => Self::LfDropsBoth,
            _ => return None,
        })
    }
}

impl CanTxMode {
    /// As a module is shipped: each byte at once in a frame of its own, 20 ms apart (R-ESD-027, 028).
    pub const DEFAULT: Self = Self { inhibit: 20, max_char: 1, min_char: MinChar::Bytes(1) };

    /// The value of the parameter: inhibit time in the high byte, `MaxChar` and `MinChar` in the nibbles of the low one
    /// (R-ESD-091, 092).
    #[must_use]
    pub fn value(self) -> u16 {
        u16::from_be_bytes([self.inhibit, (self.max_char << 4) | self.min_char.code()])
    }

    /// The value for a module that has `MinChar` in the high nibble.
    #[must_use]
    pub fn value_with_min_char_high(self) -> u16 {
        let [inhibit, low] = self.value().to_be_bytes();
        u16::from_be_bytes([inhibit, low.rotate_left(4)])
    }

    /// `None` where `MaxChar` is not 1..=8 or `MinChar` is reserved.
    #[must_use]
    pub fn from_value(value: u16) -> Option<Self> {
        let [inhibit, low] = value.to_be_bytes();
        let max_char = low >> 4;
        let min_char = MinChar::from_code(low & 0x0F)?;
        (1..=8).contains(&max_char).then_some(Self { inhibit, max_char, min_char })
    }
}

/// Bit rates of serial lines in bit/s, by their codes (R-ESD-096).
const RATES: [u32; 16] = [
    38_400, 19_200, 9_600, 4_800, 2_400, 1_200, 600, 300, 150, 7_200, 14_400, 28_800, 57_600, 115_200,
    230_400, 76_800,
];

/// The bit rate of a serial line, one of sixteen.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Rate(u8);

impl Rate {
    /// The rate of so many bit/s; `None` where modules do not have it.
    #[must_use]
    pub fn new(bits_per_second: u32) -> Option<Self> {
        let code = RATES.iter().position(|rate| *rate == bits_per_second)?;
        Some(Self(u8::try_from(code).ok()?))
    }

    /// bit/s.
    #[must_use]
    pub fn bits_per_second(self) -> u32 {
        RATES.get(usize::from(self.0)).copied().unwrap_or(9_600)
    }

    /// All rates in bit/s, the lowest first.
    #[must_use]
    pub fn all() -> [u32; 16] {
        let mut rates = RATES;
        rates.sort_unstable();
        rates
    }

    /// Its code, 0x0..=0xF.
    #[must_use]
    pub fn code(self) -> u8 {
        self.0
    }
}

/// Parity of a serial line (R-ESD-100, 101).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Parity {
    /// No parity bit.
    None,
    /// Even.
    Even,
    /// Odd.
    Odd,
}

/// The form of a byte on a serial line.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct LineFormat {
    /// 5..=8.
    pub data_bits: u8,
    /// Parity.
    pub parity: Parity,
    /// 1 or 2. How a module takes it is an assumption (R-ESD-099).
    pub stop_bits: u8,
}

/// Rates and format of a serial line (R-ESD-095). The bits of RTS and of the stop bits are those whose meaning is not sure:
/// they are kept as a module has them unless the configuration asks for something (R-ESD-097, 099), see [`SerialBits`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SerialMode {
    /// From the line to the module.
    pub receive: Rate,
    /// From the module to the line.
    pub transmit: Rate,
    /// RTS, bit 7.
    pub rts: bool,
    /// CTS is heeded: nothing goes out on the line while it is off (R-ESD-098). The terminal interface ignores it.
    pub cts: bool,
    /// The form of a byte. Stop bits: see [`from_value`](Self::from_value).
    pub format: LineFormat,
}

impl SerialMode {
    /// The value of the parameter. Rates in the nibbles of the high byte, the receive rate in the higher one; then RTS, CTS,
    /// stop bits, two bits of parity mode, parity type, two bits of character length.
    #[must_use]
    pub fn value(self) -> u16 {
        let parity = match self.format.parity {
            Parity::None => 0b100,
            Parity::Even => 0b000,
            Parity::Odd => 0b001,
        };
        let low = (u8::from(self.rts) << 7)
            | (u8::from(self.cts) << 6)
            | (u8::from(self.format.stop_bits == 2) << 5)
            | (parity << 2)
            | (self.format.data_bits.clamp(5, 8) - 5);
        u16::from_be_bytes([(self.receive.code() << 4) | self.transmit.code(), low])
    }

    /// `None` for the parity modes 01 and 11, whose meaning is not known. Bit 5 set is read as two stop bits, which is an
    /// assumption; the default of a module has it set (R-ESD-099).
    #[must_use]
    pub fn from_value(value: u16) -> Option<Self> {
        let [rates, low] = value.to_be_bytes();
        let parity = match ((low >> 3) & 0b11, (low >> 2) & 1) {
            (0b10, _) => Parity::None,
            (0b00, 0) => Parity::Even,
            (0b00, _) => Parity::Odd,
            _ => return None,
        };
        Some(Self {
            receive: Rate(rates >> 4),
            transmit: Rate(rates & 0x0F),
            rts: low & 0x80 != 0,
            cts: low & 0x40 != 0,
            format: LineFormat {
                data_bits: (low & 0b11) + 5,
                parity,
                stop_bits: if low & 0x20 == 0 { 1 } else { 2 },
            },
        })
    }

    /// The value of a module as it is shipped: 9600 bit/s, 8 bits, no parity, CTS heeded (R-ESD-103).
    pub const DEFAULT_VALUE: u16 = 0x2273;

    /// Bytes per second that a line can bring, with one stop bit: devices send no fewer.
    #[must_use]
    pub fn receives(self) -> u32 {
        let bits = 2 + u32::from(self.format.data_bits) + u32::from(self.format.parity != Parity::None);
        self.receive.bits_per_second() / bits
    }

    /// How long one byte takes on its way out, with start bit, parity and stop bits.
    #[must_use]
    pub fn byte_time(self) -> Duration {
        let bits =
            1 + self.format.data_bits + u8::from(self.format.parity != Parity::None) + self.format.stop_bits;
        Duration::from_secs(1) * u32::from(bits) / self.transmit.bits_per_second()
    }
}

/// How long one byte takes on its way out with a value of the parameter "Serial mode", on a line that has so many stop bits at
/// least. Where the parity mode is one whose meaning is not known, the longer way is assumed.
#[must_use]
pub fn byte_time_of(value: u16, stop_bits: u8) -> Duration {
    let [rates, low] = value.to_be_bytes();
    let has_parity = (low >> 3) & 0b11 != 0b10;
    let bits = 1 + (low & 0b11) + 5 + u8::from(has_parity) + stop_bits;
    Duration::from_secs(1) * u32::from(bits) / Rate(rates & 0x0F).bits_per_second()
}

/// Bits of the parameter "Serial mode": those that somebody asks for. The others stay as a module has them.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct SerialBits(pub u16);

impl SerialBits {
    /// Rate from the line to the module.
    pub const RECEIVE: Self = Self(0xF000);
    /// Rate from the module to the line.
    pub const TRANSMIT: Self = Self(0x0F00);
    /// RTS.
    pub const RTS: Self = Self(0x0080);
    /// CTS.
    pub const CTS: Self = Self(0x0040);
    /// Stop bits.
    pub const STOP_BITS: Self = Self(0x0020);
    /// Whether there is a parity bit.
    pub const PARITY_MODE: Self = Self(0x0018);
    /// Which parity; means nothing without one.
    pub const PARITY_TYPE: Self = Self(0x0004);
    /// Length of a character.
    pub const DATA_BITS: Self = Self(0x0003);
    /// All of them.
    pub const ALL: Self = Self(0xFFFF);

    /// These and those, where `also` holds.
    #[must_use]
    pub fn and(self, also: bool, those: Self) -> Self {
        if also { Self(self.0 | those.0) } else { self }
    }

    /// Whether all of those are among them.
    #[must_use]
    pub fn has(self, those: Self) -> bool {
        self.0 & those.0 == those.0
    }

    /// What a module has, with these bits as they are wanted.
    #[must_use]
    pub fn merged(self, found: u16, wanted: u16) -> u16 {
        (found & !self.0) | (wanted & self.0)
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn r_esd_091_092_v_esd_09_can_tx_mode_as_a_value() {
        assert_eq!(CanTxMode::DEFAULT.value(), 0x1411);
        assert_eq!(CanTxMode::from_value(0x1411), Some(CanTxMode::DEFAULT));
        let end_mark = CanTxMode { inhibit: 20, max_char: 8, min_char: MinChar::CrDropped };
        assert_eq!(end_mark.value(), 0x148B);
        let packed = CanTxMode { inhibit: 20, max_char: 8, min_char: MinChar::Bytes(4) };
        assert_eq!((packed.value(), packed.value_with_min_char_high()), (0x1484, 0x1448));
    }

    #[test]
    fn r_esd_093_094_reserved_codes_are_refused_and_end_marks_are_not() {
        for value in [0x1410, 0x141F, 0x1401, 0x1491] {
            assert_eq!(CanTxMode::from_value(value), None, "{value:04X}");
        }
        for code in 1..=0xE {
            assert_eq!(MinChar::from_code(code).map(MinChar::code), Some(code));
        }
    }

    #[test]
    fn r_esd_095_to_103_v_esd_09_serial_mode_as_a_value() {
        let default = SerialMode::from_value(SerialMode::DEFAULT_VALUE).unwrap();
        assert_eq!((default.receive.bits_per_second(), default.transmit.bits_per_second()), (9_600, 9_600));
        assert!(default.cts && !default.rts);
        assert_eq!(default.format, LineFormat { data_bits: 8, parity: Parity::None, stop_bits: 2 });
        let rate = Rate::new(19_200).unwrap();
        assert_eq!(SerialMode { receive: rate, transmit: rate, ..default }.value(), 0x1173);
        assert_eq!(SerialMode::from_value(0x2200 | 0b0001_1000), None, "parity mode 11");
        assert_eq!(SerialMode::from_value(0x2200 | 0b0000_1000), None, "parity mode 01");
    }

    #[test]
    fn r_esd_096_rates_have_codes() {
        let codes = [38_400, 19_200, 9_600, 4_800, 150, 7_200, 115_200, 230_400, 76_800]
            .map(|rate| Rate::new(rate).unwrap().code());
        assert_eq!(codes, [0x0, 0x1, 0x2, 0x3, 0x8, 0x9, 0xD, 0xE, 0xF]);
        assert_eq!(Rate::new(500_000), None, "no code (K-ESD-05)");
    }

    #[test]
    fn r_esd_101_from_public_copies_parity_type_0_is_even() {
        let mode = SerialMode::from_value(0x2243).unwrap();
        assert_eq!(mode.format.parity, Parity::Even);
        assert_eq!(SerialMode::from_value(0x2247).unwrap().format.parity, Parity::Odd);
    }

    #[test]
    fn numbers_of_parameters_are_those_of_the_manual() {
        assert_eq!([1, 2, 3, 4, 5].map(can_tx_mode_of), [0x01, 0x09, 0x11, 0x19, 0x21]);
        assert_eq!([1, 2, 3, 4, 5].map(serial_mode_of), [0x02, 0x0A, 0x12, 0x1A, 0x22]);
    }

    #[test]
    fn a_byte_takes_as_long_as_its_bits() {
        let mode = SerialMode::from_value(0x0013).unwrap();
        assert_eq!(mode.format, LineFormat { data_bits: 8, parity: Parity::None, stop_bits: 1 });
        assert_eq!(mode.byte_time(), Duration::from_nanos(260_416));
    }

    proptest! {
        #[test]
        fn what_is_understood_is_written_back_as_it_was(value: u16) {
            if let Some(mode) = CanTxMode::from_value(value) {
                prop_assert_eq!(mode.value(), value);
            }
            if let Some(mode) = SerialMode::from_value(value) {
                // The parity type means nothing without parity.
                let shown = if mode.format.parity == Parity::None { value & !0b100 } else { value };
                prop_assert_eq!(mode.value(), shown);
            }
        }
    }
}
