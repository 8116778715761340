//! `cangate completions`: the completion script of a shell. \[IO\]

use clap::CommandFactory;

use super::args::{CommandLine, CompletionsArguments};
use super::{Exit, output};

/// Prints the script.
pub(super) fn run(options: &CompletionsArguments) -> Exit {
    let mut script = Vec::new();
    clap_complete::generate(options.shell, &mut CommandLine::command(), "cangate", &mut script);
    output::write_out(&String::from_utf8_lossy(&script), None)
}
