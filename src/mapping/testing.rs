//! Tag tables for tests.

use std::collections::BTreeMap;

use super::installation::{BusEntry, NodeEntry};
use super::{At, Installation, SourceText, TagTable, build};

/// One bus `can0` with a DetCon of each name, in the order of their names, with node ids 1, 2, 3 and so on.
///
/// # Panics
///
/// Where the shipped mapping has a problem.
#[must_use]
pub fn detcon(nodes: &[&str]) -> TagTable {
    let mut nodes = nodes.to_vec();
    nodes.sort_unstable();
    let at = |text: &str| At::nowhere(text.to_owned());
    let buses = BTreeMap::from([(at("can0"), BusEntry::virtual_bus("can0"))]);
    let nodes = (1..)
        .zip(nodes)
        .map(|(id, name)| (at(name), NodeEntry::new("can0", id, "motortech-detcon")))
        .collect();
    let installation = Installation {
        gateway: "test",
        gateway_unit_id: 247,
        config: &SourceText::new("test.toml", ""),
        buses: &buses,
        nodes: &nodes,
        mappings: &BTreeMap::new(),
        lost: &[],
    };
    match build(&installation) {
        Ok((table, warnings)) => {
            assert_eq!(warnings, []);
            table
        }
        Err(problems) => panic!("{problems:#?}"),
    }
}
