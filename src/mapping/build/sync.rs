//! PDOs that go with SYNC.

use std::time::Duration;

use super::super::{At, SourceText};
use super::node::Tpdo;
use super::problems::Problems;
use super::tags::Context;
use crate::canopen::Role;

/// Highest transmission type of a PDO that goes with SYNC.
pub const LAST_SYNCHRONOUS: u64 = 240;

/// How a PDO goes with SYNC.
#[derive(Clone, Copy, Debug, Default)]
pub struct Cycle {
    /// It does.
    pub is_synchronous: bool,
    /// Time between two, where it is known.
    pub period: Option<Duration>,
}

/// How a TPDO goes with SYNC, as far as the files say.
pub fn cycle(problems: &mut Problems, context: &Context<'_>, tpdo: &Tpdo<'_>) -> Cycle {
    let Some((source, at)) = tpdo.transmission_type(context) else { return Cycle::default() };
    if at.value > LAST_SYNCHRONOUS {
        return Cycle::default();
    }
    check(problems, context, (source, at), &format!("TPDO {}", tpdo.number));
    let period = context.bus.as_ref().and_then(|bus| bus.sync).and_then(|sync| sync.period);
    // With type 0 it is sent after a SYNC only when something changed.
    let every = u32::try_from(at.value).ok().filter(|every| *every > 0);
    Cycle { is_synchronous: true, period: period.zip(every).map(|(period, every)| period * every) }
}

/// A PDO that goes with SYNC does not go at all where there is none.
pub fn check(
    problems: &mut Problems,
    context: &Context<'_>,
    (source, at): (&SourceText, &At<u64>),
    what: &str,
) {
    let Some(bus) = &context.bus else { return };
    // In the passive role somebody else rules the bus, and knows.
    if bus.sync.is_none() && bus.role == Role::Master {
        let message = format!(
            "{what} waits for SYNC (transmission type {}), but nobody is known to send it on bus `{}`",
            at.value, bus.name
        );
        let hint = format!(
            "add [bus.{name}.sync] with a `period_ms`, or with `producer = \"other\"` where somebody else sends it; or use \
             transmission type 255",
            name = bus.name
        );
        problems.warning(source, &at.span, message, hint);
    }
}

/// Changes of TPDOs that the mapping does not have.
pub fn check_changes(problems: &mut Problems, context: &Context<'_>) {
    for number in context.entry.tpdo.keys() {
        if !context.tpdos.iter().any(|tpdo| tpdo.key == number) {
            let known = context.tpdos.iter().map(|tpdo| tpdo.key.value.as_str());
            problems.unknown(context.config, &number.span, "TPDO", &number.value, known);
        }
    }
}
