//! The end of the MQTT task in good order \[IO\].

use std::time::Duration;

use super::super::publisher::Publisher;
use super::super::store_link::CLOSE_TIMEOUT;
use super::super::uplink::{Happening, Uplink};
use super::{Phase, Task, turn_done};

/// At a stop: time for what still waits.
const FLUSH_TIMEOUT: Duration = Duration::from_secs(1);
/// At a stop: time for the acknowledgement of `offline`.
pub(super) const OFFLINE_TIMEOUT: Duration = Duration::from_secs(2);

/// At a stop: time to read what happened last, where the disk makes room for it slowly.
const READ_TIMEOUT: Duration = Duration::from_secs(4);
/// Within this time a stop is over, whatever broker and disk do: that is the sum of all times here, one more answer of the disk, which
/// may come at the end of the first of them, and some for what takes no time.
pub const STOP_LIMIT: Duration = READ_TIMEOUT
    .saturating_add(FLUSH_TIMEOUT)
    .saturating_add(OFFLINE_TIMEOUT)
    .saturating_add(CLOSE_TIMEOUT.saturating_mul(3))
    .saturating_add(Duration::from_secs(2));

/// How sending the rest at a stop ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Flushed {
    /// The broker has what it was to have.
    Done,
    /// Not within the time.
    Late,
    /// The session ended.
    Closed,
}

impl Task {
    /// A stop in good order: what waits, then `offline`, then DISCONNECT. A broker that did not acknowledge `offline` in
    /// time is left without a DISCONNECT: then it publishes the last will, which says the same.
    pub(super) async fn stop<U: Uplink>(mut self, phase: Phase<U>) {
        self.image.demand();
        let begin = self.clock.now().instant;
        while (self.image.has_changed() || self.publisher.has_more())
            && self.clock.now().instant.since(begin) < READ_TIMEOUT
        {
            self.image.allow();
            self.read_image();
            if self.publisher.waits_for_store() && !self.make_room().await {
                break;
            }
        }
        if let Phase::Session { uplink, began: Some(_), .. } = phase {
            self.say_farewell(uplink).await;
        } else {
            self.publisher.handle_stop();
        }
        // What was sent and not acknowledged belongs to the next start.
        self.publisher.handle_session_down();
        self.close_store().await;
        self.report(false);
    }

    /// The store takes what waits for it; `false` where its disk does not answer in time.
    async fn make_room(&mut self) -> bool {
        self.turn_store();
        let Some(store) = &mut self.store else { return false };
        let Some(done) = store.rest().await else { return false };
        self.publisher.handle_turn(done);
        true
    }

    /// The end of the store. Events that it did not take are lost, counted and told of.
    async fn close_store(&mut self) {
        let Some(mut store) = self.store.take() else { return };
        if let Some(done) = store.rest().await {
            self.publisher.handle_turn(done);
        }
        let mut lost = self.reader.read(|image| self.publisher.unread_events(image));
        let waiting = self.publisher.events_for_store();
        let rest = if store.is_busy() { None } else { self.publisher.poll_turn(self.clock.now()) };
        if !store.close(self.clock, rest).await {
            lost = lost.saturating_add(waiting);
        }
        if lost > 0 {
            self.publisher.count_missed(lost);
            tracing::error!(
                events = lost,
                "{lost} events for MQTT are lost: they did not get to the disk before the stop"
            );
        }
    }

    async fn say_farewell<U: Uplink>(&mut self, mut uplink: U) {
        let rest = self.flush(&mut uplink, FLUSH_TIMEOUT, Publisher::is_idle).await;
        self.publisher.handle_stop();
        if rest != Flushed::Closed
            && self.flush(&mut uplink, OFFLINE_TIMEOUT, Publisher::has_said_farewell).await == Flushed::Done
        {
            uplink.disconnect().await;
        }
    }

    /// Sends until it is `done`, the time is over, or the session ends.
    pub(super) async fn flush<U: Uplink>(
        &mut self,
        uplink: &mut U,
        limit: Duration,
        done: fn(&Publisher) -> bool,
    ) -> Flushed {
        let deadline = self.clock.deadline(self.clock.now().instant + limit);
        loop {
            self.turn_store();
            if !self.send(uplink) {
                return Flushed::Closed;
            }
            if done(&self.publisher) {
                return Flushed::Done;
            }
            tokio::select! {
                () = tokio::time::sleep_until(deadline) => return Flushed::Late,
                done = turn_done(&mut self.store) => self.publisher.handle_turn(done),
                happening = uplink.next() => match happening {
                    Happening::Acknowledged(id) => self.publisher.handle_acknowledged(id),
                    Happening::NotTaken(id, why) => self.not_taken(id, why),
                    Happening::Closed(_) => return Flushed::Closed,
                    // Too late for a command.
                    Happening::Connected | Happening::Subscribed | Happening::Message(_) => {}
                },
            }
        }
    }
}
