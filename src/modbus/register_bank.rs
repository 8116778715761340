//! Reads registers and bits out of the process image. One call reads at one moment.

use std::sync::Arc;

use super::encoding::Cell;
use super::gateway_block::{GatewayView, bus_register};
use super::heartbeat::Heartbeats;
use super::line_text;
use super::node_block::NodeView;
use super::pdu::ExceptionCode;
use super::register_map::{BitShow, RegisterMap, RegisterShow, TagRegister, Unit};
use crate::mapping::{OnLoss, TagTable};
use crate::process_image::{AlarmIndex, AlarmState, NodeIndex, ProcessImage, Quality, Sample, Value};
use crate::time::Now;

/// The register map joined to what it shows.
#[derive(Debug)]
pub struct RegisterBank {
    table: Arc<TagTable>,
    map: Arc<RegisterMap>,
    heartbeats: Heartbeats,
}

impl RegisterBank {
    /// `map` must have been built from `table`.
    #[must_use]
    pub fn new(table: Arc<TagTable>, map: Arc<RegisterMap>) -> Self {
        let heartbeats = Heartbeats::new(table.nodes.len());
        Self { table, map, heartbeats }
    }

    /// Nodes and tags.
    #[must_use]
    pub fn table(&self) -> &TagTable {
        &self.table
    }

    /// The register map.
    #[must_use]
    pub fn map(&self) -> &RegisterMap {
        &self.map
    }

    /// The heartbeat registers go on where those of `old` stood; `from` tells for each node its place there.
    pub fn go_on_from(&self, old: &Self, from: &[Option<NodeIndex>]) {
        self.heartbeats.go_on_from(&old.heartbeats, from);
    }

    /// To be called once a second.
    pub fn tick(&self, image: &ProcessImage, now: Now) {
        self.heartbeats.tick(&self.table, image, now);
    }

    /// Appends `quantity` registers, two bytes each.
    ///
    /// # Errors
    /// 02 outside the published blocks; 0B where invalid data is touched and the node's `on_loss` is `exception`. What
    /// was appended then is to be thrown away.
    pub fn read_registers(
        &self,
        image: &ProcessImage,
        now: Now,
        unit: &Unit,
        (start, quantity): (u16, u16),
        out: &mut Vec<u8>,
    ) -> Result<(), ExceptionCode> {
        let entries = unit.registers.read(start, quantity).ok_or(ExceptionCode::IllegalDataAddress)?;
        let first = out.len();
        out.resize(first + usize::from(quantity) * 2, 0);
        let body = out.get_mut(first..).unwrap_or_default();
        let mut put = |address: u32, word: u16| {
            let place = address.checked_sub(start.into()).and_then(|place| usize::try_from(place).ok());
            let bytes = place.and_then(|place| body.get_mut(place * 2..place * 2 + 2));
            if let Some(bytes) = bytes {
                bytes.copy_from_slice(&word.to_be_bytes());
            }
        };
        for entry in entries {
            let (word, second) = self.cell(image, now, &entry.show)?.registers(self.map.word_order());
            put(entry.address, word);
            if let Some(second) = second {
                put(entry.address + 1, second);
            }
        }
        Ok(())
    }

    /// Appends `quantity` bits, eight to a byte, the first lowest.
    ///
    /// # Errors
    /// As for registers.
    pub fn read_bits(
        &self,
        image: &ProcessImage,
        unit: &Unit,
        (start, quantity): (u16, u16),
        out: &mut Vec<u8>,
    ) -> Result<(), ExceptionCode> {
        let entries = unit.bits.read(start, quantity).ok_or(ExceptionCode::IllegalDataAddress)?;
        let first = out.len();
        out.resize(first + usize::from(quantity.div_ceil(8)), 0);
        let body = out.get_mut(first..).unwrap_or_default();
        for entry in entries {
            let place = entry.address.checked_sub(start.into()).and_then(|place| usize::try_from(place).ok());
            if let Some(place) = place
                && let Some(byte) = body.get_mut(place / 8)
                && self.bit(image, &entry.show)?
            {
                *byte |= 1 << (place % 8);
            }
        }
        Ok(())
    }

    fn cell(&self, image: &ProcessImage, now: Now, show: &RegisterShow) -> Result<Cell, ExceptionCode> {
        Ok(match show {
            RegisterShow::Tag(register) => tag_cell(image.tag(register.tag), register)?,
            RegisterShow::Node(node, show) => {
                let view = NodeView::new(&self.table, image, *node, now);
                view.map_or(Cell::Word(0), |view| view.register(*show, self.heartbeats.node(*node)))
            }
            RegisterShow::Gateway(show) => {
                let view = GatewayView { table: &self.table, image, now, map_hash: self.map.hash() };
                view.register(*show, self.heartbeats.gateway())
            }
            RegisterShow::Bus(bus, show) => {
                image.buses.get(*bus).map_or(Cell::Word(0), |bus| bus_register(bus, *show))
            }
            RegisterShow::Line(register) => line_text::cell(image, register)?,
            RegisterShow::NewestEvent => Cell::low_double(image.journal.newest()),
            RegisterShow::Event(place, field) => self.map.events().register(image, *place, *field),
        })
    }

    /// A bit. It has no pattern for "invalid": it keeps its last value, and its validity bit drops.
    fn bit(&self, image: &ProcessImage, show: &BitShow) -> Result<bool, ExceptionCode> {
        let any = |alarms: &[AlarmIndex], such: fn(AlarmState) -> bool| {
            alarms.iter().any(|alarm| image.alarm(*alarm).is_some_and(|alarm| such(alarm.state)))
        };
        Ok(match show {
            BitShow::Tag(register) => {
                let sample = image.tag(register.tag);
                let lost = unusable(sample.quality, register)?.is_some();
                sample.value.is_true() && !(lost && register.zero_on_bad)
            }
            BitShow::Validity { vouches_for } => vouches_for.iter().all(|tag| {
                let def = self.table.tag(*tag);
                def.is_some_and(|def| def.objection(image, image.tag(*tag)).is_none())
            }),
            BitShow::Active(alarms) => any(alarms, AlarmState::is_active),
            BitShow::Unacknowledged(alarms) => any(alarms, AlarmState::is_unacknowledged),
        })
    }
}

/// The registers of a tag.
fn tag_cell(sample: &Sample, register: &TagRegister) -> Result<Cell, ExceptionCode> {
    let zero = (Value::Unsigned(0), Value::Unsigned(0), true);
    let (value, raw, usable) = match unusable(sample.quality, register)? {
        None => (sample.value, sample.raw, true),
        Some(Instead::Invalid) => (sample.value, sample.raw, false),
        Some(Instead::Zero) => zero,
    };
    Ok(Cell::of_value(register.encoding, register.resolution, value, raw, usable))
}

/// What is shown instead of a value.
enum Instead {
    Invalid,
    Zero,
}

/// What is to be shown instead of the value; `None` = the value. A value that was never received cannot be held.
fn unusable(quality: Quality, register: &TagRegister) -> Result<Option<Instead>, ExceptionCode> {
    if quality.is_usable() {
        return Ok(None);
    }
    match register.on_loss {
        OnLoss::Exception => Err(ExceptionCode::GatewayTargetDevice),
        OnLoss::Hold if register.zero_on_bad => Ok(Some(Instead::Zero)),
        OnLoss::Hold if quality != Quality::NEVER => Ok(None),
        OnLoss::Hold | OnLoss::Invalid => Ok(Some(Instead::Invalid)),
    }
}
