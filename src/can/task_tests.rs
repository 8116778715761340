//! Tests of the bus task, on a bus that the test plays, with the test in the gateway's place.

use std::collections::VecDeque;
use std::sync::Arc;

use super::*;
use crate::can::virtual_bus::VirtualBus;

type Told = (BusIndex, BusEvent);

/// The longest wait between two openings.
const LONGEST: Duration = Duration::from_millis(500);

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
        sending: Sending::Told,
        events,
        transmit: to_send,
        clock,
        stop: stop.clone(),
    };
    let task = tokio::spawn(run_with(open, LONGEST, ends));
    Harness { events: told, transmit, stop, clock, task }
}

impl Harness {
    /// The next event that is not the report of the counters, nor of a frame that was sent.
    async fn next(&mut self) -> BusEvent {
        loop {
            let (bus, event) = self.events.recv().await.unwrap();
            assert_eq!(bus, BusIndex(3));
            if !matches!(event, BusEvent::Counters { .. } | BusEvent::Sent { .. }) {
                return event;
            }
        }
    }

    async fn next_link(&mut self) -> Link {
        let event = self.next().await;
        let BusEvent::Link { link, .. } = event else { panic!("no link: {event:?}") };
        link
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
async fn of_each_frame_one_thing_is_told_in_order_that_it_was_sent_or_was_not() {
    let (mut stage, bus) = fake_bus();
    let mut harness = run_on(vec![Ok(bus)]);
    stage.script.send(Ok(link(Link::ErrorActive))).await.unwrap();
    harness.next_link().await;
    for number in 0..6_u8 {
        *stage.busy.lock().unwrap() = number % 3 == 2;
        harness.transmit.send(frame(&format!("105#{number:02X}"))).await.unwrap();
        let mut told = harness.events.recv().await.unwrap().1;
        while matches!(told, BusEvent::Counters { .. }) {
            told = harness.events.recv().await.unwrap().1;
        }
        let expected = frame(&format!("105#{number:02X}"));
        if number % 3 == 2 {
            assert!(matches!(told, BusEvent::NotSent { frame, .. } if frame == expected), "{told:?}");
        } else {
            assert!(matches!(told, BusEvent::Sent { frame, .. } if frame == expected), "{told:?}");
            assert_eq!(stage.sent.try_recv(), Ok(expected));
        }
    }
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
        Tally { error_frames: 5, fd_frames: 2, overruns: 7, bit_rate: Some(125_000), ..Tally::default() };
    first.script.send(Ok(link(Link::ErrorActive))).await.unwrap();
    first.script.send(Ok(received("181#01"))).await.unwrap();
    first.script.send(Err(absent())).await.unwrap();
    *second.tally.lock().unwrap() = Tally { error_frames: 1, fd_frames: 1, overruns: 1, ..Tally::default() };
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
async fn a_frame_that_the_interface_took_and_gave_back_counts_as_not_sent_and_no_counter_goes_back() {
    let (mut stage, bus) = fake_bus();
    let mut harness = run_on(vec![Ok(bus)]);
    stage.script.send(Ok(link(Link::ErrorActive))).await.unwrap();
    harness.next_link().await;
    let refused = frame("701#R1");
    harness.transmit.send(refused).await.unwrap();
    stage.sent.recv().await.unwrap();
    assert_eq!(harness.counters().await.frames_sent, 1);
    let back = BusEvent::NotSent { frame: refused, at: harness.clock.now() };
    stage.script.send(Ok(back.clone())).await.unwrap();
    assert_eq!(harness.next().await, back);
    let counters = harness.counters().await;
    assert_eq!((counters.frames_sent, counters.frames_not_sent), (1, 1));
    for _ in 0..2 {
        harness.transmit.send(frame("701#R1")).await.unwrap();
        stage.sent.recv().await.unwrap();
    }
    let counters = harness.counters().await;
    let bits = u64::from(refused.wire_bits());
    assert_eq!((counters.frames_sent, counters.frames_not_sent, counters.wire_bits), (2, 1, 2 * bits));
}

/// When a bus is opened that each time works for so long, in milliseconds since the start.
async fn openings_of_a_bus_that_works_for(each: Duration) -> Vec<u64> {
    let clock = Clock::start();
    let opened = Arc::new(Mutex::new(Vec::new()));
    let times = Arc::clone(&opened);
    let open = move || {
        times.lock().unwrap().push(clock.now().instant.as_millis());
        let (stage, bus) = fake_bus();
        tokio::spawn(async move {
            stage.script.send(Ok(BusEvent::Link { link: Link::ErrorActive, at: clock.now() })).await.unwrap();
            tokio::time::sleep(each).await;
            let _ = stage.script.send(Err(absent())).await;
        });
        Ok(bus)
    };
    let (events, mut told) = mpsc::channel(1_024);
    let (_transmit, to_send) = mpsc::channel(64);
    let stop = CancellationToken::new();
    let ends = Ends {
        bus: BusIndex(0),
        name: "fake".into(),
        sending: Sending::Told,
        events,
        transmit: to_send,
        clock,
        stop,
    };
    let _task = tokio_util::task::AbortOnDropHandle::new(tokio::spawn(run_with(open, LONGEST, ends)));
    while opened.lock().unwrap().len() < 6 {
        told.recv().await.unwrap();
    }
    opened.lock().unwrap().clone()
}

#[tokio::test(start_paused = true)]
async fn a_bus_that_works_only_for_moments_is_opened_ever_more_seldom() {
    let opened = openings_of_a_bus_that_works_for(Duration::from_millis(10)).await;
    assert_eq!(opened, [0, 110, 320, 730, 1_240, 1_750]);
}

#[tokio::test(start_paused = true)]
async fn a_bus_that_has_worked_for_ten_seconds_is_opened_again_at_once() {
    let opened = openings_of_a_bus_that_works_for(STEADY).await;
    assert_eq!(opened, [0, 10_100, 20_200, 30_300, 40_400, 50_500]);
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
    let ends = Ends {
        bus: BusIndex(0),
        name,
        sending: Sending::Told,
        events,
        transmit: to_send,
        clock: Clock::start(),
        stop,
    };
    let _task = tokio::spawn(run_with(open, LONGEST, ends));
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
    let ends =
        Ends { bus: BusIndex(0), name, sending: Sending::Told, events, transmit: to_send, clock, stop };
    let _task = tokio::spawn(run_with(move || Ok(ours.join(clock)), LONGEST, ends));
    let (mut reader, mut writer) = bus.join(clock);
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
