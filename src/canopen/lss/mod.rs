//! LSS master (CiA 305): finds devices, gives them node ids and bit rates.
//!
//! [`LssMaster`] is for one bus and does one job at a time: a service of the protocol, a scan, or a whole change of
//! node id or bit rate. It has the four verbs of this crate, and one more: what a change needs beside LSS (an SDO
//! write, an NMT request, a boot-up message) it asks of its caller by [`LssOutput::Perform`], who reports back with
//! [`LssMaster::handle_performed`]. Every job that is taken ends with one [`LssOutput::Done`].
//!
//! An LSS slave says yes by an answer and no by silence, and all slaves answer with the same identifier; the answers of
//! several at once look like one. What follows from that for scans is said in `fastscan` and `slowscan`.
//!
//! All slaves in configuration state obey alike. The master therefore configures only a slave that was selected by its
//! address, or one of which an operator has confirmed that it is the only one on the bus (R-DST-111).
//!
//! - `types`: what is asked of it, and what it gives back. `codec`: frames.
//! - `master`: frames, time limits and duties of the job under way.
//! - `program`: jobs as steps; `fastscan`, `slowscan`, `change`: the longer ones.

mod change;
mod codec;
mod fastscan;
mod master;
mod program;
mod slowscan;
mod types;

pub use codec::{ANSWER_ID, REQUEST_ID};
pub use master::LssMaster;
pub use types::{
    LssActivation, LssAddress, LssAnswer, LssBitRate, LssChange, LssDuty, LssError, LssJob, LssKnown,
    LssOutput, LssRange, LssSettings, LssState, LssTarget, Performed,
};

#[cfg(test)]
mod tests;
