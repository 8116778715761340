//! How a client begins, pure: whether it is a browser, which a web page from anywhere can make send bytes of its choice.
//!
//! Such bytes come in a request of HTTP, or, where the page names a port with TLS, in the hello of TLS. Both are known by
//! their first bytes, however long what follows is.

/// What begins a request. Browsers send no others across sites, and write them so.
const METHODS: [&[u8]; 9] =
    [b"GET ", b"HEAD ", b"POST ", b"OPTIONS ", b"PUT ", b"DELETE ", b"PATCH ", b"CONNECT ", b"TRACE "];
/// What follows the method.
const TARGETS: [&[u8]; 3] = [b"/", b"*", b"http"];
/// The end of the first line of a request, whatever its method.
const VERSION: &[u8] = b" HTTP/1.";
/// The longest beginning that is not decided yet is shorter than this.
const LONGEST: usize = 16;

/// The beginning of what a client sends.
#[derive(Debug, Default)]
pub struct Opening {
    /// The first bytes, while it is open what they are; never [`LONGEST`] of them.
    begin: Vec<u8>,
    /// The last so many of them are held back.
    held: usize,
    /// The client is none that has to be kept out.
    passed: bool,
}

/// What is to be done with bytes.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Verdict {
    /// These go out.
    Pass(Vec<u8>),
    /// Held back until more comes, or [`Opening::release`].
    Hold,
    /// The connection ends: a request of HTTP, or a hello of TLS.
    Refuse,
}

/// Whether bytes match a pattern.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
enum Match {
    No,
    /// So far; more bytes decide.
    Open,
    Yes,
}

impl Opening {
    /// Takes what came. Bytes that were held back come first in what passes.
    pub fn take(&mut self, bytes: &[u8]) -> Verdict {
        if self.passed {
            return Verdict::Pass(bytes.to_vec());
        }
        let sent = self.begin.len().saturating_sub(std::mem::take(&mut self.held));
        let mut all = std::mem::take(&mut self.begin);
        all.extend_from_slice(bytes);
        match http(&all).max(tls(&all)) {
            Match::Yes => Verdict::Refuse,
            Match::Open if all.len() < LONGEST => {
                self.held = all.len() - sent;
                self.begin = all;
                Verdict::Hold
            }
            Match::Open | Match::No => {
                self.passed = true;
                Verdict::Pass(all.split_off(sent))
            }
        }
    }

    /// Whether bytes are held back.
    #[must_use]
    pub fn holds(&self) -> bool {
        self.held > 0
    }

    /// Nothing more came for a while: the bytes that were held back, which go out now. What follows is still looked at.
    pub fn release(&mut self) -> Vec<u8> {
        let held = std::mem::take(&mut self.held);
        self.begin.iter().skip(self.begin.len().saturating_sub(held)).copied().collect()
    }
}

/// How far bytes are a text.
fn begins(bytes: &[u8], text: &[u8]) -> Match {
    if bytes.starts_with(text) {
        Match::Yes
    } else if text.starts_with(bytes) {
        Match::Open
    } else {
        Match::No
    }
}

/// A request: `GET /`.
fn http(bytes: &[u8]) -> Match {
    let line = bytes.split(|byte| *byte == b'\n').next().unwrap_or_default();
    if line.windows(VERSION.len()).any(|part| part == VERSION) {
        return Match::Yes;
    }
    let method = |method: &&[u8]| match bytes.strip_prefix(*method) {
        Some(target) => TARGETS.iter().map(|text| begins(target, text)).max().unwrap_or(Match::No),
        None => begins(bytes, method),
    };
    METHODS.iter().map(method).max().unwrap_or(Match::No)
}

