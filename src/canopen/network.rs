//! All nodes of one bus.

mod exchange;

use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;

use super::broadcasts::Broadcasts;
use super::lss;
use super::node::{Moved, Node, SdoRefused, predefined_tpdo};
use super::outputs::Outputs;
use super::sdo::{SdoRequest, TransferId, request_id};
use super::{
    ErrorControl, ForeignEvent, NetworkOutput, NetworkSettings, NmtRequest, NodeEvent, NodeId, PdoIndex,
    Role, RpdoIndex, cob_id,
};
use crate::can::{CanFrame, CanId};
use crate::time::{Instant, Now};

/// Identifiers of 11 bits.
const STANDARD_IDS: usize = 0x800;
/// First guard requests of neighbours stand at most this far apart, so that the last node need not wait long.
const STAGGER: Duration = Duration::from_millis(10);
/// Foreign 29-bit identifiers that are remembered; those beyond are never called new.
const REMEMBERED: usize = 256;

/// Others who do the same again within this time need not be told of again.
pub(super) const FOREIGN_QUIET: Duration = Duration::from_secs(60);

/// One bus as its NMT master, or a passive listener, sees it.
#[derive(Debug)]
pub struct Network {
    role: Role,
    start_broadcast: bool,
    nodes: Vec<Node>,
    /// Whose an 11-bit identifier is.
    standard: Vec<Slot>,
    /// The same for 29 bits, where a TPDO has such an identifier.
    extended: BTreeMap<u32, Slot>,
    strangers: Strangers,
    broadcasts: Broadcasts,
    /// When somebody else used LSS the last time.
    foreign_lss: Option<Instant>,
    outputs: Outputs,
    link_up: bool,
    /// The wall clock of the host is right.
    clock_synchronised: bool,
    /// Not later than the earliest deadline of all nodes.
    next: Option<(Instant, &'static str)>,
}

/// What an identifier is for; `node` by its place in [`Network::nodes`].
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
enum Slot {
    #[default]
    Unknown,
    Sync,
    Time,
    ErrorControl(usize),
    Emergency(usize),
    SdoAnswer(usize),
    SdoRequest(usize),
    Pdo(usize, PdoIndex),
}

impl Slot {
    fn node(self) -> Option<usize> {
        match self {
            Self::Unknown | Self::Sync | Self::Time => None,
            Self::ErrorControl(node)
            | Self::Emergency(node)
            | Self::SdoAnswer(node)
            | Self::SdoRequest(node)
            | Self::Pdo(node, _) => Some(node),
        }
    }

