//! The step that reads a PDO's parameters and changes them where asked (R-DST-020..024, R-DST-119).
//!
//! Here told of a TPDO; with an RPDO it is the same at 0x1400 and 0x1600.
//!
//! Read are 0x1800:1 (COB-ID), :2 (transmission type), :3 (inhibit time), :5 (event timer) and all entries of 0x1A00. What
//! differs is written in the order of CiA 301: the PDO may be marked not valid, 0x1A00:0 = 0, the entries, the unused ones
//! zero, 0x1A00:0 = their number, the PDO valid again, with the other bits of its COB-ID as they were. Then all is read
//! once more: what counts is what the node says.

use super::task::{Advance, Answer};
use super::{BootEvent, BootFailure, MappedPdo, MappingMode, PdoSetup};
use crate::canopen::cob_id;
use crate::canopen::object::{MappedObject, ObjectId};
use crate::canopen::sdo::{SdoError, SdoRequest};

/// The bit of a COB-ID in 0x1800:1 of a PDO that is not sent.
const NOT_VALID: u32 = 1 << 31;
/// A mapping has at most so many entries; beyond are multiplexed PDOs.
const MOST_ENTRIES: u8 = 64;

/// A TPDO that is being looked at.
#[derive(Debug)]
pub(super) struct PdoTask {
    setup: PdoSetup,
    /// It is an RPDO.
    received: bool,
    phase: Phase,
    found: Found,
    /// What is still to be written, the next one last.
    writes: Vec<(ObjectId, Vec<u8>)>,
    /// The object of the last request.
    asked: ObjectId,
    /// Everything was written and is read for the second time.
    second: bool,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Phase {
    Begin,
    /// Which parameter is awaited: sub-index of 0x1800.
    Parameter(u8),
    Count,
    /// Which entry of 0x1A00 is awaited.
    Entry(u8),
    /// The last write is awaited.
    Write,
    /// Its success was told; the next one follows.
    Wrote,
    /// A deviation was told.
    Deviation,
    Told,
}

/// What the node says.
#[derive(Debug, Default)]
struct Found {
    cob_id: u32,
    transmission_type: u8,
    inhibit_time: Option<u16>,
    event_timer: Option<u16>,
    count: u8,
    maps: Vec<MappedObject>,
}

impl PdoTask {
    /// `received`: it is an RPDO of the node.
    pub(super) fn new(setup: PdoSetup, received: bool) -> Self {
        Self {
            setup,
            received,
            phase: Phase::Begin,
            found: Found::default(),
            writes: Vec::new(),
            asked: ObjectId::default(),
            second: false,
        }
    }

    pub(super) fn advance(&mut self, answer: Answer, may_run: bool) -> Advance {
        match (self.phase, answer) {
            (Phase::Begin, _) => self.read(Phase::Parameter(1)),
            (Phase::Parameter(sub), Some(answer)) => self.parameter(sub, answer),
            (Phase::Count, Some(answer)) => self.count(answer, may_run),
            (Phase::Entry(entry), Some(answer)) => self.entry(entry, answer, may_run),
            (Phase::Write, Some(Ok(_))) => {
                self.phase = Phase::Wrote;
                Advance::Wrote(self.asked)
            }
            (Phase::Write, Some(Err(error))) => Advance::failed(self.asked, error),
            // The node is pre-operational now, or the last write was told.
            (Phase::Write | Phase::Wrote, None) => self.write(),
            (Phase::Deviation, _) => self.tell(),
            (Phase::Told, _)
            | (Phase::Wrote, Some(_))
            | (Phase::Parameter(_) | Phase::Count | Phase::Entry(_), None) => Advance::Done,
        }
    }

    fn communication(&self, sub: u8) -> ObjectId {
        let first: u16 = if self.received { 0x1400 } else { 0x1800 };
        ObjectId::new(first.saturating_add(self.setup.number.saturating_sub(1)), sub)
    }

    fn mapping(&self, sub: u8) -> ObjectId {
        let first: u16 = if self.received { 0x1600 } else { 0x1A00 };
        ObjectId::new(first.saturating_add(self.setup.number.saturating_sub(1)), sub)
    }

    fn read(&mut self, phase: Phase) -> Advance {
        self.phase = phase;
        let (object, len) = match phase {
            Phase::Parameter(1) => (self.communication(1), 4),
            Phase::Parameter(2) => (self.communication(2), 1),
            Phase::Parameter(sub) => (self.communication(sub), 2),
            Phase::Entry(entry) => (self.mapping(entry), 4),
            Phase::Begin | Phase::Count | Phase::Write | Phase::Wrote | Phase::Deviation | Phase::Told => {
                (self.mapping(0), 1)
            }
        };
        self.asked = object;
        Advance::Ask(SdoRequest::read(object).of_len(len))
    }

    fn parameter(&mut self, sub: u8, answer: Result<Vec<u8>, SdoError>) -> Advance {
        let number = match answer {
            Ok(data) => match number(self.asked, &data) {
                Ok(number) => Some(number),
                Err(failure) => return Advance::Failed(failure),
            },
            // Inhibit time and event timer need not be there.
            Err(SdoError::Abort(_)) if sub > 2 => None,
            Err(error) => return Advance::failed(self.asked, error),
        };
        let short = number.and_then(|number| u16::try_from(number).ok());
        match sub {
            1 => self.found.cob_id = number.unwrap_or_default(),
            2 => self.found.transmission_type = number.and_then(narrow).unwrap_or_default(),
            3 => self.found.inhibit_time = short,
            _ => self.found.event_timer = short,
        }
        match sub {
            1 => self.read(Phase::Parameter(2)),
            2 => self.read(Phase::Parameter(3)),
            3 => self.read(Phase::Parameter(5)),
            _ => self.read(Phase::Count),
        }
    }