/// A hello of TLS: a record of handshake with version 3.0 to 3.4, in it a client's hello of less than 128 KiB with a version
/// of its own. All these bytes are looked at, for the first ones alone are also a question of Modbus RTU to slave 22.
fn tls(bytes: &[u8]) -> Match {
    let is_hello = |(place, byte): (usize, &u8)| match place {
        0 => *byte == 0x16,
        1 | 9 => *byte == 3,
        2 | 10 => *byte <= 4,
        5 => *byte == 1,
        6 => *byte <= 1,
        _ => true,
    };
    match bytes.iter().enumerate().all(is_hello) {
        true if bytes.len() > 10 => Match::Yes,
        true => Match::Open,
        false => Match::No,
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const REQUESTS: [&[u8]; 8] = [
        b"GET /",
        b"HEAD /",
        b"POST /x",
        b"OPTIONS *",
        b"PUT http://plant/",
        b"DELETE /",
        b"PATCH /",
        b"\x16\x03\x01\x06\xFC\x01\x00\x06\xF8\x03\x03",
    ];
    const COMMANDS: [&[u8]; 12] = [
        b"G\r",
        b"GET\r\n",
        b"GET 1\r",
        b"GETX",
        b"POST 5",
        b"POSITION /",
        b"PUT x",
        b"OPTIONS?",
        b"get /",
        b"\x16\x03\x00\x10\x00\x02\xC6\xE9",
        b"\x16\x02",
        b"\x02START\x03",
    ];

    #[test]
    fn a_request_of_a_browser_is_known_by_its_first_bytes_however_they_come() {
        for request in REQUESTS {
            assert_eq!(Opening::default().take(request), Verdict::Refuse, "{request:02x?}");
            let mut opening = Opening::default();
            let mut bytes = request.iter().map(|byte| opening.take(&[*byte]));
            assert_eq!(
                bytes.find(|verdict| *verdict != Verdict::Hold),
                Some(Verdict::Refuse),
                "{request:02x?}"
            );
        }
        assert_eq!(Opening::default().take(b"BREW /pot HTTP/1.1\r\n"), Verdict::Refuse);
    }

    #[test]
    fn a_command_passes_with_the_byte_that_no_request_has() {
        for command in COMMANDS {
            assert_eq!(Opening::default().take(command), Verdict::Pass(command.to_vec()), "{command:02x?}");
        }
        let mut opening = Opening::default();
        assert_eq!(opening.take(b"G"), Verdict::Hold);
        assert!(opening.holds());
        assert_eq!(opening.take(b"\r"), Verdict::Pass(b"G\r".to_vec()));
        assert!(!opening.holds());
        assert_eq!(
            opening.take(b"GET / HTTP/1.1"),
            Verdict::Pass(b"GET / HTTP/1.1".to_vec()),
            "a device's own"
        );
    }

    #[test]
    fn what_was_released_is_still_looked_at_and_goes_out_once() {
        let mut opening = Opening::default();
        assert_eq!(opening.take(b"GET"), Verdict::Hold);
        assert_eq!(opening.release(), b"GET");
        assert!(!opening.holds());
        assert_eq!(opening.take(b" "), Verdict::Hold);
        assert_eq!(opening.take(b"x"), Verdict::Pass(b" x".to_vec()));
        let mut opening = Opening::default();
        opening.take(b"GET");
        opening.release();
        assert_eq!(opening.take(b" /"), Verdict::Refuse);
    }

    proptest! {
        #[test]
        fn however_bytes_are_cut_all_go_out_in_order_or_none_after_a_refusal(
            bytes in proptest::collection::vec(prop_oneof![Just(b'G'), Just(b'E'), Just(b'T'), Just(b' '), Just(0x16), Just(3), any::<u8>()], 0..40),
            cut in 1..8_usize,
        ) {
            let (mut opening, mut out, mut refused) = (Opening::default(), Vec::new(), false);
            for piece in bytes.chunks(cut) {
                match opening.take(piece) {
                    Verdict::Pass(bytes) => out.extend(bytes),
                    Verdict::Hold => {}
                    Verdict::Refuse => { refused = true; break; }
                }
            }
            if refused {
                prop_assert!(out.is_empty());
            } else {
                out.extend(opening.release());
                prop_assert_eq!(out, bytes);
            }
        }
    }
}
