//! The slave's side of LSS (CiA DSP305), without fastscan. Pure.
//!
//! Written for itself: it shares nothing with the master in `canopen`, whose judge it is. It knows requests and answers;
//! what is stored and what becomes of it on the bus is the device's business.

use std::time::Duration;

use crate::canopen::NodeId;

/// What makes a device unique: the four entries of 0x1018 (R-DST-095).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct LssAddress {
    /// Maker.
    pub vendor: u32,
    /// Product.
    pub product: u32,
    /// Revision.
    pub revision: u32,
    /// Serial number.
    pub serial: u32,
}

/// What the device has to do for a request.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LssEffect {
    /// Keep these for good; `None` = as it is.
    Store {
        /// The node id that was configured.
        node: Option<NodeId>,
        /// The index of the bit timing that was configured.
        bit_timing: Option<u8>,
    },
    /// Be silent for this long, switch to the stored bit rate, be silent for this long again (R-DST-102).
    ActivateBitTiming(Duration),
    /// The configuration state was left: a stored node id becomes active (R-DST-098).
    Waiting,
}

/// What becomes of a request.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct LssReaction {
    /// To be sent at once.
    pub answer: Option<[u8; 8]>,
    /// To be done.
    pub effect: Option<LssEffect>,
}

/// What the slave has to know of its device to answer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct LssFacts {
    /// The node id that is stored (R-DST-105).
    pub stored_node: NodeId,
    /// Whether the device counts as not configured (R-DST-109).
    pub unconfigured: bool,
}

/// The slave. In waiting state when made.
#[derive(Clone, Debug)]
pub struct LssSlave {
    address: LssAddress,
    configuration: bool,
    /// How many requests of switch state selective came in turn and matched.
    selected: usize,
    /// How many requests of identify remote slave came in turn and matched.
    identified: usize,
    /// Low revision of an identify request that is under way.
    revision_low: u32,
    node: Option<NodeId>,
    bit_timing: Option<u8>,
}

/// The indices of the standard table of bit timings that a device supports, 5 being reserved (R-DST-116).
#[must_use]
pub fn bit_timing_is_supported(index: u8) -> bool {
    index <= 7 && index != 5
}

impl LssSlave {
    /// A slave in waiting state.
    #[must_use]
    pub fn new(address: LssAddress) -> Self {
        Self {
            address,
            configuration: false,
            selected: 0,
            identified: 0,
            revision_low: 0,
            node: None,
            bit_timing: None,
        }
    }

    /// As after power-on: waiting, and nothing configured.
    pub fn reset(&mut self) {
        *self = Self::new(self.address);
    }

    /// Whether it is in configuration state.
    #[must_use]
    pub fn is_in_configuration(&self) -> bool {
        self.configuration
    }

    /// Takes a request on 0x7E5, of which all 8 bytes are there.
    pub fn handle_request(&mut self, request: [u8; 8], facts: LssFacts) -> LssReaction {
        let [command, a, b, c, d, ..] = request;
        let number = u32::from_le_bytes([a, b, c, d]);
        if !(0x40..=0x43).contains(&command) {
            self.selected = 0;
        }
        if !(0x46..=0x4B).contains(&command) {
            self.identified = 0;
        }
        match command {
            0x04 => self.switch_global(a),
            0x40..=0x43 => self.select(usize::from(command - 0x40), number),
            0x46..=0x4B => self.identify(usize::from(command - 0x46), number),
            0x4C if facts.unconfigured => answer([0x50, 0, 0, 0, 0]),
            _ if self.configuration => self.configure(command, a, b, facts),
            _ => LssReaction::default(),
        }
    }

    fn switch_global(&mut self, mode: u8) -> LssReaction {
        match mode {
            0 if self.configuration => {
                // What was not stored is lost (R-DST-096).
                self.reset();
                LssReaction { answer: None, effect: Some(LssEffect::Waiting) }
            }
            1 => {
                self.configuration = true;
                LssReaction::default()
            }
            _ => LssReaction::default(),
        }
    }

