//! A gas engine as its knock controller sees it: plausible, not physical. Pure and deterministic.
//!
//! Each cylinder has its own noise, which wanders slowly and grows with the load. Knocking raises a cylinder; the
//! controller answers by retarding the ignition over its analogue output, and demands less load when it can retard no
//! further. A trip lets the engine run down, stand and start again. Speed and load are in 1/1000 of the nominal.

use std::time::Duration;

use super::super::random::Random;
use super::values::{Channel, StatusBit, Values};
use crate::time::Instant;

/// The engine moves on at this pace.
const STEP: Duration = Duration::from_millis(100);
/// How long an engine that was tripped is kept from starting again.
pub const STANDSTILL: Duration = Duration::from_secs(10);
/// Full speed, full load.
const FULL: i32 = 1000;
/// Below this speed the controller reports low speed.
const LOW_SPEED: i32 = 300;
/// Speed lost and won in a step.
const RUN_DOWN: i32 = 50;
const RUN_UP: i32 = 25;
/// What the analogue output rises and falls in a step, raw: all of it within 2.6 s.
const RETARD_UP: u8 = 10;
const RETARD_DOWN: u8 = 3;

/// One cylinder's sensor.
#[derive(Clone, Copy, Debug, Default)]
struct Cylinder {
    /// Noise at full load, raw.
    noise: i32,
    /// Slow deviation from it, raw.
    drift: i32,
    /// Quick deviation, raw; renewed in each step.
    jitter: i32,
    /// Intensity while it knocks.
    knock: Option<u8>,
    bad: bool,
}

/// The engine. Running at part load when made.
#[derive(Clone, Debug)]
pub struct Engine {
    random: Random,
    cylinders: Vec<(Channel, Cylinder)>,
    load: i32,
    speed: i32,
    retard: u8,
    trip_until: Option<Instant>,
    restart_at: Option<Instant>,
    next_step: Instant,
}

impl Engine {
    /// An engine with sensors at channels 1 to `cylinders`; equal seeds behave alike.
    #[must_use]
    pub fn new(cylinders: u8, seed: u64, now: Instant) -> Self {
        let mut random = Random::new(seed);
        let fitted = Channel::all().take_while(|channel| channel.get() <= cylinders);
        let cylinders = fitted
            .map(|channel| (channel, Cylinder { noise: random.between(28, 56), ..Cylinder::default() }))
            .collect();
        let load = random.between(700, 850);
        Self {
            random,
            cylinders,
            load,
            speed: FULL,
            retard: 0,
            trip_until: None,
            restart_at: None,
            next_step: now + STEP,
        }
    }

    /// A cylinder knocks with this raw intensity, or no longer. Nothing happens at a channel without a cylinder.
    pub fn knock(&mut self, channel: Channel, level: Option<u8>) {
        if let Some(cylinder) = self.cylinder(channel) {
            cylinder.knock = level;
        }
    }

    /// A sensor breaks, or is mended. Nothing happens at a channel without a cylinder.
    pub fn break_sensor(&mut self, channel: Channel, bad: bool) {
        if let Some(cylinder) = self.cylinder(channel) {
            cylinder.bad = bad;
        }
    }

    /// No cylinder knocks and all sensors are good.
    pub fn mend(&mut self) {
        for (_, cylinder) in &mut self.cylinders {
            cylinder.knock = None;
            cylinder.bad = false;
        }
    }

    /// Trips the engine: the trip bit is set for `pulse`, the engine runs down and starts again after [`STANDSTILL`].
    pub fn trip(&mut self, now: Instant, pulse: Duration) {
        self.trip_until = Some(now + pulse);
        self.restart_at = Some(now + STANDSTILL);
    }

    /// What became due. A late call does not catch up: the engine has simply been slow.
    pub fn handle_timeout(&mut self, now: Instant) {
        if self.trip_until.is_some_and(|end| end <= now) {
            self.trip_until = None;
        }
        if self.next_step <= now {
            self.next_step = if now.since(self.next_step) < STEP { self.next_step } else { now } + STEP;
            self.step(now);
        }
    }

    /// When `handle_timeout` is to be called at the latest.
    #[must_use]
    pub fn poll_timeout(&self) -> Instant {
        self.trip_until.map_or(self.next_step, |end| end.min(self.next_step))
    }

    /// What the controller measures and reports now.
    #[must_use]
    pub fn values(&self) -> Values {
        let mut values = Values::default();
        values.analog_output = self.retard;
        for (channel, cylinder) in &self.cylinders {
            values.set_used(*channel, true);
            values.set_bad(*channel, cylinder.bad);
            values.set_intensity(*channel, self.intensity(cylinder));
            values.knock(*channel, self.knocks(cylinder));
        }
        values.set_status(StatusBit::Trip, self.trip_until.is_some());
        values.set_status(StatusBit::LoadReduction, values.is_knocking() && self.retard == u8::MAX);
        values.set_status(StatusBit::LowRpm, self.speed < LOW_SPEED);
        values.set_status(StatusBit::NoIsuPulses, self.speed == 0);
        values
    }

    fn cylinder(&mut self, channel: Channel) -> Option<&mut Cylinder> {
        self.cylinders.iter_mut().find(|(own, _)| *own == channel).map(|(_, cylinder)| cylinder)
    }

    fn step(&mut self, now: Instant) {
        self.restart_at = self.restart_at.filter(|at| *at > now);
        let change = if self.restart_at.is_some() { -RUN_DOWN } else { RUN_UP };
        self.speed = (self.speed + change).clamp(0, FULL);
        self.load = (self.load + self.random.between(-4, 4)).clamp(600, 950);
        for (_, cylinder) in &mut self.cylinders {
            cylinder.drift = (cylinder.drift + self.random.between(-1, 1)).clamp(-8, 8);
            cylinder.jitter = self.random.between(-2, 2);
        }
        let knocking = self.cylinders.iter().any(|(_, cylinder)| self.knocks(cylinder));
        self.retard = if knocking {
            self.retard.saturating_add(RETARD_UP)
        } else {
            self.retard.saturating_sub(RETARD_DOWN)
        };
    }

