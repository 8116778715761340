//! What is asked of an LSS master, and what it gives back. Plain data.

use std::fmt;
use std::time::Duration;

use crate::can::CanFrame;
use crate::canopen::{NmtRequest, NodeId};

/// The address of an LSS slave: its identity object 0x1018 (R-DST-095). No two devices in the world have the same.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct LssAddress {
    /// Vendor id, 0x1018:1; 0x23D for Danfoss.
    pub vendor: u32,
    /// Product code, 0x1018:2.
    pub product: u32,
    /// Revision number, 0x1018:3.
    pub revision: u32,
    /// Serial number, 0x1018:4.
    pub serial: u32,
}

impl fmt::Display for LssAddress {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { vendor, product, revision, serial } = self;
        write!(f, "vendor 0x{vendor:X} product 0x{product:X} revision 0x{revision:X} serial {serial}")
    }
}

/// A group of LSS addresses, as `identify remote slave` takes it: one vendor, one product, ranges of the rest. Both ends
/// are part of a range.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct LssRange {
    /// Vendor id.
    pub vendor: u32,
    /// Product code.
    pub product: u32,
    /// Least and greatest revision number. Some devices (DST P92C, R-DST-106) ignore it when both are 0.
    pub revision: (u32, u32),
    /// Least and greatest serial number.
    pub serial: (u32, u32),
}

/// What is known of an address before a fastscan; what is not is found out bit by bit.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct LssKnown {
    /// Vendor id.
    pub vendor: Option<u32>,
    /// Product code.
    pub product: Option<u32>,
    /// Revision number.
    pub revision: Option<u32>,
    /// Serial number.
    pub serial: Option<u32>,
}

/// State of an LSS slave.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LssState {
    /// Ordinary operation.
    Waiting,
    /// Takes node id and bit rate.
    Configuration,
}

/// A bit rate by its index in the table of CiA 305 (R-DST-101).
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct LssBitRate(u8);

impl LssBitRate {
    /// kbit/s by index; 5 is reserved.
    const TABLE: [Option<u32>; 9] =
        [Some(1000), Some(800), Some(500), Some(250), Some(125), None, Some(50), Some(20), Some(10)];

    /// From kbit/s; `None` for rates that CiA 305 does not have, such as 100.
    #[must_use]
    pub fn from_kbit(kbit: u32) -> Option<Self> {
        let index = Self::TABLE.iter().position(|each| *each == Some(kbit))?;
        u8::try_from(index).ok().map(Self)
    }

    /// kbit/s.
    #[must_use]
    pub fn kbit(self) -> u32 {
        Self::TABLE.get(usize::from(self.0)).copied().flatten().unwrap_or_default()
    }

    /// Index in the table.
    #[must_use]
    pub const fn index(self) -> u8 {
        self.0
    }
}

impl fmt::Display for LssBitRate {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} kbit/s", self.kbit())
    }
}

impl fmt::Debug for LssBitRate {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Display::fmt(self, f)
    }
}

/// How an LSS master behaves.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct LssSettings {
    /// How long an answer may take (`lss_timeout_ms`, R-DST-110).
    pub timeout: Duration,
    /// How long the answer to `store` may take (R-DST-110).
    pub store_timeout: Duration,
    /// How long a scan waits for an answer; silence means "no", so that a scan waits often.
    pub scan_timeout: Duration,
    /// At least so much time between two frames: simple devices have one receive buffer.
    pub gap: Duration,
    /// Also takes an answer to `store` whose command specifier is 0, as the manual of the DST P92C prints it
    /// (`lss_accept_zero_cs`, R-DST-115).
    pub accept_zero_cs: bool,
    /// How long to wait for the boot-up message after a change (`boot_timeout_ms`, R-DST-118).
    pub boot_timeout: Duration,
}

impl Default for LssSettings {
    fn default() -> Self {
        Self {
            timeout: Duration::from_millis(200),
            store_timeout: Duration::from_millis(1000),
            scan_timeout: Duration::from_millis(50),
            gap: Duration::from_millis(2),
            accept_zero_cs: false,
            boot_timeout: Duration::from_millis(5000),
        }
    }
}

