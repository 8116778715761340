//! `cangate run`: the gateway. \[IO\]

use tokio_util::sync::CancellationToken;

use super::args::RunArguments;
use super::output::{block_on, print_error};
use super::{Exit, load};
use crate::supervisor::{self, Ended, Installation, Tasks, shutdown};
use crate::time::Clock;

/// Runs until a signal.
pub(super) fn run(options: &RunArguments) -> Exit {
    match load::installation(&options.config) {
        Ok(installation) => block_on(serve(installation)),
        Err(exit) => exit,
    }
}

/// Binds, runs, stops.
async fn serve(installation: Installation) -> Exit {
    let stop = CancellationToken::new();
    if let Err(error) = shutdown::on_signal(stop.clone()) {
        print_error(&format!("signals cannot be handled: {error}"));
        return Exit::Io;
    }
    match supervisor::bind(installation, Clock::start()).await {
        Ok(bound) => ended(&bound.run(Tasks::default(), stop).await),
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
