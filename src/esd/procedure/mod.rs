//! Managing one module: find it, compare it with what is wanted, write what differs, and look after it (R-ESD-005, 054,
//! 063..067, 074..077).
//!
//! The status bits are cleared before the comparing begins, and read when it is over: if the module starts anew meanwhile,
//! with other parameters, that is seen then, and nothing is called configured that is not.

mod answers;

use std::time::Duration;

use super::answer::Answer;
use super::event::ModuleEvent;
use super::identifiers::{ModuleKind, ModuleNumber};
use super::init_frame::{InitCommand, Order, Request, Setting};
use super::outputs::Teller;
use super::parameters::DEFAULT_FIRST_TX_DELAY;
use super::plan::{Item, plan};
use super::settings::{ManagementSettings, ModuleSettings};
use super::status::CanStatus;
use super::step::{Change, Condition, Step};
use crate::can::CanFrame;
use crate::time::Instant;

/// A module that does not answer is asked again after this time.
const SEEK_AGAIN: Duration = Duration::from_secs(2);
/// A module that is another one, or cannot be configured, is looked at again after this time.
const RETRY: Duration = Duration::from_secs(60);
/// A question of the comparing that was not answered is asked again after this time.
const STEP_AGAIN: Duration = Duration::from_millis(500);
/// A module that is to reset itself is left alone for this time.
const RESETTING: Duration = Duration::from_secs(1);
/// Writing its memory keeps a module busy.
const STORING: Duration = Duration::from_secs(1);
/// As many questions in a row without an answer lose a module.
const MOST_MISSES: u32 = 3;

/// Manages one module.
#[derive(Debug)]
pub(super) struct Procedure {
    number: ModuleNumber,
    kind: ModuleKind,
    settings: ManagementSettings,
    plan: Vec<Item>,
    step: Step,
    /// When the step is to be taken; `None` while the bus cannot be used.
    due: Option<Instant>,
    /// Questions in a row that were not answered, and when the first of them was given up.
    misses: u32,
    silent_since: Instant,
    /// A question that it did not answer so often: whether it is there is asked before that is called its silence.
    unanswered: Option<Step>,
    /// It sends data and answers no commands: its silence says nothing.
    is_mute: bool,
    /// It was reset, and may be silent until its First Tx activate delay is over: nobody misses it before.
    silent_until: Option<Instant>,
    /// It does not answer the question for its status: it is looked after by asking for its number.
    hides_status: bool,
    condition: Condition,
    /// What was told last.
    told: Option<String>,
    /// As told last.
    status: Option<CanStatus>,
    /// It holds back what it gets, as it says, or as it was ordered to.
    suspended: bool,
    /// "New on bus" was seen cleared: when it is set again, the module started anew.
    cleared: bool,
    /// It started not long ago and passes nothing on before its First Tx activate delay is over.
    started: Option<Instant>,
    /// The longest that was found since then: what is written holds at once or from the next start on, nobody knows.
    first_tx_delay: Option<Duration>,
    /// Its CAN error bit stays set; tried again then.
    error_stays: Option<Instant>,
    /// Comparing begins anew then, as something was not in order.
    retry: Option<Instant>,
    round: Round,
    /// Something was written since it was stored, or since it started.
    unstored: bool,
    /// It was set going, or found going.
    watchdog_set: bool,
    /// All of its watchdog was found as wanted since it appeared or started.
    guarded: bool,
    /// What it has at the place of the plan that is to be written.
    found: Option<Answer>,
    /// The last frame that set something, and the step that sent it.
    undo: Option<(CanFrame, Step)>,
}

/// What the comparing has found so far.
#[derive(Debug, Default)]
struct Round {
    /// What is different.
    differences: Vec<String>,
    /// Parameters that were written and then found as wanted.
    written: usize,
    stored: bool,
    /// What was found of its watchdog as wanted, of `GUARDS`.
    guards: u8,
}

impl Procedure {
    /// On a bus that cannot be used.
    pub(super) fn new(module: &ModuleSettings, settings: ManagementSettings) -> Self {
        Self {
            number: module.number,
            kind: module.kind,
            plan: plan(&settings, &module.channels),
            settings,
            step: Step::Seek,
            due: None,
            misses: 0,
            silent_since: Instant::START,
            unanswered: None,
            is_mute: false,
            silent_until: None,
            hides_status: false,
            condition: Condition::Unknown,
            told: None,
            status: None,
            suspended: false,
            cleared: false,
            started: None,
            first_tx_delay: None,
            error_stays: None,
            retry: None,
            round: Round::default(),
            unstored: false,
            watchdog_set: false,
            guarded: false,
            found: None,
            undo: None,
        }
    }