    /// An engine that stands does not knock, and a bad sensor hears nothing.
    fn knocks(&self, cylinder: &Cylinder) -> bool {
        cylinder.knock.is_some() && !cylinder.bad && self.speed > 0
    }

    fn intensity(&self, cylinder: &Cylinder) -> u8 {
        let raw = match cylinder.knock {
            _ if cylinder.bad || self.speed == 0 => 0,
            Some(level) => i32::from(level) + 3 * cylinder.jitter,
            None => {
                let load = self.load * (FULL - i32::from(self.retard)) / FULL;
                let noise = (cylinder.noise + cylinder.drift) * (FULL + 2 * load) / (3 * FULL);
                (noise + cylinder.jitter) * self.speed / FULL
            }
        };
        u8::try_from(raw.clamp(0, 255)).unwrap_or(u8::MAX)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn seven() -> Channel {
        Channel::new(7).unwrap()
    }

    fn run(engine: &mut Engine, from: u64, to: u64, mut look: impl FnMut(u64, &Values)) {
        for millis in (from..=to).step_by(100) {
            engine.handle_timeout(Instant::from_millis(millis));
            look(millis, &engine.values());
        }
    }

    #[test]
    fn a_healthy_engine_stays_below_its_limits_and_alive() {
        for seed in 0..20 {
            let mut engine = Engine::new(16, seed, Instant::START);
            let mut seen = std::collections::BTreeSet::new();
            run(&mut engine, 0, 120_000, |_, values| {
                for channel in Channel::all() {
                    let (raw, used) = (values.intensity(channel), channel.get() <= 16);
                    assert_eq!(values.is_used(channel), used);
                    assert!(if used { (5..80).contains(&raw) } else { raw == 0 }, "{channel}: {raw}");
                }
                assert!(!values.is_knocking() && values.analog_output == 0);
                assert!(StatusBit::ALL.iter().all(|bit| !values.status(*bit)));
                seen.insert(values.intensity(seven()));
            });
            assert!(seen.len() > 5, "{seen:?}");
        }
    }

    #[test]
    fn equal_seeds_behave_alike_and_others_do_not() {
        let trace = |seed| {
            let mut engine = Engine::new(12, seed, Instant::START);
            let mut trace = Vec::new();
            run(&mut engine, 0, 5000, |_, values| trace.push(*values));
            trace
        };
        assert_eq!(trace(3), trace(3));
        assert_ne!(trace(3), trace(4));
    }

    #[test]
    fn a_knocking_cylinder_rises_above_its_limit_and_the_load_is_reduced_when_retarding_does_not_help() {
        let mut engine = Engine::new(16, 1, Instant::START);
        engine.knock(seven(), Some(160));
        let values = engine.values();
        assert!(values.is_knocking());
        assert!(values.intensity(seven()) > values.ignition_reduction_limit);
        let mut last = 0;
        run(&mut engine, 100, 3000, |_, values| {
            assert!(values.analog_output > last || last == 255);
            last = values.analog_output;
            assert_eq!(values.status(StatusBit::LoadReduction), last == 255);
        });
        assert_eq!(last, 255);
        engine.knock(seven(), None);
        assert!(!engine.values().is_knocking());
        assert!(!engine.values().status(StatusBit::LoadReduction));
        run(&mut engine, 3100, 20_000, |_, _| {});
        assert_eq!(engine.values().analog_output, 0);
    }

    #[test]
    fn a_tripped_engine_runs_down_stands_and_starts_again() {
        let mut engine = Engine::new(16, 1, Instant::START);
        run(&mut engine, 0, 1000, |_, _| {});
        engine.trip(Instant::from_millis(1000), Duration::from_millis(100));
        engine.knock(seven(), Some(200));
        assert!(engine.values().status(StatusBit::Trip));
        assert_eq!(engine.poll_timeout(), Instant::from_millis(1100));
        run(&mut engine, 1100, 5000, |_, values| assert!(!values.status(StatusBit::Trip)));
        let standing = engine.values();
        assert!(standing.status(StatusBit::LowRpm) && standing.status(StatusBit::NoIsuPulses));
        assert!(!standing.is_knocking());
        assert_eq!(standing.intensity(seven()), 0);
        run(&mut engine, 5100, 30_000, |_, _| {});
        let running = engine.values();
        assert!(!running.status(StatusBit::LowRpm) && !running.status(StatusBit::NoIsuPulses));
        assert!(running.is_knocking());
    }

    #[test]
    fn a_broken_sensor_reads_zero_and_mending_ends_everything() {
        let mut engine = Engine::new(16, 1, Instant::START);
        engine.break_sensor(seven(), true);
        engine.knock(seven(), Some(200));
        engine.break_sensor(Channel::new(20).unwrap(), true);
        let values = engine.values();
        assert!(values.is_bad(seven()) && !values.is_knocking());
        assert_eq!(values.intensity(seven()), 0);
        assert!(!values.is_bad(Channel::new(20).unwrap()));
        engine.mend();
        assert!(!engine.values().is_bad(seven()) && !engine.values().is_knocking());
    }

    #[test]
    fn a_stalled_process_does_not_make_the_engine_race() {
        let mut engine = Engine::new(16, 1, Instant::START);
        engine.handle_timeout(Instant::from_millis(60_000));
        assert_eq!(engine.poll_timeout(), Instant::from_millis(60_100));
    }
}
