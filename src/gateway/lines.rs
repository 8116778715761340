//! Serial lines of esd modules: what came in on them, for readers; what goes out, for askers.

mod carry;

use std::collections::BTreeMap;
use std::time::Duration;

use super::core::{Gateway, Output};
use super::operate::Finished;
use super::{CommandSource, Outcome};
use crate::canopen::Role;
use crate::esd::{MessageEnd, ModuleIndex, SendOutcome, SendRefused};
use crate::mapping::{LineValue, ModuleCarrier, TagTable};
use crate::process_image::{LineIndex, NodeIndex, ProcessImage, Quality};
use crate::time::{Instant, Now, Timestamp};

/// How often values that change by mere time are looked at.
const SECOND: Duration = Duration::from_secs(1);
/// What a time since something shows that never was, or is longer ago than can be shown.
const NEVER: u64 = 65_535;

/// What is counted of a line, since the gateway started.
const COUNTERS: [LineValue; 6] = [
    LineValue::BytesReceived,
    LineValue::FramesReceived,
    LineValue::BytesSent,
    LineValue::FramesSent,
    LineValue::BytesNotSent,
    LineValue::MessagesReceived,
];

/// All serial lines.
#[derive(Debug)]
pub(super) struct Lines {
    /// Of every module, also of those channels that nobody uses; those of one stand side by side.
    all: Vec<Line>,
    /// Where the lines of each node begin.
    first: Vec<usize>,
    sends: BTreeMap<u64, Asked>,
    newest_send: u64,
    /// When times are shown anew; `None` without lines.
    next_look: Option<Instant>,
}

/// One line.
#[derive(Debug)]
struct Line {
    /// As readers know it; `None`: it is only counted.
    index: Option<LineIndex>,
    node: NodeIndex,
    channel: usize,
    counters: Counters,
    received_at: Option<Instant>,
    /// When the frame with the newest byte was received.
    newest_byte: Option<Timestamp>,
    sent_at: Option<Instant>,
    /// Bytes that were asked for and not yet handed to the bus.
    waiting: u64,
    open: bool,
    breaks: u64,
    /// What readers have not been shown yet.
    changed: bool,
    bytes: Vec<u8>,
    messages: Vec<(Timestamp, Vec<u8>, MessageEnd)>,
}

/// What is counted of a line.
#[derive(Clone, Copy, Debug, Default)]
struct Counters {
    bytes_received: u64,
    frames_received: u64,
    messages_received: u64,
    bytes_sent: u64,
    frames_sent: u64,
    bytes_not_sent: u64,
}

impl Counters {
    /// `None` for what is no counter.
    fn of(&self, value: LineValue) -> Option<u64> {
        Some(match value {
            LineValue::BytesReceived => self.bytes_received,
            LineValue::FramesReceived => self.frames_received,
            LineValue::MessagesReceived => self.messages_received,
            LineValue::BytesSent => self.bytes_sent,
            LineValue::FramesSent => self.frames_sent,
            LineValue::BytesNotSent => self.bytes_not_sent,
            LineValue::BytesWaiting | LineValue::SecondsSinceReceived | LineValue::SecondsSinceSent => {
                return None;
            }
        })
    }
}

/// Who waits for bytes to be sent.
#[derive(Debug)]
struct Asked {
    id: u64,
    source: CommandSource,
    line: LineIndex,
    len: usize,
}

impl Lines {
    /// Lines on which nothing has happened yet.
    pub(super) fn new(table: &TagTable, now: Now) -> Self {
        let line = |node: NodeIndex, channel: usize| Line {
            index: table
                .lines
                .iter()
                .position(|def| (def.node, def.channel) == (node, channel))
                .map(LineIndex),
            node,
            channel,
            counters: Counters::default(),
            received_at: None,
            newest_byte: None,
            sent_at: None,
            waiting: 0,
            open: false,
            breaks: 0,
            changed: false,
            bytes: Vec::new(),
            messages: Vec::new(),
        };
        let (mut all, mut first) = (Vec::new(), Vec::with_capacity(table.nodes.len()));
        for (place, node) in table.nodes.iter().enumerate() {
            let channels = node.protocol.module().map_or(0, |module| module.channels.len());
            first.push(all.len());
            all.extend((0..channels).map(|channel| line(NodeIndex(place), channel)));
        }
        let next_look = (!all.is_empty()).then_some(now.instant + SECOND);
        Self { all, first, sends: BTreeMap::new(), newest_send: 0, next_look }
    }

