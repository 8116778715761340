//! What can be wrong with what a user tells the simulator.

use std::fmt;

/// Errors of this room.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum SimulatorError {
    /// A scenario file has these problems, in the order of the file.
    #[error("{}", lines(.0))]
    Scenario(Vec<Problem>),
    /// A control line is not understood, or would do nothing.
    #[error("`{line}` is not done: {reason}")]
    Control {
        /// The line.
        line: String,
        /// What is wrong, and how to mend it.
        reason: String,
    },
}

/// One problem of a scenario file: `file:line:column: error: message`, then the hint on a line of its own.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Problem {
    /// Path as the user gave it.
    pub file: String,
    /// 1-based.
    pub line: usize,
    /// 1-based, in characters.
    pub column: usize,
    /// What is wrong.
    pub message: String,
    /// How to mend it.
    pub hint: String,
}

impl fmt::Display for Problem {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}:{}:{}: error: {}", self.file, self.line, self.column, self.message)?;
        if self.hint.is_empty() { Ok(()) } else { write!(f, "\n  hint: {}", self.hint) }
    }
}

fn lines(problems: &[Problem]) -> String {
    problems.iter().map(ToString::to_string).collect::<Vec<_>>().join("\n")
}
