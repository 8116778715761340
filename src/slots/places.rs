//! The places themselves, pure: who must go when all are taken.
//!
//! The newcomer always gets in. Who has never asked for anything goes first; then the connection that has been silent for
//! longest; in both cases one of the address that holds most. So a flood from one address displaces itself and not the
//! PLC that polls from another, and connections that are opened and left alone do not displace one that works.
//!
//! Clients with a reserved place always get in, and go only for one another: where they hold all places, others stay outside.

use core::net::IpAddr;
use std::cmp::Reverse;
use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use crate::time::Instant;

/// When a connection sent its last request.
#[derive(Debug)]
pub struct Activity(AtomicU64);

impl Activity {
    /// It has sent a request.
    pub fn touch(&self, now: Instant) {
        self.0.store(now.as_micros().max(1), Ordering::Relaxed);
    }

    /// 0 before the first.
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
    /// Places that one address may have.
    share: usize,
    next: u64,
    taken: BTreeMap<SlotId, Slot<H>>,
}

#[derive(Debug)]
struct Slot<H> {
    address: IpAddr,
    reserved: bool,
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
        Self::with_share(limit, usize::MAX)
    }

    /// The same, of which one address has at most `share`, at least one: beyond it a newcomer displaces one of its own address.
    #[must_use]
    pub fn with_share(limit: usize, share: usize) -> Self {
        Self { limit: limit.max(1), share: share.max(1), next: 0, taken: BTreeMap::new() }
    }

    /// Places in use.
    #[must_use]
    pub fn in_use(&self) -> usize {
        self.taken.len()
    }

    /// A place for a newcomer that always gets one.
    pub fn take(&mut self, address: IpAddr, handle: H) -> Taken<H> {
        let own = self.evict_of_share(address);
        let evicted = if own.is_none() && self.taken.len() >= self.limit { self.evict() } else { own };
        self.seat(address, true, handle, evicted)
    }

    /// A place for any other newcomer; `None` where those that always get one hold all of them.
    pub fn take_unreserved(&mut self, address: IpAddr, handle: H) -> Option<Taken<H>> {
        let own = self.evict_of_share(address);
        let evicted = if own.is_none() && self.taken.len() >= self.limit {
            Some(self.evict_where(|slot| !slot.reserved)?)
        } else {
            own
        };
        Some(self.seat(address, false, handle, evicted))
    }

    fn seat(&mut self, address: IpAddr, reserved: bool, handle: H, evicted: Option<H>) -> Taken<H> {
        let id = SlotId(self.next);
        self.next += 1;
        let activity = Arc::new(Activity(AtomicU64::new(0)));
        self.taken.insert(id, Slot { address, reserved, activity: Arc::clone(&activity), handle });
        Taken { id, activity, evicted }
    }

    /// Where an address has its share: the one of its own that must go.
    fn evict_of_share(&mut self, address: IpAddr) -> Option<H> {
        let held = self.taken.values().filter(|slot| slot.address == address).count();
        if held < self.share { None } else { self.evict_where(|slot| slot.address == address) }
    }

    /// Takes the place of the one that must go, of those without a reserved place if there are any; `None` where nobody has a
    /// place.
    pub fn evict(&mut self) -> Option<H> {
        self.evict_where(|_| true)
    }

    fn evict_where(&mut self, may_go: impl Fn(&Slot<H>) -> bool) -> Option<H> {
        let mut held: BTreeMap<IpAddr, usize> = BTreeMap::new();
        for slot in self.taken.values() {
            *held.entry(slot.address).or_default() += 1;
        }
        let order = |(id, slot): &(&SlotId, &Slot<H>)| {
            let last = slot.activity.last();
            (slot.reserved, last > 0, Reverse(held.get(&slot.address).copied()), last, **id)
        };
        let candidates = self.taken.iter().filter(|(_, slot)| may_go(slot));
        let victim = candidates.min_by_key(order).map(|(id, _)| *id)?;
        self.taken.remove(&victim).map(|slot| slot.handle)
    }

    /// A connection has ended. Nothing, where it was evicted before.
    pub fn release(&mut self, id: SlotId) {
        self.taken.remove(&id);
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
        for (time, name) in (0..).zip(["first", "second", "third"]) {
            slots.take(address(1), name).activity.touch(at(time));
        }
        let newcomer = slots.take(address(1), "fourth");
        assert_eq!(newcomer.evicted, Some("first"));
        assert_eq!(slots.in_use(), 3);
    }

    #[test]
    fn who_never_asked_goes_before_who_works_oldest_first() {
        let mut slots = Slots::new(4);
        slots.take(address(1), "plc").activity.touch(at(0));
        for name in ["a", "b", "c"] {
            slots.take(address(1), name);
        }
        let evicted: Vec<_> = (0..100).filter_map(|_| slots.take(address(1), "script").evicted).collect();
        assert_eq!(evicted[..4], ["a", "b", "c", "script"]);
        assert!(
            !evicted.contains(&"plc"),
            "though it has been silent for longest, and is of the same address"
        );
    }

    #[test]
    fn p25_a_flood_from_one_address_displaces_itself() {
        for asks in [false, true] {
            let mut slots = Slots::new(4);
            slots.take(address(1), "plc").activity.touch(at(1));
            let flood = |time| {
                let taken = slots.take(address(2), "flood");
                if asks {
                    taken.activity.touch(at(time));
                }
                taken.evicted
            };
            let evicted: Vec<_> = (2..101).filter_map(flood).collect();
            assert_eq!(evicted.len(), 96);
            assert!(evicted.iter().all(|who| *who == "flood"));
            assert_eq!(slots.take(address(3), "other").evicted, Some("flood"));
        }
    }

    #[test]
    fn one_who_has_just_come_is_not_displaced_by_a_flood_from_elsewhere() {
        let mut slots = Slots::new(4);
        for _ in 0..3 {
            slots.take(address(2), "flood");
        }
        slots.take(address(1), "plc");
        assert_eq!(
            (0..3).map(|_| slots.take(address(2), "flood").evicted.unwrap()).collect::<Vec<_>>(),
            ["flood"; 3]
        );
    }

    #[test]
    fn s2_no_place_is_lost_whatever_the_order() {
        let mut slots = Slots::new(2);
        let ids: Vec<_> = (0..10).map(|_| slots.take(address(1), ()).id).collect();
        assert_eq!(slots.in_use(), 2);
        for id in ids.iter().chain(&ids) {
            slots.release(*id);
        }
        assert_eq!((slots.in_use(), slots.evict()), (0, None));
    }

    #[test]
    fn f42_a_reserved_place_is_found_at_once_and_never_lost_to_a_stranger() {
        let mut slots = Slots::new(3);
        for (stranger, time) in [(1, 30), (2, 10), (3, 20)] {
            let taken = slots.take_unreserved(address(stranger), "stranger").unwrap();
            taken.activity.touch(at(time));
        }
        let plc = slots.take(address(9), "plc");
        assert_eq!(plc.evicted, Some("stranger"));
        // It has not asked for anything yet, and strangers that ask all the time come and go.
        for time in 0..100 {
            let taken = slots.take_unreserved(address(4), "stranger").unwrap();
            assert_eq!(taken.evicted, Some("stranger"));
            taken.activity.touch(at(1_000 + time));
        }
        for name in ["plc 2", "plc 3"] {
            assert_eq!(slots.take(address(9), name).evicted, Some("stranger"));
        }
        assert!(slots.take_unreserved(address(5), "stranger").is_none(), "all are reserved and taken");
        assert_eq!((slots.in_use(), slots.take(address(8), "plc 4").evicted), (3, Some("plc")));
    }

    #[test]
    fn an_address_that_has_its_share_displaces_itself_though_there_is_room() {
        let mut slots = Slots::with_share(10, 2);
        for name in ["first", "second"] {
            assert_eq!(slots.take_unreserved(address(1), name).unwrap().evicted, None);
        }
        assert_eq!(slots.take_unreserved(address(1), "third").unwrap().evicted, Some("first"));
        assert_eq!(slots.take_unreserved(address(2), "other").unwrap().evicted, None);
        assert_eq!((slots.take(address(1), "fourth").evicted, slots.in_use()), (Some("second"), 3));
    }
}
