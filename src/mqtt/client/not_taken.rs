//! What the task does with messages that the broker does not take \[IO\]: it tells of them, once for each topic in a session.

use super::super::outbox::{Became, MessageId};
use super::super::uplink::NotTaken;
use super::Task;

/// Topics that are told of in a session; of more the messages are counted only.
const MOST_TOLD: usize = 100;

impl Task {
    /// The broker does not have a message, and says so.
    pub(super) fn not_taken(&mut self, id: MessageId, why: NotTaken) {
        let now = self.clock.now();
        let Some(message) = self.publisher.handle_not_taken(now, id, why.for_ever) else { return };
        if self.not_taken.len() >= MOST_TOLD || !self.not_taken.insert(message.topic.clone()) {
            return;
        }
        let (topic, words) = (&*message.topic, why.words);
        match message.became {
            Became::Held => tracing::warn!(
                topic,
                "the broker does not take what goes to `{topic}`: {words}; events are kept and tried again every minute"
            ),
            Became::GivenUp(_) => {
                tracing::error!(
                    topic,
                    "a message to `{topic}` is lost, as the broker will never take it: {words}"
                );
            }
            Became::Untold(_) => {
                tracing::warn!(topic, "the broker does not take what goes to `{topic}`: {words}");
            }
        }
    }
}
