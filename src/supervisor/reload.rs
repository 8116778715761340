//! Takes in another configuration while everything runs: read, check, plan, apply. \[IO\]
//!
//! **A bad file changes nothing.** Everything that can fail comes first: the files are read and checked as a whole, the map is
//! compared with the one that PLCs rely on, new addresses are tried. Only then is anything touched, and nothing of that can be
//! refused any more (`Running::apply`). What a file says is never taken in part: settings that are missing there have their
//! defaults, as at the start.
//!
//! It is asked for by SIGHUP, or by files that changed where `[gateway] reload = "watch"`. Files are looked at once a second rather than
//! watched by the kernel: that works on every file system and mount, and one that is being written has to stay as it is from one look to
//! the next before it is read.

use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use tokio::sync::mpsc;
use tokio::time::{MissedTickBehavior, interval};
use tracing::{error, info, warn};

use super::last_good::{LastGood, Looks, Sources};
use super::listeners;
use super::plan::Plan;
use super::running::Running;
use super::wiring::Installation;
use crate::config::ReloadMode;
use crate::gateway::order::Order;
use crate::mapping::Diagnostic;
use crate::modbus::security::door;
use crate::slots::listening;
use crate::tls::{ServerKeeper, TlsError};
use crate::web::line::Security;

/// How often files are looked at.
const LOOK: Duration = Duration::from_secs(1);
/// Problems that an event tells one by one.
const TOLD: usize = 3;

/// Reads and checks the configuration as it is now.
pub type Read = Arc<dyn Fn() -> Result<Fresh, Refusal> + Send + Sync>;

/// A configuration in which nothing is wrong.
#[derive(Clone, Debug)]
pub struct Fresh {
    /// What it asks for.
    pub installation: Installation,
    /// Its texts.
    pub sources: Sources,
    /// What works but is probably not meant.
    pub warnings: Vec<Diagnostic>,
}

/// What was read and tried before anything is touched.
#[derive(Debug, Default)]
pub(super) struct Prepared {
    /// Certificates of Modbus/TCP Security, where that begins anew.
    pub(super) keeper: Option<Arc<ServerKeeper>>,
}

/// Why a configuration is not taken in.
#[derive(Clone, Debug, Default)]
pub struct Refusal {
    /// Everything that is wrong, with file, line and column where there are any.
    pub problems: Vec<String>,
    /// Files that were looked at.
    pub files: Vec<PathBuf>,
}

impl Refusal {
    fn of(problem: impl Into<String>) -> Self {
        Self { problems: vec![problem.into()], files: Vec::new() }
    }

    /// In one line: the first problems, and how many more there are.
    #[must_use]
    pub fn summary(&self) -> String {
        let first: Vec<String> =
            self.problems.iter().take(TOLD).map(|problem| problem.replace("\n  hint: ", "; ")).collect();
        let more = self.problems.len().saturating_sub(TOLD);
        let more = if more == 0 { String::new() } else { format!(" | and {more} more") };
        first.join(" | ") + &more
    }
}

/// Where other configurations come from.
pub struct Reloads {
    /// `None`: none ever does.
    pub read: Option<Read>,
    /// Somebody asks for one.
    pub asked: mpsc::Receiver<()>,
    /// Published addresses may change their meaning, whatever the file says of that.
    pub allow_map_change: bool,
    /// What the program started with.
    pub started_with: Option<Sources>,
    /// The file was refused at the start, and the last good one runs.
    pub refused_at_start: Option<Refusal>,
    /// Where the last good one is kept.
    pub last_good: Option<LastGood>,
}

impl std::fmt::Debug for Reloads {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Reloads").field("allow_map_change", &self.allow_map_change).finish_non_exhaustive()
    }
}

impl Reloads {
    /// No other configuration ever comes.
    #[must_use]
    pub fn none(asked: mpsc::Receiver<()>) -> Self {
        Self {
            read: None,
            asked,
            allow_map_change: false,
            started_with: None,
            refused_at_start: None,
            last_good: None,
        }
    }
}

/// Takes in what is asked for until the program stops or a task ends by itself.
pub(super) async fn run(running: &mut Running, mut reloads: Reloads) {
    let mut looks = reloads.started_with.as_ref().map_or_else(|| Looks::new(Vec::new()), Looks::of);
    if let Some(refusal) = reloads.refused_at_start.take() {
        looks = Looks::new(refusal.files.clone());
        refuse(running, &refusal).await;
    } else if let Some(sources) = &reloads.started_with {
        keep(&mut reloads.last_good, sources);
    }
    let mut second = interval(LOOK);
    second.set_missed_tick_behavior(MissedTickBehavior::Skip);
    let stop = running.stop.clone();
    let mut nobody_asks = false;
    loop {
        let mode = running.installation.reload.mode;
        tokio::select! {
            () = stop.cancelled() => return,
            () = running.tasks.ended_early() => return,
            asked = reloads.asked.recv(), if !nobody_asks => match asked {
                Some(()) if mode == ReloadMode::Off => warn!("SIGHUP: nothing is read, as [gateway] reload = \"off\""),
                Some(()) => reload(running, &mut reloads, &mut looks).await,
                None => nobody_asks = true,
            },
            _ = second.tick(), if mode == ReloadMode::Watch => {
                if looks.have_changed() {
                    info!("a file of the configuration changed");
                    reload(running, &mut reloads, &mut looks).await;
                }
            }
        }
    }
}

