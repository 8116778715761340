//! NMT states and commands (CiA 301).

use super::{NodeId, cob_id};
use crate::can::CanFrame;

/// State of a node as it reports it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum NmtState {
    /// Starting; code 0, also the boot-up message.
    Initialising,
    /// Stopped; code 4. No PDOs.
    Stopped,
    /// Operational; code 5.
    Operational,
    /// Pre-operational; code 127. No PDOs.
    PreOperational,
}

impl NmtState {
    /// The code on the bus, without the toggle bit.
    #[must_use]
    pub const fn code(self) -> u8 {
        match self {
            Self::Initialising => 0,
            Self::Stopped => 4,
            Self::Operational => 5,
            Self::PreOperational => 127,
        }
    }

    /// From the code on the bus; `None` for a code that CiA 301 does not define (R-DET-041).
    #[must_use]
    pub const fn from_code(code: u8) -> Option<Self> {
        match code {
            0 => Some(Self::Initialising),
            4 => Some(Self::Stopped),
            5 => Some(Self::Operational),
            127 => Some(Self::PreOperational),
            _ => None,
        }
    }

    /// The word in payloads, events and pages.
    #[must_use]
    pub const fn word(self) -> &'static str {
        match self {
            Self::Initialising => "initialising",
            Self::Stopped => "stopped",
            Self::Operational => "operational",
            Self::PreOperational => "pre_operational",
        }
    }
}

/// An NMT command.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum NmtRequest {
    /// 0x01
    Start,
    /// 0x02
    Stop,
    /// 0x80
    EnterPreOperational,
    /// 0x81
    ResetNode,
    /// 0x82
    ResetCommunication,
}

impl NmtRequest {
    /// The command byte.
    #[must_use]
    pub const fn code(self) -> u8 {
        match self {
            Self::Start => 0x01,
            Self::Stop => 0x02,
            Self::EnterPreOperational => 0x80,
            Self::ResetNode => 0x81,
            Self::ResetCommunication => 0x82,
        }
    }

    /// From the command byte.
    #[must_use]
    pub const fn from_code(code: u8) -> Option<Self> {
        match code {
            0x01 => Some(Self::Start),
            0x02 => Some(Self::Stop),
            0x80 => Some(Self::EnterPreOperational),
            0x81 => Some(Self::ResetNode),
            0x82 => Some(Self::ResetCommunication),
            _ => None,
        }
    }

    /// The frame that asks `node`, or all nodes when `None` (R-DET-007..010).
    #[must_use]
    pub fn frame(self, node: Option<NodeId>) -> CanFrame {
        let node = node.map_or(0, NodeId::get);
        CanFrame::data_frame(cob_id::NMT, &[self.code(), node])
            .unwrap_or_else(|| unreachable!("two bytes fit"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn v_det_01_r_det_007_to_010_r_dst_054_055_056_start_stop_and_reset_addressed_and_broadcast() {
        let node = NodeId::new(1);
        assert_eq!(NmtRequest::Start.frame(node).to_string(), "000#0101");
        assert_eq!(NmtRequest::Start.frame(None).to_string(), "000#0100");
        assert_eq!(NmtRequest::Stop.frame(node).to_string(), "000#0201");
        assert_eq!(NmtRequest::Stop.frame(None).to_string(), "000#0200");
        assert_eq!(NmtRequest::Start.frame(NodeId::new(127)).to_string(), "000#017F");
        assert_eq!(NmtRequest::ResetNode.frame(node).to_string(), "000#8101");
    }
}
