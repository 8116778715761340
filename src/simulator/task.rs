//! Puts simulated devices on a bus. \[IO\]

use std::collections::VecDeque;

use tokio::sync::mpsc;
use tokio::sync::mpsc::error::TrySendError;
use tokio::time::sleep_until;
use tokio_util::sync::CancellationToken;

use super::device::{Device, DevicePlan, Status};
use super::kind::Kind;
use super::order::{self, Order};
use crate::can::outage::Repeats;
use crate::can::{BusEvent, BusIndex, CanFrame};
use crate::time::{Clock, Instant, Now};

/// The bus that the devices are on: the other ends of the queues of `can::task::run`.
#[derive(Debug)]
pub struct BusEnd {
    /// What happens on the bus. The bus of an event is not looked at: all devices are on one.
    pub events: mpsc::Receiver<(BusIndex, BusEvent)>,
    /// Frames to send. When it is full a frame is lost, as on a bus that is overloaded.
    pub transmit: mpsc::Sender<CanFrame>,
}

/// Orders that wait for the bus to come up. One more is refused.
const LINES_IN_ADVANCE: usize = 64;

/// Runs devices until `stop`, or until the bus task has ended. They are powered on when the bus is up for the first time.
///
/// `lines` takes control lines ([`Order`], or `help`); its end does not end the simulation. Orders that come before the
/// bus is up are carried out when it is. `report` gets one text for each change of a device's [`Status`], each order and
/// each change of the bus; when it is full, texts are left out and counted, when it is closed the simulation goes on.
pub async fn run(
    plans: Vec<DevicePlan>,
    mut bus: BusEnd,
    mut lines: mpsc::Receiver<String>,
    report: mpsc::Sender<String>,
    clock: Clock,
    stop: CancellationToken,
) {
    let mut bench = Bench::new(plans, bus.transmit, report);
    let mut lines_open = true;
    loop {
        let now = clock.now();
        bench.settle(now);
        let due = bench.next_due().unwrap_or(now.instant + std::time::Duration::from_secs(3600));
        tokio::select! {
            () = stop.cancelled() => return,
            event = bus.events.recv() => match event {
                Some((_, event)) => bench.handle_event(clock.now(), &event),
                None => return,
            },
            line = lines.recv(), if lines_open => match line {
                Some(line) => bench.handle_line(clock.now(), line.trim()),
                None => lines_open = false,
            },
            () = sleep_until(clock.deadline(due)) => {
                let now = clock.now();
                bench.each(|device| device.handle_timeout(now));
            }
        }
    }
}

/// Texts for whoever watches. One that finds the queue full is left out: a reader who is slow, or a terminal that is
/// paused, must not hold up the devices.
struct Report {
    queue: mpsc::Sender<String>,
    left_out: u64,
}

impl Report {
    fn say(&mut self, text: String) {
        if self.left_out > 0 {
            let gap = format!("({} lines were left out here: nobody read them in time)", self.left_out);
            if self.queue.try_send(gap).is_ok() {
                self.left_out = 0;
            }
        }
        if matches!(self.queue.try_send(text), Err(TrySendError::Full(_))) {
            self.left_out += 1;
        }
    }
}

struct Bench {
    /// Devices that wait for the bus.
    plans: Vec<DevicePlan>,
    /// Orders that wait for the devices.
    waiting: VecDeque<String>,
    /// What can be ordered of all of them.
    help: String,
    /// Each with the status that was reported last.
    devices: Vec<(Box<dyn Device>, Option<Status>)>,
    transmit: mpsc::Sender<CanFrame>,
    overloads: Repeats,
    failures: Repeats,
    bus_up: Option<bool>,
    report: Report,
}

impl Bench {
    fn new(plans: Vec<DevicePlan>, transmit: mpsc::Sender<CanFrame>, report: mpsc::Sender<String>) -> Self {
        let mut kinds: Vec<_> = plans.iter().map(|plan| plan.scenario.settings.kind()).collect();
        kinds.sort();
        kinds.dedup();
        let mut bench = Self {
            plans,
            help: kinds.into_iter().map(Kind::help).collect::<Vec<_>>().join("\n\n"),
            waiting: VecDeque::new(),
            devices: Vec::new(),
            transmit,
            overloads: Repeats::default(),
            failures: Repeats::default(),
            bus_up: None,
            report: Report { queue: report, left_out: 0 },
        };
        let mut stories: Vec<String> =
            bench.plans.iter().map(|plan| plan.scenario.description.clone()).collect();
        stories.dedup();
        for story in stories {
            bench.report.say(format!("scenario: {story}"));
        }
        bench
    }

