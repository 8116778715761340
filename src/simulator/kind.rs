//! The closed list of devices that can be simulated. Whoever adds one begins here. Pure.

use super::detcon::{self, DetconSettings, SimulatedDetcon};
use super::device::{Device, DevicePlan};
use super::dst_p92c::{self, DstSettings, SimulatedDst};
use super::order;
use super::scenario::Shipped;
use super::slave;
use crate::time::Now;

/// A kind of device.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Kind {
    /// MOTORTECH DetCon detonation controller.
    Detcon,
    /// Danfoss DST P92C pressure transmitter.
    DstP92c,
}

/// What a device of each kind is like: the `[device]` table of its scenario.
#[derive(Clone, Debug, PartialEq)]
pub enum Settings {
    /// Of a DetCon.
    Detcon(DetconSettings),
    /// Of a DST P92C.
    DstP92c(Box<DstSettings>),
}

impl Kind {
    /// All kinds.
    pub const ALL: [Self; 2] = [Self::Detcon, Self::DstP92c];

    /// The word on the command line.
    #[must_use]
    pub const fn word(self) -> &'static str {
        match self {
            Self::Detcon => "detcon",
            Self::DstP92c => "dst-p92c",
        }
    }

    /// The scenarios that come with the program; each kind has one of the name `quiet`.
    #[must_use]
    pub const fn shipped(self) -> &'static [Shipped] {
        match self {
            Self::Detcon => &detcon::SCENARIOS,
            Self::DstP92c => &dst_p92c::SCENARIOS,
        }
    }

    /// What can be ordered, for people.
    #[must_use]
    pub fn help(self) -> String {
        let own = match self {
            Self::Detcon => detcon::control::HELP,
            Self::DstP92c => dst_p92c::action::HELP,
        };
        [own, slave::HELP, order::HELP].join("\n")
    }

    /// The order that ends another, for a step of a scenario that lasts for a time; `None` where it does not last.
    pub(super) fn undo(self, words: &[&str]) -> Option<String> {
        match self {
            Self::Detcon => detcon::control::undo(words),
            Self::DstP92c => dst_p92c::action::undo(words),
        }
    }
}

impl Settings {
    /// Of which kind.
    #[must_use]
    pub const fn kind(&self) -> Kind {
        match self {
            Self::Detcon(_) => Kind::Detcon,
            Self::DstP92c(_) => Kind::DstP92c,
        }
    }

    /// Whether a device that is like this would take this order; otherwise the reason why not.
    pub(super) fn check(&self, words: &[&str]) -> Result<(), String> {
        match self {
            Self::Detcon(settings) => detcon::control::check(settings, words).map(drop),
            Self::DstP92c(_) => dst_p92c::action::parse(words).map(drop),
        }
    }
}

impl DevicePlan {
    /// Powers the device on at `now`.
    #[must_use]
    pub fn power_on(&self, now: Now) -> Box<dyn Device> {
        match &self.scenario.settings {
            Settings::Detcon(settings) => Box::new(SimulatedDetcon::power_on(self, settings, now)),
            Settings::DstP92c(settings) => Box::new(SimulatedDst::power_on(self, settings, now)),
        }
    }
}
