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
    /// Those that can be stopped alone.
    parts: Vec<(Id, CancellationToken)>,
    /// Those that were told to stop, did not in time, and are left to it: that they end at last is no bug.
    left: Vec<Id>,
    /// One ended by itself while another was waited for.
    early: Option<Result<(Id, ()), JoinError>>,
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

    /// Starts a task that can be [stopped](Self::stop_part) alone, by a token that also ends with `stop`.
    pub fn spawn_part<F: Future<Output = ()> + Send + 'static>(
        &mut self,
        name: impl Into<String>,
        stop: &CancellationToken,
        task: impl FnOnce(CancellationToken) -> F,
    ) {
        let own = stop.child_token();
        let handle = self.set.spawn(task(own.clone()));
        self.names.push((handle.id(), name.into()));
        self.parts.push((handle.id(), own));
    }

    /// Stops the parts of this name and waits until they have ended, at most [`SHUTDOWN_LIMIT`]. Nothing where there is none.
    pub async fn stop_part(&mut self, name: &str) {
        self.stop_part_within(name, SHUTDOWN_LIMIT).await;
    }

    /// The same with a limit of its own. A part that takes longer is left to end when it will.
    pub async fn stop_part_within(&mut self, name: &str, limit: Duration) {
        let of_name = |id: &Id| self.names.iter().any(|(known, each)| known == id && each == name);
        let mut waiting: Vec<Id> = Vec::new();
        for (id, stop) in self.parts.iter().filter(|(id, _)| of_name(id)) {
            stop.cancel();
            waiting.push(*id);
        }
        self.parts.retain(|(id, _)| !waiting.contains(id));
        let all = async {
            while !waiting.is_empty()
                && let Some(result) = self.set.join_next_with_id().await
            {
                let ended = id(&result);
                let known = waiting.iter().position(|each| *each == ended).map(|place| waiting.remove(place));
                if known.is_none() || panicked(&result) {
                    self.note(result);
                }
            }
        };
        if tokio::time::timeout(limit, all).await.is_err() {
            error!(task = name, "did not end within {} s; leaving it", limit.as_secs());
            self.left.extend(waiting);
        }
    }

    /// Waits until a task ends by itself, which none should. Cancel-safe.
    pub async fn ended_early(&mut self) {
        while self.early.is_none() {
            match self.set.join_next_with_id().await {
                Some(result) => self.note(result),
                None => std::future::pending().await,
            }
        }
    }

    /// A task ended that nobody waits for.
    fn note(&mut self, result: Result<(Id, ()), JoinError>) {
        let ended = id(&result);
        self.parts.retain(|(part, _)| *part != ended);
        let was_left = self.left.iter().position(|left| *left == ended).map(|place| self.left.remove(place));
        if was_left.is_none() || panicked(&result) {
            self.early.get_or_insert(result);
        }
    }

    /// Waits until `stop` is cancelled or a task ends by itself; then stops all and waits for them, at most
    /// [`SHUTDOWN_LIMIT`]. A task that panics is a bug at any time, also while it stops.
    pub async fn run(mut self, stop: CancellationToken) -> Ended {
        tokio::select! {
            () = stop.cancelled() => {}
            () = self.ended_early() => {}
        }
        let early = self.early.take();
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
    async fn a_part_is_stopped_alone_and_another_that_ends_meanwhile_is_not_forgotten() {
        let stop = CancellationToken::new();
        let mut tasks = Tasks::default();
        tasks.spawn("steady", stop.clone().cancelled_owned());
        for _ in 0..2 {
            tasks.spawn_part("part", &stop, |stop| async move {
                stop.cancelled().await;
                tokio::time::sleep(Duration::from_secs(1)).await;
            });
        }
        tasks.stop_part("nobody").await;
        tasks.stop_part("part").await;
        assert_eq!((tasks.set.len(), tasks.parts.len()), (1, 0));
        assert!(tokio::time::timeout(Duration::from_secs(1), tasks.ended_early()).await.is_err());
        tasks.spawn("broken", tokio::time::sleep(Duration::from_millis(500)));
        tasks.spawn_part("part", &stop, |stop| async move {
            stop.cancelled().await;
            tokio::time::sleep(Duration::from_secs(1)).await;
        });
        tasks.stop_part("part").await;
        tasks.ended_early().await;
        assert_eq!(tasks.run(stop.clone()).await, Ended::Bug { task: "broken".into() });
        assert!(stop.is_cancelled());
    }

    #[tokio::test(start_paused = true)]
    async fn a_part_that_is_late_is_left_and_may_end_when_it_will_unless_it_panics() {
        let stop = CancellationToken::new();
        let mut tasks = Tasks::default();
        tasks.spawn("steady", stop.clone().cancelled_owned());
        let late = |end: fn()| {
            move |stop: CancellationToken| async move {
                stop.cancelled().await;
                tokio::time::sleep(SHUTDOWN_LIMIT * 2).await;
                end();
            }
        };
        tasks.spawn_part("part", &stop, late(|| {}));
        tasks.stop_part("part").await;
        assert!(tasks.parts.is_empty());
        // Another of its name runs by now.
        tasks.spawn_part("part", &stop, late(|| {}));
        assert!(tokio::time::timeout(SHUTDOWN_LIMIT * 4, tasks.ended_early()).await.is_err());
        tasks.stop_part_within("part", SHUTDOWN_LIMIT * 3).await;
        assert_eq!((tasks.set.len(), tasks.left.len()), (1, 0));
        tasks.spawn_part("part", &stop, late(|| panic!("for the test")));
        tasks.stop_part("part").await;
        tasks.ended_early().await;
        assert_eq!(tasks.run(stop).await, Ended::Bug { task: "part".into() });
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
