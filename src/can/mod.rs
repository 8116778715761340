//! CAN buses: what a frame is, what can happen on a bus, and the ways to reach one.
//!
//! Not here: what a frame means. That is [`canopen`](crate::canopen)'s business.
//!
//! - [`frame`]: classical CAN frames, pure.
//! - this file: [`BusEvent`], and the traits [`BusReader`] and [`BusWriter`], the two halves of any open bus.
//! - [`interface`]: how an interface is written (`can0`, `virtual:demo`, `slcan:/dev/ttyACM0`).
//! - [`bus`] \[IO\]: [`open`] any interface.
//! - [`socketcan`] \[IO\]: interfaces of the host, with [`host_link`] \[IO\] (what the host says of them) and, pure,
//!   [`raw_frame`] (what a socket gives), [`controller`] (the state of the link), [`stamp`] (receive times).
//! - [`slcan_port`] \[IO\]: LAWICEL adapters on serial ports and TCP, with [`slcan_session`] \[IO\] (the conversation)
//!   and, pure, [`slcan`] (their language) and [`slcan_answers`] (what is known of one of them).
//! - [`virtual_bus`] \[IO\]: buses inside the process.
//! - [`task`] \[IO\]: owns one bus, opens it again whenever it was lost, counts; [`bus_log`] tells the log of it, and
//!   [`outage`] keeps that short.
//! - [`recording`]: candump logs, pure.

pub mod bus;
pub mod bus_log;
pub mod controller;
pub mod frame;
pub mod host_link;
pub mod interface;
pub mod outage;
pub mod raw_frame;
pub mod recording;
pub mod slcan;
pub mod slcan_answers;
pub mod slcan_port;
pub mod slcan_session;
pub mod socketcan;
pub mod stamp;
pub mod task;
pub mod virtual_bus;

use std::future::Future;

pub use bus::{AnyReader, AnyWriter, open};
pub use frame::{CanFrame, CanId, ParseFrameError};
pub use interface::{BIT_RATES, DEFAULT_BIT_RATE, Interface, ParseInterfaceError};

use crate::time::Now;

/// Which of the configured buses, by its place in the configuration.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct BusIndex(pub usize);

/// What a bus tells the gateway. `at` is the receive time of the kernel where it gives one.
#[derive(Clone, Debug, PartialEq)]
pub enum BusEvent {
    /// A frame was received from another node. Frames that the gateway itself sent are not echoed here.
    Frame {
        /// The frame.
        frame: CanFrame,
        /// When it was received.
        at: Now,
    },
    /// The link or the controller changed its state.
    Link {
        /// The new state.
        link: Link,
        /// When.
        at: Now,
    },
    /// The interface took a frame that the gateway asked to send. Told of each that is not [`NotSent`](Self::NotSent), where that
    /// was asked for ([`Sending::Told`](task::Sending)); some interfaces take a frame and give it back later: then both.
    Sent {
        /// The frame.
        frame: CanFrame,
        /// When it was taken.
        at: Now,
    },
    /// A frame that the gateway asked to send did not leave: it is not the node's fault if no answer comes.
    NotSent {
        /// The frame.
        frame: CanFrame,
        /// When the sending was given up.
        at: Now,
    },
    /// Counters since the start, reported once a second and at every change of `overruns`.
    Counters {
        /// The counters.
        counters: BusCounters,
        /// When.
        at: Now,
    },
}

/// The state of an interface and its controller.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord)]
pub enum Link {
    /// There is no such interface, or it cannot be opened.
    #[default]
    Absent,
    /// The interface is there but down.
    Down,
    /// Working; both error counters are low.
    ErrorActive,
    /// Working, with an error counter over 127: wiring, bit rate, or nobody acknowledges.
    ErrorPassive,
    /// The controller has left the bus after 256 transmit errors.
    BusOff,
}

impl Link {
    /// Whether frames can be sent and received.
    #[must_use]
    pub fn is_up(self) -> bool {
        matches!(self, Self::ErrorActive | Self::ErrorPassive)
    }
}

