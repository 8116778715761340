//! Requests, pure: from the bytes of a PDU to what is asked for, or to the exception that they deserve.
//!
//! The order of the checks is that of V1.1b3, 7: the function (exception 01), then quantities, values and the length of
//! the PDU (03). Addresses (02) and the unit (0B) are judged by whoever knows the register map. Every length is checked
//! before it is used; a PDU that is longer than it says is as wrong as one that is shorter.

use std::ops::RangeInclusive;

pub use tokio_modbus::ExceptionCode;

/// What is asked for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Request {
    /// FC 1, 2.
    ReadBits {
        /// First address.
        start: u16,
        /// How many, 1..=2000.
        quantity: u16,
    },
    /// FC 3, 4.
    ReadRegisters {
        /// First address.
        start: u16,
        /// How many, 1..=125.
        quantity: u16,
    },
    /// FC 5, 6, 15, 16, 22, 23, whole and well formed.
    Write {
        /// First address that is to be written.
        start: u16,
        /// How many, 1..=1968.
        quantity: u16,
    },
    /// FC 43/14.
    ReadIdentification {
        /// Which objects.
        access: Access,
        /// The object, or the one to begin with.
        object: u8,
    },
}

/// Which objects of the device identification are asked for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Access {
    /// Code 1: vendor, product, revision; as a stream.
    Basic,
    /// Code 2: those and the other objects with names in the standard.
    Regular,
    /// Code 3: all.
    Extended,
    /// Code 4: one.
    Individual,
}

impl Access {
    /// The code in request and answer.
    #[must_use]
    pub fn code(self) -> u8 {
        match self {
            Self::Basic => 1,
            Self::Regular => 2,
            Self::Extended => 3,
            Self::Individual => 4,
        }
    }
}

/// Function code of "encapsulated interface transport".
pub const ENCAPSULATED: u8 = 0x2B;
/// Its type "read device identification".
pub const MEI_IDENTIFICATION: u8 = 0x0E;

const READ_BITS: RangeInclusive<u16> = 1..=2000;
const READ_REGISTERS: RangeInclusive<u16> = 1..=125;
const WRITE_COILS: RangeInclusive<u16> = 1..=1968;
const WRITE_REGISTERS: RangeInclusive<u16> = 1..=123;
const READ_WRITE_WRITES: RangeInclusive<u16> = 1..=121;

/// What a PDU asks for.
///
/// # Errors
/// The exception that it is to be answered with: 01 or 03.
pub fn decode(pdu: &[u8]) -> Result<Request, ExceptionCode> {
    let (&function, body) = pdu.split_first().ok_or(ExceptionCode::IllegalFunction)?;
    let request = match function {
        1 | 2 => {
            start_and_quantity(body, READ_BITS).map(|(start, quantity)| Request::ReadBits { start, quantity })
        }
        3 | 4 => start_and_quantity(body, READ_REGISTERS)
            .map(|(start, quantity)| Request::ReadRegisters { start, quantity }),
        5 => write_coil(body),
        6 => exactly::<4>(body).map(|[a1, a0, _, _]| Request::write(word(a1, a0), 1)),
        15 => write_many(body, WRITE_COILS, |quantity| quantity.div_ceil(8)),
        16 => write_many(body, WRITE_REGISTERS, |quantity| quantity * 2),
        22 => exactly::<6>(body).map(|[a1, a0, ..]| Request::write(word(a1, a0), 1)),
        23 => read_and_write(body),
        ENCAPSULATED => return encapsulated(body),
        _ => return Err(ExceptionCode::IllegalFunction),
    };
    request.ok_or(ExceptionCode::IllegalDataValue)
}

impl Request {
    fn write(start: u16, quantity: u16) -> Self {
        Self::Write { start, quantity }
    }
}

/// Appends an exception answer.
pub fn write_exception(out: &mut Vec<u8>, function: u8, code: ExceptionCode) {
    out.extend_from_slice(&[function | 0x80, code.into()]);
}

fn word(high: u8, low: u8) -> u16 {
    u16::from_be_bytes([high, low])
}

fn exactly<const N: usize>(body: &[u8]) -> Option<[u8; N]> {
    body.try_into().ok()
}

fn start_and_quantity(body: &[u8], allowed: RangeInclusive<u16>) -> Option<(u16, u16)> {
    let [a1, a0, q1, q0] = exactly(body)?;
    let quantity = word(q1, q0);
    allowed.contains(&quantity).then_some((word(a1, a0), quantity))
}

/// FC 5: a coil is switched by 0xFF00 or 0x0000 and by nothing else.
fn write_coil(body: &[u8]) -> Option<Request> {
    let [a1, a0, v1, v0] = exactly(body)?;
    matches!(word(v1, v0), 0x0000 | 0xFF00).then(|| Request::write(word(a1, a0), 1))
}

/// FC 15, 16: quantity, byte count and the bytes that are there must agree.
fn write_many(body: &[u8], allowed: RangeInclusive<u16>, bytes: fn(u16) -> u16) -> Option<Request> {
    let (start, quantity) = start_and_quantity(body.get(..4)?, allowed)?;
    counted(body.get(4..)?, bytes(quantity))?;
    Some(Request::write(start, quantity))
}

/// FC 23: a read and a write in one.
fn read_and_write(body: &[u8]) -> Option<Request> {
    start_and_quantity(body.get(..4)?, READ_REGISTERS)?;
    let (start, quantity) = start_and_quantity(body.get(4..8)?, READ_WRITE_WRITES)?;
    counted(body.get(8..)?, quantity * 2)?;
    Some(Request::write(start, quantity))
}

/// A byte count and exactly as many bytes.
fn counted(counted: &[u8], expected: u16) -> Option<()> {
    let (&count, bytes) = counted.split_first()?;
    (u16::from(count) == expected && bytes.len() == usize::from(expected)).then_some(())
}

/// FC 43: of its types only 14. Type 13 (CANopen general reference) is not offered: exception 01.
fn encapsulated(body: &[u8]) -> Result<Request, ExceptionCode> {
    match *body {
        [MEI_IDENTIFICATION, code, object] => {
            let access = match code {
                1 => Access::Basic,
                2 => Access::Regular,
                3 => Access::Extended,
                4 => Access::Individual,
                _ => return Err(ExceptionCode::IllegalDataValue),
            };
            Ok(Request::ReadIdentification { access, object })
        }
        [] | [MEI_IDENTIFICATION, ..] => Err(ExceptionCode::IllegalDataValue),
        _ => Err(ExceptionCode::IllegalFunction),
    }
}
