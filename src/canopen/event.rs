//! What a network tells the gateway.

use std::time::Duration;

use super::boot::BootEvent;
use super::object::ObjectId;
use super::sdo::{SdoError, TransferId};
use super::{NmtRequest, NmtState, NodeId, PdoIndex, RpdoIndex};
use crate::can::{CanFrame, CanId};

/// Output of [`Network`](super::Network).
#[derive(Clone, Debug, PartialEq)]
pub enum NetworkOutput {
    /// Send this frame. Only frames of the kinds that the settings allow are ever asked for.
    Transmit(CanFrame),
    /// Something happened to a configured node.
    Node(NodeId, NodeEvent),
    /// Something happened that belongs to no configured node.
    Foreign(ForeignEvent),
}

/// What happened to a node.
#[derive(Clone, Debug, PartialEq)]
pub enum NodeEvent {
    /// A TPDO with a usable length; `data` beyond `length` is padding.
    Pdo {
        /// Which.
        pdo: PdoIndex,
        /// The bytes of the frame.
        data: [u8; 8],
        /// How many of them were sent.
        length: u8,
    },
    /// A TPDO was too short (discarded) or too long (decoded unless strict), R-DET-080, R-DET-081.
    PdoLength {
        /// Which.
        pdo: PdoIndex,
        /// DLC received.
        received: u8,
        /// Whether it was thrown away.
        discarded: bool,
    },
    /// A supervised TPDO did not come in time (R-DET-082); told once until it comes again.
    PdoTimeout {
        /// Which.
        pdo: PdoIndex,
    },
    /// A TPDO came while the node was known not to be operational and no start command explains it (R-DET-083).
    PdoInUnexpectedState {
        /// Which.
        pdo: PdoIndex,
        /// The believed state.
        state: Option<NmtState>,
    },
    /// A synchronous TPDO came later after SYNC than the window allows; its own event precedes.
    PdoOutsideWindow {
        /// Which.
        pdo: PdoIndex,
        /// How long after SYNC.
        after: Duration,
    },
    /// The node takes part from now on, so that it is sent its RPDOs: it is operational, configured, and was heard.
    RpdosStarted,
    /// The node takes part no longer: it is sent no RPDO.
    RpdosStopped,
    /// An RPDO is sent to the node.
    RpdoSent {
        /// Which.
        rpdo: RpdoIndex,
        /// What; of it the first bytes, as many as it has.
        data: [u8; 8],
    },
    /// An RPDO did not leave. One that is not sent after SYNC is tried again.
    RpdoNotSent {
        /// Which.
        rpdo: RpdoIndex,
    },
    /// The first sign of life since the gateway started, or since `NeverSeen`.
    Seen,
    /// No frame at all since the gateway started (R-DET-001).
    NeverSeen,
    /// The believed state changed: by report, or because a TPDO came (R-DET-083). A TPDO's own event follows.
    State {
        /// Believed state before.
        from: Option<NmtState>,
        /// State now.
        to: NmtState,
        /// `false`: an unexpected change (R-DET-038). `true` for the first state ever, the effect of an NMT command of the
        /// gateway (in the passive role: of an overheard one), the end of initialisation, and a boot-up message, of which
        /// `Restarted` tells whether it was asked for.
        ordered: bool,
    },
    /// A boot-up message that no ordered reset explains, from a node that was running (R-DET-039): its data is stale.
    Restarted,
    /// A state code that CiA 301 does not define (R-DET-041); reported once per change. The known state stays.
    InvalidState {
        /// Bits 6..0 of the reply.
        raw: u8,
    },
    /// A guard request was not answered in time (R-DET-033).
    GuardMissed {
        /// Consecutive misses and toggle errors so far.
        consecutive: u16,
    },
    /// A reply had the wrong toggle bit (R-DET-035).
    ToggleError {
        /// Consecutive misses and toggle errors so far; unchanged when the policy accepts the reply.
        consecutive: u16,
    },
    /// The life time ran out (R-DET-036): no value can be trusted.
    Lost {
        /// Whether wrong toggle bits, not silence, were the cause: the device's CPU may be dead.
        stuck_toggle: bool,
    },
    /// A valid reply, heartbeat or boot-up ended the loss (R-DET-037).
    Recovered,
    /// A non-zero state frame nobody had asked for, or after the reply deadline (R-DET-045); reported once.
    UnsolicitedState,
    /// The node told its state by itself or when asked, for the first time since it was lost or the bus could not be used:
    /// it is supervised from now on. A boot-up message alone is no such sign.
    Supervised,
    /// Somebody else sends guard requests to this node (R-DET-043); told once.
    ForeignGuardMaster,
    /// No guard request of somebody else for 60 s after `ForeignGuardMaster`.
    ForeignGuardMasterGone,
    /// Somebody else accesses an object of this node by SDO. Of reads the first, and again after 60 s without; of writes all.
    ForeignSdo {
        /// Which.
        object: ObjectId,
        /// Whether it is changed.
        write: bool,
    },
    /// A frame on the error control identifier with a wrong length (R-DET-042), of which the first byte counts if there
    /// is one; or an emergency message that is too short, or a remote or 29-bit frame on one of the node's identifiers
    /// (R-DET-006), which are ignored.
    Malformed {
        /// The frame.
        frame: CanFrame,
    },
    /// The gateway sends an NMT command to this node.
    NmtSent {
        /// Which.
        request: NmtRequest,
    },
    /// Three start commands had no effect (R-DET-020); told once until the node is operational. Starting goes on.
    StartFailed {
        /// Start commands sent so far.
        attempts: u32,
    },
    /// The node boots again and again, probably because it is started: its next start waits.
    StartHeldBack {
        /// How long.
        wait: Duration,
    },
    /// What its boot found, did, or failed at.
    Boot(BootEvent),
    /// An object that is polled was read.
    Polled {
        /// Which, by its place in [`NodeSettings::polls`](super::NodeSettings::polls).
        poll: usize,
        /// Its bytes, little-endian, or why it could not be read.
        result: Result<Vec<u8>, SdoError>,
    },
    /// A transfer that was asked for is over: the bytes that were read (none after a write), or why it failed.
    Sdo {
        /// As it was asked for.
        id: TransferId,
        /// What came of it.
        result: Result<Vec<u8>, SdoError>,
    },
    /// The node is operational after a `StartFailed`.
    StartSucceeded,
    /// An emergency message (R-DET-091).
    Emergency {
        /// Error code; 0 = error reset or no error.
        code: u16,
        /// Error register.
        register: u8,
        /// Manufacturer bytes.
        vendor: [u8; 5],
    },
    /// It booted: the errors that its emergency messages told of before are over. Only where there was one.
    ErrorsForgotten,
    /// Two nodes seem to share this id; told once for each kind of evidence until `DuplicateCleared`.
    DuplicateSuspected {
        /// What was seen.
        evidence: &'static str,
    },
    /// The frames of this TPDO come with two lengths: those that have not the right one are discarded, and the others are
    /// the node's own. Until `DuplicateCleared`.
    DuplicateToldApart {
        /// Which.
        pdo: PdoIndex,
    },
    /// Nothing suspicious for 30 s after `DuplicateSuspected`.
    DuplicateCleared,
    /// A data frame of the node on one of its identifiers, for the frame counter; precedes what the frame caused.
    FrameSeen,
}

/// What happened beside the configured nodes.
#[derive(Clone, Debug, PartialEq)]
pub enum ForeignEvent {
    /// An NMT command that the gateway did not send: there is another master.
    NmtCommand {
        /// Its command byte.
        command: u8,
        /// Its node id byte, 0 = all.
        node: u8,
    },
    /// A SYNC that the gateway did not send.
    Sync {
        /// Whether the gateway sends SYNC on this bus too: then there are two producers, and every device answers both.
        produced: bool,
        /// Whether it is the first on this bus.
        first: bool,
    },
    /// A TIME message that the gateway did not send.
    Time {
        /// Whether the gateway sends TIME on this bus too.
        produced: bool,
        /// Whether it is the first on this bus.
        first: bool,
    },
    /// Somebody else uses LSS: told the first time, and again after 60 s without.
    Lss,
    /// A frame of an identifier that belongs to no configured node, or a malformed NMT command.
    UnknownId {
        /// The identifier.
        id: CanId,
        /// The node id, where the identifier belongs to the predefined connection set.
        node: Option<NodeId>,
        /// Whether it is the first frame of this identifier. Of 29-bit identifiers the first 256 are remembered; those
        /// beyond are never called first.
        first: bool,
    },
}
