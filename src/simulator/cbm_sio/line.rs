//! What is at the other end of a serial line: nothing, an echo, a barcode scanner, a balance, or something outside. Pure.

use std::time::Duration;

use crate::time::Instant;

/// A kind of line end.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LineKind {
    /// Nothing: bytes are lost.
    None,
    /// Sends back what it gets.
    Echo,
    /// Sends a barcode and CR LF from time to time.
    Scanner,
    /// Answers each line `S` with its weight.
    Balance,
    /// Outside this program.
    External,
}

impl LineKind {
    /// Those that a scenario can name.
    pub const NAMED: [(&'static str, Self); 4] =
        [("none", Self::None), ("echo", Self::Echo), ("scanner", Self::Scanner), ("balance", Self::Balance)];

    /// By its name in a scenario.
    #[must_use]
    pub fn named(word: &str) -> Option<Self> {
        Self::NAMED.iter().find(|(name, _)| *name == word).map(|(_, kind)| *kind)
    }
}

/// What the scanner reads, in turns.
const BARCODES: [&str; 3] = ["4006381333931", "5901234123457", "9780201379624"];
/// A scanner is not faster than this.
pub const SHORTEST_SCAN: Duration = Duration::from_millis(100);
/// The longest line that a balance remembers.
const REQUEST: usize = 80;
/// What is on the balance at first.
pub const WEIGHT_KG: f64 = 12.45;

/// A line end as it runs.
#[derive(Clone, Debug)]
pub struct Line {
    kind: LineKind,
    scan_every: Duration,
    scan_at: Instant,
    /// Which barcode is next.
    scans: usize,
    weight_kg: f64,
    request: Vec<u8>,
}

impl Line {
    /// A line end that is switched on at `now`.
    #[must_use]
    pub fn new(kind: LineKind, scan_every: Duration, now: Instant) -> Self {
        let scan_every = scan_every.max(SHORTEST_SCAN);
        Self {
            kind,
            scan_every,
            scan_at: now + scan_every,
            scans: 0,
            weight_kg: WEIGHT_KG,
            request: Vec::new(),
        }
    }

    /// Its kind.
    #[must_use]
    pub fn kind(&self) -> LineKind {
        self.kind
    }

    /// Puts something on the balance.
    pub fn weigh(&mut self, kg: f64) {
        self.weight_kg = kg;
    }

    /// When it says something by itself.
    #[must_use]
    pub fn poll_timeout(&self) -> Option<Instant> {
        (self.kind == LineKind::Scanner).then_some(self.scan_at)
    }

    /// What it says by itself at `now`.
    pub fn handle_timeout(&mut self, now: Instant) -> Vec<u8> {
        if self.poll_timeout().is_none_or(|due| due > now) {
            return Vec::new();
        }
        self.scan_at = self.scan_at + self.scan_every;
        let code = BARCODES.get(self.scans).copied().unwrap_or_default();
        self.scans = (self.scans + 1) % BARCODES.len();
        format!("{code}\r\n").into_bytes()
    }

    /// What it answers to a byte.
    pub fn hear(&mut self, byte: u8) -> Vec<u8> {
        match (self.kind, byte) {
            (LineKind::Echo, _) => vec![byte],
            (LineKind::Balance, b'\n') => {
                let request = std::mem::take(&mut self.request);
                self.weigh_for(request.trim_ascii())
            }
            (LineKind::Balance, _) => {
                if self.request.len() < REQUEST {
                    self.request.push(byte);
                }
                Vec::new()
            }
            (LineKind::None | LineKind::Scanner | LineKind::External, _) => Vec::new(),
        }
    }

    fn weigh_for(&self, request: &[u8]) -> Vec<u8> {
        match request {
            b"S" | b"SI" => format!("S S {:>10.2} kg\r\n", self.weight_kg).into_bytes(),
            b"" => Vec::new(),
            _ => b"ES\r\n".to_vec(),
        }
    }
}
