//! The named tasks of the process: started together, watched, stopped together. \[IO\]

use std::time::Duration;

use tokio::task::{Id, JoinError, JoinSet};
use tokio_util::sync::CancellationToken;
use tracing::{debug, error};

/// How long the tasks have to end once they are told to stop.
pub const SHUTDOWN_LIMIT: Duration = Duration::from_secs(5);

/// The tasks of the process.
///
/// Every task runs until it is told to stop; whatever the outside world does to it, it handles itself and tries again.
/// So a task that ends by itself, or panics, is a bug of ours: the process stops in order and says so.
#[derive(Debug, Default)]
pub struct Tasks {
    set: JoinSet<()>,
    names: Vec<(Id, String)>,
}

/// Why the tasks ended.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Ended {
    /// They were told to.
    Stopped,
    /// A task ended that should not have: a bug of ours.
    Bug {
        /// Which.
        task: String,
    },
}

impl Tasks {
    /// Starts a task.
    pub fn spawn(&mut self, name: impl Into<String>, task: impl Future<Output = ()> + Send + 'static) {
        let handle = self.set.spawn(task);
        self.names.push((handle.id(), name.into()));
    }

    /// Waits until `stop` is cancelled or a task ends by itself; then stops all and waits for them, at most
    /// [`SHUTDOWN_LIMIT`]. A task that panics is a bug at any time, also while it stops.
    pub async fn run(mut self, stop: CancellationToken) -> Ended {
        let early = tokio::select! {
            () = stop.cancelled() => None,
            ended = self.set.join_next_with_id() => ended,
        };
        // Told to stop and ended in the same moment: in order, unless it panicked.
        let early = early.filter(|result| !stop.is_cancelled() || panicked(result));
        let mut ended = match early {
            None => Ended::Stopped,
            Some(result) => {
                let task = self.name(id(&result));
                error!(
                    task,
                    cause = describe(&result),
                    "a task ended by itself: this is a bug in cangate; stopping"
                );
                Ended::Bug { task }
            }
        };
        stop.cancel();
        let all = async {
            while let Some(result) = self.set.join_next_with_id().await {
                let task = self.name(id(&result));
                if !panicked(&result) {
                    debug!(task, "ended");
                    continue;
                }
                error!(task, "a task panicked while stopping: this is a bug in cangate");
                if ended == Ended::Stopped {
                    ended = Ended::Bug { task };
                }
            }
        };
        if tokio::time::timeout(SHUTDOWN_LIMIT, all).await.is_err() {
            error!("some tasks did not end within {} s; leaving them", SHUTDOWN_LIMIT.as_secs());
        }
        ended
    }

    fn name(&self, id: Id) -> String {
        self.names
            .iter()
            .find(|(known, _)| *known == id)
            .map_or_else(|| "unknown".to_owned(), |(_, name)| name.clone())
    }
}

fn id(result: &Result<(Id, ()), JoinError>) -> Id {
    match result {
        Ok((id, ())) => *id,
        Err(error) => error.id(),
    }
}

fn panicked(result: &Result<(Id, ()), JoinError>) -> bool {
    result.as_ref().is_err_and(JoinError::is_panic)
}

fn describe(result: &Result<(Id, ()), JoinError>) -> &'static str {
    match result {
        Ok(_) => "it returned",
        Err(error) if error.is_panic() => "it panicked",
        Err(_) => "it was aborted",
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test(start_paused = true)]
    async fn all_tasks_are_stopped_together() {
        let stop = CancellationToken::new();
        let mut tasks = Tasks::default();
        for name in ["one", "two"] {
            tasks.spawn(name, stop.clone().cancelled_owned());
        }
        stop.cancel();
        assert_eq!(tasks.run(stop).await, Ended::Stopped);
    }

    #[tokio::test(start_paused = true)]
    async fn a_task_that_ends_by_itself_stops_the_others_and_is_named() {
        let stop = CancellationToken::new();
        let mut tasks = Tasks::default();
        tasks.spawn("steady", stop.clone().cancelled_owned());
        tasks.spawn("broken", async {});
        assert_eq!(tasks.run(stop.clone()).await, Ended::Bug { task: "broken".into() });
        assert!(stop.is_cancelled());
    }

    #[tokio::test(start_paused = true)]
    async fn a_panic_in_a_task_does_not_take_the_process_with_it() {
        let stop = CancellationToken::new();
        let mut tasks = Tasks::default();
        tasks.spawn("broken", async { panic!("for the test") });
        assert_eq!(tasks.run(stop).await, Ended::Bug { task: "broken".into() });
    }

    #[tokio::test(start_paused = true)]
    async fn a_panic_while_stopping_is_a_bug_too_and_the_first_cause_is_named() {
        let at_the_stop = |stop: &CancellationToken| {
            let stop = stop.clone();
            async move {
                stop.cancelled().await;
                panic!("for the test")
            }
        };
        let stop = CancellationToken::new();
        let mut tasks = Tasks::default();
        tasks.spawn("steady", stop.clone().cancelled_owned());
        tasks.spawn("broken", at_the_stop(&stop));
        stop.cancel();
        assert_eq!(tasks.run(stop).await, Ended::Bug { task: "broken".into() });

        let stop = CancellationToken::new();
        let mut tasks = Tasks::default();
        tasks.spawn("first", async {});
        tasks.spawn("second", at_the_stop(&stop));
        assert_eq!(tasks.run(stop).await, Ended::Bug { task: "first".into() });
    }

    #[tokio::test(start_paused = true)]
    async fn a_panic_in_the_moment_of_the_stop_is_a_bug() {
        let stop = CancellationToken::new();
        let mut tasks = Tasks::default();
        tasks.spawn("broken", async { panic!("for the test") });
        // It has ended before anybody looks.
        tokio::task::yield_now().await;
        stop.cancel();
        assert_eq!(tasks.run(stop).await, Ended::Bug { task: "broken".into() });
    }

    #[tokio::test(start_paused = true)]
    async fn a_task_that_does_not_stop_is_left_behind_in_time() {
        let stop = CancellationToken::new();
        let mut tasks = Tasks::default();
        tasks.spawn("deaf", std::future::pending());
        stop.cancel();
        assert_eq!(tasks.run(stop).await, Ended::Stopped);
    }
}
