//! The SDO client for one node: a queue, one transfer at a time, its time limits and repetitions.

use std::collections::VecDeque;
use std::time::Duration;

use super::codec::{Payload, Request, answer_id, request_id};
use super::transfer::{Step, Transfer};
use super::{
    AbortCode, Refused, SdoAction, SdoCounters, SdoError, SdoOutput, SdoPriority, SdoRequest, SdoSettings,
    TransferId,
};
use crate::can::CanFrame;
use crate::canopen::NodeId;
use crate::canopen::object::ObjectId;
use crate::time::Instant;

/// Requests of one priority that may wait beside the one under way.
const WAITING: usize = 8;
/// Outputs that nobody fetched, above which no more frames are sent.
const UNFETCHED: usize = 1024;
/// Between two transfers of the same object at least so much time passes, in which copies of the answer to the first
/// are recognised: some bit times suffice on a bus, more where a network lies between.
const SETTLE: Duration = Duration::from_millis(20);
/// Segments of a block that are sent at once, and the time between two such bursts: less than a bus of 125 kbit/s carries,
/// so that other frames are not delayed behind ours.
const BURST: usize = 8;
const BURST_GAP: Duration = Duration::from_millis(10);
/// Store and restore.
const SLOW_OBJECTS: [u16; 2] = [0x1010, 0x1011];

/// The SDO client of one node.
#[derive(Debug)]
pub struct SdoClient {
    node: NodeId,
    settings: SdoSettings,
    active: Option<Active>,
    boot: VecDeque<(TransferId, SdoRequest)>,
    commands: VecDeque<(TransferId, SdoRequest)>,
    outputs: VecDeque<SdoOutput>,
    /// No transfer begins before: late answers to the last one may still come.
    quiet_until: Option<Instant>,
    /// The object of the last transfer, and when that ended.
    last: Option<(ObjectId, Instant)>,
    /// The node knows no block transfer.
    no_blocks: bool,
    /// The bus cannot be used.
    paused: bool,
    counters: SdoCounters,
}

/// The transfer under way.
#[derive(Debug)]
struct Active {
    id: TransferId,
    transfer: Transfer,
    /// It may be begun again.
    repeatable: bool,
    timeout: Duration,
    /// When it must be over.
    end: Instant,
    /// How often it was begun.
    begun: u32,
    phase: Phase,
    /// When the last frame was sent, or the last answer taken.
    since: Instant,
    /// The last frame that expects an answer.
    sent: Payload,
    /// That frame did not leave: the bus is to blame for the silence.
    not_sent: bool,
}

#[derive(Clone, Copy, Debug)]
enum Phase {
    /// For an answer, until then.
    Waiting(Instant),
    /// Segments of a block go out; the next burst then.
    Sending(Instant),
    /// It broke off; it begins again then, when no late answer is to be expected any more.
    Resting(Instant),
}

impl SdoClient {
    /// A client that has nothing to do, on a bus that can be used.
    #[must_use]
    pub fn new(node: NodeId, settings: SdoSettings) -> Self {
        Self {
            node,
            settings,
            active: None,
            boot: VecDeque::new(),
            commands: VecDeque::new(),
            outputs: VecDeque::new(),
            quiet_until: None,
            last: None,
            no_blocks: false,
            paused: false,
            counters: SdoCounters::default(),
        }
    }

    /// What was counted.
    #[must_use]
    pub fn counters(&self) -> SdoCounters {
        self.counters
    }

    /// Whether nothing is under way and nothing waits.
    #[must_use]
    pub fn is_idle(&self) -> bool {
        self.active.is_none() && self.boot.is_empty() && self.commands.is_empty()
    }

    /// Asks for a transfer. If it is taken, [`SdoOutput::Done`] with this id will follow, in bounded time.
    pub fn request(&mut self, now: Instant, id: TransferId, request: SdoRequest) -> Result<(), Refused> {
        let longest = self.settings.longest;
        if self.paused {
            return Err(Refused::BusUnavailable);
        }
        if let SdoAction::Write(data) = &request.action
            && data.len() > longest
        {
            return Err(Refused::TooLong { len: data.len(), longest });
        }
        let queue = match request.priority {
            SdoPriority::Boot => &mut self.boot,
            SdoPriority::Command => &mut self.commands,
        };
        if queue.len() >= WAITING || self.outputs.len() >= UNFETCHED {
            return Err(Refused::QueueFull { limit: WAITING });
        }
        queue.push_back((id, request));
        self.begin_next(now);
        Ok(())
    }

