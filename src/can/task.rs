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

use super::interface::Interface;
use super::outage::{Outage, Repeats};
use super::{
    BusCounters, BusError, BusEvent, BusIndex, BusReader, BusWriter, CanBus, CanFrame, Link, Tally, open,
};
use crate::time::{Clock, Instant};

/// Time between a failure and the first try to open the bus again; it doubles up to the longest.
const FIRST_WAIT: Duration = Duration::from_millis(100);

/// How often the counters are reported.
const REPORT_EVERY: Duration = Duration::from_secs(1);

/// Runs one bus until `stop`, or until the gateway is gone.
///
/// `events` is awaited when it is full. Frames are taken from `transmit` one after another.
pub async fn run(
    bus: BusIndex,
    interface: Interface,
    events: mpsc::Sender<(BusIndex, BusEvent)>,
    transmit: mpsc::Receiver<CanFrame>,
    clock: Clock,
    stop: CancellationToken,
) {
    let ends = Ends { bus, name: interface.to_string(), events, transmit, clock, stop };
    run_with(|| open(&interface, clock), longest_wait(&interface), ends).await;
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
pub async fn run_with<B: CanBus>(
    open: impl FnMut() -> Result<B, BusError>,
    longest_wait: Duration,
    ends: Ends,
) {
    let Ends { bus, name, events, transmit, clock, stop } = ends;
    let desk = Desk { bus, name, events, clock, state: Mutex::default() };
    let writer = tokio::sync::Mutex::new(None);
    tokio::select! {
        Err(GatewayGone) = read_for_ever(&desk, &writer, open, longest_wait) => {}
        _ = write_for_ever(&desk, &writer, transmit) => {}
        () = stop.cancelled() => {}
    }
}

/// The gateway has dropped its end: nobody is left to work for.
struct GatewayGone;

/// What reading and writing share.
struct Desk {
    bus: BusIndex,
    name: String,
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
            bit_rate: None,
        };
    }
}

async fn read_for_ever<B: CanBus>(
    desk: &Desk,
    writer: &tokio::sync::Mutex<Option<B::Writer>>,
    mut open: impl FnMut() -> Result<B, BusError>,
    longest_wait: Duration,
) -> Result<std::convert::Infallible, GatewayGone> {
    let mut reports = interval(REPORT_EVERY);
    reports.set_missed_tick_behavior(MissedTickBehavior::Delay);
    let mut log = Log::default();
    let mut wait = FIRST_WAIT;
    loop {
        let error = match open() {
            Ok(bus) => {
                let (mut reader, opened) = bus.split();
                *writer.lock().await = Some(opened);
                let mut session = Session { desk, log: &mut log, was_up: false };
                let error = session.read(&mut reader, &mut reports).await?;
                if session.was_up {
                    wait = FIRST_WAIT;
                }
                *writer.lock().await = None;
                desk.close_tally(reader.tally());
                error
            }
            Err(error) => error,
        };
        log.outage.handle_error(&desk.name, &error, desk.clock.now().instant);
        let link = if matches!(error, BusError::Down { .. }) { Link::Down } else { Link::Absent };
        if desk.set_link(link) {
            desk.tell(BusEvent::Link { link, at: desk.clock.now() }).await?;
        }
        let again = tokio::time::sleep(wait);
        tokio::pin!(again);
        loop {
            tokio::select! {
                () = &mut again => break,
                _ = reports.tick() => desk.tell_counters().await?,
            }
        }
        wait = longest_wait.min(wait * 2);
    }
}

/// What the log has been told.
#[derive(Default)]
struct Log {
    outage: Outage,
    down: Repeats,
    bus_off: Repeats,
    passive: Repeats,
    suspected_bit_rate: bool,
}

