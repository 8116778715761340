//! Recordings of a bus as `candump -l` writes them and `canplayer` reads them. Pure.
//!
//! ```text
//! (1763760000.123456) can0 181#0011223344556677
//! (1763760000.223456) can0 701#R1
//! ```
//!
//! Error frames and CAN FD frames (`181##0...`) are counted and left out (R-DET-006). Empty lines and lines that begin
//! with `#` mean nothing, so that a recording can say what it is.

use std::fmt;

use super::frame::CanFrame;
use crate::time::{Instant, Now, Timestamp};

/// A frame of a recording.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Record {
    /// When it was received, by the clock of the host that recorded it.
    pub utc: Timestamp,
    /// On which interface, as that host called it.
    pub interface: String,
    /// The frame.
    pub frame: CanFrame,
}

impl Record {
    /// The moment of this frame in a replay that begins with the record of time `first`. A recording may contain a
    /// step of the wall clock: a frame that seems older than the first is as old as it.
    #[must_use]
    pub fn at(&self, first: Timestamp) -> Now {
        let since = self.utc.as_micros().saturating_sub(first.as_micros());
        Now { instant: Instant::from_micros(u64::try_from(since).unwrap_or(0)), utc: self.utc }
    }
}

impl fmt::Display for Record {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let micros = self.utc.as_micros();
        let (seconds, rest) = (micros.div_euclid(1_000_000), micros.rem_euclid(1_000_000));
        write!(f, "({seconds:010}.{rest:06}) {} {}", self.interface, self.frame)
    }
}

/// A whole recording.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Recording {
    /// The frames, in the order of the lines.
    pub records: Vec<Record>,
    /// Error frames that were left out.
    pub error_frames: u64,
    /// CAN FD frames that were left out.
    pub fd_frames: u64,
}

/// A line that is not part of a recording.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("line {line}: {reason}; a line of a candump log reads `(1763760000.123456) can0 181#0011`")]
pub struct RecordingError {
    /// Which line, from 1.
    pub line: usize,
    reason: String,
}

impl std::str::FromStr for Recording {
    type Err = RecordingError;

    fn from_str(text: &str) -> Result<Self, RecordingError> {
        let mut recording = Self::default();
        for (index, line) in text.lines().enumerate() {
            let parsed = parse_line(line).map_err(|reason| RecordingError { line: index + 1, reason })?;
            match parsed {
                Line::Nothing => {}
                Line::Record(record) => recording.records.push(record),
                Line::ErrorFrame => recording.error_frames += 1,
                Line::FdFrame => recording.fd_frames += 1,
            }
        }
        Ok(recording)
    }
}

impl fmt::Display for Recording {
    /// The frames alone, one a line.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.records.iter().try_for_each(|record| writeln!(f, "{record}"))
    }
}

/// What a line of a recording holds.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Line {
    /// Nothing: it is empty, or a comment.
    Nothing,
    /// A frame.
    Record(Record),
    /// An error frame.
    ErrorFrame,
    /// A CAN FD frame.
    FdFrame,
}

/// Reads one line, for recordings that are too long to be held whole.
///
/// # Errors
/// What is wrong with the line, without its number.
pub fn parse_line(line: &str) -> Result<Line, String> {
    let mut words = line.split_ascii_whitespace();
    let time = match words.next() {
        None => return Ok(Line::Nothing),
        Some(word) if word.starts_with('#') => return Ok(Line::Nothing),
        Some(word) => word,
    };
    let utc = timestamp(time).ok_or_else(|| format!("`{time}` is not a time in parentheses"))?;
    let interface = words.next().ok_or("the interface is missing")?;
    let frame = words.next().ok_or("the frame is missing")?;
    // Newer versions of candump say at the end whether the frame was received or sent.
    match (words.next(), words.next()) {
        (None | Some("R" | "T"), None) => {}
        (Some(word), _) | (None, Some(word)) => return Err(format!("`{word}` is too much")),
    }
    if is_error_frame(frame) {
        return Ok(Line::ErrorFrame);
    }
    if frame.contains("##") {
        return Ok(Line::FdFrame);
    }
    let frame = frame.parse().map_err(|error| format!("{error}"))?;
    Ok(Line::Record(Record { utc, interface: interface.to_owned(), frame }))
}

