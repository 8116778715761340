//! Messages about one EDS file, each with its line and column. They are bounded: a file can be wrong in every line.

use crate::mapping::{Diagnostic, Severity};

/// Warnings about one file that are told one by one; the rest is counted.
const MOST_WARNINGS: usize = 200;

/// Where something stands in a file.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord)]
pub struct Place {
    /// 1-based; 0 where the file as a whole is meant.
    pub line: usize,
    /// 1-based, in characters.
    pub column: usize,
}

impl Place {
    /// Where a file begins: for what is missing in it.
    pub const START: Self = Self { line: 1, column: 1 };
}

/// What was found in one file so far.
#[derive(Clone, Debug, Default)]
pub struct Report {
    file: String,
    list: Vec<Diagnostic>,
    warnings: usize,
}

impl Report {
    /// Nothing found yet in a file of this name.
    #[must_use]
    pub fn new(file: impl Into<String>) -> Self {
        Self { file: file.into(), list: Vec::new(), warnings: 0 }
    }

    /// Something that works, but is not as it should be. From the 201st on only counted.
    pub fn warn(&mut self, place: Place, message: impl Into<String>, hint: impl Into<String>) {
        self.warnings += 1;
        if self.warnings <= MOST_WARNINGS {
            self.push(Severity::Warning, place, message.into(), hint.into());
        }
    }

    /// Something because of which the file cannot be used.
    pub fn error(&mut self, place: Place, message: impl Into<String>, hint: impl Into<String>) {
        self.push(Severity::Error, place, message.into(), hint.into());
    }

    fn push(&mut self, severity: Severity, place: Place, message: String, hint: String) {
        let file = self.file.clone();
        let Place { line, column } = place;
        self.list.push(Diagnostic {
            severity,
            file,
            line: line.max(1),
            column: column.max(1),
            message,
            hint,
        });
    }

    /// All of them by line, and how many were too many.
    #[must_use]
    pub fn finish(mut self) -> Vec<Diagnostic> {
        self.list.sort_by_key(|problem| (problem.line, problem.column));
        if self.warnings > MOST_WARNINGS {
            let more = self.warnings - MOST_WARNINGS;
            let last = self.list.last().map_or(Place::START, |last| Place { line: last.line, column: 1 });
            self.push(Severity::Warning, last, format!("{more} more warnings"), String::new());
        }
        self.list
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn warnings_come_by_line_and_those_above_the_limit_are_counted() {
        let mut report = Report::new("a.eds");
        for line in (1..=MOST_WARNINGS + 3).rev() {
            report.warn(Place { line, column: 1 }, "odd", "");
        }
        report.error(Place::START, "wrong", "");
        let list = report.finish();
        assert_eq!(list.len(), MOST_WARNINGS + 2);
        assert!(list.iter().any(|problem| problem.severity == Severity::Error));
        assert_eq!(list.last().unwrap().message, "3 more warnings");
        assert!(list.windows(2).all(|pair| pair[0].line <= pair[1].line));
    }
}
