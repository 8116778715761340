//! The server's side of SDO (CiA 301, 7.2.4): expedited, segmented and block transfers in both directions. Pure.
//!
//! Written for itself: it shares nothing with the client in `canopen`, whose judge it is. It knows requests, answers and
//! a [`Dictionary`]; identifiers, delays and NMT states are the device's business. There is no time-out: a transfer that
//! the client has left ends with the next one.

mod block;
#[cfg(test)]
mod tests;

use block::{BlockDownload, BlockUpload};

/// Why an access is refused: the code of an SDO abort.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Abort(pub u32);

impl Abort {
    /// Toggle bit not alternated.
    pub const TOGGLE: Self = Self(0x0503_0000);
    /// Command specifier not valid or unknown.
    pub const UNKNOWN_COMMAND: Self = Self(0x0504_0001);
    /// Block size not valid.
    pub const BLOCK_SIZE: Self = Self(0x0504_0002);
    /// Sequence number not valid.
    pub const SEQUENCE: Self = Self(0x0504_0003);
    /// Checksum wrong.
    pub const CRC: Self = Self(0x0504_0004);
    /// Out of memory: longer than the server takes.
    pub const OUT_OF_MEMORY: Self = Self(0x0504_0005);
    /// Read of a write-only object.
    pub const WRITE_ONLY: Self = Self(0x0601_0001);
    /// Write of a read-only object.
    pub const READ_ONLY: Self = Self(0x0601_0002);
    /// The object does not exist.
    pub const NO_OBJECT: Self = Self(0x0602_0000);
    /// The object cannot be mapped.
    pub const NOT_MAPPABLE: Self = Self(0x0604_0041);
    /// The mapped objects exceed the length of the PDO.
    pub const PDO_LENGTH: Self = Self(0x0604_0042);
    /// Parameter incompatibility.
    pub const INCOMPATIBLE: Self = Self(0x0604_0043);
    /// Data length too high.
    pub const TOO_LONG: Self = Self(0x0607_0012);
    /// Data length too low.
    pub const TOO_SHORT: Self = Self(0x0607_0013);
    /// The sub-index does not exist.
    pub const NO_SUB_INDEX: Self = Self(0x0609_0011);
    /// Value range exceeded.
    pub const RANGE: Self = Self(0x0609_0030);
}

/// The objects that a server gives access to.
pub trait Dictionary {
    /// The content of an entry, any length.
    ///
    /// # Errors
    /// There is none to read.
    fn read(&mut self, index: u16, sub: u8) -> Result<Vec<u8>, Abort>;

    /// Whether an entry can be written, and its length in bytes where that is fixed.
    ///
    /// # Errors
    /// It cannot.
    fn may_write(&self, index: u16, sub: u8) -> Result<Option<usize>, Abort>;

    /// Writes an entry, whole, of the length that [`may_write`](Self::may_write) gives.
    ///
    /// # Errors
    /// Not this value, or not now.
    fn write(&mut self, index: u16, sub: u8, data: &[u8]) -> Result<(), Abort>;
}

/// An answer on the bus; always 8 bytes (R-DST-065).
pub type Answer = [u8; 8];

/// An entry: index and sub-index.
type Entry = (u16, u8);

/// The server. Idle when made.
#[derive(Clone, Debug)]
pub struct SdoServer {
    transfer: Transfer,
    /// Most bytes of a download to an entry whose length is not fixed.
    longest: usize,
}

#[derive(Clone, Debug)]
enum Transfer {
    Idle,
    Upload { entry: Entry, data: Vec<u8>, at: usize, toggle: bool },
    Download { download: Download, toggle: bool },
    BlockUpload(BlockUpload),
    BlockDownload(BlockDownload),
}

/// What is being written.
#[derive(Clone, Debug)]
struct Download {
    entry: Entry,
    /// As the client announced it, or as the entry has it.
    expected: Option<usize>,
    longest: usize,
    data: Vec<u8>,
}

impl Download {
    /// Checks what can be checked before the data come.
    fn begin(
        dictionary: &dyn Dictionary,
        entry: Entry,
        announced: Option<usize>,
        longest: usize,
    ) -> Result<Self, Abort> {
        let fixed = dictionary.may_write(entry.0, entry.1)?;
        if let (Some(announced), Some(fixed)) = (announced, fixed) {
            length_is(announced, fixed)?;
        }
        let expected = announced.or(fixed);
        if expected.is_some_and(|expected| expected > longest) {
            return Err(Abort::OUT_OF_MEMORY);
        }
        Ok(Self { entry, expected, longest, data: Vec::new() })
    }

    fn append(&mut self, bytes: &[u8]) -> Result<(), Abort> {
        self.data.extend_from_slice(bytes);
        if self.data.len() > self.longest { Err(Abort::OUT_OF_MEMORY) } else { Ok(()) }
    }

