//! What the answers of a LAWICEL adapter mean: to which command each belongs, and what is known of the adapter. Pure.
//!
//! Most answers bear no name. Adapters answer in the order of the commands, but many are silent about frames that they
//! took: until an adapter was seen to acknowledge a frame, a refusal is taken for that of the latest command.

use std::collections::VecDeque;
use std::time::Duration;

use super::controller::{ErrorReport, LinkTracker};
use super::slcan::{Flags, Incoming};
use super::{BusEvent, CanFrame, Link, Tally};
use crate::time::{Instant, Now};

/// How often [`Answers::handle_timeout`] is to be called: it asks for the status flags.
pub const FLAGS_EVERY: Duration = Duration::from_secs(1);
/// Unanswered questions for the flags after which an adapter that had answered is taken for dead.
const LOST_ANSWERS: u32 = 3;
/// Refused questions for the flags, with no answer in between, after which an adapter that had answered has closed its
/// channel. One may be the refusal of a frame.
const REFUSED_ANSWERS: u32 = 2;
/// An answer that is not there by now does not come.
const FORGET_AFTER: Duration = Duration::from_secs(2);
/// Commands that may await their answers; then the oldest is taken for answered.
const OPEN_COMMANDS: usize = 64;
/// A controller that is off the bus for so long does not come back by itself, or its adapter does not tell.
const LONGEST_BUS_OFF: Duration = Duration::from_secs(5);

/// What an adapter is asked to do while its channel is open.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Command {
    /// Send a frame.
    Send(CanFrame),
    /// Tell the status flags, `F`.
    AskFlags,
}

/// Why the channel cannot be used as it is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum Ending {
    /// It had answered before.
    #[error("the adapter does not answer any more")]
    Silent,
    /// It restarted, for example.
    #[error("the adapter closed its channel: it was restarted, or somebody else uses it")]
    Closed,
    /// The adapter is there, and it may help to open its channel anew: it was still starting when that was done first,
    /// or its controller stays off the bus.
    #[error("the adapter's channel has to be opened anew")]
    OpenAnew,
}

/// All that is known of one adapter, from the opening of its port on.
#[derive(Debug, Default)]
pub struct Answers {
    tally: Tally,
    tracker: LinkTracker,
    bus_off_since: Option<Instant>,
    /// In the order in which they were sent.
    commands: VecDeque<Sent>,
    flags: Asking,
    /// Has acknowledged a frame.
    acknowledges: bool,
    /// Was silent while its channel was opened: it may not have heard.
    is_deaf: bool,
    was_opened: bool,
}

#[derive(Clone, Copy, Debug)]
struct Sent {
    command: Command,
    at: Instant,
    is_written: bool,
}

/// What is known about an adapter's answers to `F`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Asking {
    /// Has never answered; was asked this often.
    New(u32),
    /// Has answered; since then was asked and has refused this often.
    Answers { asked: u32, refused: u32 },
    /// Refuses the question, or does not know it.
    Never,
}

impl Default for Asking {
    fn default() -> Self {
        Self::New(0)
    }
}

impl Answers {
    /// What was counted.
    #[must_use]
    pub fn tally(&self) -> Tally {
        self.tally
    }

    /// The channel was opened, with or without an answer of the adapter, at this bit rate in bit/s. Gives the link.
    pub fn handle_opened(&mut self, answered: bool, bit_rate: Option<u32>) -> Link {
        self.tally.bit_rate = bit_rate;
        self.tracker = LinkTracker::default();
        self.tracker.handle_frame();
        self.bus_off_since = None;
        self.commands.clear();
        self.flags = match self.flags {
            Asking::New(_) => Asking::New(0),
            Asking::Answers { .. } => Asking::Answers { asked: 0, refused: 0 },
            Asking::Never => Asking::Never,
        };
        // An adapter that was silent twice is so by nature.
        self.is_deaf = !answered && !self.was_opened;
        self.was_opened = true;
        self.tracker.link()
    }

    /// A command is about to be written.
    pub fn handle_sending(&mut self, command: Command, at: Instant) {
        self.forget(at);
        if self.commands.len() >= OPEN_COMMANDS {
            self.commands.pop_front();
        }
        self.commands.push_back(Sent { command, at, is_written: false });
    }

    /// The latest command was written.
    pub fn handle_written(&mut self) {
        if let Some(sent) = self.commands.back_mut() {
            sent.is_written = true;
        }
    }

