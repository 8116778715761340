//! What can be wrong with a simulated DST P92C. Every fault can be switched while the device runs.

use std::time::Duration;

/// The faults that are on. The default is a healthy device.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Faults {
    /// Sensors that are broken: pressure, temperature.
    pub broken: [bool; 2],
    /// An error that the device reports besides those that it finds.
    pub error: Option<u16>,
    /// SDO requests are not answered.
    pub mute_sdo: bool,
    /// No heartbeats; boot-up messages still go out.
    pub mute_heartbeat: bool,
    /// No emergency messages; the error register and 0x1003 go on.
    pub mute_emcy: bool,
    /// No TPDO1.
    pub mute_pdo: bool,
    /// SDO answers come this long after the request.
    pub late_sdo: Option<Duration>,
    /// An error is found at each start.
    pub boot_error: bool,
}
