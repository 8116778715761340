//! All alarms.
//!
//! A condition that changes is only noted; what follows from it is worked out in [`AlarmList::poll_output`] and
//! [`AlarmList::handle_timeout`], for one instant at a time and causes first. So a cause that is told of in the same
//! instant as its consequences suppresses them before they are raised, in whatever order they were told.

mod carry;

use std::cmp::Reverse;
use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::time::Duration;

use super::AlarmSpec;
use super::state::{AlarmEvent, AlarmMachine};
use super::suppression::Suppression;
use crate::process_image::{AlarmIndex, AlarmState, AlarmStatus, Value};
use crate::time::{Instant, Now};

/// An alarm that is raised [`CHATTER_RAISES`] times within this time chatters: from then on its condition must be gone so
/// long before it returns.
const CHATTER: Duration = Duration::from_secs(60);

/// See [`CHATTER`].
const CHATTER_RAISES: usize = 3;

/// An alarm changed its state.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Transition {
    /// Which.
    pub alarm: AlarmIndex,
    /// State before.
    pub from: AlarmState,
    /// State now.
    pub to: AlarmState,
    /// When: the instant at which a delay ran out, also if it was noticed later.
    pub at: Now,
    /// All that readers see of it now (its `revision` is for the gateway to fill in). The marks of first-out of other
    /// alarms of its group may have gone with it.
    pub status: AlarmStatus,
}

/// Why an alarm could not be acknowledged.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum AcknowledgeError {
    /// There is no such alarm.
    #[error("there is no such alarm")]
    Unknown,
    /// Nothing waits for an acknowledgement.
    #[error("the alarm does not wait for an acknowledgement")]
    NothingToAcknowledge,
}

/// All alarms of the gateway.
#[derive(Debug)]
pub struct AlarmList {
    alarms: Vec<Alarm>,
    suppression: Suppression,
    groups: BTreeMap<u32, Group>,
    timers: BTreeSet<Timer>,
    transitions: VecDeque<Transition>,
    /// A count rose that nobody asked for since; that of a suppressed alarm does so without a transition.
    counted: bool,
    /// The latest moment heard of.
    now: Now,
}

#[derive(Debug)]
struct Alarm {
    spec: AlarmSpec,
    machine: AlarmMachine,
    status: AlarmStatus,
    /// Whether the condition holds once all delays that ran out are dealt with.
    holds: bool,
    /// The delay that runs.
    delay: Option<Timer>,
    /// When it was raised the last times before it was quiet for long, the oldest first.
    raised_at: [Option<Instant>; CHATTER_RAISES],
    /// Causes that are active.
    causes: usize,
    /// Value told with the condition.
    value: Option<Value>,
}

/// A first-out group.
#[derive(Debug, Default)]
struct Group {
    members: Vec<usize>,
    active: usize,
    /// When the first was raised.
    since: Instant,
}

/// Something that happens at a time. In one instant conditions that begin come first, causes before consequences; then
/// conditions that end, consequences before causes: what begins and ends with its cause is never raised.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
struct Timer {
    at: Instant,
    what: Expiry,
    alarm: usize,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
enum Expiry {
    On { rank: usize },
    Off { rank: Reverse<usize> },
}

impl AlarmList {
    /// All alarms normal.
    ///
    /// Chains of [`AlarmSpec::suppressed_by`] are to be free of circles; a link that closes one is ignored.
    #[must_use]
    pub fn new(specs: Vec<AlarmSpec>) -> Self {
        let suppression = Suppression::new(&specs);
        let mut groups = BTreeMap::<u32, Group>::new();
        for (place, spec) in specs.iter().enumerate() {
            if let Some(group) = spec.first_out_group {
                groups.entry(group).or_default().members.push(place);
            }
        }
        let alarms = specs.into_iter().map(Alarm::new).collect();
        Self {
            alarms,
            suppression,
            groups,
            timers: BTreeSet::new(),
            transitions: VecDeque::new(),
            counted: false,
            now: Now::default(),
        }
    }

    /// Whether an alarm's condition holds; `value` is the one that decides, where there is one. Cheap when that is known
    /// already. A condition that begins and ends in one instant has held; one that ends and begins has not ended.
    pub fn set_condition(&mut self, now: Now, alarm: AlarmIndex, holds: bool, value: Option<Value>) {
        self.observe(now);
        let place = alarm.0;
        let rank = self.suppression.rank(place);
        let Some(alarm) = self.alarms.get_mut(place) else { return };
        let raised = alarm.delay.is_some_and(|timer| timer.leads_to() && timer.at < now.instant);
        if holds && value.is_some() && !raised {
            alarm.value = value;
        }
        match alarm.delay {
            Some(timer) if timer.leads_to() == holds => return,
            Some(timer) if timer.ran_out_before(now.instant) => alarm.holds = timer.leads_to(),
            Some(timer) => {
                self.timers.remove(&timer);
            }
            None => {}
        }
        alarm.delay = None;
        if alarm.holds != holds {
            let (delay, what) = if holds {
                alarm.value = value;
                (alarm.spec.on_delay, Expiry::On { rank })
            } else {
                (alarm.off_delay(), Expiry::Off { rank: Reverse(rank) })
            };
            let timer = Timer { at: now.instant + delay, what, alarm: place };
            alarm.delay = Some(timer);
            self.timers.insert(timer);
        }
    }

