//! Puts simulated devices on a bus. \[IO\]

use std::collections::VecDeque;

use tokio::sync::mpsc;
use tokio::sync::mpsc::error::TrySendError;
use tokio::time::sleep_until;
use tokio_util::sync::CancellationToken;

use super::device::{Device, DevicePlan, Status};
use super::kind::Kind;
use super::order::{self, Order};
use super::serial_end::{Heard, SerialEnd, Wire};
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
/// Pieces from outside ends that wait; more than there are ends, each of which waits with one at most.
const SERIAL_QUEUE: usize = 64;

/// Runs devices until `stop`, or until the bus task has ended. They are powered on when the bus is up for the first time.
///
/// `lines` takes control lines ([`Order`], or `help`); its end does not end the simulation. Orders that come before the
/// bus is up are carried out when it is. `report` gets one text for each change of a device's [`Status`], each order and
/// each change of the bus; when it is full, texts are left out and counted, when it is closed the simulation goes on.
pub async fn run(
    plans: Vec<DevicePlan>,
    bus: BusEnd,
    lines: mpsc::Receiver<String>,
    report: mpsc::Sender<String>,
    clock: Clock,
    stop: CancellationToken,
) {
    run_with_ends(plans, Vec::new(), bus, lines, report, clock, stop).await;
}

/// As [`run`], with outside ends at serial channels of the first device.
pub async fn run_with_ends(
    plans: Vec<DevicePlan>,
    ends: Vec<SerialEnd>,
    mut bus: BusEnd,
    mut lines: mpsc::Receiver<String>,
    report: mpsc::Sender<String>,
    clock: Clock,
    stop: CancellationToken,
) {
    let mut bench = Bench::new(plans, bus.transmit, report);
    let mut lines_open = true;
    let (heard_to_us, mut heard) = mpsc::channel(SERIAL_QUEUE);
    for end in ends {
        bench.report.say(format!("channel {}: {}", end.channel(), end.describe()));
        bench.wires.push(Wire::start(end, heard_to_us.clone()));
    }
    loop {
        let now = clock.now();
        bench.settle(now);
        let due = bench.next_due().unwrap_or(now.instant + std::time::Duration::from_secs(3600));
        tokio::select! {
            // What was heard comes before what is due: it may be older, when this task was not given the processor in time.
            biased;
            () = stop.cancelled() => return,
            event = bus.events.recv() => match event {
                Some((_, event)) => bench.handle_event(clock.now(), &event),
                None => return,
            },
            line = lines.recv(), if lines_open => match line {
                Some(line) => bench.handle_line(clock.now(), line.trim()),
                None => lines_open = false,
            },
            Some((channel, heard)) = heard.recv() => bench.handle_serial(clock.now(), channel, heard),
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
    /// Outside ends at channels of the first device.
    wires: Vec<Wire>,
    unread: Repeats,
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
            wires: Vec::new(),
            unread: Repeats::default(),
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
            BusEvent::Frame { frame, at } => {
                // Devices hear it when it came, and not when this task got round to it: frames that came one after the other
                // are no flood.
                let then = if at.instant > now.instant { now } else { *at };
                self.each(|device| {
                    if device.hears(frame.id()) {
                        device.handle_frame(then, frame);
                    } else if device.poll_timeout().is_some_and(|due| due <= then.instant) {
                        device.handle_timeout(then);
                    }
                });
            }
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
            BusEvent::Sent { .. } | BusEvent::Counters { .. } => {}
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

    fn handle_serial(&mut self, now: Now, channel: u8, heard: Heard) {
        match heard {
            Heard::Said(text) => self.say(now, &text),
            Heard::Bytes(bytes) => {
                if let Some((device, _)) = self.devices.first_mut() {
                    device.handle_serial(now, channel, &bytes);
                }
                if let Some(wire) = self.wires.iter_mut().find(|wire| wire.channel == channel) {
                    wire.received(bytes.len());
                }
            }
        }
    }

    /// Gives outside ends what is theirs, and lets them send what the lines take.
    fn settle_ends(&mut self, now: Now) {
        let Some((device, _)) = self.devices.first_mut() else { return };
        let mut lost = None;
        while let Some((channel, bytes)) = device.poll_serial() {
            let wire = self.wires.iter_mut().find(|wire| wire.channel == channel);
            if wire.is_some_and(|wire| !wire.send(bytes)) {
                lost = Some(channel);
            }
        }
        for wire in &mut self.wires {
            wire.allow(device.serial_room(wire.channel));
        }
        if let Some((channel, unsaid)) =
            lost.and_then(|channel| Some((channel, self.unread.admit(now.instant)?)))
        {
            let text = format!("channel {channel}: bytes are lost, because the other end does not read them");
            self.say(now, &counted(&text, unsaid));
        }
    }

    /// Sends what is to be sent and reports what has changed.
    fn settle(&mut self, now: Now) {
        self.settle_ends(now);
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
                changes.push(format!("{}: {status}", device.name()));
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
#[path = "task_tests.rs"]
mod tests;
