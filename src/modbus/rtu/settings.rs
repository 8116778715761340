//! The `[[modbus.rtu]]` tables of the configuration.

use std::path::PathBuf;
use std::time::Duration;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// A serial line on which the registers can be read: the gateway answers there under all its unit ids but 0 and 255, and
/// keeps silent for every other unit, which may be another device.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct RtuSettings {
    /// The port, for example `/dev/ttyS0`, or a path of `/dev/serial/by-id` for an adapter that is plugged in.
    pub device: PathBuf,
    /// Bit rate, 1200..=115200.
    #[serde(default = "default_baud", deserialize_with = "baud")]
    #[schemars(range(min = 1200, max = 115_200))]
    pub baud: u32,
    /// Parity. Without one, each character has two stop bits.
    #[serde(default)]
    pub parity: Parity,
}

/// Parity of characters.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Parity {
    /// Even, which the standard wants every device to offer.
    #[default]
    Even,
    /// Odd.
    Odd,
    /// None, and two stop bits.
    None,
}

/// Bits of a character on the line: start, 8, parity or second stop bit, stop.
const BITS: u32 = 11;
/// Above 19,200 bit/s the standard holds the pause fast.
const SHORTEST_PAUSE: Duration = Duration::from_micros(1_750);
/// Operating systems and USB adapters hand over bytes in lumps: what came in two of them may be one frame.
const LUMPS: Duration = Duration::from_millis(20);

impl RtuSettings {
    /// After a pause of this time what came before is a whole frame, or none: 3.5 characters, and what lumps need.
    #[must_use]
    pub fn pause(&self) -> Duration {
        let characters = Duration::from_micros(u64::from(3_500_000 * BITS / self.baud.max(1)));
        characters.max(SHORTEST_PAUSE) + LUMPS
    }
}

fn default_baud() -> u32 {
    19_200
}

fn baud<'de, D: serde::Deserializer<'de>>(deserializer: D) -> Result<u32, D::Error> {
    let baud = u32::deserialize(deserializer)?;
    if (1_200..=115_200).contains(&baud) {
        Ok(baud)
    } else {
        Err(serde::de::Error::custom(format!("{baud} is no bit rate of a line; use 1200 to 115200")))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_line_needs_its_port_only_and_has_then_what_the_standard_wants() {
        let settings: RtuSettings = toml::from_str("device = '/dev/ttyS0'").unwrap();
        assert_eq!((settings.baud, settings.parity), (19_200, Parity::Even));
        assert_eq!(settings.pause(), Duration::from_micros(2_005 + 20_000));
        for wrong in
            ["", "device = 'a'\nbaud = 300", "device = 'a'\nparity = 'mark'", "device = 'a'\nspeed = 9600"]
        {
            assert!(toml::from_str::<RtuSettings>(wrong).is_err(), "{wrong}");
        }
    }
}