    /// What a condition is about became something else while it holds: an alarm that is raised shows that from now on, one
    /// that waits for its on-delay when it is raised. `true` when the alarm shows something else than before.
    pub fn set_value(&mut self, alarm: AlarmIndex, value: Value) -> bool {
        let Some(alarm) = self.alarms.get_mut(alarm.0) else { return false };
        alarm.value = Some(value);
        alarm.machine.suppresses_others() && alarm.status.value.replace(value) != Some(value)
    }

    /// An operator has seen the alarm.
    pub fn acknowledge(&mut self, now: Now, alarm: AlarmIndex) -> Result<(), AcknowledgeError> {
        self.handle_timeout(now);
        if alarm.0 >= self.alarms.len() {
            Err(AcknowledgeError::Unknown)
        } else if self.apply(now, alarm.0, AlarmEvent::Acknowledge) {
            Ok(())
        } else {
            Err(AcknowledgeError::NothingToAcknowledge)
        }
    }

    /// An operator has seen all of these that wait for it; how many did.
    pub fn acknowledge_all(&mut self, now: Now, alarms: impl IntoIterator<Item = AlarmIndex>) -> usize {
        alarms.into_iter().filter(|alarm| self.acknowledge(now, *alarm).is_ok()).count()
    }

    /// An operator resets a latched, acknowledged alarm. `false` where there is nothing to reset.
    pub fn reset(&mut self, now: Now, alarm: AlarmIndex) -> bool {
        self.handle_timeout(now);
        self.apply(now, alarm.0, AlarmEvent::Reset)
    }

    /// Delays that ran out.
    pub fn handle_timeout(&mut self, now: Now) {
        self.observe(now);
        self.settle(now.instant);
    }

    /// Transitions, in order; call until `None` when all conditions of an instant are told.
    ///
    /// The queue holds as many as there are alarms, eight times over; if nobody calls this, the oldest leave.
    pub fn poll_output(&mut self) -> Option<Transition> {
        self.settle(self.now.instant);
        self.transitions.pop_front()
    }

    /// Whether an alarm was counted since the last call: what [`status`](Self::status) says is other than before.
    pub fn take_counted(&mut self) -> bool {
        std::mem::take(&mut self.counted)
    }

    /// When `handle_timeout` is to be called at the latest.
    #[must_use]
    pub fn poll_timeout(&self) -> Option<Instant> {
        self.timers.first().map(|timer| timer.at)
    }

    /// An alarm as it stands.
    #[must_use]
    pub fn status(&self, alarm: AlarmIndex) -> Option<&AlarmStatus> {
        self.alarms.get(alarm.0).map(|alarm| &alarm.status)
    }

    fn observe(&mut self, now: Now) {
        if now.instant >= self.now.instant {
            self.now = now;
        }
    }

    /// Does what is due, up to and including an instant, in order.
    fn settle(&mut self, until: Instant) {
        while let Some(timer) = self.timers.first().copied().filter(|timer| timer.at <= until) {
            self.timers.remove(&timer);
            let Some(alarm) = self.alarms.get_mut(timer.alarm) else { continue };
            let event = match timer.what {
                Expiry::On { .. } => AlarmEvent::On,
                Expiry::Off { .. } => AlarmEvent::Off,
            };
            if alarm.delay == Some(timer) {
                alarm.delay = None;
                alarm.holds = timer.leads_to();
            }
            self.apply(self.moment(timer.at), timer.alarm, event);
        }
    }

    /// Both clocks at an instant that has passed.
    fn moment(&self, at: Instant) -> Now {
        let ago = i64::try_from(self.now.instant.since(at).as_micros()).unwrap_or(i64::MAX);
        let utc = self.now.utc.as_micros().saturating_sub(ago);
        Now { instant: at, utc: crate::time::Timestamp::from_micros(utc) }
    }