/// From one opening of the bus to its failure.
struct Session<'a> {
    desk: &'a Desk,
    log: &'a mut Log,
    was_up: bool,
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
            let lost_frames = self.desk.take_tally(reader.tally());
            if lost_frames || event.is_none() {
                self.suspect_bit_rate();
                self.desk.tell_counters().await?;
            }
            if let Some(event) = event {
                self.handle(event).await?;
            }
        }
    }

    async fn handle(&mut self, event: BusEvent) -> Result<(), GatewayGone> {
        match event {
            BusEvent::Frame { frame, .. } => {
                let counters = &mut self.desk.state().counters;
                counters.frames_received = counters.frames_received.saturating_add(1);
                counters.wire_bits = counters.wire_bits.saturating_add(u64::from(frame.wire_bits()));
            }
            BusEvent::Link { link, at } => {
                if !self.desk.set_link(link) {
                    return Ok(());
                }
                self.was_up |= link.is_up();
                self.log.handle_link(&self.desk.name, link, at.instant);
                self.suspect_bit_rate();
            }
            BusEvent::NotSent { .. } => {
                let counters = &mut self.desk.state().counters;
                counters.frames_not_sent = counters.frames_not_sent.saturating_add(1);
            }
            // Counters are this task's own business.
            BusEvent::Counters { .. } => return Ok(()),
        }
        self.desk.tell(event).await
    }

    fn suspect_bit_rate(&mut self) {
        let counters = self.desk.state().counters;
        if self.log.suspected_bit_rate || !counters.bit_rate_is_suspect() {
            return;
        }
        self.log.suspected_bit_rate = true;
        let bit_rate = counters.bit_rate.map_or_else(|| "unknown".to_owned(), |rate| format!("{rate} bit/s"));
        tracing::warn!(
            interface = self.desk.name,
            bit_rate,
            error_frames = counters.error_frames,
            "errors and not one valid frame: the bit rate may differ from that of the bus; else look at the \
             wiring and the terminators"
        );
    }
}

impl Log {
    fn handle_link(&mut self, interface: &str, link: Link, at: Instant) {
        if link.is_up() {
            self.outage.handle_up(interface, at);
        }
        match link {
            Link::ErrorActive => tracing::debug!(interface, "the bus works"),
            Link::ErrorPassive => {
                if let Some(unsaid) = self.passive.admit(at) {
                    tracing::warn!(
                        interface,
                        unsaid,
                        "error passive: nobody acknowledges, or wiring or bit rate are wrong"
                    );
                }
            }
            Link::BusOff => {
                if let Some(unsaid) = self.bus_off.admit(at) {
                    tracing::warn!(
                        interface,
                        unsaid,
                        "bus-off: the controller has left the bus; it comes back by itself where the interface has \
                         a restart-ms, else with `ip link set {interface} type can restart`"
                    );
                }
            }
            Link::Down | Link::Absent => {
                if let Some(unsaid) = self.down.admit(at) {
                    tracing::warn!(interface, unsaid, "the interface is down");
                }
            }
        }
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
        let error = match writer.lock().await.as_mut() {
            Some(writer) if desk.is_up() => writer.send(&frame).await.err(),
            Some(_) | None => {
                not_sent(desk, frame).await?;
                continue;
            }
        };
        let Some(error) = error else {
            let counters = &mut desk.state().counters;
            counters.frames_sent = counters.frames_sent.saturating_add(1);
            counters.wire_bits = counters.wire_bits.saturating_add(u64::from(frame.wire_bits()));
            continue;
        };
        if let Some(unsaid) = failures.admit(desk.clock.now().instant) {
            tracing::warn!(interface = desk.name, %frame, %error, unsaid, "a frame was not sent");
        }
        not_sent(desk, frame).await?;
    }
    Ok(())
}

async fn not_sent(desk: &Desk, frame: CanFrame) -> Result<(), GatewayGone> {
    {
        let counters = &mut desk.state().counters;
        counters.frames_not_sent = counters.frames_not_sent.saturating_add(1);
    }
    desk.tell(BusEvent::NotSent { frame, at: desk.clock.now() }).await
}

#[cfg(test)]
mod tests {
    use std::collections::VecDeque;
    use std::sync::Arc;

    use super::*;
    use crate::can::virtual_bus::VirtualBus;

    type Told = (BusIndex, BusEvent);

    /// A bus that a test plays.
    struct FakeReader {
        script: mpsc::Receiver<Result<BusEvent, BusError>>,
        tally: Arc<Mutex<Tally>>,
    }

    impl BusReader for FakeReader {
        async fn recv(&mut self) -> Result<BusEvent, BusError> {
            match self.script.recv().await {
                Some(happened) => happened,
                None => std::future::pending().await,
            }
        }

        fn tally(&self) -> Tally {
            *self.tally.lock().unwrap()
        }
    }

