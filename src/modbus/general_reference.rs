//! CANopen general reference (FC 43/13, CiA 309-2), pure: objects of CANopen nodes, read and written over Modbus.
//!
//! The Modbus standard reserves the type and limits it to one PDU (V1.1b3, 6.20); its layout is that of CiA 309-2, which is
//! not public. What stands here was found in manuals of devices that serve it; `docs/modbus.md` tells what of it is our
//! reading.
//!
//! | bytes | content |
//! |---|---|
//! | 1 | 0x2B |
//! | 1 | 0x0D |
//! | 1 | protocol control, counted from the highest bit: 0 more follows, 1 the field has two bytes, 2 a counter follows, 5 a network id follows, 6 encoding follows, 7 = 1 write |
//! | 1 | reserved, 0 |
//! | 0..3 | counter, network id, encoding: those that protocol control announces, in this order |
//! | 1 | node id |
//! | 2, 1 | index, high byte first; sub-index |
//! | 2 | address of the first byte within the object, high byte first |
//! | 2 | number of bytes, high byte first |
//! | n | the bytes of the object, as they are on CAN: little-endian |
//!
//! An answer has the layout of its request.

use super::frame::LONGEST_PDU;
use super::pdu::{ENCAPSULATED, ExceptionCode};
use crate::gateway::command::{Action, ObjectId, Outcome};
use crate::mapping::TagTable;
use crate::process_image::NodeIndex;

/// Its type of "encapsulated interface transport".
pub const MEI_GENERAL_REFERENCE: u8 = 0x0D;

/// Bits of protocol control.
const MORE_FOLLOWS: u8 = 0x80;
const COUNTER: u8 = 0x20;
const NETWORK: u8 = 0x04;
const ENCODING: u8 = 0x02;
const WRITE: u8 = 0x01;

/// A request.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Reference {
    /// As it came, without [`MORE_FOLLOWS`].
    control: u8,
    /// What control announces, in the order of the layout.
    options: Vec<u8>,
    /// The number of the bus, where the request has one.
    network: Option<u8>,
    node: u8,
    object: ObjectId,
    /// Of the first byte.
    start: u16,
    /// How many bytes are wanted, or are written.
    count: u16,
    data: Vec<u8>,
}

/// Whether a PDU is a general reference.
#[must_use]
pub fn is_general_reference(pdu: &[u8]) -> bool {
    matches!(pdu, [ENCAPSULATED, MEI_GENERAL_REFERENCE, ..])
}

/// Reads a PDU.
///
/// # Errors
/// 03: it is cut off or too long, has bits that nobody knows the meaning of, is one part of several, asks for nothing, or
/// would write a part of an object.
pub fn decode(pdu: &[u8]) -> Result<Reference, ExceptionCode> {
    read_layout(pdu).filter(Reference::makes_sense).ok_or(ExceptionCode::IllegalDataValue)
}

fn read_layout(pdu: &[u8]) -> Option<Reference> {
    let [ENCAPSULATED, MEI_GENERAL_REFERENCE, control, 0, rest @ ..] = pdu else { return None };
    if control & !(COUNTER | NETWORK | ENCODING | WRITE) != 0 {
        return None;
    }
    let announced = [COUNTER, NETWORK, ENCODING].map(|option| control & option != 0);
    let (options, rest) = rest.split_at_checked(announced.iter().filter(|option| **option).count())?;
    let network_place = usize::from(control & COUNTER != 0);
    let network = options.get(network_place).copied().filter(|_| control & NETWORK != 0);
    let [node, index_high, index_low, sub, start_high, start_low, count_high, count_low, data @ ..] = rest
    else {
        return None;
    };
    Some(Reference {
        control: *control,
        options: options.to_vec(),
        network,
        node: *node,
        object: ObjectId::new(u16::from_be_bytes([*index_high, *index_low]), *sub),
        start: u16::from_be_bytes([*start_high, *start_low]),
        count: u16::from_be_bytes([*count_high, *count_low]),
        data: data.to_vec(),
    })
}

impl Reference {
    /// A read asks for something and brings nothing; a write brings as much as it says, and the whole object.
    fn makes_sense(&self) -> bool {
        if self.writes() {
            self.start == 0 && usize::from(self.count) == self.data.len()
        } else {
            self.count > 0 && self.data.is_empty()
        }
    }

    /// Whether the object is to be written.
    #[must_use]
    pub fn writes(&self) -> bool {
        self.control & WRITE != 0
    }

