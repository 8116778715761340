//! All alarms.

use super::AlarmSpec;
use crate::process_image::{AlarmIndex, AlarmState, AlarmStatus, Value};
use crate::time::{Instant, Now};

/// An alarm changed its state.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Transition {
    /// Which.
    pub alarm: AlarmIndex,
    /// State before.
    pub from: AlarmState,
    /// State now.
    pub to: AlarmState,
    /// When.
    pub at: Now,
    /// All that readers see of it now (its `revision` is for the gateway to fill in).
    pub status: AlarmStatus,
}

/// Why an alarm could not be acknowledged.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum AcknowledgeError {
    /// There is no such alarm.
    #[error("there is no such alarm")]
    Unknown,
    /// Nothing waits for an acknowledgement.
    #[error("the alarm does not wait for an acknowledgement")]
    NothingToAcknowledge,
}

/// All alarms of the gateway.
#[derive(Debug)]
pub struct AlarmList {
    _specs: Vec<AlarmSpec>,
}

impl AlarmList {
    /// All alarms normal.
    #[must_use]
    pub fn new(specs: Vec<AlarmSpec>) -> Self {
        Self { _specs: specs }
    }

    /// Whether an alarm's condition holds; `value` is the one that decides, where there is one.
    pub fn set_condition(&mut self, _now: Now, _alarm: AlarmIndex, _holds: bool, _value: Option<Value>) {}

    /// An operator has seen the alarm.
    pub fn acknowledge(&mut self, _now: Now, _alarm: AlarmIndex) -> Result<(), AcknowledgeError> {
        Err(AcknowledgeError::Unknown)
    }

    /// An operator resets a latched, acknowledged alarm. `false` where there is nothing to reset.
    pub fn reset(&mut self, _now: Now, _alarm: AlarmIndex) -> bool {
        false
    }

    /// Delays that ran out.
    pub fn handle_timeout(&mut self, _now: Now) {}

    /// Transitions, in order; call until `None`.
    pub fn poll_output(&mut self) -> Option<Transition> {
        None
    }

    /// When `handle_timeout` is to be called at the latest.
    #[must_use]
    pub fn poll_timeout(&self) -> Option<Instant> {
        None
    }

    /// An alarm as it stands.
    #[must_use]
    pub fn status(&self, _alarm: AlarmIndex) -> Option<&AlarmStatus> {
        None
    }
}
