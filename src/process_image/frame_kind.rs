//! Kinds of frames that the gateway sends, and how many of each it sent.

/// A kind of frame that the gateway may send, where the configuration allows it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum FrameKind {
    /// NMT start, of one node or of all.
    NmtStart,
    /// NMT enter pre-operational.
    NmtPreOperational,
    /// NMT stop.
    NmtStop,
    /// NMT reset node and reset communication.
    NmtReset,
    /// The remote frame of node guarding.
    GuardRequest,
    /// A request of an SDO transfer.
    SdoRequest,
    /// SYNC.
    Sync,
    /// TIME.
    Time,
    /// The gateway's own heartbeat.
    Heartbeat,
    /// An RPDO.
    Rpdo,
    /// A question to an esd module.
    EsdRequest,
    /// Something that is set in an esd module.
    EsdSetting,
    /// The watchdog of an esd module is triggered.
    EsdWatchdog,
    /// Bytes for a serial line.
    EsdData,
}

impl FrameKind {
    /// All, in the order of [`FrameCounts`].
    pub const ALL: [Self; 14] = [
        Self::NmtStart,
        Self::NmtPreOperational,
        Self::NmtStop,
        Self::NmtReset,
        Self::GuardRequest,
        Self::SdoRequest,
        Self::Sync,
        Self::Time,
        Self::Heartbeat,
        Self::Rpdo,
        Self::EsdRequest,
        Self::EsdSetting,
        Self::EsdWatchdog,
        Self::EsdData,
    ];

    /// Its word in metrics and lists.
    #[must_use]
    pub fn word(self) -> &'static str {
        match self {
            Self::NmtStart => "nmt_start",
            Self::NmtPreOperational => "nmt_pre_operational",
            Self::NmtStop => "nmt_stop",
            Self::NmtReset => "nmt_reset",
            Self::GuardRequest => "guard_request",
            Self::SdoRequest => "sdo_request",
            Self::Sync => "sync",
            Self::Time => "time",
            Self::Heartbeat => "heartbeat",
            Self::Rpdo => "rpdo",
            Self::EsdRequest => "esd_request",
            Self::EsdSetting => "esd_setting",
            Self::EsdWatchdog => "esd_watchdog",
            Self::EsdData => "esd_data",
        }
    }

    fn place(self) -> usize {
        Self::ALL.iter().position(|kind| *kind == self).unwrap_or_default()
    }
}

/// How many frames of each kind were handed to a bus. They saturate.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct FrameCounts([u64; FrameKind::ALL.len()]);

impl FrameCounts {
    /// One more.
    pub fn count(&mut self, kind: FrameKind) {
        if let Some(count) = self.0.get_mut(kind.place()) {
            *count = count.saturating_add(1);
        }
    }

    /// How many of a kind.
    #[must_use]
    pub fn of(&self, kind: FrameKind) -> u64 {
        self.0.get(kind.place()).copied().unwrap_or_default()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_kind_is_counted_by_itself_and_has_a_word_of_its_own() {
        let mut counts = FrameCounts::default();
        for (place, kind) in FrameKind::ALL.into_iter().enumerate() {
            (0..=place).for_each(|_| counts.count(kind));
        }
        let counted = FrameKind::ALL.map(|kind| counts.of(kind));
        assert!(counted.iter().copied().eq(1..=14), "{counted:?}");
        let words: std::collections::BTreeSet<_> = FrameKind::ALL.map(FrameKind::word).into_iter().collect();
        assert_eq!(words.len(), FrameKind::ALL.len());
    }
}
