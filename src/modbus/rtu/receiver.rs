//! Requests in the bytes of a serial line, pure (MODBUS over Serial Line V1.02, 2.5.1).
//!
//! On the line a frame ends with a pause, but pauses do not survive operating systems and adapters. So a request is taken as
//! soon as it is as long as its function code says and its check is right; what is left at a pause is a frame if its check
//! is right, and thrown away if not. What others said before it, questions and answers, passes by as soon as more follows.

/// The longest frame: address, PDU, check.
pub const LONGEST: usize = 256;
/// The shortest frame: address, function code, check.
const SHORTEST: usize = 4;
/// Bytes that are kept: a frame, and as much of the next one as shows that it is over.
const ROOM: usize = LONGEST + SHORTEST;

/// A request.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Request {
    /// Unit id; 0 is for all.
    pub unit: u8,
    /// Function code and what follows.
    pub pdu: Vec<u8>,
}

/// The bytes of a line since the last frame.
#[derive(Clone, Debug, Default)]
pub struct Receiver {
    bytes: Vec<u8>,
    /// What we sent last, as long as it may come back: adapters of two-wire lines hear themselves.
    echo: Vec<u8>,
    discarded: u64,
}

impl Receiver {
    /// Bytes came.
    pub fn handle_bytes(&mut self, bytes: &[u8]) {
        self.bytes.extend_from_slice(bytes);
        if !self.echo.is_empty() {
            if self.bytes.starts_with(&self.echo) {
                self.bytes.drain(..self.echo.len());
                self.echo.clear();
            } else if !self.echo.starts_with(&self.bytes) {
                // Not what was sent: the adapter does not hear itself.
                self.echo.clear();
            }
        }
        if self.bytes.len() > ROOM {
            self.pass_over();
        }
        if self.bytes.len() > ROOM {
            self.discard();
        }
    }

    /// An answer was sent.
    pub fn handle_sent(&mut self, frame: &[u8]) {
        frame.clone_into(&mut self.echo);
    }

    /// A request that is complete, and nothing behind it.
    pub fn poll_output(&mut self) -> Option<Request> {
        if !self.echo.is_empty() {
            return None;
        }
        self.pass_over();
        (length(&self.bytes)? == self.bytes.len()).then(|| self.take()).flatten()
    }

    /// Nothing came for the time of a pause.
    pub fn handle_pause(&mut self) -> Option<Request> {
        self.echo.clear();
        self.pass_over();
        if self.bytes.is_empty() {
            return None;
        }
        let request = self.take();
        if request.is_none() {
            self.discard();
        }
        request
    }

    /// Whether a pause would end something.
    #[must_use]
    pub fn is_waiting(&self) -> bool {
        !self.bytes.is_empty() || !self.echo.is_empty()
    }

    /// Frames thrown away because their check was wrong or they were too long.
    #[must_use]
    pub fn discarded(&self) -> u64 {
        self.discarded
    }

    /// Lets go of whole frames behind which another one begins: nobody waits for an answer to them any more.
    fn pass_over(&mut self) {
        let mut begin = 0;
        while let Some(rest) = self.bytes.get(begin..)
            && let Some(end) = [answer_length(rest), length(rest)].into_iter().flatten().find(|end| {
                end + SHORTEST <= rest.len() && rest.get(..*end).is_some_and(|frame| body(frame).is_some())
            })
        {
            begin += end;
        }
        self.bytes.drain(..begin);
    }

    fn take(&mut self) -> Option<Request> {
        let (unit, pdu) = body(&self.bytes)?.split_first()?;
        let request = Request { unit: *unit, pdu: pdu.to_vec() };
        self.bytes.clear();
        Some(request)
    }

    fn discard(&mut self) {
        self.bytes.clear();
        self.discarded = self.discarded.saturating_add(1);
    }
}

