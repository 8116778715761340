//! Stories that a device tells by itself: what happens when, once or again and again. Pure.
//!
//! `docs/simulator.md` teaches the file format; `scenario_file` reads it.

use std::time::Duration;

use super::control::Control;
use super::detcon::DetconSettings;
use crate::time::Instant;

/// A device and its story.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Scenario {
    /// One sentence.
    pub description: String,
    /// Cylinders of the engine, 0..=20.
    pub cylinders: u8,
    /// What the device is like.
    pub settings: DetconSettings,
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
    /// What.
    pub control: Control,
}

/// Scenarios that come with the program: name and text.
pub const SHIPPED: [(&str, &str); 11] = [
    ("quiet", include_str!("scenarios/quiet.toml")),
    ("knock_cylinder_7", include_str!("scenarios/knock_cylinder_7.toml")),
    ("trip", include_str!("scenarios/trip.toml")),
    ("bad_sensor", include_str!("scenarios/bad_sensor.toml")),
    ("power_cycle", include_str!("scenarios/power_cycle.toml")),
    ("mute_guarding", include_str!("scenarios/mute_guarding.toml")),
    ("mute_pdos", include_str!("scenarios/mute_pdos.toml")),
    ("stuck_toggle", include_str!("scenarios/stuck_toggle.toml")),
    ("wrong_length", include_str!("scenarios/wrong_length.toml")),
    ("second_master", include_str!("scenarios/second_master.toml")),
    ("demo", include_str!("scenarios/demo.toml")),
];

impl Scenario {
    /// A scenario that comes with the program, by its name; `None` when there is none of that name.
    #[must_use]
    pub fn shipped(name: &str) -> Option<Self> {
        let (name, text) = SHIPPED.iter().find(|(shipped, _)| *shipped == name)?;
        Self::parse(&format!("{name}.toml"), text).ok()
    }
}

/// Tells a story: gives each control when it is due.
#[derive(Clone, Debug, Default)]
pub struct Player {
    pending: Vec<Pending>,
}

#[derive(Clone, Debug)]
struct Pending {
    next: Instant,
    every: Option<Duration>,
    control: Control,
}

impl Player {
    /// The story begins at `start`.
    #[must_use]
    pub fn new(scenario: &Scenario, start: Instant) -> Self {
        let pending = |event: &Event| Pending {
            next: start + event.at,
            every: event.every.filter(|every| !every.is_zero()),
            control: event.control,
        };
        Self { pending: scenario.events.iter().map(pending).collect() }
    }

    /// When the next control is due.
    #[must_use]
    pub fn poll_timeout(&self) -> Option<Instant> {
        self.pending.iter().map(|pending| pending.next).min()
    }

    /// What is due, in the order of time and, at the same time, of the file; call until `None`. Repetitions that a late
    /// call has missed are left out.
    pub fn poll(&mut self, now: Instant) -> Option<Control> {
        let due = self.pending.iter().enumerate().filter(|(_, pending)| pending.next <= now);
        let (at, _) = due.min_by_key(|(_, pending)| pending.next)?;
        let pending = self.pending.get_mut(at)?;
        let control = pending.control;
        if let Some(every) = pending.every {
            let missed = now.since(pending.next).as_micros() / every.as_micros().max(1);
            pending.next = pending.next + every * u32::try_from(missed + 1).unwrap_or(u32::MAX);
        } else {
            self.pending.remove(at);
        }
        Some(control)
    }
}

#[cfg(test)]
#[path = "scenario_tests.rs"]
mod tests;