/// A stop is heard at any moment of it, whatever file or address makes it wait: what is half done then ends with all else.
async fn reload(running: &mut Running, reloads: &mut Reloads, looks: &mut Looks) {
    let stop = running.stop.clone();
    tokio::select! {
        () = stop.cancelled() => {}
        () = Box::pin(read_and_take_in(running, reloads, looks)) => {}
    }
}

async fn read_and_take_in(running: &mut Running, reloads: &mut Reloads, looks: &mut Looks) {
    let Some(read) = reloads.read.clone() else { return };
    // What is read is not older than this look, so that no change is missed.
    looks.take();
    let read = tokio::task::spawn_blocking(move || read()).await;
    let outcome = match read {
        Ok(Ok(fresh)) => {
            let checked = check(running, &fresh, reloads.allow_map_change).await;
            checked.map(|(plan, prepared)| (fresh, plan, prepared))
        }
        Ok(Err(refusal)) => Err(refusal),
        Err(_) => Err(Refusal::of("reading the configuration panicked: this is a bug in cangate")),
    };
    match outcome {
        Ok((fresh, plan, prepared)) => {
            for warning in &fresh.warnings {
                warn!("{warning}");
            }
            looks.watch(&fresh.sources);
            take_in(running, fresh.installation, &plan, prepared).await;
            keep(&mut reloads.last_good, &fresh.sources);
        }
        Err(refusal) => {
            looks.watch_too(&refusal.files);
            refuse(running, &refusal).await;
        }
    }
}

/// What changes, unless something speaks against it. Touches nothing.
async fn check(
    running: &Running,
    fresh: &Fresh,
    allow_map_change: bool,
) -> Result<(Plan, Prepared), Refusal> {
    let new = &fresh.installation;
    let mut plan = Plan::new(&running.installation, new);
    plan.listen_again(running.lost.keys().copied());
    if !plan.map_breaks.is_empty() && !allow_map_change && !new.reload.allow_map_change {
        let name = &fresh.sources.name;
        let mut problems = vec![format!(
            "{name}: error: published addresses or topics would change their meaning for PLCs that read them now; keep them, or allow it for this \
             once with `allow_map_change = true` in [gateway]"
        )];
        problems.extend(plan.map_breaks.iter().map(|line| format!("{name}: map: {line}")));
        return Err(Refusal { problems, files: fresh.sources.files() });
    }
    let is_lost = |listener| running.lost.contains_key(&listener);
    for (address, tried) in listeners::to_try(&running.installation, is_lost, new, &plan) {
        // Tried only; it is opened when all else is known to be good.
        if let Err(error) = listening::try_address(tried) {
            let problem = format!("{}: error: cannot listen on {address}: {error}", fresh.sources.name);
            return Err(Refusal { problems: vec![problem], files: fresh.sources.files() });
        }
    }
    let refuse = |error: TlsError| {
        let problem = format!("{}: error: {error}", fresh.sources.name);
        Refusal { problems: vec![problem], files: fresh.sources.files() }
    };
    let keeper = if plan.security {
        door::prepare(&new.modbus.security, running.clock).await.map_err(refuse)?
    } else {
        None
    };
    if let Some(files) = new.http.tls.files().filter(|_| plan.http) {
        Security::prepare(files, running.clock).await.map_err(refuse)?;
    }
    Ok((plan, Prepared { keeper }))
}

async fn take_in(running: &mut Running, new: Installation, plan: &Plan, prepared: Prepared) {
    for line in &plan.lines {
        info!("reload: {line}");
    }
    if plan.is_empty() {
        info!("reload: the configuration is good, and nothing of what runs changes");
        running.installation = new;
    } else {
        running.apply(new, plan, prepared).await;
        info!(map = running.installation.map.hash_text(), "reload: the new configuration runs");
    }
    if plan.core.is_none() && !plan.is_empty() {
        tell(running, Order::Loaded(plan.lines.join("; "))).await;
    }
    // An address that was free a moment ago has gone to another program.
    let lost: Vec<&str> = running.lost.values().map(String::as_str).collect();
    let problem = (!lost.is_empty()).then(|| lost.join(" | "));
    tell(running, problem.clone().map_or(Order::Good, Order::Rejected)).await;
    let now = running.clock.now().utc;
    running.parts.configuration.send_modify(|configuration| {
        configuration.loaded = now;
        configuration.reloads = configuration.reloads.saturating_add(1);
        configuration.rejected = problem;
    });
}

async fn refuse(running: &Running, refusal: &Refusal) {
    for problem in &refusal.problems {
        error!("configuration refused: {problem}");
    }
    error!("the configuration that ran before goes on, unchanged");
    let summary = refusal.summary();
    running.parts.configuration.send_modify(|configuration| {
        configuration.rejections = configuration.rejections.saturating_add(1);
        configuration.rejected = Some(summary.clone());
    });
    tell(running, Order::Rejected(summary)).await;
}

async fn tell(running: &Running, order: Order) {
    // The gateway's task is gone only when everything stops.
    let _ = running.orders.send(order).await;
}

fn keep(last_good: &mut Option<LastGood>, sources: &Sources) {
    if let Some(place) = last_good
        && let Err(error) = place.keep(sources)
    {
        warn!(%error, "the last good configuration cannot be kept; should the file be bad at the next start, the gateway will not start");
    }
}
