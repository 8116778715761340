//! One module: its life, its lines, how it is managed, and its watchdog, together.

use std::time::Duration;

use super::answer::Answer;
use super::event::{Cause, MessageEnd, ModuleEvent, SerialChunk};
use super::identifiers::ModuleNumber;
use super::init_frame::{InitCommand, Order, Request, Setting};
use super::outputs::Teller;
use super::procedure::Procedure;
use super::serial_channel::{Ended, Full, SerialChannel};
use super::settings::ModuleSettings;
use super::step::{Change, Condition};
use super::watchdog::{Verdict, Watchdog};
use crate::can::{CanFrame, CanId};
use crate::time::Instant;

/// One module of a bus.
#[derive(Debug)]
pub(super) struct Module {
    pub(super) number: ModuleNumber,
    channels: Vec<SerialChannel>,
    /// How it is managed; `None`: only data is exchanged with it.
    pub(super) procedure: Option<Procedure>,
    watchdog: Option<Watchdog>,
    link_up: bool,
    /// It showed itself since the bus came up, and was not lost after that.
    alive: bool,
    /// When it last showed itself other than by an answer.
    heard: Option<Instant>,
    /// It is reported then, if it has not shown itself.
    never_seen: Option<Instant>,
}

impl Module {
    /// On a bus that cannot be used.
    pub(super) fn new(mut settings: ModuleSettings, is_managed: bool, reply_timeout: Duration) -> Self {
        let management = settings.management.take().filter(|_| is_managed);
        let watchdog = management.as_ref().and_then(|management| management.watchdog);
        Self {
            number: settings.number,
            channels: settings
                .channels
                .iter()
                .map(|channel| SerialChannel::new(channel, settings.kind.is_terminal(channel.number)))
                .collect(),
            procedure: management.map(|management| Procedure::new(&settings, management)),
            watchdog: watchdog.map(|watchdog| Watchdog::new(watchdog, settings.number, reply_timeout)),
            link_up: false,
            alive: false,
            heard: None,
            never_seen: None,
        }
    }

    /// Identifier of its watchdog, where it has one.
    pub(super) fn watchdog_id(&self) -> Option<CanId> {
        self.watchdog.as_ref().map(Watchdog::id)
    }

    /// The bus can be used.
    pub(super) fn resume(&mut self, now: Instant) {
        self.link_up = true;
        if let Some(procedure) = &mut self.procedure {
            procedure.resume(now);
            self.never_seen = Some(now + procedure.settings().never_seen_after);
        }
        if let Some(watchdog) = &mut self.watchdog {
            watchdog.resume(now);
        }
    }

    /// The bus cannot be used: nothing is asked, nobody is blamed, and what waits is given up.
    pub(super) fn pause(&mut self, teller: &mut Teller<'_>) {
        self.give_up(Cause::BusDown, teller);
    }

    fn give_up(&mut self, why: Cause, teller: &mut Teller<'_>) {
        self.link_up = false;
        self.alive = false;
        self.heard = None;
        self.never_seen = None;
        if let Some(procedure) = &mut self.procedure {
            procedure.pause();
        }
        if let Some(watchdog) = &mut self.watchdog {
            watchdog.pause();
        }
        self.break_off(why, teller);
    }

    /// The gateway stops: a module whose watchdog was set going would reset itself without it (R-ESD-088).
    pub(super) fn stop(&mut self, teller: &mut Teller<'_>) {
        if self.link_up && self.procedure.as_ref().is_some_and(Procedure::has_set_watchdog) {
            self.switch_watchdog_off(teller);
        }
        self.give_up(Cause::Stopped, teller);
    }

    fn switch_watchdog_off(&self, teller: &mut Teller<'_>) {
        let setting = Setting::WatchdogTime { millis: 0, factor: 0 };
        teller.transmit(InitCommand::Set { module: self.number, setting }.frame());
    }

