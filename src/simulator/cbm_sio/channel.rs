//! One serial channel of an esd module: two ring buffers, the pace of the line, and how bytes become frames. Pure.
//!
//! A channel lives in events of its own: each has the moment when it was due, whenever it is carried out. So a task that
//! wakes up late changes neither the pace of the line nor the frames.

use std::collections::VecDeque;
use std::time::Duration;

use super::line::{Line, LineKind};
use super::parameters::{FRAME, Keep, SerialMode, Trigger, TxMode};
use crate::time::Instant;

/// Bytes that wait in each direction; what comes beyond is lost and counted (R-ESD-036).
pub const RING: usize = 256;
/// Bytes that a line end has still to send; what it would say beyond is lost.
pub const LINE_LIMIT: usize = 4096;
/// Bytes that an outside end may be ahead of the line.
pub const AHEAD: usize = 256;
/// From so many waiting bytes on, RTS tells the line end to pause.
const RTS_LIMIT: usize = 192;
/// Bytes that wait for whoever takes them to an outside end; the oldest are lost.
const OUTSIDE_LIMIT: usize = 4096;

/// From when on the channel may send: `None` = not now.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Gates {
    /// To CAN.
    pub can: Option<Instant>,
    /// To the line.
    pub line: Option<Instant>,
    /// Whether the module has power: otherwise nobody takes what comes from the line.
    pub power: bool,
}

/// What a channel has done.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Step {
    /// Something that concerns nobody else.
    Inside,
    /// It sends these bytes to CAN.
    Frame(Vec<u8>),
}

/// Characters that follow each other on a line without a gap.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Burst {
    start: Instant,
    done: u64,
}

/// What a channel does next.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Work {
    /// A character has come in from the line.
    Arrive,
    /// A character has gone out to the line.
    Leave,
    /// The next character begins to go out.
    Begin,
    /// The line end says something by itself.
    Speak,
    /// A frame goes out.
    Frame,
}

/// A channel.
#[derive(Clone, Debug)]
pub struct Channel {
    tx: TxMode,
    serial: SerialMode,
    idle: Option<Duration>,
    heeds_rts: bool,
    /// Line level of CTS.
    cts: bool,
    line: Line,
    /// What the line end has still to send.
    arriving: VecDeque<u8>,
    arrivals: Option<Burst>,
    to_can: VecDeque<u8>,
    /// Lengths of frames that an end mark, or a full frame, has made ready.
    cuts: VecDeque<u8>,
    /// Bytes behind the last cut.
    uncut: u8,
    last_arrival: Instant,
    last_frame: Option<Instant>,
    to_line: VecDeque<u8>,
    /// Since when the next character could begin, as far as the channel knows.
    ready_since: Instant,
    leaving: Option<u8>,
    departures: Option<Burst>,
    outside: VecDeque<u8>,
    /// Bytes from the line that found the ring full.
    pub overflow_to_can: u64,
    /// Bytes from CAN that found the ring full.
    pub overflow_to_line: u64,
}

impl Channel {
    /// A channel that nothing has come to.
    #[must_use]
    pub fn new(line: Line, tx: TxMode, serial: SerialMode, idle: Option<Duration>, heeds_rts: bool) -> Self {
        Self {
            tx,
            serial,
            idle,
            heeds_rts,
            cts: true,
            line,
            arriving: VecDeque::new(),
            arrivals: None,
            to_can: VecDeque::new(),
            cuts: VecDeque::new(),
            uncut: 0,
            last_arrival: Instant::START,
            last_frame: None,
            to_line: VecDeque::new(),
            ready_since: Instant::START,
            leaving: None,
            departures: None,
            outside: VecDeque::new(),
            overflow_to_can: 0,
            overflow_to_line: 0,
        }
    }

    /// The rings are emptied, as by a reset or without power. The line end notices no more than RTS.
    pub fn clear(&mut self, now: Instant) {
        if self.heeds_rts {
            self.arrivals = self.arrivals.map(|_| Burst { start: now, done: 0 });
        }
        self.to_can.clear();
        self.cuts.clear();
        self.uncut = 0;
        self.last_frame = None;
        self.to_line.clear();
        (self.leaving, self.departures) = (None, None);
    }

