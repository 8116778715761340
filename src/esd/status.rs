//! The CAN status byte of a module (R-ESD-074).

/// What a module says of itself. Bits 3 and 4 have no meaning that is known; they are kept.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct CanStatus(pub u8);

impl CanStatus {
    /// Bit 0: it runs; else it was stopped.
    #[must_use]
    pub const fn runs(self) -> bool {
        self.0 & 0x01 != 0
    }

    /// Bit 1: it was suspended: what comes in is kept, nothing is passed on (R-ESD-041).
    #[must_use]
    pub const fn is_suspended(self) -> bool {
        self.0 & 0x02 != 0
    }

    /// Bit 2: its CAN controller had an error since this was cleared last.
    #[must_use]
    pub const fn had_can_error(self) -> bool {
        self.0 & 0x04 != 0
    }

    /// Bit 6: since its last RESET it works with default parameters.
    #[must_use]
    pub const fn woke_with_defaults(self) -> bool {
        self.0 & 0x40 != 0
    }

    /// Bit 7: it started and nobody has cleared this since (R-ESD-076).
    #[must_use]
    pub const fn is_new_on_bus(self) -> bool {
        self.0 & 0x80 != 0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn r_esd_074_v_esd_07_bits_of_the_status_byte() {
        let status = CanStatus(0xC1);
        assert!(status.runs() && status.woke_with_defaults() && status.is_new_on_bus());
        assert!(!status.is_suspended() && !status.had_can_error());
        let status = CanStatus(0x07);
        assert!(status.runs() && status.is_suspended() && status.had_can_error());
        assert!(!status.woke_with_defaults() && !status.is_new_on_bus());
    }
}
