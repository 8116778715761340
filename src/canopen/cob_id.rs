//! Node ids and the identifiers of the predefined connection set (CiA 301).

use std::fmt;

use crate::can::CanId;

/// A CANopen node id, 1..=127 (R-DET-005).
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct NodeId(u8);

impl NodeId {
    /// 127.
    pub const HIGHEST: Self = Self(127);

    /// `None` outside 1..=127.
    #[must_use]
    pub const fn new(id: u8) -> Option<Self> {
        if id >= 1 && id <= 127 { Some(Self(id)) } else { None }
    }

    /// The number.
    #[must_use]
    pub const fn get(self) -> u8 {
        self.0
    }
}

impl fmt::Display for NodeId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}", self.0)
    }
}

impl fmt::Debug for NodeId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "node {}", self.0)
    }
}

/// NMT commands: everybody hears them.
pub const NMT: CanId = CanId::Standard(0x000);
/// SYNC.
pub const SYNC: CanId = CanId::Standard(0x080);
/// TIME.
pub const TIME: CanId = CanId::Standard(0x100);

/// Whether a CANopen device, also one that nobody has configured, may obey or send a frame of this identifier as it is shipped:
/// NMT; SYNC, emergency messages and TIME; PDOs and SDOs; NMT error control and 0x700 beside it; layer setting services.
#[must_use]
pub fn is_predefined(id: CanId) -> bool {
    matches!(id, CanId::Standard(0x000 | 0x080..=0x100 | 0x181..=0x67F | 0x700..=0x77F | 0x7E4 | 0x7E5))
}

/// The emergency message of a node.
#[must_use]
pub fn emcy(node: NodeId) -> CanId {
    CanId::Standard(0x080 + u16::from(node.get()))
}

/// Answers of the SDO server of a node.
#[must_use]
pub fn sdo_answer(node: NodeId) -> CanId {
    CanId::Standard(0x580 + u16::from(node.get()))
}

/// Boot-up, heartbeat and node guarding of a node.
#[must_use]
pub fn error_control(node: NodeId) -> CanId {
    CanId::Standard(0x700 + u16::from(node.get()))
}

/// The identifier in an object of type COB-ID (CiA 301: 0x1014, 0x1400:1 and their like): bit 29 says that it has 29 bits.
/// `None` where bit 31 says that it is not used.
#[must_use]
pub fn in_use(value: u32) -> Option<CanId> {
    const NOT_VALID: u32 = 1 << 31;
    const EXTENDED: u32 = 1 << 29;
    let id = if value & EXTENDED == 0 {
        u16::try_from(value & 0x7FF).ok().and_then(CanId::standard)
    } else {
        CanId::extended(value & 0x1FFF_FFFF)
    };
    id.filter(|_| value & NOT_VALID == 0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_high_bits_of_a_cob_id_say_how_long_it_is_and_whether_it_is_used() {
        for (value, id) in [
            (0x81, Some(CanId::Standard(0x81))),
            (0x4000_0181, Some(CanId::Standard(0x181))),
            (0x2001_2345, Some(CanId::Extended(0x1_2345))),
            (0x8000_0081, None),
            (0xA001_2345, None),
        ] {
            assert_eq!(in_use(value), id, "{value:X}");
        }
    }

    #[test]
    fn r_det_005_r_dst_003_120_node_ids_are_1_to_127() {
        let valid: Vec<u8> = (0..=255).filter(|id| NodeId::new(*id).is_some()).collect();
        assert_eq!(valid, (1..=127).collect::<Vec<u8>>());
    }
}
