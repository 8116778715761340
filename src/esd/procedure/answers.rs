//! What an answer of the module means for the step that asked, and what was found in the end.

use std::time::Duration;

use super::{Procedure, RETRY};
use crate::esd::answer::Answer;
use crate::esd::event::ModuleEvent;
use crate::esd::init_frame::Request;
use crate::esd::outputs::Teller;
use crate::esd::parameters::FIRST_TX_DELAY;
use crate::esd::plan::Item;
use crate::esd::status::CanStatus;
use crate::esd::step::{Change, Condition, Step};
use crate::time::Instant;

/// How often the status bits are cleared before they are said to stay (R-ESD-077).
const MOST_CLEARS: u8 = 3;
/// Identifier and time of a watchdog.
const GUARDS: u8 = 2;
/// The letter of a firmware that speaks CAL/CMS (R-ESD-005).
const CMS: char = 'C';

impl Procedure {
    /// The answer to what was asked last.
    pub(in crate::esd) fn handle_answer(
        &mut self,
        now: Instant,
        answer: Answer,
        teller: &mut Teller<'_>,
    ) -> Change {
        self.misses = 0;
        self.is_mute = false;
        self.silent_until = None;
        if let Answer::Status(status) = answer {
            if self.handle_status(now, status, teller) {
                return Change::Restarted;
            }
            if let Step::Status(times) = self.step {
                self.judge_status(now, times, status, teller);
            } else if self.step == Step::Confirm {
                return self.finish(now, teller);
            } else {
                self.watch(now, status);
            }
            return Change::Nothing;
        }
        match (self.step, answer) {
            (Step::Kind, Answer::ModuleType(code)) => teller.tell(ModuleEvent::Kind(code)),
            (Step::Switch, Answer::Switch(value)) => teller.tell(ModuleEvent::Switch(value)),
            _ => {}
        }
        match (self.step, answer) {
            (Step::Seek, _) => match self.unanswered.take() {
                Some(step) => return self.pass_over(now, step, teller),
                None => self.begin_round(now, Step::Kind),
            },
            (Step::Kind, found)
                if found == Answer::ModuleType(self.kind.code()) || !self.settings.check_kind =>
            {
                self.go(now, Step::Software);
            }
            (Step::Kind, found) => {
                let (number, code, model) = (self.number, self.kind.code(), self.kind.model());
                let text = format!("module {number} has the type {found}; a {model} has 0x{code:02X}");
                self.leave_alone(now, text, teller);
            }
            (Step::Software, Answer::Software(revision)) if revision.protocol() == CMS => {
                let text = format!(
                    "module {} has the firmware {revision}, which speaks CAL/CMS and not the esd protocol",
                    self.number
                );
                self.leave_alone(now, text, teller);
            }
            (Step::Software, _) => {
                self.go(now, self.after_software());
            }
            (Step::Switch, found) => {
                if let Some(wanted) = self.settings.switch.filter(|wanted| found != Answer::Switch(*wanted)) {
                    self.round.differences.push(format!(
                        "coding switch of module {} is {found}, wanted is 0x{wanted:02X}",
                        self.number
                    ));
                }
                self.go(now, Step::Status(0));
            }
            (Step::Item(place) | Step::Verify(place), found) => self.compare(now, place, found),
            // It does not know the question for its status.
            (Step::Confirm, _) => return self.finish(now, teller),
            (Step::Status(_), _) => {
                self.round.differences.push(format!("module {} does not tell its status", self.number));
                self.go(now, Step::Item(0));
            }
            (Step::Watch | Step::Clear(_) | Step::Write(_), _) => {
                let retry = self.retry.is_some_and(|at| at <= now);
                self.go(now + self.settings.status_period, if retry { Step::Seek } else { Step::Watch });
            }
        }
        Change::Nothing
    }

    /// It is there and does not answer one question, perhaps as its firmware answers that in another form: that is told, and
    /// the rest is done.
    fn pass_over(&mut self, now: Instant, step: Step, teller: &mut Teller<'_>) -> Change {
        if step != Step::Kind || self.settings.check_kind {
            let what = step.asks_for(&self.plan);
            self.round
                .differences
                .push(format!("module {} does not answer the question for its {what}", self.number));
        }
        let next = match step {
            Step::Kind => Step::Software,
            Step::Software => self.after_software(),
            Step::Switch => Step::Status(0),
            Step::Item(place) | Step::Verify(place) | Step::Write(place) => Step::Item(place + 1),
            Step::Status(_) | Step::Clear(_) => {
                self.hides_status = true;
                Step::Item(0)
            }
            Step::Confirm | Step::Seek | Step::Watch => {
                self.hides_status = true;
                return self.finish(now, teller);
            }
        };
        self.go(now, next);
        Change::Nothing
    }

