//! LSS jobs with all that they need beside LSS: SDO, NMT, boot-up messages. Pure.
//!
//! An [`LssMaster`] asks its caller for what is not LSS; this is that caller for a tool, which knows of the bus only what it
//! overhears. A change therefore begins with listening, so that nodes that are stopped for it are brought back into the
//! state that they were in. A node whose state is not known is left pre-operational: from there it can be talked to and
//! sends no process data.

use std::collections::{BTreeMap, VecDeque};
use std::time::Duration;

use super::session::{Machine, Step};
use crate::can::CanFrame;
use crate::canopen::census::Census;
use crate::canopen::lss::{
    LssAddress, LssAnswer, LssChange, LssDuty, LssError, LssJob, LssMaster, LssOutput, LssSettings, LssState,
    LssTarget, Performed,
};
use crate::canopen::object::ObjectId;
use crate::canopen::sdo::{SdoClient, SdoError, SdoOutput, SdoRequest, SdoSettings, TransferId};
use crate::canopen::{NmtRequest, NmtState, NodeId, cob_id};
use crate::time::{Instant, Now};

/// How long to listen before a change. A heartbeat or a TPDO of most devices comes within it.
const LISTEN: Duration = Duration::from_secs(2);
/// Producer heartbeat time.
const HEARTBEAT: ObjectId = ObjectId::new(0x1017, 0);
/// Identity: sub-indices 1 to 4 are the LSS address.
const IDENTITY: u16 = 0x1018;

/// What became of all jobs: one answer each, or why one failed, after which the rest was left out.
type Outcome = Result<Vec<LssAnswer>, LssError>;

/// Jobs one after another, and all that they need.
#[derive(Debug)]
pub(super) struct LssTask {
    master: LssMaster,
    jobs: VecDeque<LssJob>,
    answers: Vec<LssAnswer>,
    /// Why a job failed.
    failed: Option<LssError>,
    /// A change whose address is to be read by SDO first.
    of_node: Option<(LssChange, NodeId)>,
    /// Node ids of the change, before and after.
    node: Option<NodeId>,
    new_node: Option<NodeId>,
    census: Census,
    listen_until: Option<Instant>,
    /// When each node booted last.
    boot_ups: BTreeMap<NodeId, Instant>,
    /// When the last LSS frame left.
    sent: Instant,
    sdo: Option<SdoClient>,
    duty: Duty,
    /// Nodes that an NMT request concerned, with the states from before; `None`: not known.
    before: BTreeMap<NodeId, Option<NmtState>>,
    outputs: VecDeque<Step<Outcome>>,
}

/// What is being done for the master.
#[derive(Debug, Default)]
enum Duty {
    #[default]
    Nothing,
    ReadHeartbeat,
    WriteHeartbeat,
    /// The parts read so far; with what they must be.
    Identity {
        read: Vec<u32>,
        expected: Option<LssAddress>,
    },
    BootUp {
        node: NodeId,
        until: Instant,
    },
}

impl LssTask {
    /// These jobs.
    pub(super) fn new(jobs: Vec<LssJob>) -> Self {
        let change =
            jobs.iter().find_map(|job| if let LssJob::Change(change) = job { Some(change) } else { None });
        let (node, new_node) = change.map_or((None, None), |change| (change.node, change.node_id));
        Self {
            master: LssMaster::new(LssSettings::default()),
            jobs: jobs.into(),
            answers: Vec::new(),
            failed: None,
            of_node: None,
            node,
            new_node,
            census: Census::default(),
            listen_until: None,
            boot_ups: BTreeMap::new(),
            sent: Instant::START,
            sdo: None,
            duty: Duty::Nothing,
            before: BTreeMap::new(),
            outputs: VecDeque::new(),
        }
    }

    /// A change of the device at this node id, whose address is read there first.
    pub(super) fn of_node(change: LssChange, node: NodeId) -> Self {
        let new_node = change.node_id;
        let mut task = Self::new(Vec::new());
        (task.node, task.new_node, task.of_node) = (Some(node), new_node, Some((change, node)));
        task
    }

