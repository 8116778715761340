//! What becomes of messages that the broker says it does not take, as it can with MQTT 5.

use std::sync::Arc;

use super::{Copied, Entry, MessageId, Origin, Outbox, Unsent, count};
use crate::store::Class;

/// A message that the broker did not take.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct NotTakenMessage {
    /// Where it was to go.
    pub topic: Arc<str>,
    /// What became of it.
    pub became: Became,
}

/// What becomes of a message that the broker does not take.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Became {
    /// It waits, and with it all that is not retained.
    Held,
    /// It is lost; where the store has it, there.
    GivenUp(Option<(Class, u64)>),
    /// It is not told: the next of its topic says more. A sample that the store does not have belongs to the history.
    Untold(Option<Unsent>),
}

impl Outbox {
    /// The broker does not have a message, and says so. An event that may be taken later goes back in front, and nothing that
    /// is not retained is sent until [`release`](Self::release), so that the order stays. Everything else, also what expires, is
    /// given up, and counted. An id that is not in flight is ignored.
    pub fn handle_not_taken(&mut self, id: MessageId, for_ever: bool) -> Option<NotTakenMessage> {
        let entry = self.in_flight.remove(&id)?;
        self.count_out(&entry);
        let topic = Arc::clone(&entry.message.topic);
        let is_lasting = !entry.message.retain && entry.message.expires.is_none();
        if !for_ever && is_lasting && entry.origin != Origin::Forgotten {
            self.held = true;
            self.insert_waiting(id, Entry { sent_before: true, ..entry });
            return Some(NotTakenMessage { topic, became: Became::Held });
        }
        count(&mut self.report.refused);
        let became = if for_ever {
            if entry.is_copied(Copied::Soon) {
                self.acknowledged_soon.insert(id);
            }
            Became::GivenUp(entry.stored())
        } else {
            Became::Untold(entry.unsent())
        };
        Some(NotTakenMessage { topic, became })
    }

    /// Events may be tried again.
    pub fn release(&mut self) {
        self.held = false;
    }
}
