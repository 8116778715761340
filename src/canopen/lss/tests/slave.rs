//! LSS slaves for the tests, written from CiA 305 without the master's codec, and a bus with several of them.

use super::{LssAddress, LssAnswer, LssError, LssJob, LssMaster, LssOutput, LssSettings, at};
use crate::can::{CanFrame, CanId};

type Payload = [u8; 8];

/// One slave.
#[derive(Clone, Debug, Default)]
pub(super) struct Slave {
    pub(super) address: [u32; 4],
    /// 0xFF: none.
    pub(super) node: u8,
    pub(super) configuring: bool,
    /// How many of the frames of `switch selective`, or `identify`, have matched in a row.
    selected: usize,
    identified: usize,
    /// Which part fastscan has come to.
    part: u8,
    /// Says yes to every question.
    pub(super) liar: bool,
}

impl Slave {
    pub(super) fn new(address: LssAddress, node: u8) -> Self {
        let LssAddress { vendor, product, revision, serial } = address;
        Self { address: [vendor, product, revision, serial], node, ..Self::default() }
    }

    fn handle(&mut self, request: Payload) -> Option<Payload> {
        let number = u32::from_le_bytes(request[1..5].try_into().unwrap());
        let answer = |command: u8| Some([command, 0, 0, 0, 0, 0, 0, 0]);
        match request[0] {
            0x04 => self.configuring = request[1] == 1,
            0x40..=0x43 if !self.configuring => {
                let place = usize::from(request[0] - 0x40);
                let matches = self.address[place] == number && (place == 0 || self.selected == place);
                self.selected = if matches { place + 1 } else { 0 };
                self.configuring = self.selected == 4;
                return answer(0x44).filter(|_| self.configuring);
            }
            0x46..=0x4B => {
                let place = usize::from(request[0] - 0x46);
                let [vendor, product, revision, serial] = self.address;
                let fits = match place {
                    0 => vendor == number,
                    1 => product == number,
                    2 => revision >= number,
                    3 => revision <= number,
                    4 => serial >= number,
                    _ => serial <= number,
                };
                self.identified =
                    if fits && (place == 0 || self.identified == place) { place + 1 } else { 0 };
                return answer(0x4F).filter(|_| self.identified == 6 || self.liar && place == 5);
            }
            0x4C if self.node == 0xFF => return answer(0x50),
            0x51 if self.node == 0xFF && !self.configuring => return self.fastscan(number, request),
            0x11 if self.configuring => {
                self.node = request[1];
                return answer(0x11);
            }
            0x5A..=0x5D if self.configuring => {
                let [a, b, c, d] = self.address[usize::from(request[0] - 0x5A)].to_le_bytes();
                return Some([request[0], a, b, c, d, 0, 0, 0]);
            }
            _ => {}
        }
        None
    }

    fn fastscan(&mut self, number: u32, request: Payload) -> Option<Payload> {
        let [.., bit, part, next] = request;
        let yes = Some([0x4F, 0, 0, 0, 0, 0, 0, 0]);
        if bit == 0x80 {
            self.part = 0;
            return yes;
        }
        let own = self.address[usize::from(part)];
        if part != self.part || (own ^ number) >> bit != 0 {
            return None;
        }
        if bit == 0 && next != part {
            self.configuring = next < part;
            self.part = next;
        }
        yes
    }
}

/// A bus with slaves.
pub(super) struct Bus {
    pub(super) slaves: Vec<Slave>,
    pub(super) master: LssMaster,
    pub(super) now: u64,
    /// Every so many-th frame to the slaves gets lost.
    pub(super) lost: usize,
    /// How much later than its neighbour each slave answers, in milliseconds.
    pub(super) lag: u64,
    frames: usize,
}

impl Bus {
    pub(super) fn new(slaves: Vec<Slave>) -> Self {
        let master = LssMaster::new(LssSettings::default());
        Self { slaves, master, now: 0, lost: usize::MAX, lag: 6, frames: 0 }
    }

    /// Runs a job to its end; slaves answer one after the other, some milliseconds later.
    pub(super) fn run(&mut self, job: LssJob) -> Result<LssAnswer, LssError> {
        self.master.request(at(self.now), job)?;
        let mut answers: Vec<(u64, Payload)> = Vec::new();
        for _ in 0..1_000_000 {
            while let Some(output) = self.master.poll_output() {
                match output {
                    LssOutput::Transmit(frame) => {
                        assert_eq!((frame.id(), frame.dlc()), (CanId::Standard(0x7E5), 8));
                        self.frames += 1;
                        if self.frames.is_multiple_of(self.lost) {
                            continue;
                        }
                        let payload = frame.data().try_into().unwrap();
                        for (place, slave) in (0..).zip(&mut self.slaves) {
                            answers.extend(
                                slave.handle(payload).map(|answer| (self.now + 3 + self.lag * place, answer)),
                            );
                        }
                    }
                    LssOutput::Perform(duty) => panic!("{duty:?}"),
                    LssOutput::Found(_) => {}
                    LssOutput::Done(result) => return result,
                }
            }
            answers.sort_unstable();
            let due = self.master.poll_timeout().expect("a job waits for something").0.as_millis();
            match answers.first() {
                Some((when, answer)) if *when <= due => {
                    self.now = self.now.max(*when);
                    let frame = CanFrame::data_frame(CanId::Standard(0x7E4), answer).unwrap();
                    self.master.handle_frame(at(self.now), &frame);
                    answers.remove(0);
                }
                _ => {
                    self.now = self.now.max(due);
                    self.master.handle_timeout(at(self.now));
                }
            }
        }
        panic!("no end");
    }
}