    /// Takes a frame with the identifier of the node's answers; others are ignored.
    pub fn handle_answer(&mut self, now: Instant, frame: &CanFrame) {
        if frame.id() != answer_id(self.node) {
            return;
        }
        let Ok(payload) = Payload::try_from(frame.data()) else {
            count(&mut self.counters.malformed);
            return;
        };
        let Some(active) = self.active.as_mut().filter(|active| !matches!(active.phase, Phase::Resting(_)))
        else {
            count(&mut self.counters.unasked);
            return;
        };
        match active.transfer.handle_answer(payload) {
            Step::Send(request) => self.send(now, request),
            Step::Continue if active.transfer.has_segments() => self.send_segments(now),
            Step::Continue => active.await_answer(now),
            Step::Duplicate => count(&mut self.counters.duplicates),
            Step::Unasked => count(&mut self.counters.unasked),
            Step::NoBlocks { abort } => {
                // That is no repetition of a request that was not answered.
                active.begun = active.begun.saturating_sub(1);
                self.no_blocks = true;
                self.abort(abort);
                self.begin(now);
            }
            Step::Done { data, farewell } => {
                if let Some(payload) = farewell {
                    self.transmit(payload);
                }
                self.finish(now, Ok(data));
            }
            Step::Failed { error: SdoError::Interrupted, .. } if self.may_repeat() => self.rest(),
            Step::Failed { error, abort } => {
                self.abort(abort);
                self.finish(now, Err(error));
            }
        }
    }

    /// What became due.
    pub fn handle_timeout(&mut self, now: Instant) {
        if self.quiet_until.is_some_and(|until| until <= now) {
            self.quiet_until = None;
        }
        match self.active.as_ref().map(|active| active.phase) {
            Some(Phase::Waiting(at)) if at <= now => self.handle_silence(now),
            Some(Phase::Sending(at)) if at <= now => self.send_segments(now),
            Some(Phase::Resting(at)) if at <= now => self.begin(now),
            Some(Phase::Waiting(_) | Phase::Sending(_) | Phase::Resting(_)) => {}
            None => self.begin_next(now),
        }
    }

    /// A frame of ours did not leave: if no answer comes, the node is not to blame, and the request may be repeated.
    pub fn handle_not_sent(&mut self, frame: &CanFrame) {
        if let Some(active) = &mut self.active
            && frame.id() == request_id(self.node)
            && frame.data() == active.sent
            && !std::mem::replace(&mut active.not_sent, true)
            && active.transfer.is_beginning()
        {
            active.transfer.not_begun();
        }
    }

    /// The bus cannot be used: what is under way or waits fails, and nothing is taken until [`resume`](Self::resume).
    pub fn pause(&mut self) {
        self.paused = true;
        // What the node still has to say it may say when the bus is back.
        let cut = self.active.take();
        if cut.is_some() || self.quiet_until.is_some() {
            self.quiet_until = Some(Instant::from_micros(u64::MAX));
        }
        let waiting = self.boot.drain(..).chain(self.commands.drain(..)).map(|(id, _)| id);
        let ids: Vec<TransferId> = cut.map(|active| active.id).into_iter().chain(waiting).collect();
        for id in ids {
            self.tell(id, Err(SdoError::BusUnavailable));
        }
    }

    /// The bus can be used again.
    pub fn resume(&mut self, now: Instant) {
        if std::mem::take(&mut self.paused) && self.quiet_until.is_some() {
            self.quiet_until = Some(now + self.settings.timeout);
        }
    }

    /// What is to be done; call until `None` after each of the calls above.
    pub fn poll_output(&mut self) -> Option<SdoOutput> {
        self.outputs.pop_front()
    }

    /// When [`handle_timeout`](Self::handle_timeout) is to be called, and why.
    #[must_use]
    pub fn poll_timeout(&self) -> Option<(Instant, &'static str)> {
        match &self.active {
            Some(Active { phase: Phase::Waiting(at), .. }) => Some((*at, "SDO answer")),
            Some(Active { phase: Phase::Sending(at), .. }) => Some((*at, "SDO block segments")),
            Some(Active { phase: Phase::Resting(at), .. }) => Some((*at, "SDO repetition")),
            None => self.next().map(|(_, request)| (self.free_at(request.object), "SDO request that waits")),
        }
    }

    /// The request that is next.
    fn next(&self) -> Option<&(TransferId, SdoRequest)> {
        self.boot.front().or_else(|| self.commands.front())
    }

    /// From when on a transfer of this object may begin.
    fn free_at(&self, object: ObjectId) -> Instant {
        let quiet = self.quiet_until.unwrap_or(Instant::START);
        match self.last {
            Some((last, ended)) if last == object => quiet.max(ended + SETTLE),
            _ => quiet,
        }
    }

    /// Begins the next transfer if none is under way.
    fn begin_next(&mut self, now: Instant) {
        let free = self.next().is_some_and(|(_, request)| self.free_at(request.object) <= now);
        if self.active.is_some() || !free {
            return;
        }
        let Some((id, request)) = self.boot.pop_front().or_else(|| self.commands.pop_front()) else { return };
        let slow = request.action != SdoAction::Read && SLOW_OBJECTS.contains(&request.object.index);
        let usual = if slow { self.settings.store_timeout } else { self.settings.timeout };
        let timeout = request.timeout.unwrap_or(usual);
        self.active = Some(Active {
            id,
            repeatable: request.idempotent || request.action == SdoAction::Read,
            timeout,
            end: now + self.settings.within,
            begun: 0,
            phase: Phase::Resting(now),
            since: now,
            sent: Payload::default(),
            not_sent: false,
            transfer: Transfer::new(request, self.settings.longest),
        });
        self.begin(now);
    }

