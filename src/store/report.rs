//! Figures of the store.

use std::sync::Arc;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// When what is written has to be safe against a power cut.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Sync {
    /// Within 500 ms: a power cut costs at most that; the end of the process costs nothing.
    #[default]
    Balanced,
    /// Before a record is handed out: nothing, at the price of one write of a block or more for each.
    Strict,
}

/// How the disk is.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum State {
    /// None is used: records are in memory alone.
    #[default]
    Off,
    /// It takes records.
    Good,
    /// It has no room for another reason than the store's own limit; records are in memory.
    Full,
    /// It failed; records are in memory.
    Faulty,
}

impl State {
    /// The word in payloads.
    #[must_use]
    pub fn word(self) -> &'static str {
        match self {
            Self::Off => "off",
            Self::Good => "ok",
            Self::Full => "full",
            Self::Faulty => "faulty",
        }
    }

    /// The number in metrics.
    #[must_use]
    pub fn code(self) -> u64 {
        match self {
            Self::Off => 0,
            Self::Good => 1,
            Self::Full => 2,
            Self::Faulty => 3,
        }
    }

    /// Whether a disk that is to be used cannot be.
    #[must_use]
    pub fn is_fault(self) -> bool {
        matches!(self, Self::Full | Self::Faulty)
    }
}

/// Fill, state and counters since the start; arrays are by [`Class::place`](super::Class::place).
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct StoreReport {
    /// How the disk is.
    pub state: State,
    /// Why it is not good; empty when it is.
    pub reason: Arc<str>,
    /// Records that are not acknowledged.
    pub records: [u64; 2],
    /// Bytes taken on disk; in memory while there is none or it fails.
    pub bytes: u64,
    /// Most of those bytes.
    pub bytes_limit: u64,
    /// Four fifths of what fits are taken, or records have been dropped and it is still nearly so.
    pub filling: bool,
    /// Records dropped because there was no room, or that were too old.
    pub dropped: [u64; 2],
    /// Records that were damaged.
    pub damaged: [u64; 2],
    /// Places in files at which something unreadable was skipped, and files of which nothing could be read.
    pub damaged_places: u64,
    /// Times that the disk failed.
    pub faults: u64,
    /// Bytes handed to the disk.
    pub written: u64,
    /// Bytes of the bodies among them.
    pub payload: u64,
    /// Times that the disk was told to make sure.
    pub syncs: u64,
}

impl StoreReport {
    /// Bytes handed to the disk for each byte of the bodies; `None` before the first.
    #[must_use]
    #[expect(clippy::as_conversions, clippy::cast_precision_loss, reason = "a ratio needs no 53 bits")]
    pub fn written_per_payload(&self) -> Option<f64> {
        (self.payload > 0).then(|| self.written as f64 / self.payload as f64)
    }
}
