//! Tests of the alarm list: delays, chatter, suppression, first-out; and a model to compare it with.

use proptest::prelude::*;

use super::fixture::{Builder, spec};
use super::{AcknowledgeError, AlarmList};
use crate::process_image::{AlarmIndex, AlarmState, Value};
use crate::time::Now;

fn list<const N: usize>(specs: [Builder; N]) -> AlarmList {
    AlarmList::new(specs.into_iter().map(Builder::build).collect())
}

fn at(millis: u64) -> Now {
    Now::from_millis(1000 + millis)
}

fn set(list: &mut AlarmList, millis: u64, alarm: usize, holds: bool) {
    list.set_condition(at(millis), AlarmIndex(alarm), holds, None);
}

/// What changed until now, as `time alarm from>to` with a star for first-out.
fn changes(list: &mut AlarmList) -> Vec<String> {
    std::iter::from_fn(|| list.poll_output())
        .map(|change| {
            let star = if change.status.first_out { "*" } else { "" };
            let millis = change.at.instant.as_millis() - 1000;
            assert_eq!(change.at, at(millis));
            assert_eq!(change.status.since, Some(change.at.utc));
            format!("{millis} {} {}>{}{star}", change.alarm.0, letter(change.from), letter(change.to))
        })
        .collect()
}

fn run(list: &mut AlarmList, until: u64) -> Vec<String> {
    let mut all = changes(list);
    while let Some(due) = list.poll_timeout().filter(|due| *due <= at(until).instant) {
        list.handle_timeout(Now::from_millis(due.as_millis()));
        all.extend(changes(list));
    }
    all
}

fn letter(state: AlarmState) -> char {
    char::from(b'A' + u8::try_from(state.code()).unwrap())
}

#[test]
fn an_alarm_is_raised_after_its_on_delay_and_returns_after_its_off_delay() {
    let mut list = list([spec().delays(500, 2000)]);
    set(&mut list, 0, 0, true);
    assert_eq!(run(&mut list, 499), Vec::<String>::new());
    assert_eq!(run(&mut list, 600), ["500 0 A>B"]);
    set(&mut list, 700, 0, false);
    set(&mut list, 2000, 0, true);
    set(&mut list, 2100, 0, false);
    assert_eq!(run(&mut list, 4099), Vec::<String>::new(), "a gap shorter than the off-delay does not count");
    assert_eq!(run(&mut list, 5000), ["4100 0 B>D"]);
    set(&mut list, 5000, 0, true);
    set(&mut list, 5499, 0, false);
    assert_eq!(run(&mut list, 9000), Vec::<String>::new(), "shorter than the on-delay");
}

#[test]
fn telling_the_same_again_does_not_restart_a_delay() {
    let mut list = list([spec().delays(500, 500)]);
    for millis in (0..=400).step_by(100) {
        set(&mut list, millis, 0, true);
    }
    assert_eq!(run(&mut list, 500), ["500 0 A>B"]);
}

#[test]
fn an_edge_longer_than_the_delay_counts_even_if_nobody_looked_meanwhile() {
    let mut list = list([spec().delays(100, 50)]);
    set(&mut list, 0, 0, true);
    set(&mut list, 200, 0, false);
    set(&mut list, 300, 0, true);
    set(&mut list, 350, 0, false);
    assert_eq!(changes(&mut list), ["100 0 A>B", "250 0 B>D"]);
    assert_eq!(list.status(AlarmIndex(0)).unwrap().count, 1);
}

#[test]
fn a_pulse_of_no_length_is_latched() {
    let mut list = list([spec().latch(true)]);
    set(&mut list, 0, 0, true);
    set(&mut list, 0, 0, false);
    assert_eq!(changes(&mut list), ["0 0 A>B", "0 0 B>E"]);
    set(&mut list, 0, 0, true);
    set(&mut list, 0, 0, false);
    set(&mut list, 0, 0, true);
    assert_eq!(changes(&mut list), ["0 0 E>B"], "and has not ended when it begins again at once");
}

#[test]
fn a_latching_alarm_stays_until_it_is_acknowledged_and_reset() {
    let mut list = list([spec().latch(true)]);
    set(&mut list, 0, 0, true);
    set(&mut list, 100, 0, false);
    assert!(!list.reset(at(200), AlarmIndex(0)), "not acknowledged");
    assert_eq!(list.acknowledge(at(200), AlarmIndex(0)), Ok(()));
    assert!(list.reset(at(300), AlarmIndex(0)));
    assert_eq!(changes(&mut list), ["0 0 A>B", "100 0 B>E", "200 0 E>F", "300 0 F>A"]);
}

