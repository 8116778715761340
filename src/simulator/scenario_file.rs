//! The TOML form of a scenario, strictly read: every problem at once, as `file:line:column`, with a hint.

use std::collections::BTreeMap;
use std::ops::Range;
use std::time::Duration;

use serde::Deserialize;
use toml::Spanned;

use super::control::{Control, KNOCK_LEVEL, Point, TRIP_PULSE};
use super::detcon::DetconSettings;
use super::error::{Problem, SimulatorError};
use super::scenario::{Event, Scenario};
use super::values::{Channel, Tpdo, WireFormat};

/// Nothing repeats faster than this.
const SHORTEST_REPEAT_MS: u64 = 100;
/// Power is off this long unless told.
const POWER_OFF_MS: u64 = 1000;

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct ScenarioFile {
    description: String,
    repeat_ms: Option<Spanned<u64>>,
    #[serde(default)]
    device: DeviceTable,
    #[serde(default)]
    step: Vec<StepTable>,
}

#[derive(Deserialize, Default)]
#[serde(deny_unknown_fields)]
struct DeviceTable {
    cylinders: Option<Spanned<i64>>,
    initialisation_ms: Option<u64>,
    reply_delay_ms: Option<u64>,
    guard_in_boot: Option<bool>,
    event_restarts_period: Option<bool>,
    all_nmt_commands: Option<bool>,
    big_endian_sensor_fields: Option<bool>,
    status_invert_mask: Option<Spanned<i64>>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct StepTable {
    at_ms: u64,
    every_ms: Option<Spanned<u64>>,
    for_ms: Option<Spanned<u64>>,
    #[serde(rename = "do")]
    action: Spanned<ActionTable>,
}

#[derive(Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
enum ActionTable {
    Knock { channel: Spanned<i64>, level: Option<Spanned<i64>> },
    Trip,
    SensorBad(Spanned<i64>),
    PowerCycle,
    MuteGuarding,
    MutePdos(Vec<Spanned<i64>>),
    StuckToggle,
    WrongLength { pdo: Spanned<i64>, dlc: Spanned<i64> },
    SecondMaster,
    Duplicate,
    LateRepliesMs(u64),
    ReservedBits,
    BootLoopMs(u64),
    RefuseStart,
    Set(BTreeMap<Spanned<String>, Spanned<i64>>),
    Clear(Vec<Spanned<String>>),
}

/// What an action does, and what ends it.
#[derive(Default)]
struct Effect {
    begin: Vec<Control>,
    end: Vec<Control>,
    /// How long it lasts unless told; `None` = for good.
    lasts_ms: Option<u64>,
}

impl Scenario {
    /// Reads a scenario; `file` is its name in messages.
    ///
    /// # Errors
    /// All problems of the file.
    pub fn parse(file: &str, text: &str) -> Result<Self, SimulatorError> {
        let mut reader = Reader { file, text, problems: Vec::new() };
        match toml::from_str::<ScenarioFile>(text) {
            Ok(table) => {
                let scenario = reader.scenario(&table);
                reader.problems.sort_by_key(|problem| (problem.line, problem.column));
                if reader.problems.is_empty() {
                    Ok(scenario)
                } else {
                    Err(SimulatorError::Scenario(reader.problems))
                }
            }
            Err(error) => {
                let span = error.span().unwrap_or_default();
                reader.problem(&span, error.message(), "docs/simulator.md shows what a scenario may contain");
                Err(SimulatorError::Scenario(reader.problems))
            }
        }
    }
}

struct Reader<'a> {
    file: &'a str,
    text: &'a str,
    problems: Vec<Problem>,
}

