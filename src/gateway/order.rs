//! What a reload has the gateway's task do. \[IO\]

use std::sync::Arc;

use tokio::sync::{mpsc, oneshot};

use super::command::desk::Requests;
use super::kept::Kept;
use crate::can::{BusIndex, CanFrame};
use crate::mapping::TagTable;
use crate::process_image::{ImageReader, ImageWriter};

/// What the task is to do.
#[derive(Debug)]
pub enum Order {
    /// Go on with another tag table.
    Exchange(Box<Exchange>),
    /// A configuration was taken in that does not concern the core; what changed, in words.
    Loaded(String),
    /// One was refused; why, in words.
    Rejected(String),
    /// The configuration that runs is the one that was asked for last.
    Good,
    /// A stream of events on disk is gone on with.
    NumberAfter {
        /// The last event that was told to a broker.
        told: u64,
        /// The number with which the stream ends; where it is higher, the next event after `told` has the next number.
        newest: u64,
        /// Answered when that is so.
        done: oneshot::Sender<()>,
    },
}

/// Another tag table, and what goes with it. By the places of buses in the new table where nothing else is said.
#[derive(Debug)]
pub struct Exchange {
    /// The table.
    pub table: Arc<TagTable>,
    /// What stays.
    pub kept: Kept,
    /// The queue of frames to each bus.
    pub transmit: Vec<mpsc::Sender<CanFrame>>,
    /// The number under which the task of each bus tells events.
    pub ports: Vec<usize>,
    /// Buses that a simulator is on.
    pub simulated: Vec<BusIndex>,
    /// Requests by the places of the new table; those by the old one's are turned away.
    pub requests: Requests,
    /// Gets the reader of the new image when all is done; and the writer of the old image, whose readers end when it does.
    pub done: oneshot::Sender<(ImageReader, ImageWriter)>,
}
