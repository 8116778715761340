//! One serial line behind a module: what came in on it as messages, and what is to go out at the pace of the line
//! (R-ESD-032..039).
//!
//! A module keeps what it has not yet put on the line in a ring of 256 bytes and loses what does not fit without a word. So
//! the channel keeps account of what the ring can still hold, as if the line were a little slower than it is, and never lets
//! it come near its end. Within that, a frame that is sent late is made up for, so that a gateway whose timers are late
//! sends as fast as the line goes. What holds the line up unseen, which is CTS, is not in the account.
//!
//! A frame enters the account when the bus says that it left: what waits on the way there does not drain, and would leave in
//! one burst. Three quarters of the ring are left for what nobody tells of, such as frames that wait in the interface.

use std::collections::VecDeque;
use std::time::Duration;

use super::event::{Cause, MessageEnd, SendOutcome};
use super::framing::Messages;
use super::pace::Bucket;
use super::parameters::{SerialBits, byte_time_of, serial_mode_of};
use super::settings::{ChannelSettings, FlowControl};
use crate::can::{CanFrame, CanId};
use crate::time::Instant;

/// Jobs that wait or are under way at one time.
const MOST_JOBS: usize = 16;
/// Bytes of one job.
const LONGEST_JOB: usize = 4096;
/// Data bytes of a frame.
const FRAME_BYTES: usize = 8;
/// Bytes that the ring of the module may hold, for all that is known.
const AHEAD: u32 = 64;
/// The same where the other end of the line can say stop: all that is in the ring comes after that.
const AHEAD_WITH_FLOW_CONTROL: u32 = 16;
/// The whole ring.
const RING: u32 = 256;
/// Of the rate of the line so much is used, in percent: real rates differ from the nominal ones (R-ESD-010).
const USED_PERCENT: u32 = 98;

const XON: u8 = 0x11;
const XOFF: u8 = 0x13;
/// Bytes wait for the other end of the line, or for a module that was suspended, so long at most: then what waits is given up, as
/// it was meant for another time. After an XOFF the line is tried again with what comes next.
const LONGEST_HOLD: Duration = Duration::from_secs(60);

/// The newest frames, which may still be given back as not sent: more than the queue to the bus holds of one line.
const REMEMBERED: usize = 96;

/// A frame that found no room in the queue to the bus is tried again after this time, and how often: for a second, in which the
/// gateway does run. The same second on the clock could be one in which nothing did, and nothing was given up by the bus.
const REFUSED_AGAIN: Duration = Duration::from_millis(20);
const MOST_REFUSALS: u32 = 50;

/// One serial line.
#[derive(Debug)]
pub(super) struct SerialChannel {
    rx_id: CanId,
    /// Its number, 1..=5.
    number: u8,
    is_terminal: bool,
    /// It was ordered to have one stop bit: how the field is then.
    short: Option<u16>,
    byte_time: Duration,
    gap: Option<Duration>,
    flow_control: FlowControl,
    messages: Messages,
    jobs: VecDeque<Job>,
    ring: Bucket,
    /// Frames that were handed to the bus and have not left, for all that is known. They do not drain.
    on_way: VecDeque<CanFrame>,
    /// When the next frame may leave at the earliest, where there is a distance to keep.
    next: Instant,
    /// The other end said stop; it holds until then.
    stopped_until: Option<Instant>,
    /// The module was suspended then, and has not gone on.
    suspended: Option<Instant>,
    /// The newest frames, also of jobs that are over, but for those that are known not to count.
    sent: VecDeque<Sent>,
    /// The next frame was given out, and it is not known yet whether there was room for it.
    in_hand: bool,
    /// There was none: how often, and when it is tried again.
    refused: Option<(u32, Instant)>,
}

/// Bytes that are to go out together.
#[derive(Debug)]
struct Job {
    id: u64,
    bytes: Vec<u8>,
    /// When they came.
    since: Instant,
    /// How many were handed out.
    done: usize,
}

/// A frame that was handed to the bus.
#[derive(Debug)]
struct Sent {
    job: u64,
    /// Bytes of the job that stood before it.
    before: usize,
    frame: CanFrame,
}