    pub(super) fn poll_timeout(&self) -> Option<Instant> {
        self.next_look
    }

    /// Copies what happened since the last call into the image. `true` where a reader has something new to see.
    pub(super) fn publish(&mut self, image: &mut ProcessImage) -> bool {
        let mut moved = false;
        for line in self.all.iter_mut().filter(|line| line.changed) {
            line.changed = false;
            let Some(shown) = line.index.and_then(|index| image.lines.get_mut(index.0)) else {
                line.bytes.clear();
                line.messages.clear();
                continue;
            };
            moved = true;
            shown.open = line.open;
            shown.breaks = line.breaks;
            shown.append(&line.bytes);
            line.bytes.clear();
            for (at, bytes, end) in line.messages.drain(..) {
                shown.append_message(at, bytes, end.word());
            }
        }
        moved
    }

    fn find(&mut self, node: NodeIndex, channel: usize) -> Option<&mut Line> {
        let place = self.first.get(node.0)?.checked_add(channel)?;
        self.all.get_mut(place).filter(|line| (line.node, line.channel) == (node, channel))
    }

    /// The lines of a node.
    fn of_node(&mut self, node: NodeIndex) -> impl Iterator<Item = &mut Line> {
        let first = self.first.get(node.0).copied().unwrap_or(usize::MAX);
        self.all.iter_mut().skip(first).take_while(move |line| line.node == node)
    }
}

impl Gateway {
    /// Bytes came in.
    pub(super) fn line_received(&mut self, at: (Now, NodeIndex), channel: usize, bytes: &[u8]) {
        let Some(line) = self.lines.find(at.1, channel) else { return };
        line.bytes.extend_from_slice(bytes);
        line.changed = true;
        line.received_at = Some(at.0.instant);
        if !bytes.is_empty() {
            line.newest_byte = Some(at.0.utc);
        }
        line.counters.bytes_received += u64::try_from(bytes.len()).unwrap_or(0);
        line.counters.frames_received += 1;
        if let Some(node) = self.nodes.get_mut(at.1.0) {
            node.status.newest_data = Some(at.0.utc);
        }
        self.show_counters(at, channel, &[LineValue::BytesReceived, LineValue::FramesReceived]);
        self.show_line(at, channel, LineValue::SecondsSinceReceived, 0);
    }

    /// What came in makes a message. Its time is that of its last byte: a pause or a loss is found out later.
    pub(super) fn line_message(
        &mut self,
        at: (Now, NodeIndex),
        channel: usize,
        bytes: Vec<u8>,
        end: MessageEnd,
    ) {
        let Some(line) = self.lines.find(at.1, channel) else { return };
        line.messages.push((line.newest_byte.unwrap_or(at.0.utc), bytes, end));
        line.changed = true;
        line.counters.messages_received += 1;
        self.show_counters(at, channel, &[LineValue::MessagesReceived]);
    }

    /// Bytes were handed to the bus.
    pub(super) fn line_sent(&mut self, at: (Now, NodeIndex), channel: usize, bytes: usize) {
        let Some(line) = self.lines.find(at.1, channel) else { return };
        let bytes = u64::try_from(bytes).unwrap_or(0);
        line.sent_at = Some(at.0.instant);
        line.waiting = line.waiting.saturating_sub(bytes);
        line.counters.bytes_sent += bytes;
        line.counters.frames_sent += 1;
        self.show_counters(at, channel, &[LineValue::BytesSent, LineValue::FramesSent]);
        self.show_waiting(at, channel);
        self.show_line(at, channel, LineValue::SecondsSinceSent, 0);
    }

