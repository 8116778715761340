//! A bus in numbers-time with one device on it, for the tests of this room.

use super::super::slave::SlaveFaults;
use super::faults::Faults;
use super::protocol::{Detcon, DetconSettings};
use super::values::{Channel, Values};
use crate::canopen::NodeId;
use crate::time::Now;

/// Node 1, and what it sent.
pub struct Bench {
    pub device: Detcon,
    now: u64,
    log: Vec<(u64, String)>,
}

impl Bench {
    /// Powered on at 0.
    pub fn powered(settings: DetconSettings) -> Self {
        let mut bench = Self::off(settings);
        bench.power(0, true);
        bench
    }

    pub fn off(settings: DetconSettings) -> Self {
        let device = Detcon::new(NodeId::new(1).unwrap(), settings);
        Self { device, now: 0, log: Vec::new() }
    }

    /// Powered on long ago and started at `at` ms; nothing sent yet is in the log but what the start caused.
    pub fn operational(settings: DetconSettings, at: u64) -> Self {
        let mut bench = Self::powered(settings);
        bench.run_to(at);
        bench.take();
        bench.frame(at, "000#0101");
        bench
    }

    pub fn now(&self) -> Now {
        Now::from_millis(self.now)
    }

    /// Lets time pass up to and including `millis`.
    pub fn run_to(&mut self, millis: u64) {
        self.run_before(millis + 1);
        self.now = millis;
    }

    /// Lets time pass up to `millis`, without what becomes due just then.
    fn run_before(&mut self, millis: u64) {
        let due = |device: &Detcon| device.poll_timeout().map(|due| due.as_micros().div_ceil(1000));
        while let Some(due) = due(&self.device).filter(|due| *due < millis) {
            self.now = due.max(self.now);
            self.device.handle_timeout(self.now());
            self.drain();
        }
        self.now = millis;
    }

    pub fn power(&mut self, millis: u64, on: bool) {
        self.run_to(millis);
        if on {
            self.device.power_on(self.now());
        } else {
            self.device.power_off(self.now());
        }
        self.drain();
    }

    /// At `millis`, another participant sends `frame`.
    pub fn frame(&mut self, millis: u64, frame: &str) {
        self.run_to(millis);
        self.device.handle_frame(self.now(), &frame.parse().unwrap());
        self.drain();
    }

    pub fn update(&mut self, millis: u64, change: impl FnOnce(&mut Values)) {
        self.run_before(millis);
        self.device.update(self.now(), change);
        self.drain();
    }

    pub fn faults(&mut self, millis: u64, change: impl FnOnce(&mut Faults)) {
        self.run_before(millis);
        self.device.update_faults(self.now(), change);
        self.drain();
    }

    pub fn slave_faults(&mut self, millis: u64, change: impl FnOnce(&mut SlaveFaults)) {
        self.run_before(millis);
        self.device.update_slave_faults(self.now(), change);
        self.drain();
    }

    fn drain(&mut self) {
        while let Some(frame) = self.device.poll_output() {
            self.log.push((self.now, frame.to_string()));
        }
    }

    /// What was sent since the last call.
    pub fn take(&mut self) -> Vec<(u64, String)> {
        std::mem::take(&mut self.log)
    }

    /// When frames of this identifier were sent since the last call; forgets the others.
    pub fn times(&mut self, id: &str) -> Vec<u64> {
        self.take().into_iter().filter(|(_, frame)| frame.starts_with(id)).map(|(at, _)| at).collect()
    }

    /// Guards the device at `millis` and returns the data of what it answers.
    pub fn guard(&mut self, millis: u64) -> Option<String> {
        self.run_to(millis);
        self.take();
        self.frame(millis, "701#R1");
        self.run_to(millis + 1);
        self.take().into_iter().find_map(|(_, frame)| frame.strip_prefix("701#").map(str::to_owned))
    }
}

pub fn healthy() -> DetconSettings {
    DetconSettings::default()
}

pub fn channel(number: u8) -> Channel {
    Channel::new(number).unwrap()
}

/// Frames with their times, as the log has them.
pub fn sent(frames: &[(u64, &str)]) -> Vec<(u64, String)> {
    frames.iter().map(|(at, frame)| (*at, (*frame).to_owned())).collect()
}

/// Like [`DetconSettings::default`], but all TPDOs start at the start command, to the millisecond.
pub fn in_phase() -> DetconSettings {
    DetconSettings { stagger: std::time::Duration::ZERO, ..DetconSettings::default() }
}
