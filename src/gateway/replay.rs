//! A recording through the same core as the running gateway, as text: the same lines for the same frames, always.
//!
//! The gateway listens only, whatever its role: what it would have sent is in the recording already, or was never
//! sent. Time is that of the recording; it ends with its last frame.

use std::collections::VecDeque;
use std::sync::Arc;

use super::{Gateway, Input};
use crate::can::{BusEvent, BusIndex, CanFrame, Link};
use crate::canopen::Role;
use crate::mapping::TagTable;
use crate::process_image::{Event, NodeIndex, ProcessImage, Sample, TagIndex, Value};
use crate::time::{Instant, Now, Timestamp};

/// Replays frames of one bus.
///
/// Each line is a moment in seconds of the recording's monotonic time, then one of
///
/// ```text
/// 0.500000 engine1.trip = true good
/// 0.500000 engine1 online
/// 0.500000 event 4 alarm engine1 trip: normal -> unacknowledged (critical)
/// ```
#[must_use]
pub fn run<I>(table: &TagTable, bus: BusIndex, frames: I) -> Replay<I::IntoIter>
where
    I: IntoIterator<Item = (Now, CanFrame)>,
{
    let mut table = table.clone();
    for bus in &mut table.buses {
        bus.role = Role::Passive;
    }
    Replay { table: Arc::new(table), bus, frames: frames.into_iter(), core: None, lines: VecDeque::new() }
}

/// The lines of a replay.
#[derive(Debug)]
pub struct Replay<I> {
    table: Arc<TagTable>,
    bus: BusIndex,
    frames: I,
    core: Option<Core>,
    /// Lines of the last moment that are not yet taken.
    lines: VecDeque<String>,
}

#[derive(Debug)]
struct Core {
    gateway: Gateway,
    image: ProcessImage,
    online: Vec<bool>,
    seq: u64,
    start: Now,
}

impl<I: Iterator<Item = (Now, CanFrame)>> Iterator for Replay<I> {
    type Item = String;

    fn next(&mut self) -> Option<String> {
        while self.lines.is_empty() {
            let (at, frame) = self.frames.next()?;
            self.frame(at, frame);
        }
        self.lines.pop_front()
    }
}

impl<I> Replay<I> {
    fn frame(&mut self, at: Now, frame: CanFrame) {
        let Self { table, bus, core, lines, .. } = self;
        let core = core.get_or_insert_with(|| Core::new(table, *bus, at));
        while let Some((due, _)) = core.gateway.poll_timeout()
            && due <= at.instant
        {
            let now = core.at(due);
            core.gateway.handle_timeout(now);
            core.publish(table, now, lines);
        }
        let event = BusEvent::Frame { frame, at };
        core.gateway.handle_input(at, Input::Bus { bus: *bus, event });
        core.publish(table, at, lines);
    }
}

impl Core {
    fn new(table: &Arc<TagTable>, bus: BusIndex, start: Now) -> Self {
        let mut gateway = Gateway::new(Arc::clone(table), start);
        // A bus from which frames were recorded was up; of others nothing is known.
        let link = BusEvent::Link { link: Link::ErrorActive, at: start };
        gateway.handle_input(start, Input::Bus { bus, event: link });
        let mut core = Self {
            image: gateway.empty_image(),
            gateway,
            online: vec![false; table.nodes.len()],
            seq: 0,
            start,
        };
        core.publish(table, start, &mut VecDeque::new());
        core
    }

    /// A moment between frames on both clocks.
    fn at(&self, instant: Instant) -> Now {
        let micros = i64::try_from(instant.since(self.start.instant).as_micros()).unwrap_or(i64::MAX);
        Now { instant, utc: Timestamp::from_micros(self.start.utc.as_micros().saturating_add(micros)) }
    }