    /// Works by other parameters from now on; what waits in the rings stays.
    pub fn set_modes(&mut self, now: Instant, tx: TxMode, serial: SerialMode) {
        if tx != self.tx {
            self.tx = tx;
            self.cut_anew();
        }
        if serial != self.serial {
            self.serial = serial;
            let again = Burst { start: now, done: 0 };
            self.arrivals = self.arrivals.map(|_| again);
            self.departures = self.departures.map(|_| again);
        }
    }

    fn cut_anew(&mut self) {
        self.cuts.clear();
        self.uncut = 0;
        if matches!(self.tx.trigger, Trigger::Mark(..)) {
            let (full, rest) =
                (self.to_can.len() / usize::from(FRAME), self.to_can.len() % usize::from(FRAME));
            self.cuts.extend(std::iter::repeat_n(FRAME, full));
            self.cuts.extend(u8::try_from(rest).ok().filter(|rest| *rest > 0));
        }
    }

    /// How the line works.
    #[must_use]
    pub fn serial(&self) -> SerialMode {
        self.serial
    }

    /// The line end.
    pub fn line(&mut self) -> &mut Line {
        &mut self.line
    }

    /// Its kind.
    #[must_use]
    pub fn line_kind(&self) -> LineKind {
        self.line.kind()
    }

    /// The line end switches CTS.
    pub fn set_cts(&mut self, now: Instant, on: bool) {
        self.cts = on;
        self.ready_since = self.ready_since.max(now);
    }

    /// Whether RTS lets the line end send (R-ESD-011).
    #[must_use]
    pub fn rts(&self) -> bool {
        self.to_can.len() < RTS_LIMIT
    }

    /// How many bytes the line takes from an outside end without being ahead of its pace.
    #[must_use]
    pub fn room(&self) -> usize {
        AHEAD.saturating_sub(self.arriving.len())
    }

    /// The line end sends.
    pub fn say(&mut self, now: Instant, bytes: &[u8]) {
        if self.arriving.is_empty() && !bytes.is_empty() {
            self.arrivals = Some(Burst { start: now, done: 0 });
        }
        let room = LINE_LIMIT.saturating_sub(self.arriving.len());
        self.arriving.extend(bytes.iter().take(room));
    }

    /// Data came from CAN (R-ESD-035).
    pub fn hear(&mut self, now: Instant, data: &[u8]) {
        if self.to_line.is_empty() {
            self.ready_since = self.ready_since.max(now);
        }
        for byte in data {
            if self.to_line.len() < RING {
                self.to_line.push_back(*byte);
            } else {
                self.overflow_to_line += 1;
            }
        }
    }

    /// Bytes that wait: from the line end, to CAN, to the line, to an outside end.
    #[must_use]
    pub fn waiting(&self) -> [usize; 4] {
        [self.arriving.len(), self.to_can.len(), self.to_line.len(), self.outside.len()]
    }

    /// What has gone out to an outside end since the last call.
    pub fn take_outside(&mut self) -> Vec<u8> {
        std::mem::take(&mut self.outside).into()
    }

    /// When something is due.
    #[must_use]
    pub fn poll_timeout(&self, gates: Gates) -> Option<Instant> {
        self.next(gates).map(|(due, _)| due)
    }

    /// Does one thing that is due until `now`; call until `None`.
    pub fn handle_timeout(&mut self, now: Instant, gates: Gates) -> Option<Step> {
        let (at, work) = self.next(gates).filter(|(due, _)| *due <= now)?;
        match work {
            Work::Arrive => self.arrive(at, gates.power),
            Work::Leave => self.leave(at),
            Work::Begin => self.begin(at),
            Work::Speak => {
                let text = self.line.handle_timeout(at);
                self.say(at, &text);
            }
            Work::Frame => return Some(Step::Frame(self.frame(at))),
        }
        Some(Step::Inside)
    }

    fn next(&self, gates: Gates) -> Option<(Instant, Work)> {
        let works = [
            (self.arrival_due(), Work::Arrive),
            (self.departure_due(), Work::Leave),
            (self.begin_due(gates), Work::Begin),
            (self.line.poll_timeout(), Work::Speak),
            (self.frame_due(gates), Work::Frame),
        ];
        works.into_iter().filter_map(|(due, work)| Some((due?, work))).min_by_key(|(due, _)| *due)
    }

