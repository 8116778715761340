//! Keeps the log short when a bus fails again and again. Pure.

use std::time::Duration;

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
        if self.is_quiet(now) {
            self.unsaid = self.unsaid.saturating_add(1);
            return None;
        }
        self.last = Some(now);
        Some(std::mem::take(&mut self.unsaid))
    }

    fn is_quiet(&self, now: Instant) -> bool {
        self.last.is_some_and(|last| now.since(last) < QUIET)
    }
}

/// What the log is told of a bus that cannot be used: why, and that it works again. An outage that is over before it may
/// be told is counted, and one that lasts is told as soon as it may.
#[derive(Clone, Debug, Default)]
pub struct Outage {
    /// Why the bus does not work now, and since when.
    present: Option<(Instant, String)>,
    /// Why it does not work according to the log; `None` where the log says that it works, or nothing yet.
    told: Option<String>,
    messages: Repeats,
}

/// A line for the log.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum OutageMessage {
    /// The bus cannot be used.
    Begun {
        /// Why.
        reason: String,
        /// Outages since the last message that were over before they could be told.
        unsaid: u64,
    },
    /// The bus works again.
    Over {
        /// How long it did not.
        lasted: Duration,
    },
}

impl Outage {
    /// The bus does not work, or not for another reason than before.
    pub fn handle_down(&mut self, reason: &str, now: Instant) -> Option<OutageMessage> {
        match &mut self.present {
            Some((_, present)) => reason.clone_into(present),
            None => self.present = Some((now, reason.to_owned())),
        }
        self.handle_timeout(now)
    }

    /// The bus works.
    pub fn handle_up(&mut self, now: Instant) -> Option<OutageMessage> {
        let (since, _) = self.present.take()?;
        if self.told.take().is_none() {
            self.messages.unsaid = self.messages.unsaid.saturating_add(1);
            return None;
        }
        Some(OutageMessage::Over { lasted: now.since(since) })
    }

    /// To be called once a second or so: an outage that could not be told when it began is told later.
    pub fn handle_timeout(&mut self, now: Instant) -> Option<OutageMessage> {
        let (_, reason) = self.present.as_ref()?;
        if self.told.as_ref() == Some(reason) || self.messages.is_quiet(now) {
            return None;
        }
        let unsaid = self.messages.admit(now)?;
        self.told = Some(reason.clone());
        Some(OutageMessage::Begun { reason: reason.clone(), unsaid })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(millis: u64) -> Instant {
        Instant::from_millis(millis)
    }

    fn begun(reason: &str, unsaid: u64) -> OutageMessage {
        OutageMessage::Begun { reason: reason.to_owned(), unsaid }
    }

    fn over(millis: u64) -> OutageMessage {
        OutageMessage::Over { lasted: Duration::from_millis(millis) }
    }

    #[test]
    fn repeats_are_counted_and_told_with_the_next_message() {
        let mut repeats = Repeats::default();
        assert_eq!(repeats.admit(at(0)), Some(0));
        assert_eq!(repeats.admit(at(1)), None);
        assert_eq!(repeats.admit(at(9_999)), None);
        assert_eq!(repeats.admit(at(10_000)), Some(2));
        assert_eq!(repeats.admit(at(10_001)), None);
    }

    #[test]
    fn an_outage_is_told_once_with_its_reason_and_once_with_its_length() {
        let mut outage = Outage::default();
        assert_eq!(outage.handle_up(at(0)), None, "it had never failed");
        assert_eq!(outage.handle_down("gone", at(1_000)), Some(begun("gone", 0)));
        for again in 2..200 {
            assert_eq!(outage.handle_down("gone", at(again * 1_000)), None);
        }
        assert_eq!(outage.handle_up(at(200_000)), Some(over(199_000)));
        assert_eq!(outage.handle_up(at(200_001)), None);
    }

    #[test]
    fn a_new_reason_is_told_when_the_last_message_is_ten_seconds_old() {
        let mut outage = Outage::default();
        outage.handle_down("gone", at(0));
        assert_eq!(outage.handle_down("refused", at(1_000)), None);
        assert_eq!(outage.handle_timeout(at(9_999)), None);
        assert_eq!(outage.handle_timeout(at(10_000)), Some(begun("refused", 0)));
        assert_eq!(outage.handle_up(at(12_000)), Some(over(12_000)), "since the first reason");
    }

    #[test]
    fn a_bus_that_flaps_fills_no_log_and_the_last_word_is_true() {
        let mut outage = Outage::default();
        assert_eq!(outage.handle_down("gone", at(0)), Some(begun("gone", 0)));
        assert_eq!(outage.handle_up(at(100)), Some(over(100)));
        for flap in 1..90 {
            assert_eq!(outage.handle_down("gone", at(flap * 100)), None);
            assert_eq!(outage.handle_up(at(flap * 100 + 50)), None);
        }
        // The log says that it works. It does not, and that is told in time.
        assert_eq!(outage.handle_down("gone", at(9_500)), None);
        assert_eq!(outage.handle_timeout(at(10_000)), Some(begun("gone", 89)));
        assert_eq!(outage.handle_up(at(10_100)), Some(over(600)));
    }
}
