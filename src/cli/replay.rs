//! `cangate replay`: a candump log through the gateway's core. \[IO\]

use std::collections::BTreeSet;

use super::args::ReplayArguments;
use super::output::{print_error, print_line, read_file};
use super::{Exit, load};
use crate::can::BusIndex;
use crate::can::recording::{Record, Recording};
use crate::config::Loaded;
use crate::gateway::replay;

/// Prints what the gateway would have told, line by line.
pub(super) fn run(arguments: &ReplayArguments) -> Exit {
    let prepared = load::configuration(&arguments.config).and_then(|loaded| {
        let text = read_file(&arguments.recording)?;
        let recording = text.parse::<Recording>().map_err(|error| {
            print_error(&format!("{}: {error}", arguments.recording.display()));
            Exit::Configuration
        })?;
        let chosen = choose(&loaded, &recording, arguments.bus.as_deref()).map_err(|text| {
            print_error(&text);
            Exit::Usage
        })?;
        Ok((loaded, recording, chosen))
    });
    let (loaded, recording, (bus, interface)) = match prepared {
        Ok(prepared) => prepared,
        Err(exit) => return exit,
    };
    let records: Vec<&Record> =
        recording.records.iter().filter(|record| record.interface == interface).collect();
    let first = records.first().map(|record| record.utc).unwrap_or_default();
    let frames = records.iter().map(|record| (record.at(first), record.frame));
    for line in replay::run(&loaded.table, bus, frames) {
        if !print_line(&line) {
            break;
        }
    }
    Exit::Ok
}

/// Which bus of the configuration hears which interface of the recording.
///
/// The bus that is asked for, or the one whose interface is in the recording, or the only one; and its interface, or the
/// only one of the recording.
fn choose(loaded: &Loaded, recording: &Recording, asked: Option<&str>) -> Result<(BusIndex, String), String> {
    let recorded: BTreeSet<&str> = recording.records.iter().map(|record| record.interface.as_str()).collect();
    let buses: Vec<(usize, &str, String)> = (loaded.table.buses.iter().zip(&loaded.interfaces).enumerate())
        .map(|(index, (bus, interface))| (index, bus.name.as_str(), interface.to_string()))
        .collect();
    let known = || buses.iter().map(|(_, name, _)| *name).collect::<Vec<_>>().join(", ");
    let bus = match (asked, buses.as_slice()) {
        (Some(name), _) => buses.iter().find(|(_, known, _)| *known == name),
        (None, [only]) => Some(only),
        (None, _) => buses.iter().find(|(_, _, interface)| recorded.contains(interface.as_str())),
    };
    let (index, name, interface) =
        bus.ok_or_else(|| format!("say which bus the recording is of: `--bus NAME`, one of {}", known()))?;
    if recorded.contains(interface.as_str()) || recorded.is_empty() {
        return Ok((BusIndex(*index), interface.clone()));
    }
    match recorded.iter().copied().collect::<Vec<_>>().as_slice() {
        [only] => Ok((BusIndex(*index), (*only).to_owned())),
        several => Err(format!(
            "the recording has the interfaces {}, but bus `{name}` is on `{interface}`: cut the recording to one of them",
            several.join(", ")
        )),
    }
}