    /// Hands an event to an alarm, and to its consequences what follows for them. `false`: it means nothing.
    fn apply(&mut self, at: Now, place: usize, event: AlarmEvent) -> bool {
        let Some(alarm) = self.alarms.get_mut(place) else { return false };
        let was_cause = alarm.machine.suppresses_others();
        let accepted = alarm.machine.handle(event);
        let is_cause = alarm.machine.suppresses_others();
        if event == AlarmEvent::On && accepted {
            alarm.status.count = alarm.status.count.saturating_add(1);
            self.counted = true;
            alarm.note_raise(at.instant);
            if let Some(timer) = alarm.delay.filter(|timer| alarm.chatters() && !timer.leads_to()) {
                // The condition has ended already, before it was known that the alarm chatters.
                let later =
                    Timer { at: timer.at + alarm.off_delay().saturating_sub(alarm.spec.off_delay), ..timer };
                alarm.delay = Some(later);
                self.timers.remove(&timer);
                self.timers.insert(later);
            }
        } else if event == AlarmEvent::Off && accepted && alarm.chatters() {
            alarm.raised_at = [None; CHATTER_RAISES];
        }
        self.show(at, place);
        if is_cause != was_cause {
            for index in 0.. {
                let Some(consequence) = self.suppression.consequences(place).get(index).copied() else {
                    break;
                };
                self.suppress(at, consequence, is_cause);
            }
        }
        accepted
    }

    /// A cause of an alarm became active, or is active no more.
    fn suppress(&mut self, at: Now, place: usize, active: bool) {
        let Some(alarm) = self.alarms.get_mut(place) else { return };
        alarm.causes = if active { alarm.causes + 1 } else { alarm.causes.saturating_sub(1) };
        let event = if alarm.causes == 0 { AlarmEvent::Unsuppress } else { AlarmEvent::Suppress };
        alarm.machine.handle(event);
        self.show(at, place);
    }

    /// Makes what shows what is.
    fn show(&mut self, at: Now, place: usize) {
        let Some(alarm) = self.alarms.get_mut(place) else { return };
        let (from, to) = (alarm.status.state, alarm.machine.state());
        if from == to {
            return;
        }
        alarm.status.state = to;
        alarm.status.since = Some(at.utc);
        if to == AlarmState::Unacknowledged {
            alarm.status.value = alarm.value;
        }
        if to == AlarmState::Normal {
            alarm.status.first_out = false;
        }
        if let Some(group) = alarm.spec.first_out_group {
            self.regroup(at, place, group, (from, to));
        }
        let Some(status) = self.alarms.get(place).map(|alarm| alarm.status) else { return };
        if self.transitions.len() >= self.alarms.len().saturating_mul(8) {
            self.transitions.pop_front();
        }
        self.transitions.push_back(Transition { alarm: AlarmIndex(place), from, to, at, status });
    }

    /// Keeps a first-out group: who is raised first after all of it was quiet is marked, and who is raised in the same
    /// instant too, since nobody can say which of them came first.
    fn regroup(&mut self, at: Now, place: usize, group: u32, (from, to): (AlarmState, AlarmState)) {
        let Some(group) = self.groups.get_mut(&group) else { return };
        match (from.is_active(), to.is_active()) {
            (false, true) => group.active += 1,
            (true, false) => group.active = group.active.saturating_sub(1),
            (false, false) | (true, true) => return,
        }
        if !to.is_active() {
            return;
        }
        let begins = group.active == 1;
        if begins {
            group.since = at.instant;
            for member in &group.members {
                if let Some(alarm) = self.alarms.get_mut(*member) {
                    alarm.status.first_out = false;
                }
            }
        }
        let first = begins || group.since == at.instant;
        if let Some(alarm) = self.alarms.get_mut(place) {
            alarm.status.first_out |= first;
        }
    }
}

impl Alarm {
    fn new(spec: AlarmSpec) -> Self {
        Self {
            machine: AlarmMachine::new(spec.latch),
            spec,
            status: AlarmStatus::default(),
            holds: false,
            delay: None,
            raised_at: [None; CHATTER_RAISES],
            causes: 0,
            value: None,
        }
    }

    fn note_raise(&mut self, at: Instant) {
        self.raised_at.rotate_left(1);
        if let Some(newest) = self.raised_at.last_mut() {
            *newest = Some(at);
        }
    }

    /// It was raised so often lately that it is held until it is quiet for long.
    fn chatters(&self) -> bool {
        match (self.raised_at.first(), self.raised_at.last()) {
            (Some(Some(oldest)), Some(Some(newest))) => newest.since(*oldest) <= CHATTER,
            _ => false,
        }
    }

    /// How long the condition must be gone before it returns.
    fn off_delay(&self) -> Duration {
        if self.chatters() { self.spec.off_delay.max(CHATTER) } else { self.spec.off_delay }
    }
}

impl Timer {
    /// Whether the condition holds once this delay has run out.
    fn leads_to(self) -> bool {
        matches!(self.what, Expiry::On { .. })
    }

    /// Whether the delay ran out before the opposite was told at `now`.
    fn ran_out_before(self, now: Instant) -> bool {
        self.at < now || self.at == now && self.leads_to()
    }
}
