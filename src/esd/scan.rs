//! Which modules are on a bus (R-ESD-069, 070).
//!
//! Modules with news answer the service request, all with the same empty frame. So the range of numbers is halved until
//! single ones are left. Modules without news, whose manager has seen to them, do not answer that: they are found by
//! asking each number, which is slower. Nothing is changed in any module.

use std::collections::{BTreeMap, VecDeque};
use std::time::Duration;

use super::answer::Answer;
use super::identifiers::ModuleNumber;
use super::init_frame::{InitCommand, Request};
use crate::can::{CanFrame, CanId};
use crate::time::{Instant, Now};

/// All modules of a range answer at once: after the first answer the others have this time.
const OTHERS: Duration = Duration::from_millis(20);
/// A question that does not leave so often in a row ends the scan.
const MOST_UNSENT: u32 = 10;

/// What is to be looked for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ScanSettings {
    /// Identifier of the answers, 0..=0x7FF; nobody else may use it.
    pub reply_id: u16,
    /// The lowest number.
    pub low: ModuleNumber,
    /// The highest number.
    pub high: ModuleNumber,
    /// How long an answer may take.
    pub timeout: Duration,
    /// Ask each number too.
    pub ask_each: bool,
}

/// What a scan wants done, or tells.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ScanOutput {
    /// Send a frame.
    Transmit(CanFrame),
    /// There is a module of this number.
    Found {
        /// Its number.
        number: ModuleNumber,
        /// It started, or had a CAN error, and nobody has seen to that.
        news: bool,
    },
    /// The scan is over. `complete`: all was asked; else questions did not leave.
    Done {
        /// All was asked.
        complete: bool,
    },
}

/// A scan.
#[derive(Debug)]
pub struct Scan {
    settings: ScanSettings,
    /// Ranges that are still to be asked, the next one last.
    ranges: Vec<(u8, u8)>,
    /// Numbers that are still to be asked one by one.
    numbers: VecDeque<ModuleNumber>,
    open: Option<Open>,
    unsent: u32,
    /// With whether it had news.
    found: BTreeMap<ModuleNumber, bool>,
    outputs: VecDeque<ScanOutput>,
}

#[derive(Clone, Copy, Debug)]
struct Open {
    question: Question,
    frame: CanFrame,
    deadline: Instant,
    answered: bool,
    /// It did not leave.
    unsent: bool,
}

#[derive(Clone, Copy, Debug)]
enum Question {
    Range(u8, u8),
    Number(ModuleNumber),
}

impl Scan {
    /// Begins at once.
    #[must_use]
    pub fn new(settings: ScanSettings, now: Now) -> Self {
        let (low, high) = (settings.low.get(), settings.high.get());
        let numbers = (low..=high).filter(|_| settings.ask_each);
        let mut scan = Self {
            settings,
            ranges: if low <= high { vec![(low, high)] } else { Vec::new() },
            numbers: numbers.filter_map(ModuleNumber::new).collect(),
            open: None,
            unsent: 0,
            found: BTreeMap::new(),
            outputs: VecDeque::new(),
        };
        scan.ask_next(now.instant);
        scan
    }

    /// Takes a frame that another node sent.
    pub fn handle_frame(&mut self, now: Now, frame: &CanFrame) {
        if frame.is_remote() || CanId::standard(self.settings.reply_id) != Some(frame.id()) {
            return;
        }
        let Some(open) = &mut self.open else { return };
        let answers = match open.question {
            Question::Range(..) => frame.data().is_empty(),
            Question::Number(number) => {
                Answer::parse(Request::ActiveNumber, frame.data()) == Some(Answer::Number(number.get()))
            }
        };
        if answers && !open.answered {
            open.answered = true;
            open.unsent = false;
            open.deadline = open.deadline.min(now.instant + OTHERS);
        }
    }

    /// A question did not leave: it is asked again.
    pub fn handle_not_sent(&mut self, _now: Now, frame: &CanFrame) {
        if let Some(open) = self.open.as_mut().filter(|open| open.frame == *frame && !open.answered) {
            open.unsent = true;
        }
    }

