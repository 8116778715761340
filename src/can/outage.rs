//! Keeps the log short when a bus fails again and again. Pure.

use std::time::Duration;

use super::BusError;
use crate::time::Instant;

/// After a message, the same message is counted instead of logged for this long.
const QUIET: Duration = Duration::from_secs(10);

/// Messages of one kind: logged once in a while, counted in between.
#[derive(Clone, Copy, Debug, Default)]
pub struct Repeats {
    last: Option<Instant>,
    unsaid: u64,
}

impl Repeats {
    /// Whether to log one more of this kind, and how many have been left out since the last that was logged.
    pub fn admit(&mut self, now: Instant) -> Option<u64> {
        if self.last.is_some_and(|last| now.since(last) < QUIET) {
            self.unsaid = self.unsaid.saturating_add(1);
            return None;
        }
        self.last = Some(now);
        Some(std::mem::take(&mut self.unsaid))
    }
}

/// The time in which a bus cannot be opened: its beginning, each new reason and its end are logged.
#[derive(Clone, Debug, Default)]
pub struct Outage {
    since: Option<Instant>,
    reason: String,
    tries: u64,
}

impl Outage {
    /// The bus could not be opened, or was lost.
    pub fn handle_error(&mut self, interface: &str, error: &BusError, now: Instant) {
        self.since.get_or_insert(now);
        self.tries = self.tries.saturating_add(1);
        let reason = error.to_string();
        if self.reason == reason {
            return;
        }
        tracing::warn!(interface, "{reason}; trying again until it works");
        self.reason = reason;
    }

    /// The bus works.
    pub fn handle_up(&mut self, interface: &str, now: Instant) {
        if let Some(since) = self.since {
            let seconds = now.since(since).as_secs();
            tracing::info!(interface, seconds, tries = self.tries, "the bus works again");
        }
        *self = Self::default();
    }

    /// How often the bus failed since it last worked.
    #[must_use]
    pub fn tries(&self) -> u64 {
        self.tries
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn repeats_are_counted_and_told_with_the_next_message() {
        let mut repeats = Repeats::default();
        assert_eq!(repeats.admit(Instant::from_millis(0)), Some(0));
        assert_eq!(repeats.admit(Instant::from_millis(1)), None);
        assert_eq!(repeats.admit(Instant::from_millis(9_999)), None);
        assert_eq!(repeats.admit(Instant::from_millis(10_000)), Some(2));
        assert_eq!(repeats.admit(Instant::from_millis(10_001)), None);
    }

    #[test]
    fn an_outage_counts_its_tries_until_the_bus_works() {
        let mut outage = Outage::default();
        let error = BusError::Down { interface: "can0".into() };
        outage.handle_error("can0", &error, Instant::START);
        outage.handle_error("can0", &error, Instant::from_millis(100));
        assert_eq!(outage.tries(), 2);
        outage.handle_up("can0", Instant::from_millis(200));
        assert_eq!(outage.tries(), 0);
    }
}
