//! Objects of one node that are read again and again, because no PDO carries them.

use std::time::Duration;

use super::object::{MappedObject, ObjectId};
use super::sdo::{SdoRequest, TransferId};
use crate::time::Instant;

/// Ids of polls have this bit; the highest belongs to the boot.
const POLL_ID: u64 = 1 << 62;

/// An object that somebody writes is read so much later: by then the write is over as a rule.
const AFTER_WRITE: Duration = Duration::from_millis(100);

/// While the SDO client is busy with what others ask, a reading is asked for again so often.
const RETRY: Duration = Duration::from_millis(100);

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
    /// It is not read while a TPDO carries so many bits of the object, 1..=64; `None`: it is read whatever comes.
    pub unless_sent: Option<u8>,
}

/// The polls of one node: one at a time, in turn, and none while the node is not ready.
#[derive(Debug)]
pub(super) struct Polls {
    list: Vec<Poll>,
    /// When each is due; `None` while the node is not ready.
    due: Vec<Option<Instant>>,
    /// The one under way.
    open: Option<usize>,
    /// Objects that TPDOs carry after all, and how many bits of each.
    carried: Vec<(ObjectId, u8)>,
    /// Since when no reading was taken, because others ask for too much.
    crowded_out: Option<Instant>,
}

impl Polls {
    /// Nothing is read before [`begin`](Self::begin).
    pub(super) fn new(polls: Vec<Poll>) -> Self {
        Self { due: vec![None; polls.len()], list: polls, open: None, carried: Vec::new(), crowded_out: None }
    }

    /// Whether a transfer was asked for by a poll.
    pub(super) fn is_mine(id: TransferId) -> bool {
        id.0 & POLL_ID != 0
    }

    /// The node is ready: all that are not known yet are read at once, then each in its own time.
    pub(super) fn begin(&mut self, now: Instant) {
        for (due, poll) in self.due.iter_mut().zip(&self.list) {
            let first = if poll.read_by_boot { now + poll.period } else { now };
            let sent = |(object, bits): &(ObjectId, u8)| {
                *object == poll.object && poll.unless_sent.is_some_and(|needed| needed <= *bits)
            };
            *due = Some(first).filter(|_| !self.carried.iter().any(sent));
        }
        self.open = None;
    }

    /// The node is asked anew what it sends by itself.
    pub(super) fn forget_carried(&mut self) {
        self.carried.clear();
    }

    /// The node sends a TPDO with this content by itself. What lies behind its 64th bit does not come.
    pub(super) fn carry(&mut self, maps: &[MappedObject]) {
        let mut room = 64_u8;
        for mapped in maps {
            self.carried.push((mapped.object, mapped.bits.min(room)));
            room = room.saturating_sub(mapped.bits);
        }
    }

    /// Somebody else writes an object: what was read of it does not hold any more.
    pub(super) fn handle_write(&mut self, now: Instant, object: ObjectId) {
        for (due, poll) in self.due.iter_mut().zip(&self.list) {
            if poll.object == object {
                *due = due.map(|due| due.min(now + AFTER_WRITE));
            }
        }
    }

    /// The node is not ready any more.
    pub(super) fn stop(&mut self) {
        self.due.fill(None);
        self.open = None;
        self.crowded_out = None;
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

    /// The reading is under way.
    pub(super) fn handle_taken(&mut self) {
        self.crowded_out = None;
    }

    /// There is no room for the reading, which is nobody's fault: it is asked for again soon. `false`: that has gone on for
    /// a whole period of it, so that it has failed.
    pub(super) fn postpone(&mut self, now: Instant) -> bool {
        let since = *self.crowded_out.get_or_insert(now);
        let Some(place) = self.open else { return false };
        let (Some(due), Some(poll)) = (self.due.get_mut(place), self.list.get(place)) else { return false };
        if now.since(since) >= poll.period {
            return false;
        }
        *due = Some(now + RETRY);
        self.open = None;
        true
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
            unless_sent: None,
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

    #[test]
    fn r_dst_024_an_object_of_which_a_tpdo_carries_enough_bits_is_not_read_and_any_other_is() {
        for (maps, unless_sent, read) in [
            (&[0x9130_0220][..], Some(32), false),
            (&[0x9130_0210], Some(32), true),
            (&[0x9130_0210], Some(16), false),
            (&[0x9130_0120], Some(32), true),
            (&[0x9130_0120, 0x9130_0220], Some(32), false),
            (&[0x9130_0120, 0x6150_0108, 0x9130_0220], Some(32), true),
            (&[0x9130_0220], None, true),
        ] {
            let object = ObjectId::new(0x9130, 2);
            let period = Duration::from_secs(1);
            let mut polls =
                Polls::new(vec![Poll { object, period, length: 4, read_by_boot: false, unless_sent }]);
            let maps: Vec<_> = maps.iter().copied().map(MappedObject::from_entry).collect();
            polls.carry(&maps);
            polls.begin(at(0));
            assert_eq!(polls.handle_timeout(at(0)).is_some(), read, "{maps:?} {unless_sent:?}");
        }
    }

    #[test]
    fn a_reading_that_finds_no_room_is_asked_for_again_and_has_failed_after_one_period() {
        let object = ObjectId::new(0x3000, 1);
        let period = Duration::from_secs(1);
        let mut polls =
            Polls::new(vec![Poll { object, period, length: 2, read_by_boot: false, unless_sent: None }]);
        polls.begin(at(0));
        for millis in (0..1000).step_by(100) {
            assert!(polls.handle_timeout(at(millis)).is_some(), "{millis}");
            assert!(polls.postpone(at(millis)), "{millis}");
            assert_eq!(polls.poll_timeout().map(|(due, _)| due), Some(at(millis + 100)));
        }
        let (id, _) = polls.handle_timeout(at(1000)).unwrap();
        assert!(!polls.postpone(at(1000)));
        assert_eq!(polls.handle_sdo(id), Some(0), "it has failed");
        assert_eq!(polls.poll_timeout().map(|(due, _)| due), Some(at(2000)), "in its own time");
        assert!(polls.handle_timeout(at(2000)).is_some());
        polls.handle_taken();
        assert!(polls.handle_sdo(id).is_some());
        assert!(polls.handle_timeout(at(3000)).is_some());
        assert!(polls.postpone(at(3000)), "counted anew");
    }
}
