//! Answers of modules to requests (R-ESD-051..064).
//!
//! They carry no module number: whose an answer is follows from who was asked last (R-ESD-055, see `dialogue`).

use std::fmt;

use super::init_frame::Request;
use super::status::CanStatus;

/// What a module answers to a command that it does not know: one byte (R-ESD-052).
const UNKNOWN: u8 = 0xFF;

/// What a module answered.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Answer {
    /// The code of its type (R-ESD-058).
    ModuleType(u8),
    /// The value of its coding switches (R-ESD-059).
    Switch(u8),
    /// Type and number as text (R-ESD-060).
    AsciiId {
        /// Five characters of the type.
        kind: [u8; 5],
        /// Two hexadecimal digits.
        number: [u8; 2],
    },
    /// Its firmware.
    Software(SoftwareRevision),
    /// Six characters (R-ESD-062).
    SerialNumber([u8; 6]),
    /// A module number.
    Number(u8),
    /// Its status byte.
    Status(CanStatus),
    /// A bit rate as two registers.
    BitRate([u8; 2]),
    /// An identifier.
    Id(u16),
    /// The first and the last identifier of a block; equal where blocks are not used (R-ESD-064).
    Ids {
        /// The first.
        first: u16,
        /// The last.
        last: u16,
    },
    /// `WDtime`.
    WatchdogTime {
        /// ms.
        millis: u16,
        /// Life time factor, where it was told (R-ESD-089).
        factor: Option<u8>,
    },
    /// A time in ms or the value of a user parameter.
    Value(u16),
    /// It does not know what it was asked.
    Unknown,
}

/// Level, revision, firmware and protocol of a module, one character each but for the protocol (R-ESD-061).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SoftwareRevision([u8; 7]);

impl SoftwareRevision {
    /// `C`: it speaks CAL/CMS and not the esd protocol, `E` (R-ESD-005). The meaning of the letters comes from public
    /// copies of the manual.
    #[must_use]
    pub fn protocol(self) -> char {
        char::from(self.0[5])
    }
}

impl fmt::Display for SoftwareRevision {
    /// As in the manual: `V1.0aE0`. What is no printing character shows as `?`.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.iter().try_for_each(|byte| {
            let shown = if byte.is_ascii_graphic() { char::from(*byte) } else { '?' };
            write!(f, "{shown}")
        })
    }
}

impl Answer {
    /// What the data of a frame answers to a request; `None` where it is not the answer to that: another head, or another
    /// length than such an answer has.
    ///
    /// The layout of some answers is cut off in the manual: they may be longer than what is known of them.
    #[must_use]
    pub fn parse(request: Request, data: &[u8]) -> Option<Self> {
        if data == [UNKNOWN] {
            return Some(Self::Unknown);
        }
        let [command, sub] = request.head();
        match (request, data) {
            // Where byte 1 carries data, byte 0 alone is the head.
            (Request::AsciiId, [0x00, rest @ ..]) => {
                let (kind, number) = rest.split_first_chunk::<5>()?;
                return Some(Self::AsciiId { kind: *kind, number: number.try_into().ok()? });
            }
            (Request::SoftwareRevision, [0x00, rest @ ..]) => {
                let revision: [u8; 7] = rest.try_into().ok()?;
                return (revision[0] == b'V' && revision[2] == b'.')
                    .then_some(Self::Software(SoftwareRevision(revision)));
            }
            (Request::AsciiId | Request::SoftwareRevision, _) => return None,
            _ => {}
        }
        let (head, rest) = data.split_first_chunk::<2>()?;
        if *head != [command, sub] {
            return None;
        }
        Self::parse_rest(request, rest)
    }

    /// What follows command and sub-command.
    fn parse_rest(request: Request, rest: &[u8]) -> Option<Self> {
        let word = |bytes: &[u8; 2]| u16::from_be_bytes(*bytes);
        Some(match (request, rest) {
            (Request::ModuleType, [kind, ..]) => Self::ModuleType(*kind),
            (Request::Switch, [value] | [value, _]) => Self::Switch(*value),
            (Request::SerialNumber, _) => Self::SerialNumber(rest.try_into().ok()?),
            (Request::SavedNumber | Request::ActiveNumber, [number] | [number, _]) => Self::Number(*number),
            (Request::Status, [status] | [status, _]) => Self::Status(CanStatus(*status)),
            (Request::BitRate, _) => Self::BitRate(rest.try_into().ok()?),
            (Request::WatchdogTime, [high, low, factor @ ..]) if factor.len() <= 1 => {
                Self::WatchdogTime { millis: word(&[*high, *low]), factor: factor.first().copied() }
            }
            (Request::WatchdogId | Request::TxId(_), _) => Self::Id(word(rest.try_into().ok()?)),
            (Request::RxId(_), [high, low]) => {
                Self::Ids { first: word(&[*high, *low]), last: word(&[*high, *low]) }
            }
            (Request::RxId(_), [high, low, last_high, last_low]) => {
                Self::Ids { first: word(&[*high, *low]), last: word(&[*last_high, *last_low]) }
            }
            (Request::TxActivateTime(_) | Request::Parameter(_), _) => {
                Self::Value(word(rest.try_into().ok()?))
            }
            _ => return None,
        })
    }
}

