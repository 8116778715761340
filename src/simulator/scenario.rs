//! Stories that a device tells by itself: what happens when, once or again and again. Pure.
//!
//! `docs/simulator.md` teaches the file format; `scenario_file` reads it.

use std::time::Duration;

use super::kind::{Kind, Settings};
use crate::time::Instant;

/// A device and its story.
#[derive(Clone, Debug, PartialEq)]
pub struct Scenario {
    /// One sentence.
    pub description: String,
    /// What the device is like.
    pub settings: Settings,
    /// What happens.
    pub events: Vec<Event>,
}

/// Something that happens.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Event {
    /// After the begin of the story.
    pub at: Duration,
    /// And again after this long; never zero.
    pub every: Option<Duration>,
    /// What is ordered then, in the words of the control line.
    pub order: String,
}

/// A scenario that comes with the program: name and text.
pub type Shipped = (&'static str, &'static str);

impl Scenario {
    /// A scenario that comes with the program, by its name; `None` when there is none of that name.
    #[must_use]
    pub fn shipped(kind: Kind, name: &str) -> Option<Self> {
        let (name, text) = kind.shipped().iter().find(|(shipped, _)| *shipped == name)?;
        Self::parse(kind, &format!("{name}.toml"), text).ok()
    }
}

/// Tells a story: gives each order when it is due.
#[derive(Clone, Debug, Default)]
pub struct Player {
    pending: Vec<Pending>,
}

#[derive(Clone, Debug)]
struct Pending {
    next: Instant,
    every: Option<Duration>,
    order: String,
}

impl Player {
    /// The story begins at `start`.
    #[must_use]
    pub fn new(scenario: &Scenario, start: Instant) -> Self {
        let pending = |event: &Event| Pending {
            next: start + event.at,
            every: event.every.filter(|every| !every.is_zero()),
            order: event.order.clone(),
        };
        Self { pending: scenario.events.iter().map(pending).collect() }
    }

    /// When the next order is due.
    #[must_use]
    pub fn poll_timeout(&self) -> Option<Instant> {
        self.pending.iter().map(|pending| pending.next).min()
    }

    /// What is due, in the order of time and, at the same time, of the file; call until `None`. Repetitions that a late
    /// call has missed are left out.
    pub fn poll(&mut self, now: Instant) -> Option<String> {
        let due = self.pending.iter().enumerate().filter(|(_, pending)| pending.next <= now);
        let (at, _) = due.min_by_key(|(_, pending)| pending.next)?;
        let pending = self.pending.get_mut(at)?;
        let Some(every) = pending.every else { return Some(self.pending.remove(at).order) };
        let missed = now.since(pending.next).as_micros() / every.as_micros().max(1);
        pending.next = pending.next + every * u32::try_from(missed + 1).unwrap_or(u32::MAX);
        Some(pending.order.clone())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::simulator::detcon::DetconSettings;

    #[test]
    fn a_story_that_is_told_late_leaves_repetitions_out() {
        let event = |at, order: &str| Event {
            at: Duration::from_millis(at),
            every: Some(Duration::from_millis(1000)),
            order: order.to_owned(),
        };
        let scenario = Scenario {
            description: String::new(),
            settings: Settings::Detcon(DetconSettings::default()),
            events: vec![event(200, "power on"), event(100, "power off")],
        };
        let mut player = Player::new(&scenario, Instant::START);
        assert_eq!(player.poll_timeout(), Some(Instant::from_millis(100)));
        let told: Vec<_> = std::iter::from_fn(|| player.poll(Instant::from_millis(5150))).collect();
        assert_eq!(told, ["power off", "power on"]);
        assert_eq!(player.poll_timeout(), Some(Instant::from_millis(5200)));
    }
}
