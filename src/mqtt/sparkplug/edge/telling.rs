//! What is said of an origin: births, deaths, data, and what was kept. Pure.

use std::collections::BTreeMap;

use super::super::history::{Batch, Kept};
use super::super::messages;
use super::super::origin::{Change, Origin, Told, is_fast, is_news, is_online};
use super::super::payload::Metric;
use super::{EdgeNode, HISTORY_BATCH, HISTORY_PACE, MOST_QUEUED, Phase, count};
use crate::process_image::{ProcessImage, TagIndex};
use crate::time::Now;

impl EdgeNode {
    /// NBIRTH or DBIRTH.
    pub(super) fn give_birth(&mut self, place: usize, now: Now, image: &ProcessImage) {
        let mut metrics = Vec::new();
        if place == 0 {
            self.seq = 0;
            metrics.extend(messages::of_edge_node(now, self.bd_seq.0));
        }
        let mut units = BTreeMap::new();
        for metric in self.catalogue.of(place) {
            let Some(def) = self.catalogue.metric(metric) else { continue };
            let reading = def.read(&self.table, image);
            let at = reading.at.unwrap_or(now.utc);
            let unit = def.tag().and_then(|tag| Some((tag, image.units.get(&tag)?)));
            metrics.push(def.birth(&reading, at, unit.map(|(_, unit)| unit.as_str())));
            units.extend(unit.map(|(tag, unit)| (tag, unit.clone())));
            if let Some(told) = self.told.get_mut(metric) {
                *told = Some(Told { datum: reading.datum, quality: reading.quality, at });
            }
        }
        metrics.sort_by_key(|metric| metric.timestamp);
        let seq = self.next_seq();
        let payload = messages::numbered(now, seq, metrics);
        let topic = self.topics.birth(place);
        let sent = self.push(topic, &payload, None).is_some();
        if !sent {
            // The number is given to the next message, so that there is no gap.
            self.seq = self.seq.wrapping_sub(1);
        }
        if let Some(origin) = self.origins.get_mut(place) {
            *origin =
                Origin { born: sent, refused: !sent, last: Some(now.instant), units, ..Origin::default() };
        }
        if place == 0 {
            count(&mut self.report.births);
        }
    }

    /// Marks an origin of which something is not as it was told.
    pub(super) fn note_changes(&mut self, place: usize, image: &ProcessImage) {
        let Some(origin) = self.origins.get(place).filter(|origin| self.listens(origin) && !origin.urgent)
        else {
            return;
        };
        let fast = is_fast(self.node(place), image);
        let mut change = (origin.dirty, false);
        for metric in self.catalogue.of(place) {
            let Some(def) = self.catalogue.metric(metric) else { continue };
            let reading = def.read(&self.table, image);
            if is_news(def, self.told.get(metric).copied().flatten(), &reading) {
                change = (true, change.1 || def.is_urgent());
            }
        }
        if let Some(origin) = self.origins.get_mut(place) {
            (origin.dirty, origin.urgent) = change;
            origin.fast = fast;
        }
    }

    /// Births, deaths and data of an origin. `false` where there is no room for them.
    pub(super) fn tell(&mut self, place: usize, now: Now, image: &ProcessImage) -> bool {
        let Some(origin) = self.origins.get(place) else { return true };
        if self.phase == Phase::Live {
            let online = is_online(place, image);
            let (born, refused) = (origin.born, origin.refused);
            let other_units = born && self.has_other_units(place, image);
            if (born != online && !refused) || other_units {
                if self.queue.len() >= MOST_QUEUED {
                    return false;
                }
                if online {
                    self.give_birth(place, now, image);
                } else {
                    self.die(place, now);
                }
                return true;
            }
        }
        let Some(origin) = self.origins.get(place) else { return true };
        if !origin.dirty || !self.listens(origin) || now.instant < origin.due(self.node(place)) {
            return true;
        }
        if self.phase == Phase::Live && self.queue.len() >= MOST_QUEUED {
            return false;
        }
        let changes = self.changes(place, now, image);
        if let Some(origin) = self.origins.get_mut(place) {
            (origin.dirty, origin.urgent, origin.last) = (false, false, Some(now.instant));
        }
        if self.phase == Phase::Live {
            self.send_data(place, now, changes);
        } else {
            for change in changes {
                self.history.push(place, change.kept);
            }
        }
        true
    }

