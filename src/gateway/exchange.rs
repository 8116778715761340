//! A running gateway goes on with another tag table.
//!
//! The core is made anew from the new table, and takes over the state of what stays ([`Kept`]): the machine of each node that
//! watches, boots and asks it, its values, counters and alarms; the state of each bus; the journal's numbers. A node that stays notices
//! nothing: its next guard request leaves when it would have left. What does not stay begins as at the start of the program.
//!
//! Nothing here can fail: whatever can, is checked before.

use std::sync::Arc;

use super::Outcome;
use super::bus::Bus;
use super::core::Gateway;
use super::events::Name;
use super::kept::Kept;
use crate::can::BusIndex;
use crate::canopen::NodeId;
use crate::mapping::{AlarmOwner, BuiltIn, TagTable};
use crate::process_image::{NodeIndex, ProcessImage, Revision};
use crate::time::Now;

impl Gateway {
    /// Says goodbye to what does not stay: modules whose watchdog was set going are told so, and whoever waits for an answer of a
    /// node gets one. What is to be sent by that is to be taken before [`exchange`](Self::exchange).
    pub fn prepare_exchange(&mut self, now: Now, table: &TagTable, kept: &Kept) {
        for old in (0..self.buses.len()).map(BusIndex) {
            let new = kept.buses.iter().position(|from| *from == Some(old)).map(BusIndex);
            if new.is_some_and(|new| kept.keeps_modules(&self.table, table, new)) {
                continue;
            }
            if let Some(bus) = self.buses.get_mut(old.0) {
                bus.modules.handle_stop(now);
            }
            self.drain_modules(now, old);
        }
        self.break_off_sends(now, |line| kept.new_line(line).is_none(), &gone());
        self.break_off_transfers(now, |node| !kept.has_node(node), &gone());
        self.events.flush(now);
        self.settle(now);
    }

    /// The same gateway with another table, and the image for its readers: what `old` showed of what stays.
    #[must_use]
    pub fn exchange(
        self,
        table: Arc<TagTable>,
        kept: &Kept,
        now: Now,
        old: &ProcessImage,
    ) -> (Self, ProcessImage) {
        let mut new = Self::bare(table, now);
        new.take_over(self, kept, now);
        new.events.record(now, AlarmOwner::Gateway, Name::Word("configuration_loaded"), |event| {
            let stay = kept.nodes.iter().flatten().count();
            event.text = format!("{stay} of {} nodes stay as they are", kept.nodes.len());
        });
        new.begin(now, |node| kept.nodes.get(node.0).is_none_or(Option::is_none));
        let image = new.exchanged_image(kept, old);
        (new, image)
    }

    fn take_over(&mut self, mut old: Self, kept: &Kept, now: Now) {
        self.events.take_over(&old.events);
        self.health = old.health;
        let mut buses: Vec<Option<Bus>> = std::mem::take(&mut old.buses).into_iter().map(Some).collect();
        for (place, from) in kept.buses.iter().enumerate() {
            let Some(from) = *from else { continue };
            let (index, ids) = (BusIndex(place), self.kept_ids(kept, BusIndex(place)));
            let broadcasts = same_broadcasts(&old.table, from, &self.table, index);
            let modules = kept.keeps_modules(&old.table, &self.table, index);
            let before = buses.get_mut(from.0).and_then(Option::take);
            if let Some((bus, before)) = self.buses.get_mut(place).zip(before) {
                bus.take_over(before, now, &ids, broadcasts, modules);
            }
        }
        for (place, from) in kept.nodes.iter().enumerate() {
            if let Some(from) = from
                && let (Some(node), Some(old)) = (self.nodes.get_mut(place), old.nodes.get_mut(from.0))
            {
                std::mem::swap(node, old);
            }
        }
        self.tags.take_over(old.tags, kept, now);
        self.supply.take_over(old.supply, kept);
        self.lines.take_over(old.lines, kept);
        self.conditions.take_over(old.conditions, kept, now);
        self.transfers.take_over(old.transfers, kept);
        self.intruders = old.intruders;
        self.next_look = old.next_look;
        self.next_expiry = old.next_expiry;
        for bus in (0..self.buses.len()).map(BusIndex) {
            if let Some(bus) = self.buses.get_mut(bus.0) {
                bus.network.handle_clock(now, self.health.clock_synchronised);
            }
        }
    }

