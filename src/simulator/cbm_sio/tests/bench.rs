//! A bus in numbers-time with one esd module on it.

use super::super::device::SimulatedSio;
use super::super::line::LineKind;
use super::super::parameters::Model;
use super::super::settings::SioSettings;
use crate::can::CanFrame;
use crate::simulator::{Device, DeviceNumber, DevicePlan, Scenario, Settings};
use crate::time::{Instant, Now};

/// The module, what it sent to CAN, and what came out of its lines.
pub struct Bench {
    pub device: SimulatedSio,
    now: u64,
    log: Vec<(u64, String)>,
    lines: Vec<(u64, u8, u8)>,
}

/// A module that sends at once, with outside ends at all its lines, whose CTS is on.
pub fn prompt(model: Model) -> SioSettings {
    SioSettings { first_tx_delay_ms: 0, lines: [LineKind::External; 5], ..SioSettings::new(model) }
}

/// Bytes in candump notation.
pub fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02X}")).collect::<Vec<_>>().concat()
}

impl Bench {
    /// Powered on at 0, with so much on its coding switches.
    pub fn of(settings: &SioSettings, switch: u8) -> Self {
        let scenario = Scenario {
            description: String::new(),
            settings: Settings::CbmSio(Box::new(settings.clone())),
            events: Vec::new(),
        };
        Self::told(settings, switch, scenario)
    }

    pub fn told(settings: &SioSettings, switch: u8, scenario: Scenario) -> Self {
        let plan = DevicePlan::new(DeviceNumber::new(switch).unwrap(), scenario);
        let device = SimulatedSio::power_on(&plan, settings, Now::from_millis(0));
        let mut bench = Self { device, now: 0, log: Vec::new(), lines: Vec::new() };
        bench.drain();
        bench
    }

    /// An SIO1 that sends at once.
    pub fn sio1(switch: u8) -> Self {
        Self::of(&prompt(Model::Sio1), switch)
    }

    /// An SIO4 that sends at once.
    pub fn sio4(switch: u8) -> Self {
        Self::of(&prompt(Model::Sio4), switch)
    }

    /// Milliseconds since power-on.
    pub fn now(&self) -> u64 {
        self.now / 1000
    }

    fn moment(&self) -> Now {
        let moment = Now::from_millis(self.now / 1000);
        moment.later(std::time::Duration::from_micros(self.now % 1000))
    }

    /// Lets so many ms pass.
    pub fn run_for(&mut self, millis: u64) {
        self.run_to(self.now() + millis);
    }

    /// Lets time pass up to and including `millis`.
    pub fn run_to(&mut self, millis: u64) {
        let until = millis * 1000;
        while let Some(due) = self.device.poll_timeout().map(Instant::as_micros).filter(|due| *due <= until) {
            self.now = due.max(self.now);
            self.device.handle_timeout(self.moment());
            self.drain();
        }
        self.now = until.max(self.now);
    }

    /// Time passes, but the module's task sleeps through it.
    pub fn oversleep_to(&mut self, millis: u64) {
        self.now = millis * 1000;
        self.device.handle_timeout(self.moment());
        self.drain();
    }

    /// Another participant sends a frame now. Only what the module says that it hears is handed to it, as the task does.
    pub fn frame(&mut self, frame: &str) {
        let frame: CanFrame = frame.parse().unwrap();
        if self.device.hears(frame.id()) {
            self.device.handle_frame(self.moment(), &frame);
        }
        self.drain();
    }

    #[track_caller]
    pub fn order(&mut self, line: &str) {
        let words: Vec<&str> = line.split(' ').collect();
        self.device.handle_line(self.moment(), &words).unwrap();
        self.drain();
    }

    /// The outside end of a channel sends.
    pub fn say(&mut self, channel: u8, bytes: &[u8]) {
        self.device.handle_serial(self.moment(), channel, bytes);
        self.drain();
    }

    fn drain(&mut self) {
        while let Some(frame) = self.device.poll_output() {
            self.log.push((self.now / 1000, frame.to_string()));
        }
        while let Some((channel, bytes)) = self.device.poll_serial() {
            self.lines.extend(bytes.into_iter().map(|byte| (self.now, channel, byte)));
        }
    }

    /// What was sent since the last call, with its time in ms.
    pub fn take(&mut self) -> Vec<(u64, String)> {
        std::mem::take(&mut self.log)
    }

    /// What was sent since the last call.
    pub fn frames(&mut self) -> Vec<String> {
        self.take().into_iter().map(|(_, frame)| frame).collect()
    }

    /// What came out of a line since the last call; forgets the others.
    pub fn line(&mut self, channel: u8) -> Vec<u8> {
        self.timed_line(channel).into_iter().map(|(_, byte)| byte).collect()
    }

    /// The same with the time in microseconds.
    pub fn timed_line(&mut self, channel: u8) -> Vec<(u64, u8)> {
        let lines = std::mem::take(&mut self.lines);
        lines.into_iter().filter(|(_, own, _)| *own == channel).map(|(at, _, byte)| (at, byte)).collect()
    }

    /// Sends a request and gives the one frame that answers it within 10 ms; `-` when there is none.
    pub fn ask(&mut self, request: &str) -> String {
        self.take();
        self.frame(request);
        self.run_for(10);
        let answers = self.frames();
        assert!(answers.len() <= 1, "{answers:?}");
        answers.first().cloned().unwrap_or_else(|| "-".to_owned())
    }

    /// Requests and their answers, one after the other.
    #[track_caller]
    pub fn talk(&mut self, conversation: &[(&str, &str)]) {
        for (request, answer) in conversation {
            assert_eq!(self.ask(request), *answer, "{request}");
        }
    }

    /// What is remarkable about it, in one line.
    pub fn device_remarks(&self) -> String {
        self.device.status().to_string()
    }

    pub fn says(&self, remark: &str) -> bool {
        self.device.status().says(remark)
    }
}
