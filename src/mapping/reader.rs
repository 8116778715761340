//! Strict reading of TOML: every problem of a file at once, each with its place and a hint.
//!
//! A deserializer stops at the first problem. So the entry that it complains about is taken out of the parsed document
//! and the rest is read again, until nothing is left to complain about.

use std::ops::Range;

use serde::de::DeserializeOwned;
use toml::Spanned;
use toml::de::{DeArray, DeTable, DeValue, Deserializer};

use super::diagnostic::{Diagnostic, SourceText};
use super::suggest::closest;

/// Problems of one file after which reading it stops.
const MOST_PROBLEMS: usize = 100;

/// What came of reading a file.
#[derive(Debug)]
pub struct Read<T> {
    /// The content without the entries that were wrong; `None` where too little of it can be read.
    pub content: Option<T>,
    /// What was wrong with its form.
    pub problems: Vec<Diagnostic>,
    /// Names of entries that could not be read: a reference to one of them is not a problem of its own.
    pub lost: Vec<String>,
}

/// Reads a file. Syntax errors are reported alone: what stands after them cannot be trusted.
#[must_use]
pub fn read<T: DeserializeOwned>(source: &SourceText) -> Read<T> {
    let (mut document, errors) = DeTable::parse_recoverable(&source.text);
    let mut problems: Vec<Diagnostic> = errors
        .into_iter()
        .take(MOST_PROBLEMS)
        .map(|error| {
            let hint = "the file is not valid TOML here: https://toml.io";
            source.error(&error.span().unwrap_or(0..0), error.message().trim(), hint)
        })
        .collect();
    if !problems.is_empty() {
        return Read { content: None, problems, lost: Vec::new() };
    }
    let whole = document.span();
    let mut removed = Removed::default();
    let content = loop {
        match T::deserialize(Deserializer::from(document.clone())) {
            Ok(content) => break Some(content),
            Err(error) => {
                let span = error.span().unwrap_or(0..0);
                let wording = error.message().trim();
                if !removed.explains(wording, &span) {
                    let (message, hint) = rephrase(wording);
                    problems.push(source.error(&span, message, hint));
                }
                let found = removed.take_from_table(document.get_mut(), &whole, &span);
                if !found || problems.len() >= MOST_PROBLEMS {
                    break None;
                }
            }
        }
    };
    problems.sort_by_key(|problem| (problem.line, problem.column));
    Read { content, problems, lost: removed.names }
}

/// Entries that were taken out.
#[derive(Debug, Default)]
struct Removed {
    /// The span of the table that it stood in, and its key.
    keys: Vec<(Range<usize>, String)>,
    /// What it was called.
    names: Vec<String>,
}

impl Removed {
    /// Whether a key is missing only because it was wrong and has been told already.
    fn explains(&self, message: &str, table: &Range<usize>) -> bool {
        message.starts_with("missing field")
            && self.keys.iter().any(|(span, key)| span == table && message.contains(&format!("`{key}`")))
    }

    /// Takes out the innermost entry that lies at a span. `false` when there is none.
    fn take_from_table(
        &mut self,
        table: &mut DeTable<'_>,
        whole: &Range<usize>,
        span: &Range<usize>,
    ) -> bool {
        let mut found = None;
        for (key, value) in table.iter_mut() {
            let value_span = value.span();
            if self.take_from_value(value.get_mut(), &value_span, span) {
                return true;
            }
            if covers(&key.span(), span) || covers(&value_span, span) {
                found = Some((key.get_ref().to_string(), name_of(value.get_ref())));
            }
        }
        let Some((key, name)) = found else { return false };
        let removed = table.remove(key.as_str()).is_some();
        self.names.push(name.unwrap_or_else(|| key.clone()));
        self.keys.push((whole.clone(), key));
        removed
    }

    fn take_from_value(
        &mut self,
        value: &mut DeValue<'_>,
        whole: &Range<usize>,
        span: &Range<usize>,
    ) -> bool {
        match value {
            DeValue::Table(table) => self.take_from_table(table, whole, span),
            DeValue::Array(items) => self.take_from_array(items, span),
            DeValue::String(_)
            | DeValue::Integer(_)
            | DeValue::Float(_)
            | DeValue::Boolean(_)
            | DeValue::Datetime(_) => false,
        }
    }

    fn take_from_array(&mut self, items: &mut DeArray<'_>, span: &Range<usize>) -> bool {
        let inside = items.iter_mut().any(|item| {
            let whole = item.span();
            self.take_from_value(item.get_mut(), &whole, span)
        });
        if inside {
            return true;
        }
        let Some(at) = items.iter().position(|item| covers(&item.span(), span)) else { return false };
        let mut rest = DeArray::new();
        for (index, item) in items.iter().enumerate() {
            if index == at {
                self.names.extend(name_of(item.get_ref()));
            } else {
                rest.push(Spanned::clone(item));
            }
        }
        *items = rest;
        true
    }
}

fn covers(outer: &Range<usize>, inner: &Range<usize>) -> bool {
    !outer.is_empty() && outer.start <= inner.start && inner.end <= outer.end
}