    fn arrival_due(&self) -> Option<Instant> {
        let burst = self.arrivals.filter(|_| !self.heeds_rts || self.rts())?;
        Some(burst.start + self.serial.receive_time(burst.done + 1))
    }

    fn arrive(&mut self, at: Instant, power: bool) {
        let byte = self.arriving.pop_front();
        self.arrivals = self
            .arrivals
            .filter(|_| !self.arriving.is_empty())
            .map(|burst| Burst { done: burst.done + 1, ..burst });
        let Some(byte) = byte.filter(|_| power) else { return };
        self.last_arrival = at;
        self.take_in(self.serial.cut(byte));
    }

    /// A byte from the line goes into the ring, and the bytes before it may become a frame.
    fn take_in(&mut self, byte: u8) {
        let Trigger::Mark(mark, keep) = self.tx.trigger else {
            self.push(byte);
            return;
        };
        let dropped = match keep {
            Keep::All => false,
            Keep::NoMark => byte == mark,
            Keep::NoLineEnds => matches!(byte, 0x0A | 0x0D),
        };
        if !dropped && self.push(byte) {
            self.uncut += 1;
        }
        if (byte == mark && self.uncut > 0) || self.uncut == FRAME {
            self.cuts.push_back(self.uncut);
            self.uncut = 0;
        }
    }

    fn push(&mut self, byte: u8) -> bool {
        let fits = self.to_can.len() < RING;
        if fits {
            self.to_can.push_back(byte);
        } else {
            self.overflow_to_can += 1;
        }
        fits
    }

    /// How many bytes the next frame has, and since when it is ready.
    fn ready(&self) -> Option<(u8, Instant)> {
        let waiting = u8::try_from(self.to_can.len()).unwrap_or(u8::MAX);
        let (triggered, most) = match self.tx.trigger {
            Trigger::Count(least) => (waiting >= least, self.tx.most),
            Trigger::Mark(..) => (!self.cuts.is_empty(), self.cuts.front().copied().unwrap_or(FRAME)),
        };
        let since = if triggered { self.last_arrival } else { self.last_arrival + self.idle? };
        (waiting > 0).then_some((waiting.min(most), since))
    }

    fn frame_due(&self, gates: Gates) -> Option<Instant> {
        let (open, (_, since)) = (gates.can?, self.ready()?);
        let inhibited = self.last_frame.map_or(open, |last| last + self.tx.inhibit);
        Some(open.max(since).max(inhibited))
    }

    fn frame(&mut self, at: Instant) -> Vec<u8> {
        let length = self.ready().map_or(0, |(length, _)| usize::from(length));
        if self.cuts.pop_front().is_none() {
            self.uncut = 0;
        }
        let paused = !self.rts();
        let data = self.to_can.drain(..length).collect();
        self.last_frame = Some(at);
        if self.heeds_rts && paused && self.rts() {
            self.arrivals = self.arrivals.map(|_| Burst { start: at, done: 0 });
        }
        data
    }

    fn begin_due(&self, gates: Gates) -> Option<Instant> {
        let waits = self.leaving.is_none() && !self.to_line.is_empty() && (self.cts || !self.serial.cts);
        gates.line.filter(|_| waits).map(|open| open.max(self.ready_since))
    }

    /// A character follows the one before it at once, or begins anew after a pause.
    fn begin(&mut self, at: Instant) {
        let goes_on = self.departures.filter(|burst| burst.start + self.serial.send_time(burst.done) >= at);
        self.departures = goes_on.or(Some(Burst { start: at, done: 0 }));
        self.leaving = self.to_line.pop_front();
    }

    fn departure_due(&self) -> Option<Instant> {
        let burst = self.departures.filter(|_| self.leaving.is_some())?;
        Some(burst.start + self.serial.send_time(burst.done + 1))
    }

    fn leave(&mut self, at: Instant) {
        let Some(byte) = self.leaving.take().map(|byte| self.serial.cut(byte)) else { return };
        self.ready_since = at;
        self.departures = self.departures.map(|burst| Burst { done: burst.done + 1, ..burst });
        if self.line.kind() == LineKind::External {
            if self.outside.len() >= OUTSIDE_LIMIT {
                self.outside.pop_front();
            }
            self.outside.push_back(byte);
        }
        let answer = self.line.hear(byte);
        self.say(at, &answer);
    }
}
