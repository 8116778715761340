//! The objects of a DST P92C with their values, as SDO sees them. Pure.

use std::collections::BTreeMap;

use super::super::sdo_server::{Abort, Dictionary};
use super::object_table::{Access, Entry, Key, Range, TABLE, Type, find, has_object};
use super::settings::DstSettings;
use super::store::Store;
use super::units;
use crate::canopen::NodeId;

/// The objects that TPDO1 can carry, as mapping entries (R-DST-018).
pub const MAPPABLE: [u32; 6] = [0x9130_0120, 0x6130_0120, 0x6150_0108, 0x9130_0220, 0x6130_0220, 0x6150_0208];

/// Sub-indices of 0x1A00 that hold mapping entries.
const MAPPING_SUBS: std::ops::RangeInclusive<u8> = 1..=4;

/// The objects.
#[derive(Clone, Debug)]
pub struct Objects {
    node: NodeId,
    transmission_type: u8,
    identity: [u32; 3],
    values: BTreeMap<Key, u32>,
    /// Values that somebody has set against the plant, and SDO accesses that fail because somebody wants them to.
    overrides: BTreeMap<Key, u32>,
    aborts: BTreeMap<Key, Abort>,
    written: Option<Key>,
}

impl Objects {
    /// The objects with their defaults, for a device of this serial number.
    #[must_use]
    pub fn new(settings: &DstSettings, node: NodeId, serial_number: u32) -> Self {
        Self {
            node,
            transmission_type: settings.default_transmission_type,
            identity: [settings.product_code, settings.revision, serial_number],
            values: BTreeMap::new(),
            overrides: BTreeMap::new(),
            aborts: BTreeMap::new(),
            written: None,
        }
    }

    /// As after a reset: defaults, and over them what is stored. `only` chooses the indices; the others stay.
    pub fn load(&mut self, store: &Store, only: impl Fn(u16) -> bool) {
        for entry in TABLE.iter().filter(|entry| only(entry.key.0)) {
            self.values.insert(entry.key, self.default(entry));
        }
        self.values.extend(store.parameters().filter(|(key, _)| only(key.0)));
        for (key, value) in [((0x4F00, 0), store.bit_rate), ((0x4F01, 0), store.node.get())] {
            if only(key.0) {
                self.values.insert(key, u32::from(value));
            }
        }
    }

    /// Gives the device another node id; identifiers that follow it follow (R-DST-004).
    pub fn set_node(&mut self, node: NodeId) {
        let follows = self.raw((0x1800, 1)) == self.default_of((0x1800, 1));
        self.node = node;
        for key in [(0x1014, 0), (0x1800, 1)] {
            if follows || key != (0x1800, 1) {
                self.values.insert(key, self.default_of(key));
            }
        }
    }

    /// The default of an entry in this device.
    #[must_use]
    pub fn default_of(&self, key: Key) -> u32 {
        find(key).map_or(0, |entry| self.default(entry))
    }

    fn default(&self, entry: &Entry) -> u32 {
        let node = u32::from(self.node.get());
        let [product, revision, serial] = self.identity;
        match entry.key {
            (0x1014, 0) => 0x80 + node,
            (0x1018, 2) => product,
            (0x1018, 3) => revision,
            (0x1018, 4) => serial,
            (0x1800, 1) => 0x180 + node,
            (0x1800, 2) => u32::from(self.transmission_type),
            _ => entry.default,
        }
    }

    /// All values, as they are kept.
    #[must_use]
    pub fn values(&self) -> &BTreeMap<Key, u32> {
        &self.values
    }

    /// The bits of a number, 0 where there is none.
    #[must_use]
    pub fn raw(&self, key: Key) -> u32 {
        self.overrides.get(&key).or_else(|| self.values.get(&key)).copied().unwrap_or_default()
    }

    /// A number with a sign.
    #[must_use]
    pub fn signed(&self, key: Key) -> i32 {
        self.raw(key).cast_signed()
    }

    /// A float.
    #[must_use]
    pub fn float(&self, key: Key) -> f64 {
        f64::from(f32::from_bits(self.raw(key)))
    }

    /// Puts a number of the device's own; nobody is asked.
    pub fn put(&mut self, key: Key, raw: u32) {
        self.values.insert(key, raw);
    }

    /// Sets a number against the plant and against its access, or gives it back. Of a parameter: as if somebody had written
    /// it, or its default.
    pub fn set(&mut self, key: Key, raw: Option<u32>) {
        let parameter = find(key).is_some_and(|entry| entry.access == Access::Rw);
        match raw {
            _ if parameter => self.put(key, raw.unwrap_or_else(|| self.default_of(key))),
            Some(raw) => {
                self.overrides.insert(key, raw);
            }
            None => {
                self.overrides.remove(&key);
            }
        }
    }

    /// Lets each access to an entry fail, or no longer.
    pub fn set_abort(&mut self, key: Key, code: Option<Abort>) {
        match code {
            Some(code) => self.aborts.insert(key, code),
            None => self.aborts.remove(&key),
        };
    }

    /// Ends everything that was set against the plant, and all wanted aborts.
    pub fn clear(&mut self) {
        self.overrides.clear();
        self.aborts.clear();
    }

    /// The entry that SDO has written since the last call.
    pub fn take_written(&mut self) -> Option<Key> {
        self.written.take()
    }

