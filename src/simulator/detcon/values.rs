//! What a `DetCon` measures and reports, and how it stands in the four TPDOs.

use std::fmt;

use crate::can::CanId;
use crate::canopen::NodeId;

/// A knock sensor channel, 1..=20.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Channel(u8);

impl Channel {
    /// How many there are.
    pub const COUNT: u8 = 20;

    /// `None` outside 1..=20.
    #[must_use]
    pub const fn new(number: u8) -> Option<Self> {
        if number >= 1 && number <= Self::COUNT { Some(Self(number)) } else { None }
    }

    /// The number.
    #[must_use]
    pub const fn get(self) -> u8 {
        self.0
    }

    /// All channels, in order.
    pub fn all() -> impl Iterator<Item = Self> {
        (1..=Self::COUNT).map(Self)
    }

    /// Place in an array of 20.
    #[must_use]
    pub fn index(self) -> usize {
        usize::from(self.0 - 1)
    }

    /// Its bit in a mask of channels: channel k is bit k - 1 (R-DET-060).
    #[must_use]
    pub const fn bit(self) -> u32 {
        1 << (self.0 - 1)
    }
}

impl fmt::Display for Channel {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Display::fmt(&self.0, f)
    }
}

/// A bit of the status byte that can be set by itself. Bit 0, engine knocking, cannot: it follows from
/// [`Values::knock`] (R-DET-076).
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum StatusBit {
    /// Bit 1: the engine was tripped.
    Trip,
    /// Bit 2: load is being reduced.
    LoadReduction,
    /// Bit 3: the engine turns slowly.
    LowRpm,
    /// Bit 4: the ignition gives no pulses.
    NoIsuPulses,
    /// Bit 5: a pulse came out of turn.
    SpuriousPulse,
    /// Bit 6: the parameter memory is faulty.
    EepromFault,
}

impl StatusBit {
    /// All of them, lowest bit first.
    pub const ALL: [Self; 6] = [
        Self::Trip,
        Self::LoadReduction,
        Self::LowRpm,
        Self::NoIsuPulses,
        Self::SpuriousPulse,
        Self::EepromFault,
    ];

    /// Its mask in TPDO3 byte 0 (R-DET-058).
    #[must_use]
    pub const fn mask(self) -> u8 {
        match self {
            Self::Trip => 0x02,
            Self::LoadReduction => 0x04,
            Self::LowRpm => 0x08,
            Self::NoIsuPulses => 0x10,
            Self::SpuriousPulse => 0x20,
            Self::EepromFault => 0x40,
        }
    }

    /// The word in scenarios and on the control line.
    #[must_use]
    pub const fn word(self) -> &'static str {
        match self {
            Self::Trip => "trip",
            Self::LoadReduction => "load_reduction",
            Self::LowRpm => "low_rpm",
            Self::NoIsuPulses => "no_isu_pulses",
            Self::SpuriousPulse => "spurious_pulse",
            Self::EepromFault => "eeprom_fault",
        }
    }
}

/// Bit 0 of the status byte.
const ENGINE_KNOCKING: u8 = 0x01;
/// Bit 7 of the status byte is reserved (R-DET-052).
const RESERVED_STATUS: u8 = 0x80;
/// The upper half of TPDO4 bytes 4 and 5 is reserved (R-DET-052).
const RESERVED_SENSORS: u8 = 0xF0;

/// One of the four TPDOs.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Tpdo {
    /// Knock intensities 1 to 8.
    One,
    /// Knock intensities 9 to 16.
    Two,
    /// Status, analogue output, sensors 1 to 16, limits.
    Three,
    /// Knock intensities 17 to 20, sensors 17 to 20.
    Four,
}

impl Tpdo {
    /// All of them, in order.
    pub const ALL: [Self; 4] = [Self::One, Self::Two, Self::Three, Self::Four];

    /// By its number, 1..=4.
    #[must_use]
    pub fn from_number(number: u8) -> Option<Self> {
        Self::ALL.into_iter().find(|tpdo| tpdo.number() == number)
    }

    /// 1..=4.
    #[must_use]
    pub const fn number(self) -> u8 {
        match self {
            Self::One => 1,
            Self::Two => 2,
            Self::Three => 3,
            Self::Four => 4,
        }
    }

    /// Place in an array of four.
    #[must_use]
    pub fn index(self) -> usize {
        usize::from(self.number() - 1)
    }

    /// Its identifier (R-DET-053, R-DET-055, R-DET-057, R-DET-064).
    #[must_use]
    pub fn can_id(self, node: NodeId) -> CanId {
        CanId::Standard(0x080 + 0x100 * u16::from(self.number()) + u16::from(node.get()))
    }

    /// Bytes that a healthy device sends.
    #[must_use]
    pub const fn length(self) -> u8 {
        match self {
            Self::One | Self::Two | Self::Three => 8,
            Self::Four => 6,
        }
    }
}

/// How the values are written into the TPDOs. The default is what devices are expected to do.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct WireFormat {
    /// The two 16-bit sensor fields most significant byte first (R-DET-050).
    pub big_endian_sensor_fields: bool,
    /// Status bits that are sent inverted (R-DET-051).
    pub status_invert_mask: u8,
    /// All reserved bits set (R-DET-052).
    pub reserved_bits: bool,
}

