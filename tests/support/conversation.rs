//! A scripted conversation between the gateway core and devices, in candump notation, with made-up time.
//!
//! A script has one line for each step. It begins with the time in ms; time runs on to it first.
//!
//! ```text
//! 0     <- 701#00                a frame arrives
//! 102   -> 000#0101              exactly now the gateway sends this frame
//! 350   tag trip = true good     a tag as readers see it now
//! 1600  alarm node_lost unacknowledged
//! 1600  event node_lost          such an event was journalled since the event before
//! 1600  reply 701#05             answers the guard request of this moment, else the next one, 1 ms after it
//! ```
//!
//! Every frame that the gateway sends must stand in the script, guard requests excepted: those are only looked at
//! where a line names one. [`Conversation::answer_guarding`] and [`Conversation::send_cyclically`] play a device.

use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;

use cangate::can::{BusEvent, BusIndex, CanFrame, Link};
use cangate::canopen::NmtRequest;
use cangate::gateway::kept::Kept;
use cangate::gateway::{Action, Command, CommandSource, Gateway, Health, Input, Outcome, Output};
use cangate::mapping::{AlarmOwner, TagTable};
use cangate::process_image::{
    AlarmIndex, AlarmState, AlarmStatus, BusStatus, Event, EventKind, NodeIndex, NodeStatus, ProcessImage,
    Sample, TagIndex,
};
use cangate::time::{Instant, Now, Timestamp};

pub const BUS: BusIndex = BusIndex(0);

pub struct Conversation {
    pub gateway: Gateway,
    pub image: ProcessImage,
    pub table: Arc<TagTable>,
    now: Instant,
    /// Frames sent and not yet looked at, guard requests apart.
    sent: VecDeque<(Instant, String)>,
    guard_requests: Vec<(Instant, String)>,
    /// Everything that was ever sent.
    pub all_sent: Vec<CanFrame>,
    outcomes: Vec<Outcome>,
    event_cursor: u64,
    /// By node id: state and the toggle bit of the next reply.
    guarded: BTreeMap<u8, (u8, bool)>,
    /// By identifier and data: next time and period, in µs.
    cyclic: BTreeMap<String, (u64, u64)>,
}

impl Conversation {
    /// The gateway starts at 0 ms, all buses working.
    pub fn new(table: TagTable) -> Self {
        let table = Arc::new(table);
        let gateway = Gateway::new(Arc::clone(&table), Now::default());
        let image = gateway.empty_image();
        let mut conversation = Self {
            gateway,
            image,
            table,
            now: Instant::START,
            sent: VecDeque::new(),
            guard_requests: Vec::new(),
            all_sent: Vec::new(),
            outcomes: Vec::new(),
            event_cursor: 0,
            guarded: BTreeMap::new(),
            cyclic: BTreeMap::new(),
        };
        conversation.drain();
        conversation.link(Link::ErrorActive);
        conversation
    }

    fn moment(&self) -> Now {
        let micros = self.now.as_micros();
        Now { instant: self.now, utc: Timestamp::from_micros(i64::try_from(micros).unwrap()) }
    }

    fn drain(&mut self) {
        while let Some(output) = self.gateway.poll_output() {
            match output {
                Output::Transmit { bus, frame } => {
                    let at = self.moment();
                    self.gateway.handle_input(at, Input::Bus { bus, event: BusEvent::Sent { frame, at } });
                    self.all_sent.push(frame);
                    let entry = (self.now, frame.to_string());
                    if frame.is_remote() {
                        self.guard_requests.push(entry);
                        self.reply_to_guarding(frame);
                    } else {
                        self.sent.push_back(entry);
                    }
                }
                Output::Reply { outcome, .. } => self.outcomes.push(outcome),
            }
        }
        self.gateway.publish(&mut self.image);
        let blocked: u64 = self.image.buses.iter().map(|bus| bus.frames_blocked).sum();
        assert_eq!(blocked, 0, "the gateway made a frame that the configuration does not allow");
    }

    fn reply_to_guarding(&mut self, request: CanFrame) {
        let node = u8::try_from(request.id().raw() & 0x7F).unwrap();
        if let Some((state, toggle)) = self.guarded.get_mut(&node) {
            let byte = *state | if *toggle { 0x80 } else { 0 };
            *toggle = !*toggle;
            let at = self.now.as_micros() + 1_000;
            self.cyclic.insert(format!("{:03X}#{byte:02X}", 0x700 + u16::from(node)), (at, 0));
        }
    }

    /// From now on the node answers guard requests within 1 ms; the first reply has toggle bit 0.
    pub fn answer_guarding(&mut self, node: u8, state: u8) {
        let toggle = self.guarded.get(&node).is_some_and(|(_, toggle)| *toggle);
        self.guarded.insert(node, (state, toggle));
    }

    pub fn stop_answering(&mut self, node: u8) {
        self.guarded.remove(&node);
    }

