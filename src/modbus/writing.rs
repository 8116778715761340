//! Writes, pure: from a PDU to what the gateway is asked for, decoded and checked whole before anything is asked.

use std::collections::BTreeSet;

use super::WordOrder;
use super::command_block::{self, Block};
use super::pdu::ExceptionCode;
use super::register_bank::RegisterBank;
use super::register_map::{BitShow, RegisterShow, Unit};
use crate::gateway::command::{Access, Action, Deed, Outcome};
use crate::mapping::Encoding;
use crate::process_image::{NodeIndex, ProcessImage, TagIndex, Value};
use crate::time::Now;

/// A coil of every unit that acknowledges all alarms: of the unit's nodes, or of everything at the gateway's unit.
pub const ACKNOWLEDGE_ALL: u16 = 9_000;

/// What can be written over Modbus at all, by whomever: what the map calls writable.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Writable {
    /// Tags that some client may write.
    pub tags: BTreeSet<TagIndex>,
    /// Some client may give commands: there are a command block and coils.
    pub commands: bool,
}

impl Writable {
    /// What the `[access.NAME]` tables allow Modbus clients.
    #[must_use]
    pub fn of(access: &Access) -> Self {
        let grants = || access.of_modbus().filter(|grant| grant.allows(Deed::Acknowledge).is_ok());
        Self { tags: grants().flat_map(|grant| grant.tags()).collect(), commands: grants().next().is_some() }
    }
}

/// What a PDU writes.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Write {
    function: u8,
    start: u16,
    what: What,
    /// FC 23: what is read afterwards.
    pub read: Option<(u16, u16)>,
    /// The body of the answer, function included; of FC 23 without what was read.
    echo: Vec<u8>,
}

#[derive(Clone, Debug, PartialEq, Eq)]
enum What {
    Registers(Vec<u16>),
    Mask { and: u16, or: u16 },
    Bits(Vec<bool>),
}

/// What is to be done for a write.
#[derive(Clone, Debug, PartialEq)]
pub enum Plan {
    /// The gateway is asked for this.
    Ask(Action),
    /// Registers of the command block, from this place on.
    Block(u16, Vec<u16>),
}

fn word(high: u8, low: u8) -> u16 {
    u16::from_be_bytes([high, low])
}

fn words(bytes: &[u8]) -> Vec<u16> {
    bytes.as_chunks().0.iter().map(|pair| u16::from_be_bytes(*pair)).collect()
}

/// Reads a PDU whose form [`pdu::decode`](super::pdu::decode) found to be that of a write. `None` for any other.
#[must_use]
pub fn decode(pdu: &[u8]) -> Option<Write> {
    let (&function, body) = pdu.split_first()?;
    let [a1, a0, b1, b0, rest @ ..] = body else { return None };
    let (start, second) = (word(*a1, *a0), word(*b1, *b0));
    let echo = || pdu.get(..5).unwrap_or_default().to_vec();
    let write = |what, echo| Some(Write { function, start, what, read: None, echo });
    match function {
        5 => write(What::Bits(vec![second == 0xFF00]), echo()),
        6 => write(What::Registers(vec![second]), echo()),
        15 => {
            let bytes = rest.get(1..)?;
            let bit = |place: u16| {
                bytes.get(usize::from(place / 8)).is_some_and(|byte| byte >> (place % 8) & 1 == 1)
            };
            write(What::Bits((0..second).map(bit).collect()), echo())
        }
        16 => write(What::Registers(words(rest.get(1..)?)), echo()),
        22 => {
            let [o1, o0] = rest else { return None };
            write(What::Mask { and: second, or: word(*o1, *o0) }, pdu.to_vec())
        }
        23 => {
            let [w1, w0, _, _, _, values @ ..] = rest else { return None };
            let what = What::Registers(words(values));
            Some(Write {
                function,
                start: word(*w1, *w0),
                what,
                read: Some((start, second)),
                echo: vec![function],
            })
        }
        _ => None,
    }
}

impl Write {
    /// The function code.
    #[must_use]
    pub fn function(&self) -> u8 {
        self.function
    }

