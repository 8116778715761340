//! The command block of the gateway's unit, pure: arguments, a check, a command, and what came of it, to be read.
//!
//! Each `[access.NAME]` has a block of its own. Clients of one table share it: while a command is under way, it is not written.

use super::event_ring::EventCodes;
use crate::gateway::command::{Action, NmtRequest, Outcome};
use crate::mapping::{AlarmOwner, TagTable};
use crate::process_image::{AlarmIndex, NodeIndex, ProcessImage};

/// Where it stands, in the holding registers of the gateway's unit.
pub const ADDRESS: u16 = 600;
/// Its registers; those without a meaning read 0.
pub const REGISTERS: u16 = 10;

/// Place of the unit id of the node; that of the gateway for alarms of the gateway and of buses.
pub const ARGUMENT: u16 = 0;
/// Place of the alarm's number as in the event ring, or of the NMT command.
pub const ARGUMENT_2: u16 = 1;
/// Place of the check.
pub const CHECK: u16 = 2;
/// Place of the command; writing it gives it.
pub const COMMAND: u16 = 3;
/// Place of the result.
pub const RESULT: u16 = 4;
/// Place of the result's counter.
pub const COUNTER: u16 = 5;

/// Its registers with a meaning: place, name, whether it can be written, and what it is.
pub const ROWS: [(u16, &str, bool, &str); 6] = [
    (
        ARGUMENT,
        "command.argument",
        true,
        "Unit id of the node; that of the gateway for its own alarms and those of buses",
    ),
    (ARGUMENT_2, "command.argument_2", true, "Number of the alarm as in the event ring, or the NMT command"),
    (
        CHECK,
        "command.check",
        true,
        "Low word of the sequence number with which the alarm was raised; 65535 minus the NMT command",
    ),
    (
        COMMAND,
        "command.command",
        true,
        "1 acknowledge, 2 reset, 3 NMT command, 4 acknowledge all; writing it gives the command",
    ),
    (
        RESULT,
        "command.result",
        false,
        "0 none yet, 1 done, 2 unknown, 3 rejected, 4 busy, 5 node unavailable, 6 timeout, 7 aborted, 8 failed, 9 not allowed, 10 wrong check, 65535 under way",
    ),
    (COUNTER, "command.counter", false, "Counts up with every result"),
];

const UNDER_WAY: u16 = 65_535;
const UNKNOWN: u16 = 2;
/// The result of a command that broke off, or whose connection ended first: it may have been done or not.
pub const FAILED: u16 = 8;
const WRONG_CHECK: u16 = 10;

/// The registers of one client.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Block {
    registers: [u16; 10],
}

/// The place of an address within the block, where so many from there on can be written.
#[must_use]
pub fn place(start: u16, count: usize) -> Option<u16> {
    let place = start.checked_sub(ADDRESS)?;
    (count > 0 && usize::from(place) + count <= usize::from(RESULT)).then_some(place)
}

impl Block {
    /// A register.
    #[must_use]
    pub fn get(&self, place: u16) -> u16 {
        self.registers.get(usize::from(place)).copied().unwrap_or_default()
    }

    /// Sets a register.
    pub fn set(&mut self, place: u16, word: u16) {
        if let Some(register) = self.registers.get_mut(usize::from(place)) {
            *register = word;
        }
    }

    /// A command has begun and has no result yet.
    #[must_use]
    pub fn is_under_way(&self) -> bool {
        self.get(RESULT) == UNDER_WAY
    }

    /// The command begins.
    pub fn begin(&mut self) {
        self.set(RESULT, UNDER_WAY);
    }

    /// The command is over.
    pub fn end(&mut self, result: u16) {
        self.set(RESULT, result);
        self.set(COUNTER, self.get(COUNTER).wrapping_add(1));
    }

    /// What the command asks for.
    ///
    /// # Errors
    /// The result, where it asks for nothing that there is.
    pub fn action(
        &self,
        table: &TagTable,
        image: &ProcessImage,
        codes: &EventCodes,
        gateway_unit: u8,
    ) -> Result<Action, u16> {
        let unit = u8::try_from(self.get(ARGUMENT)).map_err(|_| UNKNOWN)?;
        let is_gateway = unit == gateway_unit;
        match self.get(COMMAND) {
            1 | 2 => {
                let owned = |owner: AlarmOwner| match owner {
                    AlarmOwner::Gateway | AlarmOwner::Bus(_) => is_gateway,
                    AlarmOwner::Node(node) => table.node(node).is_some_and(|node| node.unit_id == unit),
                };
                let alarms = table.alarms.iter().enumerate();
                let named: Vec<AlarmIndex> = alarms
                    .filter(|(place, alarm)| {
                        owned(alarm.owner) && codes.code(*place) == Some(self.get(ARGUMENT_2))
                    })
                    .map(|(place, _)| AlarmIndex(place))
                    .collect();
                if named.is_empty() {
                    return Err(UNKNOWN);
                }
                let check = self.get(CHECK);
                let alarm = named
                    .into_iter()
                    .find(|alarm| raised_with(image, *alarm) == Some(check))
                    .ok_or(WRONG_CHECK)?;
                let raise = image.alarm(alarm).map(|status| status.count);
                Ok(if self.get(COMMAND) == 1 {
                    Action::Acknowledge { alarm, raise }
                } else {
                    Action::Reset { alarm }
                })
            }
            3 => {
                let request = nmt(self.get(ARGUMENT_2)).ok_or(UNKNOWN)?;
                if self.get(CHECK) != u16::MAX - self.get(ARGUMENT_2) {
                    return Err(WRONG_CHECK);
                }
                Ok(Action::Nmt { node: only_node(table, unit).ok_or(UNKNOWN)?, request })
            }
            4 if is_gateway => Ok(Action::AcknowledgeAll { node: None }),
            4 => Ok(Action::AcknowledgeAll { node: Some(only_node(table, unit).ok_or(UNKNOWN)?) }),
            _ => Err(UNKNOWN),
        }
    }
}

/// The low word of the sequence number with which an alarm was last raised, where the journal still has it.
fn raised_with(image: &ProcessImage, alarm: AlarmIndex) -> Option<u16> {
    let mut events = image.journal.newest_first();
    let event = events.find(|event| event.alarm == Some(alarm) && event.to == "unacknowledged")?;
    Some(super::encoding::low_16(event.seq))
}

/// The node of a unit id, where it has but one.
fn only_node(table: &TagTable, unit: u8) -> Option<NodeIndex> {
    let mut nodes = table.nodes.iter().enumerate().filter(|(_, node)| node.unit_id == unit);
    let (place, _) = nodes.next()?;
    nodes.next().is_none().then_some(NodeIndex(place))
}

/// By the numbers of CiA 301.
fn nmt(command: u16) -> Option<NmtRequest> {
    Some(match command {
        1 => NmtRequest::Start,
        2 => NmtRequest::Stop,
        128 => NmtRequest::EnterPreOperational,
        129 => NmtRequest::ResetNode,
        130 => NmtRequest::ResetCommunication,
        _ => return None,
    })
}

/// The number of an outcome.
#[must_use]
pub fn result(outcome: &Outcome) -> u16 {
    match outcome {
        Outcome::Done | Outcome::Read(_) => 1,
        Outcome::Unknown => UNKNOWN,
        Outcome::Rejected(_) => 3,
        Outcome::Busy => 4,
        Outcome::NodeUnavailable => 5,
        Outcome::Timeout => 6,
        Outcome::Aborted(_) => 7,
        Outcome::Failed(_) => FAILED,
        Outcome::Forbidden(_) => 9,
    }
}