    /// From now on this frame arrives every `period` ms.
    pub fn send_cyclically(&mut self, frame: &str, period: u64) {
        self.cyclic.insert(frame.to_owned(), (self.now.as_micros(), period * 1_000));
    }

    /// Cyclic frames that begin so no longer arrive.
    pub fn stop_sending(&mut self, prefix: &str) {
        self.cyclic.retain(|frame, _| !frame.starts_with(prefix));
    }

    /// Whole milliseconds since the start.
    pub fn now_millis(&self) -> u64 {
        self.now.as_millis()
    }

    /// Time runs on to so many ms after the start.
    pub fn run_to(&mut self, millis: u64) {
        self.run_to_instant(Instant::from_millis(millis));
    }

    /// To the next guard request unless one was sent right now, and 1 ms on; then the reply arrives.
    fn reply(&mut self, frame: &str) {
        let requests = self.guard_requests.len();
        let just_asked = self.guard_requests.last().is_some_and(|(at, _)| *at == self.now);
        while !just_asked && self.guard_requests.len() == requests {
            let (due, _) = self.gateway.poll_timeout().expect("the gateway guards its nodes");
            self.run_to_instant(due.max(self.now));
        }
        self.run_to_instant(Instant::from_micros(self.now.as_micros() + 1_000));
        self.frame(frame);
    }

    fn run_to_instant(&mut self, end: Instant) {
        assert!(end >= self.now, "time does not run backwards");
        loop {
            let due = self.gateway.poll_timeout().map(|(due, _)| due.max(self.now));
            let frame = self.cyclic.iter().map(|(frame, (at, _))| (*at, frame.clone())).min();
            let frame_at = frame.as_ref().map(|(at, _)| Instant::from_micros(*at));
            match (due, frame_at) {
                (Some(due), at) if due <= end && at.is_none_or(|at| due < at) => {
                    self.now = due;
                    let now = self.moment();
                    self.gateway.handle_timeout(now);
                    self.drain();
                }
                (_, Some(at)) if at <= end => {
                    self.now = at;
                    let (_, frame) = frame.unwrap();
                    match self.cyclic.get(&frame).unwrap().1 {
                        0 => drop(self.cyclic.remove(&frame)),
                        period => drop(self.cyclic.insert(frame.clone(), (at.as_micros() + period, period))),
                    }
                    self.frame(&frame);
                }
                _ => break,
            }
        }
        self.now = end;
        let now = self.moment();
        self.gateway.handle_timeout(now);
        self.drain();
    }

    pub fn input(&mut self, input: Input) {
        self.gateway.handle_input(self.moment(), input);
        self.drain();
    }

    pub fn bus_event(&mut self, event: BusEvent) {
        self.input(Input::Bus { bus: BUS, event });
    }

    /// A frame arrives now.
    pub fn frame(&mut self, frame: &str) {
        let frame = frame.parse().unwrap_or_else(|error| panic!("{frame}: {error}"));
        self.bus_event(BusEvent::Frame { frame, at: self.moment() });
    }

    /// The gateway goes on with another table; its interfaces stay.
    pub fn exchange(&mut self, table: TagTable) {
        let table = Arc::new(table);
        let kept = Kept::new(&self.table, &table, |_, _| true);
        let now = self.moment();
        self.gateway.prepare_exchange(now, &table, &kept);
        self.drain();
        let old = std::mem::replace(&mut self.gateway, Gateway::new(Arc::default(), now));
        (self.gateway, self.image) = old.exchange(Arc::clone(&table), &kept, now, &self.image);
        self.table = table;
        self.drain();
    }

    pub fn link(&mut self, link: Link) {
        self.bus_event(BusEvent::Link { link, at: self.moment() });
    }

    pub fn health(&mut self, health: Health) {
        self.input(Input::Health(health));
    }

    pub fn command(&mut self, action: Action) -> Outcome {
        let source = CommandSource::mqtt("test".into());
        self.input(Input::Command(Command { id: 1, source, action }));
        self.outcomes.pop().expect("every command is answered at once")
    }

    /// Asks for something; the answer may come later.
    pub fn ask(&mut self, action: Action) {
        let source = CommandSource::mqtt("test".into());
        self.input(Input::Command(Command { id: 1, source, action }));
    }

    /// All answers so far, in words.
    pub fn outcome_words(&self) -> Vec<String> {
        self.outcomes.iter().map(|outcome| format!("{outcome:?}")).collect()
    }

    /// When a guard request was sent, in ms.
    pub fn guard_requests_of(&self, frame: &str) -> Vec<u64> {
        let of = self.guard_requests.iter().filter(|(_, sent)| sent == frame);
        of.map(|(at, _)| at.as_millis()).collect()
    }

    pub fn nmt(&mut self, request: NmtRequest) -> Outcome {
        self.command(Action::Nmt { node: NodeIndex(0), request })
    }

    pub fn tag_index(&self, name: &str) -> TagIndex {
        self.table.find_tag(NodeIndex(0), name).unwrap_or_else(|| panic!("there is no tag `{name}`"))
    }

