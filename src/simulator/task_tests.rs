//! Tests of the task of simulated devices, with the test in the place of the bus and of the person at the console.

use std::time::Duration;

use super::super::scenario::Scenario;
use super::*;
use crate::can::Link;
use crate::canopen::NodeId;

/// Devices 1 to `count` on a bus of which the test holds the other end.
struct Rig {
    events: mpsc::Sender<(BusIndex, BusEvent)>,
    sent: mpsc::Receiver<CanFrame>,
    lines: mpsc::Sender<String>,
    paper: mpsc::Receiver<String>,
    clock: Clock,
    stop: CancellationToken,
    task: tokio::task::JoinHandle<()>,
}

impl Rig {
    /// On a bus that is up.
    async fn start(count: u8, queue: usize) -> Self {
        let rig = Self::waiting(count, queue);
        rig.link(Link::ErrorActive).await;
        rig
    }

    async fn link(&self, link: Link) {
        let event = BusEvent::Link { link, at: self.clock.now() };
        self.events.send((BusIndex(0), event)).await.unwrap();
    }

    fn waiting(count: u8, queue: usize) -> Self {
        Self::with_reports(count, queue, 1000)
    }

    /// With a reader that lets so many reports wait.
    fn with_reports(count: u8, queue: usize, reports: usize) -> Self {
        let (report, paper) = mpsc::channel(reports);
        let (events, events_end) = mpsc::channel(16);
        let (transmit, sent) = mpsc::channel(queue);
        let (lines, lines_end) = mpsc::channel(16);
        let (clock, stop) = (Clock::start(), CancellationToken::new());
        let plan = |node| {
            let scenario = Scenario::shipped(Kind::Detcon, "quiet").unwrap();
            DevicePlan::new(NodeId::new(node).unwrap(), scenario)
        };
        let plans = (1..=count).map(plan).collect();
        let end = BusEnd { events: events_end, transmit };
        let task = tokio::spawn(run(plans, end, lines_end, report, clock, stop.clone()));
        Self { events, sent, lines, paper, clock, stop, task }
    }

    async fn frame(&self, frame: &str) {
        let event = BusEvent::Frame { frame: frame.parse().unwrap(), at: self.clock.now() };
        self.events.send((BusIndex(0), event)).await.unwrap();
    }

    async fn line(&self, line: &str) {
        self.lines.send(line.to_owned()).await.unwrap();
    }

    fn frames(&mut self) -> Vec<String> {
        std::iter::from_fn(|| self.sent.try_recv().ok()).map(|frame| frame.to_string()).collect()
    }

    fn report(&mut self) -> String {
        std::iter::from_fn(|| self.paper.try_recv().ok()).map(|text| text + "\n").collect()
    }

    async fn not_sent(&self) {
        let event = BusEvent::NotSent { frame: "701#00".parse().unwrap(), at: self.clock.now() };
        self.events.send((BusIndex(0), event)).await.unwrap();
    }
}

async fn pass(millis: u64) {
    tokio::time::sleep(Duration::from_millis(millis)).await;
}

#[tokio::test(start_paused = true)]
async fn devices_boot_start_and_report() {
    let mut rig = Rig::start(2, 64).await;
    pass(200).await;
    rig.frame("000#0102").await;
    pass(60).await;
    assert_eq!(rig.frames()[..2], ["701#00", "702#00"]);
    let report = rig.report();
    for line in
        ["0.000 node 1: initialising\n", "0.080 node 2: pre_operational\n", "0.200 node 2: operational\n"]
    {
        assert!(report.contains(line), "{report}");
    }
    assert!(!report.contains("node 1: operational"));
    rig.stop.cancel();
    rig.task.await.unwrap();
}

