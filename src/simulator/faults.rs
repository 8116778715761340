//! What can be wrong with a simulated device. Every fault can be switched while the device runs.

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
    /// Another master is on the bus: it guards this device and stops it from time to time.
    pub second_master: bool,
    /// Another device with the same node id: everything is sent twice.
    pub duplicate: bool,
    /// Guard replies come this long after the request.
    pub late_replies: Option<Duration>,
    /// Reserved bits are set.
    pub reserved_bits: bool,
    /// The device restarts by itself, again and again, with this time between two restarts (at least
    /// [`SHORTEST_BOOT_LOOP`]).
    pub boot_loop: Option<Duration>,
    /// NMT start has no effect.
    pub refuse_start: bool,
}

/// A boot loop is not faster than this.
pub const SHORTEST_BOOT_LOOP: Duration = Duration::from_millis(100);

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