    /// A data frame on the transmit identifier of a channel.
    pub(super) fn handle_data(
        &mut self,
        now: Instant,
        place: usize,
        frame: &CanFrame,
        teller: &mut Teller<'_>,
    ) {
        teller.tell(ModuleEvent::Frame);
        self.appear(now, teller);
        self.heard = Some(now);
        let Some(channel) = self.channels.get_mut(place) else { return };
        time_out(now, place, channel, teller);
        let (data, messages) = channel.receive(now, frame);
        teller.tell(ModuleEvent::Received { channel: place, chunk: SerialChunk::new(&data) });
        for message in messages {
            tell_message(place, message, teller);
        }
    }

    /// A data frame on the identifier of its watchdog. `true`: it was lost by that.
    pub(super) fn handle_watchdog(
        &mut self,
        now: Instant,
        frame: &CanFrame,
        teller: &mut Teller<'_>,
    ) -> bool {
        let Some(watchdog) = self.watchdog.as_mut().filter(|_| self.link_up) else { return false };
        let verdict = watchdog.handle_frame(frame);
        if verdict == Verdict::Nothing {
            return false;
        }
        teller.tell(ModuleEvent::Frame);
        if verdict == Verdict::Alive {
            self.appear(now, teller);
            self.heard = Some(now);
        }
        self.judge(now, verdict, teller)
    }

    /// The answer to what it was asked. `true`: what it is asked at this moment does not matter any more.
    pub(super) fn handle_answer(&mut self, now: Instant, answer: Answer, teller: &mut Teller<'_>) -> bool {
        teller.tell(ModuleEvent::Frame);
        self.appear(now, teller);
        let Some(procedure) = &mut self.procedure else { return false };
        if let (Some((_, Some(Request::Parameter(number)))), Answer::Value(value)) =
            (procedure.next(), answer)
        {
            self.channels.iter_mut().for_each(|channel| channel.learn(number, value));
        }
        let was_suspended = procedure.is_suspended();
        let change = procedure.handle_answer(now, answer, teller);
        let is_other = procedure.condition() == Condition::Other;
        self.heed_suspension(now, was_suspended);
        if is_other {
            // What was triggered until now would reset itself (R-ESD-088).
            if self.stop_watchdog() {
                self.switch_watchdog_off(teller);
            }
            self.break_off(Cause::OtherModule, teller);
        }
        self.apply(now, change, teller)
    }

    /// It did not answer what it was asked. `true`: it was lost by that.
    pub(super) fn handle_unanswered(&mut self, now: Instant, teller: &mut Teller<'_>) -> bool {
        let (alive, heard) = (self.alive, self.heard);
        let Some(procedure) = &mut self.procedure else { return false };
        let change = procedure.handle_unanswered(now, alive, heard, teller);
        self.apply(now, change, teller)
    }

    /// What became due, but for questions. `true`: it was lost by that.
    pub(super) fn handle_timeout(&mut self, now: Instant, teller: &mut Teller<'_>) -> bool {
        for (place, channel) in self.channels.iter_mut().enumerate() {
            time_out(now, place, channel, teller);
        }
        if self.never_seen.take_if(|at| *at <= now).is_some() {
            teller.tell(ModuleEvent::NeverSeen);
        }
        let Some(watchdog) = &mut self.watchdog else { return false };
        let (verdict, request) = watchdog.handle_timeout(now);
        let lost = self.judge(now, verdict, teller);
        if let Some(request) = request {
            teller.transmit(request);
        }
        lost
    }

    /// A frame of ours did not leave. `true`: what it is asked at this moment does not matter any more.
    pub(super) fn handle_not_sent(&mut self, now: Instant, frame: &CanFrame) -> bool {
        if self.watchdog.as_mut().is_some_and(|watchdog| watchdog.handle_not_sent(now, frame)) {
            return false;
        }
        self.procedure.as_mut().is_some_and(|procedure| procedure.handle_not_sent(now, frame))
    }

    /// A data frame to one of its lines left.
    pub(super) fn handle_data_sent(&mut self, now: Instant, place: usize, frame: &CanFrame) {
        if let Some(channel) = self.channels.get_mut(place) {
            channel.handle_sent(now, frame);
        }
    }

