//! SDO answers that are one too many: two servers answer in the name of one node.
//!
//! Only expedited transfers are looked at: one request, one answer. Requests of other clients count as well, so that their
//! answers are not taken for too many.

use std::time::Duration;

use crate::can::CanFrame;
use crate::time::Instant;

/// An answer later than this after the last request is no answer to it.
const ANSWERS_WITHIN: Duration = Duration::from_secs(2);
/// Producer heartbeat time, 0x1017:0, as it stands in a frame.
const HEARTBEAT: [u8; 3] = [0x17, 0x10, 0];

/// An answer too many.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(in crate::canopen) enum Extra {
    /// It says the same as the first.
    Same,
    /// It says something else: there are two who answer.
    Different,
}

/// The answers to the last request.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(in crate::canopen) struct Answers {
    /// Index and sub-index of the last request; `None`: it is of a kind that has several answers.
    object: Option<[u8; 3]>,
    asked: Instant,
    /// Requests for it that were not answered yet.
    open: u8,
    /// The last answer.
    answer: Vec<u8>,
}

/// What a node says of the time between its heartbeats.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(in crate::canopen) enum HeartbeatTime {
    /// This; zero = it sends none.
    Told(Duration),
    /// It refuses to tell, or to change it.
    Unknown,
}

impl Answers {
    /// A request to the node. The heartbeat time that it writes, if it does.
    pub(in crate::canopen) fn handle_request(&mut self, now: Instant, frame: &CanFrame) -> Option<Duration> {
        let &[command, a, b, c, low, high, ..] = frame.data() else { return None };
        let object = [a, b, c];
        let expedited_write = command & 0xE2 == 0x22;
        match command >> 5 {
            1 if expedited_write => self.ask(now, object),
            2 => self.ask(now, object),
            // The next segment of a transfer that is not judged.
            0 | 3 => {}
            _ => self.object = None,
        }
        (expedited_write && object == HEARTBEAT)
            .then(|| Duration::from_millis(u16::from_le_bytes([low, high]).into()))
    }

    fn ask(&mut self, now: Instant, object: [u8; 3]) {
        let again = self.object == Some(object) && now.since(self.asked) <= ANSWERS_WITHIN;
        if !again {
            self.open = 0;
            self.answer.clear();
        }
        self.open = self.open.saturating_add(1);
        self.object = Some(object);
        self.asked = now;
    }

    /// An answer of the node: whether it is one too many; and what it says of its heartbeat, if it does.
    pub(in crate::canopen) fn handle_answer(
        &mut self,
        now: Instant,
        frame: &CanFrame,
    ) -> (Option<Extra>, Option<HeartbeatTime>) {
        let &[command, a, b, c, low, high, ..] = frame.data() else { return (None, None) };
        let object = [a, b, c];
        let is_value = command & 0xE2 == 0x42;
        let heartbeat = match command >> 5 {
            2 if is_value && object == HEARTBEAT => {
                Some(HeartbeatTime::Told(Duration::from_millis(u16::from_le_bytes([low, high]).into())))
            }
            4 if object == HEARTBEAT => Some(HeartbeatTime::Unknown),
            _ => None,
        };
        match command >> 5 {
            2 if is_value => (self.take(now, object, frame), heartbeat),
            3 | 4 => (self.take(now, object, frame), heartbeat),
            2 => {
                // It goes on in segments.
                self.object = None;
                (None, heartbeat)
            }
            _ => (None, heartbeat),
        }
    }

    fn take(&mut self, now: Instant, object: [u8; 3], frame: &CanFrame) -> Option<Extra> {
        if self.object != Some(object) || now.since(self.asked) > ANSWERS_WITHIN {
            return None;
        }
        if self.open > 0 {
            self.open -= 1;
            self.answer = frame.data().to_vec();
            return None;
        }
        Some(if self.answer == frame.data() { Extra::Same } else { Extra::Different })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Frames of a conversation in turns: `>` to the node, `<` from it. The answers that are too many.
    fn extra(frames: &[(u64, &str)]) -> Vec<Extra> {
        let mut answers = Answers::default();
        let mut found = Vec::new();
        for (millis, line) in frames {
            let now = Instant::from_millis(*millis);
            let frame = line[1..].parse().unwrap();
            if line.starts_with('>') {
                answers.handle_request(now, &frame);
            } else {
                found.extend(answers.handle_answer(now, &frame).0);
            }
        }
        found
    }

    #[test]
    fn one_answer_to_each_request_is_right_also_when_it_was_repeated_or_somebody_else_asked() {
        for frames in [
            &[(0, ">601#4000100000000000"), (1, "<581#4300100094010200")][..],
            &[
                (0, ">601#4000100000000000"),
                (500, ">601#4000100000000000"),
                (600, "<581#4300100094010200"),
                (601, "<581#4300100094010200"),
            ],
            &[
                (0, ">601#4000100000000000"),
                (1, ">601#4018100100000000"),
                (2, "<581#4300100094010200"),
                (3, "<581#431810013D020000"),
            ],
            &[
                (0, ">601#4008100000000000"),
                (1, "<581#410810000C000000"),
                (2, ">601#6000000000000000"),
                (3, "<581#0044535420503932"),
                (4, "<581#8008100000000408"),
            ],
            &[(0, ">601#2B171000F4010000"), (1, "<581#6017100000000000"), (3000, "<581#6017100000000000")],
            &[(0, "<581#6017100000000000"), (1, "<581#6017100000000000")],
        ] {
            assert_eq!(extra(frames), [], "{frames:?}");
        }
    }

    #[test]
    fn a_second_answer_is_one_too_many_and_says_the_same_or_not() {
        assert_eq!(
            extra(&[
                (0, ">601#4018100400000000"),
                (1, "<581#4318100440E20100"),
                (2, "<581#4318100441E20100"),
                (10, ">601#2B171000F4010000"),
                (11, "<581#6017100000000000"),
                (12, "<581#6017100000000000"),
                (20, ">601#4000100000000000"),
                (21, "<581#4300100094010200"),
                (22, "<581#8000100000000206"),
            ]),
            [Extra::Different, Extra::Same, Extra::Different]
        );
    }

    #[test]
    fn the_heartbeat_time_is_learned_from_what_is_read_and_written() {
        let mut answers = Answers::default();
        let ask = |frame: &str| answers.clone().handle_request(Instant::START, &frame.parse().unwrap());
        assert_eq!(ask("601#2B171000F4010000"), Some(Duration::from_millis(500)));
        assert_eq!(ask("601#2B181000F4010000"), None);
        let mut hear = |frame: &str| answers.handle_answer(Instant::START, &frame.parse().unwrap()).1;
        assert_eq!(hear("581#4B171000F4010000"), Some(HeartbeatTime::Told(Duration::from_millis(500))));
        assert_eq!(hear("581#8017100002000106"), Some(HeartbeatTime::Unknown));
        assert_eq!(hear("581#6017100000000000"), None);
    }
}
