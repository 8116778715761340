//! The non-volatile memory of a DST P92C: what survives without power (section 10 of the requirements). Pure.

use std::collections::BTreeMap;

use super::object_table::{Access, Key, TABLE};
use crate::canopen::NodeId;

/// The memory. What is not in it has its default.
#[derive(Clone, Debug, PartialEq)]
pub struct Store {
    parameters: BTreeMap<Key, u32>,
    /// Pressure that is shown as 0, in Pa (R-DST-086).
    pub zero_pa: f64,
    /// 0x4F01, 1..=127.
    pub node: NodeId,
    /// 0x4F00.
    pub bit_rate: u8,
}

/// What the factory stores (R-DST-002, R-DST-003).
const FACTORY_BIT_RATE: u8 = 4;

impl Store {
    /// The memory of a device that was given its address and nothing else.
    #[must_use]
    pub fn new(node: NodeId, bit_rate: u8) -> Self {
        Self { parameters: BTreeMap::new(), zero_pa: 0.0, node, bit_rate }
    }

    /// Forgets everything (R-DST-085): all parameters, of which the address is one.
    pub fn restore_defaults(&mut self) {
        if let Some(factory_node) = NodeId::new(1) {
            *self = Self::new(factory_node, FACTORY_BIT_RATE);
        }
    }

    /// Keeps all parameters (R-DST-084).
    ///
    /// `default` is what an entry has without being kept: what has it is not kept, so that an identifier that follows the
    /// node id goes on to follow it (R-DST-004), and one that was written does not (R-DST-119).
    pub fn save(&mut self, values: &BTreeMap<Key, u32>, zero_pa: f64, default: impl Fn(Key) -> u32) {
        let kept = values.iter().filter(|(key, value)| is_parameter(**key) && default(**key) != **value);
        self.parameters = kept.map(|(key, value)| (*key, *value)).collect();
        self.zero_pa = zero_pa;
        self.keep_address(values);
    }

    /// Keeps node id and bit rate alone.
    pub fn keep_address(&mut self, values: &BTreeMap<Key, u32>) {
        let byte = |key| values.get(&key).and_then(|value| u8::try_from(*value).ok());
        self.node = byte((0x4F01, 0)).and_then(NodeId::new).unwrap_or(self.node);
        self.bit_rate = byte((0x4F00, 0)).unwrap_or(self.bit_rate);
    }

    /// What is kept, but for the address.
    pub fn parameters(&self) -> impl Iterator<Item = (Key, u32)> {
        self.parameters.iter().map(|(key, value)| (*key, *value))
    }
}

/// Entries that "save" keeps: all that can be written and read, but for those that are commands.
fn is_parameter(key: Key) -> bool {
    let command = matches!(key, (0x1003, 0) | (0x1010 | 0x1011, 1));
    let address = matches!(key, (0x4F00 | 0x4F01, 0));
    !command && !address && TABLE.iter().any(|entry| entry.key == key && entry.access == Access::Rw)
}
