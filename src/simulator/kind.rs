//! The closed list of devices that can be simulated. Whoever adds one begins here. Pure.

use super::cbm_sio::{self, Model, SimulatedSio, SioSettings};
use super::detcon::{self, DetconSettings, SimulatedDetcon};
use super::device::{Device, DevicePlan};
use super::dst_p92c::{self, DstSettings, SimulatedDst};
use super::order;
use super::scenario::Shipped;
use super::slave;
use crate::canopen::NodeId;
use crate::time::Now;

/// A kind of device.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Kind {
    /// MOTORTECH DetCon detonation controller.
    Detcon,
    /// Danfoss DST P92C pressure transmitter.
    DstP92c,
    /// esd CAN-CBM-SIO1, a serial line behind CAN.
    CbmSio1,
    /// esd CAN-CBM-SIO4, five serial lines behind CAN.
    CbmSio4,
}

/// What a device of each kind is like: the `[device]` table of its scenario.
#[derive(Clone, Debug, PartialEq)]
pub enum Settings {
    /// Of a DetCon.
    Detcon(DetconSettings),
    /// Of a DST P92C.
    DstP92c(Box<DstSettings>),
    /// Of either esd module.
    CbmSio(Box<SioSettings>),
}

impl Kind {
    /// All kinds.
    pub const ALL: [Self; 4] = [Self::Detcon, Self::DstP92c, Self::CbmSio1, Self::CbmSio4];

    /// The word on the command line.
    #[must_use]
    pub const fn word(self) -> &'static str {
        match self {
            Self::Detcon => "detcon",
            Self::DstP92c => "dst-p92c",
            Self::CbmSio1 => "cbm-sio1",
            Self::CbmSio4 => "cbm-sio4",
        }
    }

    /// The scenarios that come with the program; each kind has one of the name `quiet`.
    #[must_use]
    pub const fn shipped(self) -> &'static [Shipped] {
        match self {
            Self::Detcon => &detcon::SCENARIOS,
            Self::DstP92c => &dst_p92c::SCENARIOS,
            Self::CbmSio1 => &cbm_sio::SIO1_SCENARIOS,
            Self::CbmSio4 => &cbm_sio::SIO4_SCENARIOS,
        }
    }

    /// What can be ordered, for people.
    #[must_use]
    pub fn help(self) -> String {
        match self {
            Self::Detcon => [detcon::control::HELP, slave::HELP, order::HELP].join("\n"),
            Self::DstP92c => [dst_p92c::action::HELP, slave::HELP, order::HELP].join("\n"),
            Self::CbmSio1 | Self::CbmSio4 => [cbm_sio::action::HELP, order::HELP].join("\n"),
        }
    }

    /// The order that ends another, for a step of a scenario that lasts for a time; `None` where it does not last.
    pub(super) fn undo(self, words: &[&str]) -> Option<String> {
        match self {
            Self::Detcon => detcon::control::undo(words),
            Self::DstP92c => dst_p92c::action::undo(words),
            Self::CbmSio1 | Self::CbmSio4 => cbm_sio::action::undo(words),
        }
    }

    /// The highest number that such a device can have; the lowest is 1.
    #[must_use]
    pub const fn highest_number(self) -> u8 {
        match self {
            Self::Detcon | Self::DstP92c => NodeId::HIGHEST.get(),
            Self::CbmSio1 => Model::Sio1.highest_switch(),
            Self::CbmSio4 => Model::Sio4.highest_switch(),
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
            Self::CbmSio(settings) => match settings.model {
                Model::Sio1 => Kind::CbmSio1,
                Model::Sio4 => Kind::CbmSio4,
            },
        }
    }

    /// Whether a device that is like this would take this order; otherwise the reason why not.
    pub(super) fn check(&self, words: &[&str]) -> Result<(), String> {
        match self {
            Self::Detcon(settings) => detcon::control::check(settings, words).map(drop),
            Self::DstP92c(_) => dst_p92c::action::parse(words).map(drop),
            Self::CbmSio(settings) => cbm_sio::action::check(settings, words).map(drop),
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
            Settings::CbmSio(settings) => Box::new(SimulatedSio::power_on(self, settings, now)),
        }
    }
}
