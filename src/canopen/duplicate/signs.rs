//! What is counted of a node id: how often frames come, what takes turns, boot-up messages.

use std::time::Duration;

use crate::time::Instant;

/// Frames are counted over this long, or five of their periods.
const WINDOW: Duration = Duration::from_secs(2);
/// What takes turns does so with no longer pauses than this; a device that is changed once is no two devices.
const TURN: Duration = Duration::from_secs(10);
/// Two devices that start together send their boot-up messages within this time.
const TOGETHER: Duration = Duration::from_millis(500);
/// A device that sends a third one within this time restarts again and again.
const ALONE: Duration = Duration::from_secs(2);

/// Counts the frames of one kind.
#[derive(Debug)]
pub(super) struct Rate {
    window: Duration,
    /// More than this in a window is too often: 1.5 times what the shortest period allows, and one for jitter.
    most: u64,
    since: Option<Instant>,
    count: u64,
}

impl Rate {
    /// `None` for a period of zero, against which no rate is too high.
    pub(super) fn new(shortest_period: Duration) -> Option<Self> {
        let window = WINDOW.max(shortest_period.saturating_mul(5));
        let expected = window.as_micros().checked_div(shortest_period.as_micros())?;
        let most = u64::try_from(expected.saturating_mul(3) / 2 + 1).unwrap_or(u64::MAX);
        Some(Self { window, most, since: None, count: 0 })
    }

    /// A frame came. Whether there were too many of late.
    pub(super) fn is_too_high(&mut self, now: Instant) -> bool {
        match self.since {
            Some(since) if now.since(since) < self.window => self.count = self.count.saturating_add(1),
            Some(_) | None => {
                self.since = Some(now);
                self.count = 1;
            }
        }
        self.count > self.most
    }
}

/// Watches whether two values take turns.
#[derive(Debug)]
pub(super) struct Alternation<T> {
    last: Option<T>,
    /// The other of the two.
    other: Option<T>,
    changed: Instant,
    changes: u8,
}

impl<T> Default for Alternation<T> {
    fn default() -> Self {
        Self { last: None, other: None, changed: Instant::START, changes: 0 }
    }
}

impl<T: PartialEq> Alternation<T> {
    /// The next one. If it differs from the last: how many changes between these two followed each other soon, this one
    /// included.
    pub(super) fn add(&mut self, now: Instant, next: T) -> Option<u8> {
        let before = self.last.replace(next);
        if before.is_none() || before == self.last {
            return None;
        }
        let back = self.other == self.last;
        self.other = before;
        let soon = now.since(self.changed) <= TURN;
        self.changes = if soon && (back || self.changes == 0) { self.changes.saturating_add(1) } else { 1 };
        self.changed = now;
        Some(self.changes)
    }

    /// There is a reason why the next one may differ.
    pub(super) fn interrupt(&mut self) {
        self.last = None;
        self.other = None;
        self.changes = 0;
    }
}

/// Looks for boot-up messages that come in pairs.
///
/// One reset makes one device boot once. A device whose plug bounces boots twice as well, so that without a reset as their
/// cause two pairs in a row are needed.
#[derive(Debug, Default)]
pub(super) struct BootUps {
    /// The last one, and whether it was ordered.
    last: Option<(Instant, bool)>,
    /// A pair came; it counts unless a third message comes until then. Whether the first of it was ordered.
    pending: Option<(Instant, bool)>,
    /// Pairs in a row.
    pairs: u8,
    /// The last one was the second of a pair.
    paired: bool,
}

impl BootUps {
    /// A boot-up message.
    pub(super) fn add(&mut self, now: Instant, ordered: bool) {
        let third = self.pending.take().is_some();
        // Of two resets, each brings one.
        let soon = |last: Instant| !third && !ordered && !self.paired && now.since(last) <= TOGETHER;
        let pair = self.last.filter(|(last, _)| soon(*last));
        if third || (pair.is_none() && !self.paired) {
            self.pairs = 0;
        }
        self.pending = pair.map(|(_, ordered)| (now + ALONE, ordered));
        self.paired = pair.is_some();
        self.last = Some((now, ordered));
    }

    /// Whether two devices seem to have booted.
    pub(super) fn handle_timeout(&mut self, now: Instant) -> bool {
        let Some((_, ordered)) = self.pending.filter(|(due, _)| *due <= now) else { return false };
        self.pending = None;
        self.pairs = self.pairs.saturating_add(1);
        ordered || self.pairs >= 2
    }

    /// When that is known.
    pub(super) fn poll_timeout(&self) -> Option<Instant> {
        self.pending.map(|(due, _)| due)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(millis: u64) -> Instant {
        Instant::from_millis(millis)
    }

    #[test]
    fn a_period_of_zero_is_never_exceeded() {
        assert!(Rate::new(Duration::ZERO).is_none());
    }

    #[test]
    fn what_changes_for_good_or_seldom_takes_no_turns() {
        let mut lengths = Alternation::default();
        assert_eq!(lengths.add(at(0), 5), None);
        assert_eq!(lengths.add(at(100), 5), None);
        assert_eq!(lengths.add(at(200), 8), Some(1));
        assert_eq!(lengths.add(at(10_300), 5), Some(1), "too long ago");
        assert_eq!(lengths.add(at(10_400), 8), Some(2));
        lengths.interrupt();
        assert_eq!(lengths.add(at(10_500), 5), None);
        assert_eq!(lengths.add(at(10_600), 8), Some(1));
        assert_eq!(lengths.add(at(10_700), 5), Some(2));
        assert_eq!(lengths.add(at(10_800), 0), Some(1), "a third length");
        assert_eq!(lengths.add(at(10_900), 5), Some(2));
    }

    /// Times of boot-up messages in ms, and whether the first of them was ordered; when two devices were found.
    fn found(boot_ups: &[u64], ordered: bool) -> Vec<u64> {
        let mut watch = BootUps::default();
        let mut found = Vec::new();
        let mut look = |watch: &mut BootUps, until: u64| {
            if let Some(due) = watch.poll_timeout().filter(|due| *due <= at(until))
                && watch.handle_timeout(due)
            {
                found.push(due.as_millis());
            }
        };
        for (place, millis) in boot_ups.iter().enumerate() {
            look(&mut watch, *millis);
            watch.add(at(*millis), ordered && place == 0);
        }
        look(&mut watch, u64::from(u32::MAX));
        found
    }

    #[test]
    fn one_reset_with_two_boot_ups_or_two_pairs_in_a_row_are_two_devices() {
        assert_eq!(found(&[1000, 1300], true), [3300]);
        assert_eq!(found(&[1000, 1300], false), [0; 0], "a plug that bounced");
        assert_eq!(found(&[1000, 1300, 60_000, 60_100], false), [62_100]);
        assert_eq!(found(&[1000, 1300, 60_000, 90_000, 90_100], false), [0; 0], "one of them alone");
        assert_eq!(found(&[1000, 1600], true), [0; 0], "too far apart");
        assert_eq!(found(&[1000], true), [0; 0]);
    }

    #[test]
    fn a_device_that_restarts_again_and_again_is_one_device() {
        for pause in [100, 300, 499, 700, 1000, 1900] {
            let boot_ups: Vec<u64> = (1..50).map(|round| pause * round).collect();
            assert_eq!(found(&boot_ups, true), [0; 0], "every {pause} ms");
        }
    }
}