    /// Fails to send while `busy`.
    struct FakeWriter {
        sent: mpsc::Sender<CanFrame>,
        busy: Arc<Mutex<bool>>,
    }

    impl BusWriter for FakeWriter {
        async fn send(&mut self, frame: &CanFrame) -> Result<(), BusError> {
            if *self.busy.lock().unwrap() {
                return Err(BusError::Busy { interface: "fake".into() });
            }
            self.sent.send(*frame).await.unwrap();
            Ok(())
        }
    }

    /// The test's side of a fake bus.
    struct Stage {
        script: mpsc::Sender<Result<BusEvent, BusError>>,
        tally: Arc<Mutex<Tally>>,
        sent: mpsc::Receiver<CanFrame>,
        busy: Arc<Mutex<bool>>,
    }

    fn fake_bus() -> (Stage, (FakeReader, FakeWriter)) {
        let (script, played) = mpsc::channel(100);
        let (sent, seen) = mpsc::channel(100);
        let tally = Arc::new(Mutex::new(Tally::default()));
        let busy = Arc::new(Mutex::new(false));
        let reader = FakeReader { script: played, tally: Arc::clone(&tally) };
        let writer = FakeWriter { sent, busy: Arc::clone(&busy) };
        (Stage { script, tally, sent: seen, busy }, (reader, writer))
    }

    struct Harness {
        events: mpsc::Receiver<Told>,
        transmit: mpsc::Sender<CanFrame>,
        stop: CancellationToken,
        clock: Clock,
        task: tokio::task::JoinHandle<()>,
    }

    /// Runs the task on these buses, one opening after another.
    fn run_on(openings: Vec<Result<(FakeReader, FakeWriter), BusError>>) -> Harness {
        let (events, told) = mpsc::channel(1_024);
        let (transmit, to_send) = mpsc::channel(64);
        let (stop, clock) = (CancellationToken::new(), Clock::start());
        let mut openings = VecDeque::from(openings);
        let open = move || openings.pop_front().unwrap_or_else(|| Err(absent()));
        let ends = Ends {
            bus: BusIndex(3),
            name: "fake".into(),
            events,
            transmit: to_send,
            clock,
            stop: stop.clone(),
        };
        let task = tokio::spawn(run_with(open, Duration::from_millis(500), ends));
        Harness { events: told, transmit, stop, clock, task }
    }

    impl Harness {
        /// The next event that is not the report of the counters.
        async fn next(&mut self) -> BusEvent {
            loop {
                let (bus, event) = self.events.recv().await.unwrap();
                assert_eq!(bus, BusIndex(3));
                if !matches!(event, BusEvent::Counters { .. }) {
                    return event;
                }
            }
        }

        async fn next_link(&mut self) -> Link {
            match self.next().await {
                BusEvent::Link { link, .. } => link,
                BusEvent::Frame { .. } | BusEvent::NotSent { .. } | BusEvent::Counters { .. } => {
                    panic!("no link")
                }
            }
        }

        /// The counters that are reported from now on.
        async fn counters(&mut self) -> BusCounters {
            while self.events.try_recv().is_ok() {}
            loop {
                if let (_, BusEvent::Counters { counters, .. }) = self.events.recv().await.unwrap() {
                    return counters;
                }
            }
        }
    }

    fn absent() -> BusError {
        BusError::Absent { interface: "fake".into(), source: std::io::ErrorKind::NotFound.into() }
    }

    fn link(link: Link) -> BusEvent {
        BusEvent::Link { link, at: crate::time::Now::from_millis(0) }
    }

    fn frame(text: &str) -> CanFrame {
        text.parse().unwrap()
    }

    fn received(text: &str) -> BusEvent {
        BusEvent::Frame { frame: frame(text), at: crate::time::Now::from_millis(7) }
    }

    #[tokio::test(start_paused = true)]
    async fn what_the_bus_gives_reaches_the_gateway_unchanged() {
        let (stage, bus) = fake_bus();
        let mut harness = run_on(vec![Ok(bus)]);
        stage.script.send(Ok(link(Link::ErrorActive))).await.unwrap();
        stage.script.send(Ok(received("181#01"))).await.unwrap();
        assert_eq!(harness.next_link().await, Link::ErrorActive);
        assert_eq!(harness.next().await, received("181#01"));
    }

