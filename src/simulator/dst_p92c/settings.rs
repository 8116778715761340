//! What a DST P92C is like: the switches where the guide leaves a choice, and the `[device]` table of its scenario. Pure.

use std::time::Duration;

use serde::Deserialize;
use toml::Spanned;

use super::super::kind::Settings;
use super::super::scenario_file::{self, Reader};

/// Bit rates in kbit/s by their index; 5 is reserved (section 13 of the requirements, R-DST-007).
pub const BIT_RATES: [(u8, u16); 7] = [(0, 1000), (1, 800), (2, 500), (3, 250), (4, 125), (6, 50), (7, 20)];

/// The bit rate of an index, in kbit/s.
#[must_use]
pub fn kbit(index: u8) -> Option<u16> {
    BIT_RATES.iter().find(|(own, _)| *own == index).map(|(_, kbit)| *kbit)
}

/// The index of a bit rate in kbit/s.
#[must_use]
pub fn bit_rate_index(kbit: u16) -> Option<u8> {
    BIT_RATES.iter().find(|(_, own)| *own == kbit).map(|(index, _)| *index)
}

/// What a device is like. The default is what devices in the field are expected to be.
#[derive(Clone, Debug, PartialEq)]
pub struct DstSettings {
    /// From power-on or reset to the boot-up message.
    pub boot: Duration,
    /// From a request or a SYNC to the answer.
    pub reply_delay: Duration,
    /// Transmission type from the factory, 1 or 255 (`sim_default_transmission_type`, R-DST-043).
    pub default_transmission_type: u8,
    /// The boot-up message comes in spite of an error (`sim_boot_on_error`, R-DST-052).
    pub boot_on_error: bool,
    /// SDO is answered in Stopped too (`sim_sdo_in_stopped`, R-DST-071).
    pub sdo_in_stopped: bool,
    /// The device counts as not configured (`sim_unconfigured`, R-DST-109).
    pub unconfigured: bool,
    /// LSS is answered outside Stopped and with heartbeats too (R-DST-092).
    pub lss_in_any_state: bool,
    /// Node id and bit rate that were written by SDO survive a reset only when they were saved (R-DST-118).
    pub address_needs_save: bool,
    /// 0x1018/02.
    pub product_code: u32,
    /// 0x1018/03.
    pub revision: u32,
    /// 0x1018/04 of node 1; each further node of a simulation has the next.
    pub serial_number: u32,
    /// Bit rate of the bus in kbit/s; 0 = the bus takes every bit rate.
    pub bus_kbit: u16,
    /// Index of the bit rate that is stored in the device.
    pub bit_rate: u8,
    /// Highest pressure that it measures, in bar; the lowest is 0.
    pub span_bar: f64,
    /// Pressure of the plant, in bar.
    pub pressure_bar: f64,
    /// Temperature of the plant, in °C.
    pub temperature_c: f64,
    /// Pressure and temperature wander and are noisy.
    pub noise: bool,
}

/// Factory bit rate (R-DST-002).
const FACTORY_KBIT: u16 = 125;

impl Default for DstSettings {
    fn default() -> Self {
        Self {
            boot: Duration::from_millis(100),
            reply_delay: Duration::from_millis(1),
            default_transmission_type: 1,
            boot_on_error: false,
            sdo_in_stopped: false,
            unconfigured: false,
            lss_in_any_state: false,
            address_needs_save: true,
            product_code: 0x1234_5678,
            revision: 0x0001_0203,
            serial_number: 123_456,
            bus_kbit: FACTORY_KBIT,
            bit_rate: 4,
            span_bar: 400.0,
            pressure_bar: 180.0,
            temperature_c: 45.0,
            noise: true,
        }
    }
}