    fn finish(&self, dictionary: &mut dyn Dictionary) -> Result<(), Abort> {
        if let Some(expected) = self.expected {
            length_is(self.data.len(), expected)?;
        }
        dictionary.write(self.entry.0, self.entry.1, &self.data)
    }
}

/// R-DST-010.
fn length_is(length: usize, expected: usize) -> Result<(), Abort> {
    match length.cmp(&expected) {
        std::cmp::Ordering::Less => Err(Abort::TOO_SHORT),
        std::cmp::Ordering::Equal => Ok(()),
        std::cmp::Ordering::Greater => Err(Abort::TOO_LONG),
    }
}

/// An answer that names an entry, with up to four bytes of data.
fn answer(command: u8, (index, sub): Entry, data: [u8; 4]) -> Answer {
    let [low, high] = index.to_le_bytes();
    let [a, b, c, d] = data;
    [command, low, high, sub, a, b, c, d]
}

fn abort(entry: Entry, Abort(code): Abort) -> Answer {
    answer(0x80, entry, code.to_le_bytes())
}

/// A request, taken apart.
struct Request {
    command: u8,
    entry: Entry,
    data: [u8; 4],
    /// All but the command.
    segment: [u8; 7],
}

impl Request {
    fn new([command, low, high, sub, a, b, c, d]: [u8; 8]) -> Self {
        Self {
            command,
            entry: (u16::from_le_bytes([low, high]), sub),
            data: [a, b, c, d],
            segment: [low, high, sub, a, b, c, d],
        }
    }

    /// The first `count` bytes of the segment.
    fn bytes(&self, count: usize) -> &[u8] {
        self.segment.get(..count).unwrap_or(&self.segment)
    }

    fn size(&self) -> usize {
        usize::try_from(u32::from_le_bytes(self.data)).unwrap_or(usize::MAX)
    }

    /// Two bits of the command, counted from bit `low`, as the number of bytes that are not meant.
    fn unused(&self, low: u8, mask: u8) -> usize {
        usize::from(self.command >> low & mask)
    }
}

impl SdoServer {
    /// A server that takes up to `longest` bytes at once.
    #[must_use]
    pub fn new(longest: usize) -> Self {
        Self { transfer: Transfer::Idle, longest }
    }

    /// Forgets the transfer that is under way, as a device does that boots or is stopped.
    pub fn reset(&mut self) {
        self.transfer = Transfer::Idle;
    }

    /// Takes a request and gives what is to be sent for it, in order; at most 127 answers.
    pub fn handle_request(&mut self, request: [u8; 8], dictionary: &mut dyn Dictionary) -> Vec<Answer> {
        let request = Request::new(request);
        let transfer = std::mem::replace(&mut self.transfer, Transfer::Idle);
        let result = if request.command == 0x80 {
            Ok((Transfer::Idle, Vec::new()))
        } else if let Transfer::BlockDownload(block) = transfer {
            // Its segments look like commands.
            let step = block.handle(&request, dictionary);
            step.map(|(next, answers)| (next.map_or(Transfer::Idle, Transfer::BlockDownload), answers))
        } else {
            self.handle_command(&request, transfer, dictionary)
        };
        match result {
            Ok((next, answers)) => {
                self.transfer = next;
                answers
            }
            Err((entry, code)) => vec![abort(entry, code)],
        }
    }

    fn handle_command(
        &self,
        request: &Request,
        transfer: Transfer,
        dictionary: &mut dyn Dictionary,
    ) -> Result<(Transfer, Vec<Answer>), (Entry, Abort)> {
        let of = |entry: Entry| move |code: Abort| (entry, code);
        match (request.command >> 5, transfer) {
            (0, Transfer::Download { download, toggle }) => {
                let entry = download.entry;
                download_segment(request, download, toggle, dictionary).map_err(of(entry))
            }
            (1, _) => self.begin_download(request, dictionary).map_err(of(request.entry)),
            (2, _) => {
                let data = dictionary.read(request.entry.0, request.entry.1).map_err(of(request.entry))?;
                Ok(begin_upload(request.entry, data))
            }
            (3, Transfer::Upload { entry, data, at, toggle }) => {
                if (request.command & 0x10 != 0) != toggle {
                    return Err((entry, Abort::TOGGLE));
                }
                Ok(upload_segment(entry, data, at, toggle))
            }
            (5, transfer) => {
                let (next, answers) = match transfer {
                    Transfer::BlockUpload(block) if request.command & 0x03 != 0 => block.handle(request)?,
                    Transfer::Idle
                    | Transfer::Upload { .. }
                    | Transfer::Download { .. }
                    | Transfer::BlockUpload(_)
                    | Transfer::BlockDownload(_) => {
                        return begin_block_upload(request, dictionary);
                    }
                };
                Ok((next.map_or(Transfer::Idle, Transfer::BlockUpload), answers))
            }
            (6, _) if request.command & 0x01 == 0 => {
                let announced = (request.command & 0x02 != 0).then(|| request.size());
                let download = Download::begin(dictionary, request.entry, announced, self.longest)
                    .map_err(of(request.entry))?;
                let (block, answers) = BlockDownload::begin(download, request.command & 0x04 != 0);
                Ok((Transfer::BlockDownload(block), answers))
            }
            _ => Err(((0, 0), Abort::UNKNOWN_COMMAND)),
        }
    }

