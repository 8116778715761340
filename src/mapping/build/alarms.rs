//! The alarms of gateway, buses and nodes.

use std::collections::{BTreeMap, BTreeSet};
use std::ops::Range;
use std::time::Duration;

use super::super::builtin::{BuiltinAlarm, OF_BUS, OF_GATEWAY, OF_NODE, is_of_module};
use super::super::file::{AlarmSection, IdentitySection};
use super::super::table::{AlarmCondition, AlarmDef, AlarmOwner, BuiltIn};
use super::super::{At, SourceText};
use super::derived::condition;
use super::emergency;
use super::items::{Element, elements, refuse_stride};
use super::node::Tpdo;
use super::order::causes_first;
use super::problems::{Problems, is_snake_case, matched};
use super::tags::Context;
use crate::can::BusIndex;
use crate::canopen::PdoSettings;
use crate::process_image::TagIndex;

/// Longest delay of an alarm, in ms: a day.
const LONGEST_DELAY: u64 = 86_400_000;
/// Most alarms of one node.
const MOST_ALARMS: usize = 1024;

/// The alarms of the gateway and of each bus; with them the table begins.
pub fn of_gateway_and_buses(buses: usize) -> Vec<AlarmDef> {
    let mut alarms: Vec<AlarmDef> =
        OF_GATEWAY.iter().map(|builtin| plain(builtin, AlarmOwner::Gateway)).collect();
    for bus in 0..buses {
        let names = names_of_bus(bus);
        alarms.extend(OF_BUS.iter().map(|builtin| AlarmDef {
            suppressed_by:
                builtin.suppressed_by.iter().filter_map(|name| names.get(*name).copied()).collect(),
            ..plain(builtin, AlarmOwner::Bus(BusIndex(bus)))
        }));
    }
    alarms
}

/// The places of a bus's alarms in the table, by their names.
fn names_of_bus(bus: usize) -> BTreeMap<&'static str, usize> {
    let base = OF_GATEWAY.len() + bus * OF_BUS.len();
    OF_BUS.iter().zip(base..).map(|(builtin, place)| (builtin.name, place)).collect()
}

fn plain(builtin: &BuiltinAlarm, owner: AlarmOwner) -> AlarmDef {
    AlarmDef {
        name: builtin.name.to_owned(),
        owner,
        condition: AlarmCondition::BuiltIn(builtin.condition),
        priority: builtin.priority,
        on_delay: builtin.on_delay(),
        off_delay: builtin.off_delay(),
        latch: builtin.latch,
        suppressed_by: Vec::new(),
        first_out: false,
        bit: builtin.bit,
        value: None,
        text: builtin.text.to_owned(),
        action: builtin.action.to_owned(),
    }
}

/// An alarm whose causes are still names.
pub struct Draft {
    /// It, without its causes.
    pub alarm: AlarmDef,
    /// They, and where the mapping names them.
    pub causes: Vec<(String, Option<Range<usize>>)>,
    /// Where the name of the alarm stands.
    pub span: Range<usize>,
}

