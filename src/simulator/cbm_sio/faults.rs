//! What can be wrong with a simulated esd module. Every fault can be switched while it runs.

/// The faults that are on. The default is a healthy module.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Faults {
    /// Requests are not answered.
    pub mute_replies: bool,
    /// Watchdog requests are not answered; they count all the same.
    pub mute_watchdog: bool,
    /// Frames with data are lost.
    pub mute_data: bool,
    /// The CAN plug is out: nothing comes, nothing goes.
    pub unplugged: bool,
    /// The CAN controller's own error stands: clearing the bit does not help (R-ESD-077).
    pub error_stands: bool,
    /// Bit 7 of the watchdog replies no longer changes.
    pub stuck_toggle: bool,
}
