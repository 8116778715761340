//! The ASCII lines of LAWICEL adapters ("slcan"), as in the CAN232 and CANUSB manuals. Pure.
//!
//! A frame is `t` (11 bit) or `T` (29 bit), `r` or `R` when it is remote; then the identifier in 3 or 8 hexadecimal
//! digits, the DLC in one, and the data. A remote frame keeps its DLC and has no data. With time stamps switched on,
//! four more digits follow, which are not used. A carriage return ends every line and alone means "done"; a bell
//! means "refused".

use std::fmt::Write as _;

use super::Link;
use super::frame::{CanFrame, CanId};
use super::interface::BIT_RATES;

/// The longest line that means something: a 29-bit frame with 8 bytes and a time stamp.
const LONGEST: usize = 30;

const RETURN: u8 = b'\r';
const BELL: u8 = 0x07;

/// What an adapter said.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Incoming {
    /// A frame from the bus.
    Frame(CanFrame),
    /// A CAN FD frame, an extension of some adapters; only counted (R-DET-006).
    Fd,
    /// The command was carried out.
    Done,
    /// The command was refused.
    Refused,
    /// A frame was taken for sending (`z`, `Z`).
    Sent,
    /// The answer to `F`.
    Flags(Flags),
    /// The controller's state, an extension that the Linux driver knows too (`sa`, `sw`, `sp`, `sb`).
    State(Link),
    /// An error on the bus, an extension of the same kind (`e...`).
    BusError,
    /// A line that is none of these: noise, half a line, the answer to a question that was not ours.
    Garbage,
}

/// The status flags of an adapter.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Flags(pub u8);

impl Flags {
    /// The adapter lost received frames: its queue was full, or the controller overran.
    #[must_use]
    pub fn lost_frames(self) -> bool {
        self.0 & 0b0000_1001 != 0
    }

    /// The controller is error passive.
    #[must_use]
    pub fn error_passive(self) -> bool {
        self.0 & 0b0010_0000 != 0
    }

    /// There was an error on the bus since the last question.
    #[must_use]
    pub fn bus_error(self) -> bool {
        self.0 & 0b1000_0000 != 0
    }
}

/// Cuts what an adapter sends into lines and reads them. Holds one line and no more.
#[derive(Clone, Debug, Default)]
pub struct Decoder {
    line: [u8; LONGEST],
    len: usize,
    overlong: bool,
}

impl Decoder {
    /// Takes one byte; gives what it completes.
    pub fn push(&mut self, byte: u8) -> Option<Incoming> {
        match byte {
            RETURN | BELL => {
                let line = self.line.get(..self.len).unwrap_or_default();
                let incoming = match (self.overlong, byte, line) {
                    (false, BELL, []) => Incoming::Refused,
                    (false, RETURN, line) => read_line(line),
                    _ => Incoming::Garbage,
                };
                self.len = 0;
                self.overlong = false;
                Some(incoming)
            }
            b'\n' | 0 => None,
            _ => {
                match self.line.get_mut(self.len) {
                    Some(place) => {
                        *place = byte;
                        self.len += 1;
                    }
                    None => self.overlong = true,
                }
                None
            }
        }
    }
}

fn read_line(line: &[u8]) -> Incoming {
    match line {
        [] => Incoming::Done,
        [b'z' | b'Z'] => Incoming::Sent,
        [b't', rest @ ..] => frame(rest, 3, false),
        [b'T', rest @ ..] => frame(rest, 8, false),
        [b'r', rest @ ..] => frame(rest, 3, true),
        [b'R', rest @ ..] => frame(rest, 8, true),
        [b'd' | b'D' | b'b' | b'B', _, ..] => Incoming::Fd,
        [b'F', high, low] => match (digit(*high), digit(*low)) {
            (Some(high), Some(low)) => Incoming::Flags(Flags(high << 4 | low)),
            _ => Incoming::Garbage,
        },
        // The counters that follow in six digits are not used.
        [b's', b'a' | b'w', _, _, _, _, _, _] => Incoming::State(Link::ErrorActive),
        [b's', b'p', _, _, _, _, _, _] => Incoming::State(Link::ErrorPassive),
        [b's', b'b', _, _, _, _, _, _] => Incoming::State(Link::BusOff),
        [b'e', count, kinds @ ..] if digit(*count).map(usize::from) == Some(kinds.len()) => {
            Incoming::BusError
        }
        _ => Incoming::Garbage,
    }
}