/// The alarms of a node: built-in ones first, then those of the mapping, causes before what they suppress. `base` is the place
/// of the first in the table; `places` are those of the items among the node's tags.
pub fn of_node(
    problems: &mut Problems,
    context: &Context<'_>,
    pdos: &[PdoSettings],
    places: &[usize],
    bus: BusIndex,
    base: usize,
) -> Vec<AlarmDef> {
    let mut known: BTreeSet<String> = OF_BUS.iter().map(|builtin| builtin.name.to_owned()).collect();
    let mut drafts = built_in(problems, context, pdos, &mut known);
    let mut names = BTreeMap::new();
    drafts.extend(from_mapping(problems, context, places, &mut known, &mut names));
    drafts.extend(emergency::alarms(problems, context, &mut known, &mut names));
    check_names(problems, context, &known);
    let by_name: BTreeMap<String, usize> =
        drafts.iter().enumerate().map(|(index, draft)| (draft.alarm.name.clone(), index)).collect();
    let bus = names_of_bus(bus.0);
    let mut own_causes = Vec::new();
    let mut bus_causes = Vec::new();
    for draft in &drafts {
        let mut own = Vec::new();
        let mut others = Vec::new();
        for (name, span) in &draft.causes {
            if let Some(index) = by_name.get(name) {
                own.push(*index);
            } else if let Some(place) = bus.get(name.as_str()) {
                others.push(*place);
            } else if let (Some(span), false) = (span, known.contains(name)) {
                problems.unknown(context.source, span, "alarm", name, known.iter().map(String::as_str));
            }
        }
        own_causes.push(own);
        bus_causes.push(others);
    }
    let (order, circle) = causes_first(&own_causes);
    if let Some(first) = circle.first().and_then(|index| drafts.get(*index)) {
        let names: Vec<&str> = circle
            .iter()
            .filter_map(|index| drafts.get(*index))
            .map(|draft| draft.alarm.name.as_str())
            .collect();
        let message = format!("alarms suppress each other in a circle: {}", names.join(", "));
        problems.error(context.source, &first.span, message, "take one of them out of a `suppressed_by`");
    }
    let mut place_of = vec![0; drafts.len()];
    for (place, index) in order.iter().enumerate() {
        place_of.get_mut(*index).into_iter().for_each(|slot| *slot = base + place);
    }
    let mut sorted: Vec<(usize, AlarmDef)> = Vec::new();
    for (((draft, own), others), place) in drafts.into_iter().zip(own_causes).zip(bus_causes).zip(&place_of) {
        let mut suppressed_by = others;
        suppressed_by.extend(own.into_iter().filter_map(|index| place_of.get(index).copied()));
        suppressed_by.sort_unstable();
        sorted.push((*place, AlarmDef { suppressed_by, ..draft.alarm }));
    }
    sorted.sort_by_key(|(place, _)| *place);
    sorted.into_iter().map(|(_, alarm)| alarm).collect()
}

fn built_in(
    problems: &mut Problems,
    context: &Context<'_>,
    pdos: &[PdoSettings],
    known: &mut BTreeSet<String>,
) -> Vec<Draft> {
    let mut drafts = Vec::new();
    let is_module = context.file.esd.is_some();
    let watched = |builtin: &&BuiltinAlarm| {
        if is_module { is_of_module(builtin.condition) } else { builtin.condition != BuiltIn::NotConfigured }
    };
    for builtin in OF_NODE.iter().filter(watched) {
        // Who is not asked who it is cannot be another.
        let asked = BuiltIn::IdentityMismatch != builtin.condition
            || is_module
            || context.file.identity.as_ref().is_some_and(|identity| *identity != IdentitySection::default());
        let one = [(builtin.name.to_owned(), builtin.text.to_owned(), builtin.condition, asked)];
        let each = pdos.iter().enumerate().map(|(place, pdo)| {
            let fill = |text: &str| text.replace("{}", &pdo.number.to_string());
            // Whether one that is adopted is supervised is for the device to say.
            let supervised = pdo.timeout.is_some() || context.tpdos.get(place).is_some_and(Tpdo::is_adopted);
            (fill(builtin.name), fill(builtin.text), BuiltIn::PdoTimeout(place), supervised)
        });
        let variants: Vec<_> =
            if builtin.name.contains("{}") { each.collect() } else { one.into_iter().collect() };
        for (name, text, condition, mut enabled) in variants {
            let mut alarm = AlarmDef {
                condition: AlarmCondition::BuiltIn(condition),
                text,
                ..plain(builtin, AlarmOwner::Node(context.node))
            };
            alarm.name.clone_from(&name);
            for (_, change) in context
                .file
                .builtin_alarm
                .iter()
                .filter(|(pattern, _)| matched(&pattern.value, &name).is_some())
            {
                enabled = change.enabled.unwrap_or(enabled);
                alarm.priority = change.priority.map_or(alarm.priority, Into::into);
                alarm.latch = change.latch.unwrap_or(alarm.latch);
                alarm.text = change.text.clone().unwrap_or(alarm.text);
                alarm.action = change.action.clone().unwrap_or(alarm.action);
                let source = context.source;
                alarm.on_delay =
                    delay(problems, source, change.on_delay_ms.as_ref(), "on_delay_ms", alarm.on_delay);
                alarm.off_delay =
                    delay(problems, source, change.off_delay_ms.as_ref(), "off_delay_ms", alarm.off_delay);
            }
            enabled = change_by_installation(problems, context, &mut alarm, enabled);
            known.insert(name);
            if enabled {
                let causes = builtin.suppressed_by.iter().map(|name| ((*name).to_owned(), None)).collect();
                drafts.push(Draft { alarm, causes, span: 0..0 });
            }
        }
    }
    drafts
}