    /// The ids of the CANopen nodes of a bus that stay.
    fn kept_ids(&self, kept: &Kept, bus: BusIndex) -> Vec<NodeId> {
        let nodes = self.table.nodes.iter().zip(&kept.nodes);
        let stay = nodes.filter(|(def, from)| def.bus == bus && from.is_some());
        stay.filter_map(|(def, _)| Some(def.canopen()?.id)).collect()
    }

    /// What readers see, with the journal, and the streams of the lines that stay.
    fn exchanged_image(&self, kept: &Kept, old: &ProcessImage) -> ProcessImage {
        let mut image = self.empty_image();
        image.revision = Revision(old.revision.0 + 1);
        image.journal = old.journal.clone();
        image.journal.renumber_alarms(|alarm| kept.new_alarm(alarm));
        for (line, from) in image.lines.iter_mut().zip(&kept.lines) {
            if let Some(before) = from.and_then(|from| old.lines.get(from.0)) {
                line.clone_from(before);
            }
        }
        for (alarm, from) in image.alarms.iter_mut().zip(&kept.alarms) {
            if let Some(before) = from.and_then(|from| old.alarms.get(from.0)) {
                *alarm = *before;
            }
        }
        image.mqtt_connected = old.mqtt_connected;
        image.clock_synchronised = old.clock_synchronised;
        image.written_at = old.written_at;
        image
    }

    /// A new configuration was refused, and why; `None`: the one that runs was taken in as it should be (G05).
    pub fn set_configuration_rejected(&mut self, now: Now, why: Option<&str>) {
        if let Some(why) = why {
            self.events.record(now, AlarmOwner::Gateway, Name::Word("configuration_rejected"), |event| {
                why.clone_into(&mut event.text);
            });
        }
        self.conditions.set(now, AlarmOwner::Gateway, BuiltIn::ConfigurationRejected, why.is_some());
        self.settle(now);
    }

    /// A new configuration was taken in that did not concern the core.
    pub fn configuration_loaded(&mut self, now: Now, text: &str) {
        self.events.record(now, AlarmOwner::Gateway, Name::Word("configuration_loaded"), |event| {
            text.clone_into(&mut event.text);
        });
        self.settle(now);
    }

    /// The events after `told` are numbered on where a stream on disk ended, `newest`, where that is longer; those before as it
    /// comes. All are in the journal of `image` by then.
    pub fn number_events_after(&mut self, told: u64, newest: u64, image: &mut ProcessImage) {
        self.publish(image);
        let by = newest.saturating_sub(told);
        self.events.number_higher(by);
        image.journal.number_higher(by);
    }

    /// Nodes that are `new` show what is known of them; networks are asked what they want to say.
    pub(super) fn begin(&mut self, now: Now, new: impl Fn(NodeIndex) -> bool) {
        for (place, node) in self.nodes.iter_mut().enumerate() {
            node.status.data_good = self.tags.all_good(NodeIndex(place));
        }
        for node in (0..self.nodes.len()).map(NodeIndex).filter(|node| new(*node)) {
            self.show_module_lines((now, node));
        }
        for bus in 0..self.buses.len() {
            self.drain_network(now, BusIndex(bus));
            self.refresh_nodes_of(now, BusIndex(bus));
        }
        self.settle(now);
    }
}

/// What whoever waits for a node that does not stay is told.
fn gone() -> Outcome {
    Outcome::Failed("the configuration of the node was changed meanwhile".to_owned())
}

/// Whether what is sent to everybody by the clock stays as it is.
fn same_broadcasts(old: &TagTable, from: BusIndex, new: &TagTable, to: BusIndex) -> bool {
    let of = |table: &TagTable, bus: BusIndex| {
        table.buses.get(bus.0).map(|bus| (bus.sync, bus.time, bus.own_heartbeat))
    };
    of(old, from) == of(new, to)
}

impl Bus {
    /// Goes on where `old` stood: `ids` are the CANopen nodes that stay.
    fn take_over(&mut self, old: Self, now: Now, ids: &[NodeId], broadcasts: bool, modules: bool) {
        let up = old.is_up();
        self.network.take_over(old.network, now, ids, broadcasts);
        if modules {
            self.modules = old.modules;
        } else if up {
            self.modules.handle_link(now, true);
        }
        self.status = old.status;
        self.link = old.link;
        (self.heard_at, self.ever_heard, self.silent) = (old.heard_at, old.ever_heard, old.silent);
        self.look_at = old.heard_at + self.shortest_silence;
        self.back_at = old.back_at;
        (self.counters, self.counted_at) = (old.counters, old.counted_at);
        (self.refused, self.foreign) = (old.refused, old.foreign);
    }
}