    /// The object.
    #[must_use]
    pub fn object(&self) -> ObjectId {
        self.object
    }

    /// What the gateway is to be asked for. `unit` is where the request came to: a node's, which must be that of the request,
    /// or the gateway's own, where every node can be named.
    ///
    /// # Errors
    /// 02: there is no such node there, or there are several and the request names no network.
    pub fn action(&self, table: &TagTable, unit: u8) -> Result<Action, ExceptionCode> {
        let of_node = table.nodes.iter().any(|node| node.unit_id == unit);
        // The gateway itself does not know which bus is meant where there are several.
        let network = self.network.map(usize::from).or((table.buses.len() == 1).then_some(1));
        let mut found = table.nodes.iter().enumerate().filter(|(_, node)| {
            let there = if of_node { node.unit_id == unit } else { network.is_some() };
            there
                && node.canopen().is_some_and(|settings| settings.id.get() == self.node)
                && network.is_none_or(|network| node.bus.0 + 1 == network)
        });
        let (place, _) = found.next().ok_or(ExceptionCode::IllegalDataAddress)?;
        // Two buses can each have a node of this id behind the unit id. Neither is taken at a venture.
        if found.next().is_some() {
            return Err(ExceptionCode::IllegalDataAddress);
        }
        let (node, object, timeout) = (NodeIndex(place), self.object, None);
        Ok(if self.writes() {
            Action::SdoWrite { node, object, data: self.data.clone(), timeout }
        } else {
            Action::SdoRead { node, object, len: None, timeout }
        })
    }

    /// Appends the PDU of the answer to what came of it.
    ///
    /// # Errors
    /// The exception that stands for what came of it; 02 where the object ends before the first byte that was asked for.
    pub fn answer(&self, outcome: &Outcome, out: &mut Vec<u8>) -> Result<(), ExceptionCode> {
        let bytes = match outcome {
            Outcome::Done => {
                self.write_header(false, self.count, out);
                return Ok(());
            }
            Outcome::Read(bytes) => bytes,
            Outcome::Unknown
            | Outcome::Rejected(_)
            | Outcome::Forbidden(_)
            | Outcome::Busy
            | Outcome::NodeUnavailable
            | Outcome::Aborted(_)
            | Outcome::Timeout
            | Outcome::Failed(_) => return Err(exception(outcome)),
        };
        let start = usize::from(self.start);
        if start > 0 && start >= bytes.len() {
            return Err(ExceptionCode::IllegalDataAddress);
        }
        let wanted = bytes.get(start..).unwrap_or_default();
        let wanted = wanted.get(..usize::from(self.count)).unwrap_or(wanted);
        let room = LONGEST_PDU - HEADER - self.options.len();
        let sent = wanted.get(..room).unwrap_or(wanted);
        self.write_header(sent.len() < wanted.len(), u16::try_from(sent.len()).unwrap_or(u16::MAX), out);
        out.extend_from_slice(sent);
        Ok(())
    }

    fn write_header(&self, more_follows: bool, count: u16, out: &mut Vec<u8>) {
        let control = self.control | if more_follows { MORE_FOLLOWS } else { 0 };
        out.extend_from_slice(&[ENCAPSULATED, MEI_GENERAL_REFERENCE, control, 0]);
        out.extend_from_slice(&self.options);
        out.push(self.node);
        out.extend_from_slice(&self.object.index.to_be_bytes());
        out.push(self.object.sub);
        out.extend_from_slice(&self.start.to_be_bytes());
        out.extend_from_slice(&count.to_be_bytes());
    }
}

/// Bytes of an answer before the object's, options apart.
const HEADER: usize = 12;

fn exception(outcome: &Outcome) -> ExceptionCode {
    match outcome {
        Outcome::Unknown => ExceptionCode::IllegalDataAddress,
        Outcome::Rejected(_) | Outcome::Forbidden(_) => ExceptionCode::IllegalDataValue,
        Outcome::Busy => ExceptionCode::ServerDeviceBusy,
        Outcome::NodeUnavailable => ExceptionCode::GatewayPathUnavailable,
        Outcome::Timeout => ExceptionCode::GatewayTargetDevice,
        Outcome::Aborted(_) | Outcome::Failed(_) | Outcome::Done | Outcome::Read(_) => {
            ExceptionCode::ServerDeviceFailure
        }
    }
}

#[cfg(test)]
#[path = "general_reference_tests.rs"]
mod tests;