    fn count(&mut self, answer: Result<Vec<u8>, SdoError>, may_run: bool) -> Advance {
        let count = match answer.map(|data| number(self.asked, &data)) {
            Ok(Ok(count)) => u8::try_from(count).unwrap_or(u8::MAX),
            Ok(Err(failure)) => return Advance::Failed(failure),
            Err(error) => return Advance::failed(self.asked, error),
        };
        self.found.count = count;
        self.found.maps.clear();
        // 254 and 255 are multiplexed PDOs, which carry no fixed content.
        if count == 0 || count > MOST_ENTRIES { self.compare(may_run) } else { self.read(Phase::Entry(1)) }
    }

    fn entry(&mut self, entry: u8, answer: Result<Vec<u8>, SdoError>, may_run: bool) -> Advance {
        match answer.map(|data| number(self.asked, &data)) {
            Ok(Ok(value)) => self.found.maps.push(MappedObject::from_entry(value)),
            Ok(Err(failure)) => return Advance::Failed(failure),
            Err(error) => return Advance::failed(self.asked, error),
        }
        if entry < self.found.count { self.read(Phase::Entry(entry + 1)) } else { self.compare(may_run) }
    }

    /// Everything is read.
    fn compare(&mut self, may_run: bool) -> Advance {
        self.writes = self.differences();
        if self.writes.is_empty() || matches!(self.setup.mode, MappingMode::Adopt { .. }) {
            return self.tell();
        }
        if self.setup.mode == MappingMode::Verify {
            if self.received {
                return self.tell();
            }
            self.phase = Phase::Deviation;
            return Advance::Tell(BootEvent::Deviation { pdo: self.setup.pdo });
        }
        if self.second {
            let object = self.writes.last().map_or(self.asked, |(object, _)| *object);
            return Advance::Failed(BootFailure::NotKept { object });
        }
        self.phase = Phase::Write;
        if may_run { Advance::EnterPreOperational } else { self.write() }
    }

    /// What has to be written, the first one last.
    fn differences(&self) -> Vec<(ObjectId, Vec<u8>)> {
        let (setup, found) = (&self.setup, &self.found);
        let mut writes = Vec::new();
        if let Some(wanted) = setup.transmission_type.filter(|wanted| *wanted != found.transmission_type) {
            writes.push((self.communication(2), vec![wanted]));
        }
        if let Some(wanted) = setup.inhibit_time.filter(|wanted| Some(*wanted) != found.inhibit_time) {
            writes.push((self.communication(3), wanted.to_le_bytes().to_vec()));
        }
        if let Some(wanted) = setup.event_timer.filter(|wanted| Some(*wanted) != found.event_timer) {
            writes.push((self.communication(5), wanted.to_le_bytes().to_vec()));
        }
        if !setup.maps.is_empty() && setup.maps != found.maps {
            let cob_id = |bits: u32| (self.communication(1), bits.to_le_bytes().to_vec());
            if setup.set_invalid {
                writes.push(cob_id(found.cob_id | NOT_VALID));
            }
            writes.push((self.mapping(0), vec![0]));
            // Entries that the node had and that are not wanted any more are zero (R-DST-017).
            let wanted = setup.maps.iter().map(|object| object.entry()).chain(std::iter::repeat(0));
            let last = setup.maps.len().max(found.maps.len());
            for (entry, sub) in wanted.take(last).zip(1_u8..) {
                writes.push((self.mapping(sub), entry.to_le_bytes().to_vec()));
            }
            writes.push((self.mapping(0), vec![u8::try_from(setup.maps.len()).unwrap_or(MOST_ENTRIES)]));
            if setup.set_invalid {
                writes.push(cob_id(found.cob_id & !NOT_VALID));
            }
        }
        writes.reverse();
        writes
    }

    fn write(&mut self) -> Advance {
        let Some((object, data)) = self.writes.pop() else {
            self.second = true;
            return self.read(Phase::Parameter(1));
        };
        self.phase = Phase::Write;
        self.asked = object;
        Advance::Ask(SdoRequest::write(object, data).repeatable())
    }

    fn tell(&mut self) -> Advance {
        self.phase = Phase::Told;
        let found = &mut self.found;
        let mapped = MappedPdo {
            pdo: self.setup.pdo,
            cob_id: cob_id::in_use(found.cob_id),
            maps: std::mem::take(&mut found.maps),
            transmission_type: found.transmission_type,
            event_timer: found.event_timer.unwrap_or_default(),
        };
        Advance::Tell(if self.received { BootEvent::RpdoMapped(mapped) } else { BootEvent::Mapped(mapped) })
    }
}

fn narrow(number: u32) -> Option<u8> {
    u8::try_from(number).ok()
}

/// A number of 1 to 4 bytes.
fn number(object: ObjectId, data: &[u8]) -> Result<u32, BootFailure> {
    let mut bytes = [0; 4];
    match bytes.get_mut(..data.len()) {
        Some(place) if !data.is_empty() => place.copy_from_slice(data),
        _ => return Err(BootFailure::Length { object, length: data.len() }),
    }
    Ok(u32::from_le_bytes(bytes))
}