/// Why bytes were not taken.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Full {
    /// Too many jobs.
    Jobs,
    /// More bytes than a job may have.
    Bytes,
}

/// A job that is over.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Ended {
    pub(super) id: u64,
    pub(super) outcome: SendOutcome,
}

/// What a frame that did not leave made of a line.
#[derive(Debug, Default, PartialEq, Eq)]
pub(super) struct Returned {
    /// Bytes that were handed out meanwhile.
    pub(super) handed: usize,
    /// Bytes of a job that is over, which were not sent after all.
    pub(super) missing: usize,
    pub(super) ended: Vec<Ended>,
}

impl SerialChannel {
    /// `is_terminal`: it always has one stop bit (R-ESD-012).
    pub(super) fn new(settings: &ChannelSettings, is_terminal: bool) -> Self {
        Self {
            rx_id: settings.rx_id,
            number: settings.number,
            is_terminal,
            short: settings
                .serial_mode
                .filter(|mode| settings.serial_bits.has(SerialBits::STOP_BITS) && mode.format.stop_bits == 1)
                .map(|_| if settings.stop_bit_set == 1 { SerialBits::STOP_BITS.0 } else { 0 }),
            byte_time: settings.byte_time * 100 / USED_PERCENT,
            gap: settings.gap,
            flow_control: settings.flow_control,
            messages: Messages::new(&settings.framing),
            jobs: VecDeque::new(),
            ring: Bucket::new(),
            on_way: VecDeque::new(),
            next: Instant::START,
            stopped_until: None,
            suspended: None,
            sent: VecDeque::new(),
            in_hand: false,
            refused: None,
        }
    }

    /// A frame came in from the line. Gives its bytes as a frame of their own, without those of flow control, and the
    /// messages that they end. [`handle_timeout`](Self::handle_timeout) is to be called before.
    pub(super) fn receive(
        &mut self,
        now: Instant,
        frame: &CanFrame,
    ) -> (CanFrame, Vec<(Vec<u8>, MessageEnd)>) {
        let mut messages = Vec::new();
        let mut data = Vec::with_capacity(FRAME_BYTES);
        for byte in frame.data() {
            match (self.flow_control, *byte) {
                (FlowControl::XonXoff, XON) => self.stopped_until = None,
                // Who says it again and again holds no longer.
                (FlowControl::XonXoff, XOFF) => {
                    self.stopped_until.get_or_insert(now + LONGEST_HOLD);
                }
                (FlowControl::XonXoff | FlowControl::None, byte) => {
                    data.push(byte);
                    messages.extend(self.messages.push(now, byte));
                }
            }
        }
        (CanFrame::data_frame(frame.id(), &data).unwrap_or(*frame), messages)
    }

    /// Takes bytes to be sent.
    pub(super) fn send(&mut self, now: Instant, id: u64, bytes: Vec<u8>) -> Result<(), Full> {
        if bytes.len() > LONGEST_JOB {
            return Err(Full::Bytes);
        }
        if self.jobs.len() >= MOST_JOBS {
            return Err(Full::Jobs);
        }
        self.jobs.push_back(Job { id, bytes, since: now, done: 0 });
        Ok(())
    }

    /// When the next frame may leave; may lie in the past. `None`: nothing waits, the other end said stop, or what is on its way
    /// has to leave before.
    pub(super) fn due(&self) -> Option<Instant> {
        let waits = !self.in_hand && self.stopped_until.is_none();
        let job = self.jobs.front().filter(|_| waits)?;
        let on_way: usize = self.on_way.iter().map(|frame| frame.data().len()).sum();
        let (cost, depth) = (self.cost(on_way + job.next_bytes().len()), self.cost_of(self.ahead()));
        if cost > depth || (self.gap.is_some() && on_way > 0) {
            return None;
        }
        let due = self.ring.opens(cost, depth).max(self.next);
        Some(self.refused.map_or(due, |(_, again)| due.max(again)))
    }

    /// Gives out the next frame. One of [`handed_out`](Self::handed_out) and [`handle_not_sent`](Self::handle_not_sent) is to
    /// follow. `None`: the next job is empty.
    pub(super) fn give_out(&mut self) -> Option<CanFrame> {
        self.in_hand = true;
        self.next_frame()
    }

