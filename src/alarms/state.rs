//! The state machine of one alarm (ISA-18.2, IEC 62682).
//!
//! Underneath is what an operator has to deal with: one of the six states from normal to latched acknowledged. Over it
//! lies a reason to keep quiet: suppressed. An alarm that is kept quiet still follows its condition, but is not raised.
//! When nothing keeps it quiet any more it is raised at once if its condition holds; if not, it shows what it remembers
//! from before: an alarm that nobody acknowledged still waits for that, a latched one for its reset.
//!
//! Suppression shows only where there is something to suppress: a normal alarm whose cause is active stays normal, so
//! that one cause does not move every alarm of a plant.
//!
//! The standard's other reasons, shelving and taking out of service, are an operator's; nothing asks for them here.

use crate::process_image::AlarmState;

/// What can happen to an alarm. The condition's delays have passed already.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum AlarmEvent {
    /// Its condition holds.
    On,
    /// Its condition has gone.
    Off,
    /// An operator has seen it.
    Acknowledge,
    /// An operator resets it after the cause was mended.
    Reset,
    /// Another alarm tells the cause.
    Suppress,
    /// The cause has gone.
    Unsuppress,
}

impl AlarmEvent {
    /// All of them.
    pub const ALL: [Self; 6] =
        [Self::On, Self::Off, Self::Acknowledge, Self::Reset, Self::Suppress, Self::Unsuppress];
}

/// One alarm.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct AlarmMachine {
    latch: bool,
    holds: bool,
    /// What would show if nothing kept it quiet: normal to latched acknowledged.
    annunciated: AlarmState,
    suppressed: bool,
}

impl AlarmMachine {
    /// Normal. `latch`: stays active after its condition has gone, until it is acknowledged and then reset.
    #[must_use]
    pub const fn new(latch: bool) -> Self {
        Self { latch, holds: false, annunciated: AlarmState::Normal, suppressed: false }
    }

    /// The state that shows.
    #[must_use]
    pub fn state(&self) -> AlarmState {
        if self.suppressed && (self.holds || self.annunciated != AlarmState::Normal) {
            AlarmState::Suppressed
        } else {
            self.annunciated
        }
    }

    /// Whether it tells the cause of others: its condition holds, delays included, whatever an operator did about it.
    #[must_use]
    pub fn suppresses_others(&self) -> bool {
        self.holds
    }

    /// Takes an event. `false`: it means nothing in this state, as an acknowledgement where nothing waits for one.
    pub fn handle(&mut self, event: AlarmEvent) -> bool {
        match event {
            AlarmEvent::On => {
                let rises = !std::mem::replace(&mut self.holds, true);
                if rises {
                    self.raise();
                }
                rises
            }
            AlarmEvent::Off => {
                let falls = std::mem::take(&mut self.holds);
                if falls {
                    self.annunciated = without_condition(self.annunciated, self.latch);
                }
                falls
            }
            AlarmEvent::Acknowledge => self.answer(acknowledged),
            AlarmEvent::Reset => self.answer(reset),
            AlarmEvent::Suppress => !std::mem::replace(&mut self.suppressed, true),
            AlarmEvent::Unsuppress => {
                let suppressed = std::mem::take(&mut self.suppressed);
                if suppressed && self.holds {
                    // Also if it was acknowledged before: what happened meanwhile nobody was told.
                    self.raise();
                }
                suppressed
            }
        }
    }

    fn raise(&mut self) {
        if !self.suppressed {
            self.annunciated = AlarmState::Unacknowledged;
        }
    }

    /// An operator's answer counts only for what the operator can see.
    fn answer(&mut self, step: fn(AlarmState) -> Option<AlarmState>) -> bool {
        let next = step(self.annunciated).filter(|_| !self.suppressed);
        if let Some(next) = next {
            self.annunciated = next;
        }
        next.is_some()
    }
}

/// The condition goes.
fn without_condition(state: AlarmState, latch: bool) -> AlarmState {
    match state {
        AlarmState::Unacknowledged if latch => AlarmState::LatchedUnacknowledged,
        AlarmState::Unacknowledged => AlarmState::ReturnedUnacknowledged,
        AlarmState::Acknowledged if latch => AlarmState::LatchedAcknowledged,
        AlarmState::Acknowledged => AlarmState::Normal,
        AlarmState::Normal
        | AlarmState::ReturnedUnacknowledged
        | AlarmState::LatchedUnacknowledged
        | AlarmState::LatchedAcknowledged
        | AlarmState::Shelved
        | AlarmState::Suppressed
        | AlarmState::OutOfService => state,
    }
}

/// An operator acknowledges; `None` where nothing waits for it.
fn acknowledged(state: AlarmState) -> Option<AlarmState> {
    match state {
        AlarmState::Unacknowledged => Some(AlarmState::Acknowledged),
        AlarmState::ReturnedUnacknowledged => Some(AlarmState::Normal),
        AlarmState::LatchedUnacknowledged => Some(AlarmState::LatchedAcknowledged),
        AlarmState::Normal
        | AlarmState::Acknowledged
        | AlarmState::LatchedAcknowledged
        | AlarmState::Shelved
        | AlarmState::Suppressed
        | AlarmState::OutOfService => None,
    }
}