    /// A tag of the first node.
    pub fn tag(&self, name: &str) -> Sample {
        *self.image.tag(self.tag_index(name))
    }

    /// `true good`, `12.55 stale (pdo_timeout)`.
    pub fn tag_text(&self, name: &str) -> String {
        let sample = self.tag(name);
        match sample.value {
            cangate::process_image::Value::Float(number) => format!("{number:.2} {}", sample.quality),
            value => format!("{value} {}", sample.quality),
        }
    }

    pub fn node(&self) -> &NodeStatus {
        &self.image.nodes[0]
    }

    pub fn bus(&self) -> &BusStatus {
        &self.image.buses[0]
    }

    /// An alarm of the gateway, of a bus, or of the first node that has one of this name.
    pub fn alarm_index(&self, name: &str) -> AlarmIndex {
        let place = self.table.alarms.iter().position(|alarm| alarm.name == name);
        AlarmIndex(place.unwrap_or_else(|| panic!("there is no alarm `{name}`")))
    }

    pub fn alarm(&self, name: &str) -> AlarmStatus {
        self.image.alarms[self.alarm_index(name).0]
    }

    pub fn alarm_of(&self, node: usize, name: &str) -> AlarmStatus {
        let owner = AlarmOwner::Node(NodeIndex(node));
        let place = self.table.alarms.iter().position(|alarm| alarm.owner == owner && alarm.name == name);
        self.image.alarms[place.unwrap()]
    }

    /// Names of all alarms that were ever raised (suppressed ones were not), as often as they were.
    pub fn raised(&self) -> Vec<String> {
        let is_raised = |event: &Event| event.kind == EventKind::Alarm && event.to == "unacknowledged";
        self.events().into_iter().filter(is_raised).map(|event| event.name).collect()
    }

    /// Names of all alarms that are active now.
    pub fn active(&self) -> Vec<&str> {
        let alarms = self.table.alarms.iter().zip(&self.image.alarms);
        alarms.filter(|(_, status)| status.state.is_active()).map(|(alarm, _)| alarm.name.as_str()).collect()
    }

    pub fn events(&self) -> Vec<Event> {
        self.image.journal.after(0).0
    }

    pub fn events_named(&self, name: &str) -> Vec<Event> {
        self.events().into_iter().filter(|event| event.name == name).collect()
    }

    /// Plays a script; see the head of this file.
    pub fn play(&mut self, script: &str) {
        for line in script.lines().map(str::trim).filter(|line| !line.is_empty()) {
            let (time, step) = line.split_once(char::is_whitespace).unwrap_or_else(|| panic!("`{line}`"));
            self.run_to(time.parse().unwrap_or_else(|_| panic!("`{line}` does not begin with a time")));
            let (verb, rest) = step.trim().split_once(char::is_whitespace).unwrap_or((step.trim(), ""));
            self.step(line, verb, rest.trim());
        }
    }

    fn step(&mut self, line: &str, verb: &str, rest: &str) {
        if verb != "->" {
            self.expect_nothing_sent_before(self.now, line);
        }
        match verb {
            "<-" => self.frame(rest),
            "->" if rest.contains("#R") => {
                let wanted = (self.now, rest.to_owned());
                assert!(self.guard_requests.contains(&wanted), "{line}: sent {:?}", self.guard_requests);
            }
            "->" => assert_eq!(self.sent.pop_front(), Some((self.now, rest.to_owned())), "{line}"),
            "reply" => self.reply(rest),
            "tag" => {
                let (name, wanted) = rest.split_once(" = ").unwrap_or_else(|| panic!("`{line}`"));
                assert_eq!(self.tag_text(name), wanted, "{line}");
            }
            "alarm" => {
                let (name, wanted) = rest.split_once(' ').unwrap_or_else(|| panic!("`{line}`"));
                assert_eq!(self.alarm(name).state.word(), wanted, "{line}");
            }
            "event" => {
                let (events, _) = self.image.journal.after(self.event_cursor);
                let found = events.iter().find(|event| event.name == rest);
                let names: Vec<&str> = events.iter().map(|event| event.name.as_str()).collect();
                self.event_cursor = found.unwrap_or_else(|| panic!("{line}: only {names:?}")).seq;
            }
            _ => panic!("`{line}`: no such verb"),
        }
    }

    fn expect_nothing_sent_before(&self, now: Instant, line: &str) {
        let forgotten: Vec<_> = self.sent.iter().filter(|(at, _)| *at < now).collect();
        assert!(forgotten.is_empty(), "before {line} was sent, and is not in the script: {forgotten:?}");
    }

    /// All that was sent has been looked at.
    pub fn end(&self) {
        assert!(self.sent.is_empty(), "not in the script: {:?}", self.sent);
    }

    /// Forgets what was sent.
    pub fn forget_sent(&mut self) {
        self.sent.clear();
    }

    pub fn is_normal(&self, alarm: &str) -> bool {
        self.alarm(alarm).state == AlarmState::Normal
    }
}