#[test]
fn acknowledging_what_does_not_wait_for_it_is_an_error() {
    let mut list = list([spec(), spec(), spec()]);
    let error = Err(AcknowledgeError::NothingToAcknowledge);
    assert_eq!(list.acknowledge(at(0), AlarmIndex(0)), error);
    assert_eq!(list.acknowledge(at(0), AlarmIndex(3)), Err(AcknowledgeError::Unknown));
    set(&mut list, 1, 0, true);
    set(&mut list, 1, 2, true);
    assert_eq!(list.acknowledge_all(at(1), (0..4).map(AlarmIndex)), 2);
    assert_eq!(list.acknowledge(at(1), AlarmIndex(0)), error);
}

#[test]
fn the_value_that_raised_an_alarm_stays_with_it() {
    let mut list = list([spec().delays(100, 0)]);
    for (millis, value) in [(0, 1), (50, 2), (150, 3)] {
        list.set_condition(at(millis), AlarmIndex(0), true, Some(Value::Unsigned(value)));
        run(&mut list, millis);
    }
    assert_eq!(list.status(AlarmIndex(0)).unwrap().value, Some(Value::Unsigned(2)));
}

#[test]
fn a_value_that_takes_the_place_of_another_is_shown_while_the_condition_holds() {
    let mut list = list([spec().delays(100, 500)]);
    let alarm = AlarmIndex(0);
    let shown = |list: &AlarmList| list.status(alarm).unwrap().value;
    list.set_condition(at(0), alarm, true, Some(Value::Unsigned(1)));
    assert!(!list.set_value(alarm, Value::Unsigned(2)), "it is not raised yet");
    run(&mut list, 100);
    assert_eq!(shown(&list), Some(Value::Unsigned(2)));
    assert!(list.set_value(alarm, Value::Unsigned(3)));
    assert!(!list.set_value(alarm, Value::Unsigned(3)), "no news");
    set(&mut list, 200, 0, false);
    run(&mut list, 700);
    assert_eq!(shown(&list), Some(Value::Unsigned(3)), "what was there last");
    list.set_condition(at(800), alarm, true, Some(Value::Unsigned(4)));
    assert!(!list.set_value(alarm, Value::Unsigned(4)));
    assert_eq!(shown(&list), Some(Value::Unsigned(3)), "until it is raised again");
    run(&mut list, 900);
    assert_eq!(shown(&list), Some(Value::Unsigned(4)));
    assert!(!list.set_value(AlarmIndex(7), Value::Unsigned(1)), "there is no such alarm");
}

#[test]
fn an_alarm_that_is_raised_without_a_value_shows_none_of_the_time_before() {
    let mut list = list([spec()]);
    list.set_condition(at(0), AlarmIndex(0), true, Some(Value::Unsigned(1)));
    run(&mut list, 0);
    set(&mut list, 100, 0, false);
    set(&mut list, 200, 0, true);
    run(&mut list, 200);
    assert_eq!(list.status(AlarmIndex(0)).unwrap().value, None);
}

#[test]
fn an_alarm_that_chatters_is_held_until_it_is_quiet_for_a_minute() {
    let mut list = list([spec().delays(0, 500)]);
    for raise in 0..3 {
        set(&mut list, 10_000 * raise, 0, true);
        set(&mut list, 10_000 * raise + 1_000, 0, false);
    }
    let raised = run(&mut list, 79_000);
    assert_eq!(raised, ["0 0 A>B", "1500 0 B>D", "10000 0 D>B", "11500 0 B>D", "20000 0 D>B"]);
    set(&mut list, 79_500, 0, true);
    set(&mut list, 80_000, 0, false);
    assert_eq!(run(&mut list, 150_000), ["140000 0 B>D"], "a minute after the last");
    set(&mut list, 150_000, 0, true);
    set(&mut list, 151_000, 0, false);
    assert_eq!(run(&mut list, 200_000), ["150000 0 D>B", "151500 0 B>D"], "then as ever");
}