    #[tokio::test(start_paused = true)]
    async fn f08_a_bus_that_is_absent_at_the_start_is_used_when_it_appears() {
        let (stage, bus) = fake_bus();
        let mut harness = run_on(vec![Err(absent()), Err(absent()), Err(absent()), Ok(bus)]);
        stage.script.send(Ok(link(Link::ErrorActive))).await.unwrap();
        assert_eq!(harness.next_link().await, Link::Absent);
        assert_eq!(harness.next_link().await, Link::ErrorActive);
    }

    #[tokio::test(start_paused = true)]
    async fn p21_a_lost_bus_is_opened_again_within_a_second() {
        let (first, bus) = fake_bus();
        let (second, again) = fake_bus();
        let mut openings = vec![Ok(bus)];
        openings.extend((0..20).map(|_| Err(absent())));
        openings.push(Ok(again));
        let mut harness = run_on(openings);
        first.script.send(Ok(link(Link::ErrorActive))).await.unwrap();
        first.script.send(Err(absent())).await.unwrap();
        second.script.send(Ok(link(Link::ErrorActive))).await.unwrap();
        assert_eq!(harness.next_link().await, Link::ErrorActive);
        assert_eq!(harness.next_link().await, Link::Absent);
        assert_eq!(harness.next_link().await, Link::ErrorActive);
        // 21 tries, at most half a second apart; the clock is the test's own.
        assert!(harness.clock.now().instant <= Instant::from_millis(21 * 500));
    }

    #[tokio::test(start_paused = true)]
    async fn p20_a_frame_for_a_bus_that_is_not_up_is_given_back_at_once_and_never_sent_later() {
        let (mut stage, bus) = fake_bus();
        let mut harness = run_on(vec![Ok(bus)]);
        for state in [Link::Down, Link::BusOff] {
            stage.script.send(Ok(link(state))).await.unwrap();
            assert_eq!(harness.next_link().await, state);
            harness.transmit.send(frame("701#R1")).await.unwrap();
            assert!(
                matches!(harness.next().await, BusEvent::NotSent { frame: back, .. } if back == frame("701#R1"))
            );
        }
        stage.script.send(Ok(link(Link::ErrorActive))).await.unwrap();
        assert_eq!(harness.next_link().await, Link::ErrorActive);
        harness.transmit.send(frame("000#0101")).await.unwrap();
        assert_eq!(stage.sent.recv().await, Some(frame("000#0101")));
        let counters = harness.counters().await;
        assert_eq!((counters.frames_sent, counters.frames_not_sent, counters.bus_off_count), (1, 2, 1));
    }

    #[tokio::test(start_paused = true)]
    async fn p20_a_frame_that_a_full_queue_refuses_is_given_back() {
        let (mut stage, bus) = fake_bus();
        let mut harness = run_on(vec![Ok(bus)]);
        stage.script.send(Ok(link(Link::ErrorPassive))).await.unwrap();
        assert_eq!(harness.next_link().await, Link::ErrorPassive);
        *stage.busy.lock().unwrap() = true;
        harness.transmit.send(frame("701#R1")).await.unwrap();
        assert!(matches!(harness.next().await, BusEvent::NotSent { .. }));
        *stage.busy.lock().unwrap() = false;
        harness.transmit.send(frame("701#R1")).await.unwrap();
        assert_eq!(stage.sent.recv().await, Some(frame("701#R1")));
    }

    #[tokio::test(start_paused = true)]
    async fn counters_go_on_over_a_new_opening() {
        let (first, bus) = fake_bus();
        let (second, again) = fake_bus();
        let mut harness = run_on(vec![Ok(bus), Ok(again)]);
        *first.tally.lock().unwrap() =
            Tally { error_frames: 5, fd_frames: 2, overruns: 7, bit_rate: Some(125_000) };
        first.script.send(Ok(link(Link::ErrorActive))).await.unwrap();
        first.script.send(Ok(received("181#01"))).await.unwrap();
        first.script.send(Err(absent())).await.unwrap();
        *second.tally.lock().unwrap() = Tally { error_frames: 1, fd_frames: 1, overruns: 1, bit_rate: None };
        second.script.send(Ok(link(Link::ErrorActive))).await.unwrap();
        second.script.send(Ok(received("181#01"))).await.unwrap();
        for _ in 0..5 {
            harness.next().await;
        }
        let counters = harness.counters().await;
        let wire_bits = 2 * u64::from(frame("181#01").wire_bits());
        let expected = BusCounters {
            frames_received: 2,
            error_frames: 6,
            fd_frames: 3,
            overruns: 8,
            wire_bits,
            ..BusCounters::default()
        };
        assert_eq!(counters, expected);
    }

