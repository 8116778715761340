//! Figures of the outbox.

/// Fill and counters since the start. Counters saturate.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct OutboxReport {
    /// Messages in the outbox: events, and at most one waiting for each retained topic.
    pub messages: usize,
    /// Most events.
    pub messages_limit: usize,
    /// Bytes in the outbox.
    pub bytes: usize,
    /// Most bytes of events.
    pub bytes_limit: usize,
    /// Events in the outbox, and their bytes: what the limits hold for.
    pub held: (usize, usize),
    /// Times that a message was handed to the session.
    pub sent: u64,
    /// Of those: after an earlier try whose session ended.
    pub sent_again: u64,
    /// Acknowledged by the broker.
    pub acknowledged: u64,
    /// Retained messages that were let go without an acknowledgement: a newer one of the same topic replaced them, or the
    /// session was lost.
    pub superseded: u64,
    /// Messages that the broker did not take, and that are not sent again.
    pub refused: u64,
    /// Larger than the limit of one message.
    pub too_large: u64,
    /// Events that left the journal before they could be read.
    pub events_missed: u64,
    /// Events taken in, and their bytes: for the forecast.
    pub events: (u64, u64),
    /// Events dropped because the outbox was full.
    pub events_dropped: u64,
}

impl OutboxReport {
    /// Messages dropped because the outbox was full, by class. Only events can be; the other classes are a promise of
    /// version 1 of the payloads.
    #[must_use]
    pub fn dropped(&self) -> [(&'static str, u64); 4] {
        [("sample", 0), ("status", 0), ("alarm", 0), ("event", self.events_dropped)]
    }

    /// How long events at their mean rate so far would take to fill what is free; `None` before the first event.
    /// At most 10,000 hours.
    #[must_use]
    #[expect(clippy::as_conversions, clippy::cast_precision_loss, reason = "a forecast needs no 53 bits")]
    pub fn hours_left(&self, uptime_s: u64) -> Option<f64> {
        let (events, bytes) = self.events;
        let hours = uptime_s.max(1) as f64 / 3600.0;
        let left = |free: usize, used: u64| free as f64 / (used as f64 / hours);
        let by_count = left(self.messages_limit.saturating_sub(self.held.0), events);
        let by_bytes = left(self.bytes_limit.saturating_sub(self.held.1), bytes);
        (events > 0).then(|| by_count.min(by_bytes).min(10_000.0))
    }
}
