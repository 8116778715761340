//! SYNC, TIME and the own heartbeat of a bus.

use std::time::Duration;

use super::super::installation::{BusEntry, ProducerWord, SyncEntry, TimeEntry};
use super::super::{At, SourceText};
use super::network::restricted;
use super::problems::Problems;
use crate::can::CanId;
use crate::canopen::{NodeId, OwnHeartbeatSettings, Role, SyncSettings, TimeSettings, cob_id};

/// Longest period and window, in us.
const LONGEST: u64 = 60_000_000;

/// What the configuration says of SYNC.
pub fn sync(problems: &mut Problems, config: &SourceText, bus: &BusEntry) -> Option<SyncSettings> {
    let At { value: entry, span } = bus.sync.as_ref()?;
    let produced = entry.producer == ProducerWord::Gateway;
    let is_off = [&entry.period_ms, &entry.period_us].into_iter().flatten().any(|at| at.value == 0);
    let period = period(problems, config, entry);
    if produced && period.is_none() && !is_off {
        let message = "SYNC has no period";
        problems.error(config, span, message, "give it `period_ms`, or `producer = \"other\"`");
    }
    if produced && !is_off && Role::from(bus.role) == Role::Passive {
        let message = "the gateway is passive on this bus, so it sends no SYNC";
        problems.warning(config, span, message, "write `producer = \"other\"`, or leave it out");
    }
    if let Some(counter) = entry.counter.as_ref().filter(|_| !produced) {
        let message = "the gateway does not send SYNC here, so `counter` means nothing";
        problems.error(config, &counter.span, message, "leave it out, or write `producer = \"gateway\"`");
    }
    let overflow = entry.counter.as_ref().filter(|counter| counter.value != 0);
    let overflow = overflow.map(|counter| problems.within(config, counter, "counter", 2..=240));
    let window = entry.window_us.as_ref().filter(|window| window.value != 0);
    let window = window.map(|window| {
        let micros = problems.within(config, window, "window_us", 1..=LONGEST);
        if period.is_some_and(|period| Duration::from_micros(micros) >= period) {
            let message = format!("the window of {micros} us is not shorter than the period of SYNC");
            problems.error(config, &window.span, message, "a TPDO must come before the next SYNC");
        }
        Duration::from_micros(micros)
    });
    let cob_id = identifier(problems, config, entry.cob_id.as_ref(), cob_id::SYNC);
    // A period of 0 is no SYNC, as in 0x1006 (R-ESD-114).
    (!produced || !is_off).then_some(SyncSettings {
        cob_id,
        produced,
        period,
        overflow: overflow.and_then(|overflow| u8::try_from(overflow).ok()),
        window,
    })
}

/// What the configuration says of TIME.
pub fn time(problems: &mut Problems, config: &SourceText, bus: &BusEntry) -> Option<TimeSettings> {
    let At { value: entry, span } = bus.time.as_ref()?;
    let TimeEntry { period_s, cob_id, unsynchronised } = entry;
    if Role::from(bus.role) == Role::Passive {
        let message = "the gateway is passive on this bus, so it sends no TIME";
        problems.warning(config, span, message, "leave it out");
    }
    Some(TimeSettings {
        cob_id: identifier(problems, config, cob_id.as_ref(), cob_id::TIME),
        period: Duration::from_secs(problems.within(config, period_s, "period_s", 1..=86_400)),
        unsynchronised: *unsynchronised,
    })
}

/// What the configuration says of the gateway's own node id and heartbeat.
pub fn own_heartbeat(
    problems: &mut Problems,
    config: &SourceText,
    bus: &BusEntry,
) -> Option<OwnHeartbeatSettings> {
    let node = bus.own_node_id.as_ref().map(|id| problems.within(config, id, "own_node_id", 1..=127));
    let at = bus.own_heartbeat_ms.as_ref()?;
    let millis = problems.within(config, at, "own_heartbeat_ms", 10..=65_535);
    if node.is_none() {
        let message = "a heartbeat needs a node id";
        problems.error(config, &at.span, message, "give the bus `own_node_id` too, one that no device has");
    }
    if Role::from(bus.role) == Role::Passive {
        let message = "the gateway is passive on this bus, so it sends no heartbeat";
        problems.warning(config, &at.span, message, "leave it out");
    }
    let node = NodeId::new(u8::try_from(node?).ok()?)?;
    Some(OwnHeartbeatSettings { node, period: Duration::from_millis(millis) })
}

fn period(problems: &mut Problems, config: &SourceText, entry: &SyncEntry) -> Option<Duration> {
    match (&entry.period_ms, &entry.period_us) {
        (Some(_), Some(micros)) => {
            problems.error(config, &micros.span, "SYNC has two periods", "leave one of them out");
            None
        }
        (Some(At { value: 0, .. }), None) | (None, Some(At { value: 0, .. }) | None) => None,
        (Some(millis), None) => {
            let millis = problems.within(config, millis, "period_ms", 1..=LONGEST / 1_000);
            Some(Duration::from_millis(millis))
        }
        (None, Some(micros)) => {
            Some(Duration::from_micros(problems.within(config, micros, "period_us", 1_000..=LONGEST)))
        }
    }
}

fn identifier(problems: &mut Problems, config: &SourceText, at: Option<&At<u64>>, usual: CanId) -> CanId {
    let Some(at) = at else { return usual };
    let number = problems.within(config, at, "cob_id", 1..=0x1FFF_FFFF);
    let id = match u16::try_from(number).ok().and_then(CanId::standard) {
        Some(id) => Some(id),
        None => u32::try_from(number).ok().and_then(CanId::extended),
    };
    let id = id.unwrap_or(usual);
    if let Some(purpose) = restricted(id) {
        problems.error(config, &at.span, format!("identifier {id} is kept for {purpose}"), "use another one");
    }
    id
}
