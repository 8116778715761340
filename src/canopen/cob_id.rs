//! Node ids and the identifiers of the predefined connection set (CiA 301).

use std::fmt;

use crate::can::CanId;

/// A CANopen node id, 1..=127 (R-DET-005).
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct NodeId(u8);

impl NodeId {
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn r_det_005_r_dst_003_120_node_ids_are_1_to_127() {
        let valid: Vec<u8> = (0..=255).filter(|id| NodeId::new(*id).is_some()).collect();
        assert_eq!(valid, (1..=127).collect::<Vec<u8>>());
    }
}
