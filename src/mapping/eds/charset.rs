//! The characters of an EDS: UTF-8 with or without a mark, else ISO 8859-1, which is what most makers' tools write.

use std::borrow::Cow;

use super::report::Place;

/// Largest file that is read, in bytes. The largest known real ones have 300 KiB.
pub const MOST_BYTES: usize = 16 << 20;

/// Why a file is no text.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct NotText {
    /// Where.
    pub place: Place,
    /// What is wrong.
    pub message: String,
    /// How to mend it.
    pub hint: &'static str,
}

/// The text of a file.
pub fn decode(bytes: &[u8]) -> Result<Cow<'_, str>, NotText> {
    let refuse = |place, message: &str, hint| Err(NotText { place, message: message.to_owned(), hint });
    if bytes.len() > MOST_BYTES {
        let message = format!("this file has {} bytes, more than any EDS", bytes.len());
        return refuse(Place::START, &message, "16 MiB are read at most");
    }
    if bytes.starts_with(&[0xFF, 0xFE]) || bytes.starts_with(&[0xFE, 0xFF]) {
        return refuse(Place::START, "this file is UTF-16", "save it as UTF-8 or ISO 8859-1");
    }
    let bytes = bytes.strip_prefix(&[0xEF, 0xBB, 0xBF]).unwrap_or(bytes);
    if let Some(at) = bytes.iter().position(|byte| *byte == 0) {
        let line = 1 + bytes.iter().take(at).filter(|byte| **byte == b'\n').count();
        return refuse(Place { line, column: 1 }, "this is no text", "an EDS or DCF is a text file");
    }
    Ok(std::str::from_utf8(bytes)
        .map_or_else(|_| Cow::Owned(bytes.iter().map(|byte| char::from(*byte)).collect()), Cow::Borrowed))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn utf_8_with_and_without_a_mark_and_latin_1_are_read() {
        assert_eq!(decode("Öl".as_bytes()).unwrap(), "Öl");
        assert_eq!(decode(b"\xEF\xBB\xBF\xC3\x96l").unwrap(), "Öl");
        assert_eq!(decode(b"\xD6l 5 \xB5m").unwrap(), "Öl 5 µm");
        assert_eq!(decode(b"").unwrap(), "");
    }

    #[test]
    fn what_is_no_text_is_refused_with_its_line() {
        assert_eq!(decode(b"a\nb\0").unwrap_err().place.line, 2);
        assert!(decode(b"\xFF\xFE[\0").unwrap_err().message.contains("UTF-16"));
        assert!(decode(&vec![b' '; MOST_BYTES + 1]).is_err());
    }
}
