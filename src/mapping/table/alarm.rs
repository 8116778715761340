//! Alarms.

use std::borrow::Cow;
use std::time::Duration;

use super::super::expression::Expression;
use crate::can::BusIndex;
use crate::canopen::emcy;
use crate::process_image::{NodeIndex, Priority, SessionTrouble, TagIndex, Value};

/// An alarm.
#[derive(Clone, Debug, PartialEq)]
pub struct AlarmDef {
    /// Unique among the alarms of its owner, snake case, part of the topic.
    pub name: String,
    /// Whose it is.
    pub owner: AlarmOwner,
    /// When it holds.
    pub condition: AlarmCondition,
    /// How urgent.
    pub priority: Priority,
    /// The condition must hold this long.
    pub on_delay: Duration,
    /// The condition must be gone this long.
    pub off_delay: Duration,
    /// Stays until acknowledged and reset.
    pub latch: bool,
    /// Alarms that tell the cause, by their place in [`TagTable::alarms`](super::TagTable::alarms).
    pub suppressed_by: Vec<usize>,
    /// Takes part in its owner's first-out.
    pub first_out: bool,
    /// Bit at discrete inputs 128 (active) and 160 (unacknowledged), 0..=31; alarms of one array share one bit.
    pub bit: Option<u8>,
    /// The tag whose value is shown with the alarm.
    pub value: Option<TagIndex>,
    /// What it means, one sentence.
    pub text: String,
    /// What the operator should do.
    pub action: String,
}

impl AlarmDef {
    /// What it means, in the words for the operator: with the error code, where one raised it; with the reason why there is no
    /// MQTT session.
    #[must_use]
    pub fn told(&self, value: Option<Value>) -> Cow<'_, str> {
        let of_error =
            matches!(self.condition, AlarmCondition::BuiltIn(BuiltIn::Emergency | BuiltIn::NamedError(_)));
        match value {
            Some(Value::Unsigned(code)) if of_error => {
                let meaning = u16::try_from(code).map_or("", emcy::meaning);
                Cow::Owned(format!("{} Error code 0x{code:04X} ({meaning}).", self.text))
            }
            Some(Value::Unsigned(code)) if self.condition == AlarmCondition::BuiltIn(BuiltIn::MqttDown) => {
                let why = SessionTrouble::of_code(code).map_or("", SessionTrouble::meaning);
                Cow::Owned(format!("{} {why}", self.text))
            }
            _ => Cow::Borrowed(&self.text),
        }
    }
}

/// Whose an alarm is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum AlarmOwner {
    /// The gateway's own.
    Gateway,
    /// A bus's.
    Bus(BusIndex),
    /// A node's.
    Node(NodeIndex),
}

/// When an alarm holds.
#[derive(Clone, Debug, PartialEq)]
pub enum AlarmCondition {
    /// A condition on tags, from the mapping file.
    Tags(Expression),
    /// A condition that the gateway itself watches.
    BuiltIn(BuiltIn),
}

/// Conditions that the gateway watches for every bus and node, whatever the device.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum BuiltIn {
    /// G01: no MQTT session.
    MqttDown,
    /// G02: what is kept for the broker fills four fifths of its room.
    BufferFilling,
    /// G03: the disk that it is kept on cannot be used.
    BufferFault,
    /// G05: a new configuration was refused; that before goes on.
    ConfigurationRejected,
    /// G06: a certificate expires within a month.
    CertificateExpires,
    /// G06: within a week.
    CertificateExpiresSoon,
    /// G06: it has.
    CertificateExpired,
    /// G07: requests were refused for want of a right, again and again.
    AccessRefused,
    /// B01: the controller is off the bus.
    BusOff,
    /// B02: the interface is missing or down.
    InterfaceDown,
    /// B03: no frame from anyone while nodes are expected.
    BusSilent,
    /// B04: error passive.
    ErrorPassive,
    /// B05: the kernel dropped frames.
    FramesLost,
    /// B06: load over 80 %.
    HighLoad,
    /// B07: an NMT command from somebody else.
    ForeignMaster,
    /// SYNC or TIME from somebody else, where the gateway sends it too.
    ForeignProducer,
    /// N01: guarding or heartbeat lost the node.
    NodeLost,
    /// N01, first time: no frame at all since the start (R-DET-001).
    NodeNeverSeen,
    /// N02: wrong toggle bits.
    GuardToggle,
    /// N03: this TPDO (by its place in the node's settings) is stale.
    PdoTimeout(usize),
    /// N04: started without effect, or not operational (R-DET-020).
    NotOperational,
    /// N05: restarted unasked.
    Restarted,
    /// N06: TPDO with a wrong length.
    PdoLength,
    /// N07: two nodes seem to share this id.
    DuplicateNode,
    /// Another device than the mapping is for (R-DST-001).
    IdentityMismatch,
    /// N09: an error that the mapping does not name.
    Emergency,
    /// N09: an error that the mapping names, by its place in [`EmergencyDef::errors`](super::EmergencyDef::errors).
    NamedError(usize),
    /// R-DET-043: somebody else guards this node.
    ForeignGuardMaster,
    /// An esd module is not as the configuration wants it, and cannot be made so.
    NotConfigured,
}
