//! What a network and its nodes are to do. Plain data; checked by whoever reads it from a file.

use std::time::Duration;

use super::NodeId;
use super::boot::BootSettings;
use super::polls::Poll;
use super::sdo::SdoSettings;
use crate::can::CanId;

/// What the gateway may do on a bus.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Role {
    /// NMT master: starts and guards its nodes.
    #[default]
    Master,
    /// Sends nothing at all; derives what it can from what it overhears. Whether a node is lost it can tell only where
    /// somebody else guards it or it sends heartbeats.
    Passive,
}

/// One bus with its nodes.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct NetworkSettings {
    /// Master or passive.
    pub role: Role,
    /// Start all nodes with one broadcast instead of one by one (R-DET-018). Off unless asked for.
    pub start_broadcast: bool,
    /// SYNC, where it is told of; else it is 0x080 and somebody else's.
    pub sync: Option<SyncSettings>,
    /// TIME, where the gateway sends it; else it is 0x100 and somebody else's.
    pub time: Option<TimeSettings>,
    /// The gateway's own heartbeat, where it sends one.
    pub own_heartbeat: Option<OwnHeartbeatSettings>,
    /// The nodes; at most one for each node id (R-DET-004), no COB-ID twice. Of two equal ones the first counts.
    pub nodes: Vec<NodeSettings>,
}

/// SYNC on a bus (CiA 301, R-DST-045).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SyncSettings {
    /// Its identifier.
    pub cob_id: CanId,
    /// Whether the gateway sends it. In the passive role it never does.
    pub produced: bool,
    /// Time between two; `None` where somebody else sends it and it is not known. Nothing is sent without.
    pub period: Option<Duration>,
    /// Highest number of its counter, 2..=240; `None`: it carries no data.
    pub overflow: Option<u8>,
    /// How long after SYNC synchronous TPDOs may come; `None`: that is not looked at.
    pub window: Option<Duration>,
}

/// TIME on a bus (CiA 301): the UTC of the host. Sent in the role master only.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TimeSettings {
    /// Its identifier.
    pub cob_id: CanId,
    /// Time between two.
    pub period: Duration,
    /// Send it also while it is not known whether the clock of the host is right.
    pub unsynchronised: bool,
}

/// The heartbeat of the gateway itself, so that devices can tell whether it is there (CiA 301, R-DST-062). Sent in the
/// role master only; its state is always operational.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct OwnHeartbeatSettings {
    /// The gateway's node id on this bus.
    pub node: NodeId,
    /// Time between two.
    pub period: Duration,
}

/// One node.
#[derive(Clone, Debug, PartialEq)]
pub struct NodeSettings {
    /// Its id.
    pub id: NodeId,
    /// How its life is watched.
    pub error_control: ErrorControl,
    /// How it is started.
    pub start: StartSettings,
    /// How its objects are read and written; `None`: the node knows no SDO, and none is sent (R-DET-002).
    pub sdo: Option<SdoSettings>,
    /// What is done before it is started; nothing without SDO or in the passive role.
    pub boot: BootSettings,
    /// Objects that are read again and again once it is booted; none without SDO.
    pub polls: Vec<Poll>,
    /// The TPDOs that it sends, in the order of the mapping; [`PdoIndex`] counts in it.
    pub pdos: Vec<PdoSettings>,
    /// The RPDOs that it is sent; [`RpdoIndex`] counts in it. None unless the configuration allows it.
    pub rpdos: Vec<RpdoSettings>,
    /// Identifier of its emergency messages, node id already added; `None`: 0x080 + id, as CiA 301 predefines it.
    pub emergency: Option<CanId>,
    /// How long after the start of the gateway a node that showed no frame at all is reported (R-DET-001).
    pub never_seen_after: Duration,
}

/// Which TPDO of a node, by its place in [`NodeSettings::pdos`].
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct PdoIndex(pub usize);

/// Which RPDO of a node, by its place in [`NodeSettings::rpdos`].
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct RpdoIndex(pub usize);

/// How the life of a node is watched; guarding and heartbeat exclude each other (R-DET-044).
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum ErrorControl {
    /// The gateway asks by remote frame, the node answers with its state and a toggle bit.
    Guarding(GuardingSettings),
    /// The node tells its state by itself.
    Heartbeat {
        /// Lost after this long without a frame on `0x700 + id`, counted from the start of the gateway.
        timeout: Duration,
    },
    /// Not at all. Such a node is started automatically after its boot-up message only: it reports no state.
    None,
}

