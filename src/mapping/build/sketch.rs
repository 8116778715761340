//! An installation that stands in no configuration file: for a mapping by itself, and for tests.

use std::collections::BTreeMap;

use super::super::installation::{BusEntry, NodeEntry};
use super::super::{At, Diagnostic, SourceText, TagTable};
use super::{Installation, build};

/// The bus of a sketch.
const BUS: &str = "can0";

/// One bus `can0` and the nodes on it, all that is not said as it is by default. The gateway is called `hall-1` and has unit
/// id 247.
///
/// A sketch goes the way of every installation: [`Sketch::build`] checks what it makes.
#[derive(Clone, Debug)]
pub struct Sketch {
    bus: BusEntry,
    nodes: BTreeMap<At<String>, NodeEntry>,
    mappings: BTreeMap<String, SourceText>,
}

impl Default for Sketch {
    fn default() -> Self {
        Self { bus: BusEntry::virtual_bus(BUS), nodes: BTreeMap::new(), mappings: BTreeMap::new() }
    }
}

impl Sketch {
    /// The bus, and nothing on it.
    #[must_use]
    pub fn new() -> Self {
        Self::default()
    }

    /// Changes the bus.
    #[must_use]
    pub fn bus(mut self, change: impl FnOnce(&mut BusEntry)) -> Self {
        change(&mut self.bus);
        self
    }

    /// Adds a mapping; nodes call it by the name of its text.
    #[must_use]
    pub fn mapping(mut self, source: SourceText) -> Self {
        self.mappings.insert(source.name.clone(), source);
        self
    }

    /// Adds a node and changes its entry. `mapping` is one of the sketch, or a shipped one.
    #[must_use]
    pub fn node(mut self, name: &str, id: u8, mapping: &str, change: impl FnOnce(&mut NodeEntry)) -> Self {
        let mut entry = NodeEntry::new(BUS, id, mapping);
        change(&mut entry);
        self.nodes.insert(At::nowhere(name.to_owned()), entry);
        self
    }

    /// The tag table and the warnings.
    ///
    /// # Errors
    /// Everything that is wrong, warnings included.
    pub fn build(&self) -> Result<(TagTable, Vec<Diagnostic>), Vec<Diagnostic>> {
        build(&Installation {
            gateway: "hall-1",
            gateway_unit_id: 247,
            config: &SourceText::new("", ""),
            buses: &BTreeMap::from([(At::nowhere(BUS.to_owned()), self.bus.clone())]),
            nodes: &self.nodes,
            mappings: &self.mappings,
            listeners: &[],
            lost: &[],
        })
    }
}
