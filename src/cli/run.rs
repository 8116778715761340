//! `cangate run`: the gateway. \[IO\]

use std::sync::Arc;

use super::args::RunArguments;
use super::load::Reader;
use super::output::{block_on, print_diagnostics, print_error, print_text, stop_on_signal};
use super::{Exit, load};
use crate::config::DEFAULT_STATE_DIR;
use crate::supervisor::shutdown::on_hang_up;
use crate::supervisor::{self, Ended, Fresh, LastGood, Refusal, Reloads, Tasks};
use crate::time::Clock;

/// Runs until a signal.
pub(super) fn run(options: &RunArguments) -> Exit {
    let reader = Reader::new(&options.config);
    let last_good = match &options.state_dir {
        Some(folder) => Some(LastGood::new(folder)),
        None => LastGood::if_writable(DEFAULT_STATE_DIR),
    };
    match first(options, &reader, last_good.as_ref()) {
        Ok((fresh, refused)) => block_on(serve(options, reader, last_good, fresh, refused)),
        Err(exit) => exit,
    }
}

/// What is started: the file, or where that is bad the last good one, with what is wrong with the file.
fn first(
    options: &RunArguments,
    reader: &Reader,
    last_good: Option<&LastGood>,
) -> Result<(Fresh, Option<Refusal>), Exit> {
    let refusal = match reader.read() {
        Ok(fresh) => {
            print_diagnostics(&fresh.warnings);
            return Ok((fresh, None));
        }
        Err(refusal) => refusal,
    };
    let kept = last_good.and_then(|place| place.read().ok());
    match kept.and_then(|kept| reader.read_kept(&kept).ok()) {
        Some(fresh) => {
            for problem in &refusal.problems {
                print_text(problem);
            }
            print_error(
                "this configuration is BAD; the last good one is started instead. Mend the file and send SIGHUP",
            );
            Ok((fresh, Some(refusal)))
        }
        // As ever: everything that is wrong, and the exit code that says so.
        None => Err(load::installation(&options.config).err().unwrap_or(Exit::Configuration)),
    }
}

/// Binds, runs, stops.
async fn serve(
    options: &RunArguments,
    reader: Reader,
    last_good: Option<LastGood>,
    fresh: Fresh,
    refused_at_start: Option<Refusal>,
) -> Exit {
    let stop = match stop_on_signal() {
        Ok(stop) => stop,
        Err(exit) => return exit,
    };
    let asked = match on_hang_up() {
        Ok(asked) => asked,
        Err(error) => {
            print_error(&format!("SIGHUP cannot be handled: {error}"));
            return Exit::Io;
        }
    };
    let reloads = Reloads {
        read: Some(Arc::new(move || reader.read())),
        asked,
        allow_map_change: options.allow_map_change,
        started_with: Some(fresh.sources),
        refused_at_start,
        last_good,
    };
    match supervisor::bind(fresh.installation, Clock::start()).await {
        Ok(bound) => ended(&Box::pin(bound.run_with_reloads(Tasks::default(), stop, reloads)).await),
        Err(error) => {
            print_error(&error.to_string());
            Exit::Io
        }
    }
}

/// The exit code of a run.
pub(super) fn ended(ended: &Ended) -> Exit {
    match ended {
        Ended::Stopped => Exit::Ok,
        Ended::Bug { .. } => Exit::Bug,
    }
}
