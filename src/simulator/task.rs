//! Puts simulated devices on a bus. \[IO\]

use std::io::Write;

use tokio::sync::mpsc;
use tokio::time::sleep_until;
use tokio_util::sync::CancellationToken;

use super::control::{HELP, Order};
use super::device::{DevicePlan, SimulatedDevice, Status};
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

/// Runs devices until `stop`, or until the bus task has ended. They are powered on when the bus is up for the first time.
///
/// `lines` takes control lines ([`Order`], or `help`); its end does not end the simulation. `report` gets one line for
/// each change of a device's [`Status`], each order and each change of the bus; when it cannot be written to, the
/// simulation goes on without it.
pub async fn run(
    plans: Vec<DevicePlan>,
    mut bus: BusEnd,
    mut lines: mpsc::Receiver<String>,
    report: impl Write + Send,
    clock: Clock,
    stop: CancellationToken,
) {
    let mut bench =
        Bench { plans, devices: Vec::new(), transmit: bus.transmit, queue_full: false, bus_up: None, report };
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
            line = lines.recv(), if lines_open && bench.plans.is_empty() => match line {
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

struct Bench<W> {
    /// Devices that wait for the bus.
    plans: Vec<DevicePlan>,
    /// Each with the status that was reported last.
    devices: Vec<(SimulatedDevice, Option<Status>)>,
    transmit: mpsc::Sender<CanFrame>,
    queue_full: bool,
    bus_up: Option<bool>,
    report: W,
}

impl<W: Write> Bench<W> {
    fn each(&mut self, mut act: impl FnMut(&mut SimulatedDevice)) {
        for (device, _) in &mut self.devices {
            act(device);
        }
    }

    fn next_due(&self) -> Option<Instant> {
        self.devices.iter().filter_map(|(device, _)| device.poll_timeout()).min()
    }

    fn handle_event(&mut self, now: Now, event: &BusEvent) {
        match event {
            BusEvent::Frame { frame, .. } => self.each(|device| device.handle_frame(now, frame)),
            BusEvent::Link { link, .. } => {
                if self.bus_up.replace(link.is_up()) != Some(link.is_up()) {
                    self.say(now, if link.is_up() { "bus: up" } else { "bus: down" });
                }
                if link.is_up() {
                    let plans = std::mem::take(&mut self.plans);
                    let devices = plans.iter().map(|plan| (SimulatedDevice::power_on(plan, now), None));
                    self.devices.extend(devices);
                }
            }
            BusEvent::NotSent { .. } | BusEvent::Counters { .. } => {}
        }
    }

    fn handle_line(&mut self, now: Now, line: &str) {
        match line {
            "" => {}
            "help" => self.say_plain(HELP),
            _ => match line.parse::<Order>() {
                Ok(order) => self.obey(now, line, &order),
                Err(error) => self.say_plain(&format!("error: {error}")),
            },
        }
    }

    fn obey(&mut self, now: Now, line: &str, order: &Order) {
        let mut found = false;
        self.each(|device| {
            if order.node.is_none_or(|node| node == device.node()) {
                found = true;
                device.handle_control(now, order.control);
            }
        });
        if found {
            self.say(now, &format!("ok: {line}"));
        } else {
            self.say_plain(&format!("error: `{line}`: no such node is simulated here"));
        }
    }

    /// Sends what is to be sent and reports what has changed.
    fn settle(&mut self, now: Now) {
        while let Some(frame) = self.devices.iter_mut().find_map(|(device, _)| device.poll_output()) {
            let full = self.transmit.try_send(frame).is_err();
            if full && !self.queue_full {
                self.say(now, "bus: overloaded, frames are lost");
            }
            self.queue_full = full;
        }
        let mut changes = Vec::new();
        for (device, reported) in &mut self.devices {
            let status = device.status();
            if reported.replace(status) != Some(status) {
                changes.push(format!("node {}: {status}", device.node()));
            }
        }
        for change in changes {
            self.say(now, &change);
        }
    }

    fn say(&mut self, now: Now, text: &str) {
        let (seconds, millis) = (now.instant.as_millis() / 1000, now.instant.as_millis() % 1000);
        self.say_plain(&format!("{seconds}.{millis:03} {text}"));
    }

    /// A report that nobody reads any more is no reason to stop.
    fn say_plain(&mut self, text: &str) {
        let _ = writeln!(self.report, "{text}").and_then(|()| self.report.flush());
    }
}

#[cfg(test)]
mod tests {
    use std::sync::{Arc, Mutex};
    use std::time::Duration;

    use super::super::scenario::Scenario;
    use super::*;
    use crate::can::Link;
    use crate::canopen::NodeId;

    #[derive(Clone, Default)]
    struct Paper(Arc<Mutex<Vec<u8>>>);

    impl Write for Paper {
        fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
            self.0.lock().unwrap().write(bytes)
        }

        fn flush(&mut self) -> std::io::Result<()> {
            Ok(())
        }
    }

    /// Devices 1 to `count` on a bus of which the test holds the other end.
    struct Rig {
        events: mpsc::Sender<(BusIndex, BusEvent)>,
        sent: mpsc::Receiver<CanFrame>,
        lines: mpsc::Sender<String>,
        paper: Paper,
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
            let (events, events_end) = mpsc::channel(16);
            let (transmit, sent) = mpsc::channel(queue);
            let (lines, lines_end) = mpsc::channel(16);
            let (clock, stop, paper) = (Clock::start(), CancellationToken::new(), Paper::default());
            let plan =
                |node| DevicePlan::new(NodeId::new(node).unwrap(), Scenario::shipped("quiet").unwrap());
            let plans = (1..=count).map(plan).collect();
            let end = BusEnd { events: events_end, transmit };
            let task = tokio::spawn(run(plans, end, lines_end, paper.clone(), clock, stop.clone()));
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

        fn report(&self) -> String {
            String::from_utf8(std::mem::take(&mut *self.paper.0.lock().unwrap())).unwrap()
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
            "error: `nonsense` is not understood: type `help`",
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
        let rig = Rig::start(1, 64).await;
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
}
