//! What is told of the gateway, alarms and nodes as an image shows them. Pure.

use std::sync::Arc;

use super::super::home_assistant::HomeAssistant;
use super::super::outbox::{Message, MessageId};
use super::super::payload::{self, Stamp};
use super::super::told::{NodeState, differs, is_same_alarm};
use super::{Birth, HEALTH_INTERVAL, HISTORY_IS_LONGER, Publisher};
use crate::mapping::NodeDef;
use crate::process_image::{NodeIndex, ProcessImage, TagIndex};
use crate::time::{Instant, Now};

impl Publisher {
    pub(super) fn publish_health(&mut self, now: Now, image: &ProcessImage) {
        if now.instant < self.next_health {
            return;
        }
        self.next_health = now.instant + HEALTH_INTERVAL;
        let report = *self.outbox.report();
        let buffer = self.buffer_report(now);
        let reports = (&report, buffer.as_ref());
        payload::health(&mut self.scratch, &self.table, image, &self.identity, now, reports);
        self.push(Arc::clone(&self.topics.bridge_health), true);
        if self.birth == Birth::Done {
            // The last will of a session before this one may have come late.
            self.publish_bridge_state(payload::ONLINE);
        }
    }

    pub(super) fn publish_bridge_state(&mut self, state: &str) -> Option<MessageId> {
        self.scratch.clear();
        self.scratch.push_str(state);
        self.push(Arc::clone(&self.topics.bridge_state), true)
    }

    pub(super) fn publish_announcements(&mut self, left: &mut usize) {
        while self.home_assistant.as_ref().is_some_and(HomeAssistant::has_more) && self.take_one(left) {
            let next = self.home_assistant.as_mut().and_then(HomeAssistant::poll_output);
            if let Some((topic, payload)) = next {
                self.outbox.push(Message::retained(topic, payload));
            }
        }
    }

    pub(super) fn publish_alarms(&mut self, image: &ProcessImage, left: &mut usize) {
        let table = Arc::clone(&self.table);
        for (place, (def, status)) in table.alarms.iter().zip(&image.alarms).enumerate() {
            let told = self.alarms.get(place).copied().flatten();
            if told.is_some_and(|told| is_same_alarm(&told, status)) {
                continue;
            }
            if !self.take_one(left) {
                return;
            }
            payload::alarm(&mut self.scratch, &table, def, status);
            if let Some(topic) = self.topics.alarms.get(place).cloned() {
                self.push(topic, true);
            }
            if let Some(told) = self.alarms.get_mut(place) {
                *told = Some(*status);
            }
        }
    }

    pub(super) fn publish_nodes(&mut self, now: Now, image: &ProcessImage, left: &mut usize) {
        let table = Arc::clone(&self.table);
        let changed = self.seen != Some(image.revision);
        for (place, def) in table.nodes.iter().enumerate() {
            if changed && self.session && !self.publish_availability(place, image, left) {
                return;
            }
            if changed {
                self.note_changes(place, def, image);
            }
            let due = self.nodes.get(place).is_some_and(|node| self.due(def, node) <= now.instant);
            if due && !self.take_one(left) {
                return;
            }
            if due {
                self.publish_state(now, place, def, image);
            }
        }
    }

    /// When the state of a node is to be published, or to be kept for the history.
    pub(super) fn due(&self, def: &NodeDef, node: &NodeState) -> Instant {
        let due = node.due(def);
        match node.published {
            Some(published) if !self.session => due.max(published + self.history_interval),
            Some(_) | None => due,
        }
    }

    /// Tells whether a node is there, when that changed. `false` when that has to wait for the next read.
    fn publish_availability(&mut self, place: usize, image: &ProcessImage, left: &mut usize) -> bool {
        let (Some(status), Some(node)) = (image.nodes.get(place), self.nodes.get(place)) else { return true };
        let told = node.availability.as_ref();
        if told.is_some_and(|(online, reason)| {
            *online == status.online && (status.online || *reason == status.reason)
        }) {
            return true;
        }
        if !self.take_one(left) {
            return false;
        }
        payload::availability(&mut self.scratch, status);
        if let Some(topics) = self.topics.nodes.get(place) {
            let topic = Arc::clone(&topics.availability);
            self.push(topic, true);
        }
        if let Some(node) = self.nodes.get_mut(place) {
            node.availability = Some((status.online, status.reason.clone()));
        }
        true
    }

    /// Marks a node whose published values, what is to be said against them, or NMT state are not those that were told.
    fn note_changes(&mut self, place: usize, def: &NodeDef, image: &ProcessImage) {
        let table = &self.table;
        let Some(node) = self.nodes.get_mut(place) else { return };
        node.fast = def.publish.fast_while.is_some_and(|tag| {
            let sample = image.tag(tag);
            sample.quality.is_usable() && sample.value.is_true()
        });
        if node.dirty {
            return;
        }
        let told = self.tags.get(def.tags.clone()).unwrap_or_default();
        let watched = self.watched.get(def.tags.clone()).unwrap_or_default();
        let tags = table.tags.get(def.tags.clone()).unwrap_or_default().iter().zip(told).zip(watched);
        let moved = def.tags.clone().zip(tags).any(|(index, ((tag, told), watched))| {
            if !watched {
                return false;
            }
            let sample = image.tag(TagIndex(index));
            told.is_none_or(|(value, quality)| {
                quality != sample.quality || differs(value, sample.value, tag.deadband)
            })
        });
        node.dirty = moved || image.nodes.get(place).is_some_and(|status| status.nmt != node.nmt);
    }

    fn publish_state(&mut self, now: Now, place: usize, def: &NodeDef, image: &ProcessImage) {
        let Some(node) = self.nodes.get_mut(place) else { return };
        node.seq += 1;
        node.published = Some(now.instant);
        node.dirty = false;
        node.nmt = image.nodes.get(place).and_then(|status| status.nmt);
        let stamp = Stamp { sid: &self.identity.sid, seq: node.seq };
        payload::state(&mut self.scratch, &self.table, image, NodeIndex(place), stamp);
        for (index, told) in def.tags.clone().zip(self.tags.get_mut(def.tags.clone()).unwrap_or_default()) {
            let sample = image.tag(TagIndex(index));
            *told = Some((sample.value, sample.quality));
        }
        let Some(topics) = self.topics.nodes.get(place) else { return };
        let topic = Arc::clone(&topics.state);
        let message = Message {
            at_least_once: self.state_acknowledged,
            expires: self.state_expiry.map(|expiry| now.instant + expiry),
            ..Message::retained(Arc::clone(&topic), Arc::from(self.scratch.as_str()))
        };
        let Some(buffer) = &mut self.buffer else {
            self.outbox.push(message);
            return;
        };
        buffer.count_state(&self.scratch, topic.len() + HISTORY_IS_LONGER);
        if self.outbox.is_waiting(&topic) {
            // It is about to be replaced, and goes to the store behind those that are on their way to the broker.
            self.keep_told_since(now.instant);
        }
        let unsent = if self.session { self.outbox.push_sample(message, now.instant) } else { Some(message) };
        self.keep_samples(unsent);
    }

    /// Uses up one of the payloads that may still be made under this lock.
    pub(super) fn take_one(&mut self, left: &mut usize) -> bool {
        self.more = *left == 0;
        *left = left.saturating_sub(1);
        !self.more
    }
}