    /// The same of the node at this place; `None` for what is of no node.
    fn at(self, node: usize) -> Option<Self> {
        Some(match self {
            Self::Unknown | Self::Sync | Self::Time => return None,
            Self::ErrorControl(_) => Self::ErrorControl(node),
            Self::Emergency(_) => Self::Emergency(node),
            Self::SdoAnswer(_) => Self::SdoAnswer(node),
            Self::SdoRequest(_) => Self::SdoRequest(node),
            Self::Pdo(_, pdo) => Self::Pdo(node, pdo),
        })
    }
}

/// Identifiers of nobody's that were seen.
#[derive(Debug)]
struct Strangers {
    standard: Vec<bool>,
    extended: BTreeSet<u32>,
}

impl Strangers {
    /// Whether this is the first frame of this identifier.
    fn is_first(&mut self, id: CanId) -> bool {
        match id {
            CanId::Standard(number) => {
                self.standard.get_mut(usize::from(number)).is_some_and(|seen| !std::mem::replace(seen, true))
            }
            CanId::Extended(number) => self.extended.len() < REMEMBERED && self.extended.insert(number),
        }
    }
}

impl Network {
    /// A network of which nothing is known yet, on a bus that cannot be used before [`handle_link`](Self::handle_link)
    /// says so. Then every node is guarded at once, without waiting for a boot-up (R-DET-046), one a few milliseconds
    /// after the other.
    ///
    /// Node ids and COB-IDs are to be unique (R-DET-004, checked by the mapping): of two equal ones the first counts.
    #[must_use]
    pub fn new(settings: NetworkSettings, now: Now) -> Self {
        let step = stagger(&settings);
        let mut network = Self {
            role: settings.role,
            start_broadcast: settings.start_broadcast,
            nodes: Vec::with_capacity(settings.nodes.len()),
            standard: vec![Slot::Unknown; STANDARD_IDS],
            extended: BTreeMap::new(),
            strangers: Strangers { standard: vec![false; STANDARD_IDS], extended: BTreeSet::new() },
            broadcasts: Broadcasts::new(settings.role, settings.sync, settings.time, settings.own_heartbeat),
            foreign_lss: None,
            outputs: Outputs::new(),
            link_up: false,
            clock_synchronised: false,
            next: None,
        };
        let mut pdos = Vec::new();
        for node in settings.nodes {
            let place = network.nodes.len();
            let error_control = cob_id::error_control(node.id);
            if network.slot(error_control) != Slot::Unknown {
                continue;
            }
            network.claim(error_control, Slot::ErrorControl(place));
            let emergency = node.emergency.unwrap_or_else(|| cob_id::emcy(node.id));
            network.claim(emergency, Slot::Emergency(place));
            if node.sdo.is_some() {
                network.claim(cob_id::sdo_answer(node.id), Slot::SdoAnswer(place));
            }
            network.claim(request_id(node.id), Slot::SdoRequest(place));
            let cob_ids = node.pdos.iter().map(|pdo| pdo.cob_id).enumerate();
            pdos.extend(cob_ids.map(|(index, id)| (id, Slot::Pdo(place, PdoIndex(index)))));
            let phase = step.saturating_mul(u32::try_from(place).unwrap_or(0));
            let mut node = Node::new(node, settings.role, phase, now.instant);
            node.pause();
            network.nodes.push(node);
        }
        let [sync, time] = network.broadcasts.ids();
        network.claim(sync, Slot::Sync);
        network.claim(time, Slot::Time);
        for (id, slot) in pdos {
            network.claim(id, slot);
        }
        network.look_ahead();
        network
    }

    /// Takes a frame that another node sent; `now` is its receive time.
    pub fn handle_frame(&mut self, now: Now, frame: &CanFrame) {
        let at = now.instant;
        let slot = self.slot(frame.id());
        let outputs = &mut self.outputs;
        let mut node = slot.node().and_then(|place| self.nodes.get_mut(place));
        let start = match (slot, &mut node) {
            (Slot::ErrorControl(_), Some(node)) => node.handle_error_control(at, frame, outputs),
            (Slot::Emergency(_), Some(node)) => node.handle_emergency(at, frame, outputs),
            (Slot::Pdo(_, pdo), Some(node)) => {
                let counts = node.handle_pdo(at, pdo, frame, outputs) && node.is_synchronous(pdo);
                if let Some(after) = self.broadcasts.outside_window(at).filter(|_| counts) {
                    outputs.node(node.id, NodeEvent::PdoOutsideWindow { pdo, after });
                }
                false
            }
            (Slot::SdoAnswer(_), Some(node)) => {
                node.handle_sdo_answer(at, frame, outputs);
                false
            }
            (Slot::SdoRequest(_), Some(node)) => {
                node.handle_foreign_sdo(at, frame, outputs);
                self.next = earlier(self.next, node.poll_timeout());
                return;
            }
            (Slot::Unknown | Slot::Sync | Slot::Time, _) | (_, None) => {
                self.handle_stranger(at, slot, frame);
                return;
            }
        };
        if !self.link_up
            && let Some(node) = &mut node
        {
            // It was on its way when the bus went down: it counts, but sets no clock going.
            node.pause();
            node.transfer(at, outputs);
        }
        if let Some(node) = &mut node {
            node.drive_rpdos(at, outputs);
        }
        let moved = node.as_mut().map(|node| node.take_moved()).unwrap_or_default();
        self.next = earlier(self.next, node.and_then(|node| node.poll_timeout()));
        if let Some(place) = slot.node() {
            self.move_ids(place, &moved);
        }
        if let Some(place) = slot.node().filter(|_| start && self.link_up) {
            self.start(at, place);
        }
    }