    /// What became due.
    pub fn handle_timeout(&mut self, now: Now) {
        let Some(open) = self.open.take_if(|open| open.deadline <= now.instant) else { return };
        if open.unsent {
            self.unsent += 1;
            if self.unsent >= MOST_UNSENT {
                self.outputs.push_back(ScanOutput::Done { complete: false });
                return;
            }
            return self.ask(now.instant, open.question);
        }
        self.unsent = 0;
        match open.question {
            Question::Range(low, high) if open.answered && low < high => {
                let middle = low + (high - low) / 2;
                self.ranges.extend([(middle + 1, high), (low, middle)]);
            }
            Question::Range(number, _) if open.answered => self.find(ModuleNumber::new(number), true),
            Question::Number(number) if open.answered => self.find(Some(number), false),
            Question::Range(..) | Question::Number(_) => {}
        }
        self.ask_next(now.instant);
    }

    /// What is to be done; call until `None` after each of the calls above.
    pub fn poll_output(&mut self) -> Option<ScanOutput> {
        self.outputs.pop_front()
    }

    /// When `handle_timeout` is to be called, and why; `None` when the scan is over.
    #[must_use]
    pub fn poll_timeout(&self) -> Option<(Instant, &'static str)> {
        self.open.as_ref().map(|open| (open.deadline, "answers of modules"))
    }

    /// The modules that were found until now, each with whether it had news.
    pub fn found(&self) -> impl Iterator<Item = (ModuleNumber, bool)> {
        self.found.iter().map(|(number, news)| (*number, *news))
    }

    fn find(&mut self, number: Option<ModuleNumber>, news: bool) {
        let Some(number) = number else { return };
        self.found.insert(number, news);
        self.numbers.retain(|each| *each != number);
        self.outputs.push_back(ScanOutput::Found { number, news });
    }

    fn ask_next(&mut self, now: Instant) {
        let range = self.ranges.pop().map(|(low, high)| Question::Range(low, high));
        match range.or_else(|| self.numbers.pop_front().map(Question::Number)) {
            Some(question) => self.ask(now, question),
            None => self.outputs.push_back(ScanOutput::Done { complete: true }),
        }
    }