    fn after_software(&self) -> Step {
        if self.settings.switch.is_some() { Step::Switch } else { Step::Status(0) }
    }

    /// A status byte, at whatever step. `true`: the module started anew.
    fn handle_status(&mut self, now: Instant, status: CanStatus, teller: &mut Teller<'_>) -> bool {
        let before = self.status.replace(status);
        if before != Some(status) {
            teller.tell(ModuleEvent::Status(status));
        }
        self.suspended = status.is_suspended();
        if !status.had_can_error() {
            self.error_stays = None;
        }
        if !status.is_new_on_bus() {
            self.cleared = true;
        } else if std::mem::take(&mut self.cleared) {
            teller.tell(ModuleEvent::Restarted);
            self.begin(now);
            self.condition = Condition::Unknown;
            self.guarded = false;
            self.told = None;
            self.start(now);
            self.unstored = false;
            return true;
        } else if self.condition == Condition::Unknown && self.started.is_none() {
            self.start(now);
        }
        false
    }

    /// It started not long before now.
    fn start(&mut self, now: Instant) {
        self.started = Some(now);
        self.first_tx_delay = None;
    }

    /// The status before the comparing.
    fn judge_status(&mut self, now: Instant, times: u8, status: CanStatus, teller: &mut Teller<'_>) {
        let is_set = status.is_new_on_bus() || status.had_can_error();
        if is_set && times < MOST_CLEARS {
            return self.go(now, Step::Clear(times + 1));
        }
        if status.is_new_on_bus() {
            let text =
                format!("bit 7 of the status of module {} stays set though it was cleared", self.number);
            self.round.differences.push(text);
        }
        if status.had_can_error() {
            if self.error_stays.is_none() {
                teller.tell(ModuleEvent::CanErrorStays);
            }
            self.error_stays = Some(now + RETRY);
        }
        self.go(now, Step::Item(0));
    }

    /// What was found at a place of the plan.
    fn compare(&mut self, now: Instant, place: usize, found: Answer) {
        let delay = self.next().and_then(|(_, request)| request) == Some(Request::Parameter(FIRST_TX_DELAY));
        if let (true, Answer::Value(millis)) = (delay, found) {
            self.first_tx_delay = self.first_tx_delay.max(Some(Duration::from_millis(u64::from(millis))));
        }
        let verifies = matches!(self.step, Step::Verify(_));
        match self.plan.get(place) {
            Some(Item::Want(want)) if want.is_met(found) => {
                if verifies && want.is_parameter {
                    self.round.written += 1;
                }
                self.round.guards += u8::from(!want.is_parameter);
                if want.request == Request::WatchdogTime {
                    self.watchdog_set = true;
                }
            }
            Some(Item::Want(want)) if want.may_be_written && !verifies && found != Answer::Unknown => {
                self.found = Some(found);
                return self.go(now, Step::Write(place));
            }
            Some(Item::Want(want)) => self.round.differences.push(want.difference(self.number, found)),
            Some(Item::Read(_) | Item::Store) | None => {}
        }
        self.go(now, Step::Item(place + 1));
    }

    /// The round is over and the module did not start anew meanwhile.
    fn finish(&mut self, now: Instant, teller: &mut Teller<'_>) -> Change {
        self.go(now + self.settings.status_period, Step::Watch);
        self.guarded = self.round.guards >= GUARDS;
        let differences = std::mem::take(&mut self.round.differences);
        if !differences.is_empty() {
            self.retry = Some(now + RETRY);
            self.tell_different(differences.join("; "), teller);
            return Change::Nothing;
        }
        self.retry = None;
        let news = self.condition != Condition::Good || self.round.written > 0 || self.round.stored;
        self.condition = Condition::Good;
        self.told = None;
        if news {
            teller.tell(ModuleEvent::Configured { written: self.round.written, stored: self.round.stored });
        }
        Change::Configured
    }

    /// A status of the module while it is only looked after.
    fn watch(&mut self, now: Instant, status: CanStatus) {
        let due = |at: Option<Instant>| at.is_some_and(|at| at <= now);
        if due(self.retry) {
            self.go(now, Step::Seek);
        } else if status.had_can_error() && (self.error_stays.is_none() || due(self.error_stays)) {
            // Clearing takes "new on bus" with it: the comparing finds what a start at this moment would have undone.
            self.begin_round(now, Step::Software);
        } else {
            self.due = Some(now + self.settings.status_period);
        }
    }
}
