//! Fastscan (CiA 305 from V2.2 on): finds the address of one slave without node id, one bit after the other.
//!
//! A slave answers when its bits from 31 down to the asked one are those of the question. Silence thus means that the bit
//! is 1, and has to be waited for; with several slaves on the bus the scan follows those that answer, and ends with one.
//! That one is in configuration state then and is asked for its address, as a late answer or a lost frame may have led
//! astray.

use super::codec::{self, FASTSCAN_START, IDENTIFIED};
use super::program::{Exchange, Expect, Next, Reply};
use super::{LssAddress, LssAnswer, LssError, LssKnown};

/// Parts of an address.
const PARTS: u8 = 4;

/// A fastscan under way.
#[derive(Debug)]
pub(super) struct Fastscan {
    known: LssKnown,
    /// The parts that are complete.
    numbers: Vec<u32>,
    /// The part under way, its undecided bits 0.
    number: u32,
    question: Question,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Question {
    /// Nothing was asked yet.
    Nothing,
    /// Whether anybody is there.
    Start,
    /// Whether this bit is 0.
    Bit(u8),
    /// Whether the part is right; who says so goes on to the next.
    Part,
    /// Which number this part of the address of the slave in configuration state is.
    Inquire(u8),
}

impl Fastscan {
    /// A scan that has not begun.
    pub(super) fn new(known: LssKnown) -> Self {
        Self { known, numbers: Vec::new(), number: 0, question: Question::Nothing }
    }

    /// The step after this reply.
    pub(super) fn next(&mut self, reply: Reply) -> Next {
        let answer = match reply {
            Reply::Failed(error) => return Next::Finish(Err(error)),
            Reply::Answer(answer) => Some(answer),
            Reply::Done | Reply::Silence | Reply::Performed(_) => None,
        };
        let yes = answer.is_some();
        self.question = match self.question {
            Question::Nothing => Question::Start,
            Question::Start if !yes => return Next::Finish(Ok(LssAnswer::Found(Vec::new()))),
            Question::Start => self.begin_part(),
            Question::Bit(bit) => {
                self.number |= u32::from(!yes) << bit;
                bit.checked_sub(1).map_or(Question::Part, Question::Bit)
            }
            // A known part simply may not be there; one that was found out must be.
            Question::Part if !yes && self.known().is_some() => {
                return Next::Finish(Ok(LssAnswer::Found(Vec::new())));
            }
            Question::Part if !yes => return Next::Finish(Err(LssError::Inconsistent)),
            Question::Part => {
                self.numbers.push(self.number);
                if self.numbers.len() < PARTS.into() { self.begin_part() } else { Question::Inquire(0) }
            }
            Question::Inquire(part)
                if answer.map(codec::number) != self.numbers.get(usize::from(part)).copied() =>
            {
                return Next::Finish(Err(LssError::Inconsistent));
            }
            Question::Inquire(part) => match *self.numbers.as_slice() {
                [vendor, product, revision, serial] if part + 1 == PARTS => {
                    let found = LssAddress { vendor, product, revision, serial };
                    return Next::Finish(Ok(LssAnswer::Found(vec![found])));
                }
                _ => Question::Inquire(part + 1),
            },
        };
        Next::Exchange(self.exchange())
    }

    fn begin_part(&mut self) -> Question {
        self.number = self.known().unwrap_or_default();
        if self.known().is_some() { Question::Part } else { Question::Bit(31) }
    }

    /// The part under way, if it need not be found out.
    fn known(&self) -> Option<u32> {
        match self.numbers.len() {
            0 => self.known.vendor,
            1 => self.known.product,
            2 => self.known.revision,
            _ => self.known.serial,
        }
    }

    fn exchange(&self) -> Exchange {
        let part = u8::try_from(self.numbers.len()).unwrap_or_default();
        let frame = match self.question {
            Question::Nothing | Question::Start => codec::fastscan(0, FASTSCAN_START, 0, 0),
            Question::Bit(bit) => codec::fastscan(self.number, bit, part, part),
            // After the last part the slave goes back to the first, and into configuration state.
            Question::Part => codec::fastscan(self.number, 0, part, (part + 1) % PARTS),
            Question::Inquire(part) => {
                let command = codec::INQUIRE_VENDOR + part;
                return Exchange::new("inquire address", &[codec::plain(command)], Expect::Answer(command));
            }
        };
        Exchange::new("fastscan", &[frame], Expect::Collect(IDENTIFIED))
    }
}