#[derive(Deserialize, Default)]
#[serde(deny_unknown_fields)]
pub(in super::super) struct DeviceTable {
    boot_ms: Option<u64>,
    reply_delay_ms: Option<u64>,
    default_transmission_type: Option<Spanned<i64>>,
    boot_on_error: Option<bool>,
    sdo_in_stopped: Option<bool>,
    unconfigured: Option<bool>,
    lss_in_any_state: Option<bool>,
    address_needs_save: Option<bool>,
    product_code: Option<Spanned<i64>>,
    revision: Option<Spanned<i64>>,
    serial_number: Option<Spanned<i64>>,
    bus_kbit: Option<Spanned<i64>>,
    kbit: Option<Spanned<i64>>,
    span_bar: Option<Spanned<f64>>,
    pressure_bar: Option<f64>,
    temperature_c: Option<f64>,
    noise: Option<bool>,
}

impl DeviceTable {
    /// The bit rate of the bus, and the index of the device's own.
    fn bit_rates(&self, reader: &mut Reader) -> (u16, u8) {
        let bus = reader.number(self.bus_kbit.as_ref(), "bit rate in kbit/s", 0, 1000);
        let bus = bus.unwrap_or(FACTORY_KBIT);
        let usual = bit_rate_index(bus).unwrap_or(4);
        let Some(own) = &self.kbit else { return (bus, usual) };
        let index = u16::try_from(*own.get_ref()).ok().and_then(bit_rate_index);
        if index.is_none() {
            let message = format!("{} is not a bit rate of the device", own.get_ref());
            reader.problem(&own.span(), &message, "give 20, 50, 125, 250, 500, 800 or 1000 kbit/s");
        }
        (bus, index.unwrap_or(usual))
    }

    fn transmission_type(&self, reader: &mut Reader) -> Option<u8> {
        let given = self.default_transmission_type.as_ref()?;
        let number = u8::try_from(*given.get_ref()).ok().filter(|number| matches!(number, 1 | 255));
        if number.is_none() {
            let message = format!("{} is not a transmission type of the device", given.get_ref());
            reader.problem(&given.span(), &message, "give 1 (after each SYNC) or 255 (by itself)");
        }
        number
    }
}

impl scenario_file::DeviceTable for DeviceTable {
    fn settings(&self, reader: &mut Reader) -> Settings {
        let default = DstSettings::default();
        let (bus_kbit, bit_rate) = self.bit_rates(reader);
        let mut id = |number, what, usual| reader.number(number, what, 0, u32::MAX).unwrap_or(usual);
        let product_code = id(self.product_code.as_ref(), "product code", default.product_code);
        let revision = id(self.revision.as_ref(), "revision number", default.revision);
        let serial_number = id(self.serial_number.as_ref(), "serial number", default.serial_number);
        if let Some(span) = self.span_bar.as_ref().filter(|span| !(1.0..=2000.0).contains(span.get_ref())) {
            let message = format!("{} bar is no span", span.get_ref());
            reader.problem(&span.span(), &message, "give 1 to 2000");
        }
        Settings::DstP92c(Box::new(DstSettings {
            boot: self.boot_ms.map_or(default.boot, Duration::from_millis),
            reply_delay: self.reply_delay_ms.map_or(default.reply_delay, Duration::from_millis),
            default_transmission_type: self
                .transmission_type(reader)
                .unwrap_or(default.default_transmission_type),
            boot_on_error: self.boot_on_error.unwrap_or(default.boot_on_error),
            sdo_in_stopped: self.sdo_in_stopped.unwrap_or(default.sdo_in_stopped),
            unconfigured: self.unconfigured.unwrap_or(default.unconfigured),
            lss_in_any_state: self.lss_in_any_state.unwrap_or(default.lss_in_any_state),
            address_needs_save: self.address_needs_save.unwrap_or(default.address_needs_save),
            product_code,
            revision,
            serial_number,
            bus_kbit,
            bit_rate,
            span_bar: self.span_bar.as_ref().map_or(default.span_bar, |span| *span.get_ref()),
            pressure_bar: self.pressure_bar.unwrap_or(default.pressure_bar),
            temperature_c: self.temperature_c.unwrap_or(default.temperature_c),
            noise: self.noise.unwrap_or(default.noise),
        }))
    }
}
