//! Messages out of the bytes that come in on a line (R-ESD-034).

use std::time::Duration;

use super::event::MessageEnd;
use super::settings::Framing;
use crate::time::Instant;

/// What came in since the last message.
#[derive(Debug)]
pub(super) struct Messages {
    delimiter: Vec<u8>,
    longest: usize,
    idle: Option<Duration>,
    buffer: Vec<u8>,
    /// When the newest byte came.
    last: Instant,
}

impl Messages {
    pub(super) fn new(framing: &Framing) -> Self {
        Self {
            delimiter: framing.delimiter.clone(),
            longest: framing.longest.max(1),
            idle: framing.idle,
            buffer: Vec::new(),
            last: Instant::START,
        }
    }

    /// One more byte; what it ends, if anything.
    ///
    /// Where there is an end mark, a message of the greatest length is told only when it is clear that its mark
    /// does not follow.
    pub(super) fn push(&mut self, now: Instant, byte: u8) -> Option<(Vec<u8>, MessageEnd)> {
        self.last = now;
        self.buffer.push(byte);
        if self.delimiter.is_empty() {
            let full = self.buffer.len() >= self.longest;
            return full.then(|| (std::mem::take(&mut self.buffer), MessageEnd::Length));
        }
        if let Some(length) = self.buffer.strip_suffix(self.delimiter.as_slice()).map(<[u8]>::len) {
            let mut bytes = std::mem::take(&mut self.buffer);
            bytes.truncate(length);
            return Some((bytes, MessageEnd::Delimiter));
        }
        let begun = (1..self.delimiter.len())
            .rev()
            .find(|count| self.delimiter.get(..*count).is_some_and(|begin| self.buffer.ends_with(begin)));
        let known = self.buffer.len().saturating_sub(begun.unwrap_or(0));
        (known > self.longest).then(|| {
            let rest = self.buffer.split_off(self.longest);
            (std::mem::replace(&mut self.buffer, rest), MessageEnd::Length)
        })
    }

    /// What a pause ended.
    pub(super) fn take_idle(&mut self, now: Instant) -> Option<(Vec<u8>, MessageEnd)> {
        self.idle_at().filter(|at| *at <= now)?;
        Some((std::mem::take(&mut self.buffer), MessageEnd::Idle))
    }

    /// What follows does not belong to what came until now.
    pub(super) fn cut(&mut self) -> Option<(Vec<u8>, MessageEnd)> {
        let bytes = std::mem::take(&mut self.buffer);
        (!bytes.is_empty()).then_some((bytes, MessageEnd::Cut))
    }

    /// When a pause will have ended a message.
    pub(super) fn idle_at(&self) -> Option<Instant> {
        let idle = self.idle.filter(|_| !self.buffer.is_empty())?;
        Some(self.last + idle)
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn framing(delimiter: &[u8], longest: usize, idle: Option<u64>) -> Framing {
        Framing { delimiter: delimiter.to_vec(), longest, idle: idle.map(Duration::from_millis) }
    }

    /// Messages as text, with their ends.
    fn messages(framing: &Framing, text: &str) -> Vec<String> {
        let mut messages = Messages::new(framing);
        let told = text.bytes().filter_map(|byte| messages.push(Instant::START, byte));
        told.map(|(bytes, end)| format!("{}:{}", String::from_utf8(bytes).unwrap(), end.word())).collect()
    }

    #[test]
    fn r_esd_034_a_message_ends_with_its_end_mark_which_is_no_part_of_it() {
        let lines = framing(b"\r\n", 100, None);
        assert_eq!(
            messages(&lines, "ab\r\ncd\r\r\n\r\n\re\n\r"),
            ["ab:delimiter", "cd\r:delimiter", ":delimiter"]
        );
    }

    #[test]
    fn r_esd_034_a_message_ends_at_its_greatest_length() {
        assert_eq!(messages(&framing(b"", 4, None), "abcdefghij"), ["abcd:length", "efgh:length"]);
        let lines = framing(b"\r\n", 4, None);
        assert_eq!(messages(&lines, "abcd\r\nefghi\r\n"), ["abcd:delimiter", "efgh:length", "i:delimiter"]);
        assert_eq!(messages(&lines, "abcd\rx\r\n"), ["abcd:length", "\rx:delimiter"]);
    }

    #[test]
    fn r_esd_034_a_message_ends_with_a_pause() {
        let mut messages = Messages::new(&framing(b"\n", 100, Some(50)));
        assert_eq!(messages.idle_at(), None);
        messages.push(Instant::from_millis(10), b'a');
        messages.push(Instant::from_millis(40), b'b');
        assert_eq!(messages.take_idle(Instant::from_millis(89)), None);
        let message = messages.take_idle(Instant::from_millis(90));
        assert_eq!(message, Some((b"ab".to_vec(), MessageEnd::Idle)));
        assert_eq!(messages.idle_at(), None);
        messages.push(Instant::from_millis(95), b'c');
        assert_eq!(messages.cut(), Some((b"c".to_vec(), MessageEnd::Cut)));
        assert_eq!(messages.cut(), None);
    }

    proptest! {
        #[test]
        fn r_esd_032_nothing_is_lost_or_moved_and_no_message_is_too_long(
            bytes in prop::collection::vec(prop::sample::select(b"ab\r\n".to_vec()), 0..200),
            delimiter in prop::sample::select(vec!["", "\n", "\r\n", "\r\r\n", "abab\r"]),
            longest in 1_usize..6,
        ) {
            let mut messages = Messages::new(&framing(delimiter.as_bytes(), longest, None));
            let mut joined = Vec::new();
            for byte in &bytes {
                let ended = messages.push(Instant::START, *byte);
                if let Some((message, end)) = ended {
                    prop_assert!(message.len() <= longest + delimiter.len());
                    joined.extend(message);
                    if end == MessageEnd::Delimiter {
                        joined.extend(delimiter.as_bytes());
                    }
                }
                prop_assert!(messages.buffer.len() <= longest + 2 * delimiter.len());
            }
            joined.extend(messages.cut().map(|(rest, _)| rest).unwrap_or_default());
            prop_assert_eq!(joined, bytes);
        }
    }
}
