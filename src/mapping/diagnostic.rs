//! Messages about files: what is wrong, where, and how to mend it.

use std::fmt;
use std::ops::Range;

/// How bad.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Severity {
    /// Works, but is probably not meant.
    Warning,
    /// Does not work.
    Error,
}

/// One message: `file:line:column: error: message`, then the hint on a line of its own. What has no lines, as an
/// environment variable, is told without them.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Diagnostic {
    /// Error or warning.
    pub severity: Severity,
    /// Path as the user gave it.
    pub file: String,
    /// 1-based; 0 where there are no lines.
    pub line: usize,
    /// 1-based, in characters; 0 where there are no lines.
    pub column: usize,
    /// What is wrong.
    pub message: String,
    /// How to mend it.
    pub hint: String,
}

impl Diagnostic {
    /// An error in something that has no lines.
    #[must_use]
    pub fn without_place(
        what: impl Into<String>,
        message: impl Into<String>,
        hint: impl Into<String>,
    ) -> Self {
        Self {
            severity: Severity::Error,
            file: what.into(),
            line: 0,
            column: 0,
            message: message.into(),
            hint: hint.into(),
        }
    }
}

impl fmt::Display for Diagnostic {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let severity = match self.severity {
            Severity::Warning => "warning",
            Severity::Error => "error",
        };
        write!(f, "{}", self.file)?;
        if self.line > 0 {
            write!(f, ":{}:{}", self.line, self.column)?;
        }
        write!(f, ": {severity}: {}", self.message)?;
        if !self.hint.is_empty() {
            write!(f, "\n  hint: {}", self.hint)?;
        }
        Ok(())
    }
}

/// A file's name and text, to find lines and columns in.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct SourceText {
    /// Path as the user gave it.
    pub name: String,
    /// Its content.
    pub text: String,
}

impl SourceText {
    /// A named text.
    #[must_use]
    pub fn new(name: impl Into<String>, text: impl Into<String>) -> Self {
        Self { name: name.into(), text: text.into() }
    }

    /// 1-based line and column (in characters) of a byte offset; the end of the text for one beyond it.
    #[must_use]
    pub fn position(&self, offset: usize) -> (usize, usize) {
        let before: String =
            self.text.char_indices().take_while(|(at, _)| *at < offset).map(|(_, c)| c).collect();
        let line = before.matches('\n').count() + 1;
        let column = before.rsplit('\n').next().map_or(0, |rest| rest.chars().count()) + 1;
        (line, column)
    }

    /// An error at a byte range.
    #[must_use]
    pub fn error(
        &self,
        span: &Range<usize>,
        message: impl Into<String>,
        hint: impl Into<String>,
    ) -> Diagnostic {
        let (line, column) = self.position(span.start);
        Diagnostic {
            severity: Severity::Error,
            file: self.name.clone(),
            line,
            column,
            message: message.into(),
            hint: hint.into(),
        }
    }

    /// A warning at a byte range.
    #[must_use]
    pub fn warning(
        &self,
        span: &Range<usize>,
        message: impl Into<String>,
        hint: impl Into<String>,
    ) -> Diagnostic {
        Diagnostic { severity: Severity::Warning, ..self.error(span, message, hint) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn positions_count_lines_and_characters_from_one() {
        let source = SourceText::new("m.toml", "a = 1\nä = 2\n");
        assert_eq!(source.position(0), (1, 1));
        assert_eq!(source.position(6), (2, 1));
        assert_eq!(source.position(8), (2, 2));
        assert_eq!(source.position(999), (3, 1));
    }

    #[test]
    fn a_message_says_what_where_and_how_to_mend_it() {
        let source = SourceText::new("m.toml", "a = 1\nb = 2\n");
        let text = source.error(&(6..7), "unknown key `b`", "known keys are: a").to_string();
        assert_eq!(text, "m.toml:2:1: error: unknown key `b`\n  hint: known keys are: a");
        let text = Diagnostic::without_place("variable X", "it is empty", "").to_string();
        assert_eq!(text, "variable X: error: it is empty");
    }
}
