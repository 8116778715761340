//! When the next session is tried, what is worth a warning, and when commands are subscribed: alike for each session. Pure.

use std::time::Duration;

use super::back_off::{BackOff, Pace};
use super::subscription::Subscription;
use super::uplink::SessionError;
use crate::time::Instant;

/// The attempts of one connection.
#[derive(Debug)]
pub(super) struct Attempts {
    back_off: BackOff,
    /// Why the attempt before failed; `None` after a session began.
    told: Option<SessionError>,
    /// Of commands.
    pub(super) subscription: Subscription,
}

/// What follows when a session is over or could not begin.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Lost {
    /// Time until the next attempt.
    pub(super) wait: Duration,
    /// Worth a warning: the first time, and again when the cause is another one; an absence that lasts does not fill the log.
    pub(super) is_news: bool,
    /// The broker took the session, and dropped it soon after.
    pub(super) soon_dropped: bool,
}

impl Attempts {
    /// None so far.
    pub(super) fn new(pace: Pace) -> Self {
        Self { back_off: BackOff::new(pace), told: None, subscription: Subscription::default() }
    }

    /// A session began.
    pub(super) fn handle_session_up(&mut self) {
        self.told = None;
    }

    /// The next session is another one, by other settings.
    pub(super) fn handle_new_session(&mut self) {
        (self.subscription, self.told) = (Subscription::default(), None);
    }

    /// Other waits from now on; they begin with the first.
    pub(super) fn set_pace(&mut self, pace: Pace) {
        self.back_off = BackOff::new(pace);
    }

    /// The session that began then is over, or none could begin. `chance` is drawn evenly from 0..1.
    pub(super) fn handle_lost(
        &mut self,
        began: Option<Instant>,
        error: &SessionError,
        now: Instant,
        chance: f64,
    ) -> Lost {
        self.subscription.handle_session_down(error, now);
        let before = self.back_off.failures();
        let wait = if error.is_refusal() {
            self.back_off.after_refusal(chance)
        } else {
            let lasted = began.map_or(Duration::ZERO, |began| now.since(began));
            self.back_off.after_session(lasted, chance)
        };
        let told = self.told.replace(error.clone());
        let is_same = told.is_some_and(|told| told.is_kind_of(error));
        Lost {
            wait,
            is_news: before == 0 || began.is_some() || !is_same,
            soon_dropped: began.is_some() && self.back_off.failures() > 1,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_absence_is_told_once_and_again_when_the_cause_is_another() {
        let mut attempts = Attempts::new(Pace::default());
        let mut news = |began: Option<u64>, error: &SessionError| {
            let now = Instant::from_millis(200_000);
            attempts.handle_lost(began.map(Instant::from_millis), error, now, 0.5).is_news
        };
        let gone = SessionError::Lost("gone".into());
        assert!(news(None, &gone));
        assert!(!news(None, &gone) && !news(None, &SessionError::Lost("away".into())));
        assert!(news(None, &SessionError::NoAnswer));
        assert!(!news(None, &SessionError::NoAnswer));
        assert!(news(Some(199_000), &SessionError::NoAnswer), "a session is over");
    }

    #[test]
    fn only_a_session_that_was_taken_before_is_soon_dropped() {
        let mut attempts = Attempts::new(Pace::default());
        let mut dropped = |began: u64| {
            let error = SessionError::Lost("gone".into());
            let (began, now) = (Instant::from_millis(began), Instant::from_millis(200_000));
            attempts.handle_lost(Some(began), &error, now, 0.5).soon_dropped
        };
        assert_eq!([dropped(199_000), dropped(199_000), dropped(0)], [false, true, false]);
    }
}