#[test]
fn an_alarm_that_is_raised_twice_in_a_minute_or_three_times_in_more_does_not_chatter() {
    let mut list = list([spec().delays(0, 500)]);
    let mut count = 0;
    for raise in 0..20 {
        set(&mut list, 31_000 * raise, 0, true);
        set(&mut list, 31_000 * raise + 1_000, 0, false);
        count += run(&mut list, 31_000 * raise + 2_000).len();
    }
    assert_eq!(count, 40);
}

#[test]
fn the_third_pulse_of_no_length_within_a_minute_is_held_too() {
    let mut list = list([spec()]);
    for pulse in 0..3 {
        set(&mut list, 1_000 * pulse, 0, true);
        set(&mut list, 1_000 * pulse, 0, false);
    }
    let held = ["0 0 A>B", "0 0 B>D", "1000 0 D>B", "1000 0 B>D", "2000 0 D>B", "62000 0 B>D"];
    assert_eq!(run(&mut list, 100_000), held);
}

/// A bus, a node on it, a TPDO of the node.
fn chain() -> AlarmList {
    list([spec(), spec().suppressed_by(&[0]), spec().suppressed_by(&[0, 1])])
}

#[test]
fn one_cause_raises_one_alarm_in_whatever_order_they_are_told_of() {
    for order in [[0, 1, 2], [2, 1, 0], [1, 0, 2], [1, 2, 0]] {
        let mut list = chain();
        for alarm in order {
            set(&mut list, 0, alarm, true);
        }
        assert_eq!(changes(&mut list), ["0 0 A>B", "0 1 A>H", "0 2 A>H"], "{order:?}");
        for alarm in order {
            set(&mut list, 100, alarm, false);
        }
        assert_eq!(changes(&mut list), ["100 2 H>A", "100 1 H>A", "100 0 B>D"], "{order:?}");
    }
}

#[test]
fn a_consequence_whose_cause_comes_within_its_on_delay_is_never_raised() {
    let mut list = list([spec(), spec().delays(1500, 0).suppressed_by(&[0])]);
    set(&mut list, 0, 1, true);
    set(&mut list, 1500, 0, true);
    assert_eq!(run(&mut list, 5000), ["1500 0 A>B", "1500 1 A>H"]);
}

#[test]
fn a_consequence_that_was_raised_already_is_suppressed_and_keeps_what_nobody_acknowledged() {
    let mut list = chain();
    set(&mut list, 0, 2, true);
    assert_eq!(changes(&mut list), ["0 2 A>B"]);
    set(&mut list, 100, 1, true);
    assert_eq!(changes(&mut list), ["100 1 A>B", "100 2 B>H"]);
    assert_eq!(list.acknowledge(at(100), AlarmIndex(2)), Err(AcknowledgeError::NothingToAcknowledge));
    set(&mut list, 200, 2, false);
    set(&mut list, 300, 1, false);
    assert_eq!(changes(&mut list), ["300 1 B>D", "300 2 H>D"]);
}

#[test]
fn what_still_holds_when_its_last_cause_goes_is_raised_at_once_and_counted_once() {
    let mut list = chain();
    set(&mut list, 0, 0, true);
    set(&mut list, 0, 1, true);
    set(&mut list, 10, 2, true);
    set(&mut list, 100, 0, false);
    assert_eq!(changes(&mut list), ["0 0 A>B", "0 1 A>H", "10 2 A>H", "100 0 B>D", "100 1 H>B"]);
    set(&mut list, 200, 1, false);
    assert_eq!(changes(&mut list), ["200 1 B>D", "200 2 H>B"]);
    assert_eq!([0, 1, 2].map(|alarm| list.status(AlarmIndex(alarm)).unwrap().count), [1, 1, 1]);
}

#[test]
fn a_suppressed_alarm_counts() {
    let mut list = chain();
    set(&mut list, 0, 0, true);
    for pulse in 1..=3 {
        set(&mut list, 100_000 * pulse, 1, true);
        set(&mut list, 100_000 * pulse + 5, 1, false);
    }
    assert_eq!(changes(&mut list).len(), 7);
    assert_eq!(list.status(AlarmIndex(1)).unwrap().count, 3);
}