    /// Begins.
    pub(super) fn begin(&mut self, now: Instant) {
        self.sent = now;
        let changes = self.of_node.is_some() || self.jobs.iter().any(|job| matches!(job, LssJob::Change(_)));
        if changes {
            self.listen_until = Some(now + LISTEN);
        } else {
            self.next_job(now);
        }
        self.drain(now);
    }

    fn next_job(&mut self, now: Instant) {
        if let Some((_, node)) = self.of_node {
            self.duty = Duty::Identity { read: Vec::new(), expected: None };
            self.read_identity(now, node, 1);
        } else if let Some(job) = self.jobs.pop_front() {
            if let Err(error) = self.master.request(now, job) {
                let error = self.failed.take().unwrap_or(error);
                self.end(Err(error));
            }
        } else {
            let answers = std::mem::take(&mut self.answers);
            let outcome = self.failed.take().map_or(Ok(answers), Err);
            self.end(outcome);
        }
    }

    /// Of the jobs that are left only the way out of configuration state is gone.
    fn fail(&mut self, now: Instant, error: LssError) {
        let leave = |job: &LssJob| matches!(job, LssJob::SwitchGlobal { state: LssState::Waiting, .. });
        self.jobs.retain(leave);
        self.failed.get_or_insert(error);
        self.next_job(now);
    }

    /// Gives up; a change goes back as far as it can before it ends.
    pub(super) fn cancel(&mut self, now: Instant) {
        (self.duty, self.sdo, self.listen_until, self.of_node) = (Duty::Nothing, None, None, None);
        if self.master.is_idle() {
            self.jobs.clear();
            self.end(Err(LssError::Cancelled));
        } else {
            self.master.cancel(now);
        }
        self.drain(now);
    }

    fn end(&mut self, outcome: Outcome) {
        self.outputs.push_back(Step::Done(outcome));
    }

    /// Goes on until there is something to wait for.
    fn drain(&mut self, now: Instant) {
        loop {
            if let Some(output) = self.master.poll_output() {
                self.handle_master(now, output);
            } else if let Some(output) = self.sdo.as_mut().and_then(SdoClient::poll_output) {
                match output {
                    SdoOutput::Transmit(frame) => self.outputs.push_back(Step::Transmit(frame)),
                    SdoOutput::Done(_, result) => self.handle_sdo(now, result),
                }
            } else {
                return;
            }
        }
    }

    fn handle_master(&mut self, now: Instant, output: LssOutput) {
        match output {
            LssOutput::Transmit(frame) => {
                self.sent = now;
                self.outputs.push_back(Step::Transmit(frame));
            }
            LssOutput::Perform(duty) => self.perform(now, &duty),
            // The answer has them all.
            LssOutput::Found(_) => {}
            LssOutput::Done(Ok(answer)) => {
                self.answers.push(answer);
                self.next_job(now);
            }
            LssOutput::Done(Err(error)) => self.fail(now, error),
        }
    }

    fn perform(&mut self, now: Instant, duty: &LssDuty) {
        match *duty {
            LssDuty::ReadHeartbeat(node) => {
                self.duty = Duty::ReadHeartbeat;
                self.ask(now, node, SdoRequest::read(HEARTBEAT).of_len(2));
            }
            LssDuty::WriteHeartbeat(node, millis) => {
                self.duty = Duty::WriteHeartbeat;
                let value = millis.to_le_bytes().to_vec();
                self.ask(now, node, SdoRequest::write(HEARTBEAT, value).repeatable());
            }
            LssDuty::Nmt(target, request) => {
                self.remember(target);
                self.nmt(target, request);
                self.master.handle_performed(now, Performed::Yes);
            }
            LssDuty::ChangeInterface(_) => {
                let reason = "a tool cannot change the bit rate of this host's interface".to_owned();
                self.master.handle_performed(now, Performed::Failed(reason));
            }
            LssDuty::AwaitBootUp(node, within) => {
                if self.boot_ups.get(&node).is_some_and(|booted| *booted >= self.sent) {
                    self.master.handle_performed(now, Performed::Yes);
                } else {
                    self.duty = Duty::BootUp { node, until: now + within };
                }
            }
            LssDuty::CheckIdentity(node, address) => {
                self.duty = Duty::Identity { read: Vec::new(), expected: Some(address) };
                self.read_identity(now, node, 1);
            }
            LssDuty::RestoreStates => {
                self.restore();
                self.master.handle_performed(now, Performed::Yes);
            }
        }
    }

