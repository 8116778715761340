//! The register map as IEC 61131-3 structured text: addresses as constants, so that no program has to know numbers.

use std::collections::BTreeSet;
use std::fmt::Write as _;

use super::gateway_block::MAP_VERSION;
use super::{Point, RegisterMap};

/// A list of global constants: for each point the address on the wire, for each node its unit id, and the hash of the map
/// to compare with registers 21-22 of the gateway.
#[must_use]
pub fn structured_text(map: &RegisterMap) -> String {
    let (hash, letters) = (map.hash_text(), map.word_order().letters());
    let short_hash = hash.get(..8).unwrap_or_default().to_uppercase();
    let mut text = format!(
        "(* Register map {hash} of cangate, version {MAP_VERSION}: addresses as on the wire, from 0; 32-bit values {letters}. *)\n\
         (* Written by `cangate map --format st`: make it anew instead of editing it. *)\n\
         VAR_GLOBAL CONSTANT\n    CANGATE_MAP_HASH : DWORD := 16#{short_hash}; (* registers 21-22 of the gateway *)\n"
    );
    let mut names = BTreeSet::from(["CANGATE_MAP_HASH".to_owned()]);
    let mut owner = None;
    for point in map.points() {
        let prefix = if point.node.is_empty() { "cangate" } else { &point.node };
        if owner != Some(&point.node) {
            owner = Some(&point.node);
            let name = unique(&mut names, identifier(&format!("{prefix}_unit_id")));
            let _infallible = writeln!(text, "\n    {name} : BYTE := {};", point.unit_id);
        }
        let name = unique(&mut names, identifier(&format!("{prefix}_{}_{}", point.tag, point.kind)));
        let _infallible = writeln!(text, "    {name} : UINT := {}; (* {} *)", point.address, comment(point));
    }
    text.push_str("END_VAR\n");
    text
}

/// An identifier of the standard: letters, digits and single underscores, not beginning with a digit. Case means nothing
/// there, so it is all capitals here.
fn identifier(name: &str) -> String {
    let words = name.split(|c: char| !c.is_ascii_alphanumeric()).filter(|word| !word.is_empty());
    let name = words.collect::<Vec<_>>().join("_").to_ascii_uppercase();
    if name.starts_with(|c: char| c.is_ascii_digit()) { format!("N_{name}") } else { name }
}

/// Two names of the configuration can be one identifier (`pump-a` and `pump_a`): the second gets a number.
fn unique(taken: &mut BTreeSet<String>, name: String) -> String {
    let numbered = (2..).map(|number: u32| format!("{name}_{number}"));
    let free = std::iter::once(name.clone()).chain(numbered).find(|name| !taken.contains(name));
    let free = free.unwrap_or(name);
    taken.insert(free.clone());
    free
}

fn comment(point: &Point) -> String {
    let mut text = point.table.word().replace('_', " ");
    if point.scale.to_string() != "1" || !point.engineering_unit.is_empty() {
        let _infallible = write!(text, ", {} {}", point.scale, point.engineering_unit);
    }
    let _infallible = write!(text, ": {}", point.description);
    text.replace("*)", "* )").replace("(*", "( *").replace(['\n', '\r'], " ")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn identifiers_are_those_of_the_standard_and_each_is_given_once() {
        assert_eq!(identifier("1-pump_node.heartbeat__u16"), "N_1_PUMP_NODE_HEARTBEAT_U16");
        let mut taken = BTreeSet::new();
        let given = ["pump-a", "pump_a", "PUMP.A"].map(|name| unique(&mut taken, identifier(name)));
        assert_eq!(given, ["PUMP_A", "PUMP_A_2", "PUMP_A_3"]);
    }
}