    /// A frame of ours did not leave: what waits for its answer must not blame the node.
    pub fn handle_not_sent(&mut self, now: Now, frame: &CanFrame) {
        if let Slot::ErrorControl(place) = self.slot(frame.id())
            && frame.is_remote()
            && let Some(node) = self.nodes.get_mut(place)
        {
            node.guard_request_not_sent();
        } else if let Some((command, node)) = nmt_command(frame)
            && let Some(request) = NmtRequest::from_code(command)
        {
            for node in self.nodes.iter_mut().filter(|each| node == 0 || each.id.get() == node) {
                node.command_not_sent(now.instant, request, &mut self.outputs);
                node.drive_rpdos(now.instant, &mut self.outputs);
            }
        } else {
            let outputs = &mut self.outputs;
            for node in &mut self.nodes {
                node.sdo_not_sent(frame);
                node.rpdo_not_sent(now.instant, frame, outputs);
            }
        }
        self.look_ahead();
    }

    /// The bus can be used, or cannot: while it cannot, nothing is sent and no node is blamed for silence. When it can
    /// again, all nodes are asked as at the start; a node that was lost stays so until it answers.
    pub fn handle_link(&mut self, now: Now, up: bool) {
        if std::mem::replace(&mut self.link_up, up) == up {
            return;
        }
        for node in &mut self.nodes {
            if up {
                node.resume(now.instant);
            } else {
                node.pause();
            }
            // Who waits for an object learns at once that the bus went down; what begins anew is told of.
            node.transfer(now.instant, &mut self.outputs);
            node.drive_rpdos(now.instant, &mut self.outputs);
        }
        if up {
            self.broadcasts.resume(now.instant, self.clock_synchronised);
        } else {
            self.broadcasts.pause();
        }
        self.look_ahead();
    }

    /// Whether the wall clock of the host is right, so that TIME may be sent. At the start it is not.
    pub fn handle_clock(&mut self, now: Now, synchronised: bool) {
        self.clock_synchronised = synchronised;
        if self.link_up {
            self.broadcasts.set_clock(now.instant, synchronised);
            self.look_ahead();
        }
    }

    /// What an RPDO of a node carries from now on; `None` where one of its values is not known, so that it is not sent.
    pub fn set_rpdo(&mut self, now: Now, node: NodeId, rpdo: RpdoIndex, data: Option<[u8; 8]>) {
        if let Some(node) = self.nodes.iter_mut().find(|each| each.id == node) {
            node.set_rpdo(now.instant, rpdo, data, &mut self.outputs);
            self.next = earlier(self.next, node.poll_timeout());
        }
    }

    /// An NMT command that an operator asked for, for one node or all.
    ///
    /// A node that is stopped or put into pre-operational in this way is not started automatically until an operator
    /// starts it. `false`: the role forbids it, there is no such node, or the bus cannot be used; nothing is sent.
    pub fn request_nmt(&mut self, now: Now, node: Option<NodeId>, request: NmtRequest) -> bool {
        let known = node.is_none_or(|id| self.nodes.iter().any(|each| each.id == id));
        if self.role == Role::Passive || !self.link_up || !known {
            return false;
        }
        self.outputs.transmit(request.frame(node));
        for each in self.nodes.iter_mut().filter(|each| node.is_none_or(|id| each.id == id)) {
            each.command_sent(now.instant, request, true, &mut self.outputs);
            each.drive_rpdos(now.instant, &mut self.outputs);
        }
        self.look_ahead();
        true
    }

    /// Reads or writes an object of a node. If it is taken, [`NodeEvent::Sdo`] with this id will
    /// follow, in bounded time. The three highest bits of ids, 61 to 63, belong to what the network asks by itself.
    pub fn request_sdo(
        &mut self,
        now: Now,
        node: NodeId,
        id: TransferId,
        request: SdoRequest,
    ) -> Result<(), SdoRefused> {
        let place = self.nodes.iter().position(|each| each.id == node).ok_or(SdoRefused::NoSdo)?;
        let node = self.nodes.get_mut(place).ok_or(SdoRefused::NoSdo)?;
        node.request_sdo(now.instant, id, request, &mut self.outputs)?;
        self.next = earlier(self.next, node.poll_timeout());
        Ok(())
    }