    fn each(&mut self, mut act: impl FnMut(&mut dyn Device)) {
        for (device, _) in &mut self.devices {
            act(device.as_mut());
        }
    }

    fn next_due(&self) -> Option<Instant> {
        self.devices.iter().filter_map(|(device, _)| device.poll_timeout()).min()
    }

    fn handle_event(&mut self, now: Now, event: &BusEvent) {
        match event {
            BusEvent::Frame { frame, .. } => self.each(|device| {
                if device.hears(frame.id()) {
                    device.handle_frame(now, frame);
                }
            }),
            BusEvent::Link { link, .. } => {
                if self.bus_up.replace(link.is_up()) != Some(link.is_up()) {
                    self.say(now, if link.is_up() { "bus: up" } else { "bus: down" });
                }
                if link.is_up() {
                    self.power_on(now);
                }
            }
            BusEvent::NotSent { .. } => {
                if let Some(unsaid) = self.failures.admit(now.instant) {
                    let text = "bus: a frame could not be sent: the bus is down, or nobody acknowledges";
                    self.say(now, &counted(text, unsaid));
                }
            }
            BusEvent::Counters { .. } => {}
        }
    }

    /// The bus is up: powers on what has waited for it, and carries out what was ordered meanwhile.
    fn power_on(&mut self, now: Now) {
        for plan in std::mem::take(&mut self.plans) {
            self.devices.push((plan.power_on(now), None));
        }
        for line in std::mem::take(&mut self.waiting) {
            self.carry_out(now, &line);
        }
    }

    fn handle_line(&mut self, now: Now, line: &str) {
        match line {
            "" => {}
            "help" => self.report.say(self.help.clone()),
            _ if self.plans.is_empty() => self.carry_out(now, line),
            _ if self.waiting.len() < LINES_IN_ADVANCE => self.waiting.push_back(line.to_owned()),
            _ => self.report.say(format!(
                "error: `{line}`: {LINES_IN_ADVANCE} orders already wait for the bus to come up"
            )),
        }
    }

    fn carry_out(&mut self, now: Now, line: &str) {
        match line.parse::<Order>() {
            Ok(order) => self.obey(now, line, &order),
            Err(error) => self.report.say(format!("error: {error}")),
        }
    }

    fn obey(&mut self, now: Now, line: &str, order: &Order) {
        let words = order.words();
        let (mut obeyed, mut refusal) = (false, None);
        self.each(|device| {
            if order.node.is_none_or(|node| node == device.node()) {
                match device.handle_line(now, &words) {
                    Ok(()) => obeyed = true,
                    Err(reason) => refusal = Some(reason),
                }
            }
        });
        match refusal {
            Some(reason) => self.report.say(format!("error: {}", order::refused(line, reason))),
            None if obeyed => self.say(now, &format!("ok: {line}")),
            None => self.report.say(format!("error: `{line}`: no such node is simulated here")),
        }
    }

    /// Sends what is to be sent and reports what has changed.
    fn settle(&mut self, now: Now) {
        while let Some(frame) = self.devices.iter_mut().find_map(|(device, _)| device.poll_output()) {
            match self.transmit.try_send(frame) {
                // That the bus task has ended is told by its events.
                Ok(()) | Err(TrySendError::Closed(_)) => {}
                Err(TrySendError::Full(_)) => {
                    if let Some(unsaid) = self.overloads.admit(now.instant) {
                        self.say(now, &counted("bus: overloaded, a frame is lost", unsaid));
                    }
                }
            }
        }
        let mut changes = Vec::new();
        for (device, reported) in &mut self.devices {
            let status = device.status();
            if reported.as_ref() != Some(&status) {
                changes.push(format!("node {}: {status}", device.node()));
                *reported = Some(status);
            }
        }
        for change in changes {
            self.say(now, &change);
        }
    }

    fn say(&mut self, now: Now, text: &str) {
        let (seconds, millis) = (now.instant.as_millis() / 1000, now.instant.as_millis() % 1000);
        self.report.say(format!("{seconds}.{millis:03} {text}"));
    }
}

/// A message, and how many of its kind were not told since the last.
fn counted(text: &str, unsaid: u64) -> String {
    if unsaid == 0 { text.to_owned() } else { format!("{text} ({unsaid} more since this was last said)") }
}

#[cfg(test)]
mod tests {
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
        assert!(
            report.contains("overloaded, a frame is lost (11 more since this was last said)"),
            "{report}"
        );
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
}
