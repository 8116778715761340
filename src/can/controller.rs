//! The state of a controller, put together from error frames, from what the host says and from received frames. Pure.
//!
//! Error frames come at once but not from every driver, and a vcan never sends them by itself; the host knows the
//! truth but is only asked from time to time; a vcan has no controller, so the host knows nothing of its state.

use super::Link;

/// Class bits of an error frame's identifier, `linux/can/error.h`.
mod class {
    pub(super) const TX_TIMEOUT: u32 = 0x001;
    pub(super) const CONTROLLER: u32 = 0x004;
    pub(super) const PROTOCOL: u32 = 0x008;
    pub(super) const TRANSCEIVER: u32 = 0x010;
    pub(super) const NO_ACKNOWLEDGE: u32 = 0x020;
    pub(super) const BUS_OFF: u32 = 0x040;
    pub(super) const BUS_ERROR: u32 = 0x080;
    pub(super) const RESTARTED: u32 = 0x100;
    /// Bytes 6 and 7 hold the error counters.
    pub(super) const COUNTERS: u32 = 0x200;
}

/// Bits of byte 1 of an error frame of class `CONTROLLER`.
mod problem {
    pub(super) const OVERFLOW: u8 = 0x01 | 0x02;
    pub(super) const WARNING: u8 = 0x04 | 0x08;
    pub(super) const PASSIVE: u8 = 0x10 | 0x20;
    pub(super) const ACTIVE: u8 = 0x40;
}

/// An error counter from which a controller is error passive (ISO 11898-1).
const PASSIVE_FROM: u8 = 128;

/// What an error frame says. One frame may say several things at once.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ErrorReport {
    /// The state of the controller, where the frame tells it.
    pub link: Option<Link>,
    /// Something went wrong on the bus or in the controller (not a mere change of state, nor a lost arbitration).
    pub is_error: bool,
}

impl ErrorReport {
    /// From the identifier without its flags, and the data.
    #[must_use]
    pub fn decode(class: u32, data: [u8; 8]) -> Self {
        let has = |bits: u32| class & bits != 0;
        let [_, problems, _, _, _, _, transmit_errors, receive_errors] = data;
        let problems = if has(class::CONTROLLER) { problems } else { 0 };
        let link = if has(class::BUS_OFF) {
            Some(Link::BusOff)
        } else if problems & problem::PASSIVE != 0 {
            Some(Link::ErrorPassive)
        } else if problems & (problem::ACTIVE | problem::WARNING) != 0 || has(class::RESTARTED) {
            Some(Link::ErrorActive)
        } else if has(class::COUNTERS) {
            let passive = transmit_errors.max(receive_errors) >= PASSIVE_FROM;
            Some(if passive { Link::ErrorPassive } else { Link::ErrorActive })
        } else {
            None
        };
        let is_error = problems & problem::OVERFLOW != 0
            || has(class::TX_TIMEOUT
                | class::PROTOCOL
                | class::TRANSCEIVER
                | class::NO_ACKNOWLEDGE
                | class::BUS_ERROR);
        Self { link, is_error }
    }
}

/// What the host says about an interface.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Observation {
    /// The interface is up.
    pub up: bool,
    /// The controller's state, [`Link::ErrorActive`] to [`Link::BusOff`]; `None` where the driver tells none.
    pub controller: Option<Link>,
}

/// The link as far as it is known. Starts as [`Link::Absent`]: nothing is known yet.
///
/// Each `handle_*` returns the new state if it changed.
#[derive(Clone, Copy, Debug, Default)]
pub struct LinkTracker {
    link: Link,
    /// The host tells the controller's state, so received frames need not prove it.
    host_knows: bool,
    /// Counts what error frames and the socket told, to recognise an observation that was made before.
    told: u64,
}

impl LinkTracker {
    /// The present state.
    #[must_use]
    pub fn link(&self) -> Link {
        self.link
    }

    /// To be remembered when the host is asked, and handed back with its answer.
    #[must_use]
    pub fn asked(&self) -> u64 {
        self.told
    }

    /// An error frame came. One that was still queued when the interface went down is no news.
    pub fn handle_error(&mut self, report: ErrorReport) -> Option<Link> {
        let link = report.link?;
        self.told = self.told.wrapping_add(1);
        if self.link == Link::Down { None } else { self.change(link) }
    }

    /// A frame came: the controller takes part in the traffic.
    pub fn handle_frame(&mut self) -> Option<Link> {
        match self.link {
            Link::Absent => self.change(Link::ErrorActive),
            Link::BusOff if !self.host_knows => self.change(Link::ErrorActive),
            Link::BusOff | Link::Down | Link::ErrorActive | Link::ErrorPassive => None,
        }
    }

    /// The host says nothing of the interface: that it could be opened has to do.
    pub fn handle_no_answer(&mut self) -> Option<Link> {
        if self.link == Link::Absent { self.change(Link::ErrorActive) } else { None }
    }

    /// The socket reported that the interface went down.
    pub fn handle_down(&mut self) -> Option<Link> {
        self.told = self.told.wrapping_add(1);
        self.change(Link::Down)
    }

    /// The host answered a question that was asked at [`LinkTracker::asked`].
    pub fn handle_observation(&mut self, asked: u64, observation: Observation) -> Option<Link> {
        if asked != self.told {
            return None;
        }
        self.host_knows = observation.controller.is_some();
        if !observation.up {
            return self.change(Link::Down);
        }
        match (observation.controller, self.link) {
            (Some(link), _) => self.change(link),
            (None, Link::Absent | Link::Down) => self.change(Link::ErrorActive),
            (None, Link::ErrorActive | Link::ErrorPassive | Link::BusOff) => None,
        }
    }

