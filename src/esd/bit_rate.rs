//! Bit rates of the CAN bus as modules take them: two registers of their controller (R-ESD-078, 079).

/// One of the 15 bit rates of the manual.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct CanBitRate {
    /// Its place in the table, 0x0..=0xE: what the coding switches select (R-ESD-080).
    pub index: u8,
    /// The registers BTR0 and BTR1 of a SJA1000 at 16 MHz.
    pub registers: [u8; 2],
}

/// BTR0 and BTR1, by index.
const REGISTERS: [[u8; 2]; 15] = [
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

/// Clock of the controller in Hz.
const CLOCK: u32 = 16_000_000;

impl CanBitRate {
    /// By its index; `None` from 0xF, which has no entry (K-ESD-06).
    #[must_use]
    pub fn from_index(index: u8) -> Option<Self> {
        Some(Self { index, registers: *REGISTERS.get(usize::from(index))? })
    }

    /// By the registers, as a module answers; `None` where they are none of the table.
    #[must_use]
    pub fn from_registers(registers: [u8; 2]) -> Option<Self> {
        Self::all().find(|rate| rate.registers == registers)
    }

    /// The rate that a bus of so many bit/s has; `None` where modules do not have it. Rates that are no whole numbers of bit/s
    /// are found by what stands before the point.
    #[must_use]
    pub fn from_bits_per_second(rate: u32) -> Option<Self> {
        Self::all().find(|each| each.bits_per_second() == rate)
    }

    /// All, the highest first.
    pub fn all() -> impl Iterator<Item = Self> {
        (0..).zip(REGISTERS).map(|(index, registers)| Self { index, registers })
    }

    /// bit/s, without what stands after the point.
    #[must_use]
    pub fn bits_per_second(self) -> u32 {
        let [first, second] = self.registers.map(u32::from);
        let prescaler = 2 * ((first & 0x3F) + 1);
        let quanta = 3 + (second & 0x0F) + ((second >> 4) & 0x07);
        CLOCK / (prescaler * quanta)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn r_esd_078_the_table_of_the_manual() {
        let rates: Vec<u32> = CanBitRate::all().map(CanBitRate::bits_per_second).collect();
        let expected = [
            1_000_000, 800_000, 666_666, 500_000, 333_333, 250_000, 166_666, 125_000, 100_000, 66_666,
            50_000, 33_333, 20_000, 12_500, 10_000,
        ];
        assert_eq!(rates, expected);
        assert_eq!(CanBitRate::from_index(0xF), None, "K-ESD-06");
    }

    #[test]
    fn r_esd_003_079_v_esd_10_125_kbit_s_as_registers() {
        let rate = CanBitRate::from_bits_per_second(125_000).unwrap();
        assert_eq!((rate.index, rate.registers), (7, [0x03, 0x1C]));
        assert_eq!(CanBitRate::from_registers([0x03, 0x1C]), Some(rate));
        assert_eq!(CanBitRate::from_registers([0x03, 0x1D]), None);
        assert_eq!(CanBitRate::from_bits_per_second(125_001), None);
    }
}
