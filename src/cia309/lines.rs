//! Lines out of a stream of bytes. A line ends with LF; a CR before it belongs to the end.

/// The longest line in bytes, its end included: enough to write an object of 12,000 bytes.
pub const LONGEST_LINE: usize = 16_384;

/// A line was longer than [`LONGEST_LINE`]; all of it was thrown away.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TooLong;

/// What came and is not yet worked off: never more than was given at once, beside one line.
#[derive(Debug, Default)]
pub struct Lines {
    bytes: Vec<u8>,
    /// Up to here they were handed out.
    used: usize,
    /// The rest of a line that is too long is being thrown away.
    skipping: bool,
}

impl Lines {
    /// More bytes came. To be called only when [`next`](Self::next_line) has nothing more.
    pub fn push(&mut self, bytes: &[u8]) {
        self.bytes.drain(..self.used);
        self.used = 0;
        self.bytes.extend_from_slice(bytes);
    }

    /// The next line without its end; `None` when none is complete.
    pub fn next_line(&mut self) -> Option<Result<&[u8], TooLong>> {
        let start = self.used;
        let rest = self.bytes.get(start..)?;
        let Some(length) = rest.iter().position(|byte| *byte == b'\n') else {
            if rest.len() >= LONGEST_LINE {
                self.skipping = true;
            }
            if self.skipping {
                self.bytes.clear();
                self.used = 0;
            }
            return None;
        };
        self.used = start + length + 1;
        if std::mem::take(&mut self.skipping) || length >= LONGEST_LINE {
            return Some(Err(TooLong));
        }
        let line = self.bytes.get(start..start + length)?;
        Some(Ok(line.strip_suffix(b"\r").unwrap_or(line)))
    }

    /// Bytes that wait, handed out or not.
    #[must_use]
    pub fn held(&self) -> usize {
        self.bytes.len()
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn lines(chunks: &[&[u8]]) -> Vec<Result<Vec<u8>, TooLong>> {
        let mut lines = Lines::default();
        let mut all = Vec::new();
        for chunk in chunks {
            lines.push(chunk);
            while let Some(line) = lines.next_line() {
                all.push(line.map(<[u8]>::to_vec));
            }
            assert!(lines.held() < LONGEST_LINE + chunk.len());
        }
        all
    }

    #[test]
    fn a_line_ends_with_lf_or_crlf_wherever_the_stream_is_cut() {
        let expected: Vec<_> = [&b"[1] a"[..], b"", b"\r", b"b"].map(|line| Ok(line.to_vec())).into();
        let text = b"[1] a\r\n\n\r\r\nb\nrest";
        for cut in 0..text.len() {
            assert_eq!(lines(&[&text[..cut], &text[cut..]]), expected, "cut at {cut}");
        }
    }

    #[test]
    fn a_line_that_is_too_long_is_thrown_away_as_a_whole_and_the_next_one_is_heard() {
        let long = vec![b'x'; LONGEST_LINE * 3];
        assert_eq!(lines(&[&long, &long, b"\r\n[2] b\n"]), [Err(TooLong), Ok(b"[2] b".to_vec())]);
        let at_once = [&long[..], b"\n[2] b\n"].concat();
        assert_eq!(lines(&[&at_once]), [Err(TooLong), Ok(b"[2] b".to_vec())]);
        let longest = [&long[..LONGEST_LINE - 1], b"\n"].concat();
        assert!(lines(&[&longest])[0].is_ok());
    }

    proptest! {
        #[test]
        fn how_the_stream_is_cut_changes_nothing(
            text in proptest::collection::vec(prop_oneof![Just(b'\n'), Just(b'\r'), any::<u8>()], 0..200),
            cut in 1..20_usize,
        ) {
            let chunks: Vec<&[u8]> = text.chunks(cut).collect();
            prop_assert_eq!(lines(&chunks), lines(&[&text]));
        }
    }
}