    /// The bytes of a number, least significant first (R-DST-012), for SDO and PDO alike.
    #[must_use]
    pub fn number(&self, key: Key) -> Vec<u8> {
        let length = find(key).and_then(|entry| entry.kind.length()).unwrap_or_default();
        self.raw(key).to_le_bytes().into_iter().take(length).collect()
    }

    fn text(&self, key: Key) -> Vec<u8> {
        match key {
            (0x1008, _) => b"DST P92C CANopen".to_vec(),
            (0x1009, _) => b"1.00r1".to_vec(),
            (0x100A, _) => b"1.02r3".to_vec(),
            _ => {
                let part = |sub| self.raw((0x4E00, sub));
                format!("{}.{}.{}", part(1), part(2), part(3)).into_bytes()
            }
        }
    }

    /// R-DST-008.
    fn entry(&self, key: Key) -> Result<&'static Entry, Abort> {
        let missing = || if has_object(key.0) { Abort::NO_SUB_INDEX } else { Abort::NO_OBJECT };
        let entry = find(key).ok_or_else(missing)?;
        self.aborts.get(&key).map_or(Ok(entry), |code| Err(*code))
    }

    /// Whether a number may be written (R-DST-011).
    fn admit(&self, entry: &Entry, raw: u32) -> Result<(), Abort> {
        let within = |allowed: bool| if allowed { Ok(()) } else { Err(Abort::RANGE) };
        match entry.range {
            Range::Any => within(entry.kind != Type::F32 || f32::from_bits(raw).is_finite()),
            Range::Only(numbers) => within(numbers.contains(&raw)),
            Range::Between(low, high) => within((low..=high).contains(&raw)),
            Range::CobId => within((1..=0x7FF).contains(&raw)),
            Range::PdoCobId => within((1..=0x7FF).contains(&(raw & 0x3FFF_FFFF))),
            Range::PressureUnit => within(units::pressure(raw).is_some()),
            Range::PressureDigits => {
                let most = units::pressure(self.raw((0x6131, 1))).map_or(0, |unit| unit.most_digits);
                within(raw <= most)
            }
            Range::Mapping => self.admit_mapping_entry(raw),
            Range::Special => self.admit_mapping_count(raw),
        }
    }

    fn admit_mapping_entry(&self, raw: u32) -> Result<(), Abort> {
        if self.raw((0x1A00, 0)) != 0 {
            return Err(Abort::INCOMPATIBLE);
        }
        if raw == 0 || MAPPABLE.contains(&raw) { Ok(()) } else { Err(Abort::NOT_MAPPABLE) }
    }

    fn admit_mapping_count(&self, count: u32) -> Result<(), Abort> {
        let subs = MAPPING_SUBS.take_while(|sub| u32::from(*sub) <= count);
        let mapped: Vec<u32> = subs.map(|sub| self.raw((0x1A00, sub))).collect();
        if count > u32::from(*MAPPING_SUBS.end()) || mapped.iter().map(|entry| entry & 0xFF).sum::<u32>() > 64
        {
            return Err(Abort::PDO_LENGTH);
        }
        if mapped.contains(&0) { Err(Abort::NOT_MAPPABLE) } else { Ok(()) }
    }

    /// What else changes with an entry.
    fn follow_up(&mut self, key: Key, raw: u32) {
        match key {
            // Digits that the new unit does not allow would make the number mean nothing.
            (0x6131, 1) => {
                let most = units::pressure(raw).map_or(0, |unit| unit.most_digits);
                if self.raw((0x6132, 1)) > most {
                    self.put((0x6132, 1), 0);
                }
            }
            // R-DST-017.
            (0x1A00, 0) if raw != 0 => {
                for sub in MAPPING_SUBS.filter(|sub| u32::from(*sub) > raw) {
                    self.put((0x1A00, sub), 0);
                }
            }
            (0x1003, 0) => self.put((0x1003, 1), 0),
            _ => {}
        }
    }
}

impl Dictionary for Objects {
    fn read(&mut self, index: u16, sub: u8) -> Result<Vec<u8>, Abort> {
        let entry = self.entry((index, sub))?;
        match (entry.access, entry.kind) {
            (Access::Wo, _) => Err(Abort::WRITE_ONLY),
            (Access::Ro | Access::Rw, Type::Text) => Ok(self.text(entry.key)),
            (Access::Ro | Access::Rw, _) => Ok(self.number(entry.key)),
        }
    }

    fn may_write(&self, index: u16, sub: u8) -> Result<Option<usize>, Abort> {
        let entry = self.entry((index, sub))?;
        match entry.access {
            Access::Ro => Err(Abort::READ_ONLY),
            Access::Wo | Access::Rw => Ok(entry.kind.length()),
        }
    }

    fn write(&mut self, index: u16, sub: u8, data: &[u8]) -> Result<(), Abort> {
        let entry = self.entry((index, sub))?;
        let mut bytes = [0; 4];
        for (to, byte) in bytes.iter_mut().zip(data) {
            *to = *byte;
        }
        let raw = u32::from_le_bytes(bytes);
        self.admit(entry, raw)?;
        // Commands are carried out, not kept.
        let command = matches!(entry.key, (0x1010 | 0x1011 | 0x6125, 1));
        if !command {
            self.put(entry.key, raw);
            self.follow_up(entry.key, raw);
        }
        self.written = Some(entry.key);
        Ok(())
    }
}