/// Node guarding (CiA 301, R-DET-031..046).
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct GuardingSettings {
    /// Time between two requests, 20 ms..65.535 s; zero = no guarding, as [`ErrorControl::None`] (R-DET-031).
    pub guard_time: Duration,
    /// Consecutive missed replies until the node is lost, 1..=255 (R-DET-032).
    pub life_time_factor: u8,
    /// A reply later than this is missed; at most the guard time (R-DET-033).
    pub reply_timeout: Duration,
    /// What a wrong toggle bit means (R-DET-035).
    pub toggle: TogglePolicy,
    /// Compare a reply's toggle bit with that of the last state frame received, also of one that answered somebody
    /// else's request, instead of the last reply accepted. Bears with a second master that guards the same node.
    pub toggle_resync: bool,
    /// DLC of the request: 1 for most devices, 0 for some.
    pub rtr_dlc: u8,
    /// Pause between an NMT command to the node and the next request: a request that falls into it is sent at its end.
    pub settle: Duration,
}

impl Default for GuardingSettings {
    fn default() -> Self {
        Self {
            guard_time: Duration::from_millis(500),
            life_time_factor: 3,
            reply_timeout: Duration::from_millis(100),
            toggle: TogglePolicy::Strict,
            toggle_resync: false,
            rtr_dlc: 1,
            settle: Duration::from_millis(20),
        }
    }
}

/// What a reply with the wrong toggle bit means (R-DET-035).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum TogglePolicy {
    /// As if it had not come.
    #[default]
    Strict,
    /// Counted, but accepted.
    Warn,
    /// Not looked at.
    Off,
}

/// How a node is started (R-DET-016..020). Started is a node that reports operational or sends a TPDO.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct StartSettings {
    /// Send NMT start when it reports pre-operational, or stopped, unless an operator put it there through the gateway;
    /// then it stays so until an operator starts it. Off: the node starts by itself, or an operator starts it.
    pub auto_start: bool,
    /// After a boot-up message start at the latest after this long.
    pub delay: Duration,
    /// A start that shows no effect for this long is repeated.
    pub confirm: Duration,
    /// Time between repeated starts.
    pub retry: Duration,
    /// Send reset node when a lost node comes back. Off: a reset of a protection device is the operator's decision.
    pub reset_on_recovery: bool,
}

impl Default for StartSettings {
    fn default() -> Self {
        Self {
            auto_start: true,
            delay: Duration::from_millis(500),
            confirm: Duration::from_millis(1000),
            retry: Duration::from_millis(1000),
            reset_on_recovery: false,
        }
    }
}

/// One TPDO.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct PdoSettings {
    /// TPDO number, 1-based, for messages.
    pub number: u16,
    /// Its identifier, with the node id already added.
    pub cob_id: CanId,
    /// Bytes that the mapping uses; a shorter frame is discarded as a whole (R-DET-080).
    pub length: u8,
    /// Discard a longer frame too (R-DET-081).
    pub strict_length: bool,
    /// Stale after this long while the node is operational; `None` = not supervised (R-DET-082).
    pub timeout: Option<Duration>,
    /// It follows SYNC (transmission types 0 to 240).
    pub synchronous: bool,
    /// Expected time between two frames, where it is known: a rate of over 1.5 times that of the shortest is suspicious.
    pub shortest_period: Option<Duration>,
}

/// One RPDO: what the gateway sends a node.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RpdoSettings {
    /// RPDO number, 1-based, for messages.
    pub number: u16,
    /// Its identifier, with the node id already added.
    pub cob_id: CanId,
    /// Bytes, 1..=8.
    pub length: u8,
    /// When it is sent.
    pub trigger: RpdoTrigger,
    /// Send it again after this long without a change; with [`RpdoTrigger::Event`] only.
    pub refresh: Option<Duration>,
    /// At least this long between two frames, whatever changes.
    pub inhibit: Duration,
}

/// When an RPDO is sent.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum RpdoTrigger {
    /// When it changes (transmission types 254 and 255).
    Event,
    /// After every so many SYNCs, 1..=240; 0: after the next SYNC when it changed.
    Sync(u8),
}