    /// The channel is not used any more. Gives the frames that did not leave, as far as that is known: those that were not
    /// written, and those that an adapter has not acknowledged that acknowledges frames.
    pub fn handle_closed(&mut self) -> Vec<CanFrame> {
        let lost = |sent: &Sent| self.acknowledges || !sent.is_written;
        let frame = |sent: &Sent| match sent.command {
            Command::Send(frame) => Some(frame),
            Command::AskFlags => None,
        };
        let frames = self.commands.iter().filter(|sent| lost(sent)).filter_map(frame).collect();
        self.commands.clear();
        frames
    }

    /// What the adapter said: the new link if it changed, and what else it tells the gateway.
    ///
    /// # Errors
    /// The channel cannot be used as it is.
    pub fn handle_incoming(
        &mut self,
        incoming: Incoming,
        now: Now,
    ) -> Result<(Option<Link>, Option<BusEvent>), Ending> {
        match incoming {
            Incoming::Frame(frame) => {
                self.is_deaf = false;
                let link = self.tracker.handle_frame();
                self.follow(link, now.instant);
                return Ok((link, Some(BusEvent::Frame { frame, at: now })));
            }
            Incoming::Fd => self.tally.fd_frames = self.tally.fd_frames.saturating_add(1),
            Incoming::BusError => self.tally.error_frames = self.tally.error_frames.saturating_add(1),
            Incoming::State(link) => return Ok((self.tell(link, now.instant), None)),
            Incoming::Flags(flags) => return Ok((self.handle_flags(flags, now.instant)?, None)),
            Incoming::Done | Incoming::Sent => self.handle_done(incoming, now.instant),
            Incoming::Refused => return Ok((None, self.handle_refused(now)?)),
            Incoming::Garbage => tracing::debug!("the adapter sent a line that means nothing"),
        }
        Ok((None, None))
    }

    /// Comes every [`FLAGS_EVERY`]. Whether to ask for the flags now.
    ///
    /// # Errors
    /// The channel cannot be used as it is.
    pub fn handle_timeout(&mut self, now: Instant) -> Result<bool, Ending> {
        if self.bus_off_since.is_some_and(|since| now.since(since) >= LONGEST_BUS_OFF) {
            return Err(Ending::OpenAnew);
        }
        match &mut self.flags {
            Asking::New(asked) if *asked >= LOST_ANSWERS => self.flags = Asking::Never,
            Asking::Answers { asked, .. } if *asked >= LOST_ANSWERS => return Err(Ending::Silent),
            Asking::New(asked) | Asking::Answers { asked, .. } => *asked += 1,
            Asking::Never => {}
        }
        Ok(self.flags != Asking::Never)
    }

    fn handle_flags(&mut self, flags: Flags, now: Instant) -> Result<Option<Link>, Ending> {
        if self.is_deaf {
            return Err(Ending::OpenAnew);
        }
        self.flags = Asking::Answers { asked: 0, refused: 0 };
        while self.commands.pop_front().is_some_and(|sent| sent.command != Command::AskFlags) {}
        let tally = &mut self.tally;
        tally.overruns = tally.overruns.saturating_add(u64::from(flags.lost_frames()));
        tally.error_frames = tally.error_frames.saturating_add(u64::from(flags.bus_error()));
        // The flags do not know bus-off.
        if self.tracker.link() == Link::BusOff {
            return Ok(None);
        }
        Ok(self.tell(if flags.error_passive() { Link::ErrorPassive } else { Link::ErrorActive }, now))
    }

    fn handle_done(&mut self, incoming: Incoming, now: Instant) {
        self.forget(now);
        if incoming == Incoming::Sent {
            // A question before it was not answered and will not be.
            while self.commands.front().is_some_and(|sent| sent.command == Command::AskFlags) {
                self.commands.pop_front();
            }
        }
        if let Some(Sent { command: Command::Send(_), .. }) = self.commands.pop_front() {
            self.acknowledges = true;
            self.is_deaf = false;
        }
    }

    fn handle_refused(&mut self, now: Now) -> Result<Option<BusEvent>, Ending> {
        self.forget(now.instant);
        if self.is_deaf {
            return Err(Ending::OpenAnew);
        }
        let refused = if self.acknowledges { self.commands.pop_front() } else { self.commands.pop_back() };
        match refused.map(|sent| sent.command) {
            Some(Command::Send(frame)) => return Ok(Some(BusEvent::NotSent { frame, at: now })),
            Some(Command::AskFlags) => match &mut self.flags {
                Asking::Answers { refused, .. } => {
                    *refused += 1;
                    if *refused >= REFUSED_ANSWERS {
                        return Err(Ending::Closed);
                    }
                }
                Asking::New(_) | Asking::Never => self.flags = Asking::Never,
            },
            None => {}
        }
        Ok(None)
    }

