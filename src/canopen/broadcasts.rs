//! SYNC, TIME and the own heartbeat: what is sent to everybody by the clock (CiA 301).
//!
//! Nothing of it is sent in the passive role, nor while the bus cannot be used. What did not leave is not sent later.

use std::time::Duration;

use super::beat::Beat;
use super::{NmtState, OwnHeartbeatSettings, Role, SyncSettings, TimeSettings, cob_id};
use crate::can::{CanFrame, CanId};
use crate::time::{Instant, Now, Timestamp};

/// Days from 1970-01-01 to 1984-01-01, from which TIME counts.
const FIRST_DAY: i64 = 5_113;
const MILLIS_OF_A_DAY: i64 = 86_400_000;

/// What of a bus goes to everybody.
#[derive(Debug)]
pub(super) struct Broadcasts {
    sync_id: CanId,
    time_id: CanId,
    sync: Option<SyncProducer>,
    time: Option<TimeProducer>,
    heartbeat: Option<HeartbeatProducer>,
    /// Synchronous TPDOs come within this long after SYNC.
    window: Option<Duration>,
    /// When the last SYNC was sent, or heard.
    last_sync: Option<Instant>,
}

#[derive(Debug)]
struct SyncProducer {
    beat: Beat,
    /// Highest number of the counter.
    overflow: Option<u8>,
    counter: u8,
}

#[derive(Debug)]
struct TimeProducer {
    beat: Beat,
    /// Whether a time that may be wrong is sent too.
    unsynchronised: bool,
}

#[derive(Debug)]
struct HeartbeatProducer {
    beat: Beat,
    id: CanId,
}

impl Broadcasts {
    /// Nothing is sent before [`resume`](Self::resume), and no TIME before [`set_clock`](Self::set_clock) unless the
    /// settings say otherwise.
    pub(super) fn new(
        role: Role,
        sync: Option<SyncSettings>,
        time: Option<TimeSettings>,
        heartbeat: Option<OwnHeartbeatSettings>,
    ) -> Self {
        let master = role == Role::Master;
        let period = |sync: SyncSettings| sync.period.filter(|_| master && sync.produced);
        Self {
            sync_id: sync.map_or(cob_id::SYNC, |sync| sync.cob_id),
            time_id: time.map_or(cob_id::TIME, |time| time.cob_id),
            sync: sync.and_then(|sync| {
                Some(SyncProducer { beat: Beat::new(period(sync)?), overflow: sync.overflow, counter: 0 })
            }),
            time: time.filter(|_| master).map(|time| TimeProducer {
                beat: Beat::new(time.period),
                unsynchronised: time.unsynchronised,
            }),
            heartbeat: heartbeat.filter(|_| master).map(|heartbeat| HeartbeatProducer {
                beat: Beat::new(heartbeat.period),
                id: cob_id::error_control(heartbeat.node),
            }),
            window: sync.and_then(|sync| sync.window),
            last_sync: None,
        }
    }

    /// The identifiers of SYNC and of TIME.
    pub(super) fn ids(&self) -> [CanId; 2] {
        [self.sync_id, self.time_id]
    }

    /// Whether SYNC is sent here.
    pub(super) fn produces_sync(&self) -> bool {
        self.sync.is_some()
    }

    /// Whether TIME is sent here.
    pub(super) fn produces_time(&self) -> bool {
        self.time.is_some()
    }

    /// The bus can be used. `synchronised`: the time of this host is right.
    pub(super) fn resume(&mut self, now: Instant, synchronised: bool) {
        if let Some(sync) = &mut self.sync {
            // Devices that count from a certain SYNC on must not take the old count for the new one's.
            sync.counter = 0;
            sync.beat.start(now);
        }
        if let Some(heartbeat) = &mut self.heartbeat {
            heartbeat.beat.start(now);
        }
        if let Some(time) = &mut self.time
            && (synchronised || time.unsynchronised)
        {
            time.beat.start(now);
        }
    }

    /// The bus cannot be used.
    pub(super) fn pause(&mut self) {
        if let Some(sync) = &mut self.sync {
            sync.beat.stop();
        }
        if let Some(time) = &mut self.time {
            time.beat.stop();
        }
        if let Some(heartbeat) = &mut self.heartbeat {
            heartbeat.beat.stop();
        }
        self.last_sync = None;
    }