    fn next_frame(&self) -> Option<CanFrame> {
        let bytes = self.jobs.front()?.next_bytes();
        CanFrame::data_frame(self.rx_id, bytes).filter(|_| !bytes.is_empty())
    }

    /// The frame was handed to the bus. How many bytes that were, and what that ended. [`handle_sent`](Self::handle_sent) or
    /// [`handle_not_sent`](Self::handle_not_sent) is to follow.
    pub(super) fn handed_out(&mut self) -> (usize, Option<Ended>) {
        if !std::mem::take(&mut self.in_hand) {
            return (0, None);
        }
        self.refused = None;
        let Some(job) = self.jobs.front_mut() else { return (0, None) };
        let bytes = job.next_bytes();
        let count = bytes.len();
        if let Some(frame) = CanFrame::data_frame(self.rx_id, bytes) {
            if self.sent.len() >= REMEMBERED {
                self.sent.pop_front();
            }
            self.sent.push_back(Sent { job: job.id, before: job.done, frame });
            self.on_way.push_back(frame);
        }
        job.done += count;
        let is_done = job.done >= job.bytes.len();
        let ended = if is_done { self.jobs.pop_front() } else { None };
        (count, ended.map(|job| Ended { id: job.id, outcome: SendOutcome::Done }))
    }

    /// A frame on its way left, and with it those before it, as they leave in order: the module has them. One that nobody knows
    /// of is from before.
    pub(super) fn handle_sent(&mut self, now: Instant, frame: &CanFrame) {
        let Some(place) = self.on_way.iter().position(|on_way| on_way == frame) else { return };
        let bytes = self.on_way.drain(..=place).map(|frame| frame.data().len()).sum();
        self.ring.fill(now, self.cost(bytes));
        self.next = now + self.gap.unwrap_or_default();
    }

    /// A frame did not leave.
    ///
    /// If it was given out just now, there was no room for it in the queue to the bus: it is sent a little later, and only if
    /// there is no room for long its job breaks off. If it was handed out before, what is behind it may be on the bus already:
    /// its job breaks off there, or is over and has a hole. What waits breaks off with it, as it may be the next piece of the
    /// same text. Frames come back in the order in which they left; of equal ones it is the first.
    pub(super) fn handle_not_sent(&mut self, now: Instant, frame: &CanFrame) -> Returned {
        if self.in_hand && self.next_frame() == Some(*frame) {
            self.in_hand = false;
            let before = self.refused.map_or(0, |(times, _)| times);
            self.refused = Some((before + 1, now + REFUSED_AGAIN));
            let ended = if before < MOST_REFUSALS { Vec::new() } else { self.break_off(Cause::NoRoom) };
            return Returned { ended, ..Returned::default() };
        }
        // If it is not on its way any more, it had left and was given back.
        if let Some(place) = self.on_way.iter().position(|on_way| on_way == frame) {
            self.on_way.remove(place);
        }
        let Some(place) = self.sent.iter().position(|sent| sent.frame == *frame) else {
            return Returned::default();
        };
        // What is in hand was not given back until now: it leaves.
        let (handed, done) = self.handed_out();
        let current = self.jobs.front().map(|job| job.id);
        let is_current = |sent: &Sent| Some(sent.job) == current && sent.frame == *frame;
        let mut returned = Returned { handed, missing: 0, ended: Vec::from_iter(done) };
        // A job under way that has an equal frame breaks off there: which of them came back nobody knows.
        let hole = self.sent.iter().find(|sent| is_current(sent)).map(|sent| sent.before);
        if hole.is_none() && self.sent.remove(place).is_some() {
            returned.missing = frame.data().len();
        }
        returned.ended.extend(self.break_off_at(hole, Cause::NotSent));
        returned
    }

    /// All that waits is given up: what was handed out may not have reached the line.
    pub(super) fn break_off(&mut self, why: Cause) -> Vec<Ended> {
        self.stopped_until = None;
        self.break_off_at(None, why)
    }

