//! Clients that may ask for more than registers: their writes, handed to the gateway. \[IO\]

use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::sync::{Arc, Mutex, PoisonError};

use super::caller::Caller;
use super::command_block::{self, Block, COMMAND};
use super::connection::Shared;
use super::general_reference;
use super::pdu::{self, ExceptionCode, Request};
use super::security::PeerRole;
use super::writing::{self, Plan, Write};
use crate::gateway::command::{Authority, CommandSource, Desk, Grant};

/// Where writes are handed in, and the command blocks.
#[derive(Clone, Debug)]
pub struct Writers {
    desk: Desk,
    /// By the name of the access table, of which there are few.
    blocks: Arc<Mutex<BTreeMap<Arc<str>, Block>>>,
}

/// Who asks, and for which unit.
#[derive(Clone, Debug)]
pub struct Asking {
    peer: SocketAddr,
    grant: Arc<Grant>,
    /// The unit id of the request.
    pub unit: u8,
    /// The request.
    pub pdu: Vec<u8>,
}

impl Asking {
    fn source(&self) -> CommandSource {
        let mut source = CommandSource::modbus(self.peer.to_string());
        source.access = Some(Arc::clone(self.grant.name()));
        source
    }
}

/// A command of a block, which has its result when this is dropped: the connection may end before the gateway answers.
struct UnderWay<'a> {
    writers: &'a Writers,
    asking: &'a Asking,
    result: u16,
}

impl Drop for UnderWay<'_> {
    fn drop(&mut self) {
        self.writers.with_block(self.asking, |block| block.end(self.result));
    }
}

impl Writers {
    /// Writers of this desk.
    #[must_use]
    pub fn new(desk: Desk) -> Self {
        Self { desk, blocks: Arc::default() }
    }

    /// The same writers, with their command blocks, at another desk.
    #[must_use]
    pub fn at(&self, desk: Desk) -> Self {
        Self { desk, blocks: Arc::clone(&self.blocks) }
    }

    /// Whether a request is one that its client may make, and registers alone cannot answer. A write of somebody who is not
    /// known is counted, and answered like every write is without this.
    #[must_use]
    pub fn take(
        &self,
        shared: &Shared,
        (peer, caller): (SocketAddr, &Caller),
        unit: u8,
        pdu: &[u8],
    ) -> Option<Asking> {
        let writes = is_write(pdu);
        let reads_block = || {
            matches!(pdu.first(), Some(3 | 4))
                && shared.bank.map().is_gateway(unit)
                && matches!(pdu::decode(pdu), Ok(Request::ReadRegisters { start, quantity }) if in_block(start, quantity))
        };
        if !writes && !reads_block() {
            return None;
        }
        let access = self.desk.access();
        let grant = match &caller.role {
            // A certificate says who it is, and an address nothing beside it.
            Some(PeerRole(role)) => role.as_deref().and_then(|role| access.of_role(role)),
            None => access.of_address(peer.ip()),
        };
        if let Some(grant) = grant {
            return Some(Asking { peer, grant: Arc::clone(grant), unit, pdu: pdu.to_vec() });
        }
        if writes {
            self.refuse((peer.to_string(), caller), unit, pdu, "no [access] table knows this client");
        }
        None
    }

    /// Tells of a request that its client has no right to. `client` is its address, or its line.
    pub fn refuse(&self, (client, caller): (String, &Caller), unit: u8, pdu: &[u8], why: &str) {
        let mut source = CommandSource::modbus(client);
        let access = self.desk.access();
        let grant = caller.role.as_ref().and_then(|role| access.of_role(role.0.as_deref()?));
        source.access = grant.map(|grant| Arc::clone(grant.name()));
        let function = pdu.first().copied().unwrap_or_default();
        self.desk.refuse(source, verb(pdu), format!("function {function} at unit {unit}: {why}"));
    }

    /// Does what is asked for; gives the PDU of the answer.
    ///
    /// # Errors
    /// The exception.
    pub async fn answer(&self, shared: &Shared, asking: &Asking) -> Result<Vec<u8>, ExceptionCode> {
        if shared.bank.map().unit(asking.unit).is_none() {
            return Err(self.told(asking, ExceptionCode::GatewayTargetDevice));
        }
        let request = pdu::decode(&asking.pdu).map_err(|code| self.told(asking, code))?;
        if let Request::ReadRegisters { start, quantity } = request {
            let mut answer = asking.pdu.get(..1).unwrap_or_default().to_vec();
            self.read(shared, asking, (start, quantity), &mut answer)?;
            return Ok(answer);
        }
        let write = writing::decode(&asking.pdu).ok_or(ExceptionCode::IllegalFunction)?;
        let now = shared.clock.now();
        let plan = shared.reader.read(|image| write.plan(&shared.bank, image, now, asking.unit));
        let plan = plan.map_err(|code| self.told(asking, code))?;
        if let Some(read) = write.read {
            // What cannot be read afterwards is not written before.
            self.read(shared, asking, read, &mut Vec::new()).map_err(|code| self.told(asking, code))?;
        }
        self.carry_out(shared, asking, plan).await?;
        self.finish(shared, asking, &write)
    }