#[tokio::test(start_paused = true)]
async fn control_lines_switch_one_or_all_devices_and_are_answered() {
    let mut rig = Rig::start(2, 64).await;
    rig.frame("000#0100").await;
    for line in ["node 2 power off", "knock 7 on", "node 9 trip", "nonsense", "", "help"] {
        rig.line(line).await;
    }
    pass(50).await;
    let report = rig.report();
    for line in [
        "0.000 ok: node 2 power off\n",
        "node 2: off, knocking\n",
        "node 1: initialising, knocking\n",
        "error: `node 9 trip`: no such node",
        "error: `nonsense` is not done: type `help`",
        "mute guarding on|off",
    ] {
        assert!(report.contains(line), "{line}\n---\n{report}");
    }
    rig.frames();
    rig.frame("701#R1").await;
    rig.frame("702#R1").await;
    pass(100).await;
    let frames = rig.frames();
    assert!(frames.iter().all(|frame| frame.starts_with("701#")) && !frames.is_empty(), "{frames:?}");
}

#[tokio::test(start_paused = true)]
async fn the_simulation_outlives_its_control_lines_and_ends_with_the_bus() {
    let mut rig = Rig::start(1, 64).await;
    let (lines, _) = mpsc::channel(1);
    rig.lines = lines;
    pass(100).await;
    rig.frame("000#0101").await;
    pass(100).await;
    assert!(rig.frames().iter().any(|frame| frame.starts_with("181#")));
    let (events, _) = mpsc::channel(1);
    rig.events = events;
    rig.task.await.unwrap();
}

#[tokio::test(start_paused = true)]
async fn a_full_queue_loses_frames_and_says_so_once() {
    let mut rig = Rig::start(4, 2).await;
    pass(1).await;
    assert_eq!(rig.frames(), ["701#00", "702#00"]);
    assert_eq!(rig.report().matches("overloaded").count(), 1);
}

#[tokio::test(start_paused = true)]
async fn the_state_of_the_bus_is_reported_when_it_changes() {
    let mut rig = Rig::start(1, 64).await;
    for link in [Link::ErrorPassive, Link::Down, Link::Absent] {
        rig.link(link).await;
    }
    pass(1).await;
    let report = rig.report();
    assert_eq!((report.matches("bus: up").count(), report.matches("bus: down").count()), (1, 1));
}

#[tokio::test(start_paused = true)]
async fn devices_are_powered_on_when_the_bus_is_up_and_not_again() {
    let mut rig = Rig::waiting(1, 64);
    rig.link(Link::Absent).await;
    rig.line("knock 7 on").await;
    pass(5000).await;
    assert!(rig.frames().is_empty());
    rig.link(Link::ErrorActive).await;
    pass(10).await;
    assert_eq!(rig.frames(), ["701#00"]);
    assert!(rig.report().contains("5.000 ok: knock 7 on"));
    rig.link(Link::Down).await;
    rig.link(Link::ErrorActive).await;
    pass(10).await;
    assert!(rig.frames().is_empty());
}

#[tokio::test(start_paused = true)]
async fn a_queue_that_is_full_again_and_again_is_told_once_in_a_while_and_counted() {
    let mut rig = Rig::start(4, 2).await;
    pass(1).await;
    rig.report();
    for _ in 0..5 {
        rig.frames();
        rig.line("power off").await;
        rig.line("power on").await;
        pass(100).await;
    }
    assert_eq!(rig.report().matches("overloaded").count(), 0, "it was said a moment ago");
    pass(10_000).await;
    rig.line("power off").await;
    rig.line("power on").await;
    pass(100).await;
    let report = rig.report();
    assert!(report.contains("overloaded, a frame is lost (11 more since this was last said)"), "{report}");
}

#[tokio::test(start_paused = true)]
async fn frames_that_could_not_be_sent_are_told_and_counted() {
    let mut rig = Rig::start(1, 64).await;
    for _ in 0..3 {
        rig.not_sent().await;
    }
    pass(10_000).await;
    rig.not_sent().await;
    pass(1).await;
    let report = rig.report();
    assert_eq!(report.matches("could not be sent").count(), 2, "{report}");
    assert!(report.contains("nobody acknowledges (2 more since this was last said)"), "{report}");
}

