//! Which messages of serial lines were not published yet, pure.

use crate::mapping::{LineEncoding, TagTable};
use crate::process_image::{LineIndex, ProcessImage, SerialMessage};

/// Messages taken under one lock of the image; the rest follows under the next.
const MOST_PER_READ: usize = 64;

/// A reader for each line that is published.
#[derive(Clone, Debug)]
pub(super) struct LineReaders {
    readers: Vec<LineReader>,
    /// The one that is looked at.
    at: usize,
    /// Messages that may still be taken under this lock.
    left: usize,
    /// Some were left.
    more: bool,
}

#[derive(Clone, Debug)]
struct LineReader {
    line: LineIndex,
    encoding: LineEncoding,
    /// Number of the last message that was taken.
    last: u64,
}

/// A message that is to be published.
pub(super) struct NewMessage<'a> {
    pub(super) line: LineIndex,
    pub(super) message: &'a SerialMessage,
    pub(super) encoding: LineEncoding,
    /// Messages before it that were gone.
    pub(super) missed: u64,
}

impl LineReaders {
    /// Readers of which none has read anything.
    pub(super) fn new(table: &TagTable) -> Self {
        let published = table.lines.iter().enumerate().filter(|(_, line)| line.mqtt.publish);
        let reader = |(place, line): (usize, &crate::mapping::LineDef)| LineReader {
            line: LineIndex(place),
            encoding: line.mqtt.encoding,
            last: 0,
        };
        Self { readers: published.map(reader).collect(), at: 0, left: 0, more: false }
    }

    /// Goes on behind what others have taken: `lines` tells for each line its place there, where it is the same one.
    pub(super) fn go_on_from(&mut self, old: &Self, lines: &[Option<LineIndex>]) {
        for reader in &mut self.readers {
            let from = lines.get(reader.line.0).copied().flatten();
            let before = old.readers.iter().find(|before| Some(before.line) == from);
            reader.last = before.map_or(0, |before| before.last);
        }
    }

    /// Begins with the first line.
    pub(super) fn begin(&mut self) {
        self.at = 0;
        self.left = MOST_PER_READ;
        self.more = false;
    }

    /// The next message; call until `None`.
    pub(super) fn next<'a>(&mut self, image: &'a ProcessImage) -> Option<NewMessage<'a>> {
        while let Some(reader) = self.readers.get_mut(self.at) {
            let line = image.lines.get(reader.line.0).filter(|line| line.newest_message() > reader.last);
            let next = line.and_then(|line| {
                let (mut messages, missed) = line.messages_after(reader.last);
                messages.next().map(|message| (message, missed))
            });
            let Some((message, missed)) = next else {
                self.at += 1;
                continue;
            };
            if self.left == 0 {
                self.more = true;
                return None;
            }
            self.left -= 1;
            reader.last = message.number;
            return Some(NewMessage { line: reader.line, message, encoding: reader.encoding, missed });
        }
        None
    }

    /// Whether messages were left for the next read.
    pub(super) fn has_more(&self) -> bool {
        self.more
    }

    /// Nothing more is wanted.
    pub(super) fn stop(&mut self) {
        self.readers.clear();
        self.more = false;
    }
}
