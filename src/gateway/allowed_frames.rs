//! The transmit allow-list: which frames the configuration lets the gateway send. Pure.
//!
//! Built once from the tag table, and from nothing else: neither from what devices say nor from what anybody asks for. Every
//! frame passes [`AllowedFrames::permit`] on its way out, whoever made it; what is not in the list does not leave. On a bus in
//! the passive role the list is empty.
//!
//! - `rules`: the list of a table.

mod rules;

use std::collections::BTreeMap;
use std::fmt;

use crate::can::{BusIndex, CanFrame, CanId};
use crate::esd::{InitCommand, ModuleNumber};
use crate::mapping::TagTable;
use crate::process_image::{FrameKind, NodeIndex};

/// All that may be sent.
#[derive(Clone, Debug, Default)]
pub struct AllowedFrames {
    frames: Vec<AllowedFrame>,
    /// Places in `frames`.
    by_id: BTreeMap<(usize, CanId), Vec<usize>>,
}

/// A frame, or frames that differ in their data only, that may be sent.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct AllowedFrame {
    /// On which bus.
    pub bus: BusIndex,
    /// With which identifier.
    pub id: CanId,
    /// What it is.
    pub kind: FrameKind,
    /// Whom it is for; `None`: everybody.
    pub node: Option<NodeIndex>,
    /// What it looks like.
    pub shape: Shape,
    /// Why it may be sent, in words.
    pub why: String,
    /// How often at most, in words.
    pub at_most: String,
}

/// What a frame has to look like beside its identifier.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Shape {
    /// Just so.
    Exactly(CanFrame),
    /// Just so, but for those bits of the last two bytes that are 0 in this number, the high byte first.
    Bits(CanFrame, u16),
    /// A data frame with so many bytes, from and to.
    Bytes(u8, u8),
    /// A data frame with one byte from 1 to this.
    Counter(u8),
    /// Any question of the esd protocol to this module, with this identifier for the answer.
    Question(ModuleNumber, u16),
}

impl Shape {
    fn fits(&self, frame: &CanFrame) -> bool {
        match self {
            Self::Exactly(exactly) => exactly == frame,
            Self::Bits(wanted, bits) => {
                let parts = |frame: &CanFrame| {
                    let (head, last) = frame.data().split_last_chunk()?;
                    Some((frame.id(), frame.is_remote(), head.to_vec(), u16::from_be_bytes(*last) & bits))
                };
                parts(wanted).is_some_and(|wanted| parts(frame) == Some(wanted))
            }
            Self::Bytes(least, most) => !frame.is_remote() && (*least..=*most).contains(&frame.dlc()),
            Self::Counter(highest) => matches!(frame.data(), [count] if (1..=*highest).contains(count)),
            Self::Question(wanted, answer) => matches!(
                InitCommand::parse(frame).filter(|_| !frame.is_remote()),
                Some(InitCommand::Request { module, reply_id, .. }) if module == *wanted && reply_id == *answer
            ),
        }
    }
}

impl fmt::Display for Shape {
    /// The data, as candump writes it, or in words.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Exactly(frame) if frame.is_remote() => write!(f, "R{}", frame.dlc()),
            Self::Exactly(frame) => frame.data().iter().try_for_each(|byte| write!(f, "{byte:02X}")),
            Self::Bits(frame, bits) => {
                frame.data().iter().try_for_each(|byte| write!(f, "{byte:02X}"))?;
                write!(f, " in bits {bits:04X} of the last two bytes")
            }
            Self::Bytes(0, 0) => f.write_str("no data"),
            Self::Bytes(least, most) if least == most => write!(f, "{least} bytes"),
            Self::Bytes(least, most) => write!(f, "{least} to {most} bytes"),
            Self::Counter(highest) => write!(f, "01 to {highest:02X}"),
            Self::Question(module, answer) => write!(f, "question to {module}, answer on {answer:03X}"),
        }
    }
}

impl AllowedFrames {
    /// What a table allows.
    #[must_use]
    pub fn new(table: &TagTable) -> Self {
        let frames = rules::frames(table);
        let mut by_id: BTreeMap<_, Vec<usize>> = BTreeMap::new();
        for (place, frame) in frames.iter().enumerate() {
            by_id.entry((frame.bus.0, frame.id)).or_default().push(place);
        }
        Self { frames, by_id }
    }

    /// What a frame is, where it may be sent; `None` where it may not.
    #[must_use]
    pub fn permit(&self, bus: BusIndex, frame: &CanFrame) -> Option<FrameKind> {
        let of_id = self.by_id.get(&(bus.0, frame.id())).into_iter().flatten();
        let mut of_id = of_id.filter_map(|place| self.frames.get(*place));
        of_id.find(|allowed| allowed.shape.fits(frame)).map(|allowed| allowed.kind)
    }

    /// All of them: bus by bus, those for everybody first, then node by node.
    #[must_use]
    pub fn list(&self) -> &[AllowedFrame] {
        &self.frames
    }
}
