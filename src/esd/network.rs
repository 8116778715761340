//! All modules of one bus.

use std::time::Duration;

use super::dialogue::{Dialogue, Heard, Overdue};
use super::event::{ModuleIndex, NetworkOutput};
use super::identifiers::INIT_ID;
use super::init_frame::{InitCommand, Request, Setting};
use super::module::Module;
use super::outputs::Outputs;
use super::pace::Bucket;
use super::plan::standard;
use super::serial_channel::Full;
use super::settings::NetworkSettings;
use crate::can::{CanFrame, CanId};
use crate::time::{Instant, Now};

/// Identifiers of 11 bits.
const STANDARD_IDS: usize = 0x800;
/// Another manager who goes on within this time need not be told of again.
const FOREIGN_QUIET: Duration = Duration::from_secs(60);
/// Data frames that are given out for one input: the queue to the bus has other users, and is not long.
const AT_ONCE: usize = 16;
/// Frames of the greatest length that may be ahead of what the bus carries.
const AHEAD: u32 = 16;
/// Bits of the longest data frame on the wire.
const FRAME_BITS: u32 = 130;
/// The part of the bus that data for serial lines may fill, in percent: it often has higher priority than what
/// else is there.
pub const BUS_PERCENT: u32 = 60;

/// The modules of one bus, as their manager or a passive listener sees them.
#[derive(Debug)]
pub struct Network {
    passive: bool,
    modules: Vec<Module>,
    /// Whose an 11-bit identifier is.
    slots: Vec<Slot>,
    /// `None`: no module is managed.
    dialogue: Option<Dialogue>,
    /// When somebody else sent a command the last time.
    foreign: Option<Instant>,
    outputs: Outputs,
    link_up: bool,
    /// The gateway stops: nothing is sent any more.
    stopped: bool,
    /// As far as time has come: the latest that was told of. Bytes for lines leave then, whatever came in that waited.
    now: Instant,
    /// Module and channel of the data frames that were given out since the last input, one of each channel at most: the
    /// queue to the bus may have no room for them.
    in_hand: Vec<(usize, usize)>,
    /// The part of the bus that may be filled with data.
    bus: Bucket,
    bit_time: Duration,
}

/// What an identifier is for; modules and channels by their places.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
enum Slot {
    #[default]
    Unknown,
    Init,
    Reply,
    /// What comes in on a line.
    Data(usize, usize),
    /// What goes out on a line.
    Line(usize, usize),
    Watchdog(usize),
}

/// Why bytes for a line were not taken.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum SendRefused {
    /// The network is passive.
    #[error("this bus is passive: nothing is sent there")]
    Passive,
    /// The bus cannot be used, the module was not seen or is lost, it is another module, or there is no such channel.
    #[error("the bus or the module cannot be used now")]
    Unavailable,
    /// 16 jobs wait already.
    #[error("16 messages wait for this line already")]
    Full,
    /// More than 4096 bytes.
    #[error("more than 4096 bytes at once")]
    TooLong,
}

impl Network {
    /// A network of which nothing is known yet, on a bus that cannot be used before [`handle_link`](Self::handle_link)
    /// says so.
    ///
    /// Identifiers are to be unique (R-ESD-022, checked by the mapping): of two equal ones the first counts. Those of 29 bits
    /// are nobody's.
    #[must_use]
    pub fn new(settings: NetworkSettings, now: Now) -> Self {
        let reply_id = settings.reply_id.and_then(standard).filter(|_| !settings.passive);
        let bits_per_second = settings.bit_rate.max(1);
        let mut network = Self {
            passive: settings.passive,
            modules: Vec::with_capacity(settings.modules.len()),
            slots: vec![Slot::Unknown; STANDARD_IDS],
            dialogue: reply_id.map(|id| Dialogue::new(id, settings.reply_timeout, settings.repetitions)),
            foreign: None,
            outputs: Outputs::new(),
            link_up: false,
            stopped: false,
            now: now.instant,
            in_hand: Vec::new(),
            bus: Bucket::new(),
            bit_time: Duration::from_secs(1) * 100 / BUS_PERCENT / bits_per_second,
        };
        if settings.reply_id.is_some() || !settings.modules.is_empty() {
            network.claim(INIT_ID, Slot::Init);
        }
        if let Some(id) = settings.reply_id {
            network.claim(id, Slot::Reply);
        }
        for (place, module) in settings.modules.into_iter().enumerate() {
            for (number, channel) in module.channels.iter().enumerate() {
                network.claim(channel.tx_id, Slot::Data(place, number));
                network.claim(channel.rx_id, Slot::Line(place, number));
            }
            let module = Module::new(module, reply_id.is_some(), settings.reply_timeout);
            if let Some(id) = module.watchdog_id() {
                network.claim(id, Slot::Watchdog(place));
            }
            network.modules.push(module);
        }
        network
    }

