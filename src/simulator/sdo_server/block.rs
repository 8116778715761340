//! Block transfers of the SDO server. Pure.

use super::{Abort, Answer, Dictionary, Download, Entry, Request, answer, first_seven, with_segment};

/// Segments in a block of a download, as the server asks for them.
const BLOCK_SIZE: u8 = 127;

type Step<T> = Result<(Option<T>, Vec<Answer>), (Entry, Abort)>;

/// A block upload: the server sends.
#[derive(Clone, Debug)]
pub(super) struct BlockUpload {
    entry: Entry,
    data: Vec<u8>,
    /// Bytes that the client has confirmed.
    confirmed: usize,
    block_size: u8,
    /// Segments of the block under way; 0 before the first.
    sent: u8,
    with_crc: bool,
    /// The end was sent and is to be confirmed.
    ended: bool,
}

impl BlockUpload {
    pub(super) fn begin(entry: Entry, data: Vec<u8>, block_size: u8, with_crc: bool) -> (Self, Vec<Answer>) {
        let size = u32::try_from(data.len()).unwrap_or(u32::MAX);
        let announced = answer(0xC6, entry, size.to_le_bytes());
        (Self { entry, data, confirmed: 0, block_size, sent: 0, with_crc, ended: false }, vec![announced])
    }

    /// A request that belongs to the transfer.
    pub(super) fn handle(mut self, request: &Request) -> Step<Self> {
        let entry = self.entry;
        let unexpected = Err((entry, Abort::UNKNOWN_COMMAND));
        match request.command & 0x03 {
            0x03 if self.sent == 0 => Ok(self.send_block()),
            0x02 if self.sent > 0 && !self.ended => {
                let [acknowledged, block_size, ..] = request.segment;
                if acknowledged > self.sent {
                    return Err((entry, Abort::SEQUENCE));
                }
                if !(1..=127).contains(&block_size) {
                    return Err((entry, Abort::BLOCK_SIZE));
                }
                let all = acknowledged == self.sent && self.reaches_the_end();
                self.confirmed += 7 * usize::from(acknowledged);
                self.block_size = block_size;
                Ok(if all { self.end() } else { self.send_block() })
            }
            0x01 if self.ended => Ok((None, Vec::new())),
            _ => unexpected,
        }
    }

    /// Whether the block under way contains the last byte.
    fn reaches_the_end(&self) -> bool {
        self.confirmed + 7 * usize::from(self.sent) >= self.data.len()
    }

    fn send_block(mut self) -> (Option<Self>, Vec<Answer>) {
        let rest = self.data.get(self.confirmed..).unwrap_or_default();
        // Nothing to send is one segment of no bytes.
        let segments = rest.len().div_ceil(7).max(1);
        let count = u8::try_from(segments).unwrap_or(u8::MAX).min(self.block_size);
        let mut answers = Vec::with_capacity(usize::from(count));
        for sequence in 1..=count {
            let from = 7 * usize::from(sequence - 1);
            let (segment, _) = first_seven(rest.get(from..).unwrap_or_default());
            let last = if usize::from(sequence) == segments { 0x80 } else { 0 };
            answers.push(with_segment(sequence | last, segment));
        }
        self.sent = count;
        (Some(self), answers)
    }

    fn end(mut self) -> (Option<Self>, Vec<Answer>) {
        let in_last = match self.data.len() % 7 {
            0 if !self.data.is_empty() => 7,
            rest => u8::try_from(rest).unwrap_or(0),
        };
        let [low, high] = if self.with_crc { crc(&self.data) } else { 0 }.to_le_bytes();
        self.ended = true;
        (Some(self), vec![[0xC1 | (7 - in_last) << 2, low, high, 0, 0, 0, 0, 0]])
    }
}

/// A block download: the client sends.
#[derive(Clone, Debug)]
pub(super) struct BlockDownload {
    download: Download,
    with_crc: bool,
    /// The last segment of the block that came in turn.
    sequence: u8,
    /// All segments are here; the end is to come.
    complete: bool,
}

impl BlockDownload {
    pub(super) fn begin(download: Download, with_crc: bool) -> (Self, Vec<Answer>) {
        let ready = answer(0xA4, download.entry, [BLOCK_SIZE, 0, 0, 0]);
        (Self { download, with_crc, sequence: 0, complete: false }, vec![ready])
    }

    /// A segment, or the end.
    pub(super) fn handle(mut self, request: &Request, dictionary: &mut dyn Dictionary) -> Step<Self> {
        let entry = self.download.entry;
        if self.complete {
            return self.end(request, dictionary).map_err(|code| (entry, code));
        }
        let (sequence, last) = (request.command & 0x7F, request.command & 0x80 != 0);
        let in_turn = sequence == self.sequence + 1;
        if in_turn {
            self.sequence = sequence;
            self.download.data.extend_from_slice(&request.segment);
            // The last segment may be padded; the end says how much of it is meant.
            if self.download.data.len() > self.download.longest.saturating_add(7) {
                return Err((entry, Abort::OUT_OF_MEMORY));
            }
        }
        if !last && sequence < BLOCK_SIZE {
            return Ok((Some(self), Vec::new()));
        }
        let confirmed = [0xA2, self.sequence, BLOCK_SIZE, 0, 0, 0, 0, 0];
        self.complete = in_turn && last;
        self.sequence = 0;
        Ok((Some(self), vec![confirmed]))
    }

    fn end(
        mut self,
        request: &Request,
        dictionary: &mut dyn Dictionary,
    ) -> Result<(Option<Self>, Vec<Answer>), Abort> {
        if request.command & 0xE3 != 0xC1 {
            return Err(Abort::UNKNOWN_COMMAND);
        }
        let meant = self.download.data.len().saturating_sub(request.unused(2, 0x07));
        self.download.data.truncate(meant);
        self.download.append(&[])?;
        let [low, high, ..] = request.segment;
        if self.with_crc && crc(&self.download.data) != u16::from_le_bytes([low, high]) {
            return Err(Abort::CRC);
        }
        self.download.finish(dictionary)?;
        Ok((None, vec![[0xA1, 0, 0, 0, 0, 0, 0, 0]]))
    }
}

/// The checksum of CiA 301: polynomial 0x1021, begun with 0.
pub(super) fn crc(data: &[u8]) -> u16 {
    data.iter().fold(0, |crc, byte| {
        (0..8).fold(
            crc ^ u16::from(*byte) << 8,
            |crc, _| {
                if crc & 0x8000 == 0 { crc << 1 } else { crc << 1 ^ 0x1021 }
            },
        )
    })
}
