//! Computed tags.

use std::ops::Range;
use std::time::Duration;

use super::super::expression_parser::parse;
use super::super::file::DerivedSection;
use super::super::file::values::NameList;
use super::super::table::Derived;
use super::super::{At, Expression, SourceText};
use super::items::{Element, Found, Item};
use super::problems::Problems;
use super::tags::{Context, Kind};
use crate::process_image::TagIndex;

/// The ways to compute a tag.
const WAYS: &str = "bit, pack, when, maximum, arg_maximum, margin, count, rising_edges, seconds_since_rise, latch or edges_within";

/// The kind of a computed tag's value.
pub fn kind(section: &DerivedSection) -> Kind {
    if section.bit.is_some() || section.when.is_some() || section.latch.is_some() {
        Kind::Bool
    } else if let Some(pack) = &section.pack {
        match &pack.value {
            NameList::Several(names) => Kind::Bits(u8::try_from(names.len()).unwrap_or(64).min(64)),
            NameList::One(_) => Kind::Bits(64),
        }
    } else {
        Kind::Number
    }
}

/// How a tag is computed; its inputs are the places of items.
pub fn derived(
    problems: &mut Problems,
    context: &Context<'_>,
    item: &Item<'_>,
    section: &DerivedSection,
) -> Derived {
    let span = &item.span;
    let source = context.source;
    let ways = ways(section);
    if ways != 1 {
        let message = if ways == 0 {
            format!("`{}` does not say how it is computed", item.name)
        } else {
            format!("`{}` says in {ways} ways how it is computed", item.name)
        };
        problems.error(source, span, message, format!("give it exactly one of {WAYS}"));
    }
    let comparing = section.maximum.is_some() || section.arg_maximum.is_some() || section.margin.is_some();
    if let (Some(only_where), false) = (&section.only_where, comparing) {
        let hint = "leave it out, or put the condition into a tag with `when`";
        problems.error(source, &only_where.span, "`where` is for maximum, arg_maximum and margin", hint);
    }
    one_way(problems, context, item, section).unwrap_or(Derived::Constant { value: 0.0 })
}

fn ways(section: &DerivedSection) -> usize {
    [
        section.bit.is_some(),
        section.pack.is_some(),
        section.when.is_some(),
        section.maximum.is_some(),
        section.arg_maximum.is_some(),
        section.margin.is_some(),
        section.count.is_some(),
        section.rising_edges.is_some(),
        section.seconds_since_rise.is_some(),
        section.latch.is_some(),
        section.edges_within.is_some(),
    ]
    .into_iter()
    .filter(|given| *given)
    .count()
}

fn one_way(
    problems: &mut Problems,
    context: &Context<'_>,
    item: &Item<'_>,
    section: &DerivedSection,
) -> Option<Derived> {
    let element = &item.element;
    if let Some(bit) = &section.bit {
        return self::bit(problems, context, &bit.of, &bit.bit, element);
    }
    if let Some(list) = &section.pack {
        let of = indexes(bools(problems, context, list, element));
        if of.len() > 64 {
            problems.error(
                context.source,
                &list.span,
                "more than 64 tags to pack",
                "make two numbers of them",
            );
        }
        return Some(Derived::Pack { of });
    }
    if let Some(when) = &section.when {
        return condition(problems, context, when, element).map(|when| Derived::Logic { when });
    }
    if let Some(list) = &section.count {
        return Some(Derived::Count { of: indexes(bools(problems, context, list, element)) });
    }
    let bool_tag = |problems: &mut Problems, name: &At<String>, what: &str| {
        context.bool_tag(problems, name, element, what)
    };
    if let Some(name) = &section.rising_edges {
        return bool_tag(problems, name, "`rising_edges`").map(|of| Derived::RisingEdges { of });
    }
    if let Some(name) = &section.seconds_since_rise {
        return bool_tag(problems, name, "`seconds_since_rise`").map(|of| Derived::SecondsSinceRise { of });
    }
    if let Some(name) = &section.latch {
        return bool_tag(problems, name, "`latch`").map(|of| Derived::Latch { of });
    }
    if let Some(edges) = &section.edges_within {
        let window = problems.within(context.source, &edges.window_s, "window_s", 1..=86_400);
        let window = Duration::from_secs(window);
        return bool_tag(problems, &edges.of, "`edges_within`").map(|of| Derived::EdgesWithin { of, window });
    }
    compared(problems, context, item, section)
}

fn compared(
    problems: &mut Problems,
    context: &Context<'_>,
    item: &Item<'_>,
    section: &DerivedSection,
) -> Option<Derived> {
    let of = section.margin.as_ref().map(|margin| &margin.of);
    let list = section.maximum.as_ref().or(section.arg_maximum.as_ref()).or(of)?;
    let found = context.items.find_all(problems, context.source, list, &item.element);
    for index in &found.items {
        number(problems, context, *index, &list.span);
    }
    let valid = section.only_where.as_ref().map(|names| {
        let valid = bools(problems, context, names, &item.element);
        check_pairs(problems, context, names, &found, &valid);
        indexes(valid)
    });
    let numbers = found.numbers.clone();
    let among = indexes(found);
    if section.maximum.is_some() {
        return Some(Derived::Maximum { among, valid });
    }
    let Some(margin) = &section.margin else {
        let numbers = numbers.unwrap_or_else(|| (1..).take(among.len()).collect());
        let numbers = numbers.into_iter().map(|number| u16::try_from(number).unwrap_or(u16::MAX)).collect();
        return Some(Derived::ArgMaximum { among, valid, numbers });
    };
    let limit = item.element.fill(&margin.to.value);
    let limit = context.items.find(problems, context.source, &limit, &margin.to.span)?;
    number(problems, context, limit, &margin.to.span);
    Some(Derived::Margin { among, valid, limit: TagIndex(limit) })
}

