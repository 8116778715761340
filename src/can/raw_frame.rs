//! Frames as a `CAN_RAW` socket gives and takes them: `struct can_frame` and `struct canfd_frame` of `linux/can.h`.

use super::controller::ErrorReport;
use super::frame::{CanFrame, CanId};

/// Bytes of a `struct can_frame`.
pub const CLASSICAL_SIZE: usize = 16;
/// Bytes of a `struct canfd_frame`, the largest that a socket gives us.
pub const FD_SIZE: usize = 72;

const EXTENDED_FLAG: u32 = 0x8000_0000;
const REMOTE_FLAG: u32 = 0x4000_0000;
const ERROR_FLAG: u32 = 0x2000_0000;
const NUMBER_MASK: u32 = 0x1FFF_FFFF;

/// What a socket gave.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Received {
    /// A classical data or remote frame.
    Frame(CanFrame),
    /// The driver's report on errors or on the state of the controller.
    Error(ErrorReport),
    /// A CAN FD frame, which is only counted (R-DET-006).
    Fd,
    /// Nothing of the above; no kernel gives this.
    Malformed,
}

/// Reads one message of a socket.
#[must_use]
pub fn decode(bytes: &[u8]) -> Received {
    if bytes.len() == FD_SIZE {
        return Received::Fd;
    }
    let Ok(&[a, b, c, d, len, _, _, _, ref data @ ..]) = <&[u8; CLASSICAL_SIZE]>::try_from(bytes) else {
        return Received::Malformed;
    };
    let word = u32::from_ne_bytes([a, b, c, d]);
    let number = word & NUMBER_MASK;
    if word & ERROR_FLAG != 0 {
        return Received::Error(ErrorReport::decode(number, *data));
    }
    let id = if word & EXTENDED_FLAG == 0 {
        u16::try_from(number).ok().and_then(CanId::standard)
    } else {
        CanId::extended(number)
    };
    let Some(id) = id else { return Received::Malformed };
    let frame = if word & REMOTE_FLAG == 0 {
        data.get(..usize::from(len)).and_then(|data| CanFrame::data_frame(id, data))
    } else {
        CanFrame::remote_frame(id, len)
    };
    frame.map_or(Received::Malformed, Received::Frame)
}

/// The message for a socket that sends this frame.
#[must_use]
pub fn encode(frame: &CanFrame) -> [u8; CLASSICAL_SIZE] {
    let mut word = match frame.id() {
        CanId::Standard(id) => u32::from(id),
        CanId::Extended(id) => id | EXTENDED_FLAG,
    };
    if frame.is_remote() {
        word |= REMOTE_FLAG;
    }
    let mut bytes = [0; CLASSICAL_SIZE];
    let header = word.to_ne_bytes().into_iter().chain([frame.dlc(), 0, 0, 0]);
    for (place, byte) in bytes.iter_mut().zip(header.chain(frame.data().iter().copied())) {
        *place = byte;
    }
    bytes
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn every_kind_of_frame_survives_a_round_trip() {
        for text in ["181#00FF80017FFE3340", "701#R1", "701#R0", "181#", "00000181#0102", "1FFFFFFF#R8"] {
            let frame: CanFrame = text.parse().unwrap();
            assert_eq!(decode(&encode(&frame)), Received::Frame(frame), "{text}");
        }
    }

    #[test]
    fn r_det_006_an_fd_frame_is_no_frame() {
        assert_eq!(decode(&[0; FD_SIZE]), Received::Fd);
    }

    #[test]
    fn an_error_frame_is_reported_apart() {
        let mut bytes = [0; CLASSICAL_SIZE];
        bytes[..4].copy_from_slice(&(ERROR_FLAG | 0x40).to_ne_bytes());
        assert!(matches!(decode(&bytes), Received::Error(report) if report.link.is_some()));
    }

    proptest! {
        #[test]
        fn no_message_panics(bytes in proptest::collection::vec(any::<u8>(), 0..100)) {
            let _ = decode(&bytes);
        }

        #[test]
        fn what_is_read_as_a_frame_is_written_the_same(bytes in any::<[u8; CLASSICAL_SIZE]>()) {
            if let Received::Frame(frame) = decode(&bytes) {
                prop_assert_eq!(decode(&encode(&frame)), Received::Frame(frame));
            }
        }
    }
}