    /// The beginning of the answer to a write that was done.
    #[must_use]
    pub fn echo(&self) -> &[u8] {
        &self.echo
    }

    /// What is to be done for it, if all of it can be written.
    ///
    /// # Errors
    /// 02: an address that there is not, or that nobody may write over Modbus; 03: half a value, or none that can be written;
    /// 0A: bits of a value that is not known.
    pub fn plan(
        &self,
        bank: &RegisterBank,
        image: &ProcessImage,
        now: Now,
        unit_id: u8,
    ) -> Result<Plan, ExceptionCode> {
        let unit = bank.map().unit(unit_id).ok_or(ExceptionCode::GatewayTargetDevice)?;
        let is_gateway = bank.map().is_gateway(unit_id);
        match &self.what {
            What::Registers(words) if is_gateway => command_block::place(self.start, words.len())
                .map(|place| Plan::Block(place, words.clone()))
                .ok_or(ExceptionCode::IllegalDataAddress),
            What::Registers(words) => tags(bank, unit, self.start, words).map(ask),
            What::Mask { and, or } => {
                let is_known = |(tag, _): &(TagIndex, Value)| image.tag(*tag).quality.is_usable();
                // What its registers show then is no value, and the bits that are to stay would be made of it.
                if !tags(bank, unit, self.start, &[0])?.iter().all(is_known) {
                    return Err(ExceptionCode::GatewayPathUnavailable);
                }
                let mut bytes = Vec::new();
                bank.read_registers(image, now, unit, (self.start, 1), &mut bytes)?;
                let before = words(&bytes).first().copied().unwrap_or_default();
                tags(bank, unit, self.start, &[(before & and) | (or & !and)]).map(ask)
            }
            What::Bits(bits) if unit.bits.read(self.start, 1).is_none() => match **bits {
                [true] if self.start == ACKNOWLEDGE_ALL => {
                    acknowledge_all(bank, unit_id, is_gateway).map(Plan::Ask)
                }
                [false] if self.start == ACKNOWLEDGE_ALL => Err(ExceptionCode::IllegalDataValue),
                _ => Err(ExceptionCode::IllegalDataAddress),
            },
            What::Bits(bits) => coils(bank, unit, self.start, bits).map(ask),
        }
    }
}

fn ask(writes: Vec<(TagIndex, Value)>) -> Plan {
    Plan::Ask(Action::WriteTags { writes })
}

/// The alarms of a unit's node, or all. Of a unit with several nodes only the command block can name one.
fn acknowledge_all(bank: &RegisterBank, unit_id: u8, is_gateway: bool) -> Result<Action, ExceptionCode> {
    if is_gateway {
        return Ok(Action::AcknowledgeAll { node: None });
    }
    let nodes = bank.table().nodes.iter().enumerate();
    let mut of_unit = nodes.filter(|(_, node)| node.unit_id == unit_id).map(|(place, _)| NodeIndex(place));
    match (of_unit.next(), of_unit.next()) {
        (Some(node), None) => Ok(Action::AcknowledgeAll { node: Some(node) }),
        _ => Err(ExceptionCode::IllegalDataAddress),
    }
}

/// The values of whole tags that registers hold, without a hole.
fn tags(
    bank: &RegisterBank,
    unit: &Unit,
    start: u16,
    words: &[u16],
) -> Result<Vec<(TagIndex, Value)>, ExceptionCode> {
    let quantity = u16::try_from(words.len()).map_err(|_| ExceptionCode::IllegalDataValue)?;
    let entries = unit.registers.read(start, quantity).ok_or(ExceptionCode::IllegalDataAddress)?;
    let mut rest = words;
    let mut next = u32::from(start);
    let mut writes = Vec::new();
    for entry in entries {
        let RegisterShow::Tag(register) = &entry.show else { return Err(ExceptionCode::IllegalDataAddress) };
        if !bank.map().writable().tags.contains(&register.tag) {
            return Err(ExceptionCode::IllegalDataAddress);
        }
        let count = usize::from(register.encoding.count());
        // It begins before what is written, or ends behind it, or there is nothing between it and the one before.
        let (own, after) = rest
            .split_at_checked(count)
            .filter(|_| entry.address == next)
            .ok_or(ExceptionCode::IllegalDataValue)?;
        let value = value(register.encoding, register.resolution, own, bank.map().word_order());
        writes.push((register.tag, value.ok_or(ExceptionCode::IllegalDataValue)?));
        rest = after;
        next += entry.count;
    }
    if writes.is_empty() {
        return Err(ExceptionCode::IllegalDataAddress);
    }
    if rest.is_empty() { Ok(writes) } else { Err(ExceptionCode::IllegalDataValue) }
}