    fn has_other_units(&self, place: usize, image: &ProcessImage) -> bool {
        let Some(node) = self.node(place) else {
            return false;
        };
        let told = self.origins.get(place).map(|origin| &origin.units);
        let published = |tag: &TagIndex| self.table.tag(*tag).is_some_and(|def| def.published);
        let now = image.units.range(TagIndex(node.tags.start)..TagIndex(node.tags.end));
        told.is_some_and(|told| !told.iter().eq(now.filter(|(tag, _)| published(tag))))
    }

    /// What changed of an origin, by its own time; it counts as told.
    fn changes(&mut self, place: usize, now: Now, image: &ProcessImage) -> Vec<Change> {
        let mut changes = Vec::new();
        for metric in self.catalogue.of(place) {
            let (Some(def), Some(told)) = (self.catalogue.metric(metric), self.told.get_mut(metric)) else {
                continue;
            };
            let reading = def.read(&self.table, image);
            if !is_news(def, *told, &reading) {
                continue;
            }
            // Where only the quality changed, it changed now.
            let received = reading.at.filter(|at| told.is_none_or(|told| *at > told.at));
            let at = received.unwrap_or(now.utc);
            let (datum, quality) = (reading.datum, reading.quality);
            let requalified = told.is_none_or(|told| told.quality != quality);
            *told = Some(Told { datum, quality, at });
            changes.push(Change { kept: Kept { metric, at, datum, quality }, requalified });
        }
        changes.sort_by_key(|change| change.kept.at);
        changes
    }

    fn send_data(&mut self, place: usize, now: Now, changes: Vec<Change>) {
        let metric = |change: &Change| messages::data(&self.catalogue, &change.kept, change.requalified);
        let metrics: Vec<_> = changes.iter().filter_map(metric).collect();
        if !metrics.is_empty() {
            let batch = self.history.live(place, changes.into_iter().map(|change| change.kept));
            self.push_data(place, now, metrics, batch);
        }
    }

    pub(super) fn has_history(&self) -> bool {
        let born = |origin: usize| self.origins.get(origin).is_some_and(|origin| origin.born);
        self.phase == Phase::Live && self.history.has(born)
    }

    /// After what is live, at its pace.
    pub(super) fn send_history(&mut self, now: Now) {
        if !self.has_history() || !self.queue.is_empty() || now.instant < self.next_history {
            return;
        }
        let origins = &self.origins;
        let born = |origin: usize| origins.get(origin).is_some_and(|origin| origin.born);
        let Some(batch) = self.history.take(HISTORY_BATCH, born) else { return };
        self.next_history = now.instant + HISTORY_PACE;
        let metric = |(_, kept): &(u64, Kept)| messages::historical(&self.catalogue, kept);
        let metrics = batch.values.iter().filter_map(metric).collect();
        self.push_data(batch.origin, now, metrics, batch);
    }

    fn push_data(&mut self, place: usize, now: Now, metrics: Vec<Metric>, batch: Batch) {
        let seq = self.next_seq();
        let payload = messages::numbered(now, seq, metrics);
        let topic = self.topics.data(place);
        if self.push(topic, &payload, Some(batch)).is_none() {
            self.seq = self.seq.wrapping_sub(1);
        }
        count(&mut self.report.data);
    }

    /// DDEATH.
    pub(super) fn die(&mut self, place: usize, now: Now) {
        let seq = self.next_seq();
        let payload = messages::numbered(now, seq, Vec::new());
        let topic = self.topics.death(place);
        self.push(topic, &payload, None);
        if let Some(origin) = self.origins.get_mut(place) {
            origin.born = false;
        }
    }

    pub(super) fn next_seq(&mut self) -> u8 {
        let seq = self.seq;
        self.seq = seq.wrapping_add(1);
        seq
    }
}
