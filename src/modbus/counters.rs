//! What the server has seen, for metrics.

use std::sync::atomic::{AtomicU64, Ordering};

use super::pdu::ExceptionCode;

/// Highest exception code that the standard defines.
const HIGHEST_CODE: usize = 11;

/// Counters since the start; all but [`open`](CounterValues::open) only grow.
#[derive(Debug, Default)]
pub struct Counters {
    accepted: AtomicU64,
    open: AtomicU64,
    accept_errors: AtomicU64,
    requests: AtomicU64,
    exceptions: [AtomicU64; HIGHEST_CODE + 1],
    foreign_frames: AtomicU64,
    forbidden: AtomicU64,
    delayed: AtomicU64,
    turned_away: AtomicU64,
    rtu_discarded: AtomicU64,
    ended: [AtomicU64; 9],
}

/// Why a connection ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum End {
    /// The client closed it.
    Closed,
    /// The network broke it.
    Broken,
    /// What came was no Modbus.
    Malformed,
    /// No request for the idle time.
    Idle,
    /// A request stayed incomplete.
    PartialFrame,
    /// The client did not take its answers.
    SlowClient,
    /// It had to make room.
    Evicted,
    /// The gateway stops.
    Stopped,
    /// There was no TLS, or its certificate was refused.
    Handshake,
}

impl End {
    /// All of them.
    pub const ALL: [Self; 9] = [
        Self::Closed,
        Self::Broken,
        Self::Malformed,
        Self::Idle,
        Self::PartialFrame,
        Self::SlowClient,
        Self::Evicted,
        Self::Stopped,
        Self::Handshake,
    ];

    /// The word in metrics and logs.
    #[must_use]
    pub fn word(self) -> &'static str {
        match self {
            Self::Closed => "closed",
            Self::Broken => "broken",
            Self::Malformed => "malformed",
            Self::Idle => "idle",
            Self::PartialFrame => "partial_frame",
            Self::SlowClient => "slow_client",
            Self::Evicted => "evicted",
            Self::Stopped => "stopped",
            Self::Handshake => "handshake",
        }
    }

    fn place(self) -> usize {
        Self::ALL.iter().position(|end| *end == self).unwrap_or_default()
    }
}

/// The counters at one moment.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct CounterValues {
    /// Connections accepted.
    pub accepted: u64,
    /// Connections open now.
    pub open: u64,
    /// Times that accepting failed: no file descriptor, no memory.
    pub accept_errors: u64,
    /// Requests answered, exceptions included.
    pub requests: u64,
    /// Exceptions by their code, 0..=11; 0 counts codes that the standard does not define.
    pub exceptions: [u64; HIGHEST_CODE + 1],
    /// Frames of other protocols, passed over.
    pub foreign_frames: u64,
    /// Of the requests: those that their client had no right to.
    pub forbidden: u64,
    /// Of the requests: those that waited, as their client asks faster than it may.
    pub delayed: u64,
    /// Connections that were not let in: not allowed, or no place.
    pub turned_away: u64,
    /// Frames on serial lines with a wrong check.
    pub rtu_discarded: u64,
    /// Connections ended, in the order of [`End::ALL`].
    pub ended: [u64; 9],
}

impl CounterValues {
    /// Connections that ended so.
    #[must_use]
    pub fn ended(&self, end: End) -> u64 {
        self.ended.get(end.place()).copied().unwrap_or_default()
    }
}

fn place(code: ExceptionCode) -> usize {
    Some(usize::from(u8::from(code))).filter(|code| *code <= HIGHEST_CODE).unwrap_or_default()
}

fn count(counter: &AtomicU64) {
    counter.fetch_add(1, Ordering::Relaxed);
}

impl Counters {
    /// A connection was accepted.
    pub fn accepted(&self) {
        count(&self.accepted);
        count(&self.open);
    }

    /// Accepting failed.
    pub fn accept_error(&self) {
        count(&self.accept_errors);
    }

    /// A request was answered.
    pub fn request(&self, exception: Option<ExceptionCode>) {
        count(&self.requests);
        if let Some(counter) = exception.and_then(|code| self.exceptions.get(place(code))) {
            count(counter);
        }
    }

    /// A frame of another protocol was passed over.
    pub fn foreign_frame(&self) {
        count(&self.foreign_frames);
    }

    /// So many frames on serial lines were thrown away because their check was wrong.
    pub fn rtu_discarded(&self, more: u64) {
        self.rtu_discarded.fetch_add(more, Ordering::Relaxed);
    }

    /// A connection was not let in.
    pub fn turned_away(&self) {
        count(&self.turned_away);
    }

    /// A request was answered 01 because its client had no right to it.
    pub fn forbidden(&self) {
        count(&self.forbidden);
    }

    /// A request has to wait, as its client asks faster than it may.
    pub fn delayed(&self) {
        count(&self.delayed);
    }

    /// A connection that was accepted has ended.
    pub fn ended(&self, end: End) {
        self.open.fetch_sub(1, Ordering::Relaxed);
        if let Some(counter) = self.ended.get(end.place()) {
            count(counter);
        }
    }

    /// The counters as they stand.
    #[must_use]
    pub fn values(&self) -> CounterValues {
        let value = |counter: &AtomicU64| counter.load(Ordering::Relaxed);
        CounterValues {
            accepted: value(&self.accepted),
            open: value(&self.open),
            accept_errors: value(&self.accept_errors),
            requests: value(&self.requests),
            exceptions: self.exceptions.each_ref().map(value),
            foreign_frames: value(&self.foreign_frames),
            forbidden: value(&self.forbidden),
            delayed: value(&self.delayed),
            turned_away: value(&self.turned_away),
            rtu_discarded: value(&self.rtu_discarded),
            ended: self.ended.each_ref().map(value),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn exceptions_and_ends_are_counted_by_kind() {
        let counters = Counters::default();
        counters.request(None);
        counters.request(Some(ExceptionCode::IllegalDataAddress));
        counters.request(Some(ExceptionCode::GatewayTargetDevice));
        counters.request(Some(ExceptionCode::Custom(99)));
        counters.accepted();
        counters.accepted();
        counters.ended(End::Idle);
        let values = counters.values();
        assert_eq!((values.accepted, values.open), (2, 1));
        assert_eq!(values.requests, 4);
        assert_eq!(values.exceptions, [1, 0, 1, 0, 0, 0, 0, 0, 0, 0, 0, 1]);
        assert_eq!(End::ALL.map(|end| values.ended(end)), [0, 0, 0, 1, 0, 0, 0, 0, 0]);
    }
}
