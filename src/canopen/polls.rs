//! Objects of one node that are read again and again, because no PDO carries them.

use std::time::Duration;

use super::object::ObjectId;
use super::sdo::{SdoRequest, TransferId};
use crate::time::Instant;

/// Ids of polls have this bit; the highest belongs to the boot.
const POLL_ID: u64 = 1 << 62;

/// An object that is read again and again.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Poll {
    /// Which.
    pub object: ObjectId,
    /// Time from one reading to the next, 100 ms and more.
    pub period: Duration,
    /// How many bytes it has, 1..=8.
    pub length: usize,
    /// The boot has read it: there is nothing new in it before one period has passed.
    pub read_by_boot: bool,
}

/// The polls of one node: one at a time, in turn, and none while the node is not ready.
#[derive(Debug)]
pub(super) struct Polls {
    list: Vec<Poll>,
    /// When each is due; `None` while the node is not ready.
    due: Vec<Option<Instant>>,
    /// The one under way.
    open: Option<usize>,
    /// Objects that a TPDO carries after all: they are not read.
    carried: Vec<ObjectId>,
}

impl Polls {
    /// Nothing is read before [`begin`](Self::begin).
    pub(super) fn new(polls: Vec<Poll>) -> Self {
        Self { due: vec![None; polls.len()], list: polls, open: None, carried: Vec::new() }
    }

    /// Whether a transfer was asked for by a poll.
    pub(super) fn is_mine(id: TransferId) -> bool {
        id.0 & POLL_ID != 0
    }

    /// The node is ready: all that are not known yet are read at once, then each in its own time.
    pub(super) fn begin(&mut self, now: Instant) {
        for (due, poll) in self.due.iter_mut().zip(&self.list) {
            let first = if poll.read_by_boot { now + poll.period } else { now };
            *due = Some(first).filter(|_| !self.carried.contains(&poll.object));
        }
        self.open = None;
    }

    /// The node is asked anew what it sends by itself.
    pub(super) fn forget_carried(&mut self) {
        self.carried.clear();
    }

    /// The node sends these objects by itself.
    pub(super) fn carry(&mut self, objects: impl Iterator<Item = ObjectId>) {
        self.carried.extend(objects);
    }

    /// The node is not ready any more.
    pub(super) fn stop(&mut self) {
        self.due.fill(None);
        self.open = None;
    }

    /// The next request, if one is due and none is under way.
    pub(super) fn handle_timeout(&mut self, now: Instant) -> Option<(TransferId, SdoRequest)> {
        if self.open.is_some() {
            return None;
        }
        let (place, _) = self.next().filter(|(_, due)| *due <= now)?;
        let poll = self.list.get(place)?;
        if let Some(due) = self.due.get_mut(place) {
            *due = Some(now + poll.period);
        }
        self.open = Some(place);
        let id = TransferId(POLL_ID | u64::try_from(place).unwrap_or_default());
        Some((id, SdoRequest::read(poll.object).of_len(poll.length)))
    }

    /// A reading is over. Which it was; `None` where it does not count any more.
    pub(super) fn handle_sdo(&mut self, id: TransferId) -> Option<usize> {
        let place = usize::try_from(id.0 & !POLL_ID).ok()?;
        self.open.take_if(|open| *open == place)
    }

    /// When [`handle_timeout`](Self::handle_timeout) has something to do, and why.
    pub(super) fn poll_timeout(&self) -> Option<(Instant, &'static str)> {
        if self.open.is_some() {
            return None;
        }
        self.next().map(|(_, due)| (due, "object that is polled"))
    }

    fn next(&self) -> Option<(usize, Instant)> {
        let due = self.due.iter().enumerate().filter_map(|(place, due)| Some((place, (*due)?)));
        due.min_by_key(|(_, due)| *due)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(millis: u64) -> Instant {
        Instant::from_millis(millis)
    }

    #[test]
    fn r_dst_088_objects_are_read_one_at_a_time_each_in_its_own_period() {
        let poll = |sub, seconds| Poll {
            object: ObjectId::new(0x3000, sub),
            period: Duration::from_secs(seconds),
            length: 2,
            read_by_boot: false,
        };
        let mut polls = Polls::new(vec![poll(1, 60), poll(2, 10)]);
        assert_eq!(polls.poll_timeout(), None);
        polls.begin(at(0));
        let mut read = Vec::new();
        for second in 0..=60 {
            while let Some((id, request)) = polls.handle_timeout(at(second * 1000)) {
                assert_eq!(polls.handle_timeout(at(second * 1000)), None, "one at a time");
                assert!(Polls::is_mine(id));
                assert!(polls.handle_sdo(id).is_some());
                assert!(polls.handle_sdo(id).is_none(), "once");
                read.push((second, request.object.sub));
            }
        }
        let expected = [(0, 1), (0, 2), (10, 2), (20, 2), (30, 2), (40, 2), (50, 2), (60, 1), (60, 2)];
        assert_eq!(read, expected);
        polls.stop();
        assert_eq!(polls.poll_timeout(), None);
    }
}
