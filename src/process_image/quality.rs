//! How far a value can be trusted (R-DET-084).

use std::fmt;

/// Quality of a value, best first; the order is used to find the worst of several.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Quality {
    /// Fresh, from a node that is supervised and well.
    Good,
    /// Fresh, but with a reservation.
    Uncertain(Reason),
    /// The last value, too old to act on.
    Stale(Reason),
    /// No usable value.
    Bad(Reason),
}

/// Why a value is not good.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Reason {
    /// Nothing was received since the gateway started.
    NeverReceived,
    /// Node guarding or heartbeat lost the node.
    NodeLost,
    /// The PDO that carries it did not come in time.
    PdoTimeout,
    /// The node restarted and has not sent it since.
    NodeRestarted,
    /// The node is not operational.
    NodeNotOperational,
    /// The bus is off, down or absent.
    BusUnavailable,
    /// Two nodes seem to share this node id.
    DuplicateNode,
    /// Computed from values of which none is usable.
    NoInput,
    /// The device sends NaN or infinity (R-DST-037).
    NotANumber,
    /// The object could not be read from the device.
    ReadFailed,
    /// The device maps its PDO otherwise than the mapping file.
    MappingDiffers,
    /// No TPDO of the device carries it.
    NotMapped,
    /// The device tells a unit that is not known here (R-DST-036).
    UnknownUnit,
    /// The device measures something else than what the value is to be converted to.
    OtherUnit,
    /// The device does not tell how many decimal digits its whole numbers have.
    UnknownDigits,
    /// The gateway has not sent it to the device, or it did not leave.
    NotSent,
}

impl Quality {
    /// Nothing was ever received: the quality of every tag at start.
    pub const NEVER: Self = Self::Bad(Reason::NeverReceived);

    /// Whether the value may be used: good or uncertain.
    #[must_use]
    pub fn is_usable(self) -> bool {
        matches!(self, Self::Good | Self::Uncertain(_))
    }

    /// Whether the value is good.
    #[must_use]
    pub fn is_good(self) -> bool {
        self == Self::Good
    }

    /// The worse of two.
    #[must_use]
    pub fn worst(self, other: Self) -> Self {
        self.max(other)
    }

    /// `good`, `uncertain`, `stale` or `bad`: the word in payloads and pages.
    #[must_use]
    pub fn word(self) -> &'static str {
        match self {
            Self::Good => "good",
            Self::Uncertain(_) => "uncertain",
            Self::Stale(_) => "stale",
            Self::Bad(_) => "bad",
        }
    }

    /// Why it is not good.
    #[must_use]
    pub fn reason(self) -> Option<Reason> {
        match self {
            Self::Good => None,
            Self::Uncertain(reason) | Self::Stale(reason) | Self::Bad(reason) => Some(reason),
        }
    }
}

impl Reason {
    /// The word in payloads and pages, in snake case.
    #[must_use]
    pub fn word(self) -> &'static str {
        match self {
            Self::NeverReceived => "never_received",
            Self::NodeLost => "node_lost",
            Self::PdoTimeout => "pdo_timeout",
            Self::NodeRestarted => "node_restarted",
            Self::NodeNotOperational => "node_not_operational",
            Self::BusUnavailable => "bus_unavailable",
            Self::DuplicateNode => "duplicate_node",
            Self::NoInput => "no_input",
            Self::NotANumber => "not_a_number",
            Self::ReadFailed => "read_failed",
            Self::MappingDiffers => "mapping_differs",
            Self::NotMapped => "not_mapped",
            Self::UnknownUnit => "unknown_unit",
            Self::OtherUnit => "other_unit",
            Self::UnknownDigits => "unknown_digits",
            Self::NotSent => "not_sent",
        }
    }
}

impl fmt::Display for Quality {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.reason() {
            None => f.write_str(self.word()),
            Some(reason) => write!(f, "{} ({})", self.word(), reason.word()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn r_det_084_the_worst_quality_wins() {
        let order = [
            Quality::Good,
            Quality::Uncertain(Reason::NodeLost),
            Quality::Stale(Reason::PdoTimeout),
            Quality::Bad(Reason::NeverReceived),
        ];
        for (index, better) in order.iter().enumerate() {
            for worse in order.iter().skip(index) {
                assert_eq!(better.worst(*worse), *worse);
                assert_eq!(worse.worst(*better), *worse);
            }
        }
    }
}