    /// Whether frames of this identifier belong to this network: data of its channels either way, answers of its modules
    /// and their watchdogs, and commands.
    #[must_use]
    pub fn owns(&self, id: CanId) -> bool {
        self.slot(id) != Slot::Unknown
    }

    /// Takes a frame that another node sent; `now` is its receive time.
    pub fn handle_frame(&mut self, now: Now, frame: &CanFrame) {
        let at = self.advance(now);
        if frame.is_remote() {
            return;
        }
        match self.slot(frame.id()) {
            Slot::Unknown | Slot::Line(..) => return,
            Slot::Init => {
                // Modules take commands of 6 bytes; two more would not be used (R-ESD-045).
                if !matches!(frame.data().len(), 6 | 8) {
                    return;
                }
                let last = self.foreign.replace(at);
                if last.is_none_or(|last| at.since(last) > FOREIGN_QUIET) {
                    self.outputs.push(NetworkOutput::ForeignCommand(*frame));
                }
                self.overhear(at, frame);
            }
            Slot::Reply => self.handle_reply(at, frame),
            Slot::Data(place, channel) => {
                if let Some(module) = self.modules.get_mut(place) {
                    module.handle_data(at, channel, frame, &mut self.outputs.of(place));
                }
            }
            Slot::Watchdog(place) => {
                // A deadline that lies before the frame comes first.
                self.time_out_module(at, place);
                if let Some(module) = self.modules.get_mut(place) {
                    let lost = module.handle_watchdog(at, frame, &mut self.outputs.of(place));
                    self.forget_question(at, place, lost);
                }
            }
        }
        self.drive(at);
    }

    /// The interface took a data frame for a line. Of each that [`poll_output`](Self::poll_output) gives, this is to be told, or
    /// [`handle_not_sent`](Self::handle_not_sent): until then it counts as something that the module will still get, however
    /// long that takes (R-ESD-037). Of other frames it need not be told.
    pub fn handle_sent(&mut self, now: Now, frame: &CanFrame) {
        self.now = self.now.max(now.instant);
        let Slot::Line(place, channel) = self.slot(frame.id()) else { return };
        let Some(module) = self.modules.get_mut(place).filter(|_| !frame.is_remote()) else { return };
        if let Some(given) = self.in_hand.iter().position(|given| *given == (place, channel)) {
            self.in_hand.swap_remove(given);
            module.data_handed_out(channel, &mut self.outputs.of(place));
        }
        module.handle_data_sent(now.instant, channel, frame);
    }

    /// A frame of ours did not leave: what waits for its answer must not blame the module, and bytes in it were not
    /// sent.
    pub fn handle_not_sent(&mut self, now: Now, frame: &CanFrame) {
        // What was given out last is not settled by this: it may be among it.
        self.now = self.now.max(now.instant);
        let at = now.instant;
        if let Slot::Line(place, channel) = self.slot(frame.id()) {
            if let Some(module) = self.modules.get_mut(place).filter(|_| !frame.is_remote()) {
                module.handle_data_not_sent(self.now, channel, frame, &mut self.outputs.of(place));
            }
            return;
        }
        if let Some(dialogue) = &mut self.dialogue {
            dialogue.handle_not_sent(frame);
        }
        for place in 0..self.modules.len() {
            let void = self.modules.get_mut(place).is_some_and(|module| module.handle_not_sent(at, frame));
            self.forget_question(at, place, void);
        }
    }

    /// The bus can be used, or cannot: while it cannot, nothing is sent, no module is blamed for silence, and what was to be
    /// sent to lines is given up. When it can again, all modules are looked at as at the start.
    pub fn handle_link(&mut self, now: Now, up: bool) {
        let at = self.advance(now);
        if self.stopped || std::mem::replace(&mut self.link_up, up) == up {
            return;
        }
        if let Some(dialogue) = &mut self.dialogue {
            dialogue.clear(at);
        }
        self.bus.clear();
        for (place, module) in self.modules.iter_mut().enumerate() {
            if up {
                module.resume(at);
            } else {
                module.pause(&mut self.outputs.of(place));
            }
        }
        self.drive(at);
    }

