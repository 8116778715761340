//! The places for connections, pure: who must go when all are taken.
//!
//! The newcomer always gets in. It takes the place of the connection that has been silent for longest among those of the
//! address that holds most: a flood from one address displaces itself and not the PLC that polls from another.

use core::net::IpAddr;
use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use crate::time::Instant;

/// When a connection sent its last request.
#[derive(Debug)]
pub struct Activity(AtomicU64);

impl Activity {
    fn new(now: Instant) -> Self {
        Self(AtomicU64::new(now.as_micros()))
    }

    /// It has sent a request.
    pub fn touch(&self, now: Instant) {
        self.0.store(now.as_micros(), Ordering::Relaxed);
    }

    fn last(&self) -> u64 {
        self.0.load(Ordering::Relaxed)
    }
}

/// Names a taken place.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct SlotId(u64);

/// All places. `H` is what a connection can be told to end with.
#[derive(Debug)]
pub struct Slots<H> {
    limit: usize,
    next: u64,
    taken: BTreeMap<SlotId, Slot<H>>,
}

#[derive(Debug)]
struct Slot<H> {
    address: IpAddr,
    activity: Arc<Activity>,
    handle: H,
}

/// What a newcomer gets.
#[derive(Debug)]
pub struct Taken<H> {
    /// Its place.
    pub id: SlotId,
    /// To be touched at every request.
    pub activity: Arc<Activity>,
    /// The one that had to go; its place is free already.
    pub evicted: Option<H>,
}

impl<H> Slots<H> {
    /// `limit` places, at least one.
    #[must_use]
    pub fn new(limit: usize) -> Self {
        Self { limit: limit.max(1), next: 0, taken: BTreeMap::new() }
    }

    /// Places in use.
    #[must_use]
    pub fn in_use(&self) -> usize {
        self.taken.len()
    }

    /// A place for a newcomer.
    pub fn take(&mut self, address: IpAddr, handle: H, now: Instant) -> Taken<H> {
        let full = self.taken.len() >= self.limit;
        let evicted = if full { self.victim().and_then(|id| self.taken.remove(&id)) } else { None };
        let id = SlotId(self.next);
        self.next += 1;
        let activity = Arc::new(Activity::new(now));
        self.taken.insert(id, Slot { address, activity: Arc::clone(&activity), handle });
        Taken { id, activity, evicted: evicted.map(|slot| slot.handle) }
    }

    /// A connection has ended. Nothing, where it was evicted before.
    pub fn release(&mut self, id: SlotId) {
        self.taken.remove(&id);
    }

    fn victim(&self) -> Option<SlotId> {
        let mut held: BTreeMap<IpAddr, usize> = BTreeMap::new();
        for slot in self.taken.values() {
            *held.entry(slot.address).or_default() += 1;
        }
        let most = held.values().copied().max()?;
        let candidates = self.taken.iter().filter(|(_, slot)| held.get(&slot.address) == Some(&most));
        candidates.min_by_key(|(id, slot)| (slot.activity.last(), **id)).map(|(id, _)| *id)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn address(last: u8) -> IpAddr {
        IpAddr::from([10, 0, 0, last])
    }

    fn at(millis: u64) -> Instant {
        Instant::from_millis(millis)
    }

    #[test]
    fn f42_the_longest_silent_makes_room() {
        let mut slots = Slots::new(3);
        let first = slots.take(address(1), "first", at(0));
        slots.take(address(1), "second", at(1));
        slots.take(address(1), "third", at(2));
        first.activity.touch(at(3));
        let newcomer = slots.take(address(1), "fourth", at(4));
        assert_eq!(newcomer.evicted, Some("second"));
        assert_eq!(slots.in_use(), 3);
    }

    #[test]
    fn p25_a_flood_from_one_address_displaces_itself() {
        let mut slots = Slots::new(4);
        slots.take(address(1), "plc", at(0));
        let evicted: Vec<_> =
            (1..100).filter_map(|time| slots.take(address(2), "flood", at(time)).evicted).collect();
        assert_eq!(evicted.len(), 96);
        assert!(evicted.iter().all(|who| *who == "flood"));
        assert_eq!(slots.take(address(3), "other", at(100)).evicted, Some("flood"));
    }

    #[test]
    fn s2_no_place_is_lost_whatever_the_order() {
        let mut slots = Slots::new(2);
        let ids: Vec<_> = (0..10).map(|time| slots.take(address(1), (), at(time)).id).collect();
        assert_eq!(slots.in_use(), 2);
        for id in ids.iter().chain(&ids) {
            slots.release(*id);
        }
        assert_eq!(slots.in_use(), 0);
    }
}