    /// A data frame to one of its lines did not leave.
    pub(super) fn handle_data_not_sent(
        &mut self,
        now: Instant,
        place: usize,
        frame: &CanFrame,
        teller: &mut Teller<'_>,
    ) {
        let Some(channel) = self.channels.get_mut(place) else { return };
        let returned = channel.handle_not_sent(now, frame);
        if returned.handed > 0 {
            teller.tell(ModuleEvent::Sent { channel: place, bytes: returned.handed });
        }
        if returned.missing > 0 {
            teller.tell(ModuleEvent::NotSent { channel: place, bytes: returned.missing });
        }
        for ended in returned.ended {
            tell_ended(place, ended, teller);
        }
    }

    /// Somebody sent it an order. `true`: what it is asked at this moment does not matter any more.
    pub(super) fn ordered(&mut self, now: Instant, order: Order, teller: &mut Teller<'_>) -> bool {
        if !self.link_up {
            return false;
        }
        if let Some(procedure) = &mut self.procedure {
            let was_suspended = procedure.is_suspended();
            procedure.ordered(now, order);
            self.heed_suspension(now, was_suspended);
        }
        let resets = matches!(order, Order::Reset | Order::DefaultReset);
        if resets {
            self.stop_watchdog();
            self.break_off(Cause::Reset, teller);
        }
        resets
    }

    /// Its lines follow when it was suspended, or goes on.
    fn heed_suspension(&mut self, now: Instant, was_suspended: bool) {
        let is_suspended = self.procedure.as_ref().is_some_and(Procedure::is_suspended);
        for channel in &mut self.channels {
            channel.suspend(now, is_suspended);
            if was_suspended && !is_suspended {
                channel.ring_may_be_full(now);
            }
        }
    }

    /// Somebody had its parameters stored.
    pub(super) fn storing(&mut self, now: Instant) {
        if let Some(procedure) = &mut self.procedure {
            procedure.storing(now);
        }
    }

    /// Whether bytes for its lines are taken.
    pub(super) fn takes_bytes(&self) -> bool {
        self.link_up
            && self
                .procedure
                .as_ref()
                .is_none_or(|procedure| self.alive && procedure.condition() != Condition::Other)
    }

    /// Bytes for a line; `None`: there is no such channel.
    pub(super) fn send(
        &mut self,
        now: Instant,
        place: usize,
        id: u64,
        bytes: Vec<u8>,
    ) -> Option<Result<(), Full>> {
        Some(self.channels.get_mut(place)?.send(now, id, bytes))
    }

    /// The channel whose frame is due first, and when.
    pub(super) fn data_due(&self) -> Option<(Instant, usize)> {
        let from = match &self.procedure {
            Some(procedure) => procedure.passes_on_from()?,
            None => Instant::START,
        };
        let due = |(place, channel): (usize, &SerialChannel)| Some((channel.due()?.max(from), place));
        self.channels.iter().enumerate().filter_map(due).min()
    }

    /// Gives out the next frame of a channel; `None`: what is first there is empty.
    pub(super) fn give_out(&mut self, place: usize) -> Option<CanFrame> {
        self.channels.get_mut(place)?.give_out()
    }

    /// That frame was handed to the bus, if it was not given back.
    pub(super) fn data_handed_out(&mut self, place: usize, teller: &mut Teller<'_>) {
        let Some(channel) = self.channels.get_mut(place) else { return };
        let (bytes, ended) = channel.handed_out();
        if bytes > 0 {
            teller.tell(ModuleEvent::Sent { channel: place, bytes });
        }
        if let Some(ended) = ended {
            tell_ended(place, ended, teller);
        }
    }

    /// When its management has a step to take, and what that asks.
    pub(super) fn next_step(&self) -> Option<(Instant, Option<Request>)> {
        self.procedure.as_ref().and_then(Procedure::next)
    }