    /// The gateway stops. Where a watchdog was set going it is switched off, so that the module does not reset itself
    /// (R-ESD-088); after that nothing is sent any more, and what was to be sent to lines is given up. Whether a watchdog that
    /// runs can be switched off is not stated in the manual.
    pub fn handle_stop(&mut self, now: Now) {
        let at = self.advance(now);
        for (place, module) in self.modules.iter_mut().enumerate() {
            module.stop(&mut self.outputs.of(place));
        }
        if let Some(dialogue) = &mut self.dialogue {
            dialogue.clear(at);
        }
        self.link_up = false;
        self.stopped = true;
    }

    /// Bytes for a line, in one piece: nothing else for this line comes between them. If they are taken,
    /// [`ModuleEvent::SendDone`](super::ModuleEvent::SendDone) with this id follows.
    ///
    /// They may wait: for the line, for a module that is suspended (a minute at most) or being configured, and for one that started lately, as it
    /// passes nothing on before its First Tx activate delay (R-ESD-033).
    pub fn send(
        &mut self,
        now: Now,
        module: ModuleIndex,
        channel: usize,
        id: u64,
        bytes: Vec<u8>,
    ) -> Result<(), SendRefused> {
        let at = self.advance(now);
        if self.passive {
            return Err(SendRefused::Passive);
        }
        let module = self.modules.get_mut(module.0).filter(|module| module.takes_bytes());
        let taken = module.ok_or(SendRefused::Unavailable)?.send(at, channel, id, bytes);
        taken.ok_or(SendRefused::Unavailable)?.map_err(|full| match full {
            Full::Jobs => SendRefused::Full,
            Full::Bytes => SendRefused::TooLong,
        })
    }

    /// What the clock shows, where that may be later than what is told of next. A gateway that was kept from running gets the
    /// frames of a while at once, with the times at which they came: bytes for lines paced by these would leave in one burst
    /// that no module can hold (R-ESD-037).
    pub fn handle_clock(&mut self, now: Now) {
        self.now = self.now.max(now.instant);
    }

    /// What became due.
    pub fn handle_timeout(&mut self, now: Now) {
        let at = self.advance(now);
        self.time_out_question(at);
        for place in 0..self.modules.len() {
            self.time_out_module(at, place);
        }
        self.drive(at);
    }

    /// What is to be done; call until `None` after each of the calls above. A frame for which there is no room in the queue
    /// to the bus is to be given back by [`handle_not_sent`](Self::handle_not_sent) before anything else is told.
    pub fn poll_output(&mut self) -> Option<NetworkOutput> {
        if let Some(output) = self.outputs.pop() {
            return Some(output);
        }
        loop {
            let (_, place, channel) = self.next_data().filter(|(due, ..)| *due <= self.now)?;
            self.in_hand.push((place, channel));
            if let Some(frame) = self.modules.get_mut(place).and_then(|module| module.give_out(channel)) {
                self.bus.fill(self.now, self.bit_time.saturating_mul(frame.wire_bits()));
                return Some(NetworkOutput::Transmit(frame));
            }
        }
    }

    /// When `handle_timeout` is to be called at the latest, and why. May be earlier than anything is due.
    #[must_use]
    pub fn poll_timeout(&self) -> Option<(Instant, &'static str)> {
        let modules = self.modules.iter().filter_map(Module::poll_timeout);
        let question = self.next_question().map(|at| (at, "question to a module"));
        let data = if self.in_hand.is_empty() {
            self.next_data().map(|(at, ..)| (at, "data for a serial line"))
        } else {
            Some((self.now, "data that was given out"))
        };
        modules.chain(question).chain(data).min_by_key(|(at, _)| *at)
    }

    /// Something came in: what was given out before that found room. Inputs that are told of late do not turn time back.
    fn advance(&mut self, now: Now) -> Instant {
        self.now = self.now.max(now.instant);
        for (place, channel) in std::mem::take(&mut self.in_hand) {
            if let Some(module) = self.modules.get_mut(place) {
                module.data_handed_out(channel, &mut self.outputs.of(place));
            }
        }
        now.instant
    }

    /// The data frame that is due first: when, and of which channel of which module.
    fn next_data(&self) -> Option<(Instant, usize, usize)> {
        if !self.link_up || self.passive || self.in_hand.len() >= AT_ONCE {
            return None;
        }
        let modules = self.modules.iter().enumerate();
        let due = modules.filter_map(|(place, module)| {
            let (due, channel) = module.data_due()?;
            Some((due, place, channel))
        });
        let (due, place, channel) = due.min()?;
        let frame = self.bit_time.saturating_mul(FRAME_BITS);
        Some((due.max(self.bus.opens(frame, frame.saturating_mul(AHEAD))), place, channel))
    }