    /// R-DST-099. Only in waiting state (R-DST-094).
    fn select(&mut self, step: usize, number: u32) -> LssReaction {
        let LssAddress { vendor, product, revision, serial } = self.address;
        let matches = match step {
            0 => number == vendor,
            1 => number == product,
            2 => number == revision || number == 0,
            _ => number == serial,
        };
        let in_turn = step == 0 || self.selected == step;
        self.selected = if matches && in_turn && !self.configuration { step + 1 } else { 0 };
        if self.selected < 4 {
            return LssReaction::default();
        }
        self.selected = 0;
        self.configuration = true;
        answer([0x44, 0, 0, 0, 0])
    }

    /// R-DST-106, R-DST-107, R-DST-108.
    fn identify(&mut self, step: usize, number: u32) -> LssReaction {
        let LssAddress { vendor, product, revision, serial } = self.address;
        let matches = match step {
            0 => number == vendor,
            1 => number == product,
            2 => {
                self.revision_low = number;
                true
            }
            3 => (self.revision_low == 0 && number == 0) || (self.revision_low..=number).contains(&revision),
            4 => number <= serial,
            _ => serial <= number,
        };
        let in_turn = step == 0 || self.identified == step;
        self.identified = if matches && in_turn { step + 1 } else { 0 };
        if self.identified < 6 {
            return LssReaction::default();
        }
        self.identified = 0;
        answer([0x4F, 0, 0, 0, 0])
    }

    fn configure(&mut self, command: u8, a: u8, b: u8, facts: LssFacts) -> LssReaction {
        match command {
            0x11 => {
                self.node = NodeId::new(a).or(self.node);
                answer([0x11, u8::from(NodeId::new(a).is_none()), 0, 0, 0])
            }
            0x13 => {
                let supported = a == 0 && bit_timing_is_supported(b);
                self.bit_timing = if supported { Some(b) } else { self.bit_timing };
                answer([0x13, u8::from(!supported), 0, 0, 0])
            }
            0x15 => {
                let delay = Duration::from_millis(u64::from(u16::from_le_bytes([a, b])));
                LssReaction { answer: None, effect: Some(LssEffect::ActivateBitTiming(delay)) }
            }
            0x17 => self.store(),
            0x5A => inquiry(command, self.address.vendor),
            0x5B => inquiry(command, self.address.product),
            0x5C => inquiry(command, self.address.revision),
            0x5D => inquiry(command, self.address.serial),
            0x5E => answer([0x5E, facts.stored_node.get(), 0, 0, 0]),
            _ => LssReaction::default(),
        }
    }

    /// R-DST-103.
    fn store(&mut self) -> LssReaction {
        let (node, bit_timing) = (self.node.take(), self.bit_timing.take());
        if node.is_none() && bit_timing.is_none() {
            return answer([0x17, 0xFF, 1, 0, 0]);
        }
        let effect = Some(LssEffect::Store { node, bit_timing });
        LssReaction { effect, ..answer([0x17, 0, 0, 0, 0]) }
    }
}

fn inquiry(command: u8, number: u32) -> LssReaction {
    let [a, b, c, d] = number.to_le_bytes();
    answer([command, a, b, c, d])
}

fn answer([command, a, b, c, d]: [u8; 5]) -> LssReaction {
    LssReaction { answer: Some([command, a, b, c, d, 0, 0, 0]), effect: None }
}

#[cfg(test)]
mod tests {
    use super::*;

    const FACTS: LssFacts = LssFacts { stored_node: NodeId::new(1).unwrap(), unconfigured: false };

    fn slave() -> LssSlave {
        LssSlave::new(LssAddress { vendor: 0x23D, product: 7, revision: 0x0001_0203, serial: 100 })
    }

    fn ask(slave: &mut LssSlave, command: u8, number: u32) -> Option<u8> {
        let [a, b, c, d] = number.to_le_bytes();
        slave.handle_request([command, a, b, c, d, 0, 0, 0], FACTS).answer.map(|answer| answer[0])
    }

    fn identify(numbers: [(u8, u32); 6]) -> Option<u8> {
        let mut slave = slave();
        numbers.into_iter().find_map(|(command, number)| ask(&mut slave, command, number))
    }

