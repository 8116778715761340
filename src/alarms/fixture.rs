//! Alarms for tests.

use std::time::Duration;

use super::AlarmSpec;
use crate::process_image::{AlarmIndex, Priority};

/// A spec to be changed; without delays, not latching.
pub(super) fn spec() -> Builder {
    Builder(AlarmSpec {
        priority: Priority::Medium,
        on_delay: Duration::ZERO,
        off_delay: Duration::ZERO,
        latch: false,
        suppressed_by: Vec::new(),
        first_out_group: None,
    })
}

/// See [`spec`].
pub(super) struct Builder(AlarmSpec);

impl Builder {
    /// In milliseconds.
    pub(super) fn delays(mut self, on: u64, off: u64) -> Self {
        self.0.on_delay = Duration::from_millis(on);
        self.0.off_delay = Duration::from_millis(off);
        self
    }

    pub(super) fn latch(mut self, latch: bool) -> Self {
        self.0.latch = latch;
        self
    }

    pub(super) fn suppressed_by(mut self, causes: &[usize]) -> Self {
        self.0.suppressed_by = causes.iter().map(|cause| AlarmIndex(*cause)).collect();
        self
    }

    pub(super) fn first_out(mut self, group: u32) -> Self {
        self.0.first_out_group = Some(group);
        self
    }

    pub(super) fn build(self) -> AlarmSpec {
        self.0
    }
}
