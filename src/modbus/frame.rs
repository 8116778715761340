//! The frame of Modbus TCP (MBAP header and PDU) in a stream of bytes, pure.
//!
//! Header: transaction id (2), protocol id (2), length (2), unit id (1); `length` counts the unit id and the PDU. The
//! length is judged as soon as it is there, so that a wrong one never makes the server wait or buffer.

/// Bytes before the PDU.
pub const HEADER: usize = 7;
/// The longest PDU.
pub const LONGEST_PDU: usize = 253;
/// The longest frame.
pub const LONGEST_FRAME: usize = HEADER + LONGEST_PDU;

/// What the beginning of a stream holds.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Parsed<'a> {
    /// A frame that is not complete; nothing at all where the stream is empty.
    Incomplete,
    /// A request.
    Frame(Frame<'a>),
    /// A frame of another protocol, to be passed over. The session stays (Messaging Guide V1.0b, 4.4.2.2).
    Foreign {
        /// Its length in bytes.
        length: usize,
    },
    /// No Modbus: where the next frame begins cannot be known, so that the session must end.
    Malformed,
}

/// A request as it came.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Frame<'a> {
    /// Chosen by the client; the answer carries it too.
    pub transaction: u16,
    /// Unit id.
    pub unit: u8,
    /// Function code and what follows, 1..=253 bytes.
    pub pdu: &'a [u8],
}

impl Frame<'_> {
    /// Its length in bytes with the header.
    #[must_use]
    pub fn length(&self) -> usize {
        HEADER + self.pdu.len()
    }
}

/// Looks at the beginning of a stream.
#[must_use]
pub fn parse(stream: &[u8]) -> Parsed<'_> {
    let Some((&[t1, t0, p1, p0, l1, l0], rest)) = stream.split_first_chunk() else {
        return Parsed::Incomplete;
    };
    let length = usize::from(u16::from_be_bytes([l1, l0]));
    if !(2..=1 + LONGEST_PDU).contains(&length) {
        return Parsed::Malformed;
    }
    let Some((&unit, pdu)) = rest.get(..length).and_then(<[u8]>::split_first) else {
        return Parsed::Incomplete;
    };
    if [p1, p0] != [0, 0] {
        return Parsed::Foreign { length: HEADER - 1 + length };
    }
    Parsed::Frame(Frame { transaction: u16::from_be_bytes([t1, t0]), unit, pdu })
}

/// Appends an answer. `pdu` writes the PDU, at least one byte; more than 253 bytes would be our bug and are cut off.
pub fn write(out: &mut Vec<u8>, transaction: u16, unit: u8, pdu: impl FnOnce(&mut Vec<u8>)) {
    out.extend_from_slice(&transaction.to_be_bytes());
    out.extend_from_slice(&[0, 0]);
    let length_at = out.len();
    out.extend_from_slice(&[0, 0, unit]);
    let pdu_at = out.len();
    pdu(out);
    debug_assert!((1..=LONGEST_PDU).contains(&(out.len() - pdu_at)), "a PDU has 1..=253 bytes");
    out.truncate(pdu_at + LONGEST_PDU);
    let length = u16::try_from(out.len() - pdu_at + 1).unwrap_or(u16::MAX);
    if let Some(place) = out.get_mut(length_at..length_at + 2) {
        place.copy_from_slice(&length.to_be_bytes());
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const REQUEST: [u8; 12] = [0x12, 0x34, 0, 0, 0, 6, 9, 3, 0, 100, 0, 2];

    #[test]
    fn a_frame_is_seen_only_when_it_is_complete() {
        for end in 0..REQUEST.len() {
            assert_eq!(parse(&REQUEST[..end]), Parsed::Incomplete, "{end} bytes");
        }
        let frame = Frame { transaction: 0x1234, unit: 9, pdu: &[3, 0, 100, 0, 2] };
        assert_eq!(parse(&REQUEST), Parsed::Frame(frame));
        assert_eq!(frame.length(), REQUEST.len());
        let mut more = REQUEST.to_vec();
        more.extend_from_slice(&[0xFF; 3]);
        assert_eq!(parse(&more), Parsed::Frame(frame));
    }

    #[test]
    fn s1_a_length_that_cannot_be_is_refused_before_its_bytes_are_awaited() {
        for length in 0..=u16::MAX {
            let [l1, l0] = length.to_be_bytes();
            let header = [0, 0, 0, 0, l1, l0];
            let expected = if (2..=254).contains(&length) { Parsed::Incomplete } else { Parsed::Malformed };
            assert_eq!(parse(&header), expected, "length {length}");
        }
    }

    #[test]
    fn f35_a_frame_of_another_protocol_is_passed_over_as_a_whole() {
        let mut foreign = REQUEST;
        foreign[3] = 1;
        assert_eq!(parse(&foreign), Parsed::Foreign { length: 12 });
        assert_eq!(parse(&foreign[..11]), Parsed::Incomplete);
    }

    #[test]
    fn an_answer_carries_transaction_and_unit_and_its_own_length() {
        let mut out = vec![0xAA];
        write(&mut out, 0x1234, 9, |out| out.extend_from_slice(&[0x83, 2]));
        assert_eq!(out, [0xAA, 0x12, 0x34, 0, 0, 0, 3, 9, 0x83, 2]);
        assert!(matches!(
            parse(&out[1..]),
            Parsed::Frame(Frame { transaction: 0x1234, unit: 9, pdu: [0x83, 2] })
        ));
    }
}
