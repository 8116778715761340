//! What a node speaks.

use crate::canopen::{NodeSettings, PdoSettings, RpdoSettings, boot::BootSettings, polls::Poll};
use crate::esd::ModuleSettings;

/// What a node speaks, and what its manager has to know of it.
#[derive(Clone, Debug, PartialEq)]
pub enum Protocol {
    /// CANopen (CiA 301).
    Canopen(Box<NodeSettings>),
    /// The esd protocol for CAN modules.
    Esd(Box<ModuleSettings>),
}

impl Protocol {
    /// Settings of a CANopen node.
    #[must_use]
    pub fn canopen(&self) -> Option<&NodeSettings> {
        match self {
            Self::Canopen(settings) => Some(settings),
            Self::Esd(_) => None,
        }
    }

    /// Settings of an esd module.
    #[must_use]
    pub fn module(&self) -> Option<&ModuleSettings> {
        match self {
            Self::Esd(settings) => Some(settings),
            Self::Canopen(_) => None,
        }
    }

    /// Node id, or module number.
    #[must_use]
    pub fn number(&self) -> u8 {
        match self {
            Self::Canopen(settings) => settings.id.get(),
            Self::Esd(settings) => settings.number.get(),
        }
    }

    /// TPDOs; a module has none.
    #[must_use]
    pub fn pdos(&self) -> &[PdoSettings] {
        self.canopen().map_or(&[], |settings| &settings.pdos)
    }

    /// RPDOs that it is sent; a module has none.
    #[must_use]
    pub fn rpdos(&self) -> &[RpdoSettings] {
        self.canopen().map_or(&[], |settings| &settings.rpdos)
    }

    /// Objects that are polled; a module has none.
    #[must_use]
    pub fn polls(&self) -> &[Poll] {
        self.canopen().map_or(&[], |settings| &settings.polls)
    }

    /// What is done before it is started; nothing with a module.
    #[must_use]
    pub fn boot(&self) -> Option<&BootSettings> {
        self.canopen().map(|settings| &settings.boot)
    }

    /// Whether its objects can be read by SDO.
    #[must_use]
    pub fn has_sdo(&self) -> bool {
        self.canopen().is_some_and(|settings| settings.sdo.is_some())
    }
}