    /// Bytes that were counted as sent did not leave after all, and who asked for them was told that they did.
    pub(super) fn line_not_sent(&mut self, at: (Now, NodeIndex), channel: usize, bytes: usize) {
        let Some(line) = self.lines.find(at.1, channel) else { return };
        let bytes = u64::try_from(bytes).unwrap_or(0);
        line.counters.bytes_sent = line.counters.bytes_sent.saturating_sub(bytes);
        line.counters.bytes_not_sent += bytes;
        self.show_counters(at, channel, &[LineValue::BytesNotSent, LineValue::BytesSent]);
    }

    /// What was to be sent is sent, or will not be.
    pub(super) fn send_done(&mut self, at: (Now, NodeIndex), channel: usize, id: u64, outcome: SendOutcome) {
        let Some(asked) = self.lines.sends.remove(&id) else { return };
        let outcome = match outcome {
            SendOutcome::Done => Outcome::Done,
            SendOutcome::Broken { handed, sent, why } => {
                let bytes = |count| u64::try_from(count).unwrap_or(0);
                if let Some(line) = self.lines.find(at.1, channel) {
                    line.waiting = line.waiting.saturating_sub(bytes(asked.len.saturating_sub(handed)));
                    let back = bytes(handed.saturating_sub(sent));
                    line.counters.bytes_not_sent += bytes(asked.len.saturating_sub(sent));
                    line.counters.bytes_sent = line.counters.bytes_sent.saturating_sub(back);
                }
                self.show_counters(at, channel, &[LineValue::BytesNotSent, LineValue::BytesSent]);
                self.show_waiting(at, channel);
                let len = asked.len;
                Outcome::Failed(format!("{sent} of {len} bytes were handed to the bus: {}", why.words()))
            }
        };
        self.finish_send(at.0, asked, outcome);
    }

    /// Bytes for a line, if they can go there.
    pub(super) fn serial_send(
        &mut self,
        now: Now,
        (id, source): (u64, CommandSource),
        line: LineIndex,
        bytes: Vec<u8>,
    ) {
        let asked = Asked { id, source, line, len: bytes.len() };
        match self.begin_send(now, line, bytes) {
            Ok(send) => {
                self.lines.sends.insert(send, asked);
                let bus =
                    self.table.line(line).and_then(|line| self.table.node(line.node)).map(|node| node.bus);
                if let Some(bus) = bus {
                    self.drain_modules(now, bus);
                }
            }
            Err(outcome) => self.finish_send(now, asked, outcome),
        }
    }

    fn begin_send(&mut self, now: Now, line: LineIndex, bytes: Vec<u8>) -> Result<u64, Outcome> {
        let def = self.table.line(line).ok_or(Outcome::Unknown)?;
        let (node, channel) = (def.node, def.channel);
        let index = self.table.node(node).ok_or(Outcome::Unknown)?.bus;
        let bus_def = self.table.buses.get(index.0).ok_or(Outcome::Unknown)?;
        if bus_def.role == Role::Passive {
            let name = &bus_def.name;
            return Err(Outcome::Rejected(format!(
                "the gateway is passive on bus `{name}`: it sends nothing there"
            )));
        }
        if bytes.is_empty() {
            return Err(Outcome::Done);
        }
        let bus = self.buses.get_mut(index.0).ok_or(Outcome::Unknown)?;
        let place = bus.module_nodes.iter().position(|each| *each == node).ok_or(Outcome::Unknown)?;
        let len = u64::try_from(bytes.len()).unwrap_or(0);
        let send = self.lines.newest_send + 1;
        bus.modules.send(now, ModuleIndex(place), channel, send, bytes).map_err(|refused| match refused {
            SendRefused::Passive => Outcome::Rejected("the gateway is passive".into()),
            SendRefused::Unavailable => Outcome::NodeUnavailable,
            SendRefused::Full => Outcome::Busy,
            SendRefused::TooLong => Outcome::Rejected("at most 4096 bytes can be sent at once".into()),
        })?;
        self.lines.newest_send = send;
        if let Some(line) = self.lines.find(node, channel) {
            line.waiting = line.waiting.saturating_add(len);
        }
        self.show_waiting((now, node), channel);
        Ok(send)
    }

    /// Whoever still waits for bytes to be sent on such a line is told what came of it.
    pub(super) fn break_off_sends(&mut self, now: Now, of: impl Fn(LineIndex) -> bool, outcome: &Outcome) {
        let gone: Vec<Asked> =
            self.lines.sends.extract_if(.., |_, asked| of(asked.line)).map(|(_, asked)| asked).collect();
        for asked in gone {
            self.finish_send(now, asked, outcome.clone());
        }
    }

