//! What can be wrong with a simulated `DetCon`. Every fault can be switched while the device runs.

use std::time::Duration;

use super::values::Tpdo;

/// The faults that are on. The default is a healthy device.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Faults {
    /// Guard requests are not answered; boot-up messages still go out.
    pub mute_guarding: bool,
    /// TPDOs that are not sent, by [`Tpdo::index`].
    pub mute_pdos: [bool; 4],
    /// Bit 7 of the guard replies no longer changes.
    pub stuck_toggle: bool,
    /// Lengths (DLC, 0..=8) that TPDOs have instead of their own, by [`Tpdo::index`].
    pub wrong_length: [Option<u8>; 4],
    /// Guard replies come this long after the request.
    pub late_replies: Option<Duration>,
    /// Reserved bits are set.
    pub reserved_bits: bool,
}

impl Faults {
    /// Whether this TPDO is muted.
    #[must_use]
    pub fn mutes(&self, tpdo: Tpdo) -> bool {
        self.mute_pdos.get(tpdo.index()).copied().unwrap_or_default()
    }

    /// Mutes or unmutes one TPDO.
    pub fn set_mute(&mut self, tpdo: Tpdo, on: bool) {
        if let Some(mute) = self.mute_pdos.get_mut(tpdo.index()) {
            *mute = on;
        }
    }

    /// The length that this TPDO has on the bus.
    #[must_use]
    pub fn length_of(&self, tpdo: Tpdo) -> u8 {
        self.wrong_length.get(tpdo.index()).copied().flatten().unwrap_or_else(|| tpdo.length()).min(8)
    }

    /// Gives a TPDO a wrong length, 0..=8, or its own again.
    pub fn set_length(&mut self, tpdo: Tpdo, dlc: Option<u8>) {
        if let Some(length) = self.wrong_length.get_mut(tpdo.index()) {
            *length = dlc;
        }
    }
}