/// Everything that the TPDOs carry. Percentages are raw: 0 = 0 %, 255 = 100 % (R-DET-047).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Values {
    intensity: [u8; 20],
    used: u32,
    bad: u32,
    knocking: u32,
    status: u8,
    /// Analogue output.
    pub analog_output: u8,
    /// Ignition reduction limit.
    pub ignition_reduction_limit: u8,
    /// Immediate stop limit.
    pub immediate_stop_limit: u8,
}

impl Default for Values {
    /// All channels at 0 and unused, limits at 50 % and 80 %.
    fn default() -> Self {
        Self {
            intensity: [0; 20],
            used: 0,
            bad: 0,
            knocking: 0,
            status: 0,
            analog_output: 0,
            ignition_reduction_limit: 128,
            immediate_stop_limit: 204,
        }
    }
}

impl Values {
    /// Knock intensity of a channel, raw.
    #[must_use]
    pub fn intensity(&self, channel: Channel) -> u8 {
        self.intensity.get(channel.index()).copied().unwrap_or_default()
    }

    /// Sets the knock intensity of a channel, raw.
    pub fn set_intensity(&mut self, channel: Channel, raw: u8) {
        if let Some(slot) = self.intensity.get_mut(channel.index()) {
            *slot = raw;
        }
    }

    /// Whether the device is set up to use this sensor.
    #[must_use]
    pub fn is_used(&self, channel: Channel) -> bool {
        self.used & channel.bit() != 0
    }

    /// Sets whether the device uses this sensor.
    pub fn set_used(&mut self, channel: Channel, used: bool) {
        set_bit(&mut self.used, channel, used);
    }

    /// Whether the input of this channel is reported bad.
    #[must_use]
    pub fn is_bad(&self, channel: Channel) -> bool {
        self.bad & channel.bit() != 0
    }

    /// Sets whether the input of this channel is reported bad.
    pub fn set_bad(&mut self, channel: Channel, bad: bool) {
        set_bit(&mut self.bad, channel, bad);
    }

    /// A channel begins or ends to knock. While any knocks, bit 0 of the status is set (R-DET-076) and TPDO1, 2 and 4
    /// come faster (R-DET-069).
    pub fn knock(&mut self, channel: Channel, on: bool) {
        set_bit(&mut self.knocking, channel, on);
    }

    /// Whether any channel knocks.
    #[must_use]
    pub fn is_knocking(&self) -> bool {
        self.knocking != 0
    }

    /// Whether a status bit is set.
    #[must_use]
    pub fn status(&self, bit: StatusBit) -> bool {
        self.status & bit.mask() != 0
    }

    /// Sets a status bit.
    pub fn set_status(&mut self, bit: StatusBit, on: bool) {
        if on {
            self.status |= bit.mask();
        } else {
            self.status &= !bit.mask();
        }
    }

    /// The data of a TPDO; [`Tpdo::length`] of the bytes are meant, the others are 0.
    #[must_use]
    pub fn encode(&self, tpdo: Tpdo, format: WireFormat) -> [u8; 8] {
        match tpdo {
            Tpdo::One => self.intensities(1),
            Tpdo::Two => self.intensities(9),
            Tpdo::Three => self.encode_status(format),
            Tpdo::Four => self.encode_last_channels(format),
        }
    }

    fn encode_status(&self, format: WireFormat) -> [u8; 8] {
        let knocking = if self.is_knocking() { ENGINE_KNOCKING } else { 0 };
        let reserved = if format.reserved_bits { RESERVED_STATUS } else { 0 };
        let status = ((self.status | knocking) ^ (format.status_invert_mask & !RESERVED_STATUS)) | reserved;
        let [mut used_low, mut used_high, ..] = self.used.to_le_bytes();
        let [mut bad_low, mut bad_high, ..] = self.bad.to_le_bytes();
        if format.big_endian_sensor_fields {
            (used_low, used_high) = (used_high, used_low);
            (bad_low, bad_high) = (bad_high, bad_low);
        }
        [
            status,
            self.analog_output,
            used_low,
            used_high,
            bad_low,
            bad_high,
            self.ignition_reduction_limit,
            self.immediate_stop_limit,
        ]
    }

    fn encode_last_channels(&self, format: WireFormat) -> [u8; 8] {
        let reserved = if format.reserved_bits { RESERVED_SENSORS } else { 0 };
        let [first, second, third, fourth, ..] = self.intensities(17);
        let [_, _, used, _] = self.used.to_le_bytes();
        let [_, _, bad, _] = self.bad.to_le_bytes();
        [first, second, third, fourth, used | reserved, bad | reserved, 0, 0]
    }

    /// Up to eight intensities from `first` on, 0 beyond the last channel.
    fn intensities(&self, first: u8) -> [u8; 8] {
        let mut bytes = [0; 8];
        for (byte, raw) in bytes.iter_mut().zip(self.intensity.iter().skip(usize::from(first - 1))) {
            *byte = *raw;
        }
        bytes
    }
}

