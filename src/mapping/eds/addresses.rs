//! Gives register and bit addresses away: in order, without gaps, none twice.

use std::ops::Range;

/// Lowest register of device data; below are those of the node itself.
const FIRST_REGISTER: usize = 100;
/// Bits of the node's alarms.
const ALARM_BITS: Range<usize> = 128..192;
/// Addresses of a unit.
const SPACE: usize = 65_536;

/// Which addresses are taken, and where new ones begin.
#[derive(Clone, Debug)]
pub struct Addresses {
    registers: Vec<bool>,
    bits: Vec<bool>,
    next_register: usize,
    next_bit: usize,
    /// An odd address that an aligned value left free.
    hole: Option<usize>,
}

impl Default for Addresses {
    fn default() -> Self {
        let mut bits = vec![false; SPACE];
        for bit in bits.iter_mut().take(ALARM_BITS.end).skip(ALARM_BITS.start) {
            *bit = true;
        }
        Self { registers: vec![false; SPACE], bits, next_register: FIRST_REGISTER, next_bit: 0, hole: None }
    }
}

impl Addresses {
    /// Keeps registers from being given away.
    pub fn claim_registers(&mut self, addresses: Range<u64>) {
        claim(&mut self.registers, addresses);
    }

    /// Keeps bits from being given away.
    pub fn claim_bits(&mut self, addresses: Range<u64>) {
        claim(&mut self.bits, addresses);
    }

    /// New addresses lie at or above these.
    pub fn begin_at(&mut self, register: u64, bit: u64) {
        let limited = |address| usize::try_from(address).unwrap_or(SPACE).min(SPACE);
        self.next_register = self.next_register.max(limited(register));
        self.next_bit = self.next_bit.max(limited(bit));
    }

    /// One or two registers; two begin at an even address. `None` when there are no more.
    pub fn registers(&mut self, count: u16) -> Option<u16> {
        if count == 1 {
            let address = match self.hole.take() {
                Some(hole) => hole,
                None => self.single()?,
            };
            return u16::try_from(address).ok();
        }
        let mut first = self.single()?;
        while !first.is_multiple_of(2) || self.registers.get(first + 1).copied().unwrap_or(true) {
            self.hole = self.hole.or(Some(first));
            first = self.single()?;
        }
        self.next_register = first + 2;
        u16::try_from(first).ok()
    }

    /// The next free register.
    fn single(&mut self) -> Option<usize> {
        let found = free(&self.registers, self.next_register)?;
        self.next_register = found + 1;
        Some(found)
    }

    /// A bit. `None` when there are no more.
    pub fn bit(&mut self) -> Option<u16> {
        let found = free(&self.bits, self.next_bit)?;
        self.next_bit = found + 1;
        u16::try_from(found).ok()
    }
}

fn claim(space: &mut [bool], addresses: Range<u64>) {
    let index = |address| usize::try_from(address).unwrap_or(SPACE).min(SPACE);
    for slot in space.get_mut(index(addresses.start)..index(addresses.end)).unwrap_or_default() {
        *slot = true;
    }
}

fn free(space: &[bool], from: usize) -> Option<usize> {
    let rest = space.get(from..)?;
    rest.iter().position(|taken| !taken).map(|at| from + at)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn r_esd_122_addresses_follow_each_other_and_a_hole_takes_the_next_small_value() {
        let mut addresses = Addresses::default();
        let given: Vec<_> = [1, 2, 1, 2, 2, 1].map(|count| addresses.registers(count).unwrap()).into();
        assert_eq!(given, [100, 102, 101, 104, 106, 108]);
    }

    #[test]
    fn r_esd_121_what_is_taken_is_gone_round() {
        let mut addresses = Addresses::default();
        addresses.claim_registers(101..103);
        addresses.claim_registers(65_534..70_000);
        addresses.claim_bits(1..2);
        addresses.begin_at(100, 0);
        assert_eq!([1, 2, 1].map(|count| addresses.registers(count).unwrap()), [100, 104, 103]);
        assert_eq!([0; 2].map(|_| addresses.bit().unwrap()), [0, 2]);
        addresses.begin_at(65_533, 127);
        assert_eq!((addresses.registers(2), addresses.registers(1)), (None, Some(65_533)));
        assert_eq!([0; 2].map(|_| addresses.bit().unwrap()), [127, 192], "bits 128 to 191 are the alarms'");
        addresses.begin_at(u64::MAX, u64::MAX);
        assert_eq!((addresses.registers(1), addresses.bit()), (None, None));
    }
}