    fn tell(&mut self, link: Link, now: Instant) -> Option<Link> {
        let change = self.tracker.handle_error(ErrorReport { link: Some(link), is_error: false });
        self.follow(change, now);
        change
    }

    fn follow(&mut self, change: Option<Link>, now: Instant) {
        if let Some(link) = change {
            self.bus_off_since = (link == Link::BusOff).then_some(now);
        }
    }

    /// Answers that did not come: many adapters are silent about frames that they took.
    fn forget(&mut self, now: Instant) {
        while self.commands.front().is_some_and(|sent| now.since(sent.at) > FORGET_AFTER) {
            self.commands.pop_front();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::can::slcan::Decoder;

    /// An adapter whose channel is open, and the time.
    struct Bench {
        answers: Answers,
        millis: u64,
    }

    fn opened(answered: bool) -> Bench {
        let mut answers = Answers::default();
        assert_eq!(answers.handle_opened(answered, Some(125_000)), Link::ErrorActive);
        Bench { answers, millis: 0 }
    }

    impl Bench {
        fn send(&mut self, command: Command) {
            self.answers.handle_sending(command, Instant::from_millis(self.millis));
            self.answers.handle_written();
        }

        fn send_frames(&mut self, frames: &[&str]) {
            for text in frames {
                self.send(Command::Send(frame(text)));
            }
        }

        /// The adapter says this; what the last line of it did.
        fn hear(&mut self, text: &str) -> Result<(Option<Link>, Option<BusEvent>), Ending> {
            let now = Now::from_millis(self.millis);
            let mut decoder = Decoder::default();
            let heard = text.bytes().filter_map(|byte| decoder.push(byte));
            heard.map(|incoming| self.answers.handle_incoming(incoming, now)).last().unwrap()
        }

        /// A second passes; whether the flags are asked for.
        fn second(&mut self) -> Result<bool, Ending> {
            self.millis += 1_000;
            let ask = self.answers.handle_timeout(Instant::from_millis(self.millis))?;
            if ask {
                self.send(Command::AskFlags);
            }
            Ok(ask)
        }

        /// The frame that what the adapter says gives back.
        fn given_back(&mut self, text: &str) -> String {
            match self.hear(text) {
                Ok((None, Some(BusEvent::NotSent { frame, .. }))) => frame.to_string(),
                other => panic!("{other:?}"),
            }
        }
    }

    fn frame(text: &str) -> CanFrame {
        text.parse().unwrap()
    }

    #[test]
    fn p20_an_adapter_that_acknowledges_refuses_the_oldest_open_frame() {
        let mut bench = opened(true);
        bench.send_frames(&["000#0101", "701#R1", "702#R1"]);
        assert_eq!(bench.given_back("z\r\x07"), "701#R1");
        bench.send_frames(&["703#R1"]);
        assert_eq!(bench.given_back("\r\x07"), "703#R1");
    }

    #[test]
    fn p20_an_adapter_that_has_acknowledged_nothing_refuses_the_latest_frame() {
        let mut bench = opened(true);
        bench.send_frames(&["000#0101", "701#R1"]);
        assert_eq!(bench.given_back("\x07"), "701#R1");
        bench.millis += 100;
        bench.send_frames(&["702#R1"]);
        assert_eq!(bench.given_back("\x07"), "702#R1");
    }

    #[test]
    fn an_acknowledgement_never_belongs_to_a_question() {
        let mut bench = opened(true);
        bench.send(Command::AskFlags);
        bench.send_frames(&["701#R1", "702#R1"]);
        assert_eq!(bench.given_back("z\r\x07"), "702#R1");
    }

    #[test]
    fn an_answer_that_never_came_is_not_awaited_for_ever() {
        let mut bench = opened(true);
        bench.send_frames(&["701#R1", "702#R1"]);
        assert_eq!(bench.hear("z\r"), Ok((None, None)));
        bench.millis += 2_001;
        bench.send_frames(&["703#R1"]);
        assert_eq!(bench.given_back("\x07"), "703#R1");
    }

    #[test]
    fn an_adapter_that_answered_and_now_refuses_has_closed_its_channel() {
        let mut bench = opened(true);
        for _ in 0..5 {
            assert_eq!(bench.second(), Ok(true));
            assert!(bench.hear("F00\r").is_ok());
        }
        assert_eq!(bench.second(), Ok(true));
        assert_eq!(bench.hear("\x07"), Ok((None, None)), "it may be the refusal of a frame");
        assert_eq!(bench.second(), Ok(true));
        assert_eq!(bench.hear("\x07"), Err(Ending::Closed));
    }

    #[test]
    fn refused_frames_do_not_close_the_channel() {
        let mut bench = opened(true);
        for _ in 0..20 {
            bench.send_frames(&["701#R1"]);
            bench.second().unwrap();
            // The refusal of the frame, when the question had already gone out.
            bench.hear("\x07").unwrap();
            bench.hear("F00\r").unwrap();
        }
    }

    #[test]
    fn an_adapter_that_never_answered_and_refuses_is_not_asked_again() {
        let mut bench = opened(true);
        assert_eq!(bench.second(), Ok(true));
        assert_eq!(bench.hear("\x07"), Ok((None, None)));
        assert_eq!(bench.second(), Ok(false));
    }

    #[test]
    fn an_adapter_that_stops_answering_is_given_up_and_one_that_never_did_is_used_without() {
        let mut bench = opened(true);
        bench.second().unwrap();
        bench.hear("F00\r").unwrap();
        for _ in 0..3 {
            assert_eq!(bench.second(), Ok(true));
        }
        assert_eq!(bench.second(), Err(Ending::Silent));

        let mut bench = opened(true);
        let asked = (0..10).filter(|_| bench.second().unwrap()).count();
        assert_eq!(asked, 3);
    }

    #[test]
    fn an_adapter_that_was_still_starting_is_opened_anew_when_it_shows_itself() {
        for shows_itself in ["\x07", "F00\r"] {
            let mut bench = opened(false);
            bench.second().unwrap();
            assert_eq!(bench.hear(shows_itself), Err(Ending::OpenAnew));
            // Silent again: it is so by nature.
            bench.answers.handle_opened(false, None);
            bench.second().unwrap();
            assert_eq!(bench.hear(shows_itself), Ok((None, None)));
        }
    }

    #[test]
    fn a_silent_adapter_that_gives_frames_or_takes_them_is_open() {
        for proof in ["t1810\r", "z\r"] {
            let mut bench = opened(false);
            bench.send_frames(&["701#R1"]);
            bench.hear(proof).unwrap();
            bench.second().unwrap();
            assert_eq!(bench.hear("F00\r"), Ok((None, None)), "{proof}");
        }
    }

    #[test]
    fn a_controller_that_stays_off_the_bus_is_opened_anew() {
        let mut bench = opened(true);
        assert_eq!(bench.hear("sb000256\r"), Ok((Some(Link::BusOff), None)));
        for _ in 0..4 {
            assert!(bench.second().is_ok());
            assert_eq!(bench.hear("F20\r"), Ok((None, None)), "the flags do not know bus-off");
        }
        assert_eq!(bench.second(), Err(Ending::OpenAnew));
        assert_eq!(bench.answers.handle_opened(true, None), Link::ErrorActive);
        for _ in 0..10 {
            assert!(bench.second().is_ok());
            bench.hear("F00\r").unwrap();
        }
    }

    #[test]
    fn a_bus_off_that_ended_in_time_is_forgotten() {
        for end in ["sa000000\r", "t1810\r"] {
            let mut bench = opened(true);
            bench.hear("sb000256\r").unwrap();
            bench.second().unwrap();
            assert_eq!(bench.hear(end).unwrap().0, Some(Link::ErrorActive));
            for _ in 0..10 {
                bench.second().unwrap();
                bench.hear("F00\r").unwrap();
            }
        }
    }

    #[test]
    fn what_was_not_written_or_not_acknowledged_comes_back_at_the_end() {
        let mut bench = opened(true);
        bench.send_frames(&["701#R1"]);
        bench.answers.handle_sending(Command::Send(frame("702#R1")), Instant::START);
        assert_eq!(
            bench.answers.handle_closed(),
            [frame("702#R1")],
            "this adapter may be silent about frames"
        );
        bench.send_frames(&["701#R1", "702#R1"]);
        bench.hear("z\r").unwrap();
        bench.send(Command::AskFlags);
        assert_eq!(bench.answers.handle_closed(), [frame("702#R1")], "this one would have acknowledged it");
        assert_eq!(bench.answers.handle_closed(), []);
    }

    #[test]
    fn commands_without_answers_do_not_pile_up() {
        let mut bench = opened(true);
        for _ in 0..1_000 {
            bench.send_frames(&["701#R1"]);
        }
        bench.send_frames(&["702#R1"]);
        assert_eq!(bench.answers.commands.len(), OPEN_COMMANDS);
        assert_eq!(bench.given_back("\x07"), "702#R1");
    }
}
