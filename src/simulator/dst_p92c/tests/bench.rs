//! A bus in numbers-time with one DST P92C on it.

use super::super::device::SimulatedDst;
use super::super::settings::DstSettings;
use crate::canopen::{NmtState, NodeId};
use crate::simulator::{Device, DevicePlan, Scenario, Settings};
use crate::time::Now;

/// The device, and what it sent.
pub struct Bench {
    pub device: SimulatedDst,
    now: u64,
    log: Vec<(u64, String)>,
}

/// A plant without noise: what is ordered is measured to the last digit.
pub fn quiet() -> DstSettings {
    DstSettings { noise: false, ..DstSettings::default() }
}

impl Bench {
    /// Node 1, powered on at 0.
    pub fn powered(settings: &DstSettings) -> Self {
        Self::of_node(1, settings)
    }

    pub fn of_node(node: u8, settings: &DstSettings) -> Self {
        let scenario = Scenario {
            description: String::new(),
            settings: Settings::DstP92c(Box::new(settings.clone())),
            events: Vec::new(),
        };
        let plan = DevicePlan::new(NodeId::new(node).unwrap(), scenario);
        let device = SimulatedDst::power_on(&plan, settings, Now::from_millis(0));
        let mut bench = Self { device, now: 0, log: Vec::new() };
        bench.drain();
        bench
    }

    /// Powered on and in Pre-Operational; what it sent meanwhile is forgotten.
    pub fn ready() -> Self {
        Self::ready_as(&quiet())
    }

    pub fn ready_as(settings: &DstSettings) -> Self {
        let mut bench = Self::powered(settings);
        bench.run_for(200);
        bench.take();
        bench
    }

    /// Asynchronous with its event timer of 1000 ms, and started just now.
    pub fn operational() -> Self {
        let mut bench = Self::ready_as(&DstSettings { default_transmission_type: 255, ..quiet() });
        bench.frame("000#0101");
        bench
    }

    pub fn now(&self) -> u64 {
        self.now
    }

    pub fn run_for(&mut self, millis: u64) {
        self.run_to(self.now + millis);
    }

    /// Lets time pass up to and including `millis`.
    pub fn run_to(&mut self, millis: u64) {
        let due = |device: &SimulatedDst| device.poll_timeout().map(|due| due.as_micros().div_ceil(1000));
        while let Some(due) = due(&self.device).filter(|due| *due <= millis) {
            self.now = due.max(self.now);
            self.device.handle_timeout(Now::from_millis(self.now));
            self.drain();
        }
        self.now = millis;
    }

    /// Another participant sends a frame now. Only what the device says that it hears is handed to it, as the task does.
    pub fn frame(&mut self, frame: &str) {
        let frame: crate::can::CanFrame = frame.parse().unwrap();
        if self.device.hears(frame.id()) {
            self.device.handle_frame(Now::from_millis(self.now), &frame);
        }
        self.drain();
    }

    #[track_caller]
    pub fn order(&mut self, line: &str) {
        let words: Vec<&str> = line.split(' ').collect();
        self.device.handle_line(Now::from_millis(self.now), &words).unwrap();
        self.drain();
    }

    fn drain(&mut self) {
        while let Some(frame) = self.device.poll_output() {
            self.log.push((self.now, frame.to_string()));
        }
    }

    /// What was sent since the last call, with its time.
    pub fn take(&mut self) -> Vec<(u64, String)> {
        std::mem::take(&mut self.log)
    }

    /// What was sent since the last call.
    pub fn frames(&mut self) -> Vec<String> {
        self.take().into_iter().map(|(_, frame)| frame).collect()
    }

    /// When frames with this beginning were sent since the last call; forgets the others.
    pub fn times(&mut self, beginning: &str) -> Vec<u64> {
        self.take().into_iter().filter(|(_, frame)| frame.starts_with(beginning)).map(|(at, _)| at).collect()
    }

    /// The frames with this beginning that were sent since the last call; forgets the others.
    pub fn of(&mut self, beginning: &str) -> Vec<String> {
        self.frames().into_iter().filter(|frame| frame.starts_with(beginning)).collect()
    }

    /// Sends a request and gives the one frame that answers it within 2 ms; `-` when there is none.
    pub fn ask(&mut self, request: &str) -> String {
        self.take();
        self.frame(request);
        self.run_for(2);
        let answers: Vec<_> = self.frames().into_iter().filter(|frame| is_answer(frame)).collect();
        assert!(answers.len() <= 1, "{answers:?}");
        answers.first().cloned().unwrap_or_else(|| "-".to_owned())
    }

    /// Requests and their answers.
    #[track_caller]
    pub fn talk(&mut self, conversation: &[(&str, &str)]) {
        for (request, answer) in conversation {
            assert_eq!(self.ask(request), *answer, "{request}");
        }
    }

    /// Reads a number of the dictionary of node 1.
    #[track_caller]
    pub fn read(&mut self, index: u16, sub: u8) -> u32 {
        let [low, high] = index.to_le_bytes();
        let node = self.device.node().get();
        let answer =
            self.ask(&format!("{:03X}#40{low:02X}{high:02X}{sub:02X}00000000", 0x600 + u16::from(node)));
        let data = answer.split_once('#').map_or_else(|| panic!("no answer"), |(_, data)| data);
        assert!(data.starts_with('4'), "{index:04X}/{sub}: {answer}");
        let bytes: Vec<u8> =
            (4..8).map(|at| u8::from_str_radix(&data[2 * at..2 * at + 2], 16).unwrap()).collect();
        u32::from_le_bytes(bytes.try_into().unwrap())
    }

    /// Writes a number of the dictionary, and gives the abort code or 0.
    #[track_caller]
    pub fn write(&mut self, index: u16, sub: u8, length: u8, value: u32) -> u32 {
        let [low, high] = index.to_le_bytes();
        let [a, b, c, d] = value.to_le_bytes();
        let command = 0x23 | (4 - length) << 2;
        let id = 0x600 + u16::from(self.device.node().get());
        let answer = self
            .ask(&format!("{id:03X}#{command:02X}{low:02X}{high:02X}{sub:02X}{a:02X}{b:02X}{c:02X}{d:02X}"));
        let data = answer.split_once('#').map_or_else(|| panic!("no answer"), |(_, data)| data);
        let code = |at: usize| u8::from_str_radix(&data[2 * at..2 * at + 2], 16).unwrap();
        match code(0) {
            0x60 => 0,
            0x80 => u32::from_le_bytes([code(4), code(5), code(6), code(7)]),
            other => panic!("{other:02X}"),
        }
    }

    pub fn state(&self) -> Option<NmtState> {
        self.device.status().state
    }
}

/// Of an SDO server or an LSS slave.
fn is_answer(frame: &str) -> bool {
    let id = u16::from_str_radix(&frame[..3], 16).unwrap();
    (0x581..=0x5FF).contains(&id) || id == 0x7E4
}