    /// Whether its watchdog is known to be as it was set.
    pub(super) fn is_guarded(&self) -> bool {
        self.guarded
    }

    pub(super) fn settings(&self) -> &ManagementSettings {
        &self.settings
    }

    pub(super) fn condition(&self) -> Condition {
        self.condition
    }

    /// Whether its watchdog was set going by us, or found so.
    pub(super) fn has_set_watchdog(&self) -> bool {
        self.watchdog_set
    }

    /// Whether it holds back what it gets.
    pub(super) fn is_suspended(&self) -> bool {
        self.suspended
    }

    /// From when on data may be sent to its lines; `None`: not before something else happens.
    ///
    /// A module that does not answer may be gone or may have started anew: what it is sent then is lost. But one that is not as
    /// wanted may be one that never answers some question; only its silence to the questions that it did answer counts.
    pub(super) fn passes_on_from(&self) -> Option<Instant> {
        let counts = self.condition == Condition::Good || matches!(self.step, Step::Seek | Step::Watch);
        let is_silent = counts && self.misses > 0 && !self.is_mute;
        match self.condition {
            Condition::Good | Condition::Different if !self.suspended && !is_silent => {
                let delay = self.first_tx_delay.unwrap_or(DEFAULT_FIRST_TX_DELAY);
                Some(self.started.map_or(Instant::START, |at| at + delay))
            }
            Condition::Unknown | Condition::Good | Condition::Different | Condition::Other => None,
        }
    }

    /// The bus can be used: everything begins anew.
    pub(super) fn resume(&mut self, now: Instant) {
        self.begin(now);
        self.forget();
        self.error_stays = None;
    }

    /// The bus cannot be used.
    pub(super) fn pause(&mut self) {
        self.due = None;
        self.undo = None;
    }

    /// A first sign of life that is no answer: it is asked at once.
    pub(super) fn wake(&mut self, now: Instant) {
        if self.step == Step::Seek && self.due.is_some() {
            self.due = Some(now);
            self.misses = 0;
        }
    }

    /// It was lost by its watchdog.
    pub(super) fn lose(&mut self, now: Instant) {
        self.begin(now + SEEK_AGAIN);
        self.forget();
    }

    /// Somebody sent it an order.
    pub(super) fn ordered(&mut self, now: Instant, order: Order) {
        match order {
            Order::Reset | Order::DefaultReset => {
                // What it will have is what is stored in it: nobody knows.
                let delay = self.first_tx_delay.max(self.settings.first_tx_delay);
                self.begin(now + RESETTING);
                self.forget();
                self.silent_until =
                    Some(now + RESETTING + delay.unwrap_or_default().max(DEFAULT_FIRST_TX_DELAY));
            }
            Order::Suspend => {
                self.suspended = true;
                self.look(now);
            }
            Order::Continue => {
                // One that said that it is suspended is believed to go on when it says so.
                self.suspended = self.status.is_some_and(CanStatus::is_suspended);
                self.look(now);
            }
            Order::Watchdog | Order::ClearCanError => {}
        }
    }

    /// Asks for its status at once, if it is only looked after.
    fn look(&mut self, now: Instant) {
        if self.step == Step::Watch && self.due.is_some() {
            self.due = Some(now);
        }
    }

    /// Somebody had its parameters stored: it is left alone for a moment.
    pub(super) fn storing(&mut self, now: Instant) {
        self.due = self.due.map(|due| due.max(now + STORING));
    }

    fn begin(&mut self, at: Instant) {
        self.step = Step::Seek;
        self.due = Some(at);
        self.misses = 0;
        self.retry = None;
        self.undo = None;
        self.unanswered = None;
    }

    /// The comparing begins.
    fn begin_round(&mut self, now: Instant, step: Step) {
        self.round = Round::default();
        self.hides_status = false;
        self.go(now, step);
    }

    /// Nothing is known of it any more.
    fn forget(&mut self) {
        self.guarded = false;
        self.condition = Condition::Unknown;
        self.told = None;
        self.status = None;
        self.suspended = false;
        self.is_mute = false;
        self.silent_until = None;
        // A start that was noted is told from a newer one.
        if !self.cleared {
            self.started = None;
        }
    }

    /// When the next step is due, and what it asks; `None` for one that sets something.
    pub(super) fn next(&self) -> Option<(Instant, Option<Request>)> {
        let request = if self.step == Step::Watch && self.hides_status {
            Some(Request::ActiveNumber)
        } else {
            self.step.request(&self.plan)
        };
        Some((self.due?, request))
    }