fn digit(byte: u8) -> Option<u8> {
    char::from(byte).to_digit(16).and_then(|digit| u8::try_from(digit).ok())
}

/// What follows the letter of a frame.
fn frame(rest: &[u8], id_digits: usize, remote: bool) -> Incoming {
    parse_frame(rest, id_digits, remote).map_or(Incoming::Garbage, Incoming::Frame)
}

fn parse_frame(rest: &[u8], id_digits: usize, remote: bool) -> Option<CanFrame> {
    let (id, rest) = rest.split_at_checked(id_digits)?;
    let number = id.iter().try_fold(0_u32, |number, byte| Some(number << 4 | u32::from(digit(*byte)?)))?;
    let id =
        if id_digits == 3 { CanId::standard(u16::try_from(number).ok()?)? } else { CanId::extended(number)? };
    let (dlc, rest) = rest.split_first()?;
    let dlc = digit(*dlc).filter(|dlc| *dlc <= 8)?;
    let len = if remote { 0 } else { usize::from(dlc) };
    let (payload, time_stamp) = rest.split_at_checked(2 * len)?;
    if !matches!(time_stamp.len(), 0 | 4) || !time_stamp.iter().all(u8::is_ascii_hexdigit) {
        return None;
    }
    if remote {
        return CanFrame::remote_frame(id, dlc);
    }
    let mut data = [0; 8];
    for (place, pair) in data.iter_mut().zip(payload.chunks(2)) {
        let [high, low] = pair else { return None };
        *place = digit(*high)? << 4 | digit(*low)?;
    }
    CanFrame::data_frame(id, data.get(..len)?)
}

/// Appends the line that sends a frame.
pub fn encode(frame: &CanFrame, line: &mut String) {
    let letter = match (frame.id(), frame.is_remote()) {
        (CanId::Standard(_), false) => 't',
        (CanId::Extended(_), false) => 'T',
        (CanId::Standard(_), true) => 'r',
        (CanId::Extended(_), true) => 'R',
    };
    // Writing into a string cannot fail.
    let _ = write!(line, "{letter}{}{}", frame.id(), frame.dlc());
    for byte in frame.data() {
        let _ = write!(line, "{byte:02X}");
    }
    line.push('\r');
}