    #[tokio::test(start_paused = true)]
    async fn counters_are_told_at_once_when_frames_were_lost_and_once_a_second_else() {
        let (stage, bus) = fake_bus();
        let mut harness = run_on(vec![Ok(bus)]);
        stage.script.send(Ok(link(Link::ErrorActive))).await.unwrap();
        harness.next_link().await;
        harness.counters().await;
        let before = harness.clock.now().instant;
        assert_eq!(harness.counters().await.overruns, 0);
        assert_eq!(harness.clock.now().instant.since(before), REPORT_EVERY);
        stage.tally.lock().unwrap().overruns = 3;
        let before = harness.clock.now().instant;
        stage.script.send(Ok(received("181#01"))).await.unwrap();
        assert_eq!(harness.counters().await.overruns, 3);
        assert_eq!(harness.clock.now().instant, before);
    }

    #[tokio::test(start_paused = true)]
    async fn reading_goes_on_while_a_send_hangs() {
        struct Hanging;
        impl BusWriter for Hanging {
            async fn send(&mut self, _: &CanFrame) -> Result<(), BusError> {
                std::future::pending().await
            }
        }
        let (stage, (reader, _)) = fake_bus();
        let (events, mut told) = mpsc::channel(1_024);
        let (transmit, to_send) = mpsc::channel(64);
        let stop = CancellationToken::new();
        let mut opening = Some((reader, Hanging));
        let open = move || opening.take().ok_or_else(absent);
        let name = "fake".to_owned();
        let ends = Ends { bus: BusIndex(0), name, events, transmit: to_send, clock: Clock::start(), stop };
        let _task = tokio::spawn(run_with(open, Duration::from_millis(500), ends));
        stage.script.send(Ok(link(Link::ErrorActive))).await.unwrap();
        transmit.send(frame("701#R1")).await.unwrap();
        for _ in 0..100 {
            tokio::task::yield_now().await;
            stage.script.send(Ok(received("181#01"))).await.unwrap();
        }
        let mut frames = 0;
        while frames < 100 {
            frames += u32::from(matches!(told.recv().await.unwrap().1, BusEvent::Frame { .. }));
        }
    }

    #[tokio::test(start_paused = true)]
    async fn the_task_ends_when_told_to_and_when_the_gateway_is_gone() {
        let (_stage, bus) = fake_bus();
        let harness = run_on(vec![Ok(bus)]);
        harness.stop.cancel();
        harness.task.await.unwrap();

        let (_stage, bus) = fake_bus();
        let harness = run_on(vec![Ok(bus)]);
        drop(harness.events);
        harness.task.await.unwrap();
    }

    #[tokio::test(start_paused = true)]
    async fn a_virtual_bus_is_run_by_the_same_task() {
        let bus = VirtualBus::default();
        let clock = Clock::start();
        let (events, mut told) = mpsc::channel(1_024);
        let (transmit, to_send) = mpsc::channel(64);
        let stop = CancellationToken::new();
        let ours = bus.clone();
        let name = "virtual:test".to_owned();
        let ends = Ends { bus: BusIndex(0), name, events, transmit: to_send, clock, stop };
        let _task = tokio::spawn(run_with(move || Ok(ours.join(clock)), Duration::from_millis(500), ends));
        let (mut reader, mut writer) = bus.join(clock).split();
        while !matches!(told.recv().await.unwrap().1, BusEvent::Link { link: Link::ErrorActive, .. }) {}
        transmit.send(frame("000#0101")).await.unwrap();
        while !matches!(reader.recv().await.unwrap(), BusEvent::Frame { frame: heard, .. } if heard == frame("000#0101"))
        {
        }
        writer.send(&frame("701#00")).await.unwrap();
        while !matches!(told.recv().await.unwrap().1, BusEvent::Frame { frame: heard, .. } if heard == frame("701#00"))
        {
        }
    }
}