    /// Only what failed is journalled: what goes well goes well hundreds of times a second. What a grant allowed always is.
    fn finish_send(&mut self, now: Now, asked: Asked, outcome: Outcome) {
        let Asked { id, source, line, .. } = asked;
        if outcome == Outcome::Done && source.access.is_none() {
            return self.outputs.push_back(Output::Reply { id, outcome });
        }
        let def = self.table.line(line);
        let about = self.owner_of_node(def.map_or(NodeIndex(usize::MAX), |def| def.node));
        let what = def.map(|def| format!("serial channel {}", def.number)).unwrap_or_default();
        self.finished.push(Finished::of_send(now, (id, source), about, what, outcome));
    }

    /// The module lost what it had: what comes from now on has a gap before it.
    pub(super) fn break_lines(&mut self, at: (Now, NodeIndex)) {
        for line in self.lines.of_node(at.1) {
            line.breaks += 1;
            line.changed = true;
        }
    }

    /// Whether bytes can be sent to the lines of a module.
    pub(super) fn refresh_lines(&mut self, at: (Now, NodeIndex)) {
        let Some((def, node)) = self.table.node(at.1).zip(self.nodes.get(at.1.0)) else { return };
        let Some(bus) = self.buses.get(def.bus.0) else { return };
        let managed = def.protocol.module().is_some_and(|module| module.management.is_some());
        let is_there = !managed || (node.status.online && !node.status.identity_mismatch);
        let open = bus.is_up() && is_there && !node.status.passive;
        for line in self.lines.of_node(at.1).filter(|line| line.open != open) {
            line.open = open;
            line.changed = true;
            if !open {
                line.breaks += 1;
            }
        }
    }

    /// Shows everything of the lines of a module; needed after all tags of its node were called bad.
    pub(super) fn show_module_lines(&mut self, at: (Now, NodeIndex)) {
        for channel in 0..self.lines.of_node(at.1).count() {
            self.show_counters(at, channel, &COUNTERS);
            self.show_waiting(at, channel);
            self.show_times(at, channel);
        }
    }

    /// Times go on though nothing happens.
    pub(super) fn look_at_lines(&mut self, now: Now) {
        if self.lines.next_look.is_none_or(|due| due > now.instant) {
            return;
        }
        self.lines.next_look = Some(now.instant + SECOND);
        for place in 0..self.lines.all.len() {
            let Some(line) = self.lines.all.get(place) else { continue };
            let (node, channel) = (line.node, line.channel);
            self.show_times((now, node), channel);
        }
    }

    /// What the gateway itself counts is right whatever becomes of the module and its bus.
    fn show_line(&mut self, at: (Now, NodeIndex), channel: usize, value: LineValue, number: u64) {
        self.show_module(at, ModuleCarrier::Line(channel, value), number, Quality::Good);
    }

    fn show_counters(&mut self, at: (Now, NodeIndex), channel: usize, counters: &[LineValue]) {
        for counter in counters {
            let line = self.lines.find(at.1, channel);
            if let Some(count) = line.and_then(|line| line.counters.of(*counter)) {
                self.show_line(at, channel, *counter, count);
            }
        }
    }

    fn show_waiting(&mut self, at: (Now, NodeIndex), channel: usize) {
        if let Some(waiting) = self.lines.find(at.1, channel).map(|line| line.waiting) {
            self.show_line(at, channel, LineValue::BytesWaiting, waiting);
        }
    }

    fn show_times(&mut self, at: (Now, NodeIndex), channel: usize) {
        let Some(line) = self.lines.find(at.1, channel) else { return };
        let since = |then: Option<Instant>| {
            then.map_or(NEVER, |then| at.0.instant.since(then).as_secs().min(NEVER - 1))
        };
        let (received, sent) = (since(line.received_at), since(line.sent_at));
        self.show_line(at, channel, LineValue::SecondsSinceReceived, received);
        self.show_line(at, channel, LineValue::SecondsSinceSent, sent);
    }
}
