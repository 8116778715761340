//! A publisher goes on with another tag table, and other settings, while its session lasts. Pure.
//!
//! What is to be told is told anew, as at the begin of a session: that is never wrong, and what is retained is replaced by what
//! says the same. What was collected stays: events, messages of serial lines, the store and the numbers of all of them.

use std::collections::BTreeSet;
use std::sync::Arc;

use super::super::home_assistant::HomeAssistant;
use super::super::outbox::Message;
use super::super::payload::{self, Identity};
use super::super::settings::MqttSettings;
use super::{Birth, Publisher};
use crate::mapping::TagTable;
use crate::process_image::LineIndex;
use crate::time::{Instant, Now};

/// Topics that are remembered to be cleared, and nodes whose numbers are; of more the first by name are let go.
const MOST_GONE: usize = 4096;

impl Publisher {
    /// Goes on with another table. `lines`: for each line there its place in the table before, where it is the same one.
    pub fn exchange(
        &mut self,
        settings: &MqttSettings,
        table: Arc<TagTable>,
        identity: Identity,
        lines: &[Option<LineIndex>],
    ) {
        let next = Self::new(table, settings, identity);
        let mut old = std::mem::replace(self, next);
        self.gone = std::mem::take(&mut old.gone);
        self.gone.extend(old.retained());
        for topic in self.retained().collect::<Vec<_>>() {
            self.gone.remove(&topic);
        }
        while self.gone.len() > MOST_GONE {
            self.gone.pop_first();
        }
        if let (Some(home_assistant), Some(old)) = (&mut self.home_assistant, &old.home_assistant) {
            home_assistant.go_on_from(old);
        }
        self.numbers = std::mem::take(&mut old.numbers);
        let before = old.table.nodes.iter().zip(&old.nodes);
        self.numbers.extend(before.map(|(def, node)| (def.name.clone(), node.seq)));
        for (def, node) in self.table.nodes.iter().zip(&mut self.nodes) {
            node.seq = self.numbers.remove(&def.name).unwrap_or_default();
        }
        while self.numbers.len() > MOST_GONE {
            self.numbers.pop_first();
        }
        self.lines.go_on_from(&old.lines, lines);
        self.outbox.go_on_from(old.outbox);
        self.buffer = old.buffer;
        if let Some(buffer) = &mut self.buffer {
            buffer.set_rate(settings.history_rate);
        }
        (self.session, self.cursor) = (old.session, old.cursor);
    }

    /// The session is to end, and another one to begin: `offline` is told, and what waits stays.
    pub fn handle_pause(&mut self) {
        self.farewell_acknowledged = false;
        self.farewell = self.publish_bridge_state(payload::OFFLINE);
    }

    /// The other session may begin.
    pub fn handle_pause_end(&mut self) {
        self.farewell = None;
    }

    /// Begins behind this event: those before were told by another publisher.
    pub fn begin_after(&mut self, event: u64) {
        self.cursor = event;
    }

    /// The last event that was taken from the journal.
    #[must_use]
    pub fn taken_through(&self) -> u64 {
        self.cursor
    }

    /// What the broker keeps of ours, but for `bridge/state`, which always says whether we are there.
    fn retained(&self) -> impl Iterator<Item = Arc<str>> {
        let topics = &self.topics;
        let nodes = topics.nodes.iter().flat_map(|node| [&node.state, &node.availability]);
        let own = [&topics.bridge_info, &topics.bridge_health].into_iter();
        let announced = self.home_assistant.iter().flat_map(HomeAssistant::topics);
        own.chain(nodes).chain(&topics.alarms).chain(announced).cloned()
    }

    /// Clears what former tables left at the broker: once, for somebody else may have such a topic later.
    pub(super) fn clear_gone(&mut self, now: Now) {
        let gone: BTreeSet<Arc<str>> = self.gone.clone();
        if self.buffer.is_some() && gone.iter().any(|topic| self.outbox.is_waiting(topic)) {
            // A state that is about to be replaced belongs to the history.
            self.keep_told_since(now.instant);
        }
        self.clearing.clear();
        for topic in gone {
            let message = Message::retained(Arc::clone(&topic), "".into());
            self.clearing.extend(self.outbox.push(message).map(|id| (id, topic)));
        }
        self.birth = Birth::Due;
        self.next_health = Instant::START;
    }
}
