//! Messages that the broker says it does not take, as it can with MQTT 5. Pure.

use std::time::Duration;

use super::super::outbox::{Became, MessageId, NotTakenMessage};
use super::Publisher;
use crate::time::Now;

/// How long events wait that the broker does not take for now; a new session ends the wait.
pub const TRY_AGAIN: Duration = Duration::from_secs(60);

impl Publisher {
    /// The broker does not have a message, and says so. Gives where it was to go, and whether it waits for another try; nothing
    /// for one that is not in flight.
    pub fn handle_not_taken(&mut self, now: Now, id: MessageId, for_ever: bool) -> Option<NotTakenMessage> {
        let message = self.outbox.handle_not_taken(id, for_ever)?;
        match &message.became {
            Became::Held => self.release_at = Some(now.instant + TRY_AGAIN),
            Became::Untold(unsent) => self.keep_samples(unsent.clone()),
            Became::GivenUp(stored) => {
                if let (Some(buffer), Some(stored)) = (&mut self.buffer, *stored) {
                    buffer.acknowledge(stored);
                }
            }
        }
        Some(message)
    }

    /// Tries events again, where that is due.
    pub(super) fn release_held(&mut self, now: Now) {
        if self.release_at.is_some_and(|at| at <= now.instant) {
            self.release_at = None;
            self.outbox.release();
        }
    }
}
