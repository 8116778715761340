//! What the publisher does with a store, where there is one. Pure.

use std::sync::Arc;
use std::time::Duration;

use super::super::buffer::{self, Buffer, BufferReport, Told};
use super::super::outbox::Message;
use super::super::payload;
use super::super::settings::MqttSettings;
use super::Publisher;
use crate::process_image::ProcessImage;
use crate::store::{Class, Done, Turn};
use crate::time::{Instant, Now};

/// A state that waits longer for its acknowledgement goes to the store as well.
const SAMPLE_PATIENCE: Duration = Duration::from_secs(1);

impl Publisher {
    /// From here on events go through a store, of which `opened` tells what it holds. `newest` is the number of the newest
    /// event that went there: none up to it is taken from the journal.
    pub fn take_store(&mut self, settings: &MqttSettings, opened: &Done, newest: u64) {
        let now = self.identity.started.instant;
        self.buffer = Some(Buffer::new(opened, settings.history_rate, now));
        self.cursor = self.cursor.max(newest);
    }

    /// What is to be done with the store now; nothing while a turn is under way.
    pub fn poll_turn(&mut self, now: Now) -> Option<Turn> {
        self.buffer.as_mut()?.poll_turn(now.instant, &self.outbox, self.session && self.farewell.is_none())
    }

    /// A turn with the store is done.
    pub fn handle_turn(&mut self, done: Done) {
        let Some(buffer) = &mut self.buffer else { return };
        for told in buffer.handle_done(done, &mut self.outbox) {
            self.push_stored(&told);
        }
    }

    /// Fill, counters and forecast of the store; nothing where there is none.
    #[must_use]
    pub fn buffer_report(&self, now: Now) -> Option<BufferReport> {
        let uptime = now.instant.since(self.identity.started.instant).as_secs();
        self.buffer.as_ref().map(|buffer| buffer.report(uptime))
    }

    /// Whether the store has to take what waits before more is read.
    #[must_use]
    pub fn waits_for_store(&self) -> bool {
        self.buffer.as_ref().is_some_and(|buffer| !buffer.takes_events())
    }

    /// Events that wait for the store to take them.
    #[must_use]
    pub fn events_for_store(&self) -> u64 {
        self.buffer.as_ref().map_or(0, Buffer::events)
    }

    /// Events in the journal that were not read.
    #[must_use]
    pub fn unread_events(&self, image: &ProcessImage) -> u64 {
        image.journal.newest().saturating_sub(self.cursor)
    }

    /// So many events are lost.
    pub fn count_missed(&mut self, events: u64) {
        self.outbox.count_missed(events);
    }

    /// Puts the event that stands in the buffer into the store, or into the outbox where there is none.
    pub(super) fn keep_event(&mut self, number: u64) {
        let topic = Arc::clone(&self.topics.event);
        let Some(buffer) = &mut self.buffer else {
            self.push(topic, false);
            return;
        };
        let rest = payload::without_stream(&self.scratch, &self.identity.sid, number);
        buffer.keep_event(number, buffer::body(&topic, rest));
    }

    /// States that are not told live any more go to the store.
    pub(super) fn keep_samples(&mut self, unsent: impl IntoIterator<Item = Message>) {
        let Some(buffer) = &mut self.buffer else { return };
        for message in unsent {
            buffer.keep_sample(history(&message), None);
        }
    }

    /// States whose acknowledgement takes long go to the store as well.
    pub(super) fn keep_overdue(&mut self, now: Now) {
        if self.overdue_at().is_some_and(|due| due <= now.instant) {
            let patience = u64::try_from(SAMPLE_PATIENCE.as_micros()).unwrap_or(u64::MAX);
            self.keep_told_since(Instant::from_micros(now.instant.as_micros().saturating_sub(patience)));
        }
    }

    /// States that are told live since then or longer go to the store as well.
    pub(super) fn keep_told_since(&mut self, since: Instant) {
        let Some(buffer) = &mut self.buffer else { return };
        for (name, message) in self.outbox.take_overdue(since) {
            buffer.keep_sample(history(&message), Some(name));
        }
    }

    pub(super) fn overdue_at(&self) -> Option<Instant> {
        let oldest = self.buffer.as_ref().and_then(|_| self.outbox.oldest_sample());
        oldest.filter(|_| self.session).map(|since| since + SAMPLE_PATIENCE)
    }

    /// What came out of the store, on its way to the broker.
    fn push_stored(&mut self, told: &Told) {
        let Told { class, item } = told;
        let Some((topic, payload)) = buffer::parts(&item.body) else {
            self.give_up(*class, item.position);
            return;
        };
        let payload: Arc<str> = match class {
            Class::Sample => payload.into(),
            Class::Event => {
                let stream = buffer::stream_text(item.stream);
                if item.lost_before > 0 {
                    let last = item.number.saturating_sub(1);
                    payload::events_lost(&mut self.scratch, &stream, last, item.lost_before, item.at);
                    self.push(Arc::clone(&topic), false);
                }
                payload::with_stream(&stream, item.number, payload).into()
            }
        };
        let message = Message::event(topic, payload);
        if !self.outbox.push_stored(message, *class, item.position) {
            self.give_up(*class, item.position);
        }
    }

    /// No broker takes it: it would stand in the way for ever.
    fn give_up(&mut self, class: Class, position: u64) {
        if let Some(buffer) = &mut self.buffer {
            buffer.acknowledge((class, position));
        }
    }
}

/// A state as it stands in the history.
fn history(state: &Message) -> String {
    let topic = state.topic.strip_suffix("/state").unwrap_or(&state.topic);
    buffer::body(&format!("{topic}/history"), &payload::historical(&state.payload))
}