    fn change(&mut self, link: Link) -> Option<Link> {
        if self.link == link {
            return None;
        }
        self.link = link;
        Some(link)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const UP: Observation = Observation { up: true, controller: None };

    fn report(class: u32, data: [u8; 8]) -> ErrorReport {
        ErrorReport::decode(class, data)
    }

    fn up() -> LinkTracker {
        let mut tracker = LinkTracker::default();
        assert_eq!(tracker.handle_observation(0, UP), Some(Link::ErrorActive));
        tracker
    }

    #[test]
    fn each_state_is_read_from_an_error_frame() {
        for (class, data, link) in [
            (0x040, [0; 8], Some(Link::BusOff)),
            (0x004, [0, 0x10, 0, 0, 0, 0, 0, 0], Some(Link::ErrorPassive)),
            (0x004, [0, 0x20, 0, 0, 0, 0, 0, 0], Some(Link::ErrorPassive)),
            (0x004, [0, 0x40, 0, 0, 0, 0, 0, 0], Some(Link::ErrorActive)),
            (0x100, [0; 8], Some(Link::ErrorActive)),
            (0x088, [0; 8], None),
            // Several causes in one frame: what Linux sends since 6.0.
            (0x204, [0, 0x20, 0, 0, 0, 0, 130, 5], Some(Link::ErrorPassive)),
            (0x204, [0, 0x08, 0, 0, 0, 0, 100, 5], Some(Link::ErrorActive)),
            (0x244, [0, 0x20, 0, 0, 0, 0, 255, 0], Some(Link::BusOff)),
            (0x288, [0, 0, 0, 0, 0, 0, 5, 128], Some(Link::ErrorPassive)),
            (0x288, [0, 0, 0, 0, 0, 0, 127, 127], Some(Link::ErrorActive)),
        ] {
            assert_eq!(report(class, data).link, link, "{class:03X} {data:?}");
        }
    }

    #[test]
    fn only_errors_count_as_errors() {
        for class in [0x001, 0x008, 0x010, 0x020, 0x080, 0x0A8] {
            assert!(report(class, [0; 8]).is_error, "{class:03X}");
        }
        assert!(report(0x004, [0, 0x01, 0, 0, 0, 0, 0, 0]).is_error, "receive overflow");
        for class in [0x002, 0x040, 0x100, 0x200] {
            assert!(!report(class, [0xFF; 8]).is_error, "{class:03X}");
        }
        assert!(!report(0x004, [0, 0x20, 0, 0, 0, 0, 0, 0]).is_error, "error passive");
    }

    #[test]
    fn byte_1_counts_only_in_a_controller_frame() {
        assert_eq!(report(0x008, [0, 0x20, 0, 0, 0, 0, 0, 0]).link, None);
    }

    #[test]
    fn a_bus_off_without_a_controller_ends_with_the_next_frame() {
        let mut tracker = up();
        assert_eq!(tracker.handle_error(report(0x040, [0; 8])), Some(Link::BusOff));
        assert_eq!(tracker.handle_observation(tracker.asked(), UP), None);
        assert_eq!(tracker.handle_frame(), Some(Link::ErrorActive));
    }

    #[test]
    fn a_bus_off_of_a_real_controller_ends_when_the_host_says_so() {
        let mut tracker = LinkTracker::default();
        let observed = |controller| Observation { up: true, controller: Some(controller) };
        tracker.handle_observation(0, observed(Link::BusOff));
        assert_eq!(tracker.handle_frame(), None);
        assert_eq!(tracker.handle_observation(0, observed(Link::ErrorActive)), Some(Link::ErrorActive));
    }

    #[test]
    fn a_restart_ends_bus_off() {
        let mut tracker = up();
        tracker.handle_error(report(0x040, [0; 8]));
        assert_eq!(tracker.handle_error(report(0x100, [0; 8])), Some(Link::ErrorActive));
    }

    #[test]
    fn an_answer_of_the_host_that_is_older_than_an_error_frame_is_ignored() {
        let mut tracker = up();
        let asked = tracker.asked();
        tracker.handle_error(report(0x040, [0; 8]));
        let old = Observation { up: true, controller: Some(Link::ErrorActive) };
        assert_eq!(tracker.handle_observation(asked, old), None);
        assert_eq!(tracker.link(), Link::BusOff);
    }

    #[test]
    fn down_is_left_only_when_the_host_says_up() {
        let mut tracker = up();
        assert_eq!(tracker.handle_down(), Some(Link::Down));
        assert_eq!(tracker.handle_frame(), None);
        assert_eq!(tracker.handle_error(report(0x040, [0; 8])), None);
        assert_eq!(tracker.handle_observation(tracker.asked(), UP), Some(Link::ErrorActive));
    }

    #[test]
    fn the_first_frame_proves_that_the_link_is_up() {
        assert_eq!(LinkTracker::default().handle_frame(), Some(Link::ErrorActive));
    }

    #[test]
    fn where_the_host_says_nothing_a_new_bus_works_and_nothing_else_changes() {
        assert_eq!(LinkTracker::default().handle_no_answer(), Some(Link::ErrorActive));
        let mut tracker = up();
        tracker.handle_error(report(0x040, [0; 8]));
        assert_eq!(tracker.handle_no_answer(), None);
        assert_eq!(tracker.link(), Link::BusOff);
        tracker.handle_down();
        assert_eq!(tracker.handle_no_answer(), None);
    }

    proptest! {
        #[test]
        fn every_error_frame_is_decoded(class in 0_u32..0x2000_0000, data in any::<[u8; 8]>()) {
            prop_assert!(report(class, data).link.is_none_or(|link| link >= Link::ErrorActive));
        }
    }
}
