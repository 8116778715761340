//! Which tags can be written, and how.

use super::{Source, TagTable, WriteLimits};
use crate::canopen::Role;
use crate::canopen::object::ObjectId;
use crate::process_image::TagIndex;

/// How a tag is written.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Writing {
    /// In an RPDO.
    Rpdo,
    /// By SDO.
    Object(ObjectId, WriteLimits),
}

/// Why a tag cannot be written, whoever asks.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum ReadOnly {
    /// There is no such tag.
    #[error("there is no such tag")]
    Unknown,
    /// Nothing is sent on its bus.
    #[error("the gateway is passive on this bus: it sends nothing there")]
    Passive,
    /// It stands in an RPDO of a node that is sent none.
    #[error("outputs are not enabled for `{0}`: [node.{0}] outputs = true")]
    Outputs(String),
    /// It is an object of a node with which no SDO is used.
    #[error("the gateway uses no SDO with `{0}`: [node.{0}] configure = false")]
    Sdo(String),
    /// Its value is the device's own.
    #[error("the tag cannot be written: its value comes from the device")]
    Device,
}

impl TagTable {
    /// How a tag is written.
    ///
    /// # Errors
    /// Why it never is.
    pub fn writing(&self, tag: TagIndex) -> Result<Writing, ReadOnly> {
        let def = self.tag(tag).ok_or(ReadOnly::Unknown)?;
        let node = self.node(def.node).ok_or(ReadOnly::Unknown)?;
        let writing = match (&def.source, def.object, def.writable) {
            (Source::Rpdo { .. }, _, _) => Writing::Rpdo,
            (_, Some(object), Some(limits)) => Writing::Object(object, limits),
            (_, _, _) => return Err(ReadOnly::Device),
        };
        if self.buses.get(node.bus.0).is_none_or(|bus| bus.role == Role::Passive) {
            return Err(ReadOnly::Passive);
        }
        if writing == Writing::Rpdo && !node.outputs {
            return Err(ReadOnly::Outputs(node.name.clone()));
        }
        if writing != Writing::Rpdo && node.canopen().is_none_or(|canopen| canopen.sdo.is_none()) {
            return Err(ReadOnly::Sdo(node.name.clone()));
        }
        Ok(writing)
    }
}