    fn publish(&mut self, table: &TagTable, now: Now, lines: &mut VecDeque<String>) {
        while self.gateway.poll_output().is_some() {}
        let before = self.image.revision;
        self.gateway.publish(&mut self.image);
        if self.image.revision == before {
            return;
        }
        let micros = now.instant.as_micros();
        let time = format!("{}.{:06}", micros / 1_000_000, micros % 1_000_000);
        for (place, sample) in self.image.tags.iter().enumerate() {
            if sample.revision == self.image.revision {
                let told = self.image.units.get(&TagIndex(place));
                lines.push_back(tag_line(table, &time, TagIndex(place), told, sample));
            }
        }
        for (place, (node, online)) in self.image.nodes.iter().zip(&mut self.online).enumerate() {
            if node.online != *online {
                *online = node.online;
                let name = table.node(NodeIndex(place)).map_or("", |node| node.name.as_str());
                lines.push_back(match (node.online, node.reason.as_str()) {
                    (true, "") => format!("{time} {name} online"),
                    (true, reason) => format!("{time} {name} online: {reason}"),
                    (false, reason) => format!("{time} {name} offline: {reason}"),
                });
            }
        }
        let (events, _) = self.image.journal.after(self.seq);
        self.seq = self.image.journal.newest();
        lines.extend(events.iter().map(|event| event_line(&time, event)));
    }
}

fn tag_line(table: &TagTable, time: &str, tag: TagIndex, told: Option<&String>, sample: &Sample) -> String {
    let Some(def) = table.tag(tag) else { return String::new() };
    let node = table.node(def.node).map_or("", |node| node.name.as_str());
    let value = match sample.value {
        Value::Float(number) => format!("{number:.*}", usize::from(def.decimals)),
        value @ (Value::Bool(_) | Value::Unsigned(_) | Value::Signed(_)) => value.to_string(),
    };
    let unit = told.unwrap_or(&def.unit);
    let unit = if unit.is_empty() { String::new() } else { format!(" {unit}") };
    format!("{time} {node}.{} = {value}{unit} {}", def.name, sample.quality)
}

fn event_line(time: &str, event: &Event) -> String {
    let who = event.node.as_deref().or(event.bus.as_deref()).map(|who| format!(" {who}")).unwrap_or_default();
    let change = if event.from.is_empty() && event.to.is_empty() {
        String::new()
    } else {
        format!(": {} -> {}", event.from, event.to)
    };
    let priority = event.priority.map(|priority| format!(" ({})", priority.word())).unwrap_or_default();
    let text = if event.text.is_empty() { String::new() } else { format!("; {}", event.text) };
    format!("{time} event {} {}{who} {}{change}{priority}{text}", event.seq, event.kind.word(), event.name)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gateway::fixture;

    fn recording() -> Vec<(Now, CanFrame)> {
        let frames = [
            (0, "701#R1"),
            (1, "701#7F"),
            (2, "000#0101"),
            (40, "181#3300"),
            (140, "181#3301"),
            (5_000, "181#3301"),
        ];
        frames.map(|(millis, frame)| (Now::from_millis(millis), frame.parse().unwrap())).to_vec()
    }

    #[test]
    fn a_recording_gives_the_same_lines_every_time() {
        let table = fixture::table();
        let lines: Vec<String> = run(&table, BusIndex(0), recording()).collect();
        assert_eq!(lines, run(&table, BusIndex(0), recording()).collect::<Vec<_>>());
        let has =
            |line: &str| assert!(lines.iter().any(|known| known == line), "{line} is not in {lines:#?}");
        has("0.040000 engine1.level = 20.00 good");
        has("0.140000 engine1.trip = true good");
        has("0.001000 engine1 online: not operational: pre_operational");
        assert!(lines.iter().any(|line| line.contains("1.") && line.contains("pdo_timeout")), "{lines:#?}");
    }

    #[test]
    fn an_empty_recording_gives_no_line() {
        assert_eq!(run(&fixture::table(), BusIndex(0), []).count(), 0);
    }
}
