//! `cangate map`: the register and topic map; `--frames`: what may be sent; `cangate map diff`: what moved. \[IO\]

use std::path::Path;

use super::args::{MapArguments, MapCommand};
use super::output::{print_error, print_line, read_file, write_out};
use super::{Exit, load, map_frames};
use crate::modbus::map_text;

/// Writes the map, or compares two.
pub(super) fn run(arguments: &MapArguments) -> Exit {
    if let Some(MapCommand::Diff { old, new }) = &arguments.command {
        return diff(old, new).unwrap_or_else(|exit| exit);
    }
    match text(arguments) {
        Ok(text) => write_out(&text, arguments.output.as_deref()),
        Err(exit) => exit,
    }
}

fn text(arguments: &MapArguments) -> Result<String, Exit> {
    let loaded = load::configuration(&arguments.config)?;
    if arguments.frames {
        return map_frames::text(&loaded.table, arguments.format);
    }
    Ok(map_text::render(&load::register_map(&loaded)?, arguments.format))
}

fn diff(old: &Path, new: &Path) -> Result<Exit, Exit> {
    let diff = map_text::diff(&read_file(old)?, &read_file(new)?).map_err(|error| {
        print_error(&format!("{error}: {}; write maps with `cangate map --format json`", error.source));
        Exit::Configuration
    })?;
    for line in &diff.lines {
        if !print_line(line) {
            break;
        }
    }
    Ok(if diff.breaking { Exit::Different } else { Exit::Ok })
}
