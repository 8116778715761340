//! Serial lines as readers see them: what came in last, as bytes and as messages.
//!
//! Both are rings: a reader brings a cursor and learns what it has missed. Nothing waits for a reader.

use std::collections::VecDeque;

use crate::time::Timestamp;

/// Bytes that are kept of a line: at 38,400 bit/s those of 17 s.
pub const BYTES: usize = 65_536;
/// Messages that are kept of a line.
pub const MESSAGES: usize = 128;

/// A serial line.
#[derive(Clone, Debug, Default)]
pub struct SerialLine {
    /// Bytes can be sent to it: the bus is up, its module is not lost, and the gateway is not passive.
    pub open: bool,
    /// How often what came in may have a gap: the module was lost or started anew, or the bus went down.
    pub breaks: u64,
    bytes: VecDeque<u8>,
    /// How many came in since the gateway started: the cursor of the next.
    received: u64,
    messages: VecDeque<SerialMessage>,
    /// Number of the next.
    next_message: u64,
}

/// What came in on a line and belongs together.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct SerialMessage {
    /// Counts the messages of the line since the gateway started, from 1.
    pub number: u64,
    /// When its last frame was received.
    pub at: Timestamp,
    /// Without its end mark.
    pub bytes: Vec<u8>,
    /// What ended it: `delimiter`, `length`, `idle` or `cut`.
    pub end: &'static str,
}

impl SerialLine {
    /// Bytes came in.
    pub fn append(&mut self, bytes: &[u8]) {
        self.received = self.received.saturating_add(u64::try_from(bytes.len()).unwrap_or(0));
        self.bytes.extend(bytes);
        self.bytes.drain(..self.bytes.len().saturating_sub(BYTES));
    }

    /// They make a message.
    pub fn append_message(&mut self, at: Timestamp, bytes: Vec<u8>, end: &'static str) {
        self.next_message += 1;
        if self.messages.len() >= MESSAGES {
            self.messages.pop_front();
        }
        self.messages.push_back(SerialMessage { number: self.next_message, at, bytes, end });
    }

    /// The cursor of a reader that wants what comes in from now on.
    #[must_use]
    pub fn cursor(&self) -> u64 {
        self.received
    }

    /// At most `limit` bytes from a cursor on, which moves behind them; and how many were gone already.
    pub fn read(&self, cursor: &mut u64, limit: usize) -> (Vec<u8>, u64) {
        let kept = u64::try_from(self.bytes.len()).unwrap_or(0);
        let oldest = self.received - kept;
        let from = (*cursor).clamp(oldest, self.received);
        let missed = from.saturating_sub(*cursor);
        let skip = usize::try_from(from - oldest).unwrap_or(usize::MAX);
        let bytes: Vec<u8> = self.bytes.iter().skip(skip).take(limit).copied().collect();
        *cursor = from + u64::try_from(bytes.len()).unwrap_or(0);
        (bytes, missed)
    }

    /// The messages after that of a number, and how many of them are gone already.
    pub fn messages_after(&self, number: u64) -> (impl Iterator<Item = &SerialMessage>, u64) {
        let oldest = self.messages.front().map_or(self.next_message + 1, |message| message.number);
        let missed = oldest.saturating_sub(number.saturating_add(1));
        (self.messages.iter().filter(move |message| message.number > number), missed)
    }

    /// The number of the newest message; 0 before the first.
    #[must_use]
    pub fn newest_message(&self) -> u64 {
        self.next_message
    }

    /// The newest message.
    #[must_use]
    pub fn last_message(&self) -> Option<&SerialMessage> {
        self.messages.back()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_reader_gets_what_came_in_since_it_read_last_in_order() {
        let mut line = SerialLine::default();
        line.append(b"before");
        let mut cursor = line.cursor();
        line.append(b"abc");
        line.append(b"defg");
        assert_eq!(line.read(&mut cursor, 5), (b"abcde".to_vec(), 0));
        assert_eq!(line.read(&mut cursor, 5), (b"fg".to_vec(), 0));
        assert_eq!(line.read(&mut cursor, 5), (Vec::new(), 0));
    }

    #[test]
    fn a_reader_that_is_too_slow_learns_how_much_it_missed() {
        let mut line = SerialLine::default();
        let mut cursor = line.cursor();
        for _ in 0..BYTES / 8 {
            line.append(b"12345678");
        }
        line.append(b"xyz");
        let (bytes, missed) = line.read(&mut cursor, BYTES * 2);
        assert_eq!((bytes.len(), missed), (BYTES, 3));
        assert!(bytes.ends_with(b"8xyz"));
        assert_eq!(cursor, line.cursor());
    }

    #[test]
    fn messages_have_numbers_and_those_that_are_gone_are_counted() {
        let mut line = SerialLine::default();
        let at = Timestamp::from_micros(0);
        assert_eq!(line.messages_after(0).1, 0);
        for _ in 0..MESSAGES + 2 {
            line.append_message(at, b"x".to_vec(), "delimiter");
        }
        let (messages, missed) = line.messages_after(1);
        assert_eq!((messages.count(), missed), (MESSAGES, 1));
        let (messages, missed) = line.messages_after(line.newest_message() - 2);
        let numbers: Vec<u64> = messages.map(|message| message.number).collect();
        assert_eq!((numbers, missed), (vec![129, 130], 0));
        assert_eq!(line.last_message().unwrap().number, line.newest_message());
    }
}
