//! LSS frames (CiA 305): always 8 bytes, the first the command specifier, unused ones 0 (R-DST-091).

use super::{LssAddress, LssBitRate, LssRange, LssState};
use crate::can::CanId;
use crate::canopen::NodeId;

/// The identifier of what an LSS master sends.
pub const REQUEST_ID: CanId = CanId::Standard(0x7E5);
/// The identifier of what LSS slaves answer, all of them.
pub const ANSWER_ID: CanId = CanId::Standard(0x7E4);

/// The data of an LSS frame.
pub(super) type Payload = [u8; 8];

/// Command specifiers that are answered with themselves.
pub(super) const NODE_ID: u8 = 0x11;
pub(super) const BIT_RATE: u8 = 0x13;
pub(super) const STORE: u8 = 0x17;
pub(super) const INQUIRE_VENDOR: u8 = 0x5A;
pub(super) const INQUIRE_NODE_ID: u8 = 0x5E;
/// Answer to `switch selective`.
pub(super) const SELECTED: u8 = 0x44;
/// Answer to `identify remote slave` and fastscan.
pub(super) const IDENTIFIED: u8 = 0x4F;
/// Answer to `identify non-configured`.
pub(super) const NON_CONFIGURED: u8 = 0x50;

/// A node id for slaves that are to have none.
const NO_NODE_ID: u8 = 0xFF;

fn with_bytes(command: u8, first: u8, second: u8) -> Payload {
    [command, first, second, 0, 0, 0, 0, 0]
}

fn with_number(command: u8, number: u32) -> Payload {
    let [a, b, c, d] = number.to_le_bytes();
    [command, a, b, c, d, 0, 0, 0]
}

/// All slaves into a state (R-DST-097). Not answered.
pub(super) fn switch_global(state: LssState) -> Payload {
    with_bytes(0x04, u8::from(state == LssState::Configuration), 0)
}

/// One slave into configuration state (R-DST-099). Answered by [`SELECTED`].
pub(super) fn switch_selective(address: &LssAddress) -> [Payload; 4] {
    [
        with_number(0x40, address.vendor),
        with_number(0x41, address.product),
        with_number(0x42, address.revision),
        with_number(0x43, address.serial),
    ]
}

/// Node id (R-DST-100). Answered by [`NODE_ID`].
pub(super) fn configure_node_id(node: Option<NodeId>) -> Payload {
    with_bytes(NODE_ID, node.map_or(NO_NODE_ID, NodeId::get), 0)
}

/// Bit rate by the standard table, whose selector is 0 (R-DST-101). Answered by [`BIT_RATE`].
pub(super) fn configure_bit_rate(bit_rate: LssBitRate) -> Payload {
    with_bytes(BIT_RATE, 0, bit_rate.index())
}

/// Change to the stored bit rate after so many milliseconds (R-DST-102). Not answered.
pub(super) fn activate_bit_rate(delay_ms: u16) -> Payload {
    let [low, high] = delay_ms.to_le_bytes();
    with_bytes(0x15, low, high)
}

/// Without parameters: [`STORE`], [`INQUIRE_NODE_ID`], or a part of the address from [`INQUIRE_VENDOR`] on (R-DST-103..105).
pub(super) fn plain(command: u8) -> Payload {
    with_bytes(command, 0, 0)
}

/// Whether there is a slave in this range (R-DST-106). Answered by [`IDENTIFIED`], or not at all.
pub(super) fn identify(range: &LssRange) -> [Payload; 6] {
    [
        with_number(0x46, range.vendor),
        with_number(0x47, range.product),
        with_number(0x48, range.revision.0),
        with_number(0x49, range.revision.1),
        with_number(0x4A, range.serial.0),
        with_number(0x4B, range.serial.1),
    ]
}

/// Whether there is a slave without node id (R-DST-109). Answered by [`NON_CONFIGURED`], or not at all.
pub(super) fn identify_non_configured() -> Payload {
    plain(0x4C)
}

/// One step of a fastscan: whether the bits of `number` from 31 down to `bit` are those of part `part` (0..=3) of an
/// address; the slaves that agree go on to part `next`. Answered by [`IDENTIFIED`], or not at all.
pub(super) fn fastscan(number: u32, bit: u8, part: u8, next: u8) -> Payload {
    let [a, b, c, d] = number.to_le_bytes();
    [0x51, a, b, c, d, bit, part, next]
}

/// `bit` of the first step of a fastscan, to which every slave without node id answers.
pub(super) const FASTSCAN_START: u8 = 0x80;

/// The number in an answer.
pub(super) fn number(answer: Payload) -> u32 {
    let [_, a, b, c, d, ..] = answer;
    u32::from_le_bytes([a, b, c, d])
}

/// The node id in an answer: none for 0xFF, `Err` for what is no node id.
pub(super) fn node_id(answer: Payload) -> Result<Option<NodeId>, u8> {
    let [_, node, ..] = answer;
    match NodeId::new(node) {
        None if node != NO_NODE_ID => Err(node),
        known => Ok(known),
    }
}