    fn ask(&mut self, now: Instant, question: Question) {
        let reply_id = self.settings.reply_id;
        let command = match question {
            Question::Range(low, high) => InitCommand::Service { low, high, reply_id },
            Question::Number(module) => {
                InitCommand::Request { module, request: Request::ActiveNumber, reply_id }
            }
        };
        let frame = command.frame();
        let deadline = now + self.settings.timeout;
        self.open = Some(Open { question, frame, deadline, answered: false, unsent: false });
        self.outputs.push_back(ScanOutput::Transmit(frame));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Modules on a bus: number, and whether it has news.
    type Modules = &'static [(u8, bool)];

    fn number(number: u8) -> ModuleNumber {
        ModuleNumber::new(number).unwrap()
    }

    fn settings(low: u8, high: u8, ask_each: bool) -> ScanSettings {
        let timeout = Duration::from_millis(50);
        ScanSettings { reply_id: 0x567, low: number(low), high: number(high), timeout, ask_each }
    }

    /// Runs a scan to its end; what it found, its frames, and the time it took in ms.
    fn scan(settings: ScanSettings, modules: Modules) -> (Vec<(u8, bool)>, Vec<String>, u64) {
        let mut now = Now::from_millis(0);
        let mut scan = Scan::new(settings, now);
        let mut frames = Vec::new();
        let mut done = false;
        while !done {
            let mut answers = Vec::new();
            while let Some(output) = scan.poll_output() {
                match output {
                    ScanOutput::Transmit(frame) => {
                        frames.push(frame.to_string());
                        answers.extend(modules.iter().filter_map(|module| answer(*module, &frame)));
                    }
                    ScanOutput::Found { .. } => {}
                    ScanOutput::Done { complete } => done = complete,
                }
            }
            for answer in answers {
                now = now.later(Duration::from_micros(200));
                scan.handle_frame(now, &answer);
            }
            if let Some((at, _)) = scan.poll_timeout() {
                now = now.later(at.since(now.instant));
                scan.handle_timeout(now);
            }
        }
        let found = scan.found().map(|(number, news)| (number.get(), news)).collect();
        (found, frames, now.instant.as_millis())
    }

    fn answer((number, news): (u8, bool), frame: &CanFrame) -> Option<CanFrame> {
        let text = match InitCommand::parse(frame)? {
            InitCommand::Service { low, high, .. } if news && (low..=high).contains(&number) => {
                "567#".to_owned()
            }
            InitCommand::Request { module, request: Request::ActiveNumber, .. } if module.get() == number => {
                format!("567#0101{number:02X}")
            }
            InitCommand::Service { .. }
            | InitCommand::Request { .. }
            | InitCommand::Set { .. }
            | InitCommand::Supervisor { .. } => return None,
        };
        Some(text.parse().unwrap())
    }

    #[test]
    fn r_esd_069_070_v_esd_06_the_range_is_halved_until_single_modules_are_left() {
        let modules: Modules = &[(0x03, true), (0x11, true)];
        let (found, frames, _) = scan(settings(0x01, 0x12, false), modules);
        assert_eq!(found, modules);
        assert_eq!(frames[..3], ["700#7F0112000567", "700#7F0109000567", "700#7F0105000567"]);
        assert!(frames.contains(&"700#7F1111000567".to_owned()), "one module: low = high");
    }

    #[test]
    fn r_esd_070_every_module_is_found_wherever_it_is_in_the_range() {
        for module in [1, 2, 127, 128, 253, 254] {
            let modules: Modules = Box::leak(Box::new([(module, true)]));
            assert_eq!(scan(settings(1, 254, false), modules).0, modules);
        }
        let all: Vec<(u8, bool)> = (1..=254).map(|number| (number, true)).collect();
        assert_eq!(scan(settings(1, 254, false), Box::leak(all.clone().into_boxed_slice())).0, all);
    }

    #[test]
    fn r_esd_070_modules_without_news_are_found_by_asking_each_number() {
        let modules: Modules = &[(0x05, false), (0x06, true), (0xFE, false)];
        assert_eq!(scan(settings(1, 254, false), modules).0, [(0x06, true)]);
        let (found, frames, took) = scan(settings(1, 254, true), modules);
        assert_eq!(found, modules);
        assert_eq!(frames.iter().filter(|frame| frame.starts_with("700#0101")).count(), 253, "not 6 again");
        assert!(took <= 254 * 50 + 2000, "{took} ms");
    }

    #[test]
    fn an_empty_bus_and_an_empty_range_have_an_end() {
        assert_eq!(scan(settings(1, 254, false), &[]), (vec![], vec!["700#7F01FE000567".to_owned()], 50));
        assert_eq!(scan(settings(9, 8, true), &[]).0, []);
    }

    #[test]
    fn a_question_that_did_not_leave_is_asked_again_and_not_for_ever() {
        let mut scan = Scan::new(settings(1, 1, false), Now::from_millis(0));
        let mut sent = 0;
        for step in 1_u64.. {
            match scan.poll_output() {
                Some(ScanOutput::Transmit(frame)) => {
                    sent += 1;
                    scan.handle_not_sent(Now::from_millis(50 * step), &frame);
                    scan.handle_timeout(Now::from_millis(50 * step));
                }
                output => {
                    assert_eq!(output, Some(ScanOutput::Done { complete: false }));
                    break;
                }
            }
        }
        assert_eq!((sent, scan.poll_timeout()), (10, None));
    }

    #[test]
    fn frames_that_are_no_answers_are_ignored() {
        let mut scan = Scan::new(settings(1, 1, true), Now::from_millis(0));
        for text in ["567#00", "567#R0", "568#", "00000567#"] {
            scan.handle_frame(Now::from_millis(1), &text.parse().unwrap());
        }
        scan.handle_timeout(Now::from_millis(50));
        scan.handle_frame(Now::from_millis(51), &"567#010102".parse().unwrap());
        scan.handle_frame(Now::from_millis(51), &"567#".parse().unwrap());
        scan.handle_timeout(Now::from_millis(100));
        assert_eq!(scan.found().count(), 0);
    }
}
