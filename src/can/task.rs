//! The task that owns one bus: opens it, reads, writes, counts, and opens it again whenever it was lost. \[IO\]
//!
//! Reading and writing go on side by side and never wait for each other. When the gateway is slow, reading waits for
//! it and the kernel's buffer holds the frames; what that cannot hold is counted ([`BusCounters::overruns`]).
//!
//! A frame that cannot be sent now is answered with [`BusEvent::NotSent`] at once and forgotten: a guard request that
//! goes out late, when the cable is back, is worse than none.

use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use tokio::sync::mpsc;
use tokio::time::{Interval, MissedTickBehavior, interval};
use tokio_util::sync::CancellationToken;

use super::bus_log::BusLog;
use super::interface::Interface;
use super::outage::Repeats;
use super::{BusCounters, BusError, BusEvent, BusIndex, BusReader, BusWriter, CanFrame, Link, Tally, open};
use crate::time::{Clock, Instant};

/// Time between a failure and the first try to open the bus again; it doubles up to the longest.
const FIRST_WAIT: Duration = Duration::from_millis(100);

/// A bus that worked for so long was no false start: its failure is a first one.
const STEADY: Duration = Duration::from_secs(10);

/// How often the counters are reported.
const REPORT_EVERY: Duration = Duration::from_secs(1);

/// What the task does with frames that are to be sent.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Sending {
    /// Nothing may leave, not even the acknowledging of frames: `listen_only` as with [`open`]. Where an interface of the host
    /// acknowledges frames all the same, that is logged.
    Never,
    /// They are sent; those that could not be are told of.
    Untold,
    /// The same, and each that left is told of ([`BusEvent::Sent`]). The next one waits until there is room to tell it.
    Told,
}

/// Runs one bus until `stop`, or until the gateway is gone.
///
/// `events` is awaited when it is full. Frames are taken from `transmit` one after another.
pub async fn run(
    bus: BusIndex,
    interface: Interface,
    sending: Sending,
    events: mpsc::Sender<(BusIndex, BusEvent)>,
    transmit: mpsc::Receiver<CanFrame>,
    clock: Clock,
    stop: CancellationToken,
) {
    let ends = Ends { bus, name: interface.to_string(), sending, events, transmit, clock, stop };
    run_with(|| open(&interface, sending == Sending::Never, clock), longest_wait(&interface), ends).await;
}

/// An interface that was re-created is found within a second; a far host is not called that often.
fn longest_wait(interface: &Interface) -> Duration {
    match interface {
        Interface::SocketCan(_) | Interface::Virtual(_) | Interface::Slcan { .. } => {
            Duration::from_millis(500)
        }
        Interface::SlcanTcp { .. } => Duration::from_secs(2),
    }
}

/// What ties the task to the rest of the program.
pub struct Ends {
    /// Which of the configured buses this is.
    pub bus: BusIndex,
    /// The interface as the user wrote it, for the log.
    pub name: String,
    /// Of frames that are to be sent.
    pub sending: Sending,
    /// To the gateway.
    pub events: mpsc::Sender<(BusIndex, BusEvent)>,
    /// From the gateway.
    pub transmit: mpsc::Receiver<CanFrame>,
    /// The clock.
    pub clock: Clock,
    /// Ends the task.
    pub stop: CancellationToken,
}

/// As [`run`], on any kind of bus.
pub async fn run_with<R: BusReader, W: BusWriter>(
    open: impl FnMut() -> Result<(R, W), BusError>,
    longest_wait: Duration,
    ends: Ends,
) {
    let Ends { bus, name, sending, events, transmit, clock, stop } = ends;
    let desk = Desk { bus, name, sending, events, clock, state: Mutex::default() };
    let writer = tokio::sync::Mutex::new(None);
    tokio::select! {
        // First what is to be sent: a gateway that has gone may have left something.
        biased;
        _ = write_for_ever(&desk, &writer, transmit) => {}
        Err(GatewayGone) = read_for_ever(&desk, &writer, open, longest_wait) => {}
        () = stop.cancelled() => {}
    }
}

/// The gateway has dropped its end: nobody is left to work for.
struct GatewayGone;

/// What reading and writing share.
struct Desk {
    bus: BusIndex,
    name: String,
    sending: Sending,
    events: mpsc::Sender<(BusIndex, BusEvent)>,
    clock: Clock,
    state: Mutex<State>,
}