/// The command that sets a bit rate, without its carriage return; `None` for one that is not in [`BIT_RATES`].
#[must_use]
pub fn bit_rate_command(bit_rate: u32) -> Option<String> {
    BIT_RATES.iter().position(|rate| *rate == bit_rate).map(|index| format!("S{index}"))
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn read(text: &str) -> Vec<Incoming> {
        let mut decoder = Decoder::default();
        text.bytes().filter_map(|byte| decoder.push(byte)).collect()
    }

    fn frame(text: &str) -> Incoming {
        Incoming::Frame(text.parse().unwrap())
    }

    #[test]
    fn each_kind_of_frame_is_read() {
        assert_eq!(read("t12331122AA\r"), [frame("123#1122AA")]);
        assert_eq!(read("t1230\r"), [frame("123#")]);
        assert_eq!(read("T0000018120102\r"), [frame("00000181#0102")]);
        assert_eq!(read("t18180011223344556677\r"), [frame("181#0011223344556677")]);
    }

    #[test]
    fn a_remote_frame_keeps_its_dlc() {
        assert_eq!(read("r7011\r"), [frame("701#R1")]);
        assert_eq!(read("R000007018\r"), [frame("00000701#R8")]);
    }

    #[test]
    fn a_time_stamp_is_left_out() {
        assert_eq!(read("t1232AABB1F40\r"), [frame("123#AABB")]);
        assert_eq!(read("r70111F40\r"), [frame("701#R1")]);
    }

    #[test]
    fn answers_are_read() {
        assert_eq!(
            read("\r\x07z\rZ\rF20\r"),
            [Incoming::Done, Incoming::Refused, Incoming::Sent, Incoming::Sent, Incoming::Flags(Flags(0x20))]
        );
        assert_eq!(
            read("sa000000\rsw100096\rsp130005\rsb000256\re1a\rd18110102\r"),
            [
                Incoming::State(Link::ErrorActive),
                Incoming::State(Link::ErrorActive),
                Incoming::State(Link::ErrorPassive),
                Incoming::State(Link::BusOff),
                Incoming::BusError,
                Incoming::Fd,
            ]
        );
    }

    #[test]
    fn flags_are_those_of_the_manual() {
        assert!(Flags(0x20).error_passive() && !Flags(0xDF).error_passive());
        assert!(Flags(0x08).lost_frames() && Flags(0x01).lost_frames() && !Flags(0xF6).lost_frames());
        assert!(Flags(0x80).bus_error() && !Flags(0x7F).bus_error());
    }

    #[test]
    fn after_garbage_the_next_line_is_read() {
        for garbage in [
            "t12",
            "t1239",
            "t8000",
            "t12310",
            "t1231G0",
            "t123100F",
            "T2000000010",
            "r7019",
            "\u{fffd}\u{fffd}",
            "t1238001122334455667700000000000000000000000000000",
        ] {
            assert_eq!(read(&format!("{garbage}\rt1230\r")), [Incoming::Garbage, frame("123#")], "{garbage}");
        }
        assert_eq!(read("t12\x07t1230\r"), [Incoming::Garbage, frame("123#")]);
        assert_eq!(read("\r\nt1230\r\n"), [Incoming::Done, frame("123#")]);
    }

    #[test]
    fn r_det_089_every_bit_rate_has_its_command() {
        assert_eq!(bit_rate_command(10_000).as_deref(), Some("S0"));
        assert_eq!(bit_rate_command(125_000).as_deref(), Some("S4"));
        assert_eq!(bit_rate_command(1_000_000).as_deref(), Some("S8"));
        assert_eq!(bit_rate_command(83_333), None);
    }

    fn any_frame() -> impl Strategy<Value = CanFrame> {
        let id = prop_oneof![
            (0_u16..0x800).prop_map(CanId::Standard),
            (0_u32..0x2000_0000).prop_map(CanId::Extended)
        ];
        let data = proptest::collection::vec(any::<u8>(), 0..=8);
        (id, data, any::<bool>()).prop_map(|(id, data, remote)| {
            if remote {
                CanFrame::remote_frame(id, u8::try_from(data.len()).unwrap()).unwrap()
            } else {
                CanFrame::data_frame(id, &data).unwrap()
            }
        })
    }

    proptest! {
        #[test]
        fn what_is_sent_reads_back_as_the_same_frame(frame in any_frame()) {
            let mut line = String::new();
            encode(&frame, &mut line);
            prop_assert_eq!(read(&line), [Incoming::Frame(frame)]);
        }

        #[test]
        fn no_bytes_panic_and_every_line_gives_one_answer(bytes in proptest::collection::vec(any::<u8>(), 0..500)) {
            let mut decoder = Decoder::default();
            let answers = bytes.iter().filter(|byte| decoder.push(**byte).is_some()).count();
            let ends = bytes.iter().filter(|byte| matches!(**byte, RETURN | BELL)).count();
            prop_assert_eq!(answers, ends);
        }

        #[test]
        fn after_any_bytes_a_whole_line_is_read(bytes in proptest::collection::vec(any::<u8>(), 0..100)) {
            let mut decoder = Decoder::default();
            for byte in bytes.into_iter().chain([RETURN]) {
                decoder.push(byte);
            }
            let last = b"t1230\r".iter().filter_map(|byte| decoder.push(*byte)).last();
            prop_assert_eq!(last, Some(frame("123#")));
        }
    }
}
