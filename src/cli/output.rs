//! What every command needs: printing, files, a runtime, the order to stop. \[IO\]
//!
//! It is the only place that writes to standard output and standard error.

use std::io::{self, Write};
use std::path::Path;
use std::time::Duration;

use tokio_util::sync::CancellationToken;

use super::Exit;
use crate::mapping::Diagnostic;
use crate::supervisor::shutdown;

/// A line for the user on standard output. `false` when nobody reads any more (`| head`).
pub(super) fn print_line(text: &str) -> bool {
    writeln!(io::stdout().lock(), "{text}").is_ok()
}

/// A line on standard error.
pub(super) fn print_error(text: &str) {
    // If standard error is gone there is nowhere left to say so.
    let _ = writeln!(io::stderr().lock(), "cangate: {text}");
}

/// A text on standard error, as it is.
pub(super) fn print_text(text: &str) {
    let _ = writeln!(io::stderr().lock(), "{text}");
}

/// All diagnostics on standard error.
pub(super) fn print_diagnostics(diagnostics: &[Diagnostic]) {
    for diagnostic in diagnostics {
        print_text(&diagnostic.to_string());
    }
}

/// Writes a text to a file, or to standard output without one.
pub(super) fn write_out(text: &str, file: Option<&Path>) -> Exit {
    write_bytes(text.as_bytes(), file)
}

/// The same for a text of another character set.
pub(super) fn write_bytes(bytes: &[u8], file: Option<&Path>) -> Exit {
    let written = match file {
        Some(file) => {
            std::fs::write(file, bytes).map_err(|error| format!("cannot write {}: {error}", file.display()))
        }
        None => io::stdout()
            .lock()
            .write_all(bytes)
            .or_else(|error| if error.kind() == io::ErrorKind::BrokenPipe { Ok(()) } else { Err(error) })
            .map_err(|error| format!("cannot write to standard output: {error}")),
    };
    match written {
        Ok(()) => Exit::Ok,
        Err(text) => {
            print_error(&text);
            Exit::Io
        }
    }
}

/// Reads a text file, or says why not.
pub(super) fn read_file(path: &Path) -> Result<String, Exit> {
    std::fs::read_to_string(path).map_err(|error| {
        print_error(&format!("cannot read {}: {error}", path.display()));
        Exit::Io
    })
}

/// How long the end waits for threads that are held up in the system: one that asks a name server which does not answer
/// would hold the process for half a minute.
const LEAVE_BEHIND: Duration = Duration::from_millis(500);

/// What SIGTERM and SIGINT cancel; a second one ends the process at once. To be called on a runtime.
pub(super) fn stop_on_signal() -> Result<CancellationToken, Exit> {
    let stop = CancellationToken::new();
    match shutdown::on_signal(stop.clone()) {
        Ok(()) => Ok(stop),
        Err(error) => {
            print_error(&format!("signals cannot be handled: {error}"));
            Err(Exit::Io)
        }
    }
}

/// Runs a future on a new runtime. What still runs when it ends is left behind.
pub(super) fn block_on(future: impl Future<Output = Exit>) -> Exit {
    match tokio::runtime::Builder::new_multi_thread().enable_all().build() {
        Ok(runtime) => {
            let exit = runtime.block_on(future);
            runtime.shutdown_timeout(LEAVE_BEHIND);
            exit
        }
        Err(error) => {
            print_error(&format!("the runtime cannot be started: {error}"));
            Exit::Io
        }
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;
    use std::sync::atomic::{AtomicBool, Ordering};
    use std::sync::mpsc;

    use super::*;

    #[test]
    fn a_thread_that_is_held_up_does_not_hold_up_the_end() {
        let (release, held) = mpsc::sync_channel::<()>(1);
        let over = Arc::new(AtomicBool::new(false));
        let told = Arc::clone(&over);
        let exit = block_on(async move {
            let (begun, begins) = tokio::sync::oneshot::channel();
            tokio::task::spawn_blocking(move || {
                begun.send(()).unwrap();
                // As getaddrinfo does; long, so that a runtime that waits fails this test instead of hanging in it.
                let _ = held.recv_timeout(Duration::from_secs(60));
                told.store(true, Ordering::SeqCst);
            });
            begins.await.unwrap();
            Exit::Ok
        });
        assert_eq!(exit, Exit::Ok);
        assert!(!over.load(Ordering::SeqCst), "the thread was waited for");
        drop(release);
    }
}