    /// Somebody else sent a command: what it does to our modules is known before they tell of it.
    fn overhear(&mut self, now: Instant, frame: &CanFrame) {
        let Some(command) = InitCommand::parse(frame) else { return };
        for place in 0..self.modules.len() {
            let Some(module) = self.modules.get_mut(place) else { return };
            let void = match command {
                InitCommand::Supervisor { module: to, order } if to.is_none_or(|to| to == module.number) => {
                    module.ordered(now, order, &mut self.outputs.of(place))
                }
                InitCommand::Set { module: to, setting: Setting::Store } if to == module.number => {
                    module.storing(now);
                    false
                }
                InitCommand::Supervisor { .. }
                | InitCommand::Set { .. }
                | InitCommand::Request { .. }
                | InitCommand::Service { .. } => false,
            };
            self.forget_question(now, place, void);
        }
    }

    /// A frame on the identifier of answers.
    fn handle_reply(&mut self, now: Instant, frame: &CanFrame) {
        if !self.link_up {
            return;
        }
        let late = |dialogue: &Dialogue| dialogue.poll_timeout().is_some_and(|deadline| deadline < now);
        if self.dialogue.as_ref().is_some_and(late) {
            self.time_out_question(now);
        }
        let Some(dialogue) = &mut self.dialogue else { return };
        match dialogue.handle_frame(now, frame.data()) {
            Heard::Nothing => {}
            Heard::Next(frame) => self.outputs.transmit(frame),
            Heard::Answer(place, answer) => {
                if let Some(module) = self.modules.get_mut(place) {
                    let void = module.handle_answer(now, answer, &mut self.outputs.of(place));
                    self.forget_question(now, place, void);
                }
            }
        }
    }

    /// A question that was not answered in time.
    fn time_out_question(&mut self, now: Instant) {
        match self.dialogue.as_mut().map(|dialogue| dialogue.handle_timeout(now)) {
            Some(Overdue::Again(frame)) => self.outputs.transmit(frame),
            Some(Overdue::Unanswered(place)) => {
                if let Some(module) = self.modules.get_mut(place) {
                    module.handle_unanswered(now, &mut self.outputs.of(place));
                }
            }
            Some(Overdue::Nothing) | None => {}
        }
    }

    fn time_out_module(&mut self, now: Instant, place: usize) {
        if let Some(module) = self.modules.get_mut(place) {
            let lost = module.handle_timeout(now, &mut self.outputs.of(place));
            self.forget_question(now, place, lost);
        }
    }

    fn forget_question(&mut self, now: Instant, place: usize, void: bool) {
        if let Some(dialogue) = self.dialogue.as_mut().filter(|_| void) {
            dialogue.drop_module(now, place);
        }
    }

    /// Takes the steps of managing that are due, until one asks something: one question at a time (R-ESD-055).
    fn drive(&mut self, now: Instant) {
        while self.next_question().is_some_and(|at| at <= now) {
            let Some((place, request)) = self.next_step().map(|(_, place, request)| (place, request)) else {
                return;
            };
            let (Some(dialogue), Some(module)) = (&mut self.dialogue, self.modules.get_mut(place)) else {
                return;
            };
            if !dialogue.is_free() {
                return;
            }
            let frame = match request {
                Some(request) => Some(dialogue.ask(now, place, module.number, request)),
                None => module.procedure.as_mut().and_then(|procedure| procedure.set(now)),
            };
            if let Some(frame) = frame {
                self.outputs.transmit(frame);
            }
        }
    }

    /// When there is something to do about questions: one that is open has had its time, or the next step is due.
    fn next_question(&self) -> Option<Instant> {
        let dialogue = self.dialogue.as_ref().filter(|_| self.link_up)?;
        if !dialogue.is_free() {
            return dialogue.poll_timeout();
        }
        let (due, _, request) = self.next_step()?;
        Some(if request.is_some() { due.max(dialogue.ready_at()) } else { due })
    }

    /// The step of managing that is due first.
    fn next_step(&self) -> Option<(Instant, usize, Option<Request>)> {
        let steps = self.modules.iter().enumerate().filter_map(|(place, module)| {
            let (due, request) = module.next_step()?;
            Some((due, place, request))
        });
        steps.min_by_key(|(due, ..)| *due)
    }

    fn slot(&self, id: CanId) -> Slot {
        let number = standard(id).map(usize::from);
        number.and_then(|number| self.slots.get(number)).copied().unwrap_or_default()
    }

    /// Gives an identifier to whoever claims it first.
    fn claim(&mut self, id: CanId, slot: Slot) {
        let place = standard(id).and_then(|number| self.slots.get_mut(usize::from(number)));
        if let Some(place) = place.filter(|place| **place == Slot::Unknown) {
            *place = slot;
        }
    }
}