#[derive(Default)]
struct State {
    /// As told to the gateway; `None` before it was told anything.
    link: Option<Link>,
    counters: BusCounters,
    /// What readers of earlier openings had counted.
    before: Tally,
    /// Frames that were counted as sent and came back, and their bits: counters never go back, so that the next ones are
    /// not counted instead.
    frames_too_many: u64,
    bits_too_many: u64,
}

/// Adds to a counter, less what it has too many.
fn add(counter: &mut u64, amount: u64, too_many: &mut u64) {
    let known = amount.min(*too_many);
    *too_many -= known;
    *counter = counter.saturating_add(amount - known);
}

impl Desk {
    fn state(&self) -> MutexGuard<'_, State> {
        // The state is whole after every statement, so a panic elsewhere leaves a good one.
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    async fn tell(&self, event: BusEvent) -> Result<(), GatewayGone> {
        self.events.send((self.bus, event)).await.map_err(|_| GatewayGone)
    }

    async fn tell_counters(&self) -> Result<(), GatewayGone> {
        let counters = self.state().counters;
        self.tell(BusEvent::Counters { counters, at: self.clock.now() }).await
    }

    /// Whether this is news.
    fn set_link(&self, link: Link) -> bool {
        let mut state = self.state();
        let changed = state.link.replace(link) != Some(link);
        if changed && link == Link::BusOff {
            state.counters.bus_off_count = state.counters.bus_off_count.saturating_add(1);
        }
        changed
    }

    fn count_received(&self, frame: &CanFrame) {
        let State { counters, bits_too_many, .. } = &mut *self.state();
        counters.frames_received = counters.frames_received.saturating_add(1);
        add(&mut counters.wire_bits, u64::from(frame.wire_bits()), bits_too_many);
    }

    fn count_sent(&self, frame: &CanFrame) {
        let State { counters, frames_too_many, bits_too_many, .. } = &mut *self.state();
        add(&mut counters.frames_sent, 1, frames_too_many);
        add(&mut counters.wire_bits, u64::from(frame.wire_bits()), bits_too_many);
    }

    fn count_not_sent(&self) {
        let counters = &mut self.state().counters;
        counters.frames_not_sent = counters.frames_not_sent.saturating_add(1);
    }

    /// A frame that the interface had taken, so that it is counted as sent, did not leave.
    fn count_came_back(&self, frame: &CanFrame) {
        self.count_not_sent();
        let mut state = self.state();
        state.frames_too_many = state.frames_too_many.saturating_add(1);
        state.bits_too_many = state.bits_too_many.saturating_add(u64::from(frame.wire_bits()));
    }

    fn is_up(&self) -> bool {
        self.state().link.is_some_and(Link::is_up)
    }

    /// Takes over what the present reader has counted; whether frames were lost since the last time.
    fn take_tally(&self, tally: Tally) -> bool {
        let mut state = self.state();
        let before = state.before;
        let counters = &mut state.counters;
        counters.error_frames = before.error_frames.saturating_add(tally.error_frames);
        counters.fd_frames = before.fd_frames.saturating_add(tally.fd_frames);
        counters.bit_rate = tally.bit_rate;
        let overruns = before.overruns.saturating_add(tally.overruns);
        std::mem::replace(&mut counters.overruns, overruns) != overruns
    }

    /// The present reader has ended.
    fn close_tally(&self, tally: Tally) {
        self.take_tally(tally);
        let mut state = self.state();
        let counters = state.counters;
        state.before = Tally {
            error_frames: counters.error_frames,
            fd_frames: counters.fd_frames,
            overruns: counters.overruns,
            ..Tally::default()
        };
    }
}

