//! Collects what is wrong, and the checks that every part needs.

use std::ops::{Range, RangeInclusive};
use std::time::Duration;

use super::super::suggest::closest;
use super::super::{At, Diagnostic, Severity, SourceText};

/// Everything that was found, so far.
#[derive(Debug, Default)]
pub struct Problems {
    list: Vec<Diagnostic>,
}

impl Problems {
    /// Adds an error.
    pub fn error(
        &mut self,
        source: &SourceText,
        span: &Range<usize>,
        message: impl Into<String>,
        hint: impl Into<String>,
    ) {
        self.list.push(source.error(span, message, hint));
    }

    /// Adds a warning.
    pub fn warning(
        &mut self,
        source: &SourceText,
        span: &Range<usize>,
        message: impl Into<String>,
        hint: impl Into<String>,
    ) {
        self.list.push(source.warning(span, message, hint));
    }

    /// Adds problems that another found.
    pub fn extend(&mut self, problems: impl IntoIterator<Item = Diagnostic>) {
        self.list.extend(problems);
    }

    /// Whether there is an error, warnings apart.
    pub fn has_errors(&self) -> bool {
        self.list.iter().any(|problem| problem.severity == Severity::Error)
    }

    /// All of them, sorted.
    pub fn sorted(self) -> Vec<Diagnostic> {
        sort_problems(self.list)
    }

    /// A number within limits; the nearest limit where it is not.
    pub fn within(
        &mut self,
        source: &SourceText,
        number: &At<u64>,
        what: &str,
        limits: RangeInclusive<u64>,
    ) -> u64 {
        if !limits.contains(&number.value) {
            let (lowest, highest) = (limits.start(), limits.end());
            self.error(
                source,
                &number.span,
                format!("{what} {} is out of range", number.value),
                format!("use {lowest} to {highest}"),
            );
        }
        number.value.clamp(*limits.start(), *limits.end())
    }

    /// Milliseconds within limits, or a default.
    pub fn milliseconds(
        &mut self,
        source: &SourceText,
        number: Option<&At<u64>>,
        what: &str,
        limits: RangeInclusive<u64>,
        default: Duration,
    ) -> Duration {
        number.map_or(default, |number| Duration::from_millis(self.within(source, number, what, limits)))
    }

    /// A name of a gateway, bus or node: part of topics, and of the names of environment variables.
    pub fn name(&mut self, source: &SourceText, name: &At<String>, what: &str) {
        if !is_name(&name.value) {
            self.error(
                source,
                &name.span,
                format!("`{}` cannot be the name of a {what}", name.value),
                "use 1 to 64 of a-z, 0-9, _ and -",
            );
        }
    }

    /// A name that is not known, with the known one that is closest to it.
    pub fn unknown<'a>(
        &mut self,
        source: &SourceText,
        span: &Range<usize>,
        what: &str,
        name: &str,
        known: impl IntoIterator<Item = &'a str> + Clone,
    ) {
        let mut list: Vec<&str> = known.clone().into_iter().take(12).collect();
        list.sort_unstable();
        let hint = match closest(name, known) {
            Some(close) => format!("did you mean `{close}`?"),
            None if list.is_empty() => format!("there is no {what} at all"),
            None => format!("known here: {}", list.join(", ")),
        };
        self.error(source, span, format!("there is no {what} `{name}`"), hint);
    }
}

/// By file and place. Of those at one place that differ in numbers only, the first: elements of an array, or two nodes with
/// the same mapping, have the same problem.
#[must_use]
pub fn sort_problems(mut problems: Vec<Diagnostic>) -> Vec<Diagnostic> {
    let place = |problem: &Diagnostic| (problem.file.clone(), problem.line, problem.column);
    let gist = |problem: &Diagnostic| -> String {
        problem.message.chars().filter(|letter| !letter.is_ascii_digit()).collect()
    };
    problems.sort_by_key(place);
    let mut unique: Vec<Diagnostic> = Vec::new();
    for problem in problems {
        let here = unique.iter().rev().take_while(|known| place(known) == place(&problem));
        if !here.into_iter().any(|known| gist(known) == gist(&problem)) {
            unique.push(problem);
        }
    }
    unique
}

/// Whether a text can be the name of a gateway, bus or node.
#[must_use]
pub fn is_name(text: &str) -> bool {
    (1..=64).contains(&text.len())
        && text
            .bytes()
            .all(|byte| byte.is_ascii_lowercase() || byte.is_ascii_digit() || matches!(byte, b'_' | b'-'))
}

/// Whether a text can be the name of a tag or alarm: snake case.
#[must_use]
pub fn is_snake_case(text: &str) -> bool {
    (1..=64).contains(&text.len())
        && text.bytes().next().is_some_and(|byte| byte.is_ascii_lowercase())
        && text.bytes().all(|byte| byte.is_ascii_lowercase() || byte.is_ascii_digit() || byte == b'_')
}

/// The number that the `*` of a pattern stands for in a name; 0 where the pattern has none and is the name. `None` where
/// they do not match.
#[must_use]
pub fn matched(pattern: &str, name: &str) -> Option<u64> {
    let Some((before, after)) = pattern.split_once('*') else { return (pattern == name).then_some(0) };
    let number = name.strip_prefix(before)?.strip_suffix(after)?;
    let digits = !number.is_empty() && number.bytes().all(|byte| byte.is_ascii_digit());
    if digits { number.parse().ok() } else { None }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_star_stands_for_a_number_only() {
        assert_eq!(matched("knock_*", "knock_12"), Some(12));
        assert_eq!(matched("knock_*", "knock_max"), None);
        assert_eq!(matched("knock_*", "knock_"), None);
        assert_eq!(matched("a_*_b", "a_3_b"), Some(3));
        assert_eq!(matched("trip", "trip"), Some(0));
        assert_eq!(matched("trip", "tripe"), None);
    }

    #[test]
    fn names_are_fit_for_topics_and_environment_variables() {
        assert!(is_name("engine-1"));
        assert!(!is_name("Engine"));
        assert!(!is_name(""));
        assert!(!is_name(&"a".repeat(65)));
        assert!(is_snake_case("knock_1"));
        assert!(!is_snake_case("1_knock"));
        assert!(!is_snake_case("knock-1"));
    }
}
