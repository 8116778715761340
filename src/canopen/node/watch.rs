//! How the life of a node is watched: by asking, by listening, or not at all.

use std::time::Duration;

use super::super::guarding::Guarding;
use super::super::heartbeat::Heartbeat;
use super::super::{ErrorControl, Role};
use crate::time::Instant;

/// How the life of the node is watched.
#[derive(Debug)]
pub(in crate::canopen) enum Watch {
    /// By asking.
    Guarding(Guarding),
    /// By listening.
    Heartbeat(Heartbeat),
    /// Not at all.
    Nothing,
}

impl Watch {
    /// `phase`: wait before the first guard request.
    pub(super) fn new(control: ErrorControl, role: Role, phase: Duration, now: Instant) -> Self {
        match (control, role) {
            (ErrorControl::Guarding(settings), _) if settings.guard_time.is_zero() => Self::Nothing,
            (ErrorControl::Guarding(settings), Role::Master) => {
                Self::Guarding(Guarding::new(settings, phase, now))
            }
            (ErrorControl::Guarding(settings), Role::Passive) => {
                let life_time = settings.guard_time.saturating_mul(settings.life_time_factor.max(1).into());
                Self::Heartbeat(Heartbeat::after_first_frame(life_time + settings.reply_timeout))
            }
            (ErrorControl::Heartbeat { timeout }, Role::Master) => {
                Self::Heartbeat(Heartbeat::new(timeout, now))
            }
            (ErrorControl::Heartbeat { timeout }, Role::Passive) => {
                Self::Heartbeat(Heartbeat::after_first_frame(timeout))
            }
            (ErrorControl::None, _) => Self::Nothing,
        }
    }

    /// Whether the node is lost.
    pub(in crate::canopen) fn is_lost(&self) -> bool {
        match self {
            Self::Guarding(guarding) => guarding.is_lost(),
            Self::Heartbeat(heartbeat) => heartbeat.is_lost(),
            Self::Nothing => false,
        }
    }

    /// The guard machine, where there is one.
    pub(in crate::canopen) fn guarding(&mut self) -> Option<&mut Guarding> {
        match self {
            Self::Guarding(guarding) => Some(guarding),
            Self::Heartbeat(_) | Self::Nothing => None,
        }
    }
}