impl fmt::Display for Answer {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::ModuleType(number) | Self::Switch(number) | Self::Number(number) => {
                write!(f, "0x{number:02X}")
            }
            Self::AsciiId { kind, number } => {
                write!(f, "{}{}", kind.escape_ascii(), number.escape_ascii())
            }
            Self::Software(revision) => revision.fmt(f),
            Self::SerialNumber(text) => write!(f, "{}", text.escape_ascii()),
            Self::Status(status) => write!(f, "0x{:02X}", status.0),
            Self::BitRate([first, second]) => write!(f, "0x{first:02X} 0x{second:02X}"),
            Self::Ids { first, last } if first != last => write!(f, "0x{first:03X} to 0x{last:03X}"),
            Self::Id(id) | Self::Ids { first: id, .. } => write!(f, "0x{id:03X}"),
            Self::WatchdogTime { millis, factor: None } => write!(f, "{millis} ms, no factor told"),
            Self::WatchdogTime { millis, factor: Some(factor) } => write!(f, "{millis} ms times {factor}"),
            Self::Value(value) => write!(f, "0x{value:04X}"),
            Self::Unknown => f.write_str("not known to it"),
        }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::can::CanFrame;

    fn parse(request: Request, text: &str) -> Option<Answer> {
        let frame: CanFrame = text.parse().unwrap();
        Answer::parse(request, frame.data())
    }

    #[test]
    fn r_esd_051_059_060_061_062_v_esd_06_answers_byte_for_byte() {
        assert_eq!(parse(Request::TxId(0), "567#020000B4"), Some(Answer::Id(0x0B4)));
        assert_eq!(parse(Request::TxId(0), "567#020001AA"), Some(Answer::Id(0x1AA)));
        let Some(Answer::Software(revision)) = parse(Request::SoftwareRevision, "567#0056312E30614530")
        else {
            panic!("no revision");
        };
        assert_eq!((revision.to_string().as_str(), revision.protocol()), ("V1.0aE0", 'E'));
        let serial = parse(Request::SerialNumber, "567#0005414130303132");
        assert_eq!(serial.map(|it| it.to_string()).as_deref(), Some("AA0012"));
        assert_eq!(parse(Request::Switch, "567#000112"), Some(Answer::Switch(0x12)));
        assert_eq!(parse(Request::ActiveNumber, "567#010112"), Some(Answer::Number(0x12)));
        assert_eq!(parse(Request::SavedNumber, "567#010000"), Some(Answer::Number(0)));
        assert_eq!(parse(Request::Status, "567#0102C1"), Some(Answer::Status(CanStatus(0xC1))), "V-ESD-07");
        assert_eq!(parse(Request::Parameter(0x22), "567#06222273"), Some(Answer::Value(0x2273)), "V-ESD-09");
        let id = parse(Request::AsciiId, "567#0053494F34313939");
        assert_eq!(id.map(|it| it.to_string()).as_deref(), Some("SIO4199"));
    }

    #[test]
    fn r_esd_058_module_types() {
        assert_eq!(parse(Request::ModuleType, "567#000030"), Some(Answer::ModuleType(0x30)));
        assert_eq!(parse(Request::ModuleType, "567#00003105"), Some(Answer::ModuleType(0x31)));
    }

    #[test]
    fn r_esd_064_from_public_copies_the_receive_identifier_stands_twice_in_its_answer() {
        let one = Answer::Ids { first: 0x155, last: 0x155 };
        assert_eq!(parse(Request::RxId(0), "567#030001550155"), Some(one));
        assert_eq!(parse(Request::RxId(0), "567#03000155"), Some(one));
        let block = parse(Request::RxId(0), "567#030001550158");
        assert_eq!(block, Some(Answer::Ids { first: 0x155, last: 0x158 }));
    }

    #[test]
    fn r_esd_089_from_public_copies_the_watchdog_factor_follows_the_time() {
        let told = Answer::WatchdogTime { millis: 1000, factor: Some(3) };
        assert_eq!(parse(Request::WatchdogTime, "567#010503E803"), Some(told));
        let untold = Answer::WatchdogTime { millis: 1000, factor: None };
        assert_eq!(parse(Request::WatchdogTime, "567#010503E8"), Some(untold));
    }

    #[test]
    fn r_esd_052_one_byte_ff_says_that_the_command_is_not_known() {
        assert_eq!(parse(Request::Parameter(3), "567#FF"), Some(Answer::Unknown));
        assert_eq!(parse(Request::Parameter(3), "567#FFFF"), None);
    }

    #[test]
    fn answers_to_something_else_or_of_a_wrong_length_are_none() {
        for (request, text) in [
            (Request::TxId(0), "567#020100B4"),
            (Request::TxId(0), "567#0200B4"),
            (Request::TxId(0), "567#020000B400"),
            (Request::TxId(0), "567#R4"),
            (Request::Status, "567#0102"),
            (Request::Status, "567#0102C10C00"),
            (Request::ActiveNumber, "567#010212"),
            (Request::SoftwareRevision, "567#0005414130303132"),
            (Request::SoftwareRevision, "567#0056312E306145"),
            (Request::SerialNumber, "567#00054141303031"),
            (Request::RxId(0), "567#0300015501"),
            (Request::WatchdogTime, "567#010503E80300"),
            (Request::Switch, "567#"),
        ] {
            assert_eq!(parse(request, text), None, "{request:?} {text}");
        }
    }

    proptest! {
        #[test]
        fn no_bytes_panic(sub: u8, data in prop::collection::vec(any::<u8>(), 0..=8)) {
            for request in [Request::ModuleType, Request::AsciiId, Request::WatchdogTime, Request::RxId(sub)] {
                if let Some(answer) = Answer::parse(request, &data) {
                    prop_assert!(!answer.to_string().is_empty());
                }
            }
        }
    }
}