    async fn carry_out(&self, shared: &Shared, asking: &Asking, plan: Plan) -> Result<(), ExceptionCode> {
        let authority = Authority::Grant(Arc::clone(&asking.grant));
        let (place, words) = match plan {
            Plan::Ask(action) => {
                let outcome = self.desk.ask(asking.source(), &authority, action).await;
                return writing::exception(&outcome).map_or(Ok(()), Err);
            }
            Plan::Block(place, words) => (place, words),
        };
        let gives_command = usize::from(place) + words.len() > usize::from(COMMAND);
        let block = self.with_block(asking, |block| {
            if block.is_under_way() {
                return Err(ExceptionCode::ServerDeviceBusy);
            }
            writing::fill(block, place, &words);
            if gives_command {
                block.begin();
            }
            Ok(*block)
        })?;
        if !gives_command {
            return Ok(());
        }
        let map = shared.bank.map();
        let action = shared
            .reader
            .read(|image| block.action(shared.bank.table(), image, map.events(), map.gateway_unit_id()));
        let mut under_way = UnderWay { writers: self, asking, result: command_block::FAILED };
        under_way.result = match action {
            Ok(action) => command_block::result(&self.desk.ask(asking.source(), &authority, action).await),
            Err(result) => {
                let text = format!("the command block asks for nothing that there is: result {result}");
                self.desk.refuse(asking.source(), "command", text);
                result
            }
        };
        Ok(())
    }

    fn finish(&self, shared: &Shared, asking: &Asking, write: &Write) -> Result<Vec<u8>, ExceptionCode> {
        let mut answer = write.echo().to_vec();
        if let Some(read) = write.read {
            self.read(shared, asking, read, &mut answer)?;
        }
        Ok(answer)
    }

    /// Appends a number of bytes and as many bytes.
    fn read(
        &self,
        shared: &Shared,
        asking: &Asking,
        (start, quantity): (u16, u16),
        out: &mut Vec<u8>,
    ) -> Result<(), ExceptionCode> {
        out.push(u8::try_from(quantity * 2).map_err(|_| ExceptionCode::IllegalDataValue)?);
        let bank = &shared.bank;
        if bank.map().is_gateway(asking.unit) && in_block(start, quantity) {
            let block = self.with_block(asking, |block| *block);
            for address in start..start + quantity {
                out.extend_from_slice(&block.get(address - command_block::ADDRESS).to_be_bytes());
            }
            return Ok(());
        }
        let unit = bank.map().unit(asking.unit).ok_or(ExceptionCode::GatewayTargetDevice)?;
        let now = shared.clock.now();
        shared.reader.read(|image| bank.read_registers(image, now, unit, (start, quantity), out))
    }

    fn with_block<T>(&self, asking: &Asking, look: impl FnOnce(&mut Block) -> T) -> T {
        let mut blocks = self.blocks.lock().unwrap_or_else(PoisonError::into_inner);
        look(blocks.entry(Arc::clone(asking.grant.name())).or_default())
    }

    /// A write that asks for nothing that can be written is told of too.
    fn told(&self, asking: &Asking, code: ExceptionCode) -> ExceptionCode {
        let function = asking.pdu.first().copied().unwrap_or_default();
        let text = format!("function {function} at unit {}{}: {code}", asking.unit, place(&asking.pdu));
        self.desk.refuse(asking.source(), "write", text);
        code
    }
}

/// Where a PDU writes, in words; nothing where it is too short to say so.
fn place(pdu: &[u8]) -> String {
    match pdu {
        [23, r1, r0, _, _, w1, w0, ..] => {
            let (read, written) = (u16::from_be_bytes([*r1, *r0]), u16::from_be_bytes([*w1, *w0]));
            format!(", address {written}, to read from {read}")
        }
        [23, ..] => String::new(),
        [_, a1, a0, ..] => format!(", address {}", u16::from_be_bytes([*a1, *a0])),
        _ => String::new(),
    }
}

/// The word of what a PDU asks for.
fn verb(pdu: &[u8]) -> &'static str {
    if is_write(pdu) {
        return "write";
    }
    match general_reference::decode(pdu) {
        Ok(reference) if reference.writes() => "sdo_write",
        Ok(_) => "sdo_read",
        // What is wrong in itself is not known to write.
        Err(_) if general_reference::is_general_reference(pdu) => "sdo_read",
        Err(_) => "read",
    }
}

/// Whether a PDU is of a function that writes.
#[must_use]
pub fn is_write(pdu: &[u8]) -> bool {
    matches!(pdu.first(), Some(5 | 6 | 15 | 16 | 22 | 23))
}

fn in_block(start: u16, quantity: u16) -> bool {
    let end = u32::from(start) + u32::from(quantity);
    start >= command_block::ADDRESS && end <= u32::from(command_block::ADDRESS + command_block::REGISTERS)
}

#[cfg(test)]
#[path = "writers_tests.rs"]
mod tests;
