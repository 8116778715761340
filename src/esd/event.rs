//! What a network tells.

use super::status::CanStatus;
use crate::can::CanFrame;

/// Which module, by its place in [`NetworkSettings::modules`](super::NetworkSettings::modules).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct ModuleIndex(pub usize);

/// What a network wants done, or tells.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum NetworkOutput {
    /// Send a frame.
    Transmit(CanFrame),
    /// Something happened to a module.
    Module(ModuleIndex, ModuleEvent),
    /// Somebody else sent a command on the INIT-Id: another manager, with its bytes. Told again only after it was quiet.
    ForeignCommand(CanFrame),
}

/// Something that happened to a module. Channels are given by their places in
/// [`ModuleSettings::channels`](super::ModuleSettings::channels).
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum ModuleEvent {
    /// A frame of its came: for counters. The others say what it means.
    Frame,
    /// The first sign of life since the bus came up, or since it was lost.
    Appeared,
    /// It answers no more.
    Lost,
    /// It showed nothing at all since the bus came up.
    NeverSeen,
    /// It started anew: by itself, by its watchdog, or by a command. What was on its way to its lines is gone.
    Restarted,
    /// The code of its type, as it tells it (R-ESD-058).
    Kind(u8),
    /// What its coding switch says (R-ESD-059).
    Switch(u8),
    /// Its status byte, where it differs from the last one that was told, or is the first.
    Status(CanStatus),
    /// It did not answer the watchdog in time; how often in a row.
    WatchdogMiss {
        /// Since the last answer.
        in_a_row: u32,
    },
    /// It answered the watchdog with the toggle bit of the answer before (R-ESD-085).
    ToggleError,
    /// It has been compared with what is wanted, and is in order now.
    Configured {
        /// Parameters that had to be written.
        written: usize,
        /// They were stored in the module.
        stored: bool,
    },
    /// It is not as it is wanted, and cannot be made so; what, wanted and found, in words.
    NotConfigured(String),
    /// It is another module than the configuration says, or does not speak the esd protocol (R-ESD-005): it is left
    /// alone. In words.
    OtherModule(String),
    /// Its CAN error bit stays set though it was cleared (R-ESD-077).
    CanErrorStays,
    /// Bytes that came in on a line, in their order. One for each data frame, with no bytes where it had none, or none but
    /// those of flow control.
    Received {
        /// On which.
        channel: usize,
        /// They.
        chunk: SerialChunk,
    },
    /// All that came in on a line since the last message makes one now.
    Message {
        /// On which.
        channel: usize,
        /// What came in, without its end mark.
        bytes: Vec<u8>,
        /// What ended it.
        end: MessageEnd,
    },
    /// Bytes were handed to the bus for a line.
    Sent {
        /// For which.
        channel: usize,
        /// How many.
        bytes: usize,
    },
    /// Bytes that were told of as `Sent`, and whose `SendDone` was told, did not leave after all: what was sent has a hole.
    NotSent {
        /// For which.
        channel: usize,
        /// How many.
        bytes: usize,
    },
    /// Bytes for a line were dealt with, all of them or as far as it went. One for each
    /// `send` that was taken.
    SendDone {
        /// For which.
        channel: usize,
        /// As it was given.
        id: u64,
        /// What came of it.
        outcome: SendOutcome,
    },
}

/// Up to 8 bytes that came in on a line.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SerialChunk {
    data: [u8; 8],
    len: u8,
}

impl SerialChunk {
    /// The data of a frame.
    #[must_use]
    pub fn new(frame: &CanFrame) -> Self {
        let mut data = [0; 8];
        for (to, from) in data.iter_mut().zip(frame.data()) {
            *to = *from;
        }
        Self { data, len: u8::try_from(frame.data().len().min(8)).unwrap_or(8) }
    }

    /// The bytes, the oldest first.
    #[must_use]
    pub fn bytes(&self) -> &[u8] {
        self.data.get(..usize::from(self.len)).unwrap_or_default()
    }
}

/// What ended a message.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum MessageEnd {
    /// Its end mark.
    Delimiter,
    /// It had become as long as a message may be.
    Length,
    /// Nothing more came.
    Idle,
    /// The module was lost or started anew, or the bus went down: what follows does not belong to it.
    Cut,
}

impl MessageEnd {
    /// The word in payloads and events.
    #[must_use]
    pub fn word(self) -> &'static str {
        match self {
            Self::Delimiter => "delimiter",
            Self::Length => "length",
            Self::Idle => "idle",
            Self::Cut => "cut",
        }
    }
}

/// What came of bytes that were to be sent.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SendOutcome {
    /// All were handed to the bus. A frame of them that comes back as not sent after this is told of as
    /// [`ModuleEvent::NotSent`].
    Done,
    /// It broke off. A job that waited behind one that breaks off breaks off too.
    Broken {
        /// How many bytes were told of as `Sent`.
        handed: usize,
        /// How many of them left, from the first on, for all that is known; those of the last moment may not have reached the
        /// line. At most `handed`.
        sent: usize,
        /// Why.
        why: Cause,
    },
}

/// Why bytes for a line were given up.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Cause {
    /// The bus cannot be used.
    BusDown,
    /// The gateway stops.
    Stopped,
    /// The module answers no more.
    Lost,
    /// The module started anew.
    Restarted,
    /// Somebody ordered the module to start anew.
    Reset,
    /// It is another module.
    OtherModule,
    /// It was suspended for a minute.
    Suspended,
    /// The other end of the line said XOFF, and no XON for a minute.
    Xoff,
    /// There was no room in the queue to the bus for a second.
    NoRoom,
    /// A frame did not leave.
    NotSent,
}

impl Cause {
    /// In words, for messages.
    #[must_use]
    pub fn words(self) -> &'static str {
        match self {
            Self::BusDown => "the bus went down",
            Self::Stopped => "the gateway stops",
            Self::Lost => "the module does not answer any more",
            Self::Restarted => "the module started anew",
            Self::Reset => "somebody reset the module",
            Self::OtherModule => "another module answers",
            Self::Suspended => "the module has been suspended for a minute",
            Self::Xoff => "the device on the line has held it with XOFF for a minute",
            Self::NoRoom => "the bus took nothing for a second",
            Self::NotSent => "a frame did not leave the bus controller",
        }
    }
}
