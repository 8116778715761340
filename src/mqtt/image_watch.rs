//! When the image is to be read, pure: what changes within some milliseconds comes together.

use std::time::Duration;

use crate::time::Instant;

/// The image is read at most this often.
const READ_INTERVAL: Duration = Duration::from_millis(5);

/// What is known of the image.
#[derive(Clone, Copy, Debug)]
pub(super) struct ImageWatch {
    /// The writer still exists.
    alive: bool,
    /// It changed since the last read.
    changed: bool,
    /// It is not read before.
    next_read: Instant,
}

impl ImageWatch {
    /// An image that was not read yet.
    pub(super) fn new() -> Self {
        Self { alive: true, changed: true, next_read: Instant::START }
    }

    /// Waiting for a change ended; `alive`: the writer still exists.
    pub(super) fn handle_wake(&mut self, alive: bool) {
        self.alive = alive;
        self.changed = true;
    }

    /// It is to be read, whether it changed or not.
    pub(super) fn demand(&mut self) {
        self.changed = true;
    }

    /// However short ago it was read.
    pub(super) fn allow(&mut self) {
        self.next_read = Instant::START;
    }

    /// Whether to read it now, because it changed or what was `due` is: yes once.
    pub(super) fn take(&mut self, now: Instant, due: Option<Instant>) -> bool {
        let wanted = self.changed || due.is_some_and(|due| due <= now);
        let taken = wanted && self.next_read <= now;
        if taken {
            self.changed = false;
            self.next_read = now + READ_INTERVAL;
        }
        taken
    }

    /// It has to be read.
    pub(super) fn has_changed(&self) -> bool {
        self.changed
    }

    /// Whether to wait for a change.
    pub(super) fn listens(&self) -> bool {
        self.alive && !self.changed
    }

    /// When [`take`](Self::take) may say yes.
    pub(super) fn poll_timeout(&self, due: Option<Instant>) -> Option<Instant> {
        let changed = self.changed.then_some(self.next_read);
        [changed, due.map(|due| due.max(self.next_read))].into_iter().flatten().min()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn changes_within_five_milliseconds_are_one_read() {
        let at = Instant::from_millis;
        let mut watch = ImageWatch::new();
        assert!(watch.take(at(0), None) && !watch.take(at(0), None));
        assert!(watch.listens());
        watch.handle_wake(true);
        assert_eq!((watch.take(at(4), None), watch.poll_timeout(None)), (false, Some(at(5))));
        assert!(!watch.listens() && watch.take(at(5), None));
        // What is due is read though nothing changed, but not more often.
        assert_eq!(watch.poll_timeout(Some(at(6))), Some(at(10)));
        assert!(!watch.take(at(9), Some(at(6))) && watch.take(at(10), Some(at(6))));
        watch.handle_wake(false);
        assert!(watch.take(at(20), None) && !watch.listens(), "nobody writes it any more");
    }
}
