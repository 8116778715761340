//! The tags of a mapping, one by one: arrays unrolled, names resolved.

use std::collections::BTreeMap;
use std::ops::Range;

use super::super::file::values::NameList;
use super::super::file::{ArraySection, DerivedSection, MappingFile, ParameterSection, TagSection};
use super::super::{At, SourceText};
use super::problems::{Problems, is_snake_case, matched};

/// Most tags (or alarms) that one array makes.
const LONGEST_ARRAY: u64 = 1024;
/// Most tags of one device.
const MOST_TAGS: usize = 4096;

/// What `{}` stands for in one element of an array.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Element {
    /// The number or word; `None` outside an array.
    pub text: Option<String>,
    /// Place in the array, from 0.
    pub index: u64,
}

impl Element {
    /// A text with `{}` filled in.
    pub fn fill(&self, template: &str) -> String {
        match &self.text {
            Some(text) => template.replace("{}", text),
            None => template.to_owned(),
        }
    }
}

/// The elements of an array; one for an entry that is none.
pub fn elements(
    problems: &mut Problems,
    source: &SourceText,
    name: &At<String>,
    array: Option<&At<ArraySection>>,
) -> Vec<Element> {
    let templated = name.value.contains("{}");
    let Some(array) = array else {
        if templated {
            let hint = "add `array = { first = 1, count = 8 }`, or take the {} out of the name";
            problems.error(source, &name.span, format!("`{}` holds {{}} but is no array", name.value), hint);
            return Vec::new();
        }
        return vec![Element::default()];
    };
    if !templated {
        let hint = "put {} into the name, where the number is to stand: `level_{}`";
        problems.error(
            source,
            &name.span,
            format!("all elements of `{}` would have the same name", name.value),
            hint,
        );
        return Vec::new();
    }
    match (&array.value.words, &array.value.count, &array.value.first) {
        (Some(words), None, None) => {
            (0..).zip(words).map(|(index, word)| Element { text: Some(word.value.clone()), index }).collect()
        }
        (None, Some(count), first) => {
            let count = problems.within(source, count, "count", 1..=LONGEST_ARRAY);
            let first = first.as_ref().map_or(1, |first| problems.within(source, first, "first", 0..=65_535));
            (0..count).map(|index| Element { text: Some((first + index).to_string()), index }).collect()
        }
        _ => {
            let hint = "write either { first = 1, count = 8 } or { words = [\"left\", \"right\"] }";
            problems.error(source, &array.span, "an array has either a count or words", hint);
            Vec::new()
        }
    }
}

/// `bit_stride` is for what has bits in a TPDO.
pub fn refuse_stride(problems: &mut Problems, source: &SourceText, array: Option<&At<ArraySection>>) {
    if let Some(stride) = array.and_then(|array| array.value.bit_stride.as_ref()) {
        let hint = "it is for tags of a TPDO; leave it out";
        problems.error(source, &stride.span, "`bit_stride` means nothing here", hint);
    }
}

/// One tag as it stands in the file.
#[derive(Clone, Copy, Debug)]
pub enum Entry<'a> {
    /// `[[parameter]]`
    Parameter(&'a ParameterSection),
    /// `[[tag]]`
    Tag(&'a TagSection),
    /// `[[derived]]`
    Derived(&'a DerivedSection),
}

/// One tag, its array unrolled.
#[derive(Clone, Debug)]
pub struct Item<'a> {
    /// Its name.
    pub name: String,
    /// Where the name stands.
    pub span: Range<usize>,
    /// What `{}` stands for.
    pub element: Element,
    /// Its entry.
    pub entry: Entry<'a>,
}

/// Tags that a list names.
#[derive(Clone, Debug, Default)]
pub struct Found {
    /// Their places among the items.
    pub items: Vec<usize>,
    /// Their numbers, where the list is one pattern: what its `*` stands for.
    pub numbers: Option<Vec<u64>>,
}

/// All tags of a mapping, in the order of the file: parameters, tags, derived tags.
#[derive(Debug)]
pub struct Items<'a> {
    /// They.
    pub list: Vec<Item<'a>>,
    by_name: BTreeMap<String, usize>,
    /// Names of entries that could not be read or unrolled.
    lost: Vec<String>,
}

