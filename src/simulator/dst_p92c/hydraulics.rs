//! The plant that a DST P92C measures at: a hydraulic pressure line, plausible, not physical. Pure and deterministic.
//!
//! Pressure and temperature wander slowly around what the plant is set to, with some noise, until they are ordered.

use std::time::Duration;

use super::super::random::Random;
use super::settings::DstSettings;
use crate::time::Instant;

/// The plant moves on at this pace.
const STEP: Duration = Duration::from_millis(50);
/// Pascal in a bar.
pub const BAR: f64 = 100_000.0;

/// What the sensors see.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Reading {
    /// The pressure without its noise, in Pa; overloads are told by it, so that noise at the end of the span is none.
    pub pressure_pa: f64,
    /// Noise of the pressure, in Pa.
    pub noise_pa: f64,
    /// Temperature, in °C.
    pub temperature_c: f64,
}

/// A change of the pressure from one value to another, in bar.
#[derive(Clone, Copy, Debug)]
struct Ramp {
    from: f64,
    to: f64,
    begin: Instant,
    length: Duration,
}

impl Ramp {
    fn at(&self, now: Instant) -> f64 {
        let passed = now.since(self.begin);
        if passed >= self.length {
            return self.to;
        }
        self.from + (self.to - self.from) * passed.as_secs_f64() / self.length.as_secs_f64()
    }
}

/// The plant.
#[derive(Clone, Debug)]
pub struct Hydraulics {
    random: Random,
    usual_bar: f64,
    usual_c: f64,
    noise: bool,
    ordered_bar: Option<Ramp>,
    ordered_c: Option<f64>,
    /// Slow deviations, in 1/100 bar and 1/100 K.
    drift: i32,
    warmth: i32,
    reading: Reading,
    next_step: Instant,
}

impl Hydraulics {
    /// A plant; equal seeds behave alike.
    #[must_use]
    pub fn new(settings: &DstSettings, seed: u64, now: Instant) -> Self {
        let mut plant = Self {
            random: Random::new(seed),
            usual_bar: settings.pressure_bar,
            usual_c: settings.temperature_c,
            noise: settings.noise,
            ordered_bar: None,
            ordered_c: None,
            drift: 0,
            warmth: 0,
            reading: Reading::default(),
            next_step: now + STEP,
        };
        plant.look(now);
        plant
    }

    /// The pressure is to be this, in bar, and to get there within a time; `None` = the plant's own again.
    pub fn order_pressure(&mut self, now: Instant, bar: Option<f64>, length: Duration) {
        let from = self.reading.pressure_pa / BAR;
        self.ordered_bar = bar.map(|to| Ramp { from, to, begin: now, length });
        self.look(now);
    }

    /// The temperature is this, in °C; `None` = the plant's own again.
    pub fn order_temperature(&mut self, now: Instant, celsius: Option<f64>) {
        self.ordered_c = celsius;
        self.look(now);
    }

    /// What the sensors see now.
    #[must_use]
    pub fn reading(&self) -> Reading {
        self.reading
    }

    /// What became due. A late call does not catch up.
    pub fn handle_timeout(&mut self, now: Instant) {
        if self.next_step > now {
            return;
        }
        self.next_step = if now.since(self.next_step) < STEP { self.next_step } else { now } + STEP;
        if self.noise {
            self.drift = (self.drift + self.random.between(-20, 20)).clamp(-500, 500);
            self.warmth = (self.warmth + self.random.between(-1, 1)).clamp(-200, 200);
        }
        self.look(now);
    }

    /// When `handle_timeout` is to be called at the latest.
    #[must_use]
    pub fn poll_timeout(&self) -> Instant {
        self.next_step
    }

    fn look(&mut self, now: Instant) {
        let usual = self.usual_bar + f64::from(self.drift) / 100.0;
        let noise = if self.noise { self.random.between(-500, 500) } else { 0 };
        self.reading = Reading {
            pressure_pa: self.ordered_bar.map_or(usual, |ramp| ramp.at(now)) * BAR,
            noise_pa: f64::from(noise),
            temperature_c: self.ordered_c.unwrap_or(self.usual_c + f64::from(self.warmth) / 100.0),
        };
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn run(plant: &mut Hydraulics, until: u64) -> Vec<Reading> {
        let mut readings = Vec::new();
        while plant.poll_timeout() <= Instant::from_millis(until) {
            let now = plant.poll_timeout();
            plant.handle_timeout(now);
            readings.push(plant.reading());
        }
        readings
    }

    #[test]
    fn the_plant_wanders_around_its_set_point_and_equal_seeds_alike() {
        let settings = DstSettings::default();
        let trace = |seed| run(&mut Hydraulics::new(&settings, seed, Instant::START), 60_000);
        let readings = trace(1);
        let bar = |reading: &Reading| reading.pressure_pa / BAR;
        assert!(readings.iter().all(|reading| (174.9..=185.1).contains(&bar(reading))));
        assert!(readings.windows(2).any(|pair| pair[0] != pair[1]));
        assert_eq!(readings, trace(1));
        assert_ne!(readings, trace(2));
    }

    #[test]
    fn an_ordered_pressure_is_reached_in_its_time_and_kept() {
        let settings = DstSettings { noise: false, ..DstSettings::default() };
        let mut plant = Hydraulics::new(&settings, 1, Instant::START);
        plant.order_pressure(Instant::START, Some(280.0), Duration::from_secs(1));
        let readings = run(&mut plant, 2000);
        let bar: Vec<f64> = readings.iter().map(|reading| (reading.pressure_pa / BAR).round()).collect();
        assert_eq!((bar[0], bar[9], bar[19], bar[39]), (185.0, 230.0, 280.0, 280.0));
        plant.order_pressure(Instant::from_millis(2000), None, Duration::ZERO);
        assert!((plant.reading().pressure_pa - 180.0 * BAR).abs() < 1.0);
    }
}