/// A delay of an alarm.
pub fn delay(
    problems: &mut Problems,
    source: &SourceText,
    at: Option<&At<u64>>,
    what: &str,
    default: Duration,
) -> Duration {
    problems.milliseconds(source, at, what, 0..=LONGEST_DELAY, default)
}

/// What `[node.NAME.alarm.ALARM]` says. Returns whether the alarm is enabled.
pub fn change_by_installation(
    problems: &mut Problems,
    context: &Context<'_>,
    alarm: &mut AlarmDef,
    enabled: bool,
) -> bool {
    let mut enabled = enabled;
    let changes =
        context.entry.alarm.iter().filter(|(pattern, _)| matched(&pattern.value, &alarm.name).is_some());
    for (_, change) in changes {
        enabled = change.enabled.unwrap_or(enabled);
        alarm.priority = change.priority.map_or(alarm.priority, Into::into);
        alarm.latch = change.latch.unwrap_or(alarm.latch);
        let config = context.config;
        alarm.on_delay = delay(problems, config, change.on_delay_ms.as_ref(), "on_delay_ms", alarm.on_delay);
        alarm.off_delay =
            delay(problems, config, change.off_delay_ms.as_ref(), "off_delay_ms", alarm.off_delay);
    }
    enabled
}

fn from_mapping(
    problems: &mut Problems,
    context: &Context<'_>,
    places: &[usize],
    known: &mut BTreeSet<String>,
    names: &mut BTreeMap<String, usize>,
) -> Vec<Draft> {
    let mut drafts = Vec::new();
    let mut bits: BTreeMap<u64, &At<String>> = BTreeMap::new();
    for section in &context.file.alarm {
        check_bit(problems, context, section, &mut bits);
        refuse_stride(problems, context.source, section.array.as_ref());
        for element in elements(problems, context.source, &section.name, section.array.as_ref()) {
            let name = element.fill(&section.name.value);
            check_name(problems, context, &section.name.span, &name, known, names);
            known.insert(name.clone());
            let (draft, enabled) = draft(problems, context, places, section, &element, name);
            if enabled {
                drafts.extend(draft);
            }
        }
        if drafts.len() > MOST_ALARMS {
            let hint = format!("a device can have {MOST_ALARMS} alarms at most");
            problems.error(context.source, &section.name.span, "too many alarms", hint);
            break;
        }
    }
    drafts
}

fn check_bit<'a>(
    problems: &mut Problems,
    context: &Context<'_>,
    section: &'a AlarmSection,
    bits: &mut BTreeMap<u64, &'a At<String>>,
) {
    let Some(bit) = &section.bit else { return };
    problems.within(context.source, bit, "bit", 16..=31);
    if let Some(other) = bits.insert(bit.value, &section.name) {
        let message =
            format!("alarms `{}` and `{}` have the same bit {}", other.value, section.name.value, bit.value);
        problems.error(context.source, &bit.span, message, "give each its own bit of 16 to 31");
    }
}