fn name_of(value: &DeValue<'_>) -> Option<String> {
    value.get("name")?.get_ref().as_str().map(str::to_owned)
}

/// Whether a file is meant to be a device mapping: it has a `format` or, broken as it may be, a `[device]`.
#[must_use]
pub fn is_mapping(source: &SourceText) -> bool {
    let (document, _) = DeTable::parse_recoverable(&source.text);
    ["format", "device"].into_iter().any(|key| document.get_ref().contains_key(key))
}

/// Where a key stands: its value, or as much of the path as there is; `0..0` where there is nothing of it.
#[must_use]
pub fn locate(source: &SourceText, path: &[&str]) -> Range<usize> {
    let (document, _) = DeTable::parse_recoverable(&source.text);
    let mut table = document.get_ref();
    let mut span = 0..0;
    for key in path {
        let Some(value) = table.get(*key) else { break };
        span = value.span();
        let Some(inner) = value.get_ref().as_table() else { break };
        table = inner;
    }
    span
}

/// The reader's messages in our words, with a hint.
fn rephrase(message: &str) -> (String, String) {
    let quoted: Vec<&str> = message.split('`').skip(1).step_by(2).collect();
    let words = |from: usize| quoted.get(from..).unwrap_or_default();
    if message.starts_with("unknown field") {
        return unknown("key", words(0));
    }
    if message.starts_with("unknown variant") {
        return unknown("word", words(0));
    }
    if let (true, Some(key)) = (message.starts_with("missing field"), quoted.first()) {
        return (format!("key `{key}` is missing"), format!("add `{key} = ...` here"));
    }
    if let Some((found, expected)) =
        message.strip_prefix("invalid type: ").and_then(|rest| rest.split_once(", expected "))
    {
        return (format!("this is of the wrong type: {found}"), format!("write {}", in_words(expected)));
    }
    if let Some((found, expected)) =
        message.strip_prefix("invalid value: ").and_then(|rest| rest.split_once(", expected "))
    {
        return (format!("this value is not possible: {found}"), format!("write {}", in_words(expected)));
    }
    (message.to_owned(), String::new())
}

fn unknown(what: &str, words: &[&str]) -> (String, String) {
    let Some((wrong, known)) = words.split_first() else { return (format!("unknown {what}"), String::new()) };
    let list = known.join(", ");
    let hint = match closest(wrong, known.iter().copied()) {
        Some(close) => format!("did you mean `{close}`? Known here: {list}"),
        None if known.is_empty() => format!("no {what} is known here"),
        None => format!("known here: {list}"),
    };
    (format!("unknown {what} `{wrong}`"), hint)
}

fn in_words(expected: &str) -> String {
    match expected {
        "u8" => "a whole number from 0 to 255".to_owned(),
        "u16" => "a whole number from 0 to 65535".to_owned(),
        "u32" | "u64" | "usize" => "a whole number, not negative".to_owned(),
        "i64" => "a whole number".to_owned(),
        "f64" => "a number".to_owned(),
        "a string" => "text in quotation marks".to_owned(),
        "a boolean" => "true or false".to_owned(),
        "a sequence" => "a list in square brackets".to_owned(),
        "a map" => "a table".to_owned(),
        other => other.strip_prefix("struct ").map_or_else(|| other.to_owned(), |_| "a table".to_owned()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[derive(Debug, PartialEq, serde::Deserialize)]
    #[serde(deny_unknown_fields)]
    struct File {
        number: u8,
        #[serde(default)]
        item: Vec<Item>,
    }

    #[derive(Debug, PartialEq, serde::Deserialize)]
    #[serde(deny_unknown_fields)]
    struct Item {
        name: String,
        wanted: bool,
    }

    #[test]
    fn every_problem_of_form_is_told_and_the_rest_is_read() {
        let source = SourceText::new(
            "f.toml",
            "number = 300\nnumer = 3\n[[item]]\nname = \"a\"\n[[item]]\nname = 5\nwanted = true\n[[item]]\nname = \"c\"\nwanted = true\n",
        );
        let read = read::<File>(&source);
        let messages: Vec<String> = read.problems.iter().map(ToString::to_string).collect();
        let expected = [
            "f.toml:1:10: error: this value is not possible: integer `300`\n  hint: write a whole number from 0 to 255",
            "f.toml:2:1: error: unknown key `numer`\n  hint: did you mean `number`? Known here: number, item",
            "f.toml:3:1: error: key `wanted` is missing\n  hint: add `wanted = ...` here",
            "f.toml:6:8: error: this is of the wrong type: integer `5`\n  hint: write text in quotation marks",
        ];
        assert_eq!(messages, expected, "{messages:#?}");
        assert!(read.lost.contains(&"a".to_owned()));
    }

    #[test]
    fn all_syntax_errors_come_with_their_place() {
        let source = SourceText::new("f.toml", "a = \nb = ]\n");
        let read = read::<File>(&source);
        assert!(read.content.is_none());
        assert!(read.problems.iter().any(|problem| problem.line == 1));
        assert!(read.problems.iter().any(|problem| problem.line == 2));
    }
}
