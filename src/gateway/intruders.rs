//! Who asks again and again for what is not theirs: requests that were refused for want of a right.

use std::time::Duration;

use super::core::Gateway;
use super::refusals::Report;
use crate::gateway::command::Refused;
use crate::mapping::{AlarmOwner, BuiltIn};
use crate::time::{Instant, Now};

/// So many refusals within [`WINDOW`] are told as an alarm (G07).
const MANY: usize = 5;

/// See [`MANY`].
const WINDOW: Duration = Duration::from_secs(60);

/// When the last requests were refused.
#[derive(Debug, Default)]
pub(super) struct Intruders {
    /// The oldest first.
    last: [Option<Instant>; MANY],
}

impl Intruders {
    fn note(&mut self, now: Instant, count: u64) {
        for _ in 0..count.min(u64::try_from(MANY).unwrap_or(u64::MAX)) {
            self.last.rotate_left(1);
            if let Some(newest) = self.last.last_mut() {
                *newest = Some(now);
            }
        }
    }

    /// Until when there are many.
    pub(super) fn poll_timeout(&self) -> Option<Instant> {
        self.last.first().copied().flatten().map(|oldest| oldest + WINDOW)
    }

    fn forget(&mut self, now: Instant) {
        if self.poll_timeout().is_some_and(|until| until <= now) {
            // The others are younger, but without this one they are too few.
            if let Some(oldest) = self.last.first_mut() {
                *oldest = None;
            }
        }
    }
}

impl Gateway {
    /// Requests were refused: told, folded by kind, and counted.
    pub(super) fn requests_refused(&mut self, now: Now, refused: Vec<Refused>) {
        for Refused { source, verb, action, text, count } in refused {
            self.intruders.note(now.instant, count);
            let (about, what) =
                action.map_or((AlarmOwner::Gateway, String::new()), |action| self.in_words(&action));
            let text = if what.is_empty() { text } else { format!("{what}: {text}") };
            let (is_command, outcome) = (true, "forbidden");
            self.events
                .record_refusal(now, Report { source, name: verb, is_command, about, outcome, text, count });
        }
        self.look_at_intruders(now);
        self.settle(now);
    }

    pub(super) fn look_at_intruders(&mut self, now: Now) {
        self.intruders.forget(now.instant);
        let many = self.intruders.poll_timeout().is_some();
        self.conditions.set(now, AlarmOwner::Gateway, BuiltIn::AccessRefused, many);
    }
}
