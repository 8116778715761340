//! How long to wait before the next attempt to reach the broker. Pure: the caller brings time and chance.
//!
//! Exponential with full jitter, so that a thousand gateways do not return to a restarted broker in one moment. It
//! applies to a broker that takes the session and drops it as well: only a session that lasted starts it anew.

use std::time::Duration;

use super::settings::{BACK_OFF_FIRST, BACK_OFF_LONGEST, HEALTHY_AFTER, MqttSettings, REFUSED, SILENCE};

/// How long to wait for what.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Pace {
    /// Longest first wait.
    pub first: Duration,
    /// Longest wait of all.
    pub longest: Duration,
    /// Longest wait after a refusal that only a person can mend; the shortest is half of it.
    pub refused: Duration,
    /// A session that lasted this long starts the waits anew.
    pub healthy_after: Duration,
    /// Shortest time without an acknowledgement that ends a session; one and a half times the keep alive if that is
    /// longer.
    pub silence: Duration,
}

impl Default for Pace {
    fn default() -> Self {
        Self {
            first: BACK_OFF_FIRST,
            longest: BACK_OFF_LONGEST,
            refused: REFUSED,
            healthy_after: HEALTHY_AFTER,
            silence: SILENCE,
        }
    }
}

impl Pace {
    /// As configured.
    #[must_use]
    pub fn of(settings: &MqttSettings) -> Self {
        Self { longest: Duration::from_secs(settings.reconnect_max_s.into()), ..Self::default() }
    }
}

/// The state of the waits.
#[derive(Clone, Copy, Debug)]
pub struct BackOff {
    pace: Pace,
    failures: u32,
}

impl BackOff {
    /// No failure yet.
    #[must_use]
    pub fn new(pace: Pace) -> Self {
        Self { pace, failures: 0 }
    }

    /// A session that lasted for `lasted` is over; zero for an attempt that never became a session.
    /// `chance` is drawn evenly from 0..1.
    pub fn after_session(&mut self, lasted: Duration, chance: f64) -> Duration {
        if lasted >= self.pace.healthy_after {
            self.failures = 0;
        }
        let ceiling = self.pace.first.saturating_mul(1 << self.failures.min(20)).min(self.pace.longest);
        self.failures = self.failures.saturating_add(1);
        // Never at once, whatever the chance.
        ceiling.mul_f64(chance.clamp(0.0, 1.0)).max(self.pace.first / 10)
    }

    /// The broker refused the session for a reason that only a person can mend: long waits at once, so that
    /// no broker locks the account for too many tries.
    pub fn after_refusal(&mut self, chance: f64) -> Duration {
        self.failures = u32::MAX;
        self.pace.refused.mul_f64(0.5 + 0.5 * chance.clamp(0.0, 1.0))
    }

    /// Failures since the last session that lasted.
    #[must_use]
    pub fn failures(&self) -> u32 {
        self.failures
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn p18_waits_double_up_to_a_minute_and_start_anew_only_after_a_session_that_lasted() {
        let mut back_off = BackOff::new(Pace::default());
        let mut wait = |lasted| back_off.after_session(Duration::from_secs(lasted), 1.0).as_secs();
        let waits: Vec<_> = (0..9).map(|_| wait(0)).collect();
        assert_eq!(waits, [1, 2, 4, 8, 16, 32, 60, 60, 60]);
        assert_eq!(wait(59), 60, "taken and dropped is no health");
        assert_eq!(wait(60), 1);
        assert_eq!(wait(0), 2);
    }

    #[test]
    fn p18_there_is_no_wait_of_zero() {
        let mut back_off = BackOff::new(Pace::default());
        assert_eq!(back_off.after_session(Duration::ZERO, 0.0), Duration::from_millis(100));
    }

    #[test]
    fn p18_a_thousand_gateways_do_not_return_in_one_moment() {
        // Each lost its session at 0 and fails until the broker is back after 30 s.
        let mut random = fastrand::Rng::with_seed(7);
        let mut connects = vec![0u32; 200];
        for _ in 0..1000 {
            let mut back_off = BackOff::new(Pace::default());
            let mut at = Duration::ZERO;
            while at < Duration::from_secs(30) {
                at += back_off.after_session(Duration::ZERO, random.f64());
            }
            connects[usize::try_from(at.as_secs()).unwrap()] += 1;
        }
        let most = connects.iter().max().unwrap();
        assert!(*most <= 50, "{most} connects in one second");
    }

    #[test]
    fn a_refusal_waits_long_at_once_and_a_lasting_session_mends_it() {
        let mut back_off = BackOff::new(Pace::default());
        assert_eq!(back_off.after_refusal(0.0), Duration::from_secs(30));
        assert_eq!(back_off.after_session(Duration::ZERO, 1.0), Duration::from_secs(60));
        assert_eq!(back_off.after_session(Duration::from_secs(61), 1.0), Duration::from_secs(1));
    }
}