/// One thing to do. One at a time.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum LssJob {
    /// All slaves into a state. Gives [`LssAnswer::Done`].
    SwitchGlobal {
        /// The state.
        state: LssState,
        /// An operator confirms that there is one slave on the bus: without that, nothing is configured in this state
        /// (R-DST-111).
        only_slave: bool,
    },
    /// One slave into configuration state. Gives [`LssAnswer::Done`].
    SwitchSelective(LssAddress),
    /// Node id for the slave in configuration state; `None`: without one (0xFF). Gives [`LssAnswer::Done`].
    ConfigureNodeId(Option<NodeId>),
    /// Bit rate for the slave in configuration state. Gives [`LssAnswer::Done`].
    ConfigureBitRate(LssBitRate),
    /// All slaves in configuration state change to the bit rate that they stored: they fall silent for the delay, change,
    /// and stay silent for the delay again. In steps of 1 ms, 65.5 s at most. Gives [`LssAnswer::Done`].
    ActivateBitRate {
        /// The delay.
        delay: Duration,
    },
    /// The slave in configuration state stores what it was told. Gives [`LssAnswer::Done`].
    Store,
    /// Asks the slave in configuration state for its address. Gives [`LssAnswer::Address`].
    InquireAddress,
    /// Asks the slave in configuration state for its node id. Gives [`LssAnswer::NodeId`].
    InquireNodeId,
    /// Whether there are slaves in a range. Gives [`LssAnswer::Answered`].
    Identify(LssRange),
    /// Whether there are slaves without node id. Gives [`LssAnswer::Answered`].
    IdentifyNonConfigured,
    /// Finds one slave without node id and leaves it in configuration state (CiA 305, from V2.2 on). Gives
    /// [`LssAnswer::Found`] with none or one.
    Fastscan(LssKnown),
    /// Finds all slaves in these ranges, whether they have a node id or not, by halving the ranges. Vendor and product
    /// must be known: the protocol takes no ranges of them. Gives [`LssAnswer::Found`], and
    /// [`LssOutput::Found`] as it goes.
    Slowscan(Vec<LssRange>),
    /// Gives one slave a new node id or bit rate, from its preparation to its boot-up (R-DST-113). Gives
    /// [`LssAnswer::Changed`].
    Change(LssChange),
}

/// A change of node id, bit rate or both.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct LssChange {
    /// Which slave.
    pub target: LssTarget,
    /// Its present node id; `None`: unknown or none. Then its heartbeat cannot be turned off before (R-DST-092).
    pub node: Option<NodeId>,
    /// Stop all nodes, as the manual's example does, instead of the one at `node`. All are stopped also when `node` is not
    /// known.
    pub stop_all: bool,
    /// The new node id.
    pub node_id: Option<NodeId>,
    /// The new bit rate.
    pub bit_rate: Option<LssBitRate>,
    /// How the change comes into effect.
    pub activation: LssActivation,
}

/// Whom a change is for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LssTarget {
    /// The slave of this address.
    Address(LssAddress),
    /// The only slave on the bus, of which an operator confirms that it is (R-DST-111). All slaves obey.
    OnlySlave {
        /// Without it the change is refused.
        confirmed: bool,
    },
}

/// How a change comes into effect.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LssActivation {
    /// At once. A new bit rate: the slave changes after `delay`, and so must our interface.
    Now {
        /// For a new bit rate.
        delay: Duration,
    },
    /// When somebody switches the device off and on (R-DST-114).
    PowerCycle,
}

/// What a job found out.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum LssAnswer {
    /// It is done; there is nothing to tell.
    Done,
    /// The address.
    Address(LssAddress),
    /// The node id; `None`: the slave has none (0xFF).
    NodeId(Option<NodeId>),
    /// Whether a slave answered.
    Answered(bool),
    /// The slaves that were found.
    Found(Vec<LssAddress>),
    /// The change is stored.
    Changed {
        /// It is in effect: the node booted with it. Else it takes effect when the device is switched off and on.
        active: bool,
        /// NMT states and heartbeat are as they were before.
        restored: bool,
    },
}