/// What happened on a bus since the gateway started. All counters saturate.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct BusCounters {
    /// Classical data and remote frames received.
    pub frames_received: u64,
    /// Frames sent.
    pub frames_sent: u64,
    /// Frames that were to be sent and were given up: queue full, link down, no acknowledge.
    pub frames_not_sent: u64,
    /// Error frames that report a bus error (not mere state changes).
    pub error_frames: u64,
    /// CAN FD frames, which no device here sends (R-DET-006).
    pub fd_frames: u64,
    /// Times that the controller went bus-off.
    pub bus_off_count: u64,
    /// Frames that the kernel dropped because we read too slowly (`SO_RXQ_OVFL`).
    pub overruns: u64,
    /// Bits of all frames seen or sent, [`CanFrame::wire_bits`]: the load is their rate over the bit rate.
    pub wire_bits: u64,
    /// Bit rate in bit/s, where the interface tells it.
    pub bit_rate: Option<u32>,
}

impl BusCounters {
    /// Whether there were errors and never a valid frame, as it is where our bit rate is not that of the bus
    /// (R-DET-089). Wiring and terminators may be the cause as well.
    #[must_use]
    pub fn bit_rate_is_suspect(&self) -> bool {
        /// A few errors are normal when somebody plugs in a cable.
        const MANY: u64 = 20;
        self.frames_received == 0 && (self.bus_off_count > 0 || self.error_frames >= MANY)
    }
}

/// What a reader has counted since its bus was opened.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Tally {
    /// As [`BusCounters::error_frames`].
    pub error_frames: u64,
    /// As [`BusCounters::fd_frames`].
    pub fd_frames: u64,
    /// As [`BusCounters::overruns`].
    pub overruns: u64,
    /// As [`BusCounters::bit_rate`].
    pub bit_rate: Option<u32>,
    /// Whether the controller only listens and does not even acknowledge frames; `None` where there is no controller or
    /// nothing is known of it.
    pub listens_only: Option<bool>,
}

/// The receiving half of a bus: receiving never waits for sending. The bus is closed when both halves are dropped.
pub trait BusReader: Send {
    /// Waits for what happens next: frames, and changes of the link. The first event of a bus that has just been
    /// opened says how its link is; before that it may not be usable. Counters are in [`BusReader::tally`].
    ///
    /// Cancel-safe: dropping the future loses no frame.
    ///
    /// # Errors
    /// The bus is unusable and has to be opened again.
    fn recv(&mut self) -> impl Future<Output = Result<BusEvent, BusError>> + Send;

    /// What was counted since the bus was opened.
    fn tally(&self) -> Tally {
        Tally::default()
    }
}

/// The sending half of a bus.
pub trait BusWriter: Send {
    /// Sends a frame, or gives up after a short time; never queues behind a dead bus.
    ///
    /// # Errors
    /// The frame did not leave.
    fn send(&mut self, frame: &CanFrame) -> impl Future<Output = Result<(), BusError>> + Send;
}

/// Why a bus could not be used. Printed once, by the task that owns it.
#[derive(Debug, thiserror::Error)]
pub enum BusError {
    /// There is no such interface.
    #[error("interface `{interface}` is not there: {source}")]
    Absent {
        /// As written in the configuration.
        interface: String,
        /// What the system says.
        source: std::io::Error,
    },
    /// The interface is down, or went down.
    #[error("interface `{interface}` is down; bring it up with `ip link set {interface} up`")]
    Down {
        /// As written in the configuration.
        interface: String,
    },
    /// The transmit queue stayed full: nobody acknowledges, or the bus is overloaded.
    #[error(
        "the transmit queue of `{interface}` stayed full: nobody on the bus acknowledges, or it is overloaded"
    )]
    Busy {
        /// As written in the configuration.
        interface: String,
    },
    /// Anything else that the system reports.
    #[error("interface `{interface}`: {source}")]
    Io {
        /// As written in the configuration.
        interface: String,
        /// What the system says.
        source: std::io::Error,
    },
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn r_det_089_errors_without_a_valid_frame_make_the_bit_rate_suspect() {
        let suspect = |frames_received, error_frames, bus_off_count| {
            BusCounters { frames_received, error_frames, bus_off_count, ..BusCounters::default() }
                .bit_rate_is_suspect()
        };
        assert!(suspect(0, 20, 0));
        assert!(suspect(0, 0, 1));
        assert!(!suspect(0, 19, 0));
        assert!(!suspect(1, 1_000, 5));
    }
}
