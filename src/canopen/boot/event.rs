//! What the boot of a node tells.

use std::time::Duration;

use crate::can::CanId;
use crate::canopen::PdoIndex;
use crate::canopen::object::{MappedObject, ObjectId};
use crate::canopen::sdo::SdoError;

/// Something that the boot of a node found or did.
#[derive(Clone, Debug, PartialEq)]
pub enum BootEvent {
    /// It begins, or begins anew: what was known of the node's configuration is not known any more.
    Begun,
    /// An object was read; `None` where the node refuses to tell it.
    Object {
        /// Which.
        object: ObjectId,
        /// Its bytes, little-endian.
        data: Option<Vec<u8>>,
    },
    /// What is wrong with the node, as it says itself.
    Errors {
        /// The error register; `None` where it refuses to tell it.
        register: Option<u8>,
        /// The code of its newest error; 0 = none, or it refuses to tell it.
        code: u16,
    },
    /// An object was written, because it had another value.
    Wrote {
        /// Which.
        object: ObjectId,
    },
    /// A node refused a value that it may refuse.
    Refused {
        /// Which object.
        object: ObjectId,
        /// Why.
        error: SdoError,
    },
    /// It is another device than the mapping file is for, and that is tolerated.
    OtherDevice(BootFailure),
    /// A TPDO is otherwise than the mapping file says, and stays so.
    Deviation {
        /// Which.
        pdo: PdoIndex,
    },
    /// A TPDO as the node sends it, from now on.
    Mapped(MappedPdo),
    /// An RPDO as the node takes it, from now on; its `pdo` is the place among the RPDOs of the node's settings.
    RpdoMapped(MappedPdo),
    /// All steps are done; the node may be started.
    Done {
        /// Objects that were written.
        written: u32,
    },
    /// It cannot be booted; told once for each cause. It is tried again.
    Failed(BootFailure),
}

/// A TPDO as the node sends it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct MappedPdo {
    /// Which, by its place in the node's settings.
    pub pdo: PdoIndex,
    /// Its identifier; `None` where the node has it switched off (bit 31).
    pub cob_id: Option<CanId>,
    /// Its content, in order.
    pub maps: Vec<MappedObject>,
    /// Transmission type: 0..=240 with SYNC, 254 and 255 by itself.
    pub transmission_type: u8,
    /// Event timer in ms; 0 or absent = off.
    pub event_timer: u16,
}

impl MappedPdo {
    /// Bytes that the content takes, 0..=8.
    #[must_use]
    pub fn length(&self) -> u8 {
        let bits: u32 = self.maps.iter().map(|object| u32::from(object.bits)).sum();
        u8::try_from(bits.div_ceil(8)).unwrap_or(8).min(8)
    }

    /// Within which time it has to come: three event timers (R-DST-050). `None`: it is switched off, or its event timer does
    /// not run.
    #[must_use]
    pub fn timeout(&self) -> Option<Duration> {
        let timed = self.cob_id.is_some() && self.transmission_type >= 254 && self.event_timer > 0;
        timed.then(|| 3 * Duration::from_millis(self.event_timer.into()))
    }
}

/// Why a node cannot be booted. The letters are those of CiA 302-2.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum BootFailure {
    /// B.
    #[error("it does not answer SDO requests (B); is it there, and does it know SDO?")]
    NoAnswer,
    /// C, D, M, N, O: another device than the mapping file is for.
    #[error(
        "it is another device than the mapping is for ({letter}): {object} is 0x{found:08X}, not 0x{expected:08X}"
    )]
    Identity {
        /// Which object differs.
        object: ObjectId,
        /// What the mapping file says.
        expected: u32,
        /// What the node says.
        found: u32,
        /// The letter.
        letter: char,
    },
    /// J: an object could not be read or written.
    #[error("its configuration failed at {object} (J): {error}")]
    Configuration {
        /// Which.
        object: ObjectId,
        /// Why.
        error: SdoError,
    },
    /// J: an object does not keep what is written to it.
    #[error("{object} does not keep the value that was written to it (J)")]
    NotKept {
        /// Which.
        object: ObjectId,
    },
    /// J: an object has another length than its type.
    #[error("{object} has {length} bytes, which cannot be (J)")]
    Length {
        /// Which.
        object: ObjectId,
        /// How many bytes came.
        length: usize,
    },
}