    /// What became due.
    pub fn handle_timeout(&mut self, now: Now) {
        let at = now.instant;
        if let Some(frame) = self.broadcasts.take_sync(at) {
            self.outputs.transmit(frame);
            self.sync(at);
        }
        if let Some(frame) = self.broadcasts.take_time(now) {
            self.outputs.transmit(frame);
        }
        if let Some(frame) = self.broadcasts.take_heartbeat(at) {
            self.outputs.transmit(frame);
        }
        for place in 0..self.nodes.len() {
            let Some(node) = self.nodes.get_mut(place) else { continue };
            let due = node.poll_timeout().is_some_and(|(deadline, _)| deadline <= at);
            if !due {
                continue;
            }
            let start = node.handle_timeout(at, &mut self.outputs);
            node.drive_rpdos(at, &mut self.outputs);
            let moved = node.take_moved();
            self.move_ids(place, &moved);
            if start {
                self.start(at, place);
            }
        }
        self.look_ahead();
    }

    /// What is to be done; call until `None` after each of the calls above.
    pub fn poll_output(&mut self) -> Option<NetworkOutput> {
        self.outputs.pop()
    }

    /// When `handle_timeout` is to be called at the latest, and why. May be earlier than anything is due.
    #[must_use]
    pub fn poll_timeout(&self) -> Option<(Instant, &'static str)> {
        self.next
    }

    /// Starts a node; or all with one frame where the settings ask for it and nobody would be started who must not be
    /// (R-DET-018).
    fn start(&mut self, now: Instant, place: usize) {
        if self.start_broadcast && self.nodes.iter().all(Node::may_be_started_with_all) {
            self.outputs.transmit(NmtRequest::Start.frame(None));
            for (other, node) in self.nodes.iter_mut().enumerate() {
                if other == place {
                    node.command_sent(now, NmtRequest::Start, false, &mut self.outputs);
                } else {
                    node.started_with_all(now, &mut self.outputs);
                }
            }
            self.look_ahead();
        } else if let Some(node) = self.nodes.get_mut(place) {
            self.outputs.transmit(NmtRequest::Start.frame(Some(node.id)));
            node.command_sent(now, NmtRequest::Start, false, &mut self.outputs);
            self.next = earlier(self.next, node.poll_timeout());
        }
    }

    /// A SYNC went over the bus: what is to follow it is sent now.
    fn sync(&mut self, now: Instant) {
        for node in &mut self.nodes {
            node.handle_sync(now, &mut self.outputs);
        }
    }

    /// TPDOs of a node, or its emergency messages, have other identifiers than before (R-DST-119). One that is somebody
    /// else's stays so.
    fn move_ids(&mut self, place: usize, moved: &[(Moved, Option<CanId>)]) {
        for (what, id) in moved {
            let slot = match what {
                Moved::Pdo(pdo) => Slot::Pdo(place, *pdo),
                Moved::Emergency => Slot::Emergency(place),
            };
            if id.is_some_and(|id| self.slot(id) == slot) {
                continue;
            }
            self.standard.iter_mut().filter(|each| **each == slot).for_each(|each| *each = Slot::Unknown);
            self.extended.retain(|_, each| *each != slot);
            if let Some(id) = id {
                self.claim(*id, slot);
            }
        }
    }

    /// A frame that belongs to no configured node.
    fn handle_stranger(&mut self, now: Instant, slot: Slot, frame: &CanFrame) {
        let id = frame.id();
        if let Slot::Sync | Slot::Time = slot
            && !frame.is_remote()
        {
            let first = self.strangers.is_first(id);
            if slot == Slot::Time {
                let produced = self.broadcasts.produces_time();
                return self.outputs.foreign(ForeignEvent::Time { produced, first });
            }
            let produced = self.broadcasts.produces_sync();
            self.outputs.foreign(ForeignEvent::Sync { produced, first });
            if !produced && self.link_up {
                self.broadcasts.heard_sync(now);
                self.sync(now);
            }
        } else if let Some((command, node)) = nmt_command(frame) {
            self.outputs.foreign(ForeignEvent::NmtCommand { command, node });
            let Some(request) = NmtRequest::from_code(command) else { return };
            for each in self.nodes.iter_mut().filter(|each| node == 0 || each.id.get() == node) {
                each.handle_foreign_command(now, request, &mut self.outputs);
                each.drive_rpdos(now, &mut self.outputs);
            }
            self.look_ahead();
        } else if id == lss::REQUEST_ID && !frame.is_remote() {
            // A search for devices takes thousands of them.
            let last = self.foreign_lss.replace(now);
            if last.is_none_or(|last| now.since(last) > FOREIGN_QUIET) {
                self.outputs.foreign(ForeignEvent::Lss);
            }
        } else if let Some(node) = self.imitated(id).and_then(|place| self.nodes.get_mut(place)) {
            node.handle_foreign_format(frame, &mut self.outputs);
        } else {
            let tpdo = predefined_tpdo(id).filter(|_| self.link_up);
            let node = tpdo.and_then(|(owner, _)| self.nodes.iter_mut().find(|node| node.id == owner));
            if let (Some((_, number)), Some(node)) = (tpdo, node) {
                node.handle_strange_tpdo(now, number, frame, &mut self.outputs);
                self.next = earlier(self.next, node.poll_timeout());
            }
            let first = self.strangers.is_first(id);
            self.outputs.foreign(ForeignEvent::UnknownId { id, node: predefined_node(id), first });
        }
    }