    /// The time of this host became right, or can no longer be relied on; the bus can be used.
    pub(super) fn set_clock(&mut self, now: Instant, synchronised: bool) {
        if let Some(time) = &mut self.time {
            if synchronised || time.unsynchronised {
                time.beat.start(now);
            } else {
                time.beat.stop();
            }
        }
    }

    /// The SYNC that is due.
    pub(super) fn take_sync(&mut self, now: Instant) -> Option<CanFrame> {
        let sync = self.sync.as_mut()?;
        if !sync.beat.take(now) {
            return None;
        }
        self.last_sync = Some(now);
        match sync.overflow {
            None => CanFrame::data_frame(self.sync_id, &[]),
            Some(overflow) => {
                sync.counter = if sync.counter >= overflow { 1 } else { sync.counter + 1 };
                CanFrame::data_frame(self.sync_id, &[sync.counter])
            }
        }
    }

    /// The TIME message that is due.
    pub(super) fn take_time(&mut self, now: Now) -> Option<CanFrame> {
        let time = self.time.as_mut()?;
        if !time.beat.take(now.instant) {
            return None;
        }
        CanFrame::data_frame(self.time_id, &time_of_day(now.utc)?)
    }

    /// The heartbeat of the gateway that is due.
    pub(super) fn take_heartbeat(&mut self, now: Instant) -> Option<CanFrame> {
        let heartbeat = self.heartbeat.as_mut()?;
        if !heartbeat.beat.take(now) {
            return None;
        }
        CanFrame::data_frame(heartbeat.id, &[NmtState::Operational.code()])
    }

    /// Somebody else's SYNC was heard.
    pub(super) fn heard_sync(&mut self, now: Instant) {
        self.last_sync = Some(now);
    }

    /// How long after the last SYNC it is, where that is more than the window.
    pub(super) fn outside_window(&self, now: Instant) -> Option<Duration> {
        let passed = now.since(self.last_sync?);
        (passed > self.window?).then_some(passed)
    }

    /// When something is due.
    pub(super) fn poll_timeout(&self) -> Option<(Instant, &'static str)> {
        let sync = self.sync.as_ref().and_then(|sync| sync.beat.due()).map(|due| (due, "SYNC"));
        let time = self.time.as_ref().and_then(|time| time.beat.due()).map(|due| (due, "TIME"));
        let heartbeat = self.heartbeat.as_ref().and_then(|heartbeat| heartbeat.beat.due());
        let heartbeat = heartbeat.map(|due| (due, "heartbeat of the gateway"));
        sync.into_iter().chain(time).chain(heartbeat).min_by_key(|(due, _)| *due)
    }
}

/// `TIME_OF_DAY` of CiA 301: milliseconds since midnight, 28 bits, then days since 1984-01-01, 16 bits. `None` before that
/// day, and after the days that 16 bits can count (2163-06-06).
fn time_of_day(utc: Timestamp) -> Option<[u8; 6]> {
    let millis = utc.as_millis();
    let days = u16::try_from(millis.div_euclid(MILLIS_OF_A_DAY) - FIRST_DAY).ok()?;
    let [a, b, c, d] = u32::try_from(millis.rem_euclid(MILLIS_OF_A_DAY)).ok()?.to_le_bytes();
    let [low, high] = days.to_le_bytes();
    Some([a, b, c, d, low, high])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn time_counts_milliseconds_of_the_day_and_days_since_1984() {
        let at = |millis| time_of_day(Timestamp::from_millis(millis));
        assert_eq!(at(441_763_200_000), Some([0; 6]), "1984-01-01T00:00:00Z");
        assert_eq!(at(441_763_200_000 - 1), None);
        // 2025-11-22T07:46:33.123Z: 27,993,123 ms of day 15,301.
        assert_eq!(at(1_763_797_593_123), Some([0x23, 0x24, 0xAB, 0x01, 0xC5, 0x3B]));
        assert_eq!(at(441_763_200_000 + 65_536 * 86_400_000 - 1), Some([0xFF, 0x5B, 0x26, 0x05, 0xFF, 0xFF]));
        assert_eq!(at(441_763_200_000 + 65_536 * 86_400_000), None);
        assert_eq!(at(-1), None);
    }
}
