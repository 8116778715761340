//! The gateway's four verbs.

use std::sync::Arc;

use super::{Command, Outcome};
use crate::can::{BusEvent, BusIndex, CanFrame};
use crate::mapping::TagTable;
use crate::process_image::ProcessImage;
use crate::time::{Instant, Now};

/// What the gateway is told.
#[derive(Clone, Debug, PartialEq)]
pub enum Input {
    /// Something happened on a bus; the event carries its own time.
    Bus {
        /// Which bus.
        bus: BusIndex,
        /// What.
        event: BusEvent,
    },
    /// A northbound asks for something.
    Command(Command),
    /// How the rest of the program is.
    Health(Health),
}

/// How the rest of the program is.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Health {
    /// The MQTT session is up; `None` where MQTT is not configured.
    pub mqtt_connected: Option<bool>,
    /// The wall clock is synchronised.
    pub clock_synchronised: bool,
}

/// What the gateway wants done.
#[derive(Clone, Debug, PartialEq)]
pub enum Output {
    /// Send a frame.
    Transmit {
        /// On which bus.
        bus: BusIndex,
        /// It.
        frame: CanFrame,
    },
    /// Answer a command.
    Reply {
        /// Its id.
        id: u64,
        /// What came of it.
        outcome: Outcome,
    },
}

/// The core of the program.
#[derive(Debug)]
pub struct Gateway {
    _table: Arc<TagTable>,
}

impl Gateway {
    /// A gateway that has seen nothing yet.
    #[must_use]
    pub fn new(table: Arc<TagTable>, _now: Now) -> Self {
        Self { _table: table }
    }

    /// An image of the right size, in which nothing was ever received.
    #[must_use]
    pub fn empty_image(&self) -> ProcessImage {
        ProcessImage::default()
    }

    /// Takes what came in.
    pub fn handle_input(&mut self, _now: Now, _input: Input) {}

    /// What became due.
    pub fn handle_timeout(&mut self, _now: Now) {}

    /// What is to be done; call until `None`.
    pub fn poll_output(&mut self) -> Option<Output> {
        None
    }

    /// When `handle_timeout` is to be called at the latest, and why.
    #[must_use]
    pub fn poll_timeout(&self) -> Option<(Instant, &'static str)> {
        None
    }

    /// Copies all that changed since the last call into the image, and appends the new events to its journal.
    /// Allocates nothing when only values changed.
    pub fn publish(&mut self, _image: &mut ProcessImage) {}
}