    /// Sends the first request of the transfer under way.
    fn begin(&mut self, now: Instant) {
        let blocks = self.settings.block && !self.no_blocks;
        if let Some(active) = &mut self.active {
            active.begun += 1;
            let first = active.transfer.begin(blocks);
            self.send(now, first);
        }
    }

    /// No answer came in time.
    fn handle_silence(&mut self, now: Instant) {
        let Some(active) = &self.active else { return };
        count(&mut self.counters.timeouts);
        let beginning = active.transfer.is_beginning();
        if active.end <= now {
            self.abort(Some(AbortCode::TIMEOUT));
            self.finish(now, Err(SdoError::TooSlow { within: self.settings.within }));
        } else if self.may_repeat() && beginning {
            self.repeat(now);
        } else if self.may_repeat() {
            self.abort(Some(AbortCode::TIMEOUT));
            self.rest();
        } else {
            let after = active.timeout;
            let error = SdoError::Timeout { after, requests: active.begun };
            let error = if active.not_sent { SdoError::BusUnavailable } else { error };
            self.abort(Some(AbortCode::TIMEOUT));
            self.finish(now, Err(error));
        }
    }

    /// Whether the transfer may be begun again. A first request that did not leave did nothing, whatever it was.
    fn may_repeat(&self) -> bool {
        self.active.as_ref().is_some_and(|active| {
            let harmless = active.repeatable || active.not_sent && active.transfer.is_beginning();
            harmless && active.begun <= self.settings.repeat
        })
    }

    /// Sends the first request once more. Not in blocks: some nodes do not even refuse what they do not know.
    fn repeat(&mut self, now: Instant) {
        if let Some(active) = &mut self.active {
            active.begun += 1;
            let first = active.transfer.begin(false);
            self.send(now, first);
        }
    }

    /// Waits until nothing of the transfer can arrive any more, to begin it again.
    fn rest(&mut self) {
        if let Some(active) = &mut self.active {
            active.phase = Phase::Resting(active.silent_from());
        }
    }

    /// Sends a frame whose answer is awaited.
    fn send(&mut self, now: Instant, payload: Payload) {
        if let Some(active) = &mut self.active {
            active.sent = payload;
            active.not_sent = false;
            active.await_answer(now);
            self.transmit(payload);
        }
    }

    /// Sends some segments of a block.
    fn send_segments(&mut self, now: Instant) {
        for _ in 0..BURST {
            let Some(active) = &mut self.active else { return };
            let Some(payload) = active.transfer.poll_segment() else { break };
            active.sent = payload;
            self.transmit(payload);
        }
        if let Some(active) = &mut self.active {
            active.not_sent = false;
            if active.transfer.has_segments() {
                active.phase = Phase::Sending(now + BURST_GAP);
            } else {
                active.await_answer(now);
            }
        }
    }

    /// Ends the transfer under way, and begins the next.
    fn finish(&mut self, now: Instant, result: Result<Vec<u8>, SdoError>) {
        let Some(active) = self.active.take() else { return };
        // An answer of the node that ends a transfer is its last word, unless it was asked several times.
        let last_word = matches!(result, Ok(_) | Err(SdoError::Abort(_)));
        if !last_word || active.transfer.is_unsettled() {
            self.quiet_until = Some(active.silent_from());
        }
        self.last = Some((active.transfer.object, now));
        self.tell(active.id, result);
        self.begin_next(now);
    }

    fn tell(&mut self, id: TransferId, result: Result<Vec<u8>, SdoError>) {
        count(if result.is_ok() { &mut self.counters.succeeded } else { &mut self.counters.failed });
        self.outputs.push_back(SdoOutput::Done(id, result));
    }

    fn abort(&mut self, code: Option<AbortCode>) {
        if let (Some(active), Some(code)) = (&self.active, code) {
            let payload = Request::Abort(active.transfer.object, code).payload();
            self.transmit(payload);
        }
    }

    fn transmit(&mut self, payload: Payload) {
        if let Some(frame) = CanFrame::data_frame(request_id(self.node), &payload)
            && self.outputs.len() < UNFETCHED
        {
            self.outputs.push_back(SdoOutput::Transmit(frame));
        }
    }
}

impl Active {
    /// From when on no answer is expected any more, not even a late one.
    fn silent_from(&self) -> Instant {
        self.since + self.timeout + self.timeout
    }

    /// From now on the node is to answer within the time-out, but not longer than the transfer may take.
    fn await_answer(&mut self, now: Instant) {
        self.since = now;
        self.phase = Phase::Waiting(self.end.min(now + self.timeout).max(now));
    }
}

fn count(counter: &mut u64) {
    *counter = counter.saturating_add(1);
}
