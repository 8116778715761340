//! The edge node goes on with another tag table, in the session that it has. Pure.
//!
//! Devices that are no more, and those that begin anew, die; then all is born again, with the number of the session (bdSeq) that
//! the last will bears. Values that were kept stay where their metric does.

use std::collections::BTreeMap;

use super::super::history::{Batch, Kept};
use super::super::host::PrimaryHost;
use super::{EdgeNode, Phase};
use crate::process_image::NodeIndex;
use crate::time::Now;

/// Where each metric of the table before stands now, with its origin.
type Places = BTreeMap<usize, (usize, usize)>;

impl EdgeNode {
    /// Goes on as `next`. `nodes`: for each node there its place in the table before, where it goes on as it is.
    pub fn exchange(&mut self, now: Now, next: Self, nodes: &[Option<NodeIndex>]) {
        if matches!(self.phase, Phase::Births(_) | Phase::Live) {
            for origin in 1..self.origins.len() {
                let goes_on = nodes.contains(&Some(NodeIndex(origin - 1)));
                if !goes_on && self.origins.get(origin).is_some_and(|origin| origin.born) {
                    self.die(origin, now);
                }
            }
        }
        let old = std::mem::replace(self, next);
        let places = places(&old, self);
        let place = |_, kept: Kept| {
            let (origin, metric) = *places.get(&kept.metric)?;
            Some((origin, Kept { metric, ..kept }))
        };
        let batch = |batch: Batch| {
            let mut values = batch.values.into_iter();
            let moved: Vec<_> = values
                .by_ref()
                .filter_map(|(number, kept)| {
                    place(batch.origin, kept).map(|(origin, kept)| (origin, (number, kept)))
                })
                .collect();
            let origin = moved.first()?.0;
            Some(Batch { origin, values: moved.into_iter().map(|(_, value)| value).collect(), ..batch })
        };
        self.history.go_on_from(old.history, place);
        self.queue = old.queue.into_iter().map(|(packet, values)| (packet, values.and_then(batch))).collect();
        self.under_way =
            old.under_way.into_iter().filter_map(|(id, values)| Some((id, batch(values)?))).collect();
        for (before, (_, metric)) in &places {
            if let (Some(told), Some(before)) = (self.told.get_mut(*metric), old.told.get(*before)) {
                *told = *before;
            }
        }
        let topic = |host: &Option<PrimaryHost>| host.as_ref().map(|host| host.topic().to_owned());
        if topic(&old.host) == topic(&self.host) {
            self.host = old.host;
        }
        self.phase = match old.phase {
            Phase::Births(_) | Phase::Live => Phase::Births(0),
            phase @ (Phase::Down | Phase::Waiting | Phase::Dead) => phase,
        };
        (self.bd_seq, self.seq, self.next_id) = (old.bd_seq, old.seq, old.next_id);
        (self.next_history, self.report) = (old.next_history, old.report);
        (self.farewell, self.farewell_sent) = (old.farewell, old.farewell_sent);
    }
}

/// By names: a metric of the same name at the node of the same name is the same.
fn places(old: &EdgeNode, new: &EdgeNode) -> Places {
    let mut places = Places::new();
    for origin in 0..new.catalogue.origins() {
        let before = match origin.checked_sub(1) {
            None => Some(0),
            Some(node) => {
                let name = new.table.nodes.get(node).map(|node| node.name.as_str());
                name.and_then(|name| old.table.find_node(name)).map(|node| node.0 + 1)
            }
        };
        let Some(before) = before else { continue };
        let name = |catalogue: &super::Catalogue, metric| {
            catalogue.metric(metric).map(|metric| metric.name.clone()).unwrap_or_default()
        };
        let known: BTreeMap<String, usize> =
            old.catalogue.of(before).map(|metric| (name(&old.catalogue, metric), metric)).collect();
        for metric in new.catalogue.of(origin) {
            if let Some(before) = known.get(&name(&new.catalogue, metric)) {
                places.insert(*before, (origin, metric));
            }
        }
    }
    places
}
