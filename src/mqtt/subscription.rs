//! When the command topics are subscribed, pure.
//!
//! At the begin of each session, as a rule. A message that is too large ends the session; a retained one would come, and end it,
//! after every subscription. So it is published without commands for a while after one.

use std::time::Duration;

use super::uplink::SessionError;
use crate::time::Instant;

/// How long no commands are taken after a message that was too large.
pub const WITHOUT_COMMANDS: Duration = Duration::from_secs(600);

/// Whether it is done, and when it may be.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Subscription {
    /// Not before; `None`: at once.
    from: Option<Instant>,
    /// Done in this session.
    made: bool,
}

impl Subscription {
    /// The session is over, or could not begin.
    pub(super) fn handle_session_down(&mut self, error: &SessionError, now: Instant) {
        self.made = false;
        if *error == SessionError::TooLarge {
            self.from = Some(now + WITHOUT_COMMANDS);
        }
    }

    /// Whether to subscribe now, in a session that is up: yes once.
    pub(super) fn is_due(&mut self, now: Instant) -> bool {
        let due = !self.made && self.from.is_none_or(|from| from <= now);
        self.made |= due;
        due
    }

    /// Whether it was done in this session.
    pub(super) fn is_made(self) -> bool {
        self.made
    }

    /// When it is due in a session that is up.
    pub(super) fn poll_timeout(&self) -> Option<Instant> {
        self.from.filter(|_| !self.made)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(secs: u64) -> Instant {
        Instant::from_millis(secs * 1000)
    }

    #[test]
    fn each_session_subscribes_once() {
        let mut subscription = Subscription::default();
        for second in [0, 5] {
            assert!(subscription.is_due(at(second)) && !subscription.is_due(at(second)));
            assert_eq!(subscription.poll_timeout(), None);
            subscription.handle_session_down(&SessionError::Lost("gone".into()), at(second));
        }
    }

    #[test]
    fn after_a_message_that_is_too_large_it_waits_ten_minutes_and_other_ends_change_nothing() {
        let mut subscription = Subscription::default();
        assert!(subscription.is_due(at(0)));
        subscription.handle_session_down(&SessionError::TooLarge, at(1));
        assert!(!subscription.is_due(at(2)));
        subscription.handle_session_down(&SessionError::Lost("gone".into()), at(300));
        assert!(!subscription.is_due(at(600)));
        assert_eq!(subscription.poll_timeout(), Some(at(601)));
        assert!(subscription.is_due(at(601)));
        assert_eq!(subscription.poll_timeout(), None);
    }
}
