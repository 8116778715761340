//! The CAN bus from outside: can-utils, link state, who may use it.

use std::process::Command;
use std::sync::atomic::{AtomicU32, Ordering::SeqCst};
use std::sync::{Mutex, MutexGuard, PoisonError};

use super::process::{Line, Process, run};
use super::wait::{wait_for, wait_until};

/// The interface of all tests.
pub const BUS: &str = "vcan0";

/// vcan0 and the one processor of a guest are there once: one test at a time.
static IN_USE: Mutex<()> = Mutex::new(());

/// Waits until no other test runs, and leaves the bus as a new one.
///
/// Deletes vcan0, and tests after it make routes between interfaces: outside the runner that would be the host's own.
pub fn take_the_bus() -> MutexGuard<'static, ()> {
    assert!(
        std::env::var_os("CANGATE_VCAN").is_some(),
        "these tests delete and make CAN interfaces, so they run only where no one else uses them: by `tests/all vcan`, \
         or one of them as docs/testing.md says under \"One test\""
    );
    let guard = IN_USE.lock().unwrap_or_else(PoisonError::into_inner);
    let _ = run("ip", &["link", "del", BUS]);
    create_interface();
    guard
}

/// Makes vcan0 and takes it up.
pub fn create_interface() {
    ip(&["link", "add", BUS, "type", "vcan"]);
    ip(&["link", "set", BUS, "up"]);
}

/// Runs `ip`, which must work.
pub fn ip(arguments: &[&str]) {
    let (good, _, stderr) = run("ip", arguments);
    assert!(good, "ip {arguments:?}: {stderr}");
}

/// Sends a frame in candump's notation with can-utils' cansend.
pub fn cansend(frame: &str) {
    let (good, _, stderr) = run("cansend", &[BUS, frame]);
    assert!(good, "cansend {BUS} {frame}: {stderr}");
}

/// Frames by which a capture finds its place; no participant of any test sends or knows them.
const MARK: &str = "7EF#";

/// Everything that is on the bus, as can-utils' candump sees it.
pub struct Capture {
    candump: Process,
}

impl Capture {
    /// Starts candump and waits until it listens.
    pub fn start() -> Self {
        Self::start_on(BUS)
    }

    /// As [`start`](Self::start), of these 11-bit identifiers only: a guest has no room for millions of frames.
    pub fn start_of(ids: &[u16]) -> Self {
        let mut filters = vec![format!("{BUS},{}:7FF", MARK.trim_end_matches('#'))];
        filters.extend(ids.iter().map(|id| format!("{id:03X}:7FF")));
        Self::start_on(&filters.join(","))
    }

    fn start_on(bus: &str) -> Self {
        // -L: log format; -D: stay when the interface goes down; -r: room for what comes while a machine that is busy
        // elsewhere does not let it read; -e is left out: error frames are no frames of a participant.
        let candump =
            Process::start("candump", Command::new("candump").args(["-L", "-D", "-r", "8000000", bus]));
        // Sent until it is seen.
        let capture = Self { candump };
        wait_until("candump to listen", || {
            cansend(MARK);
            capture.candump.stdout_count() > 0
        });
        capture
    }

    /// The frames so far with the kernel's time in seconds since 1970, without those of [`start`](Self::start) and
    /// [`mark`](Self::mark).
    pub fn timed(&self) -> Vec<(f64, String)> {
        let read = |text: &str| {
            let mut words = text.split(' ');
            let time = words.next()?.trim_matches(['(', ')']).parse().ok()?;
            Some((time, words.nth(1)?.to_owned()))
        };
        self.candump
            .stdout(0)
            .iter()
            .filter_map(|line| read(&line.text))
            .filter(|(_, frame)| !frame.starts_with(MARK))
            .collect()
    }

    /// How many frames were on the bus until now. A count of what candump has printed is late: a frame of a process that
    /// has ended may not be in it yet. So a frame is sent, and those before it are counted.
    pub fn mark(&self) -> usize {
        static MARKS: AtomicU32 = AtomicU32::new(1);
        let mark = format!("{MARK}{:08X}", MARKS.fetch_add(1, SeqCst));
        cansend(&mark);
        let is = |line: &Line, frame: &str| {
            line.text.split(' ').nth(2).is_some_and(|seen| seen.starts_with(frame))
        };
        wait_for(format!("{mark} on {BUS}"), || {
            let lines = self.candump.stdout(0);
            let place = lines.iter().position(|line| is(line, &mark))?;
            Some(lines[..place].iter().filter(|line| !is(line, MARK)).count())
        })
    }

    /// The frames so far, for example `701#R1`.
    pub fn frames(&self) -> Vec<String> {
        self.timed().into_iter().map(|(_, frame)| frame).collect()
    }

    /// How many frames there are so far.
    pub fn count(&self) -> usize {
        self.frames().len()
    }

    /// Waits until a frame came after the first `after` frames; gives its place. A frame that ends in `#` stands for any
    /// data of that identifier.
    pub fn wait_for(&self, frame: &str, after: usize) -> usize {
        wait_for(format!("{frame} on {BUS}"), || {
            self.frames()
                .iter()
                .skip(after)
                .position(|seen| seen == frame || frame.ends_with('#') && seen.starts_with(frame))
                .map(|place| place + after)
        })
    }

    /// Waits until these frames came in this order after the first `after` frames, whatever else is between them.
    pub fn wait_for_sequence(&self, frames: &[&str], after: usize) {
        frames.iter().fold(after, |next, frame| self.wait_for(frame, next) + 1);
    }
}
