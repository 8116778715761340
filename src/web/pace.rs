//! How often an address may ask, pure: a bucket for each that fills steadily.

use core::net::{IpAddr, Ipv6Addr};
use std::collections::BTreeMap;
use std::time::Duration;

use super::login::place;
use crate::slots::{Bucket, Rate};
use crate::time::Instant;

/// 100 requests a second, and 400 at once.
const RATE: Rate = Rate { each: Duration::from_millis(10), burst: 400 };
/// Addresses that are kept apart. Further ones share a bucket.
const MOST_ADDRESSES: usize = 1_024;

/// By address.
#[derive(Debug, Default)]
pub struct Pace(BTreeMap<IpAddr, Bucket>);

impl Pace {
    /// Takes a request from the bucket of its address.
    ///
    /// # Errors
    /// The bucket is empty: in how long there is something in it.
    pub fn take(&mut self, now: Instant, address: IpAddr) -> Result<(), Duration> {
        let place = place(address);
        if self.0.len() >= MOST_ADDRESSES {
            self.0.retain(|_, bucket| !bucket.is_full(now));
        }
        let is_known = self.0.contains_key(&place) || self.0.len() < MOST_ADDRESSES;
        let key = if is_known { place } else { IpAddr::V6(Ipv6Addr::UNSPECIFIED) };
        self.0.entry(key).or_default().take(now, RATE)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(millis: u64) -> Instant {
        Instant::from_millis(millis)
    }

    fn address(number: u32) -> IpAddr {
        core::net::Ipv4Addr::from_bits(number).into()
    }

    #[test]
    fn cr_7_1_an_address_may_ask_400_times_at_once_and_then_100_times_a_second() {
        let mut pace = Pace::default();
        let taken = (0..1000).filter(|_| pace.take(at(5000), address(1)).is_ok()).count();
        assert_eq!(taken, 400);
        assert_eq!(pace.take(at(5000), address(1)), Err(RATE.each));
        assert!(pace.take(at(5000), address(2)).is_ok(), "others have their own");
        let taken = (0..1000).filter(|_| pace.take(at(6000), address(1)).is_ok()).count();
        assert_eq!(taken, 100);
        let taken = (0..1000).filter(|_| pace.take(at(60_000), address(1)).is_ok()).count();
        assert_eq!(taken, 400, "no more is saved up");
    }

    #[test]
    fn the_table_is_bounded_and_those_above_share_a_bucket() {
        let mut pace = Pace::default();
        let taken = (0..10_000).filter(|number| pace.take(at(0), address(*number)).is_ok()).count();
        assert_eq!(taken, MOST_ADDRESSES + 400);
        assert!(pace.0.len() <= MOST_ADDRESSES + 1);
        assert!(pace.take(at(10_000), address(77_777)).is_ok(), "full buckets are forgotten");
        assert_eq!(pace.0.len(), 1);
    }
}
