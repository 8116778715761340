//! Tests of the LSS master: the frames of the DST P92C's manual, scans among slaves, changes with their way back.

mod changes;
mod properties;
mod scans;
mod services;
mod slave;

use super::{
    LssActivation, LssAddress, LssAnswer, LssBitRate, LssChange, LssError, LssJob, LssKnown, LssMaster,
    LssOutput, LssRange, LssSettings, LssState, LssTarget, Performed,
};
use crate::time::Instant;

/// The address of the worked examples (V-DST-19).
const DST: LssAddress =
    LssAddress { vendor: 0x23D, product: 0x1234_5678, revision: 0x0001_0203, serial: 123_456 };

fn at(millis: u64) -> Instant {
    Instant::from_millis(millis)
}

/// A conversation written down: what the master does, and what is done to it.
struct Script {
    master: LssMaster,
    now: Instant,
}

impl Script {
    fn new(settings: LssSettings) -> Self {
        Self { master: LssMaster::new(settings), now: at(0) }
    }

    fn begin(&mut self, job: LssJob) -> Vec<String> {
        self.master.request(self.now, job).unwrap();
        self.outputs()
    }

    /// All that the master does until it waits for an answer or a duty.
    fn outputs(&mut self) -> Vec<String> {
        let mut texts = Vec::new();
        loop {
            while let Some(output) = self.master.poll_output() {
                texts.push(match output {
                    LssOutput::Transmit(frame) => frame.to_string(),
                    LssOutput::Perform(duty) => format!("{duty:?}"),
                    LssOutput::Found(address) => address.to_string(),
                    LssOutput::Done(Ok(answer)) => format!("{answer:?}"),
                    LssOutput::Done(Err(error)) => format!("{error:?}"),
                });
            }
            match self.master.poll_timeout() {
                Some((at, "LSS frame" | "LSS pause")) => {
                    self.now = at;
                    self.master.handle_timeout(at);
                }
                _ => return texts,
            }
        }
    }

    fn answer(&mut self, frame: &str) -> Vec<String> {
        self.master.handle_frame(self.now, &frame.parse().unwrap());
        self.outputs()
    }

    fn performed(&mut self, performed: Performed) -> Vec<String> {
        self.master.handle_performed(self.now, performed);
        self.outputs()
    }

    /// Nobody answers.
    fn silence(&mut self) -> Vec<String> {
        self.now = self.master.poll_timeout().unwrap().0;
        self.master.handle_timeout(self.now);
        self.outputs()
    }
}
