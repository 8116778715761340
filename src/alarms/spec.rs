//! What an alarm is like.

use std::time::Duration;

use crate::process_image::{AlarmIndex, Priority};

/// The behaviour of one alarm.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct AlarmSpec {
    /// How urgent.
    pub priority: Priority,
    /// The condition must hold this long before the alarm is raised.
    pub on_delay: Duration,
    /// The condition must be gone this long before the alarm returns.
    pub off_delay: Duration,
    /// Stays active after its condition has gone, until it is acknowledged and then reset.
    pub latch: bool,
    /// Alarms that tell the cause: while the condition of one of them holds (its delays included) this one is
    /// suppressed, acknowledged or suppressed itself as that one may be.
    pub suppressed_by: Vec<AlarmIndex>,
    /// First-out group: the first alarm of a group to be raised since none of it was active is marked.
    pub first_out_group: Option<u32>,
}
