//! Waiting for something to become true, with a deadline that a stalling machine keeps.

use std::fmt::Display;
use std::time::{Duration, Instant};

/// Long enough for anything that happens at all.
pub const GENEROUS: Duration = Duration::from_secs(30);

/// How often is looked. A guest has one slow processor: looking must not be what it does all day.
const STEP: Duration = Duration::from_millis(20);

/// Looks until there is something, at most for `limit`.
pub fn within<T>(limit: Duration, mut look: impl FnMut() -> Option<T>) -> Option<T> {
    let end = Instant::now() + limit;
    loop {
        if let Some(found) = look() {
            return Some(found);
        }
        if Instant::now() >= end {
            return None;
        }
        std::thread::sleep(STEP);
    }
}

/// Looks until there is something; the test fails when there is nothing for [`GENEROUS`].
pub fn wait_for<T>(what: impl Display, look: impl FnMut() -> Option<T>) -> T {
    within(GENEROUS, look).unwrap_or_else(|| panic!("waited {GENEROUS:?} for {what}"))
}

/// Waits until a condition holds; the test fails when it does not for [`GENEROUS`].
pub fn wait_until(what: impl Display, mut holds: impl FnMut() -> bool) {
    wait_for(what, || holds().then_some(()));
}

/// Gives the gateway time to do something that it must not do.
pub fn give_it(time: Duration) {
    std::thread::sleep(time);
}