/// An alarm of the mapping has a name of its own. `names`: those before, and where they stand.
pub fn check_name(
    problems: &mut Problems,
    context: &Context<'_>,
    span: &Range<usize>,
    name: &str,
    known: &BTreeSet<String>,
    names: &mut BTreeMap<String, usize>,
) {
    if !is_snake_case(name) {
        let hint = "use 1 to 64 of a-z, 0-9 and _, a letter first";
        problems.error(context.source, span, format!("`{name}` cannot be the name of an alarm"), hint);
    }
    if let Some(first) = names.get(name) {
        let (line, _) = context.source.position(*first);
        let hint = format!("the other is in line {line}; rename one of them");
        problems.error(context.source, span, format!("there are two alarms `{name}`"), hint);
    } else if known.contains(name) {
        let hint = "rename it, or change the built-in one under [builtin_alarm]";
        problems.error(context.source, span, format!("`{name}` is the name of a built-in alarm"), hint);
    }
    names.insert(name.to_owned(), span.start);
}

fn draft(
    problems: &mut Problems,
    context: &Context<'_>,
    places: &[usize],
    section: &AlarmSection,
    element: &Element,
    name: String,
) -> (Option<Draft>, bool) {
    let in_table = |index: usize| TagIndex(context.base + places.get(index).copied().unwrap_or_default());
    let source = context.source;
    let expression = condition(problems, context, &section.when, element).map(|mut expression| {
        expression.for_each_tag_mut(&mut |tag| *tag = in_table(tag.0));
        expression
    });
    let value = section.value.as_ref().and_then(|value| {
        context.items.find(problems, source, &element.fill(&value.value), &value.span).map(in_table)
    });
    let none = Duration::ZERO;
    let mut alarm = AlarmDef {
        name,
        owner: AlarmOwner::Node(context.node),
        condition: match expression {
            Some(expression) => AlarmCondition::Tags(expression),
            None => return (None, true),
        },
        priority: section.priority.into(),
        on_delay: delay(problems, source, section.on_delay_ms.as_ref(), "on_delay_ms", none),
        off_delay: delay(problems, source, section.off_delay_ms.as_ref(), "off_delay_ms", none),
        latch: section.latch,
        suppressed_by: Vec::new(),
        first_out: section.first_out,
        bit: section.bit.as_ref().and_then(|bit| u8::try_from(bit.value).ok()),
        value,
        text: element.fill(&section.text),
        action: element.fill(&section.action),
    };
    let enabled = change_by_installation(problems, context, &mut alarm, section.enabled.unwrap_or(true));
    let causes = section
        .suppressed_by
        .iter()
        .map(|cause| (element.fill(&cause.value), Some(cause.span.clone())))
        .collect();
    (Some(Draft { alarm, causes, span: section.name.span.clone() }), enabled)
}

/// Names in changes of alarms that mean nothing.
fn check_names(problems: &mut Problems, context: &Context<'_>, known: &BTreeSet<String>) {
    let own: Vec<&str> = known
        .iter()
        .map(String::as_str)
        .filter(|name| !OF_BUS.iter().any(|builtin| builtin.name == *name))
        .collect();
    for pattern in context.entry.alarm.keys() {
        if !own.iter().any(|name| matched(&pattern.value, name).is_some()) {
            problems.unknown(context.config, &pattern.span, "alarm", &pattern.value, own.iter().copied());
        }
    }
    let numbered =
        |name: &str| OF_NODE.iter().any(|builtin| matched(&builtin.name.replace("{}", "*"), name).is_some());
    let built_in: Vec<&str> = own.iter().copied().filter(|name| numbered(name)).collect();
    for pattern in context.file.builtin_alarm.keys() {
        if !built_in.iter().any(|name| matched(&pattern.value, name).is_some()) {
            problems.unknown(
                context.source,
                &pattern.span,
                "built-in alarm",
                &pattern.value,
                built_in.iter().copied(),
            );
        }
    }
}
