//! The TOML form of a scenario, strictly read: every problem at once, as `file:line:column`, with a hint.

use std::fmt;
use std::ops::Range;
use std::time::Duration;

use serde::de::{DeserializeOwned, SeqAccess, Visitor};
use serde::{Deserialize, Deserializer};
use toml::Spanned;

use super::cbm_sio;
use super::detcon;
use super::dst_p92c;
use super::error::{Problem, SimulatorError};
use super::kind::{Kind, Settings};
use super::scenario::{Event, Scenario};

/// Nothing repeats faster than this.
const SHORTEST_REPEAT_MS: u64 = 100;

/// The `[device]` table of a kind of device.
pub(super) trait DeviceTable: DeserializeOwned + Default {
    /// What it says; problems are told to the reader.
    fn settings(&self, reader: &mut Reader) -> Settings;
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct ScenarioFile<D: Default> {
    description: String,
    repeat_ms: Option<Spanned<u64>>,
    #[serde(default)]
    device: D,
    #[serde(default)]
    step: Vec<StepTable>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct StepTable {
    at_ms: u64,
    every_ms: Option<Spanned<u64>>,
    for_ms: Option<Spanned<u64>>,
    #[serde(rename = "do")]
    orders: Spanned<Orders>,
}

/// One order or several, each with its place unless it is that of the whole.
#[derive(Default)]
struct Orders(Vec<(Option<Range<usize>>, String)>);

impl<'de> Deserialize<'de> for Orders {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        deserializer.deserialize_any(OrdersVisitor)
    }
}

struct OrdersVisitor;

impl<'de> Visitor<'de> for OrdersVisitor {
    type Value = Orders;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("an order as it would be typed, or a list of them")
    }

    fn visit_str<E>(self, order: &str) -> Result<Orders, E> {
        Ok(Orders(vec![(None, order.to_owned())]))
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut list: A) -> Result<Orders, A::Error> {
        let mut orders = Orders::default();
        while let Some(order) = list.next_element::<Spanned<String>>()? {
            orders.0.push((Some(order.span()), order.into_inner()));
        }
        Ok(orders)
    }
}

impl Scenario {
    /// Reads a scenario for a kind of device; `file` is its name in messages.
    ///
    /// # Errors
    /// All problems of the file.
    pub fn parse(kind: Kind, file: &str, text: &str) -> Result<Self, SimulatorError> {
        let reader = Reader { file, text, problems: Vec::new() };
        match kind {
            Kind::Detcon => reader.read::<detcon::DeviceTable>(),
            Kind::DstP92c => reader.read::<dst_p92c::DeviceTable>(),
            Kind::CbmSio1 => reader.read::<cbm_sio::Sio1Table>(),
            Kind::CbmSio4 => reader.read::<cbm_sio::Sio4Table>(),
        }
    }
}

/// Collects the problems of a file.
pub(super) struct Reader<'a> {
    file: &'a str,
    text: &'a str,
    problems: Vec<Problem>,
}

impl Reader<'_> {
    fn read<D: DeviceTable>(mut self) -> Result<Scenario, SimulatorError> {
        match toml::from_str::<ScenarioFile<D>>(self.text) {
            Ok(table) => {
                let scenario = self.scenario(&table);
                self.problems.sort_by_key(|problem| (problem.line, problem.column));
                if self.problems.is_empty() {
                    Ok(scenario)
                } else {
                    Err(SimulatorError::Scenario(self.problems))
                }
            }
            Err(error) => {
                let span = error.span().unwrap_or_default();
                self.problem(&span, error.message(), "docs/simulator.md shows what a scenario may contain");
                Err(SimulatorError::Scenario(self.problems))
            }
        }
    }

    /// Notes a problem at a place of the file.
    pub(super) fn problem(&mut self, span: &Range<usize>, message: &str, hint: &str) {
        let before = self.text.get(..span.start).unwrap_or(self.text);
        self.problems.push(Problem {
            file: self.file.to_owned(),
            line: before.matches('\n').count() + 1,
            column: before.rsplit('\n').next().map_or(0, |rest| rest.chars().count()) + 1,
            message: message.to_owned(),
            hint: hint.to_owned(),
        });
    }

    /// A number from `low` to `high`; `None` when it is not given, or wrong, which is noted.
    pub(super) fn number<T>(
        &mut self,
        number: Option<&Spanned<i64>>,
        what: &str,
        low: T,
        high: T,
    ) -> Option<T>
    where
        T: TryFrom<i64> + PartialOrd + std::fmt::Display + Copy,
    {
        let number = number?;
        let value = T::try_from(*number.get_ref()).ok().filter(|value| (low..=high).contains(value));
        if value.is_none() {
            let message = format!("{} is not a {what}", number.get_ref());
            self.problem(&number.span(), &message, &format!("give a number from {low} to {high}"));
        }
        value
    }

    fn scenario<D: DeviceTable>(&mut self, table: &ScenarioFile<D>) -> Scenario {
        let repeat = table.repeat_ms.as_ref().and_then(|repeat| self.repeat(repeat));
        let settings = table.device.settings(self);
        let events = table.step.iter().flat_map(|step| self.step(step, &settings, repeat)).collect();
        Scenario { description: table.description.clone(), settings, events }
    }

    fn step(&mut self, step: &StepTable, settings: &Settings, repeat: Option<u64>) -> Vec<Event> {
        let every = step.every_ms.as_ref().map_or(repeat, |every| self.repeat(every));
        let lasts = step.for_ms.as_ref().and_then(|lasts| self.lasts(lasts, every));
        let event = |at: u64, order: String| Event {
            at: Duration::from_millis(at),
            every: every.map(Duration::from_millis),
            order,
        };
        let (mut begin, mut end) = (Vec::new(), Vec::new());
        for (span, order) in &step.orders.get_ref().0 {
            let words: Vec<&str> = order.split_whitespace().collect();
            if let Err(reason) = settings.check(&words) {
                let span = span.clone().unwrap_or_else(|| step.orders.span());
                self.problem(&span, &format!("`{order}` cannot be ordered"), &reason);
                continue;
            }
            begin.push(event(step.at_ms, words.join(" ")));
            let undo = lasts.and_then(|_| settings.kind().undo(&words));
            if let (Some(lasts), Some(undo)) = (lasts, &undo) {
                end.push(event(step.at_ms.saturating_add(lasts), undo.clone()));
            } else if let Some(for_ms) = step.for_ms.as_ref().filter(|_| lasts.is_some()) {
                let message = format!("`{order}` does not last");
                self.problem(&for_ms.span(), &message, "leave `for_ms` out");
            }
        }
        begin.append(&mut end);
        begin
    }

    fn lasts(&mut self, lasts: &Spanned<u64>, every: Option<u64>) -> Option<u64> {
        let millis = *lasts.get_ref();
        if millis == 0 {
            let message = "the step is over at the moment when it begins";
            self.problem(&lasts.span(), message, "give at least 1, or leave `for_ms` out");
            return None;
        }
        if let Some(every) = every.filter(|every| millis >= *every) {
            let message = format!("the step lasts {millis} ms and comes again after {every} ms");
            self.problem(&lasts.span(), &message, "let it end before it comes again");
        }
        Some(millis)
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
