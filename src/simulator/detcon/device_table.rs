//! The `[device]` table of a `DetCon`'s scenario. Pure.

use std::time::Duration;

use serde::Deserialize;
use toml::Spanned;

use super::super::kind::Settings;
use super::super::scenario_file::{self, Reader};
use super::protocol::DetconSettings;
use super::values::{Channel, WireFormat};

#[derive(Deserialize, Default)]
#[serde(deny_unknown_fields)]
pub(in super::super) struct DeviceTable {
    cylinders: Option<Spanned<i64>>,
    initialisation_ms: Option<u64>,
    reply_delay_ms: Option<u64>,
    guard_in_boot: Option<bool>,
    event_restarts_period: Option<bool>,
    all_nmt_commands: Option<bool>,
    big_endian_sensor_fields: Option<bool>,
    status_invert_mask: Option<Spanned<i64>>,
}

impl scenario_file::DeviceTable for DeviceTable {
    fn settings(&self, reader: &mut Reader) -> Settings {
        let default = DetconSettings::default();
        let cylinders = reader.number(self.cylinders.as_ref(), "number of cylinders", 0, Channel::COUNT);
        let mask = reader.number(self.status_invert_mask.as_ref(), "status mask", 0, 255);
        Settings::Detcon(DetconSettings {
            cylinders: cylinders.unwrap_or(default.cylinders),
            initialisation: self.initialisation_ms.map_or(default.initialisation, Duration::from_millis),
            reply_delay: self.reply_delay_ms.map_or(default.reply_delay, Duration::from_millis),
            guard_in_boot: self.guard_in_boot.unwrap_or(default.guard_in_boot),
            event_restarts_period: self.event_restarts_period.unwrap_or(default.event_restarts_period),
            all_nmt_commands: self.all_nmt_commands.unwrap_or(default.all_nmt_commands),
            format: WireFormat {
                big_endian_sensor_fields: self.big_endian_sensor_fields.unwrap_or_default(),
                status_invert_mask: mask.unwrap_or_default(),
                reserved_bits: false,
            },
            stagger: default.stagger,
        })
    }
}