/// An operator resets; `None` where there is nothing to reset, or it has to be acknowledged first.
fn reset(state: AlarmState) -> Option<AlarmState> {
    (state == AlarmState::LatchedAcknowledged).then_some(AlarmState::Normal)
}

#[cfg(test)]
mod tests {
    use super::*;

    use AlarmState::{
        Acknowledged as C, LatchedAcknowledged as F, LatchedUnacknowledged as E, Normal as A,
        ReturnedUnacknowledged as D, Suppressed as H, Unacknowledged as B,
    };

    fn machine(latch: bool, events: &[AlarmEvent]) -> AlarmMachine {
        let mut machine = AlarmMachine::new(latch);
        for event in events {
            assert!(machine.handle(*event), "{event:?}");
        }
        machine
    }

    /// A machine in each state; the suppressed one with a condition that holds.
    fn in_each_state() -> [(AlarmState, AlarmMachine); 7] {
        use AlarmEvent::{Acknowledge, Off, On, Suppress};
        [
            (A, machine(false, &[])),
            (B, machine(false, &[On])),
            (C, machine(false, &[On, Acknowledge])),
            (D, machine(false, &[On, Off])),
            (E, machine(true, &[On, Off])),
            (F, machine(true, &[On, Off, Acknowledge])),
            (H, machine(false, &[On, Suppress])),
        ]
    }

    #[test]
    fn all_42_pairs_of_state_and_event() {
        // on, off, acknowledge, reset, suppress, unsuppress
        let table = [
            (A, [B, A, A, A, A, A]),
            (B, [B, D, C, B, H, B]),
            (C, [C, A, C, C, H, C]),
            (D, [B, D, A, D, H, D]),
            (E, [B, E, F, E, H, E]),
            (F, [B, F, F, A, H, F]),
            (H, [H, H, H, H, H, B]),
        ];
        for ((state, machine), (expected_state, row)) in in_each_state().into_iter().zip(table) {
            assert_eq!((machine.state(), state), (expected_state, expected_state));
            for (event, expected) in AlarmEvent::ALL.into_iter().zip(row) {
                let mut machine = machine;
                machine.handle(event);
                assert_eq!(machine.state(), expected, "{state:?}, {event:?}");
            }
        }
    }

    #[test]
    fn an_event_that_means_nothing_is_refused_and_changes_nothing() {
        for (state, machine) in in_each_state() {
            for event in AlarmEvent::ALL {
                let mut after = machine;
                if !after.handle(event) {
                    assert_eq!(after, machine, "{state:?}, {event:?}");
                }
            }
        }
    }

    #[test]
    fn the_active_states_of_a_latching_alarm() {
        use AlarmEvent::{Acknowledge, Off, On, Reset};
        let mut machine = AlarmMachine::new(true);
        let walk = [(On, B), (Acknowledge, C), (Off, F), (On, B), (Off, E), (Acknowledge, F), (Reset, A)];
        for (event, expected) in walk {
            assert!(machine.handle(event));
            assert_eq!(machine.state(), expected, "{event:?}");
        }
    }

    #[test]
    fn what_came_and_went_while_it_was_suppressed_leaves_nothing() {
        use AlarmEvent::{Off, On, Suppress, Unsuppress};
        for latch in [false, true] {
            assert_eq!(machine(latch, &[Suppress, On, Off, Unsuppress]).state(), A);
        }
    }

    #[test]
    fn what_was_unacknowledged_or_latched_before_is_remembered() {
        use AlarmEvent::{Acknowledge, Off, On, Suppress, Unsuppress};
        assert_eq!(machine(false, &[On, Suppress, Off, Unsuppress]).state(), D);
        assert_eq!(machine(true, &[On, Suppress, Off, Unsuppress]).state(), E);
        assert_eq!(machine(true, &[On, Acknowledge, Suppress, Off, Unsuppress]).state(), F);
        assert_eq!(machine(false, &[On, Acknowledge, Suppress, Off, Unsuppress]).state(), A);
        assert_eq!(machine(false, &[On, Off, Suppress]).state(), H);
    }

    #[test]
    fn what_still_holds_when_suppression_ends_is_raised_at_once() {
        use AlarmEvent::{Acknowledge, On, Suppress, Unsuppress};
        assert_eq!(machine(false, &[Suppress, On]).state(), H);
        assert_eq!(machine(false, &[Suppress, On, Unsuppress]).state(), B);
        assert_eq!(machine(false, &[On, Acknowledge, Suppress, Unsuppress]).state(), B);
    }

    #[test]
    fn a_normal_alarm_does_not_show_that_its_cause_is_active() {
        use AlarmEvent::{Off, On, Suppress};
        assert_eq!(machine(false, &[Suppress]).state(), A);
        assert_eq!(machine(false, &[Suppress, On, Off]).state(), A);
    }
}