impl Reader<'_> {
    fn problem(&mut self, span: &Range<usize>, message: &str, hint: &str) {
        let before = self.text.get(..span.start).unwrap_or(self.text);
        self.problems.push(Problem {
            file: self.file.to_owned(),
            line: before.matches('\n').count() + 1,
            column: before.rsplit('\n').next().map_or(0, |rest| rest.chars().count()) + 1,
            message: message.to_owned(),
            hint: hint.to_owned(),
        });
    }

    fn scenario(&mut self, table: &ScenarioFile) -> Scenario {
        let repeat = table.repeat_ms.as_ref().and_then(|repeat| self.repeat(repeat));
        Scenario {
            description: table.description.clone(),
            cylinders: table
                .device
                .cylinders
                .as_ref()
                .and_then(|cylinders| self.small(cylinders, "number of cylinders", 0, Channel::COUNT))
                .unwrap_or(16),
            settings: self.settings(&table.device),
            events: table.step.iter().flat_map(|step| self.step(step, repeat)).collect(),
        }
    }

    fn settings(&mut self, table: &DeviceTable) -> DetconSettings {
        let default = DetconSettings::default();
        let mask = table.status_invert_mask.as_ref();
        DetconSettings {
            initialisation: table.initialisation_ms.map_or(default.initialisation, Duration::from_millis),
            reply_delay: table.reply_delay_ms.map_or(default.reply_delay, Duration::from_millis),
            guard_in_boot: table.guard_in_boot.unwrap_or(default.guard_in_boot),
            event_restarts_period: table.event_restarts_period.unwrap_or(default.event_restarts_period),
            all_nmt_commands: table.all_nmt_commands.unwrap_or(default.all_nmt_commands),
            format: WireFormat {
                big_endian_sensor_fields: table.big_endian_sensor_fields.unwrap_or_default(),
                status_invert_mask: mask
                    .and_then(|mask| self.small(mask, "status mask", 0, 255))
                    .unwrap_or_default(),
                reserved_bits: false,
            },
            stagger: default.stagger,
        }
    }

    fn step(&mut self, step: &StepTable, repeat: Option<u64>) -> Vec<Event> {
        let effect = self.effect(&step.action);
        let every = step.every_ms.as_ref().map_or(repeat, |every| self.repeat(every));
        let lasts = step.for_ms.as_ref().map(|lasts| *lasts.get_ref()).or(effect.lasts_ms);
        let span = step.for_ms.as_ref().map_or_else(|| step.action.span(), Spanned::span);
        if step.for_ms.is_some() && effect.end.is_empty() && effect.lasts_ms.is_none() {
            self.problem(&span, "this action does not last", "leave `for_ms` out");
        }
        if let (Some(lasts), Some(every)) = (lasts, every)
            && lasts >= every
        {
            let message = format!("the action lasts {lasts} ms and comes again after {every} ms");
            self.problem(&span, &message, "let it end before it comes again");
        }
        let mut begin = effect.begin;
        if let [Control::Trip(pulse)] = begin.as_mut_slice() {
            *pulse = lasts.map_or(*pulse, Duration::from_millis);
        }
        let event = |at: u64| {
            move |control| Event {
                at: Duration::from_millis(at),
                every: every.map(Duration::from_millis),
                control,
            }
        };
        let end = lasts.map(|lasts| effect.end.into_iter().map(event(step.at_ms.saturating_add(lasts))));
        begin.into_iter().map(event(step.at_ms)).chain(end.into_iter().flatten()).collect()
    }

    fn effect(&mut self, action: &Spanned<ActionTable>) -> Effect {
        let switch = |control: fn(bool) -> Control| Effect {
            begin: vec![control(true)],
            end: vec![control(false)],
            lasts_ms: None,
        };
        let optional = |control: fn(Option<Duration>) -> Control, millis: u64| Effect {
            begin: vec![control(Some(Duration::from_millis(millis)))],
            end: vec![control(None)],
            lasts_ms: None,
        };
        match action.get_ref() {
            ActionTable::Knock { channel, level } => self.knock(channel, level.as_ref()),
            ActionTable::Trip => Effect {
                begin: vec![Control::Trip(TRIP_PULSE)],
                end: Vec::new(),
                lasts_ms: Some(u64::try_from(TRIP_PULSE.as_millis()).unwrap_or_default()),
            },
            ActionTable::SensorBad(channel) => self
                .channel(channel)
                .map(|channel| pair(Control::SensorBad(channel, true), Control::SensorBad(channel, false)))
                .unwrap_or_default(),
            ActionTable::PowerCycle => {
                Effect { lasts_ms: Some(POWER_OFF_MS), ..pair(Control::Power(false), Control::Power(true)) }
            }
            ActionTable::MuteGuarding => switch(Control::MuteGuarding),
            ActionTable::MutePdos(numbers) => self.mute_pdos(numbers),
            ActionTable::StuckToggle => switch(Control::StuckToggle),
            ActionTable::WrongLength { pdo, dlc } => {
                let (tpdo, dlc) = (self.tpdo(pdo), self.small(dlc, "DLC", 0, 8));
                tpdo.map(|tpdo| pair(Control::WrongLength(tpdo, dlc), Control::WrongLength(tpdo, None)))
                    .unwrap_or_default()
            }
            ActionTable::SecondMaster => switch(Control::SecondMaster),
            ActionTable::Duplicate => switch(Control::Duplicate),
            ActionTable::LateRepliesMs(millis) => optional(Control::LateReplies, *millis),
            ActionTable::ReservedBits => switch(Control::ReservedBits),
            ActionTable::BootLoopMs(millis) => optional(Control::BootLoop, *millis),
            ActionTable::RefuseStart => switch(Control::RefuseStart),
            ActionTable::Set(values) => self.set(values),
            ActionTable::Clear(names) => self.clear(names),
        }
    }

    fn knock(&mut self, channel: &Spanned<i64>, level: Option<&Spanned<i64>>) -> Effect {
        let channel = self.channel(channel);
        let level = level.and_then(|level| self.small(level, "raw intensity", 0, 255)).unwrap_or(KNOCK_LEVEL);
        channel
            .map(|channel| pair(Control::Knock(channel, Some(level)), Control::Knock(channel, None)))
            .unwrap_or_default()
    }

    fn mute_pdos(&mut self, numbers: &[Spanned<i64>]) -> Effect {
        let tpdos: Vec<Tpdo> = numbers.iter().filter_map(|number| self.tpdo(number)).collect();
        let mute = |on| tpdos.iter().map(|tpdo| Control::MutePdo(Some(*tpdo), on)).collect();
        Effect { begin: mute(true), end: mute(false), lasts_ms: None }
    }

    fn set(&mut self, values: &BTreeMap<Spanned<String>, Spanned<i64>>) -> Effect {
        let mut effect = Effect::default();
        for (name, raw) in values {
            let point = self.point(name);
            let raw = self.small(raw, "raw value", 0, 255);
            if let (Some(point), Some(raw)) = (point, raw) {
                effect.begin.push(Control::Set(point, raw));
                effect.end.push(Control::Clear(point));
            }
        }
        effect
    }

    fn clear(&mut self, names: &[Spanned<String>]) -> Effect {
        let mut effect = Effect::default();
        for name in names {
            if name.get_ref() == "all" {
                effect.begin.push(Control::ClearAll);
            } else if let Some(point) = self.point(name) {
                effect.begin.push(Control::Clear(point));
            }
        }
        effect
    }

    fn point(&mut self, name: &Spanned<String>) -> Option<Point> {
        let point = Point::parse(name.get_ref());
        point.map_err(|message| self.problem(&name.span(), &message, "")).ok()
    }

    fn channel(&mut self, number: &Spanned<i64>) -> Option<Channel> {
        self.small(number, "channel", 1, Channel::COUNT).and_then(Channel::new)
    }

    fn tpdo(&mut self, number: &Spanned<i64>) -> Option<Tpdo> {
        self.small(number, "TPDO", 1, 4).and_then(Tpdo::from_number)
    }

    fn small(&mut self, number: &Spanned<i64>, what: &str, low: u8, high: u8) -> Option<u8> {
        let value = u8::try_from(*number.get_ref()).ok().filter(|value| (low..=high).contains(value));
        if value.is_none() {
            let message = format!("{} is not a {what}", number.get_ref());
            self.problem(&number.span(), &message, &format!("give a number from {low} to {high}"));
        }
        value
    }

    fn repeat(&mut self, millis: &Spanned<u64>) -> Option<u64> {
        let value = *millis.get_ref();
        if value < SHORTEST_REPEAT_MS {
            let message = format!("{value} ms is too short a time to repeat");
            self.problem(&millis.span(), &message, &format!("give at least {SHORTEST_REPEAT_MS}"));
            return None;
        }
        Some(value)
    }
}

fn pair(begin: Control, end: Control) -> Effect {
    Effect { begin: vec![begin], end: vec![end], lasts_ms: None }
}