/// What only the caller can do for a [`LssJob::Change`]. It answers each with
/// [`LssMaster::handle_performed`](super::LssMaster::handle_performed), before which the job does not go on.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum LssDuty {
    /// Read 0x1017 of this node by SDO; answer with its value, 0 when there is no such object.
    ReadHeartbeat(NodeId),
    /// Write 0x1017 of this node by SDO, in milliseconds; 0 = off.
    WriteHeartbeat(NodeId, u16),
    /// Send this NMT request to one node or all, and remember the states that the nodes had.
    Nmt(Option<NodeId>, NmtRequest),
    /// Set our own interface to this bit rate; answer when the bus can be used again.
    ChangeInterface(LssBitRate),
    /// Wait for the boot-up message of this node, which may have come at any time after the last frame of the job was sent;
    /// answer [`Performed::No`] when none came within the time.
    AwaitBootUp(NodeId, Duration),
    /// Read 0x1018 of this node by SDO; answer [`Performed::No`] when it is another address.
    CheckIdentity(NodeId, LssAddress),
    /// Bring the nodes into the states that they had before the NMT request; the changed node by its new id.
    RestoreStates,
}

/// What became of an [`LssDuty`].
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Performed {
    /// Done.
    Yes,
    /// It did not come about.
    No,
    /// Done, and this was read.
    Value(u32),
    /// It failed, for this reason.
    Failed(String),
}

/// What an LSS master wants done, or tells.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum LssOutput {
    /// Send this frame.
    Transmit(CanFrame),
    /// Do this, and say what became of it.
    Perform(LssDuty),
    /// A scan found a slave.
    Found(LssAddress),
    /// The job is over.
    Done(Result<LssAnswer, LssError>),
}

/// Why a job failed. Texts name what CiA 305 and the manual of the DST P92C say of a code (K-DST-11).
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum LssError {
    /// Another job is under way; this one was not taken.
    #[error("another LSS job is under way; try again when it is done")]
    Busy,
    /// The bus is down, or did not take a frame.
    #[error("the bus cannot be used")]
    BusUnavailable,
    /// All slaves would obey (R-DST-111).
    #[error(
        "all LSS slaves on the bus would take the same node id or bit rate: name one by its address, or confirm that \
         there is only one"
    )]
    NotConfirmed,
    /// The job says nothing that could be done.
    #[error("{0}")]
    Nonsense(&'static str),
    /// No slave answered.
    #[error("no LSS slave answered `{service}` within {} ms", after.as_millis())]
    NoAnswer {
        /// What was asked.
        service: &'static str,
        /// How long it was waited for, in total.
        after: Duration,
    },
    /// The slave refused.
    #[error("the LSS slave refused `{service}`: {}", reason(service, *code, *specific))]
    Refused {
        /// What was asked.
        service: &'static str,
        /// The error code, not 0.
        code: u8,
        /// The specific error; of the manufacturer, with code 255.
        specific: u8,
    },
    /// The caller could not do its part.
    #[error("{what} failed: {reason}")]
    Duty {
        /// What was to be done.
        what: &'static str,
        /// The caller's words.
        reason: String,
    },
    /// After the change the node did not boot, or another device answers at its new node id.
    #[error(
        "the change is stored, but {0}; switch the device off and on, then look for it with its new node id and bit rate"
    )]
    NotActive(&'static str),
    /// Answers contradict each other.
    #[error("LSS slaves answered in turn yes and no; is a second LSS master at work, or do frames get lost?")]
    Inconsistent,
    /// The caller gave up.
    #[error("cancelled")]
    Cancelled,
}

/// What an error code means.
fn reason(service: &str, code: u8, specific: u8) -> String {
    match (service, code) {
        ("configure node id", 1) => "the node id is out of range".to_owned(),
        ("configure bit rate", 1) => "it does not support the bit rate".to_owned(),
        ("store", 1) => "it cannot store (CiA 305), or the node id is out of range (DST P92C)".to_owned(),
        ("store", 2) => "it cannot reach its memory".to_owned(),
        ("store", 255) if specific == 1 => {
            "manufacturer's error 1 (DST P92C: there is nothing to store)".to_owned()
        }
        (_, 255) => format!("manufacturer's error {specific}"),
        _ => format!("error {code}"),
    }
}