    fn begin_download(
        &self,
        request: &Request,
        dictionary: &mut dyn Dictionary,
    ) -> Result<(Transfer, Vec<Answer>), Abort> {
        let (expedited, sized) = (request.command & 0x02 != 0, request.command & 0x01 != 0);
        let done = vec![answer(0x60, request.entry, [0; 4])];
        if !expedited {
            let announced = sized.then(|| request.size());
            let download = Download::begin(dictionary, request.entry, announced, self.longest)?;
            return Ok((Transfer::Download { download, toggle: false }, done));
        }
        let announced = sized.then(|| 4 - request.unused(2, 0x03));
        let mut download = Download::begin(dictionary, request.entry, announced, self.longest)?;
        // Without a size all four bytes may be meant; an entry of its own length takes as many as it needs.
        let length = download.expected.unwrap_or(4).min(4);
        download.append(request.data.get(..length).unwrap_or_default())?;
        download.finish(dictionary)?;
        Ok((Transfer::Idle, done))
    }
}

fn begin_block_upload(
    request: &Request,
    dictionary: &mut dyn Dictionary,
) -> Result<(Transfer, Vec<Answer>), (Entry, Abort)> {
    if request.command & 0x03 != 0 {
        return Err(((0, 0), Abort::UNKNOWN_COMMAND));
    }
    let [block_size, threshold, ..] = request.data;
    if !(1..=127).contains(&block_size) {
        return Err((request.entry, Abort::BLOCK_SIZE));
    }
    let data = dictionary.read(request.entry.0, request.entry.1).map_err(|code| (request.entry, code))?;
    if data.len() <= usize::from(threshold) {
        return Ok(begin_upload(request.entry, data));
    }
    let (block, answers) = BlockUpload::begin(request.entry, data, block_size, request.command & 0x04 != 0);
    Ok((Transfer::BlockUpload(block), answers))
}

fn begin_upload(entry: Entry, data: Vec<u8>) -> (Transfer, Vec<Answer>) {
    let expedited = match *data.as_slice() {
        [a] => Some((0x4F, [a, 0, 0, 0])),
        [a, b] => Some((0x4B, [a, b, 0, 0])),
        [a, b, c] => Some((0x47, [a, b, c, 0])),
        [a, b, c, d] => Some((0x43, [a, b, c, d])),
        _ => None,
    };
    if let Some((command, bytes)) = expedited {
        return (Transfer::Idle, vec![answer(command, entry, bytes)]);
    }
    let size = u32::try_from(data.len()).unwrap_or(u32::MAX);
    let announced = answer(0x41, entry, size.to_le_bytes());
    (Transfer::Upload { entry, data, at: 0, toggle: false }, vec![announced])
}

fn upload_segment(entry: Entry, data: Vec<u8>, at: usize, toggle: bool) -> (Transfer, Vec<Answer>) {
    let rest = data.get(at..).unwrap_or_default();
    let (segment, count) = first_seven(rest);
    let last = rest.len() <= 7;
    let command = u8::from(toggle) << 4 | (7 - count) << 1 | u8::from(last);
    let next = if last {
        Transfer::Idle
    } else {
        Transfer::Upload { entry, data, at: at + usize::from(count), toggle: !toggle }
    };
    (next, vec![with_segment(command, segment)])
}

fn download_segment(
    request: &Request,
    mut download: Download,
    toggle: bool,
    dictionary: &mut dyn Dictionary,
) -> Result<(Transfer, Vec<Answer>), Abort> {
    if (request.command & 0x10 != 0) != toggle {
        return Err(Abort::TOGGLE);
    }
    download.append(request.bytes(7 - request.unused(1, 0x07)))?;
    let confirmed = vec![[0x20 | u8::from(toggle) << 4, 0, 0, 0, 0, 0, 0, 0]];
    if request.command & 0x01 == 0 {
        return Ok((Transfer::Download { download, toggle: !toggle }, confirmed));
    }
    download.finish(dictionary)?;
    Ok((Transfer::Idle, confirmed))
}

/// Up to seven bytes, filled up with zeros, and how many there are.
fn first_seven(data: &[u8]) -> ([u8; 7], u8) {
    let mut segment = [0; 7];
    let mut count = 0;
    for (to, byte) in segment.iter_mut().zip(data) {
        *to = *byte;
        count += 1;
    }
    (segment, count)
}

fn with_segment(command: u8, segment: [u8; 7]) -> Answer {
    let mut answer = [command; 8];
    for (to, byte) in answer.iter_mut().skip(1).zip(segment) {
        *to = byte;
    }
    answer
}