    /// All jobs end. Of the first so many bytes were sent; `None`: all that were handed out.
    fn break_off_at(&mut self, hole: Option<usize>, why: Cause) -> Vec<Ended> {
        self.in_hand = false;
        self.refused = None;
        if let Some((job, hole)) = self.jobs.front().zip(hole) {
            // They are told of as not sent with this, whether they come back or not.
            self.sent.retain(|sent| sent.job != job.id || sent.before < hole);
        }
        let end = |(place, job): (usize, Job)| {
            let sent = hole.filter(|_| place == 0).unwrap_or(job.done);
            Ended { id: job.id, outcome: SendOutcome::Broken { handed: job.done, sent, why } }
        };
        self.jobs.drain(..).enumerate().map(end).collect()
    }

    /// The module told the value of a user parameter: if it is the rates and the format of this line, the pace follows them.
    /// What the bit of the stop bits means is not sure: unless one was ordered and the bit says one, two are reckoned with.
    pub(super) fn learn(&mut self, parameter: u8, value: u16) {
        if parameter == serial_mode_of(self.number) {
            let has_one = self.is_terminal || self.short == Some(value & SerialBits::STOP_BITS.0);
            self.byte_time = byte_time_of(value, if has_one { 1 } else { 2 }) * 100 / USED_PERCENT;
        }
    }

    /// The module has forgotten what it held.
    pub(super) fn ring_is_empty(&mut self) {
        self.ring.clear();
    }

    /// The module held back what it got; nobody knows how much that is.
    pub(super) fn ring_may_be_full(&mut self, now: Instant) {
        self.ring.holds(now, self.cost_of(RING));
    }

    /// The module holds back what it gets, or does not any more.
    pub(super) fn suspend(&mut self, now: Instant, is_suspended: bool) {
        self.suspended = is_suspended.then(|| self.suspended.unwrap_or(now));
    }

    /// What follows does not belong to what came until now.
    pub(super) fn cut(&mut self) -> Option<(Vec<u8>, MessageEnd)> {
        self.messages.cut()
    }

    /// What became due: a message that a pause ended, and jobs that waited too long for the other end or the module.
    pub(super) fn handle_timeout(&mut self, now: Instant) -> (Option<(Vec<u8>, MessageEnd)>, Vec<Ended>) {
        let is_due = |at: Option<Instant>| at.is_some_and(|at| at <= now);
        let ended = if is_due(self.stopped_until) {
            self.break_off(Cause::Xoff)
        } else if is_due(self.suspended_too_long()) {
            self.break_off(Cause::Suspended)
        } else {
            Vec::new()
        };
        (self.messages.take_idle(now), ended)
    }

    /// When [`handle_timeout`](Self::handle_timeout) has something to do, and why.
    pub(super) fn poll_timeout(&self) -> Option<(Instant, &'static str)> {
        let idle = self.messages.idle_at().map(|at| (at, "pause on a serial line"));
        let stuck = self.stopped_until.map(|at| (at, "XOFF on a serial line"));
        let suspended = self.suspended_too_long().map(|at| (at, "suspended module of a serial line"));
        idle.into_iter().chain(stuck).chain(suspended).min_by_key(|(at, _)| *at)
    }

    /// When the first bytes that wait will have waited too long for a module that was suspended.
    fn suspended_too_long(&self) -> Option<Instant> {
        let job = self.jobs.front()?;
        Some(self.suspended?.max(job.since) + LONGEST_HOLD)
    }

    fn ahead(&self) -> u32 {
        match self.flow_control {
            FlowControl::None => AHEAD,
            FlowControl::XonXoff => AHEAD_WITH_FLOW_CONTROL,
        }
    }

    fn cost(&self, bytes: usize) -> Duration {
        self.cost_of(u32::try_from(bytes).unwrap_or(u32::MAX))
    }

    fn cost_of(&self, bytes: u32) -> Duration {
        self.byte_time.saturating_mul(bytes)
    }
}

impl Job {
    /// What the next frame carries.
    fn next_bytes(&self) -> &[u8] {
        let rest = self.bytes.get(self.done..).unwrap_or_default();
        rest.get(..FRAME_BYTES).unwrap_or(rest)
    }
}
