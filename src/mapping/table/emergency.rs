//! Errors of a device that its mapping names.

use crate::canopen::emcy::Known;

/// What is known of the emergency messages of a node.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct EmergencyDef {
    /// Errors that have alarms of their own ([`BuiltIn::NamedError`](super::BuiltIn::NamedError)).
    pub errors: Vec<ErrorDef>,
    /// The poll that reads the error register, by its place among those of the node's settings.
    pub register_poll: Option<usize>,
}

/// An error that the mapping names.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ErrorDef {
    /// Error code.
    pub code: u16,
    /// The bits of the code that count.
    pub mask: u16,
    /// Name of its alarm.
    pub name: String,
    /// The bit of the error register that it sets besides bit 0, 1..=7, where that is known.
    pub register_bit: Option<u8>,
}

impl ErrorDef {
    /// Whether a code is this error.
    #[must_use]
    pub fn matches(&self, code: u16) -> bool {
        (code ^ self.code) & self.mask == 0
    }
}

impl EmergencyDef {
    /// What is known of a code: the entry of which most bits count.
    #[must_use]
    pub fn find(&self, code: u16) -> Option<Known> {
        let matching = self.errors.iter().enumerate().filter(|(_, error)| error.matches(code));
        let (entry, error) = matching.max_by_key(|(_, error)| error.mask.count_ones())?;
        Some(Known { entry, register_bit: error.register_bit })
    }
}
