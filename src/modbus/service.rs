//! From a request to its answer, pure.

use super::frame::{self, Frame};
use super::pdu::{self, ExceptionCode, Request};
use super::register_bank::RegisterBank;
use crate::process_image::ProcessImage;
use crate::time::Now;

/// Appends the answer to a request, header included. Returns the exception, where it is one.
///
/// An unknown unit id answers 0B whatever is asked. Then come the checks in the order of the standard: function (01),
/// quantity, value and length (03), address (02), execution (0B for data that is not valid).
pub fn answer(
    bank: &RegisterBank,
    image: &ProcessImage,
    now: Now,
    request: &Frame<'_>,
    out: &mut Vec<u8>,
) -> Option<ExceptionCode> {
    let mut exception = None;
    frame::write(out, request.transaction, request.unit, |out| {
        let start = out.len();
        if let Err(code) = answer_pdu(bank, image, now, request, out) {
            out.truncate(start);
            pdu::write_exception(out, request.pdu.first().copied().unwrap_or_default(), code);
            exception = Some(code);
        }
    });
    exception
}

fn answer_pdu(
    bank: &RegisterBank,
    image: &ProcessImage,
    now: Now,
    request: &Frame<'_>,
    out: &mut Vec<u8>,
) -> Result<(), ExceptionCode> {
    let unit = bank.map().unit(request.unit).ok_or(ExceptionCode::GatewayTargetDevice)?;
    let function = request.pdu.first().copied().unwrap_or_default();
    match pdu::decode(request.pdu)? {
        Request::ReadBits { start, quantity } => {
            out.extend_from_slice(&[function, byte_count(quantity.div_ceil(8))]);
            bank.read_bits(image, unit, (start, quantity), out)
        }
        Request::ReadRegisters { start, quantity } => {
            out.extend_from_slice(&[function, byte_count(quantity * 2)]);
            bank.read_registers(image, now, unit, (start, quantity), out)
        }
        // Writing is a function that the server knows, but there is no address that it may be used on.
        Request::Write { .. } => Err(ExceptionCode::IllegalDataAddress),
        Request::ReadIdentification { access, object } => unit.identification.answer(access, object, out),
    }
}

/// `decode` limits quantities to what one byte can count.
fn byte_count(bytes: u16) -> u8 {
    u8::try_from(bytes).unwrap_or(u8::MAX)
}
