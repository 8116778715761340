//! What may be told of an address, pure: once a minute for each reason, however often it comes.

use core::net::IpAddr;
use std::collections::BTreeMap;
use std::time::Duration;

use crate::time::Instant;

/// How long an address is not told of again.
const PAUSE: Duration = Duration::from_secs(60);
/// Addresses that are remembered of each reason. Of more than these in a minute nothing is told: a flood does not fill the log.
const MOST: usize = 64;

/// Why something is told of a client.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Reason {
    /// It sends where nothing ever goes out.
    Mute,
    /// It sent while another one writes.
    NotTheWriter,
    /// It sent a request of HTTP or TLS.
    Http,
    /// What it sent was dropped, as it ended its sending while the line was closed.
    Dropped,
    /// Its connection was lost.
    Lost,
    /// It took what came in too slowly.
    Slow,
    /// Not all that it sent went out.
    NotSent,
}

/// The addresses that were told of lately, by reasons.
#[derive(Debug, Default)]
pub struct Told {
    at: BTreeMap<Reason, BTreeMap<IpAddr, Last>>,
}

#[derive(Debug)]
struct Last {
    told: Instant,
    /// How often it came since and was not told of.
    untold: u64,
}

impl Told {
    /// Whether an address is to be told of now for a reason: how often it came and was not told of since it was told of last.
    pub fn due(&mut self, reason: Reason, address: IpAddr, now: Instant) -> Option<u64> {
        let at = self.at.entry(reason).or_default();
        if let Some(last) = at.get_mut(&address) {
            if now.since(last.told) < PAUSE {
                last.untold = last.untold.saturating_add(1);
                return None;
            }
            last.told = now;
            return Some(std::mem::take(&mut last.untold));
        }
        if at.len() >= MOST {
            at.retain(|_, last| now.since(last.told) < PAUSE);
        }
        if at.len() >= MOST {
            return None;
        }
        at.insert(address, Last { told: now, untold: 0 });
        Some(0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn address(number: u32) -> IpAddr {
        IpAddr::from(number.to_be_bytes())
    }

    #[test]
    fn an_address_is_told_of_once_a_minute() {
        let mut told = Told::default();
        let due = |told: &mut Told, number, millis| {
            told.due(Reason::Http, address(number), Instant::from_millis(millis)).is_some()
        };
        assert!(due(&mut told, 1, 0) && due(&mut told, 2, 10));
        assert!(!due(&mut told, 1, 59_999) && !due(&mut told, 2, 59_999));
        assert!(due(&mut told, 1, 60_000) && !due(&mut told, 2, 60_000));
    }

    #[test]
    fn one_reason_does_not_hide_another() {
        let mut told = Told::default();
        for reason in [Reason::Mute, Reason::NotTheWriter, Reason::Http] {
            assert_eq!(told.due(reason, address(1), Instant::from_millis(5)), Some(0), "{reason:?}");
            assert_eq!(told.due(reason, address(1), Instant::from_millis(6)), None, "{reason:?}");
        }
    }

    #[test]
    fn what_was_not_told_is_counted_and_told_with_the_next() {
        let mut told = Told::default();
        let mut due = |millis| told.due(Reason::Slow, address(1), Instant::from_millis(millis));
        assert_eq!(due(0), Some(0));
        assert!((1..=500).all(|millis| due(millis).is_none()));
        assert_eq!((due(60_000), due(60_001), due(120_000)), (Some(500), None, Some(1)));
    }

    #[test]
    fn a_flood_of_addresses_is_told_of_a_bounded_number_of_times_a_minute() {
        let mut told = Told::default();
        let lines = (0..10_000)
            .filter(|number| told.due(Reason::Lost, address(*number), Instant::from_millis(1)).is_some())
            .count();
        assert_eq!((lines, told.at[&Reason::Lost].len()), (MOST, MOST));
        assert_eq!(told.due(Reason::Http, address(99_999), Instant::from_millis(1)), Some(0), "for itself");
        assert_eq!(told.due(Reason::Lost, address(99_999), Instant::from_millis(60_001)), Some(0));
    }
}