/// [`Cell::of_value`](super::encoding::Cell::of_value) backwards. `None`: raw bits are not written.
fn value(encoding: Encoding, resolution: f64, words: &[u16], order: WordOrder) -> Option<Value> {
    let double = || match (words, order) {
        ([high, low], WordOrder::Big) | ([low, high], WordOrder::Little) => {
            Some(u32::from(*high) << 16 | u32::from(*low))
        }
        _ => None,
    };
    let scaled = |number: i64| {
        if resolution.to_bits() == 1.0_f64.to_bits() {
            return Value::Signed(number);
        }
        // Within 33 bits, which a double holds.
        #[expect(
            clippy::as_conversions,
            clippy::cast_precision_loss,
            reason = "33 bits fit into the 53 of a double"
        )]
        Value::Float(number as f64 * resolution)
    };
    match encoding {
        Encoding::U16 => Some(scaled((*words.first()?).into())),
        Encoding::I16 => Some(scaled(words.first()?.cast_signed().into())),
        Encoding::U32 => Some(scaled(double()?.into())),
        Encoding::I32 => Some(scaled(double()?.cast_signed().into())),
        Encoding::F32 => Some(Value::Float(f32::from_bits(double()?).into())),
        Encoding::Bool | Encoding::Raw16 | Encoding::Raw32 => None,
    }
}

fn coils(
    bank: &RegisterBank,
    unit: &Unit,
    start: u16,
    bits: &[bool],
) -> Result<Vec<(TagIndex, Value)>, ExceptionCode> {
    let quantity = u16::try_from(bits.len()).map_err(|_| ExceptionCode::IllegalDataValue)?;
    let entries = unit.bits.read(start, quantity).ok_or(ExceptionCode::IllegalDataAddress)?;
    let mut writes = Vec::new();
    for ((entry, bit), address) in entries.iter().zip(bits).zip(u32::from(start)..) {
        let BitShow::Tag(register) = &entry.show else { return Err(ExceptionCode::IllegalDataAddress) };
        if entry.address != address || !bank.map().writable().tags.contains(&register.tag) {
            return Err(ExceptionCode::IllegalDataAddress);
        }
        writes.push((register.tag, Value::Bool(*bit)));
    }
    if writes.len() == bits.len() { Ok(writes) } else { Err(ExceptionCode::IllegalDataAddress) }
}

/// The exception that stands for an outcome, if it is one.
#[must_use]
pub fn exception(outcome: &Outcome) -> Option<ExceptionCode> {
    match outcome {
        Outcome::Done | Outcome::Read(_) => None,
        Outcome::Unknown => Some(ExceptionCode::IllegalDataAddress),
        Outcome::Rejected(_) | Outcome::Forbidden(_) => Some(ExceptionCode::IllegalDataValue),
        Outcome::Busy => Some(ExceptionCode::ServerDeviceBusy),
        Outcome::NodeUnavailable => Some(ExceptionCode::GatewayPathUnavailable),
        Outcome::Timeout => Some(ExceptionCode::GatewayTargetDevice),
        Outcome::Aborted(_) | Outcome::Failed(_) => Some(ExceptionCode::ServerDeviceFailure),
    }
}

/// Puts words into a block.
pub fn fill(block: &mut Block, place: u16, words: &[u16]) {
    for (place, word) in (place..).zip(words) {
        block.set(place, *word);
    }
}