    /// When [`handle_timeout`](Self::handle_timeout) has something to do, and why.
    pub(super) fn poll_timeout(&self) -> Option<(Instant, &'static str)> {
        let channels = self.channels.iter().filter_map(SerialChannel::poll_timeout);
        let never_seen = self.never_seen.map(|at| (at, "module that was never seen"));
        let watchdog = self.watchdog.as_ref().and_then(Watchdog::poll_timeout);
        channels.chain(never_seen).chain(watchdog).min_by_key(|(at, _)| *at)
    }

    /// A sign of life.
    fn appear(&mut self, now: Instant, teller: &mut Teller<'_>) {
        if self.link_up && !std::mem::replace(&mut self.alive, true) {
            self.never_seen = None;
            teller.tell(ModuleEvent::Appeared);
            if let Some(procedure) = &mut self.procedure {
                procedure.wake(now);
            }
        }
    }

    /// What its watchdog says. Silence and toggle bits count only while it is known that the watchdog of the module is as it
    /// was set: it is off in one that reset itself (R-ESD-081).
    fn judge(&mut self, now: Instant, verdict: Verdict, teller: &mut Teller<'_>) -> bool {
        if !self.procedure.as_ref().is_some_and(Procedure::is_guarded) {
            if let Some(watchdog) = &mut self.watchdog {
                watchdog.forgive();
            }
            return false;
        }
        match verdict {
            Verdict::Nothing | Verdict::Alive => return false,
            Verdict::Missed(in_a_row) => teller.tell(ModuleEvent::WatchdogMiss { in_a_row }),
            Verdict::ToggleError => teller.tell(ModuleEvent::ToggleError),
        }
        if !self.alive || !self.watchdog.as_ref().is_some_and(Watchdog::has_failed) {
            return false;
        }
        if let Some(procedure) = &mut self.procedure {
            procedure.lose(now);
        }
        self.apply(now, Change::Lost, teller)
    }

    fn apply(&mut self, now: Instant, change: Change, teller: &mut Teller<'_>) -> bool {
        match change {
            Change::Nothing => false,
            Change::Configured => {
                if let Some(watchdog) = &mut self.watchdog {
                    watchdog.start(now);
                }
                false
            }
            Change::Restarted => {
                self.stop_watchdog();
                self.channels.iter_mut().for_each(SerialChannel::ring_is_empty);
                self.break_off(Cause::Restarted, teller);
                true
            }
            Change::Lost => {
                self.alive = false;
                if let Some(watchdog) = &mut self.watchdog {
                    watchdog.forgive();
                }
                teller.tell(ModuleEvent::Lost);
                self.break_off(Cause::Lost, teller);
                true
            }
        }
    }

    /// `true`: it was triggered until now.
    fn stop_watchdog(&mut self) -> bool {
        self.watchdog.as_mut().is_some_and(Watchdog::stop)
    }

    /// What waits for its lines is given up, and what came in on them is cut.
    fn break_off(&mut self, why: Cause, teller: &mut Teller<'_>) {
        for (place, channel) in self.channels.iter_mut().enumerate() {
            channel.suspend(Instant::START, false);
            for ended in channel.break_off(why) {
                tell_ended(place, ended, teller);
            }
            if let Some(message) = channel.cut() {
                tell_message(place, message, teller);
            }
        }
    }
}

fn time_out(now: Instant, place: usize, channel: &mut SerialChannel, teller: &mut Teller<'_>) {
    let (message, ended) = channel.handle_timeout(now);
    if let Some(message) = message {
        tell_message(place, message, teller);
    }
    for ended in ended {
        tell_ended(place, ended, teller);
    }
}

fn tell_message(channel: usize, (bytes, end): (Vec<u8>, MessageEnd), teller: &mut Teller<'_>) {
    teller.tell(ModuleEvent::Message { channel, bytes, end });
}

fn tell_ended(channel: usize, ended: Ended, teller: &mut Teller<'_>) {
    teller.tell(ModuleEvent::SendDone { channel, id: ended.id, outcome: ended.outcome });
}