#[test]
fn what_a_suppressed_alarm_counts_is_told_though_nothing_else_of_it_changes() {
    let mut list = chain();
    set(&mut list, 0, 0, true);
    set(&mut list, 0, 1, true);
    run(&mut list, 1);
    assert!(list.take_counted() && !list.take_counted());
    set(&mut list, 2, 1, false);
    run(&mut list, 3);
    assert!(!list.take_counted());
    set(&mut list, 4, 1, true);
    run(&mut list, 5);
    let status = list.status(AlarmIndex(1)).unwrap();
    assert_eq!((status.state, status.count, list.take_counted()), (AlarmState::Suppressed, 2, true));
}

#[test]
fn the_first_alarm_of_a_quiet_group_is_marked_and_ties_are_shown() {
    let mut list = list([spec().first_out(7), spec().first_out(7), spec().first_out(7), spec().first_out(8)]);
    set(&mut list, 0, 1, true);
    assert_eq!(changes(&mut list), ["0 1 A>B*"]);
    set(&mut list, 1, 0, true);
    set(&mut list, 1, 3, true);
    assert_eq!(changes(&mut list), ["1 0 A>B", "1 3 A>B*"]);
    set(&mut list, 2, 1, false);
    assert_eq!(changes(&mut list), ["2 1 B>D*"], "the group is not quiet yet");
    set(&mut list, 3, 0, false);
    assert_eq!(changes(&mut list), ["3 0 B>D"]);
    set(&mut list, 4, 0, true);
    set(&mut list, 4, 2, true);
    assert_eq!(changes(&mut list), ["4 0 D>B*", "4 2 A>B*"]);
    assert!(!list.status(AlarmIndex(1)).unwrap().first_out, "the mark of the time before is gone");
}

#[test]
fn a_latched_alarm_keeps_its_group_from_being_quiet() {
    let mut list = list([spec().first_out(1).latch(true), spec().first_out(1)]);
    set(&mut list, 0, 0, true);
    set(&mut list, 1, 0, false);
    set(&mut list, 2, 1, true);
    assert_eq!(changes(&mut list), ["0 0 A>B*", "1 0 B>E*", "2 1 A>B"]);
}

#[test]
fn transitions_that_nobody_fetches_are_bounded() {
    let mut list = list([spec()]);
    for minute in 0..1000 {
        set(&mut list, 60_000 * minute, 0, minute % 2 == 0);
        list.handle_timeout(at(60_000 * minute));
    }
    let left = changes(&mut list);
    assert_eq!(left.len(), 8);
    assert_eq!(left.last().unwrap(), "59940000 0 B>D");
}

#[test]
fn alarms_that_do_not_exist_are_ignored() {
    let mut list = list([]);
    set(&mut list, 0, 5, true);
    assert!(!list.reset(at(0), AlarmIndex(5)));
    assert!(list.status(AlarmIndex(5)).is_none());
    assert_eq!(list.poll_timeout(), None);
}

/// What an operator or the plant does.
#[derive(Clone, Copy, Debug)]
enum Act {
    Condition(usize, bool),
    Acknowledge(usize),
    Reset(usize),
}

fn any_act() -> impl Strategy<Value = Act> {
    let alarm = 0_usize..3;
    prop_oneof![
        8 => (alarm.clone(), any::<bool>()).prop_map(|(alarm, holds)| Act::Condition(alarm, holds)),
        2 => alarm.clone().prop_map(Act::Acknowledge),
        1 => alarm.prop_map(Act::Reset),
    ]
}

/// The model's unit of time, in ms: so long that a minute is a few of them, and alarms can chatter and be quiet again.
const TICK: u64 = 10_000;
/// A minute.
const CHATTER: u64 = 6;

/// One alarm as a naive reader of the rules would write it: looked at once in every tick.
#[derive(Clone, Debug, Default)]
struct Model {
    on_delay: u64,
    off_delay: u64,
    latch: bool,
    raw: bool,
    raw_since: u64,
    live: bool,
    active: bool,
    acknowledged: bool,
    latched: bool,
    suppressed: bool,
    chatters: bool,
    raises: Vec<u64>,
    ons: u64,
    offs: u64,
}

impl Model {
    fn raise(&mut self) {
        if !self.suppressed {
            (self.active, self.acknowledged, self.latched) = (true, false, false);
        }
    }