    fn nmt(&mut self, target: Option<NodeId>, request: NmtRequest) {
        self.outputs.push_back(Step::Transmit(request.frame(target)));
    }

    /// Remembers the states of the nodes that an NMT request concerns; those from before the first request count.
    fn remember(&mut self, target: Option<NodeId>) {
        let seen = self
            .census
            .nodes
            .iter()
            .filter(|(id, node)| node.is_heard() && target.is_none_or(|target| target == **id));
        let states: Vec<_> = seen
            .map(|(id, node)| {
                let sends = node.tpdos.iter().any(|tpdo| tpdo.count > 0);
                (*id, if sends { Some(NmtState::Operational) } else { node.state })
            })
            .collect();
        for (id, state) in states.into_iter().chain(target.or(self.node).map(|node| (node, None))) {
            self.before.entry(id).or_insert(state);
        }
    }

    /// Brings the nodes back into their states. The changed node has booted as pre-operational, with its new id; it is started
    /// if it was the only one that could have been operational at its old one.
    fn restore(&mut self) {
        let moved =
            self.new_node.filter(|new| self.boot_ups.get(new).is_some_and(|booted| *booted >= self.sent));
        let shared = self
            .node
            .and_then(|node| self.census.nodes.get(&node))
            .is_some_and(|node| !node.suspicions.is_empty());
        let before = std::mem::take(&mut self.before);
        for (node, state) in before {
            let request = match state {
                Some(NmtState::Operational) => NmtRequest::Start,
                Some(NmtState::Stopped) => continue,
                Some(NmtState::PreOperational | NmtState::Initialising) | None => {
                    NmtRequest::EnterPreOperational
                }
            };
            self.nmt(Some(node), request);
            if let Some(new) = moved
                && Some(node) == self.node
                && request == NmtRequest::Start
                && !shared
            {
                self.nmt(Some(new), request);
            }
        }
    }

    fn ask(&mut self, now: Instant, node: NodeId, request: SdoRequest) {
        let mut client = SdoClient::new(node, SdoSettings::default());
        // A new client takes every request of this size.
        let _ = client.request(now, TransferId(0), request);
        self.sdo = Some(client);
    }

    fn read_identity(&mut self, now: Instant, node: NodeId, sub: u8) {
        self.ask(now, node, SdoRequest::read(ObjectId::new(IDENTITY, sub)).of_len(4));
    }
}

impl LssTask {
    fn handle_sdo(&mut self, now: Instant, result: Result<Vec<u8>, SdoError>) {
        self.sdo = None;
        let missing = matches!(&result, Err(SdoError::Abort(code)) if code.is_missing());
        match std::mem::take(&mut self.duty) {
            Duty::ReadHeartbeat => self.master.handle_performed(
                now,
                match result {
                    Ok(bytes) => Performed::Value(number(&bytes)),
                    Err(_) if missing => Performed::Value(0),
                    Err(error) => Performed::Failed(error.to_string()),
                },
            ),
            Duty::WriteHeartbeat => self.master.handle_performed(
                now,
                match result {
                    Ok(_) => Performed::Yes,
                    Err(error) => Performed::Failed(error.to_string()),
                },
            ),
            Duty::Identity { read, expected } => self.handle_identity(now, read, expected, result),
            Duty::BootUp { node, until } => self.duty = Duty::BootUp { node, until },
            Duty::Nothing => {}
        }
    }

