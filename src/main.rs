//! The program: parse the arguments, run, exit code.

use std::process::ExitCode;

fn main() -> ExitCode {
    cangate::cli::main()
}
