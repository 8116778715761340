//! What the broker was told last, pure: whether there is news, and when it is due.

use crate::mapping::{NodeDef, TagTable};
use crate::process_image::{AlarmStatus, NmtState, Value};
use crate::time::Instant;

/// What was last published of a node.
#[derive(Clone, Debug, Default)]
pub(super) struct NodeState {
    /// When its state was last published; `None` = publish now.
    pub(super) published: Option<Instant>,
    /// Something changed since.
    pub(super) dirty: bool,
    /// Its `fast_while` tag is true.
    pub(super) fast: bool,
    pub(super) nmt: Option<NmtState>,
    /// Online, and the reason if not; `None` before the first.
    pub(super) availability: Option<(bool, String)>,
    /// Of the last state message.
    pub(super) seq: u64,
}

impl NodeState {
    /// When its state is to be published.
    pub(super) fn due(&self, def: &NodeDef) -> Instant {
        let Some(published) = self.published else { return Instant::START };
        let publish = &def.publish;
        let interval = match (self.dirty, self.fast) {
            (true, true) => publish.fast_interval,
            (true, false) => publish.min_interval,
            (false, _) => publish.max_interval,
        };
        published + interval.min(publish.max_interval)
    }
}

/// Of each tag: whether it is published, or tells whether a published one means anything or is doubtful.
pub(super) fn watched(table: &TagTable) -> Vec<bool> {
    let mut watched: Vec<bool> = table.tags.iter().map(|tag| tag.published).collect();
    let published = table.tags.iter().filter(|tag| tag.published);
    for validity in published.flat_map(|tag| tag.valid.into_iter().chain(tag.doubtful)) {
        if let Some(watched) = watched.get_mut(validity.0) {
            *watched = true;
        }
    }
    watched
}

/// Whether two reports of an alarm say the same; a value that is no number equals itself here.
pub(super) fn is_same_alarm(told: &AlarmStatus, now: &AlarmStatus) -> bool {
    let same_value = match (told.value, now.value) {
        (Some(told), Some(now)) => !differs(told, now, 0.0),
        (told, now) => told.is_none() && now.is_none(),
    };
    same_value
        && (told.state, told.since, told.count, told.first_out)
            == (now.state, now.since, now.count, now.first_out)
}

/// Whether a value moved by its deadband or more; by anything at all where there is none.
pub(super) fn differs(told: Value, now: Value, deadband: f64) -> bool {
    let moved = (now.as_f64() - told.as_f64()).abs();
    if moved.is_nan() {
        // One of the two is no number: a difference, unless neither is.
        return told.as_f64().is_nan() != now.as_f64().is_nan();
    }
    moved > 0.0 && moved >= deadband
}
