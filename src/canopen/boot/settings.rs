//! What is done with a node before it is started. Plain data.

use std::time::Duration;

use crate::canopen::object::{MappedObject, ObjectId};
use crate::canopen::{PdoIndex, RpdoIndex};

/// How a node is booted.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct BootSettings {
    /// What is done, in this order; empty: nothing, the node may be started at once.
    pub steps: Vec<BootStep>,
    /// A boot that failed begins anew after this long, then after twice as long, and so on.
    pub retry: Duration,
    /// But never more seldom than this.
    pub longest_retry: Duration,
    /// The node starts by itself (0x1F80, R-DST-059): it is put into pre-operational before anything is written, and started
    /// when that is done.
    pub self_starting: bool,
}

impl BootSettings {
    /// What is done with a TPDO, if anything.
    #[must_use]
    pub fn setup_of(&self, pdo: PdoIndex) -> Option<&PdoSetup> {
        self.steps.iter().find_map(|step| match step {
            BootStep::Pdo(setup) if setup.pdo == pdo => Some(setup),
            BootStep::Pdo(_)
            | BootStep::Rpdo(_)
            | BootStep::Identity { .. }
            | BootStep::Read { .. }
            | BootStep::Write { .. }
            | BootStep::Errors
            | BootStep::Save => None,
        })
    }

    /// What is done with an RPDO, if anything.
    #[must_use]
    pub fn setup_of_rpdo(&self, rpdo: RpdoIndex) -> Option<&PdoSetup> {
        self.steps.iter().find_map(|step| match step {
            BootStep::Rpdo(setup) if setup.pdo.0 == rpdo.0 => Some(setup),
            BootStep::Pdo(_)
            | BootStep::Rpdo(_)
            | BootStep::Identity { .. }
            | BootStep::Read { .. }
            | BootStep::Write { .. }
            | BootStep::Errors
            | BootStep::Save => None,
        })
    }

    /// Whether a TPDO is taken as the node has it; then whether its time-out follows from the node's event timer.
    #[must_use]
    pub fn adopts(&self, pdo: PdoIndex) -> Option<bool> {
        match self.setup_of(pdo)?.mode {
            MappingMode::Adopt { timed } => Some(timed),
            MappingMode::Write | MappingMode::Verify => None,
        }
    }

    /// Whether the node is asked what is wrong with it.
    #[must_use]
    pub fn asks_about_errors(&self) -> bool {
        self.steps.contains(&BootStep::Errors)
    }

    /// Whether the node is asked what a TPDO carries.
    #[must_use]
    pub fn asks_about(&self, pdo: PdoIndex) -> bool {
        self.setup_of(pdo).is_some()
    }
}

impl Default for BootSettings {
    fn default() -> Self {
        Self {
            steps: Vec::new(),
            retry: Duration::from_secs(1),
            longest_retry: Duration::from_secs(30),
            self_starting: false,
        }
    }
}

/// One step.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum BootStep {
    /// The object must have this value, else it is another device (0x1000, 0x1018; R-DST-001).
    Identity {
        /// Which.
        object: ObjectId,
        /// Its value.
        expected: u32,
        /// Another device is told, and booted all the same (`check_identity = false`).
        tolerated: bool,
    },
    /// Reads an object and tells its value. That the node does not have it is told too, and no failure.
    Read {
        /// Which.
        object: ObjectId,
    },
    /// Sees to it that an object has this value: reads it, writes it where it differs, and reads it again.
    Write {
        /// Which.
        object: ObjectId,
        /// Its bytes, little-endian.
        data: Vec<u8>,
        /// A node that refuses is started all the same (K-DST-15).
        optional: bool,
    },
    /// Reads the error register (0x1001) and the newest error (0x1003:1) and tells them. That the node refuses to tell one
    /// of them is no failure (R-DST-081). How many errors there are (0x1003:0) is not asked: not every device keeps it.
    Errors,
    /// Reads a TPDO's communication and mapping parameters and tells them; changes them first where it is asked to.
    Pdo(PdoSetup),
    /// The same for an RPDO; its `pdo` is the place among the RPDOs of the node's settings.
    Rpdo(PdoSetup),
    /// Stores all parameters in the node (0x1010:1), if any of the steps before wrote something.
    Save,
}

/// A TPDO, or RPDO, as it should be.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct PdoSetup {
    /// Which, by its place in the node's settings.
    pub pdo: PdoIndex,
    /// Its number, 1..=512: its objects are 0x1800 and 0x1A00, of an RPDO 0x1400 and 0x1600, plus this number less one.
    pub number: u16,
    /// What is done where the node has it otherwise.
    pub mode: MappingMode,
    /// Its content, in order.
    pub maps: Vec<MappedObject>,
    /// Transmission type (sub-index 2); `None`: as it is.
    pub transmission_type: Option<u8>,
    /// Inhibit time in units of 100 us (sub-index 3); `None`: as it is.
    pub inhibit_time: Option<u16>,
    /// Event timer in ms (sub-index 5); `None`: as it is.
    pub event_timer: Option<u16>,
    /// Mark the PDO as not valid (bit 31 of its COB-ID) while its mapping is changed (R-DST-023).
    pub set_invalid: bool,
}

/// What is done where a node has another PDO mapping than the mapping file (R-DST-024).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum MappingMode {
    /// It is changed in the node.
    #[default]
    Write,
    /// It is told, and decoded as the node has it.
    Verify,
    /// Nothing is written: it is decoded as the node has it.
    Adopt {
        /// It has to come within three times its event timer, where the node has that running.
        timed: bool,
    },
}