fn indexes(found: Found) -> Vec<TagIndex> {
    found.items.into_iter().map(TagIndex).collect()
}

/// Each value needs a tag that tells whether it takes part: that of the same number where both lists have numbers, else
/// that of the same place.
fn check_pairs(
    problems: &mut Problems,
    context: &Context<'_>,
    names: &At<NameList>,
    values: &Found,
    valid: &Found,
) {
    if values.items.is_empty() || valid.items.is_empty() {
        return;
    }
    if let (Some(numbers), Some(there)) = (&values.numbers, &valid.numbers)
        && let Some(alone) = numbers.iter().position(|number| !there.contains(number))
        && let Some(item) = values.items.get(alone).and_then(|index| context.items.get(*index))
    {
        let there: Vec<String> = there.iter().map(u64::to_string).collect();
        let message =
            format!("`{}` has no tag in `where`: those there are numbered {}", item.name, there.join(", "));
        let hint = "give both the same numbers, or list the tags one by one in the same order";
        problems.error(context.source, &names.span, message, hint);
    } else if values.items.len() != valid.items.len() {
        let message = format!("{} values, but {} tags in `where`", values.items.len(), valid.items.len());
        let hint = "give one bool tag for each value, in the same order";
        problems.error(context.source, &names.span, message, hint);
    }
}

fn number(problems: &mut Problems, context: &Context<'_>, index: usize, span: &Range<usize>) {
    if let (Kind::Bool, Some(item)) = (context.kind(index), context.items.get(index)) {
        let message = format!("`{}` is a bool tag, but a number is needed here", item.name);
        problems.error(
            context.source,
            span,
            message,
            "name tags that are numbers; `count` and `pack` take bool tags",
        );
    }
}

fn bools(problems: &mut Problems, context: &Context<'_>, names: &At<NameList>, element: &Element) -> Found {
    let found = context.items.find_all(problems, context.source, names, element);
    for index in &found.items {
        if let (false, Some(item)) = (context.kind(*index) == Kind::Bool, context.items.get(*index)) {
            let message = format!("`{}` is a number, but bool tags are needed here", item.name);
            let hint = "name bool tags; make one of a number with `when = \"tag > 5\"`";
            problems.error(context.source, &names.span, message, hint);
        }
    }
    found
}

fn bit(
    problems: &mut Problems,
    context: &Context<'_>,
    of: &At<String>,
    bit: &At<u64>,
    element: &Element,
) -> Option<Derived> {
    let name = element.fill(&of.value);
    let index = context.items.find(problems, context.source, &name, &of.span)?;
    let number = bit.value.saturating_add(element.index);
    match context.kind(index) {
        Kind::Bits(width) if number < u64::from(width) => {}
        Kind::Bits(width) => {
            let message = format!("`{name}` has no bit {number}");
            problems.error(context.source, &bit.span, message, format!("its bits are 0 to {}", width - 1));
        }
        Kind::Bool | Kind::Whole(_) | Kind::Number => {
            let message = format!("`{name}` has no bits to take one of");
            let hint = "take a bit of an unsigned tag without scale";
            problems.error(context.source, &of.span, message, hint);
        }
    }
    Some(Derived::Bit { of: TagIndex(index), bit: u8::try_from(number).unwrap_or(u8::MAX) })
}

/// A condition; `None` where it cannot be read or names an unknown tag. Its tags are the places of items.
pub fn condition(
    problems: &mut Problems,
    context: &Context<'_>,
    text: &At<String>,
    element: &Element,
) -> Option<Expression> {
    let mut complete = true;
    let parsed = parse(&text.value, &mut |name, span| {
        let name = element.fill(name);
        let place = inside(context.source, text, &span);
        let found = context.items.find(problems, context.source, &name, &place);
        complete &= found.is_some();
        TagIndex(found.unwrap_or_default())
    });
    match parsed {
        Ok(expression) => complete.then_some(expression),
        Err(error) => {
            let place = inside(context.source, text, &error.span);
            problems.error(context.source, &place, error.message, error.hint);
            None
        }
    }
}

/// The place in the file of a part of a text; the whole text's where it is written with escapes, which move its letters.
fn inside(source: &SourceText, text: &At<String>, part: &Range<usize>) -> Range<usize> {
    let start = text.span.start + 1;
    let plain = source.text.get(start..).is_some_and(|rest| rest.starts_with(&text.value));
    if plain { start + part.start..start + part.end } else { text.span.clone() }
}