#[tokio::test(start_paused = true)]
async fn a_bus_task_that_has_ended_is_not_an_overload() {
    let mut rig = Rig::start(1, 64).await;
    let (_, closed) = mpsc::channel(1);
    drop(std::mem::replace(&mut rig.sent, closed));
    pass(1000).await;
    assert!(!rig.report().contains("overloaded"));
}

#[tokio::test(start_paused = true)]
async fn a_report_that_nobody_reads_does_not_stop_the_devices_and_its_gap_is_told() {
    let mut rig = Rig::with_reports(1, 64, 4);
    rig.link(Link::ErrorActive).await;
    for _ in 0..10 {
        rig.line("knock 7 on").await;
        pass(10).await;
    }
    pass(200).await;
    rig.frame("000#0101").await;
    pass(1000).await;
    assert!(rig.frames().iter().any(|frame| frame.starts_with("181#")));
    rig.report();
    rig.line("knock 7 off").await;
    pass(10).await;
    let report = rig.report();
    assert!(report.starts_with('(') && report.contains("lines were left out here"), "{report}");
}

#[tokio::test(start_paused = true)]
async fn help_is_given_before_the_bus_is_up_and_so_is_the_scenario() {
    let mut rig = Rig::waiting(2, 64);
    rig.link(Link::Absent).await;
    rig.line("help").await;
    pass(10).await;
    let report = rig.report();
    assert!(report.contains("mute guarding on|off"), "{report}");
    assert_eq!(report.matches("scenario: ").count(), 1, "{report}");
}

#[tokio::test(start_paused = true)]
async fn frames_that_are_read_late_are_heard_when_they_came() {
    let (report, mut paper) = mpsc::channel(1000);
    let (events, events_end) = mpsc::channel(100);
    let (transmit, _sent) = mpsc::channel(100);
    let (_lines, lines_end) = mpsc::channel(1);
    let text = "description = \"\"\n[device]\nfirst_tx_delay_ms = 0\n";
    let scenario = Scenario::parse(Kind::CbmSio4, "s.toml", text).unwrap();
    let plan = DevicePlan::new(NodeId::new(0x1A).unwrap(), scenario);
    let (clock, stop) = (Clock::start(), CancellationToken::new());
    let end = BusEnd { events: events_end, transmit };
    tokio::spawn(run(vec![plan], end, lines_end, report, clock, stop.clone()));
    let up = BusEvent::Link { link: Link::ErrorActive, at: clock.now() };
    events.send((BusIndex(0), up)).await.unwrap();
    pass(1).await;
    tokio::time::advance(Duration::from_secs(2)).await;
    for count in 1..=60 {
        let frame = "109#4142434445464748".parse().unwrap();
        events.try_send((BusIndex(0), BusEvent::Frame { frame, at: Now::from_millis(20 * count) })).unwrap();
    }
    pass(1000).await;
    let told: Vec<_> = std::iter::from_fn(|| paper.try_recv().ok()).collect();
    assert!(told.iter().any(|text| text.contains("operational")), "{told:?}");
    assert!(!told.iter().any(|text| text.contains("overflow")), "{told:?}");
    stop.cancel();
}

#[tokio::test(start_paused = true)]
async fn orders_without_a_bus_are_bounded() {
    let mut rig = Rig::waiting(1, 64);
    for _ in 0..=LINES_IN_ADVANCE {
        rig.line("power on").await;
    }
    pass(10).await;
    assert_eq!(rig.report().matches("already wait for the bus").count(), 1);
    rig.link(Link::ErrorActive).await;
    pass(10).await;
    assert_eq!(rig.report().matches("ok: power on").count(), LINES_IN_ADVANCE);
}
