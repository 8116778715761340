//! What must outlive the process: an append-only log of records on disk, with memory behind it for when the disk fails.
//!
//! - [`record`]: how a record and the head of a file stand on disk, pure.
//! - [`disk`]: what is asked of a disk. [`files`] \[IO\]: a folder. `model_disk`: one for tests, which tears, fills and lies.
//! - `log`: the records of one class, in segment files, pure. `recovery`: what is found of them after a start, pure.
//!   `reading`: handing them out in order, pure.
//! - [`keeper`]: both classes under one bound, and what happens when the disk fails, pure. [`report`]: its figures.
//!
//! ## What is promised
//!
//! - A record has a position in its class; positions go up by one and none is used twice, also over restarts. A reader is
//!   told how many are missing before a record, whatever the reason: dropped because the store was full, or damaged.
//! - A record that was handed out was on disk before (written; with [`Sync::Strict`] also synced), unless the disk fails.
//! - A record leaves when it is acknowledged, or when there is no room: the oldest samples first, in whole segments, and
//!   events only when no sample is left.
//! - What is handed out is byte for byte what was taken in; on disk long bodies are deflated, each by itself.
//! - Damage costs what is damaged: the next record is found by its mark, and none is believed whose checksum does not fit.
//! - A disk that fails is told of. Records go to a bounded memory until it works again; then they go to disk, in order.

pub mod disk;
pub mod files;
pub mod keeper;
mod log;
#[cfg(test)]
pub(crate) mod model_disk;
mod reading;
pub mod record;
mod recovery;
pub mod report;
#[cfg(test)]
#[path = "store_tests.rs"]
mod tests;

pub use disk::{Disk, DiskError, NoDisk};
pub use files::Files;
pub use keeper::{Done, Entry, Limits, Store, StoreSettings, Turn};
pub use reading::Want;
pub use record::{Class, Item, StreamId};
pub use report::{State, StoreReport, Sync};
