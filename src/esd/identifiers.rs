//! Module numbers, kinds of modules, and the identifiers that follow from the coding switch.

use std::fmt;

use crate::can::CanId;

/// All commands go to this identifier, and no module answers on it (R-ESD-044). In CANopen it would belong to the error
/// control of node 0, which does not exist (R-ESD-023).
pub const INIT_ID: CanId = CanId::Standard(0x700);

/// Each step of the coding switch is worth so many identifiers (R-ESD-013).
const IDENTIFIERS_OF_A_SWITCH: u16 = 10;

/// The number that a module listens to, 1..=254: 0 means all modules, and 255 is used where numbers are programmed
/// (R-ESD-049).
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct ModuleNumber(u8);

impl ModuleNumber {
    /// `None` for 0 and 255.
    #[must_use]
    pub const fn new(number: u8) -> Option<Self> {
        if number >= 1 && number <= 254 { Some(Self(number)) } else { None }
    }

    /// The number.
    #[must_use]
    pub const fn get(self) -> u8 {
        self.0
    }
}

impl fmt::Display for ModuleNumber {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "0x{:02X}", self.0)
    }
}

/// A kind of module.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum ModuleKind {
    /// CAN-CBM-SIO1: one serial line.
    Sio1,
    /// CAN-CBM-SIO4: five serial lines, the fifth of which is its terminal interface.
    Sio4,
}

impl ModuleKind {
    /// Serial lines (R-ESD-016).
    #[must_use]
    pub const fn channels(self) -> u8 {
        match self {
            Self::Sio1 => 1,
            Self::Sio4 => 5,
        }
    }

    /// Its code in the answer to the question for the module type (R-ESD-058).
    #[must_use]
    pub const fn code(self) -> u8 {
        match self {
            Self::Sio1 => 0x30,
            Self::Sio4 => 0x31,
        }
    }

    /// The model, as it stands on the module.
    #[must_use]
    pub const fn model(self) -> &'static str {
        match self {
            Self::Sio1 => "CAN-CBM-SIO1",
            Self::Sio4 => "CAN-CBM-SIO4",
        }
    }

    /// Whether a channel is on the DSUB9 connector, which has fewer line formats and ignores CTS (R-ESD-012).
    #[must_use]
    pub const fn is_terminal(self, channel: u8) -> bool {
        match self {
            Self::Sio1 => true,
            Self::Sio4 => channel == 5,
        }
    }

    /// Highest value of the coding switch with which all identifiers have 11 bits (R-ESD-021).
    #[must_use]
    pub const fn highest_switch(self) -> u8 {
        match self {
            Self::Sio1 => 0xCC,
            Self::Sio4 => 0xCB,
        }
    }

    /// `TxId` (module to us) and `RxId` (us to module) of a channel, 1-based, as they follow from the coding switch
    /// (R-ESD-013..015). `None` where there is no such channel, for switch 0, whose identifier would be that of NMT
    /// (U-ESD-17), and above [`highest_switch`](Self::highest_switch).
    #[must_use]
    pub fn identifiers(self, switch: u8, channel: u8) -> Option<[CanId; 2]> {
        if switch == 0 || switch > self.highest_switch() || channel == 0 || channel > self.channels() {
            return None;
        }
        let transmit = IDENTIFIERS_OF_A_SWITCH * u16::from(switch) + u16::from(channel) - 1;
        Some([CanId::standard(transmit)?, CanId::standard(transmit + u16::from(self.channels()))?])
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ids(kind: ModuleKind, switch: u8) -> Vec<[u32; 2]> {
        (1..=kind.channels())
            .map(|channel| kind.identifiers(switch, channel).unwrap().map(CanId::raw))
            .collect()
    }

    #[test]
    fn r_esd_013_014_015_018_v_esd_01_identifiers_follow_from_the_coding_switch() {
        assert_eq!(
            ids(ModuleKind::Sio4, 0x11),
            [[0x0AA, 0x0AF], [0x0AB, 0x0B0], [0x0AC, 0x0B1], [0x0AD, 0x0B2], [0x0AE, 0x0B3]]
        );
        assert_eq!(ids(ModuleKind::Sio1, 0x11), [[0x0AA, 0x0AB]]);
        assert_eq!(ids(ModuleKind::Sio1, 0x23), [[0x15E, 0x15F]]);
        assert_eq!(ids(ModuleKind::Sio1, 0x12), [[0x0B4, 0x0B5]]);
        assert_eq!(ids(ModuleKind::Sio4, 0xCB).last(), Some(&[0x7F2, 0x7F7]));
        assert_eq!(ids(ModuleKind::Sio1, 0xCC), [[0x7F8, 0x7F9]]);
    }

    #[test]
    fn r_esd_002_all_identifiers_of_all_switches_have_11_bits() {
        for kind in [ModuleKind::Sio1, ModuleKind::Sio4] {
            for switch in 1..=kind.highest_switch() {
                assert!(
                    ids(kind, switch).into_iter().flatten().all(|id| id <= 0x7FF),
                    "{kind:?} {switch:02X}"
                );
            }
        }
    }

    #[test]
    fn r_esd_021_switches_without_identifiers_of_11_bits_have_none() {
        assert_eq!(ModuleKind::Sio4.identifiers(0xCC, 1), None);
        assert_eq!(ModuleKind::Sio1.identifiers(0xCD, 1), None);
        assert_eq!(ModuleKind::Sio1.identifiers(0, 1), None);
        assert_eq!(ModuleKind::Sio1.identifiers(0x11, 2), None);
        assert_eq!(ModuleKind::Sio4.identifiers(0x11, 6), None);
    }

    #[test]
    fn r_esd_049_a_module_has_a_number_from_1_to_254() {
        assert_eq!([0, 255].map(ModuleNumber::new), [None, None]);
        assert_eq!([1, 254].map(|number| ModuleNumber::new(number).unwrap().get()), [1, 254]);
    }

    #[test]
    fn r_esd_016_channel_5_of_a_sio4_is_its_terminal_interface() {
        assert_eq!((1..=5).map(|channel| ModuleKind::Sio4.is_terminal(channel)).position(|it| it), Some(4));
        assert!(ModuleKind::Sio1.is_terminal(1));
    }
}