    /// Lets the condition take effect once its delay has passed.
    fn follow(&mut self, now: u64, to: bool) {
        let held = if self.chatters { CHATTER } else { 0 };
        let delay = if to { self.on_delay } else { self.off_delay.max(held) };
        if self.raw != to || self.live == to || now < self.raw_since + delay {
            return;
        }
        self.live = to;
        if to {
            self.ons += 1;
            self.raises.push(now);
            let lately = self.raises.iter().filter(|at| now - **at <= CHATTER).count();
            self.chatters = lately >= 3;
            self.raise();
        } else {
            self.offs += 1;
            if self.chatters {
                self.raises.clear();
            }
            self.chatters = false;
            if self.active {
                self.latched = self.latch;
                self.active = false;
            }
        }
    }

    fn nothing_remembered(&self) -> bool {
        !self.active && !self.latched && self.acknowledged
    }

    fn state(&self) -> AlarmState {
        match (self.active, self.latched, self.acknowledged) {
            _ if self.suppressed && (self.live || !self.nothing_remembered()) => AlarmState::Suppressed,
            (true, _, false) => AlarmState::Unacknowledged,
            (true, _, true) => AlarmState::Acknowledged,
            (false, true, false) => AlarmState::LatchedUnacknowledged,
            (false, true, true) => AlarmState::LatchedAcknowledged,
            (false, false, false) => AlarmState::ReturnedUnacknowledged,
            (false, false, true) => AlarmState::Normal,
        }
    }
}

const CAUSES: [&[usize]; 3] = [&[], &[0], &[0, 1]];

/// Suppression follows the causes; what comes free and holds is raised.
fn suppress(models: &mut [Model; 3]) {
    for place in 0..3 {
        let suppressed = CAUSES[place].iter().any(|cause| models[*cause].live);
        let freed = models[place].suppressed && !suppressed;
        models[place].suppressed = suppressed;
        if freed && models[place].live {
            models[place].raise();
        }
    }
}

fn settle(models: &mut [Model; 3], now: u64) {
    for place in 0..3 {
        models[place].follow(now, true);
        suppress(models);
    }
    for place in (0..3).rev() {
        models[place].follow(now, false);
        suppress(models);
    }
}

fn act(models: &mut [Model; 3], now: u64, act: Act) {
    match act {
        Act::Condition(place, holds) => {
            let model = &mut models[place];
            if model.raw != holds {
                (model.raw, model.raw_since) = (holds, now);
            }
        }
        Act::Acknowledge(place) => {
            let model = &mut models[place];
            model.acknowledged |= !model.suppressed;
        }
        Act::Reset(place) => {
            let model = &mut models[place];
            model.latched &= model.active || model.suppressed || !model.acknowledged;
        }
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(2000))]

    #[test]
    fn the_list_does_what_the_rules_say(
        delays in prop::array::uniform3((0_u64..4, 0_u64..9, any::<bool>())),
        acts in prop::collection::vec(prop::option::of(any_act()), 1..150),
    ) {
        let mut models = delays.map(|(on_delay, off_delay, latch)| {
            Model { on_delay, off_delay, latch, acknowledged: true, ..Model::default() }
        });
        let specs = delays.iter().zip(CAUSES).map(|(&(on, off, latch), causes)| {
            spec().delays(on * TICK, off * TICK).latch(latch).suppressed_by(causes).build()
        });
        let mut list = AlarmList::new(specs.collect());
        let mut shown = [AlarmState::Normal; 3];
        for (tick, step) in (0_u64..).zip(&acts) {
            let now = at(tick * TICK);
            settle(&mut models, tick);
            list.handle_timeout(now);
            if let Some(step) = step {
                match *step {
                    Act::Condition(alarm, holds) => list.set_condition(now, AlarmIndex(alarm), holds, None),
                    Act::Acknowledge(alarm) => drop(list.acknowledge(now, AlarmIndex(alarm))),
                    Act::Reset(alarm) => drop(list.reset(now, AlarmIndex(alarm))),
                }
                act(&mut models, tick, *step);
            }
            settle(&mut models, tick);
            while let Some(change) = list.poll_output() {
                prop_assert_eq!(std::mem::replace(&mut shown[change.alarm.0], change.to), change.from);
                prop_assert_ne!(change.from, change.to);
            }
            for (place, model) in models.iter().enumerate() {
                let status = list.status(AlarmIndex(place)).unwrap();
                prop_assert_eq!(status.state, model.state(), "alarm {} at {}", place, tick);
                prop_assert_eq!(shown[place], status.state);
                prop_assert_eq!(status.count, model.ons);
                prop_assert!(model.ons - model.offs <= 1);
            }
        }
    }
}
