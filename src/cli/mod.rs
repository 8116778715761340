//! The command line: one file for each subcommand, thin. \[IO\]
//!
//! Exit codes: 0 ok, 1 a comparison found a difference, a gateway is not ready or a device refused, 64 usage, 70 our
//! bug, 74 a port, a bus or a file cannot be used at the start, 78 what a file says is wrong.

mod args;
mod buffer;
pub mod check;
mod check_files;
mod check_secrets;
mod completions;
mod dcf;
mod demo;
mod eds_files;
mod esd;
mod esd_args;
mod esd_job;
mod esd_report;
mod health;
mod import;
mod init;
mod load;
mod lss;
mod lss_args;
mod lss_job;
mod man;
mod map;
mod map_frames;
mod nmt;
mod output;
mod password;
mod replay;
mod run;
mod scan;
mod scan_report;
pub mod schema;
mod sdo;
mod sdo_tag;
mod session;
pub mod sim;
mod tool_args;

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::process::ExitCode;

use clap::Parser;

pub use args::{CommandLine, Subcommand};
use output::print_error;

/// How a command ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Exit {
    /// 0: as asked.
    Ok,
    /// 1: a comparison found a difference.
    Different,
    /// 1: the gateway that was asked is not ready.
    NotReady,
    /// 1: the device that was asked refused, or did not answer.
    Refused,
    /// 64: the command line is wrong.
    Usage,
    /// 70: a bug of ours.
    Bug,
    /// 74: something outside could not be used at start: a port is taken, a file cannot be read.
    Io,
    /// 78: the content of a file is wrong: of a configuration, a mapping, a map, a recording, a scenario.
    Configuration,
}

impl Exit {
    /// The number that the shell sees (those of `sysexits.h`).
    #[must_use]
    pub fn code(self) -> u8 {
        match self {
            Self::Ok => 0,
            Self::Different | Self::NotReady | Self::Refused => 1,
            Self::Usage => 64,
            Self::Bug => 70,
            Self::Io => 74,
            Self::Configuration => 78,
        }
    }
}

/// Parses the command line and does what it says.
#[must_use]
pub fn main() -> ExitCode {
    let arguments = match CommandLine::try_parse() {
        Ok(arguments) => arguments,
        Err(error) => {
            let code = if error.use_stderr() { Exit::Usage } else { Exit::Ok };
            // Nothing is left to tell anybody when the terminal itself is gone.
            let _ = error.print();
            return ExitCode::from(code.code());
        }
    };
    if let Err(text) = crate::telemetry::start(&arguments.log, arguments.log_format) {
        print_error(&text);
        return ExitCode::from(Exit::Usage.code());
    }
    ExitCode::from(guarded(|| dispatch(arguments.command)).code())
}

fn dispatch(command: Subcommand) -> Exit {
    match command {
        Subcommand::Run(options) => run::run(&options),
        Subcommand::Demo(options) => demo::run(&options),
        Subcommand::Check(options) => check::run(&options),
        Subcommand::Map(options) => map::run(&options),
        Subcommand::Import(options) => import::run(&options),
        Subcommand::Dcf(options) => dcf::run(&options),
        Subcommand::Sim(options) => sim::command(&options),
        Subcommand::Replay(options) => replay::run(&options),
        Subcommand::Schema(options) => schema::run(&options),
        Subcommand::Completions(options) => completions::run(&options),
        Subcommand::Man(options) => man::run(&options),
        Subcommand::Buffer(arguments) => buffer::run(&arguments),
        Subcommand::Health(options) => health::run(&options),
        Subcommand::Password => password::run(),
        Subcommand::Scan(options) => scan::run(&options),
        Subcommand::Init(options) => init::run(&options),
        Subcommand::Nmt(options) => nmt::run(&options),
        Subcommand::Sdo(options) => sdo::run(&options),
        Subcommand::Lss(options) => lss::run(&options),
        Subcommand::Esd(options) => esd::run(&options),
    }
}

/// A panic ends a command with [`Exit::Bug`]; the panic hook has told where it was.
fn guarded(command: impl FnOnce() -> Exit) -> Exit {
    catch_unwind(AssertUnwindSafe(command)).unwrap_or_else(|_| {
        print_error("this is a bug in cangate; please report it with the lines above");
        Exit::Bug
    })
}

#[cfg(test)]
mod tests {
    use clap::CommandFactory;

    use super::*;

    #[test]
    fn the_command_line_is_consistent() {
        CommandLine::command().debug_assert();
    }

    #[test]
    fn every_subcommand_can_be_parsed() {
        for words in [
            &["run"][..],
            &["demo"],
            &["check", "a.toml"],
            &["map", "--format", "csv"],
            &["map", "--frames", "-c", "a.toml", "--format", "json"],
            &["map", "diff", "a.json", "b.json"],
            &["import", "a.eds", "-o", "a.toml"],
            &["import", "--list", "eds"],
            &["dcf", "-c", "a.toml", "--eds", "eds", "-o", "dcf"],
            &["dcf", "--eds", "a.eds", "tank1"],
            &["sim", "detcon", "-i", "vcan0", "--node", "1"],
            &["replay", "bus.log"],
            &["schema", "config"],
            &["completions", "bash"],
            &["man"],
            &["password"],
            &["health", "http://127.0.0.1:8080/readyz"],
            &["scan", "-i", "can0"],
            &["scan", "-i", "can0", "--active", "--nodes", "1-10", "--format", "json"],
            &["init", "-i", "can0", "-o", "new.toml", "--force"],
            &["init", "--scan-file", "scan.json"],
            &["nmt", "-i", "can0", "start", "1"],
            &["nmt", "-i", "can0", "reset-node", "all", "--yes"],
            &["sdo", "-i", "can0", "--node", "1", "read", "0x1000:0"],
            &["lss", "-i", "can0", "scan", "--vendor", "0x23D", "--product", "1"],
            &["lss", "-i", "can0", "set-node-id", "--node", "1", "--to", "5", "--bit-rate", "250"],
            &["lss", "-i", "can0", "inquire", "--only-one-device"],
            &["esd", "scan", "-i", "can0", "--reply-id", "0x6E0", "--all"],
            &["esd", "reset", "-i", "can0", "--all", "--yes"],
            &["sdo", "-i", "can0", "--node", "1", "write", "0x6124:1", "-1.5", "--type", "f32"],
        ] {
            let line = std::iter::once("cangate").chain(words.iter().copied());
            assert!(CommandLine::try_parse_from(line).is_ok(), "{words:?}");
        }
    }

    #[test]
    fn a_panic_is_our_bug() {
        assert_eq!(guarded(|| panic!("for the test")), Exit::Bug);
        assert_eq!(guarded(|| Exit::Different), Exit::Different);
    }

    #[test]
    fn exit_codes_are_those_of_the_contract() {
        let all = [Exit::Ok, Exit::Different, Exit::Usage, Exit::Bug, Exit::Io, Exit::Configuration];
        assert_eq!(all.map(Exit::code), [0, 1, 64, 70, 74, 78]);
    }
}
