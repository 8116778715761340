//! Which refused handshakes the log has been told of: the same one of the same address once a minute, pure.

use core::net::IpAddr;
use std::collections::BTreeMap;
use std::time::Duration;

use crate::time::Instant;

/// How long the same refusal is not told again.
const QUIET: Duration = Duration::from_secs(60);
/// Refusals that are remembered; when there are more, further ones are only counted.
const REMEMBERED: usize = 64;

/// What was told when.
#[derive(Debug, Default)]
pub struct Told(BTreeMap<(IpAddr, &'static str), Instant>);

impl Told {
    /// Whether to tell of it now.
    pub fn is_news(&mut self, now: Instant, address: IpAddr, reason: &'static str) -> bool {
        self.0.retain(|_, told| now.since(*told) < QUIET);
        if self.0.contains_key(&(address, reason)) || self.0.len() >= REMEMBERED {
            return false;
        }
        self.0.insert((address, reason), now);
        true
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_same_refusal_is_told_once_a_minute_and_a_flood_does_not_fill_the_log() {
        let mut told = Told::default();
        let address = |last| IpAddr::from([10, 0, 0, last]);
        let at = |secs: u64| Instant::from_millis(secs * 1000);
        assert!(told.is_news(at(0), address(1), "expired"));
        assert!(!told.is_news(at(59), address(1), "expired"));
        assert!(told.is_news(at(59), address(1), "no_tls") && told.is_news(at(59), address(2), "expired"));
        assert!(told.is_news(at(60), address(1), "expired"));
        let news = (0..=255).filter(|last| told.is_news(at(200), address(*last), "slow")).count();
        assert_eq!(news, REMEMBERED);
    }
}