    /// Takes a step that sets something: the frame to send.
    pub(super) fn set(&mut self, now: Instant) -> Option<CanFrame> {
        let (setting, then, wait) = match (self.step, self.place()) {
            (Step::Clear(times), _) => (Setting::ClearStatus, Step::Status(times), Duration::ZERO),
            (Step::Write(place), Some(Item::Want(want))) => {
                (want.setting_over(self.found), Step::Verify(place), Duration::ZERO)
            }
            (Step::Item(place), Some(Item::Store)) => (Setting::Store, Step::Item(place + 1), STORING),
            _ => {
                // Nothing to set: not reached, and no reason to stand still.
                self.due = Some(now + RETRY);
                return None;
            }
        };
        let frame = InitCommand::Set { module: self.number, setting }.frame();
        self.undo = Some((frame, self.step));
        match setting {
            Setting::Store => {
                self.round.stored = true;
                self.unstored = false;
            }
            Setting::WatchdogTime { .. } => self.watchdog_set = true,
            Setting::Parameter(..) | Setting::TxId(..) | Setting::RxId(..) => self.unstored = true,
            Setting::ClearStatus
            | Setting::WatchdogId(_)
            | Setting::Number(_)
            | Setting::BitRate(_)
            | Setting::TxActivateTime(..) => {}
        }
        self.go(now + wait, then);
        Some(frame)
    }

    /// A frame of ours did not leave. `true`: it set something here, which is done again; an answer that is awaited does not
    /// count any more.
    pub(super) fn handle_not_sent(&mut self, now: Instant, frame: &CanFrame) -> bool {
        let Some((_, step)) = self.undo.take_if(|(sent, _)| sent == frame) else { return false };
        if let (Step::Item(_), true) = (step, self.round.stored) {
            self.round.stored = false;
            self.unstored = true;
        }
        self.step = step;
        self.due = self.due.map(|_| now + STEP_AGAIN);
        true
    }

    /// Nobody answered; `heard` is when it last showed otherwise that it is alive, `known` whether it is believed to be.
    pub(super) fn handle_unanswered(
        &mut self,
        now: Instant,
        known: bool,
        heard: Option<Instant>,
        teller: &mut Teller<'_>,
    ) -> Change {
        if self.misses == 0 {
            self.silent_since = now;
        }
        self.misses = self.misses.saturating_add(1);
        let wait = if self.step == Step::Watch {
            self.settings.status_period
        } else if self.step != Step::Seek {
            STEP_AGAIN
        } else if self.condition == Condition::Other {
            RETRY
        } else {
            SEEK_AGAIN
        };
        self.due = Some(now + wait);
        let is_expected = self.silent_until.is_some_and(|until| now < until);
        if self.misses < MOST_MISSES || !known || is_expected {
            return Change::Nothing;
        }
        if !matches!(self.step, Step::Seek | Step::Watch) {
            self.unanswered = Some(self.step);
            self.misses = 0;
            self.step = Step::Seek;
            return Change::Nothing;
        }
        if heard.is_some_and(|at| at >= self.silent_since) {
            self.begin(now + SEEK_AGAIN);
            self.is_mute = true;
            let text = format!(
                "module {} sends data but answers no commands; check its number, and that nobody else uses \
                 the reply identifier",
                self.number
            );
            self.tell_different(text, teller);
            return Change::Nothing;
        }
        self.lose(now);
        Change::Lost
    }

    fn leave_alone(&mut self, now: Instant, text: String, teller: &mut Teller<'_>) {
        self.begin(now + RETRY);
        self.condition = Condition::Other;
        if self.told.as_ref() != Some(&text) {
            teller.tell(ModuleEvent::OtherModule(text.clone()));
            self.told = Some(text);
        }
    }

    fn tell_different(&mut self, text: String, teller: &mut Teller<'_>) {
        self.condition = Condition::Different;
        if self.told.as_ref() != Some(&text) {
            teller.tell(ModuleEvent::NotConfigured(text.clone()));
            self.told = Some(text);
        }
    }

    fn place(&self) -> Option<&Item> {
        let (Step::Item(place) | Step::Write(place) | Step::Verify(place)) = self.step else { return None };
        self.plan.get(place)
    }

    /// Goes to a step, past places of the plan where nothing is to be done.
    fn go(&mut self, at: Instant, step: Step) {
        self.due = Some(at);
        self.step = step;
        if let Step::Item(place) = step {
            let stores = self.settings.store && self.unstored && self.round.differences.is_empty();
            match self.plan.get(place) {
                None => self.step = Step::Confirm,
                Some(Item::Store) if !stores => self.go(at, Step::Item(place + 1)),
                Some(Item::Want(_) | Item::Read(_) | Item::Store) => {}
            }
        }
    }
}