fn set_bit(mask: &mut u32, channel: Channel, on: bool) {
    if on {
        *mask |= channel.bit();
    } else {
        *mask &= !channel.bit();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn channel(number: u8) -> Channel {
        Channel::new(number).unwrap()
    }

    fn plain(values: &Values, tpdo: Tpdo) -> [u8; 8] {
        values.encode(tpdo, WireFormat::default())
    }

    #[test]
    fn r_det_053_055_057_064_identifiers_and_lengths() {
        let node = NodeId::new(1).unwrap();
        let ids = Tpdo::ALL.map(|tpdo| (tpdo.can_id(node).raw(), tpdo.length()));
        assert_eq!(ids, [(0x181, 8), (0x281, 8), (0x381, 8), (0x481, 6)]);
        let node = NodeId::new(127).unwrap();
        let ids = Tpdo::ALL.map(|tpdo| tpdo.can_id(node).raw());
        assert_eq!(ids, [0x1FF, 0x2FF, 0x3FF, 0x4FF]);
    }

    #[test]
    fn r_det_047_054_056_065_each_channel_has_its_byte() {
        let mut values = Values::default();
        for channel in Channel::all() {
            values.set_intensity(channel, channel.get() * 10);
        }
        assert_eq!(plain(&values, Tpdo::One), [10, 20, 30, 40, 50, 60, 70, 80]);
        assert_eq!(plain(&values, Tpdo::Two), [90, 100, 110, 120, 130, 140, 150, 160]);
        assert_eq!(plain(&values, Tpdo::Four), [170, 180, 190, 200, 0, 0, 0, 0]);
    }

    #[test]
    fn r_det_058_each_status_has_its_bit() {
        let mut values = Values::default();
        values.knock(channel(18), true);
        assert_eq!(plain(&values, Tpdo::Three)[0], 0x01);
        values.knock(channel(18), false);
        for (at, bit) in StatusBit::ALL.into_iter().enumerate() {
            values.set_status(bit, true);
            assert_eq!(plain(&values, Tpdo::Three)[0], 2 << at, "{}", bit.word());
            values.set_status(bit, false);
        }
    }

    #[test]
    fn r_det_050_060_061_066_067_each_sensor_has_its_bit() {
        for channel in Channel::all() {
            let mut values = Values::default();
            values.set_used(channel, true);
            let used = plain(&values, Tpdo::Three);
            let last = plain(&values, Tpdo::Four);
            let field = u32::from(used[2]) | u32::from(used[3]) << 8 | u32::from(last[4]) << 16;
            assert_eq!(field, channel.bit());
            values.set_used(channel, false);
            values.set_bad(channel, true);
            let bad = plain(&values, Tpdo::Three);
            let last = plain(&values, Tpdo::Four);
            let field = u32::from(bad[4]) | u32::from(bad[5]) << 8 | u32::from(last[5]) << 16;
            assert_eq!(field, channel.bit());
        }
    }

    #[test]
    fn r_det_050_the_sensor_fields_can_be_sent_most_significant_byte_first() {
        let mut values = Values::default();
        values.set_used(channel(1), true);
        values.set_bad(channel(9), true);
        let format = WireFormat { big_endian_sensor_fields: true, ..WireFormat::default() };
        assert_eq!(values.encode(Tpdo::Three, format)[2..6], [0x00, 0x01, 0x01, 0x00]);
    }

    #[test]
    fn r_det_051_a_set_bit_means_active_unless_inverted() {
        let mut values = Values::default();
        values.set_status(StatusBit::Trip, true);
        assert_eq!(plain(&values, Tpdo::Three)[0], 0x02);
        let format = WireFormat { status_invert_mask: 0x06, ..WireFormat::default() };
        assert_eq!(values.encode(Tpdo::Three, format)[0], 0x04);
    }

    #[test]
    fn r_det_052_reserved_bits_are_0_unless_a_test_sets_them() {
        let mut values = Values::default();
        for channel in Channel::all() {
            values.set_used(channel, true);
            values.set_bad(channel, true);
            values.knock(channel, true);
        }
        for bit in StatusBit::ALL {
            values.set_status(bit, true);
        }
        assert_eq!(plain(&values, Tpdo::Three)[0], 0x7F);
        assert_eq!(plain(&values, Tpdo::Four)[4..6], [0x0F, 0x0F]);
        let format = WireFormat { reserved_bits: true, status_invert_mask: 0xFF, ..WireFormat::default() };
        assert_eq!(values.encode(Tpdo::Three, format)[0], 0x80);
        assert_eq!(values.encode(Tpdo::Four, format)[4..6], [0xFF, 0xFF]);
    }

    #[test]
    fn r_det_059_062_063_analogue_output_and_limits_have_their_bytes() {
        let values = Values {
            analog_output: 0x11,
            ignition_reduction_limit: 0x66,
            immediate_stop_limit: 0x77,
            ..Values::default()
        };
        assert_eq!(plain(&values, Tpdo::Three), [0, 0x11, 0, 0, 0, 0, 0x66, 0x77]);
    }
}
