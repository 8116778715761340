//! How a reading of the sensors becomes objects: values in their units, status, counters. Pure.

use super::dictionary::Objects;
use super::hydraulics::{BAR, Reading};
use super::units;

/// Lowest and highest temperature that the device measures, in °C.
pub const TEMPERATURE_SPAN_C: (f64, f64) = (-40.0, 125.0);
/// Bits of the status objects 0x6150 (R-DST-025).
pub const INVALID: u8 = 0x01;
/// The value is above the span.
pub const OVERLOAD_POSITIVE: u8 = 0x02;
/// The value is below the span.
pub const OVERLOAD_NEGATIVE: u8 = 0x04;

/// The measuring side of a device.
#[derive(Clone, Debug)]
pub struct Measurement {
    span_pa: f64,
    /// Pressure that is shown as 0, in Pa.
    pub zero_pa: f64,
    /// Sensors that are broken: pressure, temperature.
    pub broken: [bool; 2],
    reading: Reading,
    status: [u8; 2],
}

/// One channel: where its objects are, and what is in them.
struct Channel {
    sub: u8,
    /// In the unit of the object, with its offset.
    value: f64,
    span: (f64, f64),
    digits: u32,
    /// Part of the span, 0 to 1.
    part: f64,
    broken: bool,
}

impl Measurement {
    /// A device with a span of so many bar.
    #[must_use]
    pub fn new(span_bar: f64) -> Self {
        Self {
            span_pa: span_bar * BAR,
            zero_pa: 0.0,
            broken: [false; 2],
            reading: Reading::default(),
            status: [0; 2],
        }
    }

    /// The sensors see something else.
    pub fn read(&mut self, reading: Reading) {
        self.reading = reading;
    }

    /// Status bits of pressure and temperature.
    #[must_use]
    pub fn status(&self) -> [u8; 2] {
        self.status
    }

    /// What the pressure is, is from now on shown as 0 (R-DST-086).
    pub fn autozero(&mut self) {
        self.zero_pa = self.reading.pressure_pa;
    }

    /// After power-on no overload has been counted yet.
    pub fn forget_status(&mut self) {
        self.status = [0; 2];
    }

    /// Writes everything that is measured into the objects, in the units that they ask for.
    pub fn show(&mut self, objects: &mut Objects) {
        let pressure = self.reading.pressure_pa;
        let temperature = self.reading.temperature_c;
        let status = [
            status(self.broken.first(), pressure, (0.0, self.span_pa)),
            status(self.broken.last(), temperature, TEMPERATURE_SPAN_C),
        ];
        let before = std::mem::replace(&mut self.status, status);
        count_overloads(objects, before, status);
        show(objects, &self.pressure(objects));
        show(objects, &self.temperature(objects));
        for (sub, status) in (1..).zip(status) {
            objects.put((0x6150, sub), u32::from(status));
        }
    }

    fn pressure(&self, objects: &Objects) -> Channel {
        let unit = units::pressure(objects.raw((0x6131, 1))).map_or(1.0, |unit| unit.pascal);
        let digits = objects.raw((0x6132, 1));
        let shown = (self.reading.pressure_pa + self.reading.noise_pa - self.zero_pa) / unit;
        // R-DST-087: both offsets are added.
        let offset = objects.float((0x6124, 1)) + units::from_integer(objects.signed((0x9124, 1)), digits);
        Channel {
            sub: 1,
            value: shown + offset,
            span: (0.0, self.span_pa / unit),
            digits,
            part: self.reading.pressure_pa / self.span_pa,
            broken: self.broken.first().is_some_and(|broken| *broken),
        }
    }

    fn temperature(&self, objects: &Objects) -> Channel {
        let unit = |celsius| units::temperature(objects.raw((0x6131, 2)), celsius);
        let (low, high) = TEMPERATURE_SPAN_C;
        Channel {
            sub: 2,
            value: unit(self.reading.temperature_c),
            span: (unit(low), unit(high)),
            digits: objects.raw((0x6132, 2)),
            part: (self.reading.temperature_c - low) / (high - low),
            broken: self.broken.last().is_some_and(|broken| *broken),
        }
    }
}

fn status(broken: Option<&bool>, value: f64, (low, high): (f64, f64)) -> u8 {
    let bits = [
        (broken == Some(&true), INVALID),
        (broken != Some(&true) && value > high, OVERLOAD_POSITIVE),
        (broken != Some(&true) && value < low, OVERLOAD_NEGATIVE),
    ];
    bits.into_iter().filter(|(holds, _)| *holds).fold(0, |status, (_, bit)| status | bit)
}

/// R-DST-088: one more each time that an overload begins.
fn count_overloads(objects: &mut Objects, before: [u8; 2], after: [u8; 2]) {
    let [pressure, temperature] = [0, 1].map(|place| {
        let of = |status: [u8; 2]| status.get(place).copied().unwrap_or_default();
        of(after) & !of(before)
    });
    for (index, began) in [
        (0x3000, pressure & OVERLOAD_POSITIVE),
        (0x3001, pressure & OVERLOAD_NEGATIVE),
        (0x3002, temperature & OVERLOAD_POSITIVE),
        (0x3003, temperature & OVERLOAD_NEGATIVE),
    ] {
        if began != 0 {
            objects.put((index, 0), (objects.raw((index, 0)) + 1).min(0xFFFF));
        }
    }
}

/// A broken sensor gives no number: not-a-number as a float, the highest as an integer.
fn show(objects: &mut Objects, channel: &Channel) {
    let (low, high) = channel.span;
    let (value, part) = if channel.broken { (f64::NAN, 1.0) } else { (channel.value, channel.part) };
    let integer =
        if channel.broken { i32::MAX.cast_unsigned() } else { units::integer(value, channel.digits) };
    let adc = units::integer((part * 32_000.0).clamp(-32_768.0, 32_767.0), 0);
    for (index, raw) in [
        (0x6130, units::float(value)),
        (0x6148, units::float(low)),
        (0x6149, units::float(high)),
        (0x7100, adc & 0xFFFF),
        (0x9130, integer),
        (0x9148, units::integer(low, channel.digits)),
        (0x9149, units::integer(high, channel.digits)),
    ] {
        objects.put((index, channel.sub), raw);
    }
}