/// How long a request is whose function code and byte count are there; `None` where that cannot be said.
fn length(frame: &[u8]) -> Option<usize> {
    let counted = |at: usize, fixed: usize| frame.get(at).map(|count| fixed + usize::from(*count));
    match *frame.get(1)? {
        1..=6 => Some(8),
        15 | 16 => counted(6, 9),
        22 => Some(10),
        23 => counted(10, 13),
        43 if frame.get(2) == Some(&14) => Some(7),
        _ => None,
    }
}

/// The same of an answer.
fn answer_length(frame: &[u8]) -> Option<usize> {
    match *frame.get(1)? {
        1..=4 | 17 | 23 => frame.get(2).map(|count| 5 + usize::from(*count)),
        5 | 6 | 15 | 16 => Some(8),
        22 => Some(10),
        128.. => Some(5),
        _ => None,
    }
}

/// What stands before the check of a whole frame, if that is right.
fn body(frame: &[u8]) -> Option<&[u8]> {
    let (body, check) = frame.split_last_chunk::<2>()?;
    let fits = (SHORTEST..=LONGEST).contains(&frame.len());
    (fits && crc(body).to_le_bytes() == *check).then_some(body)
}

/// Appends the check to a frame.
pub fn close(frame: &mut Vec<u8>) {
    let check = crc(frame).to_le_bytes();
    frame.extend_from_slice(&check);
}