    #[test]
    fn r_dst_106_107_a_slave_is_identified_by_ranges_that_contain_it() {
        let by = |revision: (u32, u32), serial: (u32, u32)| {
            identify([
                (0x46, 0x23D),
                (0x47, 7),
                (0x48, revision.0),
                (0x49, revision.1),
                (0x4A, serial.0),
                (0x4B, serial.1),
            ])
        };
        let found = [
            ((0, 0), (0, u32::MAX)),
            ((0x0001_0203, 0x0001_0203), (100, 100)),
            ((0, 0x0002_0000), (50, 100)),
        ];
        for (revision, serial) in found {
            assert_eq!(by(revision, serial), Some(0x4F), "{revision:?} {serial:?}");
        }
        let missed = [
            ((0, 0), (101, 200)),
            ((0, 0), (0, 99)),
            ((0x0001_0204, u32::MAX), (0, u32::MAX)),
            ((0, 1), (0, u32::MAX)),
            ((1, 0), (0, u32::MAX)),
        ];
        for (revision, serial) in missed {
            assert_eq!(by(revision, serial), None, "{revision:?} {serial:?}");
        }
    }

    #[test]
    fn r_dst_108_identify_requests_out_of_order_are_not_answered() {
        let right = [(0x46, 0x23D), (0x47, 7), (0x48, 0), (0x49, 0), (0x4A, 0), (0x4B, u32::MAX)];
        assert_eq!(identify(right), Some(0x4F));
        for (first, second) in [(0, 1), (1, 2), (2, 3), (3, 4), (4, 5)] {
            let mut wrong = right;
            wrong.swap(first, second);
            assert_eq!(identify(wrong), None, "{first} {second}");
        }
        let mut slave = slave();
        for (command, number) in right.into_iter().take(5) {
            ask(&mut slave, command, number);
        }
        assert_eq!(ask(&mut slave, 0x4C, 0), None, "another service in between");
        assert_eq!(ask(&mut slave, 0x4B, u32::MAX), None);
    }

    #[test]
    fn r_dst_094_services_of_the_configuration_state_are_not_answered_in_waiting_state() {
        let mut slave = slave();
        for command in [0x11, 0x13, 0x15, 0x17, 0x5A, 0x5B, 0x5C, 0x5D, 0x5E] {
            assert_eq!(slave.handle_request([command, 1, 0, 0, 0, 0, 0, 0], FACTS), LssReaction::default());
        }
        ask(&mut slave, 0x04, 1);
        assert!(slave.is_in_configuration());
        for (command, answered) in [(0x5A, true), (0x5E, true), (0x44, false), (0xFF, false)] {
            assert_eq!(ask(&mut slave, command, 0), answered.then_some(command));
        }
        // Both identify services work in both states, switch state selective in waiting state only.
        for (command, number) in [(0x40, 0x23D), (0x41, 7), (0x42, 0), (0x43, 100)] {
            assert_eq!(ask(&mut slave, command, number), None);
        }
    }

    #[test]
    fn r_dst_099_one_wrong_number_leaves_the_slave_waiting() {
        let right = [(0x40, 0x23D), (0x41, 7), (0x42, 0x0001_0203), (0x43, 100)];
        for wrong in 0..4 {
            let mut slave = slave();
            let last = (0..4).find_map(|step| {
                let (command, number) = right[step];
                ask(&mut slave, command, if step == wrong { number + 1 } else { number })
            });
            assert_eq!((last, slave.is_in_configuration()), (None, false), "{wrong}");
        }
    }

    #[test]
    fn r_dst_096_what_is_not_stored_is_lost_with_the_configuration_state() {
        let mut slave = slave();
        ask(&mut slave, 0x04, 1);
        assert_eq!(ask(&mut slave, 0x11, 5), Some(0x11));
        let left = slave.handle_request([0x04, 0, 0, 0, 0, 0, 0, 0], FACTS);
        assert_eq!(left.effect, Some(LssEffect::Waiting));
        ask(&mut slave, 0x04, 1);
        let stored = slave.handle_request([0x17, 0, 0, 0, 0, 0, 0, 0], FACTS);
        assert_eq!(stored.answer, Some([0x17, 0xFF, 1, 0, 0, 0, 0, 0]));
        assert_eq!(stored.effect, None);
    }
}