    /// One part of an identity was read.
    fn handle_identity(
        &mut self,
        now: Instant,
        mut read: Vec<u32>,
        expected: Option<LssAddress>,
        result: Result<Vec<u8>, SdoError>,
    ) {
        match (result, expected) {
            (Ok(bytes), _) => read.push(number(&bytes)),
            (Err(error), Some(_)) => {
                self.master.handle_performed(now, Performed::Failed(error.to_string()));
                return;
            }
            (Err(error), None) => {
                let reason =
                    format!("{error}; give the address by --vendor, --product, --revision and --serial");
                self.end(Err(LssError::Duty { what: "reading the identity 0x1018", reason }));
                return;
            }
        }
        if let [vendor, product, revision, serial] = *read.as_slice() {
            let address = LssAddress { vendor, product, revision, serial };
            match (expected, self.of_node.take()) {
                (Some(expected), _) => {
                    let performed = if address == expected { Performed::Yes } else { Performed::No };
                    self.master.handle_performed(now, performed);
                }
                (None, Some((change, _))) => {
                    let target = LssTarget::Address(address);
                    self.jobs.push_back(LssJob::Change(LssChange { target, ..change }));
                    self.next_job(now);
                }
                (None, None) => {}
            }
            return;
        }
        let node = match expected {
            Some(_) => self.new_node.or(self.node),
            None => self.node,
        };
        let sub = u8::try_from(read.len() + 1).unwrap_or(u8::MAX);
        self.duty = Duty::Identity { read, expected };
        if let Some(node) = node {
            self.read_identity(now, node, sub);
        }
    }

    fn handle_boot_up(&mut self, now: Instant, frame: &CanFrame) {
        let boot_up = !frame.is_remote() && frame.data() == [0];
        let node = u8::try_from(frame.id().raw() & 0x7F).ok().and_then(NodeId::new);
        let Some(node) = node.filter(|node| boot_up && frame.id() == cob_id::error_control(*node)) else {
            return;
        };
        self.boot_ups.insert(node, now);
        if matches!(self.duty, Duty::BootUp { node: awaited, .. } if awaited == node) {
            self.duty = Duty::Nothing;
            self.master.handle_performed(now, Performed::Yes);
        }
    }
}

/// A number of up to four bytes.
fn number(bytes: &[u8]) -> u32 {
    bytes.iter().take(4).rev().fold(0, |value, byte| value << 8 | u32::from(*byte))
}

impl Machine for LssTask {
    type Output = Outcome;

    fn handle_frame(&mut self, now: Now, frame: &CanFrame) {
        let now = now.instant;
        // What nodes do after they were told to stop says nothing of how they were.
        if self.listen_until.is_some() {
            self.census.handle_frame(now, frame);
        }
        self.handle_boot_up(now, frame);
        self.master.handle_frame(now, frame);
        if let Some(sdo) = &mut self.sdo {
            sdo.handle_answer(now, frame);
        }
        self.drain(now);
    }

    fn handle_not_sent(&mut self, now: Now, frame: &CanFrame) {
        self.master.handle_not_sent(now.instant, frame);
        if let Some(sdo) = &mut self.sdo {
            sdo.handle_not_sent(frame);
        }
        self.drain(now.instant);
    }

    fn handle_timeout(&mut self, now: Now) {
        let now = now.instant;
        if self.listen_until.is_some_and(|until| until <= now) {
            self.listen_until = None;
            self.next_job(now);
        }
        if matches!(self.duty, Duty::BootUp { until, .. } if until <= now) {
            self.duty = Duty::Nothing;
            self.master.handle_performed(now, Performed::No);
        }
        self.master.handle_timeout(now);
        if let Some(sdo) = &mut self.sdo {
            sdo.handle_timeout(now);
        }
        self.drain(now);
    }

    fn poll_output(&mut self) -> Option<Step<Outcome>> {
        self.outputs.pop_front()
    }

    fn poll_timeout(&self) -> Option<Instant> {
        let boot_up = if let Duty::BootUp { until, .. } = &self.duty { Some(*until) } else { None };
        let master = self.master.poll_timeout().map(|(at, _)| at);
        let sdo = self.sdo.as_ref().and_then(SdoClient::poll_timeout).map(|(at, _)| at);
        [self.listen_until, boot_up, master, sdo].into_iter().flatten().min()
    }
}
