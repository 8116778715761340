//! Who may log in, pure: tokens are compared in the same time whatever they are, and who guesses has to wait.

use core::net::{IpAddr, Ipv6Addr};
use std::collections::BTreeMap;
use std::time::Duration;

use crate::time::Instant;

/// So many failures within [`WINDOW`], and the address is shut out for [`BLOCKED`].
const MOST_FAILURES: usize = 5;
/// See [`MOST_FAILURES`].
const WINDOW: Duration = Duration::from_secs(60);
/// See [`MOST_FAILURES`].
const BLOCKED: Duration = Duration::from_secs(60);
/// Addresses that are kept apart. Further ones are taken for one.
const MOST_ADDRESSES: usize = 1_024;

/// The shortest token that counts: what is shorter can be guessed.
pub const SHORTEST_TOKEN: usize = 16;

/// Failed logins by address.
#[derive(Debug, Default)]
pub struct Failures {
    addresses: BTreeMap<IpAddr, Failed>,
}

#[derive(Debug, Default)]
struct Failed {
    /// The oldest first.
    last: [Option<Instant>; MOST_FAILURES],
    blocked_until: Option<Instant>,
}

impl Failed {
    fn matters(&self, now: Instant) -> bool {
        let recent = self.last.iter().flatten().any(|at| *at + WINDOW > now);
        recent || self.blocked_until.is_some_and(|until| until > now)
    }
}

/// Whoever has one address of an IPv6 network has all of it.
pub(super) fn place(address: IpAddr) -> IpAddr {
    match address.to_canonical() {
        IpAddr::V6(address) => IpAddr::V6(Ipv6Addr::from_bits(address.to_bits() & !u128::from(u64::MAX))),
        IpAddr::V4(address) => IpAddr::V4(address),
    }
}

impl Failures {
    /// Whether an address is shut out.
    #[must_use]
    pub fn is_blocked(&self, now: Instant, address: IpAddr) -> bool {
        let failed = self.addresses.get(&self.key(address));
        failed.and_then(|failed| failed.blocked_until).is_some_and(|until| until > now)
    }

    /// A login failed.
    pub fn note(&mut self, now: Instant, address: IpAddr) {
        self.addresses.retain(|_, failed| failed.matters(now));
        let key = self.key(address);
        let failed = self.addresses.entry(key).or_default();
        failed.last.rotate_left(1);
        if let Some(newest) = failed.last.last_mut() {
            *newest = Some(now);
        }
        if failed.last.first().copied().flatten().is_some_and(|oldest| oldest + WINDOW > now) {
            *failed = Failed { last: Default::default(), blocked_until: Some(now + BLOCKED) };
        }
    }

    fn key(&self, address: IpAddr) -> IpAddr {
        let place = place(address);
        let known = self.addresses.contains_key(&place);
        if known || self.addresses.len() < MOST_ADDRESSES { place } else { IpAddr::V6(Ipv6Addr::UNSPECIFIED) }
    }
}

/// Whether a token is the one of a file, in a time that tells nothing but its length.
#[must_use]
pub fn is_token(given: &str, file: &str) -> bool {
    let (given, known) = (given.as_bytes(), file.trim().as_bytes());
    let differ = given.iter().zip(known).fold(0, |differ, (one, other)| differ | (one ^ other));
    known.len() >= SHORTEST_TOKEN && given.len() == known.len() && std::hint::black_box(differ) == 0
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(secs: u64) -> Instant {
        Instant::from_millis(secs * 1000)
    }

    #[test]
    fn cr_1_11_five_failures_a_minute_shut_an_address_out_for_a_minute() {
        let (mut failures, address) = (Failures::default(), "10.0.0.7".parse().unwrap());
        for second in 0..5 {
            assert!(!failures.is_blocked(at(second), address), "{second}");
            failures.note(at(second), address);
        }
        assert!(failures.is_blocked(at(4), address) && failures.is_blocked(at(63), address));
        assert!(!failures.is_blocked(at(4), "10.0.0.8".parse().unwrap()));
        assert!(!failures.is_blocked(at(64), address));
        for second in 0..100 {
            failures.note(at(1000 + second * 16), address);
            assert!(!failures.is_blocked(at(1000 + second * 16), address), "four a minute");
        }
    }

    #[test]
    fn an_ipv6_network_is_one_place_and_the_list_is_bounded() {
        let mut failures = Failures::default();
        for host in 1..=5 {
            failures.note(at(0), format!("fd00::{host}").parse().unwrap());
        }
        assert!(failures.is_blocked(at(0), "fd00::9".parse().unwrap()));
        for host in 0..10_000_u32 {
            failures.note(at(0), core::net::Ipv4Addr::from_bits(host).into());
        }
        assert!(failures.addresses.len() <= MOST_ADDRESSES + 1);
        assert!(failures.is_blocked(at(0), "192.0.2.1".parse().unwrap()), "those above are one");
    }

    #[test]
    fn only_the_whole_token_counts_and_a_short_or_empty_file_is_nobody() {
        assert!(is_token("0123456789abcdef", "0123456789abcdef\n"));
        for given in ["", "0123456789abcde", "0123456789abcdeF", "0123456789abcdef0"] {
            assert!(!is_token(given, "0123456789abcdef"), "{given}");
        }
        assert!(!is_token("", "") && !is_token("short", "short"));
    }
}