/// CRC-16/MODBUS (6.2.2).
fn crc(bytes: &[u8]) -> u16 {
    bytes.iter().fold(0xFFFF, |crc, byte| {
        (0..8).fold(crc ^ u16::from(*byte), |crc: u16, _| {
            let carry = crc & 1 == 1;
            (crc >> 1) ^ if carry { 0xA001 } else { 0 }
        })
    })
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn frame(body: &[u8]) -> Vec<u8> {
        let mut frame = body.to_vec();
        close(&mut frame);
        frame
    }

    #[test]
    fn the_check_is_that_of_the_standard() {
        assert_eq!(crc(b"123456789"), 0x4B37);
        // The example of the standard's appendix: address 2, function 7.
        assert_eq!(frame(&[0x02, 0x07]), [0x02, 0x07, 0x41, 0x12]);
    }

    #[test]
    fn a_request_is_taken_as_soon_as_it_is_complete_in_whatever_lumps_it_comes() {
        for body in [
            &[1, 4, 0, 100, 0, 20][..],
            &[9, 16, 0, 1, 0, 2, 4, 1, 2, 3, 4],
            &[9, 23, 0, 0, 0, 1, 0, 0, 0, 1, 2, 7, 7],
            &[9, 22, 0, 1, 0, 2, 0, 3],
            &[9, 43, 14, 1, 0],
        ] {
            let frame = frame(body);
            let mut receiver = Receiver::default();
            for (place, byte) in frame.iter().enumerate() {
                assert_eq!(receiver.poll_output(), None, "after {place} bytes");
                receiver.handle_bytes(&[*byte]);
            }
            assert_eq!(receiver.poll_output(), Some(Request { unit: body[0], pdu: body[1..].to_vec() }));
            assert!(!receiver.is_waiting());
        }
    }

    #[test]
    fn what_has_no_length_of_its_own_is_taken_at_a_pause_and_what_is_wrong_is_thrown_away() {
        let mut receiver = Receiver::default();
        receiver.handle_bytes(&frame(&[9, 17]));
        assert_eq!(receiver.poll_output(), None);
        assert_eq!(receiver.handle_pause(), Some(Request { unit: 9, pdu: vec![17] }));
        receiver.handle_bytes(&[9, 4, 0, 0, 0, 1, 0xBA, 0xD0]);
        assert_eq!(receiver.poll_output(), None);
        assert_eq!((receiver.handle_pause(), receiver.discarded()), (None, 1));
        receiver.handle_bytes(&frame(&[9, 4, 0, 0, 0, 1]));
        assert!(receiver.poll_output().is_some(), "the next one is whole again");
    }

    #[test]
    fn our_own_answer_that_the_adapter_hears_is_no_request() {
        let answer = frame(&[9, 1, 3, 0, 1, 2]);
        for echoes in [true, false] {
            let mut receiver = Receiver::default();
            receiver.handle_sent(&answer);
            if echoes {
                receiver.handle_bytes(&answer[..3]);
                assert_eq!(receiver.poll_output(), None);
                receiver.handle_bytes(&answer[3..]);
                assert_eq!(receiver.poll_output(), None);
            } else {
                assert_eq!(receiver.handle_pause(), None);
            }
            receiver.handle_bytes(&frame(&[9, 4, 0, 0, 0, 1]));
            assert!(receiver.poll_output().is_some(), "echoes: {echoes}");
        }
    }

    #[test]
    fn a_request_right_behind_an_answer_that_has_no_echo_is_taken() {
        let mut receiver = Receiver::default();
        receiver.handle_sent(&frame(&[9, 4, 2, 0, 1]));
        receiver.handle_bytes(&frame(&[9, 4, 0, 0, 0, 1]));
        assert_eq!(receiver.poll_output().map(|request| request.unit), Some(9));
    }

    #[test]
    fn a_request_behind_what_others_said_is_taken_in_whatever_lumps_it_comes() {
        let ours = frame(&[247, 4, 0, 90, 0, 1]);
        let others = [
            vec![frame(&[9, 3, 4, 1, 2, 3, 4])],
            vec![frame(&[9, 16, 0, 1, 0, 2])],
            vec![frame(&[9, 0x84, 2])],
            vec![frame(&[9, 22, 0, 1, 0, 2, 0, 3])],
            vec![frame(&[9, 17, 2, 1, 0xFF])],
            vec![frame(&[9, 3, 0, 0, 0, 2]), frame(&[9, 3, 4, 1, 2, 3, 4])],
            // More than one longest frame altogether.
            vec![frame(&[9, 3, 0, 0, 0, 125]), frame(&[&[9, 3, 250][..], &[7; 250]].concat())],
        ];
        for others in others {
            let line = [others.concat(), ours.clone()].concat();
            for lump in [1, 3, 20, line.len()] {
                let mut receiver = Receiver::default();
                let mut taken = Vec::new();
                for bytes in line.chunks(lump) {
                    receiver.handle_bytes(bytes);
                    taken.extend(receiver.poll_output());
                }
                let last = taken.pop();
                assert_eq!(last.map(|request| request.unit), Some(247), "{others:?} in lumps of {lump}");
                assert!(taken.iter().all(|request| request.unit == 9), "{taken:?}");
                assert!(!receiver.is_waiting() && receiver.discarded() == 0);
            }
        }
    }

    #[test]
    fn what_comes_instead_of_an_echo_is_taken_though_the_answer_was_longer() {
        let mut receiver = Receiver::default();
        receiver.handle_sent(&frame(&[&[9, 4, 40][..], &[1; 40]].concat()));
        // The first byte could be that of an echo.
        for byte in frame(&[9, 4, 0, 0, 0, 1]) {
            assert_eq!(receiver.poll_output(), None);
            receiver.handle_bytes(&[byte]);
        }
        assert_eq!(receiver.poll_output().map(|request| request.unit), Some(9));
    }

    proptest! {
        #[test]
        fn no_noise_is_taken_for_a_request_or_takes_memory_without_bound(
            lumps in proptest::collection::vec(proptest::collection::vec(any::<u8>(), 0..400), 0..20)
        ) {
            let mut receiver = Receiver::default();
            for lump in lumps {
                receiver.handle_bytes(&lump);
                if let Some(request) = receiver.poll_output() {
                    let mut body = vec![request.unit];
                    body.extend(&request.pdu);
                    prop_assert!(lump.ends_with(&crc(&body).to_le_bytes()) || lump.len() < 2);
                }
                prop_assert!(receiver.bytes.len() <= ROOM);
            }
            receiver.handle_pause();
            prop_assert!(!receiver.is_waiting());
        }
    }
}