async fn read_for_ever<R: BusReader, W: BusWriter>(
    desk: &Desk,
    writer: &tokio::sync::Mutex<Option<W>>,
    mut open: impl FnMut() -> Result<(R, W), BusError>,
    longest_wait: Duration,
) -> Result<std::convert::Infallible, GatewayGone> {
    let mut reports = interval(REPORT_EVERY);
    reports.set_missed_tick_behavior(MissedTickBehavior::Delay);
    let mut log = BusLog::new(&desk.name);
    let mut wait = FIRST_WAIT;
    loop {
        let error = match open() {
            Ok((mut reader, opened)) => {
                *writer.lock().await = Some(opened);
                let mut session = Session { desk, log: &mut log, up_since: None };
                let error = session.read(&mut reader, &mut reports).await?;
                let now = desk.clock.now().instant;
                if session.up_since.is_some_and(|since| now.since(since) >= STEADY) {
                    wait = FIRST_WAIT;
                }
                *writer.lock().await = None;
                desk.close_tally(reader.tally());
                error
            }
            Err(error) => error,
        };
        log.handle_error(&error, desk.clock.now().instant);
        if desk.set_link(Link::Absent) {
            desk.tell(BusEvent::Link { link: Link::Absent, at: desk.clock.now() }).await?;
        }
        let again = tokio::time::sleep(wait);
        tokio::pin!(again);
        loop {
            tokio::select! {
                () = &mut again => break,
                _ = reports.tick() => {
                    log.handle_timeout(desk.clock.now().instant);
                    desk.tell_counters().await?;
                }
            }
        }
        wait = longest_wait.min(wait * 2);
    }
}

/// From one opening of the bus to its failure.
struct Session<'a> {
    desk: &'a Desk,
    log: &'a mut BusLog,
    /// Since when the bus has worked, of this opening.
    up_since: Option<Instant>,
}

impl Session<'_> {
    async fn read<R: BusReader>(
        &mut self,
        reader: &mut R,
        reports: &mut Interval,
    ) -> Result<BusError, GatewayGone> {
        loop {
            let event = tokio::select! {
                biased;
                _ = reports.tick() => None,
                event = reader.recv() => match event {
                    Ok(event) => Some(event),
                    Err(error) => return Ok(error),
                }
            };
            let tally = reader.tally();
            if self.desk.sending == Sending::Never {
                self.log.handle_listening(tally.listens_only);
            }
            let lost_frames = self.desk.take_tally(tally);
            if event.is_none() {
                self.log.handle_timeout(self.desk.clock.now().instant);
            }
            if lost_frames || event.is_none() {
                self.log.handle_counters(&self.desk.state().counters);
                self.desk.tell_counters().await?;
            }
            if let Some(event) = event {
                self.handle(event).await?;
            }
        }
    }

    async fn handle(&mut self, event: BusEvent) -> Result<(), GatewayGone> {
        match event {
            BusEvent::Frame { frame, .. } => self.desk.count_received(&frame),
            BusEvent::Link { link, at } => {
                if !self.desk.set_link(link) {
                    return Ok(());
                }
                if link.is_up() {
                    self.up_since.get_or_insert(at.instant);
                }
                self.log.handle_link(link, at.instant);
                self.log.handle_counters(&self.desk.state().counters);
            }
            BusEvent::NotSent { frame, .. } => self.desk.count_came_back(&frame),
            // These are this task's own business.
            BusEvent::Sent { .. } | BusEvent::Counters { .. } => return Ok(()),
        }
        self.desk.tell(event).await
    }
}

/// Ends when the gateway is gone.
async fn write_for_ever<W: BusWriter>(
    desk: &Desk,
    writer: &tokio::sync::Mutex<Option<W>>,
    mut transmit: mpsc::Receiver<CanFrame>,
) -> Result<(), GatewayGone> {
    let mut failures = Repeats::default();
    while let Some(frame) = transmit.recv().await {
        // The lock ends with this statement: the gateway may be slow to take what it is told.
        let sent = match writer.lock().await.as_mut() {
            Some(writer) if desk.is_up() => Some(writer.send(&frame).await),
            Some(_) | None => None,
        };
        let at = desk.clock.now();
        if let Some(Ok(())) = sent {
            desk.count_sent(&frame);
            if desk.sending == Sending::Told {
                desk.tell(BusEvent::Sent { frame, at }).await?;
            }
            continue;
        }
        if let Some(Err(error)) = sent
            && let Some(unsaid) = failures.admit(at.instant)
        {
            tracing::warn!(interface = desk.name, %frame, %error, unsaid, "a frame was not sent");
        }
        desk.count_not_sent();
        desk.tell(BusEvent::NotSent { frame, at }).await?;
    }
    Ok(())
}

#[cfg(test)]
#[path = "task_tests.rs"]
mod tests;
