//! `cangate man`: the manual pages. \[IO\]

use std::path::Path;

use clap::CommandFactory;
use clap_mangen::Man;

use super::Exit;
use super::args::{CommandLine, ManArguments};
use super::output::{print_error, write_out};

/// Prints the page of the program, or writes one for each command.
pub(super) fn run(arguments: &ManArguments) -> Exit {
    match &arguments.output {
        Some(folder) => write_all(folder),
        None => write_out(&page(), None),
    }
}

fn page() -> String {
    let mut page = Vec::new();
    // Writing into memory does not fail.
    let _ = Man::new(CommandLine::command()).render(&mut page);
    String::from_utf8_lossy(&page).into_owned()
}

fn write_all(folder: &Path) -> Exit {
    match clap_mangen::generate_to(CommandLine::command(), folder) {
        Ok(()) => Exit::Ok,
        Err(error) => {
            print_error(&format!("cannot write manual pages into {}: {error}", folder.display()));
            Exit::Io
        }
    }
}
