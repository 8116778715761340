//! The process image: what is known now, with quality and time, and what happened, in order.
//!
//! One writer (the gateway task), many readers (Modbus, MQTT, web). No value is without its quality and the time
//! at which it was received. Not here: what a tag is called or where it stands in a register map; that is
//! [`mapping`](crate::mapping)'s table.
//!
//! - [`value`], [`quality`]: what a tag holds and how far it can be trusted.
//! - [`status`]: nodes, buses and alarms as readers see them.
//! - [`current`]: what views make of it, exchanged when a reload makes another image.
//! - [`frame_kind`]: kinds of frames that the gateway sends.
//! - [`image`]: all of it at one moment.
//! - [`serial`]: serial lines, as streams and as messages.
//! - [`session`]: why there is no session with the MQTT broker.
//! - [`journal`]: the last events.
//! - [`handles`]: the writer and the readers (the only file here that knows tokio).

pub mod current;
pub mod frame_kind;
pub mod handles;
pub mod image;
pub mod journal;
pub mod quality;
pub mod serial;
pub mod session;
pub mod status;
pub mod value;

pub use current::Current;
pub use frame_kind::{FrameCounts, FrameKind};
pub use handles::{ImageReader, ImageWriter, process_image};
pub use image::{ProcessImage, Revision};
pub use journal::{Event, EventKind, Journal};
pub use quality::{Quality, Reason};
pub use serial::{SerialLine, SerialMessage};
pub use session::SessionTrouble;
pub use status::{
    AlarmState, AlarmStatus, BusState, BusStatus, NodeCounters, NodeStatus, PdoStatus, Priority,
};
pub use value::Value;

/// A word of the field that readers need; defined where the protocol is.
pub use crate::canopen::NmtState;
pub use crate::canopen::emcy::{ErrorLog, ErrorRecord};
use crate::time::{Instant, Timestamp};

/// A tag of some node, by its place in the tag table.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct TagIndex(pub usize);

/// A node, by its place in the tag table.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct NodeIndex(pub usize);

/// A serial line, by its place in the tag table.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct LineIndex(pub usize);

/// An alarm, by its place in the tag table.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct AlarmIndex(pub usize);

/// The last value of a tag.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sample {
    /// As it stood in the frame: what a raw register shows.
    pub raw: Value,
    /// In engineering units. Kept when the quality drops (R-DET-084).
    pub value: Value,
    /// How far it can be trusted.
    pub quality: Quality,
    /// UTC when the frame was received that carried it.
    pub received: Timestamp,
    /// The same on the monotonic clock, for its age; `None` before the first.
    pub received_at: Option<Instant>,
    /// When value or quality changed last.
    pub revision: Revision,
}

impl Sample {
    /// A tag of which nothing was ever received.
    pub const NEVER: Self = Self {
        raw: Value::Unsigned(0),
        value: Value::Unsigned(0),
        quality: Quality::NEVER,
        received: Timestamp::from_micros(0),
        received_at: None,
        revision: Revision(0),
    };

    /// The value to show: nothing where nothing was ever received; the last one otherwise, or 0 where the installation
    /// asks for it (R-DET-084).
    #[must_use]
    pub fn shown(&self, zero_on_bad: bool) -> Option<Value> {
        match (self.quality.is_usable(), zero_on_bad, self.value) {
            (true, _, value) => Some(value),
            (false, true, Value::Bool(_)) => Some(Value::Bool(false)),
            (false, true, _) => Some(Value::Unsigned(0)),
            (false, false, value) => self.received_at.map(|_| value),
        }
    }
}