impl<'a> Items<'a> {
    /// Unrolls all arrays.
    pub fn new(
        problems: &mut Problems,
        source: &SourceText,
        file: &'a MappingFile,
        lost: &'a [String],
    ) -> Self {
        let mut items = Self { list: Vec::new(), by_name: BTreeMap::new(), lost: lost.to_vec() };
        let parameters =
            file.parameter.iter().map(|section| (&section.name, None, Entry::Parameter(section)));
        let tags =
            file.tag.iter().map(|section| (&section.name, section.array.as_ref(), Entry::Tag(section)));
        let derived = file
            .derived
            .iter()
            .map(|section| (&section.name, section.array.as_ref(), Entry::Derived(section)));
        for (name, array, entry) in parameters.chain(tags).chain(derived) {
            let elements = elements(problems, source, name, array);
            if matches!(entry, Entry::Derived(_)) {
                refuse_stride(problems, source, array);
            }
            if elements.is_empty() {
                items.lost.push(name.value.clone());
            }
            for element in elements {
                items.add(problems, source, name, element, entry);
            }
            if items.list.len() > MOST_TAGS {
                let hint = format!("a device can have {MOST_TAGS} tags at most");
                problems.error(source, &name.span, "too many tags", hint);
                break;
            }
        }
        items
    }

    fn add(
        &mut self,
        problems: &mut Problems,
        source: &SourceText,
        template: &At<String>,
        element: Element,
        entry: Entry<'a>,
    ) {
        let name = element.fill(&template.value);
        if !is_snake_case(&name) {
            let hint = "use 1 to 64 of a-z, 0-9 and _, a letter first";
            problems.error(source, &template.span, format!("`{name}` cannot be the name of a tag"), hint);
        }
        if let Some(first) = self.by_name.get(&name).and_then(|index| self.list.get(*index)) {
            let (line, _) = source.position(first.span.start);
            let message = format!("there are two tags `{name}`");
            problems.error(
                source,
                &template.span,
                message,
                format!("the other is in line {line}; rename one of them"),
            );
            return;
        }
        self.by_name.insert(name.clone(), self.list.len());
        self.list.push(Item { name, span: template.span.clone(), element, entry });
    }

    /// The place of a tag. An unknown one is told, with the closest known name, unless it was told that its entry is wrong.
    pub fn find(
        &self,
        problems: &mut Problems,
        source: &SourceText,
        name: &str,
        span: &Range<usize>,
    ) -> Option<usize> {
        let found = self.by_name.get(name).copied();
        if found.is_none() && !self.is_lost(name) {
            problems.unknown(source, span, "tag", name, self.by_name.keys().map(String::as_str));
        }
        found
    }

    /// Whether a name belongs to an entry that could not be read.
    pub fn is_lost(&self, name: &str) -> bool {
        self.lost.iter().any(|lost| match lost.split_once("{}") {
            Some((before, after)) => name.starts_with(before) && name.ends_with(after),
            None => lost == name,
        })
    }

    /// The places of several tags.
    pub fn find_all(
        &self,
        problems: &mut Problems,
        source: &SourceText,
        names: &At<NameList>,
        element: &Element,
    ) -> Found {
        let list: Vec<(String, &Range<usize>)> = match &names.value {
            NameList::One(name) => vec![(element.fill(name), &names.span)],
            NameList::Several(names) => {
                names.iter().map(|name| (element.fill(&name.value), &name.span)).collect()
            }
        };
        let only_one = list.len() == 1;
        let mut found = Found::default();
        for (pattern, span) in list {
            if !pattern.contains('*') {
                found.items.extend(self.find(problems, source, &pattern, span));
                continue;
            }
            let mut matches: Vec<(u64, usize)> = self
                .by_name
                .iter()
                .filter_map(|(name, index)| matched(&pattern, name).map(|number| (number, *index)))
                .collect();
            matches.sort_unstable();
            if matches.is_empty() && self.lost.is_empty() {
                let hint = "a * stands for a number: `level_*` means level_1, level_2 and so on";
                problems.error(source, span, format!("no tag matches `{pattern}`"), hint);
            }
            if only_one {
                found.numbers = Some(matches.iter().map(|(number, _)| *number).collect());
            }
            found.items.extend(matches.into_iter().map(|(_, index)| index));
        }
        found
    }

    /// A tag.
    pub fn get(&self, index: usize) -> Option<&Item<'a>> {
        self.list.get(index)
    }
}