    /// The node that has the same identifier in 11 bits as this one in 29.
    fn imitated(&self, id: CanId) -> Option<usize> {
        match id {
            CanId::Extended(number) => {
                let short = u16::try_from(number).ok().and_then(CanId::standard)?;
                self.slot(short).node()
            }
            CanId::Standard(_) => None,
        }
    }

    fn slot(&self, id: CanId) -> Slot {
        match id {
            CanId::Standard(number) => self.standard.get(usize::from(number)).copied().unwrap_or_default(),
            CanId::Extended(number) => self.extended.get(&number).copied().unwrap_or_default(),
        }
    }

    /// Gives an identifier to whoever claims it first; that of NMT commands to nobody.
    fn claim(&mut self, id: CanId, slot: Slot) {
        let place = match id {
            cob_id::NMT => return,
            CanId::Standard(number) => self.standard.get_mut(usize::from(number)),
            CanId::Extended(number) => Some(self.extended.entry(number).or_default()),
        };
        if let Some(place) = place.filter(|place| **place == Slot::Unknown) {
            *place = slot;
        }
    }

    /// All identifiers that are somebody's.
    fn claimed(&self) -> impl Iterator<Item = (CanId, Slot)> {
        let standard = (0..).map(CanId::Standard).zip(self.standard.iter().copied());
        let extended = self.extended.iter().map(|(id, slot)| (CanId::Extended(*id), *slot));
        standard.chain(extended).filter(|(_, slot)| *slot != Slot::Unknown)
    }

    fn look_ahead(&mut self) {
        let nodes = self.nodes.iter().filter_map(Node::poll_timeout);
        self.next = nodes.chain(self.broadcasts.poll_timeout()).min_by_key(|(at, _)| *at);
    }
}

/// Distance between the first guard requests of two neighbours: all fit into the shortest guard time.
fn stagger(settings: &NetworkSettings) -> Duration {
    let guard_times = settings.nodes.iter().filter_map(|node| match &node.error_control {
        ErrorControl::Guarding(guarding) => Some(guarding.guard_time),
        ErrorControl::Heartbeat { .. } | ErrorControl::None => None,
    });
    let shortest = guard_times.min().unwrap_or(STAGGER);
    let nodes = u32::try_from(settings.nodes.len()).unwrap_or(u32::MAX).max(1);
    STAGGER.min(shortest / nodes)
}

/// Command byte and node id byte of an NMT command.
fn nmt_command(frame: &CanFrame) -> Option<(u8, u8)> {
    match *frame.data() {
        [command, node] if frame.id() == cob_id::NMT => Some((command, node)),
        _ => None,
    }
}

/// The node of an identifier of the predefined connection set (CiA 301).
fn predefined_node(id: CanId) -> Option<NodeId> {
    let CanId::Standard(number) = id else { return None };
    let function = number >> 7;
    let node = u8::try_from(number & 0x7F).ok().and_then(NodeId::new)?;
    (function == 1 || (3..=12).contains(&function) || function == 14).then_some(node)
}

fn earlier(
    a: Option<(Instant, &'static str)>,
    b: Option<(Instant, &'static str)>,
) -> Option<(Instant, &'static str)> {
    match (a, b) {
        (Some(a), Some(b)) => Some(if b.0 < a.0 { b } else { a }),
        (a, b) => a.or(b),
    }
}