/// Seconds and microseconds in parentheses.
fn timestamp(word: &str) -> Option<Timestamp> {
    let (seconds, micros) = word.strip_prefix('(')?.strip_suffix(')')?.split_once('.')?;
    let digits = |text: &str| !text.is_empty() && text.bytes().all(|byte| byte.is_ascii_digit());
    if !digits(seconds) || !digits(micros) || micros.len() != 6 {
        return None;
    }
    let seconds: i64 = seconds.parse().ok()?;
    let micros: i64 = micros.parse().ok()?;
    Some(Timestamp::from_micros(seconds.checked_mul(1_000_000)?.checked_add(micros)?))
}

/// Eight digits of identifier with the flag of an error frame set.
fn is_error_frame(frame: &str) -> bool {
    let id = frame.split_once('#').map_or("", |(id, _)| id);
    id.len() == 8 && u32::from_str_radix(id, 16).is_ok_and(|id| id & 0x2000_0000 != 0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const LOG: &str = "\
# a device starts
(1763760000.123456) can0 701#00
(1763760000.223456) can0 701#R1

(1763760000.323456) can1 00000181#0102 R
(1763760000.423456) can0 20000040#0000000000000000
(1763760000.523456) can0 181##0112233
(1763760001.000000) can0 181#
";

    #[test]
    fn a_candump_log_is_read() {
        let recording: Recording = LOG.parse().unwrap();
        let frames: Vec<_> = recording.records.iter().map(|record| record.frame.to_string()).collect();
        assert_eq!(frames, ["701#00", "701#R1", "00000181#0102", "181#"]);
        assert_eq!((recording.error_frames, recording.fd_frames), (1, 1));
        assert_eq!(recording.records[0].utc, Timestamp::from_micros(1_763_760_000_123_456));
        assert_eq!(recording.records[2].interface, "can1");
    }

    #[test]
    fn what_is_written_reads_back_as_the_same() {
        let recording: Recording = LOG.parse().unwrap();
        let again: Recording = recording.to_string().parse().unwrap();
        assert_eq!(again.records, recording.records);
        assert!(recording.to_string().starts_with("(1763760000.123456) can0 701#00\n"));
    }

    #[test]
    fn a_wrong_line_is_named_with_its_number_and_the_reason() {
        for (line, reason) in [
            ("1763760000.123456 can0 701#00", "in parentheses"),
            ("(1763760000.12345) can0 701#00", "in parentheses"),
            ("(-1.123456) can0 701#00", "in parentheses"),
            ("(99999999999999999999.000000) can0 701#00", "in parentheses"),
            ("(1763760000.123456)", "the interface is missing"),
            ("(1763760000.123456) can0", "the frame is missing"),
            ("(1763760000.123456) can0 701#0", "pairs"),
            ("(1763760000.123456) can0 701#00 X", "too much"),
            ("(1763760000.123456) can0 701#00 R R", "too much"),
        ] {
            let error = format!("\n{line}\n").parse::<Recording>().unwrap_err();
            assert_eq!(error.line, 2);
            assert!(error.to_string().contains(reason), "{line}: {error}");
        }
    }

    #[test]
    fn a_replay_begins_with_its_first_frame_and_never_goes_back_before_it() {
        let recording: Recording = LOG.parse().unwrap();
        let first = recording.records[0].utc;
        assert_eq!(recording.records[1].at(first).instant, Instant::from_millis(100));
        assert_eq!(recording.records[1].at(first).utc, recording.records[1].utc);
        assert_eq!(recording.records[0].at(recording.records[3].utc).instant, Instant::START);
    }

    proptest! {
        #[test]
        fn no_text_panics(text in ".{0,60}") {
            let _ = parse_line(&text);
        }

        #[test]
        fn nearly_a_line_does_not_panic(time in "\\(?[0-9]{0,20}\\.[0-9]{0,7}\\)?", frame in "[0-9A-Fa-fRr#é]{0,20}") {
            let _ = parse_line(&format!("{time} can0 {frame}"));
        }
    }
}
